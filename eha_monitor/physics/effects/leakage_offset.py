"""A leakage flow that does not depend on the size of the pressure difference."""

import math

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FLOW_1, FLOW_2, P1, P2


@njit
def term(s, p, m, c):
    """Move Q_0 tanh(dp / dp_e) from chamber 1 to chamber 2."""
    q = p[0] * math.tanh((s[P1] - s[P2]) / p[1])
    c[FLOW_1] -= q
    c[FLOW_2] += q


EFFECT = Effect(
    name="leakage_offset",
    balance="flow",
    equation="Q = Q_0 tanh(dp / dp_e),  dp = p1 - p2",
    source="step of flow with the sign of dp: a check valve's pilot or flushing flow, "
    "a pressure-compensated path; negative Q_0: a leak that opens only above a preload",
    parameters=(
        Parameter("Q_0", "m^3/s", "leakage flow, independent of the pressure "
                                  "difference", -1e-2, 1e-2, 1e-7),
        Parameter("dp_e", "Pa", "pressure difference over which the sign is smoothed", 10.0, 1e7,
                  1e4, 1e4),
    ),
    term=term,
    adds=(FLOW_1, FLOW_2),
    reads=(P1, P2),
    family="gap",
    statement="a flow of {Q_0} leaks across the piston, independent of the pressure difference",
    rig_check="Block the rod and hold a small and a large pressure difference: the flow to hold "
    "them must have the same constant part.",
    starts=lambda r: ({"Q_0": 0.003 * r.flow,  # at each reversal it is the whole flow
                       "dp_e": min(1e4, 0.05 * max(r.pressure_difference[3], 200.0))},),
    passive="pressure",
)
