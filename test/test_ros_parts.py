"""Joints in messages of their own, and all in one filled with NaN: both forms are read."""

import math

import numpy as np
import pytest
from ros_tools import BEST_EFFORT, MS, START_NS, Feeder, Recorder, listen
from sensor_msgs.msg import FluidPressure, JointState

from eha_monitor.ros import messages
from eha_monitor.ros.monitor_node import Monitor
from eha_monitor.ros.simulator_node import SimulatorNode
from eha_monitor.settings import settings_from_tree

STILL = {"excitation": {"still": {"kind": "rest", "duration": 1.0}}}


def apart(graph, names=("piston", "pump"), **tree):
    """Return a monitor, its recording estimator, and a function that sends samples."""
    settings = settings_from_tree(tree, "test")
    monitor = Monitor(graph.node("monitor", "/eha"), settings, Recorder)
    feeder = Feeder(graph)
    graph.until(feeder.matched)

    def send(first, count, without=(), nan=1):
        for k in range(first, first + count):
            stamp = messages.stamp(START_NS + k * MS)
            both = (JointState(name=[names[0]], position=[0.001 * k]),
                    JointState(name=[names[1]], velocity=[math.nan if k % nan else 100.0 + k]))
            for message in both:
                if message.name[0] not in without:
                    message.header.stamp = stamp
                    feeder.joints.publish(message)
            graph.executor.spin_once(timeout_sec=0)
    return monitor, monitor._estimator, send


def test_joints_of_two_messages_are_one_row(graph):
    monitor, estimator, send = apart(graph)
    send(0, 200)
    graph.until(lambda: len(estimator.rows) == 200)
    for k, (_, row) in enumerate(estimator.rows):
        assert row == {"x": pytest.approx(0.001 * k), "omega": 100.0 + k}
    assert not [each for each in monitor.data.problems if "no entry" in each]


def test_a_number_that_lacks_is_told_and_no_joint_is_missed(graph):
    monitor, estimator, send = apart(graph)
    send(0, 100)
    graph.until(lambda: len(estimator.rows) == 100)
    for first in range(100, 10_000, 100):
        send(first, 100, nan=2)
        graph.until(lambda count=first + 100: len(estimator.rows) == count)
        if any("omega: NaN in" in each for each in monitor.data.problems):
            break
    else:
        raise AssertionError(monitor.data.problems)
    assert not [each for each in monitor.data.problems if "no entry" in each]
    assert estimator.rows[-2][1]["omega"] == 100.0 + first + 98


def test_a_joint_whose_messages_end_is_named(graph):
    monitor, estimator, send = apart(graph, monitor={"stale_after": 0.3})
    send(0, 100)
    send(100, 50, without=("pump",))
    graph.until(lambda: len(estimator.rows) == 150)
    graph.until(lambda: any("/eha/joint_states (pump): no entry named 'pump', the message has "
                            "piston" in each for each in monitor.data.problems))


def test_the_end_of_all_messages_names_no_joint(graph):
    monitor, estimator, send = apart(graph, monitor={"stale_after": 0.3})
    send(0, 150)
    graph.until(lambda: len(estimator.rows) == 150)
    graph.until(lambda: any("nothing new for 0.3 s" in each for each in monitor.data.problems))
    assert not [each for each in monitor.data.problems if "no entry" in each]


def test_a_wrong_name_is_told(graph):
    monitor, _, send = apart(graph, names=("kolben", "pump"))
    send(0, 50)
    graph.until(lambda: any("no entry named 'piston'" in each for each in monitor.data.problems))


def test_the_simulator_fills_nothing_with_nan_and_names_the_frame(graph):
    settings = settings_from_tree({"simulation": STILL, "rig": {"name": "bench"}}, "test")
    heard = {topic: listen(graph, kind, f"/eha/{topic}", BEST_EFFORT) for topic, kind in (
        ("joint_states", JointState), ("command", JointState),
        ("pressure/chamber_1", FluidPressure))}
    SimulatorNode(graph.node("simulator", "/eha"), settings, seed=1)
    graph.until(lambda: len(heard["joint_states"]) > 200)
    graph.until(lambda: heard["command"] and heard["pressure/chamber_1"])
    assert {message.header.frame_id for found in heard.values() for message in found} == {"bench"}
    by_name = {}
    for message in heard["joint_states"]:
        arrays = [message.position, message.velocity, message.effort]
        assert all(len(array) in (0, len(message.name)) for array in arrays)
        assert np.isfinite(np.concatenate(arrays)).all()
        by_name.setdefault(tuple(message.name), set()).add(tuple(len(a) for a in arrays))
    assert by_name == {("piston",): {(1, 0, 0)}, ("pump",): {(0, 1, 0)}}
    absolute = heard["pressure/chamber_1"][0].fluid_pressure
    assert absolute == pytest.approx(settings.rig.charge_pressure, rel=0.01)


def test_joints_of_which_the_same_is_measured_share_a_message(graph):
    settings = settings_from_tree({"simulation": {**STILL, "publish": ["v", "omega"]},
                                   "monitor": {"frame_id": "base_link"}}, "test")
    heard = listen(graph, JointState, "/eha/joint_states", BEST_EFFORT)
    SimulatorNode(graph.node("simulator", "/eha"), settings, seed=1)
    graph.until(lambda: heard)
    assert heard[0].name == ["piston", "pump"] and len(heard[0].velocity) == 2
    assert not heard[0].position and heard[0].header.frame_id == "base_link"
