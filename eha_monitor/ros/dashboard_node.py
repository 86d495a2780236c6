"""The dashboard: for each actuator a node that keeps what a page shows, and the web server."""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from eha_monitor.dashboard.events import ACKNOWLEDGED, EventLog
from eha_monitor.dashboard.state import Actuator, State
from eha_monitor.errors import InputError, optional
from eha_monitor.health.alarms import WATCHED
from eha_monitor.live.rows import Source
from eha_monitor.recordings.ring import plain_name
from eha_monitor.ros import running
from eha_monitor.ros.messages import DIAGNOSIS, findings_of, subscribe_to_monitor
from eha_monitor.ros.parameters import settings_of_node
from eha_monitor.ros.subscriptions import TopicInput
from eha_monitor.ros.topics import LATCHED, SHOWN_QOS, Topic, answered, every, topics_of
from eha_monitor.settings import Settings

FOLLOW_PERIOD, TAKE_PERIOD = 1.0, 0.05  # s


def position_topic(settings: Settings, source: str, resolve: Callable[[str], str] = str) -> Topic:
    """Return the topic of the measured position, and of its streams only that one."""
    for topic in topics_of(settings, source, resolve):
        for entry in topic.entries:
            position = tuple(pair for pair in entry.channels if pair[0] == "x")
            if position:
                stream = replace(entry, channels=position,
                                 source=Source(entry.source.name, ("x",), entry.source.held))
                return Topic(topic.name, (stream,), topic.full_name)
    raise InputError(f"{source}: channels.x: expected the position's topic")


class Listener:
    """Subscribes to what the page shows and keeps it in a state."""

    def __init__(self, node: Node, settings: Settings, source: str = "config",
                 log: EventLog | None = None):
        # what was heard
        self.state = State(settings, time.time, log, Path(settings.monitor.save_folder)
                           / f"{plain_name(settings.rig.name)}_acknowledged.json")
        name = node.resolve_topic_name
        measured = position_topic(settings, source, name)
        # full names of the topics, by the keys of ``View.silence``
        self.topics = {"measured": name(measured.name),
                       "estimates": ", ".join(name(f"monitor/{w.section}") for w in WATCHED),
                       "estimated": name("monitor/joint_states"),
                       "health": name("monitor/health")}
        self._node = node
        self.measured = TopicInput(node, measured, qos=SHOWN_QOS)
        for period, work in ((FOLLOW_PERIOD, self.measured.follow_graph),
                             (FOLLOW_PERIOD, lambda: self.state.watch(time.monotonic())),
                             (TAKE_PERIOD, self._take_measured)):
            every(node, period, work)
        subscribe_to_monitor(node, self._take_number, self._take_estimated, self._take_health)
        node.create_subscription(
            DiagnosticArray, DIAGNOSIS, lambda message: self.state.take_diagnosis(
                findings_of(message)), LATCHED)
        node.create_service(Trigger, "dashboard/acknowledge", self._on_acknowledge)

    def _take_measured(self) -> None:
        messages, _, _ = self.measured.take()
        if not messages:
            return
        now, clock_ns = time.monotonic(), self._node.get_clock().now().nanoseconds
        came, stamps_ns = (np.full(len(messages), value) for value in (now, clock_ns))
        for batch in self.measured.reader.read(messages, came, stamps_ns):
            for stamp_ns, values in zip(batch.stamps, batch.values, strict=True):
                self.state.take_position("measured", float(stamp_ns) * 1e-9, float(values[0]), now)

    def _take_number(self, symbol: str, suffix: str, value: float) -> None:
        take = self.state.take_stddev if suffix else self.state.take_value
        take(symbol, value, time.monotonic())

    def _take_estimated(self, message: JointState) -> None:
        if message.position:
            stamp = message.header.stamp
            self.state.take_position("estimated", stamp.sec + stamp.nanosec * 1e-9,
                                     message.position[0], time.monotonic())

    def _on_acknowledge(self, request, response):
        """Acknowledge what is raised; a service does not tell who calls it."""
        done = self.state.acknowledge(ACKNOWLEDGED, "a ROS service call")
        return answered(response, bool(done), f"acknowledged: {', '.join(done)}" if done else
                        "nothing is raised that has not been acknowledged")

    def _take_health(self, message: DiagnosticArray) -> None:
        hardware = message.status[0].hardware_id if message.status else ""
        self.state.take_findings(hardware, findings_of(message), time.monotonic())


@dataclass(frozen=True)
class Served:
    """What is served and where."""

    # port, host: of the page; port 0 takes any that is free
    port: int
    host: str
    # asked of everyone; None asks for none on loopback, and makes one elsewhere
    token: str | None = None
    metrics: bool = False  # whether ``/metrics`` is there
    foxglove: int | None = None  # port of a Foxglove WebSocket on loopback, or None for none
    names: tuple[str, ...] = ()  # further host names to answer to; a token is asked for then


def run_dashboard(config: Path | None, ros_args: list[str], served: Served,
                  duration: float | None = None, actuators: tuple[str, ...] = ()) -> int:
    """Serve the page until a signal or for ``duration`` s; returns the exit status.

    ``actuators`` : ``NAME=CONFIG`` for each of several actuators; else ``config`` is the only one.
    Raises InputError if the port is taken, or the address, config, a parameter or a ROS argument
    is wrong.
    """
    with optional("dashboard: {}; ", "dashboard"):
        from eha_monitor.dashboard.serve import claim, metrics_text, serving
    metrics = None
    if served.metrics:
        with optional("--metrics: {}; ", "dashboard"):
            metrics = metrics_text()
    if served.foxglove is not None:
        with optional("--foxglove: {}; ", "foxglove"):
            from eha_monitor.ros.foxglove_server import serving_foxglove
    wanted = running.actuators(config, actuators, ros_args, "dashboard")
    log, shown, nodes = EventLog(), {}, []
    with contextlib.ExitStack() as open_:
        door = claim(served.port, served.host, served.token, served.names)
        open_.callback(door.listener.close)
        open_.enter_context(running.ros_session(ros_args))
        for settings, source in wanted:
            node = open_.enter_context(running.node("dashboard", settings.monitor.namespace))
            settings = settings_of_node(node, settings)
            heard = Listener(node, settings, source, log)
            open_.callback(heard.measured.close)  # it is not the node's own
            nodes.append((node, settings))
            shown[settings.rig.name] = Actuator(
                settings.rig.name, node.get_namespace(), node.context.get_domain_id(),
                heard.state, heard.topics)
        running.check_apart([node for node, _ in nodes])
        if served.foxglove is not None:
            socket_ = open_.enter_context(serving_foxglove(nodes, served.foxglove))
            print(f"foxglove: {socket_}", flush=True)
        page = open_.enter_context(serving(shown, log, door, metrics))
        print(f"dashboard: {page}", flush=True)
        running.spin([node for node, _ in nodes], duration)
    return 0
