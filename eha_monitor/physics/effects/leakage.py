"""Leakage across the piston, beyond what the config's ``leakage`` holds, and to the outside."""

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
    name="cross_port_leakage",
    balance="flow",
    equation="Q = L (p1 - p2)",
    source="laminar leakage, Merritt 1967, Eq. 6-38",
    parameters=(
        Parameter("L", "m^3/(s*Pa)", "added laminar leakage coefficient", -1e-8, 1e-8, 1e-12),
    ),
    term=cross_port_leakage_term,
    adds=(FLOW_1, FLOW_2),
    reads=(P1, P2),
    statement="{L} of laminar leakage crosses the piston or the pump beyond "
    "the configured value",
    rig_check="Block the rod and hold the pump speed that keeps 1 MPa: that flow over 1 MPa is "
    "the leakage.",
    rig_twin="leakage",
    starts=lambda r: ({"L": 0.01 * r.flow / max(r.pressure_difference[3], 1.0)},),
    rarity=0,
    passive="pressure",
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
    name="turbulent_leakage",
    balance="flow",
    equation="Q = c dp / (dp^2 + dp_0^2)^(1/4),  dp = p1 - p2",
    source="orifice equation, Merritt 1967, Eq. 3-33; laminar near zero as Ellman, Piche 1999",
    parameters=(
        Parameter("c", "m^3/(s*Pa^0.5)", "leakage flow over the root of the pressure difference",
                  -1e-3, 1e-3, 1e-9),
        Parameter("dp_0", "Pa", "pressure difference below which it is laminar", 1.0, 1e7, 1e4,
                  1e4),
    ),
    term=turbulent_leakage_term,
    adds=(FLOW_1, FLOW_2),
    reads=(P1, P2),
    family="gap",
    statement="turbulent leakage of {c} of the pressure difference crosses the piston or the "
    "pump",
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
    term=leakage_offset_term,
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


# Leakage of each chamber to the outside, or to the tank: it flows to the ambient pressure.
@njit
def external_leakage_term(s, p, m, c):
    """Take L_1 (p1 - p_a) and L_2 (p2 - p_a) out of the chambers; p[2] is p_a, Pa."""
    c[FLOW_1] -= p[0] * (s[P1] - p[2])
    c[FLOW_2] -= p[1] * (s[P2] - p[2])


def external_leakage_starts(r):
    """Both chambers at once; the make-up path is weak, so little lowers the mean pressure much."""
    small = 2e-4 * r.flow / max(r.mean_pressure, 1e3)
    return ({"L_1": small, "L_2": small},)


EXTERNAL_LEAKAGE = Effect(
    name="external_leakage",
    balance="flow",
    equation="Q_1 = -L_1 (p1 - p_a), Q_2 = -L_2 (p2 - p_a): it flows to the ambient pressure p_a",
    source="external leakage, Merritt 1967, Eq. 6-39, whose pressures are above that of the tank",
    parameters=(
        Parameter("L_1", "m^3/(s*Pa)", "leakage of chamber 1 to the tank", 0.0, 1e-8, 1e-12),
        Parameter("L_2", "m^3/(s*Pa)", "leakage of chamber 2 to the tank", 0.0, 1e-8, 1e-12),
    ),
    term=external_leakage_term,
    adds=(FLOW_1, FLOW_2),
    reads=(P1, P2),
    rig_numbers=(P_AMBIENT,),
    statement="chamber 1 leaks {L_1} and chamber 2 {L_2} to the outside",
    rig_check="Look for oil at the rod seal and measure the case drain: both pressures must fall "
    "while the rod is blocked.",
    starts=external_leakage_starts,
)
