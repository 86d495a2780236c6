"""Commands that write a file: ``simulate``, ``import`` and ``config``."""

from pathlib import Path

import click

from eha_monitor.commands import common

out_option = click.option("--out", required=True, type=common.FILE, metavar="BAG",
                          help="Folder of the new bag, or a single .mcap file.")


@click.command()
@out_option
@common.config_option
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the sensor noise.")
@click.option("--duration", type=common.SECONDS, metavar="SECONDS",
              help="Length; default: one period of the config's motion.")
@click.option("--plain", is_flag=True, help="Do not compress.")
@common.overwrite_option
def simulate(out: Path, config: Path | None, seed: int | None, duration: float | None,
             plain: bool, overwrite: bool) -> None:
    """Write the simulated EHA directly to a bag, as fast as possible."""
    from eha_monitor.api.config import config_of
    from eha_monitor.api.simulate import simulate_bag

    common.check_new(out, overwrite)  # before the work, not after it
    with common.progress_bar() as told:
        made = simulate_bag(out, config_of(config), duration=duration, seed=seed, plain=plain,
                            overwrite=overwrite, progress=told)
    click.echo(f"{out}: {made.duration:g} s, {made.samples} samples, "
               f"channels {', '.join(made.channels)}")


@click.command("import")
@click.argument("file", type=common.FILE)
@click.option("--map", "map_file", required=True, type=common.FILE,
              metavar="MAP.yaml", help="Which column is which channel, in which unit.")
@out_option
@common.overwrite_option
def import_table(file: Path, map_file: Path, out: Path, overwrite: bool) -> None:
    """Convert a CSV or MAT FILE to a bag, using a channel map."""
    from eha_monitor.plausibility.judge import plausibility_of
    from eha_monitor.recordings.importing import import_file
    from eha_monitor.settings import load_settings

    with common.working(f"importing {file}"):
        recording = import_file(file, map_file, out, overwrite=overwrite)
    click.echo(f"{out}: {recording.duration:g} s, {len(recording)} samples, "
               f"channels {', '.join(recording.channels)}")
    for loss in recording.losses:
        click.echo(f"lost: {loss}")
    # The bag is as the map says; who estimates from it is refused, so it is told here already.
    for finding in plausibility_of(recording, load_settings(map_file)).findings:
        click.echo(f"check {map_file}: {finding.finding}")


@click.command()
@click.option("--config", "file", type=common.FILE, metavar="FILE",
              help="Print this config in full instead of the paper's EHA.")
def config(file: Path | None) -> None:
    """Print a config with every key: value, unit, range and description."""
    from eha_monitor.settings import load_settings
    from eha_monitor.settings.document import annotated

    title = "The paper's electrohydraulic actuator." if file is None else f"From {file.name}."
    click.echo(annotated(load_settings(file), title), nl=False)
