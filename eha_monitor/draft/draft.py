"""From a recording and answers to a draft that the recording itself has been asked about."""

from dataclasses import dataclass, replace

from eha_monitor.draft.answers import Answers, full_scale
from eha_monitor.draft.guess import Guess, Map, guessed
from eha_monitor.draft.mend import mended
from eha_monitor.draft.rig import Entry, Seen, rig_entries, seen_in
from eha_monitor.draft.sources import Source
from eha_monitor.draft.text import draft_text
from eha_monitor.errors import InputError
from eha_monitor.plausibility.judge import Plausibility, plausibility_of
from eha_monitor.recordings.importing import read_table
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.load import settings_from_tree, text_tree
from eha_monitor.settings.measured import check_unit
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig

ROUNDS = 4  # a swap may hide a unit, and that a sign


@dataclass(frozen=True)
class Draft:
    """A config in the making.

    Attributes
    ----------
    text : the config as YAML.
    settings, recording : as the config reads the file; None where it cannot be read yet.
    asked : keys that nobody has told yet, with the words of the question.
    judged : what the checks say in the end.
    problem : why the file cannot be read yet, or "".
    """

    text: str
    map: Map
    settings: Settings
    recording: Recording | None
    asked: tuple[tuple[str, str], ...]
    judged: Plausibility
    problem: str = ""


def drafted(source: Source, answers: Answers) -> Draft:
    """Return the draft of a config for a recording.

    Raises
    ------
    InputError
        If an answer is of no use, in one line.
    """
    found = _answered(guessed(source, answers.columns()), answers)
    checks: list[str] = []
    for _ in range(ROUNDS):
        settings, text, entries, recording, problem = _read(source, found, answers, checks)
        if recording is None:
            return Draft(text, found, settings, None, _open(found, entries), Plausibility(),
                         problem)
        told = _told_alone(settings, entries)
        better, checks = mended(found, plausibility_of(recording, told).findings, told)
        if better is found:
            break
        found = better
    # Once more, since the last round may have left something to ask.
    settings, text, entries, recording, problem = _read(source, found, answers, checks)
    return Draft(text, found, settings, recording, _open(found, entries),
                 plausibility_of(recording, settings), problem)


def _read(source: Source, found: Map, answers: Answers, checks: list[str]
          ) -> tuple[Settings, str, list[Entry], Recording | None, str]:
    """Return settings, text and rig of a map, and the recording as it reads it."""
    name = source.path.name.split(".")[0] or "my_rig"
    # The stamps of the file tell its sample time, whatever stands here.
    entries = rig_entries(answers, Seen(Rig().sample_time), found.rotary, name)
    settings, text = _made(source, found, entries, checks)
    try:
        recording = read_recording(source.path, settings) if source.bag else read_table(
            source.path, settings, map_source="the draft")
    except InputError as problem:
        return settings, text, entries, None, str(problem)
    entries = rig_entries(answers, seen_in(recording), found.rotary, name)
    settings, text = _made(source, found, entries, checks)
    return settings, text, entries, recording, ""


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


def _made(source: Source, found: Map, entries: list[Entry], checks: list[str]
          ) -> tuple[Settings, str]:
    text = draft_text(source, found, entries, checks)
    return settings_from_tree(text_tree(text, "the draft"), "the draft"), text


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


def _with(name: str, guess: Guess, keys: dict[str, str], rotary: bool) -> Guess:
    numbers = {key: float(keys[key]) for key in ("scale", "offset") if key in keys}
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


def _open(found: Map, entries: list[Entry]) -> tuple[tuple[str, str], ...]:
    """Return what nobody has told: key -> question."""
    asked = [(f"{name}.full", f"'{guess.candidate.shown}' is in "
              f"{'per cent' if guess.full == 'share' else 'counts'}; the full scale")
             for name, guess in found.channels.items() if guess.full]
    if "x" not in found.channels:
        asked.append(("x.column", "which column is the measured position"))
    return tuple(asked + [(f"rig.{entry.key}", entry.why) for entry in entries if entry.ask])
