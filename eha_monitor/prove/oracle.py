"""The oracle of a trial: a fit that is told effects and true rig, for what can be reached.

It runs as ``python -m eha_monitor.prove.oracle KEY CASE BAG CONFIG ANSWER``, once the
key is open.
"""

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment, experiment_of
from eha_monitor.mismatch.likelihood.fit import Fit, spread, with_unknowns
from eha_monitor.mismatch.name.base import with_effect, without_effect
from eha_monitor.mismatch.name.nominal import nominal
from eha_monitor.mismatch.name.polish import Slopes, polished
from eha_monitor.mismatch.name.refit import settled
from eha_monitor.mismatch.name.starts import Start, possible, starts_of
from eha_monitor.mismatch.show import held_out
from eha_monitor.output import write_text
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.prove.numbers import keys_off, number_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

RESOLUTION = "position_quantisation"  # has no parameter that is fitted
FIRST_STEPS = 5  # of a fit from each start, before the best is fitted to the end


def oracle(recordings: list[Recording], settings: Settings, truth: dict) -> dict:
    """Return what a fit reaches that knows which effects there are, and the rig's true numbers.

    Parameters
    ----------
    recordings : with the same samples held out as in the diagnosis.
    settings : the nominal config.
    truth : the key's entry: ``effects`` with name and parameters, ``B``, ``beta_e``, ``rig_off``.

    Returns
    -------
    dict
        ``log_evidence`` effect -> log units lost without it; ``over_simpler`` effect -> log units
        over the best effect that it contains; ``rig_evidence`` number of the rig that is off by
        three tolerances -> log units lost with the config's; ``signals`` as in the answer of
        ``diagnose``.  Effects outside the catalogue are left out.
    """
    off = truth.get("rig_off", ())
    experiment = experiment_of(recordings, corrected(settings, off))
    known = {one["name"]: one["parameters"] for one in truth["effects"]
             if one["name"] in CATALOGUE}
    names = tuple(name for name in known if name != RESOLUTION and possible(name, experiment))
    experiment, first = nominal(experiment)
    after = told(experiment, first, {name: known[name] for name in names},
                 {"B": truth["B"], "beta_e": truth["beta_e"]})
    evidence, simpler = {}, {}
    for name in names:
        without = first if names == (name,) else refitted(
            experiment, without_effect(experiment, after, name))
        evidence[name] = after.log_likelihood - without.log_likelihood
        beaten = [best_of(experiment, without, other, {}) for other in CATALOGUE[name].contains]
        if beaten:
            simpler[name] = after.log_likelihood - max(fit.log_likelihood for fit in beaten)
    for name in known:
        if name not in names:
            evidence[name] = (rounding(experiment, known[name]["q"]) if name == RESOLUTION
                              else 0.0)
    wrong = {number: without_number(experiment, after, experiment_of(recordings, corrected(
        settings, [one for one in off if number_of(one["key"]) != number])))
        for number in dict.fromkeys(map(number_of, keys_off(truth)))}
    signals = {name: asdict(fit) for name, fit in held_out.shown(experiment, first, after).items()}
    values = {name: after.value(name) for name in ("B", "beta_e")
              if any(f.name == name for f in after.free)}
    return {"log_evidence": evidence, "over_simpler": simpler, "signals": signals,
            "values": values, "rig_evidence": {
                number: after.log_likelihood - fit.log_likelihood
                for number, fit in wrong.items()}}


def corrected(settings: Settings, off: Sequence[dict]) -> Settings:
    """Return a config with the true values of some rig numbers."""
    values = {one["key"]: one["true"] for one in off}
    return settings.model_copy(update={"rig": settings.rig.model_copy(update=values)})


def without_number(experiment: Experiment, after: Fit, mistaken: Experiment) -> Fit:
    """Return the best fit with the same effects where the config has a number wrong."""
    mistaken = replace(mistaken, steps=experiment.steps, noise=experiment.noise)
    if not after.named:
        return nominal(mistaken)[1]
    theta = after.theta.copy()
    for i in range(s.N_BASE):
        if mistaken.theta[i] != experiment.theta[i]:
            theta[i] = mistaken.theta[i]
            if i == s.VOL_1:  # what the oil column yields is its volume over its bulk modulus
                theta[s.BETA_E] *= mistaken.theta[i] / experiment.theta[i]
    return refitted(mistaken, replace(after, theta=theta))


def told(experiment: Experiment, first: Fit, known: dict[str, dict], base: dict[str, float]
         ) -> Fit:
    """Return the best fit with these effects: from the key's values, and from the catalogue's."""
    if not known:
        return first
    theta = first.theta.copy()
    theta[s.B], theta[s.BETA_E] = base["B"], base["beta_e"]
    at_key = replace(first, theta=theta)
    for name, parameters in known.items():
        at_key = entered_at(at_key, true_start(experiment, name, parameters))
    found = [refitted(experiment, at_key)]
    fit, remaining = first, dict(known)
    while remaining:
        tried = [best_of(experiment, fit, name, parameters)
                 for name, parameters in remaining.items()]
        fit = max(tried, key=lambda one: one.log_likelihood)
        del remaining[fit.named[-1]]
    found.append(fit)
    return max(found, key=lambda one: one.log_likelihood)


def best_of(experiment: Experiment, fit: Fit, name: str, parameters: dict) -> Fit:
    """Return a fit with one more effect, the best over its starts."""
    starts = starts_of(name, experiment)
    if parameters:
        starts.append(true_start(experiment, name, parameters))
    quick = spread(lambda start: polished(experiment, entered_at(fit, start), Slopes(experiment),
                                          FIRST_STEPS), starts)
    return refitted(experiment, max(quick, key=lambda one: one.log_likelihood))


def refitted(experiment: Experiment, fit: Fit) -> Fit:
    """Return a fit carried to its optimum, from gains that suit where it begins."""
    return settled(experiment, with_unknowns(experiment, fit, fit.unknowns))


def entered_at(fit: Fit, start: Start) -> Fit:
    """Return a fit with an effect at its start, not refitted."""
    return with_effect(fit, start, (1.0,) * len(CATALOGUE[start.effect].sizes))


def true_start(experiment: Experiment, name: str, parameters: dict) -> Start:
    """Return the catalogue's start with the key's values where both have the symbol."""
    start = starts_of(name, experiment)[0]
    bounds = {p.name: p for p in CATALOGUE[name].parameters}

    def value(symbol: str, own: float) -> float:
        given = parameters.get(symbol)
        if not isinstance(given, int | float) or not math.isfinite(given):
            return own
        return min(max(float(given), bounds[symbol].lower), bounds[symbol].upper)

    return replace(start, values=tuple((symbol, value(symbol, own))
                                       for symbol, own in start.values))


def rounding(experiment: Experiment, step: float) -> float:
    """Return the evidence of a resolution of ``step`` m against the configured noise."""
    level = experiment.settings.noise.position
    return float(experiment.n * np.log(np.hypot(level, step / np.sqrt(12.0)) / level))


def main(arguments: list[str]) -> None:
    """Answer for one case."""
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings import load_settings

    key, case, bag, config, answer = arguments
    truth = next(one for one in json.loads(Path(key).read_text(encoding="utf-8"))["cases"]
                 if one["case"] == case)
    settings = load_settings(Path(config))
    found = oracle([read_recording(Path(bag), settings)], settings, truth)
    text = json.dumps(found, indent=1)
    write_text(Path(answer), text.replace("-Infinity", "null").replace("Infinity", "null")
               .replace("NaN", "null") + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
