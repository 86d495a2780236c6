"""``init``: a first config for a recording that nobody has described, and the first answer."""

import shlex
import sys
from pathlib import Path

import click

from eha_monitor.commands.common import FILE, check_target, working
from eha_monitor.errors import InputError
from eha_monitor.output import write_text

# What a person at the terminal is asked of the data sheet, in this order; the choices come first,
# the rest stays as the draft has it.
SHEET = (
    ("bore", "bore of the cylinder, such as 50 mm"), ("rod", "diameter of its rod, such as 28 mm"),
    ("rods", "rod on 1 or on 2 sides"), ("stroke", "stroke, such as 200 mm"),
    ("line_volume", "oil in the line to one chamber, such as 10 cm^3"),
    ("mass", "moving mass, such as 20 kg"),
    ("pump_displacement", "pump displacement, of two pumps chamber 1's, such as "
     "1.6 cm^3/rev"),
    ("charge_pressure", "absolute pressure of the make-up source, such as 20 bar or 19 bar gauge"),
    ("leakage", "leakage of all paths, such as 0.15 l/min at 100 bar, or C_T in m³/(s·Pa)"),
)
# Key of the config -> questions that answer it.
_ANSWERS = {"area_1": ("bore",), "area_2": ("rod", "rods"), "volume_1": ("stroke", "line_volume"),
            "volume_2": ("stroke", "line_volume")}
# What a rotary actuator is asked in place of bore, rod, stroke and mass of a cylinder.
_ROTARY = {"bore": ("area_1", "displacement of the actuator, such as 120 cm^3/rad"),
           "stroke": ("stroke", "whole angle, such as 270 deg"),
           "mass": ("mass", "moment of inertia, such as 3 kg m^2"),
           "friction": ("friction", "dry friction of seals, such as 12 N m, or none")}
# Question -> those that its answer makes sensible, and with which answer ("": any).
_THEN = {"load": (("gravity", "inclination"), ("spring", "spring"), ("spring", "spring_rest")),
         "stroke": (("", "zero"),), "check_valve": (("", "check_valve_opens"),),
         "relief_valve": (("", "relief_pressure"),)}


@click.command()
@click.argument("file", type=FILE)
@click.option("--out", type=FILE, default=Path("my_rig.yaml"),
              show_default=True, metavar="FILE.yaml", help="The config to write.")
@click.option("--set", "given", multiple=True, metavar="KEY=VALUE",
              help="A value: rig.area_1='5.05 cm^2', rig.bore='50 mm', x.column='Weg [mm]', "
              "x.full='80 mm' (at 100 %), machine=two_pumps, load=gravity, inclination='20 deg', "
              "zero=retracted, pressures=gauge; several times.")
@click.option("--yes", is_flag=True, help="Ask nothing: unknown values stay marked ASK.")
@click.option("--overwrite", is_flag=True, help="Replace an existing config.")
def init(file: Path, out: Path, given: tuple[str, ...], yes: bool, overwrite: bool) -> None:
    """Draft a config for FILE (CSV, MAT or bag), check it, and run the first estimate.

    Columns, units and time are guessed from header and values; what cannot be guessed is asked
    for on a terminal; otherwise it is marked ASK in the config.
    """
    from eha_monitor.draft.answers import answers_of
    from eha_monitor.draft.draft import drafted
    from eha_monitor.draft.sources import source_of

    answers = answers_of(given)
    check_target(out, file)
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists already, expected a new file, or --overwrite")
    with working(f"reading {file}"):
        source = source_of(file)
        draft = drafted(source, answers)
    if sys.stdin.isatty() and not yes and draft.asked:
        answers = _asked(draft, answers, given)
        draft = drafted(source, answers)
    write_text(out, draft.text)
    _tell(draft)
    _first_estimate(draft, out)
    _next(file, out, draft, source.bag)


def _asked(draft, answers, given):
    """Ask at the terminal for what is open; an empty answer leaves it open."""
    from eha_monitor.draft.answers import CHOICES, answers_of
    from eha_monitor.draft.rig import PARTS, QUESTIONS, Seen, seen_in

    rotary, wanted = answers.turns(draft.map.rotary), []
    seen = Seen(1.0) if draft.recording is None else seen_in(draft.recording)
    for key, question in sorted(draft.asked, key=lambda one: one[0] == "parts"):  # these last
        name = key.removeprefix("rig.")
        if name in (*CHOICES, *QUESTIONS) or key.endswith((".full", ".column")):
            wanted.append((key, question))
            continue
        wanted += [(part, words) for part in {**_ANSWERS, "parts": PARTS}.get(name, (name,))
                   for of, words in (*SHEET, *PARTS.items()) if of == part]
    if rotary:
        wanted = [_ROTARY.get(key, (key, words)) for key, words in wanted
                  if key not in ("rod", "rods")]
    said = list(given)
    click.echo("Press Enter to skip a question.", err=True)
    wanted = list(dict.fromkeys(wanted))
    while wanted:
        key, question = wanted.pop(0)
        if key in answers.rig or answers.lacks(key):
            continue
        text = _answer(key, question, said, seen, rotary)
        answers = answers_of(tuple(said))
        wanted[:0] = [(then, QUESTIONS[then]) for on, then in _THEN.get(key, ())
                      if text and text == (on or text) and not answers.none(key)]
    return answers


def _answer(key, question, said, seen, rotary):
    """Ask until the answer can be read, add it to what was said, and return it."""
    from eha_monitor.draft.answers import answers_of
    from eha_monitor.draft.rig import no_such_zero, too_short

    while True:
        text = click.prompt(question, default="", show_default=False, err=True).strip()
        try:
            if text:
                answers = answers_of((*said, f"{key}={text}"))
                if key == "stroke" and (short := too_short(answers, seen, rotary)):
                    raise InputError(short)
                if key == "zero" and (outside := no_such_zero(answers, seen, rotary)):
                    raise InputError(outside)
                said.append(f"{key}={text}")
            return text
        except InputError as problem:
            click.echo(str(problem), err=True)


def _tell(draft) -> None:
    """Print which column became which channel, and what the recording says against it."""
    from eha_monitor.commands.table import console, table

    to, time = console(), [("time", draft.map.time)] if draft.map.time else []
    to.print(table("channel", "column", "unit", "where from", rows=(
        (name, guess.candidate.shown,
         guess.full or ("" if guess.scale == 1.0 else f"{guess.scale:g} ") + guess.unit, guess.why)
        for name, guess in (*time, *draft.map.channels.items()))))
    for name, guess in draft.map.channels.items():
        if guess.clock:
            to.print(f"time of {name}: {guess.clock.why}, {guess.clock.unit}", markup=False)
    if draft.map.unused:
        to.print(f"not used: {', '.join(one.shown for one in draft.map.unused)}", markup=False)
    if draft.asked:
        to.print("missing values (ASK in the file):", markup=False)
        for key, question in draft.asked:
            to.print(f"  {key}: {question}", markup=False)
    for finding in draft.judged.findings:
        to.print(f"check: {finding.finding}", markup=False)


def _first_estimate(draft, out: Path) -> None:
    """Run the first estimate where the draft can be read, and say why where it cannot."""
    from eha_monitor.recordings.recording import SHORTEST_S

    if draft.recording is None:
        click.echo(f"no estimate yet: {draft.problem}")
        return
    if draft.judged.blocking:
        click.echo("no estimate yet: recording and config contradict each other, see check above")
        return
    if draft.recording.duration < SHORTEST_S:
        click.echo(f"no estimate yet: the recording is {draft.recording.duration:.3g} s long, "
                   f"expected at least {SHORTEST_S:g} s; is the unit of the time right?")
        return
    from eha_monitor.api.estimate import judged
    from eha_monitor.commands.table import show
    from eha_monitor.compiled import load_runtime
    from eha_monitor.estimation.pipeline import estimate
    from eha_monitor.estimation.zero import at_one_zero

    load_runtime()
    try:
        with working("estimating"):
            recording, _ = at_one_zero(draft.recording, draft.settings)
            found = estimate(recording, draft.settings)
            alarms, _ = judged(found)
    except InputError as problem:
        click.echo(f"no estimate yet: {problem}")
        return
    show(found, alarms, [], config=out)


def _next(file: Path, out: Path, draft, bag: bool) -> None:
    """Print the next three commands."""
    config, recording = shlex.quote(str(out)), shlex.quote(str(file))
    name = "my_bag" if not bag else recording
    click.echo(f"written: {out}" + (f", {len(draft.asked)} values marked ASK" if draft.asked
                                    else ""))
    click.echo("next:")
    if any(key in ("rig.area_1", "x.column") for key, _ in draft.asked):
        click.echo(f"  write what is missing into {config}, where it says ASK, or answer with "
                   "--set")
    if not bag:
        click.echo(f"  eha-monitor import {recording} --map {config} --out {name}")
    click.echo(f"  eha-monitor estimate {name} --config {config} --report my_report.html")
    click.echo(f"  eha-monitor diagnose {name} --config {config} --report why.html")
    if bag:
        click.echo(f"  eha-monitor thresholds --from {name} --config {config} "
                   "--write-config judged.yaml")
