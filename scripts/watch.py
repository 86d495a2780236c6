"""Looking on: what a monitor publishes, as lines of text."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from sensor_msgs.msg import JointState

from eha_monitor.health.alarms import ALARM_NAMES, WATCHED, Watched
from eha_monitor.health.judge import MISMATCH, Finding
from eha_monitor.health.overload import OVERLOADED
from eha_monitor.quantity import SYMBOLS, with_uncertainty
from eha_monitor.ros import running
from eha_monitor.ros.messages import findings_of, subscribe_to_monitor

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
    heard : whether the monitor has said anything.
    rows, missing : samples that the monitor had, and that it knows to lack.
    """

    estimates: dict[str, int] = field(default_factory=dict)
    raised: set[str] = field(default_factory=set)
    heard: bool = False
    rows: int = 0
    missing: int = 0

    @property
    def losses(self) -> str:
        """What was lost, as a sentence; empty where nothing was."""
        if not self.missing:
            return ""
        share = 100.0 * self.missing / (self.rows + self.missing)
        return (f"{self.missing} of {self.rows + self.missing} samples were lost on the way "
                f"({share:.2g} %): times and values above may differ from those of the whole bag")


class Watcher:
    """Subscribes to estimates, alarms and model test of one monitor and says what comes.

    Times are those of the data, since the first sample: a replay's clock is not the wall's.
    """

    def __init__(self, node: Node, say: Say):
        self.seen = Seen()
        self._say = say
        self._first_ns: int | None = None  # stamp of the first sample, as the monitor gives it
        self._now_ns: int | None = None  # stamp of the newest estimate
        self._latest: dict[str, float] = {}
        self._levels: dict[str, str] = {}
        subscribe_to_monitor(node, self._take_number, self._take_state, self._take_health)
        node.create_timer(_LINE_EVERY, self._tell)

    def _take_number(self, symbol: str, suffix: str, value: float) -> None:
        key = symbol + suffix
        self._latest[key] = value
        self.seen.estimates[key] = self.seen.estimates.get(key, 0) + 1

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

    def _take_state(self, message: JointState) -> None:
        stamp = message.header.stamp
        self._now_ns = stamp.sec * 1_000_000_000 + stamp.nanosec

    def _clock(self, since_s: float = math.nan) -> str:
        """Return a time of the data, or that of the newest estimate."""
        if math.isnan(since_s) and self._first_ns is not None and self._now_ns is not None:
            since_s = (self._now_ns - self._first_ns) * 1e-9
        return f"{'':5}  " if math.isnan(since_s) else f"{since_s:5.1f} s"

    def _take_health(self, message: DiagnosticArray) -> None:
        self.seen.heard = True
        found = {finding.name: finding for finding in findings_of(message)}
        if "data" in found:
            self._take_data(found["data"])
        for name in (*ALARM_NAMES, MISMATCH, "data"):
            if name not in found:
                continue
            finding, word = found[name], found[name].word
            if name == "data" and OVERLOADED not in finding.message and (
                    name not in self._levels):
                continue  # that nothing comes before it begins is no news
            before = self._levels.get(name, "OK")
            self._levels[name] = word
            if word != before and {word, before, finding.level} & {"WARN", "ERROR"}:
                since = finding.values.get("since_s", "") if name in ALARM_NAMES else ""
                said = finding.message.removeprefix(f"{word}: ")
                self._say(f"{self._clock(float(since or 'nan'))}  {word:5} {name}: {said}", word)
            if finding.raised and name in ALARM_NAMES:
                self.seen.raised.add(name)

    def _take_data(self, finding: Finding) -> None:
        values = finding.values
        if values.get("first_stamp_ns"):
            self._first_ns = int(values["first_stamp_ns"])
        if values.get("rows"):
            self.seen.rows = int(values["rows"])
            self.seen.missing = int(values.get("missing_samples") or 0)


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
