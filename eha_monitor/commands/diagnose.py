"""``diagnose``: where simulation and recording differ, which physics that is, and the proof."""

import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from eha_monitor.commands.archive import Archive, answer_folder, archive_options, refuse
from eha_monitor.commands.common import Several, check_outputs, config_option, on_terminal
from eha_monitor.commands.out_bag import check_out_bag, write_out_bag
from eha_monitor.errors import InputError
from eha_monitor.output import write_json, write_text

_PATH = click.Path(path_type=Path)


@click.command(cls=Several)
@click.argument("bags", type=_PATH, nargs=-1, required=True, metavar="BAG [BAG ...]")
@config_option
@click.option("--json", "json_file", type=_PATH, metavar="FILE", help="Write the result as JSON.")
@click.option("--report", "report_file", type=_PATH, metavar="FILE.html",
              help="Write a self-contained HTML report.")
@click.option("--write-config", "config_file", type=_PATH, metavar="FILE",
              help="Write the config with the identified effects and corrected rig data.")
@click.option("--out-bag", "out_bag", type=_PATH, metavar="BAG",
              help="Write measured, modelled and missing signals as a bag (docs/exports.md).")
@click.option("--held-out", "held_out", type=_PATH, metavar="BAG",
              help="Show the fit on this recording; default: on a held-out part of BAG.")
@click.option("--hypothesis", "hypothesis_file", type=_PATH, metavar="FILE|NAME",
              help="Your own hypothesis, a file or the name of an installed one: an expression "
                   "whose parameters are fitted and which is ranked with the catalogue "
                   "(docs/effects.md).")
@click.option("--reference", "references", type=_PATH, multiple=True,
              metavar="HEALTHY [HEALTHY ...]",
              help="Healthy recordings of the machine, or a folder of them: report what has "
                   "changed from these. Give BAG before it.")
@click.option("--without", multiple=True, metavar="EFFECT [EFFECT ...]",
              help="Effects of the catalogue to exclude, such as those that this rig cannot have.")
@click.option("--vary", multiple=True, type=click.Choice(["load"]),
              help="What is known to differ between several BAGs.")
@click.option("--machine", "machine_file", type=_PATH, metavar="FILE",
              help="With several BAGs: write the machine that they show. With one: judge it "
                   "against that machine, in a fraction of a second (docs/one_machine.md).")
@click.option("--calibration/--no-calibration", hidden=True, expose_value=False,
              help="No effect; kept for compatibility.")
@click.option("--exit-code", is_flag=True,
              help="Exit with 1 if the model does not fit the recording.")
@archive_options
def diagnose(bags: tuple[Path, ...], config: Path | None, json_file: Path | None,
             report_file: Path | None, config_file: Path | None, out_bag: Path | None,
             held_out: Path | None, hypothesis_file: Path | None, references: tuple[Path, ...],
             without: tuple[str, ...], vary: tuple[str, ...], machine_file: Path | None,
             exit_code: bool, **asked) -> int:
    """Locate where BAG and the model differ, identify the missing effects, show the better fit.

    Several BAGs of one rig are diagnosed together. With --reference the result is what has
    changed from healthy recordings, or that nothing has. If BAG is a folder of bags, each is
    diagnosed separately, into one table with trends over time.
    """
    archive = Archive(**asked)
    if any(archive.covers(bag) for bag in bags):
        if len(bags) > 1:
            raise InputError("expected one folder that holds bags, or bags, got "
                             + ", ".join(map(str, bags)))
        refuse(bags[0], json=json_file, report=report_file, write_config=config_file,
               out_bag=out_bag, held_out=held_out, hypothesis=hypothesis_file,
               reference=references, without=without, vary=vary, machine=machine_file)
        return int(answer_folder("diagnose", bags[0], config, archive) and exit_code)
    from eha_monitor.api.config import config_of
    from eha_monitor.api.diagnose import bags_of, known_effects
    from eha_monitor.api.diagnose import diagnose as run
    from eha_monitor.api.diagnosis_answer import completed, refusal, written_config
    from eha_monitor.api.plausible import finding_tree
    from eha_monitor.api.read import distinct
    from eha_monitor.balances.machine import save
    from eha_monitor.commands.refused import refusing
    from eha_monitor.settings.hypothesis import load_hypothesis

    references = tuple(bag for one in references for bag in bags_of(one))
    distinct(bags, held_out, references, "--held-out")
    if references and (held_out or hypothesis_file or without):
        raise InputError("--reference: expected neither --held-out, --hypothesis nor --without "
                         "beside it")
    check_outputs({"--json": json_file, "--report": report_file, "--write-config": config_file},
                  (*bags, *references, *((held_out,) if held_out else ())), config)
    check_out_bag(out_bag, (*bags, *references))
    known_effects(without, "--without")
    several = len(bags) > 1
    if machine_file and several:
        check_outputs({"--machine": machine_file}, bags, config)
    given = config_of(config)
    hypothesis = load_hypothesis(hypothesis_file) if hypothesis_file else None
    with progress_bar() as told, refusing(
            given, config, json_file, config_file, lambda problem: refusal(
            bags, str(problem), finding_tree(problem.channels))):
        found = run(bags, given, held_out=held_out, references=references, hypothesis=hypothesis,
                    without=without, vary=vary,
                    machine=None if several else machine_file, progress=told)
    notes = [finding.finding for finding in found.channels]
    if json_file:
        write_json(json_file, found.to_dict())
    if machine_file and several:
        if found.inner.machine is None:
            raise InputError("--machine: expected at least three BAGs that move, with the force "
                             "of the piston")
        save(found.inner.machine, machine_file)
    if config_file:
        write_text(config_file, written_config(found.inner, given.settings, config))
        if not completed(found.inner, given.settings)[1]:
            notes.append(f"{config_file}: the config as it was, since nothing was identified")
    if report_file:
        found.report(report_file, command=command_line(bags, config, held_out, hypothesis_file,
                                                       references, without, vary, machine_file))

    from eha_monitor.commands.diagnosis_table import show

    show(found.inner, [path for path in (json_file, report_file, config_file,
                                     machine_file if several else None) if path],
         notes, found.indicators, given.settings)
    write_out_bag(out_bag, found.inner, bags, given.settings)
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
