"""Valves that open inside the range of work."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FLOW_1, FLOW_2, P1, P2


# A relief valve between the chambers that opens inside the range of work.
@njit
def relief_valve_term(s, p, m, c):
    """Move k (|dp| - p_c)+ from the high to the low side."""
    dp = s[P1] - s[P2]
    q = p[0] * (max(dp - p[1], 0.0) - max(-dp - p[1], 0.0))
    c[FLOW_1] -= q
    c[FLOW_2] += q


def relief_valve_starts(r):
    """Cracking pressures within the record; k takes 1 % of the flow at the largest dp."""
    top = max(r.pressure_difference[3], 1.0)
    return tuple({"k": 0.01 * r.flow / ((1.0 - share) * top), "p_c": share * top}
                 for share in (0.95, 0.85, 0.7, 0.5))


RELIEF_VALVE = Effect(
    name="relief_valve",
    balance="flow",
    equation="Q = k (|dp| - p_c)+ sgn dp,  dp = p1 - p2",
    source="direct-acting relief valve, steady state, Merritt 1967, Sec. 9-2",
    parameters=(
        Parameter("k", "m^3/(s*Pa)", "flow over the pressure beyond cracking", 0.0, 1e-6, 1e-11),
        Parameter("p_c", "Pa", "cracking pressure difference", 0.0, 1e9, 2e6, 5e6),
    ),
    term=relief_valve_term,
    adds=(FLOW_1, FLOW_2),
    reads=(P1, P2),
    statement="a relief valve opens at {p_c} between the chambers and passes {k} of pressure "
              "beyond that",
    rig_check="Read the setting of the relief valves; drive against a stop: the pressure "
    "difference must flatten at p_c.",
    starts=relief_valve_starts,
)


# Check valves that feed a chamber from the tank or the accumulator when its pressure is lost.
@njit
def anti_cavitation_term(s, p, m, c):
    """Feed k (p_min - p_i)+ into each chamber."""
    c[FLOW_1] += p[0] * max(p[1] - s[P1], 0.0)
    c[FLOW_2] += p[0] * max(p[1] - s[P2], 0.0)


def anti_cavitation_starts(r):
    """Set points at the low end of the record; k feeds 1 % of the flow at its lowest pressure."""
    bottom, low, fifth = r.lowest_pressure
    found = []
    for p_min in (low, fifth, 0.5 * (fifth + max(r.mean_pressure, fifth))):
        depth = max(p_min - bottom, 1e-3 * abs(p_min), 1.0)
        found.append({"k": 0.01 * r.flow / depth, "p_min": p_min})
    return tuple(found)


ANTI_CAVITATION = Effect(
    name="anti_cavitation",
    balance="flow",
    equation="Q_i = k (p_min - p_i)+, i = 1, 2",
    source="check valve, steady state, Merritt 1967, Sec. 9-2; Ivantysyn, Ivantysynova 2001",
    parameters=(
        Parameter("k", "m^3/(s*Pa)", "flow over the pressure deficit", 0.0, 1e-6, 1e-11),
        Parameter("p_min", "Pa", "absolute pressure below which the valve opens", 0.0, 1e8, 1e6,
                  1e5),
    ),
    term=anti_cavitation_term,
    adds=(FLOW_1, FLOW_2),
    reads=(P1, P2),
    statement="a check valve feeds a chamber below {p_min}, with {k} of pressure deficit",
    rig_check="Watch the lower pressure in a fast move: it must stay flat at p_min.",
    starts=anti_cavitation_starts,
    rarity=2,
)
