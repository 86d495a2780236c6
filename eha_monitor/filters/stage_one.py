"""Stage one (Eq. 3, 4): viscous damping from the pressure force and the position.

State (x, v, B); input the force u = A1 p1 - A2 p2 (or a measured force); measurement x.
"""

from eha_monitor.compiled import njit
from eha_monitor.filters.phi import damped_mass_integrals

UNSEEN = 16.0  # squared sigmas below which a regressor is taken for noise
UNSEEN_SLOW = 4.0  # the same for the running mean, in the sigma of a single sample
MEMORY = 1.0 / 32.0  # weight of a new velocity in the running mean
STIFF = 0.5  # B T/M


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
    g_x, g_v : response of x1 and v1 to a unit force held over the sample, m/N, m/(s·N).
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
    return x1, v1, dt * e1, f_xb, e0, f_vb, per_mass * dt * e2, per_mass * e1


@njit(inline="always")
def predict_one_euler(x, v, b, u0, dt, mass):
    """The same step as the paper prints it, Eq. 4: forward Euler."""
    v1 = v + dt * (u0 / mass - b / mass * v)
    return (x + dt * v, v1, dt, 0.0, 1.0 - dt * b / mass, -dt * v / mass,
            0.5 * dt * dt / mass, dt / mass)


@njit(inline="always")
def slopes_one(v, slow, p_vv, b, f_xb, f_vb, dt, mass):
    """Return the derivatives of (x, v) to B that the filter may learn from.

    Where the velocity is no larger than its own noise it tells nothing about B, and a filter
    that takes the noise for information drifts.  Then, and where the damping is so stiff
    (B T/M > 1/2) that the velocity follows the noisy force within a sample, the running mean
    ``slow`` of the velocity stands in as an instrument whose noise is not the sample's own:
    steady motion, u = B v, in the equations of :func:`predict_one`.

    Parameters
    ----------
    v, slow : velocity and its running mean, m/s.  p_vv : variance of v, given B.
    f_xb, f_vb : derivatives at the filter's own state.
    """
    if b * dt / mass <= STIFF and v * v >= UNSEEN * p_vv:
        return f_xb, f_vb
    if slow * slow < UNSEEN_SLOW * p_vv:
        return 0.0, 0.0
    u = b * slow
    _, _, _, g_xb, _, g_vb, _, _ = predict_one(0.0, slow, b, u, u, dt, mass)
    return g_xb, g_vb
