"""The terms of a balance that one recording alone can carry, and how surely.

Terms are chosen on random halves of the recording's blocks, each judged on the other half: a
term enters where it takes the share ``alone`` of the error there.  A name is what comes up in
``stable`` of the halves (Meinshausen and Buehlmann 2010); its probability is that frequency,
flattened to what replicates of real recordings allow, and capped.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from eha_monitor.machine.least_squares import inverse_of, signed_solution
from eha_monitor.machine.policy import Policy
from eha_monitor.machine.table import Table
from eha_monitor.machine.together import allowed_of

MOST_TERMS = 8


@dataclass(frozen=True)
class Name:
    """A name that one recording supports.

    Attributes
    ----------
    term : candidate's name; ``effect`` what it is called.
    value, stddev : SI; the deviation contains a typical spread between recordings.
    frequency : share of the halves in which the effect, or one of its family, came up.
    probability : calibrated and capped.
    rivals : effects of its family that fit as well in its place.
    """

    term: str
    effect: str
    value: float
    stddev: float
    frequency: float
    probability: float
    rivals: tuple[str, ...]


@dataclass(frozen=True)
class Alone:
    """What one balance of one recording says.

    Attributes
    ----------
    names : supported ones, those that every model has first.
    effective_samples : of the fullest model's residual.
    error, nominal : share of y's standard deviation on the half left out, mean over the halves;
        ``nominal`` with the terms that every model has.
    """

    names: tuple[Name, ...]
    effective_samples: float
    error: float
    nominal: float

    @property
    def effects(self) -> frozenset[str]:
        """Effects that are named."""
        return frozenset(name.effect for name in self.names)


def alone(table: Table, policy: Policy, seed: int = 0) -> Alone:
    """Return what one balance of one recording says."""
    rng, count = np.random.default_rng(seed), len(table.blocks)
    allowed = [one for one in allowed_of(table.candidates, load_varied=False)
               if _within(table, [*(c.name for c in table.candidates if c.always), one])]
    always = [one.name for one in table.candidates if one.always]
    of = {one.name: one for one in table.candidates}
    effects, families, terms, choices = Counter(), Counter(), Counter(), []
    for _ in range(policy.halves):
        first = np.zeros(count, dtype=bool)
        first[rng.permutation(count)[: (count + 1) // 2]] = True
        fit, judge = table.blocks[first].sum(axis=0), table.blocks[~first].sum(axis=0)
        chosen = chosen_on(table, fit, judge, always, allowed, policy)
        choices.append((fit, judge))
        effects.update({of[name].effect for name in chosen})
        families.update({of[name].family or of[name].effect for name in chosen})
        terms.update(chosen)
    kept = list(always)
    for family, often in families.most_common():
        if often < policy.stable * policy.halves:
            continue
        members = [name for name, _ in terms.most_common()
                   if (of[name].family or of[name].effect) == family]
        stable = [name for name in members
                  if effects[of[name].effect] >= policy.stable * policy.halves]
        for name in stable or members[:1]:
            if of[name].effect not in {of[other].effect for other in kept}:
                kept.append(name)
    rivals = {}
    for i, name in enumerate(kept):
        if not of[name].always:
            kept[i], rivals[of[name].family] = _plainest(table, kept, i, choices, allowed, policy)
    w, stddev = _parameters(table, kept, policy)
    names, taken = [], {of[name].effect for name in kept}
    for name, value, deviation in zip(kept, w, stddev, strict=True):
        one = of[name]
        family = one.family or one.effect
        often = families[family] / policy.halves if not one.always else 1.0
        names.append(Name(name, one.effect, value, deviation, often,
                          probability_of(often, policy),
                          tuple(e for e in rivals.get(one.family, ()) if e not in taken)))
    return Alone(tuple(names), table.effective, _unseen(table, kept, choices),
                 _unseen(table, always, choices))


def _plainest(table: Table, kept: list[str], i: int, choices: list, allowed: list[str],
              policy: Policy) -> tuple[str, tuple[str, ...]]:
    """Return the first member of a family that fits as well as any, and the others that do.

    Within a family the difference is one of form; a recording alone rarely decides it, and what
    it cannot decide goes to the one that stands first among the candidates.
    """
    of = {one.name: one for one in table.candidates}
    own, taken = of[kept[i]], {of[name].effect for name in kept}
    members = [name for name in allowed if (of[name].effect == own.effect) or (
        own.family and of[name].family == own.family and of[name].effect not in taken)]
    found = {name: _unseen(table, [*kept[:i], name, *kept[i + 1 :]], choices) for name in members}
    best: dict[str, str] = {}  # effect -> its best shape
    for name in members:
        effect = of[name].effect
        if effect not in best or found[name] < found[best[effect]]:
            best[effect] = name
    least = min(found.values())
    equal = [effect for effect, name in best.items()
             if found[name] <= least * np.exp(policy.alone)]
    return best[equal[0]], tuple(equal[1:])


def probability_of(frequency: float, policy: Policy) -> float:
    """Return how surely a name of this frequency comes back on another day."""
    half = 0.5 / policy.halves
    odds = np.log((frequency + half) / (1.0 - frequency + half))
    return float(min(1.0 / (1.0 + np.exp(-policy.slope * odds)), policy.certain))


def chosen_on(table: Table, fit: np.ndarray, judge: np.ndarray, always: list[str],
              allowed: list[str], policy: Policy) -> list[str]:
    """Return the terms that gain on one half, fitted on the other."""
    names, of = list(always), {one.name: one for one in table.candidates}
    error = _error(table, fit, judge, names)
    while len(names) < MOST_TERMS:
        taken = {of[name].effect for name in names}
        best, least = None, error * np.exp(-policy.alone)
        for name in allowed:
            if name in names or (of[name].variant and of[name].effect in taken):
                continue
            found = _error(table, fit, judge, [*names, name])
            if found < least:
                best, least = name, found
        if best is None:
            break
        names.append(best)
        error = least
        for name in [one for one in names if one not in always and one != best]:
            rest = [one for one in names if one != name]
            found = _error(table, fit, judge, rest)
            if found < error * np.exp(policy.alone):
                names, error = rest, found
    return names


def _error(table: Table, fit: np.ndarray, judge: np.ndarray, names: list[str]) -> float:
    """Return the RMS on the judging half, in the unit of y times the root of the samples."""
    places = [table.places[name] for name in names]
    signs = np.array([table.candidates[i - 1].sign for i in places], dtype=int)
    w = signed_solution(fit[np.ix_(places, places)], fit[places, 0], signs)
    left = judge[0, 0] - 2.0 * w @ judge[places, 0] + w @ judge[np.ix_(places, places)] @ w
    return float(np.sqrt(max(left, 1e-300)))


def _within(table: Table, names: list[str]) -> bool:
    """Tell whether the parameters of a set are within their limits on the whole recording."""
    places = [table.places[name] for name in names]
    of = [table.candidates[i - 1] for i in places]
    w = signed_solution(table.gram[np.ix_(places, places)], table.gram[places, 0],
                        np.array([one.sign for one in of], dtype=int))
    return all(abs(value) <= one.limit for value, one in zip(w, of, strict=True))


def _unseen(table: Table, names: list[str], choices: list) -> float:
    squares = np.mean([_error(table, fit, judge, names) ** 2 for fit, judge in choices])
    share = np.mean([judge[0, 0] / table.gram[0, 0] for _, judge in choices])
    return float(np.sqrt(squares / (share * table.n))) / table.size


def _parameters(table: Table, names: list[str], policy: Policy
                ) -> tuple[list[float], list[float]]:
    """Return values and deviations: effective sample size, and a typical spread."""
    places = [table.places[name] for name in names]
    signs = np.array([table.candidates[i - 1].sign for i in places], dtype=int)
    inner = table.gram[np.ix_(places, places)]
    w = signed_solution(inner, table.gram[places, 0], signs)
    left = max(float(table.gram[0, 0] - w @ table.gram[places, 0]), 0.0) / table.n
    effective = table.effective
    scale = left * table.full[1] * effective / max(effective - len(names), 1.0)
    typical = np.array([policy.between if one.between is None else one.between
                        for one in (table.candidates[i - 1] for i in places)])
    variance = np.diag(inverse_of(inner)) * scale + (typical * w) ** 2
    return w.tolist(), np.sqrt(variance).tolist()
