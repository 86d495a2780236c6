"""Numbers alone that no rig has, in a config written by hand: bar for Pa, mm for m, cm³ for m³.

They are refused and not warned of.  A config decides every answer of every command, the monitor's
too, whose log nobody reads; and ``init`` refuses the same number.  Whoever means it writes the
unit beside it (``15 Pa``), and it is taken as it stands.
"""

from collections.abc import Iterator
from typing import Any

from eha_monitor.quantity import quantity
from eha_monitor.units import TURNING, to_si

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
    """Yield a line for each number alone that no actuator has.

    Parameters
    ----------
    tree : what a person wrote, by section.
    section_at : path -> the section there, or None.
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
