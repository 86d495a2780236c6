"""What the monitor publishes: messages filled with plain floats and levels, and the publishers.

Each message is also kept for the bag of the last minutes.
"""

import math
import struct
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from eha_monitor.estimation.results import ModelStatus, ParameterEstimate
from eha_monitor.health.alarms import SECTIONS, WATCHED
from eha_monitor.health.judge import Finding
from eha_monitor.ros.keeper import Keeper
from eha_monitor.ros.topics import LATCHED, QUEUED
from eha_monitor.settings import Settings

ESTIMATES = "monitor/estimates"  # each with its deviation, unit and status, in one stamped message
DIAGNOSIS = "monitor/diagnosis"
LEVELS = {"OK": DiagnosticStatus.OK, "WARN": DiagnosticStatus.WARN,
          "ERROR": DiagnosticStatus.ERROR, "STALE": DiagnosticStatus.STALE}
# How serious it is that a parameter has a status.
ESTIMATE_LEVELS = {"converged": "OK", "not_excited": "OK", "diverged": "ERROR", "no_data": "STALE"}
DOUBLE = struct.Struct("<xBxxd")  # a Float64 as it is sent, behind the encapsulation
_LEVEL_NAMES = {level: name for name, level in LEVELS.items()}


def stamp(time_ns: int) -> Time:
    """Return a stamp; ``time_ns`` since the epoch, in the range that the type holds."""
    seconds, nanoseconds = divmod(int(time_ns), 1_000_000_000)
    return Time(sec=min(max(seconds, -2**31), 2**31 - 1), nanosec=nanoseconds)


def joint_state(time_ns: int, name: str, position: float, velocity: float,
                frame: str = "") -> JointState:
    """Return the estimated state of one joint, m and m/s; an unknown velocity is left out."""
    message = JointState(name=[name], position=[float(position)])
    if math.isfinite(velocity):
        message.velocity = [float(velocity)]
    message.header.stamp, message.header.frame_id = stamp(time_ns), frame
    return message


def estimates(time_ns: int, frame: str, found: Iterable[ParameterEstimate], model: ModelStatus,
              hardware: str) -> DiagnosticArray:
    """Return estimates as one message, each a status with value and standard deviation.

    The numbers are text from which the very float is read again; an estimate without data has
    none.

    ``model`` : says where each comes from, and whether it is in doubt.
    """
    statuses = []
    for estimate in found:
        there, doubted = estimate.status != "no_data", model.in_doubt(estimate.name)
        values = {"value": repr(float(estimate.value)), "stddev": repr(float(estimate.stddev))
                  } if there else {}
        values |= {"unit": estimate.unit, "status": estimate.status,
                   "by": model.origin(estimate.name), "in_doubt": str(int(doubted))}
        level, message = ESTIMATE_LEVELS[estimate.status], estimate.message or estimate.status
        if doubted and level == "OK":
            level, message = "WARN", f"in doubt: {model.tainted[estimate.name].reason}; {message}"
        statuses.append(DiagnosticStatus(
            level=LEVELS[level], name=f"{hardware}: {SECTIONS[estimate.name]}",
            message=message, hardware_id=hardware,
            values=[KeyValue(key=key, value=value) for key, value in values.items()]))
    return _array(time_ns, frame, statuses)


def _array(time_ns: int, frame: str, statuses: list[DiagnosticStatus]) -> DiagnosticArray:
    message = DiagnosticArray(status=statuses)
    message.header.stamp, message.header.frame_id = stamp(time_ns), frame
    return message


def plain(value: float | int | str) -> str:
    """Return a value of the diagnostics; a number is nothing but a number.

    >>> plain(600.12345678), plain(6e8), plain(3), plain("text"), plain(float("nan"))
    ('600.123', '6e+08', '3', 'text', '')
    """
    if isinstance(value, str):
        return value
    if not math.isfinite(value):
        return ""
    return str(value) if isinstance(value, int) else f"{float(value):.6g}"


def diagnostics(time_ns: int, findings: list[Finding], hardware: str, frame: str = ""
                ) -> DiagnosticArray:
    """Return findings as one message; dashboards match on names and hardware_id, which stay."""
    return _array(time_ns, frame, [DiagnosticStatus(
        level=LEVELS[one.level], name=f"{hardware}: {one.name}", message=one.message,
        hardware_id=hardware, values=[KeyValue(key=key, value=plain(value))
                                      for key, value in one.values.items()])
        for one in findings])


def findings_of(message: DiagnosticArray) -> list[Finding]:
    """Return the findings of a message, the values as text; statuses of no known level are not.

    The inverse of :func:`diagnostics`, as far as another process can tell.
    """
    return [Finding(entry.name.rpartition(": ")[2], _LEVEL_NAMES[entry.level], entry.message,
                    {pair.key: pair.value for pair in entry.values})
            for entry in message.status if entry.level in _LEVEL_NAMES]


def subscribe_to_monitor(node: Node, take_number: Callable[[str, str, float], None],
                         take_state: Callable[[JointState], None],
                         take_health: Callable[[DiagnosticArray], None]) -> None:
    """Subscribe to what a monitor publishes in a node's namespace.

    ``take_number`` : called with symbol, ``""`` or ``"_stddev"``, and the number.
    """
    for watched in WATCHED:
        for suffix in ("", "_stddev"):
            node.create_subscription(
                Float64, f"monitor/{watched.section}{suffix}",
                lambda message, symbol=watched.symbol, suffix=suffix:
                    take_number(symbol, suffix, message.data), QUEUED)
    node.create_subscription(JointState, "monitor/joint_states", take_state, QUEUED)
    node.create_subscription(DiagnosticArray, "monitor/health", take_health, LATCHED)


class Outputs:
    """The monitor's publishers; ``settings`` name frame and hardware."""

    def __init__(self, node: Node, keeper: Keeper, settings: Settings):
        self._node, self._keeper = node, keeper
        self._frame, self._hardware = settings.frame_id, settings.rig.name
        self._publishers: list[Publisher] = []
        self.topics: list[str] = []
        self._numbers = {}
        for watched in WATCHED:
            topic = f"monitor/{watched.section}"
            self._numbers[watched.symbol] = (self._make(Float64, topic),
                                             self._make(Float64, f"{topic}_stddev"))
        self._estimates = self._make(DiagnosticArray, ESTIMATES)
        self._state = self._make(JointState, "monitor/joint_states")
        self._health = self._make(DiagnosticArray, "monitor/health", LATCHED)
        self._diagnosis = self._make(DiagnosticArray, DIAGNOSIS, LATCHED)
        # The same messages as the health: once in the bag is enough.
        self._diagnostics = self._make(DiagnosticArray, "/diagnostics", kept=False)

    def parameters(self, time_ns: int, found: Mapping[str, ParameterEstimate],
                   model: ModelStatus) -> None:
        """Publish what stands of the stages' estimates, of the data up to a stamp in ns."""
        found = model.best(found)
        for symbol, estimate in found.items():
            if estimate.status != "no_data":
                for output, value in zip(self._numbers[symbol],
                                         (estimate.value, estimate.stddev), strict=True):
                    self._publish(output, Float64(data=float(value)))
        self._publish(self._estimates, estimates(
            time_ns, self._frame, [found[symbol] for symbol in self._numbers if symbol in found],
            model, self._hardware))

    def state(self, time_ns: int, name: str, position: float, velocity: float) -> None:
        """Publish the estimated motion, m and m/s, at a stamp in ns."""
        self._publish(self._state, joint_state(time_ns, name, position, velocity, self._frame))

    def health(self, findings: list[Finding]) -> None:
        """Publish the health, latched, and as diagnostics."""
        message = diagnostics(self._node.get_clock().now().nanoseconds, findings,
                              self._hardware, self._frame)
        self._publish(self._health, message)
        self._publish(self._diagnostics, message)

    def diagnosis(self, findings: list[Finding]) -> None:
        """Publish what the monitor's own diagnosis says, latched."""
        self._publish(self._diagnosis, diagnostics(
            self._node.get_clock().now().nanoseconds, findings, self._hardware, self._frame))

    def close(self) -> None:
        """End the publishers."""
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)

    def _make(self, kind: type, topic: str, qos: QoSProfile = QUEUED,
              kept: bool = True) -> tuple[Publisher, int | None]:
        publisher = self._node.create_publisher(kind, topic, qos)
        self.topics.append(topic)
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
        data = (DOUBLE.pack(1, message.data) if type(message) is Float64
                else serialize_message(message))
        self._keeper.ring.append(stream, time.time_ns(), data)
        publisher.publish(data)
