"""The model with the named physics: parameters, sizes of effects, numbers of the rig, config."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from eha_monitor import ties
from eha_monitor.estimation.results import units_of
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.diagnosis import (
    Agreement,
    Fitted,
    NamedEffect,
    RigFinding,
    Value,
    beside_config,
    within_words,
)
from eha_monitor.mismatch.likelihood.along import contributed
from eha_monitor.mismatch.likelihood.fit import Fit, Free, sensitivities, step_of, whitener
from eha_monitor.mismatch.likelihood.invariance import consistent, directions, tangents
from eha_monitor.mismatch.name.columns import rig_free
from eha_monitor.mismatch.name.gates import at_bound
from eha_monitor.mismatch.name.naming import Naming
from eha_monitor.mismatch.name.nominal import with_rig
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import N_EFFECTS, circuit_of
from eha_monitor.physics.effects import CATALOGUE, LATE, NAMES
from eha_monitor.physics.parameters import effect_values, theta_of
from eha_monitor.quantity import quantity, share

BLOCK = 0.5  # s
TWICE = (("area_1", "area_2"), ("volume_1", "volume_2"))
ALIKE = 0.99  # correlation of their errors where both are the same number


def values_of(experiment: Experiment, fit: Fit) -> dict[str, Value]:
    """Return B and beta_e of a fit with their standard deviations."""
    wrong = {"B": of_the_areas(experiment)}
    return {name: Value(fit.value(name), float(np.hypot(
                fit.stddev(name), wrong.get(name, 0.0) * fit.value(name))), unit)
            for name, unit in units_of(experiment.settings.rig.motion).items()
            if any(f.name == name for f in fit.free)}


def of_the_areas(experiment: Experiment) -> float:
    """Return the share by which a force may be wrong that the areas make of the pressures.

    Every size of the force balance has that error, and no fit can know of it.
    """
    rig = experiment.settings.rig
    return rig.tolerance.log_spread("area_1") if experiment.by_pressures else 0.0


def fitted_of(fit: Fit) -> Fitted:
    """Return all fitted numbers with their joint covariance, in SI."""
    names = tuple(f.name for f in fit.free)
    values = np.array([fit.value(name) for name in names])
    scale = np.array([abs(value) if f.log else 1.0
                      for f, value in zip(fit.free, values, strict=True)])
    return Fitted(names, values, fit.covariance * np.outer(scale, scale))


def stated_stddev(experiment: Experiment, fit: Fit, key: str) -> float:
    """Return the standard deviation of a named effect's parameter (``effect.parameter``).

    A sensor's own lag of up to ``timing`` samples needs no name, so a time that has one is known
    no better: an error even within that limit has a standard deviation of limit/sqrt(3).
    """
    floor = experiment.policy.timing * experiment.dt / np.sqrt(3.0) if key in LATE else 0.0
    effect, _, symbol = key.partition(".")
    entry = CATALOGUE.get(effect)
    if entry is not None and entry.balance == "force" and symbol in {p.name for p in entry.sizes}:
        floor = of_the_areas(experiment) * fit.value(key)
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


def robust(experiment: Experiment, fit: Fit, of_rig: bool = True) -> Fit:
    """Return a fit whose covariance counts blocks of the record, not samples.

    Where a model is not exact to the last newton, its innovations pull the parameters one way in
    one part of the record and another way in the next.  With slopes d_b and innovations r_b of
    block b the covariance is H^-1 (sum g_b g_b') H^-1, g_b = d_b r_b (White 1982); the larger of
    this and the usual H^-1 is kept for each parameter.  To it comes what numbers of the rig that
    were not fitted leave open within their tolerances.

    ``of_rig`` : also what the rig's tolerances leave open; not between parts of one rig, which
        have its errors in common.
    """
    if not fit.free:
        return fit
    k = len(fit.free)
    whole = (*fit.free, *(f for f in with_rig(experiment, fit).free
                          if of_rig and f not in fit.free))
    w = whitener(fit.s)
    white = np.nan_to_num(fit.e) @ w.T
    slopes = sensitivities(experiment, fit.active, fit.gains, fit.e,
                           [step_of(f, fit.theta, experiment.log_step) for f in whole])
    d = np.stack([np.nan_to_num(slope) @ w.T for slope in slopes])
    along = tangents(whole, fit.theta, directions(whole, fit.theta, fit.active))
    d = consistent(d.reshape(len(whole), -1), along).reshape(d.shape)
    length = max(1, round(BLOCK / experiment.dt))
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

    A number of the rig is known to its tolerance, one standard deviation.  What the config gives
    both chambers alike is one number with one error: beta_e is no better known than the volume.
    """
    rig = experiment.settings.rig
    places = {f.symbol: i for i, f in enumerate(free) if f.of_rig}
    spread = np.array([f.spread for f in free])
    known = np.diag(spread**2)
    for one, other in TWICE:
        i, j = places.get(one), places.get(other)
        if i is not None and j is not None and getattr(rig, one) == getattr(rig, other):
            known[i, j] = known[j, i] = ALIKE * spread[i] * spread[j]
    return known


def replaced(experiment: Experiment, fit: Fit) -> list[str]:
    """Return the effects of the config whose place others have taken in a fit."""
    _, active = theta_of(experiment.settings.rig, experiment.settings.effects)
    return [name for name in experiment.settings.effects if name in NAMES
            and active[NAMES.index(name)] and not fit.active[NAMES.index(name)]]


def config_effects(experiment: Experiment, fit: Fit, names: tuple[str, ...],
                   own: tuple[str, dict] | None = None) -> dict[str, dict[str, float]]:
    """Return the ``effects:`` section: what the config had, those named, a term of its ``own``.

    As fitted, the config's within their tolerance.  A law of the config that a named one contains
    and has taken the place of is in it no more.
    """
    gone, fitted = replaced(experiment, fit), {one.name for one in fit.free}
    found = {name: dict(values) for name, values in experiment.settings.effects.items()
             if name not in gone}
    for name in (*found, *(name for name in fit.named if name in names)):
        if name not in NAMES:
            continue
        values = effect_values(fit.theta, name)
        found[name] = found.get(name, {}) | {
            p.name: float(min(max(values[p.name], p.lower), p.upper))
            for p in CATALOGUE[name].parameters
            if name in fit.named or f"{name}.{p.name}" in fitted}
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


SHARE = 0.98  # quantile of the size over the record that counts as its largest

# Circuit place -> SI unit, 1 for a share, and words.
_CIRCUIT_WORDS = {
    s.DRIVE_GAIN: ("1", " of the pump speed"), s.DRIVE_LAG: ("s", ""),
    s.SPEED_LIMIT: ("rad/s", ""), s.SLEW_LIMIT: ("rad/s²", ""),
    s.COMMAND_DELAY: ("s", ""), s.FEEDBACK_DELAY: ("s", ""), s.POSITION_DELAY: ("s", ""),
    s.PRESSURE_DELAY: ("s", ""), s.POSITION_SCALE: ("1", " of the position"),
    s.PLAY: ("m", ""), s.PRESSURE_SCALE_1: ("1", " of p1"),
    s.PRESSURE_SCALE_2: ("1", " of p2"), s.PRESSURE_OFFSET_1: ("Pa", " on p1"),
    s.PRESSURE_OFFSET_2: ("Pa", " on p2"), s.PRESSURE_DRIFT_1: ("Pa/s", " on p1"),
    s.PRESSURE_DRIFT_2: ("Pa/s", " on p2"),
}


def size_of(experiment: Experiment, fit: Fit, name: str, tracks: list[np.ndarray]) -> str:
    """Return how much a named effect does at its largest in this record, in words.

    tracks : :func:`along.filtered_tracks` of the fit.
    """
    alone = np.zeros(N_EFFECTS, dtype=bool)
    alone[NAMES.index(name)] = True
    found = []
    w = circuit_of(fit.theta, alone)
    for place, (unit, words) in _CIRCUIT_WORDS.items():
        value = abs(float(w[place]))
        if value != 0 and np.isfinite(value):
            found.append((share(value) if unit == "1" else quantity(value, unit, 3)) + words)
    rows = [contributed(experiment, fit.theta, track, (name,)) for track in tracks]
    most = np.quantile(np.abs(np.concatenate(rows)), SHARE, axis=0)
    flow = max(most[s.FLOW_1], most[s.FLOW_2], fit.theta[s.D_P] * most[s.SPEED]
               if np.isfinite(fit.theta[s.D_P]) else 0.0)
    unit = "N" if experiment.settings.rig.motion == "linear" else "N·m"
    if most[s.FORCE] > 0:
        found.append(quantity(most[s.FORCE], unit, 3))
    if flow > 0:
        found.append(quantity(flow, "m³/s", 3))
    if most[s.MASS] > 0:
        found.append(quantity(most[s.MASS], "kg" if unit == "N" else "kg·m²", 3))
    compliance = max(most[s.COMPLIANCE_1], most[s.COMPLIANCE_2]) * fit.theta[s.BETA_E]
    if compliance > 0:
        found.append(f"{share(compliance)} more compliance")
    volume = max(most[s.VOLUME_1], most[s.VOLUME_2])
    if volume > 0:
        found.append(f"{quantity(volume, 'm³', 3)} of chamber volume")
    return ", ".join(found)


SHOWN = 1e-3  # of a probability: what is closer reads the same, and stands as in the config


def rig_findings(experiment: Experiment, naming: Naming) -> tuple[RigFinding, ...]:
    """Return the numbers of the rig that a recording contradicts, the most certain first."""
    found = []
    for key in naming.wrong:
        configured, value, words = _told(experiment, naming.after, key)
        found.append(RigFinding(
            key, configured, value, naming.probability.get(f"rig.{key}", np.nan), words,
            naming.rivals.get(f"rig.{key}", ())))
    return tuple(ties.ordered(found, lambda finding: finding.probability, within=SHOWN))


def rig_within(experiment: Experiment, naming: Naming) -> tuple[RigFinding, ...]:
    """Return the numbers that a recording knows better than the config, within their tolerance.

    A pump that delivers 3 % less is no mismatch where its displacement is known to 3 %, but it is
    what the recording says.
    """
    fitted, found, policy = {f.name for f in naming.after.free}, [], experiment.policy
    for own in rig_free(experiment):
        key = own.symbol
        if own.name not in fitted or key in naming.wrong or at_bound(
                own, naming.after.value(own.name)):
            continue  # at the end of its tolerance it is no optimum, so no finding
        configured, value, words = _told(experiment, naming.after, key)
        spread = experiment.settings.rig.tolerance.log_spread(key)
        moved, sigma = np.log(value.value / configured), value.stddev / value.value
        if sigma < policy.informed * spread and abs(moved) > max(
                policy.sure * sigma, policy.informed * spread):
            found.append(RigFinding(key, configured, value, np.nan,
                                    f"{words}, {within_words(moved, spread)}"))
    return tuple(found)


def _told(experiment: Experiment, fit: Fit, key: str) -> tuple[float, Value, str]:
    """Return what the config says of a number, what the recording, and both in words."""
    name, rig = f"rig.{key}", experiment.settings.rig
    unit = type(rig).model_fields[key].json_schema_extra["unit"]
    value = Value(fit.value(name), fit.stddev(name), unit)
    configured = float(getattr(rig, key))
    return configured, value, beside_config(key, configured, value)
