"""``modelDescription.xml`` of the FMU: variables, units, structure."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from eha_monitor import __version__
from eha_monitor.exports.model import Model
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import BASE_KEYS, place_of
from eha_monitor.physics.signals import K_POS
from eha_monitor.settings.rig import Rig

INPUTS = (("x_d", "m", "demanded position, with closed_loop"),
          ("pump_speed", "rad/s", "shaft speed of the pump, without closed_loop"),
          ("load_force", "N", "external force, positive against positive motion"))
OUTPUTS = (("x", "m", "position"), ("v", "m/s", "velocity"),
           ("p1", "Pa", "absolute pressure of chamber 1"),
           ("p2", "Pa", "absolute pressure of chamber 2"),
           ("omega", "rad/s", "shaft speed of the pump"),
           ("x_measured", "m", "position as its sensor shows it: late, off its scale"),
           ("p1_measured", "Pa", "pressure 1 as its sensor shows it"),
           ("p2_measured", "Pa", "pressure 2 as its sensor shows it"),
           ("force", "N", "pressure force A1 p1 - A2 p2"))
# Numbers of the rig that age and heat change; the others are its geometry.
DRIFTING = ("viscous_damping", "bulk_modulus", "leakage", "makeup_conductance")
VR_X_START, VR_CLOSED, VR_OUTPUT, VR_PARAMETER = 10, 11, 100, 1000
_SI = {"m": {"m": 1}, "s": {"s": 1}, "kg": {"kg": 1}, "rad": {"rad": 1},
       "N": {"kg": 1, "m": 1, "s": -2}, "Pa": {"kg": 1, "m": -1, "s": -2}}


@dataclass(frozen=True)
class Variable:
    """A parameter: its name in the FMU, place in theta, unit, start, range, and if it may change.

    ``tunable`` : may be set while the simulation runs; another only before it.
    """

    name: str
    place: int
    unit: str
    description: str
    start: float
    lower: float | None
    upper: float | None
    tunable: bool


def parameters_of(model: Model, theta: np.ndarray) -> list[Variable]:
    """Return the rig's numbers and the parameters of the active effects of the catalogue."""
    found = []
    for place, key in BASE_KEYS.items():
        if place == K_POS and model.settings.rig.position_gain is None:
            continue
        field = Rig.model_fields[key]
        bounds = {name: getattr(one, name) for one in field.metadata
                  for name in ("gt", "ge") if hasattr(one, name)}
        found.append(Variable(key, place, field.json_schema_extra["unit"], field.description,
                              float(theta[place]), bounds.get("ge", bounds.get("gt")), None,
                              key in DRIFTING))
    for name in model.effects:
        for p in CATALOGUE[name].parameters:
            place = place_of(f"{name}.{p.name}")
            found.append(Variable(f"{name}.{p.name}", place, p.unit, p.description,
                                  float(theta[place]), p.lower, p.upper,
                                  p.fitted or p.default is None))
    return found


def plain(unit: str) -> str:
    """Return a unit in ASCII: ``N*s/m``, ``m^3/(s*Pa)``; empty where there is none."""
    text = unit.replace("·", "*").replace("²", "^2").replace("³", "^3")
    return "" if text == "1" else text


def exponents(unit: str) -> dict[str, int] | None:
    """Return the exponents of kg, m, s and rad in a plain unit; None where they are not whole."""
    above, _, below = unit.partition("/")
    found: dict[str, int] = {}
    for part, sign in ((above, 1), (below.strip("()"), -1)):
        for factor in filter(None, part.split("*")):
            name, _, power = factor.partition("^")
            if name == "1":
                continue
            if name not in _SI or "." in power:
                return None
            for base, exponent in _SI[name].items():
                found[base] = found.get(base, 0) + sign * exponent * int(power or 1)
    return {base: exponent for base, exponent in found.items() if exponent}


def description(model: Model, guid: str, identifier: str, start: float, parameters: list[Variable],
                lost: tuple[str, ...], units: Mapping[str, str]) -> bytes:
    """Return the XML file.

    Parameters
    ----------
    start : position at the start, m.
    units : unit of a linear rig -> that of this one.
    """
    rig = model.settings.rig
    root = ElementTree.Element("fmiModelDescription", {
        "fmiVersion": "2.0", "modelName": rig.name, "guid": guid,
        "description": f"Electrohydraulic actuator, from {model.source}; {model.provenance}",
        "generationTool": f"eha_monitor {__version__}",
        "variableNamingConvention": "structured", "numberOfEventIndicators": "0"})
    for line in lost:
        root.append(ElementTree.Comment(f" not in this FMU: {line.replace('--', '- -')} "))
    ElementTree.SubElement(root, "CoSimulation", {
        "modelIdentifier": identifier, "canHandleVariableCommunicationStepSize": "true",
        "canInterpolateInputs": "true", "maxOutputDerivativeOrder": "0",
        "canGetAndSetFMUstate": "true", "canSerializeFMUstate": "true",
        "canNotUseMemoryManagementFunctions": "true"})

    def unit_of(unit: str) -> str:
        return plain(units.get(unit, unit))

    used = {unit_of(unit) for _, unit, _ in (*INPUTS, *OUTPUTS)} | {
        unit_of(one.unit) for one in parameters}
    definitions = ElementTree.SubElement(root, "UnitDefinitions")
    for unit in sorted(used - {""}):
        whole = exponents(unit)
        one = ElementTree.SubElement(definitions, "Unit", {"name": unit})
        if whole is not None:
            ElementTree.SubElement(one, "BaseUnit", {k: str(n) for k, n in whole.items()})
    ElementTree.SubElement(root, "DefaultExperiment", {
        "startTime": "0", "stepSize": repr(rig.sample_time)})
    variables = ElementTree.SubElement(root, "ModelVariables")

    def real(name: str, vr: int, text: str, unit: str, start: float | None = None,
             bounds: tuple[float | None, float | None] = (None, None), **attributes: str) -> None:
        one = ElementTree.SubElement(variables, "ScalarVariable", {
            "name": name, "valueReference": str(vr), "description": text, **attributes})
        value = {"unit": unit_of(unit)} if unit_of(unit) else {}
        value |= {key: repr(float(bound)) for key, bound in zip(("min", "max"), bounds,
                                                                strict=True)
                  if bound is not None and np.isfinite(bound)}
        if start is not None:
            value["start"] = repr(float(start))
        ElementTree.SubElement(one, "Real", value)

    for vr, (name, unit, text) in enumerate(INPUTS):
        real(name, vr, text, unit, start if name == "x_d" else 0.0, causality="input",
             variability="continuous")
    real("x_start", VR_X_START, "position at the start, at rest", "m", start,
         causality="parameter", variability="fixed", initial="exact")
    loop = ElementTree.SubElement(variables, "ScalarVariable", {
        "name": "closed_loop", "valueReference": str(VR_CLOSED), "causality": "parameter",
        "variability": "fixed", "initial": "exact",
        "description": "true: the drive follows x_d; false: pump_speed turns the pump"})
    closed = rig.position_gain is not None
    ElementTree.SubElement(loop, "Boolean", {"start": str(closed).lower()})
    for i, one in enumerate(parameters):
        real(one.name, VR_PARAMETER + i, one.description, one.unit, one.start,
             (one.lower, one.upper), causality="parameter", initial="exact",
             variability="tunable" if one.tunable else "fixed")
    first = len(variables) + 1
    for i, (name, unit, text) in enumerate(OUTPUTS):
        real(name, VR_OUTPUT + i, text, unit, causality="output", variability="continuous",
             initial="calculated")
    structure = ElementTree.SubElement(root, "ModelStructure")
    for part in ("Outputs", "InitialUnknowns"):
        unknowns = ElementTree.SubElement(structure, part)
        for i in range(len(OUTPUTS)):
            ElementTree.SubElement(unknowns, "Unknown", {"index": str(first + i)})
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)


def safe(text: str) -> str:
    """Return a text without what XML does not allow."""
    return re.sub(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd]", "?", text)
