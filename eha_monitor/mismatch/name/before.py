"""Before effects are named: on which windows, from which angle of the shaft, where a fit begins.

Names need a minute of rich motion, not an hour of it.  What each window says of what every model
fits is a Gram matrix of whitened slopes, the innovations themselves among them, so that a window
in which the model fails says something too; the windows are taken one by one whose log det
together is the largest (D-optimal, greedy).

No channel has the shaft's angle, so a ripple learned from one recording stands at another phase in
the next.  The likelihood of the config's model says which.

What least squares on the balances say is a place where a filter's fit begins.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import SHORTEST, Experiment, Stretch
from eha_monitor.mismatch.data.inputs import cut, most_informative
from eha_monitor.mismatch.likelihood.fit import Fit, likeliest, remade, spread, with_unknowns
from eha_monitor.mismatch.name.columns import columns_at
from eha_monitor.mismatch.name.gram import grams_of
from eha_monitor.mismatch.name.nominal import with_rig
from eha_monitor.mismatch.name.refit import looked, unfitted
from eha_monitor.mismatch.name.starts import (
    Start,
    config_free,
    possible,
    starts_of,
    with_effect,
)
from eha_monitor.physics.contributions import ALL_NAMES, slot_of
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.own_term import FIRST, KIND, LAST, OWN_NAMES, PHASE, TABLE, turns
from eha_monitor.physics.parameters import effect_values
from eha_monitor.physics.signals import B

WINDOW = 4_000  # samples
MOST = 24_000  # samples that effects are named on


def informative(experiment: Experiment, most: int = MOST, window: int = WINDOW) -> Experiment:
    """Return an experiment with the most informative windows; itself where it is short.

    ``most`` : samples that are kept; ``window`` samples in each window.
    """
    if experiment.n <= most:
        return experiment
    windows = [part for stretch in experiment.stretches
               for part in windows_of(stretch, experiment.dt, window)]
    if not windows:
        return experiment
    grams = spread(lambda one: information_of(experiment.only((one,))), windows)
    chosen = most_informative(grams, list(map(len, windows)), most, window)
    return experiment.only(tuple(windows[i] for i in chosen)) if chosen else experiment


def windows_of(stretch: Stretch, dt: float, window: int) -> list[Stretch]:
    """Return a stretch in windows of about ``window`` samples, equally long."""
    count = max(round(len(stretch) / window), 1)
    bounds = np.linspace(0, len(stretch), count + 1).astype(int)
    return [cut(stretch, first, last, dt) for first, last in pairwise(bounds)
            if (last - first) * dt >= SHORTEST]


def information_of(window: Experiment) -> np.ndarray:
    """Return the Gram matrix of a window at the config's model; empty where no filter runs."""
    try:
        fit = unfitted(window)
        if not np.isfinite(fit.log_likelihood):
            return np.zeros((0, 0))
        columns = columns_at(window, fit, unnamed=False, suspects=False)
        (gram,) = grams_of(window, fit, columns.values, [fit.unknowns])
    except (np.linalg.LinAlgError, ValueError):
        return np.zeros((0, 0))
    return gram.products if np.isfinite(gram.products).all() else np.zeros((0, 0))


TRIED = 192  # angles of a revolution: eight of each period of a pump of 24 teeth
FINER = 8  # angles between two of these


def at_its_angle(experiment: Experiment) -> Experiment:
    """Return an experiment whose terms of the shaft's angle begin where the recording does."""
    for name in OWN_NAMES:
        which = ALL_NAMES.index(name)
        if not experiment.active[which] or not turns(experiment.theta[slot_of(which)]):
            continue
        q = experiment.theta[slot_of(which)]
        period = q[LAST] - q[FIRST] if q[KIND] == TABLE else 2.0 * np.pi
        step = period / TRIED
        coarse = best_of(experiment, which, step * np.arange(TRIED))
        fine = coarse + step * np.linspace(-1.0, 1.0, 2 * FINER + 1)
        experiment = begun_at(experiment, which, best_of(experiment, which, fine))
    return experiment


def begun_at(experiment: Experiment, which: int, angle: float) -> Experiment:
    """Return an experiment in which one term begins at an angle, rad."""
    theta = experiment.theta.copy()
    theta[slot_of(which).start + PHASE] = angle
    return replace(experiment, theta=theta)


def best_of(experiment: Experiment, which: int, angles: np.ndarray) -> float:
    """Return the angle under which the recording is most likely, rad."""
    found = spread(lambda angle: unfitted(
        begun_at(experiment, which, angle)).log_likelihood, angles)
    return float(angles[ties.largest(found, ties.GUESS)])


@dataclass(frozen=True)
class FirstView:
    """What the balances name."""

    # Name -> parameters, SI, as in the config's section
    effects: Mapping[str, Mapping[str, float]]
    damping: float | None = None  # B beside them, N s/m (N m s/rad); None where they do not say

    def entered(self, experiment: Experiment, fit: Fit) -> Fit | None:
        """Return a nominal model with these effects in it, not refitted; None where it has none.

        Unknowns are those of a model that has not been fitted: those that the nominal model asks
        for stand for the effects.
        """
        theta = fit.theta.copy()
        for f in fit.free:
            if f.place == B and self.damping is not None:
                theta[B] = f.outward(self.damping)
        entered = with_effects(experiment, replace(fit, theta=theta), self.effects)
        if entered.named == fit.named:
            return None
        return with_unknowns(experiment, entered, unfitted(experiment).unknowns)


TIMES = (1.0, 0.3, 3.0)  # the config's size, where an effect of it is sought beyond its tolerance


def beyond_config(experiment: Experiment, nominal: Fit) -> Fit | None:
    """Return a nominal model in which effects of the config are as large as they may be.

    Those whose sizes end where their tolerance does are names then, from the likeliest of their
    starts; not fitted to the end.  None where there are none.
    """
    fit = nominal
    for name in sorted({f.owner for f in config_free(experiment)
                        if f.at_bound(nominal.theta[f.place])}):
        sizes = {p.name for p in CATALOGUE[name].sizes}
        own = effect_values(experiment.theta, name).items()
        starts = [Start(name, tuple((key, value * (times if key in sizes else 1.0))
                                    for key, value in own)) for times in TIMES]
        fit = likeliest(spread(lambda start, fit=fit: looked(
            experiment, remade(experiment, with_effect(fit, start, ()))),
            [*starts, *starts_of(name, experiment)]))
    return None if fit is nominal or not np.isfinite(fit.log_likelihood) else with_rig(
        experiment, fit)


def with_effects(experiment: Experiment, fit: Fit, effects: Mapping[str, Mapping[str, float]]
                 ) -> Fit:
    """Return a fit with the effects that it has not yet entered where they stand, not refitted.

    ``effects`` : name -> parameters, SI, as in the config's section.
    """
    for name, values in effects.items():
        if possible(name, experiment) and name not in fit.named:
            fit = with_effect(fit, Start(name, tuple(values.items())), ())
    return fit
