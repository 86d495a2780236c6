"""How stiff the oil is, by least squares on the flow, and what another stiffness makes of it.

    A x' - known = D_p (omega - tau omega') - V(x) p' / beta_e - C_L (p1 - p2) - L p

with p the absolute pressure of the chamber that the pump fills: what leaks from it to the case.
Where a press meets its work, pressure and its rate come and go together, and a leak to the case
that has no column of its own is oil that is a third too soft.  It is fitted in a band in which
the oil's part differs from that of a late channel.  A speed that is late by tau
adds a flow as smooth as the motion; the oil takes up most where the force turns over, in some
hundredths of a second.  Which channel is how late nobody knows, so tau is fitted, with half a
sample as its prior deviation: without dry friction the force goes with the speed, and nothing else
tells the two apart.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from eha_monitor.balances.baseline import BalanceFit, Term, fitted
from eha_monitor.balances.candidates import leaks_to_case, oil_pressed, swallowed
from eha_monitor.balances.course import Course, slope
from eha_monitor.balances.least_squares import beside, rms
from eha_monitor.balances.policy import POLICY
from eha_monitor.balances.table import areas_apart, displaced, flow_columns
from eha_monitor.balances.together import pooled
from eha_monitor.settings.rig import Rig

CLEAR = 5.0  # times the noise of a regressor: its noise then draws the parameter by 4 % at most
# Of what is left of the flow, that may look like the oil's part: where one chamber's is compared,
# and where the mean of both.  Measured, in 125 recordings of 48 simulated rigs by a stranger's
# equations (median of the error over that: 0.19 and 0.23), and in 36 of ten rigs (0.04 to 0.19).
ALIKE, ALIKE_BOTH = 0.2, 0.11


class Flow(NamedTuple):
    """The flow balance in the band of a course.

    flow : (m,) what the piston takes beyond the config's effects, m³/s.
    columns : pump and leakages as :func:`baseline.fitted` takes them.
    off : what may be off, each by one prior deviation: a lag, and the areas.
    pressed : (m,) V(x) p' of the oil that the pump presses, m³·Pa/s, by the config's volumes, or
        by volumes that change over the stroke as the areas say.
    """

    course: Course
    flow: np.ndarray
    columns: tuple
    off: tuple[np.ndarray, ...]
    pressed: list[np.ndarray]

    def left(self, pressed: np.ndarray, stiffness: float) -> BalanceFit | None:
        """Return the fit of the other columns beside an oil of 1/beta_e, 1/Pa."""
        return fitted(self.course, self.course.counted("flow"), self.flow + stiffness * pressed,
                      self.columns, off=self.off)

    def rows(self, *columns: np.ndarray) -> np.ndarray:
        """Return columns (m,) in the band, at the samples that count."""
        return self.course.in_band(np.column_stack(columns))[
            self.course.compared(self.course.counted("flow"))]


def flow_of(course: Course, rig: Rig) -> Flow | None:
    """Return the flow balance of a course in its band; None without its channels or volumes."""
    columns = flow_columns(course, rig)
    if columns is None or not (rig.volume_1 and rig.volume_2) or "flow" not in course.known:
        return None
    flow, (pump, leakage, _) = columns
    leakage = (*leakage[:3], 0, leakage[4])  # beside the config's it may be less
    late = course.skew * displaced(course, course.taken(rig)) * slope(pump[-1], course.dt)
    known, own = course.added("flow"), (pump, leakage)
    if not course.mean_of_both:  # to the case, and to the make-up path, which is part of it
        case = leaks_to_case(course, rig)
        known, own = known - rig.makeup_conductance * case, (*own, (
            "L", leakage[1], "leakage to the case", 1, case))
    pressed = [course.of_filled(*oil_pressed(course, rig))]
    if not np.any(course.added("stroke")):
        pressed.append(pressed[0] + rig.area_1 * course.x * course.of_filled(
            course.rate_1, course.rate_2))
    return Flow(course, flow - known, own, (late, *areas_apart(course, rig)), pressed)


def compressibility(course: Course, rig: Rig) -> Term | None:
    """Return 1/beta_e; None where the motion does not determine it."""
    found = clearest(course, rig)
    return None if found is None else found[1]


def clearest(course: Course, rig: Rig) -> tuple[Course, Term] | None:
    """Return a motion in the band that shows the oil best, and 1/beta_e there.

    It is the widest, or the next where the pressures' noise hides the oil's part in it: that of a
    smooth motion, which is as slow as the rest.
    """
    for one in (course,) if course.wide is None else (course.quick, course):
        found = _within(one, rig)
        if found is not None:
            return one, found
    return None


def _within(course: Course, rig: Rig) -> Term | None:
    """Return 1/beta_e in a course's band, None where the motion does not determine it.

    The deviation holds how far it goes beside what a pump loses in either direction, which
    resembles the oil's part at one speed, and beside a play of the position sensor, which misses
    as much where the motion reverses; and that a share ``ALIKE`` of what is left may look like the
    oil's part, with the rms that this has of its own.
    """
    balance = flow_of(course, rig)
    if balance is None:
        return None
    found: list[tuple[float, Term]] = []
    for pressed in balance.pressed:
        own = _own(balance.rows(pressed, *(column[-1] for column in balance.columns)))
        if own < CLEAR * rig.volume_1 * course.sensors["p"] * course.passed[1]:
            continue
        fit = _beside_losses(balance, rig, pressed)
        if fit is not None and fit["1/beta_e"].determined:
            found.append((fit.error_share, _looking_alike(fit["1/beta_e"], fit, balance, own)))
    # A cylinder's volumes change over its stroke; the config's may be those of another place, but
    # where the flow hardly says so they are not.
    return min(reversed(found), key=lambda one: one[0] * (
        np.exp(POLICY.alone) if one is not found[-1] else 1.0), default=(0.0, None))[1]


def leakage(course: Course, rig: Rig) -> Term | None:
    """Return what leaks across the piston beyond the config's, m³/(s·Pa); None where unknown.

    Of equal areas, where piston, pump and make-up path are one number.  Its deviation holds what
    that of :func:`_within` does.
    """
    balance = flow_of(course, rig) if course.ratio == 1.0 else None
    fit = None if balance is None else _beside_losses(balance, rig, balance.pressed[0])
    if fit is None or not fit["C_L"].determined:
        return None
    pump, leak, *others = (column[-1] for column in balance.columns)
    own = _own(balance.rows(leak, pump, *others, balance.pressed[0]))
    return _looking_alike(fit["C_L"], fit, balance, own)


def _beside_losses(balance: Flow, rig: Rig, pressed: np.ndarray) -> BalanceFit | None:
    """Return the fit with the oil's part, beside what a pump may lose."""
    course = balance.course
    bent = (course.direction, np.ones(len(course)), swallowed(course, rig, sharp=False))
    return fitted(course, course.counted("flow"), balance.flow, (
        *balance.columns, ("1/beta_e", "1/Pa", "compressibility", 1, -pressed)), bent,
        off=balance.off)


def _looking_alike(term: Term, fit: BalanceFit, balance: Flow, own: float) -> Term:
    """Return a term as unsure as a share of what is left is that looks like it.

    ``own`` : rms of what no other column makes of its own.
    """
    alike = ALIKE_BOTH if balance.course.mean_of_both else ALIKE
    left = fit.error_share * float(np.std(balance.rows(balance.flow)))
    return replace(term, stddev=float(np.hypot(term.stddev, alike * left / own)))


def _own(rows: np.ndarray) -> float:
    """Return the rms of what no other column makes of the first."""
    return rms(beside(rows[:, 0], rows[:, 1:]))


@dataclass(frozen=True)
class Stiffness:
    """1/beta_e of recordings: mean, spread between them and deviation of the mean, 1/Pa.

    ``count`` : recordings that determine it.
    """

    value: float
    between: float
    stddev: float
    count: int = 0

    @property
    def modulus(self) -> tuple[float, float]:
        """The effective bulk modulus and how far it is off or differs from recording to recording.

        Both infinite where nothing determines it.
        """
        if not self.value > 0.0:
            return np.inf, np.inf
        return 1.0 / self.value, float(np.hypot(self.between, self.stddev)) / self.value**2


UNKNOWN = Stiffness(0.0, 0.0, np.inf)


def stiffness_of(courses: Sequence[Course], rig: Rig) -> Stiffness:
    """Return what recordings say together of the oil; an infinite deviation where none does."""
    each = [term for course in courses if (term := compressibility(course, rig)) is not None]
    if not each:
        return UNKNOWN
    values, stddevs = (np.array([getattr(term, key) for term in each])
                       for key in ("value", "stddev"))
    return Stiffness(*pooled(values, stddevs, float(values[0])), len(each))
