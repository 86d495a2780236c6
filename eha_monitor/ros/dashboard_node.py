"""The dashboard node: the topics of rig and monitor into the state that a page shows."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from eha_monitor.dashboard.events import ACKNOWLEDGED, EventLog
from eha_monitor.dashboard.state import State
from eha_monitor.errors import InputError
from eha_monitor.health.alarms import WATCHED
from eha_monitor.live.rows import Source
from eha_monitor.ros.inputs import Topic, topics_of
from eha_monitor.ros.messages import findings_of
from eha_monitor.ros.outputs import LATCHED
from eha_monitor.ros.subscriptions import TopicInput
from eha_monitor.settings import Settings

FOLLOW_PERIOD, TAKE_PERIOD = 1.0, 0.05  # s
# What is shown may miss samples, and must not be late: the newest of each turn are enough.
SHOWN_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


def position_topic(settings: Settings, source: str,
                   resolve: Callable[[str], str] = str) -> Topic:
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
    """Subscribes to what the page shows and keeps it in a state.

    Parameters
    ----------
    node : node in the namespace of the topics.
    settings : validated config.
    source : name of the config in errors.
    log : takes what changes.

    Attributes
    ----------
    state : what was heard.
    topics : full names of the topics, by the keys of ``View.silence``.
    """

    def __init__(self, node: Node, settings: Settings, source: str = "config",
                 log: EventLog | None = None):
        self.state = State(settings, time.time, log)
        name = node.resolve_topic_name
        measured = position_topic(settings, source, name)
        self.topics = {"measured": name(measured.name),
                       "estimates": ", ".join(name(f"monitor/{w.section}") for w in WATCHED),
                       "estimated": name("monitor/joint_states"),
                       "health": name("monitor/health")}
        self._node = node
        self.measured = TopicInput(node, measured, qos=SHOWN_QOS)
        for period, work in ((FOLLOW_PERIOD, self.measured.follow_graph),
                             (FOLLOW_PERIOD, lambda: self.state.watch(time.monotonic())),
                             (TAKE_PERIOD, self._take_measured)):
            node.create_timer(period, work, clock=Clock(clock_type=ClockType.STEADY_TIME))
        for watched in WATCHED:
            for suffix, take in (("", self.state.take_value),
                                 ("_stddev", self.state.take_stddev)):
                node.create_subscription(
                    Float64, f"monitor/{watched.section}{suffix}",
                    lambda message, take=take, symbol=watched.symbol:
                        take(symbol, message.data, time.monotonic()), 10)
        node.create_subscription(JointState, "monitor/joint_states", self._take_estimated, 10)
        node.create_subscription(DiagnosticArray, "monitor/health", self._take_health, LATCHED)
        node.create_service(Trigger, "dashboard/acknowledge", self._on_acknowledge)

    def close(self) -> None:
        """End the subscription that is not the node's own."""
        self.measured.close()

    def _take_measured(self) -> None:
        messages, _, _ = self.measured.take()
        if not messages:
            return
        now, clock_ns = time.monotonic(), self._node.get_clock().now().nanoseconds
        came, stamps_ns = (np.full(len(messages), value) for value in (now, clock_ns))
        for batch in self.measured.read(messages, came, stamps_ns):
            for stamp_ns, values in zip(batch.stamps, batch.values, strict=True):
                self.state.take_position("measured", float(stamp_ns) * 1e-9, float(values[0]), now)

    def _take_estimated(self, message: JointState) -> None:
        if message.position:
            stamp = message.header.stamp
            self.state.take_position("estimated", stamp.sec + stamp.nanosec * 1e-9,
                                     message.position[0], time.monotonic())

    def _on_acknowledge(self, request, response):
        """Acknowledge what is raised; a service does not tell who calls it."""
        done = self.state.acknowledge(ACKNOWLEDGED, "a ROS service call")
        response.success = bool(done)
        response.message = (f"acknowledged: {', '.join(done)}" if done else
                            "nothing is raised that has not been acknowledged")
        return response

    def _take_health(self, message: DiagnosticArray) -> None:
        hardware = message.status[0].hardware_id if message.status else ""
        self.state.take_findings(hardware, findings_of(message), time.monotonic())


