"""How a CSV is laid out: what parts its cells, where its names, units and numbers stand."""

import re
from dataclasses import dataclass
from pathlib import Path

from eha_monitor.draft.words import kind_of
from eha_monitor.errors import InputError
from eha_monitor.recordings.tables import encoding_of, first_lines, parted_cells

DELIMITERS = {"tab": "\t", ";": ";", ",": ",", "space": " "}
LOOKED_AT = 400  # lines
RUN = 5  # lines of numbers, one below the other, that begin the data
_NUMBER = re.compile(r"^[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?$")
_STAMP = re.compile(r"^[\d./:TZ+ ,-]*\d[:./-]\d[\d./:TZ+ ,-]*$")


@dataclass(frozen=True)
class Layout:
    """How a CSV is laid out.

    Attributes
    ----------
    delimiter : as ``table.delimiter`` takes it.
    skip_rows : lines above the names, or above the numbers where there are no names.
    named : whether the reader finds the names in the first line behind these.
    names, units : of the columns; units are "" where no row holds them.
    """

    delimiter: str
    skip_rows: int
    named: bool
    names: tuple[str, ...]
    units: tuple[str, ...]


def layout_of(path: Path) -> Layout:
    """Find out how a CSV is laid out.

    Raises
    ------
    InputError
        If no rows of numbers are found.
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
        if len(rows[start]) > 1 and all(
                len(row) == len(rows[start]) and _numbers(row) >= 0.5 * len(row) for row in run):
            return start
    return None


def _numbers(row: list[str]) -> int:
    return sum(bool(_NUMBER.match(cell.strip()) or _STAMP.match(cell.strip())) for cell in row)


def _with_names(delimiter: str, start: int, rows: list[list[str]]) -> Layout:
    count = len(rows[start])
    blank = ("",) * count
    head = [place for place in range(max(0, start - 4), start)
            if len(rows[place]) == count and not _numbers(rows[place])
            and not rows[place][0].startswith("***")]
    if not head:
        above = rows[start - 1] if start else [""]
        said = [cell.strip().lstrip("#").strip() for cell in above]
        # numpy's savetxt puts a # before the names; the reader leaves such a line out.
        commented = above[0].lstrip().startswith("#") and len(said) == count
        return Layout(delimiter, 0 if commented else start, False,
                      tuple(said) if commented else tuple(map(str, range(count))), blank)
    units = [place for place in head if _are_units(rows[place])]
    named = [place for place in head if place not in units] or head[:1]
    names = rows[named[0]]
    row = next((rows[place] for place in units if place != named[0]), blank)
    return Layout(delimiter, named[0], True,
                  tuple(cell.strip().lstrip("\ufeff") for cell in names),
                  tuple(cell.strip() for cell in row))


def _are_units(row: list[str]) -> bool:
    said = [cell.strip().strip("[](){} ") for cell in row]
    known = [bool(kind_of(cell)[1]) or cell in ("-", "") for cell in said]
    return any(kind_of(cell)[1] for cell in said) and sum(known) >= 0.7 * len(row)
