"""Joint selection: linearise, rank every set, refit the best, linearise there again."""

from dataclasses import dataclass

import numpy as np

from eha_monitor.mismatch.experiment import Experiment
from eha_monitor.mismatch.fit import Fit, spread
from eha_monitor.mismatch.gains import Unknowns
from eha_monitor.mismatch.name.columns import columns_at
from eha_monitor.mismatch.name.gram import grams_of
from eha_monitor.mismatch.name.rank import Ranked, ranked
from eha_monitor.mismatch.name.refit import (
    Slopes,
    at_level,
    begun,
    evidence_of,
    joined,
    polished,
    settled,
)
from eha_monitor.mismatch.search import limits_of
from eha_monitor.physics.effects import CATALOGUE

FIRST = 100.0  # times the smallest unknowns: where the nominal model is linearised
LEANING = 30.0  # times the smallest unknowns: below, the nominal model needs next to nothing
HANDFUL = 4  # sets that are refitted at a linearisation
REACH = 0.7  # share of the best set's gain that a set must have to be refitted
ROUNDS = 4
TRACE = False


@dataclass(frozen=True)
class Selection:
    """What the joint selection found.

    Attributes
    ----------
    nominal : the model without effects; ``best`` the model of the set with most evidence.
    fits : names -> refitted model; ``evidence`` names -> log units, of refitted sets.
    ranking : sets at the last linearisation, by the linear guess.
    """

    nominal: Fit
    best: Fit
    fits: dict[frozenset[str], Fit]
    evidence: dict[frozenset[str], float]
    ranking: list[Ranked]


def levels_of(experiment: Experiment, fit: Fit) -> list[Unknowns]:
    """Return the levels of the unknowns at which sets are ranked: from here down to nothing."""
    small = limits_of(experiment)[0].as_array()
    now = fit.unknowns.as_array()
    found = {tuple(small), tuple(now)}
    for factor in (0.1, 0.01, 0.001):
        found.add(tuple(np.maximum(factor * now, small)))
    for i in range(3):
        only = small.copy()
        only[i] = now[i]
        found.add(tuple(only))
        only[i] = max(0.1 * now[i], small[i])
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


def by_names(found: list[Ranked], named_only: bool) -> list[Ranked]:
    """Return the best set of each set of names."""
    seen, chosen = set(), []
    for one in found:
        if named_only and any(name not in CATALOGUE and not name.startswith("rig.")
                              for name in one.names):
            continue
        if one.names not in seen:
            seen.add(one.names)
            chosen.append(one)
    return chosen


def selected(experiment: Experiment, say=lambda text, share: None) -> Selection:
    """Find the set of effects and wrong numbers of the rig that a recording supports."""
    say("fitting the nominal model", 0.05)
    first = nominal_model(experiment)
    fits = {frozenset(): first}
    evidence = {frozenset(): evidence_of(experiment, first)}
    here, ranking = frozenset(), []
    done: set[frozenset[str]] = set()
    for turn in range(ROUNDS):
        say(f"weighing all sets, round {turn + 1}", 0.1 + 0.2 * turn)
        fit = fits[here]
        done.add(here)
        columns = columns_at(experiment, fit)
        slopes = Slopes(experiment, fit, columns)
        grams = grams_of(experiment, fit, columns.values, levels_of(experiment, fit))
        ranking = ranked(columns.what, fit.named, grams)
        own = next((one.evidence for one in ranking if one.names == here), -np.inf)
        proposals = [one for one in by_names(ranking, True) if one.names not in fits]
        top = proposals[0].evidence if proposals else -np.inf
        if TRACE:
            print("   turn", turn, sorted(here), "own %.1f top %.1f" % (own, top), fit.unknowns)
            for one in proposals[:8]:
                print("      %.1f" % one.evidence, [f"{m.owner}:{m.variant}" for m in one.members])
        chosen = [one for one in proposals[:HANDFUL] if one.evidence > own
                  and one.evidence - own >= REACH * (top - own)]

        def refitted(one: Ranked):
            return settled(experiment, joined(experiment, fit, columns.what, one), slopes)

        if TRACE:
            print("      refit")
        for one, made in zip(chosen, spread(refitted, chosen), strict=True):
            value = evidence_of(experiment, made)
            if TRACE:
                print("      %.1f" % value, made.named, made.unknowns)
            if np.isfinite(value):
                fits[one.names], evidence[one.names] = made, value
        best = max(evidence, key=evidence.get)
        if best in done:
            break
        here = best
    return Selection(first, fits[max(evidence, key=evidence.get)], fits, evidence, ranking)


__all__ = ["Selection", "at_level", "selected"]
