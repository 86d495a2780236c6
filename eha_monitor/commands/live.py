"""Commands that run as ROS nodes; what stands after ``--ros-args`` goes to ROS unread."""

from pathlib import Path

import click

from eha_monitor.commands.common import config_option, ros_module

_SECONDS = click.FloatRange(min=0, min_open=True)

duration_option = click.option("--duration", type=_SECONDS, metavar="SECONDS",
                               help="Stop after this time.")


@click.command()
@config_option
@duration_option
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the sensor noise.")
@click.pass_obj
def simulator(ros_args: list[str], config: Path | None, duration: float | None,
              seed: int | None) -> int:
    """Publish the simulated EHA: plant, effects, faults, noise and motion from the config."""
    return ros_module("simulator_node").run_simulator(config, ros_args, duration, seed)


@click.command()
@config_option
@click.option("--actuator", "actuators", multiple=True, metavar="NAME=CONFIG",
              help="Monitor an actuator with this config under the namespace /NAME; repeat for "
                   "several actuators in one process.")
@click.option("--inactive", is_flag=True,
              help="Start inactive and wait for the lifecycle transition 'activate'.")
@duration_option
@click.pass_obj
def monitor(ros_args: list[str], config: Path | None, actuators: tuple[str, ...], inactive: bool,
            duration: float | None) -> int:
    """Run the two stages on live topics; publish estimates and health."""
    return ros_module("managed_node").run_monitor(config, ros_args, duration, actuators, inactive)


@click.command()
@config_option
@duration_option
@click.option("--port", type=click.IntRange(0, 65535), default=8050, show_default=True,
              help="Port on 127.0.0.1; 0: any free port.")
@click.option("--foxglove", type=click.IntRange(0, 65535), metavar="PORT",
              help="Serve the topics on a Foxglove WebSocket as well; usual is 8765.")
@click.pass_obj
def dashboard(ros_args: list[str], config: Path | None, duration: float | None,
              port: int, foxglove: int | None) -> int:
    """Serve a live page on loopback: estimates, alarms, residual, animated actuator."""
    return ros_module("dashboard_node").run_dashboard(config, ros_args, port, duration,
                                                      foxglove)


@click.command()
@click.argument("bag", type=click.Path(path_type=Path))
@click.option("--rate", type=click.FloatRange(min=0, min_open=True), default=1.0,
              show_default=True, help="Playback speed relative to real time.")
@click.option("--clock/--no-clock", default=True, show_default=True,
              help="Publish /clock from the bag's own time.")
@click.option("--loop", is_flag=True, help="Repeat from the start at the end.")
@click.option("--start-paused", is_flag=True, help="Start paused; wait for the resume service.")
@click.pass_obj
def replay(ros_args: list[str], bag: Path, rate: float, clock: bool, loop: bool,
           start_paused: bool) -> int:
    """Publish the messages of BAG with its own timing."""
    return ros_module("replay_node").run_replay(bag, ros_args, rate, clock, loop, start_paused)


@click.command()
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="BAG",
              help="Folder of the new bag.")
@click.option("--topic", "topics", multiple=True, metavar="TOPIC",
              help="Record this topic; may be repeated. Default: the topics of the config.")
@config_option
@duration_option
@click.pass_obj
def record(ros_args: list[str], out: Path, topics: tuple[str, ...], config: Path | None,
           duration: float | None) -> int:
    """Write the topics to a rosbag2-compatible mcap bag."""
    return ros_module("record_node").run_record(out, ros_args, topics, duration, config)
