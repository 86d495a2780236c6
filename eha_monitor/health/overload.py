"""Whether the live monitor keeps up: latency, processor, and samples that are missing.

A monitor that cannot keep up looks like a rig with poor data: its queues overflow, so samples are
missing, and what it works on is old.  Missing samples alone may have been lost on the way; they
are the monitor's own where messages wait for it, or where it did not run for a while.
"""

import math
import time
from collections import deque
from dataclasses import dataclass

import numpy as np

WINDOW_S = 5.0  # shares are of the last so many seconds
# A usual machine keeps a process waiting for some hundredths of a second, and a re-run of stage
# two takes a tenth or two; what waits for longer than this waits for the monitor.
BEHIND_S = 0.25
LATE_S = 0.5  # behind for so long it warns though nothing is missing yet: the queue is filling
# The input between samples is rebuilt from its neighbours: lone gaps cost little, more than this
# widens what the filters know of the force and the drive.
FEW_MISSING = 0.03
# With more missing than there is, what the drive did between the samples is a guess.
MOST_MISSING = 0.5
# Stamps further than this from the wall clock are on another clock (a bag, a simulation).
SAME_CLOCK_S = 5.0
WAITING = 1000  # batches of rows that may wait for their estimates
OVERLOADED = "the monitor cannot keep up"
WHAT_TO_DO = ("lower the publishers' rate, raise monitor.latency, or give the monitor a core of "
              "its own")


@dataclass(frozen=True)
class Overload:
    """What is wrong: ``level`` WARN or ERROR, and the sentence."""

    level: str
    sentence: str


class LoadWatch:
    """Judges how the monitor keeps up; data older than ``stale_after`` s count as stale."""

    def __init__(self, stale_after: float):
        self._stale_after = stale_after
        self._looks: deque[tuple[float, int, int]] = deque()
        self._held_up = -float("inf")  # when last it was known to be behind or not to have run
        self._before = 0.0
        self.behind = 0.0  # age of the oldest message that waits, s
        self.share = 0.0  # of the samples of the last seconds, how many are missing

    def look(self, now: float, rows: int, missing: int, behind: float, away: float) -> None:
        """Take the state some times a second.

        Parameters
        ----------
        now : s, on a clock that only rises.
        rows, missing : samples so far, and those that lack between them.
        behind : age of the oldest message that waits now, 0 where none does, s.
        away : longest time since the last look in which the monitor did not run, s.
        """
        if away > BEHIND_S or behind > BEHIND_S:
            self._held_up = now
        self._before, self.behind = self.behind, behind
        looks = self._looks
        looks.append((now, rows, missing))
        while len(looks) > 2 and now - looks[1][0] >= WINDOW_S:
            looks.popleft()
        came, lacked = rows - looks[0][1], missing - looks[0][2]
        self.share = lacked / (came + lacked) if lacked > 0 else 0.0

    def found(self, now: float) -> Overload | None:
        """Return what is wrong at ``now``, or None.

        WARN: more than ``FEW_MISSING`` of the samples are missing where the monitor was held up,
        or it has been more than ``LATE_S`` behind at two looks.  ERROR, as the estimates are not
        those of now: it is further behind than data may be old (``monitor.stale_after``), or
        more samples are missing than there are.
        """
        behind = min(self._before, self.behind)  # one look may be the scheduler's
        mine = now - self._held_up < WINDOW_S and self.share > FEW_MISSING
        if not mine and behind <= LATE_S:
            return None
        worst = behind > self._stale_after or (mine and self.share > MOST_MISSING)
        parts = []
        if self.share > FEW_MISSING:
            parts.append(f"{100.0 * self.share:.0f} % of the samples of the last {WINDOW_S:g} s "
                         "are missing")
        if behind > BEHIND_S:
            parts.append(f"it is {behind:.1f} s behind")
        # Nothing waits: it may be the publishers that send less.
        rarer = "" if behind > BEHIND_S else (
            "; or the messages come less often than rig.sample_time says")
        of_now = ", so the estimates are not current" if worst else ""
        return Overload("ERROR" if worst else "WARN", f"{OVERLOADED}: "
                        f"{' and '.join(parts)}{of_now}; {WHAT_TO_DO}{rarer}")


class LatencyMeter:
    """How long after a row's stamp the first estimates that know of it were published.

    Where the stamps are on another clock than the wall's, it counts from the row's receipt.
    """

    def __init__(self):
        self._values = np.empty(60_000)  # one minute at 1 kHz
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
        """What the latencies count from: ``stamp`` or ``receipt``."""
        return "stamp" if self._wall_clock else "receipt"

    def _add(self, seconds: np.ndarray) -> None:
        places = (self._count + np.arange(len(seconds))) % len(self._values)
        self._values[places] = seconds
        self._count += len(seconds)

    def percentiles(self, of: int = 1) -> dict[str, float]:
        """Return p50, p95, p99 and max in ms, or nothing before the first row.

        ``of`` : of every so many rows, all but the largest; to sort a minute takes milliseconds.
        """
        kept = self._values[:min(self._count, len(self._values))]
        if not len(kept):
            return {}
        found = [*np.percentile(kept[::of], [50, 95, 99]), kept.max()]
        return {name: 1e3 * float(value) for name, value in zip(
            ("p50", "p95", "p99", "max"), found, strict=True)}


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
