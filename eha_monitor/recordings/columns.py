"""Columns that grow row by row and lie on disk once they are long.

A recording of hours does not fit into memory, and needs not: whoever reads it takes a piece at a
time.  A long column is an ordinary array over a mapped temporary file without a name (it is gone
with the process); :func:`let_go` gives the memory of its pages back.  The files lie where
``TMPDIR`` says.
"""

import mmap
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from eha_monitor.errors import InputError

IN_MEMORY = 2**18  # rows up to which a column stays in memory (4.4 minutes at 1 kHz)
PIECE = 2**16  # rows that are worked on at a time; of a longer recording only


class Column:
    """A column of float64 that is appended to, then read."""

    def __init__(self):
        self._in_memory = IN_MEMORY
        self._parts: list[np.ndarray] = []
        self._file = None
        self._whole: np.ndarray | None = None  # once it has been read, nothing is added
        self._waiting = 0
        self.rows = 0

    def append(self, values: np.ndarray) -> None:
        """Add rows; ``values`` (m,) may be reused by the caller afterwards."""
        self._parts.append(np.array(values, dtype=float))
        self._waiting += len(values)
        self.rows += len(values)
        if self.rows > self._in_memory and self._waiting >= PIECE:
            self._write()

    def fill(self, rows: int) -> None:
        """Add NaN until there are so many rows."""
        while self.rows < rows:
            self.append(np.full(min(rows - self.rows, PIECE), np.nan))

    def values(self, rows: int | None = None) -> np.ndarray:
        """Return the column, or its first rows; (n,), not to be written where it is on disk."""
        rows = self.rows if rows is None else min(rows, self.rows)
        if self._whole is not None:
            return self._whole[:rows]
        if self._file is None and self.rows <= self._in_memory:
            whole = np.concatenate(self._parts) if self._parts else np.empty(0)
            self._parts = [whole]
            return whole[:rows]
        self._write()
        mapped_file = mmap.mmap(self._file.fileno(), 8 * self.rows, access=mmap.ACCESS_READ)
        self._file.close()  # the map stays
        self._whole = np.frombuffer(mapped_file, dtype=float)
        return self._whole[:rows]

    def _write(self) -> None:
        parts, self._parts, self._waiting = self._parts, [], 0
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="eha_monitor_")  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            for part in parts:
                self._file.write(memoryview(part).cast("B") if len(part) else b"")
            self._file.flush()
        except OSError as problem:
            raise InputError(f"{tempfile.gettempdir()}: cannot hold the columns of a long "
                             f"recording: {problem.strerror}; TMPDIR names another folder"
                             ) from problem


def on_disk(values: np.ndarray) -> bool:
    """Tell whether an array lies in a mapped file."""
    return _map_of(values) is not None


def let_go(*arrays: np.ndarray) -> None:
    """Give back the memory of arrays that lie in mapped files; they can be read as before."""
    for one in {id(found): found for found in map(_map_of, arrays) if found is not None}.values():
        one.madvise(mmap.MADV_DONTNEED)


def _map_of(values) -> mmap.mmap | None:
    base = values
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, memoryview):
        base = base.obj
    return base if isinstance(base, mmap.mmap) else None


def pieces(rows: int, size: int | None = None) -> Iterator[tuple[int, int]]:
    """Yield first and behind-last row of each piece; of one piece where the rows are few."""
    size = size or (rows if rows <= IN_MEMORY else PIECE)
    for start in range(0, rows, max(size, 1)):
        yield start, min(start + size, rows)


def blocks(*columns: np.ndarray) -> Iterator[tuple[int, int, tuple[np.ndarray, ...]]]:
    """Yield (first row, behind the last, each column's rows) piece by piece, in memory."""
    for start, stop in pieces(len(columns[0])):
        yield start, stop, tuple(values[start:stop] for values in columns)
        let_go(*columns)


def any_of(columns: tuple[np.ndarray, ...], test: Callable[..., np.ndarray]) -> bool:
    """Tell whether a test holds for any row, reading no further than that."""
    return any(bool(np.any(test(*rows))) for _, _, rows in blocks(*columns))


def chosen(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return some rows of a column, ``index`` (k,) rising, in memory."""
    if not on_disk(values):
        return values[index]
    found = [rows[index[slice(*np.searchsorted(index, (start, stop)))] - start]
             for start, stop, (rows,) in blocks(values)]
    return np.concatenate(found) if found else values[index]


def stretches(mask: np.ndarray) -> np.ndarray:
    """Return first sample and one behind the last of each run of True, (m, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]))).reshape(-1, 2)


def spans_of(masks: Iterable[tuple[int, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Return first and behind-last row of each stretch of True over consecutive masks.

    ``masks`` : (row of the first, (m,) bool), one following the other.
    """
    starts: list[np.ndarray] = []
    stops: list[np.ndarray] = []
    for row, mask in masks:
        first, last = stretches(mask).T + row
        if len(first) and stops and len(stops[-1]) and first[0] == stops[-1][-1]:
            stops[-1] = stops[-1][:-1]  # it goes on
            first = first[1:]
        starts.append(first)
        stops.append(last)
    none = np.empty(0, dtype=np.int64)
    return np.concatenate([none, *starts]), np.concatenate([none, *stops])


class Table:
    """Rows of several columns, taken piece by piece, such as a filter writes them."""

    def __init__(self):
        self._columns: list[Column] = []
        self.rows = 0

    @classmethod
    def begun(cls, columns: list[np.ndarray] | None, rows: int) -> "Table":
        """Return a table that begins with the first rows of some columns."""
        table = cls()
        if columns is not None and rows:
            for _, _, part in blocks(*(values[:rows] for values in columns)):
                table.append(np.stack(part))
        return table

    def append(self, block: np.ndarray) -> None:
        """Add rows; ``block`` (columns, m)."""
        self._columns = self._columns or [Column() for _ in block]
        for column, values in zip(self._columns, block, strict=True):
            column.append(values)
        self.rows += block.shape[1]

    def values(self) -> list[np.ndarray]:
        """Return each column, (rows,)."""
        return [column.values() for column in self._columns]

    def only(self) -> np.ndarray:
        """Return the one column, (rows,); empty where nothing was appended."""
        return self.values()[0] if self.rows else np.empty(0)


def mapped(function: Callable[..., np.ndarray], *columns: np.ndarray) -> np.ndarray:
    """Return what a function that takes row by row makes of columns, (n,)."""
    made = Table()
    for _, _, rows in blocks(*columns):
        made.append(function(*rows)[None, :])
    return made.only()


def steps_to(rows: int, starts: list[int], values: list[float]) -> np.ndarray:
    """Return (rows,) values, each from its rising start on; the first from row 0."""
    made = Table()
    for first, last in pieces(rows):
        block = np.full(last - first, values[0])
        for start, value in zip(starts[1:], values[1:], strict=True):
            block[max(start - first, 0):] = value
        made.append(block[None, :])
    return made.only()


def first_where(test: Callable[..., np.ndarray], *columns: np.ndarray) -> int | None:
    """Return the first row for which a test holds, or None."""
    for start, _, rows in blocks(*columns):
        good = test(*rows)
        if good.any():
            return start + int(np.argmax(good))
    return None


def sampled(values: np.ndarray) -> np.ndarray:
    """Return every so many rows of a column, as many as stay in memory."""
    stride = -(-len(values) // IN_MEMORY)
    if stride <= 1:
        return values
    parts = [rows[-start % stride::stride].copy() for start, _, (rows,) in blocks(values)]
    return np.concatenate(parts)
