"""Exponential integrals of a damped mass and of small matrices: exact discretisation."""

import math

from eha_monitor.compiled import njit


@njit(inline="always")
def damped_mass_integrals(g):
    """Return E0..E4 with E_k(g) = integral_0^1 exp(-g s) (1-s)^(k-1)/(k-1)! ds, E0 = exp(-g).

    Recurrence E_k = 1/k! - g E_{k+1} (integration by parts), started from the series of E4
    where g is small and from exp where it is not; dE_k/dg = k E_{k+1} - E_k.

    Parameters
    ----------
    g : B T / M, dimensionless; may be negative.
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
