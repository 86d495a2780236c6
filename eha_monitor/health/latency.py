"""How late and how costly the live monitor is."""

import time

import numpy as np


class LatencyMeter:
    """Latencies of the last rows; two clocks are told apart, the stamps' and the receiver's.

    Parameters
    ----------
    keep : latencies kept; 60 000 are one minute at 1 kHz.
    """

    def __init__(self, keep: int = 60_000):
        self._values = np.empty(keep)
        self._count = 0

    def add(self, seconds: float) -> None:
        """Take one latency, s."""
        self._values[self._count % len(self._values)] = seconds
        self._count += 1

    def clear(self) -> None:
        """Forget all, e.g. when the stamps' clock changed."""
        self._count = 0

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
