"""Free air in the oil: the fluid is soft at low pressure."""

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import COMPLIANCE_1, COMPLIANCE_2, P1, P2

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
def term(s, p, m, c):
    """Add the compliance of the air to both chambers."""
    c[COMPLIANCE_1] += compliance(s[P1], p[0], p[1])
    c[COMPLIANCE_2] += compliance(s[P2], p[0], p[1])


EFFECT = Effect(
    name="entrained_air",
    balance="flow",
    equation="1/beta(p) = 1/beta_e + alpha/(n p) (p_atm/p)^(1/n)",
    source="polytropic air in oil: Yu, Chen, Lu 1994; Gholizadeh, Burton, Schoenau 2011",
    parameters=(
        Parameter("alpha", "1", "volume fraction of free air at atmospheric pressure",
                  0.0, 0.5, 0.01),
        Parameter("n", "1", "polytropic exponent", 1.0, 1.67, 0.2, 1.4),
    ),
    term=term,
    adds=(COMPLIANCE_1, COMPLIANCE_2),
    reads=(P1, P2),
    statement="{alpha:%} of free air (at atmospheric pressure) softens the oil at low pressure",
    rig_check="Raise the charge pressure: the apparent bulk modulus must rise with it.",
    starts=lambda r: ({"alpha": 1e-3, "n": 1.4},),
)
