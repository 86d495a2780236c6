"""What a balance may hold: one frozen type, and the columns of each candidate.

A candidate is linear in its one number; what is not (a distance, a speed, a share) stands as a
few candidates of one ``effect``, of which at most one enters.  All balances are taken relative to
the config: its mass, leakage, effects and drive are subtracted before (:func:`measured.known_of`).

    force   A1 p1 - A2 p2 - M x'' - known = B x' + F_0 + F_c sgn x' + ...
    flow    A1 x' - known = D_p omega - C_h p' - L (p1 - p2) - ...
    drive   omega - wanted = k wanted - tau omega' - ...
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.balances import contact
from eha_monitor.balances.course import (
    COMMANDED,
    STANDING,
    Course,
    last_sign,
    slope,
)
from eha_monitor.compiled import njit
from eha_monitor.estimation.modelled import contributions_along
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import N_EFFECTS, N_THETA, new_memory, slot_of
from eha_monitor.physics.effects import NAMES
from eha_monitor.physics.effects.oil import compliance
from eha_monitor.quantity import quantity
from eha_monitor.settings.hypothesis import Hypothesis
from eha_monitor.settings.own_terms import slot_for
from eha_monitor.settings.rig import Rig

BALANCES = ("force", "flow", "drive")
FORCE_OF_SENSORS = ("pressure_offset", "pressure_scale")  # they make a constant force as well
SIDES = {"force": "N", "flow": "m³/s", "drive": "rad/s"}
# Grids of shapes, as shares of the usual travel or speed; between two neighbours an error changes
# by less than what a name owes.
BENT = (0.005, 0.015, 0.05, 0.15)
SLACK = tuple(round(0.03 * 1.4**k, 4) for k in range(8))
TURNS = (0.1, 0.3)
SLOW = (0.03, 0.1, 0.3)
# Speeds over which friction falls, m/s: Armstrong-Helouvry, Dupont and Canudas de Wit 1994; of a
# rotary machine, whose levers nobody knows, as shares of the top speed.
FALLS, SHARES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05), (0.01, 0.02, 0.05, 0.1, 0.3, 1.0)
TOPS = (0.999, 0.98, 0.9)  # quantiles of the pump's speed at which its drive may saturate
MASS = 5.0  # times the config's: oil in lines moves with the piston, but not more than that
LATE = 0.1  # s: as late as the catalogue's delay may be
AIR_EXPONENT = 1.4  # adiabatic
LAMINAR = 1e4  # Pa: the catalogue's own rounding of a flow at no pressure difference
DRY = "dry"  # family of dry friction
# What other rooms ask of a term, by the name that machine files keep.  A new term is looked at for
# each of these.
FIRST_VIEW = ("F_c", "dM")  # what ten lines of least squares have beside B and F_0
BENT_DAMPING = "a_1"  # it bends the curve over speed as a fall of friction does
LINEAR = ("B", "B_t", "D_p", "C_h", "k_d")  # what the config's own model has; its oil warms
BASE = ("B", "D_p", "L", "k_d")  # of these, what belongs to the machine and needs no name
PUMP = ("D_p", "dD_p", "C_h", "C_x", "L", "L_1")  # what tells which chamber a pump acts on
PLAIN = ("B", "F_0", "F_c", "D_p", "C_h", "L", "k_d")  # that may change within a recording
WATCHED = ("B", "F_c", "k", "dM", "D_p", "L", "C_h")  # what wears, or a person would ask for
DEAD_SPEED = 5.0  # rad/s over which a pump's dead zone is rounded


@dataclass(frozen=True)
class Candidate:
    """One term of a balance: y = sum of parameter times column.

    Attributes
    ----------
    name : symbol of its parameter; unique within its balance.
    effect : what it is called, as in the catalogue where that has it; variants share it.
    balance : one of ``BALANCES``.
    unit, words : of the parameter.
    sign : 1 where physics wants it positive, -1 negative, 0 either.
    column : of a course and the rig, (m,) not yet in the band; None where channels are missing.
    always : in every model of the balance.
    setting : its parameter belongs to the setting of each recording, not to the machine.
    of_oil : it goes with the viscosity of the oil, which no recording shares with another.
    family : names of one family stand for one another: recordings rarely separate them.
    exclusive : of its ``effect`` (shapes of one term) or ``kind`` (nearly one column) only one
        enters; "" any.
    lasting : it is the same in all recordings of a machine, and no change of it.
    limit : a larger parameter is no physics of this rig, but the error of another term.
    between : relative spread between recordings where it is not the policy's.
    needs : what must vary between recordings, ``load`` or ``pressure``, before it can be
        separated from what it resembles; "" nothing.
    symbol, shape : the catalogue's parameter that it is, and those that its shape stands for.
    twins : effects that are the same column to first order.
    upon : family of which another term must be there, because it only adds to one.
    bears : such a term may add to it; not where it fades at low speed itself.
    odd : it changes its sign with the direction of motion.
    power : it grows with this power of the speed.
    configured : what the config has of it, SI; the term is what comes on top, and no less than
        its absence where physics wants it positive.  ``held`` is what its effects have of that.
    """

    name: str
    effect: str
    balance: str
    unit: str
    words: str
    sign: int
    column: Callable[[Course, Rig], np.ndarray | None]
    always: bool = False
    setting: bool = False
    of_oil: bool = False
    family: str = ""
    exclusive: str = ""
    lasting: bool = False
    needs: str = ""
    limit: float = np.inf
    between: float | None = None
    symbol: str = ""
    shape: tuple[tuple[str, float], ...] = ()
    twins: tuple[str, ...] = ()
    upon: str = ""
    bears: bool = True
    odd: bool = True
    power: float = 0.0
    configured: float = 0.0
    held: float = 0.0

    @property
    def least(self) -> float:
        """Bound of a parameter with a sign: with it nothing at all is there."""
        return -self.configured if self.sign else 0.0

    @property
    def kind(self) -> str:
        """Its family, or else its effect."""
        return self.family or self.effect

    def excludes(self, other: "Candidate") -> bool:
        """Whether it is another shape of what the other stands for, see ``exclusive``."""
        return bool(self.exclusive) and (
            getattr(self, self.exclusive) == getattr(other, self.exclusive))

    @property
    def quantity(self) -> tuple[str, str]:
        """Of what its parameter is the number: dry friction of any shape is one force.

        So are a drive's lags by the commanded and by the measured speed one time.
        """
        if self.family == DRY and not self.upon:
            return DRY, ""
        return self.effect, self.symbol or self.name

    def beside(self, effects: Mapping[str, Mapping[str, float]]) -> "Candidate":
        """Return the term beside the config's effects, of which it is what comes on top."""
        held = effects.get(self.effect, {}).get(self.symbol, 0.0)
        return replace(self, configured=self.configured + held, held=held) if held else self

    def adds_to(self, one: "Candidate") -> bool:
        """Tell whether it adds to another's number: so does friction's rise at low speed."""
        return self.quantity == one.quantity or one.quantity == (self.family, "")


def founded(names: Iterable[str], of: Mapping[str, Candidate]) -> list[str]:
    """Return the terms that stand by themselves, or on another of the terms.

    Friction that falls with speed is not the whole of a seal's friction: without the part that
    stays, a wide fall takes the place of viscous damping.  Nor is air all that gives way.
    """
    names = list(names)
    grounds = {of[name].family for name in names if of[name].bears and not of[name].upon}
    return [name for name in names if not of[name].upon or of[name].upon in grounds]


@njit
def stop(x: np.ndarray, reach: float) -> np.ndarray:
    """Return Prandtl's stop operator of a motion, (m,) in -1..1: friction of a bent seal.

    It holds its value at rest and turns round within twice ``reach`` m.
    """
    out, z, before = np.empty(len(x)), 0.0, x[0]
    for k in range(len(x)):
        z = min(max(z + (x[k] - before) / reach, -1.0), 1.0)
        out[k], before = z, x[k]
    return out


@njit
def taken_up(x: np.ndarray, slack: float, near: float) -> np.ndarray:
    """Return how far a one-sided load is taken up, (m,) 0..1.

    What is pushed in one direction only: it follows the way back freely, and is met again
    ``slack`` m after the motion has turned (a valve with a check valve, play behind a spring).

    Parameters
    ----------
    near : m that the motion must go back before it has turned, more than noise.
    """
    side, out, anchor = stop(x, near), np.empty(len(x)), x[0]
    for k in range(len(x)):
        if side[k] <= -1.0:
            anchor = x[k]
        met = min(max(2.0 * ((x[k] - anchor) / slack - 0.75), 0.0), 1.0)
        out[k] = 0.5 * (1.0 + side[k]) * met
    return out


def sum_of_pressures(course: Course) -> np.ndarray | None:
    """Return p1 + p2, at least 0, (m,) Pa; None where they are not recorded."""
    return None if course.p1 is None else np.maximum(course.p1 + course.p2, 0.0)


@dataclass(frozen=True)
class Scale:
    """What shapes are shares of: where the recordings move, how far and how fast, SI.

    ``origin`` and ``span`` hold all of them, ``travel`` and ``speed`` are usual, ``slowest`` is
    the top speed of the slowest; ``tops`` speeds of the pump, one for each of ``TOPS``.
    ``turns`` : each of them moves both ways; else a load of its own hides dry friction.
    ``relaxed`` : where a spring is, that of the config; of another the middle of the motion, where
    its rate moves no load.
    ``contacts`` : see :func:`contact.contacts_of`.
    ``fastest`` : the top speed of the fastest; 0 in files of older versions.
    """

    origin: float
    span: float
    travel: float
    speed: float
    slowest: float
    tops: tuple[float, ...] = ()
    turns: bool = True
    relaxed: float = 0.0
    contacts: tuple[tuple[float, float], ...] = ()
    fastest: float = 0.0

    @classmethod
    def of(cls, courses: Sequence[Course], contacts: tuple[tuple[float, float], ...] = ()
           ) -> "Scale":
        """Return the scale of some recordings."""
        low = min(float(c.x[c.good].min()) for c in courses)
        high = max(float(c.x[c.good].max()) for c in courses)
        pumps = [np.abs(c.omega[c.good]) for c in courses if c.omega is not None]
        return cls(low, max(high - low, 1e-12),
                   float(np.median([np.ptp(c.x[c.good]) for c in courses])),
                   float(np.median([c.speed for c in courses])),
                   min(c.speed for c in courses),
                   tuple(np.quantile(np.concatenate(pumps), TOPS).tolist()) if pumps else (),
                   all(turned(c) for c in courses if c.moving.any()),
                   courses[0].effects.get("spring_load", {}).get(
                       "x_0", 0.5 * (low + high)), contacts, max(c.speed for c in courses))


BOTH = 0.05  # of the moving samples: a recording that turns round has more either way


def turned(course: Course) -> bool:
    """Tell whether a recording moves both ways."""
    return bool(BOTH < np.mean(course.v[course.moving] > 0.0) < 1.0 - BOTH)


def balances_in(courses: Sequence[Course], rig: Rig) -> tuple[str, ...]:
    """Return the balances that recordings of a rig hold."""
    found = ["force"]
    if all(c.has_flow for c in courses):
        found.append("flow")
    if all(c.wanted is not None and np.any(c.omega[c.good]) for c in courses):
        found.append("drive")
    return tuple(found)


def candidates_of(balance: str, scale: Scale, rig: Rig, varied: Sequence[str] | None = None,
                  without: Sequence[str] = ()) -> tuple[Candidate, ...]:
    """Return what a balance may hold.

    Where the force is made of pressures a load alone moves both at once: friction that grows with
    pressure and is bent as well would take up the load, unless the mean pressure was set.

    Parameters
    ----------
    varied : what differs between the recordings: ``load``, ``pressure``; None for all candidates.
    without : effects that are not considered.
    """
    found = {"force": force_candidates, "flow": flow_candidates,
             "drive": drive_candidates}[balance](scale, rig)
    if varied is None:
        return found
    met = {"", *varied, *(("load",) if "pressure" in varied else ())}
    return tuple(one for one in found if one.always or (
        one.needs in met and one.effect not in without))


def force_candidates(scale: Scale, rig: Rig) -> tuple[Candidate, ...]:
    """Return what a force balance may hold; the constant load belongs to the setting."""
    def one(name, effect, unit, words, sign, column, **more):
        return Candidate(name, effect, "force", unit, words, sign, column, **more)

    def far(share):
        return f"{1e3 * share * scale.travel:.2g} mm"

    origin, standing = scale.origin, STANDING * scale.speed
    found = [
        one("B", "viscous_damping", "N·s/m", "viscous damping", 1, lambda c, r: c.v,
            always=True, power=1.0, of_oil=True),
        one("B_t", "viscous_drift", "N·s/m", "viscous damping beyond the mean at the end", 0,
            lambda c, r: c.v * later(c), setting=True, power=1.0),
        one("F_0", "constant_load", "N", "constant load", 0, lambda c, r: np.ones(len(c)),
            always=True, setting=scale.turns, symbol="F_0", odd=False,
            twins=FORCE_OF_SENSORS if rig.area_1 and rig.area_2 else ()),
        one("d_1", "pressure_drift", "Pa/s",
            "drift of a pressure sensor or of the load, as of chamber 1", 0,
            lambda c, r: None if c.p1 is None or not r.area_1 else r.area_1 * c.dt * (
                np.arange(len(c)) - 0.5 * len(c)),
            setting=True, symbol="d_1", shape=(("d_2", 0.0),), odd=False),
        one("F_c", "coulomb_friction", "N", "dry friction", 1, lambda c, r: c.direction,
            family="dry", exclusive="effect", symbol="F_c", shape=(("v_e", standing),)),
        one("mu", "pressure_friction", "m²", "dry friction per sum of pressures", 1,
            lambda c, r: None if c.p1 is None else sum_of_pressures(c) * c.direction,
            family="dry", exclusive="effect", needs="load", symbol="mu",
            shape=(("v_e", standing),)),
        one("F_v", "valve_direction", "N", "force in the direction of valve or pump", 0,
            lambda c, r: c.commanded if valves(c, r) else None),
        one("dM", "added_mass", "kg", "moving mass beyond the config's", 0, lambda c, r: c.a,
            family="inertia", exclusive="kind", limit=MASS * rig.mass, symbol="dM",
            power=2.0, configured=rig.mass),
        # Pressures that come late by T: less mass by T B, and with a spring less damping by T k.
        one("T_p", "pressure_delay", "s", "delay of the pressures", 1,
            lambda c, r: None if c.p1 is None else -slope(c.force, c.dt), family="inertia",
            exclusive="kind", lasting=True, limit=LATE, symbol="T", power=2.0),
        one("a_1", "quadratic_friction", "N·s²/m²", "quadratic damping", 1,
            lambda c, r: c.v * np.abs(c.v), family="viscous", symbol="a_1", power=2.0),
        one("dB", "asymmetric_friction", "N·s/m", "damping more forwards than the mean", 0,
            lambda c, r: np.abs(c.v), family="viscous", symbol="dB", odd=False, power=1.0),
        one("k", "spring_load", "N/m", "spring", 1, lambda c, r: c.x - scale.relaxed,
            family="position", symbol="k", shape=(("x_0", scale.relaxed),),
            twins=("position_scale",)),
    ]
    for i, share in enumerate(BENT, start=1):
        found.append(one(
            f"F_z{i}", "presliding_friction", "N", f"dry friction, bent over {far(share)}", 1,
            lambda c, r, d=share * scale.travel: stop(c.x, d), family="dry", exclusive="effect",
            symbol="F_c", shape=(("z_0", share * scale.travel), ("v_e", 1e-3 * scale.speed))))
    for i, share in enumerate(BENT, start=1):
        found.append(one(
            f"mu_z{i}", "pressure_friction", "m²", "dry friction per sum of pressures, bent over "
            f"{far(share)}", 1, lambda c, r, d=share * scale.travel: None if c.p1 is None else
            sum_of_pressures(c) * stop(c.x, d), family="dry", exclusive="effect", needs="pressure",
            symbol="mu", shape=(("z_0", share * scale.travel), ("v_e", 1e-3 * scale.speed))))
    for i, share in enumerate(SLACK, start=1):
        found.append(one(
            f"F_l{i}", "one_sided_load", "N", f"load while extending, met {far(share)} after a "
            "turn", 0, lambda c, r, d=share * scale.travel: None if c.omega is None else
            taken_up(c.x, d, d / 7.0),
            setting=scale.turns, exclusive="effect", odd=False))
    for i, share in enumerate(TURNS, start=1):
        found.append(one(
            f"F_t{i}", "coulomb_friction", "N", "dry friction, turned round within "
            f"{1e3 * share * scale.slowest:.2g} mm/s", 1,
            lambda c, r, d=share * scale.slowest: np.tanh(c.v / d), family="dry",
            exclusive="effect", symbol="F_c", shape=(("v_e", share * scale.slowest),),
            bears=False))
    for i, share in enumerate(SLOW, start=1):
        found.append(one(
            f"F_s{i}", "stribeck_friction", "N", "Stribeck rise below "
            f"{1e3 * share * scale.speed:.2g} mm/s", 1,
            lambda c, r, d=share * scale.speed: c.direction * np.exp(-np.abs(c.v) / d),
            family="dry", exclusive="effect", upon="dry", symbol="F_d",
            shape=(("v_s", share * scale.speed), ("delta", 1.0), ("v_e", standing))))
    for i in (1, 2, 3):
        found.append(one(
            f"F_x{i}", "position_load", "N", f"load over the stroke, cosine {i}", 0,
            lambda c, r, i=i: np.cos(i * np.pi * (c.x - origin) / scale.span),
            family="position", odd=False))
    for i, (place, side) in enumerate(scale.contacts, start=1):
        found.append(one(
            f"k_c{i}", contact.EFFECT, "N/m", f"spring met {'above' if side > 0.0 else 'below'} "
            f"x = {quantity(place, 'm', 3)}", 1,
            lambda c, r, at=place, side=side: contact.pressed(c.x, at, side), family="position",
            exclusive="effect", symbol="k", shape=(("x_c", place), ("side", side)), odd=False))
    return tuple(found)


def fall_speeds(course: Course, rig: Rig) -> np.ndarray:
    """Return the speeds over which dry friction may fall, (6,) m/s or rad/s."""
    return np.array(FALLS) if rig.motion == "linear" else course.speed * np.array(SHARES)


def falls_of(course: Course, rig: Rig, balance: str) -> tuple[np.ndarray, np.ndarray]:
    """Return friction of 1 N at rest that falls over each of ``FALLS``, in the band, (m, 12) N.

    By exp(-|v|/v_s) and by exp(-(v/v_s)^2).  And one that turns round over the first, (m, 1) N.
    None of either where the balance is not the force's.
    """
    if balance != "force":
        none = np.empty((len(course.compared(course.v)), 0))
        return none, none
    shares = course.v[:, None] / np.maximum(fall_speeds(course, rig), 1e-300)
    falling = course.direction[:, None] * np.exp(-np.hstack([np.abs(shares), shares**2]))
    return course.in_band(falling), course.in_band(np.tanh(shares[:, :1]))


def later(course: Course) -> np.ndarray:
    """Return time from -1 to 1 or so about the middle of a motion, (m,): oil warms as it goes.

    About the mean of v^2, so that damping at the middle is damping without a drift.
    """
    t, weight = np.arange(len(course), dtype=float), np.where(course.good, course.v**2, 0.0)
    t -= float(weight @ t) / max(float(weight.sum()), 1e-300)
    return t / max(0.5 * len(t), 1.0)


def valves(course: Course, rig: Rig) -> bool:
    """Tell whether valves turn a pump's flow to either side of a single-rod cylinder.

    So it is where a speed is commanded and the config holds no path that keeps the mean pressure.
    """
    return (course.quiet == COMMANDED and rig.area_1 != rig.area_2
            and rig.makeup_conductance == 0.0)


def pressure_rate(course: Course) -> np.ndarray:
    """Return the rate of the filled chamber's pressure, as of chamber 1; (m,) Pa/s.

    The mean of both where both count (:attr:`Course.mean_of_both`).
    """
    if course.mean_of_both:
        return 0.5 * (course.rate_1 - course.rate_2)
    side = course.pumped_side
    return np.where(side > 0.0, course.rate_1, np.where(
        side < 0.0, -course.rate_2 / course.ratio, 0.0))


def pumped_pressure(course: Course, rig: Rig) -> np.ndarray:
    """Return the pressure above ambient of the chamber that the pump fills, (m,) Pa."""
    return _above_ambient(np.where(course.pumped_side > 0.0, course.p1, course.p2), course,
                          rig)


def leaks_to_case(course: Course, rig: Rig) -> np.ndarray:
    """Return the flow, as of chamber 1, of a leak of 1 m³/(s·Pa) from the filled chamber, (m,)."""
    return -course.pumped_side * pumped_pressure(course, rig) * course.as_of_chamber_1


def _above_ambient(p: np.ndarray, course: Course, rig: Rig) -> np.ndarray:
    """Return by how much a chamber's pressure is above ambient, (m,) Pa."""
    return np.maximum(course.absolute(p, rig) - rig.ambient_pressure, 0.0)


def _pump_difference(course: Course, rig: Rig) -> np.ndarray:
    """Return the pressure difference that the pump works against, (m,) Pa."""
    if rig.area_1 == rig.area_2:
        return course.p1 - course.p2
    return course.pumped_side * pumped_pressure(course, rig)


def oil_pressed(course: Course, rig: Rig) -> np.ndarray | None:
    """Return V(x) p' of either chamber, as of chamber 1, (2, m) m³·Pa/s; None without volumes.

    The volumes are the config's, which may change over the stroke.
    """
    if not (rig.volume_1 and rig.volume_2):
        return None
    still = np.stack([rig.volume_1 * course.rate_1, -rig.volume_2 * course.rate_2 / course.ratio])
    return still + course.known.get("stroke", 0.0)


def _pressed(course: Course, rig: Rig) -> np.ndarray:
    """Return the rate that the oil is pressed at, of a volume as large as V_1, (m,) Pa/s."""
    oil = oil_pressed(course, rig)
    return pressure_rate(course) if oil is None else course.of_filled(*oil) / rig.volume_1


def swallowed(course: Course, rig: Rig, sharp: bool) -> np.ndarray:
    """Return the flow that a position sensor with a play of 1 m misses, (m,) m²/s.

    The sensor is dragged, x_s = x - (b/2) s, so at each reversal the piston goes on by b unseen
    (play operator, Nordin, Gutman 2002): A x_s' = A x' - (b/2) A s'.

    Parameters
    ----------
    sharp : the side s goes over at once, as the sensor sets out again; else with the direction of
        motion, of a piston that turns slowly, but for a rest that ends in the same one.
    """
    if sharp:
        side = last_sign(course.v, STANDING * course.speed)
    else:
        side = course.direction.copy()
        moving = np.flatnonzero(np.abs(side) >= 1.0)
        for i in np.flatnonzero((np.diff(moving) > 1) & (np.diff(side[moving]) == 0.0)):
            side[moving[i]:moving[i + 1]] = side[moving[i]]
    return -0.5 * rig.area_1 * slope(side, course.dt)


def _air(course: Course, rig: Rig) -> np.ndarray | None:
    """Return the flow into air of one, by volume at atmospheric pressure: alpha V C(p) p'."""
    oil = oil_pressed(course, rig)
    if oil is None:
        return None
    soft = [[compliance.py_func(one, 1.0, AIR_EXPONENT) for one in
             (_above_ambient(p, course, rig) + rig.ambient_pressure).tolist()]
            for p in (course.p1, course.p2)]
    return -course.of_filled(*(oil * np.array(soft)))


def _over_stroke(course: Course, rig: Rig) -> np.ndarray:
    """Return the rate that a volume over the stroke takes up: V_1 + A_v x, V_2 - A_v x."""
    if course.mean_of_both:
        return -0.5 * (course.rate_1 + course.rate_2) * course.x
    return -course.pumped_side * pressure_rate(course) * course.x


def flow_candidates(scale: Scale, rig: Rig) -> tuple[Candidate, ...]:
    """Return what a flow balance may hold."""
    pump = rig.pump_displacement

    def one(name, effect, unit, words, sign, column, **more):
        return Candidate(name, effect, "flow", unit, words, sign, column, **more)

    def crossing(of):
        return lambda c, r: -of(c.p1 - c.p2) * c.as_of_chamber_1

    return (
        one("D_p", "pump_displacement", "m³/rad", "pump displacement", 1,
            lambda c, r: c.of_pump(c.omega), always=True, between=0.02, power=1.0,
            twins=("position_scale",)),
        one("dD_p", "pump_loss_by_direction", "m³/rad", "further displacement where it retracts",
            0, lambda c, r: c.of_pump(np.minimum(c.omega, 0.0)), odd=False, power=1.0,
            twins=("pump_volumetric_loss",)),  # at one load pressure goes with direction
        one("C_h", "compliance", "m³/Pa", "compliance of chamber 1 at x = 0", 1,
            lambda c, r: -_pressed(c, r), family="compliance", power=1.0),
        one("alpha", "entrained_air", "1", "share of air, at atmospheric pressure", 1, _air,
            family="compliance", symbol="alpha", shape=(("n", AIR_EXPONENT),), power=1.0,
            limit=0.5, upon="compliance"),
        one("C_x", "position_dependent_volume", "m²/Pa", "compliance over the stroke", 0,
            _over_stroke, family="compliance", odd=False, power=1.0, upon="compliance"),
        # A leakage that the config gives is known to a factor: that is free in every model.
        one("L", "cross_port_leakage", "m³/(s·Pa)", "leakage beyond the config's",
            1, crossing(lambda dp: dp), always=rig.leakage > 0.0,
            family="" if rig.leakage else "gap", symbol="L", of_oil=rig.leakage > 0.0,
            configured=0.5 * rig.leakage),
        one("c", "turbulent_leakage", "m³/(s·√Pa)", "leakage of an orifice", 1,
            crossing(lambda dp: dp / (dp**2 + LAMINAR**2) ** 0.25), family="gap", symbol="c",
            shape=(("dp_0", LAMINAR),)),
        one("L_1", "external_leakage", "m³/(s·Pa)", "leakage to ambient", 1,
            leaks_to_case, family="gap", symbol="L_1", exclusive="effect"),
        one("L_1a", "external_leakage", "m³/(s·Pa)", "leakage of chamber 1 to ambient", 1,
            lambda c, r: c.of_filled(-_above_ambient(c.p1, c, r), np.zeros(len(c))),
            family="gap", symbol="L_1", shape=(("L_2", 0.0),), exclusive="effect", odd=False),
        one("L_2a", "external_leakage", "m³/(s·Pa)", "leakage of chamber 2 to ambient", 1,
            lambda c, r: c.of_filled(np.zeros(len(c)), _above_ambient(c.p2, c, r)
                                     * r.area_1 / r.area_2),
            family="gap", symbol="L_2", shape=(("L_1", 0.0),), exclusive="effect", odd=False),
        one("k_l", "pump_volumetric_loss", "1/Pa", "flow of the pump lost per pressure", 1,
            lambda c, r: None if not pump else (
                -pump * c.of_pump(np.abs(c.omega)) * _pump_difference(c, r)),
            family="gap", symbol="k", shape=(("motoring", 1.0),), power=1.0),
        one("Q_0", "leakage_offset", "m³/s", "leakage whatever the pressure", 1,
            crossing(lambda dp: np.tanh(dp / LAMINAR)), family="gap", symbol="Q_0",
            shape=(("dp_e", LAMINAR),)),
        one("omega_0", "pump_dead_zone", "rad/s", "speed lost to a dead zone of the pump", 1,
            lambda c, r: None if not pump else -pump * c.of_pump(np.tanh(c.omega / DEAD_SPEED)),
            symbol="omega_0"),
        one("T_q", "flow_lag", "s" if pump else "m³", "flow that lags the speed", 1,
            lambda c, r: -(pump or 1.0) * c.of_pump(slope(c.omega, c.dt)), power=2.0,
            twins=("position_delay",)),
        # Where the motion turns the piston moves by b before its sensor does.  Friction that turns
        # presses the oil then: without its compliance that is a play.
        *(one(name, "backlash", "m", "play between piston and position sensor", 1,
              lambda c, r, sharp=sharp: swallowed(c, r, sharp), symbol="b",
              shape=(("in_loop", 1.0),), exclusive="effect", upon="compliance")
          for name, sharp in (("b", True), ("b_2", False))),
    )


def drive_candidates(scale: Scale, rig: Rig) -> tuple[Candidate, ...]:
    """Return what the drive may do beside following its command."""
    def one(name, effect, unit, words, sign, column, **more):
        return Candidate(name, effect, "drive", unit, words, sign, column, **more)

    found = [
        one("tau", "drive_lag", "s", "time constant of the drive", 1,
            lambda c, r: -slope(c.omega, c.dt), exclusive="effect", symbol="tau", power=2.0,
            limit=1.0, twins=("command_delay",)),
        one("tau_d", "drive_lag", "s", "time constant of the drive", 1,
            lambda c, r: -slope(c.wanted, c.dt), exclusive="effect", symbol="tau", power=2.0,
            limit=1.0, twins=("command_delay",)),
        # Where the position loop's gain is the config's, its tolerance is free in every model.
        # A setpoint that comes late by T takes K T x_d' from it, a position K T x': where the
        # piston follows, as much as a smaller gain.
        one("k_d", "drive_gain", "1", "gain of the drive beyond the config's", 0,
            lambda c, r: c.wanted, always=rig.position_gain is not None, symbol="k", power=1.0,
            configured=1.0,  # it is a share of the config's
            twins=("command_delay", "position_delay") if rig.position_gain else ()),
    ]
    # The command may hold the setpoint's rate as well.  Of the piston's own rate any pump's speed
    # is made, whatever drives it.
    if rig.position_gain:
        found.append(one(
            "k_v", "feed_forward", "rad/m", "feed-forward of the speed beside the gain", 0,
            lambda c, r: None if c.quiet == COMMANDED else (
                c.v + slope(c.wanted, c.dt) / r.position_gain), power=1.0,
            twins=("position_delay",)))
    for i, top in enumerate(scale.tops, start=1):
        found.append(one(
            f"s_{i}", "drive_saturation", "1", f"share held back beyond {top:.3g} rad/s", 1,
            lambda c, r, top=top: np.clip(c.wanted, -top, top) - c.wanted, exclusive="effect",
            symbol="omega_max", shape=(("omega_max", top), ("slew", np.inf)), limit=1.5))
    return tuple(found)


BY_HALF = 1.5  # a parameter times this makes a term times this, if the term is linear in it


def candidate_of(hypothesis: Hypothesis, rig: Rig) -> Candidate | None:
    """Return a hypothesis as a candidate, its shape held at the start; None where it is none.

    It needs a parameter in which it is linear: that one is fitted.
    """
    start = {key: one.start for key, one in hypothesis.parameters.items()}
    for key, one in hypothesis.parameters.items():
        if start[key] and _linear(hypothesis, start, key):
            return Candidate(
                hypothesis.name, hypothesis.name, "force" if hypothesis.adds == "force"
                else "flow", one.unit or "1", hypothesis.name.replace("_", " "),
                1 if one.lower >= 0.0 else -1 if one.upper <= 0.0 else 0,
                lambda c, r, key=key: _column(hypothesis, start, key, c, r), symbol=key,
                limit=max(abs(one.lower), abs(one.upper)))
    return None


def _linear(hypothesis: Hypothesis, start: dict[str, float], key: str) -> bool:
    """Tell whether a term is proportional to a parameter, on some motion."""
    track = np.random.default_rng(0).uniform(-1.0, 1.0, (64, s.N_SIGNALS))
    track[:, s.P1:s.OMEGA] = 1e6 * (2.0 + track[:, s.P1:s.OMEGA])
    one, other = (_made(hypothesis.entry(values), track, 1e-3) for values in (
        start, {**start, key: BY_HALF * start[key]}))
    return bool(np.any(one)) and np.allclose(other, BY_HALF * one, rtol=1e-9)


def _made(entry: dict, track: np.ndarray, dt: float) -> np.ndarray:
    """Return what an own term of a config contributes along a motion, (n, N_CONTRIBUTIONS)."""
    which = len(NAMES)
    theta, active = np.zeros(N_THETA), np.zeros(N_EFFECTS, dtype=np.bool_)
    theta[slot_of(which)] = slot_for(entry)
    active[which] = True
    found = np.zeros((len(track), s.N_CONTRIBUTIONS))
    contributions_along(track, dt, 2, theta, active, new_memory(), found)
    return found


def own_column(entry: dict, course: Course, rig: Rig) -> np.ndarray | None:
    """Return an own term of a config along a recording, in its balance, (m,) SI.

    None where channels are missing.
    """
    c = _made(entry, course.track(), course.dt)
    if entry["adds"] == "force":
        return c[:, s.FORCE]
    if not course.has_flow:
        return None
    if entry["adds"] == "speed":
        return (rig.pump_displacement or 1.0) * c[:, s.SPEED]
    return course.of_filled(c[:, s.FLOW_1], -c[:, s.FLOW_2] * rig.area_1 / rig.area_2)


def _column(hypothesis: Hypothesis, values: dict[str, float], key: str, course: Course, rig: Rig
            ) -> np.ndarray | None:
    """Return the term along a recording, in its balance, by a parameter of 1; (m,)."""
    found = own_column(hypothesis.entry(values), course, rig)
    return None if found is None else found / values[key]
