"""The whole ring over DDS on loopback: an effect comes, is diagnosed, adopted, and goes again."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_tools import refused
from diagnostic_msgs.msg import DiagnosticArray
from machine_tools import machine_of
from rig_tools import MULTISINE, simulated
from ros_tools import PATIENCE, REPOSITORY, Caller, Recorder, command, end, listen, start
from std_srvs.srv import Trigger

from eha_monitor.balances.machine import save
from eha_monitor.live.diagnosing import Adopted, Answer, effects_in_words, model_of
from eha_monitor.ros.comparison import Comparison
from eha_monitor.ros.diagnosis import SelfDiagnosis
from eha_monitor.ros.messages import findings_of
from eha_monitor.ros.monitor_node import Monitor
from eha_monitor.ros.running import actuators
from eha_monitor.ros.simulator_node import SimulatorNode
from eha_monitor.ros.topics import LATCHED
from eha_monitor.settings import settings_from_tree
from eha_monitor.settings.load import annotated

FRICTION = 40.0  # N
DRY = {"parameter": "coulomb_friction.F_c", "start": 1e6, "value": FRICTION}


class Ring:
    """A simulator whose friction comes and goes on request, and a monitor process.

    Attributes
    ----------
    found : the last finding of each name; ``log`` what changed: (s, name, word, message).
    late : latencies in ms, from each row's stamp to the estimates that hold it, while a
        diagnosis runs (True) or not (False).
    """

    def __init__(self, graph, folder, fault=DRY, **diagnosis):
        self.graph, self.folder = graph, folder
        self.caller = Caller(graph, PATIENCE)
        self.found, self.log, self.late, self._newest = {}, [], {True: [], False: []}, None
        self.began = time.monotonic()
        tree = {"monitor": {"save_folder": str(folder / "saved")}, "diagnosis": diagnosis,
                "simulation": {"excitation": {"motion": {**MULTISINE, "duration": 600.0}},
                               "faults": {"fault": fault}}}
        self.config = folder / "config.yaml"
        self.settings = settings_from_tree(tree, "test")
        self.config.write_text(annotated(self.settings))
        self.simulator = None
        node = graph.node("listener", "/eha")
        for topic in ("monitor/health", "monitor/diagnosis"):
            node.create_subscription(DiagnosticArray, topic, self._take, LATCHED)
        node.create_subscription(DiagnosticArray, "monitor/estimates", self._take_estimates, 100)

    def now(self):
        return time.monotonic() - self.began

    def start(self):
        """Begin the motion, without friction."""
        self.simulator = SimulatorNode(self.graph.node("simulator", "/eha"), self.settings, 1)

    def fault(self, *values):
        """Have the fault at each of these times (s, value), one upon another."""
        plant = self.simulator._simulator
        tree = plant.settings.model_dump()
        one = tree["simulation"]["faults"].popitem()[1]
        tree["simulation"]["faults"] = {f"fault_{k}": {
            **one, "start": start, "value": value} for k, (start, value) in enumerate(values)}
        plant.settings = settings_from_tree(tree, "test")

    def _take(self, message):
        found = findings_of(message)
        for one in found:
            old = self.found.get(one.name)
            if old is None or one.word != old.word:
                self.log.append((self.now(), one.name, one.word, one.message))
            event = one.values.get("event")
            if event and (old is None or old.values.get("event") != event):
                self.log.append((self.now(), "event", "", event))
        if found[0].name == "diagnosis":
            self.found = {name: one for name, one in self.found.items()
                          if not name.startswith("effect ")}
        self.found |= {one.name: one for one in found}

    def _take_estimates(self, message):
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        if self._newest is not None and not self.value("model_in_force", "who"):
            rows = np.arange(self._newest + 1e-3, stamp + 5e-4, 1e-3)
            running = self.value("diagnosis", "state") == "a diagnosis is under way"
            self.late[running] += (1e3 * (time.time() - rows)).tolist()
        self._newest = stamp

    def until(self, condition, patience=PATIENCE):
        try:
            self.graph.until(condition, patience)
        except BaseException:  # also the end of the test's time
            told(self)
            raise
        return self.now()

    def word(self, name):
        return self.found[name].word if name in self.found else ""

    def said(self, name):
        return self.found[name].message if name in self.found else ""

    def value(self, name, key):
        return self.found[name].values.get(key, "") if name in self.found else ""

    def became(self, name, word):
        return self.until(lambda: self.word(name) == word)

    def damping(self):
        return float(self.value("viscous_damping_high", "viscous_damping_Ns_per_m"))


def once(graph, folder, adopt):
    """Go round the ring once; returns the moments in s after the friction came, and the rest."""
    ring = Ring(graph, folder, after=6.0, adopt=adopt, adopt_after=3.0, niceness=0)
    with command("monitor", "--config", ring.config) as monitor:
        ring.became("data", "STALE")
        for service, words in (("adopt", "nothing to adopt"), ("revert", "nothing to take back")):
            nothing = ring.caller.trigger(f"/eha/monitor/{service}")
            assert not nothing.success and words in nothing.message
        ring.start()
        ring.became("model_mismatch", "OK")
        plant = ring.simulator._simulator
        since = max(plant.time + 0.2, 6.0)  # no value is new any more
        ring.fault((since, FRICTION))
        began = ring.until(lambda: plant.time >= since)
        moments = {"alarm": ring.became("model_mismatch", "WARN"),
                   "held back": ring.became("viscous_damping_high", "not judged"),
                   "diagnosis": ring.until(lambda: "effect coulomb_friction" in ring.found,
                                           3 * PATIENCE)}
        if adopt == "service":
            ring.until(lambda: ": mismatch: Coulomb" in ring.said("model_mismatch"))
            answer = ring.caller.trigger("/eha/monitor/adopt")
            assert answer.success, answer.message
        moments["adopted"] = ring.until(
            lambda: f"adopted by {adopt}" in ring.said("model_in_force"))
        ring.became("model_mismatch", "OK")
        moments["judged"] = ring.became("viscous_damping_high", "OK")
        assert ring.damping() == pytest.approx(600, rel=0.03)
        gone = plant.time + 0.2
        ring.fault((since, FRICTION), (gone, -FRICTION))
        went = ring.until(lambda: plant.time >= gone)
        after = {"alarm": ring.became("model_mismatch", "WARN")}
        if adopt == "service":
            answer = ring.caller.trigger("/eha/monitor/revert")
            assert answer.success, answer.message
        after["reverted"] = ring.until(lambda: ring.said(
            "model_in_force") == "the model of the config is in force", 3 * PATIENCE)
        ring.became("model_mismatch", "OK")
        after["judged"] = ring.became("viscous_damping_high", "OK")
        assert ring.damping() == pytest.approx(600, rel=0.03)
        summary = end(monitor)
    assert "lost messages 0, missing samples 0" in summary, summary
    return ring, {key: at - began for key, at in moments.items()}, {
        f"gone, {key}": at - went for key, at in after.items()}, summary


def told(ring, moments=None, after=None, summary=""):
    """Print what was measured."""
    print()
    for at, *what in ring.log:
        if what[0] in ("event", "model_mismatch", "viscous_damping_high", "machine"):
            print(f"{at:6.1f} s", *what)
    print(", ".join(f"{key} {at:.1f} s" for key, at in ((moments or {}) | (after or {})).items()))
    for running, late in ring.late.items():
        if late:
            p50, p99 = np.percentile(late, (50, 99))
            print(f"diagnosis running {running}: p50 {p50:.0f} ms, p99 {p99:.0f} ms, "
                  f"largest {max(late):.0f} ms, {len(late)} rows")
    print(summary)


@pytest.mark.slow  # a minute of both cores each: simulator, monitor and diagnosis at once
@pytest.mark.timeout(300)
@pytest.mark.parametrize("adopt", ["automatic"] * 5 + ["service"] * 5)
def test_an_effect_is_found_adopted_and_taken_back_ten_times_of_ten(graph, tmp_path, adopt):
    begun = time.monotonic()
    told(*once(graph, tmp_path, adopt))
    assert time.monotonic() - begun < 120


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_false_alarm_an_experiment_and_the_way_back(tmp_path):
    """``make ring``: monitor, simulator and ``identify`` as processes."""
    done = subprocess.run([sys.executable, REPOSITORY / "scripts/ring.py"], cwd=tmp_path,
                          text=True, capture_output=True, check=False, timeout=390)
    print(done.stdout)
    assert done.returncode == 0, done.stderr
    for words in ("decided after", "adopted quadratic_friction", "reverted", "Done in"):
        assert words in done.stdout


@pytest.mark.slow
def test_no_row_is_late_because_of_a_diagnosis(graph, tmp_path):
    """The same mismatch without and with a diagnosis, in turn: latencies, and rows lost."""
    ring = Ring(graph, tmp_path, start="service")
    with command("monitor", "--config", ring.config) as monitor:
        ring.became("data", "STALE")
        ring.start()
        ring.became("model_mismatch", "OK")
        ring.fault((ring.simulator._simulator.time, FRICTION))
        ring.became("model_mismatch", "WARN")
        settled = ring.simulator.samples + 20_000
        ring.until(lambda: ring.simulator.samples > settled)
        ring.late = {True: [], False: []}
        ring.caller.timeout = 3 * PATIENCE  # the second one has two recordings
        for turn in (1, 2):
            ring.until(lambda turn=turn: len(ring.late[False]) > 15_000 * turn)
            answer = ring.caller.trigger("/eha/monitor/diagnose")
            assert answer.success and "Coulomb friction of" in answer.message, answer.message
        told(ring)
        summary = end(monitor)
    print(summary)
    assert "lost messages 0, missing samples 0" in summary, summary
    without, with_it = (np.percentile(ring.late[running], 99) for running in (False, True))
    assert with_it < 2.0 * without


@pytest.fixture(scope="module")
def machine(tmp_path_factory):
    """The file of a healthy machine of three recordings."""
    path = tmp_path_factory.mktemp("machine") / "machine.json"
    healthy = simulated(MULTISINE, 10.0)
    save(machine_of([replace(healthy.recording(seed), source=f"healthy {seed}")
                     for seed in range(3)], healthy.config), path)
    return path


@pytest.mark.slow  # half a minute of motion; test_machine.py has the comparison itself
@pytest.mark.timeout(300)
def test_a_change_from_the_healthy_machine_is_told_with_its_time(graph, tmp_path, machine):
    worn = {"parameter": "viscous_damping", "start": 1e6, "value": 800.0}
    ring = Ring(graph, tmp_path, worn, after=6.0)
    with command("monitor", "--config", ring.config, "--machine", machine) as monitor:
        ring.became("data", "STALE")
        ring.start()
        ring.became("machine", "OK")
        assert "nothing has changed" in ring.said("machine")
        plant = ring.simulator._simulator
        at = plant.time + 0.2
        ring.fault((at, 800.0))
        ring.until(lambda: plant.time >= at)
        moment = time.time()
        ring.became("machine", "WARN")
        why = ring.value("machine", "why")
        assert "moved" in why or why == "the model does not fit"
        since = datetime.fromisoformat(ring.value("machine", "since_utc")).timestamp()
        assert moment - 2.0 < since < moment + 10.0
        changed = ring.found["changed B"].values
        assert float(changed["healthy"]) == pytest.approx(600, rel=0.01)
        assert float(changed["now"]) == pytest.approx(800, rel=0.02)
        assert float(changed["change_percent"]) == pytest.approx(33, abs=3)
        assert ring.word("model_mismatch") == "OK"
        end(monitor)
    kept = {path.name for path in (tmp_path / "saved").iterdir()}
    assert len(kept) == 2  # that of the change, and its report; what had not changed is gone


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_what_the_healthy_machine_explains_is_not_diagnosed_besides(graph, tmp_path, machine):
    ring = Ring(graph, tmp_path, after=6.0)
    with command("monitor", "--config", ring.config, "--machine", machine) as monitor:
        ring.became("data", "STALE")
        ring.start()
        ring.became("machine", "OK")
        ring.fault((ring.simulator._simulator.time + 0.2, FRICTION))
        ring.became("model_mismatch", "WARN")
        ring.became("machine", "WARN")
        assert "changed coulomb_friction F_c" in ring.found
        ring.until(lambda: "comparison (with the healthy machine)" in ring.said("model_mismatch"))
        assert ring.value("model_mismatch", "diagnosed") == "mismatch"
        later = ring.simulator.samples + 10_000  # well beyond when a diagnosis would have begun
        ring.until(lambda: ring.simulator.samples > later)
        assert not [one for one in ring.log if "diagnosis begun" in one[3]]
        answer = ring.caller.trigger("/eha/monitor/diagnose")
        assert answer.success and "Coulomb friction of" in answer.message, answer.message
        ring.until(lambda: "its diagnosis" in ring.said("model_mismatch"))
        end(monitor)


def test_a_machine_of_another_rig_is_refused(machine, tmp_path, capfd):
    config = tmp_path / "config.yaml"
    config.write_text("rig: {name: press}")
    said = refused(capfd, "monitor", "--config", config, "--machine", machine)
    assert "the machine of the rig eha, expected that of press" in said
    config.write_text(f"rig: {{name: press}}\ndiagnosis: {{machine: {machine}}}")
    said = refused(capfd, "monitor", "--actuator", f"left={config}")
    assert "the machine of the rig eha, expected that of press" in said


def test_an_actuator_is_a_place_and_takes_the_machine_of_its_config_s_rig(machine, tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text(f"diagnosis: {{machine: {machine}}}")
    ((settings, _),) = actuators(None, (f"left={config}",), [], "monitor")
    assert (settings.rig.name, settings.monitor.namespace) == ("left", "/left")
    elsewhere = tmp_path / "elsewhere.yaml"
    elsewhere.write_text("diagnosis: {machine: /nowhere/machine.json}")
    ((shown, _),) = actuators(None, (f"left={elsewhere}",), [], "dashboard")
    assert shown.diagnosis.machine == "/nowhere/machine.json"
    assert Comparison(settings, None, lambda *said: None, int).findings[0].level == "STALE"


def test_what_no_config_holds_is_not_said_to_be_in_force(tmp_path):
    """A feed-forward of the controller was, beside a gain that alone is worse than both."""
    completed = settings_from_tree({"effects": {"coulomb_friction": {"F_c": 92.0}}}, "test")
    answer = Answer("", tmp_path, (), {
        "effects": [{"name": "feed_forward", "size": "168 rad/s"},
                    {"name": "coulomb_friction", "size": "92 N"}],
        "rig_data": [{"key": "position_gain"}]}, completed)
    assert effects_in_words(answer) == (
        "coulomb_friction (92 N) and rig.position_gain (without feed_forward, which no config "
        "holds)")


def live(graph, folder, **diagnosis):
    """Return a monitor that has taken some rows, its estimator, a sender and a caller."""
    monitor, estimator, sender = start(graph, {
        "monitor": {"save_folder": str(folder), "stale_after": 60.0},
        "diagnosis": {"niceness": 0, **diagnosis}})  # a nice one never ends on a busy machine
    sender.send(0, 200)
    graph.until(lambda: len(estimator.rows) == 200)
    return monitor, estimator, sender, Caller(graph, PATIENCE)


@pytest.mark.parametrize(("budget", "words"), [
    ({"processor_time": 1},
     "used up its 1 s of processor time (diagnosis.processor_time)"),
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


def test_one_diagnosis_at_a_time_for_all_actuators(graph, tmp_path):
    monitor, _, _, caller = live(graph, tmp_path)
    other = settings_from_tree({"monitor": {
        "namespace": "/other", "save_folder": str(tmp_path / "other")}}, "test")
    second = Monitor(graph.node("monitor", "/other"), other, Recorder)
    future = caller.begin(Trigger, "/eha/monitor/diagnose", Trigger.Request())
    graph.until(lambda: monitor.diagnosis._running)
    waiting = caller.begin(Trigger, "/other/monitor/diagnose", Trigger.Request())
    graph.until(lambda: second.diagnosis._waits)
    assert second.diagnosis._state() == "waits: a diagnosis of another actuator is under way"
    assert not second.diagnosis._running and not waiting.done()
    graph.until(future.done, PATIENCE)
    graph.until(waiting.done, PATIENCE)  # it has no rows: what matters is that its turn came
    assert monitor.diagnosis._state() == second.diagnosis._state() == "idle"


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


KILLED = """
import sys, time
from pathlib import Path
from eha_monitor.live.diagnosing import Diagnosing
from eha_monitor.settings import Settings
made = Diagnosing([Path("bags/air_ingress")], Settings(), Path(sys.argv[1]))
print(made._process.pid, flush=True)
time.sleep(600)
"""


def test_a_diagnosis_ends_with_a_monitor_that_is_killed(graph, tmp_path):
    with subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path)], cwd=REPOSITORY,
                          env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, text=True,
                          stdout=subprocess.PIPE) as process:
        running = Path("/proc", process.stdout.readline().strip(), "status")
        graph.until(lambda: "eha_monitor.limited" in running.with_name("cmdline").read_text())
        process.kill()
    graph.until(lambda: not running.exists() or "State:\tZ" in running.read_text())


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


@pytest.mark.parametrize(("now", "refuses", "said"), [
    ((), False, ""), ((("one", 300.0),), False, "does not fit the last seconds"),
    ((("one", 9000.0),), True, ""), ((("two", 40.0),), True, "")])
def test_a_model_that_fits_worse_than_the_one_in_force_is_not_adopted(now, refuses, said):
    def model(stages):
        return SimpleNamespace(message="off", mismatches=tuple(
            SimpleNamespace(stage=stage, nis=nis) for stage, nis in stages))

    running = SimpleNamespace(
        _model=model([("one", 252.0)]), _caution="", _coming=SimpleNamespace(
            estimator=SimpleNamespace(snapshot=lambda: SimpleNamespace(model=model(now)))))
    why = SelfDiagnosis._worse(running)
    assert bool(why) is refuses and ("than with the model in force" in why) is refuses
    assert (said in running._caution) and bool(running._caution) is bool(said)
