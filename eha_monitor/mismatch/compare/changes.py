"""Which numbers have changed: the fewest that bring a run back among the healthy ones."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from eha_monitor.mismatch.compare.healthy import Healthy
from eha_monitor.mismatch.compare.runs import Run
from eha_monitor.mismatch.name.columns import ALWAYS, Column
from eha_monitor.mismatch.name.suspects import exclude
from eha_monitor.physics.effects import CATALOGUE

MOST = 3  # numbers that change at once
NEXT = 12  # single ones from which sets grow
ALIKE = 2.0  # log units: what explains a run so nearly as well cannot be told from the best
PARAMETER = 0.5  # rarity of a change of B or beta_e, between what is common and what is not
STEEP = 1e-9  # of a set's products: singular


@dataclass(frozen=True)
class Explanation:
    """Numbers that have changed.

    Attributes
    ----------
    changes : place among the run's numbers -> amplitude, beyond the mean of the healthy runs.
    left : half the mean square of what is left, in the healthy runs' own spread, log units.
    complete : nothing that is left goes beyond the limits of a healthy run.
    rivals : place -> places of others that explain as much in its stead.
    """

    changes: dict[int, float]
    left: float
    complete: bool
    rivals: dict[int, tuple[int, ...]]


def changed(healthy: Healthy, run: Run) -> bool:
    """Tell whether a run goes beyond what healthy runs do."""
    return bool((np.abs(healthy.t_of(run.amplitudes)) > healthy.limit).any())


def explained(healthy: Healthy, run: Run) -> Explanation:
    """Return the fewest changes of named numbers after which a run is like the healthy ones.

    Where no such set is found, the best of the largest ones.
    """
    able = [int(i) for i in healthy.kept if named(run.what[i])]
    singles = sorted((made for i in able if (made := weighed(healthy, run, (i,))) is not None),
                     key=lambda one: one.left)
    best, found = None, singles
    for size in range(1, MOST + 1):
        if size > 1:
            first = [next(iter(one.changes)) for one in singles[:NEXT]]
            grown = [tuple(best.changes) + (i,) for i in able if i not in best.changes]
            sets = [*combinations(first, size), *grown] if size == 2 else grown
            found = sorted((made for places in dict.fromkeys(map(frozenset, sets))
                            if not clash(run, places)
                            and (made := weighed(healthy, run, tuple(places))) is not None),
                           key=lambda one: one.left)
        good = [one for one in found if one.complete]
        if good:
            return chosen(run, good)
        best = min([*found[:1], *([best] if best else [])], key=lambda one: one.left)
    return best


def chosen(run: Run, good: Sequence[Explanation]) -> Explanation:
    """Return the commonest of the explanations that are as good as the best, with the others."""
    near = [one for one in good if one.left < good[0].left + ALIKE]
    first = min(near, key=lambda one: (sum(rarity(run.what[i], amount) for i, amount
                                           in one.changes.items()), one.left))
    rivals = {}
    for i in first.changes:
        rest = set(first.changes) - {i}
        rivals[i] = tuple(next(iter(set(one.changes) - rest)) for one in near
                          if i not in one.changes and rest <= set(one.changes))
    return Explanation(first.changes, first.left, True, rivals)


def weighed(healthy: Healthy, run: Run, places: tuple[int, ...]) -> Explanation | None:
    """Return what a set explains: its numbers moved until each is at the mean of the healthy."""
    rows = np.array(places)
    mean = dict(zip(healthy.kept.tolist(), healthy.mean, strict=True))
    products = run.products[np.ix_(1 + rows, 1 + rows)] / run.power[rows][:, None]
    if np.linalg.cond(products) > 1.0 / STEEP:
        return None
    amounts = np.linalg.solve(products, run.amplitudes[rows] - [mean[i] for i in places])
    changes = dict(zip(places, amounts.tolist(), strict=True))
    t = healthy.t_of(run.without(changes))
    left = 0.5 * float(np.mean((t / healthy.limit) ** 2) * np.mean(healthy.limit) ** 2)
    return Explanation(changes, left, bool((np.abs(t) <= healthy.limit).all()), {})


def named(column: Column) -> bool:
    """Tell whether a number has a name: B, beta_e, the rig's, or of the catalogue."""
    return column.owner == ALWAYS or column.owner in CATALOGUE


def clash(run: Run, places: frozenset[int]) -> bool:
    """Tell whether two numbers of a set belong to effects of which one contains the other."""
    owners = [run.what[i].owner for i in places]
    return any(one == two and one != ALWAYS or one != two and ALWAYS not in (one, two)
               and exclude(one, two) for one, two in combinations(owners, 2))


def rarity(column: Column, amount: float) -> float:
    """Return how uncommon a change is; what can only grow has half the room of what may turn."""
    if column.owner == ALWAYS:
        return PARAMETER
    entry = CATALOGUE[column.owner]
    symbol = column.name.partition(".")[2]
    p = next(p for p in entry.parameters if p.name == symbol)
    one_way = p.lower >= p.neutral and amount > 0.0
    return entry.rarity + 0.1 * len(entry.contains) - (0.05 if one_way else 0.0)
