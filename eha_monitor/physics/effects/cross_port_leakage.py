"""Leakage across the piston beyond what the config's ``leakage`` holds."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FLOW_1, FLOW_2, P1, P2


@njit
def term(s, p, m, c):
    """Move L (p1 - p2) from chamber 1 to chamber 2."""
    q = p[0] * (s[P1] - s[P2])
    c[FLOW_1] -= q
    c[FLOW_2] += q


EFFECT = Effect(
    name="cross_port_leakage",
    balance="flow",
    equation="Q = L (p1 - p2)",
    source="laminar leakage, Merritt 1967, Eq. 6-38",
    parameters=(
        Parameter("L", "m^3/(s*Pa)", "added laminar leakage coefficient", -1e-8, 1e-8, 1e-12),
    ),
    term=term,
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
