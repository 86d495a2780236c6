"""Whether live rows contradict their config: asked early, and again now and then."""

from dataclasses import replace

from eha_monitor.filters.handover import Backoff
from eha_monitor.filters.results import LiveSnapshot, ModelStatus
from eha_monitor.filters.status import no_data
from eha_monitor.plausibility.judge import Plausibility, plausibility_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

FIRST_S = 2.0  # of rows; 360 cuts of so much and more of right recordings gave no false word
ASK_AGAIN_S = 2.0, 16.0


class LivePlausibility:
    """What the rows say about signs, units and channels.

    Attributes
    ----------
    found : what the last look gave.
    """

    def __init__(self, settings: Settings):
        self._settings = settings
        self.found = Plausibility()
        self._asking = Backoff(*ASK_AGAIN_S)

    @property
    def refuses(self) -> bool:
        """Whether no estimate would be meaningful."""
        return self.found.blocking and self._settings.implausible == "refuse"

    def ask(self, now: float, rows: Recording) -> str:
        """Look at the rows at ``now`` (s); return what is new, in words."""
        before = self.found.message
        self.found = plausibility_of(rows, self._settings)
        self._asking.answered(now, yes=self.found.message != before)
        return "" if self.found.message == before else (
            self.found.message or "the channels agree with the config again")

    def due(self, now: float, seconds: float) -> bool:
        """Tell whether ``seconds`` of rows are to be looked at."""
        return seconds >= FIRST_S and self._asking.due(now)

    def told(self, snapshot: LiveSnapshot) -> LiveSnapshot:
        """Return the snapshot with the finding; without numbers where they would mean nothing."""
        if not self.found.findings:
            return snapshot
        message = self.found.message
        snapshot = replace(snapshot, implausible=message)
        if not self.refuses:
            return snapshot
        return replace(
            snapshot, model=ModelStatus("not_judged", message),
            parameters={name: no_data(name, p.unit, message)
                        for name, p in snapshot.parameters.items()})
