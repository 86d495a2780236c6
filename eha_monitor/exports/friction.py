"""The force that the identified model puts against the motion, as a function of the velocity."""

from dataclasses import dataclass

import numpy as np

from eha_monitor.exports.model import Model
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import (
    ALL_NAMES,
    add_contributions,
    new_memory,
    with_term,
)
from eha_monitor.physics.dry_friction import V_E
from eha_monitor.physics.effects import NAMES
from eha_monitor.physics.excitation import demanded_position, total_duration
from eha_monitor.physics.parameters import theta_of

_LONG_AGO = -1e9  # m: a seal that has slid so far has its steady force
_ELSEWHERE = (-3e-3, 8e-3, 2e-2)  # m: what is not there as at x = 0 depends on the position
_SAMPLES = 20001  # of the config's own motion
SIGN = 10.0  # times the velocity over which a sign is smoothed: it is 1
SLOWEST, FITTED = 0.02, 0.1  # of the fastest speed: where a joint's law is compared, and fitted
KNOTS = 20  # of a table, on each side of standstill


@dataclass(frozen=True)
class Motion:
    """The config's own motion: range of x_d in m, fastest |x_d'| in m/s."""

    lowest: float
    highest: float
    speed: float


@dataclass(frozen=True)
class Law:
    """Force against positive motion over velocity, at x = 0 and the charge pressure.

    Attributes
    ----------
    velocity, force : (n,) m/s and N, all that acts, with B v.
    viscous : B, N·s/m;  dry : (n,) N, the force less B v and less the load.
    load : force at rest, N;  mass : moving mass with what effects add, kg.
    by_position : effects and own terms that depend on the position; held at x = 0.
    by_velocity : those that are no load and no mass.
    names : effects and own terms of the force balance that are in it.
    """

    velocity: np.ndarray
    force: np.ndarray
    viscous: float
    dry: np.ndarray
    load: float
    mass: float
    by_position: tuple[str, ...]
    by_velocity: tuple[str, ...]
    names: tuple[str, ...]


@dataclass(frozen=True)
class TwoNumbers:
    """What a simulator's joint takes: F = damping v + friction sgn v.

    Attributes
    ----------
    damping, friction : N·s/m and N.
    error : N, largest difference from the law;  at : m/s, where.
    """

    damping: float
    friction: float
    error: float
    at: float


def motion_of(model: Model) -> Motion:
    """Return what the config's own excitation demands; a step counts as no speed."""
    excitation = model.settings.simulation.excitation
    time = np.linspace(0.0, total_duration(excitation), _SAMPLES)[:-1]
    x_d = demanded_position(excitation, time)
    slope = np.abs(np.diff(x_d)) / (time[1] - time[0])
    steps = any(one.kind == "steps" for one in excitation.values())
    speed = float(np.quantile(slope, 0.99)) if steps else float(slope.max())
    return Motion(float(x_d.min()), float(x_d.max()), speed)


def law_of(model: Model, velocity: np.ndarray) -> Law:
    """Return the law at some velocities, from the very terms that the simulator runs."""
    rig = model.settings.rig
    theta, active = theta_of(rig, model.settings.effects)
    whole = _forces(model, theta, active, velocity, 0.0)
    rest = _forces(model, theta, active, np.zeros(1), 0.0)[0]
    by_position, by_velocity, names = [], [], []
    own = iter(range(len(NAMES), len(ALL_NAMES)))
    for name in model.settings.effects:
        alone = np.zeros_like(active)
        alone[next(own) if name in model.own_terms else NAMES.index(name)] = True
        at = [_forces(model, theta, alone, velocity, x) for x in (0.0, *_ELSEWHERE)]
        if any(np.any(one[:, 0] != at[0][:, 0]) for one in at[1:]):
            by_position.append(name)
        if np.ptp(at[0][:, 0]) > 0.0:
            by_velocity.append(name)
        if any(np.any(one != 0.0) for one in at):
            names.append(name)
    viscous = rig.viscous_damping * velocity
    return Law(velocity, viscous + whole[:, 0], rig.viscous_damping, whole[:, 0] - rest[0],
               float(rest[0]), rig.mass + float(rest[1]), tuple(by_position),
               tuple(by_velocity), tuple(names))


def _forces(model: Model, theta: np.ndarray, active: np.ndarray, velocity: np.ndarray, x: float
            ) -> np.ndarray:
    """Return force and added mass of the active effects in steady motion, (n, 2) N and kg."""
    rig = model.settings.rig
    memory, terms = new_memory(), with_term(active)
    memory[:, 1] = _LONG_AGO
    row, c = np.zeros(s.N_SIGNALS), np.zeros(s.N_CONTRIBUTIONS)
    row[s.X], row[s.X_D], row[s.P1] = x, x, rig.charge_pressure
    unequal = None not in (rig.area_1, rig.area_2)
    row[s.P2] = rig.charge_pressure * (rig.area_1 / rig.area_2 if unequal else 1.0)
    found = np.zeros((len(velocity), 2))
    for i, v in enumerate(velocity):
        row[s.V] = v
        add_contributions(row, theta, terms, memory, c)
        found[i] = c[s.FORCE], c[s.MASS]
    return found


def table_velocities(fastest: float) -> np.ndarray:
    """Return velocities of a table, m/s: closer near standstill, where friction bends."""
    half = fastest * np.linspace(0.0, 1.0, KNOTS + 1)[1:] ** 2
    return np.concatenate([-half[::-1], [0.0], half])


def two_numbers(model: Model, fastest: float) -> TwoNumbers:
    """Return damping and Coulomb friction of the law's odd part, for speeds up to ``fastest``.

    Exact where the law is viscous and Coulomb friction; else the least squares over the speeds
    above a tenth of ``fastest``: what only happens at creeping speed must not tilt the rest.
    """
    # Where the sign of the velocity is smoothed, a joint's own Coulomb friction is meant.
    smooth = SIGN * max((values[V_E.name] for values in model.effects.values()
                         if V_E.name in values), default=0.0)
    speed = np.linspace(max(SLOWEST * fastest, min(smooth, 0.5 * fastest)), fastest, 197)
    forwards, backwards = law_of(model, speed), law_of(model, -speed)
    odd = 0.5 * (forwards.force - backwards.force)
    fitted = speed >= FITTED * fastest
    columns = np.column_stack([speed, np.ones_like(speed)])[fitted]
    damping, friction = (float(one) for one in np.linalg.lstsq(columns, odd[fitted])[0])
    friction = 0.0 if abs(friction) < 1e-9 * abs(odd).max() else friction
    if friction < 0.0 or damping < 0.0:  # no joint takes what drives it
        damping, friction = max(float(odd @ speed / (speed @ speed)), 0.0), 0.0
    simple = damping * speed + friction
    off = np.abs(np.concatenate([forwards.force - forwards.load - simple,
                                 backwards.force - backwards.load + simple]))
    worst = int(np.argmax(off))
    return TwoNumbers(damping, friction, float(off[worst]), float(speed[worst % len(speed)]))
