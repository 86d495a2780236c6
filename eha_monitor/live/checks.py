"""What the live estimator looks into now and then, and not with every batch: less and less often.

The hand-over of a damping to stage two, whether the drive holds its command, whether the rows
contradict their config.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.estimation.discretisation import C_PLACE
from eha_monitor.estimation.hold_choice import AUTO, CONTINUOUS, SAMPLED, resolved, with_hold
from eha_monitor.estimation.inputs import StageInputs
from eha_monitor.estimation.results import (
    CONVERGED,
    LiveSnapshot,
    ModelStatus,
    ParameterEstimate,
    no_data,
)
from eha_monitor.estimation.stages import StageTwoRun, run_stage_two_kernel
from eha_monitor.plausibility.judge import Plausibility, plausibility_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

PATIENCE_S = 2.0  # wait for stage one before stage two takes the nominal damping
WEAK_S = 2.0, 8.0  # while stage two knows little: does the buffer show the modulus by now?
HOLD_S = 0.5, 16.0  # while the evidence for a hold is weak
PLAUSIBLE_S = 2.0, 16.0
FIRST_S = 2.0  # of rows; 360 cuts of so much and more of right recordings gave no false word


@dataclass
class Backoff:
    """When to look again at something that costs much: after each no twice as late.

    Parameters
    ----------
    shortest, longest : waiting times, s.
    """

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


class Handover:
    """The damping that stage two takes, and when it is worth a run over the buffer.

    Attributes
    ----------
    damping : value and standard deviation, N·m·s/rad or N·s/m; None before the first.
    """

    def __init__(self, settings: Settings):
        self.settings = settings
        self.damping: tuple[float, float] | None = None
        self._given_at = -math.inf
        self._weak = Backoff(*WEAK_S)

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
    """Whether the drive holds its command, as the rows show; continuous until they do.

    Attributes
    ----------
    settings : with the hold in force; replaced, never changed in place.
    sentence : what the rows say, "" before they do, or where the config says it.
    apart : relative difference that it makes to beta_e while nothing tells the holds apart.
    """

    def __init__(self, settings: Settings):
        self._given = settings
        self._known = settings.command_hold != AUTO
        self.settings = settings if self._known else with_hold(settings, CONTINUOUS)
        self.sentence = ""
        self.apart = 0.0
        self._backoff = Backoff(*HOLD_S)

    def due(self, now: float) -> bool:
        """Tell whether the rows are to be examined at ``now`` (s)."""
        return not self._known and self._backoff.due(now)

    def examine(self, now: float, rows: Recording) -> bool:
        """Examine the rows; True where they decide the hold now."""
        settings, decision = resolved([rows], self._given)
        self._known = decision is not None and decision.decided
        self._backoff.answered(now, yes=self._known)
        if self._known:
            self.settings, self.sentence, self.apart = settings, decision.sentence, 0.0
        return self._known

    def compare(self, found: StageTwoRun, rows: Recording, damping: np.ndarray,
                variance: np.ndarray) -> None:
        """Take stage two's run over some rows; see what the other hold makes of them."""
        if self._known:
            return
        other = with_hold(self._given, SAMPLED)
        held = run_stage_two_kernel(StageInputs.of(rows, other), other, damping, variance)
        self.apart = abs(
            float(found.state.x[C_PLACE] / max(held.state.x[C_PLACE], 1e-9)) - 1.0)


class LivePlausibility:
    """What the rows say about signs, units and channels.

    Attributes
    ----------
    found : what the last look gave.
    """

    def __init__(self, settings: Settings):
        self._settings = settings
        self.found = Plausibility()
        self._backoff = Backoff(*PLAUSIBLE_S)

    def examine(self, now: float, rows: Recording) -> str:
        """Look at the rows at ``now`` (s); return what is new, in words."""
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
