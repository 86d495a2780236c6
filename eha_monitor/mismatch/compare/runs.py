"""What one recording says of a model that others made: by how much each number would move.

Each number that may change (B, beta_e, parameters of what is in the model, sizes of all that the
catalogue has, smooth unknown functions) has a column, the innovations' sensitivity to it.  If it
alone changed, least squares tells by how much,

    a = -c'e / c'c

in units of the number's prior.  From run to run of a healthy machine these amplitudes scatter, and
that scatter, not the sensors' noise, is what a change is measured against.
"""

from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit, with_unknowns
from eha_monitor.mismatch.name.columns import ALWAYS, ASTRAY_OWNER, Column, Columns, columns_at
from eha_monitor.mismatch.name.gram import grams_of
from eha_monitor.mismatch.name.unnamed import INTERMITTENT
from eha_monitor.physics.effects import CATALOGUE

SEEN = 1e-12  # of the largest product: a column below does nothing here
CHARGE = "rig.charge_pressure"  # the one number of a rig that changes by itself


@dataclass(frozen=True)
class Run:
    """What a recording says.

    Attributes
    ----------
    what : (m,) the numbers.
    products : (1 + m, 1 + m) of the whitened columns, innovations first.
    samples : how many innovations there are.
    """

    what: tuple[Column, ...]
    products: np.ndarray
    samples: int

    @property
    def keys(self) -> list[tuple[str, int, str, int]]:
        """Owner, start, name and place among columns of that name of each number."""
        found, seen = [], {}
        for column in self.what:
            key = (column.owner, column.variant, column.name)
            seen[key] = seen.get(key, -1) + 1
            found.append((*key, seen[key]))
        return found

    @property
    def power(self) -> np.ndarray:
        """Squares of the columns, (m,)."""
        return np.diag(self.products)[1:]

    @property
    def amplitudes(self) -> np.ndarray:
        """By how much each number would move if it alone did, (m,); NaN where it does nothing."""
        with np.errstate(invalid="ignore", divide="ignore"):
            found = -self.products[0, 1:] / self.power
        return np.where(self.power > SEEN * self.power.max(), found, np.nan)

    def without(self, changes: dict[int, float]) -> np.ndarray:
        """Return the amplitudes that are left once some numbers have moved, (m,).

        ``changes`` : place -> amplitude.
        """
        found = self.amplitudes
        for place, amount in changes.items():
            found = found - amount * self.products[1:, 1 + place] / np.where(
                self.power > 0.0, self.power, np.nan)
        return found


def may_change(column: Column) -> bool:
    """Tell whether a number may differ between two recordings of one machine."""
    if column.owner == ASTRAY_OWNER or column.owner == INTERMITTENT:
        return False
    if column.name.startswith("rig."):
        return column.owner == ALWAYS and column.name == CHARGE
    if column.owner == ALWAYS:
        return "." not in column.name  # else a small timing error that every record has
    return column.owner not in CATALOGUE or column.size


def run_of(experiment: Experiment, fit: Fit, scales: np.ndarray) -> Run:
    """Return what the recordings of an experiment say of a model.

    Parameters
    ----------
    scales : (c,) by which each balance is divided where balances are compared, SI.
    """
    here = with_unknowns(experiment, fit, fit.unknowns)
    columns = columns_at(experiment, here)
    products, samples = products_of(experiment, here, columns, scales)
    kept = [i for i, column in enumerate(columns.what[: len(products) - 1]) if may_change(column)]
    rows = np.array([0, *(1 + i for i in kept)])
    return Run(tuple(columns.what[i] for i in kept), products[np.ix_(rows, rows)], samples)


def products_of(experiment: Experiment, fit: Fit, columns: Columns, scales: np.ndarray
                ) -> tuple[np.ndarray, int]:
    """Return the products of whitened columns, innovations first, and how many rows they have."""
    if not experiment.inverse:
        (gram,) = grams_of(experiment, fit, columns.values, [fit.unknowns])
        return gram.products, int(gram.counts.sum())
    values = columns.values[0]
    products, samples = np.zeros((values.shape[2],) * 2), 0
    for j, scale in enumerate(scales):
        rows = values[np.isfinite(values[:, j, 0]), j] / scale
        products += rows.T @ rows
        samples += len(rows)
    return products, samples


def moved(column: Column, fit: Fit, amplitude: float) -> float:
    """Return by how much a number moves with an amplitude, SI."""
    f = column.free
    if f is None:
        return amplitude
    if not f.log:
        return amplitude * f.spread
    now = fit.theta[f.place] if column.variant < 0 else float(np.exp(f.prior))
    return float(now * np.expm1(np.clip(amplitude * f.spread, -50.0, 50.0)))


def of_parts(experiment: Experiment, runs: list[Experiment]) -> list[Experiment]:
    """Return the data of several runs under one experiment: its noise, ranges and steps."""
    return [replace(experiment, stretches=one.stretches) for one in runs]
