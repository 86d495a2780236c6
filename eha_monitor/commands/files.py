"""Commands that write a file: ``simulate``, ``import``, ``config`` and ``export``."""

import re
from collections.abc import Callable
from pathlib import Path

import click

from eha_monitor.commands import common
from eha_monitor.errors import InputError
from eha_monitor.output import write_bytes, write_text

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
        length, samples, channels = simulate_bag(
            out, config_of(config), duration=duration, seed=seed, plain=plain,
            overwrite=overwrite, progress=told)
    click.echo(f"{out}: {length:g} s, {samples} samples, channels {', '.join(channels)}")


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
    from eha_monitor.settings.load import annotated

    title = "The paper's electrohydraulic actuator." if file is None else f"From {file.name}."
    click.echo(annotated(load_settings(file), title), nl=False)


@click.command()
@click.argument("config", type=common.FILE, metavar="CONFIG")
@click.option("--fmu", type=common.FILE, metavar="FILE.fmu",
              help="FMU 2.0 for co-simulation: Simulink, OpenModelica, fmpy.")
@click.option("--fmu-platform", "platforms", multiple=True,
              type=click.Choice(["linux64", "win64"]),
              help="Platform of the FMU, may be given several times; default: all.")
@click.option("--modelica", type=common.FILE, metavar="FILE.mo", help="Modelica text.")
@click.option("--urdf", type=common.FILE, metavar="FILE.urdf",
              help="A joint with damping and friction.")
@click.option("--mujoco", type=common.FILE, metavar="FILE.xml", help="The same for MuJoCo (MJCF).")
@click.option("--ros2-control", "ros2_control", type=common.FILE, metavar="FILE.yaml",
              help="Friction feed-forward table, as ROS parameters.")
@click.option("--joint", default="piston", show_default=True, metavar="NAME",
              help="Name of the joint in URDF, MuJoCo and ros2_control.")
@click.option("--recording", "bags", type=common.FILE, multiple=True, metavar="BAG",
              help="Recording that the model was identified from: the table marks the velocities "
                   "it covers.")
def export(config: Path, fmu: Path | None, platforms: tuple[str, ...], modelica: Path | None,
           urdf: Path | None, mujoco: Path | None, ros2_control: Path | None, joint: str,
           bags: tuple[Path, ...]) -> None:
    """Write the model of CONFIG, such as `estimate` or `diagnose --write-config` writes.

    Several formats at once.  What a format cannot represent is listed, one line each, and
    written into the file as a comment (docs/exports.md).
    """
    targets = {"--fmu": fmu, "--modelica": modelica, "--urdf": urdf, "--mujoco": mujoco,
               "--ros2-control": ros2_control}
    if not any(targets.values()):
        raise InputError(f"export: expected a format, one of {', '.join(targets)}")
    if bags and not ros2_control:
        raise InputError("--recording: expected --ros2-control beside it")
    if platforms and not fmu:
        raise InputError("--fmu-platform: expected --fmu beside it")
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,63}", joint):
        raise InputError(f"--joint: expected a name of letters, digits and _, got {joint!r}")
    for target in targets.values():
        common.check_target(target)
    common.check_outputs(targets, bags, config)

    from eha_monitor.exports import fmu as of_fmi
    from eha_monitor.exports import joints
    from eha_monitor.exports.model import Model
    from eha_monitor.exports.modelica import modelica_of
    from eha_monitor.quantity import ROTARY
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings import load_settings

    model = Model(load_settings(config), config.name)
    units = ROTARY if model.rotary else {}
    makers: dict[str, Callable] = {
        "--fmu": lambda: of_fmi.fmu_of(model, units, platforms),
        "--modelica": lambda: modelica_of(model, units),
        "--urdf": lambda: joints.urdf_of(model, joint),
        "--mujoco": lambda: joints.mujoco_of(model, joint),
        "--ros2-control": lambda: joints.feedforward_of(
            model, joint, [read_recording(bag, model.settings) for bag in bags])}
    # All are made before the first is written: a config that one format refuses writes nothing.
    made = {}
    for option, target in targets.items():
        if target is not None:
            with common.working(f"making {target}"):
                made[option] = makers[option]()
    for option, exported in made.items():
        target = targets[option]
        if isinstance(exported.content, bytes):
            write_bytes(target, exported.content)
        else:
            write_text(target, exported.content)
        click.echo(f"{target}: written; {model.provenance}")
        for line in exported.lost:
            click.echo(f"  not in it: {line}")
