"""A line between pump and cylinder: its oil has mass, so the flow arrives late and may ring.

The memory holds the line's output q and T_l q' half a step ahead, driven by the shaft speed at the
step's end: centred on both sides, so second order in the step.  The step is the exact response to
a constant input, stable for any h / T_l.
"""

import math

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import OMEGA, SPEED

SHORTEST = 0.5  # integration steps: a faster line is not resolved, and left out


@njit
def term(s, p, m, c):
    """Replace the shaft's speed by what leaves the line; a new memory is a line at rest."""
    if m[0] != 0.0 or m[1] != 0.0:
        c[SPEED] += m[0] - s[OMEGA]


@njit
def update(s, p, h, m):
    """Carry q and T_l q' over one step of constant input."""
    omega = s[OMEGA]
    if p[0] < SHORTEST * h:
        m[0] = 0.0
        m[1] = 0.0
        return
    if m[0] == 0.0 and m[1] == 0.0:  # new: the line starts in steady flow
        m[0] = omega
        return
    zeta = p[1]
    root = math.sqrt(1.0 - zeta * zeta)
    along = h / p[0]
    decay = math.exp(-zeta * along)
    sine, cosine = math.sin(root * along), math.cos(root * along)
    error, rate = m[0] - omega, m[1]
    m[0] = omega + decay * (error * cosine + (rate + zeta * error) / root * sine)
    m[1] = decay * (rate * cosine - (error + zeta * rate) / root * sine)


EFFECT = Effect(
    name="line_dynamics",
    balance="flow",
    equation="T_l^2 Q'' + 2 zeta T_l Q' + Q = D_p omega",
    source="lumped inertance, resistance and capacitance of a line, Merritt 1967, Sec. 3-6; "
    "Watton 2009, Ch. 4",
    parameters=(
        Parameter("T_l", "s", "one over the line's natural frequency in rad/s", 0.0, 0.5, 1e-3),
        Parameter("zeta", "1", "damping ratio of the line", 0.01, 0.99, 0.2, 0.2),
    ),
    term=term,
    update=update,
    statement="the line delivers the pump's flow through a second-order lag of {T_l:.3g} s with a "
    "damping ratio of {zeta:.2g}",
    rig_check="Step the pump speed with the rod blocked: the pressure must ring with a period of "
    "2 pi T_l.",
    starts=lambda r: tuple({"T_l": share * r.sample_time, "zeta": 0.2}
                           for share in (0.5, 2.0, 8.0)),
    rarity=2,
)
