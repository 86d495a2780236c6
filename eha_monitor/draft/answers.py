"""What a person answers to ``init``, by ``--set`` or at the terminal: keys, units, choices."""

import difflib
import re
from dataclasses import dataclass
from math import pi

from pydantic_core import PydanticCustomError

from eha_monitor.errors import InputError
from eha_monitor.quantity import quantity
from eha_monitor.settings.channels import CHANNELS, unit_of
from eha_monitor.settings.rig import Rig
from eha_monitor.units import TURNING, beyond, to_si

# What a data sheet of a cylinder has, and the config's numbers follow from; unit, and words.
SHEET = {"bore": ("m", "bore of the cylinder"), "rod": ("m", "diameter of the rod"),
         "stroke": ("m", "stroke of the cylinder"),
         "line_volume": ("m³", "oil in the line to one chamber"),
         "inclination": ("rad", "inclination of the axis, positive if growing x lifts the load"),
         "spring": ("N/m", "stiffness of the spring that the load is"),
         "spring_rest": ("m", "what x reads where that spring is relaxed"),
         "check_valve": ("m³/(s·Pa)", "flow of a check valve at a pressure drop"),
         "check_valve_opens": ("Pa", "pressure drop at which a check valve opens"),
         "relief_valve": ("m³/(s·Pa)", "flow of a relief valve at a pressure beyond its setting"),
         "relief_pressure": ("Pa", "difference of the chambers' pressures at which a relief valve "
                             "opens"),
         "friction": ("N", "dry friction of seals and guides"),
         "drive_lag": ("s", "time constant of the drive's speed loop")}
# Answered as a flow at a pressure, as data sheets and test stands have it.
FLOWS = ("check_valve", "relief_valve", "leakage")
SIGNED = {"inclination": 0.5001 * pi, "spring_rest": 10.0}  # largest, either sign
# Smallest and largest of any actuator that turns or travels, SI, beside those of the config's own
# keys, and how a person writes one: what lies outside has lost its unit.
_POSSIBLE = {"bore": (1e-3, 2.0), "rod": (1e-3, 2.0), "stroke": (1e-4, 50.0),
             "line_volume": (1e-9, 1.0), "spring": (1.0, 1e12),
             "check_valve_opens": (1.0, 1e7), "relief_pressure": (1e4, 1e9),
             "friction": (1e-3, 1e7), "drive_lag": (1e-6, 10.0)}
_SUCH_AS = {"bore": "40 mm", "rod": "25 mm", "stroke": "200 mm", "line_volume": "10 cm^3",
            "area_1": "5.05 cm^2", "area_2": "5.05 cm^2", "volume_1": "68.5 cm^3",
            "volume_2": "68.5 cm^3", "mass": "20 kg", "pump_displacement": "1.6 cm^3/rev",
            "charge_pressure": "20 bar", "ambient_pressure": "1 bar",
            "leakage": "0.15 l/min at 100 bar", "check_valve": "9 l/min at 0.5 bar",
            "relief_valve": "20 l/min at 10 bar", "check_valve_opens": "0.3 bar",
            "relief_pressure": "180 bar", "friction": "120 N", "drive_lag": "2 ms",
            "makeup_conductance": "1e-13", "spring": "8000 N/m", "sample_time": "1 ms",
            "inclination": "20 deg", "spring_rest": "40 mm"}
# Questions with a few answers; the config's numbers, effects and units follow from them.
CHOICES = {
    "machine": ("double_rod", "two_pumps", "accumulator", "valve", "force"),
    "rods": ("1", "2"),
    "load": ("none", "gravity", "spring", "unknown"),
    "zero": ("middle", "retracted", "extended"),
    "pressures": ("absolute", "gauge"),
}
# Machine -> what it does not have: null in the config, and nobody is asked for it.
_OIL = ("stroke", "line_volume", "zero", "volume_1", "volume_2", "pump_displacement",
        "position_gain", "leakage", "makeup_conductance", "check_valve", "relief_valve",
        "drive_lag")
NOT_OF = {"valve": _OIL, "force": (*_OIL, "bore", "rod", "rods", "area_1", "area_2", "pressures",
                                   "charge_pressure"),
          "double_rod": ("rods",), "two_pumps": ("rods",), "accumulator": ("rods",)}
_PRESSURES = ("charge_pressure", "ambient_pressure")  # absolute in the config
_NULL = ("null", "none", "-")
_CHANNEL_KEYS = {"column": "", "unit": "", "scale": "1", "offset": "1", "full": "", "delay": "s"}
_FULL = re.compile(r"^(?:(?P<raw>[-+\d.e]+)\s*=\s*)?(?P<value>[-+\d.]+(?:e[-+]?\d+)?)"
                   r"\s*(?P<unit>\S.*)$", re.IGNORECASE)


@dataclass(frozen=True)
class Answers:
    """What was answered."""

    rig: dict[str, str]  # key of ``rig`` or of a data sheet -> text as given
    channels: dict[str, dict[str, str]]  # channel or ``time`` -> key -> text

    def number(self, key: str) -> float | None:
        """Return an answer in SI, or None where there is none, or where it is ``null``."""
        text = self.rig.get(key)
        if text is None or text.casefold() in _NULL:
            return None
        return checked(key, text)

    def none(self, key: str) -> bool:
        """Tell whether it was answered that there is none."""
        return self.rig.get(key, "").casefold() in _NULL

    def middle(self) -> float | None:
        """Return the reading of x in the middle of the stroke, m, where that was answered."""
        return self.number("zero") if "zero" in self.rig else None

    def rods(self) -> str:
        """Return how many sides have a rod, as answered or as the machine has it."""
        return self.rig.get("rods", "2" if self.rig.get("machine") == "double_rod" else "1")

    def turns(self, angles: bool) -> bool:
        """Tell whether the actuator is a rotary one, as answered or as the columns are."""
        return self.rig.get("motion", "rotary" if angles else "linear") == "rotary"

    def lacks(self, key: str) -> bool:
        """Tell whether the machine that was answered has no such number."""
        return key not in self.rig and key in NOT_OF.get(self.rig.get("machine", ""), ())

    def columns(self) -> dict[str, str]:
        """Return channel -> column that was named."""
        return {name: keys["column"] for name, keys in self.channels.items() if "column" in keys}


def answers_of(given: tuple[str, ...]) -> Answers:
    """Return the answers of ``--set`` options.

    Raises InputError, one line that names the option and what was expected.
    """
    rig: dict[str, str] = {}
    channels: dict[str, dict[str, str]] = {}
    for one in given:
        key, equals, value = one.partition("=")
        key, value = key.strip(), value.strip()
        if not equals or not value:
            raise InputError(f"--set {one}: expected KEY=VALUE, such as rig.area_1='5.05 cm^2'")
        key = key.removeprefix("table.columns.").removeprefix("channels.").removeprefix("table.")
        name, _, part = key.partition(".")
        if name in (*CHANNELS, "time"):
            part = part or "column"
            if part not in _CHANNEL_KEYS:
                raise InputError(f"--set {one}: expected {name}.{' or '.join(_CHANNEL_KEYS)}")
            if _CHANNEL_KEYS[part]:
                of_channel(f"{name}.{part}", value, _CHANNEL_KEYS[part])
            channels.setdefault(name, {})[part] = value
            continue
        key = key.removeprefix("rig.")
        rig[key] = value
        checked(key, rig[key])
    answers = Answers(rig, channels)
    bore, rod = answers.number("bore"), answers.number("rod")
    if bore is not None and rod is not None and not rod < bore:
        raise InputError(f"--set rod={rig['rod']}: expected a rod thinner than the bore of "
                         f"{rig['bore']}")
    return answers


def of_channel(key: str, text: str, unit: str) -> float | None:
    """Return a number that was answered for a channel, ``x.delay``, in SI."""
    return None if text.casefold() in _NULL else to_si_of(key, text, unit, key)


def checked(key: str, text: str) -> float | None:
    """Return an answer in SI.

    Raises InputError if there is no such key, or it is no such quantity.
    """
    known = [*CHOICES, *SHEET, *Rig.model_fields]
    if key not in known:
        close = difflib.get_close_matches(key, known, 1)
        hint = f"did you mean rig.{close[0]}?" if close else (
            f"expected a channel (x.unit, p1.column, ...) or rig.<{', '.join(known)}>")
        raise InputError(f"--set {key}: unknown key, {hint}")
    if key == "zero" and text not in CHOICES[key] and text[:1] in "+-.0123456789":
        return to_si_of(key, text, "m", "the reading of x in the middle of the stroke")
    if key in CHOICES and text not in CHOICES[key]:
        more = {"rods": " (a rod on both sides)",
                "zero": ", or the reading of x in the middle of the stroke, such as '137 mm'"
                }.get(key, "")
        raise InputError(f"--set {key}: expected {' or '.join(CHOICES[key])}{more}, got '{text}'")
    if key in ("name", "motion", *CHOICES) or text.casefold() in _NULL:
        return None
    of_rig = {} if key in SHEET else Rig.model_fields[key].json_schema_extra or {}
    si, words = SHEET[key] if key in SHEET else (
        of_rig.get("unit", "1"), Rig.model_fields[key].description)
    if key in FLOWS and (passed := flow_at(key, text)):
        flow, drop = passed
        return flow / drop * (2.0 if key == "leakage" else 1.0)  # C_T is of half a difference
    if key == "drive_lag" and text.casefold().endswith("hz"):  # a bandwidth
        text = f"{1.0 / (2.0 * pi * max(to_si_of(key, text, 'Hz', words), 1e-9)):.4g} s"
    number = to_si_of(key, text, si, words, key in _PRESSURES)
    if key in SIGNED:
        if not abs(number) <= SIGNED[key]:
            raise InputError(f"--set {key}: expected {words}, at most {SIGNED[key]:.3g} {si}, "
                             f"such as '{_SUCH_AS[key]}', got '{text}'")
    elif not number >= 0:
        raise InputError(f"--set {key}: expected at least 0 {si}, got '{text}'")
    possible = _POSSIBLE.get(key) or of_rig.get("possible")
    if possible and beyond(number, possible):
        low, high = (quantity(one, si) for one in possible)
        such_as = f", such as '{_SUCH_AS[key]}'" if key in _SUCH_AS else ""
        unit_lost = f"; a number alone is in {si}" if _alone(text) else ""
        raise InputError(f"--set {key}: expected {words.partition(';')[0]} from {low} to {high}"
                         f"{such_as}, got '{text}'{unit_lost}")
    return number


def flow_at(key: str, text: str) -> tuple[float, float] | None:
    """Return flow (m³/s) and pressure (Pa) of ``9 l/min at 0.5 bar``; None of a leakage alone.

    Raises InputError if one of them is no such quantity, or not above 0.
    """
    flow, at, drop = (part.strip() for part in text.partition(" at "))
    if not at and key == "leakage":
        return None
    wanted = InputError(f"--set {key}: expected a flow at a pressure, both with their units, such "
                        f"as '{_SUCH_AS[key]}', got '{text}'")
    if not at or _alone(flow) or _alone(drop):
        raise wanted
    found = (to_si_of(key, flow, "m³/s", "a flow"), to_si_of(key, drop, "Pa", "a pressure"))
    if not (found[0] >= 0.0 and found[1] > 0.0):
        raise wanted
    return found


def _alone(text: str) -> bool:
    """Tell whether a text is a number without a unit."""
    try:
        float(text)
        return True
    except ValueError:
        return False


def to_si_of(key: str, text: str, unit: str, words: str, absolute: bool = False) -> float:
    """Return an answer in SI, of a number or of a number with a unit.

    What an angle is of was not read yet: the unit of a rig that turns is as good, and the config
    refuses the wrong one.  Raises InputError if it is neither.
    """
    try:
        return float(text)
    except ValueError:
        turning = TURNING.get(unit, unit)
        for one in (unit, turning):
            try:
                return to_si(text, one, absolute)
            except PydanticCustomError:
                continue
        either = f" (of a rotary actuator {turning})" if turning != unit else ""
        raise InputError(f"--set {key}: expected {words} in {unit}{either}, or with a unit, got "
                         f"'{text}'") from None


def full_scale(channel: str, text: str, kind: str) -> tuple[str, float]:
    """Return unit and scale of ``80 mm`` (at 100 %) or ``27648 = 250 bar`` (counts).

    Raises InputError if it is neither.
    """
    match = _FULL.match(text.replace(",", "."))
    raw = None
    if match:
        raw = float(match["raw"]) if match["raw"] else (100.0 if kind == "share" else None)
    if not raw:
        example = "'80 mm', which is 100 %" if kind == "share" else "'27648 = 250 bar'"
        raise InputError(f"--set {channel}.full: expected how much is the full scale, such as "
                         f"{example}, got '{text}'")
    try:
        unit_of(match["unit"])
    except ValueError as problem:
        raise InputError(f"--set {channel}.full: {problem}") from None
    return match["unit"], float(f"{float(match['value']) / raw:.10g}")
