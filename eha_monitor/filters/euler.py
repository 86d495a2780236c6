"""Stage two as the paper prints it: Eq. 5 in forward Euler, states (x, v, a, beta_e).

At 1 ms this step is unstable (largest pole modulus 1.094 at 6e8 Pa), so the estimate settles
too low; it is here to show what that costs, not to be used.
"""

import math

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.filters.inputs import StageInputs
from eha_monitor.filters.small_matrices import symmetric, times, times_transposed
from eha_monitor.physics import signals as s
from eha_monitor.settings.monitor import Settings

ACCELERATION_NOISE = 1.0  # m/s^2 a sample, where the config gives none: Eq. 5 needs some


@njit
def printed_step(m, b, u, dt, mass, stiff, gain, leak, f):
    """Carry (x4, x5, x6, x7) over one sample as Eq. 5 does and write its Jacobian ``f`` (4, 4).

    stiff = 2 A^2/V, gain = 2 D_p A K_pos/V, leak = C_T/V; u = x_d.
    """
    x, v, a, beta = m[0], m[1], m[2], m[3]
    push = gain / mass * (u - x) - stiff / mass * v - leak * a
    m[0] = x + dt * v
    m[1] = v + dt * a
    m[2] = a + dt * (beta * push - b / mass * a)
    f[:] = 0.0
    f[0, 0], f[0, 1] = 1.0, dt
    f[1, 1], f[1, 2] = 1.0, dt
    f[2, 0] = -dt * beta * gain / mass
    f[2, 1] = -dt * beta * stiff / mass
    f[2, 2] = 1.0 - dt * (b / mass + beta * leak)
    f[2, 3] = dt * push
    f[3, 3] = 1.0


@njit
def _run(x, u, b, dt, mass, stiff, gain, leak, r, q, m, p, out):
    f = np.empty((4, 4))
    k = np.empty(4)
    for i in range(x.shape[0]):
        if i > 0 and not math.isnan(u[i - 1]):
            printed_step(m, b[i], u[i - 1], dt, mass, stiff, gain, leak, f)
            p = times_transposed(times(f, p), f)
            p[2, 2] += q * dt * dt
        nu, sd = math.nan, math.nan
        if not math.isnan(x[i]):
            spread = p[0, 0] + r
            nu, sd = x[i] - m[0], math.sqrt(spread)
            for j in range(4):
                k[j] = p[j, 0] / spread
                m[j] += k[j] * nu
            for j in range(3, -1, -1):  # the first row, by which all are changed, last
                for other in range(3, -1, -1):
                    p[j, other] -= k[j] * p[0, other]
            p = symmetric(p)
        out[0, i], out[1, i], out[2, i], out[3, i] = m[0], m[1], m[2], m[3]
        out[4, i] = out[5, i] = math.sqrt(max(p[3, 3], 0.0))
        out[6, i], out[7, i] = nu, sd


def printed_constants(theta: np.ndarray) -> tuple[float, float, float]:
    """Return (stiff, gain, leak) of Eq. 5 for equal areas and volumes (chamber 1's)."""
    area, volume = theta[s.AREA_1], theta[s.VOL_1]
    return (2 * area**2 / volume, 2 * theta[s.D_P] * area * theta[s.K_POS] / volume,
            theta[s.C_T] / volume)


def run_printed(inputs: StageInputs, settings: Settings, damping: np.ndarray) -> np.ndarray:
    """Return the (8, n) output of stage two as printed, in the form of kernel_two.run_two."""
    q = settings.stage_two.acceleration_noise or ACCELERATION_NOISE
    first = np.flatnonzero(np.isfinite(inputs.x))
    m = np.array([inputs.x[first[0]] if len(first) else 0.0, 0.0, 0.0, settings.stage_two.prior])
    p = np.diag([inputs.position_variance, 1e-2, 1e2, settings.stage_two.prior_stddev**2])
    out = np.empty((8, len(inputs.x)))
    stiff, gain, leak = printed_constants(inputs.model.theta)
    _run(inputs.x, inputs.drive.start, damping, inputs.dt, settings.rig.mass, stiff, gain, leak,
         inputs.position_variance, (q / inputs.dt) ** 2 * inputs.dt**2, m, p, out)
    return out
