"""What the dry frictions of the catalogue share: how the sign of the velocity turns over."""

import math

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Parameter
from eha_monitor.physics.signals import V, X

SOURCE = ("sign smoothed over v_e, turning over a displacement z_0 after Dahl 1968, micro damping "
          "of LuGre, Canudas de Wit, Olsson, Astrom, Lischinsky 1995, t_1 = sigma_1/sigma_0, "
          "fading over v_d after Olsson 1996")
EQUATION = ("F = f + t_1 e^-(v/v_d)^2 f',  df/d|x| = (F_steady - f) / z_0,  "
            "s = (1 - w) tanh(v / v_e) + w v / (v_e + |v|)")
V_E = Parameter("v_e", "m/s", "velocity over which the sign is smoothed", 1e-6, 1.0, 1e-3, 1e-3)
Z_0 = Parameter("z_0", "m", "displacement over which the friction reverses", 0.0, 1e-3, 4e-6, 0.0)
T_1 = Parameter("t_1", "s", "micro damping over micro stiffness of the seal", 0.0, 0.1, 1e-4, 0.0)
V_D = Parameter("v_d", "m/s", "speed above which the micro damping fades", 1e-4, 10.0, 5e-3, 5e-3)
W = Parameter("w", "", "share of the sign that turns over as slowly as v/(v_e + |v|), the rest as "
              "tanh(v/v_e)", 0.0, 1.0, 0.25, 0.0)
RESOLVED = 1e-6  # m; a seal that turns over less is rigid: its rate of deflection is no signal
SURE, SETTLED, FADED = 20.0, 40.0, 6.0  # where tanh is 1, exp(-r) is 0 and exp(-r^2) is 0
START = {"v_e": 2e-4, "z_0": 3e-6, "t_1": 3e-4, "v_d": 5e-3}


@njit(forceinline=True)
def sliding(s, v_e, w):
    """Return the sign of the velocity, smoothed over v_e; a share w has a long tail.

    No seal turns over as a tanh: an arc tangent has w = 0.7, v / sqrt(v^2 + v_e^2) 0.2.
    """
    ratio = abs(s[V]) / v_e
    sign = 1.0 if ratio > SURE else math.tanh(ratio)  # most of the time: spare the function
    if w > 0.0:
        sign += w * (ratio / (1.0 + ratio) - sign)
    return math.copysign(sign, s[V])


@njit(forceinline=True)
def held(s, steady, z, m):
    """Return the force of the seal's deflection, N, after Dahl.

    After a reversal it turns over a displacement of about ``z`` m towards the ``steady`` force in
    N: dF/d|x| = (steady - F) / z, with F = m[0] at x = m[1], so that a seal that is pushed without
    sliding acts as a spring.  z = 0 turns at once.
    """
    if z <= 0.0 or m[0] == steady:
        return steady
    turned = abs(s[X] - m[1]) / z
    if turned > SETTLED:
        return steady
    return steady + (m[0] - steady) * math.exp(-turned)


@njit(forceinline=True)
def dry_force(s, steady, z, t_1, v_d, m):
    """Return the dry friction, N: deflection and micro damping, F + t_1 exp(-(v/v_d)^2) F'."""
    force = held(s, steady, z, m)
    fade = s[V] / v_d
    if z <= 0.0 or t_1 <= 0.0 or force == steady or abs(fade) > FADED:
        return force
    return force + t_1 * math.exp(-fade * fade) * abs(s[V]) / max(z, RESOLVED) * (
        steady - force)


@njit(forceinline=True)
def remember(s, steady, z, m):
    """Keep deflection and place at the end of a step."""
    m[0] = held(s, steady, z, m)
    m[1] = s[X]
