"""Coulomb (dry) friction of seals and guides."""

import math

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FORCE, V, X


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
def term(s, p, m, c):
    """Add F_c times the direction."""
    c[FORCE] += p[0] * direction(s, p[1], p[2], m)


@njit
def update(s, p, h, m):
    """Remember direction and place."""
    m[0] = direction(s, p[1], p[2], m)
    m[1] = s[X]


EFFECT = Effect(
    name="coulomb_friction",
    balance="force",
    equation="F = F_c r,  dr/d|x| = (tanh(v / v_e) - r) / z_0",
    source="Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Eq. 1, sign smoothed; turning over "
    "a displacement after Dahl 1968",
    parameters=(
        Parameter("F_c", "N", "Coulomb friction force", 0.0, 1e6, 20.0),
        Parameter("v_e", "m/s", "velocity over which the sign is smoothed", 1e-6, 1.0, 1e-3, 1e-3),
        Parameter("z_0", "m", "displacement over which the friction turns", 0.0, 1.2e-5, 4e-6,
                  0.0),
    ),
    term=term,
    update=update,
    statement="Coulomb friction of {F_c:.3g} N opposes the motion at every speed",
    rig_check="Push the depressurised rod by hand with a spring balance: the force at which it "
    "keeps creeping is F_c.",
    starts=lambda r: ({"F_c": 0.01 * r.force, "v_e": 1e-3, "z_0": 3e-6},),
)
