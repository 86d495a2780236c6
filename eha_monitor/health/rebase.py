"""Reading a value under a model that does not fit by how it changes from where it settled."""

import math
from collections import deque

SETTLE_S = 10.0  # a value has settled when it has stayed within ...
WITHIN = 0.05  # ... so much of itself for so long


class Rebase:
    """What one parameter read before a mismatch and what it reads under it.

    A force that the model lacks adds to B, so B is read by the difference; a flow that it lacks
    scales beta_e, so beta_e is read by the ratio.

    Parameters
    ----------
    nominal : value that stands for the one before, where the mismatch was there from the start.
    by_ratio : read by the ratio instead of the difference.
    """

    def __init__(self, nominal: float, by_ratio: bool):
        self.before, self._by_ratio = nominal, by_ratio
        self.settled: float | None = None
        self._since: float | None = None
        self._recent: deque[tuple[float, float]] = deque()

    def fits(self, value: float) -> None:
        """Note a value while the model fits."""
        self.before, self.settled, self._since = value, None, None
        self._recent.clear()

    def read(self, time_s: float, value: float, stddev: float, since_s: float
             ) -> tuple[float, float] | None:
        """Return value and standard deviation as the limits should see them.

        None while the value has not yet settled under the mismatch that began at ``since_s``.
        """
        if since_s != self._since:
            self._since, self.settled = since_s, None
            self._recent.clear()
        if self.settled is None and not self._settle(time_s, value):
            return None
        if self._by_ratio:
            factor = self.before / self.settled
            return factor * value, factor * stddev
        return value + self.before - self.settled, stddev

    def _settle(self, time_s: float, value: float) -> bool:
        recent = self._recent
        recent.append((time_s, value))
        while time_s - recent[0][0] > SETTLE_S + 1e-6:
            recent.popleft()
        values = [v for _, v in recent]
        mean = math.fsum(values) / len(values)
        if (time_s - recent[0][0] < 0.9 * SETTLE_S or mean == 0
                or max(values) - min(values) > WITHIN * abs(mean)):
            return False
        self.settled = mean
        return True
