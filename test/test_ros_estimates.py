"""The stamped estimates, and what the health tells at once, over DDS on loopback."""

import math
import time

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import Log
from ros_tools import START_NS, Caller, Feeder, Recorder, levels, listen, start
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from test_ros_keeper import LIMITS, play, tree

from eha_monitor.estimation.results import ParameterEstimate
from eha_monitor.recordings.bag import iter_raw, topics
from eha_monitor.ros import running
from eha_monitor.ros.managed_node import ManagedMonitor
from eha_monitor.ros.monitor_node import Monitor
from eha_monitor.ros.topics import LATCHED
from eha_monitor.settings import settings_from_tree

SLOW_S = 30.0  # between two looks at the clock: what comes sooner was not a timer's doing


def values(array, name):
    status = next(one for one in array.status if one.name == name)
    return {pair.key: pair.value for pair in status.values}


def stamp_ns(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


class Odd(Recorder):
    """An estimator with numbers of 17 digits, and a modulus without data."""

    B, STDDEV = 600.0 + 1 / 3, math.pi * 1e-3

    def snapshot(self):
        found = super().snapshot()
        found.parameters["B"] = ParameterEstimate("B", self.B, self.STDDEV, "N·s/m", "converged",
                                                  "B has converged")
        found.parameters["beta_e"] = ParameterEstimate("beta_e", math.nan, math.nan, "Pa",
                                                       "no_data", "no demanded position")
        return found


def test_value_deviation_unit_and_status_come_in_one_stamped_message(graph):
    _, estimator, sender = start(graph, {"rig": {"name": "bench"}})
    estimator.__class__ = Odd
    heard = listen(graph, DiagnosticArray, "/eha/monitor/estimates")
    states = listen(graph, JointState, "/eha/monitor/joint_states")
    old = listen(graph, Float64, "/eha/monitor/viscous_damping")
    sender.send(0, 200)
    graph.until(lambda: heard and states and old and len(estimator.rows) == 200)
    last = graph.until(lambda: next((m for m in heard if stamp_ns(m) == START_NS + 199_000_000),
                                    None))
    graph.until(lambda: stamp_ns(states[-1]) == stamp_ns(last))  # the same data
    assert last.header.frame_id == "bench" == states[-1].header.frame_id
    damping = values(last, "bench: viscous_damping")
    assert (float(damping["value"]), float(damping["stddev"])) == (Odd.B, Odd.STDDEV)  # to the bit
    assert old[-1].data == Odd.B and damping["unit"] == "N·s/m"
    assert damping["status"] == "converged"
    assert (damping["by"], damping["in_doubt"]) == ("stage one", "0")
    assert values(last, "bench: bulk_modulus") == {
        "unit": "Pa", "status": "no_data", "by": "stage two", "in_doubt": "0"}
    assert levels(last) == {"bench: viscous_damping": DiagnosticStatus.OK,
                            "bench: bulk_modulus": DiagnosticStatus.STALE}
    assert [status.message for status in last.status] == ["B has converged",
                                                          "no demanded position"]
    assert {status.hardware_id for status in last.status} == {"bench"}


def test_an_alarm_is_told_at_once_and_then_with_its_bag(graph, tmp_path):
    monitor, estimator, sender = start(graph, tree(tmp_path, save_on="warn"))
    for job in monitor.load._jobs:
        if job[2] == monitor._every_second:
            job[1] += SLOW_S  # so that no second's tick tells it
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    diagnostics = listen(graph, DiagnosticArray, "/diagnostics")

    def shown(key):
        return [values(m, "eha: viscous_damping_high").get(key) for m in health]

    begun = time.monotonic()
    at = play(graph, sender, 0, lambda: health and levels(health[-1])[
        "eha: viscous_damping_high"] == DiagnosticStatus.OK)
    estimator.damping = 1200.0
    play(graph, sender, at, lambda: levels(health[-1])["eha: viscous_damping_high"]
         == DiagnosticStatus.WARN)
    first = next(m for m in health if levels(m)["eha: viscous_damping_high"]
                 == DiagnosticStatus.WARN)
    assert values(first, "eha: viscous_damping_high")["bag_due"] == "1"
    bag = graph.until(lambda: next(filter(None, shown("bag")), None))
    assert values(health[-1], "eha: data")["last_bag"] == bag
    assert "bag" not in values(health[-1], "eha: bulk_modulus_low")
    graph.until(lambda: any(values(m, "eha: viscous_damping_high").get("bag") == bag
                            for m in diagnostics))
    assert time.monotonic() - begun < SLOW_S
    assert health[-1].header.frame_id == diagnostics[-1].header.frame_id == "eha"
    assert topics(bag)["/eha/joint_states"].count >= 100
    # The bag holds the moment: the health in which the alarm was raised.
    store = get_typestore(Stores.ROS2_JAZZY)
    kept = [store.deserialize_cdr(bytes(data), "diagnostic_msgs/msg/DiagnosticArray")
            for topic, _, _, data in iter_raw(bag) if topic == "/eha/monitor/health"]
    assert any(status.name == "eha: viscous_damping_high" and status.level == 1
               for message in kept for status in message.status)
    assert topics(bag)["/eha/monitor/estimates"].count >= 1


def test_the_next_time_an_alarm_is_raised_it_does_not_name_the_bag_of_before(graph, tmp_path):
    monitor, estimator, sender = start(graph, tree(tmp_path, save_on="warn"))
    at = play(graph, sender, 0, lambda: estimator.rows)
    estimator.damping = 1200.0
    at = play(graph, sender, at, lambda: any(monitor.keeper.bags.values()))
    (bag,) = monitor.keeper.bags.values()
    estimator.damping = 600.0
    at = play(graph, sender, at, lambda: monitor.board.history[-1].level == "OK")
    assert monitor.keeper.bags["viscous_damping_high"] == bag
    estimator.damping = 1200.0
    play(graph, sender, at, lambda: monitor.board.history[-1].level == "WARN")
    assert monitor.keeper.bags["viscous_damping_high"] == ""  # due when the one before has aged
    monitor.close()
    assert monitor.keeper.bags["viscous_damping_high"] not in ("", bag)


def test_thresholds_that_change_are_told_at_once(graph):
    monitor, _, _ = start(graph, {"thresholds": LIMITS})
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    graph.until(lambda: health)
    count = len(health)
    monitor.reconfigure(settings_from_tree({"thresholds": {
        "viscous_damping": {"high_warn": 900.0}}}, "test"))
    graph.until(lambda: len(health) > count)
    assert values(health[count], "eha: viscous_damping_high")["limit_warn"] == "900"


@pytest.mark.parametrize(("transition", "words"), [
    ("deactivate", "the monitor is not active"), ("shutdown", "the monitor has ended")])
def test_a_transition_of_the_node_is_told_at_once(graph, transition, words):
    with running.made("monitor", ManagedMonitor, settings_from_tree({}, "test"), "test",
                      "monitor", Recorder) as node:
        graph.executor.add_node(node)
        health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
        caller = Caller(graph)
        assert caller.change("/eha/monitor", "configure") and not health
        assert caller.change("/eha/monitor", "activate")
        graph.until(lambda: health)
        assert caller.state("/eha/monitor") == "active"
        if transition == "shutdown":  # the contract's number is that of the inactive state
            node.trigger_shutdown()
        else:
            assert caller.change("/eha/monitor", transition)
        graph.until(lambda: any(words in status.message for status in health[-1].status))
        assert {status.level for status in health[-1].status} == {DiagnosticStatus.STALE} or all(
            status.level == DiagnosticStatus.STALE or status.message == "no limit set"
            for status in health[-1].status)
        graph.executor.remove_node(node)


def test_after_a_remap_messages_and_diagnostics_name_the_new_topic(graph):
    logs = listen(graph, Log, "/rosout", 100)
    settings = settings_from_tree({"monitor": {"stale_after": 0.3}}, "test")
    node = graph.node("monitor", "/eha", cli_args=[
        "--ros-args", "-r", "joint_states:=/robot/joint_states", "-r",
        "pressure/chamber_1:=p_a"])
    monitor = Monitor(node, settings, Recorder)
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    graph.until(lambda: health)

    def message(name):
        return next(s.message for s in health[-1].status if s.name == name)

    assert message("eha: data") == "no data yet: nothing received on /robot/joint_states"
    sender = Feeder(graph)
    publisher = graph.node("robot").create_publisher(JointState, "/robot/joint_states", 100)
    sender.joints = publisher
    graph.until(lambda: publisher.get_subscription_count() and
                sender.command.get_subscription_count())
    sender.send(0, 300)
    graph.until(lambda: len(monitor._estimator.rows) == 300)
    graph.until(lambda: "nothing on /robot/joint_states" in message("eha: data"))
    assert "/eha/p_a" in message("eha: data") or any(
        "/eha/p_a: nothing received, so no p1" in each for each in monitor.data.problems)
    graph.until(lambda: "rate_robot_joint_states_Hz" in values(health[-1], "eha: data"))
    assert "rate_command_Hz" in values(health[-1], "eha: data")
    graph.until(lambda: any("data: /eha/p_a: nothing received, so no p1" in m.msg for m in logs))
    told = [m.msg for m in logs if m.name == "eha.monitor"] + [
        s.message for m in health for s in m.status]
    assert told and not [text for text in told if "/eha/joint_states" in text
                         or "pressure/chamber_1" in text]


def test_the_data_say_that_pressures_are_absolute(graph):
    _, _, sender = start(graph)
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    sender.send(0, 50)
    graph.until(lambda: health and values(health[-1], "eha: data").get("pressures"))
    assert values(health[-1], "eha: data")["pressures"] == "absolute, Pa"
