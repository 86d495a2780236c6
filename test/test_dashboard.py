"""The page in a headless Chromium, against running nodes over DDS on loopback."""

import contextlib
import json
import re
import socket
import time
import urllib.error
import urllib.request

import pytest
from command_tools import refused
from diagnostic_msgs.msg import DiagnosticArray
from ros_tools import PATIENCE, command, end, listen, start
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from eha_monitor.quantity import FLOOR, number
from eha_monitor.ros.messages import findings_of
from eha_monitor.ros.topics import LATCHED

DESK, PHONE = {"width": 1280, "height": 900}, {"width": 400, "height": 800}
STAGES = ("stage_one", "stage_two")
ALARMS = ("viscous_damping_high", "viscous_damping_low", "bulk_modulus_high", "bulk_modulus_low")
pytest.importorskip("nicegui", reason="nicegui is not installed (pip install '.[dashboard]')")


@pytest.fixture(scope="module")
def running():
    """Run the command on a free port, for all tests; gives its process and its page's address."""
    with command("dashboard", "--port", 0) as process:
        line = process.stdout.readline()
        found = re.fullmatch(r"dashboard: (http://127\.0\.0\.1:\d+/)\n", line)
        assert found, line or process.stderr.read()
        yield process, found[1]
        if process.poll() is None:
            end(process)


@pytest.fixture
def address(running):
    return running[1]


class Eyes:
    """Somebody who looks at the page; what it loads and complains of is kept."""

    def __init__(self, browser, address, size=DESK):
        self.page = browser.new_page(viewport=size)
        self.loaded, self.problems = [], []
        self.page.on("request", lambda request: self.loaded.append(request.url))
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.goto(address)
        self.page.wait_for_selector('[data-testid="B-value"]')

    def read(self, key):
        """Return a text of the page."""
        return self.page.get_by_test_id(key).inner_text()

    def shows(self, key):
        return self.page.get_by_test_id(key).is_visible()

    def number(self, key):
        """Return a shown number and the half of its last digit, as shown."""
        text = self.read(key).strip("± ")
        decimals = len(text.partition(".")[2])
        return float(text), 0.5000001 * 10.0**-decimals

    def charts(self):
        """Return the data of each line of each chart, as the browser holds them."""
        return json.loads(self.page.evaluate(
            "JSON.stringify([...document.querySelectorAll('.nicegui-echart')].map(box =>"
            " getElement(box.id.slice(1)).chart.getOption().series.map(line => line.data)))"))


def heard_levels(health):
    return {finding.name: finding.level for finding in findings_of(health[-1])}


def heard_values(health, name):
    return next(finding.values for finding in findings_of(health[-1]) if finding.name == name)


def test_numbers_equal_the_topics_and_a_reload_loses_nothing(graph, browser, address):
    """Simulator, monitor and dashboard as their commands; then the simulator is ended."""
    topics = {"B-value": "viscous_damping", "B-stddev": "viscous_damping_stddev",
              "beta_e-value": "bulk_modulus", "beta_e-stddev": "bulk_modulus_stddev"}
    heard = {key: listen(graph, Float64, f"/eha/monitor/{name}") for key, name in topics.items()}
    state = listen(graph, JointState, "/eha/monitor/joint_states")
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    with contextlib.ExitStack() as running_:
        monitor = running_.enter_context(command("monitor"))
        eyes = Eyes(browser, address)
        assert eyes.read("silence").startswith("No data yet on /eha/")
        assert "STALE" in eyes.read("bulk_modulus_low-level")
        simulator = running_.enter_context(command("simulator", "--seed", "1"))
        graph.until(lambda: all(heard.values()) and health and all(
            "innovation_nis" in heard_values(health, stage) for stage in STAGES), PATIENCE)
        graph.until(lambda: not eyes.shows("silence"))
        # This test hears a topic before the page does where the graph is discovered slowly.
        graph.until(lambda: not any(eyes.read(key) in ("", "–") for key in topics))
        graph.until(lambda: "The model of the config is in force"
                    in eyes.read("diagnosis-lines"))
        before = eyes.read("actuator"), style(eyes)
        graph.until(lambda: style(eyes) != before[1])  # the piston moves
        # Enough of a history for the reload below: none comes once the simulator has ended.
        graph.until(lambda: len(eyes.charts()[0][2]) > 4 and len(eyes.charts()[2][0]) > 30)
        # Another noise measured begins the innovations anew: not in the last moments.
        graph.until(lambda: all(int(heard_values(health, stage).get("innovation_samples", 0))
                                > 1000 for stage in STAGES))

        end(simulator)
        graph.until(lambda: eyes.shows("silence"))
        told = eyes.read("silence")
        assert re.match(r"No data since \d\d:\d\d:\d\d \(\d+ s\): nothing on /eha/joint_states",
                        told), told
        graph.until(lambda: heard_levels(health)["data"] == "STALE")
        for key, messages in heard.items():
            factor = 1e-6 if key.startswith("beta_e") else 1.0

            def equals(key=key, messages=messages, factor=factor):
                value, stddev = (heard[key.rpartition("-")[0] + part][-1].data
                                 for part in ("-value", "-stddev"))
                if not stddev <= abs(value):  # or not a number: none is shown
                    return eyes.read(key) in ("–", "")
                if eyes.read(key) in ("–", ""):
                    return False
                shown, half = eyes.number(key)
                least = FLOOR * value if "stddev" in key else 0.0
                return abs(shown - max(messages[-1].data, least) * factor) <= half

            graph.until(equals)  # the last messages may still wait to be taken
        assert eyes.read("B-unit") == "N·s/m" and eyes.read("beta_e-unit") == "MPa"
        # Of the last second: measured positions come best effort, and a sample that was lost
        # leaves the last estimate without a partner, so that the pair before it is shown.
        graph.until(lambda: any(abs(float(eyes.read("estimated").split()[1])
                                    - 1e3 * message.position[0]) <= 0.00500001
                                for message in state[-12:]))
        for stage in STAGES:
            for key, name in (("nis", "innovation_nis"),
                              ("variance", "innovation_variance_ratio")):
                graph.until(lambda stage=stage, key=key, name=name:
                            eyes.read(f"{stage}-{key}") == number(
                                float(heard_values(health, stage)[name]), 3))
        graph.until(lambda: eyes.read("model-level") == "◌ STALE")
        # Without a limit there is nothing to judge, and no OK.
        graph.until(lambda: [eyes.read(f"{name}-level") for name in ALARMS]
                    == ["◌ STALE", "◌ STALE", "–", "◌ STALE"])

        # What was sent to the page before this second's text is there: the charts are whole.
        graph.until(lambda: not re.search(r"\([0-4] s\)", eyes.read("silence")))
        lines, texts = eyes.charts(), {key: eyes.read(key) for key in topics}
        eyes.page.reload()
        eyes.page.wait_for_selector('[data-testid="B-value"]')
        graph.until(lambda: len(eyes.charts()[0][2]) >= len(lines[0][2]))
        graph.until(lambda: {key: eyes.read(key) for key in topics} == texts)
        again = eyes.charts()
        for chart in (0, 1):
            assert again[chart][2][:len(lines[chart][2])] == lines[chart][2]
        assert again[2] == lines[2] and len(lines[2][0]) > 20  # measured and estimated position

        end(monitor)
        graph.until(lambda: "nothing is received from the monitor" in eyes.read("silence"))
        assert not [url for url in eyes.loaded
                    if not url.startswith((address, address.replace("http", "ws"), "data:"))]
        eyes.page.set_viewport_size(PHONE)
        eyes.page.wait_for_function(  # the charts follow a moment later
            f"document.documentElement.scrollWidth == {PHONE['width']}", timeout=10_000)
        assert not eyes.problems


def style(eyes):
    return eyes.page.get_by_test_id("actuator").get_attribute("style")


def test_an_alarm_shows_within_a_second_and_does_not_outlive_the_monitor(graph, browser, address):
    """From the monitor's message to the browser's page, and again when it clears."""
    _monitor, estimator, sender = start(graph)
    eyes, levels, sent = Eyes(browser, address), [], 0
    key = "viscous_damping_high-level"
    graph.node("watch").create_subscription(
        DiagnosticArray, "/eha/monitor/health", lambda message: levels.append(
            (heard_levels([message])["viscous_damping_high"], time.monotonic())), LATCHED)

    def until(condition):
        nonlocal sent
        limit = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < limit
            sender.send(sent, 20)
            sent += 20
            # No queue of samples before the alarms.
            graph.until(lambda enough=sent - 10: len(estimator.rows) > enough)

    until(lambda: eyes.read(key) == "✓ OK")
    delays = {"ERROR": [], "OK": []}
    for damping, level, shown in ((2000.0, "ERROR", "✖ ERROR"), (600.0, "OK", "✓ OK")) * 3:
        estimator.damping = damping
        del levels[:]
        until(lambda wanted=level: levels and levels[-1][0] == wanted)
        came = next(when for heard, when in levels if heard == level)
        until(lambda wanted=shown: eyes.read(key) == wanted)
        took = time.monotonic() - came
        print(f"{level} on the page {1e3 * took:.0f} ms after the monitor's message")
        delays[level].append(took)
        until(lambda wanted=shown: eyes.read("overall") == wanted)
    # Of three: on a machine that is busy with other things the browser itself waits its turn.
    assert max(min(delays["ERROR"]), min(delays["OK"])) < 1.0
    assert "below" in eyes.read("viscous_damping_high-message")

    # Nobody runs the monitor's callbacks any more: a green light must not stay.
    eyes.page.wait_for_function(
        f"document.querySelector('[data-testid={key}]').innerText == '◌ STALE'", timeout=10_000)
    assert eyes.read("viscous_damping_high-message").startswith("last received OK: ")
    assert "nothing is received from the monitor" in eyes.read("silence")


def test_a_taken_port_is_one_line_and_status_2(capfd):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"cannot serve on 127.0.0.1:{port} (Address already in use), expected a free port" \
            in refused(capfd, "dashboard", "--port", port)


def test_only_loopback_and_only_by_its_own_name(address):
    port = int(address.rstrip("/").rpartition(":")[2])
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", port), timeout=5)
    request = urllib.request.Request(address, headers={"Host": "rig.example"})
    with pytest.raises(urllib.error.HTTPError, match="400"):
        urllib.request.urlopen(request, timeout=10)


def test_a_page_whose_dashboard_is_gone_says_so(browser, running):
    """The last test: it ends the dashboard."""
    process, address = running
    eyes = Eyes(browser, address)
    assert not eyes.page.get_by_text("Connection lost").is_visible()
    eyes.page.wait_for_function("window.socket && window.socket.connected")
    end(process)
    eyes.page.get_by_text("Connection lost").wait_for(state="visible", timeout=10_000)
    faded = "getComputedStyle(document.querySelector('.page')).opacity"
    assert float(eyes.page.evaluate(faded)) < 0.5
