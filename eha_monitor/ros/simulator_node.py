"""The simulator node: the simulated actuator on the topics of the channel map."""

import gc
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_srvs.srv import Trigger

from eha_monitor.errors import InputError
from eha_monitor.physics.simulator import Simulator, demanded_position
from eha_monitor.ros import running
from eha_monitor.ros.parameters import SIMULATOR_KEYS, declare, settings_of_node
from eha_monitor.ros.subscriptions import TopicInput
from eha_monitor.ros.topics import (
    HELD,
    OUTPUT_QOS,
    Entry,
    answered,
    every,
    message_class,
    topics_of,
)
from eha_monitor.settings import Settings

# Samples go out in bursts of this spacing: fewer wake-ups, and little against 20 ms of latency.
BURST = 0.002
BLOCK = 100  # the plant is simulated in blocks, as one call costs as much as a hundred samples
# Where commands are followed, a block must not begin before they have come.
FOLLOWING_BLOCK = 10
KEPT_COMMANDS = 4000
SLOW_PERIOD = 0.1  # temperature is a slow sensor


@dataclass
class _Stream:
    """One message of one topic, reused: where the values of each channel go."""

    publisher: Publisher
    message: Any
    places: list[tuple[str, Any, int | str, float, float]]
    delay_ns: int
    every: int
    stamped: bool

    def publish(self, stamp_ns: int, k: int, block: dict[str, list[float]]) -> None:
        """Publish sample ``k`` of a block."""
        if self.stamped:
            now = self.message.header.stamp
            now.sec, now.nanosec = divmod(stamp_ns + self.delay_ns, 1_000_000_000)
        for channel, holder, place, scale, offset in self.places:
            raw = (block[channel][k] - offset) / scale
            if isinstance(place, int):
                holder[place] = raw
            else:
                setattr(holder, place, raw)
        self.publisher.publish(self.message)


class SimulatorNode:
    """Publishes samples in real time, each with its exact stamp; seed None is the config's."""

    def __init__(self, node: Node, settings: Settings, seed: int | None = None,
                 source: str = "config"):
        self.samples = self.messages = 0
        follows = settings.simulation.demand == "topic"
        self._commands = _Commands(node, settings, source) if follows else None
        self._simulator = Simulator(settings, seed, source, self._commands.at if follows else None)
        published = set(settings.simulation.publish) - ({"x_d"} if follows else set())
        self._streams = _streams(node, settings, source, published)
        self._step_ns = settings.rig.sample_time * 1e9
        self._ahead = FOLLOWING_BLOCK if follows else BLOCK
        self._block: dict[str, list[float]] = {}
        self._begin = self._end = 0  # samples that the block holds
        self._advance()  # before the clock starts: the first call compiles or loads the plant
        self._start_ns = node.get_clock().now().nanoseconds
        self._start = time.monotonic()
        if self._commands is not None:
            self._commands.start_ns = self._start_ns
        every(node, BURST, self._burst)
        node.create_service(Trigger, "simulator/excite", self._on_excite)

    def _advance(self) -> None:
        if self._commands is not None:
            self._commands.take()
        shown = self._simulator.advance(self._ahead)
        self._block = {name: values.tolist() for name, values in shown.items()}
        self._begin, self._end = self._end, self._end + self._ahead

    def _burst(self) -> None:
        """Publish every sample whose time has come: timers skip ticks, samples do not."""
        due = int((time.monotonic() - self._start) * 1e9 / self._step_ns) + 1
        while self.samples < due:
            if self.samples >= self._end:
                self._advance()
            stamp_ns = self._start_ns + round(self.samples * self._step_ns)
            for stream in self._streams:
                if self.samples % stream.every == 0:
                    stream.publish(stamp_ns, self.samples - self._begin, self._block)
                    self.messages += 1
            self.samples += 1

    def _on_excite(self, request, response):
        """Begin the test excitation with the next block, at most 0.1 s ahead."""
        if self._commands is not None:
            return answered(response, False, "commands of others are followed (simulation.demand: "
                            "topic), expected a simulator with its own motion")
        stretches = ", ".join(self._simulator.settings.simulation.test_excitation)
        left = self._simulator.test_left
        if left > 0.0:
            return answered(response, False, f"a test excitation ({stretches}) is running, "
                            f"expected none: it ends in {left:.1f} s")
        self._simulator.excite()
        return answered(response, True, f"test excitation ({stretches}) for "
                        f"{self._simulator.test_left:g} s from t = {self._simulator.time:g} s on")

    def summary(self) -> str:
        """Return what was published, in one line."""
        return f"published {self.samples} samples in {self.messages} messages"


class _Commands:
    """What others demand, by stamp: each holds until the next one, straight lines between.

    A command with an earlier stamp than one that came before takes the place of all later ones.
    """

    def __init__(self, node: Node, settings: Settings, source: str):
        topic = next((one for one in topics_of(settings, source, node.resolve_topic_name)
                      if any(channel == "x_d" for entry in one.entries
                             for channel, _ in entry.channels)), None)
        if topic is None:
            raise InputError(f"{source}: channels.x_d: expected the topic that is followed")
        self._input = TopicInput(node, topic, OUTPUT_QOS)
        self.start_ns = 0
        start = demanded_position(settings.simulation.excitation, np.zeros(1))
        self._stamps, self._values = np.zeros(1, dtype=np.int64), start

    def take(self) -> None:
        """Take the commands that came."""
        while True:
            messages, _, _ = self._input.take()
            none = np.zeros(len(messages), dtype=np.int64)
            for batch in self._input.reader.read(messages, none, none) if messages else ():
                column = batch.source.channels.index("x_d")
                for at, value in zip(batch.stamps, batch.values[:, column], strict=True):
                    kept = np.searchsorted(self._stamps, at)
                    self._stamps = np.append(self._stamps[:kept], at)[-KEPT_COMMANDS:]
                    self._values = np.append(self._values[:kept], value)[-KEPT_COMMANDS:]
            if not self._input.waits:
                return

    def at(self, time_s: np.ndarray) -> np.ndarray:
        """Return x_d at times since the start, m."""
        return np.interp(time_s, (self._stamps - self.start_ns) * 1e-9, self._values)


def _streams(node: Node, settings: Settings, source: str, published: set[str]) -> list[_Stream]:
    if unmapped := sorted(published - set(settings.channels)):
        raise InputError(f"{source}: simulation.publish: {unmapped[0]} has no entry in channels")
    frame = settings.frame_id
    slow = max(1, round(SLOW_PERIOD / settings.rig.sample_time))
    streams = []
    for topic in topics_of(settings, source):
        if topic.default_type is None:
            raise InputError(f"{source}: channels on {topic.full_name}: the simulator publishes "
                             "the fields position, velocity, effort, fluid_pressure, temperature, "
                             "data; one kind to a topic")
        kind = message_class(topic.default_type)
        publisher = None
        for delay_ns in sorted({entry.delay_ns for entry in topic.entries}):
            entries = [entry for entry in topic.entries if entry.delay_ns == delay_ns
                       and published & {channel for channel, _ in entry.channels}]
            if not entries:
                continue
            publisher = publisher or node.create_publisher(kind, topic.name, OUTPUT_QOS)
            for alike in _alike(entries, published) if hasattr(kind(), "name") else [entries]:
                message = kind()
                stamped = hasattr(message, "header")
                if stamped:
                    message.header.frame_id = frame
                every = slow if all(HELD & {c for c, _ in e.channels} for e in alike) else 1
                streams.append(_Stream(publisher, message, _places(message, alike, published),
                                       delay_ns, every, stamped))
    return streams


def _alike(entries: list[Entry], published: set[str]) -> list[list[Entry]]:
    """Return joints in groups of which the same fields are measured, one group to a message.

    All arrays of a JointState are of one length or empty, so that a joint of which less is
    measured than of another would have to be filled with what was not measured.
    """
    groups: dict[frozenset[str], list[Entry]] = {}
    for entry in entries:
        fields = frozenset(c.field for channel, c in entry.channels if channel in published)
        groups.setdefault(fields, []).append(entry)
    return list(groups.values())


def _places(message: Any, entries: list[Entry], published: set[str]) -> list[tuple]:
    """Give the message its names and return where each published channel goes."""
    places = []
    named = hasattr(message, "name")
    if named:
        message.name = [entry.name for entry in entries]
    for row, entry in enumerate(entries):
        for channel, declared in entry.channels:
            if channel not in published:
                continue
            holder, place = message, declared.field
            if named:
                if not len(getattr(message, declared.field)):
                    setattr(message, declared.field, [0.0] * len(entries))
                holder, place = getattr(message, declared.field), row
            places.append((channel, holder, place, declared.gain, declared.zero))
    return places


def run_simulator(config: Path | None, ros_args: list[str], duration: float | None = None,
                  seed: int | None = None) -> int:
    """Publish the simulated actuator until a signal or for ``duration`` s.

    Raises InputError if the config, a parameter or a ROS argument is wrong.
    """
    settings, source = running.configured(config, ros_args, "simulator")
    with (running.ros_session(ros_args),
          running.node("simulator", settings.monitor.namespace) as node):
        settings = settings_of_node(node, settings)
        declare(node, settings, SIMULATOR_KEYS)
        simulator = SimulatorNode(node, settings, seed, source)
        gc.collect()
        gc.freeze()  # a collection of everything loaded would hold up the samples
        running.spin(node, duration)
        print(simulator.summary(), flush=True)
    return 0
