"""Subscriptions of the channel map: messages in, stamped samples into the row aligner."""

import time
from collections.abc import Callable

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from eha_monitor.errors import InputError
from eha_monitor.filters.rows import RowAligner
from eha_monitor.ros.inputs import Decoder, Topic, has_stamp, message_class
from eha_monitor.ros.keeper import Keeper
from eha_monitor.ros.quality import clashes
from eha_monitor.ros.raw import RawReader

# Nothing but messages: rmw_fastrtps 8.4 waits for itself forever where an EventsExecutor takes the
# event of a lost message while the next one is lost (its pull request 890), as on a busy machine.
NO_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)

# Best effort takes from every publisher; the depth holds some seconds of a stalled process.
INPUT_QOS = QoSProfile(depth=4000, reliability=ReliabilityPolicy.BEST_EFFORT)


# Neither stage needs these; that a rig does not have them is no fault.
OPTIONAL = frozenset({"temperature", "v", "omega", "force"})


class TopicInput:
    """One topic: its subscription, its decoders, what is wrong with it.

    Parameters
    ----------
    node : node to subscribe with.
    topic : topic and the streams it carries.
    aligner : takes the samples.
    on_sample : called after each message with the time of receipt (s, monotonic).
    keeper : keeps the messages as they came; None keeps nothing.
    qos : of the subscription.
    """

    def __init__(self, node: Node, topic: Topic, aligner: RowAligner,
                 on_sample: Callable[[float], None], keeper: Keeper | None = None,
                 qos: QoSProfile = INPUT_QOS):
        self.topic = topic
        self._keeper = keeper
        self.messages = 0
        self._node, self._aligner, self._on_sample, self._qos = node, aligner, on_sample, qos
        self._decoders = [Decoder(entry) for entry in topic.entries]
        self._type: str | None = None
        self._subscription: Subscription | None = None
        self._take: Callable | None = None
        self.waits = False  # whether a message was waiting at the last look
        self._type_problem: str | None = None
        self._zero_stamps = 0
        self._counted = (0, time.monotonic())
        self.follow_graph()

    def follow_graph(self) -> None:
        """Subscribe with the type that is published, or the usual one while nobody does."""
        full_name = self._node.resolve_topic_name(self.topic.name)
        published = {info.topic_type for info in
                     self._node.get_publishers_info_by_topic(full_name)}
        if self._type in published:
            self._type_problem = None
            return
        wanted = min(published) if published else self._type or self.topic.default_type
        if wanted is None or wanted == self._type:
            return
        try:
            kind = message_class(wanted)
        except InputError as problem:
            self._type_problem = f"{self.topic.name}: {problem}"
            return
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._type, self._type_problem = wanted, None
        on_message = self._callback(kind, wanted)
        self._subscription = subscription = self._node.create_subscription(
            kind, self.topic.name, on_message, self._qos, raw=True, event_callbacks=NO_EVENTS)

        def take():
            with subscription.handle:
                found = subscription.handle.take_message(kind, True)
            if found is None:
                return None
            on_message(found[0])
            return found[1]["source_timestamp"], found[1]["received_timestamp"]
        self._take = take

    def take_waiting(self) -> tuple[int, int] | None:
        """Take the oldest message that waits; return when it was sent and received, ns.

        The executor, which comes to it later, finds the next one, or none.  None where none
        waits.
        """
        found = self._take() if self._take is not None else None
        self.waits = found is not None
        return found

    def close(self) -> None:
        """End the subscription."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = self._take = None

    def problems(self, now: float, silent_after: float) -> list[str]:
        """Return what is wrong with the topic at ``now`` (s, monotonic), in sentences."""
        found = [self._type_problem] if self._type_problem else []
        for decoder, entry in zip(self._decoders, self.topic.entries, strict=True):
            silent = now - entry.source.heard_s > silent_after and not self.waits
            channels = ", ".join(channel for channel, _ in entry.channels)
            if decoder.problem is not None:
                found.append(decoder.problem)
            elif silent and not self.messages:
                if not OPTIONAL.issuperset(entry.source.channels):
                    found.append(f"{entry.source.name}: nothing received, so no {channels}")
            elif silent and not entry.source.held:
                found.append(f"{entry.source.name}: nothing new for {silent_after:g} s, "
                             f"so no {channels}")
        if self._zero_stamps > 1:
            found.append(f"{self.topic.name}: stamps are zero, the time of receipt is taken")
        return found

    def clashes(self) -> list[str]:
        """Return in sentences which publishers offer what this subscription cannot take."""
        return clashes(self._node, self.topic.name)

    def rate(self, now: float) -> float:
        """Return the messages per second since the last call; ``now`` in s, monotonic."""
        (count, since), self._counted = self._counted, (self.messages, now)
        return (self.messages - count) / max(now - since, 1e-9)

    def _callback(self, kind: type, type_name: str) -> Callable:
        streams = [(entry.source, entry.delay_ns) for entry in self.topic.entries]
        push, done, monotonic = self._aligner.push, self._on_sample, time.monotonic
        unread = self._aligner.unread
        read, stamped = RawReader(self.topic, type_name), has_stamp(kind)
        ring = self._keeper.ring if self._keeper is not None else None
        stream = self._keeper.stream(self.topic.name, type_name) if ring is not None else 0
        now_ns = time.time_ns

        def on_message(data):
            now = monotonic()
            self.messages += 1
            if ring is not None:
                ring.append(stream, now_ns(), data)
            found = read(data)
            if found is not None:
                time_ns, values_of = found
                for decoder in self._decoders:
                    decoder.problem = None
            else:
                message = deserialize_message(data, kind)
                values_of = [decoder(message) for decoder in self._decoders]
                stamp = message.header.stamp if stamped else None
                time_ns = stamp.sec * 1_000_000_000 + stamp.nanosec if stamped else 0
            if stamped and time_ns == 0:
                # One zero may be the start of simulated time, two are no stamps at all.
                self._zero_stamps += 1
                if self._zero_stamps == 1:
                    return
            if time_ns == 0:
                time_ns = self._now_ns()
            for place, ((source, delay_ns), values) in enumerate(
                    zip(streams, values_of, strict=True)):
                if values is not None:
                    push(source, time_ns - delay_ns, values, now)
                else:
                    unread(source, self._decoders[place].found)
            done(now)
        return on_message

    def _now_ns(self) -> int:
        return self._node.get_clock().now().nanoseconds
