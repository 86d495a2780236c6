"""B and beta_e of some seconds by least squares, beside the model that the config has.

    F - known = (M) x'' + B x' + F_0 (+ F_c sgn x')             force balance
    A x' - known = D_p omega - C_h p' - C_L (p1 - p2)           flow balance, beta_e = V_1 / C_h

``known`` is what the config's effects add along the measured motion.  Mass, load, displacement and
leakage stand beside as free numbers, so that a wrong one of the config moves neither parameter.  A
filter that follows a model sample by sample is more precise where that model is right, and led
astray where it is not; these two equations ask for so little that a stranger's machine meets them.
"""

from collections.abc import Iterator

import numpy as np

from eha_monitor.balances.baseline import BalanceFit, Term, fitted, flow_columns, force_fit
from eha_monitor.balances.course import Course, course_of
from eha_monitor.errors import InputError
from eha_monitor.estimation.results import ONE, TWO, Beside, ParameterEstimate
from eha_monitor.estimation.rig_model import force_of
from eha_monitor.recordings.recording import Recording, rows_of, sample_of
from eha_monitor.settings.monitor import Settings

CLEAR = 5.0  # times the noise of a regressor: its noise then draws the parameter by 4 % at most
WINDOW_S, LEAST_S, EVERY_S = 20.0, 5.0, 2.0  # how much is looked at, and how often
MOST = 200  # looks at one recording
HELD = 0.7  # of the force's rms: less within the balances' band, and they say nothing of the motion


def parameters_of(recording: Recording, settings: Settings) -> dict[str, ParameterEstimate]:
    """Return B and beta_e by least squares; those that the balances hold, each with its status.

    Parameters
    ----------
    recording : some seconds; of a longer one a sample is taken.
    settings : the config; its effects count as known.
    """
    try:
        course = course_of(recording, settings)
    except InputError:
        return {}
    found: dict[str, ParameterEstimate] = {}
    if np.std(course.in_band(course.force)) < HELD * np.nanstd(force_of(
            settings.rig, sample_of(recording).channels)):
        return found
    damping = _damping(course, settings)
    if damping is not None:
        found["B"] = ONE.judged(settings, damping.value, damping.stddev)
    soft = _compliance(course, settings)
    if soft is not None:
        beta = settings.rig.volume_1 / soft.value
        found["beta_e"] = TWO.judged(settings, beta, beta * soft.stddev / soft.value)
    return found


def along(recording: Recording, settings: Settings) -> Iterator[Beside]:
    """Yield B and beta_e of the last ``WINDOW_S`` every ``EVERY_S`` s, as live, and at the end."""
    rows, dt = len(recording), recording.sample_time
    every = max(round(EVERY_S / dt), -(-rows // MOST))
    for stop in sorted({*range(round(LEAST_S / dt), rows, every), rows}):
        start = max(0, stop - round(WINDOW_S / dt))
        yield Beside((stop - 1) * dt, parameters_of(rows_of(recording, start, stop), settings))


def _damping(course: Course, settings: Settings) -> Term | None:
    """Return B: with the config's dry friction, or with one of its own, whichever is surer.

    The deviation of the first holds how far another dry friction moves it where that fits better,
    that of the second how little the motion may tell friction from damping.
    """
    rig = settings.rig
    known = course.known["force"] - rig.mass * course.a
    ways = [fit["B"] for held in (True, False)
            if (fit := force_fit(course, rig, known, held)) is not None]
    ways = [term for term in ways if term.determined]
    return min(ways, key=lambda term: term.stddev, default=None)


def _compliance(course: Course, settings: Settings) -> Term | None:
    """Return C_h; its deviation holds how far channels that are late against one another move it.

    A position that is late by tau adds tau A x'' to the flow, which resembles C_h p'; so does, at
    one speed, what a pump loses in either direction.
    """
    rig = settings.rig
    columns = flow_columns(course, rig)
    if columns is None or not rig.volume_1 or "flow" not in course.known:
        return None
    side, (pump, leakage, soft) = columns
    leakage = (*leakage[:3], 0, leakage[4])  # beside the config's it may be less
    fit: BalanceFit | None = fitted(course, course.counted("flow"), side - course.known["flow"],
                                    (pump, leakage, soft),
                                    (course.a, course.direction, np.ones(len(course))))
    if fit is None or not fit["C_h"].determined:
        return None
    noise = course.sensors["p"] * course.passed[1]
    others = np.column_stack([pump[4], leakage[4]])
    return fit["C_h"] if _own(course, soft[4], others) > CLEAR * noise else None


def _own(course: Course, column: np.ndarray, others: np.ndarray) -> float:
    """Return the rms of what no other column makes of one; below noise it is no regressor."""
    rows = course.in_band(np.column_stack([column, others]))[
        course.compared(course.counted("flow"))]
    shares = np.linalg.lstsq(rows[:, 1:], rows[:, 0], rcond=None)[0]
    return float(np.sqrt(np.mean((rows[:, 0] - rows[:, 1:] @ shares) ** 2)))
