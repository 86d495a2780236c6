"""The equations of the actuator, written once: force, flow and drive balance.

With equal areas and volumes they are, in the pressure difference dp = p1 - p2,

    force:  M x'' = A dp - B x'
    flow:   V/(2 beta_e) dp' = D_p omega - A x' - (C_T/2) dp
    drive:  omega = K_pos (x_d - x)

from which the paper's Eq. 1 and 2 follow (they drop the small term B C_T beta_e/(M V)).
"""

from eha_monitor.compiled import njit
from eha_monitor.physics.signals import (
    AREA_1,
    AREA_2,
    BETA_E,
    C_T,
    COMPLIANCE_1,
    COMPLIANCE_2,
    D_P,
    DRIVE_GAIN,
    FLOW_1,
    FLOW_2,
    FORCE,
    G_MAKEUP,
    K_POS,
    MASS,
    P_CHARGE,
    SPEED,
    VOL_1,
    VOL_2,
    VOLUME_1,
    VOLUME_2,
    B,
    M,
)


@njit(forceinline=True)
def drive_speed(x_d, x, theta, w):
    """Pump speed that the drive wants, rad/s: omega = (1 + gain) K_pos (x_d - x)."""
    return (1.0 + w[DRIVE_GAIN]) * theta[K_POS] * (x_d - x)


@njit(forceinline=True)
def acceleration(force, v, theta, c):
    """Force balance, Eq. 3: v' = (F - B v - c[FORCE]) / (M + dM) for the driving ``force``, N."""
    return (force - theta[B] * v - c[FORCE]) / (theta[M] + c[MASS])


@njit(forceinline=True)
def rates(v, p1, p2, omega, unknown_flow, theta, c):
    """Return v', p1', p2' (m/s^2, Pa/s, Pa/s) with the effects' contributions ``c``.

    Force balance, Eq. 3 with two areas:  (M + dM) v' = A1 p1 - A2 p2 - B v - F.
    Flow balances, one for each chamber, with L = (C_T - G)/2 across the piston and the
    make-up path G to the charge pressure p_c, so that both together leak C_T/2 * dp:

        V1 (1/beta_e + C1) p1' =  D_p omega       - A1 v - L (p1 - p2) - G (p1 - p_c) + Q1
        V2 (1/beta_e + C2) p2' = -D_p omega A2/A1 + A2 v + L (p1 - p2) - G (p2 - p_c) + Q2

    For unequal areas the circuit (valves, accumulator) is taken to balance the return flow,
    hence A2/A1.  F, C, Q, dM come from the active effects.

    Parameters
    ----------
    v, p1, p2, omega : m/s, Pa, Pa, rad/s.
    unknown_flow : m^3/s from chamber 2 into 1 that no entry of the catalogue makes.
    theta : (N_THETA,); c : (N_CONTRIBUTIONS,).
    """
    dv = acceleration(theta[AREA_1] * p1 - theta[AREA_2] * p2, v, theta, c)
    pumped = theta[D_P] * (omega + c[SPEED])
    makeup = theta[G_MAKEUP]
    crossing = 0.5 * (theta[C_T] - makeup) * (p1 - p2) - unknown_flow
    compliance = 1.0 / theta[BETA_E]
    into_1 = pumped - theta[AREA_1] * v - crossing - makeup * (p1 - theta[P_CHARGE]) + c[FLOW_1]
    into_2 = (-pumped * theta[AREA_2] / theta[AREA_1] + theta[AREA_2] * v + crossing
              - makeup * (p2 - theta[P_CHARGE]) + c[FLOW_2])
    dp1 = into_1 / ((theta[VOL_1] + c[VOLUME_1]) * (compliance + c[COMPLIANCE_1]))
    dp2 = into_2 / ((theta[VOL_2] + c[VOLUME_2]) * (compliance + c[COMPLIANCE_2]))
    return dv, dp1, dp2
