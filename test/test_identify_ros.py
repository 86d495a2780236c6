"""An experiment over DDS: the real simulator follows, and a motion is aborted in each way."""

import json
import signal
import threading

import numpy as np
import pytest
from ros_tools import PATIENCE, Caller, command, end
from sensor_msgs.msg import JointState

from eha_monitor.errors import InputError
from eha_monitor.ros.identify_node import RosRig
from eha_monitor.ros.messages import joint_state
from eha_monitor.settings import load_settings

DT = 1e-3


class Asked:
    """Asks a rig from another thread while the graph turns."""

    def __init__(self, graph, rig):
        self.graph, self.rig = graph, rig

    def begin(self, function, *arguments):
        found = []

        def work():
            try:
                found.append(function(*arguments))
            except InputError as problem:
                found.append(problem)

        threading.Thread(target=work, daemon=True).start()
        return found

    def __call__(self, function, *arguments, timeout=60.0):
        found = self.begin(function, *arguments)
        return self.graph.until(lambda: found, timeout)[0]


def sine(position, amplitude, frequency, seconds):
    return position + amplitude * np.sin(2 * np.pi * frequency * np.arange(
        round(seconds / DT)) * DT)


def test_motion_abort_at_a_limit_by_the_service_and_without_data(graph, tmp_path, monkeypatch):
    monkeypatch.setattr("eha_monitor.ros.identify_node.PATIENCE", PATIENCE)
    config = tmp_path / "rig.yaml"
    config.write_text("simulation: {demand: topic}", encoding="utf-8")
    settings = load_settings("config/identify.yaml")
    bounds = settings.experiment.model_copy(update={"command_lead": 0.3})
    rig = RosRig(graph.node("identify", "/eha"), settings, bounds, tmp_path / "bags")
    asked, caller = Asked(graph, rig), Caller(graph)
    with command("simulator", "--config", config, "--seed", "1") as simulator:
        assert asked(rig.position, timeout=PATIENCE) == pytest.approx(0.0, abs=1e-4)
        assert asked(rig.ready) is None

        ran = asked(rig.run, sine(0.0, 0.005, 1.0, 1.5), "motion_01")
        assert not ran.aborted and ran.bag == tmp_path / "bags" / "motion_01"
        x, x_d = (ran.recording.channels[name] for name in ("x", "x_d"))
        assert np.nanmax(x_d) == pytest.approx(0.005, rel=1e-3) and np.nanmax(x) > 0.002
        # What is recorded as demanded is what the rig followed, to the sample.
        v = np.gradient(x, DT)
        rate = settings.rig.position_gain * settings.rig.pump_displacement / settings.rig.area_1
        good = np.isfinite(x_d) & np.isfinite(v)
        assert np.nanstd((rate * (x_d - x) - v)[good]) < 0.1 * np.nanstd(v[good])

        ran = asked(rig.run, sine(0.0, 0.06, 2.0, 4.0), "too_fast")
        assert "the limit is 150 mm/s" in ran.aborted or "the limit is 5 m/s²" in ran.aborted
        assert not ran.asked and ran.recording.duration < 2.5
        assert abs(rig.position()) < 0.06

        stopped = asked.begin(rig.run, np.full(20_000, rig.position()), "long")
        graph.until(lambda: rig._job is not None and rig._job.sent > 0)
        answer = caller.trigger("/eha/identify/stop")
        assert answer.success and "aborted" in answer.message
        ran = graph.until(lambda: stopped)[0]
        assert ran.asked and "identify/stop" in ran.aborted
        again = asked(rig.run, sine(rig.position(), 1e-3, 1.0, 1.0), "never")
        # A command that holds the position may still be on its way; of the motion nothing is.
        demanded = again.recording.channels.get("x_d", np.zeros(1))
        assert again.asked and np.nanmax(demanded) - np.nanmin(demanded) < 1e-9

        rig._stop = ""
        stalled = asked.begin(rig.run, sine(rig.position(), 1e-3, 1.0, 9.0), "stalled")
        graph.until(lambda: rig._job is not None and rig._job.sent > 0)
        rig._job.start_ns -= 3_000_000_000  # as if this process had been stopped for 3 s
        ran = graph.until(lambda: stalled)[0]
        assert "this program stood still" in ran.aborted and not ran.asked

        silent = asked.begin(rig.run, np.full(20_000, rig.position()), "silent")
        graph.until(lambda: rig._job is not None and rig._job.sent > 0)
        end(simulator)
        ran = graph.until(lambda: silent)[0]
    assert "nothing came of" in ran.aborted and not ran.asked


def test_a_piston_that_does_not_follow_is_held_where_it_is(graph, tmp_path):
    """A pump would go on against a blocked one, and one that is off jump when it is on."""
    settings, stands, sent = load_settings("config/identify.yaml"), 0.002, []
    rig = RosRig(graph.node("identify", "/eha"), settings, settings.experiment, tmp_path)
    blocked = graph.node("blocked", "/eha")
    shown = blocked.create_publisher(JointState, "joint_states", 100)
    blocked.create_timer(0.01, lambda: shown.publish(joint_state(
        blocked.get_clock().now().nanoseconds, "piston", stands, np.nan)))
    blocked.create_subscription(JointState, "command", sent.append, 1000)
    asked = Asked(graph, rig)
    assert asked(rig.position) == pytest.approx(stands)
    ran = asked(rig.run, sine(stands, 0.03, 0.5, 4.0), "motion_01")
    assert "expected one that follows the command" in ran.aborted and not ran.asked
    assert max(one.position[0] for one in sent) < stands + 0.03  # before it was all demanded
    graph.until(lambda: sent[-1].position[0] == pytest.approx(stands, abs=1e-9))


def test_an_interrupted_motion_is_held_and_written(graph, tmp_path):
    config, answer = tmp_path / "rig.yaml", tmp_path / "a.json"
    config.write_text("simulation: {demand: topic}", encoding="utf-8")
    sent = []
    graph.node("listener").create_subscription(JointState, "/eha/command", sent.append, 10)
    with command("simulator", "--config", config, "--seed", "1"), \
            command("identify", "--config", "config/identify.yaml", "--out", tmp_path / "bags",
                    "--json", answer) as process:
        graph.until(lambda: len(sent) > 400, PATIENCE)
        process.send_signal(signal.SIGINT)
        graph.until(lambda: process.poll() is not None)
        out, err = process.communicate()
    assert process.returncode == 130, err
    assert "aborted: interrupted" in out and "Traceback" not in err
    found = json.loads(answer.read_text(encoding="utf-8"))
    assert found["end"] == "aborted" and found["bags"] == [str(tmp_path / "bags" / "motion_01")]
    assert (tmp_path / "bags" / "motion_01" / "metadata.yaml").is_file()
    # the last may still wait in this node's queue
    graph.until(lambda: abs(sent[-1].position[0] - sent[-2].position[0]) < 1e-9)


@pytest.mark.slow
def test_the_command_decides_over_dds_and_waits_to_be_told(graph, tmp_path):
    config, answer = tmp_path / "rig.yaml", tmp_path / "a.json"
    config.write_text("simulation: {demand: topic}\neffects: {quadratic_friction: {a_1: 600}}",
                      encoding="utf-8")
    caller = Caller(graph, 120.0)
    with command("simulator", "--config", config, "--seed", "1"), \
            command("identify", "--config", "config/identify.yaml", "--wait", "--out",
                    tmp_path / "bags", "--json", answer) as process:
        assert caller.trigger("/eha/identify/start").success
        assert not caller.trigger("/eha/identify/start").success
        out, err = process.communicate(timeout=400)
    assert process.returncode == 0, err
    assert ": quadratic friction, 9" in out and "Decided" in out
    assert json.loads(answer.read_text(encoding="utf-8"))["end"] == "decided"


def test_an_interrupted_wait_ends_quietly(graph):
    with command("identify", "--config", "config/identify.yaml", "--wait") as process:
        Caller(graph, 90.0).trigger("/eha/identify/start")
        end(process, signal.SIGINT, 130)


def test_nobody_to_move_is_one_line(graph, tmp_path, monkeypatch):
    monkeypatch.setattr("eha_monitor.ros.identify_node.PATIENCE", 0.3)
    settings = load_settings("config/identify.yaml")
    # A namespace of its own: a simulator that was killed just now is still discovered.
    rig = RosRig(graph.node("identify", "/nobody"), settings, settings.experiment, tmp_path)
    asked = Asked(graph, rig)
    assert "no position came" in str(asked(rig.position))
    assert "nobody subscribes" in str(asked(rig.ready))
    other = graph.node("controller", "/nobody")
    other.create_publisher(JointState, "command", 10)
    other.create_subscription(JointState, "command", lambda message: None, 10)
    graph.until(lambda: len(other.get_publishers_info_by_topic("/nobody/command")) == 2)
    assert "controller commands the rig already" in str(asked(rig.ready))
