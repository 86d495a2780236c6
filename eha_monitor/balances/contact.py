"""Where a rod meets a spring: a tool, an end cushion, a stop.

k max(x - x_c, 0) is linear in k, not in x_c: that is found beforehand, as the place that leaves
the least squares of the force beside damping, friction, mass and a load of each recording's own.
A candidate it is only where it leaves less than a spring over the whole stroke does.
"""

from collections.abc import Callable, Sequence

import numpy as np

from eha_monitor import ties
from eha_monitor.balances.course import Course
from eha_monitor.balances.least_squares import signed_solution
from eha_monitor.balances.policy import Policy

EFFECT = "contact_spring"
EXTENDING, RETRACTING = 1.0, -1.0  # sides on which it is met
PLACES = 40  # over the stroke, and again between the two beside the best
SIGNS = np.array([1.0, 1.0, 0.0, 1.0])  # of damping, dry friction, mass beyond the config's, k


def pressed(x: np.ndarray, place: float | np.ndarray, side: float) -> np.ndarray:
    """Return by how much a spring is pressed, positive where it resists extension, m."""
    return side * np.maximum(side * (x - place), 0.0)


def contacts_of(courses: Sequence[Course], policy: Policy) -> tuple[tuple[float, float], ...]:
    """Return places and sides (x_c, side) at which the rod may meet a spring, m and 1.

    Three for a side on which it does: the best, and the outermost that fit as well.  That of the
    config alone, where it has one.
    """
    held = courses[0].effects.get(EFFECT)
    if held is not None:
        return ((held["x_c"], held["side"]),)
    force, found = _Force(courses), []
    if not force.courses:
        return ()
    low, high = force.range
    owed = force.left(lambda x: x[:, None] - low)[0] * np.exp(-policy.alone)
    for side in (EXTENDING, RETRACTING):
        places, left, best = np.linspace(low, high, PLACES + 2)[1:-1], np.zeros(0), 0
        for _ in range(2):
            if len(left):
                places = np.linspace(places[max(best - 1, 0)], places[min(
                    best + 1, PLACES - 1)], PLACES)
            left = force.left(lambda x, at=places, side=side: pressed(x[:, None], at, side))
            best = ties.largest(-left)
        if left[best] < owed:
            near = np.flatnonzero(left <= left[best] * np.exp(0.5 * policy.alone))[[0, -1]]
            found += [(float(places[i]), side) for i in dict.fromkeys((best, *near.tolist()))]
    return tuple(found)


class _Force:
    """The force balance of recordings with one more column, and a load of each one's own."""

    def __init__(self, courses: Sequence[Course]):
        self.courses = [c for c in courses if c.compared(c.counted("force")).any()]
        self.rows = [self._own(c, np.column_stack([
            c.force - c.added("force"), c.v, c.direction, c.a])) for c in self.courses]

    @property
    def range(self) -> tuple[float, float]:
        """Lowest and highest position, m."""
        ends = [(c.x[c.good].min(), c.x[c.good].max()) for c in self.courses]
        return float(min(low for low, _ in ends)), float(max(high for _, high in ends))

    @staticmethod
    def _own(course: Course, columns: np.ndarray) -> np.ndarray:
        """Return columns (m, k) in the band where they count, less their mean."""
        rows = course.in_band(columns)[course.compared(course.counted("force"))]
        return rows - rows.mean(axis=0)

    def left(self, columns: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return the rms that is left beside each of the columns (m, k) of a position, (k,) N."""
        rows = [np.hstack([row, self._own(c, columns(c.x))])
                for c, row in zip(self.courses, self.rows, strict=True)]
        gram, n = sum(row.T @ row for row in rows), sum(map(len, rows))
        found = []
        for i in range(self.rows[0].shape[1], len(gram)):
            places = [1, 2, 3, i]
            part = gram[np.ix_(places, places)]
            w = signed_solution(part, gram[places, 0], SIGNS)
            found.append(gram[0, 0] - 2.0 * w @ gram[places, 0] + w @ part @ w)
        return np.sqrt(np.maximum(found, 0.0) / n)
