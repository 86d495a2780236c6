"""What the dry frictions of the catalogue share: how the sign of the velocity turns over."""

import math

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Parameter
from eha_monitor.physics.signals import V, X

SOURCE = ("sign smoothed over v_e, turning over a displacement z_0 after Dahl 1968, micro damping "
          "of LuGre, Canudas de Wit, Olsson, Astrom, Lischinsky 1995, t_1 = sigma_1/sigma_0")
EQUATION = "F = f + t_1 f',  df/d|x| = (F_steady - f) / z_0,  s = tanh(v / v_e)"
V_E = Parameter("v_e", "m/s", "velocity over which the sign is smoothed", 1e-6, 1.0, 1e-3, 1e-3)
Z_0 = Parameter("z_0", "m", "displacement over which the friction turns", 0.0, 1e-3, 4e-6, 0.0)
T_1 = Parameter("t_1", "s", "micro damping over micro stiffness of the seal", 0.0, 0.1, 1e-4, 0.0)
START = {"v_e": 2e-4, "z_0": 3e-6, "t_1": 1e-4}


@njit(forceinline=True)
def sliding(s, v_e):
    """Return the sign of the velocity, smoothed over v_e."""
    return math.tanh(s[V] / v_e)


@njit(forceinline=True)
def held(s, steady, z, m):
    """Return the force of the seal's deflection, N, after Dahl.

    After a reversal it turns over a displacement of about ``z`` m towards the ``steady`` force in
    N: dF/d|x| = (steady - F) / z, with F = m[0] at x = m[1], so that a seal that is pushed without
    sliding acts as a spring.  z = 0 turns at once.
    """
    if z <= 0.0:
        return steady
    return steady + (m[0] - steady) * math.exp(-abs(s[X] - m[1]) / z)


@njit(forceinline=True)
def dry_force(s, steady, z, t_1, m):
    """Return the dry friction, N: deflection and micro damping, F + t_1 F'."""
    force = held(s, steady, z, m)
    if z <= 0.0 or t_1 <= 0.0:
        return force
    return force + t_1 * abs(s[V]) / z * (steady - force)


@njit(forceinline=True)
def remember(s, steady, z, m):
    """Keep deflection and place at the end of a step."""
    m[0] = held(s, steady, z, m)
    m[1] = s[X]
