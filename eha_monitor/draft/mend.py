"""What the recording itself corrects in a draft: signs, swaps, units, gauge pressures."""

from dataclasses import replace
from math import isclose, log

import numpy as np

from eha_monitor.draft.answers import Answers
from eha_monitor.draft.guess import Guess, Map
from eha_monitor.recordings.recording import ChannelFinding, Recording
from eha_monitor.settings.channels import unit_of
from eha_monitor.settings.monitor import Settings

BELOW = 0.9e5  # Pa, lower than the open air anywhere on low ground: no absolute pressure at rest
# Units that a column may be in, by its channel; a factor that is none of them becomes a scale.
UNITS = {"x": ("m", "mm", "cm", "um", "inch"), "x_d": ("m", "mm", "cm", "um", "inch"),
         "v": ("m/s", "mm/s", "cm/s", "m/min"),
         "omega": ("rad/s", "rpm", "rev/s", "deg/s"),
         "omega_d": ("rad/s", "rpm", "rev/s", "deg/s"),
         "p1": ("Pa", "bar", "kPa", "MPa", "psi", "mbar"),
         "p2": ("Pa", "bar", "kPa", "MPa", "psi", "mbar"), "force": ("N", "kN", "kgf", "daN")}
TIMES = {1e-3: "1 ms", 1.0: "1 s", 1e-6: "1 us", 1e-9: "1 ns", 60.0: "1 min"}


def mended(found: Map, findings: tuple[ChannelFinding, ...], settings: Settings
           ) -> tuple[Map, list[str]]:
    """Return the map with what the recording corrects, and what is left to ask.

    A sign and a swap are corrected whatever the header says, since cables and hoses are mixed up;
    a unit only where no header and nobody has named it.  Numbers of the rig are never touched.
    """
    left = []
    for finding in findings:
        changed = _one(found, finding, settings)
        if changed is None:
            left.append(finding.finding)
        else:
            found = changed
    return found, left


def _one(found: Map, finding: ChannelFinding, settings: Settings) -> Map | None:
    names = finding.channels
    if names == ("time",):
        scale = finding.correction.get("table", {}).get("time_scale")
        if found.time is None or found.time.sure or scale is None:
            return None
        unit = next((text for value, text in TIMES.items() if isclose(value, scale, rel_tol=1e-6)),
                    None)
        return unit and replace(found, time=replace(found.time, unit=unit, why=_told(finding)))
    if any(name not in found.channels for name in names) or "channels" not in finding.correction:
        return None
    if finding.kind == "swapped" and len(names) == 2:
        one, other = (found.channels[name] for name in names)
        if one.unit and other.unit and unit_of(one.unit).si != unit_of(other.unit).si:
            return None  # a position in the column of a speed: no hose or cable does that
        swapped = {names[0]: replace(other, why=_told(finding)),
                   names[1]: replace(one, why=_told(finding))}
        return replace(found, channels={**found.channels, **swapped})
    for name in names:
        guess = found.channels[name]
        if finding.kind == "offset":
            # Against a charge pressure that nobody has told it says nothing.
            if "charge pressure" in finding.finding and (
                    "charge_pressure" not in settings.rig.model_fields_set):
                return found
            if not guess.unit or (guess.sure and "gauge" in guess.unit):
                return None
            found = found.with_channel(name, replace(
                guess, unit=f"{guess.unit} gauge", why=_told(finding)))
            continue
        old, new = settings.channels[name].gain, finding.correction["channels"][name]["scale"]
        factor = new / old
        if factor < 0:
            found = found.with_channel(name, replace(
                guess, scale=-guess.scale, offset=-guess.offset, why=_told(finding)))
        if abs(log(abs(factor))) > 1e-6:
            if guess.sure:
                return None
            found = found.with_channel(name, _in_another_unit(found.channels[name], name,
                                                              abs(factor), finding))
    return found


def _in_another_unit(guess: Guess, name: str, factor: float, finding: ChannelFinding):
    wanted = unit_of(guess.unit).factor * factor
    unit = next((unit for unit in UNITS.get(name, ())
                 if isclose(unit_of(unit).factor, wanted, rel_tol=1e-4)), None)
    if unit is not None:
        return replace(guess, unit=unit, why=_told(finding))
    return replace(guess, scale=float(f"{guess.scale * factor:.10g}"), why=_told(finding))


def _told(finding: ChannelFinding) -> str:
    return f"values: {finding.finding}"


def as_answered(found: Map, answers: Answers) -> Map:
    """Take the pressures as ``pressures`` was answered, unless their unit says it itself."""
    if answers.rig.get("pressures") == "gauge":
        for name in absolute(found):
            found = _as_gauge(found, name, "answered: gauge")
    return found


def absolute(found: Map) -> list[str]:
    """Return the pressures whose unit does not say that they are gauge pressures."""
    return [name for name in ("p1", "p2") if name in found.channels
            and found.channels[name].unit and "gauge" not in found.channels[name].unit]


def _as_gauge(found: Map, name: str, why: str) -> Map:
    guess = found.channels[name]
    return found.with_channel(name, replace(guess, unit=f"{guess.unit} gauge", why=why))


def not_absolute(found: Map, recording: Recording, answers: Answers) -> tuple[Map, str]:
    """Take pressures that stay below the atmosphere's for gauge ones; what is to be said else.

    A chamber that cavitates is below it for moments: a hundredth of the samples must be.
    """
    low = {name: float(np.nanquantile(recording.get(name), 0.01)) for name in absolute(found)
           if name in recording.channels and np.isfinite(recording.get(name)).any()}
    if not low or min(low.values()) > BELOW:
        return found, ""
    name = min(low, key=low.get)
    why = (f"{name} goes down to {low[name] / 1e5:.2f} bar, and an absolute pressure of a chamber "
           "at rest is not below 1 bar")
    if answers.rig.get("pressures") == "absolute":
        return found, f"{why}: are these gauge pressures?  --set pressures=gauge"
    for name in low:
        found = _as_gauge(found, name, f"values: {why}")
    return found, ""
