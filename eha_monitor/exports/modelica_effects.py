"""Each effect of the catalogue as Modelica equations.

An entry gives what it adds to the balances, as expressions of the model's variables ``x``, ``v``,
``p1``, ``p2``, ``dp``, ``omega`` and of its own parameters, written ``{F_c}``; further variables
and equations where it remembers something.  Drive and sensor effects are constants of the
equations in :mod:`eha_monitor.exports.modelica`.  A test holds each to the compiled term.
"""

from dataclasses import dataclass, field

_SIGN = "tanh(v/{v_e})"


@dataclass(frozen=True)
class Written:
    """An effect in Modelica.

    Attributes
    ----------
    adds : contribution (``force``, ``flow_1``, ..., see modelica.CONTRIBUTIONS) -> expression.
    variables : further variables: name -> start, or "" for an algebraic one.
    equations : further equations.
    """

    adds: dict[str, str]
    variables: dict[str, str] = field(default_factory=dict)
    equations: tuple[str, ...] = ()


def dry(law: str, deflection: str = "{z_0}", beside: str = "") -> Written:
    """Return a dry friction whose seal bends before it slides, after Dahl.

    Parameters
    ----------
    law, deflection : steady force in N and bending in m, of the velocity.
    beside : what it adds besides.
    """
    return Written(
        {"force": "({self}_bent + {t_1}*exp(-(v/{v_d})^2)*der({self}_bent))" + beside},
        {"{self}_steady": "", "{self}_bent": "0"},
        ("{self}_steady = " + law,
         "der({self}_bent) = abs(v)/max(" + deflection + ", 1e-12)*({self}_steady - {self}_bent)"))


def rigid(law: str, beside: str = "") -> Written:
    """Return a dry friction that turns at once with the velocity: z_0 = 0."""
    return Written({"force": f"({law}){beside}"})


def across(flow: str) -> Written:
    """Return a flow from chamber 1 into chamber 2."""
    return Written({"flow_1": f"-({flow})", "flow_2": f"({flow})"})


_COULOMB = "{F_c}*" + _SIGN
_STRIBECK = "({F_c} + {F_d}*exp(-(v/{v_s})^2))"
_ASYMMETRIC = "{F_c}*" + _SIGN + " + {dF}*abs(" + _SIGN + ")"
_BY_PRESSURE = "{mu}*max(p1 + p2, 0)*" + _SIGN
_AIR = ("{{alpha}}/({{n}}*max({p}, 5066.25))*(101325/max({p}, 5066.25))^(1/{{n}})")

# Effect -> (with a seal that bends, z_0 > 0; without), or one of them for both.
EFFECTS: dict[str, Written | tuple[Written, Written]] = {
    "added_mass": Written({"mass": "{dM}"}),
    "anti_cavitation": Written({"flow_1": "{k}*max({p_min} - p1, 0)",
                                "flow_2": "{k}*max({p_min} - p2, 0)"}),
    "asymmetric_friction": (
        dry(_ASYMMETRIC, "{z_0}*abs({F_c} + sign(v)*{dF})/({F_c} + abs({dF}))", " + {dB}*abs(v)"),
        rigid(_ASYMMETRIC, " + {dB}*abs(v)")),
    "constant_load": Written({"force": "{F_0}"}),
    "coulomb_friction": (dry(_COULOMB), rigid(_COULOMB)),
    "cross_port_leakage": across("{L}*dp"),
    "entrained_air": Written({"compliance_1": _AIR.format(p="p1"),
                              "compliance_2": _AIR.format(p="p2")}),
    "external_leakage": Written({"flow_1": "-{L_1}*(p1 - ambient_pressure)",
                                 "flow_2": "-{L_2}*(p2 - ambient_pressure)"}),
    "leakage_offset": across("{Q_0}*tanh(dp/{dp_e})"),
    "line_dynamics": Written(
        {"speed": "({self}_flow - omega)"},
        {"{self}_flow": "0", "{self}_pressure": "0"},
        ("{T_l}*der({self}_pressure) = {Z}*(omega - {self}_flow)",
         "{Z}*{T_l}*der({self}_flow) = {self}_pressure - dp - 2*{zeta}*{Z}*{self}_flow")),
    "position_dependent_volume": Written({"volume_1": "{A_v}*x", "volume_2": "-{A_v}*x"}),
    "presliding_friction": (dry(_COULOMB), rigid(_COULOMB)),
    "pressure_friction": (dry(_BY_PRESSURE), rigid(_BY_PRESSURE)),
    "pump_dead_zone": Written({"speed": "-min(max(omega, -{omega_0}), {omega_0})"}),
    "pump_flow_gain": Written({"speed": "{k}*omega"}),
    "pump_volumetric_loss": Written({
        "speed": "-{k}*omega*abs(dp)*(if omega*dp >= 0 then 1 else -{motoring})"}),
    "quadratic_friction": Written({"force": "{a_1}*v*abs(v)"}),
    "relief_valve": across("{k}*(max(dp - {p_c}, 0) - max(-dp - {p_c}, 0))"),
    "spring_load": Written({"force": "{k}*(x - {x_0})"}),
    "stribeck_friction": (
        dry(_STRIBECK + "*" + _SIGN, "{z_0}*" + _STRIBECK + "/({F_c} + {F_d})"),
        rigid(_STRIBECK + "*" + _SIGN)),
    "turbulent_leakage": across("{c}*dp/sqrt(sqrt(dp*dp + {dp_0}*{dp_0}))"),
}
# Drive and sensor effects that are constants of the equations of drive and sensors.
CONSTANTS = ("command_delay", "drive_gain", "drive_lag", "drive_saturation", "feedback_delay",
             "position_delay", "position_scale", "pressure_delay", "pressure_drift",
             "pressure_offset", "pressure_scale")
# What is left out, and why.
WITHOUT = {
    "backlash": "a play has no equation, only a rule for each contact; the model goes without it",
    "position_quantisation": "the position of the model is continuous",
}


def written(name: str, values: dict[str, float]) -> Written:
    """Return an effect in Modelica with its parameters' places still in braces."""
    found = EFFECTS[name]
    if isinstance(found, tuple):
        return found[0] if values["z_0"] > 0.0 else found[1]
    return found
