"""The replay node: a bag on its topics with its own timing."""

import contextlib
import os
import select
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from eha_monitor.errors import InputError, one_line
from eha_monitor.recordings.bag import Bag, Topic, iter_raw, topics
from eha_monitor.ros import messages, running
from eha_monitor.ros.topics import OUTPUT_QOS, answered, check_topic, message_class, profile

# A message due within this time goes out now: waiting is not finer than that.
SLACK = 0.0005
CLOCK_PERIOD = 0.005
# How long to wait for a further subscriber before the first message: participants announce
# themselves every 3 s, should their first words be lost.
DISCOVERY = 3.5
# A publisher sees its match before the subscriber does; what is sent in between is lost.
SETTLE = 0.3
# Topics on which many nodes publish side by side.
SHARED = ("/diagnostics", "/rosout", "/parameter_events", "/tf", "/tf_static")


class Replay:
    """Publishes the messages of a bag; pause by service or by the space key."""

    def __init__(self, node: Node, bag: Path, rate: float = 1.0, clock: bool = True,
                 paused: bool = False):
        if not rate > 0:
            raise InputError(f"rate: expected more than 0, got {rate:g}")
        self.node, self.bag, self.rate, self.paused = node, bag, rate, paused
        self.published = 0
        found = topics(bag)
        if not found:
            raise InputError(f"{bag}: expected a bag with messages, it holds none")
        self._executor = EventsExecutor()
        self._executor.add_node(node)
        self._clock = node.create_publisher(Clock, "/clock", 10) if clock else None
        self._clock_due = 0.0
        self._publishers = self._make_publishers(found)
        node.create_service(SetBool, "~/pause", self._on_pause)
        self._wait_for_subscribers()

    def play(self, keys: "Keyboard", progress: Progress) -> None:
        """Publish the bag once; returns early when ROS shuts down."""
        base_ns = base = None
        for topic, _, log_ns, raw in iter_raw(self.bag):
            publisher = self._publishers.get(topic)
            if publisher is None:
                continue
            if base is None:
                base_ns, base = log_ns, time.monotonic()
            while True:
                now = time.monotonic()
                if self.paused:
                    self._executor.spin_once(timeout_sec=0.05)
                    self._poll(keys)
                    base += time.monotonic() - now  # the pause is no time of the bag
                    if not running.ok():
                        return
                    continue
                due = base + (log_ns - base_ns) * 1e-9 / self.rate
                if due - now <= SLACK:
                    break
                self._tick(now, base_ns + round((now - base) * self.rate * 1e9))
                progress.update(0, completed=(log_ns - base_ns) * 1e-9)
                self._executor.spin_once(timeout_sec=min(due - now, CLOCK_PERIOD))
                self._poll(keys)
                if not running.ok():
                    return
            self._tick(now, log_ns)
            publisher.publish(raw)
            self.published += 1

    def close(self) -> None:
        """End the executor."""
        self._executor.remove_node(self.node)
        self._executor.shutdown()

    def _make_publishers(self, found: dict[str, Topic]) -> dict[str, Publisher]:
        made = {}
        for name, topic in found.items():
            if name == "/clock" and self._clock is not None:
                continue
            try:
                check_topic(name)
                kind = message_class(topic.msgtype)
            except InputError as problem:
                self._warn(f"{self.bag}: {name} is left out: {problem}")
                continue
            made[name] = self.node.create_publisher(
                kind, name, profile(max(1, min(topic.count, 10)), latched=True)
                if _latched(topic.qos) else OUTPUT_QOS)
        if not made:
            raise InputError(f"{self.bag}: expected a topic with a name and a message type that "
                             "this ROS knows, found none")
        return made

    def _wait_for_subscribers(self) -> None:
        """Give discovery its time, then leave out what another node publishes."""
        matched, took, began = 0, 0.0, time.monotonic()
        end = began + DISCOVERY
        while running.ok() and (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=min(left, 0.05))
            now = sum(p.get_subscription_count() > 0 for p in self._publishers.values())
            if now > matched:  # discovery is under way: give the others their time too
                matched, took = now, time.monotonic() - began
                end = began + took + DISCOVERY
            if now == len(self._publishers):
                break
        # Where a match took long, the machine is busy and the subscriber's takes long as well.
        end = time.monotonic() + min(max(SETTLE, took), DISCOVERY)
        while running.ok() and (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)
        for name in list(self._publishers):
            if name not in SHARED and running.ok() and self.node.count_publishers(name) > 1:
                self._warn(f"{name} is left out: another node publishes it")
                self.node.destroy_publisher(self._publishers.pop(name))

    def _tick(self, now: float, time_ns: int) -> None:
        if self._clock is not None and now >= self._clock_due:
            self._clock_due = now + 0.2 * CLOCK_PERIOD
            self._clock.publish(Clock(clock=messages.stamp(time_ns)))

    def _poll(self, keys: "Keyboard") -> None:
        if keys.pressed() == " ":
            self.paused = not self.paused

    def _on_pause(self, request, response):
        self.paused = bool(request.data)
        return answered(response, True, "paused" if self.paused else "playing")

    def _warn(self, text: str) -> None:
        print(one_line(text), file=sys.stderr, flush=True)


def _latched(qos: str) -> bool:
    """Tell from the recorded QoS whether a late subscriber got the last message."""
    try:
        return any(profile.durability.name == "TRANSIENT_LOCAL" for profile in parse_qos(qos))
    except (ReaderError, ValueError, KeyError, TypeError, AttributeError):
        return False


class Keyboard:
    """Single keys from the terminal, or none where there is no terminal to read from."""

    def __init__(self):
        self._descriptor: int | None = None

    def pressed(self) -> str:
        """Return the key that was pressed since the last call, or an empty string."""
        if self._descriptor is None or not select.select([self._descriptor], [], [], 0)[0]:
            return ""
        return os.read(self._descriptor, 1).decode(errors="replace")

    @contextlib.contextmanager
    def listen(self) -> Iterator["Keyboard"]:
        """Read keys unbuffered within a block, and leave the terminal as it was."""
        import termios
        import tty

        if not sys.stdin.isatty() or os.tcgetpgrp(sys.stdin.fileno()) != os.getpgrp():
            yield self  # in the background, touching the terminal would stop the process
            return
        self._descriptor = sys.stdin.fileno()
        before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        try:
            yield self
        finally:
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, before)
            self._descriptor = None


def bar_of(bag: Path) -> Progress:
    """Return a progress bar as long as a bag, s, with one task: on a terminal, else unseen."""
    seen = sys.stderr.isatty()
    times = [block.times for _, block in Bag(bag).blocks() if seen and len(block.times)]
    total = (max(t.max() for t in times) - min(t.min() for t in times)) * 1e-9 if times else None
    bar = Progress(
        TextColumn("{task.completed:.1f} s of {task.total:.1f} s"), BarColumn(),
        TimeElapsedColumn(), TextColumn("space: pause"), console=Console(stderr=True),
        disable=not seen)
    bar.add_task("replay", total=total)
    return bar


def run_replay(bag: Path, ros_args: list[str], rate: float = 1.0, clock: bool = True,
               loop: bool = False, start_paused: bool = False) -> int:
    """Publish a bag until its end (``loop``: until a signal); returns the exit status.

    Raises InputError if there is no bag, it holds nothing to publish, or a ROS argument is wrong.
    """
    with running.ros_session(ros_args), running.node("replay") as node:
        replay = Replay(node, Path(bag), rate, clock, start_paused)
        start = time.monotonic()
        try:
            with (running.until_shutdown(), Keyboard().listen() as keys, bar_of(Path(bag)) as bar):
                replay.play(keys, bar)
                while loop and running.ok():
                    replay.play(keys, bar)
        finally:
            replay.close()
        print(f"published {replay.published} messages in {time.monotonic() - start:.1f} s",
              flush=True)
    return 0
