"""Clean records of a rig whose balances are compared as they stand.

The measured motion stays.  Force, pump speed and demand are moved by what is left of their
balances, so that the given model explains them, and every sensor gets its noise and steps anew.
What the catalogue gains there, and how much each balance has left there, is the sensors' doing.
"""

from dataclasses import replace

import numpy as np

from eha_monitor.mismatch.data.experiment import PULL, Experiment, Stretch
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED, OPEN, course_of, filled
from eha_monitor.mismatch.likelihood.equation_error import left_along, low_pass, motion_of
from eha_monitor.mismatch.likelihood.fit import Fit, innovations
from eha_monitor.physics.signals import D_P

DRAWS = 3  # of the floor: each has hundreds of compared samples
QUIET = 5.0  # Hz: the motion itself, without what the sensors add to it


def simulated_balances(experiment: Experiment, fit: Fit, seed: int) -> Experiment:
    """Return the experiment as it would be if ``fit`` were the whole truth."""
    rng = np.random.default_rng(seed)
    return experiment.only(tuple(_noisy(experiment, _balanced(experiment, fit, stretch), rng)
                                 for stretch in experiment.stretches))


def floor_of(experiment: Experiment, fit: Fit) -> np.ndarray:
    """Return the deviation that the sensors alone leave in each balance, (c,) SI."""
    drawn = [np.nanstd(innovations(simulated_balances(experiment, fit, seed), fit.theta,
                                   fit.active, fit.gains), axis=0) for seed in range(DRAWS)]
    return np.mean(drawn, axis=0)


def _balanced(experiment: Experiment, fit: Fit, stretch: Stretch) -> Stretch:
    """Return a stretch without noise whose balances leave nothing."""
    from scipy.interpolate import CubicSpline  # its import is felt where no balance is compared

    rig, smooth = experiment.settings.rig, low_pass(min(QUIET, 0.2 / experiment.dt), experiment.dt)
    z = stretch.z.copy()
    for j in range(z.shape[1]):
        if np.isfinite(z[:, j]).any():
            z[:, j] = smooth(filled(z[:, j]))
    u = smooth(filled(stretch.u[:, 0]))
    now = replace(stretch, z=z, u=course_of(u, 0.0, experiment.held)[0])

    def left(balance: int) -> np.ndarray:
        row = left_along(experiment, now, fit.theta, fit.active)[balance]
        motion = motion_of(experiment, now)
        fine = np.arange(len(row)) * motion.dt
        return CubicSpline(fine, row)(np.arange(len(now)) * experiment.dt)

    if experiment.mode == FORCED:
        return replace(now, u=course_of(u - left(0), 0.0, experiment.held)[0])
    over = left(0)
    z = z.copy()
    # Half of it from each side: the mean pressure, which the circuit holds, stays about the same.
    z[:, 2] -= 0.5 * over / rig.area_1
    z[:, 3] += 0.5 * over / rig.area_2
    now = replace(now, z=z)
    more = left(1) / fit.theta[D_P]
    if experiment.mode == OPEN:
        return replace(now, u=course_of(u - more, 0.0, experiment.held)[0])
    z = z.copy()
    z[:, 4] -= more
    now = replace(now, z=z)
    return replace(now, u=course_of(u + left(2) / PULL, 0.0)[0])


def _noisy(experiment: Experiment, stretch: Stretch, rng: np.random.Generator) -> Stretch:
    z, noise = stretch.z.copy(), np.nan_to_num(experiment.noise)
    step = experiment.position_step
    rounding = step / np.sqrt(12.0)
    white = np.sqrt(max(noise[0] ** 2 - rounding**2, 0.0))
    z += np.where(np.arange(z.shape[1]) == 0, white, noise) * rng.standard_normal(z.shape)
    if step > 0:
        z[:, 0] = step * np.round(z[:, 0] / step)
    u = stretch.u[:, 0]
    if experiment.mode == CLOSED:
        # The demanded speed is known; its course holds the measured position.
        u = u + z[:, 0] - stretch.z[:, 0]
    else:
        u = u + experiment.input_noise * rng.standard_normal(len(u))
    return replace(stretch, z=z, u=course_of(u, 0.0, experiment.held)[0])
