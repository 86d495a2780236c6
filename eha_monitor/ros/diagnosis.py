"""The monitor diagnoses itself: when, on what, and the model that is adopted or taken back.

The diagnosis is ``eha-monitor diagnose`` in another process, always with the model of the config;
so its answer replaces an adopted model, and ``consistent`` means that the config's own fits again.
"""

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from rclpy.node import Node

from eha_monitor.errors import InputError
from eha_monitor.estimation.results import LiveSnapshot, ModelStatus, ParameterEstimate
from eha_monitor.health.judge import Finding
from eha_monitor.live.diagnosing import (
    TURN,
    UNKNOWN,
    Adopted,
    Answer,
    Candidate,
    Cause,
    Diagnosing,
    adopted_before,
    answer_findings,
    effects_in_words,
    model_finding,
    model_of,
)
from eha_monitor.live.ingest import Columns
from eha_monitor.recordings.ring import Saved, plain_name
from eha_monitor.ros.comparison import Comparison
from eha_monitor.ros.keeper import Keeper, LateTrigger
from eha_monitor.ros.topics import every
from eha_monitor.settings import Settings

POLL_PERIOD = 0.2
PAST_S = 10.0  # of the buffer, that an estimator begins with: a window of the model's test
SLICE_S = 0.03  # of each turn, for an estimator that catches up
EARLIER = 3  # bags of the same mismatch that are diagnosed with the newest
WORSE = 2.0  # times the NIS of the model in force: another one is then no answer
LONGEST_S = 3600.0  # between two diagnoses of one mismatch
SERVICE, AUTOMATIC = "service", "automatic"
_BY = {SERVICE: "on the service", AUTOMATIC: "by itself"}


class SelfDiagnosis:
    """Services ``monitor/diagnose``, ``adopt`` and ``revert``, and what is adopted.

    Parameters
    ----------
    settings : validated config, without anything adopted.
    keeper : saves what is diagnosed.
    publish : takes what ``monitor/diagnosis`` is to say.
    candidate : makes an estimator with other settings, from the rows since a time in s.
    exchange : puts an estimator with its settings in place of the running one.
    """

    def __init__(self, node: Node, settings: Settings, keeper: Keeper,
                 publish: Callable[[list[Finding]], None],
                 candidate: Callable[[Settings, float], Candidate],
                 exchange: Callable[[object, Settings], None]):
        self._settings, self._keeper, self._publish = settings, keeper, publish
        self._make_candidate, self._exchange = candidate, exchange
        self._log = node.get_logger()
        self._folder = Path(settings.monitor.save_folder)
        self._file = self._folder / f"{plain_name(settings.rig.name)}_adopted.json"
        # the model in force in place of the config's, None where there is none
        self.adopted: Adopted | None = None
        self._model = ModelStatus("not_judged", "")  # the last test of that in force
        self._unfit_ns = 0  # until when rows contradicted their config
        self._answer: Answer | None = None
        self._running: Diagnosing | None = None
        self._saving = False
        self._by = ""  # who asked for the diagnosis, or for the exchange, that is under way
        self._coming: Candidate | None = None
        self._target: Adopted | None = None  # of the exchange that is under way
        self._gate = False
        self._caution = ""  # with which an answer is put in force
        self._events, self._last_event = 0, {}
        self._waits = ""  # who asked for a diagnosis while another was under way, or a bag saved
        self._comparison = Comparison(settings, keeper, self._tell, self._log_ns) if (
            settings.diagnosis.machine and keeper.ring is not None) else None
        self._began_anew()
        self._services = {name: LateTrigger(node, f"monitor/{name}", begin) for name, begin in (
            ("diagnose", self._on_diagnose), ("adopt", self._on_adopt),
            ("revert", self._on_revert))}
        self._node = node
        self._timer = every(node, POLL_PERIOD, self._poll)
        try:
            self.adopted = adopted_before(self._file, settings)
        except InputError as problem:
            self._tell(str(problem), "WARN")
        if self.adopted is not None:
            self._tell(f"adopted model in force: {self.adopted.words}, adopted by "
                       f"{self.adopted.who} at {self.adopted.time_utc}")
        self._say()

    def _began_anew(self) -> None:
        self._now_s = 0.0
        self._moments: deque[tuple[float, int]] = deque(maxlen=6000)  # row's time, log time in ns
        self._over()
        if self._comparison is not None:
            self._comparison.reset()

    def _over(self) -> None:
        """The model fits: what comes next is another mismatch."""
        self._waits = self._waits if self._waits == SERVICE else ""
        self._since_s: float | None = None
        self._tries, self._explained = 0, False
        self._ended_s = -np.inf  # when the last diagnosis of it ended
        # what the last diagnosis says of the mismatch that stands; None before one
        self._of_mismatch: Answer | None = None
        self._diagnosed: set[str] = set()  # stages that did not fit when that was begun
        self._same: list[Path] = []  # bags of this mismatch, of one state as far as is known
        self._saved_ns: int | None = None  # where the last of them ends

    # ---- what the monitor tells -----------------------------------------------------------------

    @property
    def in_force(self) -> Settings:
        """The settings with the adopted model, if there is one."""
        return self._settings if self.adopted is None else self.adopted.applied(self._settings)

    @property
    def of_machine(self) -> list[Finding]:
        """What the comparison with the healthy machine says; indicators beyond their limits."""
        if self._comparison is None:
            return []
        first, *rest = self._comparison.findings
        return [first, *(one for one in rest if one.level == "ERROR")]

    @property
    def cause(self) -> Cause:
        """What is known of why the model does not fit."""
        if self._of_mismatch is not None:
            return Cause.of("its diagnosis", self._of_mismatch)
        if TURN.holder is self:
            return Cause(words=self._state())
        compared = None if self._comparison is None else self._comparison.answer
        return UNKNOWN if compared is None else Cause.of(
            "its comparison (with the healthy machine)", compared)

    def leave_out(self) -> None:
        """Diagnose and compare none of the rows so far: their channels contradict the config."""
        self._unfit_ns = time.time_ns()
        self._same.clear()
        if self._comparison is not None:
            self._comparison.leave_out(self._unfit_ns)

    def known(self, snapshot: LiveSnapshot) -> LiveSnapshot:
        """Return a snapshot that is no surer than the diagnosis whose model is in force."""
        return snapshot if self.adopted is None else self.adopted.widened(snapshot, self.in_force)

    def configure(self, settings: Settings) -> Settings:
        """Take other thresholds; returns the settings in force."""
        self._settings = settings
        return self.in_force

    def note(self, model: ModelStatus, parameters: Mapping[str, ParameterEstimate], now_s: float
             ) -> None:
        """Take the test of the model at ``now_s``; begin a diagnosis if that is due."""
        self._now_s, self._model = now_s, model
        if self._moments and now_s < self._moments[-1][0]:
            self._moments.clear()  # the estimator has begun anew, and its time with it
        self._moments.append((now_s, time.time_ns()))
        if self._comparison is not None:
            self._comparison.note(model, parameters, now_s)
        if not model.mismatches:
            if model.status == "consistent":
                self._over()
            return
        if self._since_s is None:
            self._since_s = min(one.since_s for one in model.mismatches)
        grown = [one.since_s for one in model.mismatches if one.stage not in self._diagnosed]
        if grown and self._diagnosed and TURN.holder is not self:
            self._over()  # another stage than was diagnosed: something else has come
            self._since_s = min(grown)
        wanted = self._settings.diagnosis
        wait = min(wanted.after * 2**self._tries, LONGEST_S)
        if (wanted.start == AUTOMATIC and not self._left_to_machine
                and now_s - max(self._since_s, self._ended_s) >= wait
                and not self._explained and self._keeper.ring is not None):
            if not self._busy:
                self._begin(AUTOMATIC)
            elif self._elsewhere:
                self._wait(AUTOMATIC)

    @property
    def _left_to_machine(self) -> bool:
        """Whether the comparison with the healthy machine says why the model does not fit, or may.

        It knows the machine, and takes seconds; only what is adopted needs a diagnosis as well.
        """
        return (self._comparison is not None and self._settings.diagnosis.adopt == SERVICE
                and self._comparison.verdict in ("", "consistent", "mismatch"))

    def push(self, times: np.ndarray, columns: Columns) -> None:
        """Take the rows that the running estimator takes."""
        if self._coming is not None:
            self._coming.push(times, columns)

    def withdraw(self, channel: str, since_s: float) -> None:
        """Take back what a channel gave from ``since_s`` on."""
        if self._coming is not None:
            self._coming.withdraw(channel, since_s)

    def reset(self, reason: str) -> None:
        """Count time anew; an exchange that is under way goes on with the rows that come."""
        self._began_anew()
        if self._coming is not None:
            self._coming.reset(reason)

    def advance(self) -> None:
        """Let an estimator that is to take over catch up, for some milliseconds."""
        if self._coming is None or not self._coming.advance(SLICE_S):
            return
        if self._gate:
            seen = self._now_s - self._coming.first_s
            if not seen >= self._settings.diagnosis.adopt_after:
                return
            model = self._coming.estimator.snapshot().model
            if model.mismatches:
                self._refuse(f"it does not fit {seen:.0f} s of rows that the diagnosis has not "
                             f"seen: {model.message}")
                return
            if model.status != "consistent":
                return  # nothing shows it yet
        elif self._target is not None and (why := self._worse()):
            self._refuse(why)
            self._services["adopt"].end(False, f"not adopted: {why}")
            return
        self._take_over()

    def _worse(self) -> str:
        """Return where a model fits the last seconds worse than that in force, "" if nowhere.

        One that fits them no better than before is adopted, and that is said.
        """
        model = self._coming.estimator.snapshot().model
        before = {one.stage: one.nis for one in self._model.mismatches}
        for one in model.mismatches:
            now, was = one.nis, max(before.get(one.stage, 1.0), 1.0)
            if now > WORSE * was:
                return (f"with it stage {one.stage} fits the last seconds worse than with the "
                        f"model in force: NIS {now:.3g}, {was:.3g} now")
        if model.mismatches:
            self._caution += f"; it does not fit the last seconds: {model.message}"
        return ""

    def stop(self) -> None:
        """End what is under way."""
        if self._running is not None:
            self._running.end()
        if self._comparison is not None:
            self._comparison.stop()
        self._running, self._saving, self._coming, self._waits = None, False, None, ""
        TURN.give_back(self)
        for service in self._services.values():
            service.end(False, "the monitor has stopped")

    def close(self) -> None:
        """End what is under way, and the services."""
        self.stop()
        self._node.destroy_timer(self._timer)
        for service in self._services.values():
            self._node.destroy_service(service.service)

    # ---- diagnosis ------------------------------------------------------------------------------

    @property
    def _busy(self) -> bool:
        return (self._coming is not None or TURN.holder is not None
                or (self._comparison is not None and self._comparison.saving))

    def _on_diagnose(self) -> str | None:
        if self._keeper.ring is None:
            return "the buffer is off: monitor.buffer_minutes is 0"
        if self._busy:
            if not self._elsewhere:
                so_far = "" if self._running is None else (
                    f" for {self._running.seconds:.0f} s, and may take "
                    f"{self._settings.diagnosis.processor_time:g} s of processor time")
                return f"{self._state()}{so_far}; call again when it has ended"
            self._wait(SERVICE)
        else:
            self._begin(SERVICE)
        return None

    @property
    def _elsewhere(self) -> bool:
        """Whether what is in the way is another actuator's diagnosis, or a bag that is saved."""
        return self._coming is None and TURN.holder is not self

    def _wait(self, by: str) -> None:
        """Begin as soon as what is in the way has ended."""
        if not self._waits:
            self._waits = by
            self._say()

    def _begin(self, by: str) -> None:
        """Save what has come since the mismatch began, or all there is; then diagnose it."""
        TURN.take(self)
        self._by, self._saving, self._waits = by, True, ""
        self._tries += 1
        self._diagnosed = {one.stage for one in self._model.mismatches}
        since_ns = self._saved_ns + 1 if self._saved_ns is not None else (
            0 if self._since_s is None else self._log_ns(self._since_s))
        self._tell(f"diagnosis begun {_BY[by]}")
        self._keeper.save_since(max(since_ns, self._unfit_ns), self._saved)

    def _log_ns(self, row_s: float) -> int:
        """Return the log time, ns, at which a row's time, s, had come; 0 where it is long ago."""
        return next((log_ns for known_s, log_ns in self._moments if known_s >= row_s), 0)

    def _saved(self, bag: Saved) -> None:
        if not self._saving:
            return  # stopped meanwhile
        self._saving = False
        if bag.problem is not None:
            self._ended(Answer(bag.problem, bag.path, (bag.path,)))
            return
        bags = [bag.path, *(path for path in reversed(self._same) if path.is_dir())]
        if self._since_s is not None:
            self._same.append(bag.path)
            self._saved_ns = bag.last_ns
        try:
            self._running = Diagnosing(bags[:1 + EARLIER], self._settings,
                                       bag.path.with_name(f"{bag.path.name}_diagnosis"))
        except (InputError, OSError) as problem:
            self._ended(Answer(str(problem), bag.path, (bag.path,)))
        self._say()

    def _poll(self) -> None:
        answer = self._running.answer if self._running is not None else None
        if answer is not None:
            self._running = None
            self._ended(answer)
        if self._waits and not self._busy:
            self._begin(self._waits)
        if self._comparison is not None:
            if self._comparison.poll():
                self._say()
            if self._coming is None and not self._saving:
                self._comparison.begin_if_due(self._now_s)

    def _ended(self, answer: Answer) -> None:
        """Tell what came of a diagnosis; an answer of before stands where there is none."""
        TURN.give_back(self)
        self._ended_s = self._now_s
        if answer.problem:
            self._tell(answer.problem, "WARN")
        else:
            self._answer = answer
            self._of_mismatch = None if self._since_s is None else answer
            self._explained = (self._of_mismatch is not None and answer.names
                               and self._adoptable() is None)
            if not answer.names:
                # They may hold the change itself, or are the machine before it; what comes after
                # is diagnosed by itself.
                self._same.clear()
            elif answer.tree["change_points"]:  # those before are of another state
                self._same = self._same[-1:]
            self._tell(f"diagnosed {', '.join(map(str, answer.bags))} in {answer.wall_s:.0f} s: "
                       f"{answer.words}")
        self._services["diagnose"].end(
            not answer.problem, answer.problem or f"{answer.words}; {answer.folder}")
        if (not answer.problem and self._settings.diagnosis.adopt == AUTOMATIC
                and self._coming is None):
            self._consider(answer)

    # ---- adopting -------------------------------------------------------------------------------

    def _consider(self, answer: Answer) -> None:
        """Try an answer on the rows to come, if it is probable enough to be adopted by itself."""
        if answer.verdict == "consistent" and self.adopted is not None:
            self._try(None, AUTOMATIC)
        elif self._adoptable() is None:
            asked = self._settings.diagnosis.adopt_probability
            if answer.probability >= asked:
                self._try(answer, AUTOMATIC)
            else:
                self._tell("not adopted by itself: " + (
                    "it has a part without a probability" if np.isnan(answer.probability) else
                    f"its probability of {answer.probability:.3g} is below "
                    f"diagnosis.adopt_probability, {asked:g}"), "WARN")

    def _adoptable(self) -> str | None:
        """Return why the last answer cannot be adopted, None where it can."""
        if self._answer is None:
            return "nothing to adopt: there is no diagnosis"
        completed = self._answer.completed
        if self._answer.verdict == "consistent" and self._of_mismatch is not self._answer:
            completed = None  # the model that is in force fits
        if completed is None or model_of(completed) == model_of(self.in_force):
            return f"nothing to adopt: the verdict is {self._answer.verdict}" + (
                "" if completed is None else ", and the model in force is the one that was found")
        return None

    def _on_adopt(self) -> str | None:
        refused = self._exchanging() or self._adoptable()
        if refused is None:
            self._try(self._answer, SERVICE)
        return refused

    def _on_revert(self) -> str | None:
        if self._coming is not None and self._gate:
            self._refuse("monitor/revert was called")  # a trial is ended by it too
        refused = self._exchanging()
        if refused is None and self.adopted is None:
            refused = "nothing to take back: the model of the config is in force"
        if refused is not None:
            return refused
        self._try(None, SERVICE)
        return None

    def _exchanging(self) -> str | None:
        """Return that the model is being exchanged, if so; a diagnosis may be under way."""
        return None if self._coming is None else f"{self._state()}; call again when it has ended"

    def _try(self, answer: Answer | None, by: str) -> None:
        """Begin to exchange the model: for that of an answer, or back for that of the config."""
        self._by, self._gate = by, by == AUTOMATIC
        self._caution = "" if answer is None or answer.verdict == "mismatch" else (
            f"; the verdict of its diagnosis is {answer.verdict}: look whether the model fits now")
        self._target = None if answer is None else Adopted(
            by, "", effects_in_words(answer), str(answer.folder / "report.html"),
            model_of(self._settings), model_of(answer.completed), answer.spread)
        settings = self._settings if self._target is None else self._target.applied(self._settings)
        since_s = max(self._now_s - PAST_S, self._since_s or 0.0)
        self._coming = self._make_candidate(settings, np.inf if self._gate else since_s)
        if self._gate:
            self._tell(f"{self._name()} is tried on the rows of the next "
                       f"{self._settings.diagnosis.adopt_after:g} s")

    def _name(self) -> str:
        return "the config's model" if self._target is None else (
            f"the model with {self._target.words}")

    def _refuse(self, why: str) -> None:
        self._coming, self._explained = None, False
        self._tell(f"{self._name()} is not adopted: {why}", "WARN")

    def _take_over(self) -> None:
        """Put the estimator that has caught up in place of the running one."""
        coming, self._coming = self._coming, None
        now = datetime.now(UTC).isoformat(timespec="seconds")
        unkept = ""
        try:
            if self._target is None:
                self._file.unlink(missing_ok=True)
            else:
                self._target = Adopted(**vars(self._target) | {"time_utc": now})
                self._folder.mkdir(parents=True, exist_ok=True)
                self._target.save(self._file)
        except (InputError, OSError) as problem:
            unkept = f"; only until the monitor ends: {problem}"
        before, self.adopted = self.adopted, self._target
        self._over()
        done = (f"reverted from {before.words if before else 'nothing'} to the config's model"
                if self.adopted is None else f"adopted {self.adopted.words}")
        self._tell(f"{done}, {_BY.get(self._by, self._by)}, at {now}{self._caution}{unkept}")
        self._services["revert" if self.adopted is None else "adopt"].end(
            True, f"{done}{self._caution}{unkept}")
        self._exchange(coming.estimator, self.in_force)

    # ---- telling --------------------------------------------------------------------------------

    def _state(self) -> str:
        if self._coming is not None:
            return f"{self._name()} is {'on trial' if self._gate else 'being put in force'}"
        if self._saving:
            return "the recording is being saved"
        if self._running is not None:
            return "a diagnosis is under way"
        waits = "waits: " if self._waits else ""
        if TURN.holder is not None:
            return f"{waits}a diagnosis of another actuator is under way"
        if self._comparison is not None and self._comparison.under_way:
            return f"{waits}a comparison with the healthy machine is under way"
        return "idle"

    def _tell(self, text: str, level: str = "OK") -> None:
        """Log an event and publish it."""
        if level == "OK":
            self._log.info(text)
        else:
            self._log.warning(text)
        self._events += 1
        self._last_event = {"event": text, "event_level": level, "event_number": self._events}
        self._say()

    def _say(self) -> None:
        """Publish what stands."""
        head, *rest = answer_findings(self._answer)
        head = replace(head, values=head.values | {
            "state": self._state(), "by": self._by, **self._last_event})
        compared = self._comparison.findings if self._comparison is not None else []
        self._publish([head, model_finding(self.adopted), *rest, *compared])
