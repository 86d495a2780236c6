"""``diagnose``: where simulation and recording differ, which physics that is, and the proof."""

import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from eha_monitor.archive.find import find_bags, is_archive
from eha_monitor.commands.archive import Archive, answer_folder, archive_options, refuse
from eha_monitor.commands.common import Several, check_outputs, config_option, on_terminal
from eha_monitor.errors import InputError
from eha_monitor.output import write_json, write_text

_PATH = click.Path(path_type=Path)
READING = 0.03  # share of the progress bar


@click.command(cls=Several)
@click.argument("bags", type=_PATH, nargs=-1, required=True, metavar="BAG [BAG ...]")
@config_option
@click.option("--json", "json_file", type=_PATH, metavar="FILE", help="Write the answer as JSON.")
@click.option("--report", "report_file", type=_PATH, metavar="FILE.html",
              help="Write a self-contained HTML report.")
@click.option("--write-config", "config_file", type=_PATH, metavar="FILE",
              help="Write the config with the named physics and the rig's numbers in it.")
@click.option("--held-out", "held_out", type=_PATH, metavar="BAG",
              help="Show the fit on this recording; without it on a part that is kept back.")
@click.option("--hypothesis", "hypothesis_file", type=_PATH, metavar="FILE|NAME",
              help="Your own suspicion, a file or the name of an installed one: an expression "
              "whose parameters are fitted and ranked beside the catalogue (docs/effects.md).")
@click.option("--reference", "references", type=_PATH, multiple=True,
              metavar="HEALTHY [HEALTHY ...]",
              help="Healthy recordings of the machine, or a folder of them: say what has changed "
              "against these.  Give BAG before it.")
@click.option("--without", multiple=True, metavar="EFFECT [EFFECT ...]",
              help="Entries of the catalogue that this rig cannot have, or for a trial: they are "
              "not considered.")
@click.option("--calibration/--no-calibration", hidden=True, expose_value=False,
              help="Does nothing; it chose how a threshold was set that there is no more.")
@click.option("--exit-code", is_flag=True,
              help="Exit with 1 if the model does not fit the recording.")
@archive_options
def diagnose(bags: tuple[Path, ...], config: Path | None, json_file: Path | None,
             report_file: Path | None, config_file: Path | None, held_out: Path | None,
             hypothesis_file: Path | None, references: tuple[Path, ...], without: tuple[str, ...],
             exit_code: bool, **asked) -> int:
    """Say where BAG and the model differ, what physics was left out, and show the fit improve.

    Several BAGs of one rig are explained together.  With --reference the answer is what has
    changed against healthy recordings, or that nothing has.  Where BAG is a folder that holds
    bags, each is explained by itself, into one table with trends over time.
    """
    archive = Archive(**asked)
    if any(archive.covers(bag) for bag in bags):
        if len(bags) > 1:
            raise InputError("expected one folder that holds bags, or bags, got "
                             + ", ".join(map(str, bags)))
        refuse(bags[0], json=json_file, report=report_file, write_config=config_file,
               held_out=held_out, hypothesis=hypothesis_file, reference=references,
               without=without)
        return int(answer_folder("diagnose", bags[0], config, archive) and exit_code)
    references = unfolded(references)
    check_inputs(bags, held_out, references)
    if references and (held_out or hypothesis_file or without):
        raise InputError("--reference: expected neither --held-out, --hypothesis nor --without "
                         "beside it")
    check_outputs({"--json": json_file, "--report": report_file, "--write-config": config_file},
                  (*bags, *references, *((held_out,) if held_out else ())), config)

    from eha_monitor.commands.diagnosis_answer import (
        answer,
        mismatched,
        refusal,
        written_config,
    )
    from eha_monitor.commands.indicators import of_diagnosis, trees
    from eha_monitor.commands.plausible import checked, finding_tree
    from eha_monitor.commands.rotary import of_rig
    from eha_monitor.compiled import load_runtime
    from eha_monitor.mismatch.compare.compared import compared
    from eha_monitor.mismatch.diagnose import diagnose as run
    from eha_monitor.physics.effects import CATALOGUE
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings import load_settings
    from eha_monitor.settings.hypothesis import load_hypothesis

    unknown = [name for name in without if name not in CATALOGUE]
    if unknown:
        raise InputError(f"--without: {unknown[0]}: expected an effect of the catalogue, "
                         f"e.g. {', '.join(sorted(CATALOGUE)[:3])}")
    settings = load_settings(config)
    hypothesis = load_hypothesis(hypothesis_file) if hypothesis_file else None
    with progress_bar() as told:
        told("reading", 0.0)
        load_runtime()
        recordings = [read_recording(bag, settings) for bag in bags]
        unseen = read_recording(held_out, settings) if held_out else None
        healthy = [read_recording(bag, settings) for bag in references]

        def refused(findings, message: str) -> None:
            if json_file:
                write_json(json_file, refusal(bags, message, finding_tree(findings)))

        told("asking whether recording and config belong together", READING)
        findings = checked([*recordings, *([unseen] if unseen else []), *healthy], settings,
                           config, config_file, refused)

        def further(text: str, share: float) -> None:
            told(text, READING + (1 - READING) * share)

        found = compared(recordings, healthy, settings, further) if healthy else run(
            recordings, settings, unseen, further, hypothesis, without)
        found = of_rig(found, settings.rig.motion)
        findings = (*findings, *found.channels)
    indicators = of_diagnosis(found, recordings, settings)
    if json_file:
        write_json(json_file, answer(found) | {"channels": finding_tree(findings),
                                               "indicators": trees(indicators)})
    if config_file:
        write_text(config_file, written_config(found, settings, config))
    if report_file:
        from eha_monitor.reports.diagnosis_report import write_diagnosis_report

        losses = [f"{recording.source}: {loss}" for recording in recordings
                  for loss in recording.losses] + [finding.finding for finding in findings]
        write_diagnosis_report(report_file, found, settings, losses,
                               command_line(bags, config, held_out, hypothesis_file,
                                            references, without), indicators)

    from eha_monitor.commands.diagnosis_table import show

    show(found, [path for path in (json_file, report_file, config_file) if path],
         [finding.finding for finding in findings], indicators, settings)
    return int(exit_code and mismatched(found))


def unfolded(references: tuple[Path, ...]) -> tuple[Path, ...]:
    """Return references with the bags of each folder of bags."""
    found: list[Path] = []
    for one in references:
        found += [place.path for place in find_bags(one) if not place.problem] if is_archive(
            one) else [one]
    return tuple(found)


def check_inputs(bags: tuple[Path, ...], held_out: Path | None,
                 references: tuple[Path, ...] = ()) -> None:
    """Refuse a bag that is given twice: what was fitted is no longer unseen."""
    places = [bag.resolve() for bag in (*bags, *references)]
    for bag, place in zip((*bags, *references), places, strict=True):
        if places.count(place) > 1:
            raise InputError(f"{bag}: is given twice, expected different recordings")
    if held_out is not None and held_out.resolve() in places:
        raise InputError(f"{held_out}: --held-out names a bag that is fitted, expected one that "
                         "is not")


def command_line(bags: tuple[Path, ...], config: Path | None, held_out: Path | None,
                 hypothesis: Path | None = None, references: tuple[Path, ...] = (),
                 without: tuple[str, ...] = ()) -> str:
    """Return the command that makes the same answer again."""
    words = ["eha-monitor", "diagnose", *map(str, bags)]
    words += ["--config", str(config)] if config else []
    words += ["--held-out", str(held_out)] if held_out else []
    words += ["--hypothesis", str(hypothesis)] if hypothesis else []
    words += ["--reference", *map(str, references)] if references else []
    words += ["--without", *without] if without else []
    return shlex.join(words)


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Yield ``told(text, share)``, which moves a bar on a terminal and does nothing elsewhere."""
    if not on_terminal():
        yield lambda text, share: None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(),
                  console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=1.0)
        reached = 0.0

        def told(text: str, share: float) -> None:
            nonlocal reached
            reached = min(max(reached, share), 1.0)  # a bar that goes back says nothing
            progress.update(task, description=escape(text), completed=reached)

        yield told
