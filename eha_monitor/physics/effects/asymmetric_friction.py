"""Friction that is not the same in both directions."""

import math

from eha_monitor.compiled import njit
from eha_monitor.physics.dry_friction import (
    EQUATION,
    SOURCE,
    START,
    T_1,
    V_D,
    V_E,
    Z_0,
    W,
    dry_force,
    remember,
    sliding,
)
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FORCE, V, X


@njit(forceinline=True)
def level(s, p):
    """Return the dry friction in this direction, N: it brakes in both, and drives in none."""
    return max(p[0] + math.copysign(1.0, s[V]) * p[1], 0.0)


@njit(forceinline=True)
def deflection(s, p):
    """Return the deflection at which the seal slides this way, m; its stiffness is one."""
    most = p[0] + abs(p[1])
    return p[4] * level(s, p) / most if most > 0.0 else 0.0


@njit
def term(s, p, m, c):
    """Add the seal's force and dB |v|: more friction forwards is less backwards.

    In positive motion F_c + dF and B + dB act, in negative motion F_c - dF and B - dB.
    """
    c[FORCE] += p[2] * abs(s[V]) + dry_force(
        s, level(s, p) * sliding(s, p[3], p[7]), deflection(s, p), p[5], p[6], m)


@njit
def update(s, p, h, m):
    """Remember the seal."""
    remember(s, level(s, p) * sliding(s, p[3], p[7]), deflection(s, p), m)


EFFECT = Effect(
    name="asymmetric_friction",
    balance="force",
    equation=f"F_steady = max(F_c + dF sgn v, 0) s, beside dB |v|;  {EQUATION}",
    source=f"Armstrong-Helouvry 1991, Sec. 2.3, other friction by direction; {SOURCE}",
    parameters=(
        Parameter("F_c", "N", "mean dry friction of both directions", 0.0, 1e6, 20.0),
        Parameter("dF", "N", "half the difference of dry friction, positive more than negative "
                  "motion", -1e6, 1e6, 10.0),
        Parameter("dB", "N*s/m", "half the difference of viscous damping, positive more than "
                  "negative motion", -1e6, 1e6, 100.0),
        V_E,
        Z_0,
        T_1,
        V_D,
        W,
    ),
    term=term,
    adds=(FORCE,),
    reads=(X, V),
    update=update,
    statement="friction differs by direction: {F_c} of dry friction on average, to which "
    "positive motion adds {dF:+} and {dB:+}, and negative motion the opposite",
    rig_check="Hold the same steady speed in both directions: the forces differ by twice "
    "dB |v| + dF, and not at rest.",
    starts=lambda r: ({"F_c": 0.01 * r.force, "dF": 0.01 * r.force,
                       "dB": 0.01 * r.force / max(r.speed, 1e-6), **START},),
    contains=("coulomb_friction",),
    remembers_place=True,
    family="dry",
    passive="motion",
    within=(("dF", "F_c"),),
    rarity=10,  # no likelier than Coulomb friction and a constant load, which do the same
)
