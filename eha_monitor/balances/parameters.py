"""B, beta_e and leakage of some seconds by least squares, beside the model that the config has.

    F - known = M x'' + B x' + F_0 + F_c sgn x'    force balance, see :func:`damping`
    A x' - known = D_p omega - V(x) p' / beta_e - C_L (p1 - p2)  flow balance, see :mod:`oil`

``known`` is what the config's effects add along the measured motion.  Mass, load, dry friction,
displacement and leakage stand beside as free numbers, so that a wrong one of the config, or one
that wears, moves neither parameter.  A filter that follows a model sample by sample is more
precise where that model is right, and led astray where it is not; these two equations ask for so
little that a stranger's machine meets them.

A straight line through friction over speed reads its fall as less damping.  How it falls nobody
knows: over 1 to 50 mm/s, as an exponential, as a normal curve, or it only turns round slowly.
Each such f stands in the force balance, as w f(x'), in turn, and B is the mean over these models,
each as likely as the motion makes it (Bayesian model averaging: Hoeting, Madigan, Raftery,
Volinsky 1999).
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from eha_monitor import ties
from eha_monitor.balances.baseline import BETTER, BLOCK
from eha_monitor.balances.bends import FALL
from eha_monitor.balances.candidates import fall_speeds
from eha_monitor.balances.course import BAND, BANDS, Course, slope
from eha_monitor.balances.least_squares import (
    beside,
    independent,
    inverse_of,
    rms,
    signed_solution,
    unexcluded,
    weights_of,
)
from eha_monitor.balances.measured import course_within
from eha_monitor.balances.oil import compressibility, leakage
from eha_monitor.balances.together import of_one_machine
from eha_monitor.errors import InputError
from eha_monitor.estimation.results import (
    EVERY_S,
    LOOK_S,
    ONE,
    TWO,
    Beside,
    ParameterEstimate,
    judge_parameter,
    units_of,
)
from eha_monitor.estimation.rig_model import force_of
from eha_monitor.physics.effects import DRY_LAWS
from eha_monitor.recordings.recording import Recording, rows_of, sample_of
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig

LEAST_S = 5.0  # of rows that a first look needs
MOST = 200  # looks at one recording
HELD = 0.7  # of the force's rms: less within a band, and its balances say nothing of the motion
# Of how far B goes with the way that friction falls, what its true shape may change.  Measured:
# the rms of B's error over that, where it is large, in 33 of 173 motions of 53 simulated rigs
# with friction of eight laws, five of these rigs by a stranger's equations; 0.54.
SHAPE = 0.5
SPEEDS = 12  # over which friction may fall: a ratio of 1.4 from one to the next
FALLS = 2  # that may stand together: what breaks away, and what falls on
SINCE = 0.25, 0.5, 0.75  # of the seconds: dry friction may be another since
B = 2  # its column


def parameters_of(recording: Recording, settings: Settings) -> dict[str, ParameterEstimate]:
    """Return B and beta_e by least squares; those that the balances hold, each with its status.

    Parameters
    ----------
    recording : some seconds; of a longer one a sample is taken.
    settings : the config; its effects count as known.
    """
    found: dict[str, ParameterEstimate] = {}
    motion = None  # in the first band that holds it, with that in the widest
    damped: list[tuple[float, float]] = []
    for band in BANDS:
        try:
            course = course_within(recording, settings, band)
        except InputError:
            break
        if np.std(course.in_band(course.force)) < HELD * np.nanstd(force_of(
                settings.rig, sample_of(recording).channels)):
            continue
        motion = course if motion is None else replace(motion, wide=course)
        known = course.known["force"] - settings.rig.mass * course.a
        one = damping(course, settings.rig, known, _friction(settings))
        damped += [] if one is None else [one]
    if damped:
        # Of the band in which it is surest, and no better known than it is the same in the other.
        value, stddev = ties.best(damped, lambda one: -one[1])
        stddev = float(np.hypot(stddev, np.ptp([one[0] for one in damped])))
        found["B"] = ONE.by_balance(settings, value, stddev)
    soft = None if motion is None else compressibility(
        *of_one_machine([motion], settings.rig), settings.rig)
    if soft is not None:
        found["beta_e"] = TWO.by_balance(settings, 1.0 / soft.value, soft.stddev / soft.value**2)
    return found


def leakage_of(recording: Recording, settings: Settings) -> ParameterEstimate | None:
    """Return C_T by least squares; None without a flow balance, or of less than ``LEAST_S``.

    Areas that are off are off in it by the same share.
    """
    rig = settings.rig
    if recording.duration < LEAST_S:
        return None
    try:
        courses = of_one_machine([course_within(recording, settings, BAND)], rig)
    except InputError:
        return None
    found = leakage(*courses, rig)
    if found is None:
        return None
    value = rig.leakage + 2.0 * found.value
    stddev = float(np.hypot(2.0 * found.stddev, value * rig.tolerance.log_spread("area_1")))
    return judge_parameter("L", value, stddev, units_of(rig.motion)["L"], 0.0, np.inf)


def along(recording: Recording, settings: Settings) -> Iterator[Beside]:
    """Yield B and beta_e of the last ``LOOK_S`` every ``EVERY_S`` s, as live, and at the end."""
    rows, dt = len(recording), recording.sample_time
    every = max(round(EVERY_S / dt), -(-rows // MOST))
    for stop in sorted({*range(round(LEAST_S / dt), rows, every), rows}):
        start = max(0, stop - round(LOOK_S / dt))
        yield Beside((stop - 1) * dt, parameters_of(rows_of(recording, start, stop), settings))


def _friction(settings: Settings) -> float:
    """Return the dry friction that the config has, N."""
    return sum(abs(float(values.get("F_c", 0.0))) for name, values in settings.effects.items()
               if name in DRY_LAWS)


def damping(course: Course, rig: Rig, known: np.ndarray, friction: float
            ) -> tuple[float, float] | None:
    """Return B and its standard deviation, SI; None where the motion does not determine it.

    The deviation holds the noise, the mixture of the falls and ``SHAPE``, how far B goes with
    parts of the motion (jackknife of ``BLOCK`` s: Efron 1982), and beside what else a law may have
    where that fits better: a spring, damping by the square of speed, dry friction that becomes
    another in these seconds, where quick a late channel.

    Parameters
    ----------
    known : (m,) N, what else acts as the config says.
    friction : N, the config's dry friction; in ``known``.
    """
    if not course.shows:
        return None
    counted = course.compared(course.counted("force"))
    own = [np.ones(len(course)), course.a, course.v, course.direction]
    rows = course.in_band(np.column_stack([course.force - known, *own]))[counted]
    y, columns = rows[:, 0], rows[:, 1:]
    if len(y) < 4 * len(own):
        return None
    # Of load, inertia, damping, dry friction: beside the config's it may be less.
    signs = np.array([0, 1, 0, 0 if friction else 1])
    first = signed_solution(columns.T @ columns, columns.T @ y, signs)
    free = (signs == 0) | (first > 0.0)
    if not free[B] or not np.isfinite(inverse_of(columns.T @ columns)[B, B]):
        return None
    columns, place = columns[:, free], int(free[:B].sum())
    dry = max(friction + float(first[-1]), 0.0)
    fits = _Fits(y, place, counted)
    ways = FALL * dry * _falls(course, rig)[counted]
    plain, base, noise = fits.at(columns), columns, fits.noise(columns)
    for stands in range(FALLS + 1):
        at, left = fits.at(base), fits.left(base)
        found = [(at, float(inverse_of(base.T @ base)[place, place]) * noise, 0.0)]
        for way in ways.T:
            moves, mean, variance, log = unexcluded(base, way, left, noise, positive=True)
            found.append((at + mean * moves[place],
                          found[0][1] + variance * moves[place] ** 2, log))
        values, variances, logs = np.array(found).T
        if stands == FALLS or logs.max() < 0.5 * BETTER:
            break
        base = np.column_stack([base, ways[:, ties.largest(logs, ties.GUESS) - 1]])
        noise = min(noise, fits.noise(base))
    odds = np.exp(logs - logs.max())
    odds /= odds.sum()
    value = float(odds @ values)
    variance = max(float(odds @ (variances + (values - value) ** 2)),
                   fits.jackknifed(base, (np.flatnonzero(counted) * course.step / BLOCK)
                                   .astype(int)))
    others = course.in_band(np.column_stack(list(_others(course))))[counted]
    stddev = float(np.sqrt(variance + (SHAPE * (value - plain)) ** 2
                           + fits.shift(base, others) ** 2))
    return (value, stddev) if np.isfinite(stddev) else None


class _Fits:
    """Least squares of y (n,), of all samples those ``counted``; column ``place`` is B's."""

    def __init__(self, y: np.ndarray, place: int, counted: np.ndarray):
        self.y, self.place, self.counted = y, place, counted

    def at(self, columns: np.ndarray) -> float:
        """Return B."""
        return float(weights_of(columns.T @ columns, columns.T @ self.y)[self.place])

    def left(self, columns: np.ndarray) -> np.ndarray:
        return beside(self.y, columns)

    def alike(self, left: np.ndarray) -> float:
        """Return how many samples of what is left count as one."""
        whole = np.full(len(self.counted), np.nan)
        whole[self.counted] = left
        return independent(whole)

    def noise(self, columns: np.ndarray) -> float:
        """Return the variance of what is left, times the samples that count as one."""
        left, k = self.left(columns), columns.shape[1]
        alike = self.alike(left)
        effective = max(len(left) / alike, k + 1.0)
        return rms(left) ** 2 * effective / max(effective - k, 1.0) * alike

    def jackknifed(self, columns: np.ndarray, block: np.ndarray) -> float:
        """Return the variance of B as blocks of samples, left out in turn, have it."""
        gram, side, found = columns.T @ columns, columns.T @ self.y, []
        for one in np.unique(block):
            out = columns[block == one]
            found.append(weights_of(gram - out.T @ out,
                                    side - out.T @ self.y[block == one])[self.place])
        return (len(found) - 1.0) * float(np.var(found))

    def shift(self, columns: np.ndarray, others: np.ndarray) -> float:
        """Return how far B goes at most beside one of others (n, w) that fits better."""
        left, found = self.left(columns), 0.0
        limit = (1.0 - BETTER * self.alike(left) / len(left)) * float(left @ left)
        for other in others.T:
            more = np.column_stack([columns, other])
            rest = self.left(more)
            if float(rest @ rest) < limit:
                found = max(found, abs(self.at(more) - self.at(columns)))
        return found


def _falls(course: Course, rig: Rig) -> np.ndarray:
    """Return how friction of 1 N may differ from a step, in the band, (n, w) N.

    What it has more at rest, and what it lacks of a ``FALL`` where it turns round slowly.
    """
    speeds = np.geomspace(*fall_speeds(course, rig)[[0, -1]], SPEEDS)
    shares = np.abs(course.v)[:, None] / np.maximum(speeds, 1e-300)
    slowly = np.tanh(shares[:, :1]) - 1.0
    return course.in_band(course.direction[:, None] * np.hstack(
        [np.exp(-shares), np.exp(-shares**2), slowly / FALL]))


def _others(course: Course) -> Iterator[np.ndarray]:
    """Yield what else a force may have, (m,), each of any size."""
    yield course.x - np.mean(course.x)
    yield course.v * np.abs(course.v) / max(course.speed, 1e-300)
    at = np.linspace(0.0, 1.0, len(course))
    for share in SINCE:
        yield course.direction * (at > share)
    if course.band > BAND:
        yield slope(course.force, course.dt)
