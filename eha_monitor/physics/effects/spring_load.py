"""A load that grows with position: a spring, or the air on a control surface."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FORCE, X


@njit
def term(s, p, m, c):
    """Add k (x - x_0)."""
    c[FORCE] += p[0] * (s[X] - p[1])


EFFECT = Effect(
    name="spring_load",
    balance="force",
    equation="F = k (x - x_0)",
    source="spring load in the force balance, Merritt 1967, Sec. 6-1",
    parameters=(
        Parameter("k", "N/m", "stiffness", 0.0, 1e9, 1000.0),
        Parameter("x_0", "m", "position at which the spring is relaxed", -10.0, 10.0, 0.01, 0.0,
                  fitted=False),
    ),
    term=term,
    adds=(FORCE,),
    reads=(X,),
    statement="a spring of {k} pulls back to x = {x_0}",
    rig_check="Hold the actuator at rest at both ends of its travel: the pressure force must "
    "differ by k times the distance.",
    starts=lambda r: ({"k": 0.01 * r.force / max(r.position, 1e-6), "x_0": 0.0},),
    rarity=0,
)
