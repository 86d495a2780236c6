"""A load force that is the same in both directions and at rest."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FORCE


@njit
def term(s, p, m, c):
    """Add F_0, positive against positive motion."""
    c[FORCE] += p[0]


EFFECT = Effect(
    name="constant_load",
    balance="force",
    equation="F = F_0",
    source="weight or external force in the force balance, Eq. 3",
    parameters=(
        Parameter("F_0", "N", "load, positive against positive motion", -1e7, 1e7, 100.0),
    ),
    term=term,
    adds=(FORCE,),
    statement="a constant load of {F_0}, counted against positive motion",
    rig_check="Hold the actuator at rest: the pressure force that remains is the load.",
    starts=lambda r: ({"F_0": 0.01 * r.force},),
    rarity=0,
)
