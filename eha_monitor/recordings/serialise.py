"""Channels as serialised messages of the contract's topics.

One message is serialised by rosbags; stamps and values are then patched into copies of it at
the offsets that :mod:`eha_monitor.recordings.cdr` finds.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from rosbags.typesys import Stores, get_typestore

from eha_monitor.recordings import cdr
from eha_monitor.recordings.cdr import Want

JOINT = "sensor_msgs/msg/JointState"
PRESSURE = "sensor_msgs/msg/FluidPressure"
TEMPERATURE = "sensor_msgs/msg/Temperature"
SEC, NANOSEC = Want("header.stamp.sec"), Want("header.stamp.nanosec")


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
        for want, values in {SEC: seconds, NANOSEC: rest,
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
        layout = cdr.locate(raw, store.fielddefs, msgtype, (SEC, NANOSEC, *columns))
        found.append((topic, msgtype, raw, {
            columns.get(want, want): place for want, place in layout.places.items()}))
    return found


def _topics(store, channels):
    """Yield (topic, type, template message, want -> channel) for what was recorded."""
    header = store.types["std_msgs/msg/Header"](
        stamp=store.types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id="")
    joints = {"piston": {"position": "x", "velocity": "v", "effort": "force"},
              "pump": {"velocity": "omega"}}
    joint = _joints(store, header, channels, joints)
    if joint:
        yield "joint_states", JOINT, *joint
    joint = _joints(store, header, channels, {"piston": {"position": "x_d"},
                                              "pump": {"velocity": "omega_d"}})
    if joint:
        yield "command", JOINT, *joint
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
