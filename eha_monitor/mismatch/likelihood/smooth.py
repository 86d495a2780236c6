"""Smoothed states of a filtered record: what later samples say carried back over it."""

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.mismatch.data.experiment import Experiment, Stretch
from eha_monitor.mismatch.likelihood.fit import Fit, filtered, spread
from eha_monitor.mismatch.likelihood.gains import linear_of
from eha_monitor.mismatch.likelihood.innovations import N_FILTERED

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
