"""Friction that grows with the square of the speed: turbulent flow in ports and lines."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FORCE, V


@njit
def term(s, p, m, c):
    """Add a_1 v |v|."""
    c[FORCE] += p[0] * s[V] * abs(s[V])


EFFECT = Effect(
    name="quadratic_friction",
    balance="force",
    equation="F = a_1 v |v|",
    source="turbulent pressure loss, Merritt 1967, Sec. 3-3",
    parameters=(
        Parameter("a_1", "N*s^2/m^2", "force over the square of the speed", 0.0, 1e9, 2000.0),
    ),
    term=term,
    adds=(FORCE,),
    reads=(V,),
    statement="a force of {a_1} times the square of the speed opposes the motion",
    rig_check="Hold two steady speeds, one twice the other: beyond the viscous part the force "
    "must be four times as large.",
    starts=lambda r: ({"a_1": 0.01 * r.force / max(r.speed, 1e-6) ** 2},),
    passive="motion",
    mimics="dry",  # the tail of a Stribeck drop, B given a little less
)
