"""The columns of a CSV, a MAT file or a bag, whichever comes, as candidates for channels.

Of a CSV also how it is laid out: what parts its cells, where names, units and numbers stand.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from posixpath import commonpath, dirname

import numpy as np

from eha_monitor.draft.words import Header, kind_of, read
from eha_monitor.errors import InputError
from eha_monitor.recordings.importing import (
    WITH_UNIT,
    encoding_of,
    first_lines,
    parted_cells,
    read_columns,
    says_of_each,
    variables_of,
)
from eha_monitor.settings.channels import Table

DELIMITERS = {"tab": "\t", ";": ";", ",": ",", "space": " "}
LOOKED_AT = 400  # lines
LEAST_PA = 5e4  # that a pressure of a rig in motion reaches, absolute or gauge
RUN = 5  # lines of numbers, one below the other, that begin the data
_NUMBER = re.compile(r"^[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?$")
_STAMP = re.compile(r"^[\d./:TZ+ ,-]*\d[:./-]\d[\d./:TZ+ ,-]*$")


@dataclass(frozen=True)
class Layout:
    """How a CSV is laid out."""

    delimiter: str  # as ``table.delimiter`` takes it
    skip_rows: int  # lines above the names, or above the numbers where there are no names
    named: bool  # whether the reader finds the names in the first line behind these
    names: tuple[str, ...]
    units: tuple[str, ...]  # "" where no row holds them


def layout_of(path: Path) -> Layout:
    """Find out how a CSV is laid out.

    Raises InputError if no rows of numbers are found.
    """
    lines = first_lines(path, encoding_of(path), most=LOOKED_AT, blank=True)
    best = None
    for name, delimiter in DELIMITERS.items():
        rows = [parted_cells(line, delimiter) for line in lines]
        start = _first_numbers(rows)
        if start is not None and (best is None or len(rows[start]) > len(best[2][best[1]])):
            best = (name, start, rows)
    if best is None:
        raise InputError(f"{path}: expected rows of numbers in columns, found none in the first "
                         f"{len(lines)} lines")
    return _with_names(*best)


def _first_numbers(rows: list[list[str]]) -> int | None:
    """Return the first of some rows of numbers, one below the other, or None."""
    for start in range(len(rows)):
        run = rows[start:start + RUN]
        if len(rows[start]) > 1 and not says_of_each(rows[start]) and all(
                len(row) == len(rows[start]) and _numbers(row) >= 0.5 * len(row) for row in run):
            return start
    return None


def _numbers(row: list[str]) -> int:
    return sum(bool(_NUMBER.match(cell) or _STAMP.match(cell) or _unit_in(cell))
               for cell in map(str.strip, row))


def _unit_in(cell: str) -> str:
    """Return the unit that stands behind the number of a cell, such as 2.5 mm; "" without."""
    match = re.match(WITH_UNIT, cell.strip())
    return match[2] if match and kind_of(match[2])[1] else ""


def _with_names(delimiter: str, start: int, rows: list[list[str]]) -> Layout:
    count = len(rows[start])
    own = tuple(map(_unit_in, rows[start]))  # that stand in the cells themselves
    above = [place for place in range(start) if rows[place]]  # a scope leaves lines empty
    each = [place for place in above if len(rows[place]) == count and says_of_each(rows[place])]
    if each:  # the first of these is "Name"
        return Layout(delimiter, each[0], True, _stripped(rows[each[0]]), own)
    head = [place for place in above[-4:]
            if len(rows[place]) == count and not _numbers(rows[place])
            and not rows[place][0].startswith("***")]
    if not head:
        last = rows[above[-1]] if above else [""]
        names = tuple(cell.strip().lstrip("#").strip() for cell in last)
        names = names[len(names) > count and not names[0]:]  # a space behind the # parts cells
        # numpy's savetxt puts a # before the names; the reader leaves such a line out.
        commented = last[0].lstrip().startswith("#") and len(names) == count
        return Layout(delimiter, 0 if commented else start, False,
                      names if commented else tuple(map(str, range(count))), own)
    units = [place for place in head if _are_units(rows[place])]
    filled = {place: sum(map(bool, map(str.strip, rows[place]))) for place in head}
    # A spreadsheet fills a title's line up with empty cells.
    named = [place for place in head if place not in units
             and filled[place] >= 0.7 * max(filled.values())] or head[:1]
    row = next((rows[place] for place in units if place != named[0]), own)
    return Layout(delimiter, named[0], True, _stripped(rows[named[0]]),
                  tuple(cell.strip() for cell in row))


def _stripped(names: list[str]) -> tuple[str, ...]:
    return tuple(cell.strip().lstrip("\ufeff") for cell in names)


def _are_units(row: list[str]) -> bool:
    said = [cell.strip().strip("[](){} ") for cell in row]
    known = [bool(kind_of(cell)[1]) or cell in ("-", "") for cell in said]
    return any(kind_of(cell)[1] for cell in said) and sum(known) >= 0.7 * len(row)


MOST_MESSAGES = 20_000  # of a topic, to guess from
DATES = 3  # columns without numbers that may be dates


@dataclass(frozen=True, eq=False)
class Candidate:
    """A column that may be a channel."""

    place: dict[str, str]  # keys of the map that name it: column, or topic, name and field
    shown: str  # as people know it
    header: Header  # what its name says
    values: np.ndarray  # (n,) float64, or datetime64[ns] of dates; as recorded


@dataclass(frozen=True)
class Source:
    """What is to be described: its columns, and the keys of ``table`` that read it."""

    path: Path
    bag: bool
    candidates: tuple[Candidate, ...]
    table: dict[str, str | int] = field(default_factory=dict)


def source_of(path: Path) -> Source:
    """Return the columns of a recording.

    Raises InputError if it is none that can be read.
    """
    if not path.exists():
        raise InputError(f"{path}: expected a CSV file, a MAT file or a bag, found nothing")
    if path.is_dir() or path.name.endswith((".mcap", ".mcap.zstd")):
        return _bag(path)
    return _mat(path) if path.suffix.lower() == ".mat" else _csv(path)


def _csv(path: Path) -> Source:
    layout = layout_of(path)
    keys = {"kind": "csv", "delimiter": layout.delimiter,
            "header": "present" if layout.named else "absent",
            **({"skip_rows": layout.skip_rows} if layout.skip_rows else {})}
    table = Table(**keys)
    # A name that stands twice, none, or one that is a number is named by its place.
    columns = [name if layout.named and name and layout.names.count(name) == 1
               and not name.isdigit() else str(place) for place, name in enumerate(layout.names)]
    found = read_columns(path, table, columns)
    for column in [one for one in columns if not _holds(found[one])][:DATES]:
        dated = read_columns(path, table.model_copy(update={"time": column}), [column])[column]
        if dated.dtype.kind == "M" and _holds(dated):
            found[column] = dated
    rows = max(len(values) for values in found.values())
    return Source(path, False, tuple(
        Candidate({"column": column}, name or f"column {column}", read(name, unit), values)
        for column, name, unit in zip(columns, layout.names, layout.units, strict=True)
        if _holds(values := found[column]) and len(values) == rows), keys)


def _holds(values: np.ndarray) -> bool:
    known = ~np.isnat(values) if values.dtype.kind == "M" else np.isfinite(values)
    return bool(known.any())


def _mat(path: Path) -> Source:
    found = []
    columns: list[str] = []
    for name, shape in variables_of(path).items():
        if len(shape) == 2 and min(shape) == 1 and max(shape) > 1:
            columns.append(name)
        elif len(shape) == 2 and 1 < shape[1] <= 50 < shape[0]:
            columns += [f"{name}[:,{k}]" for k in range(shape[1])]
    for column in columns:
        try:
            values = read_columns(path, Table(kind="mat"), [column])[column]
        except InputError:  # text, complex numbers
            continue
        found.append(Candidate({"column": column}, column, read(column), values))
    if not found:
        raise InputError(f"{path}: expected variables with numbers, found none")
    rows = max(len(one.values) for one in found)
    return Source(path, False, tuple(one for one in found if len(one.values) == rows),
                  {"kind": "mat"})


def _bag(path: Path) -> Source:
    from rosbags.typesys.store import Typestore

    from eha_monitor.recordings.bag import iter_raw, topics
    from eha_monitor.recordings.cdr import UNREADABLE, types_of

    stores, taken, numbers = {}, {}, {}
    for topic, described in topics(path).items():
        try:
            store = Typestore()
            store.register(types_of(described.msgtype, described.encoding,
                                    described.definition.encode()))
            stores[topic] = (store, described.msgtype)
        except (*UNREADABLE, ValueError):
            continue
    for topic, _, time_ns, raw in iter_raw(path):
        if topic not in stores or taken.get(topic, 0) >= MOST_MESSAGES:
            continue
        store, msgtype = stores[topic]
        try:
            message = store.deserialize_cdr(raw, msgtype)
        except UNREADABLE:
            continue
        taken[topic] = taken.get(topic, 0) + 1
        for name, where, value in _leaves(message, ""):
            numbers.setdefault((topic, name, where), []).append((time_ns, value))
    found, machine = [], namespace_of({topic for topic, _, _ in numbers})
    grid = [time for time, _ in max(numbers.values(), key=len, default=())]
    for (topic, name, where), values in numbers.items():
        times, column = np.array(values, dtype=float).T
        column = np.interp(grid, times, column)  # columns are compared row by row
        if np.isfinite(column).any():
            place = {"topic": topic} | ({"name": name} if name else {}) | {"field": where}
            shown = " ".join(part for part in (topic, name, where) if part)
            # The machine's own namespace, "/press_3", says nothing of what is measured.
            found.append(Candidate(place, shown, _of_message(
                topic.removeprefix(machine), name, where, column), column))
    if not found:
        raise InputError(f"{path}: expected messages with numbers, found none")
    return Source(path, True, tuple(found))


def namespace_of(topics: Iterable[str]) -> str:
    """Return the namespace that topics have in common, ``/press_3``; "" where there is none."""
    topics = list(topics)
    if not topics or not all(topic.startswith("/") for topic in topics):
        return ""
    return commonpath([dirname(topic) for topic in topics]).rstrip("/")


def _of_message(topic: str, name: str, where: str, column: np.ndarray) -> Header:
    """Return what topic, joint and field say; units of standard messages are SI.

    A pressure that never reaches half a bar in Pa is in another unit, which its size says.
    """
    unit = {"position": "", "fluid_pressure": "Pa", "temperature": "degC"}.get(where, "")
    if unit == "Pa" and np.nanmax(np.abs(column)) < LEAST_PA:
        unit = ""
    last = topic.rsplit("/", 2)[-2:]
    return read(" ".join((*last, name, "" if where == "data" else where)), unit)


def _leaves(message, prefix: str):
    """Yield (joint name, field, number) of a message, without its header."""
    names = getattr(message, "name", None)
    for key in getattr(message, "__dataclass_fields__", {}):
        value = getattr(message, key)
        where = f"{prefix}{key}"
        if key in ("header", "__msgtype__", "name", "variance") or "covariance" in key:
            continue
        if isinstance(value, (bool, str)):
            continue
        if isinstance(value, (int, float, np.number)):
            yield "", where, float(value)
        elif isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "iuf":
            if names is not None and len(names) == len(value):
                yield from ((str(name), where, float(one))
                            for name, one in zip(names, value, strict=True))
            elif len(value) <= 16:
                yield from (("", f"{where}[{k}]", float(one)) for k, one in enumerate(value))
        elif hasattr(value, "__dataclass_fields__"):
            yield from _leaves(value, f"{where}.")
