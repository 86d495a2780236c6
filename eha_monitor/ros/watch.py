"""Looking on: what a monitor publishes, as lines of text."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from std_msgs.msg import Float64

from eha_monitor.health.alarms import ALARM_NAMES, WATCHED, Watched
from eha_monitor.quantity import SYMBOLS, with_uncertainty
from eha_monitor.ros import running
from eha_monitor.ros.findings import MISMATCH
from eha_monitor.ros.messages import findings_of
from eha_monitor.ros.outputs import LATCHED

_LINE_EVERY = 1.0  # s

# Takes a line, and the level of the alarm that it tells of or None.
Say = Callable[[str, str | None], None]


@dataclass
class Seen:
    """What came from the monitor.

    Attributes
    ----------
    estimates : number of estimates of ``B`` and ``beta_e``.
    raised : names of the alarms that reached WARN or ERROR.
    """

    estimates: dict[str, int] = field(default_factory=dict)
    raised: set[str] = field(default_factory=set)


class Watcher:
    """Subscribes to estimates, alarms and model test of one monitor and says what comes."""

    def __init__(self, node: Node, say: Say):
        self.seen = Seen()
        self._say = say
        self._started = time.monotonic()
        self._latest: dict[str, float] = {}
        self._levels: dict[str, str] = {}
        for watched in WATCHED:
            for suffix in ("", "_stddev"):
                node.create_subscription(
                    Float64, f"monitor/{watched.section}{suffix}",
                    self._keep(watched.symbol + suffix), 10)
        node.create_subscription(DiagnosticArray, "monitor/health", self._take_health, LATCHED)
        node.create_timer(_LINE_EVERY, self._tell)

    def _keep(self, key: str) -> Callable[[Float64], None]:
        def keep(message: Float64) -> None:
            self._latest[key] = message.data
            self.seen.estimates[key] = self.seen.estimates.get(key, 0) + 1
        return keep

    def _tell(self) -> None:
        if self._latest:
            parts = "   ".join(self._shown(watched) for watched in WATCHED)
            self._say(f"{self._clock()}  {parts}", None)

    def _shown(self, watched: Watched) -> str:
        symbol = SYMBOLS[watched.symbol]
        value = self._latest.get(watched.symbol)
        stddev = self._latest.get(f"{watched.symbol}_stddev")
        if value is None or stddev is None or not stddev < abs(value):
            return f"{symbol} not known yet"
        return f"{symbol} = {with_uncertainty(value, stddev, watched.unit)}"

    def _clock(self) -> str:
        return f"{time.monotonic() - self._started:5.1f} s"

    def _take_health(self, message: DiagnosticArray) -> None:
        for finding in findings_of(message):
            name, level = finding.name, finding.level
            if name not in (*ALARM_NAMES, MISMATCH):
                continue
            before = self._levels.get(name, "OK")
            self._levels[name] = level
            if level != before and {level, before} & {"WARN", "ERROR"}:
                self._say(f"{self._clock()}  {level:5} {name}: {finding.message}", level)
            if level in ("WARN", "ERROR") and name in ALARM_NAMES:
                self.seen.raised.add(name)


def watch(namespace: str, duration: float, say: Say,
          finished: Callable[[Seen], bool] = lambda seen: False) -> Seen:
    """Look on for ``duration`` s, or until ``finished(seen)``, which is asked each second.

    Parameters
    ----------
    namespace : of the monitor's topics.
    say : called with each line: the estimates once a second, an alarm when it is raised, falls
        or clears.
    """
    with running.ros_session([]), running.node("watch", namespace) as node:
        watcher = Watcher(node, say)
        running.spin(node, duration, finished=lambda: finished(watcher.seen))
        return watcher.seen
