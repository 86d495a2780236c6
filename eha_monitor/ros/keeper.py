"""The last minutes of a monitor: kept in memory, saved as a bag on an alarm or on request."""

import time
from collections.abc import Callable
from pathlib import Path

from rclpy.node import Node
from std_srvs.srv import Trigger

from eha_monitor.health.alarms import Alarm
from eha_monitor.recordings.ring import Ring, Saved, Saver
from eha_monitor.recordings.write import TopicType
from eha_monitor.ros.topics import answered, every
from eha_monitor.settings import Settings

POLL_PERIOD = 0.1
# A bag that could not be written is tried again after this time.
RETRY_S = 30.0
_RANK = {"OK": 0, "WARN": 1, "ERROR": 2}  # what is not judged is neither better nor worse


class Keeper:
    """Ring buffer, its saver, and the service ``monitor/save``.

    ``monitor.buffer_minutes`` = 0 keeps nothing; ``tell`` is called when there is news of a bag.
    """

    def __init__(self, node: Node, settings: Settings, tell: Callable[[], None]):
        self._node, self._tell = node, tell
        self._from = _RANK.get(settings.monitor.save_on.upper())
        self._before: dict[str, int] = {}
        self._span = 60.0 * settings.monitor.buffer_minutes
        self.ring = Ring(self._span) if self._span else None
        self._saver = Saver(self.ring, Path(settings.monitor.save_folder),
                            settings.rig.name) if self.ring is not None else None
        self._due: float | None = None  # when the next bag is to be written, s, monotonic
        self._alarm_bag_until = 0.0
        self._asked = False
        self._part: tuple[int, Callable[[Saved], None]] | None = None  # to be written
        self._part_told: Callable[[Saved], None] | None = None  # that is being written
        # by name of an alarm, the bag of the moment in which it was raised last; "" while that bag
        # is due
        self.bags: dict[str, str] = {}
        self._written: list[str] = []  # alarms of which the bag is being written
        self.last: Saved | None = None  # what came of the last attempt, or None
        self._last_good: Saved | None = None
        self._service = LateTrigger(node, "monitor/save", self._on_request)
        self._timer = every(node, POLL_PERIOD, self.poll)

    def stream(self, topic: str, type_name: str, latched: bool = False) -> int:
        """Return the number under which a topic's messages are kept."""
        return self.ring.stream(self._node.resolve_topic_name(topic),
                                TopicType(type_name, latched))

    def note(self, changes: list[Alarm]) -> None:
        """Save the last minutes if one of these alarms has been raised far enough.

        An alarm whose past is partly in the bag of one before waits until that bag's end has
        aged: so the bags of alarms that follow one another join, and do not overlap.
        """
        raised = False
        for alarm in changes:
            if alarm.level in _RANK and not alarm.not_judged:
                rank = _RANK[alarm.level]
                if rank > self._before.get(alarm.name, 0) and rank >= (self._from or 9):
                    raised = True
                    if self._saver is not None:
                        self.bags[alarm.name] = ""
                self._before[alarm.name] = rank
        if raised and self._saver is not None and self._due is None:
            self._due = max(time.monotonic(), self._alarm_bag_until)

    def save_since(self, stamp_ns: int, told: Callable[[Saved], None]) -> None:
        """Save what came from a log time on; ``told`` is called with what came of it."""
        self._part = stamp_ns, told

    def poll(self) -> None:
        """Take the result of a bag, and begin the next if one is due."""
        if self._saver is None:
            return
        self.ring.trim()
        result = self._saver.take()
        if result is not None:
            self._take(result)
        now = time.monotonic()
        due = self._due is not None and now >= self._due
        if (due or self._asked) and not self._saver.busy:
            if due:
                self._due, self._alarm_bag_until = None, now + self._span
            self._start(due)
        elif self._part is not None and not self._saver.busy:
            (since_ns, self._part_told), self._part = self._part, None
            self._saver.start(since_ns)

    def _start(self, due: bool) -> None:
        self._asked = False
        self._written = [name for name, bag in self.bags.items() if due and not bag]
        self._service.take_up()
        self._saver.start()

    @property
    def unsaved(self) -> str | None:
        """Why the last bag could not be written, as a sentence, or None."""
        return str(self.last) if self.last is not None and self.last.problem else None

    def values(self) -> dict[str, float | int | str]:
        """Return what the diagnostics say of the buffer and of the last bag."""
        if self.ring is None:
            return {}
        found: dict[str, float | int | str] = {
            "buffer_messages": self.ring.messages, "buffer_MB": self.ring.megabytes}
        if self._last_good is not None:
            found |= {"last_bag": str(self._last_good.path),
                      "last_bag_span_s": self._last_good.span_s}
        return found

    def close(self) -> None:
        """Finish the bag that is being written, write the one that is due, end the service."""
        self._node.destroy_timer(self._timer)
        if self._saver is not None:
            if self._saver.busy:
                self._take(self._saver.take(wait=True))
            if self._due is not None or self._asked:
                self._start(self._due is not None)
                self._take(self._saver.take(wait=True))
        self._node.destroy_service(self._service.service)

    def _on_request(self) -> str | None:
        if self._saver is None:
            return "the buffer is off: monitor.buffer_minutes is 0"
        self._asked = True
        return None

    def _take(self, result: Saved) -> None:
        told, self._part_told = self._part_told, None
        if told is not None:
            if result.problem is None:
                self._last_good = result
            told(result)
            self._tell()
            return
        self.last = result
        good = result.problem is None
        if good:
            self._last_good = result
            self.bags |= {name: str(result.path) for name in self._written}
            self._node.get_logger().info(f"saved {result}")
        else:
            self._node.get_logger().error(str(result))
            if result.count:
                self._due = time.monotonic() + RETRY_S
        self._service.answer(good, str(result))
        self._tell()


class LateTrigger:
    """A Trigger service that answers when the work is done, while the node goes on.

    The events executor knows no coroutines: it hands whatever the callback returns to the
    service's ``send_response``, so the header is kept there until the answer is known.

    ``begin`` is called for each request; it returns a message if that is refused at once, else
    None.
    """

    def __init__(self, node: Node, name: str, begin: Callable[[], str | None]):
        self._begin = begin
        self._waiting: list = []
        self._taken: list = []
        self.service = node.create_service(Trigger, name, self._on_request)
        self._send = self.service.send_response
        self.service.send_response = self._keep_or_send

    def take_up(self) -> None:
        """Work begins for the requests that wait now; those that come later wait for the next."""
        self._taken, self._waiting = self._taken + self._waiting, []

    def answer(self, success: bool, message: str) -> None:
        """Answer every request that was taken up."""
        taken, self._taken = self._taken, []
        for header in taken:
            self._send(Trigger.Response(success=success, message=message), header)

    def end(self, success: bool, message: str) -> None:
        """Answer every request that waits."""
        self.take_up()
        self.answer(success, message)

    def _on_request(self, request, response):
        refused = self._begin()
        return None if refused is None else answered(response, False, refused)

    def _keep_or_send(self, response, header) -> None:
        if response is None:
            self._waiting.append(header)
        else:
            self._send(response, header)
