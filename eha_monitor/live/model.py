"""The live test of the model: window after window, and whether the record fits again."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from eha_monitor.estimation.consistency import AROUND, Window, judge, stage_verdict
from eha_monitor.estimation.inputs import StageInputs
from eha_monitor.estimation.model_watch import StageWatch, Trial, model_status, tainted_by
from eha_monitor.estimation.reach import WINDOW_S, Look, Reaches, reaches_of
from eha_monitor.estimation.results import (
    STAGES,
    Consistency,
    Mismatch,
    ModelStatus,
    ParameterEstimate,
    units_of,
)
from eha_monitor.estimation.stages import run_from, run_stage_one_kernel
from eha_monitor.live.checks import Backoff
from eha_monitor.live.ingest import LiveBuffer
from eha_monitor.settings.monitor import Settings

JUDGED_S = 10.0  # the model is tested over the last so many seconds
JUDGE_EVERY_S = 0.5
# Kept from look to look: of changes that count as hopping, of what a held parameter rests on.
KEPT = math.exp(-JUDGE_EVERY_S / 300.0), math.exp(-JUDGE_EVERY_S / 30.0)
TRY_EVERY_S = 1.0, 8.0  # while a mismatch stands: does the last window fit again?


@dataclass(frozen=True)
class Fit:
    """The last window run anew by a stage: ``fits`` None where it shows nothing."""

    fits: bool | None
    value: float
    stddev: float
    innovation: np.ndarray
    innovation_stddev: np.ndarray


class LiveModel:
    """What the live estimator knows about its own model.

    Attributes
    ----------
    verdicts : on the last window of each stage, None where it could not be judged.
    first : row from which on a stage is judged; what came before was explained otherwise.
    trying : when to ask whether the last window fits again.
    measuring : when to look how far a mismatch can have moved the parameters.
    """

    def __init__(self, settings: Settings):
        self.settings = settings
        self.watches = {stage: StageWatch(stage) for stage in STAGES}
        self.verdicts: dict[str, Consistency | None] = dict.fromkeys(STAGES)
        self.first = dict.fromkeys(STAGES, 0)
        self.judged_at = 0
        self._trials = {name: Trial(units_of(settings.rig.motion)[name])
                        for name in (stage.parameter for stage in STAGES.values())}
        self.trying = Backoff(*TRY_EVERY_S)
        self.measuring = Backoff(*TRY_EVERY_S)
        self._reaches, self._look = Reaches(), Look()
        self._settled = math.nan  # B while no mismatch stood

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
        parameters : the present estimates.
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
            self.verdicts[stage] = verdict
            trial = self._trials[about.parameter].moved
            if self.watches[stage].update(time_of(taken), verdict, trial):
                started.append(self.watches[stage].standing)
                self.trying, self.measuring = Backoff(*TRY_EVERY_S), Backoff(*TRY_EVERY_S)
        if not any(watch.standing for watch in self.watches.values()):
            self._reaches = Reaches()
        damping = parameters["B"]
        if (damping.status == "converged" and not self.standing("one")
                and self._trials["B"].taint is None):
            self._settled = damping.value
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

    def measure(self, last: Callable[[float], StageInputs],
                parameters: dict[str, ParameterEstimate], damping: float,
                two, time_s: float) -> None:
        """Begin, if that is due, to find how far what does not fit can have moved what.

        Parameters
        ----------
        last : gives the inputs of the last so many seconds.
        damping : B that stage two takes, N·s/m.
        """
        if self._look.under_way or not self.measuring.due(time_s):
            return
        stages = [stage for stage in STAGES if self.standing(stage)]
        self._look.begin(reaches_of(stages, last(WINDOW_S), self.settings, parameters,
                                    (damping, _sensitivity(two))))
        self.measuring.answered(time_s, yes=False)  # it changes as slowly as the mismatch ages

    def go_on(self, time_s: float) -> None:
        """Go on with a look that is under way."""
        found = self._look.go_on() if self._look.under_way else None
        if found is not None and any(watch.standing for watch in self.watches.values()):
            self._reaches.note(time_s, found)

    def _run(self, stage: str, inputs: StageInputs, damping: tuple[float, float]) -> Fit:
        """Run a stage with one value of its parameter for the whole window."""
        if stage == "one":
            out = run_stage_one_kernel(inputs, self.settings, frozen=True)[0]
        else:
            b, variance = (np.full(inputs.rows, one) for one in damping)
            out = run_from(0, inputs, self.settings, b, variance, frozen=True).out
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

    def status(self, time_s: float, parameters: dict[str, ParameterEstimate],
               two) -> ModelStatus:
        """Return what is known about the model now, and which estimates are in doubt."""
        tainted = {}
        for name, trial in self._trials.items():
            known = parameters[name].status == "converged"
            taint = trial.update(time_s, parameters[name].value if known else None)
            if taint is not None:
                tainted[name] = taint
        standing = tuple(watch.standing for watch in self.watches.values() if watch.standing)
        if not standing:
            fitting = [v for v in self.verdicts.values() if v is None or v.consistent]
            status = model_status(fitting)
            return ModelStatus(status.status, status.message, (), tainted)
        tainted |= tainted_by(standing, abs(_sensitivity(two) * self._bias(parameters["B"])),
                              self._reaches.most())
        return ModelStatus("mismatch", "; ".join(m.message for m in standing), standing, tainted)

    def _bias(self, damping: ParameterEstimate) -> float:
        """Return how far B may be off: from what it was, or else from the nominal value."""
        if damping.status != "converged":
            return math.inf
        before = self._settled
        return damping.value - (self.settings.rig.viscous_damping if math.isnan(before)
                                else before)


def _sensitivity(two) -> float:
    """Return the relative change of beta_e with B, per N·s/m."""
    return math.nan if two is None else two.sensitivity
