"""Whether the monitor keeps up with the samples that come, from counts and times alone.

A monitor that cannot keep up looks like a rig with poor data: its queues overflow, so samples are
missing, and what it works on is old.  Missing samples alone may have been lost on the way; they
are the monitor's own where messages wait for it, or where it did not run for a while.
"""

from collections import deque
from dataclasses import dataclass

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
OVERLOADED = "the monitor cannot keep up"
WHAT_TO_DO = ("lower the publishers' rate, raise monitor.latency, or give the monitor a core of "
              "its own")


@dataclass(frozen=True)
class Overload:
    """What is wrong: ``level`` WARN or ERROR, and the sentence."""

    level: str
    sentence: str


class LoadWatch:
    """Judges how the monitor keeps up.

    Parameters
    ----------
    stale_after : older data count as stale, s.

    Attributes
    ----------
    behind : age of the oldest message that waits, s.
    share : of the samples of the last seconds, how many are missing.
    """

    def __init__(self, stale_after: float):
        self._stale_after = stale_after
        self._looks: deque[tuple[float, int, int]] = deque()
        self._held_up = -float("inf")  # when last it was known to be behind or not to have run
        self._before = 0.0
        self.behind = 0.0
        self.share = 0.0

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
        of_now = ", so the estimates are not current" if worst else ""
        return Overload("ERROR" if worst else "WARN", f"{OVERLOADED}: "
                        f"{' and '.join(parts)}{of_now}; {WHAT_TO_DO}")
