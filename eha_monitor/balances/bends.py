"""How far B, F_c and F_d go with the way in which friction falls with speed.

Dry friction falls with speed (Stribeck), by ``FALL`` of itself or so, over 1 to 50 mm/s.  Where it
falls more slowly than a recording moves, F_c is the friction there, and damping takes up the
slope; where a fall is seen, how far it goes on at rest is a matter of its speed.  A recording
rarely knows: each of some falls stands in the model in turn, as likely as it makes the recording.
"""

from collections.abc import Sequence

import numpy as np

from eha_monitor.balances.candidates import BENT_DAMPING, DRY
from eha_monitor.balances.least_squares import rms, unexcluded
from eha_monitor.balances.table import Table

FALL = 0.5  # of dry friction: what a Stribeck curve takes of it


def by_falls(table: Table, names: Sequence[str], values: Sequence[float]) -> np.ndarray:
    """Return the mean squared shifts of parameters by how friction may fall, (k, k) SI.

    The mixture of models with one bend of the friction's curve each: that which is named, or
    none, and those of :func:`candidates.falls_of`, whose size is half-normal.  Without dry
    friction, what passes for damping may be one that has not turned round yet.

    Parameters
    ----------
    names, values : (k,) terms of a model, and their parameters.
    """
    of, values = {one.name: one for one in table.candidates}, np.asarray(values)
    rows = table.rows[table.good]
    columns = rows[:, [table.places[name] for name in names]]
    falls = _which(of[name].family == DRY and of[name].upon for name in names)
    dry = _which(of[name].family == DRY and not of[name].upon for name in names)
    # Damping by the square of speed bends the curve as a fall does.
    bends = falls if falls.any() else _which(name == BENT_DAMPING for name in names)
    seen = dry.any()
    if not seen:
        dry = _which(name == "B" for name in names)
    if not dry.any():
        return np.zeros((len(names), len(names)))
    ways = (table.falls if seen else table.turning)[table.good]
    share = FALL if seen else 1.0 / max(rms(ways), 1e-300)  # it may be all of the damping
    size = share * rms(columns[:, dry] @ values[dry])
    noise = float(np.mean((rows[:, 0] - columns @ values) ** 2)) * table.full[1]
    rest, base = columns[:, ~bends], values[~bends]
    if bends.any():
        base = np.linalg.lstsq(rest, rows[:, 0], rcond=None)[0]
    left, shifts, evidence = rows[:, 0] - rest @ base, [], []

    def entered(way: np.ndarray, unit: float, whose: np.ndarray) -> None:
        """Let a bend stand in the model; ``unit`` of a weight of 1 is the parameter of whose."""
        moves, mean, variance, log = unexcluded(rest, unit * way, left, noise, positive=True)
        start, slope = np.zeros(len(names)), np.where(whose, unit, 0.0)
        start[~bends], slope[~bends] = base, moves
        shift = start + mean * slope - values
        shifts.append(np.outer(shift, shift) + variance * np.outer(slope, slope))
        evidence.append(log)

    for i in np.flatnonzero(bends):
        own = columns[:, i]
        entered(own, size if falls.any() else size / max(rms(own), 1e-300), bends)
    if not bends.any():
        shifts.append(np.zeros((len(names), len(names))))
        evidence.append(0.0)
    for way in ways.T:
        entered(way, size, falls)
    odds = np.exp(np.array(evidence) - max(evidence))
    return np.tensordot(odds, shifts, 1) / odds.sum()


def _which(flags) -> np.ndarray:
    return np.array([bool(flag) for flag in flags], dtype=bool)
