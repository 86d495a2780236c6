"""How the live estimator takes rows: onto its grid, over gaps, with channels that come late."""

import math

import numpy as np

from eha_monitor.breakdown import begins_anew
from eha_monitor.filters.inputs import missing
from eha_monitor.filters.live_buffer import LiveBuffer
from eha_monitor.filters.results import Event
from eha_monitor.recordings.recording import LARGEST

WARM_UP = 256  # rows from which the sample time and the noise are first measured
BATCH = 10  # rows taken at a time, at least
BUFFER_S = 20.0
NEARER = 0.05  # sample times
LONG_GAP_S = 0.5  # a longer gap starts the buffer anew


class Intake:
    """From aligned rows to the buffer; a part of :class:`LiveEstimator`."""

    def push(self, time_s: float, row: dict[str, float]) -> None:
        """Take one aligned row at a rising time; missing channels are absent or NaN."""
        self._now = time_s
        self._waiting.append((time_s, row))
        if len(self._waiting) >= BATCH:
            self._settle()

    def _settle(self) -> None:
        """Take the rows that came one by one."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            names = {name for _, row in waiting for name in row}
            self.push_rows(np.array([time for time, _ in waiting]), {
                name: np.array([row.get(name, math.nan) for _, row in waiting]) for name in names})

    @begins_anew
    def push_rows(self, times: np.ndarray, columns: dict[str, np.ndarray]) -> None:
        """Take aligned rows at rising times, at most some tenths of a second of them.

        Parameters
        ----------
        times : (n,) s.
        columns : channel -> (n,) SI, NaN where it has no value.
        """
        self._settle()
        if not len(times):
            return
        self._now = float(times[-1])
        warm = columns.get("temperature", np.empty(0))
        warm = warm[np.abs(warm) <= LARGEST["temperature"]]
        if len(warm):
            self._temperature = float(warm[-1])
        if self._buffer is not None:
            news = {name: given for name, values in columns.items()
                    if name not in self._channels and (given := np.isfinite(values)).any()}
            if news and self._other_channels(frozenset(news), np.any([*news.values()], axis=0)):
                return
            self._place(times, columns)
            if self._buffer.end - self._taken >= BATCH + self._lag:
                self._take()
            return
        gaps = np.flatnonzero(np.diff(times, prepend=self._early[-1][0][-1] if self._early
                                      else times[0]) > LONG_GAP_S)
        if len(gaps):  # without a model nothing is carried over a long gap
            self._early.clear()
            times = times[gaps[-1]:]
            columns = {name: values[gaps[-1]:] for name, values in columns.items()}
        self._early.append((times, columns))
        if sum(len(part) for part, _ in self._early) >= WARM_UP:
            self._start()

    def _other_channels(self, names: frozenset[str], rows: np.ndarray) -> bool:
        """Begin anew where channels have come, to stay, that let a further stage run.

        ``rows`` (n,) tells which rows hold one.
        """
        self._news += int(np.count_nonzero(rows))
        if self._news < WARM_UP:
            return False
        before, self._channels, self._news = self._channels, self._channels | names, 0
        begin = missing(self.settings, before) != missing(self.settings, self._channels)
        if begin:
            self.reset(f"{' and '.join(sorted(names - before))} arrived after the start")
        return begin

    def _place(self, times: np.ndarray, columns: dict[str, np.ndarray]) -> None:
        """Put rows to their places on the grid."""
        long = LONG_GAP_S / self.dt
        while len(times):
            places = (times - self._origin) / self.dt
            numbers = np.rint(places).astype(np.int64)
            off = np.abs(places - numbers)
            end = self._buffer.end
            count = 1
            if numbers[0] - end > long:
                self._after_gap(float(times[0]))
                continue
            # The same place again: the nearer one stands, else the first, if not yet filtered.
            if numbers[0] >= end or (numbers[0] == end - 1 >= self._taken
                                     and off[0] < self._off - NEARER):
                steps = np.diff(numbers[: self._buffer.at_once])
                breaks = np.flatnonzero((steps <= 0) | (steps > long))
                count = int(breaks[0]) + 1 if len(breaks) else len(steps) + 1
                self._buffer.write(numbers[:count], {
                    name: values[:count] for name, values in columns.items()})
                self._off = float(off[count - 1])
            times = times[count:]
            columns = {name: values[count:] for name, values in columns.items()}

    def _after_gap(self, time_s: float) -> None:
        """Go on after a long gap: parameters stay, states and buffered rows do not."""
        gap = time_s - self._time_of(self._buffer.end)
        self._events.append(Event(time_s, "monitor", f"no data for {gap:.2f} s"))
        self._take(everything=True)
        self._buffer = LiveBuffer(BUFFER_S, self.dt, frozenset(self._buffer.seen))
        self._origin = time_s  # rows are counted anew
        self._taken = self._piece = self._clean = 0
        self._tester.restart_rows()
        self._checkpoints.clear()
        self._changes = {"one": [], "two": []}
        for stage in filter(None, (self._one, self._two)):
            stage.lose()
