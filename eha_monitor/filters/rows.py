"""Rows out of streams: several topics with stamps of their own become one aligned row.

Rows stand at the stamps of the position.  Another channel enters a row by equal stamp, else by
linear interpolation between the neighbours of the row; a row waits for its last channel, but
not longer than the latency.  Stamps that repeat or go back are dropped and counted; when the
clock itself has jumped back, the reason is kept for the estimator's reset.
"""

import math
from collections import deque
from dataclasses import dataclass, field, fields

# A stamp this much before the last one is no late message: another clock, or a loop of a bag.
FAR_BACK_NS = 500_000_000
# A longer step forward is doubted until further stamps confirm it (one garbled stamp is not
# to throw away everything that follows it).
FAR_AHEAD_NS = 60_000_000_000
CONFIRM_FAR = 3
CONFIRM_NEAR = 20
# A source that was silent for this long is not waited for.
SILENT_S = 0.25
# A held channel (temperature) counts as measured for this long.
HOLD_NS = 60_000_000_000


@dataclass(kw_only=True)
class Counts:
    """What became of the samples of a stream.

    Attributes
    ----------
    taken, late, repeated : samples taken, dropped as late, as repeated.
    empty : messages with the entry and without a number.
    lacked : rows that went without this source.
    """

    taken: int = 0
    late: int = 0
    repeated: int = 0
    empty: int = 0
    lacked: int = 0

    def counts(self) -> "Counts":
        """Return the counts as they are now."""
        return Counts(**{one.name: getattr(self, one.name) for one in fields(Counts)})


@dataclass
class Source(Counts):
    """One stream of channels that share a stamp, and what became of its samples.

    Attributes
    ----------
    name : for messages, e.g. ``joint_states (piston)``.
    channels : names of the values of each sample, in order.
    held : slow channels: the last value counts, no row waits for the next one.
    last_ns : stamp of the last sample taken; None before the first.
    heard_s : when the last sample came, on the caller's clock.
    jumped : samples dropped as doubtful jumps.
    skipped : messages since the last sample that gave none.
    steps : ns between the stamps taken, shared among what was not read between them.
    """

    name: str
    channels: tuple[str, ...]
    held: bool = False
    last_ns: int | None = None
    heard_s: float = -math.inf
    jumped: int = 0
    skipped: int = 0
    steps: deque = field(default_factory=lambda: deque(maxlen=8192))
    epoch_ns: int | None = None
    doubted: int = 0
    candidate_ns: int = 0
    buffer: deque = field(default_factory=lambda: deque(maxlen=8192))


class RowAligner:
    """Align streams to rows at the position stamps.

    Parameters
    ----------
    sources : the streams; exactly one holds the channel ``x`` and gives the rows their stamps.
    latency : how long a row waits for its last channel, s; also the longest span that is
        interpolated.

    Attributes
    ----------
    rows, incomplete : rows given out, and those among them that lacked a channel of a source
        that was not silent.
    reset_reason : why the rows start anew, until :meth:`take_reset` is called; else None.
    """

    def __init__(self, sources: list[Source], latency: float):
        self.sources = sources
        self.latency = latency
        self.rows = self.incomplete = 0
        self._span_ns = round(latency * 1e9)
        self._leader = next(s for s in sources if "x" in s.channels)
        self._followers = [s for s in sources if s is not self._leader]
        self.reset_reason: str | None = None

    def push(self, source: Source, stamp_ns: int, values: tuple[float, ...],
             now: float) -> None:
        """Take one sample of a source; ``now`` in s on a clock that only rises."""
        last = source.last_ns
        ordinary = last is not None and 0 < stamp_ns - last <= FAR_AHEAD_NS
        if not ordinary and not self._believe(source, stamp_ns):
            return
        if source.last_ns is not None:
            source.steps.append((stamp_ns - source.last_ns) // (1 + source.skipped))
        source.doubted = source.skipped = 0
        source.last_ns = stamp_ns
        source.heard_s = now
        source.taken += 1
        source.buffer.append((stamp_ns, values, now))

    def unread(self, source: Source, empty: bool) -> None:
        """Note a message that gave no sample, ``empty`` for want of a number."""
        source.skipped += 1
        source.empty += empty

    def pop(self, now: float) -> list[tuple[int, dict[str, float], float]]:
        """Return the rows that are complete or overdue: stamp in ns, values, when it came."""
        out = []
        waiting = self._leader.buffer
        while waiting:
            stamp, values, came = waiting[0]
            if now - came <= self.latency and any(
                    not s.held and (s.last_ns is None or s.last_ns < stamp)
                    and now - s.heard_s < SILENT_S for s in self._followers):
                break
            waiting.popleft()
            out.append((stamp, self._row(stamp, values, now), came))
        self.rows += len(out)
        return out

    def take_reset(self) -> str | None:
        """Return why the rows start anew since the last call, or None."""
        reason, self.reset_reason = self.reset_reason, None
        return reason

    def _row(self, stamp: int, values: tuple[float, ...], now: float) -> dict[str, float]:
        row = dict(zip(self._leader.channels, values, strict=True))
        complete = True
        for source in self._followers:
            found = self._at(source, stamp)
            if found is not None:
                row.update(zip(source.channels, found, strict=True))
                continue
            source.lacked += 1
            if not source.held and now - source.heard_s < SILENT_S:
                complete = False
        self.incomplete += not complete
        return {name: value for name, value in row.items() if math.isfinite(value)}

    def _at(self, source: Source, stamp: int) -> tuple[float, ...] | None:
        """Return a follower's values at a stamp, or None where there are none."""
        buffer = source.buffer
        while len(buffer) > 1 and buffer[1][0] <= stamp:
            buffer.popleft()
        if not buffer:
            return None
        before, left, _ = buffer[0]
        if before == stamp:
            return left
        if before > stamp:
            return None
        if source.held:
            return left if stamp - before <= HOLD_NS else None
        if len(buffer) == 1:
            return None
        after, right, _ = buffer[1]
        if after - before > self._span_ns:
            return None
        part = (stamp - before) / (after - before)
        return tuple(a + part * (b - a) for a, b in zip(left, right, strict=True))

    def _believe(self, source: Source, stamp: int) -> bool:
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
            self._restart(stamp, f"stamps of {source.name} jumped back by {-step / 1e9:.3f} s")
        return True

    def _restart(self, stamp: int, reason: str) -> None:
        self.reset_reason = reason
        for source in self.sources:
            source.buffer.clear()
            source.last_ns = None
            source.epoch_ns = stamp
            source.doubted = 0
