"""The event log: what changed, when, on which actuator; and what of it was acknowledged.

Acknowledgements are kept in a file beside the monitor's bags: a dashboard that starts anew has
them.
"""

import csv
import io
import json
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from eha_monitor.errors import InputError
from eha_monitor.health.alarms import ALARM_NAMES, NOT_JUDGED
from eha_monitor.health.judge import DIAGNOSIS, MISMATCH, SEVERITY, Finding
from eha_monitor.output import write_bytes

QUALITY = "data quality"
ACKNOWLEDGED = (*ALARM_NAMES, MISMATCH)  # what a person can acknowledge
MOST = 5000  # so many events are kept; the oldest go first
# In these an alarm is worth an entry of its own; that data began or stopped is one of `data`.
_LOGGED = ("WARN", "ERROR", NOT_JUDGED)


@dataclass(frozen=True)
class Change:
    """Something that changed from one health message to the next."""

    # ``alarm``, ``acknowledged``, ``model``, ``diagnosis`` (begun, ended, adopted or taken back),
    # ``reset``, ``bag``, ``monitor``, ``data`` (they stop, come, or are refused) or ``data
    # quality`` (a warning about the samples, and its end)
    kind: str
    level: str  # the word of the level that it has now, "" where it has none
    text: str  # a sentence


@dataclass(frozen=True)
class Event(Change):
    """A change with its time of day (s since the epoch) and its actuator."""

    time_s: float
    actuator: str


class EventLog:
    """The events of all actuators, in the order in which they came; a bounded number is kept."""

    def __init__(self):
        self.count = 0  # of all events that ever came
        self._events: deque[Event] = deque(maxlen=MOST)
        self._lock = threading.Lock()

    def add(self, time_s: float, actuator: str, change: Change) -> None:
        """Keep a change; ``time_s`` since the epoch."""
        with self._lock:
            self.count += 1
            self._events.append(Event(change.kind, change.level, change.text, time_s, actuator))

    def latest(self, without: str = "") -> list[Event]:
        """Return the events that are kept, the newest first, without those of one kind."""
        with self._lock:
            return [event for event in reversed(self._events) if event.kind != without]

    def csv(self) -> str:
        """Return all events as CSV, the oldest first; times in UTC."""
        rows = [("time_utc", "actuator", "kind", "level", "text")]
        rows += [(utc(event.time_s), event.actuator, event.kind, event.level, event.text)
                 for event in reversed(self.latest())]
        return csv_text(rows)


def utc(time_s: float) -> str:
    """Return a time since the epoch as ISO 8601 in UTC, to the millisecond."""
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds")


def csv_text(rows: list[tuple]) -> str:
    """Return rows as CSV, with the mark of UTF-8 that spreadsheets look for.

    A text that a spreadsheet would take for a formula gets a quote before it.
    """
    out = io.StringIO()
    out.write("\ufeff")
    csv.writer(out, lineterminator="\r\n").writerows(
        [f"'{cell}" if isinstance(cell, str) and cell[:1] in ("=", "+", "-", "@") else cell
         for cell in row] for row in rows)
    return out.getvalue()


def changes(before: Mapping[str, Finding], after: Mapping[str, Finding]) -> Iterator[Change]:
    """Give what changed between two health messages; ``before`` is empty for the first one."""
    for name in ACKNOWLEDGED:
        if name in after:
            yield from _alarm(before.get(name), after[name])
    if "data" in after:
        yield from _data(before.get("data"), after["data"])


def diagnosis_changes(before: Mapping[str, Finding], after: Mapping[str, Finding]
                      ) -> Iterator[Change]:
    """Give the event that came with ``monitor/diagnosis``; one of before the page is none."""
    if DIAGNOSIS in before and DIAGNOSIS in after:
        old, new = before[DIAGNOSIS].values, after[DIAGNOSIS].values
        if new.get("event") and new.get("event_number") != old.get("event_number"):
            yield Change(DIAGNOSIS, str(new.get("event_level", "")), str(new["event"]))


def _alarm(old: Finding | None, new: Finding) -> Iterator[Change]:
    was = old.word if old is not None else ""
    if was == new.word or not {was, new.word}.intersection(_LOGGED):
        return
    name = new.name.replace("_", " ").capitalize()
    words = f"{name}: {was} → {new.word}" if was else f"{name}: {new.word} when first heard"
    yield Change("model" if new.name == MISMATCH else "alarm", new.word,
                 "; ".join(filter(None, (words, new.message.removeprefix(f"{NOT_JUDGED}: ")))))


def _data(old: Finding | None, new: Finding) -> Iterator[Change]:
    if old is None or old.level != new.level:
        levels = {new.level, old.level if old else "STALE"}
        yield Change(QUALITY if levels == {"OK", "WARN"} else "data", new.level, new.message)
    if old is None:
        return  # an event or a bag of before the dashboard: its time is not known
    # A bag that is replayed in a loop gives the same event at the same time again.
    keys = ("last_event", "last_event_s", "jumped_stamps")
    if any(new.values.get(key) != old.values.get(key) for key in keys) and (
            text := str(new.values.get("last_event", ""))):
        yield Change("reset" if text.startswith("estimates reset") else QUALITY, "", text)
    bag = str(new.values.get("last_bag", ""))
    if bag and bag != old.values.get("last_bag"):
        yield Change("bag", "", f"bag saved: {bag}")


@dataclass(frozen=True)
class Acknowledgement:
    """Who acknowledged an alarm, when (time of day, s since the epoch) and at which level.

    ``since`` is the alarm's own time of that level, as the monitor gives it.
    """

    who: str
    time_s: float
    level: str
    since: str = ""

    def over(self, finding: Finding) -> bool:
        """Tell whether the alarm is OK again, or raised to a higher level."""
        return finding.word == "OK" or (
            finding.raised and SEVERITY.index(finding.word) > SEVERITY.index(self.level))

    def of(self, finding: Finding) -> bool:
        """Tell whether the alarm is still the one of before this process: unchanged since."""
        return finding.word == self.level and since(finding) == self.since


def since(finding: Finding) -> str:
    """Return since when an alarm has its level, as the monitor gives it."""
    return str(finding.values.get("since_s", ""))


def acknowledgements(path: Path) -> dict[str, Acknowledgement]:
    """Return by the name of the alarm what a file has; nothing where there is none.

    Raises InputError if it cannot be read, or is no such file.
    """
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        return {str(name): Acknowledgement(str(one["who"]), float(one["time_s"]),
                                           str(one["level"]), str(one["since"]))
                for name, one in tree.items() if one["level"] in SEVERITY}
    except FileNotFoundError:
        return {}
    except OSError as problem:
        raise InputError(f"{path}: cannot read: {problem.strerror}") from problem
    except (ValueError, TypeError, KeyError, AttributeError) as problem:
        raise InputError(f"{path}: expected the acknowledgements that a dashboard wrote"
                         ) from problem


def write_acknowledgements(path: Path, given: dict[str, Acknowledgement]) -> None:
    """Write what :func:`acknowledgements` reads; raises InputError if that cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise InputError(f"{path.parent}: cannot make the folder: {problem.strerror}") from problem
    write_bytes(path, json.dumps({name: asdict(one) for name, one in given.items()},
                                 indent=1).encode())
