"""What is due and when, and whether the monitor keeps up with what waits for it."""

import time
from collections.abc import Callable, Sequence

from eha_monitor.health.overload import LoadWatch, Overload

LOOK_S = 0.15  # between two looks, at least
EARLY = 0.25  # of a period: a timer's jitter must not put what is due off to the next


class Load:
    """What is due, and how far the monitor is behind its inputs.

    Parameters
    ----------
    jobs : period in s and what to do, of each thing that is due again and again.
    stale_after : see :class:`LoadWatch`.
    """

    def __init__(self, jobs: Sequence[tuple[float, Callable[[], None]]], stale_after: float):
        now = time.monotonic()
        self.watch = LoadWatch(stale_after)
        self.period = min((period for period, _ in jobs), default=LOOK_S)
        self._jobs = [[period, now + period, job] for period, job in jobs]
        self._ran = self._looked = now
        self._away = self._waited = 0.0
        self._busy = False

    def run(self, now: float) -> float:
        """Note that the monitor runs at ``now`` (s, monotonic); return for how long not, s."""
        away, self._ran = now - self._ran, now
        self._away = max(self._away, away)
        return away

    def tick(self, now: float) -> None:
        """Do what is due at ``now`` (s, monotonic)."""
        if self._busy:
            return
        self._busy = True
        try:
            for job in self._jobs:
                if now >= job[1] - EARLY * self.period:
                    job[1] = max(job[1] + job[0], now)
                    job[2]()
        finally:
            self._busy = False

    def look(self, waited: float, rows: int, missing: int) -> None:
        """See whether the monitor keeps up, some times a second.

        Parameters
        ----------
        waited : longest that a message waited since the last look, s; a period is as it should be.
        rows, missing : samples so far, and those that lack between them.
        """
        now = time.monotonic()
        self._waited = max(self._waited, waited - self.period)
        if now - self._looked < LOOK_S:
            return
        self.watch.look(now, rows, missing, self._waited, self._away)
        self._looked, self._away, self._waited = now, 0.0, 0.0

    def found(self) -> Overload | None:
        """Return what is wrong now, or None."""
        return self.watch.found(time.monotonic())
