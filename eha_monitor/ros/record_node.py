"""The record node: topics into a rosbag2 mcap bag, as serialised bytes."""

import sys
import time
from pathlib import Path

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from eha_monitor.errors import InputError
from eha_monitor.health.alarms import WATCHED
from eha_monitor.recordings.write import BagWriter, TopicType
from eha_monitor.ros import running
from eha_monitor.ros.messages import ESTIMATES
from eha_monitor.ros.topics import check_topic, every, message_class, profile
from eha_monitor.settings import Settings

# Looking for publishers; rosbag2 does the same.
POLL_PERIOD = 0.1
DEPTH = 5000


def topics_to_record(settings: Settings) -> tuple[str, ...]:
    """Return the input topics of the channel map and what the monitor publishes."""
    inputs = dict.fromkeys(channel.topic for channel in settings.channels.values()
                           if channel.topic)
    outputs = [f"monitor/{watched.section}{end}" for watched in WATCHED for end in ("", "_stddev")]
    return (*inputs, *outputs, ESTIMATES, "monitor/joint_states", "monitor/health", "/diagnostics")


class Recorder:
    """Subscribes to topics, relative or absolute, as they appear and writes what comes."""

    def __init__(self, node: Node, writer: BagWriter, topics: tuple[str, ...]):
        self.writer = writer
        self._node = node
        # those that nobody has published so far
        self.waiting = dict.fromkeys(node.resolve_topic_name(topic) for topic in topics)
        self._poll()
        every(node, POLL_PERIOD, self._poll)

    def _poll(self) -> None:
        for topic in list(self.waiting):
            publishers = self._node.get_publishers_info_by_topic(topic)
            if publishers:
                del self.waiting[topic]
                self._subscribe(topic, publishers)

    def _subscribe(self, topic: str, publishers: list) -> None:
        """Subscribe with the strongest QoS that every publisher offers."""
        type_name = publishers[0].topic_type
        profiles = [info.qos_profile for info in publishers]
        latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
        reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
        try:
            kind = message_class(type_name)
            self.writer.add_topic(topic, TopicType(type_name, latched))
        except InputError as problem:
            print(f"{topic} is left out: {problem}", file=sys.stderr, flush=True)
            return
        write, now = self.writer.write_raw, time.time_ns

        self._node.create_subscription(
            kind, topic, lambda data: write(topic, now(), data), raw=True,
            qos_profile=profile(DEPTH, reliable, latched))


def run_record(out: Path, ros_args: list[str], topics: tuple[str, ...] | None = None,
               duration: float | None = None, config: Path | None = None) -> int:
    """Record until a signal or for ``duration`` s; returns the exit status.

    ``topics`` : topics to record; None or empty takes those of :func:`topics_to_record`.  Raises
    InputError if the bag cannot be written, or the config or a ROS argument is wrong.
    """
    settings, _ = running.configured(config, ros_args, "record")
    topics = tuple(topics or topics_to_record(settings))
    for topic in topics:
        check_topic(topic)
    with (running.ros_session(ros_args),
          running.node("record", settings.monitor.namespace) as node,
          BagWriter(out, {}) as writer):
        recorder = Recorder(node, writer, topics)
        running.spin(node, duration)
        for topic in recorder.waiting:
            print(f"{topic}: no publisher", file=sys.stderr)
        print(f"{out}: {sum(writer.counts.values())} messages on {len(writer.counts)} topics",
              flush=True)
    return 0
