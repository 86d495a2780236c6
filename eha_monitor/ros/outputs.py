"""What the monitor publishes; each message is also kept for the bag of the last minutes."""

import time
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from eha_monitor.filters.results import ParameterEstimate
from eha_monitor.health.alarms import WATCHED
from eha_monitor.health.judge import Finding
from eha_monitor.ros import messages
from eha_monitor.ros.keeper import Keeper
from eha_monitor.ros.quality import clashes
from eha_monitor.settings import Settings

ESTIMATES = "monitor/estimates"  # each with its deviation, unit and status, in one stamped message

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)

QUEUED = QoSProfile(depth=10)


class Outputs:
    """The monitor's publishers.

    Parameters
    ----------
    node : node in the namespace of the topics.
    keeper : keeps what is published.
    settings : validated config; names frame and hardware.
    """

    def __init__(self, node: Node, keeper: Keeper, settings: Settings):
        self._node, self._keeper = node, keeper
        self._frame, self._hardware = settings.frame_id, settings.rig.name
        self._publishers: list[Publisher] = []
        self._topics: list[str] = []
        self._numbers = {}
        for watched in WATCHED:
            topic = f"monitor/{watched.section}"
            self._numbers[watched.symbol] = (self._make(Float64, topic),
                                             self._make(Float64, f"{topic}_stddev"))
        self._estimates = self._make(DiagnosticArray, ESTIMATES)
        self._state = self._make(JointState, "monitor/joint_states")
        self._health = self._make(DiagnosticArray, "monitor/health", LATCHED)
        # The same messages as the health: once in the bag is enough.
        self._diagnostics = self._make(DiagnosticArray, "/diagnostics", kept=False)

    def parameters(self, time_ns: int, found: Mapping[str, ParameterEstimate]) -> None:
        """Publish the estimates of the data up to a stamp in ns, those by symbol."""
        for symbol, estimate in found.items():
            if estimate.status != "no_data":
                for output, number in zip(self._numbers[symbol],
                                          (estimate.value, estimate.stddev), strict=True):
                    self._publish(output, messages.number(number))
        self._publish(self._estimates, messages.estimates(
            time_ns, self._frame, [found[symbol] for symbol in self._numbers if symbol in found],
            self._hardware))

    def state(self, time_ns: int, name: str, position: float, velocity: float) -> None:
        """Publish the estimated motion, m and m/s, at a stamp in ns."""
        self._publish(self._state, messages.joint_state(
            time_ns, name, position, velocity, self._frame))

    def health(self, findings: list[Finding]) -> None:
        """Publish the health, latched, and as diagnostics."""
        message = messages.diagnostics(self._node.get_clock().now().nanoseconds, findings,
                                       self._hardware)
        self._publish(self._health, message)
        self._publish(self._diagnostics, message)

    def clashes(self) -> list[str]:
        """Return in sentences which subscribers get nothing, as they ask for another QoS."""
        return [clash for topic in self._topics
                for clash in clashes(self._node, topic)]

    def close(self) -> None:
        """End the publishers."""
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)

    def _make(self, kind: type, topic: str, qos: QoSProfile = QUEUED,
              kept: bool = True) -> tuple[Publisher, int | None]:
        publisher = self._node.create_publisher(kind, topic, qos)
        self._topics.append(topic)
        self._publishers.append(publisher)
        if not kept or self._keeper.ring is None:
            return publisher, None
        type_name = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
        return publisher, self._keeper.stream(topic, type_name, latched=qos is LATCHED)

    def _publish(self, output: tuple[Publisher, int | None], message: Any) -> None:
        publisher, stream = output
        if stream is None:
            publisher.publish(message)
            return
        data = serialize_message(message)
        self._keeper.ring.append(stream, time.time_ns(), data)
        publisher.publish(data)
