"""The user's hypothesis, in the same ranking as all that has a name, by the same likelihood."""

from dataclasses import dataclass

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.diagnosis import NamedEffect, Value
from eha_monitor.mismatch.learn.learned import alone, bases_of, free_slot, score_of
from eha_monitor.mismatch.learn.validated import ValidatedTerm, missing_of, removed, size_of
from eha_monitor.mismatch.likelihood.fit import Fit, Free, remade, spread
from eha_monitor.mismatch.name.naming import Naming, beyond_form
from eha_monitor.mismatch.name.refit import looked, settled
from eha_monitor.mismatch.show.held_out import shown, worse
from eha_monitor.mismatch.show.model import robust
from eha_monitor.physics.contributions import ALL_NAMES, slot_of
from eha_monitor.physics.own_term import CONSTANTS, parsed
from eha_monitor.quantity import quantity
from eha_monitor.settings.hypothesis import Hypothesis

GOING = 2  # starts that are fitted to the end
SHARES = (0.15, 0.5, 0.85)  # of the way from bound to bound: where a parameter is tried besides


@dataclass(frozen=True)
class Tested:
    """A hypothesis fitted to a recording.

    Attributes
    ----------
    which : place of its own term; ``fit`` the model with it, ``without`` the best one without it.
    gained : log units over that one, prior odds included; ``temper`` of them counts.
    values : its parameters, SI.
    """

    hypothesis: Hypothesis
    which: int
    fit: Fit
    without: Fit
    gained: float
    temper: float
    values: dict[str, float]

    @property
    def probability(self) -> float:
        """Probability that it is there, against the best model without it."""
        return float(1.0 / (1.0 + np.exp(-np.clip(self.temper * self.gained, -600.0, 600.0))))

    def entry(self) -> dict:
        """Return it as an entry of a config's ``effects``."""
        return self.hypothesis.entry(self.values)


def tested(experiment: Experiment, naming: Naming, hypothesis: Hypothesis) -> Tested | None:
    """Fit a hypothesis beside what was named, or nothing; None where there is no room for it.

    Fits begin at its start, and where each parameter in turn is elsewhere between its bounds,
    beside the better of the two models without it.
    """
    which = free_slot(experiment)
    if which is None:
        return None
    without = ties.best(bases_of(experiment, naming), lambda fit: score_of(experiment, fit),
                        lambda fit: len(fit.named), ties.SAME_FIT)
    looks = ties.ordered(spread(lambda values: looked(experiment, entered(
        experiment, without, which, hypothesis, values)), starts_of(hypothesis)),
        lambda fit: fit.log_likelihood, within=ties.GUESS)
    best = ties.best(spread(lambda fit: settled(experiment, fit), looks[:GOING]),
                     lambda fit: score_of(experiment, fit), within=ties.SAME_FIT)
    best = alone(experiment, best)
    gained = score_of(experiment, best) + experiment.policy.effect - score_of(experiment, without)
    start = slot_of(which).start + CONSTANTS
    return Tested(hypothesis, which, best, without, gained, experiment.policy.temper, {
        key: float(best.theta[start + place])
        for key, place in parsed(hypothesis.expression).parameters.items()})


def starts_of(hypothesis: Hypothesis) -> list[dict[str, float]]:
    """Return where fits begin: parameter -> value, SI."""
    first = {key: one.start for key, one in hypothesis.parameters.items()}
    found = [first]
    for key, one in hypothesis.parameters.items():
        for share in SHARES:
            value = (one.lower * (one.upper / one.lower) ** share if one.log
                     else one.lower + share * (one.upper - one.lower))
            found.append({**first, key: value})
    return found


def entered(experiment: Experiment, base: Fit, which: int, hypothesis: Hypothesis,
            values: dict[str, float]) -> Fit:
    """Return a model with the hypothesis at some values of its parameters, not yet refitted."""
    expression, slot = parsed(hypothesis.expression), slot_of(which)
    theta, active = base.theta.copy(), base.active.copy()
    theta[slot], active[which] = expression.slot(hypothesis.adds, values), True
    free = list(base.free)
    for key, place in expression.parameters.items():
        one = hypothesis.parameters[key]
        at, name = slot.start + CONSTANTS + place, f"{ALL_NAMES[which]}.{key}"
        if one.log:
            free.append(Free(name, at, one.lower, one.upper, float(np.log(one.start)),
                             0.5 * float(np.log(one.upper / one.lower)), True))
        else:
            free.append(Free(name, at, one.lower, one.upper, one.start,
                             0.5 * (one.upper - one.lower)))
    return remade(experiment, base, theta=theta, active=active, free=tuple(free))


def supported(experiment: Experiment, unseen: Experiment, naming: Naming, test: Tested
              ) -> ValidatedTerm | None:
    """Return the model with a hypothesis, if it is likely and holds on unseen data."""
    judged = shown(unseen, test.without, test.fit)
    policy = experiment.policy
    if not test.probability > policy.likely or worse(judged, policy):
        return None
    # What takes away a small part only, and leaves the rest without a name, is no answer.
    rest = beyond_form(experiment, naming.before, test.fit, test.fit.unknowns)
    if rest > policy.likely and removed(judged) < policy.likely:
        return None
    fit = robust(experiment, test.fit)
    signals = shown(unseen, naming.before, fit)
    if worse(signals, policy):
        return None
    missing = missing_of(experiment, fit, test.which, test.hypothesis.balance)
    return ValidatedTerm(fit, signals, missing, test.gained, True, test.entry(),
                         test.hypothesis.name, effect=effect_of(test, fit, size_of(missing)))


def effect_of(test: Tested, fit: Fit, size: str) -> NamedEffect:
    """Return the record of a hypothesis that is supported; ``fit`` with its covariance."""
    hypothesis, own = test.hypothesis, ALL_NAMES[test.which]
    parameters = {key: Value(value, fit.stddev(f"{own}.{key}"), hypothesis.parameters[key].unit)
                  for key, value in test.values.items()}
    numbers = {key: quantity(value.value, value.unit, 3) for key, value in parameters.items()}
    sentence = hypothesis.sentence.format(**numbers) or (
        f"{hypothesis.name.replace('_', ' ')}: "
        + ", ".join(f"{key} = {text}" for key, text in numbers.items()))
    return NamedEffect(hypothesis.name, hypothesis.balance, sentence, parameters, test.gained, (),
                       hypothesis.expression, hypothesis.check, size, test.probability)
