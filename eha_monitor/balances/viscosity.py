"""Damping beside the leakage of the same oil: a change that is less than its warmth makes.

Viscous damping grows with the oil's viscosity and a laminar leakage falls with it (Merritt 1967):
over healthy recordings at several temperatures ln B and ln L scatter against each other, and
ln B + ln L hardly at all.  Where that is so, a recording is compared by that sum as well: if it is
off, either B or L has changed, whichever asks for an oil more like that of the references.
"""

from dataclasses import replace

import numpy as np

from eha_monitor.balances.judge import Judged, Moved
from eha_monitor.balances.machine import Machine
from eha_monitor.balances.named import FORCE_OF_SENSORS
from eha_monitor.balances.scatter import limit_of
from eha_monitor.settings.rig import Rig

BOTH = ("B", "L")


def beside_viscosity(machine: Machine, judged: Judged, rig: Rig) -> Judged:
    """Return a recording with B or L as changed too, where one has moved beside the other."""
    moved = _moved(machine, judged, rig)
    return judged if moved is None else replace(judged, balances=tuple(
        one.with_change(moved) if one.balance == moved.candidate.balance else one
        for one in judged.balances))


def _moved(machine: Machine, judged: Judged, rig: Rig) -> Moved | None:
    """Return B or L where it has changed beside the other; None where nothing says so.

    Nor is it said beside what moves either by itself: another leak, or a sensor of pressure.
    """
    policy, found = machine.policy, _references(machine, rig)
    if found is None or any(name not in judged.values for name in BOTH) or any(
            moved.candidate.name in BOTH or moved.candidate.family == "gap"
            or set(FORCE_OF_SENSORS) & set(moved.rivals) for moved in judged.changed):
        return None
    logs, noise = found
    more = np.array([0.0, 0.5 * rig.leakage])
    value, total, chance = (np.array(row) for row in zip(
        *(judged.values[name] for name in BOTH), strict=True))
    if not (value + more > 0.0).all():
        return None
    here, own = np.log(value + more), float(np.linalg.norm(chance / (value + more)))
    means, spreads, runs = logs.mean(axis=0), logs.std(axis=0, ddof=1), len(logs)
    spread = float(logs.sum(axis=1).std(ddof=1))
    off, limit = float((here - means).sum()), limit_of(runs, 1.0, policy.false)
    t = off / np.sqrt(spread**2 * (1.0 + 1.0 / runs) + max(own**2 - noise**2, 0.0))
    if not abs(t) > limit or not abs(np.expm1(off)) > policy.near:
        return None
    # If B has changed the oil is as L shows it, and the other way round.
    warm = np.abs(here - means)[::-1] / spreads
    i = int(np.argmin(warm))
    healthy = float(np.exp(means.sum() - here[1 - i]))
    of = {c.name: c for one in judged.balances for c in one.table.candidates}
    rivals = (of[BOTH[1 - i]].effect,) if warm[1 - i] < policy.varied else ()
    rivals += FORCE_OF_SENSORS[:1] if BOTH[i] == "L" else ()  # its zero makes a leak where none is
    return Moved(of[BOTH[i]], float(value[i]), float(total[i]), healthy - float(more[i]),
                 healthy * float(np.hypot(spread, noise)), float(t), limit, rivals=rivals,
                 apart=healthy * abs(float(np.expm1(off) / t)),
                 given=f" with the oil that the {('leakage', 'damping')[i]} shows")


def _references(machine: Machine, rig: Rig) -> tuple[np.ndarray, float] | None:
    """Return ln B and ln L of each reference, (r, 2), and the usual deviation of their sum.

    None where the sum is not surely steadier than both, by Student's t of Pitman (1939) and Morgan
    (1939) for two variances of the same recordings; or where these are parts of one, of one oil.
    """
    rows = [(np.array(one.each)[:, j] + (p.name == "L") * 0.5 * rig.leakage,
             np.array(one.each_stddev)[:, j])
            for name in BOTH for one in machine.balances
            for j, p in enumerate(one.parameters) if p.name == name]
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
