"""CSV and MAT files to bags, through the ``table`` section of a config."""

import codecs
import csv
import gzip
import math
import re
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from eha_monitor.draft.words import other_quantity
from eha_monitor.errors import InputError
from eha_monitor.output import check_regular
from eha_monitor.recordings.align import align
from eha_monitor.recordings.cdr import Series
from eha_monitor.recordings.grid import CLOSE, SETBACK, SETBACK_NS, lower_median
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import check_bag_target, write_recording
from eha_monitor.settings import Settings, load_settings
from eha_monitor.settings.channels import CHANNEL_WORDS, Table

SHUFFLED = 0.25  # share of steps backwards in time that neither jitter nor a clock makes
WRAPPED = 10.0  # usual steps, by which a counter goes on where it has begun anew
OFTEN = 0.7  # of its cells hold a number: the others are damage, and counted


def import_file(file: str | Path, map_file: str | Path, out: str | Path, *,
                overwrite: bool = False) -> Recording:
    """Turn a CSV or MAT file into a bag.

    ``map_file`` : config with a ``table`` section; its rig gives the sample time.

    Raises InputError, one line: file or key, and what was expected.
    """
    check_bag_target(out, overwrite)  # before the work, not after it
    settings = load_settings(map_file)
    recording = read_table(file, settings, map_source=str(map_file))
    write_recording(out, recording, settings, overwrite=overwrite)
    return recording


def read_table(file: str | Path, settings: Settings, *, map_source: str = "config") -> Recording:
    """Read a table onto a uniform grid, SI units.

    Pressures stay what the source has, absolute or gauge; the offset of a column turns one into
    the other.
    """
    path, table = Path(file), settings.table
    if not table.columns:
        raise InputError(f"{map_source}: table.columns: expected at least one channel, such as "
                         "x: {column: position, scale: 0.001}")
    for name, column in table.columns.items():
        said = column.scale == 1.0 and other_quantity(  # a scale may make another quantity of it
            column.column, name, column.unit, settings.rig.motion == "rotary")
        if said:
            raise InputError(
                f"{path}: table.columns.{name}: column '{column.column}' is in {said} by its "
                f"name, expected a column of {CHANNEL_WORDS[name]}; if it is one, name it by its "
                "index from 0")
    wanted = [column.column for column in table.columns.values()]
    cells = read_columns(path, table, list(dict.fromkeys([*table.clocks, *wanted])))
    if not len(next(iter(cells.values()))):
        raise InputError(f"{path}: expected rows of numbers, found none")
    losses: list[str] = []
    clocks, series = {}, {}
    for name, column in table.columns.items():
        clock = table.clock_of(column)
        if clock not in clocks:
            clocks[clock] = _clock(path, cells, clock, settings.rig.sample_time,
                                   len(table.clocks) > 1, losses)
        stamps, rows = clocks[clock]
        with np.errstate(over="ignore", invalid="ignore"):
            raw = cells[column.column][rows]
            values = np.where(raw < 0, column.negative_gain, column.gain) * raw + column.zero
        if not np.isfinite(values).any():
            losses.append(f"{name}: column '{column.column}' holds no number")
            continue
        # A channel at half the rate has no sample in an empty cell, as in a bag; few are damage.
        there = np.isfinite(values)
        there |= there.mean() > OFTEN
        taken = stamps[there] - round(column.delay * 1e9)
        series[name] = (Series(taken, stamps[there], values[there], True), path.name)
    if not series:
        raise InputError(f"{path}: expected numbers in columns {', '.join(wanted)}, found none")
    return align(series, settings, source=str(path), losses=losses)


def _clock(path: Path, cells: dict[str, np.ndarray], clock: tuple[str, float], dt: float,
           several: bool, losses: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return the stamps of a clock in the order of time, int64 ns, and the rows that have them.

    Parameters
    ----------
    clock : its column, "" for rows that are ``dt`` s apart, and s per unit of it.
    losses : takes what is told of it.
    """
    name, scale = clock
    if not name:
        rows = np.arange(len(next(iter(cells.values()))))
        return np.round(rows * dt * 1e9).astype(np.int64), rows
    stamps, good = _stamps(cells[name], scale)
    if not good.any():
        raise InputError(f"{path}: column '{name}' holds no time in seconds, no date and no time "
                         "of day")
    # Of several clocks the slower one ends first, and cells without a time fill its column up.
    ended = int(np.flatnonzero(good)[-1]) + 1 if several else len(good)
    if lost := int(np.sum(~good[:ended])):
        losses.append(f"{lost} of {ended} rows have no time and are left out")
    stamps = stamps[good]
    order, told = _order_of_time(stamps)
    losses += [told] * bool(told)
    return stamps[order], np.flatnonzero(good)[order]


def _stamps(cells: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (n,) int64 ns of a time column, and (n,) bool where it holds a time."""
    if cells.dtype.kind == "M":
        good = ~np.isnat(cells)
        return np.where(good, cells.astype(np.int64), 0), good
    time = unwrapped(cells) * scale
    good = np.isfinite(time) & (np.abs(time) < 2**31)
    return np.round(np.where(good, time, 0.0) * 1e9).astype(np.int64), good


def unwrapped(ticks: np.ndarray) -> np.ndarray:
    """Return the ticks of a counter of 16 or 32 bits, (n,), as if it had more of them."""
    there = np.isfinite(ticks)
    steps = np.diff(ticks[there])
    usual = np.median(np.abs(steps)) if len(steps) else 0.0
    for size in (2.0**16, 2.0**32):
        wraps = np.abs(steps + size) < WRAPPED * usual
        if wraps.any() and WRAPPED * usual < 0.5 * size:
            ticks = ticks.copy()
            ticks[there] += size * np.concatenate([[0.0], np.cumsum(wraps)])
    return ticks


def _order_of_time(stamps: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the order in which to take the rows, and a sentence where it is not their own.

    Rows run backwards, are shuffled, or lie in blocks that were joined in the wrong order: then
    the times are those of one recording, and sorted they have no two rows closer than before.
    Otherwise a clock jumped or jitters, and :func:`align` repairs it.  ``stamps`` (n,) int64 ns.
    """
    own = np.arange(len(stamps))
    steps = np.diff(stamps)
    back = int(np.sum(steps < 0))
    if not back:
        return own, ""
    order = np.argsort(stamps, kind="stable")
    if back == len(steps):
        return order, "the rows run backwards in time: sorted by time"
    usual, ahead = lower_median(np.abs(steps)), np.diff(stamps[order])
    blocks = -steps.min() > max(SETBACK_NS, SETBACK * usual) and ahead.min() > CLOSE * usual
    shuffled = back > SHUFFLED * len(steps) and -steps.min() > min(
        SETBACK * lower_median(ahead), np.sum(ahead) // 2)
    if blocks or shuffled:
        return order, (f"the rows are not in order of time ({back} of {len(steps)} steps run "
                       "backwards): sorted by time")
    return own, ""


# ---- Cells as arrays of numbers, dates and times of day as stamps.

DAY = np.timedelta64(24, "h")
# Of a date with slashes the one is tried that all rows fit; within a day both give the same.
FORMATS = ("ISO8601", "%d.%m.%Y %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S.%f",
           "%m/%d/%Y %H:%M:%S", "%d/%m/%Y %H:%M:%S.%f", "%d/%m/%Y %H:%M:%S",
           "%m/%d/%Y %I:%M:%S.%f %p", "%H:%M:%S.%f", "%H:%M:%S")
MOST = 0.5  # of the rows at least must be such a time
LOOKED_AT = 200  # rows that tell the format


def stamps_of(cells) -> np.ndarray:
    """Return (n,) datetime64[ns] in UTC of text cells, NaT where a cell is no such time.

    Times of day count from 1970 on and go on over midnight.  ``cells`` : Series of n texts.
    """
    import pandas
    text = cells.str.replace(",", ".", regex=False)
    some = text.iloc[:LOOKED_AT]
    read = partial(pandas.to_datetime, errors="coerce", utc=True)
    for form in FORMATS:
        if read(some, format=form).notna().mean() <= MOST:
            continue
        found = read(text, format=form)
        stamps = found.dt.tz_localize(None).to_numpy(dtype="datetime64[ns]")
        return _days(stamps) if form.startswith("%H") else stamps
    return np.full(len(cells), np.datetime64("NaT"), dtype="datetime64[ns]")


def _days(stamps: np.ndarray) -> np.ndarray:
    """Return times of day as times since 1970, the day after midnight being the next one."""
    good = ~np.isnat(stamps)
    day = stamps.astype("datetime64[D]")
    since = stamps - np.where(good, day, np.datetime64("1970-01-01", "D"))
    own = since[good].astype(np.int64)
    half = DAY.astype("timedelta64[ns]").astype(np.int64) // 2
    whole = np.concatenate([[0], np.cumsum(np.diff(own) < -half)]) if len(own) else own
    out = np.full(len(stamps), np.datetime64("NaT"), dtype="datetime64[ns]")
    out[good] = (own + whole * 2 * half).astype("datetime64[ns]")
    return out


DELIMITERS = {"tab": "\t", "space": " "}
MOST_CELLS = 100_000_000  # of the wanted variables of a MAT file, 800 MB
MOST_HEAD = 20  # rows below the names that may hold units, ranges, remarks
NO_NUMBER = ("nan", "n/a", "na", "null", "none", "inf", "-inf", "-nan", "+inf", "#n/a")
# Thousands in groups, as 1.234,5 or 1,234.5: the last sign of them is the decimal one.
_GROUPED = r"[-+]?\d{1,3}(?:(?:\.\d{3})+,|(?:,\d{3})+\.)\d+"
_NOT_LAST = r"[.,](?=.*[.,])"
# A number and its unit in one cell, such as 2.5 mm.
WITH_UNIT = (r"^([-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][-+]?\d+)?) ?"
             r"((?:[^\W\d_]|[°%])[^\d\s]*)$")
_SLICE = re.compile(r"(\w+)(?:\[\s*:\s*,\s*(\d+)\s*\])?")


def read_columns(path: Path, table: Table, wanted: list[str]) -> dict[str, np.ndarray]:
    """Return the wanted columns, name -> (n,) float64; a cell that is no number is NaN.

    A time in dates or times of day is (n,) datetime64[ns], NaT where it is none.
    Raises InputError, one line that names the file, and a missing column with those that there
    are.
    """
    check_regular(path, "a CSV or MAT file")
    if not path.exists():
        raise InputError(f"{path}: expected a CSV or MAT file, found nothing")
    kind = table.kind
    if kind == "auto":
        kind = "mat" if path.suffix.lower() == ".mat" else "csv"
    return _mat(path, wanted) if kind == "mat" else _csv(path, table, wanted)


def _csv(path: Path, table: Table, wanted: list[str]) -> dict[str, np.ndarray]:
    import pandas

    encoding = encoding_of(path)
    lines = first_lines(path, encoding, table.skip_rows)
    delimiter = DELIMITERS.get(table.delimiter, table.delimiter)
    if delimiter == "auto":
        delimiter = _delimiter(lines)
    named = table.header == "present" or (
        table.header == "auto" and not any(_is_number(cell)
                                           for cell in parted_cells(lines[0], delimiter)))
    separator = r"\s+" if delimiter == " " else delimiter
    try:
        frame = pandas.read_csv(
            path, sep=separator, header=0 if named else None, comment="#", dtype=str,
            skip_blank_lines=True, skipinitialspace=True, encoding_errors="replace",
            encoding=encoding, skiprows=table.skip_rows, compression="infer",
            on_bad_lines="skip", index_col=False, na_filter=False)
    except (OSError, ValueError, EOFError, zlib.error) as problem:  # pandas' are ValueErrors
        what = " ".join(str(problem).split())[:120]
        raise InputError(f"{path}: expected a CSV file: {what}") from problem
    if len(frame) > 1 and not frame.iloc[-1, -1] and frame.iloc[-2, -1]:
        frame = frame[:-1]  # the logger was stopped in the middle of a line, and of a number
    names = [str(name).strip().lstrip("\ufeff") for name in frame.columns]
    found = {}
    for name in wanted:
        if named and name in names:
            place = names.index(name)
        elif name.isdigit() and int(name) < len(names):
            place = int(name)
        else:
            there = (f"columns {', '.join(names)}" if named
                     else f"{len(names)} columns without names, 0 to {len(names) - 1}")
            raise InputError(f"{path}: column '{name}' not found, the file has {there}")
        cells = frame.iloc[:, place].str.strip()
        # A comma within a cell is a decimal one: a comma between cells is not in them.
        numbers = pandas.to_numeric(cells.str.replace(",", ".", regex=False), errors="coerce")
        if (grouped := numbers.isna() & cells.str.fullmatch(_GROUPED)).any():
            plain = cells[grouped].str.replace(_NOT_LAST, "", regex=True)
            numbers[grouped] = pandas.to_numeric(plain.str.replace(",", ".", regex=False))
        if numbers.isna().all() and (bare := cells.str.extract(WITH_UNIT)[0]).notna().any():
            numbers = pandas.to_numeric(bare.str.replace(",", ".", regex=False))
        found[name] = numbers.to_numpy(dtype=float)
        if name in table.clocks and numbers.isna().all():
            found[name] = stamps_of(cells)
    return _below_the_head(found, frame)


def says_of_each(row: Sequence[str]) -> bool:
    """Tell whether a row says one thing of every signal, as a scope's: Port, 851, Port, 851."""
    keys = {cell.strip() for cell in row[::2]}
    return len(row) > 3 and len(row) % 2 == 0 and len(keys) == 1 and (
        any(map(str.isalpha, *keys)) and not _is_number(*keys))


def _below_the_head(found: dict[str, np.ndarray], frame) -> dict[str, np.ndarray]:
    """Leave out rows below the names that hold words and no number, such as a row of units."""
    said = [says_of_each(list(row)) for row in frame.iloc[:MOST_HEAD].to_numpy()]
    if said and said[0]:
        return {name: values[said.index(False) if False in said else None:]
                for name, values in found.items()}
    numbers = np.logical_or.reduce([np.isfinite(values) if values.dtype.kind == "f"
                                    else ~np.isnat(values) for values in found.values()])
    first = int(np.argmax(numbers)) if numbers.any() else 0
    if not first or first > MOST_HEAD or not frame.iloc[:first].map(
            lambda cell: any(map(str.isalpha, cell)) and cell.casefold() not in NO_NUMBER
            ).any(axis=1).all():
        return found
    return {name: values[first:] for name, values in found.items()}


def encoding_of(path: Path) -> str:
    """Return how the text of a file is written: by its mark, else UTF-8, else Windows' Latin."""
    head = _head(path)
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)  # the last letter may be cut
    except UnicodeDecodeError:
        return "cp1252" if b"\0" not in head else "utf-8"
    return "utf-8"


def _head(path: Path) -> bytes:
    try:
        with (gzip.open(path) if path.suffix == ".gz" else path.open("rb")) as file:
            return file.read(65536)
    except (OSError, EOFError, zlib.error) as problem:
        raise InputError(f"{path}: cannot read file: {problem}") from problem


def first_lines(path: Path, encoding: str, skip: int = 0, most: int = 20,
                blank: bool = False) -> list[str]:
    """Return the first lines that hold something, or all of them with ``blank``.

    The file may be packed with gzip.
    """
    text = _head(path).decode(encoding, errors="replace").lstrip("\ufeff")
    if "\0" in text:
        raise InputError(f"{path}: expected a CSV file, got binary data")
    lines = text.splitlines()[skip:]
    if blank:
        return lines[:most]
    lines = [line for line in lines if line.strip() and not line.startswith("#")]
    if not lines:
        raise InputError(f"{path}: expected a CSV file, found no rows")
    return lines[:most]


def _delimiter(lines: list[str]) -> str:
    """Return what splits the lines into equally many cells: tab, semicolon, comma or space."""
    for delimiter in ("\t", ";", ",", " "):
        counts = {len(parted_cells(line, delimiter)) for line in (lines[:-1] or lines)}
        if min(counts) > 1 and (len(counts) == 1 or delimiter in "\t;"):
            return delimiter
    return ","


def parted_cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line."""
    return line.split() if delimiter == " " else next(csv.reader([line], delimiter=delimiter), [])


def _is_number(cell: str) -> bool:
    try:
        float(cell.strip().replace(",", "."))
    except ValueError:
        return False
    return True


def _mat(path: Path, wanted: list[str]) -> dict[str, np.ndarray]:
    """Read the wanted variables, and nothing else: a few bytes may unpack to gigabytes."""
    shapes = variables_of(path)
    parts = {name: _SLICE.fullmatch(name) for name in wanted}
    for name, match in parts.items():
        if match is None or match[1] not in shapes:
            raise InputError(f"{path}: variable '{name}' not found, the file has "
                             f"{', '.join(sorted(shapes)) or 'none'}")
    names = list(dict.fromkeys(match[1] for match in parts.values()))
    cells = sum(math.prod(shapes[name]) for name in names)
    if cells > MOST_CELLS:
        raise InputError(f"{path}: the variables {', '.join(names)} hold {cells} numbers, "
                         f"expected at most {MOST_CELLS:.0e}")
    from scipy.io import loadmat
    there = _tried(path, lambda: loadmat(path, variable_names=names))
    found = {name: _column(path, name, np.asarray(there.get(match[1])), match[2])
             for name, match in parts.items()}
    lengths = {name: len(values) for name, values in found.items()}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise InputError(f"{path}: variables differ in length: {told}")
    return found


def variables_of(path: Path) -> dict[str, tuple[int, ...]]:
    """Return the variables of a MAT file with their shapes; their numbers are not read."""
    from scipy.io import whosmat
    return {name: shape for name, shape, _ in _tried(path, lambda: whosmat(path))}


def _tried(path: Path, read: Callable):
    """Return what scipy reads, or say in one line that it is no MAT file that it can read."""
    from scipy.io.matlab import MatReadError
    try:
        return read()
    except NotImplementedError as problem:
        raise InputError(f"{path}: MAT files of version 7.3 are not read; save it in MATLAB with "
                         "save(file, '-v7')") from problem
    except (OSError, ValueError, TypeError, KeyError, IndexError, EOFError, MemoryError,
            OverflowError, MatReadError, zlib.error, UnicodeDecodeError) as problem:
        raise InputError(f"{path}: expected a MAT file: "
                         f"{' '.join(str(problem).split())[:120]}") from problem


def _column(path: Path, name: str, value: np.ndarray, index: str | None) -> np.ndarray:
    if value.dtype.kind not in "biuf":
        raise InputError(f"{path}: variable '{name}' holds no real numbers")
    if index is not None:
        if value.ndim != 2 or int(index) >= value.shape[1]:
            raise InputError(f"{path}: '{name}' not found, the variable has shape {value.shape}")
        value = value[:, int(index)]
    if value.ndim > 2 or (value.ndim == 2 and min(value.shape) > 1):
        raise InputError(f"{path}: variable '{name}' has shape {value.shape}, expected a column "
                         "such as '" + name + "[:,0]'")
    return value.reshape(-1).astype(float)
