"""Leakage of each chamber to the outside, or to the tank."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FLOW_1, FLOW_2, P1, P2


@njit
def term(s, p, m, c):
    """Take L_1 p1 and L_2 p2 out of the chambers."""
    c[FLOW_1] -= p[0] * s[P1]
    c[FLOW_2] -= p[1] * s[P2]


def starts(r):
    """Both chambers at once; the make-up path is weak, so little lowers the mean pressure much."""
    small = 2e-4 * r.flow / max(r.mean_pressure, 1e3)
    return ({"L_1": small, "L_2": small},)


EFFECT = Effect(
    name="external_leakage",
    balance="flow",
    equation="Q_i = -L_i p_i, i = 1, 2: L_1 p1 and L_2 p2 leave",
    source="external leakage, Merritt 1967, Eq. 6-39",
    parameters=(
        Parameter("L_1", "m^3/(s*Pa)", "leakage of chamber 1 to the tank", -1e-8, 1e-8, 1e-12),
        Parameter("L_2", "m^3/(s*Pa)", "leakage of chamber 2 to the tank", -1e-8, 1e-8, 1e-12),
    ),
    term=term,
    statement="chamber 1 leaks {L_1} and chamber 2 {L_2} to the outside",
    rig_check="Look for oil at the rod seal and measure the case drain: both pressures must fall "
    "while the rod is blocked.",
    starts=starts,
)
