"""When stage two of the live estimator gets a damping, and is run again over the buffer."""

import math
from dataclasses import dataclass

from eha_monitor.filters.live_stages import LiveStageTwo
from eha_monitor.filters.results import ParameterEstimate
from eha_monitor.filters.status import CONVERGED
from eha_monitor.settings.monitor import Settings

PATIENCE_S = 2.0  # wait for stage one before stage two takes the nominal damping
ASK_AGAIN_S = 2.0, 8.0  # while stage two knows little: does the buffer tell the modulus by now?


@dataclass
class Backoff:
    """When to ask something that costs much again: after each no twice as late.

    Parameters
    ----------
    shortest, longest : waiting times, s.
    """

    shortest: float
    longest: float
    asked: float = -math.inf
    wait: float = 0.0

    def due(self, now: float) -> bool:
        """Tell whether to ask at ``now`` (s)."""
        return now - self.asked >= self.wait

    def answered(self, now: float, yes: bool) -> None:
        """Note an answer at ``now`` (s)."""
        self.asked = now
        self.wait = self.shortest if yes else min(max(2.0 * self.wait, self.shortest),
                                                  self.longest)


class Handover:
    """The damping that stage two takes, and when it is worth a run over the buffer.

    Attributes
    ----------
    damping : value and standard deviation, N·s/m (N·m·s/rad); None before the first.
    """

    def __init__(self, settings: Settings):
        self.settings = settings
        self.damping: tuple[float, float] | None = None
        self._given_at = -math.inf
        self._asking = Backoff(*ASK_AGAIN_S)

    def give(self, damping: tuple[float, float], now: float) -> None:
        """Take a damping at ``now`` (s)."""
        self.damping, self._given_at = damping, now

    def decide(self, now: float, b: ParameterEstimate, two: LiveStageTwo | None, *,
               waited: float, stale: bool, fits: bool) -> str | None:
        """Take the damping with which stage two is to be run now; return why, or None for no run.

        Parameters
        ----------
        now, waited : time, and time since the first row, s.
        b : stage one's estimate.
        two : stage two, once it runs.
        stale : the past of stage two was run with a damping that is now known better.
        fits : no mismatch of stage two stands; a wrong model gets no better by a run.
        """
        weak = two is not None and fits and self._asking.due(now) and (
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
        self._asking.answered(now, yes=not weak)
        self.give(given, now)
        return why
