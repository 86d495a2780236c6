"""From a recording and answers to a draft, mended by what the recording itself shows, as YAML."""

from dataclasses import dataclass, replace
from json import dumps
from math import isclose, log

import numpy as np

from eha_monitor import __version__
from eha_monitor.draft.answers import Answers, full_scale, of_channel
from eha_monitor.draft.guess import TIMES, Guess, Map, guessed
from eha_monitor.draft.rig import (
    Entry,
    Seen,
    effects_of,
    number,
    open_choices,
    rig_entries,
    seen_in,
    tolerances,
    too_short,
)
from eha_monitor.draft.sources import LEAST_PA, Source, namespace_of
from eha_monitor.errors import InputError
from eha_monitor.plausibility.judge import Plausibility, plausibility_of
from eha_monitor.recordings.importing import read_table
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import ChannelFinding, Recording
from eha_monitor.settings.channels import check_unit, counted_from, unit_of
from eha_monitor.settings.load import scalar, settings_from_tree, settings_of
from eha_monitor.settings.monitor import Monitor, Settings
from eha_monitor.settings.rig import Rig
from eha_monitor.units import to_si

ASK = "ASK"
_COLUMN = 34  # where comments begin, if there is room
BELOW = 0.9e5  # Pa, lower than the open air anywhere on low ground: no absolute pressure at rest
MOST_BAR = 1e3  # that a rig has; more is kPa
# Units that a column may be in, by its channel; a factor that is none of them becomes a scale.
UNITS = {"x": ("m", "mm", "cm", "um", "inch"), "x_d": ("m", "mm", "cm", "um", "inch"),
         "v": ("m/s", "mm/s", "cm/s", "m/min"),
         "omega": ("rad/s", "rpm", "rev/s", "deg/s"),
         "omega_d": ("rad/s", "rpm", "rev/s", "deg/s"),
         "p1": ("Pa", "bar", "kPa", "MPa", "psi", "mbar"),
         "p2": ("Pa", "bar", "kPa", "MPa", "psi", "mbar"), "force": ("N", "kN", "kgf", "daN")}


@dataclass(frozen=True)
class Lines:
    """What a draft says beside its channels: lines of ``rig`` and ``effects``, open choices."""

    rig: list[Entry]
    effects: list[Entry]
    choices: list[tuple[str, str]]
    position_step: float = 0.0


def draft_text(source: Source, found: Map, told: Lines, checks: list[str]) -> str:
    """Return the config; ``checks`` are sentences that nothing was done about."""
    lines = [f"# Drafted by eha_monitor {__version__} from {source.path.name}.",
             "# The comment behind each value gives its source; ASK marks missing values.",
             *(f"# {ASK}: {check}" for check in checks),
             *(f"# {ASK} {key}: {words}" for key, words in told.choices), "rig:"]
    lines += [_line(f"  {entry.key}: {entry.value}", entry.why, entry.ask) for entry in told.rig]
    lines += ["  tolerance:  # one standard deviation; diagnose fits each value within it"]
    lines += [_line(f"    {one.key}: {one.value}", one.why) for one in tolerances(told.rig)]
    if told.effects:
        lines += ["effects:", *(_line(f"  {one.key}: {one.value}", one.why)
                                for one in told.effects)]
    space = namespace_of(guess.candidate.place["topic"] for guess in found.channels.values()
                         ) if source.bag else ""
    if space not in ("", Monitor().namespace):
        lines += ["monitor:", _line(f"  namespace: {space}", "all topics of the bag are in it")]
    if told.position_step:  # a diagnosis need not find what a data sheet says
        lines += ["noise:", _line(f"  position_resolution: {number(told.position_step)}",
                                  "values: the encoder's step")]
    lines += ["channels:"] if source.bag else ["table:"]
    if not source.bag:
        lines += [_line(f"  {key}: {scalar(value)}", "values: how the file is laid out")
                  for key, value in source.table.items()]
        lines += _time(found.time)
        readable = not all(guess.full for guess in found.channels.values())
        lines += ["  columns:"] if readable else [
            _line("  columns: {}", "no channel was found", True)]
    margin = "  " if source.bag else "    "
    for name, guess in found.channels.items():
        if guess.full:
            all_, example = ("100 %", "'80 mm'") if guess.full == "share" else (
                "how many counts", "'27648 = 250 bar'")
            lines.append(f"{margin}# {ASK} {name}: {_in_kind(guess)}: how much is {all_}?  "
                         f"--set {name}.full={example}")
        else:
            lines.append(_channel(name, guess, margin))
    if found.unused:
        names = ", ".join(dumps(one.shown, ensure_ascii=False) for one in found.unused)
        lines.append(f"{margin}# not used: {names}")
    lines += [_line("thresholds:", "none yet: eha-monitor thresholds --from HEALTHY proposes "
                                   "limits",
                    True),
              "  viscous_damping: {low_error: null, low_warn: null, high_warn: null, "
              "high_error: null}",
              "  bulk_modulus: {low_error: null, low_warn: null, high_warn: null, "
              "high_error: null}"]
    return "\n".join(lines) + "\n"


def _in_kind(guess: Guess) -> str:
    kind = "per cent" if guess.full == "share" else "counts, volts or mA"
    return f"'{guess.candidate.shown}' is in {kind}"


def _line(text: str, why: str, ask: bool = False) -> str:
    return f"{text:<{_COLUMN}}  # {f'{ASK}: ' if ask else ''}{why}"


def _time(time: Guess | None) -> list[str]:
    if time is None:
        return [f"  # {ASK}: no column of the time was found; rows follow at rig.sample_time"]
    column = scalar(time.candidate.place["column"])
    lines = [_line(f"  time: {column}", time.why)]
    if time.unit:
        why = "header" if time.sure else "guessed from values"
        lines.append(_line(f"  time_scale: {time.unit}", why))
    return lines


def _channel(name: str, guess: Guess, margin: str) -> str:
    parts = [f"{key}: {scalar(value)}" for key, value in guess.candidate.place.items()]
    parts += [f"unit: {scalar(guess.unit)}"] if guess.unit else []
    parts += [f"{key}: {number(value)}" for key, value, usual in (
        ("scale", guess.scale, 1.0), ("offset", guess.offset, 0.0), ("delay", guess.delay, 0.0))
        if value != usual]
    if guess.clock:
        parts += [f"time: {scalar(guess.clock.candidate.place['column'])}",
                  f"time_scale: {guess.clock.unit}"]
    return _line(f"{margin}{name}: {{{', '.join(parts)}}}", guess.why)


ROUNDS = 4  # a swap may hide a unit, and that a sign


@dataclass(frozen=True)
class Draft:
    """A config in the making."""

    text: str  # the config as YAML
    map: Map
    settings: Settings
    recording: Recording | None  # as the config reads the file; None where it cannot yet
    # Keys that nobody has told yet, with the words of the question.
    asked: tuple[tuple[str, str], ...]
    judged: Plausibility  # what the checks say in the end
    problem: str = ""  # why the file cannot be read yet


def drafted(source: Source, answers: Answers) -> Draft:
    """Return the draft of a config for a recording.

    Raises InputError if an answer is of no use, in one line.
    """
    found = as_answered(_from_middle(_answered(_without_pump(
        guessed(source, answers.columns()), answers), answers), answers), answers)
    checks: list[str] = []
    step = Rig().sample_time
    for _ in range(ROUNDS):
        settings, text, lines, recording, problem = _read(source, found, answers, checks, step)
        if recording is None:
            return Draft(text, found, settings, None, _open(found, lines), Plausibility(), problem)
        step = recording.sample_time
        told = _told_alone(settings, lines.rig)
        better, checks = mended(found, plausibility_of(recording, told).findings, told)
        if better is found:
            better, said = not_absolute(found, recording, answers)
            checks += [said] if said else []
        if better is found:
            break
        found = better
    # Once more, since the last round may have left something to ask.
    settings, text, lines, recording, problem = _read(source, found, answers, checks, step)
    if recording is not None and (short := too_short(answers, seen_in(recording), found.rotary)):
        raise InputError(short)
    return Draft(text, found, settings, recording, _open(found, lines),
                 plausibility_of(recording, settings), problem)


def _read(source: Source, found: Map, answers: Answers, checks: list[str], step: float
          ) -> tuple[Settings, str, Lines, Recording | None, str]:
    """Return settings, text and rig of a map, and the recording as it reads it."""
    # The stamps of the file tell its sample time, whatever stands here.
    lines = _lines(source, found, answers, Seen(step))
    settings, text = _made(source, found, lines, checks)
    try:
        recording = read_recording(source.path, settings) if source.bag else read_table(
            source.path, settings, map_source="the draft")
    except InputError as problem:
        return settings, text, lines, None, str(problem)
    lines = _lines(source, found, answers, seen_in(recording))
    settings, text = _made(source, found, lines, checks)
    return settings, text, lines, recording, ""


def _lines(source: Source, found: Map, answers: Answers, seen: Seen) -> Lines:
    name = source.path.name.split(".")[0] or "my_rig"
    rig = rig_entries(answers, seen, found.rotary, name)
    # Nobody has to say what a unit says, or what there are no pressures for.
    known = not absolute(found) or "p1" not in found.channels
    choices = open_choices(answers, rig, seen, known)
    if found.machines:
        own, *others = found.machines
        choices = [("x.column", f"columns of several machines: {own}, {', '.join(others)}; {own} "
                    "moves most and is taken"), *choices]
    return Lines(rig, effects_of(answers, rig, seen), choices, seen.position_step)


def _without_pump(found: Map, answers: Answers) -> Map:
    """Return the map without a pump's speed where the machine has no pump."""
    speeds = {"omega", "omega_d"} & found.channels.keys() - answers.channels.keys()
    if not speeds or not answers.lacks("pump_displacement"):
        return found
    kept = {name: guess for name, guess in found.channels.items() if name not in speeds}
    return replace(found, channels=kept, unused=(*found.unused, *(
        found.channels[name].candidate for name in speeds)))


def _told_alone(settings: Settings, entries: list[Entry]) -> Settings:
    """Return the settings without the numbers that nobody has told: these bind no recording.

    What was computed from the recording agrees with any unit, and tells nothing of it.
    """
    tree = settings.model_dump(exclude_unset=True)
    for entry in entries:
        if entry.value != "null" and entry.ask:
            tree["rig"].pop(entry.key)
        elif entry.key == "position_gain" and entry.why.startswith("values"):
            tree["rig"][entry.key] = None
    return settings_from_tree(tree, "the draft")


def _made(source: Source, found: Map, lines: Lines, checks: list[str]) -> tuple[Settings, str]:
    text = draft_text(source, found, lines, checks)
    return settings_of(text, "the draft"), text


def _answered(found: Map, answers: Answers) -> Map:
    """Put units, scales and offsets that somebody has told into the map."""
    for name, keys in answers.channels.items():
        guess = found.time if name == "time" else found.channels.get(name)
        if guess is None:
            raise InputError(f"--set {name}: no column was found for it, name one with "
                             f"--set {name}.column=...")
        changed = _with(name, guess, keys, found.rotary)
        found = replace(found, time=changed) if name == "time" else found.with_channel(
            name, changed)
    return found


def _from_middle(found: Map, answers: Answers) -> Map:
    """Count x and x_d from the middle of the stroke, where its reading was answered."""
    middle = answers.middle()
    for name in ("x", "x_d") if middle is not None else ():
        guess = found.channels.get(name)
        if guess and not guess.full:
            offset = guess.offset - middle / unit_of(guess.unit).factor
            found = found.with_channel(name, replace(guess, offset=float(f"{offset:.10g}")))
    return found


def _with(name: str, guess: Guess, keys: dict[str, str], rotary: bool) -> Guess:
    numbers = {key: float(keys[key]) for key in ("scale", "offset") if key in keys}
    if "delay" in keys:
        guess = replace(guess, delay=of_channel(f"{name}.delay", keys["delay"], "s"))
    if "full" in keys:
        unit, scale = full_scale(name, keys["full"], guess.full or "counts")
        guess = replace(guess, unit=unit, scale=scale, full="", sure=True,
                        why=f"answered: {keys['full']} at full scale")
    if "unit" in keys:
        unit = keys["unit"]
        if name == "time" and not unit[:1].isdigit():
            unit = f"1 {unit}"
        guess = replace(guess, unit=unit, full="", sure=True, why="answered")
    if numbers:
        guess = replace(guess, **numbers, full="", sure=True, why="answered")
    if name != "time" and guess.unit:
        try:
            check_unit(name, guess.unit, rotary)
        except ValueError as problem:
            raise InputError(f"--set {name}: {problem}") from None
    return guess


def _open(found: Map, lines: Lines) -> tuple[tuple[str, str], ...]:
    """Return what nobody has told: key -> question."""
    asked = [(f"{name}.full", f"{_in_kind(guess)}; the full scale")
             for name, guess in found.channels.items() if guess.full]
    if "x" not in found.channels:
        asked.append(("x.column", "which column is the measured position"))
    return tuple(asked + lines.choices
                 + [(f"rig.{entry.key}", entry.why) for entry in lines.rig if entry.ask])


# ---- what the recording itself corrects: signs, swaps, units, gauge pressures -------------------


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
        unit = next((text for text in TIMES if isclose(to_si(text, "s"), scale, rel_tol=1e-6)),
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
            if not guess.unit or counted_from(guess.unit):
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
        over = counted_from(guess.unit)  # "gauge" stays what was answered
        return replace(guess, unit=f"{unit} {over}" if over else unit, why=_told(finding))
    return replace(guess, scale=float(f"{guess.scale * factor:.10g}"), why=_told(finding))


def _told(finding: ChannelFinding) -> str:
    return f"values: {finding.finding}"


def as_answered(found: Map, answers: Answers) -> Map:
    """Take the pressures as ``pressures`` was answered, unless their unit says it itself.

    Both answers stand in the unit, so that nothing that the values look like overrules them.
    """
    answered = answers.rig.get("pressures")
    for name in ("p1", "p2") if answered else ():
        guess = found.channels.get(name)
        said = counted_from(guess.unit) if guess else ""
        if said and said != answered:
            raise InputError(f"--set pressures={answered}: '{guess.candidate.shown}' is in "
                             f"'{guess.unit}', which is {said}; expected pressures={said}, or "
                             f"another {name}.unit")
        if guess and not guess.full and not said:
            found = _counted_from(found, name, answered, f"answered: {answered}")
    return found


def absolute(found: Map) -> list[str]:
    """Return the pressures whose unit does not say what it is counted from."""
    return [name for name in ("p1", "p2") if name in found.channels
            and found.channels[name].unit and not counted_from(found.channels[name].unit)]


def _counted_from(found: Map, name: str, over: str, why: str) -> Map:
    """Return the map with a pressure that is counted so; its unit by its size where none is said.

    What the recording corrects is a factor, and a zero is not multiplied: it begins near.
    """
    guess = found.channels[name]
    most = np.nanmax(np.abs(guess.candidate.values))
    sized = "" if guess.unit or most >= LEAST_PA else "bar" if most < MOST_BAR else "kPa"
    return found.with_channel(name, replace(
        guess, unit=f"{sized or guess.unit or 'Pa'} {over}",
        why=f"{why}; {sized} by its size" if sized else why))


def not_absolute(found: Map, recording: Recording, answers: Answers) -> tuple[Map, str]:
    """Take pressures that stay below the atmosphere's for gauge ones; what is to be said else.

    A chamber that cavitates is below it for moments: a hundredth of the samples must be.
    """
    open_ = absolute(found)
    low = {name: float(np.nanquantile(recording.get(name), 0.01)) for name in ("p1", "p2")
           if name in recording.channels and np.isfinite(recording.get(name)).any()
           and (guess := found.channels.get(name)) and guess.unit
           and counted_from(guess.unit) != "gauge"}
    if not low or min(low.values()) > BELOW:
        return found, ""
    name = min(low, key=low.get)
    why = (f"{name} goes down to {low[name] / 1e5:.2f} bar, and an absolute pressure of a chamber "
           "at rest is not below 1 bar")
    if answers.rig.get("pressures") == "absolute":
        return found, f"{why}: are these gauge pressures?  --set pressures=gauge"
    if name not in open_:
        return found, f"{why}: is '{found.channels[name].unit}' right?"
    for name in open_:
        found = _counted_from(found, name, "gauge", f"values: {why}")
    return found, ""
