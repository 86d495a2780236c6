"""B and beta_e of some seconds by least squares, beside the model that the config has.

    F - known = M x'' + B x' + F_0 (+ F_c sgn x')  force balance, see :mod:`damping`
    A x' - known = D_p omega - V(x) p' / beta_e - C_L (p1 - p2)  flow balance, see :mod:`oil`

``known`` is what the config's effects add along the measured motion.  Mass, load, displacement and
leakage stand beside as free numbers, so that a wrong one of the config moves neither parameter.  A
filter that follows a model sample by sample is more precise where that model is right, and led
astray where it is not; these two equations ask for so little that a stranger's machine meets them.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from eha_monitor import ties
from eha_monitor.balances.course import BANDS, Course
from eha_monitor.balances.damping import damping
from eha_monitor.balances.measured import course_within
from eha_monitor.balances.oil import compressibility
from eha_monitor.balances.together import of_one_machine
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

LEAST_S = 5.0  # of rows that a first look needs
MOST = 200  # looks at one recording
HELD = 0.7  # of the force's rms: less within a band, and its balances say nothing of the motion


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
        one = _damping(course, settings)
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


def along(recording: Recording, settings: Settings) -> Iterator[Beside]:
    """Yield B and beta_e of the last ``LOOK_S`` every ``EVERY_S`` s, as live, and at the end."""
    rows, dt = len(recording), recording.sample_time
    every = max(round(EVERY_S / dt), -(-rows // MOST))
    for stop in sorted({*range(round(LEAST_S / dt), rows, every), rows}):
        start = max(0, stop - round(LOOK_S / dt))
        yield Beside((stop - 1) * dt, parameters_of(rows_of(recording, start, stop), settings))


def _damping(course: Course, settings: Settings) -> tuple[float, float] | None:
    """Return B and its deviation: with the config's dry friction, or one of its own.

    Whichever is surer: the deviation of the first holds how far another dry friction moves it
    where that fits better, of the second how little the motion may tell friction from damping.
    """
    rig = settings.rig
    known = course.known["force"] - rig.mass * course.a
    ways = [found for held in (True, False) if (found := damping(
        course, rig, known, _friction(settings), held)) is not None]
    return ties.best(ways, lambda way: -way[1]) if ways else None


def _friction(settings: Settings) -> float:
    """Return the dry friction that the config has, N."""
    return sum(abs(float(values.get("F_c", 0.0))) for name, values in settings.effects.items()
               if getattr(CATALOGUE.get(name), "family", "") == "dry")
