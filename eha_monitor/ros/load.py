"""What waits for the monitor: how old the oldest message in the queues is, and who looks.

Under load an executor comes to no timer for seconds, since it takes messages first.  So what is
due is done between messages too (:meth:`Load.tick`).
"""

import math
import time
from collections.abc import Callable, Sequence

from eha_monitor.health.overload import LoadWatch, Overload
from eha_monitor.ros.subscriptions import TopicInput

LOOK_S = 0.2


class Load:
    """What is due, and how far the monitor is behind its inputs.

    Parameters
    ----------
    jobs : period in s and what to do, of each thing that is due again and again.
    stale_after : see :class:`LoadWatch`.
    """

    def __init__(self, jobs: Sequence[tuple[float, Callable[[], None]]], stale_after: float):
        now = time.monotonic()
        self.watch = LoadWatch(stale_after)
        self.period = min((period for period, _ in jobs), default=LOOK_S)
        self._jobs = [[period, now + period, job] for period, job in jobs]
        self._ticked = self._looked = now
        self._away = 0.0
        self._transport = math.inf  # the least from sending to reception, on two clocks, s
        self._busy = False

    def tick(self, now: float) -> float:
        """Do what is due at ``now`` (s, monotonic); return for how long nothing was, in s."""
        away = now - self._ticked
        if self._busy or away < 0.5 * self.period:
            return 0.0
        self._ticked, self._busy = now, True
        self._away = max(self._away, away)
        try:
            for job in self._jobs:
                if now >= job[1]:
                    job[1] = max(job[1] + job[0], now)
                    job[2]()
        finally:
            self._busy = False
        return away

    def look(self, inputs: list[TopicInput], rows: int, missing: int) -> None:
        """See how old what waits in the queues is, some times a second."""
        now = time.monotonic()
        if now - self._looked < LOOK_S:
            return
        behind = max((self._age(each) for each in inputs), default=0.0)
        self.watch.look(now, rows, missing, behind, self._away)
        self._looked, self._away = now, 0.0

    def _age(self, topic_input: TopicInput) -> float:
        """Return the age of the oldest message that waits, s; 0 where none does."""
        found = topic_input.take_waiting()
        if found is None:
            return 0.0
        sent_ns, received_ns = found
        waited = (time.time_ns() - received_ns) * 1e-9
        transport = (received_ns - sent_ns) * 1e-9
        self._transport = min(self._transport, transport)
        return max(waited, 0.0) + transport - self._transport

    def found(self) -> Overload | None:
        """Return what is wrong now, or None."""
        return self.watch.found(time.monotonic())
