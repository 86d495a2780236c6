"""One balance of one recording as a table: the left side and a column for each candidate."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from eha_monitor.balances.candidates import Candidate, falls_of, pressure_rate
from eha_monitor.balances.course import Course, slope
from eha_monitor.balances.least_squares import independent, signed_solution, weights_of
from eha_monitor.balances.policy import Policy
from eha_monitor.settings.rig import Rig

CANCELS, TOP = 2.0, 0.998  # quantile that is a column's largest value
FOLDS = 5  # parts of a recording that are left out in turn
PARTS = 8  # of a short recording at least, so that some can be left out
STILL = 1e-150  # of a signal that does not change; its square is a number still


@dataclass(frozen=True)
class Table:
    """A balance y = sum of parameters times columns, in its band.

    Attributes
    ----------
    source : of the recording.
    candidates : (k,) of the columns.
    rows : (m, 1 + k) y and columns at the compared points.
    good : (m,) samples that are compared (:meth:`Course.counted`); ``moving`` how many of the
        recording's are at a steady direction.
    block : (m,) number of each sample's block.
    dt : s.
    size : rms of the left side, of which y is what the config leaves open, without what the
        config's own load holds at rest; of a recording with a load of its own, its standard
        deviation.
    floor : rms that the sensors alone leave.
    known : (m,) what the config says of the left side.
    doubts : (m, j) by what the left side may be wrong, one standard deviation each: channels that
        are late by the course's skew, areas within their tolerance.
    falls, turning : (m, 12) and (m, 1), see :func:`candidates.falls_of`.
    """

    source: str
    candidates: tuple[Candidate, ...]
    rows: np.ndarray
    good: np.ndarray
    moving: int
    block: np.ndarray
    dt: float
    size: float
    floor: float
    known: np.ndarray
    doubts: np.ndarray
    falls: np.ndarray
    turning: np.ndarray

    @property
    def balance(self) -> str:
        """Which balance it is."""
        return self.candidates[0].balance

    @cached_property
    def places(self) -> dict[str, int]:
        """Column of each candidate by name."""
        return {one.name: 1 + i for i, one in enumerate(self.candidates)}

    @cached_property
    def signs(self) -> np.ndarray:
        """Sign of each column's parameter, (1 + k,); 0 of y."""
        return np.array([0, *(one.sign for one in self.candidates)])

    @cached_property
    def least(self) -> np.ndarray:
        """Bound of each column's parameter that has a sign, (1 + k,)."""
        return np.array([0.0, *(one.least for one in self.candidates)])

    @cached_property
    def blocks(self) -> np.ndarray:
        """Products of the columns in each block, (b, 1 + k, 1 + k)."""
        return np.array([part.T @ part for part in (
            self.rows[self.good & (self.block == number)] for number in self.numbers)])

    @cached_property
    def numbers(self) -> np.ndarray:
        """Numbers of the blocks that hold compared samples, (b,)."""
        return np.unique(self.block[self.good])

    @cached_property
    def gram(self) -> np.ndarray:
        """Products over all compared samples."""
        return self.blocks.sum(axis=0)

    @cached_property
    def halves(self) -> tuple[np.ndarray, np.ndarray]:
        """Products of half of the pairs of blocks, and of the rest."""
        first = self.first_half
        return self.blocks[first].sum(axis=0), self.blocks[~first].sum(axis=0)

    @property
    def first_half(self) -> np.ndarray:
        """Which blocks are of the first half, (b,) bool: pairs in a random order.

        Every other pair has one direction only of a motion whose period is that of the pairs.
        """
        pairs = np.arange(len(self.numbers)) // 2
        order = np.random.default_rng(0).permutation(int(pairs.max(initial=-1)) + 1)
        return order[pairs] % 2 == 0

    @cached_property
    def n(self) -> int:
        """Compared samples."""
        return int(self.good.sum())

    @cached_property
    def reach(self) -> np.ndarray:
        """Largest parameter of each term, (1 + k,): its limit, and what more would cancel.

        A term that is larger than ``CANCELS`` times the whole left side only makes up for another.
        Of a load over the stroke the mean is none of it: that is the constant load's.  A drive's
        limit takes away from what is asked for, which may be many times what it gives.
        """
        left = [self.rows[self.good, 0] + self.known[self.good]]
        if self.balance == "drive":
            left.append(self.known[self.good])
        whole = max(np.quantile(np.abs(one), TOP) for one in left)
        mean = self.rows[self.good].mean(axis=0) * [0, *(
            one.family == "position" for one in self.candidates)]
        most = CANCELS * whole / np.maximum(
            np.quantile(np.abs(self.rows[self.good] - mean), TOP, axis=0), 1e-300)
        # A force beyond any that was measured is the tail of a law at speeds that were not.
        limits = [min(one.limit, CANCELS * whole) if one.unit == "N" else one.limit
                  for one in self.candidates]
        free = [one.always for one in self.candidates]
        return np.array([np.inf, *np.where(free, np.inf, np.minimum(limits, most[1:]))])

    @cached_property
    def full(self) -> tuple[float, float]:
        """RMS of what all candidates together leave, and how many of its samples count as one."""
        w = weights_of(self.gram[1:, 1:], self.gram[1:, 0])
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

    def mixture(self, gram: np.ndarray, names: Iterable[str],
                held: dict[str, float] | None = None) -> np.ndarray:
        """Return the mixture of columns that a fit leaves: 1 of y, -w of each term, (1 + k,).

        Parameters
        ----------
        gram : products that are fitted, of this table's columns.
        names : terms that are fitted, within their signs; ``held`` those with a given parameter.
        """
        left = np.zeros(len(gram))
        left[0] = 1.0
        for name, value in (held or {}).items():
            left[self.places[name]] = -value
        places = [self.places[name] for name in names]
        left[places] = -signed_solution(gram[np.ix_(places, places)], gram[places] @ left,
                                        self.signs[places], self.least[places])
        return left

    def crosswise(self, names: Iterable[str], held: dict[str, float] | None = None) -> np.ndarray:
        """Return what is left of y where each pair of blocks in ``FOLDS`` is fitted without, (m,).

        All but one in so many hold either direction of any periodic motion.
        """
        left, names = np.zeros(len(self.rows)), tuple(names)
        fold = np.arange(len(self.numbers)) // 2 % FOLDS
        for one in np.unique(fold):
            here = np.isin(self.block, self.numbers[fold == one])
            gram = self.blocks[fold != one].sum(axis=0)
            left[here] = self.rows[here] @ self.mixture(gram, names, held)
        return left

    def left(self, weights: dict[str, float]) -> np.ndarray:
        """Return y less the terms with these parameters, (m,)."""
        w = np.zeros(self.rows.shape[1])
        for name, value in weights.items():
            w[self.places[name]] = value
        return self.rows[:, 0] - self.rows @ w

    def rms(self, left: np.ndarray) -> float:
        """Return the rms of (m,) over the compared samples, as a share of the signal's size."""
        return float(np.sqrt(np.mean(left[self.good] ** 2))) / self.size


def tables_of(courses: Sequence[Course], rig: Rig, balance: str,
              candidates: Sequence[Candidate], policy: Policy) -> list[Table]:
    """Return the tables of recordings; candidates that one of them has no channel for go."""
    columns, candidates = [], [one.beside(courses[0].effects) for one in candidates]
    for course in courses:
        columns.append([one.column(course, rig) for one in candidates])
    kept = [i for i in range(len(candidates)) if all(
        row[i] is not None for row in columns) and any(np.any(row[i]) for row in columns)]
    # What a load of each recording's own makes up for is no signal of the machine.
    own_load = any(one.always and one.setting for one in candidates)
    found = []
    for course, row in zip(courses, columns, strict=True):
        whole = left_side(course, rig, balance)
        known = course.wanted if balance == "drive" else course.added(balance)
        doubts = doubts_of(course, rig, balance, whole)
        rows = course.in_band(np.column_stack([whole, known, *doubts, *(row[i] for i in kept)]))
        good = course.compared(course.counted(balance))
        if balance == "drive" and good.any():
            # A controller's zero of the position is seldom the recorder's: K times what they
            # differ by is constant, and no number of the drive.
            rows = rows - rows[good].mean(axis=0)
        signal = rows[good, 0] - course.in_band(course.resting(balance))[good]
        signal -= signal.mean() if own_load else 0.0
        size = max(float(np.sqrt(np.mean(signal**2))), STILL)
        first = 2 + len(doubts)
        known, doubts = rows[:, 1], rows[:, 2:first]
        rows = np.column_stack([rows[:, 0] - known, rows[:, first:]])
        length = min(policy.block, float(good.sum()) * course.step / PARTS)
        block = (np.arange(len(rows)) * course.step / length).astype(int)
        found.append(Table(course.source, tuple(candidates[i] for i in kept), rows, good,
                           int(course.compared(course.moving).sum()), block, course.step, size,
                           course.floor(balance, rig), known, doubts,
                           *falls_of(course, rig, balance)))
    return found


def left_side(course: Course, rig: Rig, balance: str) -> np.ndarray:
    """Return what a balance explains: force, flow that the piston takes, pump speed; (m,)."""
    return {"force": lambda: course.force, "flow": lambda: course.taken(rig),
            "drive": lambda: course.omega}[balance]()


def flow_columns(course: Course, rig: Rig) -> tuple | None:
    """Return the flow that the piston takes, and the columns that make it; None without channels.

    With equal areas the mean of both chambers; else the chamber that the pump fills, as of
    chamber 1 (a valve and an accumulator take care of the other).
    """
    if course.omega is None or course.p1 is None or course.p2 is None or not (
            rig.area_1 and rig.area_2):
        return None
    return course.taken(rig), (
        ("D_p", "m³/rad", "pump displacement", 1, course.of_pump(course.omega)),
        ("C_L", "m³/(s·Pa)", "leakage", 1,
         (course.p2 - course.p1) * course.as_of_chamber_1),
        ("C_h", "m³/Pa", "compliance of a chamber", 1, -pressure_rate(course)))


def areas_apart(course: Course, rig: Rig) -> tuple[np.ndarray, ...]:
    """Return by how much more the pump moves chamber 2 where its area is off by a tolerance, (m,).

    As of chamber 1: half a per cent of the flow, more than oil takes up under a spring's load.
    Nothing where both chambers are compared at once.  It stands on the pump's side of the balance:
    on that of the piston a share of -1 would leave nothing to explain.
    """
    if course.mean_of_both:
        return ()
    moved = displaced(course, rig.area_1 * course.v) * course.of_pump(course.omega)
    return (np.where(course.pumped_side < 0.0, rig.tolerance.log_spread("area_2") * moved, 0.0),)


def displaced(course: Course, flow: np.ndarray) -> float:
    """Return what the pump moves of a flow (m,) by turning, m³/rad; 0 of one at rest."""
    good = course.good
    pump = course.of_pump(course.omega)[good]
    return float(flow[good] @ pump) / max(float(pump @ pump), 1e-300)


def doubts_of(course: Course, rig: Rig, balance: str, whole: np.ndarray) -> list[np.ndarray]:
    """Return by what a left side (m,) may be wrong, each one standard deviation, (m,).

    A bore makes both areas wrong by the same share; the rod of a single-rod cylinder only one,
    and with it the flow of chamber 2 as of chamber 1.
    """
    found = [course.skew * slope(whole, course.dt)]
    if balance == "flow" or (balance == "force" and course.p1 is not None and rig.area_1):
        found.append(rig.tolerance.log_spread("area_1") * whole)
    if balance == "force" and course.p2 is not None and rig.area_2 != rig.area_1:
        found.append(rig.tolerance.log_spread("area_2") * rig.area_2 * course.p2)
    if balance == "flow" and not course.mean_of_both:
        found.append(rig.tolerance.log_spread("area_2") * np.where(
            course.pumped_side < 0.0, whole, 0.0))
    return found


def nominal_of(balance: str, rig: Rig) -> tuple[tuple[str, ...], dict[str, float]]:
    """Return the terms of the config's linear model that are fitted, and those that it holds.

    B in the force balance, beta_e's compliance and the leakage beside the config's displacement
    in that of the flow; the drive follows its command, with the position loop's gain.
    """
    if balance == "force":
        return ("B",), {}
    if balance == "drive":
        return () if rig.position_gain is None else ("k_d",), {}
    leak = ("L",) if rig.leakage else ()
    if rig.pump_displacement is None:
        return ("D_p", "C_h", *leak), {}
    return ("C_h", *leak), {"D_p": rig.pump_displacement}


def pooled_table(tables: Sequence[Table]) -> Table:
    """Return several recordings' balance as one table.

    What every model has of the setting (a constant load) has a column for each recording, named
    ``F_0 1``, ``F_0 2``, ...; all else is shared.
    """
    if len(tables) == 1:
        return tables[0]
    columns, candidates = [np.concatenate([table.rows[:, :1] for table in tables])], []
    for i, one in enumerate(tables[0].candidates, start=1):
        rows = [table.rows[:, i : i + 1] for table in tables]
        if one.always and one.setting:
            for j in range(len(tables)):
                columns.append(np.concatenate([row if j == k else 0.0 * row
                                               for k, row in enumerate(rows)]))
                candidates.append(replace(one, name=f"{one.name} {j + 1}"))
        else:
            columns.append(np.concatenate(rows))
            candidates.append(one)
    block, first = [], 0
    for table in tables:
        block.append(table.block + first)
        first += int(table.block.max()) + 2
    good = np.concatenate([table.good for table in tables])
    sizes = [table.size for table in tables]
    return Table(", ".join(table.source for table in tables), tuple(candidates),
                 np.column_stack(columns), good,
                 sum(table.moving for table in tables), np.concatenate(block), tables[0].dt,
                 float(np.sqrt(np.mean(np.square(sizes)))),
                 float(np.sqrt(np.mean([table.floor**2 for table in tables]))),
                 np.concatenate([table.known for table in tables]),
                 np.concatenate([table.doubts for table in tables]),
                 np.concatenate([table.falls for table in tables]),
                 np.concatenate([table.turning for table in tables]))
