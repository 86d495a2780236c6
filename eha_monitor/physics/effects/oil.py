"""The oil: free air in it, its volumes, and the line between pump and cylinder."""

from eha_monitor.compiled import njit
from eha_monitor.physics import signals as of
from eha_monitor.physics.effect import Effect, Parameter

# Free air in the oil: the fluid is soft at low pressure.
P_ATM = 101325.0  # Pa


@njit
def compliance(p, alpha, n):
    """Tangent compliance of the air in 1/Pa at absolute pressure ``p``.

    Air fraction alpha at atmospheric pressure, polytropic exponent n:
    V_air = alpha V (p_atm/p)^(1/n), and -dV_air/dp / V is returned.
    """
    p = max(p, 0.05 * P_ATM)  # below that the oil boils; keep the expression finite
    return alpha / (n * p) * (P_ATM / p) ** (1.0 / n)


@njit
def entrained_air_term(s, p, m, c):
    """Add the compliance of the air to both chambers."""
    c[of.COMPLIANCE_1] += compliance(s[of.P1], p[0], p[1])
    c[of.COMPLIANCE_2] += compliance(s[of.P2], p[0], p[1])


ENTRAINED_AIR = Effect(
    name="entrained_air", balance="flow",
    equation="1/beta(p) = 1/beta_e + alpha/(n p) (p_atm/p)^(1/n)",
    source="polytropic air in oil: Yu, Chen, Lu 1994; Gholizadeh, Burton, Schoenau 2011",
    parameters=(
        Parameter("alpha", "1", "volume fraction of free air at atmospheric pressure",
                  0.0, 0.5, 0.01),
        Parameter("n", "1", "polytropic exponent", 1.0, 1.67, 0.2, 1.4),
    ),
    term=entrained_air_term, adds=(of.COMPLIANCE_1, of.COMPLIANCE_2), reads=(of.P1, of.P2),
    statement="{alpha:%} of free air (at atmospheric pressure) softens the oil at low pressure",
    rig_check="Raise the charge pressure: the apparent bulk modulus must rise with it.",
    starts=lambda r: ({"alpha": 1e-3, "n": 1.4},),
)


# Oil columns that grow and shrink with the position of the piston.
@njit
def position_dependent_volume_term(s, p, m, c):
    """Add A_v x of oil volume to chamber 1, and take r A_v x from chamber 2."""
    c[of.VOLUME_1] += p[0] * s[of.X]
    c[of.VOLUME_2] -= p[0] * p[1] * s[of.X]


POSITION_DEPENDENT_VOLUME = Effect(
    name="position_dependent_volume", balance="flow",
    equation="V1 + A_v x,  V2 - r A_v x",
    source="chamber volumes, Merritt 1967, Eq. 6-34 and 6-35",
    parameters=(
        Parameter("A_v", "m^2", "volume over position; the piston area if nothing makes up for it",
                  0.0, 0.1, 5e-4),
        Parameter("r", "1", "area of chamber 2 over that of chamber 1, of a single rod",
                  0.0, 100.0, 1.0, 1.0, fitted=False),
    ),
    term=position_dependent_volume_term, adds=(of.VOLUME_1, of.VOLUME_2), reads=(of.X,),
    statement="the oil volumes change with position as under a piston of {A_v}",
    rig_check="Excite the oil column at both ends of the travel: its resonance must shift between "
    "them.",
    starts=lambda r: ({"A_v": 0.3 * r.flow / max(r.speed, 1e-6)},),
    rarity=2,
)


# A line between pump and cylinder: its oil has mass and yields, so flow arrives late and rings.
#
# The pump fills a volume, from there the oil must be set going against the chambers:
#
#     T_l dp_l' = Z (omega - n),   Z T_l n' = dp_l - dp - 2 zeta Z n,   Q = D_p n
#
# with n (rad/s) the flow that reaches the chambers, in shaft speed.  With the line's inertance I,
# its resistance R and the volume V_l at the pump, T_l^2 = I V_l/(2 beta_e), zeta = R T_l/(2 I) and
# Z = D_p I/T_l, which does not depend on the length: with T_l = 0 there is no line.  dp loads the
# line: a model without it has another resonance.
#
# Both are staggered by half a step (leapfrog): m[0] is n half a step ahead of m[1], which is dp_l.
SHORTEST = 1.0  # integration steps: a faster line is not resolved, and left out


@njit
def line_dynamics_term(s, p, m, c):
    """Replace the shaft's speed by what leaves the line; a new memory is a line at rest."""
    if m[0] != 0.0 or m[1] != 0.0:
        c[of.SPEED] += m[0] - s[of.OMEGA]


@njit
def line_dynamics_update(s, p, h, m):
    """Carry both over one step of ``h`` s that has ended at the signals ``s``."""
    time, impedance = p[0], p[2]
    omega, dp = s[of.OMEGA], s[of.P1] - s[of.P2]
    if time < SHORTEST * h:
        m[0] = 0.0
        m[1] = 0.0
        return
    braking = p[1] * h / time
    if m[0] == 0.0 and m[1] == 0.0:  # new: the line starts in steady flow
        m[0] = omega
        m[1] = dp + 2.0 * p[1] * impedance * omega
        return
    m[1] += h * impedance / time * (omega - m[0])
    m[0] = ((1.0 - braking) * m[0] + h / (impedance * time) * (m[1] - dp)) / (1.0 + braking)


def line_dynamics_starts(r) -> tuple[dict[str, float], ...]:
    """Return lines of three lengths, in each of which the oil flows at 5 m/s, or at 0.5 m/s.

    Those are the speeds for which lines are laid out.  In a line of cross-section a, with rho c
    of 7e5 Pa*s/m, Z is about 2 D_p rho c/a, which is 7e6 Pa over the shaft speed that fills it.
    """
    impedance = 7e6 / max(r.pump_speed[3], 1e-3)
    return tuple({"T_l": share * r.sample_time, "zeta": 0.1, "Z": weight * impedance}
                 for share in (1.0, 2.0, 4.0) for weight in (0.1, 1.0))


LINE_DYNAMICS = Effect(
    name="line_dynamics", balance="flow",
    equation="T_l dp_l' = Z (omega - n),  Z T_l n' = dp_l - dp - 2 zeta Z n,  Q = D_p n",
    source="lumped inertance, resistance and capacitance of a line, Merritt 1967, Sec. 3-6; "
    "Watton 2009, Ch. 4",
    parameters=(
        Parameter("T_l", "s", "one over the line's natural frequency in rad/s, chambers blocked "
                  "at constant pressure", 0.0, 0.5, 1e-3, log=True, resolved=SHORTEST),
        Parameter("zeta", "1", "damping ratio of the line", 0.005, 5.0, 0.2, 0.2),
        Parameter("Z", "Pa*s/rad", "impedance of the line to pump speed, D_p sqrt(2 beta_e I/V_l)",
                  1.0, 1e7, 1e4, 1e4),
    ),
    term=line_dynamics_term, adds=(of.SPEED,), reads=(of.OMEGA,), update=line_dynamics_update,
    statement="the oil in the line rings with a period of 2 pi times {T_l}, damping ratio "
    "{zeta}: flow reaches the chambers late",
    rig_check="Step the pump speed with the rod blocked: the pressure must ring with a period of "
    "about 2 pi T_l.",
    starts=line_dynamics_starts,
    rarity=2,
)
