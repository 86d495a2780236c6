"""``estimate``, ``diagnose`` and ``advise``: what recordings say, printed and written."""

import shlex
from collections.abc import Sequence
from functools import partial
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eha_monitor.commands import common
from eha_monitor.errors import InputError
from eha_monitor.output import write_json, write_text

if TYPE_CHECKING:
    from eha_monitor.api.advise import Advice


@click.command()
@click.argument("bag", type=common.FILE)
@common.config_option
@common.json_option
@common.report_option
@common.write_config_option("Write the config with signs, units and channels corrected where "
                            "the recording contradicts them; not written if there is no "
                            "contradiction.")
@click.option("--exit-code", is_flag=True,
              help="Exit with 1 if an alarm is active or the model does not fit.")
@common.archive_options
def estimate(bag: Path, config: Path | None, json_file: Path | None, report_file: Path | None,
             config_file: Path | None, exit_code: bool, **of_folder) -> int:
    """Estimate B and the bulk modulus from BAG and check them against the thresholds.

    If BAG is a folder of bags, process all of them into one table with trends over time.
    """
    archive = common.Archive(**of_folder)
    if archive.covers(bag, json=json_file, report=report_file, write_config=config_file):
        from eha_monitor.commands.archive_rows import answer_folder

        return int(answer_folder("estimate", bag, config, archive) and exit_code)
    common.check_outputs({"--json": json_file, "--report": report_file,
                          "--write-config": config_file}, (bag,), config)

    from eha_monitor.api.config import config_of
    from eha_monitor.api.estimate import estimate as run
    from eha_monitor.api.estimate import refusal
    from eha_monitor.api.read import corrected_config

    given = config_of(config)
    with common.refusing(given, config, json_file, config_file, refusal), common.working(
            f"reading {bag}") as told:
        found = run(bag, given, progress=lambda text, share: told(text))
    if json_file or report_file:
        with common.working("computing what each combination of channels could identify"):
            found.observability  # noqa: B018  computed when it is asked for
    if json_file:
        write_json(json_file, found.to_dict())
    corrects = any(finding.correction for finding in found.channels)
    if config_file and corrects:
        write_text(config_file, corrected_config(found.channels, given.settings, config))
    if report_file:
        with common.working(f"drawing {report_file}"):
            found.report(report_file)

    from eha_monitor.commands.table import show

    show(found, found.alarms, [path for path in (json_file, report_file) if path],
         found.indicators, config)
    if config_file:
        click.echo(f"{config_file}: written" if corrects else f"{config_file}: not written, since "
                   "the recording contradicts no sign, unit or channel of the config")
    return int(exit_code and not found.healthy)


@click.command(cls=common.Several)
@common.bags_argument
@common.config_option
@common.json_option
@common.report_option
@common.write_config_option("Write the config with the identified effects and corrected rig data.")
@click.option("--out-bag", type=common.FILE, metavar="BAG",
              help="Write measured, modelled and missing signals as a bag (docs/exports.md).")
@click.option("--held-out", type=common.FILE, metavar="BAG",
              help="Show the fit on this recording; default: on a held-out part of BAG.")
@click.option("--hypothesis", "hypothesis_file", type=common.FILE, metavar="FILE|NAME",
              help="Your own hypothesis, a file or the name of an installed one: an expression "
                   "whose parameters are fitted and which is ranked with the catalogue "
                   "(docs/effects.md).")
@click.option("--reference", "references", type=common.FILE, multiple=True,
              metavar="HEALTHY [HEALTHY ...]",
              help="Healthy recordings of the machine, a folder of them, or the file that "
                   "--machine wrote: report what has changed from these. Give BAG before it.")
@click.option("--without", multiple=True, metavar="EFFECT [EFFECT ...]",
              help="Effects of the catalogue to exclude, such as those that this rig cannot have.")
@click.option("--vary", multiple=True, type=click.Choice(["load"]),
              help="What is known to differ between several BAGs.")
@click.option("--machine", "machine_file", type=common.FILE, metavar="FILE",
              help="With several BAGs: write the machine that they show. With one, or a folder of "
                   "bags: judge each against that machine, in seconds (docs/one_machine.md).")
@click.option("--exit-code", is_flag=True,
              help="Exit with 1 if the model does not fit the recording.")
@common.archive_options
def diagnose(bags: tuple[Path, ...], config: Path | None, json_file: Path | None,
             report_file: Path | None, config_file: Path | None, out_bag: Path | None,
             held_out: Path | None, hypothesis_file: Path | None, references: tuple[Path, ...],
             without: tuple[str, ...], vary: tuple[str, ...], machine_file: Path | None,
             exit_code: bool, **of_folder) -> int:
    """Locate where BAG and the model differ, identify the missing effects, show the better fit.

    Several BAGs of one rig are diagnosed together. With --reference the result is what has
    changed from healthy recordings, or that nothing has. If BAG is a folder of bags, each is
    diagnosed separately, into one table with trends over time.
    """
    archive = common.Archive(**of_folder)
    if len(bags) > 1 and any(map(archive.covers, bags)):
        raise InputError("expected one folder that holds bags, or bags, got "
                         + ", ".join(map(str, bags)))
    if archive.covers(bags[0], json=json_file, report=report_file, write_config=config_file,
                      out_bag=out_bag, held_out=held_out, hypothesis=hypothesis_file,
                      reference=references, without=without, vary=vary):
        from eha_monitor.commands.archive_rows import answer_folder

        return int(answer_folder("diagnose", bags[0], config, archive, machine_file) and exit_code)
    from eha_monitor.api.config import config_of
    from eha_monitor.api.diagnose import bags_of, completed, known_effects, refusal, written_config
    from eha_monitor.api.diagnose import diagnose as run
    from eha_monitor.api.read import distinct
    from eha_monitor.balances.machine import save
    from eha_monitor.reports.diagnosis_words import channels_in_parts, not_in_config
    from eha_monitor.settings.hypothesis import load_hypothesis
    from eha_monitor.words import effect_words

    file = next((one for one in references if one.suffix == ".json" and one.is_file()), None)
    if file and (len(references) > 1 or machine_file):
        raise InputError(f"--reference: expected recordings, or {file} alone, a machine's file")
    references = () if file else tuple(bag for one in references for bag in bags_of(one))
    distinct(bags, held_out, references, "--held-out")
    if references and (held_out or hypothesis_file or without):
        raise InputError("--reference: expected neither --held-out, --hypothesis nor --without "
                         "beside it")
    common.check_outputs({"--json": json_file, "--report": report_file,
                          "--write-config": config_file},
                         (*bags, *references, *((held_out,) if held_out else ())), config)
    if out_bag:
        check_out_bag(out_bag, (*bags, *references))
    known_effects(without, "--without")
    several = len(bags) > 1 and not file
    machine_file = file or machine_file
    if machine_file and several:
        common.check_outputs({"--machine": machine_file}, bags, config)
    given = config_of(config)
    hypothesis = load_hypothesis(hypothesis_file) if hypothesis_file else None
    with common.progress_bar() as told, common.refusing(
            given, config, json_file, config_file, partial(refusal, bags)):
        found = run(bags, given, held_out=held_out, references=references, hypothesis=hypothesis,
                    without=without, vary=vary,
                    machine=None if several else machine_file, progress=told)
    notes = list(channels_in_parts(found)[1])
    if json_file:
        write_json(json_file, found.to_dict())
    if machine_file and several:
        if found.machine is None:
            raise InputError("--machine: expected at least three BAGs that move, with the force "
                             "of the piston")
        save(found.belonging, machine_file)
        notes += [f"{machine_file}: without {one.source}, which does not belong" for one in (
            found.belonging.odd if len(found.belonging.sources) < len(bags) else ())]
    if config_file:
        write_text(config_file, written_config(found, given.settings, config))
        if not completed(found, given.settings)[1]:
            notes.append(f"{config_file}: the config as it was, since nothing was identified")
        elif lacks := not_in_config(found):
            notes += [f"{config_file}: without {effect_words(name)}: {why}; another diagnosis "
                      "with it finds that again" for name, why in lacks.items()]
    if report_file:
        with common.working(f"drawing {report_file}"):
            found.report(report_file, command=command_line(
                bags, config, held_out, hypothesis_file, references, without, vary, machine_file))

    from eha_monitor.commands.table import show_diagnosis

    show_diagnosis(found, given.settings, [path for path in (
        json_file, report_file, config_file, machine_file if several else None) if path],
        notes, found.indicators)
    if out_bag:
        write_out_bag(out_bag, found, bags, given.settings)
    return int(exit_code and not found.healthy)


def command_line(bags: tuple[Path, ...], config: Path | None, held_out: Path | None,
                 hypothesis: Path | None = None, references: tuple[Path, ...] = (),
                 without: tuple[str, ...] = (), vary: tuple[str, ...] = (),
                 machine: Path | None = None) -> str:
    """Return the command that makes the same answer again."""
    words = ["eha-monitor", "diagnose", *map(str, bags)]
    for option, given in (("--config", config), ("--held-out", held_out),
                          ("--hypothesis", hypothesis), ("--reference", references),
                          ("--without", without), ("--vary", vary), ("--machine", machine)):
        if given:
            words += [option, *map(str, given if isinstance(given, tuple) else (given,))]
    return shlex.join(words)


def check_out_bag(place: Path, bags: Sequence[Path]) -> None:
    """Refuse, before the work, a place for the bag that is taken, or is in a bag that is read."""
    if place.resolve() in [bag.resolve() for bag in bags]:
        raise InputError(f"{place}: is a bag that is read, expected another place for --out-bag")
    if not place.absolute().parent.is_dir():
        raise InputError(f"{place}: the folder {place.parent} does not exist")
    common.check_new(place, False)


def write_out_bag(place: Path, found, bags: Sequence[Path], settings) -> None:
    """Write the bag of a diagnosis, and say what is in it."""
    if found.verdict == "insufficient_data":
        click.echo(f"{place}: not written, there is no model: {found.message}")
        return
    from eha_monitor.api.diagnose import written_config
    from eha_monitor.mismatch.show.series import series_of, write_diagnosis_bag
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings.load import settings_of

    named = settings_of(written_config(found, settings, None), "the diagnosed config")
    recordings = [read_recording(bag, settings) for bag in bags]
    series = series_of(recordings, settings, named)
    topics = write_diagnosis_bag(place, series, recordings, settings.monitor.namespace)
    seconds = sum(len(next(iter(one.measured.values()))) * one.dt for one in series)
    click.echo(f"{place}: {seconds:.1f} s, topics {', '.join(topics)}")


@click.command()
@common.bags_argument
@common.config_option
@common.json_option
@click.option("--write-excitation", "excitation_file", type=common.FILE, metavar="FILE",
              help="Write the config with the proposed motion, for simulator and simulate.")
@click.option("--check/--no-check", default=True,
              help="Test the proposed motion in a simulation with noise.")
def advise(bags: tuple[Path, ...], config: Path | None, json_file: Path | None,
           excitation_file: Path | None, check: bool) -> None:
    """Report which effects BAG can and cannot distinguish, and the shortest motion that would.

    The motion keeps within the travel and the pump speed of BAG.  Its gain is predicted, then
    checked in simulation.
    """
    from eha_monitor.api.advise import advise as run
    from eha_monitor.api.advise import written_excitation
    from eha_monitor.api.config import config_of
    from eha_monitor.api.read import distinct

    distinct(bags)
    common.check_outputs({"--json": json_file, "--write-excitation": excitation_file}, bags,
                         config)
    given = config_of(config)
    with common.progress_bar() as told:
        found = run(bags, given, check=check, progress=told)
    motion = found.motion
    if json_file:
        write_json(json_file, found.to_dict())
    if excitation_file and motion is not None:
        write_text(excitation_file, written_excitation(motion, given.settings, bags))
    show_advice(bags, found)
    for finding in found.channels:
        click.echo(f"note: {finding.finding}")
    for path in (json_file, excitation_file):
        if path is not None and (path is json_file or motion is not None):
            click.echo(f"written: {path}")
        elif path is not None:
            click.echo(f"{path}: not written, no motion is proposed")


def show_advice(bags: tuple[Path, ...], found: "Advice") -> None:
    """Print what the recording distinguishes and leaves open, and the motion as YAML."""
    from rich.markup import escape
    from ruamel.yaml import YAML

    from eha_monitor.api.advise import HEADS, named_words, parameter_rows
    from eha_monitor.commands.table import console, table
    from eha_monitor.mismatch.advise.motions import excitation_tree
    from eha_monitor.mismatch.advise.words import doubt_words
    from eha_monitor.quantity import NOTE, number
    from eha_monitor.reports.diagnosis_words import log_units, sentence

    to = console()
    to.print(escape(f"{', '.join(map(str, bags))}: {named_words(found)}"))
    to.print(table(*HEADS, rows=parameter_rows(found)))
    to.print(NOTE, style="dim")
    for text in found.sentences:
        to.print(f"- {escape(sentence(text))}")
    if found.tried:
        rows = table("motion", "s", *(escape(doubt_words(d)) for d in found.doubts),
                     caption_justify="left",
                     caption="log units together with this recording; 20 decide")
        for one in found.tried:
            mark = "[green]" if found.motion is not None and one.motion is found.motion else ""
            rows.add_row(f"{mark}{one.motion.name}", number(one.motion.duration, 3),
                          *(log_units(max(gain, 0.0)) for gain in one.gains))
        to.print(rows)
    if found.motion is not None:
        text, yaml = StringIO(), YAML(typ="safe")
        yaml.default_flow_style = False
        yaml.sort_base_mapping_type_on_output = False
        yaml.dump({"simulation": {"excitation": excitation_tree(found.motion)}}, text)
        to.print(escape(text.getvalue()), end="", soft_wrap=True)
