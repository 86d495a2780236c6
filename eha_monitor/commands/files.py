"""Commands that write a file: ``simulate``, ``import`` and ``config``."""

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import click

from eha_monitor.commands.common import check_new, config_option, on_terminal, working

_BATCH_S = 1.0  # simulated between two moves of the progress bar
_START_NS = 1_000_000_000  # always the same, and not zero, which ROS takes for "no time"


@click.command()
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="BAG",
              help="Folder of the new bag, or a single .mcap file.")
@config_option
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the sensor noise.")
@click.option("--duration", type=click.FloatRange(min=0, min_open=True), metavar="SECONDS",
              help="Length; without it, until the motion of the config repeats.")
@click.option("--plain", is_flag=True, help="Do not compress.")
@click.option("--overwrite", is_flag=True, help="Replace a bag that is there already.")
def simulate(out: Path, config: Path | None, seed: int | None, duration: float | None,
             plain: bool, overwrite: bool) -> None:
    """Write the simulated EHA straight to a bag, as fast as it goes."""
    from eha_monitor.physics.excitation import total_duration
    from eha_monitor.physics.simulator import Simulator
    from eha_monitor.recordings.write import ChannelWriter
    from eha_monitor.settings import load_settings

    check_new(out, overwrite)  # before the work, not after it
    settings = load_settings(config)
    plant = Simulator(settings, seed, source=str(config or "config"))
    seconds = duration or total_duration(settings.simulation.excitation)
    samples = max(1, round(seconds / plant.dt))
    parts = _simulated(plant, samples)
    first = next(parts)
    with ChannelWriter(out, tuple(first), plant.dt, settings.monitor.namespace,
                       compression="none" if plain else "zstd", overwrite=overwrite,
                       start_ns=_START_NS) as writer:
        for part in chain((first,), parts):
            writer.write(part)
    click.echo(f"{out}: {samples * plant.dt:g} s, {samples} samples, channels {', '.join(first)}")


def _simulated(plant, samples: int) -> Iterator[dict]:
    """Run the plant, with a progress bar on a terminal; yields channel -> (m,)."""
    from rich.console import Console
    from rich.progress import Progress

    batch = max(1, round(_BATCH_S / plant.dt))
    with Progress(console=Console(stderr=True), disable=not on_terminal(),
                  transient=True) as progress:
        task = progress.add_task("simulating", total=samples)
        while plant.samples < samples:
            count = min(batch, samples - plant.samples)
            yield plant.advance(count)
            progress.advance(task, count)


@click.command("import")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--map", "map_file", required=True, type=click.Path(path_type=Path),
              metavar="MAP.yaml", help="Which column is which channel, in which unit.")
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="BAG",
              help="Folder of the new bag, or a single .mcap file.")
@click.option("--overwrite", is_flag=True, help="Replace a bag that is there already.")
def import_table(file: Path, map_file: Path, out: Path, overwrite: bool) -> None:
    """Turn a CSV or MAT FILE into a bag through a channel map."""
    from eha_monitor.plausibility.judge import plausibility_of
    from eha_monitor.recordings.importing import import_file
    from eha_monitor.settings import load_settings

    with working(f"importing {file}"):
        recording = import_file(file, map_file, out, overwrite=overwrite)
    click.echo(f"{out}: {recording.duration:g} s, {len(recording)} samples, "
               f"channels {', '.join(recording.channels)}")
    for loss in recording.losses:
        click.echo(f"lost: {loss}")
    # The bag is as the map says; who estimates from it is refused, so it is told here already.
    for finding in plausibility_of(recording, load_settings(map_file)).findings:
        click.echo(f"check {map_file}: {finding.finding}")


@click.command()
@click.option("--config", "file", type=click.Path(path_type=Path), metavar="FILE",
              help="Print this config in full instead of the paper's EHA.")
def config(file: Path | None) -> None:
    """Print a config with every key: value, unit, range and description."""
    from eha_monitor.settings import load_settings
    from eha_monitor.settings.document import annotated

    title = "The paper's electrohydraulic actuator." if file is None else f"From {file.name}."
    click.echo(annotated(load_settings(file), title), nl=False)
