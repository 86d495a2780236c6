"""Topics: which carry which channels, in which type and quality; timers; answers of services."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.timer import Timer
from rclpy.validate_topic_name import validate_topic_name

from eha_monitor.errors import InputError
from eha_monitor.live.rows import Source
from eha_monitor.recordings.cdr import steps_of
from eha_monitor.settings.channels import Channel
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import listed


def profile(depth: int, reliable: bool = True, latched: bool = False) -> QoSProfile:
    """Return a quality; ``latched``: a late subscriber gets the last messages."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)


LATCHED = profile(1, latched=True)
QUEUED = profile(10)
OUTPUT_QOS = profile(1000)  # the simulator's: reliable suits subscribers of either kind
# Best effort takes from every publisher; the depth holds ten seconds of a process that stands.
INPUT_QOS = profile(10_000, reliable=False)
# What is shown may miss samples, and must not be late: the newest of each turn are enough.
SHOWN_QOS = profile(100, reliable=False)


def every(node: Node, period: float, work: Callable[[], None]) -> Timer:
    """Do some work every ``period`` s of real time: it must not stop with ``/clock``."""
    return node.create_timer(period, work, clock=Clock(clock_type=ClockType.STEADY_TIME))


def answered(response: Any, success: bool, message: str) -> Any:
    """Return the response of a service with what it says."""
    response.success, response.message = success, message
    return response


def crowd(node: Node, topic: str) -> str:
    """Return in a sentence that a topic has several publishers, and which; "" where it has not."""
    name = node.resolve_topic_name(topic)
    who = sorted(_who((each.node_name, each.node_namespace))
                 for each in node.get_publishers_info_by_topic(name))
    return f"{name}: {len(who)} publishers, {listed(who)}" if len(who) > 1 else ""


def clashes(node: Node, topic: str) -> list[str]:
    """Return in sentences which others on a topic get nothing from a node, or give it nothing.

    Between qualities that do not go together DDS delivers nothing, and reports nothing.

    Parameters
    ----------
    node : publishes or subscribes there; the graph knows with what quality.
    topic : name, relative to the node's namespace; sentences have its full name, remaps included.
    """
    name = node.resolve_topic_name(topic)
    own = (node.get_name(), node.get_namespace())
    # Both ends as the graph has them: only there are their defaults written in the same way.
    publishers = node.get_publishers_info_by_topic(name)
    subscribers = node.get_subscriptions_info_by_topic(name)
    found = []
    for publisher in publishers:
        for subscriber in subscribers:
            ends = [(end.node_name, end.node_namespace) for end in (publisher, subscriber)]
            if own not in ends:
                continue
            verdict, reason = qos_check_compatible(publisher.qos_profile, subscriber.qos_profile)
            if verdict == QoSCompatibility.ERROR:
                why = " ".join(reason.replace("ERROR:", "").replace(";", " ").split())[:120]
                other = (f"the subscriber {_who(ends[1])} asks for a QoS that is not offered"
                         if own == ends[0] else
                         f"the publisher {_who(ends[0])} offers a QoS that cannot be taken")
                found.append(f"{name}: {other}, nothing is delivered: {why}")
    return found


def _who(end: tuple[str, str]) -> str:
    return f"{end[1].rstrip('/')}/{end[0]}"


# Type of a topic that nobody publishes yet, told by the field that is read from it.
DEFAULT_TYPES = {"position": "sensor_msgs/msg/JointState",
                 "velocity": "sensor_msgs/msg/JointState",
                 "effort": "sensor_msgs/msg/JointState",
                 "fluid_pressure": "sensor_msgs/msg/FluidPressure",
                 "temperature": "sensor_msgs/msg/Temperature", "data": "std_msgs/msg/Float64"}
HELD = frozenset({"temperature"})  # the oil's temperature is slow: its last value counts
# What the diagnosis reads from recordings, and no stage of the live monitor.
UNUSED = frozenset({"omega_d"})


@dataclass(frozen=True)
class Entry:
    """Channels that one entry (name) of one topic gives, with one delay: one stream."""

    source: Source
    name: str
    delay_ns: int
    channels: tuple[tuple[str, Channel], ...]


@dataclass(frozen=True)
class Topic:
    """One topic to subscribe to, and the streams it carries."""

    name: str  # as the config has it, before any remap
    entries: tuple[Entry, ...]
    full_name: str  # as it is on the graph, for messages to people

    @property
    def default_type(self) -> str | None:
        """Type to expect where the graph tells none, or None if the fields do not say."""
        kinds = {DEFAULT_TYPES.get(channel.field) for entry in self.entries
                 for _, channel in entry.channels}
        return kinds.pop() if len(kinds) == 1 else None


def topics_of(settings: Settings, source: str = "config",
              resolve: Callable[[str], str] = str) -> list[Topic]:
    """Return the topics of the channel map with their streams.

    ``resolve`` : name in the config -> full name on the graph, remaps included.  Raises InputError
    if the map has no position, or a channel without topic or field.
    """
    if "x" not in settings.channels:
        raise InputError(f"{source}: channels.x: expected the position's topic, it stamps the "
                         "rows")
    # By the name on the graph: a drafted config spells out a topic that a default names as well.
    streams: dict[str, dict[tuple, list]] = {}
    spelt: dict[str, str] = {}
    for name, channel in settings.channels.items():
        if name in UNUSED:
            continue
        for key in ("topic", "field"):
            if not getattr(channel, key):
                raise InputError(f"{source}: channels.{name}.{key}: expected a {key} to "
                                 "subscribe to")
        try:
            check_topic(channel.topic)
        except InputError as problem:
            raise InputError(f"{source}: channels.{name}.topic: {problem}") from problem
        try:
            steps_of(channel.field)
        except ValueError as problem:
            raise InputError(f"{source}: channels.{name}.field: expected a field path such as "
                             f"position or wrench.force.x, got {channel.field!r}") from problem
        key = (channel.name, round(channel.delay * 1e9), name in HELD)
        full_name = resolve(channel.topic)
        spelt.setdefault(full_name, channel.topic)
        streams.setdefault(full_name, {}).setdefault(key, []).append((name, channel))
    topics = []
    for full_name, found in streams.items():
        entries = [Entry(Source(f"{full_name} ({name})" if name else full_name,
                                tuple(channel for channel, _ in channels), held),
                         name, delay, tuple(channels))
                   for (name, delay, held), channels in found.items()]
        topics.append(Topic(spelt[full_name], tuple(entries), full_name))
    return topics


def check_topic(name: str) -> None:
    """Raise InputError for a name that ROS does not take for a topic."""
    try:
        if not (name.isascii() and name.isprintable()):  # ROS reads up to a zero only
            raise ValueError(name)
        validate_topic_name(name)
    except (InvalidTopicNameException, ValueError) as problem:
        raise InputError(f"{name!r} is no name of a topic, expected letters, digits, '_' and "
                         "'/'") from problem


def message_class(type_name: str) -> type:
    """Return the class of a type as ``std_msgs/msg/Float64``; InputError if not installed."""
    parts = type_name.split("/")
    try:
        if len(parts) != 3:
            raise ValueError(type_name)
        return getattr(importlib.import_module(f"{parts[0]}.{parts[1]}"), parts[2])
    except (ImportError, AttributeError, ValueError) as problem:
        raise InputError(f"message type {type_name} is not installed") from problem
