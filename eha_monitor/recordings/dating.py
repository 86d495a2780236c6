"""When messages without a stamp were sent: when they came, or when others say that came with them.

On a busy machine messages wait and are received together.  Their times of receipt then say little,
and the stamps of the position's messages that waited with them say more.  But a position that is
sent in blocks, by a node of its own, would put the messages of others in blocks as well.  So the
more even of the two is taken: over the same time its steps have the larger sum of roots (Jensen).
"""

import numpy as np

EVENER = 1.1  # times the sum of roots: surely the more even
KEPT = 1000  # messages of the position that are remembered
LEAST_NS, WAITS_NS = 1_000, 1_000_000_000  # between two messages; as long as one waits
FADES = 0.98  # of the sums, from one look at the topics to the next: some seconds


def beside(received: np.ndarray, of_received: np.ndarray, of_stamps: np.ndarray) -> np.ndarray:
    """Return the times of messages by the stamps of others that were received about then.

    Parameters
    ----------
    received : (n,) ns, when they were received.
    of_received, of_stamps : (m,) ns of the others, in order of receipt.
    """
    return received + np.rint(np.interp(received, of_received, of_stamps - of_received)).astype(
        np.int64)


def evenness(times: np.ndarray) -> float:
    """Return the sum of the roots of the steps between times: the larger, the more even."""
    return float(np.sum(np.sqrt(np.maximum(np.diff(times), 0.0))))


class _Topic:
    """A topic without stamps: how even its times are, by receipt and by others."""

    def __init__(self):
        self.even = np.zeros(2)
        self.last = (np.empty(0, dtype=np.int64),) * 2
        self.by_others = 0
        self.dated = 0


class Dating:
    """Dates the messages of topics without stamps as they come."""

    def __init__(self):
        self._received = self._stamps = np.empty(0, dtype=np.int64)
        self._topics: dict[str, _Topic] = {}

    def learn(self, received: np.ndarray, stamps: np.ndarray) -> None:
        """Take messages of the position: (n,) ns, when they were received, and their stamps."""
        self._received = np.concatenate((self._received, received))[-KEPT:]
        self._stamps = np.concatenate((self._stamps, stamps))[-KEPT:]

    def dated(self, topic: str, received: np.ndarray) -> np.ndarray:
        """Return the times of messages of a topic, (n,) ns."""
        if not len(self._received):
            return received
        one = self._topics.setdefault(topic, _Topic())
        both = received, beside(received, self._received, self._stamps)
        one.even = FADES * one.even + [evenness(np.concatenate((last, times)))
                                       for last, times in zip(one.last, both, strict=True)]
        one.last = tuple(times[-1:] for times in both)
        if abs(self._stamps[-1] - self._received[-1]) > WAITS_NS:
            one.by_others = 1  # they are of another clock: sim time, or a controller's
        elif one.even[1 - one.by_others] > EVENER * one.even[one.by_others]:
            one.by_others = 1 - one.by_others
        found = both[one.by_others]
        # From one to the other they must not go back: that is what a clock that was set does.
        least = one.dated + LEAST_NS * np.arange(1, 1 + len(found))
        found = np.where((found < least) & (least < found + WAITS_NS), least, found)
        one.dated = int(found[-1])
        return found
