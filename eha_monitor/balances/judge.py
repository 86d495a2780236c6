"""The next recording of a machine: what of it has changed, in a fraction of a second."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from eha_monitor.balances.beside import Beside
from eha_monitor.balances.candidates import balances_in, candidates_of
from eha_monitor.balances.course import Course
from eha_monitor.balances.judged import Judged
from eha_monitor.balances.machine import Machine, usual_of
from eha_monitor.balances.table import pooled_table, tables_of
from eha_monitor.balances.together import setting_of
from eha_monitor.balances.warmth import at_oil, viscosity_of
from eha_monitor.settings.monitor import Settings

BEYOND = 0.1  # of the healthy recordings' stroke: as far as their terms hold


def judge(machine: Machine, courses: Sequence[Course], settings: Settings) -> Judged:
    """Judge motions of one state against a machine: together, by their balances alone."""
    rig, courses = settings.rig, machine.moved(courses)
    found, own, values, there = [], {}, {}, balances_in(courses, rig)
    for one in at_oil(machine, viscosity_of(courses)):
        if one.balance not in there:
            continue
        candidates = tuple(c for c in candidates_of(one.balance, machine.scale, rig)
                           if c.name in {*one.terms, *one.scatter.names})
        compared = courses if one.balance != "drive" else within_speed(
            courses, machine.scale.tops[:1])
        if not all(course.good.any() for course in compared):
            continue
        tables = tables_of(compared, rig, one.balance, candidates, machine.policy)
        table = pooled_table(tables)
        usual, loose = usual_of(one.settings, {
            c.name: c for c in candidates if c.name in table.places})
        held = {p.name: p.value for p in one.parameters if p.name in table.places} | usual
        loads = {s.name for s in one.settings if s.name not in usual}
        free = [name for name in table.places if name.partition(" ")[0] in loads]
        value, stddev = setting_of(table, [table.places[name] for name in held],
                                   [table.places[name] for name in free],
                                   np.array(list(held.values())))
        own |= {name: (float(v), float(d)) for name, v, d in zip(free, value, stddev, strict=True)}
        left = Beside(one, table, held, free, loose, machine.policy, (
            rig.volume_1 or 0.0) / rig.bulk_modulus)
        beside = left.judged(machine)
        names = {*one.terms, *(moved.candidate.name for moved in beside.changed)}
        beside = replace(beside, each=tuple(tables), alone=left.times(names))
        if beside.foreign and not beside.changed and (come := left.newcomer(names)) is not None:
            beside = replace(beside.with_change(come), alone=left.times(
                {*names, come.candidate.name}), complete=True, small=None)
        found.append(beside.refused() if beside.hollow else beside)
        values |= found[-1].values(machine.policy)
    return Judged(", ".join(one.source for one in courses), tuple(found), own, values)


def within_speed(courses: Sequence[Course], tops: Sequence[float]) -> list[Course]:
    """Return motions without the samples that ask for more speed than any healthy recording.

    What a drive does there, at its limit for example, nobody has seen in health.
    """
    return [replace(course, good=course.good & (np.abs(course.wanted) <= top))
            for course in courses for top in tops] or list(courses)


def within_stroke(machine: Machine, courses: Sequence[Course]) -> tuple[list[Course], float]:
    """Return motions without the samples where no healthy recording has been, and their share.

    What a volume, a spring or a seal does there nobody has seen in health: of chambers half as
    large the oil read 15 times as stiff.
    """
    courses, scale = machine.moved(courses), machine.scale
    near, far = scale.origin - BEYOND * scale.span, scale.origin + (1.0 + BEYOND) * scale.span
    here = [(near <= course.x) & (course.x <= far) for course in courses]
    found = [replace(course, good=course.good & inside, moving=course.moving & inside)
             for course, inside in zip(courses, here, strict=True)]
    before, after = (sum(int(one.moving.sum()) for one in some) for some in (courses, found))
    return found, 1.0 - after / max(before, 1)
