"""Which of equals is chosen: the plainest, never the one that the last bit of a sum put ahead.

Another processor adds in another order, so two scores that are one number on paper differ there
in their last bits, and fits that end at one optimum by what their tolerance leaves.  Whatever
decides a name, a motion or an order takes it from here.  Scores within a tolerance of the highest
are equal, and of what is equal the plainest comes first: fewer members, shorter, commoner, then
by name; without such a key what stands first.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")
ROUND_OFF = 1e-9  # of a score's size: far above what a sum loses in its last bits
GUESS = 1e-6  # log units: a sum of squares that mostly cancels loses more than that of its result
SAME_FIT = 0.5  # log units: a fit that is better by less is the same fit


def best(items: Iterable[Item], score: Callable[[Item], float],
         plain: Callable[[Item], object] | None = None, within: float = 0.0) -> Item:
    """Return the plainest of the items whose score is equal to the highest.

    NaN is the lowest ``score``; the key ``plain`` is smallest for the plainest; a difference of
    scores ``within`` counts as none, beside round-off.
    """
    return ordered(items, score, plain, within)[0]


def ordered(items: Iterable[Item], score: Callable[[Item], float],
            plain: Callable[[Item], object] | None = None, within: float = 0.0) -> list[Item]:
    """Return items from the highest score to the lowest, the plainest of equals first.

    Those within the tolerance of the first one that is left are its equals; see :func:`best`.
    """
    items = list(items)
    scores = [-np.inf if (value := float(score(item))) != value else value for item in items]
    order = sorted(range(len(items)), key=lambda i: -scores[i])
    first = 0
    while first < len(order):
        least, last = _least(scores[order[first]], within), first + 1
        while last < len(order) and scores[order[last]] >= least:
            last += 1
        if last > first + 1:
            equal = sorted(order[first:last])
            order[first:last] = sorted(equal, key=lambda i: plain(items[i])) if plain else equal
        first = last
    return [items[i] for i in order]


def largest(values: Sequence[float] | np.ndarray, within: float = 0.0) -> int:
    """Return the first place of the largest of numbers; NaN is the smallest."""
    values = np.asarray(values, dtype=float)
    values = np.where(np.isnan(values), -np.inf, values)
    return int(np.argmax(values >= _least(float(values.max()), within)))


def _least(top: float, within: float) -> float:
    """Return the lowest score that is equal to the highest."""
    return top - within - ROUND_OFF * abs(top) if np.isfinite(top) else top
