"""How late and how costly the live monitor is."""

import math
import time
from collections import deque

import numpy as np

# Stamps further than this from the wall clock are on another clock (a bag, a simulation).
SAME_CLOCK_S = 5.0
WAITING = 1000  # batches of rows that may wait for their estimates


class LatencyMeter:
    """How long after a row's stamp the first estimates that know of it were published.

    Where the stamps are on another clock than the wall's, it counts from the row's receipt.

    Parameters
    ----------
    keep : latencies kept; 60 000 are one minute at 1 kHz.

    Attributes
    ----------
    counts_from : ``stamp`` or ``receipt``.
    """

    def __init__(self, keep: int = 60_000):
        self._values = np.empty(keep)
        self._count = 0
        self._wall_clock: bool | None = None
        self._waiting: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=WAITING)

    def came(self, stamps: np.ndarray, came: np.ndarray) -> None:
        """Take rows that wait for their estimates: (n,) stamps in ns, and receipt, s monotonic."""
        self._waiting.append((stamps, came))

    def published(self, until_ns: float = math.inf) -> None:
        """Note that estimates are out that know of all rows up to a stamp, ns."""
        now_ns, now = time.time_ns(), time.monotonic()
        while self._waiting and self._waiting[0][0][0] <= until_ns:
            stamps, came = self._waiting.popleft()
            count = int(np.searchsorted(stamps, until_ns, side="right"))
            if count < len(stamps):
                self._waiting.appendleft((stamps[count:], came[count:]))
            late = (now_ns - stamps[:count]) * 1e-9
            wall_clock = bool(abs(late[-1]) < SAME_CLOCK_S)
            if wall_clock != self._wall_clock:
                self._wall_clock, self._count = wall_clock, 0
            self._add(late if wall_clock else now - came[:count])

    def restart(self) -> None:
        """The rows that wait will not be known of."""
        self._waiting.clear()

    @property
    def counts_from(self) -> str:
        """What the latencies count from."""
        return "stamp" if self._wall_clock else "receipt"

    def _add(self, seconds: np.ndarray) -> None:
        places = (self._count + np.arange(len(seconds))) % len(self._values)
        self._values[places] = seconds
        self._count += len(seconds)

    def percentiles(self) -> dict[str, float]:
        """Return p50, p95, p99 and max in ms, or nothing before the first row."""
        kept = self._values[:min(self._count, len(self._values))]
        if not len(kept):
            return {}
        found = np.percentile(kept, [50, 95, 99, 100]) * 1e3
        return dict(zip(("p50", "p95", "p99", "max"), found.tolist(), strict=True))


class ProcessorMeter:
    """Share of one core that this process takes."""

    def __init__(self):
        self._start = self._last = (time.process_time(), time.monotonic())

    def share(self) -> float:
        """Return the share since the last call, 1 is one core."""
        now = (time.process_time(), time.monotonic())
        before, self._last = self._last, now
        return (now[0] - before[0]) / max(now[1] - before[1], 1e-9)

    def total(self) -> float:
        """Return the share since the beginning."""
        return (time.process_time() - self._start[0]) / max(
            time.monotonic() - self._start[1], 1e-9)
