"""What a balance may hold: one frozen type, and the columns of each candidate.

A candidate is linear in its one number; what is not (a distance, a speed, a share) stands as a
few candidates of one ``effect``, of which at most one enters.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from eha_monitor.machine.course import COMMANDED, Course
from eha_monitor.settings.rig import Rig

# Grids of shapes, as shares of the usual travel or speed; between two neighbours an error changes
# by less than what a name owes.
BENT = (0.005, 0.015, 0.05, 0.15)
SLACK = tuple(round(0.03 * 1.4**k, 4) for k in range(8))
TURNS = (0.1, 0.3)
SLOW = (0.03, 0.1, 0.3)
MASS = 5.0  # times the config's: oil in lines moves with the piston, but not more than that


@dataclass(frozen=True)
class Candidate:
    """One term of a balance: y = sum of parameter times column.

    Attributes
    ----------
    name : symbol of its parameter; unique.
    effect : what it is called, as in the catalogue where that has it; variants share it.
    balance : ``force`` or ``flow``.
    unit, words : of the parameter.
    sign : 1 where physics wants it positive, -1 negative, 0 either.
    column : of a course and the rig, (m,) not yet in the band; None where channels are missing.
    always : in every model of the balance.
    setting : its parameter belongs to the setting of each recording, not to the machine.
    family : names of one family stand for one another: recordings rarely separate them.
    variant : one of several shapes of its effect; only one of them enters.
    limit : a larger parameter is no physics of this rig, but the error of another term.
    between : relative spread between recordings where it is not the policy's.
    needs_load : a recording of one load cannot separate it from what it resembles.
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
    family: str = ""
    variant: bool = False
    needs_load: bool = False
    limit: float = np.inf
    between: float | None = None


def stop(x: np.ndarray, reach: float) -> np.ndarray:
    """Return Prandtl's stop operator of a motion, (m,) in -1..1: friction of a bent seal.

    It holds its value at rest and turns round within twice ``reach`` m.
    """
    out, z = np.empty(len(x)), 0.0
    for k, step in enumerate(np.diff(x, prepend=x[0]).tolist()):
        z = min(max(z + step / reach, -1.0), 1.0)
        out[k] = z
    return out


def taken_up(x: np.ndarray, slack: float, near: float) -> np.ndarray:
    """Return how far a one-sided load is taken up, (m,) 0..1.

    What is pushed in one direction only: it follows the way back freely, and is met again
    ``slack`` m after the motion has turned (a valve with a check valve, play behind a spring).

    Parameters
    ----------
    near : m that the motion must go back before it has turned, more than noise.
    """
    side, out, anchor = stop(x, near), np.empty(len(x)), x[0]
    for k, (place, z) in enumerate(zip(x.tolist(), side.tolist(), strict=True)):
        if z <= -1.0:
            anchor = place
        out[k] = 0.5 * (1.0 + z) * min(max(2.0 * ((place - anchor) / slack - 0.75), 0.0), 1.0)
    return out


def direction_of(course: Course) -> np.ndarray:
    """Return the side to which valve or pump act, (m,): the sign of the last real demand.

    Where no channel says what is demanded, that of the last motion; 0 before the first.
    """
    signal = course.v if course.demand is None else course.demand
    level = course.quiet * float(np.quantile(np.abs(signal), 0.98))
    marks = np.where(signal > level, 1.0, np.where(signal < -level, -1.0, 0.0))
    places = np.where(marks != 0.0, np.arange(len(marks)), 0)
    held = marks[np.maximum.accumulate(places)]
    return held


def _sliding(course: Course, rig: Rig) -> np.ndarray:
    return course.direction


def _mean_pressure(course: Course) -> np.ndarray | None:
    return None if course.p1 is None else 0.5 * np.maximum(course.p1 + course.p2, 0.0)


@dataclass(frozen=True)
class Scale:
    """What shapes are shares of: where the recordings move, how far and how fast, SI.

    ``origin`` and ``span`` hold all of them, ``travel`` and ``speed`` are usual, ``slowest`` is
    the top speed of the slowest.
    """

    origin: float
    span: float
    travel: float
    speed: float
    slowest: float

    @classmethod
    def of(cls, courses: list[Course]) -> "Scale":
        """Return the scale of some recordings."""
        low = min(float(c.x[c.good].min()) for c in courses)
        high = max(float(c.x[c.good].max()) for c in courses)
        return cls(low, max(high - low, 1e-12),
                   float(np.median([np.ptp(c.x[c.good]) for c in courses])),
                   float(np.median([c.speed for c in courses])),
                   min(c.speed for c in courses))


def candidates_of(balance: str, scale: Scale, rig: Rig) -> tuple[Candidate, ...]:
    """Return what a balance may hold, ``force`` or ``flow``."""
    return force_candidates(scale, rig) if balance == "force" else FLOW


def force_candidates(scale: Scale, rig: Rig) -> tuple[Candidate, ...]:
    """Return what a force balance may hold."""
    n, m, kg = ("N·m", "rad", "kg·m²") if rig.motion == "rotary" else ("N", "m", "kg")

    def one(name, effect, unit, words, sign, column, **more):
        return Candidate(name, effect, "force", unit, words, sign, column, **more)

    def far(share):
        return f"{1e3 * share * scale.travel:.2g} m{m}"

    found = [
        one("B", "viscous_damping", f"{n}·s/{m}", "viscous damping", 1, lambda c, r: c.v,
            always=True),
        one("F_0", "constant_load", n, "constant load", 0, lambda c, r: np.ones(len(c)),
            always=True, setting=True),
        one("F_c", "coulomb_friction", n, "dry friction", 1, _sliding, family="dry",
            variant=True),
        one("k_p", "pressure_friction", f"{n}/Pa", "dry friction per mean pressure", 1,
            lambda c, r: None if c.p1 is None else _mean_pressure(c) * c.direction,
            family="dry", needs_load=True),
        one("F_v", "valve_direction", n, "force in the direction of valve or pump", 0,
            lambda c, r: direction_of(c) if valves(c, r) else None),
        one("M", "moving_mass", kg, "moving mass", 1, lambda c, r: c.a,
            limit=MASS * rig.mass),
        one("B_2", "quadratic_friction", f"{n}·s²/{m}²", "quadratic damping", 1,
            lambda c, r: c.v * np.abs(c.v), family="viscous"),
        one("dB", "asymmetric_damping", f"{n}·s/{m}", "further damping where it retracts", 0,
            lambda c, r: np.minimum(c.v, 0.0), family="viscous"),
        one("k", "spring_load", f"{n}/{m}", "spring", 0, lambda c, r: c.x - scale.origin,
            family="position"),
    ]
    for i, share in enumerate(BENT, start=1):
        found.append(one(
            f"F_z{i}", "presliding_friction", n, f"dry friction, bent over {far(share)}", 1,
            lambda c, r, d=share * scale.travel: stop(c.x, d), family="dry", variant=True))
    for i, share in enumerate(SLACK, start=1):
        found.append(one(
            f"F_l{i}", "one_sided_load", n, f"load while extending, met {far(share)} after a "
            "turn", 0, lambda c, r, d=share * scale.travel: taken_up(c.x, d, d / 7.0),
            setting=True, variant=True))
    for i, share in enumerate(TURNS, start=1):
        found.append(one(
            f"F_t{i}", "coulomb_friction", n, "dry friction, turned round within "
            f"{1e3 * share * scale.slowest:.2g} m{m}/s", 1,
            lambda c, r, d=share * scale.slowest: np.tanh(c.v / d), family="dry", variant=True))
    for i, share in enumerate(SLOW, start=1):
        found.append(one(
            f"F_s{i}", "stribeck_friction", n, "Stribeck rise below "
            f"{1e3 * share * scale.speed:.2g} m{m}/s", 1,
            lambda c, r, d=share * scale.speed: c.direction * np.exp(-np.abs(c.v) / d),
            family="dry", variant=True))
    for i in (1, 2, 3):
        found.append(one(
            f"F_x{i}", "position_load", n, f"load over the stroke, cosine {i}", 0,
            lambda c, r, i=i: np.cos(i * np.pi * (c.x - scale.origin) / scale.span),
            family="position"))
    return tuple(found)


def valves(course: Course, rig: Rig) -> bool:
    """Tell whether valves turn a pump's flow to either side of a single-rod cylinder.

    So it is where a speed is commanded and the config holds no path that keeps the mean pressure.
    """
    return (course.quiet == COMMANDED and rig.area_1 != rig.area_2
            and rig.makeup_conductance == 0.0)


def pumped_side(course: Course, rig: Rig) -> np.ndarray:
    """Return the chamber that the pump fills, (m,): 1, -1, or 0 before the first demand.

    Behind valves it is the demand that says so, not the pressure: that falls at each switch.
    """
    if course.demand is None:
        return np.where(course.p1 > course.p2, 1.0, -1.0)
    return direction_of(course)


def pressure_rate(course: Course, rig: Rig) -> np.ndarray:
    """Return the rate of the filled chamber's pressure, as of chamber 1; (m,) Pa/s.

    With equal areas the mean of both, which sees half of the sensors' noise.
    """
    share = rig.area_2 / rig.area_1
    if share == 1.0:
        return 0.5 * (course.rate_1 - course.rate_2)
    side = pumped_side(course, rig)
    return np.where(side > 0.0, course.rate_1, np.where(
        side < 0.0, -course.rate_2 / share, 0.0))


def pumped_pressure(course: Course, rig: Rig) -> np.ndarray:
    """Return the pressure of the chamber that the pump fills, (m,) Pa."""
    return np.maximum(np.where(pumped_side(course, rig) > 0.0, course.p1, course.p2), 0.0)


def _flow(name, effect, unit, words, sign, column, **more):
    return Candidate(name, effect, "flow", unit, words, sign, column, **more)


def _steep(pressure: np.ndarray) -> np.ndarray:
    return pressure / (np.abs(pressure) + 1e4) ** 0.5


FLOW = (
    _flow("D_p", "pump_displacement", "m³/rad", "pump displacement", 1, lambda c, r: c.omega,
          always=True, between=0.02),
    _flow("dD_p", "pump_loss_by_direction", "m³/rad", "further displacement where it retracts", 0,
          lambda c, r: np.minimum(c.omega, 0.0)),
    _flow("C_h", "compliance", "m³/Pa", "compliance of a chamber", 1,
          lambda c, r: -pressure_rate(c, r), family="compliance"),
    _flow("V_a", "entrained_air", "m³/Pa", "compliance of air, at ambient pressure", 1,
          lambda c, r: -pressure_rate(c, r) * (
              r.ambient_pressure / (pumped_pressure(c, r) + r.ambient_pressure)) ** 2,
          family="compliance"),
    _flow("C_x", "position_dependent_volume", "m²/Pa", "compliance over the stroke", 0,
          lambda c, r: -pressure_rate(c, r) * c.x, family="compliance"),
    _flow("C_L", "cross_port_leakage", "m³/(s·Pa)", "leakage", 1, lambda c, r: c.p2 - c.p1,
          family="gap"),
    _flow("C_t", "turbulent_leakage", "m³/(s·√Pa)", "leakage of an orifice", 1,
          lambda c, r: _steep(c.p2 - c.p1), family="gap"),
    _flow("C_e", "external_leakage", "m³/(s·Pa)", "leakage to ambient", 1,
          lambda c, r: -pumped_side(c, r) * pumped_pressure(c, r), family="gap"),
    _flow("k_l", "pump_volumetric_loss", "m³/(rad·Pa)", "displacement lost per pressure", 1,
          lambda c, r: -c.omega * pumped_pressure(c, r), family="gap"),
    _flow("Q_0", "leakage_offset", "m³/s", "constant flow", 0, lambda c, r: np.ones(len(c))),
    _flow("Q_d", "pump_dead_zone", "m³/s", "flow lost to a dead zone of the pump", 1,
          lambda c, r: -np.tanh(c.omega / 5.0)),
    _flow("T_d", "drive_lag", "m³", "flow that lags the speed", 1,
          lambda c, r: -np.gradient(c.omega, c.dt)),
)
