"""All topics of a monitor drained at a time: messages to the rows, and to what is kept of them."""

import time

import numpy as np
from rclpy.node import Node

from eha_monitor.live.rows import RowAligner
from eha_monitor.ros.keeper import Keeper
from eha_monitor.ros.subscriptions import TopicInput

LONGEST_S = 60.0  # that a message can have waited; more is a step of the wall clock


class Drain:
    """Takes what waits on the topics.

    Parameters
    ----------
    node : its clock stamps messages that carry no stamp.
    inputs : the topics.
    aligner : takes the samples.
    keeper : keeps the messages as they came.

    Attributes
    ----------
    oldest : age of the oldest message when it was worked on, s, the worst since :meth:`look`.
    """

    def __init__(self, node: Node, inputs: list[TopicInput], aligner: RowAligner,
                 keeper: Keeper):
        self._node, self._inputs, self._aligner, self._keeper = node, inputs, aligner, keeper
        self._streams: dict[tuple[str, str], int] = {}
        self._transport = np.inf  # the least from sending to reception, on two clocks, s
        self.oldest = 0.0

    def take(self) -> bool:
        """Take what waits, or much of it; tell whether more may wait."""
        batches, kept = [], []
        wall_ns, now = time.time_ns(), time.monotonic()
        clock_ns = self._node.get_clock().now().nanoseconds
        for each in self._inputs:
            messages, received, sent_ns = each.take()
            if not messages:
                continue
            # A middleware that does not tell when: now.
            waited = np.zeros(len(received)) if not received[0] else np.minimum(np.maximum(
                (wall_ns - np.array(received)) * 1e-9, 0.0), LONGEST_S)
            batches += each.read(messages, now - waited,
                                 clock_ns - np.rint(waited * 1e9).astype(np.int64))
            transport = (received[0] - sent_ns) * 1e-9
            self._transport = min(self._transport, transport)
            self.oldest = max(self.oldest, float(waited[0]) + transport - self._transport)
            if self._keeper.ring is not None:
                kept += zip(received, (self._stream(each),) * len(messages), messages,
                            strict=True)
        if batches:
            self._aligner.take(batches)
        if kept:
            kept.sort()
            self._keeper.ring.extend(kept)
        return any(each.waits for each in self._inputs)

    def worked_on(self, came: float) -> None:
        """Note that what came at ``came`` (s, monotonic) has its turn only now."""
        self.oldest = max(self.oldest, min(time.monotonic() - came, LONGEST_S))

    def look(self) -> float:
        """Return the age of the oldest message since the last call, s; 0 where none came."""
        oldest, self.oldest = self.oldest, 0.0
        return oldest

    def _stream(self, each: TopicInput) -> int:
        key = each.topic.name, each.type
        if key not in self._streams:
            self._streams[key] = self._keeper.stream(*key)
        return self._streams[key]
