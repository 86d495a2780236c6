"""Leakage beyond what the config's ``leakage`` holds, and valves that open at work."""

import math

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FLOW_1, FLOW_2, P1, P2, P_AMBIENT


# Leakage across the piston beyond what the config's ``leakage`` holds.
@njit
def cross_port_leakage_term(s, p, m, c):
    """Move L (p1 - p2) from chamber 1 to chamber 2."""
    q = p[0] * (s[P1] - s[P2])
    c[FLOW_1] -= q
    c[FLOW_2] += q


CROSS_PORT_LEAKAGE = Effect(
    name="cross_port_leakage", balance="flow",
    equation="Q = L (p1 - p2)",
    source="laminar leakage, Merritt 1967, Eq. 6-38",
    parameters=(Parameter("L", "m^3/(s*Pa)", "added laminar leakage coefficient", -1e-8, 1e-8,
                          1e-12),),
    term=cross_port_leakage_term, adds=(FLOW_1, FLOW_2), reads=(P1, P2),
    statement="{L} of laminar leakage crosses the piston or the pump beyond the configured value",
    rig_check="Block the rod and hold the pump speed that keeps 1 MPa: that flow over 1 MPa is "
    "the leakage.",
    rig_twin="leakage",
    starts=lambda r: ({"L": 0.01 * r.flow / max(r.pressure_difference[3], 1.0)},),
    rarity=0, passive="pressure",
)


# Leakage through a sharp edge: it grows with the root of the pressure difference.
@njit
def turbulent_leakage_term(s, p, m, c):
    """Move c dp / (dp^2 + dp_0^2)^(1/4) from chamber 1 to 2: linear below dp_0."""
    dp = s[P1] - s[P2]
    q = p[0] * dp / math.sqrt(math.sqrt(dp * dp + p[1] * p[1]))
    c[FLOW_1] -= q
    c[FLOW_2] += q


TURBULENT_LEAKAGE = Effect(
    name="turbulent_leakage", balance="flow",
    equation="Q = c dp / (dp^2 + dp_0^2)^(1/4),  dp = p1 - p2",
    source="orifice equation, Merritt 1967, Eq. 3-33; laminar near zero as Ellman, Piche 1999",
    parameters=(
        Parameter("c", "m^3/(s*Pa^0.5)", "leakage flow over the root of the pressure difference",
                  0.0, 1e-3, 1e-9),
        Parameter("dp_0", "Pa", "pressure difference below which it is laminar", 1.0, 1e7, 1e4,
                  1e4),
    ),
    term=turbulent_leakage_term, adds=(FLOW_1, FLOW_2), reads=(P1, P2), family="gap",
    statement="turbulent leakage of {c} of the pressure difference crosses the piston or the pump",
    rig_check="Block the rod and hold two pressure differences, one four times the other: the "
    "flow to hold them must double.",
    starts=lambda r: ({"c": 0.01 * r.flow / max(r.pressure_difference[3], 1.0) ** 0.5,
                       "dp_0": min(1e4, 0.05 * max(r.pressure_difference[3], 20.0))},),
    passive="pressure",
)


# A leakage flow that does not depend on the size of the pressure difference.
@njit
def leakage_offset_term(s, p, m, c):
    """Move Q_0 tanh(dp / dp_e) from chamber 1 to chamber 2."""
    q = p[0] * math.tanh((s[P1] - s[P2]) / p[1])
    c[FLOW_1] -= q
    c[FLOW_2] += q


LEAKAGE_OFFSET = Effect(
    name="leakage_offset", balance="flow",
    equation="Q = Q_0 tanh(dp / dp_e),  dp = p1 - p2",
    source="step of flow with the sign of dp: a check valve's pilot or flushing flow, "
    "a pressure-compensated path",
    parameters=(
        Parameter("Q_0", "m^3/s", "leakage flow, independent of the pressure "
                                  "difference", 0.0, 1e-2, 1e-7),
        Parameter("dp_e", "Pa", "pressure difference over which the sign is smoothed", 10.0, 1e7,
                  1e4, 1e4),
    ),
    term=leakage_offset_term, adds=(FLOW_1, FLOW_2), reads=(P1, P2), family="gap",
    statement="a flow of {Q_0} leaks across the piston, independent of the pressure difference",
    rig_check="Block the rod and hold a small and a large pressure difference: the flow to hold "
    "them must have the same constant part.",
    starts=lambda r: ({"Q_0": 0.003 * r.flow,  # at each reversal it is the whole flow
                       "dp_e": min(1e4, 0.05 * max(r.pressure_difference[3], 200.0))},),
    passive="pressure",
)


# Leakage of each chamber to the outside, or to the tank: it flows to the ambient pressure.
@njit
def external_leakage_term(s, p, m, c):
    """Take L_1 (p1 - p_a) and L_2 (p2 - p_a) out of the chambers; p[2] is p_a, Pa."""
    c[FLOW_1] -= p[0] * (s[P1] - p[2])
    c[FLOW_2] -= p[1] * (s[P2] - p[2])


EXTERNAL_LEAKAGE = Effect(
    name="external_leakage", balance="flow",
    equation="Q_1 = -L_1 (p1 - p_a), Q_2 = -L_2 (p2 - p_a): it flows to the ambient pressure p_a",
    source="external leakage, Merritt 1967, Eq. 6-39, whose pressures are above that of the tank",
    parameters=(
        Parameter("L_1", "m^3/(s*Pa)", "leakage of chamber 1 to the tank", 0.0, 1e-8, 1e-12),
        Parameter("L_2", "m^3/(s*Pa)", "leakage of chamber 2 to the tank", 0.0, 1e-8, 1e-12),
    ),
    term=external_leakage_term, adds=(FLOW_1, FLOW_2), reads=(P1, P2), rig_numbers=(P_AMBIENT,),
    statement="chamber 1 leaks {L_1} and chamber 2 {L_2} to the outside",
    rig_check="Look for oil at the rod seal and measure the case drain: both pressures must fall "
    "while the rod is blocked.",
    # The make-up path is weak, so little lowers the mean pressure much.
    starts=lambda r: (dict.fromkeys(("L_1", "L_2"), 2e-4 * r.flow / max(r.mean_pressure, 1e3)),),
)


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
    name="relief_valve", balance="flow",
    equation="Q = k (|dp| - p_c)+ sgn dp,  dp = p1 - p2",
    source="direct-acting relief valve, steady state, Merritt 1967, Sec. 9-2",
    parameters=(
        Parameter("k", "m^3/(s*Pa)", "flow over the pressure beyond cracking", 0.0, 1e-6, 1e-11),
        Parameter("p_c", "Pa", "cracking pressure difference", 0.0, 1e9, 2e6, 5e6),
    ),
    term=relief_valve_term, adds=(FLOW_1, FLOW_2), reads=(P1, P2),
    statement="a relief valve opens at {p_c} between the chambers and passes {k} of pressure "
              "beyond that",
    rig_check="Read the setting of the relief valves; drive against a stop: the pressure "
    "difference must flatten at p_c.",
    valve="beyond",
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
    name="anti_cavitation", balance="flow",
    equation="Q_i = k (p_min - p_i)+, i = 1, 2",
    source="check valve, steady state, Merritt 1967, Sec. 9-2; Ivantysyn, Ivantysynova 2001",
    parameters=(
        Parameter("k", "m^3/(s*Pa)", "flow over the pressure deficit", 0.0, 1e-6, 1e-11),
        Parameter("p_min", "Pa", "absolute pressure below which the valve opens", 0.0, 1e8, 1e6,
                  1e5),
    ),
    term=anti_cavitation_term, adds=(FLOW_1, FLOW_2), reads=(P1, P2),
    statement="a check valve feeds a chamber below {p_min}, with {k} of pressure deficit",
    rig_check="Watch the lower pressure in a fast move: it must stay flat at p_min.",
    valve="below",
    starts=anti_cavitation_starts,
    rarity=2,
)
