"""One balance of one recording as a table: the left side and a column for each candidate."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from eha_monitor.machine.candidates import Candidate
from eha_monitor.machine.course import Course
from eha_monitor.machine.least_squares import independent, minimum_norm
from eha_monitor.machine.policy import Policy
from eha_monitor.settings.rig import Rig


@dataclass(frozen=True)
class Table:
    """A balance y = sum of parameters times columns, in its band.

    Attributes
    ----------
    source : of the recording.
    candidates : (k,) of the columns.
    rows : (m, 1 + k) y and columns at the compared points.
    good : (m,) samples that are compared.
    block : (m,) number of each sample's block.
    dt : s.
    """

    source: str
    candidates: tuple[Candidate, ...]
    rows: np.ndarray
    good: np.ndarray
    block: np.ndarray
    dt: float

    @cached_property
    def places(self) -> dict[str, int]:
        """Column of each candidate by name."""
        return {one.name: 1 + i for i, one in enumerate(self.candidates)}

    @cached_property
    def blocks(self) -> np.ndarray:
        """Products of the columns in each block, (b, 1 + k, 1 + k)."""
        numbers = np.unique(self.block[self.good])
        return np.array([part.T @ part for part in (
            self.rows[self.good & (self.block == number)] for number in numbers)])

    @cached_property
    def gram(self) -> np.ndarray:
        """Products over all compared samples."""
        return self.blocks.sum(axis=0)

    @cached_property
    def halves(self) -> tuple[np.ndarray, np.ndarray]:
        """Products of every other pair of blocks, and of the rest."""
        first = np.arange(len(self.blocks)) // 2 % 2 == 0
        return self.blocks[first].sum(axis=0), self.blocks[~first].sum(axis=0)

    @cached_property
    def n(self) -> int:
        """Compared samples."""
        return int(self.good.sum())

    @cached_property
    def size(self) -> float:
        """Standard deviation of y over the compared samples."""
        return max(float(np.std(self.rows[self.good, 0])), 1e-300)

    @cached_property
    def full(self) -> tuple[float, float]:
        """RMS of what all candidates together leave, and how many of its samples count as one."""
        products = self.gram[1:, 1:]
        size = np.sqrt(np.maximum(np.diag(products), 1e-300))
        w = minimum_norm(products / np.outer(size, size), self.gram[1:, 0] / size) / size
        left = np.where(self.good, self.rows[:, 0] - self.rows[:, 1:] @ w, np.nan)
        return float(np.sqrt(np.nanmean(left**2))), independent(left)

    @property
    def effective(self) -> float:
        """How many independent samples the compared ones are worth."""
        return max(self.n / self.full[1], 4.0)

    @property
    def weight(self) -> float:
        """Of its products beside those of other recordings: per independent squared residual."""
        rms, correlated = self.full
        return 1.0 / (max(rms, 1e-6 * self.size) ** 2 * correlated)

    def left(self, weights: dict[str, float]) -> np.ndarray:
        """Return y less the terms with these parameters, (m,)."""
        w = np.zeros(self.rows.shape[1])
        for name, value in weights.items():
            w[self.places[name]] = value
        return self.rows[:, 0] - self.rows @ w


def tables_of(courses: Sequence[Course], rig: Rig, balance: str,
              candidates: tuple[Candidate, ...], policy: Policy) -> list[Table]:
    """Return the tables of recordings; candidates that one of them has no channel for go."""
    columns = []
    for course in courses:
        columns.append([one.column(course, rig) for one in candidates])
    kept = [i for i in range(len(candidates)) if all(row[i] is not None for row in columns)]
    found = []
    for course, row in zip(courses, columns, strict=True):
        rows = course.in_band(np.column_stack([left_side(course, rig, balance),
                                               *(row[i] for i in kept)]))
        block = (np.arange(len(rows)) * course.step / policy.block).astype(int)
        found.append(Table(course.source, tuple(candidates[i] for i in kept), rows,
                           course.compared(course.good), block, course.step))
    return found


def left_side(course: Course, rig: Rig, balance: str) -> np.ndarray:
    """Return what a balance explains: the force, or the flow that the piston takes; (m,)."""
    return course.force if balance == "force" else rig.area_1 * course.v
