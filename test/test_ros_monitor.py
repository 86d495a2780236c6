"""The monitor's node in this process, fed over DDS on loopback."""

import itertools
import math
import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.parameter import Parameter
from ros_tools import BEST_EFFORT, MS, START_NS, Recorder, levels, listen, start
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32, Float64

from eha_monitor.errors import InputError
from eha_monitor.live.rows import Rows
from eha_monitor.ros import messages
from eha_monitor.ros.monitor_node import Monitor
from eha_monitor.ros.parameters import (
    MONITOR_KEYS,
    overridden,
    parameter_table,
    settings_of_node,
)
from eha_monitor.ros.subscriptions import DEMANDED, OPTIONAL
from eha_monitor.ros.topics import LATCHED, topics_of
from eha_monitor.settings import Settings, settings_from_tree

STATUSES = ["viscous_damping_high", "viscous_damping_low", "bulk_modulus_high",
            "bulk_modulus_low", "stage_one", "stage_two", "model",
            "model_mismatch", "data"]


def test_rows_estimates_and_health(graph):
    monitor, estimator, sender = start(graph)
    damping = listen(graph, Float64, "/eha/monitor/viscous_damping")
    stddev = listen(graph, Float64, "/eha/monitor/bulk_modulus_stddev")
    state = listen(graph, JointState, "/eha/monitor/joint_states")
    sender.send(0, 300)
    graph.until(lambda: damping and stddev and state and len(estimator.rows) == 300)
    assert [round(t, 9) for t, _ in estimator.rows] == [round(k * 1e-3, 9) for k in range(300)]
    assert estimator.rows[7][1] == pytest.approx(
        {"x": 0.007, "v": 0.5, "omega": 107.0, "x_d": 0.014, "p1": 2e6 + 7, "p2": 1e6 + 7})
    assert (damping[0].data, stddev[0].data) == (600.0, 5e6)
    assert (state[0].name, list(state[0].position)) == (["piston"], [0.01])
    graph.until(lambda: "rows" in monitor.data.values)
    assert monitor.data.problems == []  # no temperature is no fault
    assert monitor.counts() == dict.fromkeys(monitor.counts(), 0)

    late = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    graph.until(lambda: late)
    assert [s.name for s in late[0].status] == [f"eha: {name}" for name in STATUSES]
    assert {s.hardware_id for s in late[0].status} == {"eha"}
    values = {v.key: v.value for v in late[0].status[0].values}
    assert float(values["viscous_damping_Ns_per_m"]) == 600.0
    assert (values["tainted"], values["on_trial"]) == ("0", "0")
    assert values["limit_warn"] == "1000" and "600.0 ± 2.0 N·s/m" in late[0].status[0].message


def test_a_motor_without_stamps_whose_messages_come_in_bursts(graph):
    _, estimator, sender = start(graph, {"channels": {"omega": {
        "topic": "motor", "field": "data"}}})
    motor = graph.node("driver", "/eha").create_publisher(Float64, "motor", 100)
    graph.until(motor.get_subscription_count)
    begin = time.time_ns()
    for first in range(0, 600, 40):
        for k in range(first, first + 40):
            sender.send(k, 1, begin)
            motor.publish(Float64(data=100.0 + k))
        # As a driver does that was held up: all at once when the last is due.
        graph.until(lambda last=first + 80: time.time_ns() > begin + last * MS)
    graph.until(lambda: len(estimator.rows) > 590)
    rows = [row for _, row in estimator.rows[300:] if "omega" in row]
    assert len(rows) > 280 and not estimator.resets
    # They have the time at which they come, which a busy machine may make late for a burst.
    off = np.array([abs(row["omega"] - 100.0 - 1e3 * row["x"]) for row in rows])
    assert np.mean(off <= 2.0) > 0.8 and off.max() < 40.0


def test_an_alarm_is_published_when_it_is_raised(graph):
    _, estimator, sender = start(graph, {"thresholds": {"viscous_damping": {
        "high_warn": 1000.0, "high_error": 1500.0, "hold_time": 0.2}}})
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    diagnostics = listen(graph, DiagnosticArray, "/diagnostics")
    estimator.damping = 1600.0
    sender.send(0, 500)
    name = "eha: viscous_damping_high"
    for heard in (health, diagnostics):
        graph.until(lambda heard=heard: levels(heard[-1])[name] == DiagnosticStatus.ERROR
                    if heard else False)


def test_data_that_stop_make_everything_stale_in_time(graph):
    monitor, _, sender = start(graph, {"monitor": {"stale_after": 0.4}})
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    graph.until(lambda: health)
    assert "no data yet" in health[0].status[0].message
    # A busy machine may tell of the data only once they are old: they go on until it has told.
    more = itertools.count(0, 50)
    graph.until(lambda: levels(health[-1])["eha: data"] == DiagnosticStatus.OK
                or sender.send(next(more), 50))
    graph.until(lambda: levels(health[-1])["eha: data"] == DiagnosticStatus.STALE)
    # The monitor's own absence is not the data's: it moves the time of the last row.
    assert time.monotonic() - monitor._row_came < 0.4 + 0.5
    assert levels(health[-1])["eha: viscous_damping_high"] == DiagnosticStatus.STALE
    assert "data stopped: nothing on /eha/joint_states" in health[-1].status[0].message
    graph.until(lambda: levels(health[-1])["eha: viscous_damping_high"] == DiagnosticStatus.OK
                or sender.send(next(more), 50))


def test_joints_may_come_in_any_order(graph):
    _, estimator, sender = start(graph, names=("pump", "piston"))
    sender.send(0, 20)
    graph.until(lambda: len(estimator.rows) == 20)
    assert estimator.rows[3][1]["omega"] == 103.0
    assert estimator.rows[3][1]["x"] == pytest.approx(0.003)


def test_a_missing_joint_is_diagnosed_and_the_rest_goes_on(graph):
    monitor, estimator, sender = start(graph, names=("piston",))
    sender.send(0, 20)
    graph.until(lambda: len(estimator.rows) == 20)
    assert "omega" not in estimator.rows[-1][1] and "p1" in estimator.rows[-1][1]
    graph.until(lambda: any("no entry named 'pump', the message has piston" in problem
                            for problem in monitor.data.problems))


def test_a_demand_that_a_rig_does_not_have_is_no_fault_where_the_speed_comes(graph):
    """A speed loop demands the pump's speed in the topic in which others demand a position."""
    monitor, estimator, sender = start(graph, demand="pump")
    sender.send(0, 200)
    graph.until(lambda: len(estimator.rows) == 200)
    asked = next(each for each in monitor.inputs if each.topic.name == "command")
    assert asked.messages and asked.problems(time.monotonic(), math.inf, OPTIONAL | DEMANDED) == []
    assert asked.problems(time.monotonic(), math.inf, OPTIONAL)


def test_two_publishers_of_one_topic_are_named_where_its_stamps_are_mixed(graph):
    """Another node that publishes beside is no fault; one that publishes the same is."""
    monitor, estimator, sender = start(graph)
    other = graph.node("logger", "/eha").create_publisher(JointState, "joint_states", BEST_EFFORT)
    graph.until(other.get_subscription_count)
    sent = [0]

    def send(twice):
        first = sent[0]
        sent[0] += 50
        sender.send(first, 50)
        for k in range(first, first + 50 * twice):
            message = JointState(name=["piston"], position=[0.001 * k], velocity=[0.5])
            message.header.stamp = messages.stamp(START_NS + k * MS)
            other.publish(message)

    for _ in range(4):
        send(False)
        graph.until(lambda: len(estimator.rows) == sent[0])
    assert not [each for each in monitor.data.problems if "publishers" in each]
    said = "/eha/joint_states: 2 publishers, /eha/feeder and /eha/logger"
    graph.until(lambda: said in monitor.data.problems or send(True))


def test_a_joint_that_is_missing_again_is_named_again(graph):
    monitor, _, sender = start(graph)
    joints = next(each for each in monitor.inputs if each.topic.name == "joint_states")
    for k, names in enumerate((("piston",), ("piston", "pump"), ("piston",))):
        sender.names = names
        sender.send(20 * k, 20)
        graph.until(lambda count=20 * (k + 1): joints.messages == count)
        assert any("no entry named 'pump'" in problem for problem in joints.problems(
            time.monotonic(), math.inf)) == ("pump" not in names)


def test_a_missing_pressure_makes_only_damping_stale(graph):
    monitor, estimator, sender = start(graph, {"monitor": {"stale_after": 0.3}})
    sender.pressures.clear()
    sender.send(0, 500)
    graph.until(lambda: len(estimator.rows) == 500)
    by_name = {alarm.name: alarm for alarm in monitor.board.alarms}
    assert by_name["viscous_damping_high"].level == "STALE"
    assert "p1 (topic /eha/pressure/chamber_1)" in by_name["viscous_damping_high"].message
    assert by_name["bulk_modulus_low"].level == "OK"


def test_a_clock_that_jumps_back_resets_the_estimator(graph):
    monitor, estimator, sender = start(graph)
    sender.send(5000, 100)
    sender.send(0, 100)
    graph.until(lambda: estimator.resets)
    graph.until(lambda: len(estimator.rows) >= 190)
    assert len(estimator.resets) == 1 and "jumped back by" in estimator.resets[0]
    assert estimator.rows[-1][0] < 0.1
    assert monitor.counts()["missing_samples"] == 0


def test_the_type_is_taken_from_the_graph(graph):
    tree = {"channels": {"x": {"topic": "joint_states", "name": "piston", "field": "position"},
                         "p1": {"topic": "gauge", "field": "data", "scale": 1e5}}}
    settings = settings_from_tree(tree, "test")
    publisher = graph.node("gauge", "/eha").create_publisher(Float32, "gauge", 10)
    monitor = Monitor(graph.node("monitor", "/eha"), settings, Recorder)
    graph.until(publisher.get_subscription_count)
    gauge = next(i for i in monitor.inputs if i.topic.name == "gauge")
    publisher.publish(Float32(data=20.0))
    graph.until(lambda: gauge.messages)
    source = next(s for s in monitor.aligner.sources if s.channels == ("p1",))
    assert source.values.tolist() == [[2e6]]


def test_scale_offset_and_delay(graph):
    channel = {"topic": "joint_states", "name": "piston", "field": "position", "scale": 2.0,
               "offset": 1.0, "delay": 0.5}
    tree = {"channels": {"x": channel}}
    monitor = Monitor(graph.node("monitor", "/eha"), settings_from_tree(tree, "t"), Recorder)
    publisher = graph.node("p", "/eha").create_publisher(JointState, "joint_states", 10)
    graph.until(publisher.get_subscription_count)
    publisher.publish(messages.joint_state(START_NS, "piston", 3.0, math.nan))
    graph.until(lambda: monitor._estimator.rows)
    assert monitor._row_ns == START_NS - 500 * MS
    assert monitor._estimator.rows[0][1] == {"x": 7.0}


@pytest.mark.parametrize(("channels", "words"), [
    ({"x": {"topic": "", "field": "data"}}, "channels.x.topic"),
    ({"x": {"topic": "a", "field": ""}}, "channels.x.field"),
    ({"x": {"topic": "a", "field": "a..b"}}, "field path"),
])
def test_a_channel_map_that_cannot_work_is_refused(channels, words):
    with pytest.raises(InputError, match=words):
        topics_of(settings_from_tree({"channels": channels}, "test"))


def test_every_key_is_a_parameter_with_its_declaration():
    table = {entry.name: entry for entry in parameter_table(Settings(), MONITOR_KEYS)}
    assert all(entry.description for entry in table.values())
    mass = table["rig.mass"]
    assert (mass.value, mass.unit, mass.lower, mass.read_only) == (20.0, "kg", 0, True)
    assert "[kg]" in mass.descriptor().description
    assert mass.descriptor().floating_point_range[0].from_value == 0.0
    assert {e.name for e in table.values() if not e.read_only} == {
        name for name in table if name.startswith("thresholds.")}


def test_overrides_are_validated_like_a_config(graph):
    node = graph.node("a", "/eha", [Parameter("rig.mass", value=25),
                                    Parameter("thresholds.confidence", value=3.0)])
    found = settings_of_node(node, Settings())
    assert (found.rig.mass, found.thresholds.confidence) == (25.0, 3.0)
    for name, value, words in (("rig.mas", 2.0, "did you mean 'mass'"),
                               ("rig.mass", -2.0, "more than 0 in kg"),
                               ("rig.mass.heavy", 1.0, "expected a number in kg"),
                               ("monitor.namespace", "/other", "__ns:=/other")):
        node = graph.node(f"b{len(graph.nodes)}", "/eha", [Parameter(name, value=value)])
        with pytest.raises(InputError, match=words) as caught:
            settings_of_node(node, Settings())
        assert "\n" not in str(caught.value)
    assert overridden(Settings(), {"thresholds.viscous_damping.high_warn": math.nan},
                      "t").thresholds.viscous_damping.high_warn is None


def test_what_a_turn_brings_is_one_piece_so_that_estimates_know_of_all(graph):
    """Judged in the middle of a turn, its second half was published a period later."""
    monitor, estimator, _ = start(graph)
    told = []
    monitor._judge = lambda: told.append(len(estimator.rows))
    monitor._judged_ns = 80 * MS
    stamps = np.arange(135, 235) * MS
    monitor._take(Rows(stamps, {"x": np.zeros(100)}, np.zeros(100)))
    assert told == [100]
