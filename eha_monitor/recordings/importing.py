"""CSV and MAT files to bags, through the ``table`` section of a config."""

from pathlib import Path

import numpy as np

from eha_monitor.draft.words import other_quantity
from eha_monitor.errors import InputError
from eha_monitor.recordings.align import align
from eha_monitor.recordings.cdr import Series
from eha_monitor.recordings.grid import CLOSE, SETBACK, SETBACK_NS, lower_median
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.tables import read_columns
from eha_monitor.recordings.write import check_bag_target, write_recording
from eha_monitor.settings import Settings, load_settings
from eha_monitor.settings.channels import CHANNEL_WORDS

SHUFFLED = 0.25  # share of steps backwards in time that neither jitter nor a clock makes
OFTEN = 0.7  # of its cells hold a number: the others are damage, and counted


def import_file(file: str | Path, map_file: str | Path, out: str | Path, *,
                overwrite: bool = False) -> Recording:
    """Turn a CSV or MAT file into a bag.

    Parameters
    ----------
    file : the table.
    map_file : config with a ``table`` section; its rig gives the sample time.
    out : the new bag, a folder or an .mcap file.

    Raises
    ------
    InputError
        One line: file or key, and what was expected.
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
    cells = read_columns(path, table, list(dict.fromkeys(
        ([table.time] if table.time else []) + wanted)))
    rows = len(next(iter(cells.values())))
    if rows == 0:
        raise InputError(f"{path}: expected rows of numbers, found none")
    losses: list[str] = []
    if table.time:
        stamps, good = _stamps(cells[table.time], table.time_scale)
        if not good.any():
            raise InputError(f"{path}: column '{table.time}' holds no time in seconds, no date "
                             "and no time of day")
        if not good.all():
            losses.append(f"{int(np.sum(~good))} of {rows} rows have no time and are left out")
    else:
        good = np.ones(rows, dtype=bool)
        stamps = np.round(np.arange(rows) * settings.rig.sample_time * 1e9).astype(np.int64)
    stamps = stamps[good]
    order, told = _order_of_time(stamps)
    stamps = stamps[order]
    losses += [told] * bool(told)
    series = {}
    for name, column in table.columns.items():
        with np.errstate(over="ignore", invalid="ignore"):
            raw = cells[column.column][good][order]
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


def _stamps(cells: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (n,) int64 ns of a time column, and (n,) bool where it holds a time."""
    if cells.dtype.kind == "M":
        good = ~np.isnat(cells)
        return np.where(good, cells.astype(np.int64), 0), good
    time = cells * scale
    good = np.isfinite(time) & (np.abs(time) < 2**31)
    return np.round(np.where(good, time, 0.0) * 1e9).astype(np.int64), good


def _order_of_time(stamps: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the order in which to take the rows, and a sentence where it is not their own.

    Rows run backwards, are shuffled, or lie in blocks that were joined in the wrong order: then
    the times are those of one recording, and sorted they have no two rows closer than before.
    Otherwise a clock jumped or jitters, and :func:`align` repairs it.

    Parameters
    ----------
    stamps : (n,) int64 ns.
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
