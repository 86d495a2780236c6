"""A linearisation with every set ranked there, and which of the sets are worth a refit."""

from dataclasses import dataclass, replace

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.mismatch.likelihood.gains import Unknowns
from eha_monitor.mismatch.name.candidates import all_named, candidate
from eha_monitor.mismatch.name.columns import Column, Columns, columns_at
from eha_monitor.mismatch.name.gram import grams_of
from eha_monitor.mismatch.name.posterior import (
    Names,
    Refits,
    beyond,
    evidence_at_start,
    own_in,
    plainness,
    posterior,
)
from eha_monitor.mismatch.name.rank import LARGEST_SET, Ranked, best_first, best_over, ranked_at
from eha_monitor.mismatch.name.refit import Slopes
from eha_monitor.mismatch.name.starts import limits_of
from eha_monitor.physics.effects import CATALOGUE

HANDFUL = 4  # sets that are refitted at a linearisation
MOST_OF = 0.9  # of the best set's gain: the smallest sets that reach it are refitted first
PROMISING = 0.5  # of it: the best few of each smaller size are looked at
FEW = 2  # sets more from where fewer unknowns are allowed


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


@dataclass
class Linearised:
    """The innovations linearised at one model, with every set ranked there."""

    here: frozenset[str]  # names of the model
    fit: Fit  # the model itself
    what: tuple[Column, ...]  # whose the columns are
    slopes: Slopes  # of what the model has, under any gains
    levels: list[list[Ranked]]  # ranked sets at each level of the unknowns
    ranking: list[Ranked]  # at the best of all levels

    @property
    def own(self) -> Ranked | None:
        """The model itself in the ranking."""
        return own_in(self.ranking, self.here)


def beside(experiment: Experiment, here: Names, fit: Fit) -> Linearised:
    """Rank what has no name beside each part of a model.

    Unknown functions have more columns than all that has a name, and decide nothing before the
    names have been found.
    """
    return weighed(experiment, here, fit, columns_at(experiment, fit, suspects=False), more=1)


def weighed(experiment: Experiment, here: Names, fit: Fit, columns: Columns,
            more: int = LARGEST_SET) -> Linearised:
    """Rank the sets that columns at a model make; ``more`` suspects join a part of it at most."""
    grams = grams_of(experiment, fit, columns.values, levels_of(experiment, fit), columns.copies)
    levels = [beyond_one_law(found, here, experiment.policy.law) for found in ranked_at(
        columns.what, fit.named, grams, experiment.policy, more)]
    return Linearised(here, fit, columns.what, Slopes(experiment, fit, columns), levels,
                      best_over(levels))


def beyond_one_law(found: list[Ranked], here: Names, form: float) -> list[Ranked]:
    """Return sets in which a second law of a family counts as far as it is beyond form error.

    What one law has wrong another takes up: see :meth:`Refits.scores`.  The model at hand stays as
    it is, since all others are measured from it.

    ``form`` : share of what a law explains that may be its form error.
    """
    known: dict[Names, float] = {}
    for one in found:
        known[one.names] = max(one.evidence, known.get(one.names, -np.inf))
    explained: dict[Names, float] = {}
    for names, evidence in known.items():
        for law in names:
            family = candidate(law).form_kin
            if candidate(law).kin and names - {law} in known and not names & family:
                family |= {law}
                explained[family] = max(evidence - known[names - {law}],
                                        explained.get(family, 0.0))
    counted = []
    for one in found:
        evidence = one.evidence
        for family, gain in explained.items():
            laws = one.names & family
            if len(laws) > 1 and not laws <= here:
                single = max((known[some] for some in known if len(some & family) == 1
                              and some - family <= one.names), default=one.evidence)
                evidence = min(evidence, beyond(one.evidence, single, form * gain))
        counted.append(one if evidence == one.evidence else replace(one, evidence=evidence))
    return best_first(counted)


def chosen_at(view: Linearised, refits: Refits) -> list[Ranked]:
    """Return the sets that are worth a refit at a linearisation."""
    chosen = proposals_of(view.ranking, view.own, refits, view.here)
    # Large unknowns hide what they take the place of; where fewer are allowed it shows.
    for level in view.levels:
        if level and tight(level[0], view.fit):
            there = own_in(level, view.here)
            known = {one.names for one in chosen}
            chosen += [one for one in proposals_of(level, there, refits, view.here)[:FEW]
                       if one.names not in known]
    return chosen


def rivals_at(view: Linearised, refits: Refits) -> list[Ranked]:
    """Return sets that are as likely as the best, by the guess, and were never refitted.

    Among them are the best set without one of its members, and with another in its place.
    """
    weights = posterior(refits, [(view.here, view.ranking)], promising=True)
    wanted = {one.names for one in contested(view)} if view.here == refits.best() else set()
    found = [one for one in with_names(view.ranking)
             if not refits.known(one.names, view.here, promised(refits, view.here, view.own, one))
             and (weights.get(one.names, 0.0) >= refits.policy.rival or one.names in wanted)]
    return ties.ordered(found, lambda one: weights.get(one.names, 0.0),
                        lambda one: plainness(one.names))[:HANDFUL]


def contested(view: Linearised) -> list[Ranked]:
    """Return for each member of a model the best set with another suspect in its place.

    What a member explains is far from linear, so the guess says which other comes next and not
    how far behind it is; one that takes less than half of it is none.
    """
    named, own, found = with_names(view.ranking), view.own, []
    for member in sorted(view.here) if own is not None else ():
        rest = view.here - {member}
        without = own_in(view.ranking, rest)
        others = [one for one in named if rest < one.names and member not in one.names
                  and len(one.names) == len(view.here)]
        if without and others and others[0].evidence > without.evidence + PROMISING * (
                own.evidence - without.evidence):
            found.append(others[0])
    return found


def with_names(found: list[Ranked]) -> list[Ranked]:
    """Return the best set of each set of names that the catalogue or the rig has."""
    chosen: dict[Names, Ranked] = {}
    for one in found:
        if all_named(one.names):
            chosen.setdefault(one.names, one)
    return list(chosen.values())


def proposals_of(found: list[Ranked], model: Ranked | None, refits: Refits,
                 here: Names = frozenset()) -> list[Ranked]:
    """Return the sets that are worth a refit: the smallest that reach most of the best gain.

    ``model`` : the model at hand in that ranking.
    """
    better = named = with_names(found)
    if model is not None:
        start = evidence_at_start(refits, here)
        better = [one for one in named if one.evidence > model.evidence and refits.pursued(
            promised(refits, here, model, one), start)]
    if not better:
        return []
    own = better[-1].evidence if model is None else model.evidence
    enough = own + MOST_OF * (better[0].evidence - own)
    able = [one for one in better if one.evidence >= enough]
    size = min(len(one.names) for one in able)
    chosen: list[Ranked] = []
    # What is contained comes before what contains it.
    for one in sorted(best_first(one for one in able if len(one.names) == size), key=lambda one: (
            sum(len(CATALOGUE[name].contains) for name in one.names if name in CATALOGUE))):
        if not any(contained(other, one, here) for other in chosen):
            chosen.append(one)
    chosen = best_first(chosen)
    # Less of a law is far from linear: what the model has may also stay.
    staying = next((one for one in better if here < one.names), None)
    if staying is not None and not any(here <= one.names for one in chosen):
        chosen.insert(0, staying)
    # What is far off is not linear: a smaller set that promises most of it may reach all of it.
    enough = own + PROMISING * (better[0].evidence - own)
    chosen = [one for k in range(1, size) for one in [
        one for one in better if len(one.names) == k and one.evidence >= enough][:FEW]] + chosen

    def unknown(one: Ranked) -> bool:
        return not refits.known(one.names, here, promised(refits, here, model, one))

    return list(filter(unknown, chosen))[:HANDFUL] or list(filter(unknown, able))[:HANDFUL]


def promised(refits: Refits, here: Names, model: Ranked | None, one: Ranked) -> float:
    """Return the evidence of a set by the linear guess from the model at hand, log units."""
    if model is None:
        return -np.inf
    return evidence_at_start(refits, here) + (one.evidence - one.prior) - (
        model.evidence - model.prior)


def contained(simple: Ranked, other: Ranked, here: Names) -> bool:
    """Tell whether a set is another one with an effect in place of one that contains it.

    What the model at hand has needs no simpler law first.
    """
    less, more = simple.names - other.names, other.names - simple.names
    return len(less) == len(more) == 1 and (name := next(iter(more))) in CATALOGUE \
        and name not in here and next(iter(less)) in CATALOGUE[name].contains


def tight(one: Ranked, fit: Fit) -> bool:
    """Tell whether a level leaves a tenth of a fit's unknowns."""
    ratio = one.gram.unknowns.as_array() / fit.unknowns.as_array()
    return bool(0.09 < ratio.min() < 0.5)
