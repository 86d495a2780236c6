"""The oracle of a trial: a fit that knows the effects, for what can be reached.

It knows which effects there are, with their values, and which numbers of the rig are beyond
their tolerance.  Within it nobody knows a number, and no more does the oracle: as in the diagnosis
it is fitted with the prior of its tolerance, beside the effects and without them.  So an effect
that the tolerances hide (a drive gain of 0.5 % beside a position gain known to 3 %) is none that
can be found.

It runs as ``python -m eha_monitor.prove.oracle KEY CASE BAG CONFIG ANSWER``, once the
key is open.
"""

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment, experiment_of
from eha_monitor.mismatch.likelihood.fit import Fit, Free, remade, spread, with_unknowns
from eha_monitor.mismatch.name.columns import columns_at, effects_of, rig_free
from eha_monitor.mismatch.name.nominal import nominal
from eha_monitor.mismatch.name.refit import ROUGH_STEPS, ROUGHLY, Slopes, at_level, polished, wide
from eha_monitor.mismatch.name.starts import (
    Start,
    continuing,
    needs,
    possible,
    sharing,
    starts_of,
    with_effect,
    without_effect,
)
from eha_monitor.mismatch.show import held_out
from eha_monitor.output import finite, write_json
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import effect_values
from eha_monitor.prove.score import NEAR, errors_of, keys_off, number_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

RESOLUTION = "position_quantisation"  # has no parameter that is fitted
FIRST_STEPS = 5  # of a fit from each start, before the best is fitted to the end
ROUNDS, GAINED = 10, 0.5  # slopes are taken afresh until they gain less than so many log units
EXACT = 0.02  # of an evidence: what a fit that is far behind may still lack


@dataclass(frozen=True)
class RigNumbers:
    """The rig's numbers as nuisance parameters beside a model."""

    experiment: Experiment  # made with the config, not with the true rig
    # Numbers that are off by more than their tolerance allows, ``area`` for both of a pair:
    # their prior is wide
    wrong: frozenset[str] = frozenset()

    def free(self, named: Sequence[str]) -> tuple[Free, ...]:
        """Return the numbers that are fitted beside some effects: none that is one's twin."""
        policy = self.experiment.policy
        return tuple(wide(f, policy) if number_of(f.symbol) in self.wrong else f
                     for f in rig_free(self.experiment, named))

    def beside(self, fit: Fit) -> Fit:
        """Return a model with its numbers free, each within its bounds; not refitted."""
        numbers = self.free(effects_of(fit))
        inside = {f.place: f.outward(f.inward(fit.theta[f.place])) for f in numbers}
        theta = fit.theta.copy()
        for f in rig_free(self.experiment):  # the twin of an effect stays at the config's
            theta[f.place] = inside.get(f.place, self.experiment.theta[f.place])
        if s.VOL_1 in inside:  # what the oil column yields is its volume over its bulk modulus
            theta[s.BETA_E] *= theta[s.VOL_1] / fit.theta[s.VOL_1]
        return remade(self.experiment, fit, theta=theta, free=without_numbers(fit).free + numbers)

    def fitted(self, *starts: Fit, aim: float = -np.inf) -> Fit:
        """Return the best optimum over some starts; those that fall behind are not carried on.

        ``aim`` : likelihood of the complete model: what is far below it need not be exact.
        """
        fits = list(starts)
        while len(fits) > 1:
            fits = sorted(spread(self.closer, fits), key=lambda one: -one.log_likelihood)
            fits = fits[:(len(fits) + 1) // 2]
        fit = fits[0]
        for _ in range(ROUNDS):
            before, fit = fit.log_likelihood, self.closer(fit)
            least = max(GAINED, EXACT * (aim - fit.log_likelihood)) if np.isfinite(before) else 0.0
            if not fit.log_likelihood > before + least:
                break
        return fit

    def lacking(self, fit: Fit, aim: float) -> Fit:
        """Return the best optimum of a model that lacks something, from where it was complete.

        Under the small unknowns of a complete model it may run away, under those that it asks for
        it may stay where it is, and what the other numbers have to make up for may lie across a
        hill: it also begins with all of them at the config's.
        """
        theta = fit.theta.copy()
        for f in rig_free(self.experiment):
            theta[f.place] = self.experiment.theta[f.place]
        start = self.beside(fit)
        return self.fitted(start, at_level(self.experiment, start),
                           self.beside(replace(fit, theta=theta)), aim=aim)

    def closer(self, fit: Fit) -> Fit:
        """Return a model nearer to its optimum: gains and slopes from here, then other unknowns.

        Along a ridge of numbers slopes from elsewhere would end too early.
        """
        fit = max(fit, with_unknowns(self.experiment, fit), key=lambda one: one.log_likelihood)
        if np.isfinite(fit.log_likelihood):
            fit = polished(self.experiment, fit, self.slopes(fit), ROUGH_STEPS, ROUGHLY)
        return at_level(self.experiment, fit) if np.isfinite(fit.log_likelihood) else fit

    def slopes(self, fit: Fit) -> Slopes:
        """Return the slopes of all that a model fits, in one pass."""
        return Slopes(self.experiment, fit, columns_at(self.experiment, fit, unnamed=False,
                                                       suspects=False))


def oracle(recordings: list[Recording], settings: Settings, truth: dict) -> dict:
    """Return what a fit reaches that knows which effects and wrong rig numbers there are.

    Parameters
    ----------
    recordings : with the same samples held out as in the diagnosis.
    settings : the nominal config.
    truth : the key's entry: ``effects`` with name and parameters, ``B``, ``beta_e``, ``rig_off``.

    Returns
    -------
    dict
        ``log_evidence`` effect -> log units lost without it, the rig's numbers within their
        tolerances; ``over_simpler`` effect -> log units over the best effect that it contains;
        ``rig_evidence`` number of the rig that is off by three tolerances -> log units lost where
        it has to stay within its own; ``signals`` as in the answer of ``diagnose``.  Effects
        outside the catalogue are left out.
    """
    experiment, first = nominal(experiment_of(recordings, settings))
    rig = RigNumbers(experiment, frozenset(
        number for number, error in errors_of(truth).items() if error >= NEAR))
    known = {one["name"]: one["parameters"] for one in truth["effects"]
             if one["name"] in CATALOGUE}
    names = tuple(name for name in known if name != RESOLUTION and possible(name, experiment))
    after = first
    if names or rig.wrong:
        after = fit_of_truth(rig, first, {name: known[name] for name in names}, truth)
    aim = after.log_likelihood
    without = {name: rig.lacking(without_effect(experiment, after, name), aim) for name in names}
    within = {number: replace(rig, wrong=rig.wrong - {number}).lacking(after, aim)
              for number in dict.fromkeys(map(number_of, keys_off(truth)))}
    # The model with all holds each of these, so it is no worse than any.
    best = max(fit.log_likelihood for fit in (after, *without.values(), *within.values()))
    evidence = {name: rounding(experiment, known[name]["q"]) if name == RESOLUTION else 0.0
                for name in known if name not in names}
    evidence |= {name: best - fit.log_likelihood for name, fit in without.items()}
    simpler = {}
    for name in names:
        beaten = [instead(rig, after, name, other, without[name]).log_likelihood
                  for other in CATALOGUE[name].contains]
        if beaten:
            simpler[name] = best - max(without[name].log_likelihood, *beaten)
    signals = {name: asdict(fit) for name, fit in held_out.shown(experiment, first, after).items()}
    values = {name: after.value(name) for name in ("B", "beta_e")
              if any(f.name == name for f in after.free)}
    return {"log_evidence": evidence, "over_simpler": simpler, "signals": signals,
            "values": values, "rig_evidence": {
                number: best - fit.log_likelihood for number, fit in within.items()}}


def fit_of_truth(rig: RigNumbers, first: Fit, known: dict[str, dict], truth: dict) -> Fit:
    """Return the best fit with all effects, from the key's values.

    The true numbers of the rig are a start, no more.  Where that leaves something, since key and
    catalogue have other symbols or laws, also from the best of the catalogue's starts.
    """
    experiment = rig.experiment
    theta = first.theta.copy()
    theta[s.B], theta[s.BETA_E] = truth["B"], truth["beta_e"]
    true = {f"rig.{one['key']}": one["true"] for one in truth.get("rig_off", ())}
    for f in rig.free(tuple(known)):
        theta[f.place] = true.get(f.name, theta[f.place])
    start_fit = replace(first, theta=theta)
    starts = {name: true_start(experiment, name, parameters) for name, parameters in known.items()}
    for start in starts.values():
        start_fit = entered_at(start_fit, start)
    fit = rig.fitted(at_level(experiment, rig.beside(start_fit)))
    # Does it need more unknowns than every right one may, or can it not be followed?
    if not known or (np.isfinite(fit.log_likelihood)
                     and not needs(experiment, fit, experiment.policy.few)):
        return fit
    for name, start in starts.items():
        start_fit = looked(rig, without_effect(experiment, start_fit, name),
                       [start, *starts_of(name, experiment)])
    other = rig.fitted(at_level(experiment, rig.beside(start_fit)), aim=fit.log_likelihood)
    return max(fit, other, key=lambda one: one.log_likelihood)


def instead(rig: RigNumbers, after: Fit, name: str, other: str, without: Fit) -> Fit:
    """Return the best fit with a simpler effect in the place of one.

    ``without`` : the fit with neither; its unknowns suit what is wrong.
    """
    starts = starts_of(other, rig.experiment)
    starts.append(continuing(starts[0], effect_values(after.theta, name)))
    start_fit = replace(without_effect(rig.experiment, after, name), unknowns=without.unknowns)
    return rig.fitted(rig.beside(looked(rig, start_fit, starts)), aim=after.log_likelihood)


def looked(rig: RigNumbers, fit: Fit, starts: Sequence[Start]) -> Fit:
    """Return a fit with an effect at the best of its starts, after a few steps from each.

    The rig's numbers stay where they are.
    """
    fit = without_numbers(fit)

    def quick(start: Start) -> Fit:
        one = with_unknowns(rig.experiment, entered_at(fit, start), fit.unknowns)
        return polished(rig.experiment, one, rig.slopes(one), FIRST_STEPS, ROUGHLY)

    return max(spread(quick, starts), key=lambda one: one.log_likelihood)


def without_numbers(fit: Fit) -> Fit:
    """Return a fit with the rig's numbers held where they are."""
    free = tuple(f for f in fit.free if not f.of_rig)
    return replace(fit, free=free, covariance=np.zeros((len(free),) * 2))


def entered_at(fit: Fit, start: Start) -> Fit:
    """Return a fit with an effect at its start, not refitted."""
    return with_effect(fit, start, (1.0,) * len(CATALOGUE[start.effect].sizes))


def true_start(experiment: Experiment, name: str, parameters: dict) -> Start:
    """Return the catalogue's start with the key's values where both have the symbol."""
    return sharing(starts_of(name, experiment)[0], {
        symbol: float(value) for symbol, value in parameters.items()
        if isinstance(value, int | float) and math.isfinite(value)})


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
    write_json(answer, finite(found))


if __name__ == "__main__":
    main(sys.argv[1:])
