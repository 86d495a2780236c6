"""The force that the identified model puts against the motion, for the joints of other programs.

:func:`law_of` gives it over the velocity, from the very terms that the simulator runs.  URDF and
MuJoCo take damping and friction of it, ros2_control a feed-forward table.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eha_monitor import __version__
from eha_monitor.exports.model import Exported, Model, rendered
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import ALL_NAMES, add_contributions, new_memory, with_term
from eha_monitor.physics.effects import NAMES
from eha_monitor.physics.effects.friction import V_E
from eha_monitor.physics.own_term import BALANCES
from eha_monitor.physics.parameters import theta_of
from eha_monitor.physics.simulator import demanded_position, total_duration
from eha_monitor.quantity import quantity
from eha_monitor.recordings.grid import filled
from eha_monitor.recordings.recording import Recording

_LONG_AGO = -1e9  # m: a seal that has slid so far has its steady force
_ELSEWHERE = (-3e-3, 8e-3, 2e-2)  # m: what is not there as at x = 0 depends on the position
_SAMPLES = 20001  # of the config's own motion
SIGN = 10.0  # times the velocity over which a sign is smoothed: it is 1
SLOWEST, FITTED = 0.02, 0.1  # of the fastest speed: where a joint's law is compared, and fitted
KNOTS = 20  # of a table, on each side of standstill
STILL = 1e-9  # m/s: a config whose motion stands still says nothing of speeds
WORTH = 0.01  # of the force: a smaller difference needs no line
SPRING = "spring_load"  # the one load by position that MuJoCo's joint has
NODE, CONTROLLER = "friction_feedforward", "joint_trajectory_controller"
ENOUGH = 0.1  # s of motion near a velocity: it is covered
DERIVATIVE = 0.02  # s over which the position is fitted for its rate


@dataclass(frozen=True)
class Motion:
    """The config's own motion: range of x_d in m, fastest |x_d'| in m/s."""

    lowest: float
    highest: float
    speed: float


@dataclass(frozen=True)
class Law:
    """Force against positive motion over velocity, at x = 0 and the charge pressure."""

    velocity: np.ndarray  # (n,) m/s
    force: np.ndarray  # (n,) N, all that acts, with B v
    viscous: float  # B, N·s/m
    dry: np.ndarray  # (n,) N, the force less B v and less the load
    load: float  # force at rest, N
    mass: float  # moving mass with what effects add, kg
    # Effects and own terms that depend on the position; held at x = 0.
    by_position: tuple[str, ...]
    by_velocity: tuple[str, ...]  # those that are no load and no mass
    names: tuple[str, ...]  # effects and own terms of the force balance that are in it

    def inertia(self, rotary: bool) -> tuple[float, float]:
        """Return mass in kg and moment of inertia in kg·m² of the link; one is for form's sake."""
        return (1.0, self.mass) if rotary else (self.mass, 1e-3 * self.mass)


@dataclass(frozen=True)
class TwoNumbers:
    """What a simulator's joint takes: F = damping v + friction sgn v."""

    damping: float  # N·s/m
    friction: float  # N
    error: float  # largest difference from the law, N
    at: float  # where that is, m/s


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


def urdf_of(model: Model, joint: str) -> Exported:
    """Return a minimal robot whose joint has the identified damping and friction.

    A prismatic joint, or a revolute one of a rig that turns.
    """
    law, two, motion = _numbers(model)
    lost = (*_lost_of_joint(model, law, two, ()),
            "limits: those of the config's own motion, not identified; set the joint's own")
    effort = two.damping * motion.speed + two.friction + abs(law.load)
    return _joint("joint.urdf.xml.j2", model, joint, law, lost, two=two, motion=motion,
                  effort=effort)


def mujoco_of(model: Model, joint: str) -> Exported:
    """Return a minimal MuJoCo model whose joint has the identified damping and friction.

    A slide joint, or a hinge of a rig that turns; a spring load becomes the joint's stiffness.
    """
    law, two, _ = _numbers(model)
    lost = _lost_of_joint(model, law, two, (SPRING,))
    return _joint("joint.mjcf.xml.j2", model, joint, law, lost, two=two,
                  step=model.settings.rig.sample_time, spring=model.effects.get(SPRING))


def _joint(template: str, model: Model, joint: str, law: Law, lost: tuple[str, ...], **facts
           ) -> Exported:
    """Return a template filled with what all joints have, and with further facts."""
    unit = "N·m·s/rad and N·m" if model.rotary else "N·s/m and N"
    mass, inertia = law.inertia(model.rotary)
    name = "".join(one if one.isalnum() or one in "_-" else "_"
                   for one in model.settings.rig.name) or "eha"
    return Exported(rendered(
        template, name=name, joint=joint, rotary=model.rotary, mass=mass, inertia=inertia,
        comments=(
            f"eha_monitor {__version__}, from {model.source}",
            f"damping and friction in {unit}; {model.provenance}",
            *(f"not in this file: {one}" for one in lost)), **facts), lost)


def _numbers(model: Model) -> tuple[Law, TwoNumbers, Motion]:
    motion = motion_of(model)
    fastest = max(motion.speed, STILL)
    return law_of(model, table_velocities(fastest)), two_numbers(model, fastest), motion


def _lost_of_joint(model: Model, law: Law, two: TwoNumbers, held: tuple[str, ...]
                   ) -> tuple[str, ...]:
    """Return what damping and friction of a joint do not say; ``held`` are effects they do."""
    lost, force = [], "N·m" if model.rotary else "N"
    speed = "rad/s" if model.rotary else "m/s"
    largest = max(abs(law.force - law.load))
    if two.error > WORTH * largest:
        lost.append(f"{', '.join(law.by_velocity)}: the joint's damping and friction are their "
                    f"straight line, off by up to {quantity(two.error, force, 2)} at "
                    f"{quantity(two.at, speed, 2)}")
    at_rest = law.load
    if SPRING in held and SPRING in model.effects:
        spring = model.effects[SPRING]
        at_rest += spring["k"] * spring["x_0"]
    if abs(at_rest) > 1e-9:
        lost.append(f"a load of {quantity(at_rest, force, 3)} against positive motion: apply it "
                    "as a force")
    lost += _taken_at(model, law, held)
    others = [name for name in model.effects if name not in law.names]
    others += [name for name, values in model.own_terms.items()
               if BALANCES[values["adds"]] != BALANCES["force"]]
    lost.append(", ".join(["hydraulics and drive (beta_e, leakage, pump, loop)", *others])
                + ": a joint has none; it takes the pressure force A1 p1 - A2 p2")
    return tuple(lost)


def _taken_at(model: Model, law: Law, held: tuple[str, ...] = ()) -> list[str]:
    """Return at which position and pressure a law over the velocity is taken; see ``held``."""
    charge = quantity(model.settings.rig.charge_pressure, "Pa", 3)
    return [*(f"{name}: the force depends on the position; taken at x = 0"
              for name in law.by_position if name not in held),
            *(f"{name}: taken at the charge pressure, {charge}"
              for name in law.names if "pressure" in name)]


def feedforward_of(model: Model, joint: str, recordings: Sequence[Recording] = ()) -> Exported:
    """Return the table, and the one number of it that a controller of ros2_controllers takes.

    ``recordings`` : what the model was identified from: they tell which velocities are covered.
    """
    motion = motion_of(model)
    seen = [velocity_of(one) for one in recordings]
    fastest = max([motion.speed, *(float(np.nanmax(np.abs(v), initial=0.0)) for v in seen)])
    velocity = table_velocities(max(fastest, 1e-6))
    law = law_of(model, velocity)
    unit = ("rad/s", "N·m", "N·m·s/rad", "kg·m²") if model.rotary else ("m/s", "N", "N·s/m", "kg")
    rows = [("velocity", velocity, f"{unit[0]}, ascending"),
            ("force", law.force, f"{unit[1]} to keep that velocity at x = 0: B v and all named "
             "effects of the force balance"),
            ("friction", law.dry, f"{unit[1]} of it: what is neither B v nor the load"),
            ("viscous_damping", float(law.viscous), f"{unit[2]}, B"),
            ("load", law.load, f"{unit[1]} at rest, against positive motion"),
            ("moving_mass", law.mass, f"{unit[3]}, for a force with the acceleration")]
    if recordings:
        seconds = covered_seconds(velocity, seen, [one.sample_time for one in recordings])
        rows += [("covered_seconds", seconds, "s of the recordings near each velocity"),
                 ("covered", seconds >= ENOUGH, f"at least {ENOUGH:g} s: elsewhere the law is "
                  "extrapolated")]
    lost = _lost_of_table(model, law, unit[1], bool(recordings))
    head = [f"Friction feed-forward of {model.settings.rig.name}: eha_monitor {__version__}, "
            f"from {model.source}.",
            f"{NODE}: a table for a node of your own; no controller of ros2_controllers reads it.",
            f"{CONTROLLER}: its one feed-forward number, to be merged with your parameters.",
            *(f"Not in this file: {one}" for one in lost)]
    return Exported(rendered(
        "feedforward.yaml.j2", head=head, node=NODE, controller=CONTROLLER, joint=joint,
        rows=rows, unit=unit[2], law=law), lost)


def _lost_of_table(model: Model, law, force: str, covered: bool) -> tuple[str, ...]:
    lost = _taken_at(model, law)
    if np.ptp(law.dry) > 0.0:
        lost.append(f"{CONTROLLER}: ff_velocity_scale is B alone; the dry friction of up to "
                    f"{quantity(float(np.abs(law.dry).max()), force, 3)} goes in as effort of "
                    "the trajectory's points")
    if not covered:
        lost.append("which velocities the data covered: give --recording BAG")
    return tuple(lost)


def velocity_of(recording: Recording) -> np.ndarray:
    """Return the velocity of a recording, m/s (n,): measured, or the position's rate."""
    if recording.has("v"):
        return np.asarray(recording.channels["v"])
    if not recording.has("x"):
        return np.zeros(0)
    from scipy.signal import savgol_filter
    x = np.asarray(recording.channels["x"])
    half = max(2, round(0.5 * DERIVATIVE / recording.sample_time))
    if len(x) <= 2 * half:
        return np.zeros(0)
    rate = savgol_filter(filled(x), 2 * half + 1, 2, deriv=1, delta=recording.sample_time)
    return np.where(np.isfinite(x), rate, np.nan)


def covered_seconds(velocity: np.ndarray, seen: Sequence[np.ndarray],
                    sample_times: Sequence[float]) -> np.ndarray:
    """Return how long the recordings went at about each velocity of the table, s (n,)."""
    edges = np.concatenate([[-np.inf], 0.5 * (velocity[1:] + velocity[:-1]), [np.inf]])
    return sum((np.histogram(v[np.isfinite(v)], edges)[0] * dt
                for v, dt in zip(seen, sample_times, strict=True)), np.zeros(len(velocity)))
