"""Who is let in beyond loopback: the running command, asked over the network."""

import contextlib
import re
import socket
import socketserver
import threading
import urllib.error
import urllib.request

import pytest
from command_tools import refused
from ros_tools import command, end

pytest.importorskip("nicegui", reason="nicegui is not installed (pip install '.[dashboard]')")
client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
exceptions = pytest.importorskip("websockets.exceptions")

GUARDED = ("/", "/metrics", "/events.csv", "/estimates.csv",
           "/_nicegui_ws/socket.io/?EIO=4&transport=polling")


class NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *arguments):
        return None


@pytest.fixture(scope="module")
def served():
    """The command on all addresses; gives its own address and the token that it made."""
    with command("dashboard", "--host", "0.0.0.0", "--port", 0, "--metrics",
                 "--name", "Proxy.example") as process:
        line = process.stdout.readline()
        found = re.fullmatch(r"dashboard: http://([^/:]+):(\d+)/\?token=([\w-]{32})\n", line)
        assert found, line or process.stderr.read()
        assert found[1] == socket.gethostname()
        yield f"http://127.0.0.1:{found[2]}", found[3]
        end(process)


def ask(address, path, **headers):
    """Return status, headers and text of an answer; a redirection is not followed."""
    request = urllib.request.Request(address + path, headers=headers)
    try:
        answer = urllib.request.build_opener(NoRedirect).open(request, timeout=10)
    except urllib.error.HTTPError as refused:
        answer = refused
    with answer:
        return answer.status, answer.headers, answer.read().decode()


def connect(address, **options):
    return client.connect(address.replace("http", "ws")
                          + "/_nicegui_ws/socket.io/?EIO=4&transport=websocket", **options)


@pytest.mark.parametrize("path", GUARDED)
def test_without_the_token_nothing_is_told(served, path):
    address, token = served
    wrong = token[:-1] + ("a" if token[-1] != "a" else "b")
    more = "&" if "?" in path else "?"
    for asked, headers in ((path, {}), (f"{path}{more}token={wrong}", {}),
                           (f"{path}{more}token=", {}), (f"{path}{more}token=%ff%00", {}),
                           (path, {"Authorization": f"Bearer {wrong}"}),
                           (path, {"Cookie": f"eha_monitor_{address[-5:]}={token}"})):
        status, told, text = ask(address, asked, **headers)
        assert status == 401 and told["WWW-Authenticate"] == "Bearer", asked
        assert "?token=" in text and token not in text and "Set-Cookie" not in told
    status, _, text = ask(address, path, Authorization=f"Bearer {token}")
    assert status == 200 and text


def test_the_first_visit_leaves_a_cookie_and_no_token_in_the_address(served):
    address, token = served
    status, told, _ = ask(address, f"/?actuator=left&token={token}")
    assert (status, told["Location"]) == (303, "/?actuator=left")
    cookie = told["Set-Cookie"]
    assert token not in cookie and "HttpOnly" in cookie and "samesite=lax" in cookie.lower()
    kept = cookie.partition(";")[0]
    assert ask(address, "/events.csv", Cookie=kept)[0] == 200
    with connect(address, additional_headers={"Cookie": kept}) as socket_:
        assert socket_.recv(timeout=10).startswith("0{")  # engine.io lets it in
    for headers in ({}, {"Cookie": kept[:-1]}, {"Cookie": kept, "Origin": "http://evil.example"}):
        with pytest.raises(exceptions.InvalidStatus, match="403"):
            connect(address, additional_headers=headers)


def test_names_are_checked_beyond_loopback_too(served):
    address, token = served
    key = {"Authorization": f"Bearer {token}"}
    port = address.rpartition(":")[2]
    assert ask(address, "/events.csv", Host="rebound.example", **key)[0] == 400
    assert ask(address, "/events.csv", Host="[", **key)[0] == 400
    for name in (socket.gethostname(), "192.0.2.7", "[2001:db8::1]", "localhost"):
        assert ask(address, "/events.csv", Host=f"{name}:{port}", **key)[0] == 200, name
    assert ask(address, "/events.csv", Origin="http://evil.example", **key)[0] == 403
    # As a reverse proxy with TLS hands it on.
    proxied = {"Host": "proxy.example", "Origin": "https://proxy.example"}
    assert ask(address, "/events.csv", **proxied, **key)[0] == 200
    assert ask(address, "/events.csv", **proxied)[0] == 401


@pytest.fixture
def proxied(served):
    """A reverse proxy that would have ended TLS: hands on HTTP and WebSocket, and says so."""
    port = int(served[0].rpartition(":")[2])

    class Hand(socketserver.StreamRequestHandler):
        def handle(self):
            head = b"".join(self.lines())
            with socket.create_connection(("127.0.0.1", port)) as upstream:
                upstream.sendall(head)
                back = threading.Thread(target=pump, args=(upstream, self.connection))
                back.start()
                pump(self.connection, upstream)
                back.join()

        def lines(self):
            while (line := self.rfile.readline()) not in (b"\r\n", b""):
                yield line
            yield (b"X-Forwarded-For: 192.0.2.7\r\nX-Forwarded-Proto: https\r\n"
                   b"X-Forwarded-Host: proxy.example\r\n\r\n")

    def pump(source, sink):
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Hand) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}", served[1]
        server.shutdown()


def test_behind_a_proxy_that_ends_tls_the_token_is_asked_for_and_the_page_lives(proxied):
    address, token = proxied
    name = {"Host": "proxy.example"}
    for path in GUARDED:
        assert ask(address, path, **name)[0] == 401, path
    status, told, _ = ask(address, f"/?token={token}", **name)
    assert (status, told["Location"]) == (303, "/")
    assert "Secure" in told["Set-Cookie"]  # it never goes without TLS
    kept = {"Cookie": told["Set-Cookie"].partition(";")[0]}
    assert ask(address, "/", **name, **kept)[0] == 200
    origin = {"Origin": "https://proxy.example"}
    with connect("http://proxy.example", sock=socket.create_connection(
            ("127.0.0.1", int(address.rpartition(":")[2]))),
            additional_headers={**kept, **origin}) as socket_:
        assert socket_.recv(timeout=10).startswith("0{")
    with pytest.raises(exceptions.InvalidStatus, match="403"):
        connect("http://proxy.example", sock=socket.create_connection(
            ("127.0.0.1", int(address.rpartition(":")[2]))), additional_headers=origin)


def test_a_name_beside_those_of_loopback_asks_for_a_token():
    from eha_monitor.dashboard.serve import claim

    for names, asked in (((), False), (("proxy.example",), True)):
        door = claim(0, names=names)
        door.listener.close()
        assert door.loopback and door.made is asked and (door.token is not None) is asked


def test_a_person_without_the_token_is_told_what_to_do(served, browser):
    address, token = served
    page = browser.new_page(viewport={"width": 400, "height": 800})
    assert page.goto(address).status == 401
    assert "This dashboard needs its token" in page.inner_text("body")
    page.get_by_label("Token").fill("wrong")
    page.get_by_role("button").click()
    page.wait_for_function("document.body.innerText.includes('This token is wrong')")
    assert page.evaluate("document.documentElement.scrollWidth") == 400
    page.get_by_label("Token").fill(token)
    page.get_by_role("button").click()
    page.wait_for_selector('[data-testid="B-value"]')
    assert token not in page.url and page.url == f"{address}/"
    page.wait_for_function("window.socket && window.socket.connected")
    page.context.close()


@pytest.mark.parametrize(("arguments", "said"), [
    (("--host", "192.0.2.1"), "--host 192.0.2.1: cannot serve there (Cannot assign requested "
     "address), expected an address of this machine, or 0.0.0.0 for all of them"),
    (("--host", "no such name"), "--host no such name: no such address"),
    (("--host", "0.0.0.0", "--token", "short"), "expected at least 16 letters"),
    (("--config", "a.yaml", "--actuator", "left="), "--config: expected either it or --actuator"),
    (("--actuator", "left"), "--actuator left: expected NAME=CONFIG"),
])
def test_what_cannot_be_served_is_one_line_and_status_2(capfd, arguments, said):
    assert said in refused(capfd, "dashboard", "--port", "0", *arguments)


def test_a_given_token_is_asked_for_on_loopback_too_and_not_printed(monkeypatch, capfd):
    monkeypatch.setenv("EHA_MONITOR_TOKEN", "a token" * 3)
    assert "without spaces" in refused(capfd, "dashboard", "--port", 0)
    monkeypatch.setenv("EHA_MONITOR_TOKEN", "correct-horse-battery")
    with command("dashboard", "--port", 0) as process:
        address = process.stdout.readline().removeprefix("dashboard: ").strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", address)
        assert ask(address, "")[0] == 401
        assert ask(address, "metrics", Authorization="Bearer correct-horse-battery")[0] == 404
        assert ask(address, "?token=correct-horse-battery")[0] == 303
        end(process)
