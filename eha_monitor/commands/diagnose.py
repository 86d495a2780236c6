"""``diagnose``: where simulation and recording differ, which physics that is, and the proof."""

import shlex
from collections.abc import Sequence
from pathlib import Path

import click

from eha_monitor.commands import common
from eha_monitor.errors import InputError
from eha_monitor.output import write_json, write_text


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
              help="With several BAGs: write the machine that they show. With one: judge it "
                   "against that machine, in a fraction of a second (docs/one_machine.md).")
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
                      reference=references, without=without, vary=vary, machine=machine_file):
        from eha_monitor.commands.archive_rows import answer_folder

        return int(answer_folder("diagnose", bags[0], config, archive) and exit_code)
    from eha_monitor.api.config import config_of
    from eha_monitor.api.diagnose import bags_of, known_effects
    from eha_monitor.api.diagnose import diagnose as run
    from eha_monitor.api.diagnosis_answer import completed, refusal, written_config
    from eha_monitor.api.read import distinct, finding_tree
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
    check_out_bag(out_bag, (*bags, *references))
    known_effects(without, "--without")
    several = len(bags) > 1 and not file
    machine_file = file or machine_file
    if machine_file and several:
        common.check_outputs({"--machine": machine_file}, bags, config)
    given = config_of(config)
    hypothesis = load_hypothesis(hypothesis_file) if hypothesis_file else None
    with common.progress_bar() as told, common.refusing(
            given, config, json_file, config_file, lambda problem: refusal(
            bags, str(problem), finding_tree(problem.channels))):
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

    show_diagnosis(found, [path for path in (json_file, report_file, config_file,
                                     machine_file if several else None) if path],
         notes, found.indicators, given.settings)
    write_out_bag(out_bag, found, bags, given.settings)
    return int(exit_code and not found.healthy)


def command_line(bags: tuple[Path, ...], config: Path | None, held_out: Path | None,
                 hypothesis: Path | None = None, references: tuple[Path, ...] = (),
                 without: tuple[str, ...] = (), vary: tuple[str, ...] = (),
                 machine: Path | None = None) -> str:
    """Return the command that makes the same answer again."""
    words = ["eha-monitor", "diagnose", *map(str, bags)]
    words += ["--config", str(config)] if config else []
    words += ["--held-out", str(held_out)] if held_out else []
    words += ["--hypothesis", str(hypothesis)] if hypothesis else []
    words += ["--reference", *map(str, references)] if references else []
    words += ["--without", *without] if without else []
    words += ["--vary", *vary] if vary else []
    words += ["--machine", str(machine)] if machine else []
    return shlex.join(words)


def check_out_bag(place: Path | None, bags: Sequence[Path]) -> None:
    """Refuse, before the work, a place for the bag that is taken, or is in a bag that is read."""
    if place is None:
        return
    if place.resolve() in [bag.resolve() for bag in bags]:
        raise InputError(f"{place}: is a bag that is read, expected another place for --out-bag")
    if not place.absolute().parent.is_dir():
        raise InputError(f"{place}: the folder {place.parent} does not exist")
    common.check_new(place, False)


def write_out_bag(place: Path | None, found, bags: Sequence[Path], settings) -> None:
    """Write the bag of a diagnosis, and say what is in it; nothing without a place."""
    if place is None:
        return
    if found.verdict == "insufficient_data":
        click.echo(f"{place}: not written, there is no model: {found.message}")
        return
    from eha_monitor.api.diagnosis_answer import written_config
    from eha_monitor.mismatch.show.series import series_of, write_diagnosis_bag
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings.load import settings_of

    named = settings_of(written_config(found, settings, None), "the diagnosed config")
    recordings = [read_recording(bag, settings) for bag in bags]
    series = series_of(recordings, settings, named)
    topics = write_diagnosis_bag(place, series, recordings, settings.monitor.namespace)
    seconds = sum(len(next(iter(one.measured.values()))) * one.dt for one in series)
    click.echo(f"{place}: {seconds:.1f} s, topics {', '.join(topics)}")
