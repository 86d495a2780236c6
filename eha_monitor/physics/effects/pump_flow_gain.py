"""A pump that displaces more or less than the config says."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import OMEGA, SPEED


@njit
def term(s, p, m, c):
    """Add k omega to the speed that makes flow."""
    c[SPEED] += p[0] * s[OMEGA]


EFFECT = Effect(
    name="pump_flow_gain",
    balance="flow",
    equation="Q = D_p (1 + k) omega",
    source="flow balance with another displacement",
    parameters=(
        Parameter("k", "1", "relative error of the displacement", -0.9, 10.0, 0.05),
    ),
    term=term,
    adds=(SPEED,),
    reads=(OMEGA,),
    statement="the pump gives {k:+%} flow at every speed, against the configured displacement",
    rig_check="Turn the pump by hand for a number of turns without load: the rod's travel times "
    "its area over the angle is the displacement.",
    rig_twin="pump_displacement",
    starts=lambda r: ({"k": 0.003},),
)
