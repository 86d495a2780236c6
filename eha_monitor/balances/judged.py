"""The next recording beside a machine: the records of what of it has changed."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from eha_monitor.balances.alone import covariance_by_chance, form_and_doubts
from eha_monitor.balances.candidates import Candidate
from eha_monitor.balances.course import Course
from eha_monitor.balances.learned_curve import NAME as LEARNED
from eha_monitor.balances.learned_curve import (
    LearnedCurve,
    learned_curve,
    with_column,
    with_columns,
)
from eha_monitor.balances.policy import POLICY, Policy
from eha_monitor.balances.table import Table
from eha_monitor.balances.together import unseen
from eha_monitor.settings.rig import Rig

MUCH = 0.15  # of what came: right names leave 0.05 to 0.09 of it, wrong ones 0.24 to 0.8
MANY = 3.0  # times as much where all is fitted anew: the same, however little of the signal it is
BROKEN = 30.0  # times as much: a channel is read in another unit, with another sign, or of another
ERROR = 1.5  # times the largest of the machine's own recordings: the balance does not belong


@dataclass(frozen=True)
class Moved:
    """A parameter in the next recording.

    Attributes
    ----------
    candidate : what it is.
    here, stddev : in the recording; ``machine``, ``spread`` over the machine's own.
    deviations : Student's t; ``limit`` beyond which it has changed.
    removed : by how much the change lowers the error, as a share of the signal.
    rivals : effects that explain the recording as well.
    apart : deviation of the difference, which does not hold what both values share.
    given : under what the machine's value holds, in words.
    """

    candidate: Candidate
    here: float
    stddev: float
    machine: float
    spread: float
    deviations: float
    limit: float
    removed: float = 0.0
    rivals: tuple[str, ...] = ()
    apart: float = np.nan
    given: str = ""


@dataclass(frozen=True)
class JudgedBalance:
    """One balance of the next recording.

    Attributes
    ----------
    table : its columns, all recordings as one; ``each`` those of each.
    size : usual one of the machine's own signals, SI.
    held : the machine's parameters, those of the oil within their spread; ``now`` those with
        the changes.
    error : share of the signal that is left with the machine's parameters, those of the oil
        within their spread; ``after`` with the changes, ``usual`` the largest of the machine's
        own recordings.
    changed : what has changed, the most important first; ``complete`` nothing else has.
    largest : the term that differs most, changed or not.
    small : what explains most of the rest, where something differs surely but too little to
        matter.
    free : terms of the recording's own setting.
    alone : what is left where all terms and changes are fitted to the recording itself, over the
        most that the terms leave so of one of the machine's own.
    nearest : changes that fit best, of a balance that no numbers describe: they explain nothing.
    loose : spread of what may move beside a change: infinite of the recording's own setting, of
        the oil from one recording to the next.
    curve : what it lacks, learned from the recording.
    """

    balance: str
    table: Table
    held: dict[str, float]
    now: dict[str, float]
    error: float
    after: float
    usual: float
    changed: tuple[Moved, ...]
    complete: bool
    largest: Moved | None
    size: float
    free: tuple[str, ...] = ()
    each: tuple[Table, ...] = ()
    small: Moved | None = None
    alone: float = 0.0
    nearest: tuple[Moved, ...] = ()
    loose: dict[str, float] = field(default_factory=dict)
    curve: LearnedCurve | None = None

    @property
    def foreign(self) -> bool:
        """Whether no numbers of the machine's terms describe the recording as they do its own."""
        return self.alone > MANY

    @property
    def hollow(self) -> bool:
        """Whether its changes leave many times what healthy recordings do, and much of what came.

        A leak that grew tenfold leaves more of a rough law as well, but a twentieth of what came.
        """
        return bool(self.changed) and self.leaves_much(self.after)

    def leaves_much(self, after: float) -> bool:
        """Tell whether what then is left is much, where no numbers describe the recording."""
        return self.foreign and after > max(self.usual, MUCH * self.error)

    @property
    def settled(self) -> bool:
        """Whether its changes are what came: nothing else has, little, or less than they."""
        return (self.complete or self.after - self.usual <= POLICY.worse
                or explains(self.error, self.after, self.usual, POLICY))

    def refused(self) -> "JudgedBalance":
        """Return the balance without its changes, which are not what came.

        A speed limit was told so as a gain of the drive, surely, and play as one.
        """
        return replace(self, now=self.held, after=self.error, changed=(), complete=False,
                       small=None, nearest=self.changed)

    def with_curve(self, courses: Sequence[Course], rig: Rig, policy: Policy) -> "JudgedBalance":
        """Return the balance with what it lacks learned, where a curve over a signal explains it.

        Beside the machine's parameters, so it is what has come.
        """
        most = float(np.sqrt(self.usual**2 + policy.near * max(
            self.error**2 - self.usual**2, 0.0))) * self.table.size
        held = {name: value for name, value in self.held.items() if name in self.table.places}
        curve = learned_curve(courses, self.table, rig, held, self.loose, most, policy)
        if curve is None or self.leaves_much(curve.error / self.table.size):
            return self
        table = with_column(self.table, curve)
        now = self.held | {name: value + curve.beside.get(name, 0.0)
                           for name, value in held.items()} | {LEARNED: 1.0}
        return replace(
            self, table=table, now=now, after=left_unseen(table, now, self.free), complete=True,
            nearest=(), curve=curve, alone=0.0, each=with_columns(self.each, curve))

    def values(self, policy: Policy) -> dict[str, tuple[float, float, float]]:
        """Return the machine's parameters as the recording has them, as :class:`Judged` does.

        All together: else damping takes up the friction that came.
        """
        own = [name for name, spread in self.loose.items() if np.isinf(spread)]
        fitted = list(dict.fromkeys([
            *(name for name in self.now if name in self.table.places), *own]))
        here, chance = covariance_by_chance(self.table, fitted)
        covariance = chance + form_and_doubts(self.table, fitted, self.after, policy)
        return {name: row for name, *row in zip(
            fitted, here, np.sqrt(np.diag(covariance)).tolist(),
            np.sqrt(np.diag(chance)).tolist(), strict=True) if name in self.held}

    def with_change(self, moved: Moved) -> "JudgedBalance":
        """Return the balance with one more change of a number that the machine has."""
        name = moved.candidate.name
        held, now = self.held | {name: moved.machine}, self.now | {name: moved.here}
        error, after = (left_unseen(self.table, one, self.free) for one in (held, now))
        return replace(self, held=held, now=now, error=error, after=after,
                       changed=(*self.changed, replace(moved, removed=error - after)))


@dataclass(frozen=True)
class Judged:
    """The next recording beside the machine.

    Attributes
    ----------
    settings : the numbers of its setting, by name: (value, stddev).
    values : each of the machine's parameters, as the recording has it: (value, stddev, part of
        it that is chance).
    """

    source: str
    balances: tuple[JudgedBalance, ...]
    settings: dict[str, tuple[float, float]] = field(default_factory=dict)
    values: dict[str, tuple[float, float, float]] = field(default_factory=dict)

    @property
    def of(self) -> dict[str, Candidate]:
        """Candidates of all balances by name."""
        return {c.name: c for one in self.balances for c in one.table.candidates}

    @property
    def changed(self) -> tuple[Moved, ...]:
        """Parameters beyond what the machine's own recordings do, what explains most first."""
        return tuple(sorted((moved for one in self.balances for moved in one.changed),
                            key=lambda moved: -moved.removed))

    @property
    def small(self) -> tuple[Moved, ...]:
        """What surely differs but too little to matter, what explains most first."""
        return tuple(sorted((one.small for one in self.balances if one.small is not None),
                            key=lambda moved: -moved.removed))

    @property
    def loud(self) -> tuple[JudgedBalance, ...]:
        """Balances that leave more than any of the machine's own recordings.

        Also those that leave little, but many times what the machine's terms leave of its own
        recordings even where they are fitted anew: that no number of theirs has moved.
        """
        return tuple(one for one in self.balances if one.foreign or (is_loud(
            one.error, one.usual, one.size, one.table) and one.error - one.usual > POLICY.worse))

    @property
    def belongs(self) -> bool:
        """Whether it is like the machine's own recordings."""
        return not self.loud and all(one.complete and not one.changed for one in self.balances)

    @property
    def explained(self) -> bool:
        """Whether what has changed has names, in each balance that names any."""
        return bool(self.changed) and all(one.settled for one in self.balances if one.changed)

    def with_curves(self, courses: Sequence[Course], rig: Rig, policy: Policy) -> "Judged":
        """Return it with what the balances that stay open lack learned, where that explains it."""
        loud = {one.balance for one in self.loud if not one.changed}
        balances = tuple(one.with_curve(courses, rig, policy) if one.balance in loud else one
                         for one in self.balances)
        values = [one.values(policy) for one in balances if one.curve is not None]
        return replace(self, balances=balances, values=self.values | {
            name: row for found in values for name, row in found.items()})

    @property
    def broken(self) -> bool:
        """Whether force or flow is what no numbers come near, and no change explains.

        The machine's leave more than all of the signal, and fitted anew many times the usual.
        Both are made of the same position and pressures: a sign or a unit of one of these was a
        stiffer oil, or a drive with another law.
        """
        return any(one.alone > BROKEN and one.error > 1.0 and not one.changed
                   and one.balance != "drive" for one in self.balances)

    def apart(self) -> "Judged":
        """Return it without the names of balances that these leave open, where another's do not.

        Each balance is measured by channels of its own, and stands by itself: what a drive does
        that the config does not know hides no worn pump, and is none of its numbers.  But see
        :attr:`broken`.
        """
        if self.broken:
            return replace(self, balances=tuple(
                one.refused() if one.changed else one for one in self.balances))
        if not any(one.changed and one.settled for one in self.balances):
            return self
        return replace(self, balances=tuple(
            one if one.settled or not one.changed else one.refused() for one in self.balances))


def explains(before: float, after: float, usual: float, policy: Policy) -> bool:
    """Tell whether a change leaves less than ``open`` of the squared error beyond the usual."""
    return after**2 - usual**2 < policy.open * (before**2 - usual**2)


def is_loud(error: float, usual: float, size: float, table: Table) -> bool:
    """Tell whether a balance leaves more than any of the machine's own recordings.

    Parameters
    ----------
    error, usual : shares of this signal, and of the machine's own, whose usual size is ``size``:
        in a quiet motion the same newtons are a larger share.
    """
    return error > ERROR * max(usual * max(size / table.size, 1.0), table.floor / table.size)


def left_unseen(table: Table, weights: dict[str, float], free: Iterable[str]) -> float:
    """Return the share of the signal that parameters leave on unseen parts beside free ones."""
    known = {own: value for name, value in weights.items() for own in columns_of(name, table)}
    return unseen(table, [table.places[name] for name in known],
                  [table.places[name] for name in free if name not in known],
                  np.array(list(known.values())))


def columns_of(name: str, table: Table) -> list[str]:
    """Return the columns of a term: of a setting's number one for each of several recordings."""
    return [own for own in table.places if own == name or own.rpartition(" ")[0] == name]
