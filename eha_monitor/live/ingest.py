"""How rows come into the live estimator: gathered, then put to their places on a uniform grid."""


import numpy as np

from eha_monitor.recordings.recording import CHANNELS, LARGEST, Recording

WARM_UP = 256  # rows from which the sample time and the noise are first measured
BATCH = 10  # rows taken at a time, at least
BUFFER_S = 20.0
NEARER = 0.05  # sample times
LONG_GAP_S = 0.5  # a longer gap starts the buffer anew
# Columns beside the channels: damping in force and its variance, both stages' innovations, and
# what drive and pump remember after the row.
EXTRA = ("b", "b_variance", "nu_one", "sd_one", "nu_two", "sd_two", "kept")
Columns = dict[str, np.ndarray]


class LiveBuffer:
    """Rows ``first`` to ``end`` (absolute numbers) of the grid, NaN where nothing came.

    ``seconds`` are kept at least; ``seen`` are channels that came before, not in these rows.
    ``zero`` : by which the setpoint of its recordings is moved, m (:mod:`estimation.zero`).
    """

    def __init__(self, seconds: float, dt: float, seen: frozenset[str] = frozenset()):
        self.dt, self.zero = dt, 0.0
        self.length = round(seconds / dt)
        self._columns = {name: np.full(2 * self.length, np.nan) for name in (*CHANNELS, *EXTRA)}
        self.first = 0
        self.end = 0
        self.seen: set[str] = set(seen)

    def write(self, numbers: np.ndarray, columns: dict[str, np.ndarray]) -> None:
        """Write rows of rising ``numbers``, the first no earlier than the last one.

        Not more than ``length``; rows between stay NaN, as what is NaN or beyond all sensors.
        """
        last = int(numbers[-1])
        if last - self.first >= 2 * self.length:
            self._compact(last)
        places = numbers - self.first
        for name, values in columns.items():
            good = np.abs(values) <= LARGEST[name]  # a measurement
            if good.any():
                self._columns[name][places[good]] = values[good]
                self.seen.add(name)
        self.end = last + 1

    def _compact(self, number: int) -> None:
        new_first = max(number - self.length + 1, 0)
        shift = new_first - self.first
        for column in self._columns.values():
            column[:-shift] = column[shift:]
            column[-shift:] = np.nan
        self.first = new_first

    def column(self, name: str, start: int, stop: int) -> np.ndarray:
        """Return a view of rows ``start`` to ``stop`` (absolute, clipped to what is held)."""
        return self._columns[name][max(start - self.first, 0) : stop - self.first]

    def channels(self, start: int, stop: int) -> dict[str, np.ndarray]:
        """Return the recorded channels of a stretch."""
        return {name: self.column(name, start, stop) for name in CHANNELS if name in self.seen}

    def recording(self, start: int, stop: int) -> Recording:
        """Return a stretch as a recording, its setpoint at the zero of its position."""
        return Recording(self.dt, {
            name: values + self.zero if name == "x_d" else values.copy()
            for name, values in self.channels(start, stop).items()})


class Grid:
    """The buffer of the last seconds, and the times of its rows: row 0 is at ``origin``, s."""

    def __init__(self, origin: float, dt: float, seen: frozenset[str] = frozenset()):
        self.buffer, self.origin, self.dt = LiveBuffer(BUFFER_S, dt, seen), origin, dt
        self._off = 0.0  # of the last row, in sample times

    def time_of(self, number: int) -> float:
        """Return the time of a row, s."""
        return self.origin + number * self.dt

    def place(self, times: np.ndarray, columns: Columns, taken: int) -> int:
        """Put rows to their places, up to a long gap; return how many.  Those ``taken`` stand."""
        buffer, long, done = self.buffer, LONG_GAP_S / self.dt, 0
        while done < len(times):
            places = (times[done:] - self.origin) / self.dt
            numbers = np.rint(places).astype(np.int64)
            off = np.abs(places - numbers)
            end, count = buffer.end, 1
            if numbers[0] - end > long:
                break
            # The same place again: the nearer one stands, else the first, if not yet filtered.
            if numbers[0] >= end or (numbers[0] == end - 1 >= taken
                                     and off[0] < self._off - NEARER):
                steps = np.diff(numbers[: max(buffer.length // 4, 1)])
                breaks = np.flatnonzero((steps <= 0) | (steps > long))
                count = int(breaks[0]) + 1 if len(breaks) else len(steps) + 1
                buffer.write(numbers[:count], {
                    name: values[done : done + count] for name, values in columns.items()})
                self._off = float(off[count - 1])
            done += count
        return done
