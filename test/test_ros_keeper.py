"""Services of monitor and simulator, and the bag of the last minutes, over DDS on loopback."""

import os

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.serialization import deserialize_message
from ros_tools import PATIENCE, START_NS, Caller, command, end, levels, listen, start
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from eha_monitor.recordings.bag import iter_raw, topics
from eha_monitor.ros.simulator_node import SimulatorNode
from eha_monitor.ros.topics import LATCHED
from eha_monitor.settings import settings_from_tree

LIMITS = {"viscous_damping": {"high_warn": 1000.0, "high_error": 1500.0, "hold_time": 0.1}}


def tree(folder, **monitor):
    """Return a config in which a machine that stops for a while makes nothing stale."""
    return {"monitor": {"save_folder": str(folder), "stale_after": 60.0, **monitor},
            "thresholds": LIMITS}


def play(graph, sender, first, until):
    """Send samples from ``first`` on until a condition holds; returns the next one."""
    for start_at in range(first, first + 10_000, 100):
        sender.send(start_at, 100)
        graph.executor.spin_once(timeout_sec=0.01)
        if until():
            return start_at + 100
    raise AssertionError("not within 10 s of data")


def data_status(health):
    """Return message and values of the status of the data."""
    status = next(s for s in health[-1].status if s.name == "eha: data")
    return status.message, {v.key: v.value for v in status.values}


def test_reset_begins_the_estimators_anew(graph):
    _, estimator, sender = start(graph)
    sender.send(0, 100)
    graph.until(lambda: len(estimator.rows) == 100)
    answer = Caller(graph).trigger("/eha/monitor/reset")
    assert answer.success and "estimators reset" in answer.message
    assert estimator.resets == ["requested by the service monitor/reset"]
    sender.send(100, 100)
    graph.until(lambda: len(estimator.rows) == 200)
    assert estimator.rows[100][0] == 0.0


def test_save_writes_inputs_estimates_and_health(graph, tmp_path):
    monitor, estimator, sender = start(graph, tree(tmp_path))
    damping = listen(graph, Float64, "/eha/monitor/viscous_damping")
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    sender.send(0, 300)
    graph.until(lambda: damping and len(estimator.rows) == 300)
    answer = Caller(graph).trigger("/eha/monitor/save")
    assert answer.success, answer.message
    bag = monitor.keeper.values()["last_bag"]
    assert answer.message.startswith(f"{bag}: ") and " s, from " in answer.message
    found = topics(bag)
    for name in ("joint_states", "command", "pressure/chamber_1", "pressure/chamber_2"):
        assert found[f"/eha/{name}"].count == 300
    assert found["/eha/monitor/viscous_damping"].count >= 1
    assert found["/eha/monitor/health"].count >= 1 and "/diagnostics" not in found
    states = [deserialize_message(bytes(data), JointState)
              for topic, _, _, data in iter_raw(bag) if topic == "/eha/joint_states"]
    assert [s.header.stamp.nanosec for s in states] == [k * 1_000_000 for k in range(300)]
    assert states[7].position[0] == pytest.approx(0.007)
    graph.until(lambda: data_status(health)[1].get("last_bag") == bag)
    assert float(data_status(health)[1]["buffer_messages"]) >= 1200


def test_an_alarm_saves_the_minutes_before_it_once(graph, tmp_path):
    monitor, estimator, sender = start(graph, tree(tmp_path, save_on="error"))
    history = monitor.board.history

    def became(level, times=1):
        return lambda: [a.level for a in history
                        if a.name == "viscous_damping_high"].count(level) == times

    estimator.damping = 1200.0
    at = play(graph, sender, 0, became("WARN"))
    monitor.keeper.poll()
    assert not os.listdir(tmp_path) and not monitor.keeper._saver.busy
    estimator.damping = 1700.0
    at = play(graph, sender, at, became("ERROR"))
    graph.until(lambda: monitor.keeper.last)
    assert monitor.keeper.last.problem is None
    assert topics(monitor.keeper.last.path)["/eha/joint_states"].count >= 200
    # The next alarm's past is in that bag: it waits until a bag of its own joins it.
    estimator.damping = 600.0
    at = play(graph, sender, at, became("OK", 2))
    estimator.damping = 1700.0
    play(graph, sender, at, became("ERROR", 2))
    monitor.keeper.poll()
    assert len(os.listdir(tmp_path)) == 1 and not monitor.keeper._saver.busy
    monitor.close()  # what is due is not lost when the monitor ends
    assert len(os.listdir(tmp_path)) == 2


def test_a_bag_that_cannot_be_written_is_a_diagnostic_and_nothing_is_lost(graph, tmp_path):
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where the folder should be")
    monitor, estimator, sender = start(graph, tree(blocked, stale_after=1.0))
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    sender.send(0, 200)
    graph.until(lambda: len(estimator.rows) == 200)
    caller = Caller(graph)
    answer = caller.trigger("/eha/monitor/save")
    assert not answer.success and "cannot write bag" in answer.message
    graph.until(lambda: "cannot write bag" in data_status(health)[0])
    assert levels(health[-1])["eha: data"] != DiagnosticStatus.OK
    sender.send(200, 200)
    graph.until(lambda: len(estimator.rows) == 400)
    # Said beside what else is to be said of the data.
    graph.until(lambda: "data stopped" in data_status(health)[0], 5.0)
    assert "cannot write bag" in data_status(health)[0]
    blocked.unlink()
    answer = caller.trigger("/eha/monitor/save")
    assert answer.success, answer.message
    assert topics(monitor.keeper.last.path)["/eha/joint_states"].count == 400


def test_a_bag_that_is_due_is_written_when_a_signal_ends_the_monitor(graph, tmp_path):
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where the folder should be")
    config = tmp_path / "config.yaml"
    config.write_text(f"monitor: {{save_folder: '{blocked}'}}")
    caller = Caller(graph, PATIENCE)
    with command("monitor", "--config", config) as process:
        assert not caller.trigger_until_answered("/eha/monitor/save").success  # to be tried again
        blocked.unlink()
        end(process)
    (bag,) = blocked.iterdir()
    assert topics(bag)["/eha/monitor/health"].count >= 1


def test_the_filter_goes_on_while_a_bag_is_written(graph, tmp_path):
    monitor, estimator, sender = start(graph, tree(tmp_path))
    stream = monitor.keeper.stream("filling", "std_msgs/msg/Float64")
    for k in range(60_000):
        monitor.keeper.ring.append(stream, START_NS + k, b"\0\1\0\0" + os.urandom(8))
    future = Caller(graph).begin(Trigger, "/eha/monitor/save", Trigger.Request())
    graph.until(lambda: monitor.keeper._saver.busy)
    sender.send(0, 20)
    graph.until(lambda: len(estimator.rows) == 20)
    assert not future.done() and not os.path.exists(monitor.keeper.values().get("last_bag", "-"))
    graph.until(future.done)
    assert future.result().success


def test_without_a_buffer_nothing_is_kept(graph):
    _, estimator, sender = start(graph, {"monitor": {"buffer_minutes": 0.0}})
    sender.send(0, 50)
    graph.until(lambda: len(estimator.rows) == 50)
    answer = Caller(graph).trigger("/eha/monitor/save")
    assert not answer.success and "buffer_minutes is 0" in answer.message


def test_excite_begins_the_test_excitation_once(graph):
    test = {"kind": "sine", "duration": 0.5, "amplitude": 0.01, "frequency": 2.0}
    settings = settings_from_tree({"simulation": {
        "excitation": {"still": {"kind": "rest", "duration": 1.0}},
        "test_excitation": {"wave": test}}}, "test")
    heard = []
    simulator = SimulatorNode(graph.node("simulator", "/eha"), settings, seed=1)
    graph.node("ears", "/eha").create_subscription(JointState, "command", heard.append, 1000)
    caller = Caller(graph)
    graph.until(lambda: heard)
    answer = caller.trigger("/eha/simulator/excite")
    assert answer.success and "(wave) for 0.5 s" in answer.message
    again = caller.trigger("/eha/simulator/excite")
    assert not again.success and "is running" in again.message
    graph.until(lambda: max(m.position[0] for m in heard) > 0.0099)
    graph.until(lambda: not simulator._simulator.test_left)
    end = simulator.samples + 200
    graph.until(lambda: simulator.samples > end and heard[-1].position[0] == 0.0)
    moved = [m.position[0] != 0.0 for m in heard]
    assert 480 <= sum(moved) <= 500  # half a second, but for its zeros
    assert caller.trigger("/eha/simulator/excite").success
