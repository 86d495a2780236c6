"""Joint selection: linearise, rank every set, refit the best, linearise there again."""

from dataclasses import dataclass, field, replace

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit, spread, with_unknowns
from eha_monitor.mismatch.likelihood.gains import Unknowns
from eha_monitor.mismatch.name.acceptance import FORM
from eha_monitor.mismatch.name.base import limits_of
from eha_monitor.mismatch.name.columns import columns_at
from eha_monitor.mismatch.name.gram import grams_of
from eha_monitor.mismatch.name.rank import Ranked, ranked
from eha_monitor.mismatch.name.refit import (
    Slopes,
    at_level,
    begun,
    discrepancy,
    evidence_of,
    joined,
    polished,
    prior_of,
    settled,
)
from eha_monitor.physics.effects import CATALOGUE

FIRST = 100.0  # times the smallest unknowns: where the nominal model is linearised
LEANING = 30.0  # times the smallest unknowns: below, the nominal model needs next to nothing
HANDFUL = 4  # sets that are refitted at a linearisation
MOST_OF = 0.9  # of the best set's gain: the smallest sets that reach it are refitted first
CATCHING_UP = 0.7  # of the best refitted set's gain, after a few steps, to be fitted to the end
WITHIN_REACH, FINALISTS = 20.0, 3  # log units; sets that are fitted to the end
CLOSE = 1000.0  # log units: the nominal model is a rival too
QUICK = 5  # steps of the first look
ROUNDS = 5
TRACE = False


@dataclass
class Seen:
    """Every set that was refitted.

    Attributes
    ----------
    fits, evidence, left : names -> model, Laplace evidence, cost of its unknowns, log units.
    """

    fits: dict[frozenset[str], Fit] = field(default_factory=dict)
    evidence: dict[frozenset[str], float] = field(default_factory=dict)
    left: dict[frozenset[str], float] = field(default_factory=dict)

    def add(self, experiment: Experiment, names: frozenset[str], fit: Fit,
            anyway: bool = False) -> None:
        """Keep a fit of a set, if it is one and better than what is there, or ``anyway``."""
        value = evidence_of(experiment, fit) if np.isfinite(fit.log_likelihood) else -np.inf
        if np.isfinite(value) and (anyway or value > self.evidence.get(names, -np.inf)):
            self.fits[names], self.evidence[names] = fit, value
            self.left[names] = discrepancy(experiment, fit)

    def floor(self) -> float:
        """Return the evidence of a model that needs no unknowns, as far as it is known."""
        best = max(self.evidence, key=self.evidence.get)
        return self.evidence[best] + self.left[best]

    def score(self, evidence: float, prior: float) -> float:
        """Return what an evidence counts, log units: see :func:`counted`."""
        return counted(self.floor() - evidence) + prior

    def scores(self) -> dict[frozenset[str], float]:
        """Return the score of every refitted set."""
        return {names: self.score(value, prior_of(names))
                for names, value in self.evidence.items()}

    def best(self) -> frozenset[str]:
        """Return the set with the highest score."""
        scores = self.scores()
        return max(scores, key=scores.get)


@dataclass(frozen=True)
class Selection:
    """What the joint selection found.

    Attributes
    ----------
    nominal : the model without effects; ``best`` the model of the set with most evidence.
    seen : every refitted set.
    ranking : sets at the last linearisation, by the linear guess.
    """

    nominal: Fit
    best: Fit
    seen: Seen
    ranking: list[Ranked]


def counted(left: float) -> float:
    """Return what evidence that is lacking counts: in full near the noise, less far above it.

    No model is exact to the last newton.  A likelihood (1 + left / FORM)^-FORM is that of a model
    whose form error is unknown in size: what takes a tenth of much that is left has gained little,
    what takes the last bit has gained all of it.
    """
    return -FORM * float(np.log1p(max(left, 0.0) / FORM))


def levels_of(experiment: Experiment, fit: Fit) -> list[Unknowns]:
    """Return the levels of the unknowns at which sets are ranked: from here down to nothing."""
    small = limits_of(experiment)[0].as_array()
    now = fit.unknowns.as_array()
    found = {tuple(small), tuple(now)}
    for factor in (0.1, 0.01):
        found.add(tuple(np.maximum(factor * now, small)))
    for i in range(3):
        only = small.copy()
        only[i] = now[i]
        found.add(tuple(only))
    return [Unknowns(*level) for level in sorted(found)]


def nominal_model(experiment: Experiment) -> Fit:
    """Fit the nominal model, first with unknowns so large that it cannot run away."""
    held = polished(experiment, begun(experiment, FIRST), Slopes(experiment), 8, 0.5)
    small = limits_of(experiment)[0].as_array()
    if experiment.inverse or (at_level(experiment, held).unknowns.as_array()
                              > LEANING * small).any():
        return held
    return settled(experiment, held)


def with_names(found: list[Ranked]) -> list[Ranked]:
    """Return the best set of each set of names that the catalogue or the rig has."""
    seen, chosen = set(), []
    for one in found:
        if all(name in CATALOGUE or name.startswith("rig.") for name in one.names) \
                and one.names not in seen:
            seen.add(one.names)
            chosen.append(one)
    return chosen


def proposals_of(found: list[Ranked], own: float, seen: Seen) -> list[Ranked]:
    """Return the sets that are worth a refit: the smallest that reach most of the best gain."""
    named = with_names(found)
    better = [one for one in named if one.evidence > own]
    if not better:
        return []
    own = max(own, better[-1].evidence)
    enough = own + MOST_OF * (better[0].evidence - own)
    able = [one for one in better if one.evidence >= enough]
    size = min(len(one.members) for one in able)
    chosen: list[Ranked] = []
    for one in sorted((one for one in able if len(one.members) == size), key=simplicity):
        if not any(contained(other, one) for other in chosen):
            chosen.append(one)
    chosen.sort(key=lambda one: -one.evidence)
    return [one for one in chosen if one.names not in seen.fits][:HANDFUL] or [
        one for one in able if one.names not in seen.fits][:HANDFUL]


def simplicity(one: Ranked) -> tuple[int, float]:
    """Return the key that puts what is contained before what contains it."""
    return (sum(len(CATALOGUE[name].contains) for name in one.names if name in CATALOGUE),
            -one.evidence)


def contained(simple: Ranked, other: Ranked) -> bool:
    """Tell whether a set is another one with an effect in place of one that contains it."""
    less, more = simple.names - other.names, other.names - simple.names
    return len(less) == len(more) == 1 and (name := next(iter(more))) in CATALOGUE \
        and next(iter(less)) in CATALOGUE[name].contains


def selected(experiment: Experiment, say=lambda text, share: None) -> Selection:
    """Find the set of effects and wrong numbers of the rig that a recording supports."""
    say("fitting the nominal model", 0.05)
    first = nominal_model(experiment)
    seen = Seen()
    seen.add(experiment, frozenset(), first)
    at: Fit | None = None  # where the innovations were linearised last
    ranking: list[Ranked] = []
    for turn in range(ROUNDS):
        say(f"weighing all sets, round {turn + 1}", 0.1 + 0.15 * turn)
        here = seen.best()
        if seen.fits[here] is at:
            break
        at = fit = seen.fits[here]
        columns = columns_at(experiment, fit)
        grams = grams_of(experiment, fit, columns.values, levels_of(experiment, fit))
        ranking = ranked(columns.what, fit.named, grams)
        own = next((one.evidence for one in ranking if one.names == here), -np.inf)
        chosen = proposals_of(ranking, own, seen)
        if TRACE:
            print("   turn", turn, sorted(here), "own %.1f" % own, fit.unknowns)
            for one in ranking[:3] + chosen:
                print("      %.1f" % one.evidence, [f"{m.owner}:{m.variant}" for m in one.members])
        slopes = Slopes(experiment, fit, columns)
        mine = next((one for one in ranking if one.names == here), None)
        if not chosen:
            # Nothing is better: then it must hold at the unknowns that suit it best.
            if mine is None or experiment.inverse or mine.gram.unknowns == fit.unknowns:
                break
            again = settled(experiment, joined(experiment, fit, columns.what, mine), slopes)
            before = seen.evidence[here]
            seen.add(experiment, here, again)
            if seen.evidence[here] < before + 1.0:
                break
            continue

        def quick(one: Ranked) -> Fit:
            return polished(experiment, joined(experiment, fit, columns.what, one), slopes, QUICK)

        def whole(made: Fit) -> Fit:
            return settled(experiment, made, slopes)

        if mine is not None and not here and chosen[0].evidence < own + CLOSE:
            # With the same numbers of the rig free as in its rivals: else their evidence differs.
            seen.add(experiment, here, whole(joined(experiment, fit, columns.what, mine)), True)
        looks = spread(quick, chosen)
        reach = max(made.log_likelihood for made in looks)
        base = min(made.log_likelihood for made in [*looks, first] if np.isfinite(
            made.log_likelihood))
        going = [made for made in looks
                 if made.log_likelihood >= base + CATCHING_UP * (reach - base)]
        for made in spread(whole, going):
            seen.add(experiment, frozenset(made.named), made)
            if TRACE:
                print("      refit %.1f" % evidence_of(experiment, made), made.named, made.unknowns)
    finish(experiment, seen)
    return Selection(first, seen.fits[seen.best()], seen, ranking)


def finish(experiment: Experiment, seen: Seen) -> None:
    """Fit the sets that are within reach of the best to the end, under the same unknowns.

    A refit that is cut short ranks the wrong set first where effects trade.
    """
    scores = seen.scores()
    best = seen.best()
    near = [names for names in sorted(scores, key=lambda names: -scores[names])
            if names and scores[names] > scores[best] - WITHIN_REACH][:FINALISTS]
    level = seen.fits[best].unknowns

    def ended(names: frozenset[str]) -> Fit:
        fit = seen.fits[names]
        if not experiment.inverse and fit.unknowns != level:
            fit = with_unknowns(experiment, fit, level)
        return settled(experiment, replace(fit, converged=False))

    for names, fit in zip(near, spread(ended, near), strict=True):
        seen.add(experiment, names, fit)


__all__ = ["Seen", "Selection", "replace", "selected"]
