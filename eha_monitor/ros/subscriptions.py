"""Subscriptions of the channel map: messages in, samples out, and whether the monitor keeps up.

No callback runs: the messages are drained from the middleware's history, some tens of times a
second, which costs a tenth of an executor's way to a callback for each.
"""

import time
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.type_support import check_is_valid_msg_type

from eha_monitor.errors import InputError
from eha_monitor.health.overload import LoadWatch
from eha_monitor.live.faults import MIXED
from eha_monitor.live.rows import RowAligner
from eha_monitor.recordings.align import Dating
from eha_monitor.ros.decoding import Stream, TopicReader
from eha_monitor.ros.keeper import Keeper
from eha_monitor.ros.topics import INPUT_QOS, Topic, crowd

AT_ONCE = 500  # messages of a topic that are taken before those of the next

LONGEST_S = 60.0  # that a message can have waited; more is a step of the wall clock
LOOK_S = 0.15  # between two looks, at least
EARLY = 0.25  # of a period: a timer's jitter must not put what is due off to the next

# Neither stage needs these; that a rig does not have them is no fault.
OPTIONAL = frozenset({"temperature", "v", "omega", "force"})
DEMANDED = frozenset({"x_d", "omega_d"})  # the same, where the pump's speed comes


class TopicInput:
    """One topic: its subscription, its streams, what is wrong with it."""

    def __init__(self, node: Node, topic: Topic, qos: QoSProfile = INPUT_QOS):
        self.topic = topic
        # that it brings
        self.channels = frozenset(name for entry in topic.entries
                                  for name in entry.source.channels)
        # whether the position is one of them, which stamps the rows
        self.leads = "x" in self.channels
        own = f"{node.get_namespace().rstrip('/')}/{topic.name}"
        # of the topic in the diagnostics: its name in the config, or that of a remap
        self.key = (topic.name if topic.full_name in (own, topic.name) else
                    topic.full_name).strip("/").replace("/", "_")
        self.messages = 0  # how many came
        # of the messages, such as ``sensor_msgs/msg/JointState``; None before it is known
        self.type: str | None = None
        self.waits = False  # whether more were waiting than could be taken the last time
        self.reader: TopicReader | None = None  # of messages of that type
        self._node, self._qos = node, qos
        self._streams = [Stream(entry) for entry in topic.entries]
        self._subscription = None
        self._type_problem: str | None = None
        self._counted = (0, time.monotonic())
        self.follow_graph()

    def follow_graph(self) -> None:
        """Subscribe with the type that is published, or the usual one while nobody does."""
        full_name = self._node.resolve_topic_name(self.topic.name)
        published = {info.topic_type for info in
                     self._node.get_publishers_info_by_topic(full_name)}
        if self.type in published:
            self._type_problem = None
            return
        wanted = min(published) if published else self.type or self.topic.default_type
        if wanted is None or wanted == self.type:
            return
        try:
            reader = TopicReader(self.topic, wanted, self._streams)
        except InputError as problem:
            self._type_problem = f"{self.topic.full_name}: {problem}"
            return
        self.close()
        check_is_valid_msg_type(reader.kind)
        # Beside the node's own: an executor would wake up for each message, and take it.
        with self._node.handle:
            self._subscription = rclpy_implementation.Subscription(
                self._node.handle, reader.kind, self.topic.name, self._qos.get_c_qos_profile())
        self.type, self.reader, self._type_problem = wanted, reader, None

    def take(self) -> tuple[list[bytes], list[int], int]:
        """Take what waits: messages, when each was received, and when the first was sent, ns."""
        messages, received, sent_ns = [], [], 0
        subscription = self._subscription
        if subscription is not None:
            kind = self.reader.kind
            with subscription:
                take = subscription.take_message
                for _ in range(AT_ONCE):
                    found = take(kind, True)
                    if found is None:
                        break
                    data, told = found
                    messages.append(data)
                    received.append(told["received_timestamp"])
                    sent_ns = sent_ns or told["source_timestamp"]
        self.waits = len(messages) == AT_ONCE
        self.messages += len(messages)
        return messages, received, sent_ns

    def close(self) -> None:
        """End the subscription."""
        if self._subscription is not None:
            self._subscription.destroy_when_not_in_use()
            self._subscription = None

    def problems(self, now: float, silent_after: float,
                 optional: frozenset[str] = OPTIONAL) -> list[str]:
        """Return what is wrong with the topic at ``now`` (s, monotonic), in sentences."""
        found = [self._type_problem] if self._type_problem else []
        for stream, entry in zip(self._streams, self.topic.entries, strict=True):
            silent = now - entry.source.heard_s > silent_after and not self.waits
            channels = ", ".join(channel for channel, _ in entry.channels)
            if not stream.seen and self.messages and (
                    DEMANDED & optional).issuperset(entry.source.channels):
                continue  # a demand that this rig does not have, of a topic that carries others
            if stream.problem is not None or (silent and stream.absent is not None):
                found.append(stream.problem or stream.absent)
            elif silent and not self.messages:
                if not optional.issuperset(entry.source.channels):
                    found.append(f"{entry.source.name}: nothing received, so no {channels}")
            elif silent and not entry.source.held:
                found.append(f"{entry.source.name}: nothing new for {silent_after:g} s, "
                             f"so no {channels}")
        if self.reader is not None and self.reader.zero_stamps > 1:
            found.append(f"{self.topic.full_name}: stamps are zero, the time of receipt is taken")
        return found

    def crowd(self, problems: Sequence[str]) -> str:
        """Return who publishes on the topic where its stamps are mixed, as ``problems`` say."""
        mixed = any(each.startswith(self.topic.full_name) and each.endswith(MIXED)
                    for each in problems)
        return crowd(self._node, self.topic.name) if mixed else ""

    def rate(self, now: float) -> float:
        """Return the messages per second since the last call; ``now`` in s, monotonic."""
        (count, since), self._counted = self._counted, (self.messages, now)
        return (self.messages - count) / max(now - since, 1e-9)


class Drain:
    """Takes what waits on the topics: messages to the rows, and to what is kept of them.

    ``node`` : its clock stamps messages that carry no stamp.
    """

    def __init__(self, node: Node, inputs: list[TopicInput], aligner: RowAligner, keeper: Keeper):
        self._node, self._aligner, self._keeper = node, aligner, keeper
        self._inputs = sorted(inputs, key=lambda one: not one.leads)
        self._stream = cache(keeper.stream)
        self._dating = Dating()  # by the position, which is taken first
        self._transport = np.inf  # the least from sending to reception, on two clocks, s
        # age of the oldest message when it was worked on, s, the worst since :meth:`look`
        self.oldest = 0.0

    def take(self) -> bool:
        """Take what waits, or much of it; return whether more may wait."""
        batches, kept = [], []
        for each in self._inputs:
            messages, received, sent_ns = each.take()
            if not messages:
                continue
            # After the taking: none is younger, so no two get one time of receipt.
            wall_ns, now = time.time_ns(), time.monotonic()
            clock_ns = self._node.get_clock().now().nanoseconds
            # Where the middleware does not say when: now.
            waited = np.zeros(len(received)) if not received[0] else np.minimum(np.maximum(
                (wall_ns - np.array(received)) * 1e-9, 0.0), LONGEST_S)
            came_ns = clock_ns - np.rint(waited * 1e9).astype(np.int64)
            batches += each.reader.read(messages, now - waited, came_ns if each.reader.stamped
                                 else self._dating.dated(each.topic.name, came_ns))
            if each.leads and each.reader.stamped:
                self._dating.learn(came_ns, each.reader.stamps)
            transport = (received[0] - sent_ns) * 1e-9
            self._transport = min(self._transport, transport)
            self.oldest = max(self.oldest, float(waited[0]) + transport - self._transport)
            if self._keeper.ring is not None:
                kept.append((self._stream(each.topic.name, each.type), received, messages))
        if batches:
            self._aligner.take(batches)
        if kept:
            self._keeper.ring.extend(kept)
        return any(each.waits for each in self._inputs)

    def worked_on(self, came: float) -> None:
        """Note that what came at ``came`` (s, monotonic) has its turn only now."""
        self.oldest = max(self.oldest, min(time.monotonic() - came, LONGEST_S))

    def look(self) -> float:
        """Return the age of the oldest message since the last call, s; 0 where none came."""
        oldest, self.oldest = self.oldest, 0.0
        return oldest


class Load:
    """What is due again and again (period in s, job), and how far the monitor is behind."""

    def __init__(self, jobs: Sequence[tuple[float, Callable[[], None]]], stale_after: float):
        now = time.monotonic()
        self.watch = LoadWatch(stale_after)
        self.period = min((period for period, _ in jobs), default=LOOK_S)
        self._jobs = [[period, now + period, job] for period, job in jobs]
        self._ran = self._looked = now
        self._away = self._waited = 0.0

    def run(self, now: float) -> float:
        """Note that the monitor runs at ``now`` (s, monotonic); return for how long not, s."""
        away, self._ran = now - self._ran, now
        self._away = max(self._away, away)
        return away

    def tick(self, now: float) -> None:
        """Do what is due at ``now`` (s, monotonic)."""
        for job in self._jobs:
            if now >= job[1] - EARLY * self.period:
                job[1] = max(job[1] + job[0], now)
                job[2]()

    def look(self, waited: float, rows: int, missing: int) -> None:
        """See whether the monitor keeps up, some times a second.

        Parameters
        ----------
        waited : longest that a message waited since the last look, s; a period is as it should be.
        rows, missing : samples so far, and those that lack between them.
        """
        now = time.monotonic()
        self._waited = max(self._waited, waited - self.period)
        if now - self._looked < LOOK_S:
            return
        self.watch.look(now, rows, missing, self._waited, self._away)
        self._looked, self._away, self._waited = now, 0.0, 0.0
