"""The next recording of a machine: what of it has changed, in a fraction of a second.

By its balances; beside the oil; and by the lowest pressure of the chambers, that of what feeds
them (accumulator, check valves).

Viscous damping grows with the oil's viscosity and a laminar leakage falls with it (Merritt 1967):
over healthy recordings at several temperatures ln B and ln L scatter against each other, and
ln B + ln L hardly at all.  Where that is so, a recording is compared by that sum as well: if it is
off, either B or L has changed, whichever asks for an oil more like that of the references.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from eha_monitor.balances.beside import Beside
from eha_monitor.balances.candidates import FORCE_OF_SENSORS, balances_in, candidates_of
from eha_monitor.balances.course import BOTH, Course
from eha_monitor.balances.judged import Judged, Moved
from eha_monitor.balances.machine import Machine, usual_of
from eha_monitor.balances.scatter import t_of_next
from eha_monitor.balances.table import pooled_table, tables_of
from eha_monitor.balances.together import setting_of
from eha_monitor.balances.warmth import POWERS, at_oil, healthy_at, viscosity_of
from eha_monitor.mismatch.diagnosis import Change, Value
from eha_monitor.quantity import with_uncertainty
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig

BEYOND = 0.1  # of the healthy recordings' stroke: as far as their terms hold
LOWEST = 0.05  # of the lowest pressure: less of it is no change
LEAST_SPREAD = 1e-3  # of the lowest pressure: what healthy recordings differ by at least
VISCOUS = tuple(POWERS)


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


def judge_with_oil(machine: Machine, courses: Sequence[Course], settings: Settings) -> Judged:
    """Judge motions against a machine by their balances, and by the viscosity of their oil."""
    return beside_viscosity(machine, judge(machine, courses, settings),
                            viscosity_of(courses)).apart()


def beside_viscosity(machine: Machine, judged: Judged, viscosity: float) -> Judged:
    """Return a recording with B or L as changed too, where one has moved beside the other.

    One that has changed by little at the temperature of its oil is what differs but is small.

    Parameters
    ----------
    viscosity : of the recording's oil, as :attr:`Machine.viscosity`; NaN where not measured.
    """
    warm = [moved for name in POWERS
            if (moved := _at_temperature(machine, judged, viscosity, name)) is not None]
    for moved in warm or [_beside_the_other(machine, judged)]:
        if moved is not None:
            judged = replace(judged, balances=tuple(
                one if one.balance != moved.candidate.balance else one.with_change(moved)
                if not warm or _much(moved, machine) else replace(one, small=one.small or moved)
                for one in judged.balances))
    return judged


def _much(moved: Moved, machine: Machine) -> bool:
    """Tell whether a number has changed by more than ``near`` of what the machine has of it."""
    before = moved.machine + (machine.known_leakage if moved.candidate.name == "L" else 0.0)
    return abs(moved.here - moved.machine) > machine.policy.near * abs(before)


def _at_temperature(machine: Machine, judged: Judged, viscosity: float, name: str) -> Moved | None:
    """Return B or L where it has changed at the temperature of its oil; None where it has not.

    Nor is a leakage said beside what moves it by itself: another leak, or a sensor of pressure.
    """
    if name not in judged.values or any(moved.candidate.name == name or (name == "L" and (
            moved.candidate.family == "gap" or set(FORCE_OF_SENSORS) & set(moved.rivals)))
            for moved in judged.changed):
        return None
    at, (value, _, chance) = healthy_at(machine, viscosity, name), judged.values[name]
    if at is None or not value + at.more > 0.0:
        return None
    t, limit = at.t_of(value + at.more, chance, machine.policy.false)
    if not abs(t) > limit:
        return None
    apart = abs((value - at.beyond) / t)  # what both values share is in neither
    return Moved(judged.of[name], value, float(np.hypot(at.stddev, apart)), at.beyond, at.stddev,
                 t, limit, rivals=FORCE_OF_SENSORS[:1] if name == "L" else (), apart=apart,
                 given=" at the temperature of its oil")


def _beside_the_other(machine: Machine, judged: Judged) -> Moved | None:
    """Return B or L where it has changed beside the other; None where nothing says so.

    Nor is it said beside what moves either by itself: another leak, or a sensor of pressure.
    """
    policy, of = machine.policy, judged.of
    if any(name not in judged.values for name in VISCOUS) or any(
            moved.candidate.name in VISCOUS or moved.candidate.family == "gap"
            or set(FORCE_OF_SENSORS) & set(moved.rivals) for moved in judged.changed):
        return None
    more = np.array([of["L"].configured if name == "L" else 0.0 for name in VISCOUS])
    found = _steady_sum(machine, more)
    value, _, chance = (np.array(row) for row in zip(
        *(judged.values[name] for name in VISCOUS), strict=True))
    if found is None or not (value + more > 0.0).all():
        return None
    logs, noise = found
    here, own = np.log(value + more), float(np.linalg.norm(chance / (value + more)))
    means, spreads, runs = logs.mean(axis=0), logs.std(axis=0, ddof=1), len(logs)
    spread = float(logs.sum(axis=1).std(ddof=1))
    off = float((here - means).sum())
    t, limit = t_of_next(off, spread, runs, policy.false, (own, noise))
    if not abs(t) > limit or not abs(np.expm1(off)) > policy.near:
        return None
    # If B has changed the oil is as L shows it, and the other way round.
    warm = np.abs(here - means)[::-1] / spreads
    i = int(np.argmin(warm))
    healthy = float(np.exp(means.sum() - here[1 - i]))
    rivals = (of[VISCOUS[1 - i]].effect,) if warm[1 - i] < policy.varied else ()
    rivals += FORCE_OF_SENSORS[:1] if VISCOUS[i] == "L" else ()  # its zero makes a leak
    usual, apart = healthy * float(np.hypot(spread, noise)), healthy * abs(float(
        np.expm1(off) / t))
    return Moved(of[VISCOUS[i]], float(value[i]), float(np.hypot(usual, apart)),
                 healthy - float(more[i]), usual, t, limit, rivals=rivals, apart=apart,
                 given=f" with the oil that the {('leakage', 'damping')[i]} shows")


def _steady_sum(machine: Machine, more: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return ln B and ln L of each reference, (r, 2), and the usual deviation of their sum.

    None where the sum is not surely steadier than both, by Student's t of Pitman (1939) and Morgan
    (1939) for two variances of the same recordings; or where these are parts of one, of one oil.

    Parameters
    ----------
    more : what the config has of both beside, (2,).
    """
    rows = [(value + held, deviation) for name, held in zip(VISCOUS, more, strict=True)
            for value, deviation in machine.of_references(name)]
    if machine.pieces or len(rows) < 2 or any((value <= 0.0).any() for value, _ in rows):
        return None
    logs = np.log(np.transpose([value for value, _ in rows]))
    both = logs.sum(axis=1)
    if min(steadier(one, both) for one in logs.T) < machine.policy.repeats:
        return None
    return logs, float(np.median(np.linalg.norm([d / v for v, d in rows], axis=0)))


def steadier(one: np.ndarray, other: np.ndarray) -> float:
    """Return Student's t of the other varying less than the one, over the same recordings."""
    if len(one) < 3:
        return 0.0
    r = float(np.corrcoef(one + other, one - other)[0, 1])
    return r * float(np.sqrt((len(one) - 2) / max(1.0 - r * r, 1e-12)))


def source_of(machine: Machine, courses: Sequence[Course], rig: Rig, load: Moved | None
            ) -> Change | None:
    """Return how the lowest pressure of the chambers has changed, if farther than healthy.

    By Student's t for one further recording, and by more than ``LOWEST`` of itself.  What feeds
    both has changed where both have; one alone has its own make-up valve, or sensor.  Behind a
    valve, and where chambers are closed to each other, a load moves the lower pressure.  Nor has a
    source risen below which a chamber still comes: a load leaves it less time there.
    """
    if machine.oil == BOTH or machine.pieces or not all(course.has_flow for course in courses):
        return None
    means = np.mean([course.lowest(rig) for course in courses], axis=0)
    off, alike = {}, []  # chamber -> healthy and present pressure; those that are as before
    for chamber, row, here in zip((1, 2), machine.lowest, means.tolist(), strict=True):
        if not np.isfinite(here) or len(row) < machine.policy.fewest:
            continue
        of = float(np.mean(row))
        spread = max(float(np.std(row, ddof=1)), LEAST_SPREAD * of)
        t, limit = t_of_next(here - of, spread, len(row), machine.policy.false)
        still = here > of and any(
            course.as_low(rig, chamber, 0.5 * (here + of)) for course in courses)
        if abs(t) > limit and abs(here - of) > LOWEST * of and not still:
            off[chamber] = (of, here, spread)
        else:
            alike.append(chamber)
    if not off:
        return None
    of, here, spread = np.mean(list(off.values()), axis=0).tolist()
    if load is not None and abs(here - of) * min(rig.area_1, rig.area_2) <= abs(
            load.here - load.machine):
        return None
    what, whose, rest = "charge_pressure", (
        "the lowest pressure of a chamber, that of what feeds it (accumulator, check valve),"), ""
    if alike:
        what, whose, rest = "makeup_valve", f"the lowest pressure of chamber {min(off)}", (
            f", and that of chamber {alike[0]} as before: its own make-up valve or line has "
            "changed, not what feeds both")
    return Change(what, "", "flow", Value(of, spread, "Pa"), Value(here, spread, "Pa"), "Pa", (
        f"{whose} is {with_uncertainty(here, spread, 'Pa')}, where {machine.runs} have "
        f"{with_uncertainty(of, spread, 'Pa')}{rest}"), ("pressure_offset",))
