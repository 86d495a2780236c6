"""The web server, in a thread of its own: page, downloads, metrics; and who may read them."""

import contextlib
import errno
import hashlib
import hmac
import ipaddress
import math
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qsl, quote, urlencode, urlsplit

import uvicorn
from fastapi import FastAPI, HTTPException, Query, Response
from nicegui import ui
from starlette.datastructures import Headers
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from eha_monitor.dashboard.events import EventLog
from eha_monitor.dashboard.exports import estimates_csv, metrics
from eha_monitor.dashboard.page import Page
from eha_monitor.dashboard.state import Actuator
from eha_monitor.errors import InputError

VARIABLE = "EHA_MONITOR_TOKEN"
# A token that is shorter can be found by trying.
SHORTEST = 16
_ASK = ("open the address with ?token=... that the dashboard printed when it started, or put "
        "?token= and the token behind this one; a program sends the header "
        "'Authorization: Bearer TOKEN'")
_REFUSED = """<!doctype html><html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>Token needed</title>
<style>body{{font-family:system-ui,"DejaVu Sans",sans-serif;margin:2rem auto;max-width:38rem;
padding:0 1rem;color:#1c2529;line-height:1.5;overflow-wrap:anywhere}}
input,button{{font:inherit;padding:.4rem .6rem}}</style></head>
<body><h1>{reason}</h1><p>To see this dashboard, {ask}.</p>
<form method="get" action="/"><label>Token <input name="token" type="password"
autocomplete="off" required></label> <button>Open</button></form></body></html>"""


def token_for(loopback: bool, given: str | None) -> tuple[str | None, bool]:
    """Return the token that is required, None for none, and whether it was made here.

    Raises InputError if the given one is too short, or cannot stand in an address.
    """
    if given is None:
        return (None, False) if loopback else (secrets.token_urlsafe(24), True)
    if len(given) < SHORTEST or not given.isascii() or not given.isprintable() or " " in given:
        raise InputError(f"--token (or {VARIABLE}): expected at least {SHORTEST} letters, digits "
                         f"or signs without spaces, got {len(given)} characters")
    return given, False


def names_of(host: str, loopback: bool, more: tuple[str, ...] = ()) -> frozenset[str]:
    """Return the names to answer to, in small letters: those of loopback, ``host`` and ``more``.

    Beyond loopback the machine's own name counts as well.  DNS is not queried: on a rig without
    one that takes seconds.
    """
    names = {"127.0.0.1", "localhost", "::1", host.lower(), *(name.lower() for name in more)}
    if not loopback:
        own = socket.gethostname().lower()
        names |= {own, f"{own}.local"}
    return frozenset(names)


class Guard:
    """Lets those requests and WebSockets through that call it by its name and bring its token.

    A web site that resolves its own name to this machine (DNS rebinding) must not read along,
    so names are checked, and a page of another origin cannot use what the browser keeps.

    Parameters
    ----------
    names : host names that it answers to.
    any_address : whether it answers to every numerical address as well; those cannot be rebound.
    token : required of everyone; None lets everyone in.
    cookie : name of the cookie that keeps it; cookies do not tell ports apart, names must.
    """

    def __init__(self, app: ASGIApp, names: frozenset[str], any_address: bool,
                 token: str | None, cookie: str):
        self._app, self._names, self._any_address = app, names, any_address
        self._token, self._cookie = token, cookie
        # The browser keeps no more than it needs.
        self._proof = "" if token is None else hashlib.sha256(f"{cookie} {token}".encode()
                                                              ).hexdigest()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request as ASGI asks for."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        answer = self._refusal(scope, Headers(scope=scope))
        if answer is None:
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await answer(scope, receive, send)

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        if not self._known(headers.get("host", "")):
            return PlainTextResponse("Invalid host header: this dashboard answers to "
                                     f"{', '.join(sorted(self._names))}\n", status_code=400)
        origin = headers.get("origin")
        if origin and urlsplit(origin).netloc.lower() != headers.get("host", "").lower():
            return PlainTextResponse("a page of another origin may not use this dashboard\n",
                                     status_code=403)
        return None if self._token is None else self._ask(scope, headers)

    def _known(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        return name in self._names or (self._any_address and _is_address(name))

    def _ask(self, scope: Scope, headers: Headers) -> Response | None:
        query = parse_qsl(scope.get("query_string", b"").decode("latin-1"), keep_blank_values=True)
        given = next((value for key, value in query if key == "token"), None)
        scheme, _, bearer = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer" and _same(bearer.strip(), self._token):
            return None
        if given is not None and _same(given, self._token):
            if scope["type"] != "http" or scope["path"] != "/":
                return None
            rest = urlencode([pair for pair in query if pair[0] != "token"])
            answer = RedirectResponse(f"/?{rest}" if rest else "/", status_code=303,
                                      headers={"Referrer-Policy": "no-referrer",
                                               "Cache-Control": "no-store"})
            answer.set_cookie(self._cookie, self._proof, httponly=True, samesite="lax", path="/",
                              secure=scope["scheme"] == "https")  # a proxy on loopback says so
            return answer
        if given is None and _same(self._kept(headers), self._proof):
            return None
        return _unauthorised(headers, "This token is wrong" if given is not None or bearer
                             else "This dashboard needs its token")

    def _kept(self, headers: Headers) -> str:
        try:
            kept = SimpleCookie(headers.get("cookie", "")).get(self._cookie)
        except CookieError:
            return ""
        return kept.value if kept else ""


def _unauthorised(headers: Headers, reason: str) -> Response:
    kept = {"WWW-Authenticate": "Bearer", "Cache-Control": "no-store"}
    if "text/html" in headers.get("accept", ""):
        return HTMLResponse(_REFUSED.format(reason=reason, ask=_ASK), 401, kept)
    return PlainTextResponse(f"{reason}: {_ASK}\n", 401, kept)


def _same(one: str, other: str | None) -> bool:
    """Compare in a time that does not tell how much of it is right."""
    return other is not None and hmac.compare_digest(one.encode("utf-8", "replace"),
                                                     other.encode())


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


HOST = "127.0.0.1"
_START_TIMEOUT = 20.0  # s
_ICON = "⚙"
# What the system says of an address that is none of its own.
_NO_ADDRESS = (errno.EADDRNOTAVAIL, errno.ENODEV)


@dataclass(frozen=True)
class Door:
    """Where the page is served and who may come in."""

    listener: socket.socket  # listening socket
    host: str  # as it was requested
    loopback: bool  # whether nobody but this machine reaches it
    token: str | None  # required of everyone, or None
    made: bool  # whether the token was made here, so that it must be printed
    names: tuple[str, ...] = ()  # further names to answer to, as those of a reverse proxy

    @property
    def port(self) -> int:
        """The port, the one that was free where any was requested."""
        return self.listener.getsockname()[1]

    @property
    def address(self) -> str:
        """The page's address, with the token where that was made here."""
        host = self.host
        if self.listener.getsockname()[0] in ("0.0.0.0", "::"):
            host = socket.gethostname()
        elif ":" in host:
            host = f"[{host}]"
        token = f"?token={quote(self.token)}" if self.made and self.token else ""
        return f"http://{host}:{self.port}/{token}"


def claim(port: int, host: str = HOST, token: str | None = None,
          names: tuple[str, ...] = ()) -> Door:
    """Return a listening socket and who may come in; port 0 takes any that is free.

    On another address than loopback, or under other names, a token is required; one is made where
    none is given.  Raises InputError if the port is taken or not allowed to this user, the address
    is none of this machine, or the token is too short.
    """
    try:
        family, _, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM,
                                                    flags=socket.AI_PASSIVE)[0]
    except (OSError, UnicodeError) as problem:
        raise InputError(f"--host {host}: no such address ({problem}), expected one of this "
                         "machine, or 0.0.0.0 for all of them") from problem
    loopback = ipaddress.ip_address(place[0].partition("%")[0]).is_loopback
    token, made = token_for(loopback and not names, token)
    listener = socket.socket(family, socket.SOCK_STREAM)
    # Else a port stays taken for a minute after the last dashboard.
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(place)
        listener.listen()
    except OSError as problem:
        listener.close()
        reason = os.strerror(problem.errno)
        if problem.errno in _NO_ADDRESS:
            raise InputError(f"--host {host}: cannot serve there ({reason}), expected an address "
                             "of this machine, or 0.0.0.0 for all of them") from problem
        raise InputError(f"--port {port}: cannot serve on {host}:{port} ({reason}), expected a "
                         "free port") from problem
    return Door(listener, host, loopback, token, made, names)


def metrics_text() -> Callable:
    """Return what writes the metrics; raises ImportError where prometheus_client is missing."""
    from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4

    return lambda states: Response(metrics(states), media_type=CONTENT_TYPE_PLAIN_0_0_4)


@contextlib.contextmanager
def serving(shown: dict[str, Actuator], log: EventLog, door: Door,
            write_metrics: Callable | None = None) -> Iterator[str]:
    """Serve the page for the time of a block; gives its address.

    Parameters
    ----------
    shown : the actuators by name, in the order of the page.
    door : from :func:`claim`.
    write_metrics : from :func:`metrics_text`, or None for no ``/metrics``.
    """
    # No page of FastAPI's own: those load their scripts from the internet.
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    _add_downloads(app, shown, log)
    states = {name: each.state for name, each in shown.items()}
    absent = Response("start the dashboard with --metrics\n", 404, media_type="text/plain")
    app.add_api_route("/metrics", lambda: write_metrics(states) if write_metrics else absent,
                      response_class=Response)
    app.add_middleware(Guard, names=names_of(door.host, door.loopback, door.names),
                       any_address=not door.loopback, token=door.token,
                       cookie=f"eha_monitor_{door.port}")
    ui.run_with(app, root=lambda: Page(shown, log), title="Actuator health", favicon=_ICON,
                tailwind=False, show_welcome_message=False, binding_refresh_interval=None)
    server = uvicorn.Server(uvicorn.Config(app, log_config=None, log_level="warning",
                                           timeout_graceful_shutdown=1))
    # Not in the main thread, so uvicorn leaves the signals to ROS.
    thread = threading.Thread(target=server.run, kwargs={"sockets": [door.listener]},
                              name="dashboard", daemon=True)
    thread.start()
    try:
        _await_start(server, thread)
        yield door.address
    finally:
        server.should_exit = True
        thread.join(timeout=5.0)
        door.listener.close()


def _add_downloads(app: FastAPI, shown: dict[str, Actuator], log: EventLog) -> None:
    @app.get("/events.csv")
    def events() -> Response:
        return _csv(log.csv(), "events.csv")

    @app.get("/estimates.csv")
    def estimates(actuator: str = "", last: float | None = Query(None, gt=0),
                  since: float = -math.inf, until: float = math.inf) -> Response:
        name = actuator or next(iter(shown))
        if name not in shown:
            raise HTTPException(404, f"no actuator {name}, expected one of {', '.join(shown)}")
        if last is not None:
            since, until = time.time() - last, math.inf
        return _csv(estimates_csv(shown[name].state, time.monotonic(), since, until),
                    f"estimates_{name}.csv")


def _csv(text: str, name: str) -> Response:
    return Response(text, media_type="text/csv; charset=utf-8", headers={
        "Content-Disposition": f"attachment; filename*=UTF-8''{quote(name)}",
        "Cache-Control": "no-store"})


def _await_start(server: uvicorn.Server, thread: threading.Thread) -> None:
    waited = 0.0
    while not server.started:
        thread.join(timeout=0.02)
        waited += 0.02
        if not thread.is_alive() or waited > _START_TIMEOUT:
            raise InputError("the web server of the dashboard did not start")
