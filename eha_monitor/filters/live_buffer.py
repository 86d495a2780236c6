"""The last seconds of aligned rows, on a uniform grid, for the live estimator."""

import numpy as np

from eha_monitor.recordings.recording import CHANNELS, LARGEST, Recording

# Columns beside the channels: damping in force and its variance, both stages' innovations, and
# what drive and pump remember after the row.
EXTRA = ("b", "b_variance", "nu_one", "sd_one", "nu_two", "sd_two", "kept")


class LiveBuffer:
    """Rows ``first`` to ``end`` (absolute numbers) of the grid, NaN where nothing came.

    Parameters
    ----------
    seconds : how much is kept at least.
    dt : sample time, s.
    seen : channels that came before, though not in these rows.
    """

    def __init__(self, seconds: float, dt: float, seen: frozenset[str] = frozenset()):
        self.dt = dt
        self.length = round(seconds / dt)
        self._columns = {name: np.full(2 * self.length, np.nan) for name in (*CHANNELS, *EXTRA)}
        self.first = 0
        self.end = 0
        self.seen: set[str] = set(seen)

    @property
    def at_once(self) -> int:
        """How many rows may be written at a time."""
        return max(self.length // 4, 1)

    def write(self, numbers: np.ndarray, columns: dict[str, np.ndarray]) -> None:
        """Write rows of rising ``numbers``, the first no earlier than the last one.

        Rows between stay NaN, and so does what is NaN or beyond all sensors.
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
        """Return a stretch as a recording."""
        return Recording(self.dt, {name: values.copy()
                                   for name, values in self.channels(start, stop).items()})
