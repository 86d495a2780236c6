"""A fitted model along a recording: smoothed states, and the parts of its equations there.

Smoothed states are those of a filtered record, with what later samples say carried back over it.
The parts are effects, drive, and a sensor's play on a given motion.
"""

from collections.abc import Sequence

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.modelled import contributions_along
from eha_monitor.mismatch.data.experiment import Experiment, Stretch
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.fit import Fit, filtered, spread
from eha_monitor.mismatch.likelihood.gains import linear_of
from eha_monitor.mismatch.likelihood.innovations import N_FILTERED
from eha_monitor.physics import plant
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import ALL_NAMES, turned_memory

DOUBLINGS, SETTLED = 16, 1e-12  # 65 536 samples; relative change at which it stands
UNKNOWN = 1e15  # variances of a state's size or of a reading: beyond it, rounding takes the other


def covariance_before(a: np.ndarray, h: np.ndarray, q: np.ndarray, r: np.ndarray,
                      size: np.ndarray) -> np.ndarray:
    """Return the steady covariance of the prediction, (n, n).

    By doubling: each step takes twice as many samples of Riccati's equation as that before (Chu,
    Fan, Lin, Wang 2004, Eq. 2.9).  Where a state shows in nothing that is measured, or the model
    runs away, the covariance grows for ever and a solver of the algebraic equation fails; here
    it is that of ``2^DOUBLINGS`` samples, or the last that is not ``UNKNOWN``.

    Parameters
    ----------
    a, h : (n, n) and (m, n); q, r : (n,) and (m,) variances.
    size : (n,) typical size of each state: force and flow differ by ten decades.
    """
    here = q > 0
    scale = size[here]
    a = a[np.ix_(here, here)] * scale / scale[:, None]
    sigma = np.sqrt(r)
    h = h[:, here] * scale / sigma[:, None]
    back, precision, found = a.T, h.T @ h, np.diag(q[here] / scale**2)
    for _ in range(DOUBLINGS):
        inner = np.eye(len(scale)) + precision @ found
        if not np.abs(inner).max() < UNKNOWN:
            break
        inner = np.linalg.inv(inner)
        more = back.T @ found @ inner @ back
        if not np.abs(more).max() < UNKNOWN:
            break
        precision = precision + back @ inner @ precision @ back.T
        back, found = back @ inner @ back, found + 0.5 * (more + more.T)
        if np.abs(more).max() <= SETTLED * np.abs(found).max():
            break
    p = np.zeros((len(q), len(q)))
    p[np.ix_(here, here)] = found * np.outer(scale, scale)
    return 0.5 * (p + p.T)


def gain_of(p: np.ndarray, h: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gain (n, m) and S^-1 (m, m) of a steady filter."""
    inverse = np.linalg.inv(h @ p @ h.T + np.diag(r))
    return p @ h.T @ inverse, inverse


@njit(nogil=True)
def smooth_back(states, e, a, c, hs, p):
    """Carry what the later samples say back over a filtered record, in place.

    Fixed-interval smoother after Bryson and Frazier 1963: an adjoint runs backwards, and nothing
    is inverted at a sample.

    Parameters
    ----------
    states : (n, N) after the correction; smoothed on return.
    e : (n, m) innovations, 0 where nothing was measured.
    a, c : (N, N) transition, 1 - K H; hs : (N, m) H' S^-1; p : (N, N) after the correction.
    """
    n, size = states.shape
    adjoint, other = np.zeros(size), np.zeros(size)
    for k in range(n - 1, -1, -1):
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += p[i, j] * adjoint[j]
            states[k, i] -= total
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += c[j, i] * adjoint[j]
            for j in range(e.shape[1]):
                total -= hs[i, j] * e[k, j]
            other[i] = total
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += a[j, i] * other[j]
            adjoint[i] = total


def smoothed(experiment: Experiment, fit: Fit) -> list[np.ndarray]:
    """Return the smoothed states of each stretch, (n, N_FILTERED) each, SI.

    Looking forward and back alike, a reversal stands where it happened.
    """
    m = linear_of(experiment, fit.theta, fit.active, fit.unknowns)
    columns = experiment.columns
    h, r = m.h[columns], m.r[columns]
    p = covariance_before(m.a, h, m.q, r, np.sqrt(np.maximum(m.q + m.start, 1e-300)))
    gain, inverse = gain_of(p, h, r)
    c = np.eye(N_FILTERED) - gain @ h
    after = c @ p

    def one(stretch: Stretch) -> np.ndarray:
        e, states = filtered(experiment, stretch, fit.theta, fit.active, fit.gains, states=True)
        kept = np.ascontiguousarray(np.nan_to_num(e[:, columns]))  # one layout, compiled once
        smooth_back(states, kept, m.a, c, np.ascontiguousarray(h.T @ inverse), after)
        return states

    return spread(one, experiment.stretches)


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
                        turned_memory(float(track[0, s.ANGLE]), float(track[0, s.T])), found)
    return found


def signals_along(experiment: Experiment, stretch: Stretch, states: np.ndarray) -> np.ndarray:
    """Return the signals of the equations on a smoothed trajectory, (n, N_SIGNALS)."""
    n = len(states)
    found = np.zeros((n, s.N_SIGNALS))
    found[:, s.T] = stretch.start + np.arange(n) * experiment.dt
    found[:, s.X], found[:, s.V] = states[:, plant.Y_X], states[:, plant.Y_V]
    if experiment.mode == FORCED:
        found[:, s.P1], found[:, s.P2] = stretch.p1, stretch.p2
        return found
    found[:, s.P1], found[:, s.P2] = states[:, plant.Y_P1], states[:, plant.Y_P2]
    if experiment.used[4]:  # nearer to the truth than any model of the drive
        speed = stretch.z[:, 4]
        bridged = states[:, plant.Y_OMEGA] + states[:, plant.Y_SPEED]
        found[:, s.OMEGA] = np.where(np.isfinite(speed), speed, bridged)
    elif experiment.mode == CLOSED:
        found[:, s.OMEGA] = states[:, plant.Y_OMEGA] + states[:, plant.Y_SPEED]
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
            demand = plant.input_at(u, 1, place - w[s.COMMAND_DELAY] / dt)
            wanted = plant.shaft_speed(plant.drive_speed(demand, where, theta, w), w)
            if k == 0 and i == 0:
                omega = wanted
            if i == 0:
                out[k] = omega if slow else wanted
            if slow:
                rate = plant.drive_rate(wanted, omega, lag, slew)
                omega += rate * lag * (1.0 - np.exp(-h / lag))


@njit
def played(x, play):
    """Return positions behind a play of width ``play``, m (n,)."""
    out = x.copy()
    for k in range(1, len(x)):
        out[k] = min(max(out[k - 1], x[k] - 0.5 * play), x[k] + 0.5 * play)
    return out
