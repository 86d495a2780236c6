"""A pump that gives another flow than its speed times the displacement."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import OMEGA, P1, P2, SPEED


# A pump that displaces more or less than the config says.
@njit
def pump_flow_gain_term(s, p, m, c):
    """Add k omega to the speed that makes flow."""
    c[SPEED] += p[0] * s[OMEGA]


PUMP_FLOW_GAIN = Effect(
    name="pump_flow_gain",
    balance="flow",
    equation="Q = D_p (1 + k) omega",
    source="flow balance with another displacement",
    parameters=(
        Parameter("k", "1", "relative error of the displacement", -0.9, 10.0, 0.05),
    ),
    term=pump_flow_gain_term,
    adds=(SPEED,),
    reads=(OMEGA,),
    statement="the pump gives {k:+%} flow at every speed, against the configured displacement",
    rig_check="Turn the pump by hand for a number of turns without load: the rod's travel times "
    "its area over the angle is the displacement.",
    rig_twin="pump_displacement",
    starts=lambda r: ({"k": 0.003},),
)


# A pump that slips: the more it turns and the more pressure it works against, the less it gives.
#
# The loss runs from the high to the low side, as every leak does: it takes from the flow while the
# pump drives the oil (omega dp > 0) and adds to the shaft's flow while the oil drives the pump.
# That is the form with ``motoring`` = 1, and it takes energy in all four quadrants.  Many models
# apply the efficiency 1 - k |dp| to omega whatever the quadrant; that is ``motoring`` = -1.
@njit
def pump_volumetric_loss_term(s, p, m, c):
    """Take k |omega dp|, by quadrant, off the speed that makes flow."""
    dp = s[P1] - s[P2]
    lost = p[0] * s[OMEGA] * abs(dp)
    c[SPEED] -= lost if s[OMEGA] * dp >= 0.0 else -p[1] * lost


def pump_volumetric_loss_starts(r):
    """Both forms; 1 % at the largest pressure difference."""
    small = 0.01 / max(r.pressure_difference[3], 1.0)
    return tuple({"k": small, "motoring": motoring} for motoring in (1.0, -1.0))


PUMP_VOLUMETRIC_LOSS = Effect(
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
    term=pump_volumetric_loss_term,
    adds=(SPEED,),
    reads=(P1, P2, OMEGA),
    statement="the pump has a volumetric loss of {k} of pressure difference",
    rig_check="Hold the same pump speed at two loads: the rod must be slower by k times the "
    "difference in pressure.",
    starts=pump_volumetric_loss_starts,
)


# A pump that gives no flow below a speed: the first turns only fill its own leakage.
@njit
def pump_dead_zone_term(s, p, m, c):
    """Take omega, at most omega_0 of it, off the speed that makes flow."""
    c[SPEED] -= min(max(s[OMEGA], -p[0]), p[0])


PUMP_DEAD_ZONE = Effect(
    name="pump_dead_zone",
    balance="flow",
    equation="Q = D_p (|omega| - omega_0)+ sgn omega",
    source="dead zone, Tao, Kokotovic 1996; of a pump: Ivantysyn, Ivantysynova 2001",
    parameters=(
        Parameter("omega_0", "rad/s", "shaft speed below which no flow is made", 0.0, 1e4, 5.0),
    ),
    term=pump_dead_zone_term,
    adds=(SPEED,),
    reads=(OMEGA,),
    statement="the pump delivers no flow below {omega_0}, and the same speed is lost above it",
    rig_check="Turn the pump slowly with the rod free: the rod must not move below omega_0.",
    starts=lambda r: ({"omega_0": 0.003 * r.pump_speed[3]},),  # it shows at small speeds
)
