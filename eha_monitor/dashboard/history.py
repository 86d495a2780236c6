"""What has come, kept for a while in bounded, thinned series; the stretch of it that is shown."""

import math
from collections import deque
from itertools import groupby
from urllib.parse import urlencode

Row = tuple[float, ...]


class History:
    """The last rows (time, value, ...) densely, and of longer stretches before them the extremes.

    Parameters
    ----------
    span : how long rows are kept densely, s.
    every : one row in each such slot, s; with ``span`` it bounds the memory.
    gap : a longer distance is a gap, which a chart shows as one, s.
    long_span : how long the extremes are kept, s; 0 keeps none.
    stretch : of each such stretch the rows with the least and the largest value are kept, s.
    """

    def __init__(self, span: float, every: float, gap: float, long_span: float = 0.0,
                 stretch: float = math.inf):
        self.span, self.every, self.stretch = span, every, stretch
        self.gap = max(gap, 2.5 * every)
        self._dense: deque[Row] = deque(maxlen=math.ceil(span / every) + 1)
        self._old: deque[list[Row]] = deque(maxlen=math.ceil(
            long_span / stretch) + 1 if long_span else 0)

    def add(self, time_s: float, *values: float) -> None:
        """Keep a row; time that jumps back starts anew."""
        row = (time_s, *values)
        if self._dense and time_s < self._dense[-1][0]:
            self._dense.clear()
            self._old.clear()
        # Slots that lie fixed in time: series that come together are kept together.
        if not self._dense or time_s // self.every != self._dense[-1][0] // self.every:
            self._dense.append(row)
        if self._old and time_s // self.stretch == self._old[-1][0][0] // self.stretch:
            self._old[-1] = _extremes([*self._old[-1], row])
        else:
            self._old.append([row])

    def rows(self, since: float = -math.inf) -> list[Row]:
        """Return the rows from ``since`` on; a row of NaN stands where data were missing."""
        if self._dense and not self._old:
            since = max(since, self._dense[-1][0] - self.span)
        dense = [row for row in self._dense if row[0] >= since]
        if self._dense and since >= self._dense[0][0]:
            return _with_gaps(dense, self.gap)
        first = dense[0][0] if dense else math.inf
        old = [row for rows in self._old for row in rows if since <= row[0] < first]
        # With the first dense one: between the two may be a gap as well.
        older = _with_gaps([*old, *dense[:1]], max(self.gap, 2.5 * self.stretch))
        return [*older[:-1], *_with_gaps(dense, self.gap)] if dense else older


def thinned(rows: list[Row], most: int) -> list[Row]:
    """Return about ``most`` rows at the most: of each stretch those of least and largest value.

    Rows of NaN, the gaps, all stay.  The stretches lie fixed in time, so that a chart that is
    drawn anew each second does not flicker.
    """
    if len(rows) <= most:
        return rows
    step = 2.0 * (rows[-1][0] - rows[0][0]) / most
    kept: list[Row] = []
    for _, group in groupby(rows, key=lambda row: (row[0] // step, math.isnan(row[1]))):
        members = list(group)
        kept += members if math.isnan(members[0][1]) else _extremes(members)
    return kept


def _extremes(rows: list[Row]) -> list[Row]:
    """Return the rows of least and of largest value, in the order of time."""
    low, high = min(rows, key=lambda row: row[1]), max(rows, key=lambda row: row[1])
    return [low] if low is high else sorted((low, high))


def _with_gaps(rows: list[Row], gap: float) -> list[Row]:
    kept: list[Row] = []
    for row in rows:
        if kept and row[0] - kept[-1][0] > gap:
            kept.append((0.5 * (kept[-1][0] + row[0]), *[math.nan] * (len(row) - 1)))
        kept.append(row)
    return kept


# ---- which stretch of time the charts show ----------------------------------------------------

# Choices by their name; None is all that is kept.
CHOICES: dict[str, float | None] = {"1 min": 60.0, "5 min": 300.0, "30 min": 1800.0, "all": None}
FIRST = "5 min"
# A shorter stretch than this is a click and no choice, s.
SHORTEST = 1.0


class Span:
    """The choice of one page.

    Attributes
    ----------
    choice : one of ``CHOICES``; it counts while nothing is zoomed.
    zoom : the stretch that was dragged, time of day, s; None while the charts follow the data.
    """

    def __init__(self):
        self.choice = FIRST
        self.zoom: tuple[float, float] | None = None

    def choose(self, choice: str) -> None:
        """Follow the data again, over the time of a choice."""
        self.choice, self.zoom = choice, None

    def drag(self, first: float, last: float) -> bool:
        """Stay at a stretch; returns whether it is one."""
        if not (math.isfinite(first) and math.isfinite(last)) or last - first < SHORTEST:
            return False
        self.zoom = first, last
        return True

    def since(self, now: float) -> float:
        """Return from when on rows are needed; ``now`` is the time of day, s."""
        if self.zoom is not None:
            return self.zoom[0]
        length = CHOICES[self.choice]
        return -math.inf if length is None else now - length

    def query(self, actuator: str) -> str:
        """Return the query of the same stretch as CSV."""
        wanted: dict[str, str] = {"actuator": actuator}
        if self.zoom is not None:
            wanted |= {"since": f"{self.zoom[0]:.3f}", "until": f"{self.zoom[1]:.3f}"}
        elif (length := CHOICES[self.choice]) is not None:
            wanted["last"] = f"{length:g}"
        return urlencode(wanted)
