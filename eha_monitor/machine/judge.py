"""The next recording of a machine: by its balances alone, in a fraction of a second."""

from dataclasses import dataclass

import numpy as np

from eha_monitor.machine.candidates import candidates_of
from eha_monitor.machine.course import course_of
from eha_monitor.machine.least_squares import independent, inverse_of, signed_solution
from eha_monitor.machine.machine import Machine
from eha_monitor.machine.table import tables_of
from eha_monitor.machine.together import setting_of, unseen
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings


@dataclass(frozen=True)
class Moved:
    """A parameter in the next recording: there, in the machine, and how many deviations apart."""

    name: str
    words: str
    unit: str
    here: float
    stddev: float
    machine: float
    deviations: float


@dataclass(frozen=True)
class Judged:
    """The next recording beside the machine.

    Attributes
    ----------
    error : of each balance, over its standard deviation, the machine's parameters held.
    usual : the largest error that a recording of the machine had when it was left out.
    moved : every parameter, the farthest first.
    settings : the numbers of its setting, by name: (value, stddev).
    """

    source: str
    error: dict[str, float]
    usual: dict[str, float]
    moved: tuple[Moved, ...]
    settings: dict[str, tuple[float, float]]
    limit: float

    @property
    def changed(self) -> tuple[Moved, ...]:
        """Parameters beyond the spread of the machine's recordings."""
        return tuple(one for one in self.moved if abs(one.deviations) > self.limit)

    @property
    def belongs(self) -> bool:
        """Whether it is like the machine's own recordings."""
        return not self.changed and all(
            self.error[name] <= 1.5 * self.usual[name] for name in self.error)


def judge(machine: Machine, recording: Recording, settings: Settings) -> Judged:
    """Judge a recording against a machine: in a fraction of a second, by its balances alone."""
    course, rig, policy = course_of(recording, settings), settings.rig, machine.policy
    error, usual, moved, own = {}, {}, [], {}
    for one in machine.balances:
        names = set(one.terms)
        kept = tuple(c for c in candidates_of(one.balance, machine.scale, rig)
                     if c.name in names)
        (table,) = tables_of([course], rig, one.balance, kept, policy)
        shared = [table.places[p.name] for p in one.parameters]
        free = [table.places[s.name] for s in one.settings]
        w = np.array([p.value for p in one.parameters])
        error[one.balance] = unseen(table, shared, free, w)
        usual[one.balance] = max(one.error)
        value, stddev = setting_of(table, shared, free, w)
        own |= {s.name: (float(v), float(d)) for s, v, d in zip(
            one.settings, value, stddev, strict=True)}
        places = [*shared, *free]
        signs = np.array([*(table.candidates[i - 1].sign for i in shared), *(0 for _ in free)])
        gram = table.gram
        here = signed_solution(gram[np.ix_(places, places)], gram[places, 0], signs)
        left = max(float(gram[0, 0] - here @ gram[places, 0]), 0.0) / table.n
        residual = table.left(dict(zip([table.candidates[i - 1].name for i in places], here,
                                       strict=True)))
        worth = independent(np.where(table.good, residual, np.nan))
        deviation = np.sqrt(np.diag(inverse_of(gram[np.ix_(places, places)])) * left * worth)
        for p, found, spread in zip(one.parameters, here, deviation, strict=False):
            apart = (found - p.value) / max(np.sqrt(spread**2 + p.between**2 + p.stddev**2),
                                            1e-300)
            moved.append(Moved(p.name, p.words, p.unit, float(found), float(spread), p.value,
                               float(apart)))
    moved.sort(key=lambda one: -abs(one.deviations))
    return Judged(recording.source, error, usual, tuple(moved), own, policy.odd)
