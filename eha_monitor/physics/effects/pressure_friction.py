"""Dry friction of seals that the pressure presses on."""

from eha_monitor.compiled import njit
from eha_monitor.physics.dry_friction import (
    EQUATION,
    SOURCE,
    START,
    V_E,
    Z_0,
    direction,
    remember,
)
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FORCE, P1, P2


@njit
def term(s, p, m, c):
    """Add mu (p1 + p2) times the direction; a pressure below zero presses on nothing."""
    c[FORCE] += p[0] * max(s[P1] + s[P2], 0.0) * direction(s, p[1], p[2], m)


@njit
def update(s, p, h, m):
    """Remember direction and place."""
    remember(s, p[1], p[2], m)


EFFECT = Effect(
    name="pressure_friction",
    balance="force",
    equation=f"F = mu (p1 + p2) r,  {EQUATION}",
    source=f"Ottestad, Nilsen, Hansen 2012, seal friction grows with pressure; {SOURCE}",
    parameters=(
        Parameter("mu", "m^2", "friction coefficient times contact area of the seals", 0.0, 1.0,
                  3e-6),
        V_E,
        Z_0,
    ),
    term=term,
    update=update,
    statement="seal friction of {mu:.3g} m² times the sum of the chamber pressures opposes the "
    "motion",
    rig_check="Raise the charge pressure at the same motion: the friction must rise in "
    "proportion.",
    starts=lambda r: ({"mu": 0.005 * r.force / max(r.mean_pressure, 1e3), **START},),
)
