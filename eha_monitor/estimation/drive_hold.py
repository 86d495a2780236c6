"""Whether a drive with a lag holds its command over each sample: asked of the speed it makes.

Behind a lag the shaft turns smoothly whatever the command does within a sample, and the oil cannot
tell.  The drive's own equation can: tau w' + w = g u + c with u the command as a straight line in
each sample, or as a step at each stamp.  Each input is fitted by least squares in g, c and the
speed at the start, and in tau; with n residuals of sum of squares S, log L = -(n/2) log(S/n).
"""

import math
from typing import NamedTuple

import numpy as np

SHORTEST, LONGEST = 0.05, 200.0  # samples: how long a lag may be
NEAR = 1e-4  # of a lag's logarithm
FINEST = 1e-12  # rad/s: what two computations of one speed differ by


class Lagged(NamedTuple):
    """How a drive's speed follows an input.

    Attributes
    ----------
    log_likelihood : log units.
    lag : s; ``gain`` : of the speed over the input.
    left : (n,) rad/s, what the drive's equation leaves of the speed.
    through : variance of the speed over that of white noise on the input.
    """

    log_likelihood: float
    lag: float
    gain: float
    left: np.ndarray
    through: float


def weights_of(lag: float, dt: float) -> tuple[float, float, float]:
    """Return (pole, start, end): w[k] = pole w[k-1] + start u[k-1] + end u[k] of a straight line.

    The exact answer of the first-order lag over a sample in which its input runs from u[k-1] to
    u[k]; the same at both ends is a command that is held.
    """
    if lag <= 0.0:
        return 0.0, 0.0, 1.0
    pole = math.exp(-dt / lag)
    share = (1.0 - pole) * lag / dt
    return pole, share - pole, 1.0 - share


def followed(start: np.ndarray, end: np.ndarray, lag: float, dt: float) -> np.ndarray:
    """Return the speed of a drive behind a lag, (n,) rad/s, which begins at that of its input.

    Parameters
    ----------
    start, end : (n,) the input runs from ``start[k-1]`` to ``end[k]``, rad/s.
    lag : s.
    """
    from scipy.signal import lfilter  # takes half of the start of a command

    pole, first, last = weights_of(lag, dt)
    moved = np.concatenate([start[:1], first * start[:-1] + last * end[1:]])
    return lfilter([1.0], [1.0, -pole], moved)


def lagged(start: np.ndarray, end: np.ndarray, omega: np.ndarray, there: np.ndarray, dt: float
           ) -> Lagged:
    """Fit the drive's equation to a speed.

    Parameters
    ----------
    start, end : (n,) the input runs from ``start[k-1]`` to ``end[k]``, rad/s.
    omega : (n,) rad/s without gaps; ``there`` (n,) bool, where it counts.
    """
    from scipy.optimize import minimize_scalar

    number = np.arange(len(omega))

    def fit(log_lag: float) -> tuple[float, np.ndarray, np.ndarray]:
        lag = dt * math.exp(log_lag)
        columns = np.column_stack([followed(start, end, lag, dt), np.ones(len(omega)),
                                   np.exp(-np.minimum(number * dt / lag, 700.0))])
        found = np.linalg.lstsq(columns[there], omega[there], rcond=None)[0]
        left = omega - columns @ found
        return float(left[there] @ left[there]), found, left

    best = minimize_scalar(lambda at: fit(at)[0], method="bounded", options={"xatol": NEAR},
                           bounds=(math.log(SHORTEST), math.log(LONGEST)))
    squares, found, left = fit(best.x)
    lag, n = dt * math.exp(best.x), int(there.sum())
    pole, first, last = weights_of(lag, dt)
    through = (first**2 + last**2 + 2.0 * pole * first * last) / (1.0 - pole**2)
    log_likelihood = -0.5 * n * math.log(max(squares / n, FINEST**2))
    return Lagged(log_likelihood, lag, float(found[0]), left, float(found[0]) ** 2 * through)
