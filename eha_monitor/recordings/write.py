"""Channels to rosbag2 mcap bags with the topics of the interface contract, piece by piece.

One message of a topic is serialised by rosbags; stamps and values are then patched into copies of
it, where :mod:`eha_monitor.recordings.cdr` finds their places.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from rosbags.typesys import Stores, get_typestore

from eha_monitor.errors import InputError
from eha_monitor.recordings.bag_writer import BagWriter, TopicType, check_bag_target
from eha_monitor.recordings.cdr import STAMP, Want, locate
from eha_monitor.recordings.columns import any_of, let_go
from eha_monitor.recordings.recording import Recording, within_limits
from eha_monitor.settings.monitor import Settings

JOINT = "sensor_msgs/msg/JointState"
PRESSURE = "sensor_msgs/msg/FluidPressure"
TEMPERATURE = "sensor_msgs/msg/Temperature"


@dataclass(frozen=True)
class MessageStream:
    """All messages of one topic, one behind the other.

    ``stamps`` (n,) int64 ns; ``data`` (n, bytes of a message) uint8.
    """

    topic: str
    msgtype: str
    stamps: np.ndarray
    data: np.ndarray


def messages_of(channels: dict[str, np.ndarray], stamps: np.ndarray, namespace: str
                ) -> list[MessageStream]:
    """Serialise the channels; rows without a finite value are left out.

    Parameters
    ----------
    channels : channel -> (n,) SI; those that hold a finite value anywhere in the recording.
    stamps : (n,) int64 ns, header stamps and log times.
    namespace : of the topics.
    """
    streams = []
    prefix = "/" + namespace.strip("/") if namespace.strip("/") else ""
    for topic, msgtype, raw, places in _layouts(tuple(channels)):
        columns = {channel: channels[channel] for channel in places if channel in channels}
        rows = np.isfinite(np.stack(list(columns.values()))).any(axis=0)
        table = np.tile(np.frombuffer(raw, dtype=np.uint8), (int(rows.sum()), 1))
        seconds, rest = np.divmod(stamps[rows], 1_000_000_000)
        for want, values in {**dict(zip(STAMP, (seconds, rest), strict=True)),
                             **{name: v[rows] for name, v in columns.items()}}.items():
            offset, dtype = places[want]
            patch = np.ascontiguousarray(values, dtype=dtype).view(np.uint8)
            table[:, offset:offset + dtype.itemsize] = patch.reshape(len(table), dtype.itemsize)
        streams.append(MessageStream(f"{prefix}/{topic}", msgtype, stamps[rows], table))
    return streams


@cache
def _layouts(channels: tuple[str, ...]) -> list[tuple[str, str, bytes, dict]]:
    """Return topic, type, a message of zeros, and where the stamp and each channel lie in it."""
    store = get_typestore(Stores.ROS2_JAZZY)
    found = []
    for topic, msgtype, message, columns in _topics(store, channels):
        raw = bytes(store.serialize_cdr(message, msgtype))
        layout = locate(raw, store.fielddefs, msgtype, (*STAMP, *columns))
        found.append((topic, msgtype, raw, {
            columns.get(want, want): place for want, place in layout.places.items()}))
    return found


def _topics(store, channels):
    """Yield (topic, type, template message, want -> channel) for what was recorded."""
    header = store.types["std_msgs/msg/Header"](
        stamp=store.types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id="")
    for topic, joints in (
            ("joint_states", {"piston": {"position": "x", "velocity": "v", "effort": "force"},
                              "pump": {"velocity": "omega"}}),
            ("command", {"piston": {"position": "x_d"}, "pump": {"velocity": "omega_d"}})):
        if joint := _joints(store, header, channels, joints):
            yield topic, JOINT, *joint
    for topic, msgtype, field, channel in (
            ("pressure/chamber_1", PRESSURE, "fluid_pressure", "p1"),
            ("pressure/chamber_2", PRESSURE, "fluid_pressure", "p2"),
            ("temperature", TEMPERATURE, "temperature", "temperature")):
        if channel in channels:
            message = store.types[msgtype](header=header, variance=0.0, **{field: 0.0})
            yield topic, msgtype, message, {Want(field): channel}


def _joints(store, header, channels, joints):
    """Return a JointState template and its columns; arrays are full length or empty.

    A joint's number that was not measured beside one that was is NaN.
    """
    names = [joint for joint, fields in joints.items()
             if any(channel in channels for channel in fields.values())]
    columns, arrays = {}, {}
    for field in ("position", "velocity", "effort"):
        found = {joint: joints[joint][field] for joint in names
                 if joints[joint].get(field) in channels}
        arrays[field] = np.full(len(names) if found else 0, np.nan)
        columns |= {Want(field, joint): channel for joint, channel in found.items()}
    if not columns:
        return None
    return store.types[JOINT](header=header, name=names, **arrays), columns


ROWS = 4096  # written at a time
__all__ = ["BagWriter", "ChannelWriter", "TopicType", "check_bag_target", "write_recording"]


class ChannelWriter:
    """Writes rows of channels to a new bag; a context manager.

    Header stamps and log times are ``start_ns`` plus the grid; a row in which a topic has no
    finite value is left out.

    Parameters
    ----------
    path, compression, overwrite : see :class:`bag_writer.BagWriter`.
    channels : those that are going to be written.
    sample_time : s.
    namespace : of the topics.
    limited : what no sensor could show is refused; a :class:`Recording` refused it when it was
        made.
    """

    def __init__(self, path: str | Path, channels: tuple[str, ...], sample_time: float,
                 namespace: str, *, compression: str = "zstd", overwrite: bool = False,
                 start_ns: int = 0, limited: bool = True):
        self.channels, self.sample_time, self.namespace = channels, sample_time, namespace
        self._limited = limited
        self.start_ns, self.rows = start_ns, 0
        none = messages_of({name: np.empty(0) for name in channels}, np.empty(0, np.int64),
                           namespace)
        if not none:
            raise InputError(f"{path}: nothing to write, no channel has a finite value")
        self._path = path
        self._bag = BagWriter(path, {one.topic: one.msgtype for one in none},
                              compression=compression, overwrite=overwrite)

    def write(self, channels: dict[str, np.ndarray]) -> None:
        """Append rows; channel -> (m,) SI values.

        Raises InputError if a channel runs away; nothing is left of the bag then, nor after
        Ctrl-C.
        """
        rows = len(next(iter(channels.values())))
        time = np.arange(self.rows, self.rows + rows) * self.sample_time
        if self._limited:
            channels = {name: within_limits(name, channels[name], time, str(self._path))[0]
                        for name in self.channels}
        for first in range(0, rows, ROWS):
            part = {name: channels[name][first:first + ROWS] for name in self.channels}
            count = min(ROWS, rows - first)
            stamps = self.start_ns + np.round(
                np.arange(self.rows, self.rows + count) * self.sample_time * 1e9).astype(np.int64)
            _check_stamps(self._path, stamps[0], stamps[-1])
            self._bag.write_many({one.topic: (one.stamps, one.data) for one in messages_of(
                part, stamps, self.namespace)})
            self.rows += count

    def __enter__(self) -> "ChannelWriter":
        return self

    def __exit__(self, kind, value, traceback) -> None:
        # After Ctrl-C too: unlike a live recording, these can be made again.
        self._bag.close() if kind is None else self._bag.discard()


def _check_stamps(path: str | Path, first: int, last: int) -> None:
    if first < 0 or last >= 2**31 * 1_000_000_000:
        raise InputError(f"{path}: stamps from {first} to {last} ns do not fit a header")


def write_recording(path: str | Path, recording: Recording, settings: Settings, *,
                    overwrite: bool = False) -> Path:
    """Write a recording as a bag; ``monitor.namespace`` of the settings is that of its topics.

    ``path``, ``overwrite`` : see :class:`bag_writer.BagWriter`.

    Raises InputError if the target exists or cannot be written, or there is nothing to write.
    """
    if len(recording) == 0:
        raise InputError(f"{path}: nothing to write, the recording has no samples")
    start = recording.start_ns
    _check_stamps(path, start, start + round((len(recording) - 1) * recording.sample_time * 1e9))
    names = tuple(name for name, values in recording.channels.items()
                  if any_of((values,), np.isfinite))
    with ChannelWriter(path, names, recording.sample_time, settings.monitor.namespace,
                       overwrite=overwrite, start_ns=start, limited=False) as writer:
        for first in range(0, len(recording), ROWS):
            writer.write({name: recording.channels[name][first:first + ROWS] for name in names})
            let_go(*recording.channels.values())
    return Path(path)
