"""Bags for the tests, written by libraries other than the code under test."""

from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT = "sensor_msgs/msg/JointState"
PRESSURE = "sensor_msgs/msg/FluidPressure"
START = 1_700_000_000_000_000_000


def header(stamp_ns: int, frame: str = ""):
    time = STORE.types["builtin_interfaces/msg/Time"](
        sec=stamp_ns // 1_000_000_000, nanosec=stamp_ns % 1_000_000_000)
    return STORE.types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def joint(stamp_ns: int, names=("piston",), position=(), velocity=(), effort=(), frame="",
          little_endian=True) -> bytes:
    message = STORE.types[JOINT](
        header=header(stamp_ns, frame), name=list(names), position=np.array(position, float),
        velocity=np.array(velocity, float), effort=np.array(effort, float))
    return bytes(STORE.serialize_cdr(message, JOINT, little_endian=little_endian))


def pressure(stamp_ns: int, value: float) -> bytes:
    message = STORE.types[PRESSURE](header=header(stamp_ns), fluid_pressure=value, variance=0.0)
    return bytes(STORE.serialize_cdr(message, PRESSURE))


def number(value: float) -> bytes:
    return bytes(STORE.serialize_cdr(STORE.types["std_msgs/msg/Float64"](data=value),
                                     "std_msgs/msg/Float64"))


def write_mcap(path: Path, messages, *, compression="zstd", chunked=True, chunk_size=20_000,
               definitions=None, library_options=None) -> Path:
    """Write (topic, type, log_ns, bytes) with the mcap library."""
    kinds = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4,
             "none": CompressionType.NONE}
    options = {"chunk_size": chunk_size, "use_chunking": chunked, "index_types": IndexType.ALL,
               "compression": kinds[compression], **(library_options or {})}
    schemas, channels = {}, {}
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2", "test")
        for topic, msgtype, log_ns, data in messages:
            if msgtype not in schemas:
                text = (definitions or {}).get(msgtype)
                if text is None:
                    text = STORE.generate_msgdef(msgtype, ros_version=2)[0]
                schemas[msgtype] = writer.register_schema(msgtype, "ros2msg", text.encode())
            if (topic, msgtype) not in channels:
                channels[topic, msgtype] = writer.register_channel(topic, "cdr",
                                                                   schemas[msgtype])
            writer.add_message(channels[topic, msgtype], log_ns, data, log_ns)
        writer.finish()
    return path


def motion(n: int, step_ns: int = 1_000_000, start: int = START):
    """Return stamps (n,), position (n,) m and pressure (n,) Pa."""
    stamps = start + np.arange(n) * step_ns
    t = np.arange(n) * step_ns * 1e-9
    return stamps, 0.04 * np.sin(2 * np.pi * t), 2e6 + 1e5 * np.cos(2 * np.pi * t)


def contract_messages(n: int, **options):
    """Yield joint states and a pressure as (topic, type, log_ns, bytes)."""
    for stamp, x, p in zip(*motion(n, **options), strict=True):
        stamp = int(stamp)
        yield "/eha/joint_states", JOINT, stamp, joint(stamp, ("piston", "pump"), (x, 0.0),
                                                       (np.nan, 10 * x), ())
        yield "/eha/pressure/chamber_1", PRESSURE, stamp, pressure(stamp, p)
