"""Several actuators on one page, in a headless Chromium, fed over DDS on loopback."""

import contextlib
import csv
import io
import re
import time

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from ros_tools import Caller, command, end
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from test_dashboard import PHONE, Eyes

from eha_monitor.health.alarms import ALARM_NAMES, WATCHED
from eha_monitor.health.judge import Finding
from eha_monitor.ros import messages
from eha_monitor.ros.topics import LATCHED

pytest.importorskip("nicegui", reason="nicegui is not installed (pip install '.[dashboard]')")

driver = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

NAMES = ("left", "right", "nose_gear")
HIGH = "viscous_damping_high"


class Actuator:
    """What rig and monitor of one actuator would publish, with a level that a test sets."""

    def __init__(self, graph, name):
        self.name, self.level, self.damping, self.values = name, "OK", 600.0, {}
        self.on = True
        node = graph.node("monitor", f"/{name}")
        self._numbers = [(node.create_publisher(Float64, f"monitor/{w.section}{end}", 10), end)
                         for w in WATCHED for end in ("", "_stddev")]
        self._states = [node.create_publisher(JointState, topic, 10)
                        for topic in ("joint_states", "monitor/joint_states")]
        self._health = node.create_publisher(DiagnosticArray, "monitor/health", LATCHED)
        node.create_timer(0.1, self.publish)

    def publish(self):
        if not self.on:
            return
        now = time.time_ns()
        for k, (publisher, ending) in enumerate(self._numbers):
            value = (self.damping, 6e8)[k // 2]
            publisher.publish(Float64(data=float(0.01 * value if ending else value)))
        for publisher in self._states:
            publisher.publish(messages.joint_state(now, "piston", 0.01, 0.0))
        findings = [Finding(name, self.level if name == HIGH else "OK", f"{name} as told")
                    for name in ALARM_NAMES]
        self._health.publish(messages.diagnostics(now, [
            *findings, Finding("model_mismatch", "OK", "fits"),
            Finding("data", "OK", "data come", self.values)], self.name))


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The command for all three, on a free port."""
    folder = tmp_path_factory.mktemp("dashboard")
    config = folder / "config.yaml"
    config.write_text(f"monitor: {{save_folder: {folder}}}\n")
    arguments = [part for name in NAMES for part in ("--actuator", f"{name}={config}")]
    with command("dashboard", "--port", 0, "--metrics", *arguments) as process:
        line = process.stdout.readline()
        found = re.fullmatch(r"dashboard: (http://127\.0\.0\.1:\d+/)\n", line)
        assert found, line or process.stderr.read()
        yield found[1]
        end(process)


def test_three_actuators_from_alarm_to_acknowledgement(graph, browser, address):
    rigs = {name: Actuator(graph, name) for name in NAMES}
    caller, eyes = Caller(graph), Eyes(browser, address)
    page = eyes.page

    def level(name):
        return eyes.read(f"tile-{name}-level")

    graph.until(lambda: [level(name) for name in NAMES] == ["✓ OK"] * 3)
    assert eyes.read("name") == "Actuator left" and eyes.read("live") == "● live"
    assert re.fullmatch(r"last data \d\d:\d\d:\d\d \S+, namespace /left, ROS domain \d+",
                        eyes.read("rig"))

    # An alarm elsewhere shows in its tile and in the tab, and a click leads to it.
    rigs["right"].level, rigs["right"].damping = "ERROR", 1600.0
    graph.until(lambda: level("right") == "✖ ERROR" and page.title().startswith("(1) ✖ ERROR"))
    assert "1 to acknowledge" in eyes.read("tile-right") and not eyes.shows(f"{HIGH}-acknowledge")
    page.get_by_test_id("tile-right").click()
    graph.until(lambda: eyes.read("name") == "Actuator right")
    graph.until(lambda: eyes.number("B-value")[0] == 1600)
    graph.until(lambda: page.url.endswith("?actuator=right"))

    # Acknowledged it stays, quiet; it asks again after it has cleared.
    page.get_by_test_id(f"{HIGH}-acknowledge").click()
    page.get_by_test_id("confirm").click()
    page.get_by_text("expected a name").wait_for()
    page.get_by_test_id("who").fill("Ada <b>")
    page.get_by_test_id("confirm").click()
    graph.until(lambda: "acknowledged by Ada <b>, " in eyes.read(f"{HIGH}-acknowledged"))
    graph.until(lambda: eyes.read("overall") == "✖ ERROR, acknowledged")
    assert page.title() == "✖ ERROR: 3 actuators"
    assert not eyes.shows(f"{HIGH}-acknowledge")
    rigs["right"].level = "OK"
    graph.until(lambda: level("right") == "✓ OK")
    rigs["right"].level = "WARN"
    graph.until(lambda: eyes.shows(f"{HIGH}-acknowledge"))

    # The same by the standard service, of that actuator only.
    answer = caller.trigger("/right/dashboard/acknowledge")
    assert answer.success and answer.message == f"acknowledged: {HIGH}"
    graph.until(lambda: "a ROS service call" in eyes.read(f"{HIGH}-acknowledged"))
    assert not caller.trigger("/left/dashboard/acknowledge").success

    # What happened, on the page and as a file.
    rigs["left"].values = {"last_bag": "/tmp/left_bag"}
    graph.until(lambda: "bag saved: /tmp/left_bag" in eyes.read("events"))
    with page.expect_download() as got:
        page.get_by_test_id("events-csv").click()
    rows = list(csv.DictReader(io.StringIO(got.value.path().read_text("utf-8-sig"))))
    kinds = [(row["actuator"], row["kind"], row["level"]) for row in rows if row["kind"] != "data"]
    assert kinds == [("right", "alarm", "ERROR"), ("right", "acknowledged", "ERROR"),
                     ("right", "alarm", "OK"), ("right", "alarm", "WARN"),
                     ("right", "acknowledged", "WARN"), ("left", "bag", "")]

    # One stops: the others go on, and the page says so of that one only.
    rigs["right"].on = False
    graph.until(lambda: eyes.shows("silence") and level("right") == "◌ STALE")
    assert "/right/joint_states" in eyes.read("silence")
    graph.until(lambda: eyes.read("live") == "◌ no data")
    assert level("left") == level("nose_gear") == "✓ OK"
    page.get_by_test_id("tile-left").click()
    graph.until(lambda: not eyes.shows("silence") and eyes.read("live") == "● live")
    graph.until(lambda: "the monitor is not heard" in eyes.read("events"))
    page.set_viewport_size(PHONE)
    page.wait_for_function(f"document.documentElement.scrollWidth == {PHONE['width']}")
    assert not eyes.problems


def test_a_stretch_that_is_dragged_stays_while_data_come(graph, browser, address):
    Actuator(graph, "left")
    eyes = Eyes(browser, f"{address}?actuator=left")
    page = eyes.page

    def axis(number=0):
        return page.evaluate(
            "n => { const box = document.querySelectorAll('.nicegui-echart')[n];"
            " const {min, max} = getElement(box.id.slice(1)).chart.getOption().xAxis[0];"
            " return [min, max]; }", number)

    graph.until(lambda: len(eyes.charts()[0][2]) > 8)
    box = page.locator(".nicegui-echart").nth(0).bounding_box()
    begun = time.monotonic()
    y = box["y"] + 0.5 * box["height"]

    def drag():
        page.mouse.move(box["x"] + 0.5 * box["width"], y)
        page.mouse.down()
        for share in (0.6, 0.7, 0.88):
            page.mouse.move(box["x"] + share * box["width"], y)
        page.mouse.up()
        with contextlib.suppress(driver.TimeoutError):  # dragging is possible a moment later
            page.get_by_test_id("back").wait_for(timeout=1000)
        return eyes.shows("back")

    graph.until(drag)
    held = axis()
    assert 5_000 < held[1] - held[0] < 20_000
    count = len(eyes.charts()[2][0])
    graph.until(lambda: time.monotonic() > begun + 2.0 and len(eyes.charts()[2][0]) >= count)
    assert axis() == axis(1) == axis(3) == held  # all charts of the last minutes
    with page.expect_download() as got:
        page.get_by_test_id("csv").click()
    rows = list(csv.DictReader(io.StringIO(got.value.path().read_text("utf-8-sig"))))
    zone = time.localtime().tm_gmtoff  # the axis has the times of the rig's zone
    assert rows and all(held[0] <= 1e3 * (float(row["time_s"]) + zone) + 1 <= held[1] + 2
                        for row in rows)
    assert got.value.suggested_filename == "estimates_left.csv"

    page.get_by_test_id("back").click()
    graph.until(lambda: axis()[1] > held[1])
    assert not eyes.shows("back")
    page.get_by_text("all", exact=True).click()
    graph.until(lambda: page.get_by_test_id("csv").get_attribute("href")
                == "/estimates.csv?actuator=left")
    with page.expect_download() as got:
        page.get_by_test_id("B-png").click()
    assert got.value.suggested_filename.startswith("left_Viscous_damping_B_")
    assert got.value.path().read_bytes().startswith(b"\x89PNG")
    assert not eyes.problems
