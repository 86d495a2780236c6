"""Damping and leakage beside the oil: which of them has changed, and which has its temperature.

Viscous damping grows with the oil's viscosity and a laminar leakage falls with it (Merritt 1967):
over healthy recordings at several temperatures ln B and ln L scatter against each other, and
ln B + ln L hardly at all.  Where that is so, a recording is compared by that sum as well: if it is
off, either B or L has changed, whichever asks for an oil more like that of the references.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from eha_monitor.balances.candidates import FORCE_OF_SENSORS
from eha_monitor.balances.course import Course
from eha_monitor.balances.judge import judge
from eha_monitor.balances.judged import Judged, Moved
from eha_monitor.balances.machine import Machine
from eha_monitor.balances.scatter import t_of_next
from eha_monitor.balances.warmth import POWERS, healthy_at, viscosity_of
from eha_monitor.settings.monitor import Settings

VISCOUS = tuple(POWERS)


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
    at, (value, total, chance) = healthy_at(machine, viscosity, name), judged.values[name]
    if at is None or not value + at.more > 0.0:
        return None
    t, limit = at.t_of(value + at.more, chance, machine.policy.false)
    if not abs(t) > limit:
        return None
    return Moved(judged.of[name], value, total, at.beyond, at.stddev, t, limit,
                 rivals=FORCE_OF_SENSORS[:1] if name == "L" else (),
                 apart=abs((value - at.beyond) / t), given=" at the temperature of its oil")


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
    value, total, chance = (np.array(row) for row in zip(
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
    return Moved(of[VISCOUS[i]], float(value[i]), float(total[i]), healthy - float(more[i]),
                 healthy * float(np.hypot(spread, noise)), t, limit, rivals=rivals,
                 apart=healthy * abs(float(np.expm1(off) / t)),
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
