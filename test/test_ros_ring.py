"""The whole ring over DDS on loopback: an effect appears, is diagnosed, adopted, and goes again."""

import signal
import time

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rig_tools import MULTISINE
from ros_tools import Caller, listen, start
from std_srvs.srv import Trigger
from test_ros_processes import PATIENCE, command, end

from eha_monitor.live.exchange import Adopted, model_of
from eha_monitor.ros.messages import findings_of
from eha_monitor.ros.qos import LATCHED
from eha_monitor.settings import settings_from_tree
from eha_monitor.settings.document import annotated

FRICTION, SINCE = 40.0, 4.0  # N of it from 4 s on
MOTION = {"excitation": {"motion": {**MULTISINE, "duration": 600.0}}}
FAULT = {"faults": {"dry": {"parameter": "coulomb_friction.F_c", "start": SINCE,
                            "value": FRICTION}}}


class Ring:
    """What a monitor process says, and its services."""

    def __init__(self, graph, folder, **tree):
        self.graph, self.folder = graph, folder
        self.caller = Caller(graph, PATIENCE)
        self.found, self.log, self.said, self.began = {}, [], [], time.monotonic()
        self.tree = tree | {"monitor": {"save_folder": str(folder / "saved")}}
        node = graph.node("listener", "/eha")
        for topic in ("monitor/health", "monitor/diagnosis"):
            node.create_subscription(DiagnosticArray, topic, self._take, LATCHED)

    def config(self, name, **tree):
        path = self.folder / f"{name}.yaml"
        path.write_text(annotated(settings_from_tree(self.tree | tree, "test")))
        return path

    def _take(self, message):
        for one in findings_of(message):
            if one.name not in self.found or one.word != self.found[one.name].word:
                self.log.append((time.monotonic() - self.began, one.name, one.word, one.message))
            event = one.values.get("event")
            if event and event not in self.said:
                self.said.append(event)
                self.log.append((time.monotonic() - self.began, "event", "", event))
            self.found[one.name] = one
        if "effect coulomb_friction" in self.found and not any(
                one.name.startswith("effect") for one in findings_of(message)
                ) and message.status[0].name.endswith("diagnosis"):
            del self.found["effect coulomb_friction"]

    def until(self, condition, timeout=PATIENCE):
        self.graph.until(condition, timeout)
        return time.monotonic()

    def word(self, name):
        return self.found[name].word if name in self.found else ""

    def damping(self):
        return float(self.found["viscous_damping_high"].values["viscous_damping_Ns_per_m"])


def test_an_effect_is_found_adopted_and_taken_back(graph, tmp_path):
    ring = Ring(graph, tmp_path, diagnosis={"after": 6.0})
    monitor_config = ring.config("monitor")
    try:
        with command("monitor", "--config", monitor_config) as monitor:
            ring.until(lambda: "model_in_force" in ring.found and "data" in ring.found)
            nothing = ring.caller.trigger("/eha/monitor/adopt")
            assert not nothing.success and "nothing to adopt" in nothing.message
            nothing = ring.caller.trigger("/eha/monitor/revert")
            assert not nothing.success and "nothing to take back" in nothing.message
            with command("simulator", "--config", ring.config(
                    "faulty", simulation=MOTION | FAULT)) as simulator:
                ring.until(lambda: ring.word("model_mismatch") == "OK")
                ring.until(lambda: ring.word("model_mismatch") == "WARN")
                ring.until(lambda: ring.word("viscous_damping_high") == "not judged")
                ring.until(lambda: "effect coulomb_friction" in ring.found)
                adopted = ring.caller.trigger("/eha/monitor/adopt")
                assert adopted.success, adopted.message
                ring.until(lambda: ring.word("model_mismatch") == "OK")
                ring.until(lambda: ring.word("viscous_damping_high") == "OK")
                assert ring.damping() == pytest.approx(600, rel=0.03)
                end(simulator)
            with command("simulator", "--config", ring.config("healthy", simulation=MOTION)) as simulator:
                ring.until(lambda: ring.word("model_mismatch") == "WARN")
                reverted = ring.caller.trigger("/eha/monitor/revert")
                assert reverted.success, reverted.message
                ring.until(lambda: ring.word("model_mismatch") == "OK")
                ring.until(lambda: ring.word("viscous_damping_high") == "OK")
                end(simulator)
            print(end(monitor))
    finally:
        for at, *what in ring.log:
            print(f"{at:6.1f}", *what)


def live(graph, folder, **diagnosis):
    """Return a monitor that has taken some rows, its estimator, a sender and a caller."""
    monitor, estimator, sender = start(graph, {
        "monitor": {"save_folder": str(folder), "stale_after": 60.0}, "diagnosis": diagnosis})
    sender.send(0, 200)
    graph.until(lambda: len(estimator.rows) == 200)
    return monitor, estimator, sender, Caller(graph, PATIENCE)


@pytest.mark.parametrize(("budget", "words"), [
    ({"processor_time": 1}, "used up its 1 s of processor time (diagnosis.processor_time)"),
    ({"memory_gigabytes": 0.1}, "ran out of its 0.1 GB of memory (diagnosis.memory_gigabytes)"),
    ({}, "expected at least")], ids=["time", "memory", "recording"])
def test_a_diagnosis_that_fails_is_one_line_and_the_monitor_goes_on(
        graph, tmp_path, budget, words):
    monitor, estimator, sender, caller = live(graph, tmp_path, **budget)
    said = listen(graph, DiagnosticArray, "/eha/monitor/diagnosis", LATCHED)
    future = caller.begin(Trigger, "/eha/monitor/diagnose", Trigger.Request())
    graph.until(lambda: monitor.diagnosis._running)
    again = caller.trigger("/eha/monitor/diagnose")
    assert not again.success and "a diagnosis is under way" in again.message
    sender.send(200, 100)
    graph.until(lambda: len(estimator.rows) == 300)
    graph.until(future.done, PATIENCE)
    answer = future.result()
    assert not answer.success and "\n" not in answer.message
    assert words in answer.message
    graph.until(lambda: any(v.value == answer.message for one in said for v in
                            one.status[0].values if v.key == "event"))
    nothing = caller.trigger("/eha/monitor/adopt")
    assert not nothing.success and "nothing to adopt" in nothing.message
    sender.send(300, 100)
    graph.until(lambda: len(estimator.rows) == 400)


def test_a_bag_that_cannot_be_written_is_told_and_nothing_is_diagnosed(graph, tmp_path):
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where the folder should be")
    monitor, estimator, sender, caller = live(graph, blocked)
    answer = caller.trigger("/eha/monitor/diagnose")
    assert not answer.success and "cannot write bag" in answer.message
    assert monitor.diagnosis._running is None
    sender.send(200, 100)
    graph.until(lambda: len(estimator.rows) == 300)


def test_without_a_buffer_nothing_is_diagnosed(graph):
    start(graph, {"monitor": {"buffer_minutes": 0.0}})
    answer = Caller(graph).trigger("/eha/monitor/diagnose")
    assert not answer.success and "buffer_minutes is 0" in answer.message


def test_a_diagnosis_ends_with_its_monitor(graph, tmp_path):
    monitor, _, _, caller = live(graph, tmp_path)
    future = caller.begin(Trigger, "/eha/monitor/diagnose", Trigger.Request())
    graph.until(lambda: monitor.diagnosis._running)
    process = monitor.diagnosis._running._process
    monitor.close()
    assert process.returncode == -signal.SIGKILL
    graph.until(future.done)
    assert "has stopped" in future.result().message


def test_what_was_adopted_is_there_after_a_restart_and_only_for_the_same_config(graph, tmp_path):
    found = settings_from_tree({"effects": {"coulomb_friction": {"F_c": FRICTION}}}, "test")
    Adopted("service", "2026-01-01T00:00:00+00:00", "coulomb_friction (40 N)", "report.html",
            model_of(settings_from_tree({}, "test")), model_of(found)).save(
                tmp_path / "eha_adopted.json")
    folder = {"save_folder": str(tmp_path)}
    monitor, _, _ = start(graph, {"monitor": folder})
    assert monitor.settings.effects == found.effects and monitor.settings.rig == found.rig
    said = listen(graph, DiagnosticArray, "/eha/monitor/diagnosis", LATCHED)
    graph.until(lambda: said and "coulomb_friction (40 N)" in said[-1].status[1].message)
    monitor.close()
    other, _, _ = start(graph, {"monitor": folder, "rig": {"mass": 25.0}})
    assert not other.settings.effects
    graph.until(lambda: any("left out" in v.value for v in said[-1].status[0].values))
