"""The model with the named physics: its parameters, its config, what it says about health."""

import numpy as np

from eha_monitor.mismatch.diagnosis import NamedEffect, Value
from eha_monitor.mismatch.experiment import Experiment
from eha_monitor.mismatch.fit import Fit
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import place_of

COARSE = 3.0  # times the configured noise: an encoder step that the config does not know
NOTABLE = 0.02  # relative change of a health parameter that is worth a sentence


def values_of(experiment: Experiment, fit: Fit) -> dict[str, Value]:
    """Return B and beta_e of a fit with their standard deviations."""
    unit = "N·s/m" if experiment.settings.rig.motion == "linear" else "N·m·s/rad"
    known = {f.name for f in fit.free}
    found = {}
    if "B" in known:
        found["B"] = Value(fit.value("B"), honest(fit, "B"), unit)
    if "beta_e" in known:
        found["beta_e"] = Value(fit.value("beta_e"), honest(fit, "beta_e"), "Pa")
    return found


def honest(fit: Fit, name: str) -> float:
    """Return a standard deviation that counts blocks of the record, not samples.

    Where a model is not exact, innovations stay alike for a while and the samples are not
    independent; the variance of block sums tells by how much.
    """
    return fit.stddev(name) * np.sqrt(inflation(fit))


def inflation(fit: Fit, length: int = 50) -> float:
    """Return the largest variance ratio of block sums over the channels, at least 1."""
    blocks = len(fit.e) // length
    if blocks < 20:
        return 1.0
    e = np.nan_to_num(fit.e[: blocks * length])
    sums = e.reshape(blocks, length, -1).sum(axis=1)
    ratio = sums.var(axis=0) / np.maximum(length * e.var(axis=0), 1e-300)
    return float(max(1.0, ratio.max()))


def config_effects(experiment: Experiment, fit: Fit) -> dict[str, dict[str, float]]:
    """Return the ``effects:`` section: what the config had, and what was named."""
    found = {name: dict(values) for name, values in experiment.settings.effects.items()}
    for name in fit.named:
        found[name] = {}
        for p in CATALOGUE[name].parameters:
            value = float(fit.theta[place_of(f"{name}.{p.name}")])
            found[name][p.name] = float(min(max(value, p.lower), p.upper))
    return found


def quantised(experiment: Experiment) -> NamedEffect | None:
    """Return the encoder's resolution as an effect, where the config knows of none so coarse.

    A rounding error has no parameter to fit: the step is read off the data.
    """
    step = experiment.position_step
    levels = experiment.settings.noise
    known = max(levels.position_resolution,
                experiment.settings.simulation.noise.position_resolution)
    if step <= 1.5 * known or step / np.sqrt(12.0) <= COARSE * levels.position:
        return None
    entry = CATALOGUE["position_quantisation"]
    against = experiment.n * np.log(step / np.sqrt(12.0) / levels.position)
    return NamedEffect("position_quantisation", entry.balance, entry.statement.format(q=step),
                       {"q": Value(step, 0.0, "m")}, float(against), (), entry.equation,
                       entry.rig_check, f"{step * 1e6:.3g} µm")


def health_sentences(experiment: Experiment, before: dict[str, Value], after: dict[str, Value],
                     effects: tuple[NamedEffect, ...]) -> tuple[str, ...]:
    """Return in plain words what the mismatch did to the health estimates."""
    words = {"B": "B", "beta_e": "the effective bulk modulus"}
    found = []
    plant = [effect for effect in effects if effect.balance in ("force", "flow")] or list(effects)
    for name, first in before.items():
        if name not in after or not effects:
            continue
        then, unit = after[name].value, first.unit
        change = first.value - then
        if abs(change) < NOTABLE * abs(then) or abs(change) < 3.0 * after[name].stddev:
            continue
        cause = " and ".join(f"{effect.size} of {effect.name.replace('_', ' ')}".strip()
                             for effect in plant[:3])
        scale, shown = (1e6, "MPa") if name == "beta_e" else (1.0, unit)
        sense = "not wear" if name == "B" else "not the fluid"
        if change > 0:
            found.append(f"{words[name]} read {first.value / scale:.4g} {shown}; "
                         f"{change / scale:.3g} of it is {cause}, {sense}")
        else:
            found.append(f"{words[name]} read {first.value / scale:.4g} {shown}, "
                         f"{-change / scale:.3g} too little, because of {cause}")
    return tuple(found)


