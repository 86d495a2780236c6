"""Commands that run as ROS nodes; what stands after ``--ros-args`` goes to ROS unread."""

from pathlib import Path

import click

from eha_monitor.commands.common import FILE, SECONDS, config_option, ros_module

duration_option = click.option("--duration", type=SECONDS, metavar="SECONDS",
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
@click.option("--machine", "machine_file", type=FILE, metavar="FILE",
              help="Compare with the healthy machine that `diagnose A B C --machine FILE` wrote, "
                   "whenever something moves (docs/live.md); key diagnosis.machine.")
@duration_option
@click.pass_obj
def monitor(ros_args: list[str], config: Path | None, actuators: tuple[str, ...], inactive: bool,
            machine_file: Path | None, duration: float | None) -> int:
    """Run the two stages on live topics; publish estimates and health."""
    return ros_module("managed_node").run_monitor(config, ros_args, duration, actuators, inactive,
                                                  machine_file)


@click.command()
@config_option
@click.option("--actuator", "actuators", multiple=True, metavar="NAME=CONFIG",
              help="Show the actuator of the namespace /NAME, as `monitor --actuator` runs it; "
              "may be given again: one page for all.")
@duration_option
@click.option("--port", type=click.IntRange(0, 65535), default=8050, show_default=True,
              help="Port of the page; 0 takes any that is free.")
@click.option("--host", default="127.0.0.1", show_default=True, metavar="ADDRESS",
              help="Address to serve on; 0.0.0.0 is every one of this machine. On any but "
              "loopback a token is asked for.")
@click.option("--token", envvar="EHA_MONITOR_TOKEN", metavar="TOKEN",
              help="Ask for this token, 16 signs at least; better in the environment variable "
              "EHA_MONITOR_TOKEN, as others see a command line. Without it one is made and "
              "printed where --host is not loopback.")
@click.option("--name", "names", multiple=True, metavar="HOSTNAME",
              help="Answer to this host name as well, as that of a reverse proxy; may be given "
              "again. A token is asked for then.")
@click.option("--metrics", is_flag=True, help="Serve Prometheus metrics on /metrics as well.")
@click.option("--foxglove", type=click.IntRange(0, 65535), metavar="PORT",
              help="Serve the topics on a Foxglove WebSocket on loopback as well; usual is 8765.")
@click.pass_obj
def dashboard(ros_args: list[str], config: Path | None, actuators: tuple[str, ...],
              duration: float | None, **served) -> int:
    """Serve a live page: estimates, alarms, events, residual, the actuator moving."""
    module = ros_module("dashboard_node")
    return module.run_dashboard(config, ros_args, module.Served(**served), duration, actuators)


@click.command()
@click.argument("bag", type=FILE)
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
@click.option("--out", required=True, type=FILE, metavar="BAG", help="Folder of the new bag.")
@click.option("--topic", "topics", multiple=True, metavar="TOPIC",
              help="Record this topic; may be repeated. Default: the topics of the config.")
@config_option
@duration_option
@click.pass_obj
def record(ros_args: list[str], out: Path, topics: tuple[str, ...], config: Path | None,
           duration: float | None) -> int:
    """Write the topics to a rosbag2-compatible mcap bag."""
    return ros_module("record_node").run_record(out, ros_args, topics, duration, config)
