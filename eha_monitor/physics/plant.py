"""The simulated actuator: classical Runge-Kutta steps, several to a sample."""

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.physics.balances import derivatives, set_signals
from eha_monitor.physics.signals import N_CONTRIBUTIONS, N_SIGNALS


@njit
def advance(y, t, dt, substeps, x_d, theta, active):
    """Carry ``y`` = (x, v, p1, p2) over one sample ``dt`` in place.

    Parameters
    ----------
    y : (4,) state, SI, overwritten.
    t, dt : start of the sample and its length, s.
    substeps : Runge-Kutta steps in the sample; 10 at 1 kHz keeps a 75 Hz resonance to 1e-7.
    x_d : (2*substeps + 1,) demanded position at each half step, m.
    theta, active : parameters and active effects, constant over the sample.
    """
    s = np.empty(N_SIGNALS)
    c = np.empty(N_CONTRIBUTIONS)
    k1, k2, k3, k4 = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    h = dt / substeps
    for i in range(substeps):
        start = t + i * h
        set_signals(s, start, y, x_d[2 * i], theta)
        derivatives(s, theta, active, c, k1)
        set_signals(s, start + 0.5 * h, y + 0.5 * h * k1, x_d[2 * i + 1], theta)
        derivatives(s, theta, active, c, k2)
        set_signals(s, start + 0.5 * h, y + 0.5 * h * k2, x_d[2 * i + 1], theta)
        derivatives(s, theta, active, c, k3)
        set_signals(s, start + h, y + h * k3, x_d[2 * i + 2], theta)
        derivatives(s, theta, active, c, k4)
        for j in range(4):
            y[j] += h / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j])


@njit
def run(y, t0, dt, substeps, x_d, theta, active, out):
    """Simulate samples t0 + k dt, writing signals at each *before* stepping to the next.

    Parameters
    ----------
    y : (4,) state at ``t0``; left at the state after the last sample's step.
    x_d : (n, 2*substeps + 1) demanded position at each sample's half steps, m.
    theta : (n, N_THETA) or (1, N_THETA) parameters for each sample, or one row for all.
    out : (n, N_SIGNALS) written.
    """
    for k in range(out.shape[0]):
        row = theta[k if theta.shape[0] > 1 else 0]
        set_signals(out[k], t0 + k * dt, y, x_d[k, 0], row)
        advance(y, t0 + k * dt, dt, substeps, x_d[k], row, active)
