"""What has come, kept for a while: a bounded, thinned series."""

import math
from collections import deque

Row = tuple[float, ...]


class History:
    """Rows (time, value, ...) of the last ``span`` s, at most one each ``every`` s.

    Parameters
    ----------
    span : how long rows are kept, s.
    every : least distance of two rows, s; with ``span`` it bounds the memory.
    gap : a longer distance is a gap, which a chart shows as one, s.
    """

    def __init__(self, span: float, every: float, gap: float):
        self.span, self.every, self.gap = span, every, max(gap, 2.5 * every)
        self._rows: deque[Row] = deque(maxlen=math.ceil(span / every) + 1)

    def add(self, time_s: float, *values: float) -> None:
        """Keep a row, unless one came just before; time that jumps back starts anew."""
        if self._rows:
            since = time_s - self._rows[-1][0]
            if 0 <= since < self.every * (1 - 1e-6):
                return
            if since < 0:
                self._rows.clear()
        self._rows.append((time_s, *values))

    def rows(self, now: float | None = None) -> list[Row]:
        """Return the rows of the last ``span`` s before ``now`` (default: the last row).

        Where data were missing stands a row of NaN, at which a line breaks.
        """
        kept: list[Row] = []
        if not self._rows:
            return kept
        oldest = (self._rows[-1][0] if now is None else now) - self.span
        for row in self._rows:
            if row[0] < oldest:
                continue
            if kept and row[0] - kept[-1][0] > self.gap:
                kept.append((0.5 * (kept[-1][0] + row[0]), *[math.nan] * (len(row) - 1)))
            kept.append(row)
        return kept
