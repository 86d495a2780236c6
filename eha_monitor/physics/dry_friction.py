"""What the dry frictions of the catalogue share: how the sign of the velocity turns over."""

import math

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Parameter
from eha_monitor.physics.signals import V, X

SOURCE = "sign smoothed over v_e, turning over a displacement z_0 after Dahl 1968"
EQUATION = "dr/d|x| = (tanh(v / v_e) - r) / z_0"
V_E = Parameter("v_e", "m/s", "velocity over which the sign is smoothed", 1e-6, 1.0, 1e-3, 1e-3)
Z_0 = Parameter("z_0", "m", "displacement over which the friction turns", 0.0, 1e-3, 4e-6, 0.0)
START = {"v_e": 1e-3, "z_0": 3e-6}


@njit
def direction(s, v_e, z_0, m):
    """Return the share of the dry friction that acts, -1 to 1, after Dahl.

    At speed it is tanh(v / v_e), a sign smoothed over v_e.  After a reversal it turns over a
    displacement of about z_0: dr/d|x| = (tanh(v/v_e) - r) / z_0, with r = m[0] at x = m[1], so
    that a seal that is pushed without sliding acts as a spring.  z_0 = 0 turns at once.
    """
    steady = math.tanh(s[V] / v_e)
    if z_0 <= 0.0:
        return steady
    return steady + (m[0] - steady) * math.exp(-abs(s[X] - m[1]) / z_0)


@njit
def remember(s, v_e, z_0, m):
    """Keep direction and place at the end of a step."""
    m[0] = direction(s, v_e, z_0, m)
    m[1] = s[X]
