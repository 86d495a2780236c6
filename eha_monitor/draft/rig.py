"""The rig of a draft: what was answered (``--set``), what follows, what the recording shows."""

import difflib
import re
from dataclasses import dataclass
from math import pi

import numpy as np
from pydantic_core import PydanticCustomError

from eha_monitor.errors import InputError
from eha_monitor.settings.channels import CHANNELS, unit_of
from eha_monitor.settings.rig import Rig
from eha_monitor.units import to_si

# What a data sheet of a cylinder has, and the config's numbers follow from; unit, and words.
SHEET = {"bore": ("m", "bore of the cylinder"), "rod": ("m", "diameter of the rod"),
         "stroke": ("m", "stroke of the cylinder"),
         "line_volume": ("m³", "oil in the line to one chamber")}
RODS = ("1", "2")
_NULL = ("null", "none", "-")
_CHANNEL_KEYS = ("column", "unit", "scale", "offset", "full")
_FULL = re.compile(r"^(?:(?P<raw>[-+\d.e]+)\s*=\s*)?(?P<value>[-+\d.]+(?:e[-+]?\d+)?)"
                   r"\s*(?P<unit>\S.*)$", re.IGNORECASE)


@dataclass(frozen=True)
class Answers:
    """What was answered.

    Attributes
    ----------
    rig : key of ``rig`` or of a data sheet -> text as given.
    channels : channel or ``time`` -> key -> text.
    """

    rig: dict[str, str]
    channels: dict[str, dict[str, str]]

    def number(self, key: str) -> float | None:
        """Return an answer in SI, or None where there is none, or where it is ``null``."""
        text = self.rig.get(key)
        if text is None or text.casefold() in _NULL:
            return None
        return checked(key, text)

    def columns(self) -> dict[str, str]:
        """Return channel -> column that was named."""
        return {name: keys["column"] for name, keys in self.channels.items() if "column" in keys}


def answers_of(given: tuple[str, ...]) -> Answers:
    """Return the answers of ``--set`` options.

    Raises
    ------
    InputError
        One line that names the option and what was expected.
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
            if part in ("scale", "offset"):
                checked(f"{name}.{part}", value, "1")
            channels.setdefault(name, {})[part] = value
            continue
        key = key.removeprefix("rig.")
        rig[key] = value
        checked(key, value)
    return Answers(rig, channels)


def checked(key: str, text: str, unit: str = "") -> float | None:
    """Return an answer in SI.

    Raises
    ------
    InputError
        If there is no such key, or it is no such quantity.
    """
    fields = {**Rig.model_fields}
    known = [*SHEET, "rods", *fields]
    if not unit and key not in known:
        close = difflib.get_close_matches(key, known, 1)
        hint = f"did you mean rig.{close[0]}?" if close else (
            f"expected a channel (x.unit, p1.column, ...) or rig.<{', '.join(known)}>")
        raise InputError(f"--set {key}: unknown key, {hint}")
    if key == "rods" and text not in RODS:
        raise InputError(f"--set rods: expected 1 or 2 (a rod on both sides), got '{text}'")
    if key in ("name", "motion", "rods") or text.casefold() in _NULL:
        return None
    si = unit or (SHEET[key][0] if key in SHEET else
                  (fields[key].json_schema_extra or {}).get("unit", "1"))
    words = SHEET[key][1] if key in SHEET else (fields[key].description if key in fields else key)
    try:
        number = float(text)
    except ValueError:
        try:
            number = to_si(text, si)
        except PydanticCustomError:
            raise InputError(f"--set {key}: expected {words} in {si}, or with a unit, got "
                             f"'{text}'") from None
    if not unit and not number >= 0:
        raise InputError(f"--set {key}: expected at least 0 {si}, got '{text}'")
    return number


def full_scale(channel: str, text: str, kind: str) -> tuple[str, float]:
    """Return unit and scale of ``80 mm`` (at 100 %) or ``27648 = 250 bar`` (counts).

    Raises
    ------
    InputError
        If it is neither.
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


FITS = 0.97  # share of the pump speed's variance that a gain must explain to be written
PAPER = "default of the paper"
MEAN_FREE = "the mean of both pressures"


@dataclass(frozen=True)
class Entry:
    """One line of the draft: key, value as YAML, where it comes from, whether it is open."""

    key: str
    value: str
    why: str
    ask: bool = False


@dataclass(frozen=True)
class Seen:
    """What the recording itself shows of the rig; None where it does not.

    Attributes
    ----------
    sample_time : s.
    gain : rad/(s·m), and the share of the speed's variance that it explains.
    charge : Pa, the mean of both pressures.
    pump_over_area : m of travel per rad of the pump, D_p/A.
    """

    sample_time: float
    gain: tuple[float, float] | None = None
    charge: float | None = None
    pump_over_area: float | None = None


def number(value: float) -> str:
    """Return a number as YAML reads it for one."""
    text = f"{value:.6g}"
    mantissa, e, power = text.partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}{e}{power}"


def rig_entries(answers: Answers, seen: Seen, rotary: bool, name: str) -> list[Entry]:
    """Return the lines of ``rig``."""
    given = dict(answers.rig)
    area_1, area_2 = _areas(answers)
    entries = [
        Entry("name", _text(given.pop("name", name)), "from the file's name"),
        Entry("motion", given.get("motion", "rotary" if rotary else "linear"),
              "answered" if "motion" in given else "header: units of the position"),
        area_1, area_2, *_volumes(answers, area_1, area_2),
        _told(answers, "mass", "moving mass", "20 kg"),
        _told(answers, "pump_displacement", "of the pump", "1.6 cm^3/rev", seen_pump(
            answers, area_1, seen)),
        _gain(answers, seen),
        _told(answers, "leakage", "C_T; affects beta_e in slow motion", "5e-13"),
        _makeup(answers), _charge(answers, seen, area_1, area_2),
        Entry("sample_time", number(seen.sample_time), "values: the usual step of the time")
        if "sample_time" not in given else _answered(answers, "sample_time"),
    ]
    done = {entry.key for entry in entries}
    entries += [_answered(answers, key) for key in given
                if key in Rig.model_fields and key not in done]
    return entries


def _text(value: str) -> str:
    from json import dumps

    return value if value.isidentifier() else dumps(value, ensure_ascii=False)


def _answered(answers: Answers, key: str) -> Entry:
    text = answers.rig[key]
    plain = text.casefold()
    if plain in ("null", "none", "-"):
        return Entry(key, "null", "answered: none, or unknown")
    try:
        return Entry(key, number(float(text)), "answered")
    except ValueError:
        return Entry(key, _quoted(text), "answered")


def _quoted(text: str) -> str:
    return text if all(c.isalnum() or c in " .^/_-+" for c in text) else f'"{text}"'


def _areas(answers: Answers) -> tuple[Entry, Entry]:
    bore, rod = answers.number("bore"), answers.number("rod")
    rods = answers.rig.get("rods", "1")
    sheet = answers.rig
    found = []
    for key, open_end in (("area_1", rods == "1"), ("area_2", False)):
        if key in sheet:
            found.append(_answered(answers, key))
        elif bore and (open_end or rod is not None):
            minus = 0.0 if open_end else rod
            words = f"of bore {sheet['bore']}" + ("" if open_end else f" and rod {sheet['rod']}")
            found.append(Entry(key, number(pi / 4 * (bore**2 - minus**2)), f"answered: {words}"))
        else:
            found.append(Entry(key, "null", "piston area of chamber " + key[-1] + ", such as 5.05 "
                               "cm^2, or bore and rod; needed to use the pressures", True))
    return found[0], found[1]


def _value(entry: Entry, answers: Answers) -> float | None:
    if entry.key in answers.rig:
        return answers.number(entry.key)
    return None if entry.value == "null" else float(entry.value)


def _volumes(answers: Answers, *areas: Entry) -> list[Entry]:
    stroke, line = answers.number("stroke"), answers.number("line_volume") or 0.0
    found = []
    for key, area in zip(("volume_1", "volume_2"), areas, strict=True):
        own = _value(area, answers)
        if key in answers.rig:
            found.append(_answered(answers, key))
        elif stroke and own:
            words = f"answered: half of the stroke {answers.rig['stroke']}" + (
                f" and the line's {answers.rig['line_volume']}" if line else
                "; the lines' oil is left out, --set rig.line_volume='10 cm^3'")
            found.append(Entry(key, number(own * stroke / 2 + line), words, not line))
        else:
            found.append(Entry(key, "null", "oil of chamber " + key[-1] + " and its line at x = "
                               "0, such as 68.5 cm^3, or the stroke; without it no beta_e", True))
    return found


def _told(answers: Answers, key: str, words: str, example: str, hint: str = "") -> Entry:
    if key in answers.rig:
        return _answered(answers, key)
    default = Rig.model_fields[key].default
    if key == "pump_displacement":
        return Entry(key, "null", f"{words}, such as {example}{hint}", True)
    return Entry(key, number(default), f"{words}, such as {example}; this is the {PAPER}", True)


def seen_pump(answers: Answers, area: Entry, seen: Seen) -> str:
    """Return what the recording suggests for the pump, in words, or ""."""
    own = _value(area, answers)
    if not own or not seen.pump_over_area:
        return ""
    return (f"; the recording shows about {abs(seen.pump_over_area) * own * 2 * pi * 1e6:.3g} "
            "cm^3/rev")


def _gain(answers: Answers, seen: Seen) -> Entry:
    if "position_gain" in answers.rig:
        return _answered(answers, "position_gain")
    if seen.gain and seen.gain[1] > FITS and seen.gain[0] > 0:
        return Entry("position_gain", number(seen.gain[0]), "values: omega over x_d - x, which "
                     f"explains {min(seen.gain[1], 0.9999):.2%} of omega")
    told = f" (x_d - x explains {seen.gain[1]:.0%} of omega)" if seen.gain else ""
    return Entry("position_gain", "null", "pump speed over position error, rad/(s·m); null: "
                                          f"unknown{told}", True)


def _makeup(answers: Answers) -> Entry:
    if "makeup_conductance" in answers.rig:
        return _answered(answers, "makeup_conductance")
    default = Rig.model_fields["makeup_conductance"].default
    leakage = answers.number("leakage")
    if leakage is not None and leakage < default:
        return Entry("makeup_conductance", number(leakage), "all of the leakage, which is less "
                     f"than the {PAPER}")
    return Entry("makeup_conductance", number(default), "of each chamber to the make-up source, "
                 f"part of leakage; this is the {PAPER}", True)


def _charge(answers: Answers, seen: Seen, *areas: Entry) -> Entry:
    if "charge_pressure" in answers.rig:
        return _answered(answers, "charge_pressure")
    own = [_value(area, answers) for area in areas]
    if seen.charge and seen.charge > 0 and own[0] == own[1] and own[0]:
        return Entry("charge_pressure", number(seen.charge), f"values: {MEAN_FREE}")
    return Entry("charge_pressure", number(Rig.model_fields["charge_pressure"].default),
                 f"absolute, of the make-up source, such as 20 bar; this is the {PAPER}", True)


def seen_in(recording, rig_known: bool = True) -> Seen:
    """Return what a recording, in SI, shows of its rig."""
    step = recording.sample_time
    gain = charge = ratio = None
    if recording.has("omega", "x", "x_d"):
        gain = _slope(recording.get("omega"), recording.get("x_d") - recording.get("x"))
    if recording.has("p1", "p2"):
        charge = float(np.nanmedian(0.5 * (recording.get("p1") + recording.get("p2"))))
    if recording.has("omega", "x"):
        turned = np.nancumsum(np.nan_to_num(recording.get("omega"))) * step
        fit = _slope(_trendless(recording.get("x")), _trendless(turned))
        ratio = fit[0] if fit and fit[1] > FITS else None
    return Seen(step, gain, charge, ratio)


def _trendless(values: np.ndarray) -> np.ndarray:
    place = np.arange(len(values))
    good = np.isfinite(values)
    return values - np.polyval(np.polyfit(place[good], values[good], 1), place)


def _slope(left: np.ndarray, right: np.ndarray) -> tuple[float, float] | None:
    good = np.isfinite(left) & np.isfinite(right)
    a, b = left[good], right[good]
    if len(a) < 100 or not float(np.dot(b, b)) or not np.std(a):
        return None
    slope = float(np.dot(a, b) / np.dot(b, b))
    return slope, 1.0 - float(np.var(a - slope * b) / np.var(a))
