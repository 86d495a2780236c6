"""One effect in place of two: a first guess and what it lacked may be one other effect."""

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

from eha_monitor.mismatch.experiment import Experiment
from eha_monitor.mismatch.fit import Fit, spread
from eha_monitor.mismatch.screen import Start, own_sizes, possible, starts_of
from eha_monitor.mismatch.search import completed, settle, with_effect, without_effect
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import effect_values


def merged(experiment: Experiment, fit: Fit, demanded: Callable[[Fit, str], float]) -> Fit | None:
    """Return the model with one effect in place of two of a balance, or None if none will do.

    Asymmetric friction is Coulomb friction and a load to a search that takes one after the other;
    presliding friction is a Coulomb friction and a second, softer one.

    Parameters
    ----------
    demanded : log units that an effect (second) must gain beside a model (first) to be named: the
        two must be better than the one by that much, or the one stands.
    """
    for pair in combinations(fit.named, 2):
        if CATALOGUE[pair[0]].balance != CATALOGUE[pair[1]].balance:
            continue
        bare = without_effect(experiment, without_effect(experiment, fit, pair[0]), pair[1])
        tried = [with_effect(bare, start, (1.0,) * len(own_sizes(start)))
                 for start in singles_of(experiment, fit, pair)]
        done = spread(lambda other: settle(experiment, other, 1, 6, False, 0.3), tried)
        best = max(done, key=lambda other: other.log_likelihood, default=None)
        if best is None:
            continue
        gone = next((name for name in pair if name not in best.named), pair[1])
        if fit.log_likelihood - best.log_likelihood < 2.0 * demanded(best, gone):
            best = settle(experiment, completed(best))
            if fit.log_likelihood - best.log_likelihood < demanded(best, gone):
                return best
    return None


def singles_of(experiment: Experiment, fit: Fit, pair: tuple[str, str]) -> list[Start]:
    """Return starts of what may stand for both: each of them, and what contains one of them."""
    found = []
    for name in NAMES:
        if (name in fit.named and name not in pair) or not (
                name in pair or set(CATALOGUE[name].contains) & set(pair)) or not possible(
                    name, experiment):
            continue
        bounds = {p.name: p for p in CATALOGUE[name].parameters}
        for start in starts_of(name, experiment):
            found.append(start)
            values = dict(start.values)
            for other in pair:
                if other == name or other in CATALOGUE[name].contains:
                    # What both have starts where it stands.
                    values |= {key: now for key, now in effect_values(fit.theta, other).items()
                               if key in values and bounds[key].lower <= now <= bounds[key].upper}
            found.append(replace(start, values=tuple(values.items())))
    return list(dict.fromkeys(found))
