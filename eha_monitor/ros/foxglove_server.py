"""The topics as they are on a Foxglove WebSocket, on loopback, for the Foxglove app."""

import contextlib
from collections.abc import Iterator

import foxglove
from rclpy.node import Node
from rosbags.typesys import Stores, get_typestore

from eha_monitor.dashboard.serve import HOST
from eha_monitor.errors import InputError
from eha_monitor.recordings.write import TopicType
from eha_monitor.ros.record_node import Recorder, topics_to_record
from eha_monitor.settings import Settings


class _Channels:
    """Stands where a recorder has its bag: messages go to whoever is connected."""

    def __init__(self):
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._channels: dict[str, foxglove.Channel] = {}

    def add_topic(self, topic: str, kind: TopicType) -> None:
        """Offer a topic with its type's definition; raises InputError if that is unknown."""
        if kind.msgtype not in self._store.fielddefs:
            raise InputError(f"{topic}: no definition of {kind.msgtype}")
        definition = self._store.generate_msgdef(kind.msgtype, ros_version=2)[0]
        schema = foxglove.Schema(name=kind.msgtype, encoding="ros2msg", data=definition.encode())
        self._channels[topic] = foxglove.Channel(topic, message_encoding="cdr", schema=schema)

    def write_raw(self, topic: str, time_ns: int, data: bytes) -> None:
        """Hand a serialised message on, if anybody looks at its topic."""
        channel = self._channels[topic]
        if channel.has_sinks():
            channel.log(data, log_time=time_ns)


@contextlib.contextmanager
def serving_foxglove(nodes: list[tuple[Node, Settings]], port: int) -> Iterator[str]:
    """Serve inputs and outputs of the monitors for the time of a block; gives the address.

    ``nodes`` : of each actuator the node in its namespace, and its config.  Raises InputError if
    the port is taken, or not allowed to this user.
    """
    foxglove.set_log_level("WARN")
    try:
        server = foxglove.start_server(name="eha_monitor", host=HOST, port=port)
    except (RuntimeError, OSError) as problem:
        raise InputError(f"--foxglove {port}: cannot serve on {HOST}:{port} ({problem}), expected "
                         "a free port") from problem
    try:
        channels = _Channels()
        told: set[str] = set()  # a topic of several, as /diagnostics, is offered once
        for node, settings in nodes:
            names = [node.resolve_topic_name(name) for name in topics_to_record(settings)]
            Recorder(node, channels, tuple(name for name in names if name not in told))
            told.update(names)
        yield f"ws://{HOST}:{server.port}"
    finally:
        server.stop()
