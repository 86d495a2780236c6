"""What one recording says of a model that others made: by how much each number would move.

Each number that may change (B, beta_e, parameters of what is in the model, sizes of all that the
catalogue has) has a column, the innovations' sensitivity to it.  The model's own numbers vary from
run to run of a healthy machine, a ~ N(m, s^2) (:mod:`healthy`), so innovations are r + C_o a + c d
+ white noise, where d is a change of one number.  With G the products of the columns and g those
with r + C_o m, what the own numbers explain is taken out,

    g' = g - G_.o (G_oo + s^-2)^-1 g_o,    G' = G - G_.o (G_oo + s^-2)^-1 G_o.,    d = -g'/G'

in units of the number's prior.  That d scatters over the healthy runs; this scatter, not the
sensors' noise, is what a change is measured against.
"""

from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit, Free, with_unknowns
from eha_monitor.mismatch.name.candidates import candidate
from eha_monitor.mismatch.name.columns import ALWAYS, ASTRAY_OWNER, Column, columns_at
from eha_monitor.mismatch.name.gram import grams_of
from eha_monitor.mismatch.name.starts import entered
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of

NARROW = 1e-7  # of a prior's deviation: the narrowest spread of a number over healthy runs
SEEN = 1e-12  # of the largest product: a column below does nothing here
CHARGE = "rig.charge_pressure"  # the one number of a rig that changes by itself


@dataclass(frozen=True)
class Run:
    """What a recording says.

    Attributes
    ----------
    what : (m,) the numbers.
    products : (1 + m, 1 + m) of the whitened columns, innovations first.
    """

    what: tuple[Column, ...]
    products: np.ndarray

    def ordered(self, what: tuple[Column, ...]) -> "Run":
        """Return it with the numbers of another run, in its order; what it lacks does nothing."""
        places = {key_of(column): 1 + i for i, column in enumerate(self.what)}
        own = np.array([0, *(places.get(key_of(column), -1) for column in what)])
        products = self.products[np.ix_(own, own)].copy()
        products[own < 0], products[:, own < 0] = 0.0, 0.0
        return Run(what, products)


def key_of(column: Column) -> tuple[str, int, str]:
    """Return what a number is known by in every run: owner, start and name."""
    return column.owner, column.variant, column.name


@dataclass(frozen=True)
class Own:
    """The model's own numbers over the healthy runs.

    Attributes
    ----------
    places : (o,) among a run's numbers; ``mean``, ``variance`` (o,) of their amplitudes.
    free : (o,) how they are fitted.
    """

    places: np.ndarray
    mean: np.ndarray
    variance: np.ndarray
    free: tuple[Free, ...]

    def away(self, theta: np.ndarray, fit: Fit) -> np.ndarray:
        """Return how far parameters are from the healthy model's, (o,) in amplitudes."""
        return np.array([(f.inward(theta[f.place]) - f.inward(fit.theta[f.place])) / f.spread
                         for f in self.free])

    def held(self, fit: Fit) -> tuple[Free, ...]:
        """Return the own numbers as a healthy run has them: a prior for the fit of another."""
        return tuple(replace(f, prior=f.inward(fit.theta[f.place]) + mean * f.spread,
                             spread=max(np.sqrt(variance), NARROW) * f.spread)
                     for f, mean, variance in zip(self.free, self.mean, self.variance,
                                                  strict=True))


@dataclass(frozen=True)
class Reading:
    """By how much each number of a run would move if it alone did, beside the own ones.

    Attributes
    ----------
    amplitudes : (m,), NaN where a number does nothing.
    power : (m,) squares of the columns, less what the own numbers explain.
    response : (m, m) by how much the amplitude of each falls where another moves by one.
    """

    amplitudes: np.ndarray
    power: np.ndarray
    response: np.ndarray

    def without(self, place: int, amount: float) -> np.ndarray:
        """Return the amplitudes that are left once a number has moved, (m,)."""
        return self.amplitudes - self.response[:, place] * amount


def reading_of(run: Run, own: Own) -> Reading:
    """Return what a run says beside the model's own numbers."""
    products = run.products[1:, 1:]
    sides = run.products[0, 1:] + products[:, own.places] @ own.mean
    # Own numbers are read beside the other own ones, all else beside all of them.
    beside, left = _beside(products, sides, own.places, own.variance)
    for i, place in enumerate(own.places):
        rest = np.delete(np.arange(len(own.places)), i)
        rows, side = _beside(products, sides, own.places[rest], own.variance[rest])
        beside[place], left[place] = rows[place], side[place]
    power = np.diag(beside).copy()
    power[~(power > SEEN * np.diag(products))] = np.nan
    return Reading(-left / power, power, beside / power[:, None])


def _beside(products: np.ndarray, sides: np.ndarray, places: np.ndarray, variance: np.ndarray
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return products and sides without what some numbers explain."""
    if not len(places):
        return products.copy(), sides.copy()
    _, of_data = posterior_of(products[np.ix_(places, places)], variance)
    taken = of_data @ np.column_stack([products[places], sides[places]])
    return (products - products[:, places] @ taken[:, :-1],
            sides - products[:, places] @ taken[:, -1])


def posterior_of(products: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (G + s^-2)^-1 of amplitudes with a prior, (o, o), and that for products with data.

    Where two columns are nearly one, what sets them apart in their products G is lost in
    rounding, and a wide prior beside it: the sum would be singular.  In units of the prior it is
    1 + s G s, whose eigenvalues are 1 or more.  What is below the rounding of the largest is
    nothing that was measured; there products with data are rounding too, and the second matrix
    leaves them out.
    """
    s = np.sqrt(variance)
    values, vectors = np.linalg.eigh(s[:, None] * products * s)
    measured = values > len(s) * np.finfo(float).eps * values.max(initial=0.0)
    half = s[:, None] * vectors / np.sqrt(1.0 + np.where(measured, values, 0.0))
    return half @ half.T, (half * measured) @ half.T


def may_change(column: Column) -> bool:
    """Tell whether a number may differ between two recordings of one machine."""
    if column.owner == ASTRAY_OWNER:
        return False
    if column.name.startswith("rig."):
        return column.owner == ALWAYS and column.name == CHARGE
    if column.owner == ALWAYS:
        return "." not in column.name  # else a small timing error that every record has
    if column.variant < 0:
        return column.size
    # A limit has no linear size, and what grows out of another effect is that one's change.
    return (not column.start.replaces and not candidate(column.owner).limit
            and column.free.prior == 0.0)


def run_of(experiment: Experiment, fit: Fit) -> Run:
    """Return what the recordings of an experiment say of a model."""
    here = with_unknowns(experiment, fit)
    columns = columns_at(experiment, here, unnamed=False)
    gram = grams_of(experiment, here, columns.values, [here.unknowns])[0]
    # A column that runs away says nothing of this recording.
    good = np.isfinite(np.diag(gram.products))
    products = np.where(good[:, None] & good, gram.products, 0.0)
    kept = [i for i, column in enumerate(columns.what[: len(products) - 1]) if may_change(column)]
    rows = np.array([0, *(1 + i for i in kept)])
    return Run(tuple(columns.what[i] for i in kept), products[np.ix_(rows, rows)])


def with_change(fit: Fit, column: Column, amplitude: float) -> Fit:
    """Return a model with a number moved by an amplitude; its bounds hold."""
    theta, active, f = fit.theta.copy(), fit.active.copy(), column.free
    if column.variant < 0:
        theta[f.place] = f.outward(f.inward(fit.theta[f.place]) + amplitude * f.spread)
        return replace(fit, theta=theta)
    if not active[NAMES.index(column.owner)]:
        theta, active = entered(theta, active, column.start)
        for p in CATALOGUE[column.owner].sizes:
            theta[place_of(f"{column.owner}.{p.name}")] = p.neutral
    theta[f.place] = f.outward(f.prior + amplitude * f.spread)
    return replace(fit, theta=theta, active=active)
