"""Oil columns that grow and shrink with the position of the piston."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import VOLUME_1, VOLUME_2, X


@njit
def term(s, p, m, c):
    """Move A_v x of oil volume from chamber 2 to chamber 1."""
    c[VOLUME_1] += p[0] * s[X]
    c[VOLUME_2] -= p[0] * s[X]


EFFECT = Effect(
    name="position_dependent_volume",
    balance="flow",
    equation="V1 + A_v x,  V2 - A_v x",
    source="chamber volumes, Merritt 1967, Eq. 6-34 and 6-35",
    parameters=(
        Parameter("A_v", "m^2", "volume over position; the piston area if nothing makes up for it",
                  0.0, 0.1, 5e-4),
    ),
    term=term,
    adds=(VOLUME_1, VOLUME_2),
    reads=(X,),
    statement="the oil volumes change with position as under a piston of {A_v}",
    rig_check="Excite the oil column at both ends of the travel: its resonance must shift between "
    "them.",
    starts=lambda r: ({"A_v": 0.3 * r.flow / max(r.speed, 1e-6)},),
    rarity=2,
)
