"""Whether something disturbed a recording for a while: a push, a sensor that was off.

Between two moments the residual of a balance, under the model of the rest, has a variance of its
own: the two-variance normal likelihood (Inclan and Tiao 1994, for changes of variance) is largest
for the interval of the event.  It is one where

- the config's linear model leaves of the rest less than ``small`` of what it leaves there, and of
  the whole more than ``worse``;
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
from eha_monitor.balances.change_point import LEAST
from eha_monitor.balances.course import Course
from eha_monitor.balances.measured import course_of
from eha_monitor.balances.policy import POLICY, Policy
from eha_monitor.balances.table import Table, tables_of
from eha_monitor.balances.together import of_one_machine
from eha_monitor.errors import InputError
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
        for _ in range(SEVERAL):
            event = event_in(recording, settings, policy)
            if event is None:
                break
            found.append(event)
            there = (recording.time >= event.start_s) & (recording.time <= event.stop_s)
            recording = replace(recording, channels={
                name: np.where(there, np.nan, values)
                for name, values in recording.channels.items()})
        kept.append(recording)
    return kept, tuple(sorted(found, key=lambda one: (one.bag, one.start_s)))


def event_in(recording: Recording, settings: Settings, policy: Policy = POLICY) -> Event | None:
    """Return the event that stands out most, None where there is none, or no force balance."""
    rig = settings.rig
    try:
        course = course_of(recording, settings)
    except InputError:
        return None
    if not course.shows:
        return None
    (course,) = of_one_machine([course], rig, policy)
    found = []
    for balance in ("force", "flow"):
        plain = tuple(one for one in candidates_of(balance, Scale.of([course]), rig)
                      if one.name in PLAIN)
        if balance == "flow" and course.omega is None:
            continue
        (table,) = tables_of([course], rig, balance, plain, policy)
        event = _Parts(table, course).event(policy) if table.n else None
        if event is not None:
            found.append(event)
    largest = max(found, key=lambda one: one.times, default=None)
    also = tuple(one.balance for one in found if one is not largest
                 and one.start_s < largest.stop_s and one.stop_s > largest.start_s)
    return largest and replace(largest, also=also)


class _Parts:
    """One balance of a recording in short blocks of time."""

    def __init__(self, table: Table, course: Course):
        self.table, self.course = table, course
        time = np.arange(len(table.rows)) * table.dt
        self.length = max(SHORTEST, time[-1] / MOST)
        self.which = (time / self.length).astype(int)
        self.here = self.which[table.good]
        self.numbers, place = np.unique(self.here, return_inverse=True)
        rows, count = table.rows[table.good], len(self.numbers)
        self.count = np.bincount(place, minlength=count).astype(float)
        self.place = place
        self.blocks = np.zeros((count, rows.shape[1], rows.shape[1]))
        np.add.at(self.blocks, place, rows[:, :, None] * rows[:, None, :])
        self.sums = np.zeros((count, rows.shape[1]))
        np.add.at(self.sums, place, rows)

    def event(self, policy: Policy) -> Event | None:
        """Return the interval of an event, if one stands out."""
        table, blocks = self.table, len(self.numbers)
        if blocks < FEWEST:
            return None
        gain, (i, j), rest, there, mean = self.best(np.arange(blocks))
        if min(i, blocks - j) < LEAST * blocks or not rest < policy.small * there:
            return None
        whole = np.sqrt((there**2 * self.count[i:j].sum() + rest**2 * (
            self.count.sum() - self.count[i:j].sum())) / self.count.sum())
        if whole < policy.worse * table.size or any(
                gain <= self.best(order)[0] + policy.alone for order in self.orders()):
            return None
        # The band smears what begins and ends over one of its periods.
        margin = 1.0 / self.course.band
        start = max(self.numbers[i] * self.length - margin, 0.0)
        stop = (self.numbers[j - 1] + 1) * self.length + margin
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

    def best(self, order: np.ndarray) -> tuple[float, tuple[int, int], float, float, float]:
        """Return the interval of blocks, in an order, that is most unlike the rest.

        Returns
        -------
        gain : log units a sample over one variance for all.
        interval : first block of it, and the first behind.
        rest, there : rms of the residual, under the model of the rest.
        mean : of the residual in the interval, without its first and last block.
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
        # What begins and ends is less than what is there in between.
        middle = order[i[at]:j[at]][1:-1] if j[at] - i[at] > 2 else order[i[at]:j[at]]
        mean = float(w[at] @ self.sums[middle].sum(axis=0)) / float(self.count[middle].sum())
        return (float(gain[at]), (int(i[at]), int(j[at])), float(np.sqrt(rest[at])),
                float(np.sqrt(there[at])), mean)

    def orders(self) -> Iterator[np.ndarray]:
        """Yield the blocks in the order of what a missing law may go with."""
        course, good = self.course, self.table.good
        signals = [np.square(course.v), course.x, np.square(course.a)]
        if self.table.balance == "flow" and course.p1 is not None and course.p2 is not None:
            signals += [np.square(course.p1 - course.p2), course.p1 + course.p2]
        for values in signals:
            mean = np.bincount(self.place, course.compared(values)[good]) / self.count
            yield np.argsort(mean, kind="stable")


def _mixtures(grams: np.ndarray) -> np.ndarray:
    """Return 1 of y and -w of each column by least squares, for products (n, 1 + k, 1 + k)."""
    size = np.sqrt(np.maximum(np.diagonal(grams, axis1=1, axis2=2)[:, 1:], 1e-300))
    scaled = grams[:, 1:, 1:] / (size[:, :, None] * size[:, None, :])
    scaled = scaled + 1e-9 * np.eye(size.shape[1])
    w = np.linalg.solve(scaled, (grams[:, 1:, 0] / size)[:, :, None])[:, :, 0] / size
    return np.concatenate([np.ones((len(w), 1)), -w], axis=1)


def _squares(mixtures: np.ndarray, grams: np.ndarray) -> np.ndarray:
    return np.maximum(np.einsum("ni,nij,nj->n", mixtures, grams, mixtures), 0.0)
