"""Exact discretisation: of a damped mass, and of stage two's lumped hydraulics.

Stage two (Eq. 5) has the states (x, v, a, beta_e) in the paper.  Here the third state is the
hydraulic force
F = A1 p1 - A2 p2 instead of the acceleration (M a = F - B v, so it is the same system, with the
small term B C_T beta_e/(M V) kept), and the parameter is the relative compliance
c = beta_0/beta_e: the equations are nearly linear in c, so that the filter converges from a
guess that is ten times off, where it overshoots in beta_e.  ``discretisation: euler`` runs
Eq. 5 as printed, in its own states (:mod:`reference_stages`).

A line between pump and cylinder (:mod:`physics.effects.oil`) has two states of its own,
the speed n whose flow reaches the chambers and the pressure dp_l at the pump.  The chambers load
it and it feeds them: both oscillate together.  Fed with measured pressures instead, the lightly
damped line would ring with the sensors' noise.  What the pump loses or gains acts behind the line.
"""

import math

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.physics import signals as s

# Places in the constants vector of the two-sided hydraulics.
(MASS, STIFF, LEAK, GAIN, LOOP, BETA_0, EXTRA_C, LINE_TIME, LINE_DAMPING, LINE_IMPEDANCE,
 LINE_LOAD) = range(11)
C_PLACE = 3  # of the compliance among the states (x, v, F, c), after which come a line's n, dp_l
FASTEST_LINE = 1e-9  # s: a shorter one is none


@njit(inline="always")
def damped_mass_integrals(g):
    """Return E0..E4 with E_k(g) = integral_0^1 exp(-g s) (1-s)^(k-1)/(k-1)! ds, E0 = exp(-g).

    Recurrence E_k = 1/k! - g E_{k+1} (integration by parts), started from the series of E4
    where g is small and from exp where it is not; dE_k/dg = k E_{k+1} - E_k.

    ``g`` : B T / M, dimensionless; may be negative.
    """
    if -0.5 < g < 0.5:
        # E4 = sum_n (-g)^n/(n+4)!, Horner; the last term is below 1e-14 of the sum
        e4 = 1.0 / 24.0 - g * (1.0 / 120.0 - g * (1.0 / 720.0 - g * (1.0 / 5040.0 - g * (
            1.0 / 40320.0 - g * (1.0 / 362880.0 - g * (1.0 / 3628800.0 - g * (
                1.0 / 39916800.0 - g * (1.0 / 479001600.0 - g / 6227020800.0))))))))
        e3 = 1.0 / 6.0 - g * e4
        e2 = 0.5 - g * e3
        e1 = 1.0 - g * e2
        return 1.0 - g * e1, e1, e2, e3, e4
    e0 = math.exp(-min(max(g, -50.0), 700.0))
    e1 = (1.0 - e0) / g
    e2 = (1.0 - e1) / g
    e3 = (0.5 - e2) / g
    return e0, e1, e2, e3, (1.0 / 6.0 - e3) / g


@njit(allocates=False)
def _multiply(a, b, out):
    states = a.shape[0]
    for i in range(states):
        for j in range(states):
            total = 0.0
            for k in range(states):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@njit(allocates=False)
def matrix_phi(a, rate, phi0, phi1, phi2, work):
    """Write exp(a), phi_1(a), phi_2(a), phi_k(a) = sum_n a^n/(n+k)!, for an (n, n) matrix.

    Taylor series after scaling by a power of two, then doubling:
    phi_2(2z) = (e^z phi_2(z) + phi_1(z) + phi_2(z))/4, phi_1(2z) = phi_1(z)(e^z + 1)/2
    (Higham 2008, section 10.7.4).

    Parameters
    ----------
    a : (n, n), dimensionless (matrix times step).
    rate : bound of the modulus of its eigenvalues; sets the scaling, since the matrix is far
        from balanced and its norm says nothing.
    phi0, phi1, phi2 : (n, n) written.  work : (3, n, n) scratch.
    """
    states = a.shape[0]
    doublings = 0
    scale = 1.0
    while rate * scale > 0.25 and doublings < 40:
        scale *= 0.5
        doublings += 1
    power, product, other = work[0], work[1], work[2]
    for i in range(states):
        for j in range(states):
            one = 1.0 if i == j else 0.0
            power[i, j] = one
            phi0[i, j] = one
            phi1[i, j] = one
            phi2[i, j] = 0.5 * one
    factorial = 1.0
    for n in range(1, 13):
        factorial *= n
        _multiply(power, a, product)
        for i in range(states):
            for j in range(states):
                value = product[i, j] * scale
                power[i, j] = value
                phi0[i, j] += value / factorial
                phi1[i, j] += value / (factorial * (n + 1))
                phi2[i, j] += value / (factorial * (n + 1) * (n + 2))
    for _ in range(doublings):
        _multiply(phi0, phi2, product)
        for i in range(states):
            for j in range(states):
                phi2[i, j] = 0.25 * (product[i, j] + phi1[i, j] + phi2[i, j])
        _multiply(phi1, phi0, product)
        _multiply(phi0, phi0, other)
        for i in range(states):
            for j in range(states):
                phi1[i, j] = 0.5 * (product[i, j] + phi1[i, j])
                phi0[i, j] = other[i, j]


def hydraulics(theta, beta_0: float, extra_compliance: float, loop: bool,
               line: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the (11,) constants of the lumped flow balance of two chambers.

    With both chambers at one bulk modulus beta the flow balances give for the force F

        F' = beta [ S2/A1 D_p omega - S2 v ] - beta C_T/2 (1/V1 + 1/V2) F,
        S2 = A1^2/V1 + A2^2/V2,

    which for equal areas and volumes is Eq. 1's flow balance.

    Parameters
    ----------
    theta : (N_THETA,) parameters.
    beta_0 : Pa, scale of the compliance state c = beta_0/beta_e.
    extra_compliance : 1/Pa of modelled effects (entrained air), kept out of beta_e.
    loop : True where omega = K_pos (x_d - x) closes the loop, False where omega is the input.
    line : T_l (s), zeta and Z (Pa*s/rad) of a line; T_l = 0: none.  It is loaded by
        p1 - p2 = 2 (F + (A2 - A1) mean)/(A1 + A2); dp_l is counted from the mean's share, which
        moves slowly.
    """
    stiff = theta[s.AREA_1] ** 2 / theta[s.VOL_1] + theta[s.AREA_2] ** 2 / theta[s.VOL_2]
    leak = 0.5 * theta[s.C_T] * (1.0 / theta[s.VOL_1] + 1.0 / theta[s.VOL_2])
    gain = stiff / theta[s.AREA_1] * theta[s.D_P]
    return np.array([theta[s.M], stiff, leak, gain, theta[s.K_POS] if loop else 0.0, beta_0,
                     extra_compliance * beta_0, *line, 2.0 / (theta[s.AREA_1] + theta[s.AREA_2])])


@njit(allocates=False)
def states_beside_c(k):
    """Return how many states the filter has beside c: x, v, F, and a line's n and dp_l."""
    return 5 if k[LINE_TIME] > FASTEST_LINE else 3


@njit(allocates=False)
def place(i):
    """Return the place in the filter of a state beside c."""
    return i if i < C_PLACE else i + 1


@njit(allocates=False)
def column(i):
    """Return the place of a state in a row of the step: the line's come last."""
    return i if i < 3 else i + 4


@njit(allocates=False)
def system_matrix(k, b, c, leak, dt, a):
    """Write A(B, c, leak) dt for the state (x, v, F) and return the bound of its eigenvalues.

    a : (3, 3), or (5, 5) with the states n and dp_l of a line.
    """
    beta = k[BETA_0] / max(c + k[EXTRA_C], 1e-9)
    a[0, 0], a[0, 1], a[0, 2] = 0.0, dt, 0.0
    a[1, 0], a[1, 1], a[1, 2] = 0.0, -b / k[MASS] * dt, dt / k[MASS]
    a[2, 0] = -beta * k[GAIN] * k[LOOP] * dt
    a[2, 1] = -beta * k[STIFF] * dt
    a[2, 2] = -beta * leak * dt
    chambers = max(max(abs(b) / k[MASS], beta * leak), math.sqrt(beta * k[STIFF] / k[MASS])) * dt
    if a.shape[0] == 3:
        return max(chambers, (beta * k[GAIN] * k[LOOP] / k[MASS]) ** (1.0 / 3.0) * dt)
    time, zeta, impedance = k[LINE_TIME], k[LINE_DAMPING], k[LINE_IMPEDANCE]
    a[:, 3:] = 0.0
    a[3:, :] = 0.0
    a[2, 0], a[2, 3] = 0.0, beta * k[GAIN] * dt
    a[3, 2] = -k[LINE_LOAD] / (impedance * time) * dt
    a[3, 3], a[3, 4] = -2.0 * zeta / time * dt, dt / (impedance * time)
    a[4, 0], a[4, 3] = -impedance * k[LOOP] / time * dt, -impedance / time * dt
    return chambers + dt * (
        (1.0 + 2.0 * zeta) / time + math.sqrt(beta * k[GAIN] * k[LINE_LOAD] / (impedance * time))
        + (beta * k[GAIN] * k[LOOP] / (k[MASS] * time * time)) ** 0.2)


@njit(allocates=False)
def discretise_at(k, b, c, leak, dt, work, out):
    """Write the exact step of (x, v, F): out = [Phi | Gamma_0 | Gamma_1 | Gamma_f | Gamma_q].

    With a line there are five rows, and two columns more at the end, for n and dp_l.

    Gamma_0, Gamma_1 act on the drive input (x_d or omega) at the sample's two ends, between
    which it runs linearly; Gamma_f on a force (N, against positive motion) and Gamma_q on the
    rate of force beta*(A1/V1 Q1 - A2/V2 Q2) per beta, both held over the sample.
    """
    a, phi0, phi1, phi2 = work[0], work[1], work[2], work[3]
    rate = system_matrix(k, b, c, leak, dt, a)
    matrix_phi(a, rate, phi0, phi1, phi2, work[4:7])
    beta = k[BETA_0] / max(c + k[EXTRA_C], 1e-9)
    driven, drive = 2, beta * k[GAIN] * dt
    if a.shape[0] > 3:
        driven, drive = 4, k[LINE_IMPEDANCE] / k[LINE_TIME] * dt
    drive *= k[LOOP] if k[LOOP] > 0.0 else 1.0
    for i in range(a.shape[0]):
        for j in range(a.shape[0]):
            out[i, column(j)] = phi0[i, j]
        out[i, 4] = phi2[i, driven] * drive
        out[i, 3] = phi1[i, driven] * drive - out[i, 4]
        out[i, 5] = -phi1[i, 1] * dt / k[MASS]
        out[i, 6] = phi1[i, 2] * beta * dt


@njit
def discretise(k, b, c, leak, dt, work, made):
    """Write the step at (B, c, leak) and its derivatives to c (first, second), B and leak.

    Central differences of the exact step; ``made`` is (5, 3, 7), or (5, 5, 9) with a line.
    ``work`` is (10, 3, 3) or (10, 5, 5).
    """
    step, d_c, d_cc, d_b, d_leak = made[0], made[1], made[2], made[3], made[4]
    beta = k[BETA_0] / max(c + k[EXTRA_C], 1e-9)
    h_c = 1e-3 * max(c, 1e-3)
    h_b = 1e-3 * max(abs(b), 1e-2 * k[MASS] / dt)
    h_leak = 1e-3 * max(leak, 1e-2 / (beta * dt))
    rows, columns = step.shape
    around = np.empty((6, rows, columns))  # at c, B and leak: less, then more
    for which in range(7):  # one call, for what is called is written into each
        side = 1.0 if which % 2 == 1 else -1.0
        of_c = side * h_c if which // 2 == 0 else 0.0
        of_b = side * h_b if which // 2 == 1 else 0.0
        of_leak = side * h_leak if which // 2 == 2 else 0.0
        discretise_at(k, b + of_b, c + of_c, leak + of_leak, dt, work,
                      around[which] if which < 6 else step)
    for i in range(rows):
        for j in range(columns):
            d_c[i, j] = (around[1, i, j] - around[0, i, j]) / (2.0 * h_c)
            d_cc[i, j] = (around[1, i, j] - 2.0 * step[i, j] + around[0, i, j]) / (h_c * h_c)
            d_b[i, j] = (around[3, i, j] - around[2, i, j]) / (2.0 * h_b)
            d_leak[i, j] = (around[5, i, j] - around[4, i, j]) / (2.0 * h_leak)
