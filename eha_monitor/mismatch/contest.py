"""Contest of the named effects: each has to hold its place against those that came near it."""

from dataclasses import replace

from eha_monitor.mismatch.experiment import Experiment
from eha_monitor.mismatch.fit import Fit, spread
from eha_monitor.mismatch.screen import Start, own_sizes, starts_of
from eha_monitor.mismatch.search import (
    Candidate,
    Round,
    completed,
    settle,
    stiffened,
    with_effect,
    without_effect,
    yielding,
)
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import effect_values, place_of

SLACK, SLACK_SHARE = 6.0, 0.003  # rivals lie so near the best: log units, share of its gain
CONTENDING = 0.7  # of the taken effect's gain: who may yet take its place


def slack_of(gain: float) -> float:
    """Return how far behind the best a rival may lie, log units."""
    return max(SLACK, SLACK_SHARE * gain)


def comparable(experiment: Experiment, name: str, other: str) -> bool:
    """Tell whether two effects can explain one another's evidence at all.

    Where the balances' own errors are compared, what is left of one says nothing of another.
    """
    return not experiment.inverse or CATALOGUE[name].balance == CATALOGUE[other].balance


def contested(experiment: Experiment, fit: Fit, rounds: tuple[Round, ...],
              evidence: dict[str, float], rivals: dict[str, tuple[str, ...]]
              ) -> tuple[Fit, dict[str, float], dict[str, tuple[str, ...]]]:
    """Try the contenders of each named effect in its place, beside all the others.

    Returns the model that stays, the evidence of its effects, and who cannot be told from whom.
    """
    found = dict(rivals)
    for name in fit.named:
        tried = [(c.effect, start) for c in contenders(
                     rounds, fit, name, not experiment.inverse)
                 if comparable(experiment, name, c.effect)
                 for start in ways_in(experiment, substituted(experiment, fit, name, c))]
        done = spread(lambda item: settle(experiment, item[1], 1, 4, False, 0.3), tried)
        slack = slack_of(evidence[name])
        near: dict[str, Fit] = {}
        for (effect, _), other in zip(tried, done, strict=True):
            least = near[effect].log_likelihood if effect in near else fit.log_likelihood - slack
            if other.log_likelihood > least:
                near[effect] = other
        best = min([name, *near], key=lambda other: (
            0 if other in near and near[other].log_likelihood > fit.log_likelihood + slack else 1,
            CATALOGUE[other].rarity, other != name))
        group = tuple(other for other in (name, *near) if other != best
                      and best not in CATALOGUE[other].contains)
        if best != name:
            gained_by_swap = near[best].log_likelihood - fit.log_likelihood
            fit = settle(experiment, completed(near[best]))
            evidence = {best if key == name else key: value + (gained_by_swap if key == name
                                                               else 0.0)
                        for key, value in evidence.items()}
            found.pop(name, None)
        found[best] = group
    return fit, evidence, found


def ways_in(experiment: Experiment, fit: Fit) -> list[Fit]:
    """Return where to begin with what has just entered: as it is, and leaning on the model.

    Unknowns that had to stand for what was missing take most of what a right effect would show;
    and what the last one has to share its balance with took a shape that the former one left it,
    which may be too sharp to find back from: its shape begins again.
    """
    if not yielding(experiment, fit):
        return [fit]
    *others, last = fit.named
    theta, fitted = fit.theta.copy(), {f.name for f in fit.free}
    for name in (name for name in others
                 if CATALOGUE[name].balance == CATALOGUE[last].balance):
        shapes = {p.name for p in CATALOGUE[name].parameters} - {
            p.name for p in CATALOGUE[name].sizes}
        for key, value in starts_of(name, experiment)[0].values:
            if key in shapes and f"{name}.{key}" in fitted:
                theta[place_of(f"{name}.{key}")] = value
    found = [fit, stiffened(experiment, fit)]
    if (theta != fit.theta).any():
        found.append(stiffened(experiment, replace(fit, theta=theta)))
    return found


def contenders(rounds: tuple[Round, ...], fit: Fit, name: str, beside_all: bool = True
               ) -> list[Candidate]:
    """Return what may take an effect's place, best first.

    That is what came near it in the round in which it was found.  Where a balance has two named
    effects, also what else was tried in that balance, however far behind: of two that were
    missing, the first round takes one that is like both together (a root is like a line and a
    step), and only the second shows which they are.  And whatever would still gain beside the
    whole model in that balance: what takes its place would gain no less.  Not ``beside_all``:
    not that; in balances that are compared as they stand what still gains is a circuit's error.
    """
    balance = CATALOGUE[name].balance
    shared = sum(CATALOGUE[other].balance == balance for other in fit.named) > 1
    late = [c for step in rounds[-1:] for c in step.candidates
            if beside_all and c.effect not in fit.named and c.gain > SLACK
            and CATALOGUE[c.effect].balance == balance][:2]
    for step in rounds:
        own = next((c for c in step.candidates if c.effect == name), None)
        if own is not None and name not in step.before.named:
            others = [c for c in step.candidates if c is not own and c.effect not in fit.named]
            near = [c for c in others if c.gain > CONTENDING * own.gain]
            beside = [c for c in others if c.gain <= CONTENDING * own.gain and shared
                      and CATALOGUE[c.effect].balance == balance]
            known = {c.effect for c in (*near, *beside)}
            return near[:3] + beside[:3] + [c for c in late if c.effect not in known]
    return late


def substituted(experiment: Experiment, fit: Fit, name: str, rival: Candidate) -> Fit:
    """Return the model with a rival in place of a named effect, where its own fit left it."""
    start = Start(rival.effect, tuple(effect_values(rival.fit.theta, rival.effect).items()))
    return with_effect(without_effect(experiment, fit, name), start,
                       (1.0,) * len(own_sizes(start)))
