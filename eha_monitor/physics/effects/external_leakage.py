"""Leakage of each chamber to the outside, or to the tank: it flows to the ambient pressure."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FLOW_1, FLOW_2, P1, P2, P_AMBIENT


@njit
def term(s, p, m, c):
    """Take L_1 (p1 - p_a) and L_2 (p2 - p_a) out of the chambers; p[2] is p_a, Pa."""
    c[FLOW_1] -= p[0] * (s[P1] - p[2])
    c[FLOW_2] -= p[1] * (s[P2] - p[2])


def starts(r):
    """Both chambers at once; the make-up path is weak, so little lowers the mean pressure much."""
    small = 2e-4 * r.flow / max(r.mean_pressure, 1e3)
    return ({"L_1": small, "L_2": small},)


EFFECT = Effect(
    name="external_leakage",
    balance="flow",
    equation="Q_1 = -L_1 (p1 - p_a), Q_2 = -L_2 (p2 - p_a): it flows to the ambient pressure p_a",
    source="external leakage, Merritt 1967, Eq. 6-39, whose pressures are above that of the tank",
    parameters=(
        Parameter("L_1", "m^3/(s*Pa)", "leakage of chamber 1 to the tank", 0.0, 1e-8, 1e-12),
        Parameter("L_2", "m^3/(s*Pa)", "leakage of chamber 2 to the tank", 0.0, 1e-8, 1e-12),
    ),
    term=term,
    adds=(FLOW_1, FLOW_2),
    reads=(P1, P2),
    rig_numbers=(P_AMBIENT,),
    statement="chamber 1 leaks {L_1} and chamber 2 {L_2} to the outside",
    rig_check="Look for oil at the rod seal and measure the case drain: both pressures must fall "
    "while the rod is blocked.",
    starts=starts,
)
