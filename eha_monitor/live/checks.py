"""What the live estimator looks into now and then: its model, the hand-over, the hold, the config.

The live test of the model goes window after window, and tells whether the record fits again.  The
hand-over of a damping to stage two, whether the drive holds its command, and whether the rows
contradict their config are looked into less and less often.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.balances.parameters import parameters_of
from eha_monitor.estimation import hold_choice, stages, zero
from eha_monitor.estimation.consistency import AROUND, Window, judge, stage_verdict
from eha_monitor.estimation.discretisation import C_PLACE
from eha_monitor.estimation.inputs import StageInputs
from eha_monitor.estimation.model_watch import StageWatch, Trial, model_status, tainted_by
from eha_monitor.estimation.results import (
    CONVERGED,
    EVERY_S,
    LOOK_S,
    STAGES,
    Beside,
    Consistency,
    LiveSnapshot,
    Mismatch,
    ModelStatus,
    ParameterEstimate,
    Taint,
    no_data,
    units_of,
)
from eha_monitor.live.ingest import LiveBuffer
from eha_monitor.plausibility.judge import Plausibility, plausibility_of
from eha_monitor.plausibility.moments import common_span
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

PATIENCE_S = 2.0  # wait for stage one before stage two takes the nominal damping
WEAK_S = 2.0, 8.0  # while stage two knows little: does the buffer show the modulus by now?
BROKEN_S = 2.0, 64.0  # after stage two broke down; what broke it, a number of the config, stays
HOLD_S = 0.5, 16.0  # while the evidence for a hold is weak
PLAUSIBLE_S = 2.0, 16.0
ZERO_S = 2.0, 16.0  # the zero of the position beside the controller's
APART_S = 0.3  # between two actuators' runs of 20 to 60 ms: rows of ten catch up meanwhile
FIRST_S = 2.0  # of rows; 360 cuts of so much and more of right recordings gave no false word


@dataclass
class Backoff:
    """When to look again at something that costs much: after each no twice as late."""

    # shortest, longest: waiting times, s
    shortest: float
    longest: float
    looked: float = -math.inf
    wait: float = 0.0

    def due(self, now: float) -> bool:
        """Tell whether to look at ``now`` (s)."""
        return now - self.looked >= self.wait

    def answered(self, now: float, yes: bool) -> None:
        """Note an answer at ``now`` (s)."""
        self.looked = now
        self.wait = self.shortest if yes else min(max(2.0 * self.wait, self.shortest),
                                                  self.longest)


class Turns:
    """Keeps apart what takes long in several estimators that share a thread.

    Actuators of one process begin together, so that without it they all look over their buffers
    in the same tenth of a second, and rows of each wait for all.

    ``clock`` : gives seconds; the machine's time, not that of the rows.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._until, self._owner = -math.inf, None

    def free(self, estimator: object) -> bool:
        """Tell whether an estimator may now do what can wait; alone it always may."""
        return estimator is self._owner or self._clock() >= self._until

    def took(self, estimator: object) -> None:
        """Note that it has just done so."""
        self._until, self._owner = self._clock() + APART_S, estimator


class Handover:
    """The damping that stage two takes, and when it is worth a run over the buffer."""

    def __init__(self, settings: Settings):
        self.settings = settings
        # value and standard deviation, N·m·s/rad or N·s/m; None before the first
        self.damping: tuple[float, float] | None = None
        self._given_at = -math.inf
        self._weak, self._broken = Backoff(*WEAK_S), Backoff(*BROKEN_S)

    @property
    def waits(self) -> str:
        """Why stage two does not run."""
        return "waits for stage one" if self._broken.wait == 0.0 else (
            "its filter broke down, as it does where a number of the config is far from the "
            "machine's or a channel is missing, and is tried again now and then")

    def lost(self, now: float) -> float:
        """Note that stage two broke down at ``now`` (s); return how long it pauses, s."""
        self.damping = None
        self._broken.answered(now, yes=now - self._broken.looked > 2.0 * BROKEN_S[1])
        return self._broken.wait

    def give(self, damping: tuple[float, float], now: float) -> None:
        """Take a damping at ``now`` (s)."""
        self.damping, self._given_at = damping, now

    def decide(self, now: float, b: ParameterEstimate, two, *,
               waited: float, stale: bool, fits: bool) -> str | None:
        """Take the damping with which stage two is to be run now; return why, or None for no run.

        Parameters
        ----------
        now, waited : time, and time since the first row, s.
        b : stage one's estimate.
        two : stage two (:class:`state.LiveStageTwo`), None before it runs.
        stale : the past of stage two was run with a damping that is now known better.
        fits : no mismatch of stage two stands; a wrong model gets no better by a run.
        """
        if two is None and not self._broken.due(now):
            return None
        weak = two is not None and fits and self._weak.due(now) and (
            two.held or two.stddev > CONVERGED * two.value)
        if b.status == "converged":
            if two is not None and (now - self._given_at < PATIENCE_S or not (
                    stale or weak or b.stddev < 0.5 * self.damping[1])):
                return None
            given, why = (b.value, b.stddev), "handed over by stage one"
        elif self.damping is None and (b.status == "no_data" or waited > PATIENCE_S):
            given = (self.settings.rig.viscous_damping, self.settings.stage_two.damping_stddev)
            why = f"nominal, stage one gives none ({b.status})"
        elif weak:
            given, why = self.damping, "as before"
        else:
            return None
        self._weak.answered(now, yes=not weak)
        self.give(given, now)
        return why


class LiveHold:
    """Whether the drive holds its command, as the rows show; continuous until they do."""

    def __init__(self, settings: Settings):
        self._given = settings
        self._known = settings.command_hold != hold_choice.AUTO
        # with the hold in force; replaced, never changed in place
        self.settings = settings if self._known else hold_choice.with_hold(
            settings, hold_choice.CONTINUOUS)
        self.sentence = ""  # what the rows say, "" before they do, or where the config says it
        # relative difference that it makes to beta_e while nothing tells the holds apart
        self.apart = 0.0
        self._backoff = Backoff(*HOLD_S)

    def due(self, now: float) -> bool:
        """Tell whether the rows are to be examined at ``now`` (s)."""
        return not self._known and self._backoff.due(now)

    def examine(self, now: float, rows: Recording) -> bool:
        """Examine the rows; True where they decide the hold now."""
        settings, decision = hold_choice.resolved([rows], self._given)
        self._known = decision is not None and decision.decided
        self._backoff.answered(now, yes=self._known)
        if self._known:
            self.settings, self.sentence, self.apart = (
                hold_choice.for_stages(settings, decision), decision.sentence, 0.0)
        return self._known

    def compare(self, found: stages.StageTwoRun, rows: Recording, damping: np.ndarray,
                variance: np.ndarray) -> None:
        """Take stage two's run over some rows; see what the other hold makes of them."""
        if self._known:
            return
        other = hold_choice.with_hold(self._given, hold_choice.SAMPLED)
        held = stages.run_stage_two_kernel(StageInputs.of(rows, other), other, damping, variance)
        self.apart = abs(float(found.state.x[C_PLACE] / max(held.state.x[C_PLACE], 1e-9)) - 1.0)


class LiveZero:
    """By how much the position reads more than the controller's, as the rows show."""

    def __init__(self):
        self._backoff = Backoff(*ZERO_S)

    def due(self, now: float) -> bool:
        """Tell whether the rows are to be examined at ``now`` (s)."""
        return self._backoff.due(now)

    def examine(self, now: float, rows: Recording, settings: Settings) -> tuple[float, str]:
        """Return by how much the setpoint of some rows is to be moved, m, and what says so.

        ``settings`` : those in force, with the hold as far as it is decided.
        """
        found = zero.zero_of(rows, settings)
        self._backoff.answered(now, yes=False)
        if found is None:
            return 0.0, ""
        value, stddev = zero.refined(rows, settings, *found)
        return value, zero.words_of(value, stddev, settings)


class LivePlausibility:
    """What the rows say about signs, units and channels."""

    def __init__(self, settings: Settings):
        self._settings = settings
        self.found = Plausibility()  # what the last look gave
        self._backoff = Backoff(*PLAUSIBLE_S)

    def examine(self, now: float, rows: Recording) -> str | None:
        """Look at the rows at ``now`` (s); return what is new, in words.

        None, without a look, before all channels that have come were there for ``FIRST_S``.
        """
        first, stop = common_span(rows.channels)
        if (stop - first) * rows.sample_time < FIRST_S:
            return None
        before = self.found.message
        self.found = plausibility_of(rows, self._settings)
        self._backoff.answered(now, yes=self.found.message != before)
        return "" if self.found.message == before else (
            self.found.message or "the channels agree with the config again")

    def due(self, now: float, seconds: float) -> bool:
        """Tell whether ``seconds`` of rows are to be looked at."""
        return seconds >= FIRST_S and self._backoff.due(now)

    def applied(self, snapshot: LiveSnapshot) -> LiveSnapshot:
        """Return the snapshot with the finding; without numbers where they would mean nothing."""
        if not self.found.findings:
            return snapshot
        message = self.found.message
        snapshot = replace(snapshot, implausible=message)
        if not (self.found.blocking and self._settings.implausible == "refuse"):
            return snapshot
        return replace(
            snapshot, model=ModelStatus("not_judged", message),
            parameters={name: no_data(name, p.unit, message)
                        for name, p in snapshot.parameters.items()})


JUDGED_S = 10.0  # the model is tested over the last so many seconds
SHORTEST_S = 4.0  # of rows for least squares: strokes both ways
REMEMBERED_S = 30.0  # a verdict counts for so long where later windows show too little
JUDGE_EVERY_S = 0.5
# Kept from look to look: of changes that count as hopping, of what a held parameter rests on.
KEPT = math.exp(-JUDGE_EVERY_S / 300.0), math.exp(-JUDGE_EVERY_S / 30.0)
TRY_EVERY_S = 1.0, 8.0  # while a mismatch stands: does the last window fit again?


UNTESTED = "no window of the data has tested the model on it yet"


@dataclass(frozen=True)
class Fit:
    """The last window run anew by a stage: ``fits`` None where it shows nothing."""

    fits: bool | None
    value: float
    stddev: float
    innovation: np.ndarray
    innovation_stddev: np.ndarray


class LiveModel:
    """What the live estimator knows about its own model."""

    def __init__(self, settings: Settings):
        self.settings = settings
        self.watches = {stage: StageWatch(stage) for stage in STAGES}
        # on the last window of each stage that could be judged, None before there was one and once
        # it is ``REMEMBERED_S`` old
        self.verdicts: dict[str, Consistency | None] = dict.fromkeys(STAGES)
        # row from which on a stage is judged; what came before was explained otherwise
        self.first = dict.fromkeys(STAGES, 0)
        self.judged_at = 0
        self._judged_s = dict.fromkeys(STAGES, -math.inf)
        self._trials = {name: Trial(units_of(settings.rig.motion)[name])
                        for name in (stage.parameter for stage in STAGES.values())}
        self.trying = Backoff(*TRY_EVERY_S)  # when to ask whether the last window fits again
        # least squares on the balances while a mismatch stands, the last ``LOOK_S`` of them
        self.looks: tuple[Beside, ...] = ()

    def restart_rows(self) -> None:
        """Rows are counted anew after a gap; what is known stays."""
        self.judged_at = 0
        self.judge_from(0)

    def judge_from(self, row: int) -> None:
        """Judge no innovations from before a row."""
        self.first = dict.fromkeys(STAGES, row)

    def standing(self, stage: str) -> bool:
        """Tell whether a stage's mismatch stands."""
        return self.watches[stage].standing is not None

    def judge(self, buffer: LiveBuffer, taken: int, changes: dict[str, list],
              parameters: dict[str, ParameterEstimate], quantum: float,
              time_of: Callable[[int], float]) -> list[Mismatch]:
        """Test the model on the last window; return the mismatches that begin now.

        Parameters
        ----------
        taken : row after the last one that was filtered.
        changes : per stage (row, before, after, samples that showed it).
        quantum : resolution of the position, m.
        time_of : time of a row, s.
        """
        self.judged_at = taken
        started = []
        # A change that has not yet been told apart must not count against the model.
        stop = taken - AROUND
        for stage, about in STAGES.items():
            start = max(buffer.first, stop - round(JUDGED_S / buffer.dt), self.first[stage])
            rows = self._changes_since(start, stage, changes, parameters)
            verdict = stage_verdict(
                about, parameters[about.parameter],
                buffer.column(f"nu_{stage}", start, stop).copy(),
                buffer.column(f"sd_{stage}", start, stop).copy(),
                Window(buffer.dt, quantum, time_of(start), JUDGED_S), rows)
            now = time_of(taken)
            if verdict is not None:
                self.verdicts[stage], self._judged_s[stage] = verdict, now
            elif now - self._judged_s[stage] > REMEMBERED_S:
                self.verdicts[stage] = None
            trial = self._trials[about.parameter].moved
            if self.watches[stage].update(now, verdict, trial):
                started.append(self.watches[stage].standing)
                self.trying, self.looks = Backoff(*TRY_EVERY_S), ()
        if not any(watch.standing for watch in self.watches.values()):
            self.looks = ()
        return started

    @staticmethod
    def _changes_since(start: int, stage: str, changes: dict[str, list],
                       parameters: dict[str, ParameterEstimate]) -> np.ndarray:
        """Return (k, 4) changes that a stage's window shows, counted from ``start``."""
        seen = list(changes[stage])
        if stage == "two":  # a change of B shows there too; in shares, beside those of beta_e
            scale = parameters["beta_e"].value / parameters["B"].value
            seen += [(n, a * scale, b * scale, w) for n, a, b, w in changes["one"]]
        return np.array([(n - start, a, b, w) for n, a, b, w in seen
                         if n + w + AROUND >= start]).reshape(-1, 4)

    def try_again(self, stage: str, inputs: StageInputs, damping: tuple[float, float],
                  time_s: float) -> tuple[Fit, bool]:
        """Run a stage anew over a window; return the fit, and whether its mismatch ends by it.

        Parameters
        ----------
        inputs : of the last ``JUDGED_S``.
        damping : B and its variance, for stage two.
        time_s : the window's end.
        """
        fit = self._run(stage, inputs, damping)
        return fit, self.watches[stage].test(time_s, fit.fits)

    def look_beside(self, time_s: float, rows: Callable[[float], Recording]) -> None:
        """Take least squares on the balances, if that is due.

        ``rows`` gives those of the last so many seconds: as many as the mismatch is old, since
        what came before a change says nothing of what is now, and no fewer than ``SHORTEST_S``.
        """
        since = min((watch.standing.since_s for watch in self.watches.values()
                     if watch.standing), default=time_s)
        seconds = min(max(time_s - since, SHORTEST_S), LOOK_S)
        if not self.looks or time_s - self.looks[-1].time_s >= EVERY_S:
            self.looks = (*(one for one in self.looks if time_s - one.time_s <= LOOK_S),
                          Beside(time_s, parameters_of(rows(seconds), self.settings)))

    def _run(self, stage: str, inputs: StageInputs, damping: tuple[float, float]) -> Fit:
        """Run a stage with one value of its parameter for the whole window."""
        if stage == "one":
            out = stages.run_stage_one_kernel(inputs, self.settings, frozen=True)[0]
        else:
            b, variance = (np.full(inputs.rows, one) for one in damping)
            out = stages.run_from(0, inputs, self.settings, b, variance, frozen=True).out
        about = STAGES[stage]
        parameter = about.judged(self.settings, out[about.value][-1], out[about.stddev][-1])
        innovation, stddev = out[about.innovation], out[about.innovation_stddev]
        fits = None
        if parameter.status == "converged":
            verdict = judge(innovation, stddev, Window(inputs.dt, inputs.quantum), about.words,
                            about.missing)
            fits = None if verdict is None else verdict.consistent
        elif parameter.status == "diverged":
            fits = False
        return Fit(fits, parameter.value, parameter.stddev, innovation, stddev)

    def follow(self, time_s: float, parameters: dict[str, ParameterEstimate]) -> None:
        """Take the estimates after each batch, however seldom somebody asks for a status.

        A busy monitor once asked twice in two seconds and did not see that a value had moved.
        """
        for name, trial in self._trials.items():
            known = parameters[name].status == "converged"
            trial.update(time_s, parameters[name].value if known else None,
                         parameters[name].stddev)

    def status(self, time_s: float, parameters: dict[str, ParameterEstimate]) -> ModelStatus:
        """Return what is known about the model now, and which estimates are in doubt."""
        tainted = {name: trial.taint for name, trial in self._trials.items()
                   if trial.taint is not None}
        for stage, about in STAGES.items():  # a model that nothing has tested raises no alarm
            if self.verdicts[stage] is None and parameters[about.parameter].status == "converged":
                tainted[about.parameter] = Taint(
                    UNTESTED, time_s, testing=True, untested=True,
                    never=self._judged_s[stage] == -math.inf)
        standing = tuple(watch.standing for watch in self.watches.values() if watch.standing)
        if not standing:
            fitting = [v for v in self.verdicts.values() if v is None or v.consistent]
            status = model_status(fitting)
            return ModelStatus(status.status, status.message, (), tainted)
        tainted |= tainted_by(standing, parameters, self.looks, time_s)
        return ModelStatus("mismatch", "; ".join(m.message for m in standing), standing, tainted)
