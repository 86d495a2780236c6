"""The rig of a draft: what was answered (``--set``), what follows, what the recording shows.

Its numbers, their tolerances, its effects (load, valves, friction, drive, volumes that change with
x), and the choices that are still to be made.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import degrees, pi, sin
from typing import NamedTuple

import numpy as np

from eha_monitor.draft.answers import FLOWS, Answers, flow_at
from eha_monitor.errors import InputError
from eha_monitor.plausibility.relations import FORWARD
from eha_monitor.quantity import quantity
from eha_monitor.recordings.position import quantum
from eha_monitor.settings.load import scalar
from eha_monitor.settings.rig import Rig

FITS = 0.97  # share of the pump speed's variance that a gain must explain to be written
FREE = 0.9  # of the highest speed seen: a drive that is asked for less is at no limit
LEANS = 0.25  # of the unexplained share: how far that may pull the gain
# Relative error of a gain beside a feed-forward, where a delay is taken for a lag.
BESIDE_FED = 0.1
PAPER = "default of the paper"
MEAN_FREE = "the mean of both pressures"
# Key -> tolerance where it was answered, where it follows from other numbers or the recording,
# where nobody knows it and the paper's stands in its place.
_TOLERANCES = {"area_1": (0.005, 0.01, 0.0), "area_2": (0.005, 0.01, 0.0),
               "volume_1": (0.05, 0.1, 0.3), "volume_2": (0.05, 0.1, 0.3),
               "mass": (0.05, 0.1, 0.5), "pump_displacement": (0.03, 0.03, 0.0),
               "position_gain": (0.03, 0.01, 0.0), "charge_pressure": (0.2, 0.1, 0.5),
               "leakage": (2.0, 3.0, 10.0), "makeup_conductance": (3.0, 3.0, 10.0)}
_FACTORS = ("leakage", "makeup_conductance")
LOADS = {"gravity": ("inclination",), "spring": ("spring", "spring_rest")}
QUESTIONS = {
    "machine": "kind of machine: double_rod (pump-controlled), two_pumps or accumulator (single "
               "rod), valve (cylinder behind a valve), force (axis with a measured force or "
               "torque)",
    "load": "load on the rod beside mass and friction: none, gravity, spring, or unknown (a "
            "linkage, a process)",
    "inclination": "inclination of the axis, such as 20 deg, positive if growing x lifts the load",
    "spring": "stiffness of the spring, such as 8000 N/m",
    "spring_rest": "what x reads where the spring is relaxed, such as 0 mm",
    "zero": "x = 0 of the position lies at the middle of the stroke, or at the end with the rod "
            "retracted or extended; or what x reads in the middle, such as 137 mm",
    "pressures": "pressures are absolute or gauge (0 bar in the open air); absolute until told",
    "check_valve_opens": "pressure drop at which a check valve opens, such as 0.3 bar",
    "relief_pressure": "difference of the chambers' pressures at which the relief valve opens, "
                       "such as 180 bar",
}
# What a machine may have beside the numbers of its rig, and how its data sheet says it.
PARTS = {
    "check_valve": "check valves that feed a chamber from the charge pressure, such as 9 l/min at "
                   "0.5 bar, or none",
    "relief_valve": "relief valve between the chambers, its flow at a pressure beyond its "
                    "setting, such as 20 l/min at 10 bar, or none",
    "friction": "dry friction of seals and guides, such as 120 N, or none",
    "drive_lag": "time constant of the drive's speed loop, such as 2 ms, or its bandwidth, such "
                 "as 80 Hz, or none",
}


@dataclass(frozen=True)
class Entry:
    """One line of the draft."""

    key: str
    value: str  # as YAML
    why: str  # where it comes from
    ask: bool = False  # whether it is open
    off: float = 0.0  # relative error of what the recording shows; 0 where only the source counts


class Gain(NamedTuple):
    """A gain of the position loop that a recording shows."""

    K_pos: float  # rad/(s·m)
    explains: float  # share of the speed's variance, beside a feed-forward of the demand's rate
    fed: float = 0.0  # that feed-forward, where it is much of it, rad/m


@dataclass(frozen=True)
class Seen:
    """What the recording itself shows of the rig, SI; None where it does not."""

    sample_time: float
    gain: Gain | None = None
    charge: float | None = None  # the mean of both pressures
    pump_over_area: float | None = None  # m of travel per rad of the pump, D_p/A
    span: tuple[float, float] | None = None  # the lowest and the highest position
    position_step: float = 0.0  # of the encoder


def number(value: float) -> str:
    """Return a number as YAML reads it for one."""
    text = f"{value:.6g}"
    mantissa, e, power = text.partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}{e}{power}"


def rig_entries(answers: Answers, seen: Seen, rotary: bool, name: str) -> list[Entry]:
    """Return the lines of ``rig``."""
    given = dict(answers.rig)
    rotary = answers.turns(rotary)
    area_1, area_2 = _areas(answers, rotary)
    own = given.pop("name", "")
    without = [
        Entry("name", scalar(own or name),
              "answered" if own else "from the file's name; --set name='Press 3' gives another"),
        Entry("motion", "rotary" if rotary else "linear", "header: units of the position"),
        area_1, area_2, *_volumes(answers, seen, rotary, area_1, area_2),
        _untold("mass", "moment of inertia", "3 kg m^2") if rotary else
        _untold("mass", "moving mass", "20 kg",
                "; until told, the config has no load (gravity was answered)"
                if answers.rig.get("load") == "gravity" else ""),
        Entry("pump_displacement", "null", "of the pump, such as 1.6 cm^3/rev"
              + seen_pump(answers, area_1, seen), True),
        _gain(seen),
        _untold("leakage", "of all paths together; affects βe in slow motion",
                "0.15 l/min at 100 bar, or twice that flow over its pressure, 5e-13"),
        _makeup(answers), _charge(answers, seen, area_1, area_2),
        Entry("sample_time", number(seen.sample_time), "values: the usual step of the time")]
    # What was answered stands, whatever else there is to say of it.
    entries = [_answered(answers, one.key) if one.key in given else
               _nothing(answers, one.key) if answers.lacks(one.key) else one for one in without]
    done = {entry.key for entry in entries}
    entries += [_answered(answers, key) for key in given
                if key in Rig.model_fields and key not in done]
    return entries


def _nothing(answers: Answers, key: str) -> Entry:
    """Return what a machine has not: null, or the default where the config wants a number."""
    needed = key in ("leakage", "makeup_conductance", "charge_pressure")
    return Entry(key, number(Rig.model_fields[key].default) if needed else "null",
                 f"not used: the machine is answered as {answers.rig['machine']}")


def _answered(answers: Answers, key: str) -> Entry:
    text = answers.rig[key]
    if answers.none(key):
        return Entry(key, "null", "answered: none, or unknown")
    if key in FLOWS and flow_at(key, text):
        return Entry(key, number(answers.number(key)), f"answered: {text}; C_T is twice that")
    try:
        return Entry(key, number(float(text)), "answered")
    except ValueError:
        plain = all(c.isalnum() or c in " .^/_-+" for c in text)
        return Entry(key, text if plain else f'"{text}"', "answered")


def _areas(answers: Answers, rotary: bool) -> tuple[Entry, Entry]:
    if rotary:  # a bore says nothing of a vane or a rack
        first, second = (
            _answered(answers, key) if key in answers.rig else
            Entry(key, "null", "displacement of the actuator, such as 120 cm^3/rad; needed to use "
                  "the pressures", True) for key in ("area_1", "area_2"))
        if "area_2" not in answers.rig and "area_1" in answers.rig:
            second = replace(first, key="area_2", why="as area_1: a vane has equal sides")
        return first, second
    bore, rod = answers.number("bore"), answers.number("rod")
    rods = answers.rods()
    sheet = answers.rig
    found = []
    for key, open_end in (("area_1", rods == "1"), ("area_2", False)):
        if bore and (open_end or rod is not None):
            minus = 0.0 if open_end else rod
            words = f"of bore {sheet['bore']}" + ("" if open_end else f" and rod {sheet['rod']}")
            found.append(Entry(key, number(pi / 4 * (bore**2 - minus**2)), f"answered: {words}"))
        else:
            found.append(Entry(key, "null", "piston area of chamber " + key[-1] + ", such as 5.05 "
                               "cm^2, or bore and rod; needed to use the pressures", True))
    return found[0], found[1]


def value_of(entry: Entry, answers: Answers) -> float | None:
    """Return the number of a line, SI, or None."""
    if entry.key in answers.rig:
        return answers.number(entry.key)
    if entry.key == "area_2" and entry.why.startswith("as area_1"):
        return answers.number("area_1")
    return None if entry.value == "null" else float(entry.value)


# Where x = 0 lies -> shares of the stroke that chambers 1 and 2 have there.
_SHARES = {"middle": (0.5, 0.5), "retracted": (0.0, 1.0), "extended": (1.0, 0.0)}
_WORDS = {"middle": "the middle of the stroke", "retracted": "the end with the rod in",
          "extended": "the end with the rod out"}


def zero_of(answers: Answers, seen: Seen) -> tuple[str, str]:
    """Return where x = 0 lies, and who says so: ``answered``, ``values``, or "" for nobody.

    A cylinder whose x leaves the middle by more than half of its stroke does not have x = 0 there.
    """
    if "zero" in answers.rig:
        return ("middle" if answers.middle() is not None else answers.rig["zero"]), "answered"
    stroke = answers.number("stroke")
    if stroke and seen.span and max(map(abs, seen.span)) > 0.51 * stroke:
        end = "retracted" if sum(seen.span) > 0 else "extended"
        if not _beyond(end, stroke, seen.span):
            return end, "values"
    return "middle", ""


def too_short(answers: Answers, seen: Seen, rotary: bool) -> str:
    """Return in words that x moves over more than the whole stroke that was answered, or ""."""
    stroke = answers.number("stroke")
    if not stroke or not seen.span or seen.span[1] - seen.span[0] <= 1.03 * stroke:
        return ""
    moved, unit = seen.span[1] - seen.span[0], "rad" if rotary else "m"
    return (f"--set stroke={answers.rig['stroke']}: expected at least the "
            f"{quantity(moved, unit, 3)} that x moves in the recording; or is x in another unit "
            "(x.unit)?")


def _beyond(zero: str, stroke: float, span: tuple[float, float]) -> bool:
    below, above = _SHARES[zero]
    return span[0] < -(below + 0.03) * stroke or span[1] > (above + 0.03) * stroke


def no_such_zero(answers: Answers, seen: Seen, rotary: bool) -> str:
    """Return in words how far x runs where that is beyond the actuator's ends, or ""."""
    stroke, zero = answers.number("stroke"), zero_of(answers, seen)[0]
    if not stroke or not seen.span or not _beyond(zero, stroke, seen.span):
        return ""
    low, high = (degrees(one) if rotary else 1e3 * one for one in seen.span)
    unit = "deg" if rotary else "mm"
    return (f"x runs from {low:.4g} to {high:.4g} {unit}, beyond the ends of a stroke of "
            f"{answers.rig['stroke']} with x = 0 at {_WORDS[zero]}; is the stroke right?  What "
            f"does x read in the middle of the stroke?  --set zero='100 {unit}'")


def _volumes(answers: Answers, seen: Seen, rotary: bool, *areas: Entry) -> Iterator[Entry]:
    stroke, line = answers.number("stroke"), answers.number("line_volume") or 0.0
    zero, who = zero_of(answers, seen)
    at = f"{who or 'answered'}: x = 0 at {_WORDS[zero]}"
    for key, area, share in zip(("volume_1", "volume_2"), areas, _SHARES[zero], strict=True):
        own = value_of(area, answers)
        if stroke and own and share * stroke + line:
            words = f"{at}, stroke {answers.rig['stroke']}" + (
                f", the line's {answers.rig['line_volume']}" if line else
                "; the lines' oil is left out, --set rig.line_volume='10 cm^3'") + (
                "" if who else "; if it is elsewhere, --set zero=retracted")
            yield Entry(key, number(own * stroke * share + line), words, not line)
        else:
            of = "the whole angle as stroke, such as 270 deg," if rotary else "stroke"
            yield Entry(key, "null", f"oil of chamber {key[-1]} and its line at x = 0, such as "
                        f"68.5 cm^3, or {of} and line_volume; without it no beta_e", True)


def _untold(key: str, words: str, example: str, hint: str = "") -> Entry:
    return Entry(key, number(Rig.model_fields[key].default),
                 f"{words}, such as {example}; this is the {PAPER}{hint}", True)


def seen_pump(answers: Answers, area: Entry, seen: Seen) -> str:
    """Return what the recording suggests for the pump, in words, or ""."""
    own = value_of(area, answers)
    if not own or not seen.pump_over_area:
        return ""
    size = abs(seen.pump_over_area) * own * 2 * pi * 1e6
    return f"; the recording shows about {size:.3g} cm^3/rev"


def _gain(seen: Seen) -> Entry:
    gain, off = seen.gain, 0.0
    if gain and gain.explains > FITS and gain.K_pos > 0:
        why = (f"values: omega over x_d - x, which explains {100 * min(gain.explains, 0.9999):.2f}"
               " % of omega")
        if gain.fed:
            why += (f" beside a feed-forward of {number(gain.fed)} rad/m, for which a config "
                    "has no key")
            off = BESIDE_FED
        return Entry("position_gain", number(gain.K_pos), why, off=max(off, round(
            LEANS * float(np.sqrt(max(1.0 - gain.explains, 0.0))), 3)))
    told = f" (x_d - x explains {100 * gain.explains:.0f} % of omega)" if gain else ""
    return Entry("position_gain", "null", "pump speed over position error, rad/(s·m); null: "
                                          f"unknown{told}", True)


def _makeup(answers: Answers) -> Entry:
    if answers.rig.get("machine") == "accumulator":
        return Entry("makeup_conductance", "0.0", "answered: an accumulator, or check valves, hold"
                     " one side's pressure; no path of a conductance")
    default = Rig.model_fields["makeup_conductance"].default
    leakage = answers.number("leakage")
    if leakage is not None and leakage < default:
        return Entry("makeup_conductance", number(leakage), "all of the leakage, which is less "
                     f"than the {PAPER}")
    return Entry("makeup_conductance", number(default), "of each chamber to the make-up source, "
                 f"part of leakage; this is the {PAPER}", True)


def _charge(answers: Answers, seen: Seen, *areas: Entry) -> Entry:
    own = [value_of(area, answers) for area in areas]
    if seen.charge and seen.charge > 0 and own[0] == own[1] and own[0]:
        return Entry("charge_pressure", number(seen.charge), f"values: {MEAN_FREE}")
    return Entry("charge_pressure", number(Rig.model_fields["charge_pressure"].default),
                 f"absolute, of the make-up source, such as 20 bar; this is the {PAPER}"
                 + ("; until told, the config has no check valves" if "check_valve" in answers.rig
                    and not answers.none("check_valve") else ""), True)


def tolerances(entries: list[Entry]) -> Iterator[Entry]:
    """Yield the lines of ``rig.tolerance``: how far off each may be, by its source."""
    for entry in entries:
        if entry.key not in _TOLERANCES or entry.value == "null" or "not used" in entry.why:
            continue
        of = (2 if entry.ask else 0 if entry.why == "answered" or entry.key == "leakage" else 1)
        words = ("data sheet", "computed or seen", "nobody has told it")[of]
        unit = "a factor" if entry.key in _FACTORS else "relative"
        size = max(_TOLERANCES[entry.key][of], entry.off)
        yield Entry(entry.key, number(size), f"{unit}; {words}")


def open_choices(answers: Answers, entries: list[Entry], seen: Seen, gauge_known: bool
                 ) -> list[tuple[str, str]]:
    """Return key and question of each choice that neither a person nor the recording has made.

    Raises InputError if x = 0 was answered to lie where the recording goes beyond the actuator's
    ends.
    """
    told = answers.rig
    asked = [key for key in ("machine", "load") if key not in told]
    wanted = [key for key in LOADS.get(told.get("load"), ()) if key not in told]
    if "relief_valve" in told and not answers.none("relief_valve") and (
            "relief_pressure" not in told):
        wanted.append("relief_pressure")
    asked += wanted
    if "stroke" in told and not ("volume_1" in told and "volume_2" in told) and (
            not zero_of(answers, seen)[1]):
        asked.append("zero")
    if "pressures" not in told and not gauge_known:
        asked.append("pressures")
    found = [(key, QUESTIONS[key] + (
        "; x = 0 until told" if key == "spring_rest" else
        "; until told, the config has no relief valve" if key == "relief_pressure" else
        f"; until told, the config has no load ({told['load']} was answered)"
        if key in wanted else ""))
             for key in asked if not answers.lacks(key)]
    parts = [key for key in PARTS if not answers.lacks(key)]
    if not any(key in told for key in parts):
        found.append(("parts", f"what the data sheets say of {', '.join(parts)}: --set "
                      "friction='120 N', or none; what is not in the config, diagnose has to "
                      "find"))
    outside = "" if answers.lacks("zero") else no_such_zero(answers, seen, _rotary(entries))
    if outside and answers.rig.get("zero") in _SHARES:
        raise InputError(f"--set zero={answers.rig['zero']}: {outside}")
    return [*(one for one in found if one[0] != "zero"), ("zero", outside)] if outside else found


def _rotary(entries: list[Entry]) -> bool:
    return any(entry.key == "motion" and entry.value == "rotary" for entry in entries)


GRAVITY = 9.81  # m/s²


def effects_of(answers: Answers, entries: list[Entry], seen: Seen) -> list[Entry]:
    """Return the lines of ``effects``: load, valves, friction, drive, volumes that change with x.

    F = A1 p1 - A2 p2 is of absolute pressures, so what the open air does to the rod's own end, p_a
    (A1 - A2) against growing x, is a load, whatever zero the sensors have.  Raises InputError if
    the load is one that a rotary actuator has not, or valves or volumes contradict themselves.
    """
    turns = _rotary(entries)
    if turns and answers.rig.get("load") == "gravity":
        raise InputError("--set load=gravity: expected none, spring or unknown of a rotary "
                         "actuator, since the torque of a weight changes with the angle; unknown "
                         "lets diagnose identify it")
    found, of = [], {entry.key: value_of(entry, answers) for entry in entries
                     if entry.key in ("area_1", "area_2", "volume_1", "volume_2", "mass")}
    load, slope, spring = (answers.rig.get("load"), answers.number("inclination"),
                           answers.number("spring"))
    weight = (of["mass"] * GRAVITY * sin(slope)
              if load == "gravity" and slope is not None and "mass" in answers.rig else 0.0)
    air = 0.0 if turns else _open_air(answers, of["area_1"], of["area_2"])
    if weight or air:
        words = [f"weight of the mass at {answers.rig['inclination']}"] if weight else []
        words += [f"what the open air does to the rod's end, p_a (A1 - A2) = {air:.4g} N"
                  ] if air else []
        found.append(Entry("constant_load", f"{{F_0: {number(weight + air)}}}",
                           f"answered: {' and '.join(words)}, N against growing x"))
    if load == "spring" and spring:
        rest = (answers.number("spring_rest") or 0.0) - (
            (answers.middle() or 0.0) if "spring_rest" in answers.rig else 0.0)
        found.append(Entry("spring_load", f"{{k: {number(spring)}, x_0: {number(rest)}}}",
                           f"answered: {answers.rig['spring']}, relaxed at "
                           f"{answers.rig.get('spring_rest', 'x = 0')}"))
    charge = next(entry for entry in entries if entry.key == "charge_pressure")
    found += _parts(answers, None if charge.ask else value_of(charge, answers))
    zero, who = zero_of(answers, seen)
    shrinking = of["volume_1" if zero == "extended" else "volume_2"]
    if zero != "middle" and shrinking and of["area_1"] and not answers.lacks("volume_1"):
        reach = max(map(abs, seen.span)) if seen.span else answers.number("stroke") or 1.0
        ratio = (of["area_2"] or of["area_1"]) / of["area_1"]
        shrinks = 1.0 if zero == "extended" else ratio  # of A_v, how fast that chamber does
        taken, key = of["area_1"] * shrinks * reach, "volume_1" if zero == "extended" else (
            "volume_2")
        if seen.span and key in answers.rig and shrinking < taken:
            raise InputError(
                f"--set {key}={answers.rig[key]}: expected more than the "
                f"{quantity(taken, 'm³', 3)} that the piston takes of it up to x = "
                f"{quantity(reach, 'm', 3)}; volumes are those at x = 0: are volume_1 and "
                "volume_2 exchanged, or does x = 0 lie elsewhere?")
        slope = min(of["area_1"], 0.98 * shrinking / (reach * shrinks))  # some oil is left
        own = "" if ratio == 1.0 else f", r: {number(ratio)}"
        found.append(Entry("position_dependent_volume", f"{{A_v: {number(slope)}{own}}}",
                           f"{who}: x = 0 is at an end; the volumes above hold there and change "
                           "with x"))
    return found


def _open_air(answers: Answers, area_1: float | None, area_2: float | None) -> float:
    """Return p_a (A1 - A2), N; nothing where an area is not known."""
    if not area_1 or not area_2:
        return 0.0
    ambient = answers.number("ambient_pressure")
    return (Rig.model_fields["ambient_pressure"].default if ambient is None else ambient) * (
        area_1 - area_2)


def _parts(answers: Answers, charge: float | None) -> list[Entry]:
    """Return the valves, dry friction and lag of the drive that a data sheet has.

    ``charge`` : pressure of the make-up source, Pa; None where nobody knows it.
    """
    found = []

    def told(key: str) -> bool:
        return key in answers.rig and not answers.none(key)

    if told("check_valve") and charge is not None:
        opens = answers.number("check_valve_opens") or 0.0
        flow, drop = flow_at("check_valve", answers.rig["check_valve"])
        if not drop > opens:
            raise InputError(f"--set check_valve={answers.rig['check_valve']}: expected more than "
                             "the pressure at which it opens, check_valve_opens="
                             f"'{answers.rig['check_valve_opens']}'")
        k, low = number(flow / (drop - opens)), number(charge - opens)
        found.append(Entry("anti_cavitation", f"{{k: {k}, p_min: {low}}}",
                           f"answered: check valves, {answers.rig['check_valve']}, open "
                           f"{answers.rig.get('check_valve_opens', '0 bar')} below the charge "
                           "pressure"))
    if told("relief_valve") and told("relief_pressure"):
        found.append(Entry("relief_valve", f"{{k: {number(answers.number('relief_valve'))}, p_c: "
                           f"{number(answers.number('relief_pressure'))}}}",
                           f"answered: {answers.rig['relief_valve']} beyond "
                           f"{answers.rig['relief_pressure']} between the chambers"))
    for key, effect, symbol in (("friction", "coulomb_friction", "F_c"),
                                ("drive_lag", "drive_lag", "tau")):
        if told(key):
            found.append(Entry(effect, f"{{{symbol}: {number(answers.number(key))}}}",
                               f"answered: {answers.rig[key]}"))
    return found


def seen_in(recording) -> Seen:
    """Return what a recording, in SI, shows of its rig."""
    step = recording.sample_time
    gain = charge = ratio = span = None
    x = recording.get("x") if recording.has("x") else np.empty(0)
    if recording.has("x") and np.isfinite(recording.get("x")).any():
        span = float(np.nanmin(recording.get("x"))), float(np.nanmax(recording.get("x")))
    if recording.has("omega", "x", "x_d"):
        gain = _loop_gain(recording.get("omega"), recording.get("x_d"),
                          recording.get("x_d") - recording.get("x"), step)
    if recording.has("p1", "p2"):
        charge = float(np.nanmedian(0.5 * (recording.get("p1") + recording.get("p2"))))
    if recording.has("omega", "x"):
        turned = np.nancumsum(np.nan_to_num(recording.get("omega"))) * step
        fit = _slope(_trendless(recording.get("x")), _trendless(turned))
        ratio = fit[0] if fit and fit[1] > FITS else None
    return Seen(step, gain, charge, ratio, span, quantum(x[np.isfinite(x)]) if len(x) else 0.0)


def _trendless(values: np.ndarray) -> np.ndarray:
    place = np.arange(len(values))
    good = np.isfinite(values)
    return values - np.polyval(np.polyfit(place[good], values[good], 1), place)


def _loop_gain(omega: np.ndarray, demand: np.ndarray, error: np.ndarray, step: float
               ) -> Gain | None:
    """Return K_pos of omega + tau omega' = K_pos (x_d - x) + k_v x_d', and what it explains.

    Least squares, tau beside K_pos: a lag that is left out makes the gain too small. So do samples
    in which the drive gives the highest speed that it has: what asks for more is left out.  A
    feed-forward k_v is none where K_pos alone explains as much: the error goes with the speed.
    """
    plain = _slope(omega, error)
    if plain is None:
        return None
    wanted, top = np.abs(plain[0] * error), float(np.nanmax(np.abs(omega)))
    rate, led = np.gradient(omega, step), np.gradient(demand, step)
    good = np.isfinite(omega + rate + error + led) & (wanted < FREE * top)
    if good.sum() < 100 or not np.std(omega[good]):
        return Gain(*plain)
    there = omega[good]

    def fitted(*columns: np.ndarray) -> tuple[np.ndarray, float]:
        matrix = np.column_stack(columns)[good]
        w = np.linalg.lstsq(matrix, there, rcond=None)[0]
        return w, float(np.var(there - matrix @ w) / np.var(there))

    alone, left = fitted(error, -rate)
    fed, less = fitted(error, -rate, led)
    if fed[0] > 0.0 and less < FORWARD * left:
        return Gain(float(fed[0]), 1.0 - less, float(fed[2]))
    return Gain(float(alone[0]), 1.0 - left)


def _slope(left: np.ndarray, right: np.ndarray) -> tuple[float, float] | None:
    good = np.isfinite(left) & np.isfinite(right)
    a, b = left[good], right[good]
    if len(a) < 100 or not float(np.dot(b, b)) or not np.std(a):
        return None
    slope = float(np.dot(a, b) / np.dot(b, b))
    return slope, 1.0 - float(np.var(a - slope * b) / np.var(a))
