"""What lies between samples: interpolation, and sensor channels that a logger repeats.

A file at 100 Hz whose pressures come over a bus at 20 Hz holds each of them for five rows.  Taken
as measured in every row they lag by two rows on average and move in steps, and the flow balance
takes the lag for compliance.  So the rows that repeat are left out, and what lies between the new
values is interpolated as that of a topic with a rate of its own.
"""

import numpy as np

from eha_monitor.recordings.columns import IN_MEMORY, PIECE, Column, blocks
from eha_monitor.recordings.grid import GAP, JITTER, period_of
from eha_monitor.recordings.recording import sampled_rows

SENSORS = ("x", "v", "p1", "p2", "force")
# A drive may truly hold its speed, and the model has a hold for that: the logger does so only
# where it holds a sensor over as many rows.  A demand is held in any case.
DRIVEN = "omega"
ENOUGH = 50  # clear changes, below which nothing is concluded
CLEAR = 1.5  # of a small change; one step of a coarse sensor says nothing about holding
SMALL = 0.1  # of the changes are smaller: of a coarse sensor they are one step of it
LOOSE = 0.02  # of the clear changes may follow another at once (lost rows, a second source)


def interpolate(t: np.ndarray, values: np.ndarray, at: np.ndarray,
                cubic: bool = False) -> np.ndarray:
    """Interpolate between neighbours, never across a gap of more than GAP periods.

    Parameters
    ----------
    t, values : (n,) rising times in s, and values.
    at : (m,) times wanted, s.
    cubic : through four neighbours where they are close together; smooths noise less.
    """
    out = np.full(len(at), np.nan)
    if len(t) == 0:
        return out
    period = period_of(t)
    near = np.clip(np.searchsorted(t, at), 0, len(t) - 1)
    before = np.clip(near - 1, 0, None)
    near = np.where(np.abs(t[before] - at) < np.abs(t[near] - at), before, near)
    same = np.abs(t[near] - at) <= JITTER * (period or 1.0)
    if len(t) > 1:
        left = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        width = t[left + 1] - t[left]
        inside = (at >= t[0]) & (at <= t[-1]) & (width <= GAP * period)
        part = (at - t[left]) / width
        linear = values[left] * (1 - part) + values[left + 1] * part
        out[inside] = linear[inside]
        if cubic and len(t) > 3:
            four = np.clip(left, 1, len(t) - 3)[:, None] + np.arange(-1, 3)
            nodes, heights = t[four], values[four]
            apart = nodes[:, :, None] - nodes[:, None, :]
            away = at[:, None, None] - np.broadcast_to(nodes[:, None, :], apart.shape)
            one = np.eye(4, dtype=bool)[None]
            ratio = np.where(one, 1.0, away / np.where(one, 1.0, apart))
            curve = (ratio.prod(axis=2) * heights).sum(axis=1)
            close = inside & (np.diff(nodes, axis=1) <= GAP * period).all(axis=1)
            close &= np.isfinite(curve)
            out[close] = curve[close]
    same &= np.isnan(out)  # at the edge of a gap, or beside a NaN
    out[same] = values[near[same]]
    return out


def hold_of(values: np.ndarray) -> int:
    """Return over how many rows each value is repeated; 1 where every row may be new.

    A coarse sensor repeats values too, as long as the quantity moves by less than its resolution
    in a row.  It then changes by one step of its resolution; a change by more than that, always a
    few rows after the one before, is of a held value.

    Parameters
    ----------
    values : (n,) one channel, NaN where missing.
    """
    steps = np.abs(np.diff(values))
    at = np.flatnonzero(steps > 0.0)
    if len(at) <= ENOUGH:
        return 1
    clear = np.flatnonzero(steps[at] > CLEAR * np.quantile(steps[at], SMALL))
    clear = clear[clear > 0]
    if len(clear) < ENOUGH:
        return 1
    apart = at[clear] - at[clear - 1]
    return int(np.median(apart)) if np.quantile(apart, LOOSE) >= 2 else 1


def fresh_rows(values: np.ndarray, hold: int) -> np.ndarray:
    """Return the rows at which a value is new, (k,): where it changes, and every ``hold`` after.

    A value that does not change for longer than ``hold`` was measured again and is the same.
    """
    finite = np.isfinite(values)
    new = finite & np.concatenate([[True], (values[1:] != values[:-1])])
    at = np.flatnonzero(new)
    last = np.concatenate([at[1:], [len(values)]])
    # Half of a hold may be missing where two clocks drift past one another.
    again = np.maximum((last - at - (hold + 1) // 2) // hold, 0)
    rows = np.repeat(at, again + 1) + hold * (
        np.arange(np.sum(again + 1)) - np.repeat(np.cumsum(again + 1) - again - 1, again + 1))
    return rows[finite[rows]]


def released(columns: dict[str, np.ndarray], step: float, said: list[str]
             ) -> dict[str, np.ndarray]:
    """Return the columns, each held sensor channel interpolated between its new values.

    Parameters
    ----------
    columns : channel -> (n,) on one grid, SI, NaN where missing.
    step : spacing of the grid, s.
    said : takes a sentence for each channel that was held.
    """
    found, holds = dict(columns), {}
    for name in (*SENSORS, DRIVEN):
        if name not in columns:
            continue
        values, rows = columns[name], len(columns[name])
        hold = hold_of(values if rows <= IN_MEMORY else values[sampled_rows(rows)[:PIECE]])
        if hold == 1 or (name == DRIVEN and hold not in holds.values()):
            continue
        holds[name], found[name] = hold, _between(values, hold, step)
        said.append(f"{name}: {1 / (hold * step):.4g} Hz, each value repeated over {hold} rows; "
                    f"interpolated to {1 / step:.4g} Hz")
    return found


def _between(values: np.ndarray, hold: int, step: float) -> np.ndarray:
    """Return a held channel, interpolated between its new values, (n,)."""
    made = Column()
    for start, stop, _ in blocks(values):
        first, last = max(0, start - 8 * hold), min(len(values), stop + 8 * hold)
        part = values[first:last]
        rows = fresh_rows(part, hold)
        at = np.arange(start - first, stop - first)
        between = interpolate(rows * step, part[rows], at * step, cubic=True)
        # Of the last value before a gap, or the end, nothing follows.
        made.append(np.where(np.isnan(between), part[at], between))
    return made.values()
