"""``identify`` and ``prove``: experiments on a rig, and with the diagnosis.

``identify`` decides what a rig has, within limits; ``prove`` conceals effects in recordings, seals
the key, and scores the diagnosis.
"""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eha_monitor.commands import common
from eha_monitor.errors import InputError
from eha_monitor.output import finite, write_bytes, write_json, write_text

if TYPE_CHECKING:
    from eha_monitor.identify.experiment import Rig, Round
    from eha_monitor.identify.plan import Planner
    from eha_monitor.mismatch.diagnosis import Diagnosis
    from eha_monitor.recordings.recording import ChannelFinding, Recording
    from eha_monitor.settings import Settings

MOST_MOTIONS = 99


@click.command()
@common.config_option
@click.option("--simulate", "simulated", type=common.FILE, metavar="CONFIG",
              help="Experiment on the simulated actuator of this config, without ROS and as fast "
                   "as it goes.")
@click.option("--out", type=common.FILE, metavar="FOLDER", default=Path("identify"),
              show_default=True, help="Folder of the bags, one for each motion.")
@common.overwrite_option
@click.option("--probability", type=click.FloatRange(0.5, 0.999), default=0.95,
              show_default=True, help="Probability at which a set of effects is decided.")
@click.option("--dry-run", is_flag=True,
              help="Move nothing: write the first motion as a picture and a bag.")
@click.option("--wait", is_flag=True, help="Wait for the service identify/start.")
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the simulated sensor noise.")
@common.json_option
@common.report_option
@common.write_config_option("Write the config with the identified effects and corrected rig data.")
@click.pass_obj
def identify(ros_args: list[str], config: Path | None, simulated: Path | None, out: Path,
             overwrite: bool, probability: float, dry_run: bool, wait: bool, seed: int | None,
             json_file: Path | None, report_file: Path | None, config_file: Path | None) -> None:
    """Move the rig until it is decided which effects it has, and diagnose it.

    Motions are planned within the limits of the config (section experiment), each by what the
    last one left in doubt, and run through the topic `command`, or with --simulate on a simulated
    actuator. A motion is aborted at a limit, by the service identify/stop, and where data stop.
    """
    from eha_monitor.api.config import config_of
    from eha_monitor.api.read import checked
    from eha_monitor.identify.experiment import SimulatedRig, bounds_of
    from eha_monitor.identify.experiment import identify as rounds_of
    from eha_monitor.identify.plan import Planner
    from eha_monitor.quantity import rig_motion

    if simulated is not None and (ros_args or wait):
        raise InputError("--simulate: expected neither --wait nor ROS arguments beside it")
    common.check_outputs({"--json": json_file, "--report": report_file,
                          "--write-config": config_file}, (), config)
    for name in ("planned",) if dry_run else (f"motion_{i:02d}" for i in range(MOST_MOTIONS)):
        common.check_new(out / name, overwrite)
    given = config_of(config)
    source = str(config or "default config")
    bounds = bounds_of(given.settings, source)
    planner = Planner(given.settings, bounds, source, probability)
    rig = given.settings.rig
    lacking = sorted({"viscous_damping", "bulk_modulus"} - rig.model_fields_set)
    if lacking and not rig.is_papers:
        click.echo(f"{source}: {' and '.join(f'rig.{key}' for key in lacking)}: not given, so "
                   "motions are planned with the paper's; `eha-monitor diagnose RECORDING "
                   "--write-config FILE` writes this rig's")
    if dry_run:
        with rig_motion(given.settings.rig.motion):
            show_first(planner, out / "planned", overwrite)
        return
    command = " ".join(["eha-monitor identify", *(f"{option} {shlex.quote(str(value))}"
                        for option, value in (("--config", config), ("--simulate", simulated))
                        if value is not None)])

    rounds: list[Round] = []

    def usable(recording: "Recording") -> "tuple[Recording, tuple[ChannelFinding, ...]]":
        (recording,), said = checked([recording], given.settings)
        return recording, said

    def experiment(rig: "Rig") -> str:
        with rig_motion(given.settings.rig.motion):  # of this thread
            with common.progress_bar() as told:
                def say(text: str, share: float) -> None:
                    told(text, share)
                    if text.startswith("motion") and not sys.stderr.isatty():
                        click.echo(text)  # where no bar shows that it is at work

                for one in rounds_of(rig, planner, usable, say):
                    rounds.append(one)
                    written(one, len(rounds), out, given.settings, overwrite)
                    answered(rounds, planner, out, command, targets, config)
            return finish(rounds, out, targets)

    targets = json_file, report_file, config_file
    try:
        if simulated is not None:
            aborted = experiment(SimulatedRig(config_of(simulated).settings, bounds, seed,
                                              str(simulated)))
        else:
            aborted = common.ros_module("identify_node").run_identify(
                given.settings, bounds, ros_args, wait, (out, overwrite), experiment)
    except KeyboardInterrupt:
        bags = [out / f"motion_{i:02d}" for i in range(1, len(rounds) + 2)]
        kept = [path for path in (*bags, *targets) if path and path.exists()]
        click.echo(f"interrupted; kept of the motions so far: {', '.join(map(str, kept)) or '-'}")
        raise
    if aborted:
        raise InputError(aborted)


def written(one: "Round", count: int, out: Path, settings: "Settings", overwrite: bool) -> None:
    """Write the bag of a round, and say what is known after it."""
    from eha_monitor.identify.experiment import round_words
    from eha_monitor.recordings.write import write_recording

    click.echo(round_words(one, count, settings.rig.sample_time))
    if one.ran.bag is None and len(one.ran.recording):
        out.mkdir(parents=True, exist_ok=True)
        write_recording(out / one.ran.recording.source, one.ran.recording, settings,
                        overwrite=overwrite)


def bags_of(rounds: list["Round"], out: Path) -> list[Path]:
    """Return where the motions of the rounds are recorded."""
    return [one.ran.bag or out / one.ran.recording.source for one in rounds]


def last_of(rounds: list["Round"]) -> "Diagnosis | None":
    """Return the last diagnosis of the rounds, in the units of the rig; None before one."""
    from eha_monitor.quantity import in_units

    return next((in_units(one.diagnosis) for one in reversed(rounds)
                 if one.diagnosis is not None), None)


def answered(rounds: list["Round"], planner: "Planner", out: Path, command: str,
             targets: Sequence[Path | None], config: Path | None) -> None:
    """Write JSON, report and config of the rounds so far: an experiment may be interrupted."""
    from eha_monitor.api.diagnose import answer, written_config
    from eha_monitor.identify.experiment import tree
    from eha_monitor.reports.diagnosis_report import diagnosis_page

    json_file, report_file, config_file = targets
    settings = planner.settings
    found = last_of(rounds)
    bags = [*map(str, bags_of(rounds, out))]
    if json_file:
        write_json(json_file, finite(tree(rounds, bags, planner.bounds, planner.wanted,
                                          settings.rig.sample_time)
                                     | {"diagnosis": answer(found) if found else None}))
    if found is not None:
        if config_file:
            write_text(config_file, written_config(found, settings, config))
        if report_file:
            write_text(report_file, diagnosis_page(found, settings, (), command))


def finish(rounds: list["Round"], out: Path, targets: Sequence[Path | None]) -> str:
    """Say what was found and written; return why the experiment was aborted, or ""."""
    from eha_monitor.identify.experiment import DECIDED
    from eha_monitor.quantity import SYMBOLS, with_uncertainty

    last, bags = rounds[-1], bags_of(rounds, out)
    if (found := last_of(rounds)) is not None:
        decided = last.end == DECIDED
        click.echo(found.message if decided else f"not decided, most probable: {found.message}")
        for name, value in found.after.items():
            click.echo(f"{SYMBOLS.get(name, name)}: "
                       f"{with_uncertainty(value.value, value.stddev, value.unit)}")
        for one in found.rig_within:
            click.echo(f"rig data: {one.statement}")
    for path in filter(None, (*bags, *targets)):
        if path.exists():
            click.echo(f"written: {path}")
    return f"{bags[-1]}: aborted: {last.ran.aborted}" if (
        last.ran.aborted and not last.ran.asked) else ""


def show_first(planner: "Planner", bag: Path, overwrite: bool) -> None:
    """Write the first motion as a picture and as a bag of its command."""
    from eha_monitor.identify.experiment import plan_words
    from eha_monitor.recordings.recording import Recording
    from eha_monitor.recordings.write import write_recording
    from eha_monitor.reports.api_figures import motion_figure
    from eha_monitor.reports.still_image import drawn, png

    settings, bounds = planner.settings, planner.bounds
    with common.progress_bar() as told:
        told("planning the first motion", 0.1)
        planned = planner.first(0.5 * (bounds.lower + bounds.upper))
    bag.parent.mkdir(parents=True, exist_ok=True)
    dt = settings.rig.sample_time
    write_recording(bag, Recording(dt, {"x_d": planned.x_d}, 1_000_000_000), settings,
                    overwrite=overwrite)
    picture = bag.with_suffix(".png")
    write_bytes(picture, png(drawn(motion_figure(planned.x_d, planned.shown, bounds, settings.rig,
                                                 planned.motion.words))))
    click.echo(f"nothing is moved; planned: {plan_words(planned, dt)}")
    for path in (bag, picture):
        click.echo(f"written: {path}")


@click.command()
@common.config_option
@click.option("--cases", type=click.IntRange(1, 10000), default=200, show_default=True,
              help="How many recordings.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=1, show_default=True,
              help="Seed of the draws; the first cases of a longer trial are the same.")
@common.json_option
@click.option("--report", "report_file", type=common.FILE, metavar="FILE.html",
              help="Write a self-contained HTML report; without it DIR/proof.html.")
@click.option("--draw", type=click.Choice(("mixed", "outside")), default="mixed",
              show_default=True, help="Sets of 0 to 3 effects on all rigs and motions; or "
              "effects that are not in the catalogue.")
@click.option("--rig", type=click.Choice(("exact", "within", "beyond", "mixed")), default="mixed",
              show_default=True, help="What the nominal configs say of the rig: the truth; each "
              "number off by one tolerance (standard deviation); one number off by 3 to 10 of "
              "them; or 40 %, 40 % and 20 % of these.")
@click.option("--work", type=common.FILE, metavar="DIR",
              help="Folder of recordings, key and answers; by default out/proof/... here. An "
                   "interrupted trial is resumed.")
@click.option("--keep", type=click.Choice(("same", "all", "none")), default="same",
              show_default=True, help="Which results of an earlier run are kept: those of this "
                                      "very source of the program, all, or none.")
@click.option("--oracle/--no-oracle", default=False,
              help="Also fit each case with a model that is given the true effects: the best "
                   "achievable result and the available evidence (takes half as long again).")
@click.option("--jobs", type=click.IntRange(1, 1024), default=None,
              help="Processes at a time; all cores by default.")
def prove(config: Path | None, cases: int, seed: int, json_file: Path | None,
          report_file: Path | None, draw: str, rig: str, work: Path | None, keep: str,
          oracle: bool, jobs: int | None) -> int:
    """Conceal effects in recordings, seal the key, diagnose blind, open the key and score.

    The key's SHA-256 is printed before any recording is read.  With a config all cases are on its
    rig; without one, on the paper's and others about it.
    """
    common.end_as_on_interrupt()
    common.check_target(json_file)
    common.check_target(report_file)

    from eha_monitor.prove.trial import Trial, cases_of, misses, write_json
    from eha_monitor.prove.trial import prove as run
    from eha_monitor.reports.proof_report import proof_page
    from eha_monitor.settings import load_settings

    settings = load_settings(config) if config else None
    drawn = cases_of(draw, cases, seed, rig, settings, str(config))
    kind = draw if rig == "mixed" else f"{draw}-{rig}"
    work = (work or Path("out", "proof", f"{kind}-seed{seed}-{cases}")).resolve()
    with common.progress_bar() as told:
        found = run(Trial(drawn, seed, work, oracle, jobs or 0, keep), click.echo, told)
        told("writing the report", 1.0)
        report = report_file or work / "proof.html"
        write_text(report, proof_page(found, work))
    if json_file:
        write_json(json_file, found)
    click.echo(summary(found))
    click.echo(f"{len(misses(found))} of {found['cases']} missed; written: {report}, "
               f"{json_file or work / 'proof.json'}")
    return 0


def summary(found: dict) -> str:
    """Return the marks as lines, each beside the figure that is aimed at."""
    from eha_monitor.prove.score import MARKS

    lines = []
    for name, (words, aim, _, _) in MARKS.items():
        value = found["score"].get(name)
        shown = "-" if value is None else f"{100 * value:.1f} %"
        lines.append(f"  {shown:>7}  {words}" + (f" (aim: {aim})" if aim else ""))
    return "\n".join(lines)
