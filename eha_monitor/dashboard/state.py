"""What the page shows, gathered from the topics; it outlives every page that looks at it."""

import math
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlencode

from eha_monitor.dashboard.events import (
    ACKNOWLEDGED,
    Acknowledgement,
    Change,
    EventLog,
    acknowledgements,
    changes,
    diagnosis_changes,
    since,
    write_acknowledgements,
)
from eha_monitor.errors import InputError
from eha_monitor.health.alarms import ALARM_NAMES, WATCHED
from eha_monitor.health.judge import SEVERITY, Finding
from eha_monitor.settings import Settings

Row = tuple[float, ...]


class History:
    """The last rows (time, value, ...) densely, and of longer stretches before them the extremes.

    Parameters
    ----------
    span : how long rows are kept densely, s.
    every : one row in each such slot, s; with ``span`` it bounds the memory.
    gap : a longer distance is a gap, which a chart shows as one, s.
    long_span : how long the extremes are kept, s; 0 keeps none.
    stretch : of each such stretch the rows with the least and the largest value are kept, s.
    """

    def __init__(self, span: float, every: float, gap: float, long_span: float = 0.0,
                 stretch: float = math.inf):
        self.span, self.every, self.stretch = span, every, stretch
        self.gap = max(gap, 2.5 * every)
        self._dense: deque[Row] = deque(maxlen=math.ceil(span / every) + 1)
        self._old: deque[list[Row]] = deque(maxlen=math.ceil(
            long_span / stretch) + 1 if long_span else 0)

    def add(self, time_s: float, *values: float) -> None:
        """Keep a row; time that jumps back starts anew."""
        row = (time_s, *values)
        if self._dense and time_s < self._dense[-1][0]:
            self._dense.clear()
            self._old.clear()
        # Slots that lie fixed in time: series that come together are kept together.
        if not self._dense or time_s // self.every != self._dense[-1][0] // self.every:
            self._dense.append(row)
        if self._old and time_s // self.stretch == self._old[-1][0][0] // self.stretch:
            self._old[-1] = _extremes([*self._old[-1], row])
        else:
            self._old.append([row])

    def rows(self, since: float = -math.inf) -> list[Row]:
        """Return the rows from ``since`` on; a row of NaN stands where data were missing."""
        if self._dense and not self._old:
            since = max(since, self._dense[-1][0] - self.span)
        dense = [row for row in self._dense if row[0] >= since]
        if self._dense and since >= self._dense[0][0]:
            return _with_gaps(dense, self.gap)
        first = dense[0][0] if dense else math.inf
        old = [row for rows in self._old for row in rows if since <= row[0] < first]
        # With the first dense one: between the two may be a gap as well.
        older = _with_gaps([*old, *dense[:1]], max(self.gap, 2.5 * self.stretch))
        return [*older[:-1], *_with_gaps(dense, self.gap)] if dense else older


def thinned(rows: list[Row], most: int) -> list[Row]:
    """Return about ``most`` rows at the most: of each stretch those of least and largest value.

    Rows of NaN, the gaps, all stay.  The stretches lie fixed in time, so that a chart that is
    drawn anew each second does not flicker.
    """
    if len(rows) <= most:
        return rows
    step = 2.0 * (rows[-1][0] - rows[0][0]) / most
    kept: list[Row] = []
    for _, group in groupby(rows, key=lambda row: (row[0] // step, math.isnan(row[1]))):
        members = list(group)
        kept += members if math.isnan(members[0][1]) else _extremes(members)
    return kept


def _extremes(rows: list[Row]) -> list[Row]:
    """Return the rows of least and of largest value, in the order of time."""
    low, high = min(rows, key=lambda row: row[1]), max(rows, key=lambda row: row[1])
    return [low] if low is high else sorted((low, high))


def _with_gaps(rows: list[Row], gap: float) -> list[Row]:
    kept: list[Row] = []
    for row in rows:
        if kept and row[0] - kept[-1][0] > gap:
            kept.append((0.5 * (kept[-1][0] + row[0]), *[math.nan] * (len(row) - 1)))
        kept.append(row)
    return kept


# ---- which stretch of time the charts show ----------------------------------------------------

# Choices by their name; None is all that is kept.
CHOICES: dict[str, float | None] = {"1 min": 60.0, "5 min": 300.0, "30 min": 1800.0, "all": None}
FIRST = "5 min"
SHORTEST = 1.0  # a shorter stretch than this is a click and no choice, s


class Span:
    """The choice of one page."""

    def __init__(self):
        self.choice = FIRST  # one of ``CHOICES``; it counts while nothing is zoomed
        # the stretch that was dragged, time of day, s; None while the charts follow the data
        self.zoom: tuple[float, float] | None = None

    def choose(self, choice: str) -> None:
        """Follow the data again, over the time of a choice."""
        self.choice, self.zoom = choice, None

    def drag(self, first: float, last: float) -> bool:
        """Stay at a stretch; returns whether it is one."""
        if not (math.isfinite(first) and math.isfinite(last)) or last - first < SHORTEST:
            return False
        self.zoom = first, last
        return True

    def since(self, now: float) -> float:
        """Return from when on rows are needed; ``now`` is the time of day, s."""
        if self.zoom is not None:
            return self.zoom[0]
        length = CHOICES[self.choice]
        return -math.inf if length is None else now - length

    def query(self, actuator: str) -> str:
        """Return the query of the same stretch as CSV."""
        wanted: dict[str, str] = {"actuator": actuator}
        if self.zoom is not None:
            wanted |= {"since": f"{self.zoom[0]:.3f}", "until": f"{self.zoom[1]:.3f}"}
        elif (length := CHOICES[self.choice]) is not None:
            wanted["last"] = f"{length:g}"
        return urlencode(wanted)


# How long and how densely things are kept, s.
ESTIMATES_SPAN, ESTIMATES_EVERY = 1800.0, 0.5
# Before that, the extremes of each minute.
LONG_SPAN, STRETCH = 86_400.0, 60.0
POSITION_SPAN, POSITION_EVERY = 15.0, 0.04
RECENT = 1000  # measured positions among which the one of an estimate's stamp is looked for
PAIR_HOLDS = 0.5  # so long a pair of the same stamp is shown when the next ones lack a partner, s
# Health comes once a second; after this without it, what it said counts no more, s.
HEALTH_STALE_AFTER = 3.0
STAGES = {"stage_one": WATCHED[0], "stage_two": WATCHED[1]}
# A clock that was set goes at least so far at once; less is what it is steered by, s.
CLOCK_SET = 0.5
SAME_RESET = 2.5  # a reset that is reported twice within this time is one, s
# Keys of the innovations in the statuses of the stages.
NIS, VARIANCE_RATIO, SAMPLES = ("innovation_nis", "innovation_variance_ratio",
                                "innovation_samples")


class Limit(NamedTuple):
    """A threshold: ``low`` or ``high``, ``WARN`` or ``ERROR``, SI; drawn where the oil is now.

    ``drawn`` differs from ``value`` where this holds at the reference ``temperature``, °C.
    """

    side: str
    degree: str
    value: float
    drawn: float
    temperature: float


@dataclass
class _Number:
    """The last value of something and when it came (s, monotonic)."""

    value: float = math.nan
    came: float = -math.inf


@dataclass(frozen=True)
class View:
    """The present state, as one consistent copy."""

    # value, stddev: estimates by symbol, SI; NaN where none has come
    value: dict[str, float]
    stddev: dict[str, float]
    # measured, estimated: position, m (rad where the motion is rotary); NaN where none has come
    measured: float
    estimated: float
    # whether these two are of the same time, so that their difference means something
    same_stamp: bool
    findings: dict[str, Finding]  # the health, by name; what is no longer heard is STALE
    hardware: str  # the rig's name as the monitor gives it, or that of the config
    # s since the last value of each symbol, of any (``estimates``), of each position and of the
    # health; infinite where none has come
    silence: dict[str, float] = field(default_factory=dict)
    # by the name of the alarm, what of it has been acknowledged
    acknowledged: dict[str, Acknowledgement] = field(default_factory=dict)
    stamp: float = math.nan  # of the last measured position, s; NaN where none has come
    # the monitor's own diagnosis, by name; empty where none has come
    diagnosis: dict[str, Finding] = field(default_factory=dict)


class State:
    """Takes what comes on the topics; a page asks for a view or a history at any time.

    The topics come in one thread and the page is served in another, hence the lock.

    Parameters
    ----------
    settings : config: limits until the monitor's own are heard, and when data count as stopped.
    wall_clock : gives the time of day, s since the epoch.
    log : takes what changes; without it nothing is logged.
    file : where acknowledgements outlive this process; None: nowhere.
    """

    def __init__(self, settings: Settings, wall_clock: Callable[[], float],
                 log: EventLog | None = None, file: Path | None = None):
        self.settings, self._wall_clock = settings, wall_clock
        self.name = settings.rig.name
        self.log = log or EventLog()
        self._offset = math.inf
        self._acknowledged: dict[str, Acknowledgement] = {}
        self._file, self._before = file, {}
        self._heard = False
        self._last_reset = ("", -math.inf)
        self._lock = threading.Lock()
        self._values = {w.symbol: _Number() for w in WATCHED}
        self._stddevs = {w.symbol: _Number() for w in WATCHED}
        self._positions = {"measured": _Number(), "estimated": _Number()}
        self._recent: deque[tuple[float, float]] = deque(maxlen=RECENT)
        self._pair: tuple[float, float] | None = None
        self._unpaired: tuple[float, float] | None = None
        self._pair_came = -math.inf
        self._findings: dict[str, Finding] = {}
        self._diagnosis: dict[str, Finding] = {}
        self._health_came = -math.inf
        self._hardware = settings.rig.name
        gap = settings.monitor.stale_after
        self._histories = {
            **{w.symbol: History(ESTIMATES_SPAN, ESTIMATES_EVERY, gap, LONG_SPAN, STRETCH)
               for w in WATCHED},
            **{name: History(POSITION_SPAN, POSITION_EVERY, gap) for name in self._positions},
            **{stage: History(ESTIMATES_SPAN, ESTIMATES_EVERY, HEALTH_STALE_AFTER, LONG_SPAN,
                                  STRETCH) for stage in STAGES}}
        if file is not None:
            self._try(lambda: self._before.update(acknowledgements(file)))

    def take_value(self, symbol: str, value: float, now: float) -> None:
        """Take an estimate of ``B`` or ``beta_e``, SI; ``now`` in s, monotonic."""
        with self._lock:
            self._values[symbol] = _Number(value, now)

    def take_stddev(self, symbol: str, stddev: float, now: float) -> None:
        """Take the standard deviation that belongs to the last estimate."""
        with self._lock:
            self._stddevs[symbol] = _Number(stddev, now)
            value = self._values[symbol].value
            if math.isfinite(value) and math.isfinite(stddev):
                self._histories[symbol].add(now, value, stddev, float(
                    in_doubt(self._findings, symbol)))

    def take_position(self, which: str, time_s: float, position: float, now: float) -> None:
        """Take the ``measured`` or ``estimated`` position, m, with its own stamp, s."""
        if not math.isfinite(position):
            return
        with self._lock:
            self._positions[which] = _Number(position, now)
            self._histories[which].add(time_s, position)
            if which == "measured":
                self._recent.append((time_s, position))
            else:
                self._unpaired = (time_s, position)
            # Measured positions are taken in batches: an estimate may come before its own.
            if self._unpaired is not None and (
                    measured := self._measured_at(self._unpaired[0])) is not None:
                self._pair, self._pair_came = (measured, self._unpaired[1]), now
                self._unpaired = None

    def _measured_at(self, time_s: float) -> float | None:
        """Return the measured position of this stamp, or None."""
        # A moving piston goes millimetres between two stamps that are not the same.
        within = 0.75 * self.settings.rig.sample_time
        for stamp, measured in reversed(self._recent):
            if abs(stamp - time_s) < within:
                return measured
            if stamp < time_s - within:  # a search of all at each sample would cost a core
                return None
        return None

    def take_findings(self, hardware: str, findings: Iterable[Finding], now: float) -> None:
        """Take the health as it was published."""
        with self._lock:
            self._hardware = hardware or self._hardware
            before, self._findings = self._findings, {f.name: f for f in findings}
            self._health_came = now
            if before and not self._heard:
                self._note(Change("monitor", "OK", "the monitor is heard again"))
            self._heard = True
            for change in changes(before, self._findings):
                if change.kind != "reset" or self._is_new(change.text, now):
                    self._note(change)
            self._drop_acknowledgements()
            for stage in STAGES:
                finding = self._findings.get(stage)
                if finding is not None and finding.level != "STALE":
                    row = (_number(finding, NIS), _number(finding, VARIANCE_RATIO))
                    if any(math.isfinite(value) for value in row):
                        self._histories[stage].add(now, *row)

    def take_diagnosis(self, findings: Iterable[Finding]) -> None:
        """Take the monitor's own diagnosis as it was published."""
        with self._lock:
            before, self._diagnosis = self._diagnosis, {f.name: f for f in findings}
            for change in diagnosis_changes(before, self._diagnosis):
                self._note(change)

    def watch(self, now: float) -> None:
        """Log that the monitor has gone silent; to be called each second, ``now`` monotonic."""
        with self._lock:
            if self._heard and now - self._health_came > HEALTH_STALE_AFTER:
                self._heard = False
                self._note(Change("monitor", "STALE",
                                  f"the monitor is not heard for {HEALTH_STALE_AFTER:g} s"))

    def acknowledge(self, names: Iterable[str], who: str) -> list[str]:
        """Acknowledge those of the named alarms that are raised; returns which those were.

        An acknowledgement lasts until the alarm is OK again, or is raised to a higher level.
        """
        done = []
        with self._lock:
            for name in names:
                finding = self._findings.get(name)
                if name not in ACKNOWLEDGED or finding is None or not finding.raised or (
                        name in self._acknowledged):
                    continue
                self._acknowledged[name] = Acknowledgement(
                    who, self._wall_clock(), finding.word, since(finding))
                self._note(Change("acknowledged", finding.word,
                                  f"{name.replace('_', ' ').capitalize()}: {finding.word} "
                                  f"acknowledged by {who}"))
                done.append(name)
            if done:
                self._keep()
        return done

    def _drop_acknowledgements(self) -> None:
        """Let go what is over; of before this process what is not of this very alarm."""
        known = self._before | self._acknowledged
        kept = {name: given for name, given in self._acknowledged.items()
                if name not in self._findings or not given.over(self._findings[name])}
        for name in [*self._before.keys() & self._findings.keys()]:
            finding, given = self._findings[name], self._before[name]
            if finding.word in SEVERITY and finding.level != "STALE":  # else nothing is known
                del self._before[name]
                if given.of(finding):
                    kept[name] = given
        self._acknowledged = kept
        if self._before | kept != known:
            self._keep()

    def _keep(self) -> None:
        if self._file is not None:
            given = self._before | self._acknowledged
            self._try(lambda: write_acknowledgements(self._file, given))

    def _try(self, work: Callable[[], None]) -> None:
        """Do something with the file; where that fails, the page goes on without."""
        try:
            work()
        except InputError as problem:
            self._note(Change("acknowledged", "WARN", str(problem)))

    def _is_new(self, text: str, now: float) -> bool:
        """Return whether a reset is another one: its event and its count may come apart."""
        before, self._last_reset = self._last_reset, (text, now)
        return before[0] != text or now - before[1] > SAME_RESET

    def _note(self, change: Change) -> None:
        self.log.add(self._wall_clock(), self.name, change)

    def time_of_day(self, monotonic: float, now: float) -> float:
        """Return the time of day of a monotonic time; both are of the same moment ``now``.

        A clock that is steered does not move what was drawn; one that was set moves all of it.
        """
        offset = self._wall_clock() - now
        if abs(offset - self._offset) > CLOCK_SET:
            self._offset = offset
        return monotonic + self._offset

    def view(self, now: float) -> View:
        """Return the present state; ``now`` in s, monotonic."""
        with self._lock:
            silence = {name: now - n.came for name, n in (self._values | self._positions).items()}
            silence["estimates"] = min(silence[symbol] for symbol in self._values)
            silence["health"] = now - self._health_came
            findings = self._findings
            if silence["health"] > HEALTH_STALE_AFTER:
                findings = {name: _no_longer(f) for name, f in findings.items()}
            latest = min(silence["measured"], silence["estimated"])
            pair = self._pair if now - self._pair_came - latest < PAIR_HOLDS else None
            measured, estimated = pair or (self._positions["measured"].value,
                                           self._positions["estimated"].value)
            return View({s: n.value for s, n in self._values.items()},
                        {s: n.value for s, n in self._stddevs.items()},
                        measured, estimated, pair is not None, dict(findings), self._hardware,
                        silence, dict(self._acknowledged),
                        self._recent[-1][0] if self._recent else math.nan,
                        dict(self._diagnosis))

    def history(self, name: str, now: float, since: float = -math.inf) -> list[Row]:
        """Return the rows of a symbol or a stage.

        Symbols: (time of day s, value, stddev, 1 where it is in doubt, else 0); stages: (time of
        day s, normalised innovation squared, variance ratio).

        ``now`` in s, monotonic; ``since`` : time of day of the oldest row, s.
        """
        shift = self.time_of_day(0.0, now)
        with self._lock:
            rows = self._histories[name].rows(since - shift)
        return [(row[0] + shift, *row[1:]) for row in rows]

    def positions(self) -> dict[str, list[Row]]:
        """Return the rows (stamp s, position) of ``measured`` and ``estimated``."""
        with self._lock:
            return {name: self._histories[name].rows() for name in self._positions}

    def limits(self, symbol: str) -> list[Limit]:
        """Return the thresholds of a parameter, SI.

        They are those that the monitor says it judges by, else those of the config; of a value
        that is judged at the reference temperature they lie where its oil is.
        """
        watched = next(w for w in WATCHED if w.symbol == symbol)
        configured = getattr(self.settings.thresholds, watched.section)
        with self._lock:
            findings = self._findings
        found = []
        for side in ("low", "high"):
            heard = findings.get(f"{watched.section}_{side}")
            carried = math.nan if heard is None else _number(heard, "at_reference")
            for degree in ("warn", "error"):
                if heard is not None and f"limit_{degree}" in heard.values:
                    limit = _number(heard, f"limit_{degree}")
                else:
                    limit = getattr(configured, f"{side}_{degree}")
                if limit is not None and math.isfinite(limit):
                    found.append(Limit(
                        side, degree.upper(), float(limit),
                        float(limit) / carried if carried > 0.0 else float(limit),
                        self.settings.viscosity.reference_temperature))
        return found


@dataclass(frozen=True)
class Actuator:
    """One of the actuators on the page."""

    name: str  # by which it is chosen; the name of its rig where it is the only one
    namespace: str  # of its topics
    domain: int  # ROS domain id that is listened to
    state: State  # what was heard of it
    # full names of the topics, by those keys of ``View.silence`` that are looked at
    topics: dict[str, str]


def in_doubt(findings: Mapping[str, Finding], symbol: str) -> bool:
    """Tell whether the value of a parameter must not be used, as the monitor's health says.

    Its stage's is in doubt, and no least squares stand in its place.
    """
    stage, watched = next(pair for pair in STAGES.items() if pair[1].symbol == symbol)
    own = findings.get(stage)
    return own is not None and bool(int(own.values.get("in_doubt") or 0)) and not any(
        int(one.values.get("by_least_squares") or 0) for name, one in findings.items()
        if name.startswith(watched.section))


def alarms(view: View) -> list[Finding]:
    """Return the alarms in their fixed order; one that was never heard is STALE."""
    return [view.findings.get(name) or Finding(name, "STALE", "nothing received from the monitor "
                                                              "yet")
            for name in ALARM_NAMES]


def _no_longer(finding: Finding) -> Finding:
    if finding.word == "STALE":
        return finding
    return Finding(finding.name, "STALE", f"last received {finding.word}: {finding.message}",
                   {**finding.values, "not_judged": "0"})


def _number(finding: Finding, key: str) -> float:
    try:
        return float(finding.values.get(key, ""))
    except ValueError:
        return math.nan
