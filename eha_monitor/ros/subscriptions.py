"""Subscriptions of the channel map: messages in, stamped samples of the sources out.

No callback runs: the messages are drained from the middleware's history, some tens of times a
second, which costs a tenth of an executor's way to a callback for each.
"""

import time
from collections.abc import Sequence

import numpy as np
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.type_support import check_is_valid_msg_type

from eha_monitor.errors import InputError
from eha_monitor.live.rows import Batch
from eha_monitor.ros.inputs import Decoder, Entry, Topic, has_stamp, message_class
from eha_monitor.ros.parts import Part, Parts
from eha_monitor.ros.quality import clashes
from eha_monitor.ros.raw import RawReader

# Best effort takes from every publisher; the depth holds ten seconds of a process that stands.
INPUT_QOS = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.BEST_EFFORT)
AT_ONCE = 500  # messages of a topic that are taken before those of the next

# Neither stage needs these; that a rig does not have them is no fault.
OPTIONAL = frozenset({"temperature", "v", "omega", "force"})


class TopicInput:
    """One topic: its subscription, its decoders, what is wrong with it.

    Parameters
    ----------
    node : node to subscribe with.
    topic : topic and the streams it carries.
    qos : of the subscription.

    Attributes
    ----------
    key : of the topic in the diagnostics: its name in the config, or that of a remap.
    messages : how many came.
    type : of the messages, such as ``sensor_msgs/msg/JointState``; None before it is known.
    waits : whether more were waiting than could be taken the last time.
    """

    def __init__(self, node: Node, topic: Topic, qos: QoSProfile = INPUT_QOS):
        self.topic = topic
        own = f"{node.get_namespace().rstrip('/')}/{topic.name}"
        self.key = (topic.name if topic.full_name in (own, topic.name) else
                    topic.full_name).strip("/").replace("/", "_")
        self.messages = 0
        self.type: str | None = None
        self.waits = False
        self._node, self._qos = node, qos
        self._decoders = [Decoder(entry) for entry in topic.entries]
        self._subscription = None
        self._type_problem: str | None = None
        self._zero_stamps = 0
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
            kind = message_class(wanted)
        except InputError as problem:
            self._type_problem = f"{self.topic.full_name}: {problem}"
            return
        self.close()
        check_is_valid_msg_type(kind)
        # Beside the node's own: an executor would wake up for each message, and take it.
        with self._node.handle:
            self._subscription = rclpy_implementation.Subscription(
                self._node.handle, kind, self.topic.name, self._qos.get_c_qos_profile())
        self.type, self._type_problem = wanted, None
        self._kind, self._stamped = kind, has_stamp(kind)
        self._read = RawReader(self.topic, wanted)
        self._parts = Parts(self.topic, wanted, kind)

    def take(self) -> tuple[list[bytes], list[int], int]:
        """Take what waits.

        Returns
        -------
        messages, received_ns, sent_ns
            Messages as they came, when each was received, and when the first was sent.
        """
        messages, received, sent_ns = [], [], 0
        subscription = self._subscription
        if subscription is not None:
            kind = self._kind
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

    def read(self, messages: Sequence[bytes], came: np.ndarray, now_ns: np.ndarray
             ) -> list[Batch]:
        """Return the samples of each stream in some messages, of which there is one at least.

        Parameters
        ----------
        came, now_ns : (n,) when each was received: s, monotonic, and ns on the node's clock.
        """
        found = None if self._parts.several else self._read.read_all(messages)
        if found is not None and (not self._stamped or found[0].all()):
            for decoder in self._decoders:
                decoder.problem = None
            stamps = found[0] if self._stamped else now_ns
            return [Batch(entry.source, stamps - entry.delay_ns, values, came)
                    for entry, values in zip(self.topic.entries, found[1], strict=True)]
        parts = self._parts.read_all(messages) if self._stamped else None
        if parts is None:
            return self._read_singly(messages, came, now_ns)
        self._note_parts(parts)
        return [Batch(entry.source, part.stamps - entry.delay_ns, part.values, came[part.places])
                for entry, part in zip(self.topic.entries, parts, strict=True)]

    def _note_parts(self, parts: list[Part]) -> None:
        """Note which entries came, and what was there in place of those that did not."""
        for decoder, part in zip(self._decoders, parts, strict=True):
            decoder.problem = None
            decoder.absent = decoder.lacks(part.others) if part.others else None

    def _read_singly(self, messages: Sequence[bytes], came: np.ndarray, now_ns: np.ndarray
                     ) -> list[Batch]:
        """Read messages of which some differ from the others, or lack a number."""
        times, taken = [], []
        streams: list[list[tuple[int, tuple[float, ...] | None, bool | None]]] = [
            [] for _ in self._decoders]
        apart = self._parts.several
        for k, data in enumerate(messages):
            found = None if apart else self._read(data)
            if found is not None:
                time_ns, values_of = found
                for decoder in self._decoders:
                    decoder.problem = None
            else:
                message = deserialize_message(data, self._kind)
                values_of = [decoder(message) for decoder in self._decoders]
                stamp = message.header.stamp if self._stamped else None
                time_ns = stamp.sec * 1_000_000_000 + stamp.nanosec if self._stamped else 0
            if self._stamped and time_ns == 0:
                # One zero may be the start of simulated time, two are no stamps at all.
                self._zero_stamps += 1
                if self._zero_stamps == 1:
                    continue
            for stream, decoder, values in zip(streams, self._decoders, values_of, strict=True):
                if apart and not decoder.found:  # another message brings it
                    decoder.problem = None
                    continue
                stream.append((len(times), values, None if values is not None else decoder.found))
            times.append(time_ns or int(now_ns[k]))
            taken.append(k)
        stamps, came = np.array(times, dtype=np.int64), came[taken]
        return [_batch(entry, stream, stamps, came)
                for entry, stream in zip(self.topic.entries, streams, strict=True)]

    def close(self) -> None:
        """End the subscription."""
        if self._subscription is not None:
            self._subscription.destroy_when_not_in_use()
            self._subscription = None

    def problems(self, now: float, silent_after: float) -> list[str]:
        """Return what is wrong with the topic at ``now`` (s, monotonic), in sentences."""
        found = [self._type_problem] if self._type_problem else []
        for decoder, entry in zip(self._decoders, self.topic.entries, strict=True):
            silent = now - entry.source.heard_s > silent_after and not self.waits
            channels = ", ".join(channel for channel, _ in entry.channels)
            if decoder.problem is not None or (silent and decoder.absent is not None):
                found.append(decoder.problem or decoder.absent)
            elif silent and not self.messages:
                if not OPTIONAL.issuperset(entry.source.channels):
                    found.append(f"{entry.source.name}: nothing received, so no {channels}")
            elif silent and not entry.source.held:
                found.append(f"{entry.source.name}: nothing new for {silent_after:g} s, "
                             f"so no {channels}")
        if self._zero_stamps > 1:
            found.append(f"{self.topic.full_name}: stamps are zero, the time of receipt is taken")
        return found

    def clashes(self) -> list[str]:
        """Return in sentences which publishers offer what this subscription cannot take."""
        return clashes(self._node, self.topic.name)

    def rate(self, now: float) -> float:
        """Return the messages per second since the last call; ``now`` in s, monotonic."""
        (count, since), self._counted = self._counted, (self.messages, now)
        return (self.messages - count) / max(now - since, 1e-9)


def _batch(entry: Entry, stream: list[tuple], stamps: np.ndarray, came: np.ndarray) -> Batch:
    """Return what messages brought of an entry: place, values or None, whether a number lacks."""
    places, values_of, lacking = zip(*stream, strict=True) if stream else ((), (), ())
    nothing = (np.nan,) * len(entry.channels)
    chosen = np.array(places, dtype=int)
    return Batch(entry.source, stamps[chosen] - entry.delay_ns, np.array(
        [nothing if values is None else values for values in values_of],
        dtype=float).reshape(-1, len(nothing)), came[chosen],
        None if all(lacks is None for lacks in lacking) else lacking)
