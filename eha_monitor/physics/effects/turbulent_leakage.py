"""Leakage through a sharp edge: it grows with the root of the pressure difference."""

import math

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FLOW_1, FLOW_2, P1, P2


@njit
def term(s, p, m, c):
    """Move c dp / (dp^2 + dp_0^2)^(1/4) from chamber 1 to 2: linear below dp_0."""
    dp = s[P1] - s[P2]
    q = p[0] * dp / math.sqrt(math.sqrt(dp * dp + p[1] * p[1]))
    c[FLOW_1] -= q
    c[FLOW_2] += q


EFFECT = Effect(
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
    term=term,
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
