"""A pump that slips: the more it turns and the more pressure it works against, the less it gives.

The loss runs from the high to the low side, as every leak does: it takes from the flow while the
pump drives the oil (omega dp > 0) and adds to the shaft's flow while the oil drives the pump.
That is the form with ``motoring`` = 1, and it takes energy in all four quadrants.  Many models
apply the efficiency 1 - k |dp| to omega whatever the quadrant; that is ``motoring`` = -1.
"""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import OMEGA, P1, P2, SPEED


@njit
def term(s, p, m, c):
    """Take k |omega dp|, by quadrant, off the speed that makes flow."""
    dp = s[P1] - s[P2]
    lost = p[0] * s[OMEGA] * abs(dp)
    c[SPEED] -= lost if s[OMEGA] * dp >= 0.0 else -p[1] * lost


def starts(r):
    """Both forms; 1 % at the largest pressure difference."""
    small = 0.01 / max(r.pressure_difference[3], 1.0)
    return tuple({"k": small, "motoring": motoring} for motoring in (1.0, -1.0))


EFFECT = Effect(
    name="pump_volumetric_loss",
    balance="flow",
    equation="Q = D_p omega (1 - k |dp|) while pumping, D_p omega (1 + motoring k |dp|) while "
    "motoring,  dp = p1 - p2",
    source="slip of a displacement machine, Wilson 1950; Merritt 1967, Sec. 4-3",
    parameters=(
        Parameter("k", "1/Pa", "relative loss of flow over the pressure difference", 0.0, 1e-5,
                  1e-8),
        Parameter("motoring", "1", "1: the slip runs to the low side, also while motoring; -1: it "
                  "always takes from the speed", -1.0, 1.0, 1.0, 1.0, fitted=False),
    ),
    term=term,
    adds=(SPEED,),
    reads=(P1, P2, OMEGA),
    statement="the pump has a volumetric loss of {k} of pressure difference",
    rig_check="Hold the same pump speed at two loads: the rod must be slower by k times the "
    "difference in pressure.",
    starts=starts,
)
