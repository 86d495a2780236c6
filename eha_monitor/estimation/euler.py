"""Stage two as the paper prints it: Eq. 5 in forward Euler, states (x, v, a, beta_e).

At 1 ms this step is unstable (largest pole modulus 1.094 at 6e8 Pa), so the estimate settles
too low; it is here to show what that costs, not to be used.
"""

import math
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.inputs import StageInputs
from eha_monitor.estimation.small_matrices import symmetric, times, times_transposed
from eha_monitor.physics import signals as s
from eha_monitor.settings.monitor import Settings

ACCELERATION_NOISE = 1.0  # m/s^2 a sample, where the config gives none: Eq. 5 needs some


class Printed(NamedTuple):
    """Constants of Eq. 5 for equal areas and volumes (chamber 1's).

    ``stiff`` = 2 A^2/V, ``gain`` = 2 D_p A K_pos/V, ``leak`` = C_T/V.
    """

    dt: float
    mass: float
    stiff: float
    gain: float
    leak: float

    @classmethod
    def of(cls, theta: np.ndarray, mass: float, dt: float) -> "Printed":
        """Return the constants of a rig."""
        area, volume = theta[s.AREA_1], theta[s.VOL_1]
        return cls(dt, mass, 2 * area**2 / volume,
                   2 * theta[s.D_P] * area * theta[s.K_POS] / volume, theta[s.C_T] / volume)


@njit
def printed_step(m, b, u, printed, F):
    """Carry (x4, x5, x6, x7) over one sample as Eq. 5 does and write its Jacobian ``F`` (4, 4).

    u = x_d.
    """
    dt, mass, stiff, gain, leak = printed
    x, v, a, beta = m[0], m[1], m[2], m[3]
    push = gain / mass * (u - x) - stiff / mass * v - leak * a
    m[0] = x + dt * v
    m[1] = v + dt * a
    m[2] = a + dt * (beta * push - b / mass * a)
    F[:] = 0.0
    F[0, 0], F[0, 1] = 1.0, dt
    F[1, 1], F[1, 2] = 1.0, dt
    F[2, 0] = -dt * beta * gain / mass
    F[2, 1] = -dt * beta * stiff / mass
    F[2, 2] = 1.0 - dt * (b / mass + beta * leak)
    F[2, 3] = dt * push
    F[3, 3] = 1.0


@njit
def _run(rows, printed, R, q, m, P, out):
    z, u, b = rows
    F = np.empty((4, 4))
    K = np.empty(4)
    for i in range(z.shape[0]):
        if i > 0 and not math.isnan(u[i - 1]):
            printed_step(m, b[i], u[i - 1], printed, F)
            P = times_transposed(times(F, P), F)
            P[2, 2] += q * printed.dt * printed.dt
        nu, sd = math.nan, math.nan
        if not math.isnan(z[i]):
            S = P[0, 0] + R
            nu, sd = z[i] - m[0], math.sqrt(S)
            for j in range(4):
                K[j] = P[j, 0] / S
                m[j] += K[j] * nu
            for j in range(3, -1, -1):  # the first row, by which all are changed, last
                for other in range(3, -1, -1):
                    P[j, other] -= K[j] * P[0, other]
            P = symmetric(P)
        out[0, i], out[1, i], out[2, i], out[3, i] = m[0], m[1], m[2], m[3]
        out[4, i] = out[5, i] = math.sqrt(max(P[3, 3], 0.0))
        out[6, i], out[7, i] = nu, sd


def run_printed(inputs: StageInputs, settings: Settings, damping: np.ndarray) -> np.ndarray:
    """Return the (8, n) output of stage two as printed, in the form of stage_two.run_two."""
    q = settings.stage_two.acceleration_noise or ACCELERATION_NOISE
    first = np.flatnonzero(np.isfinite(inputs.x))
    m = np.array([inputs.x[first[0]] if len(first) else 0.0, 0.0, 0.0, settings.stage_two.prior])
    P = np.diag([inputs.position_variance, 1e-2, 1e2, settings.stage_two.prior_stddev**2])
    out = np.empty((8, len(inputs.x)))
    printed = Printed.of(inputs.model.theta, settings.rig.mass, inputs.dt)
    _run((inputs.x, inputs.drive.start, damping), printed, inputs.position_variance,
         (q / inputs.dt) ** 2 * inputs.dt**2, m, P, out)
    return out
