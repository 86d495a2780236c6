"""Whether the drive holds its command, asked of live rows: once they tell, and not again."""

import numpy as np

from eha_monitor.filters.handover import Backoff
from eha_monitor.filters.hold_choice import AUTO, CONTINUOUS, SAMPLED, resolved, with_hold
from eha_monitor.filters.inputs import StageInputs
from eha_monitor.filters.run_two import KernelTwoResult, run_stage_two_kernel
from eha_monitor.filters.stage_two import C_PLACE
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

ASK_AGAIN_S = 0.5, 16.0  # while the evidence is weak


class LiveHold:
    """The hold as the rows tell it; continuous until they do.

    Attributes
    ----------
    settings : with the hold in force; replaced, never changed in place.
    sentence : what the rows say, "" before they are asked, or where the config says it.
    apart : relative difference that it makes to beta_e while nothing tells the holds apart.
    """

    def __init__(self, settings: Settings):
        self._given = settings
        self._known = settings.command_hold != AUTO
        self.settings = settings if self._known else with_hold(settings, CONTINUOUS)
        self.sentence = ""
        self.apart = 0.0
        self._asking = Backoff(*ASK_AGAIN_S)

    def due(self, now: float) -> bool:
        """Tell whether the rows are to be asked at ``now`` (s)."""
        return not self._known and self._asking.due(now)

    def ask(self, now: float, rows: Recording) -> bool:
        """Ask the rows; True where they tell the hold now."""
        settings, decision = resolved([rows], self._given)
        self._known = decision is not None and decision.decided
        self._asking.answered(now, yes=self._known)
        if self._known:
            self.settings, self.sentence, self.apart = settings, decision.sentence, 0.0
        return self._known

    def compare(self, found: KernelTwoResult, rows: Recording, damping: np.ndarray,
                variance: np.ndarray) -> None:
        """Take stage two's run over some rows; see what the other hold makes of them."""
        if self._known:
            return
        other = with_hold(self._given, SAMPLED)
        held = run_stage_two_kernel(StageInputs.of(rows, other), other, damping, variance)
        self.apart = abs(float(found.state[C_PLACE] / max(held.state[C_PLACE], 1e-9)) - 1.0)
