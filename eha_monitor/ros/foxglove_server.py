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
def serving_foxglove(node: Node, settings: Settings, port: int) -> Iterator[str]:
    """Serve inputs and outputs of the monitor for the time of a block; gives the address.

    Raises
    ------
    InputError
        If the port is taken, or not allowed to this user.
    """
    foxglove.set_log_level("WARN")
    try:
        server = foxglove.start_server(name="eha_monitor", host=HOST, port=port)
    except (RuntimeError, OSError) as problem:
        raise InputError(f"--foxglove {port}: cannot serve on {HOST}:{port} ({problem}), expected "
                         "a free port") from problem
    try:
        Recorder(node, _Channels(), topics_to_record(settings))
        yield f"ws://{HOST}:{server.port}"
    finally:
        server.stop()
