"""Channels onto their grid while the bag is read, so that the messages need not be kept.

That is possible where stamps are what a sampled system writes: on an even grid, to within what
counts as exact.  Anything else (jitter, a clock that drifts or jumps, late messages) asks for the
stamps of the whole recording at once, and :mod:`align` has them.  What both take they read alike.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from eha_monitor.errors import one_line
from eha_monitor.recordings import align as whole
from eha_monitor.recordings.cdr import Series, TopicReader, Want
from eha_monitor.recordings.columns import PIECE, Column
from eha_monitor.recordings.grid import JITTER, Grid, fit_grid, repair, tell_gaps
from eha_monitor.recordings.recording import CHANNELS, LARGEST, Recording
from eha_monitor.settings.monitor import Settings

FEWEST = 1000  # samples of the reference from which its grid is told
OUTLIERS = 0.001  # share of the stamps that may lie off, as in grid.fit_grid
SLOWER = 3.0  # times: a channel so slow is kept as it came, and interpolated at the end
LONGEST_GAP_S = 3600.0  # a longer one is for the whole recording to judge

# channel -> (who reads its topic, what of it)
Sources = dict[str, tuple[TopicReader, Want]]


class NotEvenError(Exception):
    """The stamps are not on an even grid: the recording is aligned as a whole."""


@dataclass
class _Lane:
    """One channel on its way: its column, and what has been counted."""

    column: Column
    count: int = 0
    missing: int = 0
    off: int = 0


class Stream:
    """Takes what the topics' readers have collected, batch by batch.

    Parameters
    ----------
    settings : channel map and sample time.
    sources : tells which topic each channel is read from, as far as topics have come.

    Raises
    ------
    NotEvenError
        By any method, once the stamps turn out not to be on an even grid.
    """

    def __init__(self, settings: Settings, sources: Callable[[], Sources]):
        self.settings, self.sources = settings, sources
        self.grid: Grid | None = None
        self.begun: Sources = {}
        self.lanes: dict[str, _Lane] = {}
        self.slow: Sources = {}
        self.last: dict[tuple[TopicReader, Want], int] = {}
        self.origin = self.end = 0

    def take(self) -> None:
        """Put what has come on the grid and forget the messages."""
        fast: dict[TopicReader, list[str]] = {}
        for name in self.lanes:
            fast.setdefault(self.begun[name][0], []).append(name)
        for reader, names in fast.items():
            self._take(reader, names)

    def begin(self) -> None:
        """Find the grid on the first batch, and which channels keep to it."""
        found = self.sources()
        if "x" not in found or found["x"][0].count < FEWEST:
            raise NotEvenError
        series = {}
        for name, (reader, want) in found.items():
            one = reader.series(want)
            if one is None:
                raise NotEvenError  # none of it yet: whether it is a channel shows later
            series[name] = one.in_si(self.settings.channels[name])
        leader = series["x"]
        self._check(leader)
        self.origin = int(leader.stamp_ns[0])
        nominal = self.settings.rig.sample_time
        grid = fit_grid((leader.stamp_ns - self.origin) * 1e-9, leader.values, nominal)
        ratio = grid.step / nominal
        simple = nominal * round(ratio) if ratio >= 1 else nominal / round(1 / ratio)
        if grid.mode != "exact" or grid.step != simple:
            raise NotEvenError
        for name, one in series.items():
            t = (one.stamp_ns - self.origin) * 1e-9
            own = fit_grid(t, one.values, grid.step) if len(t) > 1 else None
            if own is not None and own.mode == "exact" and abs(own.step / grid.step - 1) < 0.1:
                self._check(one)
                self.lanes[name] = _Lane(Column())
            elif own is None or own.step > SLOWER * grid.step:
                self.slow[name] = found[name]
            else:
                raise NotEvenError
        self.grid, self.begun = grid, found

    def _check(self, series: Series) -> None:
        if not series.stamped or (np.diff(series.stamp_ns) <= 0).any():
            raise NotEvenError

    def _shift(self, name: str) -> int:
        return round(self.settings.channels[name].delay * 1e9)

    def _take(self, reader: TopicReader, names: list[str]) -> None:
        for stamps, columns in self._drained(
                reader, tuple(dict.fromkeys(self.begun[name][1] for name in names))):
            if len(stamps):
                self._place(stamps, columns, [
                    name for name in names if self.begun[name][1] in columns])

    def _place(self, stamps: np.ndarray, columns: dict[Want, np.ndarray], names: list[str]
               ) -> None:
        """Put channels that share their stamps on the grid."""
        for name in names:
            channel, lane = self.settings.channels[name], self.lanes[name]
            t = (stamps - self._shift(name) - self.origin) * 1e-9
            place = (t - self.grid.start) / self.grid.step
            index = np.round(place)
            lane.off += int(np.count_nonzero(np.abs(place - index) > JITTER))
            lane.count += len(t)
            # Where fit_grid would have looked again: off the grid, or two on one place.
            if (lane.off > OUTLIERS * lane.count or (np.diff(index) <= 0).any()):
                raise NotEvenError
            with np.errstate(over="ignore", invalid="ignore"):
                values = channel.gain * columns[self.begun[name][1]] + channel.zero
            missing = int(np.count_nonzero(np.isnan(values)))
            if np.count_nonzero(np.abs(values) <= LARGEST[name]) + missing < len(values):
                raise NotEvenError  # no measurement: how many there are in all decides
            lane.missing += missing
            if name == "x":
                self.end = int(index[-1]) + 1
            self._append(lane.column, index.astype(np.int64), values)

    def _drained(self, reader: TopicReader, wants: tuple[Want, ...]
                 ) -> list[tuple[np.ndarray, dict[Want, np.ndarray]]]:
        """Return the stamps and columns that a reader has collected, and empty it."""
        taken = reader.take(wants)
        if taken is None:
            raise NotEvenError
        for stamps, columns in taken:
            if not len(stamps):
                continue
            before = max(self.last.get((reader, want), int(stamps[0]) - 1) for want in columns)
            steps = np.diff(stamps, prepend=before)
            if (steps <= 0).any() or steps.max() > LONGEST_GAP_S * 1e9:
                raise NotEvenError
            self.last |= {(reader, want): int(stamps[-1]) for want in columns}
        return taken

    @staticmethod
    def _append(column: Column, index: np.ndarray, values: np.ndarray) -> None:
        """Add rows at rising places; those between stay NaN."""
        ahead = index >= column.rows
        if not ahead.all():
            if index[np.argmax(ahead)] > 0 and column.rows and not ahead[0]:
                raise NotEvenError  # it comes at a place that is taken
            index, values = index[ahead], values[ahead]
        if not len(index):
            return
        first, rows = column.rows, int(index[-1]) + 1
        if rows - first == len(index):
            column.append(values)
            return
        column.fill(int(index[0]))
        rest = np.full(rows - int(index[0]), np.nan)
        rest[index - int(index[0])] = values
        column.append(rest)

    def finish(self, source: str, losses: list[str], found: Sources) -> Recording:
        """Return the recording.

        Parameters
        ----------
        losses : sentences to begin with.
        found : the channels of the whole bag.
        """
        self.take()
        if any(found.get(name) != self.begun[name] for name in self.lanes):
            raise NotEvenError
        said, grid, points = list(losses), self.grid, self.end
        slow = {}
        for name, (reader, want) in found.items():
            lane = self.lanes.get(name)
            if lane is None:
                slow[name] = self._kept(name, reader, want, source, said)
            elif lane.missing:
                said.append(f"{name}: {lane.missing} of {lane.count} values are NaN")
        slow = {name: series for name, series in slow.items() if series is not None}
        whole.tell_grid(grid, found["x"][0].topic, self.settings.rig.sample_time, said)
        columns = {}
        for name, lane in self.lanes.items():
            lane.column.fill(points)
            values = lane.column.values(points)
            if lane.missing < lane.count:
                columns[name] = values
        for name, series in slow.items():
            values = self._interpolated(series, found[name][0].topic, points, name, said)
            if values is not None:
                columns[name] = values
        columns = {name: columns[name] for name in CHANNELS if name in columns}
        tell_gaps(columns, grid.step, said)
        return Recording(grid.step, columns,
                         max(0, self.origin + round(grid.start * 1e9)), source,
                         tuple(dict.fromkeys(map(one_line, said))))

    def _kept(self, name: str, reader: TopicReader, want: Want, source: str,
              said: list[str]) -> Series | None:
        """Return a channel that was not put on the grid as it came, in SI."""
        series = reader.series(want)
        return series and whole.within_range(series.in_si(self.settings.channels[name]), name,
                                             reader.topic, source, said)

    def _interpolated(self, series: Series, label: str, points: int, name: str,
                      said: list[str]) -> np.ndarray | None:
        """Put a channel that came slowly, or late, on the grid; (n,), None where it has none."""
        keep, jumped = repair(series.stamp_ns, label, said)
        t = (series.stamp_ns[keep] - self.origin) * 1e-9
        if jumped or t[0] > points * self.grid.step or t[-1] < 0:
            raise NotEvenError
        own = fit_grid(t, series.values[keep], self.grid.step)
        if own.mode != "exact":
            whole.tell_grid(own, label, own.step, said)
        whole.tell_rate(name, (keep, t, own), self.grid, said)
        column = Column()
        place = whole.placing(series.values, (keep, t, own), self.grid)
        found = False
        for start in range(0, points, PIECE):
            rows = place(start, min(start + PIECE, points))
            found = found or bool(np.isfinite(rows).any())
            column.append(rows)
        return column.values() if found else None
