"""A fitted model, and the likelihood of the innovations of all channels at once.

The likelihood is that of innovations with unknown covariance S,

    log L = -(N/2) log det S,  S = 1/N sum e e'

so that every channel's scale is free and the force, flow, drive and sensor candidates compete on
one number.
"""

import os
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from eha_monitor import ties
from eha_monitor.estimation.sensors import true_position, true_pressure
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.gains import Unknowns, decay_of, gains_of
from eha_monitor.mismatch.likelihood.innovations import (
    FREE,
    N_FILTERED,
    Correction,
    Record,
    innovate,
)
from eha_monitor.physics.contributions import circuit_of, turned_memory
from eha_monitor.physics.plant import N_OUTPUTS, Step, actuator_of, new_state

EXCHANGES = 20  # between free and held, times the numbers of a step: a few are usual
SINGULAR = 1e-12  # of a correlation: what rounding may make of it


@dataclass(frozen=True)
class Free:
    """One fitted parameter."""

    name: str  # ``B``, ``beta_e``, ``rig.<key>`` or ``<effect>.<parameter>``
    place: int  # in theta
    lower: float  # bounds, SI
    upper: float
    prior: float  # Gaussian prior in the fitted coordinate
    spread: float
    log: bool = False  # fitted as its logarithm

    @property
    def owner(self) -> str:
        """Effect, or number of the rig, that it belongs to; "" of B and beta_e."""
        effect, dot, _ = self.name.partition(".")
        return self.name if self.of_rig else effect if dot else ""

    @property
    def symbol(self) -> str:
        """Its name within the effect."""
        return self.name.rpartition(".")[2]

    @property
    def of_rig(self) -> bool:
        """Tell whether it is a number of the rig."""
        return self.name.startswith("rig.")

    def inward(self, value: float) -> float:
        """Return the fitted coordinate of a value."""
        return float(np.log(max(value, 1e-300))) if self.log else value

    def at_bound(self, value: float) -> bool:
        """Tell whether a value stands on one of the bounds."""
        reach = 1e-6 * (self.upper - self.lower)
        return not self.lower + reach < value < self.upper - reach

    def outward(self, coordinate: float) -> float:
        """Return the value of a coordinate, kept within the bounds."""
        value = float(np.exp(min(coordinate, 600.0))) if self.log else coordinate
        return min(max(value, self.lower), self.upper)


@dataclass(frozen=True)
class Fit:
    """A fitted model; immutable."""

    theta: np.ndarray  # parameters of the equations
    active: np.ndarray  # effects that are active
    free: tuple[Free, ...]  # what was fitted
    unknowns: Unknowns  # deviations of the unexplained force, flow and speed
    gains: np.ndarray  # of the filter
    e: np.ndarray  # (N, c) innovations of the counted samples, SI
    s: np.ndarray  # (c, c) their covariance
    log_likelihood: float  # of the innovations plus the prior's exponent
    covariance: np.ndarray  # (k, k) of what was fitted, in its coordinates
    # Effects of the catalogue that the fit has, in the order in which they were found; small
    # timing errors that every record has are active but not named
    named: tuple[str, ...] = ()
    converged: bool = True  # False where the steps ran out

    def value(self, name: str) -> float:
        """Return a fitted parameter by name."""
        return float(self.theta[next(f.place for f in self.free if f.name == name)])

    def stddev(self, name: str) -> float:
        """Return the standard deviation of a fitted parameter, in its unit."""
        i = next(i for i, f in enumerate(self.free) if f.name == name)
        sigma = float(np.sqrt(max(self.covariance[i, i], 0.0)))
        return sigma * abs(self.value(name)) if self.free[i].log else sigma


def likeliest(fits: Iterable[Fit], within: float = ties.GUESS) -> Fit:
    """Return the likeliest of some fits, the first of those that are the same ``within``."""
    return ties.best(fits, lambda fit: fit.log_likelihood, within=within)


@lru_cache(maxsize=1)
def workers() -> ThreadPoolExecutor:
    """Return the threads on which filters run; the compiled code leaves the lock."""
    return ThreadPoolExecutor(  # a run may go astray: what is no number shows in its likelihood
        len(os.sched_getaffinity(0)), "mismatch",
        partial(np.seterr, over="ignore", invalid="ignore", divide="ignore"))


def spread(function: Callable, items: Iterable) -> list:
    """Map over all cores; within a worker, which must not wait for its own pool, in turn."""
    if threading.current_thread().name.startswith("mismatch"):
        return [function(item) for item in items]
    context = copy_context()  # of the units in which sentences are written
    return list(workers().map(lambda item: context.copy().run(function, item), items))


def innovations(experiment: Experiment, theta: np.ndarray, active: np.ndarray,
                gains: np.ndarray) -> np.ndarray:
    """Return the innovations of the used channels at the counted samples, (N, c); NaN if none."""
    return experiment.counted([filtered(experiment, stretch, theta, active, gains)[0]
                               for stretch in experiment.stretches])[:, experiment.columns]


def filtered(experiment: Experiment, stretch, theta, active, gains, states: bool = False,
             free: np.ndarray | None = None, begin=None) -> tuple[np.ndarray, np.ndarray]:
    """Filter one stretch; returns all innovations (n, N_OUTPUTS) and the states, if wanted.

    ``free`` (n,) marks samples that correct nothing; ``begin`` is the stretch that tells the
    state at the start, if it is another.
    """
    n = len(stretch)
    e = np.empty((n, N_OUTPUTS))
    role = np.zeros(n) if stretch.loose is None else stretch.loose.copy()
    if free is not None:
        role[free] = FREE
    kept = np.empty((n if states else 0, N_FILTERED))
    experiment.work.add(innovate(
        Record(experiment.mode, experiment.held, experiment.hears, float(stretch.start), stretch.z,
               stretch.u, (stretch.p1, stretch.p2), role),
        Step(experiment.dt, experiment.steps), theta, active,
        Correction(gains, decay_of(experiment)),
        actuator_of(start_of(experiment, stretch if begin is None else begin,
                             circuit_of(theta, active)),
                    turned_memory(stretch.begins_at)), e, kept))
    return e, kept


def free_run(experiment: Experiment, stretch, fit: Fit) -> np.ndarray:
    """Return what the model shows on a stretch, running free from its start, (n, N_OUTPUTS)."""
    zero = replace(stretch, z=np.zeros_like(stretch.z))
    return -filtered(experiment, zero, fit.theta, fit.active, fit.gains,
                     free=np.ones(len(stretch), dtype=np.bool_), begin=stretch)[0]


def start_of(experiment: Experiment, stretch, w: np.ndarray) -> np.ndarray:
    """Return the state with which a stretch begins: what is measured, less the sensors' errors.

    A filter is given twice the noise of the pressures to begin with.  What a sensor errs by is
    far more, and their mean, which nothing but leakage and make-up changes, keeps it for long.

    ``w`` : (N_CIRCUIT,) circuit of the model: scales, offsets and drifts of the sensors.
    """
    charge = experiment.settings.rig.charge_pressure
    x, _, p1, p2, omega = stretch.first
    meant = np.array([true_position(x, w), true_pressure(p1, "p1", w, stretch.start),
                      true_pressure(p2, "p2", w, stretch.start), omega])
    x, p1, p2, omega = np.where(np.isfinite(meant), meant, (0.0, charge, charge, 0.0))
    y = new_state(x, p1, p2)
    y[1], y[4] = true_position(stretch.rise, w) / experiment.dt, omega
    return y


def covariance_of(e: np.ndarray) -> np.ndarray:
    """Return S of the innovations, (c, c); pairs with a missing channel are left out."""
    good = np.where(np.isfinite(e), np.clip(e, -1e60, 1e60), 0.0)  # a run that went astray
    count = np.isfinite(e).astype(float)
    return (good.T @ good) / np.maximum(count.T @ count, 1.0)


def log_likelihood_of(e: np.ndarray) -> float:
    """Return -(N/2) log det S, per channel scaled with how often it was measured."""
    s = covariance_of(e)
    scale = np.sqrt(np.diag(s))
    if not np.isfinite(scale).all() or (scale <= 0).any() or (scale > 1e29).any():
        return -np.inf
    share = np.isfinite(e).sum(axis=0)
    correlation = s / np.outer(scale, scale)
    sign, logdet = np.linalg.slogdet(correlation)
    if sign <= 0:
        return -np.inf
    return float(-np.sum(share * np.log(scale)) - 0.5 * share.max() * logdet)


def whitener(s: np.ndarray) -> np.ndarray:
    """Return W with W S W' = 1, (c, c).

    A run that went astray has innovations that are one curve in all channels; rounding then makes
    their S singular, or worse.
    """
    scale = np.sqrt(np.diag(s))
    correlation = s / np.outer(scale, scale) + SINGULAR * np.eye(len(s))
    return np.linalg.inv(np.linalg.cholesky(correlation)) / scale


def prior_exponent(free: Sequence[Free], theta: np.ndarray) -> float:
    """Return the exponent of the prior at theta, <= 0."""
    return -0.5 * sum(((f.inward(theta[f.place]) - f.prior) / f.spread) ** 2 for f in free)


def sensitivities(experiment: Experiment, active: np.ndarray, gains: np.ndarray, e: np.ndarray,
                  moved: Iterable[tuple[np.ndarray, float]]) -> list[np.ndarray]:
    """Return (e(theta') - e) / step for each (theta', step), on all cores, (N, c) each."""
    def one(item):
        other, step = item
        return (innovations(experiment, other, active, gains) - e) / step

    return spread(one, moved)


def step_of(f: Free, theta: np.ndarray, log_step: float) -> tuple[np.ndarray, float]:
    """Return theta with one parameter moved by a small step, and the step's length.

    ``log_step`` : of a logarithm (:attr:`Experiment.log_step`).
    """
    now = f.inward(theta[f.place])
    step = 1e-3 * f.spread if not f.log else log_step
    step = max(step, 1e-5 * abs(now)) if not f.log else step
    other = theta.copy()
    if f.outward(now + step) >= f.upper:
        step = -step
    other[f.place] = f.outward(now + step)
    return other, f.inward(other[f.place]) - now


def step_within(matrix: np.ndarray, gradient: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return the step s within ``bounds`` (k, 2) with the largest g's - s'Ms/2, (k,).

    With M = R'R that is the least |R s - R'^-1 g| within them: bounded-variable least squares
    (Stark and Parker 1995).  To stop what crosses a bound and solve for the rest is not the same:
    in a valley all may cross that need not.
    """
    inside = np.linalg.solve(matrix, gradient)
    low, high = np.minimum(bounds[:, 0], 0.0), np.maximum(bounds[:, 1], 0.0)
    if np.all((inside >= low) & (inside <= high)):
        return inside
    from scipy.optimize import lsq_linear  # a fifth of the start of a command

    root = np.linalg.cholesky(matrix).T
    wide = np.maximum(high, low + np.finfo(float).tiny)
    found = lsq_linear(root, np.linalg.solve(root.T, gradient), (low, wide), "bvls", tol=1e-12,
                       max_iter=EXCHANGES * len(gradient))
    return np.clip(found.x, low, high)


def remade(experiment: Experiment, fit: Fit, **changes) -> Fit:
    """Return a fit with some of its fields changed, not yet refitted."""
    made = replace(fit, converged=False, **changes)
    return with_unknowns(experiment, replace(made, covariance=np.zeros((len(made.free),) * 2)))


def with_unknowns(experiment: Experiment, fit: Fit, unknowns: Unknowns | None = None) -> Fit:
    """Return the same parameters under other unknowns: new gains, innovations, likelihood.

    Parameters that no filter can follow have a likelihood of zero.

    ``experiment`` : also another one than the fit was made on.
    ``unknowns`` : without them the fit's own.
    """
    unknowns = unknowns or fit.unknowns
    try:
        gains = gains_of(experiment, fit.theta, fit.active, unknowns)
    except np.linalg.LinAlgError:
        return replace(fit, unknowns=unknowns, log_likelihood=-np.inf)
    e = innovations(experiment, fit.theta, fit.active, gains)
    return replace(fit, unknowns=unknowns, gains=gains, e=e, s=covariance_of(e),
                   log_likelihood=log_likelihood_of(e) + prior_exponent(fit.free, fit.theta))
