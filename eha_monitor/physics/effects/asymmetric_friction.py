"""Friction that is not the same in both directions."""

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
from eha_monitor.physics.signals import FORCE, V


@njit
def term(s, p, m, c):
    """Add dB |v| + dF |r|: more friction forwards is less backwards.

    With B and F_c of the symmetric part, B + dB and F_c + dF act in positive motion, B - dB and
    F_c - dF in negative motion.
    """
    c[FORCE] += p[0] * abs(s[V]) + p[1] * abs(direction(s, p[2], p[3], m))


@njit
def update(s, p, h, m):
    """Remember direction and place."""
    remember(s, p[2], p[3], m)


EFFECT = Effect(
    name="asymmetric_friction",
    balance="force",
    equation=f"F = dB |v| + dF |r|,  {EQUATION}",
    source=f"Armstrong-Helouvry 1991, Sec. 2.3, other friction by direction; {SOURCE}",
    parameters=(
        Parameter("dB", "N*s/m", "half the difference of viscous damping, positive more than "
                  "negative motion", -1e6, 1e6, 100.0),
        Parameter("dF", "N", "half the difference of dry friction, positive more than negative "
                  "motion", -1e6, 1e6, 10.0),
        V_E,
        Z_0,
    ),
    term=term,
    update=update,
    statement="friction differs by direction: {dB:+.3g} N·s/m and {dF:+.3g} N in positive motion, "
    "as much less in negative motion",
    rig_check="Hold the same steady speed in both directions: the forces differ by twice "
    "dB |v| + dF, and not at rest.",
    starts=lambda r: ({"dB": 0.01 * r.force / max(r.speed, 1e-6), "dF": 0.01 * r.force, **START},),
)
