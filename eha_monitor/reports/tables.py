"""Rows of the report's tables, in words and readable units; plain data for the template."""

import math
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import numpy as np
from pydantic import BaseModel

from eha_monitor.estimation.results import Estimate, JointResult, ParameterEstimate
from eha_monitor.health.alarms import Alarm
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.own_term import ADDED_UNITS
from eha_monitor.quantity import FLOOR, SYMBOLS, number, quantity, share
from eha_monitor.reports.alarm_timeline import alarm_words
from eha_monitor.reports.parameter_figures import NAMES, limits_in_words
from eha_monitor.reports.verdict import STATUS_WORDS
from eha_monitor.settings.channels import CHANNEL_UNITS
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import effect_words

CHANNEL_WORDS = {"x": "position x", "v": "velocity v", "x_d": "demanded position x_d",
                 "omega": "pump speed ω", "p1": "pressure p₁", "p2": "pressure p₂",
                 "force": "force", "temperature": "temperature"}
_ROTARY_UNITS = {"m": "rad", "m/s": "rad/s", "N": "N·m"}


def parameter_row(estimate: ParameterEstimate) -> dict[str, Any]:
    """Return the row of one parameter; ``value`` and ``stddev`` stay exact SI numbers."""
    return {"name": NAMES.get(estimate.name, estimate.name),
            "symbol": SYMBOLS.get(estimate.name, estimate.name),
            "value": None if not math.isfinite(estimate.value) else float(estimate.value),
            "stddev": None if not math.isfinite(estimate.stddev) else float(estimate.stddev),
            "unit": estimate.unit,
            "shown": estimate.shown,
            "status": estimate.status,
            "status_words": STATUS_WORDS.get(estimate.status, estimate.status),
            "message": estimate.message}


def parameter_rows(estimate: Estimate) -> list[dict[str, Any]]:
    """Return the rows of B and beta_e with the limits that judge them."""
    thresholds = estimate.settings.thresholds
    limits = {"B": thresholds.viscous_damping, "beta_e": thresholds.bulk_modulus}
    return [parameter_row(p) | {"limits": limits_in_words(limits[name], p.unit)}
            for name, p in estimate.parameters.items()]


def joint_table(joint: JointResult | None) -> dict[str, Any] | None:
    """Return parameters and correlations of the joint estimator, or None."""
    if joint is None:
        return None
    correlation = np.asarray(joint.correlation, dtype=float)
    names = list(joint.parameters)
    strong = [f"{SYMBOLS.get(names[i], names[i])} and {SYMBOLS.get(names[j], names[j])}"
              for i in range(len(names)) for j in range(i)
              if max(i, j) < len(correlation) and abs(correlation[i, j]) > 0.9]
    return {"rows": [parameter_row(p) for p in joint.parameters.values()],
            "symbols": [SYMBOLS.get(name, name) for name in names],
            "correlation": [[{"text": f"{v:+.2f}".replace("-", "−") if math.isfinite(v) else "—",
                              "strong": i != j and abs(v) > 0.9}
                             for j, v in enumerate(row)] for i, row in enumerate(correlation)],
            "strong": strong, "message": joint.message}


def observability_table(table: Any, recording: Any) -> dict[str, Any] | None:
    """Return the observability of channel combinations, or None.

    Parameters
    ----------
    table : has ``rows``, each with ``channels`` and ``relative_stddev`` (name -> ratio).
    recording : its channels mark the rows that this recording can answer.
    """
    if table is None or not table.rows:
        return None
    names = list(dict.fromkeys(name for row in table.rows for name in row.relative_stddev))
    rows = [{"channels": ", ".join(row.channels),
             "here": recording.has(*row.channels) if row.channels else False,
             "cells": [_relative(row.relative_stddev.get(name)) for name in names]}
            for row in table.rows]
    return {"symbols": [SYMBOLS.get(name, name) for name in names], "rows": rows,
            "mixed": not all(row["here"] for row in rows),
            "message": getattr(table, "message", "")}


def _relative(ratio: float | None) -> dict[str, str]:
    """Return the text and the class of a relative standard deviation."""
    if ratio is None or not math.isfinite(ratio):
        return {"text": "not observable", "kind": "none"}
    kind = "good" if ratio <= 0.05 else "fair" if ratio <= 0.5 else "poor"
    text = f"± {share(ratio, 2)}" if ratio > FLOOR else f"below ± {share(FLOOR)}"
    return {"text": text, "kind": kind}


def noise_rows(estimate: Estimate) -> list[dict[str, str]]:
    """Return the noise level of each channel and where it comes from."""
    rotary = estimate.settings.rig.motion == "rotary"
    rows = []
    for name, noise in estimate.noise.items():
        unit = CHANNEL_UNITS.get(name, "")
        unit = _ROTARY_UNITS.get(unit, unit) if rotary else unit
        rows.append({"channel": CHANNEL_WORDS.get(name, name),
                     "level": quantity(noise.value, unit, 3),
                     "source": "measured from this recording" if noise.measured
                     else "taken from the config"})
    return rows


def alarm_rows(alarms: tuple[Alarm, ...]) -> list[dict[str, str]]:
    """Return one row for each alarm, or for each change of one."""
    return [{"name": alarm_words(a.name), "level": a.word, "message": a.message,
             "time": seconds(a.time_s)} for a in alarms]


def seconds(time_s: float) -> str:
    """Return a time of the recording to hundredths, so that columns of them can be compared."""
    return f"{time_s:.2f} s" if math.isfinite(time_s) else "—"


def config_sections(settings: Settings) -> list[dict[str, Any]]:
    """Return the values of the config that shaped this estimate, in words, section by section."""
    found = []
    for key in ("rig", "noise", "stage_one", "stage_two", "thresholds", "viscosity",
                "health"):
        about = Settings.model_fields[key].description or ""
        found.append({"name": key, "title": f"{_plain(key).capitalize()}: {about}",
                      "rows": list(_config_rows(getattr(settings, key)))})
    found.append({"name": "general", "title": "Equations", "rows": [
        {"key": _plain(key), "value": str(getattr(settings, key)),
         "description": Settings.model_fields[key].description or ""}
        for key in ("discretisation", "command_hold")]})
    known = [{"key": f"{effect_words(effect)}, {p.name}",
              "value": quantity(values[p.name], p.unit, 6), "description": p.description}
             for effect, values in settings.effects.items() if effect in CATALOGUE
             for p in CATALOGUE[effect].parameters if p.name in values]
    known += [_own_row(name, values) for name, values in settings.effects.items()
              if name not in CATALOGUE]
    if known:
        found.append({"name": "effects", "title": "Effects beyond the linear model",
                      "rows": known})
    return found


def _own_row(name: str, values: dict) -> dict[str, str]:
    """Return the row of a term of the rig's own."""
    unit = ADDED_UNITS[values["adds"]]
    if "expression" in values:
        with_ = ", ".join(f"{key} = {value:g}" for key, value in values.items()
                          if key not in ("adds", "expression"))
        text = f"{values['expression']}{f' with {with_}' if with_ else ''}"
    else:
        text = (f"{len(values['values'])} values over {values['of']}, {values['first']:g} to "
                f"{values['last']:g}")
    return {"key": _plain(name), "value": text,
            "description": f"user-defined term, adds to the {values['adds']} in {unit}"}


def _plain(key: str) -> str:
    return key.replace("_", " ").replace(".", ", ")


def _config_rows(section: BaseModel, prefix: str = "", unit: str = "") -> Iterator[dict]:
    for key, declared in type(section).model_fields.items():
        value = getattr(section, key)
        own = (declared.json_schema_extra or {}).get("unit", "") \
            if isinstance(declared.json_schema_extra, dict) else ""
        if isinstance(value, BaseModel):
            inner = {"viscous_damping": "N·s/m", "bulk_modulus": "Pa"}.get(key, "")
            yield from _config_rows(value, f"{prefix}{key}.", inner)
            continue
        if unit and own == "1" and key.endswith(("warn", "error")):
            own = unit
        yield {"key": _plain(prefix + key), "value": _config_value(value, own),
               "description": declared.description or ""}


def _config_value(value: Any, unit: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return quantity(float(value), unit, 6)
    return "not set" if value is None else str(value)


def heading(estimate: Estimate) -> list[tuple[str, str]]:
    """Return the facts at the head of the page as (label, text)."""
    recording = estimate.recording
    facts = [("Recording", recording.source or "no file"),
             ("Rig", estimate.settings.rig.name),
             ("Duration", quantity(recording.duration, "s") if recording.duration < 120 else
              f"{recording.duration:.0f} s ({recording.duration / 60:.1f} min)"),
             ("Samples", f"{len(recording):,}".replace(",", " ")
              + f" at {number(1 / recording.sample_time)} Hz"),
             ("Channels", ", ".join(name for name in recording.channels
                                    if recording.has(name)) or "none with a value")]
    facts.append(("Start", _moment(recording.start_ns) if recording.dated else
                  "no date: the stamps count from 0"))
    if estimate.wall_s > 0:
        facts.append(("Computed in", f"{quantity(estimate.wall_s, 's', 3)}"))
    return facts


def _moment(start_ns: int) -> str:
    try:
        return datetime.fromtimestamp(start_ns // 10**9, tz=UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (ValueError, OverflowError, OSError):
        return "no date: the stamps are beyond the calendar"
