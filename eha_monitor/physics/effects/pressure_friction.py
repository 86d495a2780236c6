"""Dry friction of seals that the pressure presses on."""

from eha_monitor.compiled import njit
from eha_monitor.physics.dry_friction import (
    EQUATION,
    SOURCE,
    START,
    T_1,
    V_D,
    V_E,
    W,
    dry_force,
    remember,
    sliding,
)
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FORCE, P1, P2, V, X


@njit(forceinline=True)
def steady(s, p):
    """Return mu (p1 + p2) against the motion, N; a pressure below zero presses on nothing."""
    return p[0] * max(s[P1] + s[P2], 0.0) * sliding(s, p[1], p[5])


@njit
def term(s, p, m, c):
    """Add the seal's force."""
    c[FORCE] += dry_force(s, steady(s, p), p[2], p[3], p[4], m)


@njit
def update(s, p, h, m):
    """Remember the seal."""
    remember(s, steady(s, p), p[2], m)


EFFECT = Effect(
    name="pressure_friction",
    balance="force",
    equation=f"F_steady = mu (p1 + p2) s,  {EQUATION}",
    source=f"Ottestad, Nilsen, Hansen 2012, seal friction grows with pressure; {SOURCE}",
    parameters=(
        Parameter("mu", "m^2", "friction coefficient times contact area of the seals", 0.0, 1.0,
                  3e-6),
        V_E,
        Parameter("z_0", "m", "displacement over which the friction reverses", 0.0, 1.2e-5, 4e-6,
                  0.0),
        T_1,
        V_D,
        W,
    ),
    term=term,
    adds=(FORCE,),
    reads=(X, V, P1, P2),
    update=update,
    statement="seal friction of {mu} times the sum of the chamber pressures opposes the "
    "motion",
    rig_check="Raise the charge pressure at the same motion: the friction must rise in "
    "proportion.",
    starts=lambda r: ({"mu": 0.005 * r.force / max(r.mean_pressure, 1e3), **START},),
    remembers_place=True,
    family="dry",
    passive="motion",
)
