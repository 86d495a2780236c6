"""Cells of CSV and MAT files as arrays of numbers."""

import csv
import gzip
import math
import re
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from eha_monitor.errors import InputError
from eha_monitor.regular import check_regular
from eha_monitor.settings.table import Table

DELIMITERS = {"tab": "\t", "space": " "}
MOST_CELLS = 100_000_000  # of the wanted variables of a MAT file, 800 MB
_SLICE = re.compile(r"(\w+)(?:\[\s*:\s*,\s*(\d+)\s*\])?")


def read_columns(path: Path, table: Table, wanted: list[str]) -> dict[str, np.ndarray]:
    """Return the wanted columns, name -> (n,) float64; a cell that is no number is NaN.

    Raises
    ------
    InputError
        One line that names the file, and a missing column with those that there are.
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

    lines = _first_lines(path)
    delimiter = DELIMITERS.get(table.delimiter, table.delimiter)
    if delimiter == "auto":
        delimiter = _delimiter(lines)
    named = table.header == "present" or (
        table.header == "auto" and not any(_is_number(cell)
                                           for cell in _cells(lines[0], delimiter)))
    separator = r"\s+" if delimiter == " " else delimiter
    try:
        frame = pandas.read_csv(
            path, sep=separator, header=0 if named else None, comment="#", dtype=str,
            skip_blank_lines=True, skipinitialspace=True, encoding_errors="replace",
            compression="infer", on_bad_lines="skip", index_col=False, na_filter=False)
    except (OSError, ValueError, EOFError, zlib.error) as problem:  # pandas' are ValueErrors
        what = " ".join(str(problem).split())[:120]
        raise InputError(f"{path}: expected a CSV file: {what}") from problem
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
        if delimiter != ",":  # a decimal comma
            cells = cells.str.replace(",", ".", regex=False)
        found[name] = pandas.to_numeric(cells, errors="coerce").to_numpy(dtype=float)
    return found


def _first_lines(path: Path) -> list[str]:
    """Return the first lines that hold something; the file may be packed with gzip."""
    try:
        with (gzip.open(path) if path.suffix == ".gz" else path.open("rb")) as file:
            text = file.read(65536).decode("utf-8", errors="replace").lstrip("\ufeff")
    except (OSError, EOFError, zlib.error) as problem:
        raise InputError(f"{path}: cannot read file: {problem}") from problem
    if "\0" in text:
        raise InputError(f"{path}: expected a CSV file, got binary data")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if not lines:
        raise InputError(f"{path}: expected a CSV file, found no rows")
    return lines[:20]


def _delimiter(lines: list[str]) -> str:
    """Return what splits the lines into equally many cells: tab, semicolon, comma or space."""
    for delimiter in ("\t", ";", ",", " "):
        counts = {len(_cells(line, delimiter)) for line in (lines[:-1] or lines)}
        if min(counts) > 1 and (len(counts) == 1 or delimiter in "\t;"):
            return delimiter
    return ","


def _cells(line: str, delimiter: str) -> list[str]:
    return line.split() if delimiter == " " else next(csv.reader([line], delimiter=delimiter), [])


def _is_number(cell: str) -> bool:
    try:
        float(cell.strip().replace(",", "."))
    except ValueError:
        return False
    return True


def _mat(path: Path, wanted: list[str]) -> dict[str, np.ndarray]:
    """Read the wanted variables, and nothing else: a few bytes may unpack to gigabytes."""
    shapes = _variables(path)
    names = {}
    for name in wanted:
        match = _SLICE.fullmatch(name)
        if match is None or match[1] not in shapes:
            raise InputError(f"{path}: variable '{name}' not found, the file has "
                             f"{', '.join(sorted(shapes)) or 'none'}")
        names[match[1]] = None
    cells = sum(math.prod(shapes[name]) for name in names)
    if cells > MOST_CELLS:
        raise InputError(f"{path}: the variables {', '.join(names)} hold {cells} numbers, "
                         f"expected at most {MOST_CELLS:.0e}")
    from scipy.io import loadmat

    there = _tried(path, lambda: loadmat(path, variable_names=list(names)))
    found = {}
    for name in wanted:
        match = _SLICE.fullmatch(name)
        found[name] = _column(path, name, np.asarray(there.get(match[1])), match[2])
    lengths = {name: len(values) for name, values in found.items()}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise InputError(f"{path}: variables differ in length: {told}")
    return found


def _variables(path: Path) -> dict[str, tuple[int, ...]]:
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
