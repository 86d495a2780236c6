"""The actuator of a config as Modelica text: its own equations, no library needed.

An entry of :data:`EFFECTS` gives what an effect of the catalogue adds to the balances, as
expressions of the model's variables ``x``, ``v``, ``p1``, ``p2``, ``dp``, ``omega`` and of its own
parameters, written ``{F_c}``; further variables and equations where it remembers something.  Drive
and sensor effects are constants of the equations of drive and sensors.  A test holds each to the
compiled term.
"""

import ast
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from eha_monitor import __version__
from eha_monitor.exports.model import (
    INPUTS,
    OUTPUTS,
    Exported,
    Model,
    exponents,
    lost_of_simulation,
    plain,
)
from eha_monitor.physics import signals as of
from eha_monitor.physics.contributions import circuit_of
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.own_term import turns
from eha_monitor.physics.parameters import BASE_KEYS, theta_of
from eha_monitor.physics.plant import SHORTEST_LAG, Y_P1, Y_P2, Y_X, at_rest
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.own_terms import slot_for
from eha_monitor.settings.rig import Rig

_SIGN = "((1 - {w})*tanh(v/{v_e}) + {w}*v/({v_e} + abs(v)))"


@dataclass(frozen=True)
class Written:
    """An effect in Modelica."""

    # Contribution (``force``, ``flow_1``, ..., see CONTRIBUTIONS) -> expression.
    adds: dict[str, str]
    variables: dict[str, str] = field(default_factory=dict)  # name -> start, or "" if algebraic
    equations: tuple[str, ...] = ()


def dry(law: str, deflection: str = "{z_0}", beside: str = "") -> Written:
    """Return a dry friction whose seal bends before it slides, after Dahl.

    Parameters
    ----------
    law, deflection : steady force in N and bending in m, of the velocity.
    beside : what it adds besides.
    """
    return Written(
        {"force": "({self}_bent + {t_1}*min(" + deflection + "/1e-6, 1)*exp(-(v/{v_d})^2)"
         "*der({self}_bent))" + beside},
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
_STRIBECK = "({F_c} + {F_d}*((1 - {h})*exp(-(abs(v)/{v_s})^{delta}) + {h}/(1 + (v/{v_s})^2)))"
_LEVEL = "max({F_c} + (if v < 0 then -1 else 1)*{dF}, 0)"
_ASYMMETRIC = _LEVEL + "*" + _SIGN
_BY_PRESSURE = "{mu}*max(p1 + p2, 0)*" + _SIGN
_AIR = ("{{alpha}}/({{n}}*max({p}, 5066.25))*(101325/max({p}, 5066.25))^(1/{{n}})")

# Effect -> (with a seal that bends, z_0 > 0; without), or one of them for both.
EFFECTS: dict[str, Written | tuple[Written, Written]] = {
    "added_mass": Written({"mass": "{dM}"}),
    "anti_cavitation": Written({"flow_1": "{k}*max({p_min} - p1, 0)",
                                "flow_2": "{k}*max({p_min} - p2, 0)"}),
    "asymmetric_friction": (
        dry(_ASYMMETRIC, "{z_0}*" + _LEVEL + "/({F_c} + abs({dF}))", " + {dB}*abs(v)"),
        rigid(_ASYMMETRIC, " + {dB}*abs(v)")),
    "constant_load": Written({"force": "{F_0}"}),
    "coulomb_friction": (dry(_COULOMB), rigid(_COULOMB)),
    "contact_spring": Written({"force": "{k}*{side}*max({side}*(x - {x_c}), 0)"}),
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
    "position_dependent_volume": Written({"volume_1": "{A_v}*x", "volume_2": "-{A_v}*{r}*x"}),
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


CONTRIBUTIONS = ("force", "flow_1", "flow_2", "compliance_1", "compliance_2", "volume_1",
                 "volume_2", "mass", "speed")
_OWN = {"force": {"force": ""}, "flow": {"flow_1": "", "flow_2": "-"}, "flow_1": {"flow_1": ""},
        "flow_2": {"flow_2": ""}, "speed": {"speed": ""}}
# The other signals are variables of the model.
_SIGNALS = {"p": "(0.5*(p1 + p2))", "angle": "shaft_angle"}
_FACTORS = {"none": "", "direction": "*tanh(v/{scale})", "v": "*v/{scale}", "dp": "*dp/{scale}",
            "omega": "*omega/{scale}"}
_OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "^"}


def modelica_of(model: Model, units: Mapping[str, str]) -> Exported:
    """Return the Modelica model of a config.

    What cannot be written as an equation is left out, told and named in a comment.

    ``units`` : unit of a linear rig -> that of this one.

    Raises InputError if a number of the rig is null.
    """
    model.require("a Modelica model")
    settings = model.settings
    closed = settings.rig.position_gain is not None
    theta, active = theta_of(settings.rig, settings.effects)
    w = circuit_of(theta, active)
    slow = closed and (w[of.DRIVE_LAG] > 0.0 or bool(np.isfinite(w[of.SLEW_LIMIT])))
    lost = (*(f"{name}: {why}" for name, why in WITHOUT.items() if name in model.effects),
            *(line for line in lost_of_simulation(model)
              if not line.startswith("position_quantisation")),
            *(() if closed else _open_lost(model)))
    adds: dict[str, list[str]] = {name: [] for name in CONTRIBUTIONS}
    variables: dict[str, str] = {}
    equations: list[str] = []
    for one in (*(_of_effect(name, values) for name, values in model.effects.items()
                  if name in EFFECTS),
                *(_of_own(name, values) for name, values in model.own_terms.items())):
        for contribution, expression in one.adds.items():
            adds[contribution].append(expression)
        variables |= one.variables
        equations += [line for line in one.equations if line not in equations]
    text = [f'model {model.identifier}',
            f'  "Electrohydraulic actuator, by eha_monitor {__version__}"',
            f"  // from {model.source}; {model.provenance}",
            *(f"  // not in this model: {line}" for line in lost)]
    text += _parameters(model, at_rest(theta, active, model.start), units)
    text += _ports(closed, slow, units)
    text += ["protected"]
    text += [f"  Real {name};" for name in ("dp", *(f"sum_{one}" for one in CONTRIBUTIONS),
                                            *(("seen", "wanted") if closed else ()))]
    text += [f"  Real {name}{f'(start = {begin}, fixed = true)' if begin else ''};"
             for name, begin in variables.items()]
    text += ["equation"]
    text += [f"  sum_{name} = {' + '.join(adds[name]) or '0'};" for name in CONTRIBUTIONS]
    drive = _drive(w, closed, slow, settings)
    text += [f"  {line};" for line in (*equations, *_balances(), *drive, *_sensors(w))]
    text += [f"end {model.identifier};", ""]
    return Exported("\n".join(text), lost)


def _open_lost(model: Model) -> tuple[str, ...]:
    drive = model.of_balance("drive")
    return (f"rig.position_gain is null: pump_speed is the input; {', '.join(drive)} do not act "
            "on it",) if drive else ()


def _number(value: float) -> str:
    return repr(float(value))


def _quote(text: str) -> str:
    return '"' + " ".join(text.replace("\\", "/").replace('"', "'").split()) + '"'


def _unit(unit: str, units: Mapping[str, str]) -> str:
    """Return ``(unit = "N.s/m")``, or nothing where Modelica cannot spell it."""
    text = plain(units.get(unit, unit))
    if not text or exponents(text) is None:
        return ""
    return f'(unit = "{text.replace("^", "").replace("*", ".")}")'


def _parameters(model: Model, start: np.ndarray, units: Mapping[str, str]) -> list[str]:
    lines = []
    for key in BASE_KEYS.values():
        value = getattr(model.settings.rig, key)
        if value is not None:
            info = Rig.model_fields[key]
            lines.append(f"  parameter Real {key}{_unit(info.json_schema_extra['unit'], units)} = "
                         f"{_number(value)} {_quote(info.description)};")
    for key, unit, place, what in (("x_start", "m", Y_X, "position"),
                                   ("p1_start", "Pa", Y_P1, "pressure 1, which with the other"
                                    " holds the load,"), ("p2_start", "Pa", Y_P2, "pressure 2")):
        lines.append(f"  parameter Real {key}{_unit(unit, units)} = {_number(start[place])} "
                     f'"{what} at the start, at rest";')
    for name, values in model.effects.items():
        if name not in EFFECTS:
            continue
        text = str(written(name, values))
        for p in CATALOGUE[name].parameters:
            if f"{{{p.name}}}" in text:
                lines.append(f"  parameter Real {name}_{p.name}{_unit(p.unit, units)} = "
                             f"{_number(values[p.name])} {_quote(p.description)};")
    for name, values in model.own_terms.items():
        lines += [f"  parameter Real own_{name}_{key} = {_number(value)};"
                  for key, value in values.items() if isinstance(value, float)
                  and key not in ("first", "last")]
    return lines


def _ports(closed: bool, slow: bool, units: Mapping[str, str]) -> list[str]:
    given = [port for port in INPUTS if port[0] != ("pump_speed" if closed else "x_d")]
    lines = [f"  input Real {name}{_unit(unit, units)} {_quote(re.split(', with', text)[0])};"
             for name, unit, text in given]
    starts = {"x": "x_start", "v": "0", "p1": "p1_start", "p2": "p2_start"}
    if slow:
        starts["omega"] = "0"
    for name, unit, text in OUTPUTS:
        spelt = _unit(unit, units)
        if name in starts:
            spelt = f"{spelt[:-1]}, start = {starts[name]}, fixed = true)"
        lines.append(f"  output Real {name}{spelt} {_quote(text)};")
    return lines


def _of_effect(name: str, values: Mapping[str, float]) -> Written:
    """Return an effect with the names of its parameters in the model."""
    one = written(name, values)
    places = {p.name: f"{name}_{p.name}" for p in CATALOGUE[name].parameters} | {"self": name}
    adds, variables = ({key.format(**places): text.format(**places) for key, text in part.items()}
                       for part in (one.adds, one.variables))
    return Written(adds, variables, tuple(line.format(**places) for line in one.equations))


def _of_own(name: str, values: dict) -> Written:
    """Return a term of the rig's own; ``own_`` keeps its names apart from all others."""
    name = f"own_{name}"
    if "expression" in values:
        own = {key for key in values if key not in ("adds", "expression")}
        text = _translated(ast.parse(values["expression"], mode="eval").body, name, own)
    else:
        text = f"({_table(values)}){_FACTORS[values['times']].format(scale=f'{name}_scale')}"
    shaft = turns(slot_for(values))
    return Written({contribution: f"({sign}{name}_value)"
                    for contribution, sign in _OWN[values["adds"]].items()},
                   {f"{name}_value": ""} | ({"shaft_angle": "0"} if shaft else {}),
                   (f"{name}_value = {text}", *(["der(shaft_angle) = omega"] * shaft)))


def _translated(node: ast.AST, name: str, own: set[str]) -> str:
    """Return an expression of a config, which was checked when it was read, as Modelica."""
    if isinstance(node, ast.Constant):
        return _number(node.value)
    if isinstance(node, ast.Name):
        if node.id in own:
            return f"{name}_{node.id}"
        return _number(np.pi) if node.id == "pi" else _SIGNALS.get(node.id, node.id)
    if isinstance(node, ast.UnaryOp):
        sign = "-" if isinstance(node.op, ast.USub) else ""
        return f"({sign}{_translated(node.operand, name, own)})"
    if isinstance(node, ast.BinOp):
        left, right = (_translated(one, name, own) for one in (node.left, node.right))
        if isinstance(node.op, ast.Pow) and right.endswith(".0"):
            right = right[:-2]  # a whole exponent: a negative base is allowed
        return f"({left}{_OPERATORS[type(node.op)]}{right})"
    assert isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    return f"{node.func.id}({', '.join(_translated(one, name, own) for one in node.args)})"


def _table(values: dict) -> str:
    """Return a table's cubic through its knots, piece by piece; constant beyond its ends."""
    knots, count = np.asarray(values["values"], dtype=float), len(values["values"])
    signal = _SIGNALS.get(values["of"], values["of"])
    width = values["last"] - values["first"]
    if values["of"] == "angle":  # it goes round
        first = _number(values["first"])
        whole = f"floor(({signal} - ({first}))/{_number(width)})"
        signal = f"({signal} - {_number(width)}*{whole})"
        outer = np.concatenate([knots[-1:], knots, knots[:2]])
        knots, count = np.append(knots, knots[0]), count + 1
    else:
        outer = np.concatenate([[2 * knots[0] - knots[1]], knots, [2 * knots[-1] - knots[-2]]])
    step = width / (count - 1)
    text = f"if {signal} <= {_number(values['first'])} then {_number(knots[0])}"
    for i in range(count - 1):
        a, b, c, d = outer[i : i + 4]
        cubic = (b, 0.5 * (c - a), 0.5 * (2 * a - 5 * b + 4 * c - d), 0.5 * (3 * (b - c) + d - a))
        start = values["first"] + i * step
        f = f"(({signal} - ({_number(start)}))/{_number(step)})"
        text += (f"\n    elseif {signal} <= {_number(start + step)} then {_number(cubic[0])} + {f}"
                 f"*(({_number(cubic[1])}) + {f}*(({_number(cubic[2])}) + {f}"
                 f"*({_number(cubic[3])})))")
    return f"{text}\n    else {_number(knots[-1])}"


def _balances() -> list[str]:
    """Return the balances of :mod:`eha_monitor.physics.balances`."""
    crossing = "0.5*(leakage - makeup_conductance)*dp"
    pumped = "pump_displacement*(omega + sum_speed)"
    soft = "(volume_{i} + sum_volume_{i})*(1/bulk_modulus + sum_compliance_{i})*der(p{i})"
    return ["dp = p1 - p2", "force = area_1*p1 - area_2*p2", "der(x) = v",
            "(mass + sum_mass)*der(v) = force - viscous_damping*v - sum_force - load_force",
            f"{soft.format(i=1)} = {pumped} - area_1*v - {crossing} "
            "- makeup_conductance*(p1 - charge_pressure) + sum_flow_1",
            f"{soft.format(i=2)} = -{pumped}*area_2/area_1 + area_2*v + {crossing} "
            "- makeup_conductance*(p2 - charge_pressure) + sum_flow_2"]


def _late(what: str, delay: float) -> str:
    return f"delay({what}, {_number(delay)})" if delay > 0.0 else what


def _drive(w: np.ndarray, closed: bool, slow: bool, settings: Settings) -> list[str]:
    if not closed:
        return ["omega = pump_speed"]
    seen = _late("x", w[of.FEEDBACK_DELAY])
    if w[of.IN_LOOP] != 0.0 and w[of.POSITION_SCALE] != 0.0:
        seen = f"{_number(1.0 + w[of.POSITION_SCALE])}*{seen}"
    gain = f"{_number(1.0 + w[of.DRIVE_GAIN])}*" * bool(w[of.DRIVE_GAIN]) + "position_gain"
    wanted = f"{gain}*({_late('x_d', w[of.COMMAND_DELAY])} - seen)"
    if np.isfinite(w[of.SPEED_LIMIT]):
        limit = _number(w[of.SPEED_LIMIT])
        wanted = f"min(max({wanted}, -{limit}), {limit})"
    lines = [f"seen = {seen}", f"wanted = {wanted}"]
    if slow:
        step = settings.rig.sample_time / settings.simulation.substeps
        rate = f"(wanted - omega)/{_number(max(w[of.DRIVE_LAG], SHORTEST_LAG * step))}"
        if np.isfinite(w[of.SLEW_LIMIT]):
            slew = _number(w[of.SLEW_LIMIT])
            rate = f"min(max({rate}, -{slew}), {slew})"
        return [*lines, f"der(omega) = {rate}"]
    return [*lines, "omega = wanted"]


def _sensors(w: np.ndarray) -> list[str]:
    x = _late("x", w[of.POSITION_DELAY])
    lines = [f"x_measured = {_number(1.0 + w[of.POSITION_SCALE])}*{x}"]
    for name, scale, offset, drift in (
            ("p1", of.PRESSURE_SCALE_1, of.PRESSURE_OFFSET_1, of.PRESSURE_DRIFT_1),
            ("p2", of.PRESSURE_SCALE_2, of.PRESSURE_OFFSET_2, of.PRESSURE_DRIFT_2)):
        late = _late(name, w[of.PRESSURE_DELAY])
        lines.append(f"{name}_measured = {_number(1.0 + w[scale])}*{late} + "
                     f"({_number(w[offset])}) + ({_number(w[drift])})*time")
    return lines
