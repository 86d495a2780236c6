"""``advise``: what a recording can and cannot tell apart, and the cheapest motion that would."""

from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eha_monitor.commands import common
from eha_monitor.output import write_json, write_text

if TYPE_CHECKING:
    from eha_monitor.api.advise import Advice


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
    show(bags, found)
    for finding in found.channels:
        click.echo(f"note: {finding.finding}")
    for path in (json_file, excitation_file):
        if path is not None and (path is json_file or motion is not None):
            click.echo(f"written: {path}")
        elif path is not None:
            click.echo(f"{path}: not written, no motion is proposed")


def show(bags: tuple[Path, ...], found: "Advice") -> None:
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
    rows = table(*HEADS)
    for row in parameter_rows(found):
        rows.add_row(*row)
    to.print(rows)
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
