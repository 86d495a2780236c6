"""Check valves that feed a chamber from the tank or the accumulator when its pressure is lost."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import FLOW_1, FLOW_2, P1, P2


@njit
def term(s, p, m, c):
    """Feed k (p_min - p_i)+ into each chamber."""
    c[FLOW_1] += p[0] * max(p[1] - s[P1], 0.0)
    c[FLOW_2] += p[0] * max(p[1] - s[P2], 0.0)


def starts(r):
    """Set points at the low end of the record; k feeds 1 % of the flow at its lowest pressure."""
    bottom, low, fifth = r.lowest_pressure
    found = []
    for p_min in (low, fifth, 0.5 * (fifth + max(r.mean_pressure, fifth))):
        depth = max(p_min - bottom, 1e-3 * abs(p_min), 1.0)
        found.append({"k": 0.01 * r.flow / depth, "p_min": p_min})
    return tuple(found)


EFFECT = Effect(
    name="anti_cavitation",
    balance="flow",
    equation="Q_i = k (p_min - p_i)+, i = 1, 2",
    source="check valve, steady state, Merritt 1967, Sec. 9-2; Ivantysyn, Ivantysynova 2001",
    parameters=(
        Parameter("k", "m^3/(s*Pa)", "flow over the pressure deficit", 0.0, 1e-6, 1e-11),
        Parameter("p_min", "Pa", "absolute pressure below which the valve opens", 0.0, 1e8, 1e6,
                  1e5),
    ),
    term=term,
    adds=(FLOW_1, FLOW_2),
    reads=(P1, P2),
    statement="a check valve feeds a chamber below {p_min}, with {k} of pressure deficit",
    rig_check="Watch the lower pressure in a fast move: it must stay flat at p_min.",
    starts=starts,
    rarity=2,
)
