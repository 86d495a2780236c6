"""``advise``: what a recording can and cannot tell apart, and the cheapest motion that would."""

from dataclasses import asdict
from io import StringIO
from pathlib import Path

import click

from eha_monitor.commands.common import check_outputs, config_option
from eha_monitor.commands.diagnose import READING, check_inputs, progress_bar
from eha_monitor.output import write_json, write_text

SCHEMA = "eha_monitor/advice/1"
_PATH = click.Path(path_type=Path)


@click.command()
@click.argument("bags", type=_PATH, nargs=-1, required=True, metavar="BAG [BAG ...]")
@config_option
@click.option("--json", "json_file", type=_PATH, metavar="FILE", help="Write the answer as JSON.")
@click.option("--write-excitation", "excitation_file", type=_PATH, metavar="FILE",
              help="Write the config with the proposed motion, for simulator and simulate.")
@click.option("--check/--no-check", default=True,
              help="Put the proposed motion to a simulation with noise.")
def advise(bags: tuple[Path, ...], config: Path | None, json_file: Path | None,
           excitation_file: Path | None, check: bool) -> None:
    """Say what BAG can and cannot tell apart, and which motion would, as cheaply as possible.

    The motion keeps within the travel and the pump speed of BAG.  Its gain is predicted, then
    checked in simulation.
    """
    check_inputs(bags, None)
    check_outputs({"--json": json_file, "--write-excitation": excitation_file}, bags, config)

    from eha_monitor.commands.plausible import checked, finding_tree
    from eha_monitor.commands.rotary import of_rig
    from eha_monitor.compiled import load_runtime
    from eha_monitor.mismatch.advise.advice import advise as run
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings import load_settings

    settings = load_settings(config)
    with progress_bar() as told:
        told("reading", 0.0)
        load_runtime()
        recordings = [read_recording(bag, settings) for bag in bags]
        findings = checked(recordings, settings)
        naming, found = run(recordings, settings, check,
                            lambda text, share: told(text, READING + (1 - READING) * share))
    if json_file:
        write_json(json_file, of_rig(answer(bags, naming, found), settings.rig.motion)
                   | {"channels": finding_tree(findings)})
    if excitation_file and found.motion is not None:
        write_text(excitation_file, written_excitation(found.motion, settings, bags))
    show(bags, naming, found, settings.rig.motion)
    for finding in findings:
        click.echo(f"note: {finding.finding}")
    for path in (json_file, excitation_file):
        if path is not None and (path is json_file or found.motion is not None):
            click.echo(f"written: {path}")
        elif path is not None:
            click.echo(f"{path}: not written, there is no motion to propose")


def answer(bags: tuple[Path, ...], naming, found) -> dict:
    """Return the JSON tree; NaN becomes null."""
    from eha_monitor.commands.answer import finite
    from eha_monitor.mismatch.advise.motions import excitation_tree
    from eha_monitor.mismatch.advise.words import motion_sentence, sentences

    motion = found.motion
    return finite({
        "schema": SCHEMA, "bag": ", ".join(map(str, bags)), "named": naming.after.named,
        "advice": sentences(found),
        "parameters": [asdict(one) for one in found.known],
        "plateaus": found.plateaus,
        "confusions": [asdict(one) for one in found.confusions],
        "visible_from": [asdict(one) for one in found.sights],
        "groups": found.groups,
        "doubts": [asdict(one) for one in found.doubts],
        "motion": None if motion is None else {
            "name": motion.name, "words": motion_sentence(motion), "duration_s": motion.duration,
            "excitation": excitation_tree(motion)},
        "considered": [{"name": one.motion.name, "duration_s": one.motion.duration,
                        "log_units": one.gains} for one in found.tried],
        "checks": [asdict(one) for one in found.checks],
    })


def written_excitation(motion, settings, bags: tuple[Path, ...]) -> str:
    """Return the config with the motion as its ``simulation.excitation``, an annotated file."""
    from eha_monitor.mismatch.advise.motions import excitation_tree
    from eha_monitor.mismatch.advise.words import motion_sentence
    from eha_monitor.settings.document import annotated
    from eha_monitor.settings.load import settings_from_tree

    tree = settings.model_dump()
    tree["simulation"]["excitation"] = excitation_tree(motion)
    given = ", ".join(map(str, bags))
    title = " ".join(f"Written by advise of {given}: its simulation.excitation is "
                     f"{motion_sentence(motion)}.".split())
    return annotated(settings_from_tree(tree, "advice"), title)


def show(bags: tuple[Path, ...], naming, found, motion: str) -> None:
    """Print what the recording tells, what it leaves open, and the motion as YAML."""
    from rich.markup import escape
    from rich.table import Table
    from ruamel.yaml import YAML

    from eha_monitor.commands.rotary import of_rig
    from eha_monitor.commands.table import PIPE_WIDTH, PipeConsole
    from eha_monitor.mismatch.advise.motions import excitation_tree
    from eha_monitor.mismatch.advise.words import doubt_words, sentences
    from eha_monitor.quantity import NOTE, SYMBOLS, number, with_uncertainty
    from eha_monitor.reports.diagnosis_words import log_units, sentence
    from eha_monitor.words import effect_words, listed

    console = PipeConsole(highlight=False)
    if not console.is_terminal:
        console = PipeConsole(highlight=False, width=PIPE_WIDTH)
    named = listed([effect_words(name) for name in naming.after.named]) or "nothing"
    console.print(escape(f"{', '.join(map(str, bags))}: named beside B and βe: {named}"))
    table = Table("parameter", "value", "variance inflation", "most correlated with", box=None,
                  header_style="bold", padding=(0, 2, 0, 0))
    for one in found.known:
        if one.name in ("B", "beta_e") or one.name.partition(".")[0] in naming.after.named:
            table.add_row(SYMBOLS.get(one.name, one.name),
                          with_uncertainty(one.value, one.stddev, of_rig(one, motion).unit),
                          number(one.inflation, 3),
                          f"{one.most_with} ({number(one.correlation, 3)})")
    console.print(table)
    console.print(NOTE, style="dim")
    for text in of_rig(sentences(found), motion):
        console.print(f"- {escape(sentence(text))}")
    if found.tried:
        table = Table("motion", "s", *(escape(doubt_words(d)) for d in found.doubts), box=None,
                      header_style="bold", padding=(0, 2, 0, 0), caption_justify="left",
                      caption="log units together with this recording; 20 decide")
        for one in found.tried:
            mark = "[green]" if found.motion is not None and one.motion is found.motion else ""
            table.add_row(f"{mark}{one.motion.name}", number(one.motion.duration, 3),
                          *(log_units(max(gain, 0.0)) for gain in one.gains))
        console.print(table)
    if found.motion is not None:
        text, yaml = StringIO(), YAML(typ="safe")
        yaml.default_flow_style = False
        yaml.sort_base_mapping_type_on_output = False
        yaml.dump({"simulation": {"excitation": excitation_tree(found.motion)}}, text)
        console.print(escape(text.getvalue()), end="", soft_wrap=True)
