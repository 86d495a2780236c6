"""The parts of the equations on a given motion: effects, drive, and a sensor's play."""

from collections.abc import Sequence

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.modelled import contributions_along
from eha_monitor.mismatch.data.experiment import Experiment, Stretch
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.fit import Fit, filtered
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import ALL_NAMES, turned_memory
from eha_monitor.physics.plant import (
    Y_OMEGA,
    Y_P1,
    Y_P2,
    Y_SPEED,
    Y_V,
    Y_X,
    drive_rate,
    drive_speed,
    input_at,
    shaft_speed,
)


def filtered_tracks(experiment: Experiment, fit: Fit) -> list[np.ndarray]:
    """Return the signals along each stretch as the filter has them, (n, N_SIGNALS) each."""
    return [signals_along(experiment, stretch, filtered(
        experiment, stretch, fit.theta, fit.active, fit.gains, states=True)[1])
        for stretch in experiment.stretches]


def contributed(experiment: Experiment, theta: np.ndarray, track: np.ndarray,
                names: Sequence[str]) -> np.ndarray:
    """Return the contributions of some effects along a track, (n, N_CONTRIBUTIONS)."""
    found = np.zeros((len(track), s.N_CONTRIBUTIONS))
    contributions_along(track, experiment.dt, experiment.steps, theta,
                        np.isin(ALL_NAMES, list(names)),
                        turned_memory(float(track[0, s.ANGLE])), found)
    return found


def signals_along(experiment: Experiment, stretch: Stretch, states: np.ndarray) -> np.ndarray:
    """Return the signals of the equations on a smoothed trajectory, (n, N_SIGNALS)."""
    n = len(states)
    found = np.zeros((n, s.N_SIGNALS))
    found[:, s.T] = np.arange(n) * experiment.dt
    found[:, s.X], found[:, s.V] = states[:, Y_X], states[:, Y_V]
    if experiment.mode == FORCED:
        found[:, s.P1], found[:, s.P2] = stretch.p1, stretch.p2
        return found
    found[:, s.P1], found[:, s.P2] = states[:, Y_P1], states[:, Y_P2]
    if experiment.used[4]:  # nearer to the truth than any model of the drive
        speed = stretch.z[:, 4]
        bridged = states[:, Y_OMEGA] + states[:, Y_SPEED]
        found[:, s.OMEGA] = np.where(np.isfinite(speed), speed, bridged)
    elif experiment.mode == CLOSED:
        found[:, s.OMEGA] = states[:, Y_OMEGA] + states[:, Y_SPEED]
    else:
        found[:, s.OMEGA] = stretch.u[:, 0]
    if experiment.mode == CLOSED:
        found[:, s.X_D] = stretch.u[:, 0]
    if stretch.angle is not None:
        found[:, s.ANGLE] = stretch.angle
    return found


@njit(nogil=True)
def drive_along(x, u, dt, steps, theta, w, out):
    """Write the shaft speed that a drive makes of the demand and a given position, rad/s.

    Parameters
    ----------
    x : (n,) position, m; u : (n, 4) demanded position as cubics.
    w : (N_CIRCUIT,) constants of the drive; out : (n,) written.
    """
    n = x.shape[0]
    h = dt / steps
    lag, slew = w[s.DRIVE_LAG], w[s.SLEW_LIMIT]
    slow = lag > 0.5 * h or slew < np.inf
    lag = max(lag, 0.5 * h)
    omega = 0.0
    for k in range(n):
        for i in range(steps):
            place = k + i / steps
            late = min(max(place - w[s.FEEDBACK_DELAY] / dt, 0.0), n - 1.0)
            j = min(int(late), n - 2)
            where = x[j] + (late - j) * (x[j + 1] - x[j])
            demand = input_at(u, 1, place - w[s.COMMAND_DELAY] / dt)
            wanted = shaft_speed(drive_speed(demand, where, theta, w), w)
            if k == 0 and i == 0:
                omega = wanted
            if i == 0:
                out[k] = omega if slow else wanted
            if slow:
                rate = drive_rate(wanted, omega, lag, slew)
                omega += rate * lag * (1.0 - np.exp(-h / lag))


@njit
def played(x, play):
    """Return positions behind a play of width ``play``, m (n,)."""
    out = x.copy()
    for k in range(1, len(x)):
        out[k] = min(max(out[k - 1], x[k] - 0.5 * play), x[k] + 0.5 * play)
    return out
