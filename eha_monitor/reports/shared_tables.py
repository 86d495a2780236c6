"""Tables that several pages have: the indicators of health, and the config in words."""

from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import BaseModel

from eha_monitor.indicators import indicator
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.own_term import ADDED_UNITS
from eha_monitor.quantity import number, quantity
from eha_monitor.reports.page import Cell, Table, table
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import effect_words

_SECTIONS = ("rig", "noise", "stage_one", "stage_two", "thresholds", "viscosity", "health")
_GENERAL = ("discretisation", "command_hold")
_THRESHOLD_UNITS = {"viscous_damping": "N·s/m", "bulk_modulus": "Pa"}


def indicator_table(indicators: Sequence[Indicator], settings: Settings) -> Table | None:
    """Return the indicators with their limits, those without a value last; None without any."""
    if not indicators:
        return None
    last = [one for one in indicators if one.status in (indicator.NEEDS, indicator.NONE)
            or one.message == indicator.NOT_LOOKED_FOR]
    first = [one for one in indicators if one not in last]
    rows = tuple(
        (Cell(one.words, title=one.law),
         Cell(one.shown, "value", exact=(one.value, one.stddev)
              if one.status == indicator.AVAILABLE else None),
         Cell(_limit_words(one, settings), "number", level="ERROR",
              badge="beyond its limit" if indicator.passed(one, settings) else ""),
         Cell(one.message, "message")) for one in (*first, *last))
    shown = len(first) or len(rows)
    return Table(("indicator", "value", "limit", "conditions, or why there is no value"),
                 rows[:shown], "indicators", "", rows[shown:])


def law_table(indicators: Sequence[Indicator]) -> Table:
    """Return the equation of each indicator."""
    return table("indicator | equation, and its limits",
                 [(one.words, one.law) for one in indicators], " | message")


def _limit_words(one: Indicator, settings: Settings) -> str:
    """Return the limits of an indicator, ``below 50 mL/min``, or ``not set``."""
    low, high = indicator.limits_of_indicator(one.name, settings)
    parts = [f"{words} {number(limit, 3)} {one.unit}"
             for words, limit in (("above", low), ("below", high)) if limit is not None]
    return ", ".join(parts) or "not set"


def config_tables(settings: Settings) -> list[tuple[str, Table]]:
    """Return the values of the config, in words: title and table of each section."""
    def titled(title: str, rows: Iterator | list) -> tuple[str, Table]:
        return title, table("key | value | what it is", list(rows), " | number | note")

    found = [titled(f"{_plain(key).capitalize()}: {Settings.model_fields[key].description or ''}",
                    _config_rows(getattr(settings, key))) for key in _SECTIONS]
    found.append(titled("Equations", [
        (_plain(key), str(getattr(settings, key)), Settings.model_fields[key].description or "")
        for key in _GENERAL]))
    terms = [(f"{effect_words(effect)}, {p.name}", quantity(values[p.name], p.unit, 6),
              p.description)
             for effect, values in settings.effects.items() if effect in CATALOGUE
             for p in CATALOGUE[effect].parameters if p.name in values]
    terms += [_own_row(name, values) for name, values in settings.effects.items()
              if name not in CATALOGUE]
    if terms:
        found.append(titled("Effects beyond the linear model", terms))
    return found


def _own_row(name: str, values: dict) -> tuple[str, str, str]:
    """Return the row of a term of the rig's own."""
    if "expression" in values:
        with_ = ", ".join(f"{key} = {value:g}" for key, value in values.items()
                          if key not in ("adds", "expression"))
        text = f"{values['expression']}{f' with {with_}' if with_ else ''}"
    else:
        text = (f"{len(values['values'])} values over {values['of']}, {values['first']:g} to "
                f"{values['last']:g}")
    return (_plain(name), text, f"user-defined term, adds to the {values['adds']} in "
                                f"{ADDED_UNITS[values['adds']]}")


def _plain(key: str) -> str:
    return key.replace("_", " ").replace(".", ", ")


def _config_rows(section: BaseModel, prefix: str = "", unit: str = ""
                 ) -> Iterator[tuple[str, str, str]]:
    for key, declared in type(section).model_fields.items():
        value = getattr(section, key)
        own = (declared.json_schema_extra or {}).get("unit", "") \
            if isinstance(declared.json_schema_extra, dict) else ""
        if isinstance(value, BaseModel):
            yield from _config_rows(value, f"{prefix}{key}.", _THRESHOLD_UNITS.get(key, ""))
            continue
        if unit and own == "1" and key.endswith(("warn", "error")):
            own = unit
        yield _plain(prefix + key), _config_value(value, own), declared.description or ""


def _config_value(value: Any, unit: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return quantity(float(value), unit, 6)
    return "not set" if value is None else str(value)
