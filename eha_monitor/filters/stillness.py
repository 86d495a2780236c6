"""Whether a value stands still while the rig moves."""

import math
from collections import deque

import numpy as np

from eha_monitor.filters.rows import Rows

# What must move while a channel stands still: the demand, and for the demand itself the position.
# The velocity is in no stage, and many drivers publish a zero there for ever.
REFERENCES = {"x": "x_d", "omega": "x", "p1": "x", "p2": "x", "force": "x", "x_d": "x"}
OTHERWISE = {"x": "omega"}
# A noisy value repeats by chance for some samples, a quantised one for longer where the motion is
# slow.  Longer than this, and than so many times what was seen while all was well, is frozen.
SHORTEST_S = 0.25
TIMES = 4.0
# A demand may stand still; only if the position goes on and on without it, it has frozen.
SHORTEST_DEMAND_S = 1.2
# The reference moves where it covers this part of what it covered in the last seconds.
PART = 0.05
REMEMBERED_S = 10.0
# What is usual must have been seen for so long, and is forgotten with this time constant.
LEARNT_S = 2.0
FORGOTTEN_S = 300.0


class Stillness:
    """Since when each channel has not changed.

    Attributes
    ----------
    rows, counts : rows taken, and those that held each channel.
    frozen : the channels that are.
    """

    def __init__(self):
        self.rows = 0
        self.counts: dict[str, int] = {}
        self.frozen: set[str] = set()
        self._last: dict[str, float] = {}
        self._seen: dict[str, int] = {}  # stamp of the last value, ns
        self._changed: dict[str, int] = {}  # stamp of the last change, ns
        self._pending: dict[str, float] = {}  # longest pause that ended since the last look, s
        self._longest: dict[str, float] = {}  # while the reference moved and nothing was wrong, s
        self._learnt: dict[str, float] = {}
        self._now_ns = self._looked_ns = 0
        self._ranges: dict[str, tuple[float, float]] = {}
        self._past: dict[str, deque] = {}  # (stamp, lowest, highest) of each look

    def take(self, rows: Rows) -> dict[str, int]:
        """Take rows; return the channels that are frozen, and for how many rows they still are."""
        if not len(rows):
            return {}
        self._now_ns = int(rows.stamps[-1])
        self.rows += len(rows)
        frozen = dict.fromkeys(self.frozen, len(rows))
        for name, column in rows.columns.items():
            places = np.flatnonzero(np.isfinite(column))
            if len(places):
                self._take(name, column[places], rows.stamps[places], places, frozen)
        return frozen

    def _take(self, name: str, values: np.ndarray, stamps: np.ndarray, places: np.ndarray,
              frozen: dict[str, int]) -> None:
        """Take the values of a channel, at least one, and the rows in which they stand."""
        if name not in self._last:
            self._last[name], self.counts[name] = float(values[0]), 0
            self._changed[name] = self._seen[name] = int(stamps[0])
        at = np.flatnonzero(np.diff(values, prepend=self._last[name]) != 0.0)
        if len(at):
            seen = np.concatenate([[self._seen[name]], stamps])[at]  # by the value before
            pauses = seen - np.concatenate([[self._changed[name]], stamps[at[:-1]]])
            if name in self.frozen:
                self.frozen.discard(name)
                frozen[name] = int(places[at[0]])
                pauses = pauses[1:]
            longest = int(pauses.max(initial=0))
            if longest > self._pending.get(name, 0):
                self._pending[name] = longest
            self._changed[name] = int(stamps[at[-1]])
        self._last[name], self._seen[name] = float(values[-1]), int(stamps[-1])
        self.counts[name] += len(values)
        if name in ("x", "x_d", "omega"):
            low, high = float(values.min()), float(values.max())
            span = self._ranges.get(name, (low, high))
            self._ranges[name] = min(low, span[0]), max(high, span[1])

    def reference(self, channel: str) -> str:
        """Return the channel that must move."""
        reference = REFERENCES[channel]
        return reference if reference in self._past else OTHERWISE.get(channel, reference)

    def look(self) -> dict[str, tuple[float, int, bool]]:
        """Return the channels that are frozen: for how long (s), from which stamp (ns), new?."""
        span_s = (self._now_ns - self._looked_ns) * 1e-9 if self._looked_ns else 0.0
        self._looked_ns = self._now_ns
        for name, (low, high) in self._ranges.items():
            past = self._past.setdefault(name, deque())
            past.append((self._now_ns, low, high))
            while (self._now_ns - past[0][0]) * 1e-9 > REMEMBERED_S:
                past.popleft()
        self._ranges.clear()
        found = {}
        pressures = "p1" in self.counts and "p2" in self.counts
        for name in REFERENCES:
            if name == "force" and pressures:
                continue  # the pressures stand for it, and an effort that nobody measures is 0
            if name in self._changed and (seconds := self._still(name, span_s)):
                found[name] = (seconds, self._changed[name] + 1, name not in self.frozen)
        self.frozen = set(found)
        return found

    def _still(self, name: str, span_s: float) -> float:
        """Return for how long a channel has been frozen, 0 if it is not."""
        still = (self._seen[name] - self._changed[name]) * 1e-9
        if (self._now_ns - self._seen[name]) * 1e-9 > SHORTEST_S:
            return 0.0  # silent, which is another fault
        paused = self._pending.pop(name, 0) * 1e-9
        reference = self.reference(name)
        longest = self._longest.get(name, 0.0)
        if name not in self.frozen and self._moves(reference, max(paused, span_s)):
            longest *= math.exp(-span_s / FORGOTTEN_S)
            self._longest[name] = longest = max(longest, paused)
            self._learnt[name] = self._learnt.get(name, 0.0) + span_s
        demand = name == "x_d"
        if (self._learnt.get(name, 0.0) < LEARNT_S
                or still < max(SHORTEST_DEMAND_S if demand else SHORTEST_S, TIMES * longest)
                or not self._moves(reference, still / 2.0 if demand else still)):
            return 0.0
        return still

    def _moves(self, reference: str, seconds: float) -> bool:
        """Tell whether a channel moved within the last seconds, against what it usually does."""
        past = self._past.get(reference)
        if not past or reference in self.frozen:
            return False
        covered = max(high for _, _, high in past) - min(low for _, low, _ in past)
        recent = [(low, high) for at, low, high in past
                  if (self._now_ns - at) * 1e-9 < seconds]
        if not recent or covered <= 0:
            return False
        moved = max(high for _, high in recent) - min(low for low, _ in recent)
        return moved > PART * covered
