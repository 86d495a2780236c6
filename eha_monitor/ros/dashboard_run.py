"""The dashboard command: a node for each actuator, and the web server beside them."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from eha_monitor.errors import InputError
from eha_monitor.ros import running
from eha_monitor.ros.dashboard_node import Listener
from eha_monitor.ros.managed_node import actuators_of
from eha_monitor.ros.parameters import settings_of_node
from eha_monitor.ros.params_file import with_namespace
from eha_monitor.settings import load_settings


@dataclass(frozen=True)
class Served:
    """What is served and where.

    Attributes
    ----------
    port, host : of the page; port 0 takes any that is free.
    token : asked of everyone; None asks for none on loopback, and makes one elsewhere.
    metrics : whether ``/metrics`` is there.
    foxglove : port of a Foxglove WebSocket on loopback, or None for none.
    names : further host names to answer to; a token is asked for then.
    """

    port: int
    host: str
    token: str | None = None
    metrics: bool = False
    foxglove: int | None = None
    names: tuple[str, ...] = ()


@contextlib.contextmanager
def _optional(what: str, extra: str) -> Iterator[None]:
    """Say in one line which extra is missing, where an import inside the block fails."""
    try:
        yield
    except ImportError as problem:
        if (problem.name or "").startswith("eha_monitor"):
            raise  # a defect of ours is no missing package
        raise InputError(f"{what}: {problem}; install eha_monitor[{extra}]") from problem


def run_dashboard(config: Path | None, ros_args: list[str], served: Served,
                  duration: float | None = None, actuators: tuple[str, ...] = ()) -> int:
    """Serve the page until a signal or for ``duration`` s; returns the exit status.

    Parameters
    ----------
    actuators : ``NAME=CONFIG`` for each of several actuators; else ``config`` is the only one.

    Raises
    ------
    InputError
        If the port is taken, or the address, config, a parameter or a ROS argument is wrong.
    """
    with _optional("dashboard", "dashboard"):
        from eha_monitor.dashboard.events import EventLog
        from eha_monitor.dashboard.serve import claim, metrics_text, serving
        from eha_monitor.dashboard.state import Actuator
    metrics = None
    if served.metrics:
        with _optional("--metrics", "dashboard"):
            metrics = metrics_text()
    if served.foxglove is not None:
        with _optional("--foxglove", "foxglove"):
            from eha_monitor.ros.foxglove_server import serving_foxglove
    if actuators and config is not None:
        raise InputError("--config: expected either it or --actuator NAME=CONFIG")
    wanted = actuators_of(actuators) or [(
        with_namespace(load_settings(config), ros_args, "dashboard"),
        str(config or "default config"))]
    log, shown, nodes = EventLog(), {}, []
    with contextlib.ExitStack() as open_:
        door = claim(served.port, served.host, served.token, served.names)
        open_.callback(door.listener.close)
        open_.enter_context(running.ros_session(ros_args))
        for settings, source in wanted:
            node = open_.enter_context(running.node("dashboard", settings.monitor.namespace))
            settings = settings_of_node(node, settings)
            heard = Listener(node, settings, source, log)
            open_.callback(heard.close)
            nodes.append((node, settings))
            shown[settings.rig.name] = Actuator(
                settings.rig.name, node.get_namespace(), node.context.get_domain_id(),
                heard.state, heard.topics)
        _check_apart([node.get_fully_qualified_name() for node, _ in nodes])
        if served.foxglove is not None:
            socket_ = open_.enter_context(serving_foxglove(nodes, served.foxglove))
            print(f"foxglove: {socket_}", flush=True)
        page = open_.enter_context(serving(shown, log, door, metrics))
        print(f"dashboard: {page}", flush=True)
        running.spin([node for node, _ in nodes], duration)
    return 0


def _check_apart(names: list[str]) -> None:
    if len(set(names)) < len(names):
        raise InputError(f"ROS arguments: two actuators would both be {names[0]}, expected no "
                         "remap of the namespace or the node's name")
