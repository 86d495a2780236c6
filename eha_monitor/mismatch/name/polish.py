"""A fit carried to its optimum with few runs of the filter."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment, damping_steps
from eha_monitor.mismatch.likelihood.fit import (
    Fit,
    covariance_of,
    innovations,
    log_likelihood_of,
    prior_exponent,
    sensitivities,
    step_of,
    step_within,
    whitener,
)
from eha_monitor.mismatch.likelihood.invariance import at_prior
from eha_monitor.mismatch.name.columns import ALWAYS, Columns
from eha_monitor.mismatch.name.gram import under
from eha_monitor.physics.contributions import with_place
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import place_of
from eha_monitor.physics.signals import B

# Of a step: shorter first, because inside a threshold the direction is right and the length not.
SHARES = (1.0, 0.3, 0.1, 0.03)
COARSER = 3.0  # times the integration step, for differences
LARGEST = 1e100  # slope of an innovation that is a slope; its square must still be a number
ROUGHLY = 5.0  # log units: a tolerance at which slopes are not taken afresh
DAMPED, MOST_DAMPED = 1e-2, 1e2  # of the information: where a step has failed, and at most


def coarse(experiment: Experiment, active: np.ndarray) -> Experiment:
    """Return the experiment with integration steps that do for differences.

    A slope that is one per cent off leads to the same optimum; the innovations themselves are
    taken with the fine steps.  A seal turns over within such a step: it keeps the fine ones.
    """
    if len(with_place(active)):
        return experiment
    least = damping_steps(experiment.settings, 2.0 * experiment.theta[B], experiment.dt)
    steps = max(int(np.ceil(experiment.steps / COARSER)), int(np.ceil(0.75 * least)), 1)
    return replace(experiment, steps=min(steps, experiment.steps))


def keep_within(theta: np.ndarray, named: Sequence[str]) -> None:
    """Write laws within their limits: |dF| <= F_c.

    Beyond, a law is cut off: friction of F_c + dF in positive motion and of F_c - dF < 0 in
    negative motion is one of F_c + dF and of none.  Written as such, with the same sum and F_c =
    dF, it does the same, but a step leads back.
    """
    for name in named:
        for part, whole in CATALOGUE[name].within if name in CATALOGUE else ():
            at, of = place_of(f"{name}.{part}"), place_of(f"{name}.{whole}")
            if abs(theta[at]) > theta[of]:
                half = 0.5 * (abs(theta[at]) + theta[of])
                theta[at], theta[of] = np.copysign(half, theta[at]), half


class Slopes:
    """Slopes of the innovations that are at hand from a linearisation, under any gains."""

    def __init__(self, experiment: Experiment, fit: Fit | None = None,
                 columns: Columns | None = None):
        self.experiment, self.fit = experiment, fit
        self.places: dict[str, int] = {}
        self.spreads: list[float] = []
        own = []
        for i, column in enumerate(columns.what if columns else ()):
            if column.name in self.places:  # a number that is wrong stands there twice
                continue
            if column.free is not None and (column.owner == ALWAYS or column.variant < 0):
                self.places[column.name] = len(own)
                self.spreads.append(column.free.spread)
                own.append(1 + i)
        # These alone: all columns of a minute take a hundred megabytes.
        self.values = [part[:, :, own] for part in (columns.values if columns else ())]

    def of(self, fit: Fit) -> dict[str, np.ndarray]:
        """Return name -> (N, c) slope in the fitted coordinate, of what is known."""
        wanted = [f for f in fit.free if f.name in self.places]
        if not wanted:
            return {}
        places = [self.places[f.name] for f in wanted]
        parts = under(self.experiment, self.fit, [
            np.ascontiguousarray(part[:, :, places]) for part in self.values], fit.gains)
        whole = np.concatenate([part[stretch.counted] for part, stretch in zip(
            parts, self.experiment.stretches, strict=True)])
        usable = np.abs(whole).max(axis=(0, 1)) < LARGEST  # nor is NaN
        return {f.name: whole[:, :, i] / self.spreads[self.places[f.name]]
                for i, f in enumerate(wanted) if usable[i]}


def polished(experiment: Experiment, fit: Fit, slopes: Slopes, steps: int = 12,
             tolerance: float = 0.3) -> Fit:
    """Carry a fit to its optimum with held gains: Gauss-Newton, slopes brought up to date.

    Slopes come from the linearisation where it has them, else from differences; each step then
    corrects them by what it has seen (Broyden 1965), in the metric of the information.  They are
    taken afresh where a step fails.
    """
    return polished_on(experiment, fit, slopes.of(fit), steps, tolerance)[0]


def polished_on(experiment: Experiment, fit: Fit, known: dict[str, np.ndarray], steps: int,
                tolerance: float) -> tuple[Fit, dict[str, np.ndarray]]:
    """Return :func:`polished` from slopes that are known, name -> (N, c), and those at its end."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a run may go astray
        return _polished(experiment, fit, known, steps, tolerance)


def _polished(experiment: Experiment, fit: Fit, known: dict[str, np.ndarray], steps: int,
              tolerance: float) -> tuple[Fit, dict[str, np.ndarray]]:
    theta, free = fit.theta.copy(), fit.free
    e = innovations(experiment, theta, fit.active, fit.gains)
    best = log_likelihood_of(e) + prior_exponent(free, theta)
    if not np.isfinite(best):
        return replace(fit, e=e, log_likelihood=-np.inf), {}
    bounds = np.array([[f.inward(f.lower), f.inward(f.upper)] for f in free]).reshape(-1, 2)
    prior, weight = np.array([f.prior for f in free]), np.array([f.spread for f in free]) ** -2.0
    rough = coarse(experiment, fit.active)

    def taken(which: list[int]) -> None:
        if not which:
            return
        plain = innovations(rough, theta, fit.active, fit.gains)
        fresh = sensitivities(rough, fit.active, fit.gains, plain,
                              [step_of(free[i], theta, experiment.log_step) for i in which])
        for i, slope in zip(which, fresh, strict=True):
            d[i] = np.nan_to_num(slope)

    d = np.stack([known.get(f.name, np.zeros(e.shape)) for f in free])
    taken([i for i, f in enumerate(free) if f.name not in known])
    every = list(range(len(free)))
    fresh, damping, converged, left = not known, 1e-9, False, 1 if tolerance >= ROUGHLY else steps
    white = information = None
    for _ in range(steps):
        w = whitener(covariance_of(e))
        white = (np.nan_to_num(e) @ w.T).ravel()
        flat = (d @ w.T).reshape(len(free), -1)
        information = flat @ flat.T
        now = np.array([f.inward(theta[f.place]) for f in free])
        gradient = -(flat @ white) - weight * (now - prior)
        scale = np.sqrt(np.diag(information) + weight)
        matrix = (information + np.diag(weight)) / np.outer(scale, scale)
        if not np.isfinite(matrix).all():
            return replace(fit, log_likelihood=-np.inf), {}
        whole = step_within(matrix + damping * np.eye(len(free)), gradient / scale,
                            scale[:, None] * (bounds - now[:, None])) / scale
        improved = False
        for share in SHARES:
            step = share * whole
            other = theta.copy()
            for f, value in zip(free, now + step, strict=True):
                other[f.place] = f.outward(value)
            keep_within(other, fit.named)
            moved = innovations(experiment, other, fit.active, fit.gains)
            reached = log_likelihood_of(moved) + prior_exponent(free, other)
            if reached > best:
                improved = True
                break
        if not improved:
            scaled = scale * whole
            promised = float(gradient @ whole - 0.5 * scaled @ matrix @ scaled)
            if promised < tolerance or damping >= MOST_DAMPED or not (fresh or left):
                converged = promised < tolerance
                break
            if not fresh:
                taken(every)
                fresh, left, damping = True, left - 1, 1e-9
            else:  # the direction is not to be trusted either: towards the gradient's (Levenberg)
                damping = max(10.0 * damping, DAMPED)
            continue
        step = np.array([f.inward(other[f.place]) for f in free]) - now
        missed = np.nan_to_num(moved - e) - np.tensordot(step, d, axes=1)
        metric = scale**2 * step
        d += (metric / max(float(metric @ step), 1e-300))[:, None, None] * missed[None]
        gained, theta, e, best = reached - best, other, moved, reached
        damping = max(damping / 10.0, 1e-9)
        if gained < tolerance:
            if fresh or tolerance >= ROUGHLY:
                converged = True
                break
            taken(every)
            fresh = True
        else:  # near the optimum a step leaves fresh slopes as good as fresh
            fresh = fresh and gained < ROUGHLY
    # Where no recording can tell, what is known beforehand decides, and no slope's last digit.
    for other in at_prior(free, theta, fit.active):
        moved = innovations(experiment, other, fit.active, fit.gains)
        reached = log_likelihood_of(moved) + prior_exponent(free, other)
        if reached > best:
            theta, e, best = other, moved, reached
    covariance = fit.covariance
    if information is not None:
        try:  # in units of each parameter's own deviation: a leakage is 1e-12, a modulus 1e9
            covariance = np.linalg.inv((information + np.diag(weight)) / np.outer(
                scale, scale)) / np.outer(scale, scale)
        except np.linalg.LinAlgError:  # two parameters are one there: no model to be judged
            return replace(fit, e=e, log_likelihood=-np.inf), {}
    made = replace(fit, theta=theta, e=e, s=covariance_of(e), log_likelihood=best,
                   covariance=covariance, converged=converged)
    return made, {f.name: slope for f, slope in zip(free, d, strict=True)}
