"""Dry friction that is larger at creeping speed than at speed."""

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
def sliding_force(s, p):
    """Return g = F_c + F_d drop in N, F_d = F_s - F_c, and its deflection in m.

    The drop is exp(-u^delta) with u = |v/v_s|, and a share h of it the rational 1/(1 + u^2): how
    far its tail reaches is part of what the friction at speed and B are known to.
    The seal's stiffness is the same at every speed, so the deflection goes with the force; z_0 is
    the one at standstill.
    """
    ratio = abs(s[V]) / p[2]
    drop = math.exp(-(ratio ** p[7]))
    g = p[0] + p[1] * (drop + p[9] * (1.0 / (1.0 + ratio * ratio) - drop))
    most = p[0] + p[1]
    return g, (p[4] * g / most if most > 0.0 else 0.0)


@njit
def term(s, p, m, c):
    """Add the seal's force."""
    g, z = sliding_force(s, p)
    c[FORCE] += dry_force(s, g * sliding(s, p[3], p[8]), z, p[5], p[6], m)


@njit
def update(s, p, h, m):
    """Remember the seal."""
    g, z = sliding_force(s, p)
    remember(s, g * sliding(s, p[3], p[8]), z, m)


def starts(r):
    """Stribeck velocities over two decades, within the speeds of the record.

    An exponential drop meets any other on its way; from a Gaussian one at the wrong speed a fit
    shrinks it to nothing.
    """
    small = 0.01 * r.force
    speed = max(r.speed, 1e-6)
    return tuple({"F_c": small, "F_d": small, "v_s": share * speed,
                  **START, "delta": 1.0}
                 for share in (0.3, 0.1, 0.03, 0.006))


EFFECT = Effect(
    name="stribeck_friction",
    balance="force",
    equation="F_steady = (F_c + F_d ((1 - h) exp(-u^delta) + h / (1 + u^2))) s,  u = |v| / v_s,  "
    f"{EQUATION}",
    source=f"Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Eq. 5, F_d = F_s - F_c; {SOURCE}",
    parameters=(
        Parameter("F_c", "N", "Coulomb friction force at speed", 0.0, 1e6, 20.0),
        Parameter("F_d", "N", "what is added to it near standstill, F_s - F_c", 0.0, 1e6, 20.0),
        Parameter("v_s", "m/s", "Stribeck velocity, over which the addition falls", 1e-6, 10.0,
                  5e-3, 5e-3),
        V_E,
        Z_0,
        T_1,
        V_D,
        Parameter("delta", "", "exponent of the fall: 1 exponential, 2 Gaussian", 0.4, 3.0, 1.0,
                  2.0),
        W,
        Parameter("h", "", "share of the fall that is rational, 1/(1 + (v/v_s)^2), with a long "
                  "tail", 0.0, 1.0, 0.25, 0.0),
    ),
    term=term,
    adds=(FORCE,),
    reads=(X, V),
    update=update,
    statement="dry friction of {F_c} at speed rises by {F_d} below {v_s}",
    rig_check="Let the rod creep at a few speeds below v_s: the force to keep it moving must fall "
    "as the speed rises.",
    starts=starts,
    contains=("coulomb_friction",),
    remembers_place=True,
    family="dry",
    passive="motion",
)
