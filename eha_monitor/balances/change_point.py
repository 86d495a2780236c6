"""Whether a recording is of one state, or a number of its balances changed while it ran.

A step of one term's parameter at a time tau, theta_j + delta 1(t > tau), is one more column of a
balance.  Viscous damping may drift beside it, in t and t^2, as oil warms while a machine runs.
The step is fitted on four fifths of the recording's blocks and judged on the rest; the largest
gain over all terms and times is a change where

- it gains more, by ``alone``, than what a name owes, and than a step in the order of speed or of
  position instead of time: else the motion has changed, and the law that is missing with it;
- it gains more, by ``alone``, than a steady drift of the same number, such as a sensor's;
- delta is as far from nothing as a name owes, by chance, and as what is sure also by its form:
  a missing law that looks like a term looks like it before and after, in the same motion.

1/beta_e shows in a wider band than the other numbers (:mod:`oil`), and a few strokes hold it: so
it is fitted to parts of a recording, and the mean before is compared with the mean since.

Bai and Perron 1998 for one change by least squares; the judgement on unseen blocks stands in the
place of their critical values, which hold for independent samples only.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from eha_monitor import ties
from eha_monitor.balances.alone import alone
from eha_monitor.balances.candidates import PLAIN, Candidate, Scale, balances_in, candidates_of
from eha_monitor.balances.contact import contacts_of
from eha_monitor.balances.course import Course
from eha_monitor.balances.least_squares import independent, inverse_of, rms, signed_solution
from eha_monitor.balances.measured import course_of
from eha_monitor.balances.oil import compressibility
from eha_monitor.balances.policy import POLICY, Policy
from eha_monitor.balances.table import FOLDS, Table, tables_of
from eha_monitor.balances.together import of_one_machine
from eha_monitor.errors import InputError
from eha_monitor.mismatch.diagnosis import ChangePoint, Value
from eha_monitor.quantity import with_uncertainty
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig
from eha_monitor.words import effect_words, listed

BLOCKS = 64  # at most: those of a long recording are joined
FEWEST, LEAST = 3, 0.15  # blocks on either side, and their share
DAMPING, DRIFT, COMPLIANCE = "B", "viscous_drift", "C_h"
BEYOND = " beyond the config's"
# Of the oil, whose 1/beta_e is fitted to parts of a recording.
PART_S = 5.0  # of motion: some strokes
MOST_PARTS = 12  # those of a long recording are longer
FEWEST_PARTS = 2  # on either side, of which a step is the mean


def since_change(recordings: Sequence[Recording], settings: Settings, policy: Policy = POLICY
                 ) -> tuple[list[Recording], tuple[ChangePoint, ...]]:
    """Return recordings in the state in which each of them ends, and where they changed.

    What came before is not a number there: the recording keeps its time.
    """
    kept, found = [], []
    for recording in recordings:
        point = change_point(recording, settings, policy)
        if point is not None:
            found.append(point)
            recording = blanked(recording, recording.time < point.since_s)
        kept.append(recording)
    return kept, tuple(found)


def blanked(recording: Recording, rows: np.ndarray) -> Recording:
    """Return a recording without a number in some rows, (n,) bool; it keeps its time."""
    return replace(recording, channels={name: np.where(rows, np.nan, values)
                                        for name, values in recording.channels.items()})


def motion_of(recording: Recording, settings: Settings, policy: Policy) -> Course | None:
    """Return a recording's motion; None of one without a force balance."""
    try:
        course = course_of(recording, settings)
    except InputError:
        return None
    return of_one_machine([course], settings.rig, policy)[0] if course.shows else None


def change_point(recording: Recording, settings: Settings, policy: Policy = POLICY
                 ) -> ChangePoint | None:
    """Return the largest change of a number within a recording, None where it is of one state.

    Of a recording without a force balance nothing is said.
    """
    rig, course = settings.rig, motion_of(recording, settings, policy)
    if course is None:
        return None
    scale = Scale.of([course], contacts_of([course], policy))
    found = []
    for balance in balances_in([course], rig):
        (table,) = tables_of([course], rig, balance, candidates_of(balance, scale, rig), policy)
        step = _Steps(table, course, policy).largest() if table.n else None
        if step is not None:
            found.append(step)
    largest = max(found, key=lambda step: step.removed, default=None)
    if largest is None or largest.symbol == COMPLIANCE:  # the oil shows best in its own band
        return oil_change(course, rig, policy) or largest
    return largest


def _told(source: str, c: Candidate, between: tuple[float, float], gain: float,
          step: tuple[float, float]) -> ChangePoint:
    """Return the record of a step, (value, stddev), that takes ``gain`` log units of the error."""
    words, (value, stddev), (start, stop) = c.words.removesuffix(BEYOND), step, between
    if c.twins:
        words += f" (or {listed([effect_words(one) for one in c.twins], 'or')})"
    return ChangePoint(
        source, start, stop, c.effect, c.symbol or c.name, c.balance,
        Value(value, stddev, c.unit), 1.0 - float(np.exp(-gain)),
        f"between {start:.1f} and {stop:.1f} s {words} {'rose' if value > 0.0 else 'fell'} by "
        f"{with_uncertainty(abs(value), stddev, c.unit)}")


class _Steps:
    """Steps of the terms that one recording carries in one balance.

    Parameters
    ----------
    table, course : of the recording.
    """

    def __init__(self, table: Table, course: Course, policy: Policy):
        self.table, self.course, self.policy = table, course, policy
        self.of = {one.name: one for one in table.candidates}
        self.names = [name.term for name in alone(table, policy).names if name.effect != DRIFT]
        self.terms = [name for name in dict.fromkeys((*PLAIN, *self.names))
                      if name in table.places]
        t = np.linspace(-1.0, 1.0, len(table.rows))[:, None]
        damping = [table.places[name] for name in self.names if name == DAMPING]
        self.rows = np.hstack([table.rows, *(
            table.rows[:, [place]] * np.hstack([t, t**2]) for place in damping)])
        self.drift = list(range(table.rows.shape[1], self.rows.shape[1]))
        group = np.arange(len(table.numbers)) * min(BLOCKS / len(table.numbers), 1.0)
        self.group = group.astype(int)

    @cached_property
    def whose(self) -> np.ndarray:
        """Block of each compared sample that counts, (n,)."""
        table = self.table
        return self.group[np.searchsorted(table.numbers, table.block[table.good])]

    @cached_property
    def blocks(self) -> np.ndarray:
        """Products of each block, (b, 1 + k, 1 + k)."""
        rows = self.rows[self.table.good]
        parts = np.split(rows, np.flatnonzero(np.diff(self.whose)) + 1)
        return np.array([part.T @ part for part in parts])

    @cached_property
    def edges(self) -> np.ndarray:
        """When each block begins, and the last one ends, (b + 1,) s."""
        table = self.table
        first = np.flatnonzero(np.diff(self.group, prepend=-1))
        begins = np.searchsorted(table.block, table.numbers[first]) * table.dt
        return np.append(begins, len(table.block) * table.dt)

    @property
    def range(self) -> range:
        """Blocks before which a change may lie."""
        least = max(FEWEST, round(LEAST * len(self.blocks)))
        return range(least, len(self.blocks) - least + 1)

    def largest(self) -> ChangePoint | None:
        """Return the step that gains most, if it is a change of the machine."""
        policy = self.policy
        if not self.range:
            return None
        gains = self.gains(np.arange(len(self.blocks)))
        most = max((gain for row in gains.values() for gain in row), default=0.0)
        owed = policy.named + policy.alone
        for order in self.orders():
            if most <= owed:
                return None
            owed = max(owed, policy.alone + max(
                float(row.max()) for row in self.gains(order).values()))
        if most <= owed:
            return None
        # Of what does as well, what every model has: it is the plainest.
        name = next(name for name in gains if gains[name].max() > most - policy.alone)
        whole, drifting = self.drifting(name)
        if gains[name].max() <= drifting + policy.alone:
            return None
        if whole * np.exp(-gains[name].max()) > policy.open * self.table.size:
            return None  # of a balance that stays open no number is known
        place = self.range[ties.largest(gains[name])]
        own, value, chance, stddev, least = self.fitted(name, place)
        # As oil warms, and a gain differs by the shape of a motion, a number moves a little.
        little = policy.between if self.of[name].of_oil else policy.worse
        if not self.of[name].sign:  # a load of nil may become hardly any: of what the force is
            column = self.table.rows[self.table.good, self.table.places[name]]
            own = max(own, self.table.size / rms(column))
        if abs(value) < max(policy.owed * chance, little * own) or least or not policy.sure(
                value, stddev):
            return None
        start, stop = self.edges[[place - 1, place + 1]].tolist()
        return _told(self.table.source, self.of[name], (start, stop), float(gains[name].max()),
                     (value, stddev))

    def orders(self) -> Iterator[np.ndarray]:
        """Yield the blocks in the order of their speed, and of their position; (b,)."""
        course, table = self.course, self.table
        count = np.bincount(self.whose)
        for values in (np.square(course.compared(course.v)), course.compared(course.x)):
            mean = np.bincount(self.whose, values[table.good]) / count
            yield np.argsort(mean, kind="stable")

    def gains(self, order: np.ndarray) -> dict[str, np.ndarray]:
        """Return the log units on unseen blocks that steps gain, by term: of each of ``range``.

        Parameters
        ----------
        order : (b,) blocks, those with a step last.
        """
        fold, found = order // 2 % FOLDS, {}
        for name in self.terms:
            places, signs, least = self.beside(name)
            blocks = self.blocks[order][:, places][:, :, places]
            parts = [blocks[fold == one].sum(axis=0) for one in range(FOLDS)]
            whole = sum(_left(sum(parts) - part, part, signs, least) for part in parts)
            rows = self.blocks[order][:, places[-1]][:, [*places, places[-1]]]
            later = [np.cumsum(np.where((fold == one)[:, None], rows, 0.0)[::-1], axis=0)[::-1]
                     for one in range(FOLDS)]
            free, bounds, gains = np.append(signs, 0.0), np.append(least, 0.0), []
            for i in self.range:  # a step has either sign
                grams = [_bordered(part, row[i]) for part, row in zip(parts, later, strict=True)]
                total = sum(grams)
                left = sum(_left(total - part, part, free, bounds) for part in grams)
                gains.append(0.5 * np.log(whole / left))
            found[name] = np.array(gains)
        return found

    def drifting(self, name: str) -> tuple[float, float]:
        """Return the rms on unseen blocks, and the log units that a drift of a term gains."""
        places, signs, least = self.beside(name)
        rows = self.rows[:, places]
        rows = np.hstack([rows, rows[:, -1:] * np.linspace(-1.0, 1.0, len(rows))[:, None]])
        rows, fold = rows[self.table.good], self.whose // 2 % FOLDS
        parts = [rows[fold == one].T @ rows[fold == one] for one in range(FOLDS)]
        whole = sum(_left((sum(parts) - part)[:-1, :-1], part[:-1, :-1], signs, least)
                    for part in parts)
        free, bounds = np.append(signs, 0.0), np.append(least, 0.0)
        left = sum(_left(sum(parts) - part, part, free, bounds) for part in parts)
        return float(np.sqrt(whole / self.table.n)), 0.5 * float(np.log(whole / left))

    def beside(self, name: str) -> tuple[list[int], np.ndarray, np.ndarray]:
        """Return the columns of the model with a term, that one last, their signs and bounds."""
        table = self.table
        own = [table.places[other] for other in self.names if other != name]
        own.append(table.places[name])
        none = np.zeros(len(self.drift))
        return ([0, *self.drift, *own], np.append(none, table.signs[own]),
                np.append(none, table.least[own]))

    def fitted(self, name: str, place: int) -> tuple[float, float, float, float, bool]:
        """Return a parameter before a block, its step there, deviation by chance, and whole.

        The latter holds what a missing law may look like as well.  And whether the parameter is
        less than nothing since.
        """
        table, policy, c = self.table, self.policy, self.of[name]
        places, signs, least = self.beside(name)
        gram = _bordered(self.blocks.sum(axis=0)[np.ix_(places, places)],
                         self.blocks[place:].sum(axis=0)[places[-1], [*places, places[-1]]])
        w = signed_solution(gram[1:, 1:], gram[1:, 0], np.append(signs, 0.0),
                            np.append(least, 0.0))
        since = np.searchsorted(table.numbers, table.block) >= np.searchsorted(self.group, place)
        rest = np.where(table.good, self.rows[:, places] @ np.append(1.0, -w[:-1])
                        - w[-1] * since * self.rows[:, places[-1]], np.nan)
        left, inverse = float(np.nanmean(rest**2)), inverse_of(gram[1:, 1:])[-1, -1]
        chance = left * independent(rest) * inverse
        form = policy.alike(left, table.floor**2) * table.n * inverse
        return (abs(float(w[-2]) + c.configured), float(w[-1]), float(np.sqrt(chance)),
                float(np.sqrt(chance + form)),
                bool(c.sign) and c.sign * float(w[-2:].sum()) < c.least)


def _bordered(gram: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Return products (k, k) with those of one more column, (k + 1,), its own square last."""
    found = np.empty((len(gram) + 1,) * 2)
    found[:-1, :-1] = gram
    found[-1, :] = found[:, -1] = row
    return found


def _left(fit: np.ndarray, judge: np.ndarray, signs: np.ndarray, least: np.ndarray) -> float:
    """Return the squares that a fit on some products leaves of others."""
    mixture = np.append(1.0, -signed_solution(fit[1:, 1:], fit[1:, 0], signs, least))
    return max(float(mixture @ judge @ mixture), 1e-300)


def oil_change(course: Course, rig: Rig, policy: Policy) -> ChangePoint | None:
    """Return when 1/beta_e stepped, None where it did not.

    A step is surely there, and more than the ``between`` by which the oil of a machine differs
    from recording to recording.  The deviations hold what the rest of the flow may look like, the
    same before and since: of healthy oil no step of 200 recordings came to 2 of them.  Parts whose
    motion does not determine the oil count for none.
    """
    count = min(MOST_PARTS, int(course.seconds / PART_S))
    if count < 2 * FEWEST_PARTS or not course.has_flow:
        return None
    t = np.arange(len(course)) * course.dt
    edges = np.linspace(t[course.good][0], t[course.good][-1], count + 1)
    parts = np.searchsorted(edges, t, side="right") - 1
    cut = [replace(course, good=course.good & (parts == i), moving=course.moving & (parts == i))
           for i in range(count)]
    known = [(i, term.value, term.stddev) for i, part in enumerate(cut)
             if part.has_flow and (term := compressibility(part, rig)) is not None]
    if len(known) < 2 * FEWEST_PARTS:
        return None
    place, value, stddev = (np.array(column) for column in zip(*known, strict=True))
    weight = 1.0 / stddev**2
    steps = []
    for k in range(FEWEST_PARTS, len(known) - FEWEST_PARTS + 1):
        before, since = (float(np.average(value[some], weights=weight[some]))
                         for some in (slice(None, k), slice(k, None)))
        # Their form is the same in all parts: it is no chance, and no number of parts narrows it.
        apart = float(np.hypot(*(np.median(stddev[some]) for some in (
            slice(None, k), slice(k, None)))))
        steps.append((abs(since - before) / apart, before, since, apart, k))
    size, before, since, apart, k = ties.best(steps, lambda step: step[0])
    if size < policy.varied or abs(since - before) < policy.between * before:
        return None
    start, stop = float(edges[place[k - 1]]), float(edges[place[k] + 1])
    moduli = [1.0 / one for one in (before, since)]
    error = apart / since**2
    words = " to ".join((with_uncertainty(moduli[0], apart / before**2, "Pa"),
                         with_uncertainty(moduli[1], error, "Pa")))
    return ChangePoint(
        course.source, start, stop, "bulk_modulus", "beta_e", "flow",
        Value(moduli[1] - moduli[0], float(np.hypot(apart / before**2, error)), "Pa"), 0.0,
        f"between {start:.1f} and {stop:.1f} s the effective bulk modulus "
        f"{'rose' if moduli[1] > moduli[0] else 'fell'} from {words}")
