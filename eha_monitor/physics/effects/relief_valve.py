"""A relief valve between the chambers that opens inside the range of work."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FLOW_1, FLOW_2, P1, P2


@njit
def term(s, p, m, c):
    """Move k (|dp| - p_c)+ from the high to the low side."""
    dp = s[P1] - s[P2]
    q = p[0] * (max(dp - p[1], 0.0) - max(-dp - p[1], 0.0))
    c[FLOW_1] -= q
    c[FLOW_2] += q


def starts(r):
    """Cracking pressures within the record; k takes 1 % of the flow at the largest dp."""
    top = max(r.pressure_difference[3], 1.0)
    return tuple({"k": 0.01 * r.flow / ((1.0 - share) * top), "p_c": share * top}
                 for share in (0.95, 0.85, 0.7, 0.5))


EFFECT = Effect(
    name="relief_valve",
    balance="flow",
    equation="Q = k (|dp| - p_c)+ sgn dp,  dp = p1 - p2",
    source="direct-acting relief valve, steady state, Merritt 1967, Sec. 9-2",
    parameters=(
        Parameter("k", "m^3/(s*Pa)", "flow over the pressure beyond cracking", 0.0, 1e-6, 1e-11),
        Parameter("p_c", "Pa", "cracking pressure difference", 0.0, 1e9, 2e6, 5e6),
    ),
    term=term,
    adds=(FLOW_1, FLOW_2),
    reads=(P1, P2),
    statement="a relief valve opens at {p_c} between the chambers and passes {k} of pressure "
              "beyond that",
    rig_check="Read the setting of the relief valves; drive against a stop: the pressure "
    "difference must flatten at p_c.",
    starts=starts,
)
