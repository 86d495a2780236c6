"""Numbers with units in configs: SI inside, ``"20 kg"`` or a plain SI number outside."""

import re
from collections.abc import Iterator
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo
from pydantic_core import PydanticCustomError

from eha_monitor.quantity import quantity

# Spelling for pint of the units that the configs name.
_PINT = {"1": "dimensionless", "N·s/m": "N*s/m", "m³": "m**3", "m²": "m**2",
         "m³/rad": "m**3/rad", "m³/(s·Pa)": "m**3/s/Pa", "rad/(s·m)": "rad/s/m",
         "°C": "degC", "1/K": "1/kelvin", "m/s²": "m/s**2", "m³/s": "m**3/s", "mm²/s": "mm**2/s",
         "kg·m²": "kg*m**2", "N·m·s/rad": "N*m*s/rad", "N·m/rad": "N*m/rad", "N·m": "N*m"}
# Units of the numbers of a rig that turns, by those of one that moves along a line.
TURNING = {"m": "rad", "m²": "m³/rad", "kg": "kg·m²", "N·s/m": "N·m·s/rad",
           "rad/(s·m)": "1/s", "N/m": "N·m/rad", "N": "N·m", "m/s": "rad/s",
           "m/s²": "rad/s²"}

_COMMA = re.compile(r"\d,\d")
_REV = re.compile(r"(?<=/)\s*rev\b")  # as pumps are sold: 1.6 cm^3/rev

# A number and a unit that says what it is counted from.
_ABOVE_VACUUM = re.compile(r"^(.*\d\s*(?:bar|mbar|kPa|MPa|Pa|psi))[\s_(]*"
                           r"(gauge|g|absolute|abs|a)\)?\s*$")
ATMOSPHERE = 101_325.0  # Pa; what a gauge pressure is counted from

LARGEST = 1e18  # no quantity of a rig in SI units is larger; squares stay finite


def to_si(value: Any, unit: str, absolute: bool = False) -> Any:
    """Return ``value`` in ``unit``: numbers pass, strings such as ``"68.5 cm^3"`` are converted.

    ``absolute``: it is a pressure above vacuum, and may be written as ``"15 bar gauge"``.

    Raises
    ------
    PydanticCustomError
        If the string is no quantity, or has another dimension.
    """
    if isinstance(value, bool):
        raise PydanticCustomError("number", f"expected a number in {unit}, got {value!r}")
    if isinstance(value, int | float) and abs(value) > LARGEST:
        raise PydanticCustomError("number",
                                  f"expected at most {LARGEST:g} in {unit}, got {value!r}")
    if not isinstance(value, str):
        return value
    if _COMMA.search(value):  # pint drops it: 85,5 would be 855
        raise PydanticCustomError("comma", f"expected a decimal point, such as '85.5 {unit}'")
    import pint  # slow to import, and needed only where a config writes units

    registry = pint.get_application_registry()
    zero = 0.0
    if absolute and (above := _ABOVE_VACUUM.match(value)):
        value, zero = above[1], ATMOSPHERE * above[2].casefold().startswith("g")
    value = _REV.sub("revolution", value)
    try:
        quantity = registry.Quantity(value)
        return float(quantity.to(_PINT.get(unit, unit)).magnitude) + zero
    except Exception as problem:  # pint raises a dozen kinds, all of them the user's value
        raise PydanticCustomError(
            "unit", f"expected a number in {unit}, got {value!r}"
        ) from problem


def Si(unit: str, description: str, *, optional: bool = False, absolute: bool = False,
       possible: tuple[float, float] | None = None, **bounds: float) -> Any:
    """Declare a config value: ``name: Si("kg", "moving mass", gt=0) = 20.0``.

    Returns an annotated type whose field carries unit, description and range, from which the
    documentation and the ROS parameter descriptors are made.  A rig that turns has those of
    ``TURNING``.  ``possible`` are the smallest and the largest size of any actuator, SI: a number
    alone beyond them has lost its unit (:mod:`eha_monitor.units`).
    ``absolute``: a pressure above vacuum, which may be written as one of a gauge.
    """
    extra = {"unit": unit} | ({"possible": possible} if possible else {})
    base = float | None if optional else float
    return Annotated[
        base,
        # The bounds come before the validator: so pydantic asks them of a number, not of None.
        Field(description=description, allow_inf_nan=False,
              json_schema_extra=extra, **bounds),
        BeforeValidator(lambda value, info: to_si(value, _of_motion(unit, info), absolute))]


def _of_motion(unit: str, info: ValidationInfo) -> str:
    """Return the unit; of a rig that its section (before) or the context says to turn, that."""
    motion = info.data.get("motion") or (info.context or {}).get("motion")
    return TURNING.get(unit, unit) if motion == "rotary" else unit


class Section(BaseModel):
    """A config section: frozen, and an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def unit_of(section: type[BaseModel], key: str) -> str:
    """Return the SI unit of a key of a section, or ""."""
    return (section.model_fields[key].json_schema_extra or {}).get("unit", "")


def keys_of(section: BaseModel, prefix: str = "") -> Iterator[tuple[str, Any, str, str]]:
    """Yield (key, value, unit, description) of a section and of those in it."""
    for key, about in type(section).model_fields.items():
        value, name = getattr(section, key), f"{prefix}{key}"
        if isinstance(value, BaseModel):
            yield from keys_of(value, f"{name}.")
        elif isinstance(value, dict) and value and all(
                isinstance(one, BaseModel) for one in value.values()):
            for inner, one in value.items():
                yield from keys_of(one, f"{name}.{inner}.")
        else:
            yield name, value, unit_of(type(section), key), about.description


# SI unit -> those that people type without saying so, the usual one first.
_TYPED = {"Pa": ("bar", "MPa", "kPa"), "m": ("mm", "cm"), "m²": ("cm^2", "mm^2"),
          "m³": ("cm^3", "l", "mm^3"), "m³/rad": ("cm^3/rev", "cm^3/rad"), "s": ("ms", "us"),
          "m/s": ("mm/s",), "m/s²": ("mm/s^2",), "m³/s": ("l/min", "ml/min"), "kg": ("g",),
          "m³/(s·Pa)": ("l/min/bar", "ml/min/bar")}
LONGEST, SHORTEST = 200.0, 1e-4  # m of oil column (rad of a rotary actuator), volume over area


def beyond(value: float, possible: tuple[float, float]) -> bool:
    """Tell whether a number is beyond any actuator's; zero is no oil, no leak, no source."""
    return bool(value) and not possible[0] <= abs(value) <= possible[1]


def lost_unit(key: str, value: float, unit: str, possible: tuple[float, float]) -> str:
    """Return in one line what a number alone was read as, and as what it makes sense.

    >>> lost_unit("rig.charge_pressure", 15, "Pa", (1e3, 1e8)).partition(":")[2]
    " 15 is read as 15 Pa, expected 1 kPa to 100 MPa: write '15 bar' (1.5 MPa), '15 MPa' (15 MPa),\
 or '15 Pa' if that is meant"
    """
    low, high = (quantity(one, unit) for one in possible)
    likely = [f"'{value:g} {one}' ({quantity(si, unit)})" for one in _TYPED.get(unit, ())
              if not beyond(si := to_si(f"{value!r} {one}", unit), possible)]
    forms = [*likely[:2], f"'{value:g} {plain(unit)}' if that is meant"]
    return (f"{key}: {value:g} is read as {value:g} {unit}, expected {low} to {high}: write "
            f"{', '.join(forms[:-1])}{', or ' * (len(forms) > 1)}{forms[-1]}")


def plain(unit: str) -> str:
    """Return a unit as a config takes it: ``m^3/(s*Pa)`` of m³/(s·Pa)."""
    return unit.replace("²", "^2").replace("³", "^3").replace("·", "*")


def lost_units(tree: dict, section_at) -> Iterator[str]:
    """Yield a line for each number alone in a config, as a person wrote it, that no actuator has.

    ``section_at`` returns the section at a path, or None.
    """
    rotary = isinstance(tree.get("rig"), dict) and tree["rig"].get("motion") == "rotary"
    for path, value in _numbers(tree, ()):
        section = section_at(path[:-1])
        field = section.model_fields.get(path[-1]) if section else None
        extra = field.json_schema_extra if field is not None else None
        possible = extra.get("possible") if isinstance(extra, dict) else None
        if possible and beyond(value, possible):
            unit = TURNING.get(extra["unit"], extra["unit"]) if rotary else extra["unit"]
            yield lost_unit(".".join(path), value, unit, possible)


def _numbers(tree: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], float]]:
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from _numbers(value, (*path, str(key)))
    elif isinstance(tree, (int, float)) and not isinstance(tree, bool):
        yield path, tree


def no_such_column(rig) -> str:
    """Return in words that a chamber's oil over its piston area is no column of oil, or ""."""
    for k in (1, 2):
        if f"volume_{k}" not in rig.model_fields_set:
            continue
        volume, area = getattr(rig, f"volume_{k}"), getattr(rig, f"area_{k}")
        if not volume or not area or SHORTEST <= volume / area <= LONGEST:
            continue
        turns = rig.motion == "rotary"
        return (f"rig.volume_{k}: {quantity(volume, 'm³')} over an area_{k} of "
                f"{quantity(area, 'm³/rad' if turns else 'm²')} is a column of oil of "
                f"{quantity(volume / area, 'rad' if turns else 'm', 3)}; a number alone is in m³, "
                "expected such as '68.5 cm^3'")
    return ""
