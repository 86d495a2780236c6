"""What ``ros2 param`` does to a monitor: the same service calls, over DDS on loopback."""

import math

import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rclpy.parameter import get_parameter_value, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from ros_tools import Recorder

from eha_monitor.ros.monitor_node import Monitor
from eha_monitor.ros.parameters import MONITOR_KEYS, SIMULATOR_KEYS, declare, overridden
from eha_monitor.settings import Settings, settings_from_tree

HIGH, LOW = "thresholds.bulk_modulus.high_warn", "thresholds.viscous_damping.low_warn"


def test_a_channel_that_is_null_stays_so():
    """The default came back with any change, and the monitor waited for it for ever."""
    given = settings_from_tree({"channels": {"x": {"topic": "/a"}, "omega": None}}, "x")
    there = overridden(given, {"monitor.namespace": "/b"}, "x")
    assert "omega" not in there.channels and there.channels == given.channels
    assert settings_from_tree(given.model_dump(), "x") == given


class Shell:
    """The verbs of ``ros2 param``: a text becomes a value as there, by rclpy's own function."""

    def __init__(self, graph, node):
        self._graph = graph
        self._client = AsyncParameterClient(graph.node("shell"), node)
        graph.until(self._client.services_are_ready)

    def _ask(self, future):
        self._graph.until(future.done)
        return future.result()

    def set(self, name, text):
        message = ParameterMessage(name=name, value=get_parameter_value(string_value=text))
        return self._ask(self._client.set_parameters([message])).results[0]

    def get(self, *names):
        values = self._ask(self._client.get_parameters(list(names))).values
        return [parameter_value_to_python(value) for value in values]

    def describe(self, name):
        return self._ask(self._client.describe_parameters([name])).descriptors[0]

    def names(self):
        return list(self._ask(self._client.list_parameters()).result.names)


@pytest.fixture
def monitored(graph):
    node = graph.node("monitor", "/eha")
    monitor = Monitor(node, Settings(), Recorder)
    declare(node, Settings(), MONITOR_KEYS, monitor.reconfigure)
    return monitor, Shell(graph, "/eha/monitor")


@pytest.mark.parametrize(("text", "value"), [
    ("1000000000", 1e9), ("1.1e9", 1.1e9), ("9e8", 9e8), ("900 MPa", 9e8), (".nan", None),
    ("nan", None), ("null", None)])
def test_a_limit_is_set_as_people_write_it(monitored, text, value):
    """An integer, and 9e8, which ros2 param takes for a text, were of the wrong type."""
    monitor, shell = monitored
    assert shell.set(HIGH, "2.0e9").successful
    answer = shell.set(HIGH, text)
    assert answer.successful, answer.reason
    assert monitor.settings.thresholds.bulk_modulus.high_warn == value
    (shown,) = shell.get(HIGH)
    assert isinstance(shown, float) and (shown == value or (value is None and math.isnan(shown)))


@pytest.mark.parametrize(("name", "text", "words"), [
    (HIGH, "much", "expected 'Type.DOUBLE' got 'Type.STRING'"),
    (HIGH, "900 m", "expected 'Type.DOUBLE' got 'Type.STRING'"),
    (HIGH, "true", "expected 'Type.DOUBLE' got 'Type.BOOL'"),
    (LOW, "5000", "low_warn <= high_warn"),
    ("thresholds.confidence", "-1", "out of range"),
    ("rig.mass", "21", "read-only")])
def test_what_is_no_limit_is_refused_with_the_reason(monitored, name, text, words):
    monitor, shell = monitored
    before = monitor.settings
    answer = shell.set(name, text)
    assert not answer.successful and words in answer.reason
    assert monitor.settings is before


def test_a_limit_that_is_not_set_says_what_it_is(monitored):
    _, shell = monitored
    about = shell.describe(HIGH)
    assert about.description == "limits on the effective bulk modulus, Pa: above this: WARN [Pa]"
    assert about.additional_constraints == (
        "a number from 0 to 1e+18 Pa; .nan: no limit; expected low_error <= low_warn <= "
        "high_warn <= high_error")
    assert "[N·s/m]" in shell.describe(LOW).description


def test_every_parameter_has_a_value_a_description_and_can_be_asked_for_at_once(graph):
    """One without a value made rclpy answer nothing at all, so ``ros2 param dump`` failed."""
    settings = settings_from_tree({"rig": {"position_gain": None}, "effects": {
        "coulomb_friction": {"F_c": 40.0}}}, "test")
    for name, keys in (("monitor", MONITOR_KEYS), ("simulator", SIMULATOR_KEYS)):
        declare(graph.node(name, "/eha"), settings, keys)
        shell = Shell(graph, f"/eha/{name}")
        names = [each for each in shell.names() if each != "use_sim_time"]
        assert len(shell.get(*names)) == len(names) > 60
        assert all(shell.describe(each).description for each in names
                   if not each.startswith("start_type_description"))
        assert "not known" in shell.describe("rig.position_gain").additional_constraints
        assert "absolute" in shell.describe("channels.p1.offset").description
        assert "absolute" in shell.describe("rig.charge_pressure").description
