"""The model with the named physics: its parameters, its config, what it says about health."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.diagnosis import Agreement, Fitted, NamedEffect, Value
from eha_monitor.mismatch.likelihood.fit import Fit, Free, sensitivities, step_of, whitener
from eha_monitor.mismatch.name.naming import Naming
from eha_monitor.mismatch.name.select import with_rig
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import effect_values
from eha_monitor.quantity import quantity

# Parameters in seconds that the sensors' own lags cannot be separated from.
TIMED = ("command_delay.T", "position_delay.T", "pressure_delay.T", "feedback_delay.T",
         "drive_lag.tau")
BLOCK = 0.5  # s
TWICE = (("area_1", "area_2"), ("volume_1", "volume_2"))
ALIKE = 0.99  # correlation of their errors where both are the same number


def values_of(experiment: Experiment, fit: Fit) -> dict[str, Value]:
    """Return B and beta_e of a fit with their standard deviations."""
    unit = "N·s/m" if experiment.settings.rig.motion == "linear" else "N·m·s/rad"
    known = {f.name for f in fit.free}
    found = {}
    if "B" in known:
        # Where the areas make the measured force, B has their error and no fit can know of it.
        made = experiment.by_pressures
        scale = experiment.settings.rig.tolerance.log_spread("area_1") if made else 0.0
        found["B"] = Value(fit.value("B"), float(np.hypot(
            fit.stddev("B"), scale * fit.value("B"))), unit)
    if "beta_e" in known:
        found["beta_e"] = Value(fit.value("beta_e"), fit.stddev("beta_e"), "Pa")
    return found


def fitted_of(fit: Fit) -> Fitted:
    """Return all fitted numbers with their joint covariance, in SI."""
    names = tuple(f.name for f in fit.free)
    values = np.array([fit.value(name) for name in names])
    scale = np.array([abs(value) if f.log else 1.0
                      for f, value in zip(fit.free, values, strict=True)])
    return Fitted(names, values, fit.covariance * np.outer(scale, scale))


def stated_stddev(experiment: Experiment, fit: Fit, key: str) -> float:
    """Return the standard deviation of a named effect's parameter (``effect.parameter``).

    A sensor's own lag of up to ``timing`` samples needs no name, so a delay that has one is known
    no better: an error even within that limit has a standard deviation of limit/sqrt(3).
    """
    floor = experiment.policy.timing * experiment.dt / np.sqrt(3.0) if key in TIMED else 0.0
    return float(np.hypot(fit.stddev(key), floor))


def in_doubt(known: dict[str, Value], agreement: tuple[Agreement, ...]) -> dict[str, Value]:
    """Return B and beta_e of a model that lacks something, as uncertain as its parts differ.

    What has no name pulls them one way in the slow half and another in the fast one; the
    innovations' own sigma knows nothing of it.
    """
    found = {}
    for name, value in known.items():
        apart = max((abs(part.after[name].value - value.value) for part in agreement
                     if name in part.after), default=0.0)
        found[name] = replace(value, stddev=float(np.hypot(value.stddev, apart)))
    return found


def between_models(known: dict[str, Value], naming: Naming) -> dict[str, Value]:
    """Return B and beta_e with the spread between the models that the recording cannot exclude.

    The variance of a mixture: that within the best model and that of the models' values about
    its own, each weighed as probable as its score says (Hoeting et al. 1999).
    """
    near = [(np.exp(-behind), fit) for _, fit, behind in naming.tried
            if np.exp(-behind) > naming.experiment.policy.rival]
    found = {}
    for name, value in known.items():
        there = [(weight, fit.value(name)) for weight, fit in near
                 if any(f.name == name for f in fit.free)]
        total = sum(weight for weight, _ in there)
        spread = sum(weight * (other - value.value) ** 2 for weight, other in there) / max(
            total, 1.0)
        found[name] = replace(value, stddev=float(np.hypot(value.stddev, np.sqrt(spread))))
    return found


def robust(experiment: Experiment, fit: Fit, block: float = BLOCK, of_rig: bool = True) -> Fit:
    """Return a fit whose covariance counts blocks of the record, not samples.

    Where a model is not exact to the last newton, its innovations pull the parameters one way in
    one part of the record and another way in the next.  With slopes d_b and innovations r_b of
    block b the covariance is H^-1 (sum g_b g_b') H^-1, g_b = d_b r_b (White 1982); the larger of
    this and the usual H^-1 is kept for each parameter.  To it comes what numbers of the rig that
    were not fitted leave open within their tolerances.

    Parameters
    ----------
    block : length of a block, s.
    of_rig : also what the rig's tolerances leave open; not between parts of one rig, which have
        its errors in common.
    """
    if not fit.free:
        return fit
    k = len(fit.free)
    whole = (*fit.free, *(f for f in with_rig(experiment, fit).free
                          if of_rig and f not in fit.free))
    w = whitener(fit.s)
    white = np.nan_to_num(fit.e) @ w.T
    slopes = sensitivities(experiment, fit.theta, fit.active, fit.gains, fit.e,
                           [step_of(f, fit.theta) for f in whole])
    d = np.stack([np.nan_to_num(slope) @ w.T for slope in slopes])
    length = max(1, round(block / experiment.dt))
    count = max(1, white.shape[0] // length)
    pulls = np.stack([np.einsum("kic,ic->k", part, r) for part, r in zip(
        np.array_split(d[:k], count, axis=1), np.array_split(white, count, axis=0),
        strict=True)])
    pulls = pulls - pulls.mean(axis=0)
    information = np.einsum("kic,lic->kl", d, d)
    bread = posterior_covariance(experiment, fit.free, information[:k, :k])
    # Of few blocks not all numbers cost one: priors hold some.
    meat = pulls.T @ pulls * count / max(count - k, 0.5 * count)
    sandwich = bread @ meat @ bread
    scale = np.sqrt(np.maximum(np.diag(sandwich) / np.maximum(np.diag(bread), 1e-300), 1.0))
    # What the recording says little of stayed at the config's; its tolerance is B's as well.
    loose = posterior_covariance(experiment, whole, information)[:k, :k] - bread
    return replace(fit, covariance=bread * np.outer(scale, scale) + loose)


def posterior_covariance(experiment: Experiment, free: Sequence[Free], information: np.ndarray
                         ) -> np.ndarray:
    """Return the covariance of numbers with a prior and the information of data, (k, k)."""
    both = information + np.linalg.inv(prior_covariance(experiment, free))
    unit = 1.0 / np.sqrt(np.diag(both))  # newtons beside square metres per pascal second
    return np.linalg.pinv(both * np.outer(unit, unit), hermitian=True) * np.outer(unit, unit)


def prior_covariance(experiment: Experiment, free: Sequence[Free]) -> np.ndarray:
    """Return what is known of some numbers beforehand, (k, k) in the fitted coordinates.

    A number of the rig is known to its tolerance, one standard deviation; the search holds it
    closer, so that names compete.  What the config gives both chambers alike is one number with
    one error: beta_e is no better known than the volume.
    """
    tolerance, rig = experiment.settings.rig.tolerance, experiment.settings.rig
    places = {f.symbol: i for i, f in enumerate(free)
              if f.of_rig}
    spread = np.array([f.spread for f in free])
    for key, i in places.items():
        spread[i] = max(spread[i], tolerance.log_spread(key))
    known = np.diag(spread**2)
    for one, other in TWICE:
        i, j = places.get(one), places.get(other)
        if i is not None and j is not None and getattr(rig, one) == getattr(rig, other):
            known[i, j] = known[j, i] = ALIKE * spread[i] * spread[j]
    return known


def config_effects(experiment: Experiment, fit: Fit, names: tuple[str, ...],
                   own: tuple[str, dict] | None = None) -> dict[str, dict[str, float]]:
    """Return the ``effects:`` section: what the config had, those named, a term of its ``own``."""
    found = {name: dict(values) for name, values in experiment.settings.effects.items()}
    for name in (name for name in fit.named if name in names):
        values = effect_values(fit.theta, name)
        found[name] = {p.name: float(min(max(values[p.name], p.lower), p.upper))
                       for p in CATALOGUE[name].parameters}
    if own is not None:
        (plain, entry), more = own, 2
        name = plain
        while name in found:
            name, more = f"{plain}_{more}", more + 1
        found[name] = dict(entry)
    return found


def quantised(experiment: Experiment) -> NamedEffect | None:
    """Return the encoder's resolution as an effect, where the config knows of none so coarse.

    A rounding error has no parameter to fit: the step is read off the data.
    """
    step = experiment.position_step
    levels = experiment.settings.noise
    known = max(levels.position_resolution,
                experiment.settings.simulation.noise.position_resolution)
    ratio = step / np.sqrt(12.0) / levels.position
    # Rounding that makes the noise larger by a share that counts is worth a name.
    if step <= 1.5 * known or np.hypot(1.0, ratio) <= 1.0 + experiment.policy.worse:
        return None
    entry = CATALOGUE["position_quantisation"]
    against = 0.5 * experiment.n * np.log1p(ratio**2)
    return NamedEffect("position_quantisation", entry.balance, entry.said({"q": step}),
                       {"q": Value(step, 0.0, "m")}, float(against), (), entry.equation,
                       entry.rig_check, quantity(step, "m", 3))
