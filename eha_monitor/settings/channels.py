"""The channels: what they mean, and where and in which unit they come (topics, columns).

SI value = factor * (scale * raw + offset) + zero.  ``factor`` and ``zero`` are the unit's
(``unit: mm``, ``bar``, ``bar gauge``, ``rpm``); ``scale`` and ``offset`` make of the raw number a
number in that unit, so that a transducer's sheet ("4095 counts are 250 bar") is written as it
stands.  Without a unit they give SI.
"""

import re
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field, field_validator

from eha_monitor.units import ATMOSPHERE, Section, Si

_ABSOLUTE = "absolute (above vacuum), not gauge; of a gauge sensor: unit bar gauge"
# Every channel there can be, in the order in which tables show them: SI unit and meaning.
_MEANING = {"x": ("m", "piston position"), "v": ("m/s", "piston velocity"),
            "x_d": ("m", "demanded position"), "omega": ("rad/s", "pump speed"),
            "omega_d": ("rad/s", "demanded pump speed"),
            "p1": ("Pa", f"pressure of chamber 1, {_ABSOLUTE}"),
            "p2": ("Pa", f"pressure of chamber 2, {_ABSOLUTE}"),
            "force": ("N", "force that drives the piston, if measured"),
            "temperature": ("°C", "oil temperature")}
CHANNELS = tuple(_MEANING)
CHANNEL_WORDS = {name: words.partition(",")[0] for name, (_, words) in _MEANING.items()}
CHANNEL_UNITS = {name: unit for name, (unit, _) in _MEANING.items()}
CHANNEL_ABOUT = {name: f"[{unit}] {words}" for name, (unit, words) in _MEANING.items()}

# Spellings of headers and data sheets, in several languages, for pint.  "1/min" of a shaft are
# revolutions, which pint would take for radians.
_SPELT = {
    "revolution/minute": ("rpm", "1/min", "min-1", "min^-1", "u/min", "upm", "umin", "r/min",
                          "rev/min", "tr/min", "t/min", "giri/min"),
    "revolution/second": ("rps", "rev/s", "u/s", "r/s", "tr/s"),
    "degree": ("°", "deg", "degree", "degrees", "grad", "grd"),
    "degree/second": ("°/s", "deg/s", "grad/s"),
    "degC": ("°c", "c", "degc", "celsius", "grad c"), "degF": ("°f", "f", "degf"),
    "micrometer": ("µm", "μm", "um", "micron", "microns"),
    "inch": ("in", "inch", "inches", '"', "zoll"),
    "newton*meter": ("nm", "n·m", "n.m", "n m", "n*m"),
    "kgf/centimeter**2": ("kp/cm2", "kp/cm²", "kgf/cm2", "kgf/cm²", "kg/cm2", "kg/cm²"),
    "kgf": ("kp", "kgf"),
    "millimeter": ("mm",), "centimeter": ("cm",), "meter": ("m",), "bar": ("bar",),
    "millibar": ("mbar",), "psi": ("psi",), "kilopascal": ("kpa",), "hectopascal": ("hpa",),
    "pascal": ("pa",), "newton": ("n",), "kilonewton": ("kn",), "millimeter/second": ("mm/s",),
    "meter/second": ("m/s",), "radian/second": ("rad/s",), "radian": ("rad",),
}
_ALIASES = {word: unit for unit, words in _SPELT.items() for word in words}
_PRESSURES = ("bar", "millibar", "psi", "pascal", "hectopascal", "kilopascal", "megapascal",
              "kgf/centimeter**2")
# What differs by a capital alone stands as it is written: MPa is no mPa.
_EXACT = {"MPa": "megapascal", "mPa": "millipascal", "Nm": "newton*meter", "nm": "nanometer",
          "kNm": "kilonewton*meter", "mNm": "millinewton*meter", "K": "kelvin"}
_OVER = re.compile(r"^(?P<unit>.*?[^\s_(])[\s_]*\(?(?P<over>gauge|g|rel|relative|ü|absolute|abs|"
                   r"a)\)?$")
_WORD = re.compile(r"[A-Za-zµμΩ°][\w°*/^(). -]*")
_GAUGE = ("gauge", "g", "rel", "relative", "ü")
_SHARES = ("%", "percent", "per cent", "count", "counts", "ppm")
# Quantity -> a unit of it for pint, an example for people.
_LENGTH, _SPEED = ("meter", "a length such as mm"), ("meter/second", "a speed such as mm/s")
_TURNING = ("radian/second", "a speed of rotation such as rpm")
_ANGLE = ("radian", "an angle such as deg")
LINEAR = {"x": _LENGTH, "x_d": _LENGTH, "v": _SPEED, "omega": _TURNING, "omega_d": _TURNING,
          "p1": ("pascal", "a pressure such as bar or bar gauge"),
          "p2": ("pascal", "a pressure such as bar or bar gauge"),
          "force": ("newton", "a force such as kN"),
          "temperature": ("degC", "a temperature such as degC")}
ROTARY = LINEAR | {"x": _ANGLE, "x_d": _ANGLE, "v": _TURNING,
                   "force": ("newton*meter", "a torque such as N*m")}


@dataclass(frozen=True)
class Unit:
    """A unit: SI value = factor * number + zero; ``si`` is pint's name of the SI unit."""

    factor: float
    zero: float
    si: str


NO_UNIT = Unit(1.0, 0.0, "")


@cache
def unit_of(text: str) -> Unit:
    """Return what a unit makes of its numbers; "" leaves them as they are.

    Raises ValueError if it is no unit, or one that is read in two ways.
    """
    if not text:
        return NO_UNIT
    import pint  # slow to import, and needed only where a map names units
    registry = pint.get_application_registry()
    if text.strip().casefold() in _SHARES:
        raise ValueError("per cent of full scale is not a unit: give the unit of the full scale, "
                         "and full scale over raw value as scale")
    if text.strip() in ("Hz", "1/s", "s-1", "s^-1"):
        raise ValueError(f"{text!r} may be revolutions or radians: write rev/s or rad/s")
    name, zero = _parted(text.strip())
    try:
        if not _WORD.fullmatch(name):
            raise ValueError("pint would leave out what it does not know")
        two = [registry.Quantity(number, name) for number in (0.0, 1.0)]
        si = "degC" if two[0].check("[temperature]") else str(two[1].to_base_units().units)
        low, high = (float(one.to(si).magnitude) for one in two)
    except Exception as problem:  # pint raises a dozen kinds, all of them the user's value
        raise ValueError(f"unknown unit: {text!r}") from problem
    return Unit(high - low, low + zero, si)


def counted_from(unit: str) -> str:
    """Return what a unit of pressure says it is counted from: gauge, absolute, or "" (nothing)."""
    match = None if _ALIASES.get(unit.strip().casefold()) else _OVER.match(unit.strip())
    if not match or not {match["unit"], match["unit"].casefold()} & {*_ALIASES, *_EXACT}:
        return ""
    return "gauge" if match["over"] in _GAUGE else "absolute"


def _parted(text: str) -> tuple[str, float]:
    """Return pint's name of a unit, and what a gauge pressure in it begins at, Pa."""
    known = _EXACT.get(text) or _ALIASES.get(text.casefold())
    if known:
        return known, 0.0
    match = _OVER.match(text)
    if match:
        unit = _EXACT.get(match["unit"]) or _ALIASES.get(match["unit"].casefold())
        if unit in _PRESSURES:
            return unit, ATMOSPHERE if match["over"] in _GAUGE else 0.0
    return text.replace("·", "*").replace("²", "**2").replace("³", "**3"), 0.0


def check_unit(channel: str, unit: str, rotary: bool) -> None:
    """Refuse a unit that is none of this channel's quantity.

    Raises ValueError, with what was expected.
    """
    if not unit:
        return
    import pint
    wanted, words = (ROTARY if rotary else LINEAR)[channel]
    try:
        found = unit_of(unit)
    except ValueError as problem:
        raise ValueError(f"expected {words}, got {unit!r}: {problem}") from None
    registry = pint.get_application_registry()
    own = registry.Quantity(1.0, wanted)
    if not registry.Quantity(1.0, found.si).check(own.dimensionality):
        raise ValueError(f"expected {words}, got {unit!r}")


class Measured:
    """A channel with ``unit``, ``scale`` and ``offset``: SI value = gain * raw + zero."""

    @property
    def gain(self) -> float:
        """SI units per raw unit."""
        return unit_of(self.unit).factor * self.scale if self.unit else self.scale

    @property
    def zero(self) -> float:
        """SI value at raw zero."""
        unit = unit_of(self.unit)
        return unit.factor * self.offset + unit.zero if self.unit else self.offset

    def in_si(self, raw: np.ndarray) -> np.ndarray:
        """Return raw numbers in SI, (n,); what no number holds becomes infinite."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self.gain * raw + self.zero


def _name(value):
    """Take an index as text, so that a column is always named in one way."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


class Column(Section, Measured):
    """One column of a table: scale * cell + offset is in ``unit``, taken ``delay`` earlier."""

    column: Annotated[str, BeforeValidator(_name)] = Field(
        min_length=1, description="CSV: name or index from 0; MAT: variable, or variable[:,k]")
    unit: str = Field("", description="unit of the cells, such as mm, rpm, bar, bar gauge; "
                      "empty: SI")
    scale: float = Field(1.0, allow_inf_nan=False, description="of unit, per unit of the file")
    offset: float = Field(0.0, allow_inf_nan=False, description="in unit, at zero of the file")
    negative_scale: float | None = Field(
        None, allow_inf_nan=False, description="scale of cells below zero, if different: a pump "
                                               "whose valves switch it from one piston area to "
                                               "the other")
    delay: Si("s", "delay of the row relative to the quantity", possible=(1e-9, 2.0)) = 0.0
    time: Annotated[str, BeforeValidator(_name)] = Field(
        "", description="column of its own clock, where a logger writes one beside each signal; "
                        "without it, table.time")
    time_scale: Si("s", "seconds per unit of its own clock; without it, table.time_scale", gt=0,
                   optional=True) = None

    @property
    def negative_gain(self) -> float:
        """SI units per unit of the file, of cells below zero."""
        if self.negative_scale is None:
            return self.gain
        return unit_of(self.unit).factor * self.negative_scale


class Table(Section):
    """A table of a recording, as other makers write it."""

    kind: Literal["auto", "csv", "mat"] = Field(
        "auto", description="auto: from the file extension")
    delimiter: Literal["auto", ",", ";", "tab", "space"] = Field(
        "auto", description="between the cells of a CSV")
    header: Literal["auto", "present", "absent"] = Field(
        "auto", description="whether the first row of a CSV names the columns")
    skip_rows: int = Field(0, ge=0, le=100_000,
                           description="lines of a CSV above the row of names")
    time: Annotated[str, BeforeValidator(_name)] = Field(
        "", description="column of the time; without it, rows are rig.sample_time apart")
    time_scale: Si("s", "seconds per unit of the time column", gt=0) = 1.0
    columns: dict[Literal[CHANNELS], Column] = Field(
        {}, description="channel <- column, by channel")

    def clock_of(self, column: Column) -> tuple[str, float]:
        """Return the column of the time of a channel, "" without one, and s per unit of it."""
        return column.time or self.time, column.time_scale or self.time_scale

    @property
    def clocks(self) -> tuple[str, ...]:
        """The columns that hold a time."""
        named = (self.time, *(column.time for column in self.columns.values()))
        return tuple(dict.fromkeys(filter(None, named)))


class Channel(Section, Measured):
    """Where a channel comes from: scale * raw + offset is in ``unit``, taken ``delay`` earlier."""

    topic: str = Field("", description="topic (relative names get the namespace) or, for an "
                       "import, unused")
    name: str = Field("", description="entry of a JointState, or column of an imported table")
    field: str = Field("", description="message field, e.g. position, velocity, effort, "
                       "fluid_pressure, temperature, data")
    unit: str = Field("", description="unit of scale * raw + offset, such as mm, rpm, bar, bar "
                      "gauge; empty: SI")
    scale: float = Field(1.0, allow_inf_nan=False, description="of unit, per raw unit, not 0")
    offset: float = Field(0.0, allow_inf_nan=False, description="in unit, at raw zero")
    delay: Si("s", "delay of the stamp relative to the quantity", possible=(1e-9, 2.0)) = 0.0

    @field_validator("scale")
    @classmethod
    def _not_zero(cls, value):
        if value == 0:
            raise ValueError("expected a number other than 0")
        return value


DEFAULT_CHANNELS = {
    "x": Channel(topic="joint_states", name="piston", field="position"),
    "v": Channel(topic="joint_states", name="piston", field="velocity"),
    "force": Channel(topic="joint_states", name="piston", field="effort"),
    "omega": Channel(topic="joint_states", name="pump", field="velocity"),
    "x_d": Channel(topic="command", name="piston", field="position"),
    "omega_d": Channel(topic="command", name="pump", field="velocity"),
    "p1": Channel(topic="pressure/chamber_1", field="fluid_pressure"),
    "p2": Channel(topic="pressure/chamber_2", field="fluid_pressure"),
    "temperature": Channel(topic="temperature", field="temperature"),
}


def fill_channels(given):
    """Fill in what a ``channels`` section leaves out, channel by channel and key by key.

    A topic of its own has messages of its own: of them only the field of a pressure or a
    temperature is known, which such a message has once.  Where the position is another entry
    than the default's, the default's entry has no other channel either; what is null, or has an
    empty topic, is not there.
    """
    if not isinstance(given, dict):
        return given
    absent = {name for name, channel in given.items()
              if channel is None or channel in ({"topic": ""}, {"topic": None})}
    place = given.get("x")
    if isinstance(place, dict) and place.get("name", DEFAULT_CHANNELS["x"].name) != (
            DEFAULT_CHANNELS["x"].name):
        absent |= {"v", "force"} - given.keys()
    given = {name: channel for name, channel in given.items() if name not in absent}
    filled = {name: channel.model_dump() for name, channel in DEFAULT_CHANNELS.items()
              if name not in absent}
    for name, channel in given.items():
        if isinstance(channel, dict) and name in filled and (
                "topic" not in channel or not filled[name]["name"]):
            channel = {**filled[name], **channel}
        filled[name] = channel
    return filled
