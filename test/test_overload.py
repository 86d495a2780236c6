"""A monitor that cannot keep up says so: in words, with how far behind it is and what to do."""

import os
import re
import signal
import subprocess
import sys
import textwrap
import time

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from ros_tools import Recorder, listen

from eha_monitor.health.overload import LoadWatch
from eha_monitor.ros.messages import findings_of
from eha_monitor.ros.monitor_node import Monitor
from eha_monitor.ros.topics import LATCHED
from eha_monitor.settings import Settings


def looked(seconds, rate=1000.0, lost=0.0, behind=0.0, away=0.1):
    """Look five times a second for some seconds; ``behind`` may be a function of time."""
    watch = LoadWatch(stale_after=1.0)
    for k in range(round(5 * seconds) + 1):
        now, sent = 0.2 * k, rate * 0.2 * k
        watch.look(now, round(sent * (1 - lost)), round(sent * lost),
                   behind(now) if callable(behind) else behind, away)
    return watch, watch.found(now)


def test_a_monitor_that_keeps_up_says_nothing():
    assert looked(20.0)[1] is None
    assert looked(20.0, lost=0.02, away=0.4)[1] is None  # one in fifty
    assert looked(20.0, behind=0.2)[1] is None


def test_what_is_lost_on_the_way_is_not_the_monitors():
    """It ran all the time and nothing waited: the data's own sentence tells of the loss."""
    watch, found = looked(20.0, lost=0.5)
    assert found is None and watch.share == pytest.approx(0.5)


def test_starved_it_says_how_much_is_missing_and_how_far_it_is_behind():
    watch, found = looked(20.0, lost=0.9, behind=9.3, away=0.8)
    assert found.level == "ERROR" and (watch.share, watch.behind) == (pytest.approx(0.9), 9.3)
    assert found.sentence == (
        "the monitor cannot keep up: 90 % of the samples of the last 5 s are missing and it is "
        "9.3 s behind, so the estimates are not current; lower the publishers' rate, raise "
        "monitor.latency, or give the monitor a core of its own")


@pytest.mark.parametrize("lost, behind, level", [
    (0.05, 0.3, "WARN"), (0.05, 1.5, "ERROR"), (0.6, 0.3, "ERROR"), (0.0, 0.7, "WARN"),
    (0.0, 1.2, "ERROR"), (0.0, 0.4, None)])
def test_its_level_is_of_the_missing_and_of_the_age(lost, behind, level):
    found = looked(10.0, lost=lost, behind=behind)[1]
    assert (found and found.level) == level


def test_one_late_look_is_the_schedulers_and_what_is_over_is_over():
    assert looked(10.0, behind=lambda now: 2.0 * (now > 9.9))[1] is None
    assert looked(10.0, behind=lambda now: 2.0 * (now < 4.0))[1] is None


# A publisher faster than the monitor: each of its samples has another, old clock's stamp.
PUBLISHER = """
    import sys, time
    import rclpy
    from sensor_msgs.msg import JointState
    from eha_monitor.ros import messages

    rclpy.init()
    node = rclpy.create_node("fast", namespace="/eha")
    joints = node.create_publisher(JointState, "joint_states", 1000)
    command = node.create_publisher(JointState, "command", 1000)
    while not (joints.get_subscription_count() and command.get_subscription_count()):
        time.sleep(0.01)
    sent, start = 0, time.monotonic()
    while (now := time.monotonic() - start) < float(sys.argv[1]):
        while sent < 1000 * now:
            for publisher in (joints, command):
                publisher.publish(messages.joint_state(
                    1_000_000_000_000 + 1_000_000 * sent, "piston", 1e-5 * sent, 0.1))
            sent += 1
        time.sleep(0.001)
"""


class Slow(Recorder):
    """An estimator that takes twice as long as the samples are apart."""

    def push(self, time_s, row):
        super().push(time_s, row)
        end = time.monotonic() + 0.002
        while time.monotonic() < end:
            pass


def test_a_monitor_that_falls_behind_a_bag_says_so_while_it_does(graph):
    monitor = Monitor(graph.node("monitor", "/eha"), Settings(), Slow)
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    with subprocess.Popen([sys.executable, "-c", textwrap.dedent(PUBLISHER), "8"]) as sender:
        try:
            graph.until(lambda: monitor.data.overload, 60.0)
            graph.until(lambda: monitor.load.watch.behind > 1.5, 60.0)
            graph.until(lambda: monitor.data.overload and monitor.data.overload.level == "ERROR",
                        60.0)
        finally:
            sender.kill()
    assert "s behind, so the estimates are not current" in monitor.data.overload.sentence
    assert not any("late" in p or "dropped" in p for p in monitor.data.problems)
    assert "no data for x_d" not in " ".join(a.message for a in monitor.board.alarms)

    def told():  # what is missing may make it an ERROR before it is a second behind
        return [f for array in health for f in findings_of(array)
                if f.name == "data" and f.level == "ERROR" and float(f.values["behind_s"]) > 1.0]
    graph.until(told, 60.0)
    assert told()[0].message.startswith("the monitor cannot keep up: ")
    graph.until(lambda: monitor.data.overload is None, 60.0)  # the queue has been worked off


# 40 s.  What came while the process stood is lost on its way into it.
@pytest.mark.slow
def test_a_monitor_that_is_held_up_names_what_it_missed(graph):
    """The real process, stopped by a signal while samples come."""
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)

    def data(arrays):
        return [f for array in arrays for f in findings_of(array) if f.name == "data"]
    with subprocess.Popen([sys.executable, "-m", "eha_monitor", "monitor"],
                          stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as monitor, \
            subprocess.Popen([sys.executable, "-c", textwrap.dedent(PUBLISHER), "60"]) as sender:
        try:
            graph.until(lambda: health and int(data(health[-1:])[0].values.get("rows") or 0) > 500,
                        180.0)
            os.kill(monitor.pid, signal.SIGSTOP)
            stopped = time.monotonic()
            graph.until(lambda: time.monotonic() - stopped > 13.0, 20.0)
            os.kill(monitor.pid, signal.SIGCONT)
            heard = len(health)
            graph.until(lambda: any(
                re.match(r"no data for 1[23]\.\d+ s", f.values.get("last_event", ""))
                for f in data(health[heard:])), 60.0)
            assert not any("no data for x_d" in f.message for array in health[heard:]
                           for f in findings_of(array)[:4])
        finally:
            sender.kill()
            monitor.kill()
