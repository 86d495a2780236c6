"""Messages per second of reading and writing a bag: the package's own way and the libraries'.

    python benchmarks/bag_speed.py [--seconds 60] [--rounds 5]
    python benchmarks/bag_speed.py --memory --seconds 3600

The bag holds four topics at 1 kHz.  Every way of reading ends with the same: for each topic the
stamps and the numbers of its messages as arrays; ``rosbags, decoded`` makes message objects.
Every way of writing begins with the same serialised messages.  All are measured in one run,
medians, and their ratio to the own way.

``--memory`` reads a bag with its columns put on the grid as they come, then with all messages
kept until the end; the peak resident set of a process of its own, less that of an empty bag's.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from rosbags.rosbag2 import Reader
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from eha_monitor.recordings.bag import Bag
from eha_monitor.recordings.read import Collector, _read
from eha_monitor.recordings.write import BagWriter, messages_of
from eha_monitor.settings import Settings

STEP_NS = 1_000_000
HEAD = 4  # encapsulation; the stamp follows


def channels_of(seconds: float) -> dict[str, np.ndarray]:
    """Return noise in the channels that make four topics."""
    noise = np.random.default_rng(0).normal(size=(4, round(1000 * seconds)))
    return dict(zip(("x", "x_d", "p1", "p2"), noise, strict=True))


def number_of(raw: bytes) -> tuple[int, float]:
    """Return stamp in ns and the last number but one of a message, by views on its bytes."""
    second, rest = np.frombuffer(raw, "<u4", 2, HEAD)
    return int(second) * 10**9 + int(rest), np.frombuffer(raw[-16:], "<f8")[0]


def arrays(messages: dict) -> dict:
    """Return topic -> (stamps, numbers)."""
    return {topic: np.array(found).T for topic, found in messages.items()}


def by_own(bag: Path) -> None:
    """The package's reader, up to the channels' series."""
    collector = Collector(Settings())
    for file, block in Bag(bag).blocks():
        collector.take(file, block)
    collector.flush(last=True)
    losses: list[str] = []
    collector.channels("", losses, collector.sources("", losses))


def by_rosbags(bag: Path) -> None:
    """Rosbags' reader, its raw messages viewed."""
    found: dict = {}
    with Reader(bag) as reader:
        for connection, _, raw in reader.messages():
            found.setdefault(connection.topic, []).append(number_of(raw))
    arrays(found)


def by_rosbags_decoded(bag: Path) -> None:
    """Rosbags' reader and its message objects."""
    store, found = get_typestore(Stores.ROS2_JAZZY), {}
    with Reader(bag) as reader:
        for connection, stamp, raw in reader.messages():
            message = store.deserialize_cdr(raw, connection.msgtype)
            value = (message.position[0] if connection.msgtype.endswith("JointState")
                     else message.fluid_pressure)
            found.setdefault(connection.topic, []).append((stamp, value))
    arrays(found)


def by_mcap(bag: Path) -> None:
    """Mcap's non-seeking reader, its messages viewed."""
    found: dict = {}
    with next(bag.glob("*.mcap")).open("rb") as file:
        for record in StreamReader(file).records:
            if isinstance(record, Message):
                found.setdefault(record.channel_id, []).append(number_of(record.data))
    arrays(found)


def messages(seconds: float) -> list:
    """Return the serialised messages of the bag."""
    channels = channels_of(seconds)
    stamps = 10**18 + STEP_NS * np.arange(len(channels["x"]))
    return messages_of(channels, stamps, "/eha")


def writes_own(streams: list, bag: Path) -> None:
    """The package's writer, by the thousand."""
    with BagWriter(bag, {one.topic: one.msgtype for one in streams}) as writer:
        for first in range(0, len(streams[0].stamps), 4096):
            part = slice(first, first + 4096)
            writer.write_many({one.topic: (one.stamps[part], one.data[part]) for one in streams})


def rows_of(streams: list):
    """Yield place of the stream, stamp and message in the order of time."""
    for k, stamp in enumerate(streams[0].stamps.tolist()):
        for place, one in enumerate(streams):
            yield place, stamp, one.data[k].tobytes()


def writes_single(streams: list, bag: Path) -> None:
    """The package's writer, one by one: mcap's writer and a bag's metadata."""
    with BagWriter(bag, {one.topic: one.msgtype for one in streams}) as writer:
        for place, stamp, raw in rows_of(streams):
            writer.write_raw(streams[place].topic, stamp, raw)


def writes_mcap(streams: list, bag: Path) -> None:
    """Mcap's writer alone."""
    bag.mkdir()
    with (bag / "bag.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        ids = [writer.register_channel(one.topic, "cdr", writer.register_schema(
            one.msgtype, "ros2msg", b"")) for one in streams]
        for place, stamp, raw in rows_of(streams):
            writer.add_message(ids[place], stamp, raw, stamp)
        writer.finish()


def writes_rosbags(streams: list, bag: Path) -> None:
    """Rosbags' writer."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with RosbagsWriter(bag, version=9) as writer:
        ids = [writer.add_connection(one.topic, one.msgtype, typestore=store) for one in streams]
        for place, stamp, raw in rows_of(streams):
            writer.write(ids[place], stamp, raw)


def median(run: Callable[[], None], rounds: int) -> float:
    """Return the median wall time in s after one run that is not counted."""
    times = []
    for _ in range(rounds + 1):
        started = time.perf_counter()
        run()
        times.append(time.perf_counter() - started)
    return float(np.median(times[1:]))


def memory(seconds: float) -> None:
    """Print the peak memory of both ways of reading."""
    with tempfile.TemporaryDirectory() as folder:
        for name, length in (("short", 1.0), ("long", seconds)):
            writes_own(messages(length), Path(folder) / name)
        for how in ("streamed", "kept"):
            peaks = []
            for name in ("short", "long"):
                peaks.append(float(subprocess.run(
                    [sys.executable, __file__, "--read", how, f"{folder}/{name}"], check=True,
                    capture_output=True, text=True).stdout))
            print(f"{how:10s} {peaks[1] - peaks[0]:6.0f} MB beyond the {peaks[0]:.0f} MB of a "
                  "bag of one second", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--memory", action="store_true")
    parser.add_argument("--read", nargs=2, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.read:
        _read(asked.read[1], Settings(), streamed=asked.read[0] == "streamed")
        status = Path("/proc/self/status").read_text().split("VmHWM:")[1]
        print(int(status.split()[0]) / 1024)
        return
    if asked.memory:
        memory(asked.seconds)
        return
    streams = messages(asked.seconds)
    count = sum(len(one.stamps) for one in streams)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        writes_own(streams, bag)
        ways = {"read, own": lambda: by_own(bag), "read, rosbags raw": lambda: by_rosbags(bag),
                "read, rosbags decoded": lambda: by_rosbags_decoded(bag),
                "read, mcap raw": lambda: by_mcap(bag)}
        number = iter(range(1000))
        for name, write in (("own", writes_own), ("own, one by one", writes_single),
                            ("mcap", writes_mcap), ("rosbags", writes_rosbags)):
            ways[f"write, {name}"] = lambda write=write: write(
                streams, Path(folder) / f"made_{next(number)}")
        own: dict[str, float] = {}
        for name, run in ways.items():
            rate = count / median(run, asked.rounds)
            first = own.setdefault(name.split(",")[0], rate)
            print(f"{name:24s} {rate / 1e3:9.0f} thousand messages/s  {first / rate:6.1f} x",
                  flush=True)


if __name__ == "__main__":
    main()
