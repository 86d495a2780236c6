"""B and beta_e of some seconds by least squares, beside the model that the config has.

    F - known = (M) x'' + B x' + F_0 (+ F_c sgn x')             force balance
    A x' - known = D_p omega - V(x) p' / beta_e - C_L (p1 - p2)  flow balance

``known`` is what the config's effects add along the measured motion.  Mass, load, displacement and
leakage stand beside as free numbers, so that a wrong one of the config moves neither parameter.  A
filter that follows a model sample by sample is more precise where that model is right, and led
astray where it is not; these two equations ask for so little that a stranger's machine meets them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.balances.baseline import (
    Term,
    falling,
    fitted,
    force_fit,
)
from eha_monitor.balances.bends import FALL
from eha_monitor.balances.candidates import fall_speeds, oil_pressed, swallowed
from eha_monitor.balances.course import BAND, BANDS, Course, slope
from eha_monitor.balances.measured import course_within
from eha_monitor.balances.table import areas_apart, flow_columns
from eha_monitor.balances.together import of_one_machine, pooled
from eha_monitor.errors import InputError
from eha_monitor.estimation.results import (
    EVERY_S,
    LOOK_S,
    ONE,
    TWO,
    Beside,
    ParameterEstimate,
)
from eha_monitor.estimation.rig_model import force_of
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.recordings.recording import Recording, rows_of, sample_of
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig

CLEAR = 5.0  # times the noise of a regressor: its noise then draws the parameter by 4 % at most
LEAST_S = 5.0  # of rows that a first look needs
MOST = 200  # looks at one recording
# Of what is left of the flow, that may look like the oil's part.  Measured: 0.04 to 0.19, 0.11 on
# average, in 36 recordings of ten simulated rigs, four of these by a stranger's equations.
ALIKE = 0.11
HELD = 0.7  # of the force's rms: less within a band, and its balances say nothing of the motion


def parameters_of(recording: Recording, settings: Settings) -> dict[str, ParameterEstimate]:
    """Return B and beta_e by least squares; those that the balances hold, each with its status.

    Parameters
    ----------
    recording : some seconds; of a longer one a sample is taken.
    settings : the config; its effects count as known.
    """
    found: dict[str, ParameterEstimate] = {}
    whole = np.nanstd(force_of(settings.rig, sample_of(recording).channels))
    course = None
    for band in BANDS:
        try:
            course = course_within(recording, settings, band)
        except InputError:
            break
        if "B" in found or np.std(course.in_band(course.force)) < HELD * whole:
            continue
        damping = _damping(course, settings)
        if damping is not None:
            found["B"] = ONE.judged(settings, damping.value, damping.stddev)
    soft = None if course is None else compressibility(
        *of_one_machine([course], settings.rig), settings.rig)
    if soft is not None:
        found["beta_e"] = TWO.judged(settings, 1.0 / soft.value, soft.stddev / soft.value**2)
    return found


def along(recording: Recording, settings: Settings) -> Iterator[Beside]:
    """Yield B and beta_e of the last ``LOOK_S`` every ``EVERY_S`` s, as live, and at the end."""
    rows, dt = len(recording), recording.sample_time
    every = max(round(EVERY_S / dt), -(-rows // MOST))
    for stop in sorted({*range(round(LEAST_S / dt), rows, every), rows}):
        start = max(0, stop - round(LOOK_S / dt))
        yield Beside((stop - 1) * dt, parameters_of(rows_of(recording, start, stop), settings))


def _damping(course: Course, settings: Settings) -> Term | None:
    """Return B: with the config's dry friction, or with one of its own, whichever is surer.

    The deviation of the first holds how far another dry friction moves it where that fits better,
    that of the second how little the motion may tell friction from damping.  A quick motion shows
    milliseconds between the channels as damping, which the deviation holds as well; and friction
    that falls over the speeds of the motion is less damping, as far as these do not exclude it.
    """
    rig = settings.rig
    known = course.known["force"] - rig.mass * course.a
    late = slope(course.force, course.dt) if course.band > BAND else None
    free = force_fit(course, rig, known)
    dry = _friction(settings) + (0.0 if free is None else free["F_c"].value)
    falls = [FALL * dry * falling(course, speed / max(course.speed, 1e-300))
             for speed in fall_speeds(course, rig)]
    ways = [fit["B"] for held in (True, False)
            if (fit := force_fit(course, rig, known, held, late, falls)) is not None]
    ways = [term for term in ways if term.determined]
    return min(ways, key=lambda term: term.stddev, default=None)


def _friction(settings: Settings) -> float:
    """Return the dry friction that the config has, N."""
    return sum(abs(float(values.get("F_c", 0.0))) for name, values in settings.effects.items()
               if getattr(CATALOGUE.get(name), "family", "") == "dry")


def compressibility(course: Course, rig: Rig) -> Term | None:
    """Return 1/beta_e, of a band in which the oil's part differs from that of a late channel.

    A speed that is late by tau adds tau D_p omega' to the flow, as smooth as the motion; the oil
    takes up most where the force turns over, in some hundredths of a second.  Which channel is how
    late nobody knows, so tau is fitted.  The volumes are the config's, or change over the stroke
    as the areas say, whichever leaves less.

    The deviation holds how far it goes beside what a pump loses in either direction, which
    resembles the oil's part at one speed, and beside a play of the position sensor, which misses
    as much where the motion reverses; and that ``ALIKE`` of what is left may look like the oil's
    part, with the rms that this has of its own.
    """
    course = course.quick
    columns = flow_columns(course, rig)
    if columns is None or not (rig.volume_1 and rig.volume_2) or "flow" not in course.known:
        return None
    flow, (pump, leakage, _) = columns
    leakage = (*leakage[:3], 0, leakage[4])  # beside the config's it may be less
    late = ("tau", "m³", "lag of the pump's speed", 0, slope(pump[4], course.dt))
    stroke = course.added("stroke")
    flow = flow - course.added("flow")
    oil = course.of_filled(*oil_pressed(course, rig))
    ways = [oil]
    if not np.any(stroke):
        ways.append(oil + rig.area_1 * course.x * course.of_filled(course.rate_1, course.rate_2))
    bent = (course.direction, np.ones(len(course)), swallowed(course, rig, sharp=False))
    found: list[tuple[float, Term]] = []
    whole = float(np.std(course.in_band(flow)[course.compared(course.counted("flow"))]))
    for taken in ways:
        own = _own(course, taken, np.column_stack([pump[4], leakage[4], late[4]]))
        if own < CLEAR * rig.volume_1 * course.sensors["p"] * course.passed[1]:
            continue
        fit = fitted(course, course.counted("flow"), flow, (
            pump, leakage, ("1/beta_e", "1/Pa", "compressibility", 1, -taken), late), bent,
            off=areas_apart(course, rig))
        if fit is not None and fit["1/beta_e"].determined:
            term = fit["1/beta_e"]
            found.append((fit.error_share, replace(term, stddev=float(np.hypot(
                term.stddev, ALIKE * fit.error_share * whole / own)))))
    return min(found, key=lambda one: one[0], default=(0.0, None))[1]


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


def _own(course: Course, column: np.ndarray, others: np.ndarray) -> float:
    """Return the rms of what no other column makes of one; below noise it is no regressor."""
    rows = course.in_band(np.column_stack([column, others]))[
        course.compared(course.counted("flow"))]
    shares = np.linalg.lstsq(rows[:, 1:], rows[:, 0], rcond=None)[0]
    return float(np.sqrt(np.mean((rows[:, 0] - rows[:, 1:] @ shares) ** 2)))
