"""Stage one (Eq. 3, 4): viscous damping from the pressure force and the position.

State (x, v, B); input the force u = A1 p1 - A2 p2 (or a measured force); measurement x.
"""

from eha_monitor.compiled import njit
from eha_monitor.filters.phi import damped_mass_integrals


@njit(inline="always")
def predict_one(x, v, b, u0, u1, dt, mass):
    """Carry (x, v) over one sample, exactly for a force that runs linearly from u0 to u1.

    M v' = u(t) - B v, x' = v; the variation of constants gives, with g = B T/M and the
    integrals E_k of :func:`damped_mass_integrals`,

        v1 = E0 v + T/M   [u0 (E1 - E2) + u1 E2]
        x1 = x + T E1 v + T^2/M [u0 (E2 - E3) + u1 E3]

    Returns
    -------
    x1, v1 : m, m/s.
    f_xv, f_xb, f_vv, f_vb : derivatives of x1 and v1 to v and B.
    """
    e0, e1, e2, e3, e4 = damped_mass_integrals(b * dt / mass)
    d0 = -e0
    d1 = e2 - e1
    d2 = 2.0 * e3 - e2
    d3 = 3.0 * e4 - e3
    per_mass = dt / mass
    v1 = e0 * v + per_mass * (u0 * (e1 - e2) + u1 * e2)
    x1 = x + dt * (e1 * v + per_mass * (u0 * (e2 - e3) + u1 * e3))
    f_vb = per_mass * (d0 * v + per_mass * (u0 * (d1 - d2) + u1 * d2))
    f_xb = per_mass * dt * (d1 * v + per_mass * (u0 * (d2 - d3) + u1 * d3))
    return x1, v1, dt * e1, f_xb, e0, f_vb


@njit(inline="always")
def predict_one_euler(x, v, b, u0, dt, mass):
    """The same step as the paper prints it, Eq. 4: forward Euler."""
    v1 = v + dt * (u0 / mass - b / mass * v)
    return x + dt * v, v1, dt, 0.0, 1.0 - dt * b / mass, -dt * v / mass
