"""Whether something disturbed a recording for a while: a push, a sensor that was off.

Between two moments the residual of a balance, under the model of the rest, has a variance of its
own: the two-variance normal likelihood (Inclan and Tiao 1994, for changes of variance) is largest
for the interval of the event.  It is one where

- the config's linear model leaves of the rest less than ``small`` of what it leaves there, and of
  the whole more than ``worse``; of several, one after the other, what is left in the end;
- it takes less than half of the recording, with ``LEAST`` of it on either side: the majority is
  the machine, and what stays until the end is another state of it (:mod:`change_point`);
- in the order of speed, position or acceleration (of pressure, in the flow) no interval gains as
  much, by ``alone``: what goes with the motion is a law that is missing, and not an event.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from eha_monitor import ties
from eha_monitor.balances.candidates import PLAIN, SIDES, Scale, candidates_of
from eha_monitor.balances.change_point import LEAST, blanked, motion_of
from eha_monitor.balances.course import Course
from eha_monitor.balances.policy import POLICY, Policy
from eha_monitor.balances.table import Table, tables_of
from eha_monitor.mismatch.diagnosis import Event
from eha_monitor.quantity import number, quantity
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

SHORTEST, MOST = 0.25, 96  # s of a block, and blocks of a recording
FEWEST = 12  # blocks of which some are an exception
SEVERAL = 3  # events of a recording, the largest first


def without_events(recordings: Sequence[Recording], settings: Settings, policy: Policy = POLICY
                   ) -> tuple[list[Recording], tuple[Event, ...]]:
    """Return recordings without what disturbed them for a while, and when that was.

    What is left out is not a number there: the recording keeps its time.
    """
    kept, found = [], []
    for recording in recordings:
        events, time = events_in(recording, settings, policy), recording.time
        if events:
            there = np.any([(time >= one.start_s) & (time <= one.stop_s) for one in events],
                           axis=0)
            recording = blanked(recording, there)
        found += events
        kept.append(recording)
    return kept, tuple(found)


def events_in(recording: Recording, settings: Settings, policy: Policy = POLICY) -> list[Event]:
    """Return what disturbed a recording, in order of time; nothing without a force balance.

    Where force and flow are off at one time, the one that is off more times as much as else.
    """
    rig, course = settings.rig, motion_of(recording, settings, policy)
    if course is None:
        return []
    events: list[Event] = []
    for balance in ("force", "flow"):
        plain = tuple(one for one in candidates_of(balance, Scale.of([course]), rig)
                      if one.name in PLAIN)
        if balance == "flow" and not course.has_flow:
            continue
        (table,) = tables_of([course], rig, balance, plain, policy)
        events += _Parts(table, course).events(policy) if table.n else []
    found = []
    for one in sorted(events, key=lambda one: -one.times):
        same = next((other for other in found if one.start_s < other.stop_s
                     and one.stop_s > other.start_s), None)
        if same is None:
            found.append(one)
        elif one.balance != same.balance:
            found[found.index(same)] = replace(same, also=(one.balance,))
    return sorted(found, key=lambda one: one.start_s)


class _Parts:
    """One balance of a recording in short blocks of time."""

    def __init__(self, table: Table, course: Course):
        self.table, self.course = table, course
        time = np.arange(len(table.rows)) * table.dt
        self.length = max(SHORTEST, time[-1] / MOST)
        self.numbers, self.place = np.unique(
            (time[table.good] / self.length).astype(int), return_inverse=True)
        rows, count = table.rows[table.good], len(self.numbers)
        self.count = np.bincount(self.place, minlength=count).astype(float)
        self.blocks = np.zeros((count, rows.shape[1], rows.shape[1]))
        np.add.at(self.blocks, self.place, rows[:, :, None] * rows[:, None, :])
        self.sums = np.zeros((count, rows.shape[1]))
        np.add.at(self.sums, self.place, rows)

    def events(self, policy: Policy) -> list[Event]:
        """Return what stands out once at most ``SEVERAL`` intervals have left the rest closed."""
        blocks = len(self.numbers)
        if blocks < FEWEST:
            return []
        left = np.arange(blocks)
        for _ in range(SEVERAL):
            gain, (i, j), rest, there, mixture = self.best(left)
            whole = np.sqrt(np.average([rest**2, there**2], weights=[
                self.count.sum() - self.count[left[i:j]].sum(), self.count[left[i:j]].sum()]))
            if whole < policy.worse * self.table.size or any(
                    gain <= self.best(order)[0] + policy.alone for order in self.orders(left)):
                return []
            left = np.delete(left, slice(i, j))
            if len(left) < max(FEWEST, 0.5 * blocks):
                return []
            if rest < policy.small * there:  # closed: what is loud under its model is an event
                loud = np.flatnonzero(np.sqrt(_squares(mixture[None], self.blocks) / self.count)
                                      > rest / policy.small)
                runs = np.split(loud, np.flatnonzero(np.diff(loud) > 2) + 1)
                inside = LEAST * blocks <= loud[0] and loud[-1] < (1.0 - LEAST) * blocks
                return [self.event(np.arange(run[0], run[-1] + 1), mixture, rest)
                        for run in runs] if inside else []
        return []

    def event(self, run: np.ndarray, mixture: np.ndarray, rest: float) -> Event:
        """Return the record of neighbouring blocks beside a rest of that rms."""
        table = self.table
        there = float(np.sqrt(_squares(mixture[None], self.blocks[run].sum(axis=0)[None])[0]
                              / self.count[run].sum()))
        # What begins and ends is less than what is there in between.
        middle = run[1:-1] if len(run) > 2 else run
        mean = float(mixture @ self.sums[middle].sum(axis=0) / self.count[middle].sum())
        # The band smears what begins and ends over one of its periods.
        margin = 1.0 / self.course.band
        start = max(float(self.numbers[run[0]] * self.length) - margin, 0.0)
        stop = float((self.numbers[run[-1]] + 1) * self.length) + margin
        times, unit = there / max(rest, table.floor), SIDES[table.balance]
        event = Event(table.source, start, stop, table.balance, there, mean, times, (
            f"at {start:.1f}–{stop:.1f} s the {table.balance} is off by "
            f"{quantity(there, unit, 2)} (root mean square), {number(times, 2)} times as much as "
            "else: a push, a stop or a disturbed sensor"),
            by_pressures=self.course.p1 is not None)
        if not event.is_load:
            return event
        return replace(event, statement=(
            f"at {start:.1f}–{stop:.1f} s a load of {quantity(mean, unit, 2)} on average acts "
            "against positive motion, and else none"))

    def best(self, order: np.ndarray) -> tuple[float, tuple[int, int], float, float, np.ndarray]:
        """Return the interval of blocks, in an order, that is most unlike the rest.

        Returns
        -------
        gain : log units a sample over one variance for all.
        interval : first block of it, and the first behind.
        rest, there : rms of the residual, under the model of the rest.
        mixture : (1 + k,) of the columns that the model of the rest leaves.
        """
        blocks, count = self.blocks[order], self.count[order]
        sums = np.concatenate([np.zeros((1, *blocks.shape[1:])), np.cumsum(blocks, axis=0)])
        n = np.concatenate([[0.0], np.cumsum(count)])
        i, j = np.triu_indices(len(n), 1)
        inner = n[j] - n[i]
        kept = 2.0 * inner <= n[-1]
        i, j, inner = i[kept], j[kept], inner[kept]
        within, outer = sums[j] - sums[i], n[-1] - inner
        w = _mixtures(sums[-1] - within)
        least = max(self.table.floor, 1e-9 * self.table.size) ** 2
        rest = np.maximum(_squares(w, sums[-1] - within) / outer, least)
        there = np.maximum(_squares(w, within) / inner, least)
        first = _mixtures(sums[-1:])
        all_ = max(float(_squares(first, sums[-1:])[0]) / n[-1], least)
        gain = 0.5 * (np.log(all_) - (outer * np.log(rest) + inner * np.log(there)) / n[-1])
        gain[there <= rest] = -np.inf
        at = ties.largest(gain)
        return (float(gain[at]), (int(i[at]), int(j[at])), float(np.sqrt(rest[at])),
                float(np.sqrt(there[at])), w[at])

    def orders(self, left: np.ndarray) -> Iterator[np.ndarray]:
        """Yield those blocks that are left in the order of what a missing law may go with."""
        course, good = self.course, self.table.good
        signals = [np.square(course.v), course.x, np.square(course.a)]
        if self.table.balance == "flow" and course.p1 is not None and course.p2 is not None:
            signals += [np.square(course.p1 - course.p2), course.p1 + course.p2]
        for values in signals:
            mean = np.bincount(self.place, course.compared(values)[good]) / self.count
            yield left[np.argsort(mean[left], kind="stable")]


def _mixtures(grams: np.ndarray) -> np.ndarray:
    """Return 1 of y and -w of each column by least squares, for products (n, 1 + k, 1 + k)."""
    size = np.sqrt(np.maximum(np.diagonal(grams, axis1=1, axis2=2)[:, 1:], 1e-300))
    scaled = grams[:, 1:, 1:] / (size[:, :, None] * size[:, None, :])
    scaled = scaled + 1e-9 * np.eye(size.shape[1])
    w = np.linalg.solve(scaled, (grams[:, 1:, 0] / size)[:, :, None])[:, :, 0] / size
    return np.concatenate([np.ones((len(w), 1)), -w], axis=1)


def _squares(mixtures: np.ndarray, grams: np.ndarray) -> np.ndarray:
    return np.maximum(np.einsum("ni,nij,nj->n", mixtures, grams, mixtures), 0.0)
