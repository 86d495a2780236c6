"""What is wrong with the samples as they come, from their stamps and values, in sentences.

A fault of the data is no fault of the plant.  Each kind has its own sentence, which stands while
there is evidence and a few seconds longer, so that a fault that comes in bursts does not flutter.
"""

import math
import statistics
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np

from eha_monitor.live.rows import Counts, Rows, Source, steps_from
from eha_monitor.plausibility.held import SHORTEST_S, is_frozen
from eha_monitor.recordings.recording import LARGEST, LIMITS

HELD_S = 3.0  # a sentence stands for so long after its last evidence
# So many samples, and so large a share of them, make a fault; one message in thousands is none.
FEW = 3
# What two sources that use one topic look like; ends of sentences.
MIXED = ("are duplicates and left out", "came out of order, behind later ones, and are left out")
SHARE = 0.005
GAP = 1.5  # a step between stamps longer than this, in usual steps, lacks samples
# A rate this many times off the configured one is named.
OTHER_RATE = 1.5
NEAR_RATE = 0.2  # off it, the middle step of a jitter may be so much
# So much later than at best is late; usual are some milliseconds, on a busy machine tens.
LATE_S = 0.1
AHEAD_S = 0.5  # by which a stamp is ahead of its receipt, against what is usual
# Looks after which it is known how receipt and stamp usually drift apart.
GROWTHS = 5
INTERRUPTED_S = 1.0  # without data: nothing is lost between, the source was not there
# Kinds of sentences that a monitor that cannot keep up brings about by itself.
CONSEQUENCES = ("missing", "late", "lacked")
ENOUGH = 20  # so many samples are needed to tell a usual step
# What must move while a channel stands still: the demand, and for the demand itself the position.
# The velocity is in no stage, and many drivers publish a zero there for ever.
REFERENCES = {"x": "x_d", "omega": "x", "p1": "x", "p2": "x", "force": "x", "x_d": "x"}
OTHERWISE = {"x": "omega"}
# A demand may stand still; only if the position goes on and on without it, it has frozen.
SHORTEST_DEMAND_S = 1.2
# The reference moves where it covers this part of what it usually covers within some seconds: at
# rest it covers its own noise.
PART = 0.05
REMEMBERED_S = 10.0
# What is usual must have been seen for so long, and is forgotten with this time constant.
LEARNT_S = 2.0
FORGOTTEN_S = 300.0


# What no piston and no oil does within a row, per s: a message in another unit, a counter that was
# reset.  A pressure surge rises by some 1e10 Pa/s.
LEAPS = {"x": 20.0, "p1": 1e12, "p2": 1e12}
ROTARY = 10.0  # times as many rad/s as m/s
REACH_S = 0.02  # for so long at most that it may have gone on while no value came
STEADY_S = 1.0  # of a new level without a leap, before it is taken for the sensor's


class Leaps:
    """Which values of a channel lie where it cannot have come from its last good one.

    ``rate`` per s it cannot exceed; ``least_s`` is the shortest time between rows, s.
    """

    def __init__(self, rate: float, least_s: float):
        self._rate, self._least = rate, least_s
        self._good: tuple[float, float] | None = None  # s, value
        self._raw: tuple[float, float] | None = None
        self._steady = math.inf  # s, since when the raw values leap no more

    def take(self, time: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return which rows to leave out, (n,) bool, for times (n,) s and values, NaN where none.

        A single wild value costs itself and the next; a level to which it has leapt is left out
        until it is back, or has stayed there without another leap.
        """
        out = np.zeros(len(values), dtype=bool)
        there = np.flatnonzero(np.isfinite(values))
        if not len(there):
            return out
        t, v = time[there], values[there]
        if self._raw is not None and abs(t[0] - self._raw[0]) > INTERRUPTED_S:
            self._good = self._raw = None  # where it has gone meanwhile nobody knows
        first = (t[0], v[0]) if self._good is None else self._good
        far = self._leaps(np.diff(t, prepend=first[0]), np.diff(v, prepend=first[1]))
        if not far.any() and self._good is self._raw:
            self._good = self._raw = (float(t[-1]), float(v[-1]))
            return out
        for at, moment, value in zip(there.tolist(), t.tolist(), v.tolist(), strict=True):
            here = (moment, value)
            if self._good is None:
                self._good = self._raw = here
                continue
            leapt = bool(self._leaps(moment - self._raw[0], value - self._raw[1]))
            self._raw, lost = here, self._raw is not self._good
            if not self._leaps(moment - self._good[0], value - self._good[1]) and not (
                    lost and leapt):
                self._good = here
                continue
            if not lost or leapt:
                self._steady = moment
            if moment - self._steady >= STEADY_S:
                self._good = here
            else:
                out[at] = True
        return out

    def _leaps(self, apart: np.ndarray | float, by: np.ndarray | float) -> np.ndarray:
        """Tell whether values move by more than they can in the time ``apart``, s."""
        # Of single values np.clip takes three times as long.
        return np.abs(by) > self._rate * np.minimum(np.maximum(apart, self._least), REACH_S)


class Stillness:
    """Since when each channel has not changed."""

    def __init__(self):
        # rows, counts: rows taken, and those that held each channel
        self.rows = 0
        self.counts: dict[str, int] = {}
        self.frozen: set[str] = set()  # the channels that are
        self._last: dict[str, float] = {}
        self._seen: dict[str, int] = {}  # stamp of the last value, ns
        self._changed: dict[str, int] = {}  # stamp of the last change, ns
        self._pending: dict[str, float] = {}  # longest pause that ended since the last look, s
        self._longest: dict[str, float] = {}  # while the reference moved and nothing was wrong, s
        self._learnt: dict[str, float] = {}
        self._now_ns = self._looked_ns = 0
        self._ranges: dict[str, tuple[float, float]] = {}
        self._past: dict[str, deque] = {}  # (stamp, lowest, highest) of each look
        self._widest: dict[str, float] = {}  # that it moved within ``REMEMBERED_S``

    def take(self, rows: Rows) -> dict[str, int]:
        """Take rows; return the channels that are frozen, and for how many rows they still are."""
        if not len(rows):
            return {}
        self._now_ns = int(rows.stamps[-1])
        self.rows += len(rows)
        frozen = dict.fromkeys(self.frozen, len(rows))
        for name, column in rows.columns.items():
            places = np.flatnonzero(np.isfinite(column))
            if len(places):
                self._take(name, column[places], rows.stamps[places], places, frozen)
        return frozen

    def _take(self, name: str, values: np.ndarray, stamps: np.ndarray, places: np.ndarray,
              frozen: dict[str, int]) -> None:
        """Take the values of a channel, at least one, and the rows in which they stand."""
        if name not in self._last:
            self._last[name], self.counts[name] = float(values[0]), 0
            self._changed[name] = self._seen[name] = int(stamps[0])
        at = np.flatnonzero(steps_from(self._last[name], values))
        if len(at):
            seen = np.concatenate([[self._seen[name]], stamps])[at]  # by the value before
            pauses = seen - np.concatenate([[self._changed[name]], stamps[at[:-1]]])
            if name in self.frozen:
                self.frozen.discard(name)
                frozen[name] = int(places[at[0]])
                pauses = pauses[1:]
            longest = int(pauses.max(initial=0))
            if longest > self._pending.get(name, 0):
                self._pending[name] = longest
            self._changed[name] = int(stamps[at[-1]])
        self._last[name], self._seen[name] = float(values[-1]), int(stamps[-1])
        self.counts[name] += len(values)
        if name in ("x", "x_d", "omega"):
            low, high = float(values.min()), float(values.max())
            span = self._ranges.get(name, (low, high))
            self._ranges[name] = min(low, span[0]), max(high, span[1])

    def reference(self, channel: str) -> str:
        """Return the channel that must move."""
        reference = REFERENCES[channel]
        return reference if reference in self._past else OTHERWISE.get(channel, reference)

    def look(self) -> dict[str, tuple[float, int, bool]]:
        """Return the channels that are frozen: for how long (s), from which stamp (ns), new?."""
        span_s = (self._now_ns - self._looked_ns) * 1e-9 if self._looked_ns else 0.0
        self._looked_ns = self._now_ns
        for name, (low, high) in self._ranges.items():
            past = self._past.setdefault(name, deque())
            past.append((self._now_ns, low, high))
            while (self._now_ns - past[0][0]) * 1e-9 > REMEMBERED_S:
                past.popleft()
            covered = max(high for _, _, high in past) - min(low for _, low, _ in past)
            self._widest[name] = max(
                self._widest.get(name, 0.0) * math.exp(-span_s / FORGOTTEN_S), covered)
        self._ranges.clear()
        found = {}
        pressures = "p1" in self.counts and "p2" in self.counts
        for name in REFERENCES:
            if name == "force" and pressures:
                continue  # the pressures stand for it, and an effort that nobody measures is 0
            if name in self._changed and (seconds := self._still(name, span_s)):
                found[name] = (seconds, self._changed[name] + 1, name not in self.frozen)
        self.frozen = set(found)
        return found

    def _still(self, name: str, span_s: float) -> float:
        """Return for how long a channel has been frozen, 0 if it is not."""
        still = (self._seen[name] - self._changed[name]) * 1e-9
        if (self._now_ns - self._seen[name]) * 1e-9 > SHORTEST_S:
            return 0.0  # silent, which is another fault
        paused = self._pending.pop(name, 0) * 1e-9
        reference = self.reference(name)
        longest = self._longest.get(name, 0.0)
        if name not in self.frozen and self._moves(reference, max(paused, span_s)):
            longest *= math.exp(-span_s / FORGOTTEN_S)
            self._longest[name] = longest = max(longest, paused)
            self._learnt[name] = self._learnt.get(name, 0.0) + span_s
        demand = name == "x_d"
        if (self._learnt.get(name, 0.0) < LEARNT_S
                or not is_frozen(still, longest, SHORTEST_DEMAND_S if demand else SHORTEST_S)
                or not self._moves(reference, still / 2.0 if demand else still)):
            return 0.0
        return still

    def _moves(self, reference: str, seconds: float) -> bool:
        """Tell whether a channel moved within the last seconds, against what it usually does."""
        past = self._past.get(reference)
        if not past or reference in self.frozen:
            return False
        covered = self._widest[reference]
        recent = [(low, high) for at, low, high in past if (self._now_ns - at) * 1e-9 < seconds]
        if not recent or covered <= 0:
            return False
        moved = max(high for _, high in recent) - min(low for low, _ in recent)
        return moved > PART * covered


@dataclass
class _Past:
    """One source as it was at the last look."""

    counts: Counts = field(default_factory=Counts)
    rows: int = 0
    behind: float = math.nan  # from the last stamp to its receipt, on clocks of their own, s
    best: float = math.inf  # the least of it that is usual
    growth: deque[float] = field(default_factory=lambda: deque(maxlen=25))  # of it, s/s
    at: float = -math.inf  # when it was last measured, s
    was_late: bool = False
    counted: dict[str, int] = field(default_factory=dict)


class FaultWatch:
    """Looks at the sources of the rows some times a second.

    Parameters
    ----------
    sample_time : as configured, s.
    latency : how long a row waits for its last channel, s.
    rotary : whether the position is an angle.
    """

    def __init__(self, sources: list[Source], sample_time: float, latency: float,
                 rotary: bool = False):
        self._sources, self._sample_time, self._latency = sources, sample_time, latency
        self._past = {source.name: _Past() for source in sources}
        self._noted: dict[str, tuple[float, str]] = {}  # when last, and the sentence, by key
        self.stillness = Stillness()  # of each channel's value; takes the rows
        self.missing = 0  # samples that lack between the stamps, of all sources
        self._looked = False
        self._no_values: dict[str, str] = {}  # sentence of values left out since the last look
        self._left_out: dict[str, int] = {}  # channel -> how many values, since the last look
        self._leaps = {name: Leaps(rate * (ROTARY if rotary and name == "x" else 1.0),
                                   sample_time) for name, rate in LEAPS.items()}

    def take(self, rows: Rows) -> Rows:
        """Take rows; return them without what is frozen or no measurement."""
        columns = {}
        for name, values in rows.columns.items():
            wild = np.abs(values) > LARGEST[name]  # no sensor can show it; the next look names it
            if wild.any():
                limit, unit = LIMITS[name]
                self._no_values[f"wild {name}"] = (
                    f"{name}: {values[wild][-1]:.3g} {unit} is not a valid measurement (beyond "
                    f"±{limit:.0e} {unit}), left out")
                values = self._without(wild, name, values)
            if name in self._leaps:
                leapt = self._leaps[name].take(rows.stamps * 1e-9, values)
                if leapt.any():
                    self._no_values[f"leap {name}"] = (
                        f"{name} leaps to {values[leapt][-1]:.3g} {LIMITS[name][1]}, farther than "
                        "it can move within a sample (another unit, a counter that was reset?): "
                        "left out until it is back, or has moved without a leap for "
                        f"{STEADY_S:g} s")
                    values = self._without(leapt, name, values)
            columns[name] = values
        rows = replace(rows, columns=columns)
        frozen = self.stillness.take(rows)
        for name, until in frozen.items():
            columns[name] = columns[name].copy()
            columns[name][:until] = np.nan
        return rows

    def _without(self, those: np.ndarray, name: str, values: np.ndarray) -> np.ndarray:
        """Leave out values that came, and count them: they have a sentence of their own."""
        self._left_out[name] = self._left_out.get(name, 0) + int(those.sum())
        return np.where(those, np.nan, values)

    def restart(self, reason: str, now: float) -> None:
        """Stamps have jumped back: name it, and learn anew what is usual."""
        self.note("clock", now, f"the clock jumped back: {reason}")
        for past in self._past.values():
            past.rows = 0
            past.counted.clear()
            past.growth.clear()
            past.behind, past.at = math.nan, -math.inf
        self.stillness = Stillness()

    def note(self, key: str, now: float, sentence: str) -> None:
        """Take a sentence; a newer one of the same key replaces it."""
        self._noted[key] = (now, sentence)

    def sentences(self, now: float, without: Collection[str] = ()) -> list[str]:
        """Return what stands at ``now`` (s, monotonic), in the order in which it first came.

        ``without`` leaves out kinds, the first words of keys.
        """
        self._noted = {key: (at, text) for key, (at, text) in self._noted.items()
                       if now - at <= HELD_S}
        return [text for key, (_, text) in self._noted.items()
                if key.partition(" ")[0] not in without]

    def look(self, now: float) -> dict[str, int]:
        """Compare with the last look; return channels found frozen now, and since when, ns."""
        before, self._looked = self._looked, True
        for source in self._sources:
            past = self._past[source.name]
            steps = np.array(source.steps, dtype=float) * 1e-9
            source.steps.clear()
            if before and not source.held:
                self._order(source, past, now)
                self._steps(source, past, steps, now)
                self._numbers(source, past, now)
                if source.taken > past.counts.taken and source.last_ns is not None:
                    self._lateness(source, past, steps, now)
            past.counts, past.rows = source.counts(), self.stillness.rows
            past.counted = {name: self.stillness.counts.get(name, 0) for name in source.channels}
        self._left_out.clear()
        for key, sentence in self._no_values.items():
            self.note(key, now, sentence)
        self._no_values.clear()
        fresh = {}
        for channel, (seconds, since_ns, new) in self.stillness.look().items():
            reference = self.stillness.reference(channel)
            self.note(f"still {channel}", now, f"{channel} has not changed for {seconds:.1f} s "
                      f"while {reference} moves (frozen sensor, or stuck piston)")
            if new:
                fresh[channel] = since_ns
        return fresh

    def _order(self, source: Source, past: _Past, now: float) -> None:
        """Name stamps that repeat or go back."""
        late, repeated = source.late - past.counts.late, source.repeated - past.counts.repeated
        all_ = source.taken - past.counts.taken + late + repeated
        if _many(repeated, all_):
            self.note(f"repeat {source.name}", now,
                      f"{source.name}: stamps repeat, {repeated} of {all_} messages {MIXED[0]}")
        if _many(late, all_):
            self.note(f"order {source.name}", now,
                      f"{source.name}: {late} of {all_} messages {MIXED[1]}")

    def _steps(self, source: Source, past: _Past, steps: np.ndarray, now: float) -> None:
        """Name samples that are missing, and a rate that is not the configured one."""
        if len(steps) < FEW or source.by_receipt:  # received in bursts, on a busy machine
            return
        # With up to three quarters of the samples lost, a quarter of the steps are whole ones.
        usual = float(np.partition(steps, len(steps) // 4)[len(steps) // 4])
        if usual <= 0:
            return
        # A longer gap is an interruption or a clock that was set, which others name.
        lacking = steps[(steps > GAP * usual) & (steps <= max(INTERRUPTED_S, 10.0 * usual))]
        missing = int(np.sum(np.round(lacking / usual) - 1))
        # Where stamps jitter, a short step and a long one are no gap: as many came as were due.
        middle = float(np.median(steps))
        as_asked = abs(middle - self._sample_time) < NEAR_RATE * self._sample_time
        period = self._sample_time if as_asked else max(usual, min(middle, self._sample_time))
        whole = steps[steps <= max(INTERRUPTED_S, 10.0 * usual)]
        missing = min(missing, round(float(whole.sum()) / period) - len(whole))
        missing -= source.late - past.counts.late  # they came, too late
        self.missing += max(missing, 0)
        if _many(missing, missing + len(steps)):
            self.note(f"missing {source.name}", now,
                      f"{source.name}: messages are dropped, {missing} samples missing of "
                      f"{missing + len(steps)}")
        times = self._sample_time / usual
        if len(steps) >= ENOUGH and times > OTHER_RATE:
            self.note(f"rate {source.name}", now,
                      f"{source.name}: samples come {times:.3g} times as fast as configured, "
                      f"every {usual * 1e3:.3g} ms, and rig.sample_time is "
                      f"{self._sample_time * 1e3:.3g} ms")

    def _numbers(self, source: Source, past: _Past, now: float) -> None:
        """Name a channel without a number, and one that the rows cannot wait for."""
        taken, lacked = source.taken - past.counts.taken, source.lacked - past.counts.lacked
        empty, rows = source.empty - past.counts.empty, self.stillness.rows - past.rows
        given = [name for name in source.channels if past.counted.get(name)]
        for name in given:  # it gave numbers before
            nan = empty + rows - lacked - (self.stillness.counts[name] - past.counted[name]
                                           ) - self._left_out.get(name, 0)
            if taken + empty and _many(nan, rows + empty):
                self.note(f"NaN {name}", now,
                          f"{name}: NaN in {nan} of {rows + empty} samples ({source.name})")
        if taken and _many(lacked, rows):
            self.note(f"lacked {source.name}", now,
                      f"{source.name}: {lacked} rows were processed without it, they wait no "
                      "longer than "
                      f"{self._latency:g} s (monitor.latency)")

    def _lateness(self, source: Source, past: _Past, steps: np.ndarray, now: float) -> None:
        """Name messages that come long after their stamp, or long before, against what is usual.

        The stamps' clock may be another one, and run at another rate (a replay): only a step of
        the difference between receipt and stamp tells, not its usual growth.
        """
        behind = source.heard_s - source.last_ns * 1e-9
        elapsed, past.at = now - past.at, now
        if math.isfinite(past.behind) and elapsed > 0:
            past.growth.append((behind - past.behind) / elapsed)
        past.behind = behind
        if len(past.growth) < GROWTHS:
            past.best, past.was_late = behind, False
            return
        growth = statistics.median(past.growth)
        usual, rate = past.best + growth * elapsed, max(1.0 - growth, 0.01)
        past.best = min(usual, behind)
        ahead, excess = (usual - behind) / rate, (behind - past.best) / rate  # in our own time
        ahead = min(ahead, float(steps.max(initial=0.0)))  # what waited catches up step by step
        if ahead > AHEAD_S:
            self.note(f"ahead {source.name}", now, f"{source.name}: stamps jump ahead by "
                      f"{ahead:.2f} s of the time in which they came (a clock that was set)")
        late = excess > LATE_S
        if late and past.was_late:  # one may be the scheduler's
            self.note(f"late {source.name}", now, f"{source.name}: messages come "
                      f"{excess:.2f} s later after their stamp than usual")
        past.was_late = late


def _many(count: int, of: int) -> bool:
    return count >= FEW and count > SHARE * of
