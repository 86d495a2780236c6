"""At which angle of the shaft a recording begins: of a config's terms that are functions of it.

No channel has the angle, so a ripple learned from one recording stands at another phase in the
next.  The likelihood of the config's model says which.
"""

from dataclasses import replace

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import spread
from eha_monitor.mismatch.name.refit import unfitted
from eha_monitor.physics.contributions import ALL_NAMES, slot_of
from eha_monitor.physics.own_term import FIRST, KIND, LAST, OWN_NAMES, PHASE, TABLE, turns

TRIED = 192  # angles of a revolution: eight of each period of a pump of 24 teeth
FINER = 8  # angles between two of these


def at_its_angle(experiment: Experiment) -> Experiment:
    """Return an experiment whose terms of the shaft's angle begin where the recording does."""
    for name in OWN_NAMES:
        which = ALL_NAMES.index(name)
        if not experiment.active[which] or not turns(experiment.theta[slot_of(which)]):
            continue
        q = experiment.theta[slot_of(which)]
        period = q[LAST] - q[FIRST] if q[KIND] == TABLE else 2.0 * np.pi
        step = period / TRIED
        coarse = best_of(experiment, which, step * np.arange(TRIED))
        fine = coarse + step * np.linspace(-1.0, 1.0, 2 * FINER + 1)
        experiment = begun_at(experiment, which, best_of(experiment, which, fine))
    return experiment


def begun_at(experiment: Experiment, which: int, angle: float) -> Experiment:
    """Return an experiment in which one term begins at an angle, rad."""
    theta = experiment.theta.copy()
    theta[slot_of(which).start + PHASE] = angle
    return replace(experiment, theta=theta)


def best_of(experiment: Experiment, which: int, angles: np.ndarray) -> float:
    """Return the angle under which the recording is most likely, rad."""
    found = spread(lambda angle: unfitted(
        begun_at(experiment, which, angle)).log_likelihood, angles)
    return float(angles[ties.largest(found, ties.GUESS)])
