"""Coulomb (dry) friction of seals and guides."""

import math

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FORCE, V


@njit
def term(s, p, c):
    """Add F_c tanh(v / v_e): a sign smoothed over v_e, so that it has a slope at rest."""
    c[FORCE] += p[0] * math.tanh(s[V] / p[1])


EFFECT = Effect(
    name="coulomb_friction",
    balance="force",
    equation="F = F_c tanh(v / v_e)",
    source="Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Eq. 1, sign smoothed",
    parameters=(
        Parameter("F_c", "N", "Coulomb friction force", 0.0, 1e6, 20.0),
        Parameter("v_e", "m/s", "velocity over which the sign is smoothed", 1e-6, 1.0, 1e-3, 1e-3),
    ),
    term=term,
    statement="Coulomb friction of {F_c:.3g} N opposes the motion at every speed",
    rig_check="Push the depressurised rod by hand with a spring balance: the force at which it "
    "keeps creeping is F_c.",
)
