"""Rows out of streams: several topics with stamps of their own become aligned rows.

Rows stand at the stamps of the position.  Another channel enters a row by equal stamp, else by
linear interpolation between the neighbours of the row; a row waits for its last channel, but
not longer than the latency.  Stamps that repeat or go back are dropped and counted; when the
clock itself has jumped back, the reason is kept for the estimator's reset.

Samples come in batches.  Where all stamps rise, as they do but for a fault, a batch is taken as a
whole; else sample by sample in the order in which they came.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

# A stamp this much before the last one is no late message: another clock, or a loop of a bag.
FAR_BACK_NS = 500_000_000
# A longer step forward is doubted until further stamps confirm it (one garbled stamp is not
# to throw away everything that follows it).
FAR_AHEAD_NS = 60_000_000_000
CONFIRM_FAR = 3
CONFIRM_NEAR = 20
SILENT_S = 0.25  # a source that was silent for this long is not waited for
# A held channel (temperature) counts as measured for this long.
HOLD_NS = 60_000_000_000
KEPT = 8192  # samples of a source that wait for a row, at most


def steps_from(before: float, values: np.ndarray) -> np.ndarray:
    """Return the (n,) differences of (n,) values, the first from ``before``."""
    steps = np.empty_like(values)
    steps[:1] = values[:1] - before
    np.subtract(values[1:], values[:-1], out=steps[1:])
    return steps


@dataclass(kw_only=True)
class Counts:
    """What became of the samples of a stream."""

    # taken, late, repeated: samples taken, dropped as late, as repeated
    taken: int = 0
    late: int = 0
    repeated: int = 0
    empty: int = 0  # messages with the entry and without a number
    lacked: int = 0  # rows that went without this source

    def counts(self) -> "Counts":
        """Return the counts as they are now."""
        return Counts(**{one.name: getattr(self, one.name) for one in fields(Counts)})


@dataclass
class Source(Counts):
    """One stream of channels that share a stamp, and what became of its samples.

    The samples that wait are ``stamps``, ``values`` and ``came``: ns, (n, k), s on the caller's
    clock.
    """

    name: str  # for messages, e.g. ``joint_states (piston)``
    channels: tuple[str, ...]  # names of the values of each sample, in order
    held: bool = False  # slow channels: the last value counts, no row waits for the next one
    by_receipt: bool = False  # its messages have no stamp, that of their receipt stands for it
    last_ns: int | None = None  # stamp of the last sample taken; None before the first
    heard_s: float = -math.inf  # when the last sample came, on the caller's clock
    jumped: int = 0  # samples dropped as doubtful jumps
    skipped: int = 0  # messages since the last sample that gave none
    # ns between the stamps taken, shared among what was not read between them
    steps: deque = field(default_factory=lambda: deque(maxlen=KEPT))
    epoch_ns: int | None = None
    doubted: int = 0
    candidate_ns: int = 0

    def __post_init__(self):
        self.clear()

    def clear(self) -> None:
        """Forget the samples that wait."""
        self.stamps, self.came = np.empty(0, dtype=np.int64), np.empty(0)
        self.values = np.empty((0, len(self.channels)))

    def add(self, stamps: Sequence[int], values: Sequence, came: Sequence[float]) -> None:
        """Let samples wait."""
        self.stamps = np.concatenate([self.stamps, stamps])[-KEPT:]
        self.values = np.concatenate([self.values, values])[-KEPT:]
        self.came = np.concatenate([self.came, came])[-KEPT:]

    def drop(self, count: int) -> None:
        """Let the oldest samples go."""
        if count > 0:
            self.stamps, self.values, self.came = (
                self.stamps[count:], self.values[count:], self.came[count:])


@dataclass(frozen=True)
class Batch:
    """What a topic brought of one source, message by message."""

    source: Source
    # stamps, values, came: (n,) ns, (n, k), (n,) s
    stamps: np.ndarray
    values: np.ndarray
    came: np.ndarray
    # of messages that gave no sample, whether for want of a number; None where all gave one
    lacking: tuple[bool | None, ...] | None = None


@dataclass(frozen=True)
class Rows:
    """Aligned rows."""

    # stamps, came: (n,) ns; when each position came, s on the caller's clock
    stamps: np.ndarray
    columns: dict[str, np.ndarray]  # channel -> (n,), NaN where it has no value
    came: np.ndarray

    def __len__(self) -> int:
        return len(self.stamps)

    def part(self, start: int, stop: int) -> "Rows":
        """Return rows ``start`` to ``stop``."""
        return Rows(self.stamps[start:stop], {
            name: values[start:stop] for name, values in self.columns.items()},
            self.came[start:stop])


class RowAligner:
    """Align streams to rows at the position stamps.

    Parameters
    ----------
    sources : the streams; exactly one holds the channel ``x`` and gives the rows their stamps.
    latency : how long a row waits for its last channel, s; also the longest span that is
        interpolated.
    """

    def __init__(self, sources: list[Source], latency: float):
        self.sources = sources
        self.latency = latency
        # rows, incomplete: rows given out, and those among them that lacked a channel of a source
        # that was not silent
        self.rows = self.incomplete = 0
        self._span_ns = round(latency * 1e9)
        self._leader = next(s for s in sources if "x" in s.channels)
        self._followers = [s for s in sources if s is not self._leader]
        self._names = [name for s in (self._leader, *self._followers) for name in s.channels]
        self._before: list[Rows] = []  # the clock jumped back
        # why the rows start anew, until :meth:`take_reset` is called; else None
        self.reset_reason: str | None = None

    def take(self, batches: Sequence[Batch]) -> None:
        """Take what came since the last time, of each source at most one batch."""
        steps = [self._ordinary(batch) for batch in batches]
        if not any(each is None for each in steps):
            for batch, each in zip(batches, steps, strict=True):
                self._take_whole(batch, each)
            return
        singly = []
        for batch in batches:
            lacking = batch.lacking or (None,) * len(batch.stamps)
            singly += zip(batch.came.tolist(), (batch.source,) * len(lacking),
                          batch.stamps.tolist(), batch.values.tolist(), lacking, strict=True)
        for came, source, stamp_ns, values, lacks in sorted(singly, key=lambda one: one[0]):
            if lacks is None:
                self.push(source, stamp_ns, tuple(values), came)
            else:
                self.unread(source, lacks)

    @staticmethod
    def _ordinary(batch: Batch) -> np.ndarray | None:
        """Return the steps between stamps where all messages gave samples that rise, or None."""
        last = batch.source.last_ns
        if batch.lacking is not None or last is None:
            return None
        steps = steps_from(last, batch.stamps)
        rise = steps.min(initial=1) > 0 and steps.max(initial=1) <= FAR_AHEAD_NS
        return steps if rise else None

    def _take_whole(self, batch: Batch, steps: np.ndarray) -> None:
        source = batch.source
        if not len(batch.stamps):
            return
        steps[0] //= 1 + source.skipped
        source.steps.extend(steps.tolist())
        source.doubted = source.skipped = 0
        source.last_ns, source.heard_s = int(batch.stamps[-1]), float(batch.came[-1])
        source.taken += len(batch.stamps)
        source.add(batch.stamps, batch.values, batch.came)

    def push(self, source: Source, stamp_ns: int, values: tuple[float, ...], now: float) -> None:
        """Take one sample of a source; ``now`` in s on a clock that only rises."""
        last = source.last_ns
        ordinary = last is not None and 0 < stamp_ns - last <= FAR_AHEAD_NS
        if not ordinary and not self._believe(source, stamp_ns, now):
            return
        if source.last_ns is not None:
            source.steps.append((stamp_ns - source.last_ns) // (1 + source.skipped))
        source.doubted = source.skipped = 0
        source.last_ns = stamp_ns
        source.heard_s = now
        source.taken += 1
        source.add([stamp_ns], [values], [now])

    def unread(self, source: Source, empty: bool) -> None:
        """Note a message that gave no sample, ``empty`` for want of a number."""
        source.skipped += 1
        source.empty += empty

    def pop(self, now: float) -> Rows:
        """Return the rows that are complete or overdue.

        While a reset waits for :meth:`take_reset`, those of the time before it.
        """
        if self.reset_reason is not None:
            return self._before.pop(0) if self._before else self._rows(0, now)
        leader = self._leader
        awaited = [s.last_ns for s in self._followers if not s.held and now - s.heard_s < SILENT_S]
        count = len(leader.stamps)
        if awaited:
            limit = min(-2**63 if last is None else last for last in awaited)
            waits = (leader.stamps > limit) & (now - leader.came <= self.latency)
            if waits.any():
                count = int(np.argmax(waits))
        return self._rows(count, now)

    def take_reset(self) -> str | None:
        """Return why the rows start anew since the last call, or None."""
        reason, self.reset_reason = self.reset_reason, None
        self._before.clear()
        return reason

    def _rows(self, count: int, now: float) -> Rows:
        """Give out the oldest ``count`` rows."""
        leader = self._leader
        stamps, came = leader.stamps[:count], leader.came[:count]
        complete = np.ones(count, dtype=bool)
        columns = list(leader.values[:count].T)
        for source in self._followers:
            values, found = self._at(source, stamps)
            columns += list(values.T)
            source.lacked += count - int(np.count_nonzero(found))
            if not source.held and now - source.heard_s < SILENT_S:
                complete &= found
        leader.drop(count)
        self.rows += count
        self.incomplete += count - int(np.count_nonzero(complete))
        return Rows(stamps, {name: np.where(np.isfinite(values), values, np.nan)
                             for name, values in zip(self._names, columns, strict=True)}, came)

    def _at(self, source: Source, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a follower's values at stamps, (n, k) with NaN, and where there are any, (n,)."""
        out = np.full((len(stamps), len(source.channels)), np.nan)
        given = source.stamps
        if not len(given) or not len(stamps):
            return out, np.zeros(len(stamps), dtype=bool)
        if np.array_equal(given[:len(stamps)], stamps):  # as they are where one node sends all
            values = source.values[:len(stamps)]
            source.drop(len(stamps) - 1)
            return values, np.ones(len(stamps), dtype=bool)
        before = np.searchsorted(given, stamps, side="right") - 1
        after = np.minimum(before + 1, len(given) - 1)
        at = np.maximum(before, 0)
        since = stamps - given[at]
        found = (before >= 0) & (since == 0)
        if source.held:
            found |= (before >= 0) & (since <= HOLD_NS)
            part = np.zeros(len(stamps))
        else:
            span = given[after] - given[at]
            between = (before >= 0) & ~found & (span > 0) & (span <= self._span_ns)
            part = np.where(between, since / np.maximum(span, 1), 0.0)
            found |= between
        left, right = source.values[at], source.values[after]
        part = part[:, None]
        mixed = np.where(part > 0.0, left + part * (right - left), left)
        out[found] = mixed[found]
        source.drop(int(before[-1]))
        return out, found

    def _believe(self, source: Source, stamp: int, now: float) -> bool:
        """Judge a stamp that is no ordinary step: drop it, or take it as a new beginning."""
        if source.last_ns is None:
            # After a reset, samples of the time before it may still be under way.
            if source.epoch_ns is None or abs(stamp - source.epoch_ns) <= FAR_BACK_NS:
                return True
            step = stamp - source.epoch_ns
        else:
            step = stamp - source.last_ns
        near = -FAR_BACK_NS < step <= 0
        rising = source.doubted and stamp > source.candidate_ns
        source.doubted = source.doubted + 1 if rising else 1
        source.candidate_ns = stamp
        if source.doubted < (CONFIRM_NEAR if near else CONFIRM_FAR):
            if step == 0:
                source.repeated += 1
            elif near:
                source.late += 1
            else:
                source.jumped += 1
            return False
        if step <= 0 and source.last_ns is not None:
            self._restart(stamp, f"stamps of {source.name} jumped back by {-step / 1e9:.3f} s",
                          now)
        return True

    def _restart(self, stamp: int, reason: str, now: float) -> None:
        """Begin anew at a stamp; the rows before it that are complete can still be had."""
        if self.reset_reason is None:
            self._before = [self.pop(now)]
            self.reset_reason = reason
        for source in self.sources:
            source.clear()
            source.last_ns = None
            source.epoch_ns = stamp
            source.doubted = 0
