"""One balance of the next recording beside the machine's: the search for what has changed."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from eha_monitor import ties
from eha_monitor.balances.alone import covariance_by_chance, movement
from eha_monitor.balances.candidates import DRY, Candidate
from eha_monitor.balances.judged import (
    MANY,
    JudgedBalance,
    Moved,
    columns_of,
    explains,
    is_loud,
    left_unseen,
)
from eha_monitor.balances.least_squares import weights_of
from eha_monitor.balances.machine import Machine, MachineBalance, oil_of
from eha_monitor.balances.model import LOAD
from eha_monitor.balances.policy import Policy
from eha_monitor.balances.scatter import Amplitudes, Scatter, amplitudes_of, limit_of, ridge_of
from eha_monitor.balances.table import Table
from eha_monitor.balances.together import left_alone, setting_of, unseen
from eha_monitor.words import effect_words, listed

MOST_CHANGES = 3  # that are looked for in one balance
WEARS = "F_c"
OIL = ("compliance", "entrained_air")  # that every machine has, however little it does
OF_PLACE = ("spring_load", "position_load")  # they hold a load of their own


@dataclass(frozen=True)
class Beside:
    """A balance of the next recording beside the machine's.

    Attributes
    ----------
    held : the machine's parameters; ``free`` terms of the recording's own setting.
    loose : spread of what a setting has beside its load.
    least_soft : compliance of chamber 1 by the config's oil, m³/Pa.
    """

    one: MachineBalance
    table: Table
    held: dict[str, float]
    free: list[str]
    loose: dict[str, float]
    policy: Policy
    least_soft: float = 0.0

    @cached_property
    def of(self) -> dict[str, Candidate]:
        """Candidates by name, in their order."""
        return {c.name: c for c in self.table.candidates}

    @cached_property
    def signed(self) -> set[str]:
        """Terms whose sign is that of physics: with what the config has, never less than nil."""
        return {name for name, c in self.of.items() if c.sign}

    @cached_property
    def oil(self) -> dict[str, float]:
        """Spread of what is free within it: of the oil, and of a setting beside its load."""
        return self.loose | oil_of([p for p in self.one.parameters if p.name in self.of],
                                   self.of, self.policy)

    @cached_property
    def surely(self) -> dict[str, float]:
        """What the machine surely has, by name."""
        named = {name for family in self.one.named for name in family.terms}
        named |= {p.name for p in self.one.parameters if self.policy.sure(p.value, p.stddev)}
        return {name: value for name, value in self.held.items()
                if self.of[name].always or self.of[name].configured
                or self.of[name].effect in OIL or name in named}

    def error(self, weights: dict[str, float]) -> float:
        """Return the share of the signal that is left on unseen parts."""
        return left_unseen(self.table, weights, self.free)

    def at_best(self, weights: dict[str, float], but: Iterable[str] = ()) -> dict[str, float]:
        """Return parameters with those of the oil, ``but`` some, at what fits best."""
        oil = {name: spread for name, spread in self.oil.items() if name not in but}
        if not oil:
            return weights
        table, first = self.table, len(self.free)
        places = [table.places[name] for name in (*self.free, *oil)]
        gram = table.gram[np.ix_(places, places)]
        gram += np.diag([*np.zeros(first), *ridge_of(table, oil)])
        moved = weights_of(gram, table.gram[places] @ table.mixture(table.gram, (), weights))
        most = self.policy.varied * np.fromiter(oil.values(), float, len(oil))
        return weights | {name: weights.get(name, 0.0) + float(step) for name, step in zip(
            oil, np.clip(moved[first:], -most, most), strict=True)}

    def moved(self, scatter: Scatter, found: Amplitudes, i: int, t: float, limit: float,
              removed: float = 0.0, rivals: tuple[str, ...] = ()) -> Moved:
        """Return a term of the recording beside the machine's.

        How far the machine's goes with other shapes of its family that fit as well is in both
        the healthy and the present value, not in their difference.
        """
        c, forms = self.of[found.names[i]], self.one.form_of
        alike = {other: self.part(c, other) for other in self.held if self.of[other].adds_to(c)}
        base = sum(share * self.held[other] for other, share in alike.items())
        healthy = base + scatter.mean[i]
        if c.name in self.signed:  # less than nothing is nothing that can be told from it
            healthy = max(c.sign * healthy, c.least) * c.sign
        form = float(np.linalg.norm([share * forms.get(other, 0.0)
                                     for other, share in alike.items()]))
        spread, doubt = float(np.hypot(scatter.spread[i], form)), float(np.hypot(
            self.doubt_of(c), scatter.owed(found)[scatter.names.index(c.name)]))
        return Moved(c, base + float(found.value[i]),
                     float(np.linalg.norm((found.stddev[i], spread, doubt))),
                     healthy, spread, float(t), limit, removed, rivals,
                     float(np.linalg.norm((found.stddev[i], scatter.spread[i], doubt))))

    def doubt_of(self, one: Candidate) -> float:
        """Return how far a new term goes with the columns that stand for its one shape, SI.

        How a piston goes through a play, for example, is no number of its own: half of what its
        two columns differ by.
        """
        alike = [name for name, c in self.of.items() if c.effect == one.effect and c.exclusive
                 and c.shape == one.shape and name not in self.held]
        if len(alike) < 2 or one.name not in alike:
            return 0.0
        values = amplitudes_of(self.table, self.held, self.free, alike, self.oil).value
        return 0.5 * float(np.ptp(values[np.isfinite(values)])) if np.isfinite(
            values).any() else 0.0

    def part(self, one: Candidate, other: str) -> float:
        """Return what one unit of another column of the same quantity is of it."""
        return own_part(one.name, self.table, {other: 1.0}) if one.family == DRY else 1.0

    def search(self) -> tuple[list[Moved], dict[str, float], bool, Moved | None, Moved | None]:
        """Return what has changed: one more term at a time, until none is far.

        Also the parameters with it, whether nothing else has, the term that differs most, and
        what is surely there beside the changes but too small to matter.
        """
        one, table, policy = self.one, self.table, self.policy
        names = [name for name in one.scatter.names
                 if name in table.places and name in one.beside.names]
        scatter, beside = one.scatter.only(names), one.beside.only(names)
        left, free_oil = (amplitudes_of(table, self.held, self.free, names, spreads,
                                        one.errors_of)
                          for spreads in (self.loose, self.oil))
        first, now, changes, largest = left, dict(self.held), [], None
        while names:
            # Beyond what its own recordings do, the oil held or free within its spread.
            t, far = _farther(scatter, left, beside, free_oil, policy)
            place = ties.largest(far)
            if largest is None:
                largest = self.moved(scatter, first, place, t[place], scatter.limit[place])
            if far[place] <= 1.0:
                break
            if len(changes) == MOST_CHANGES:
                return changes, now, False, largest, None
            # That something has changed, a term shows that goes farther than healthy recordings
            # do; which it is, what explains the recording; and whether it matters, what is named.
            # What is far and removes nothing is no physics: the balance's error says whether it
            # matters.
            taken = {moved.candidate.quantity for moved in changes}
            amount, gone = self.gone(left, scatter, now, taken)
            shows = ties.largest(np.where(far > 1.0, gone, -np.inf))
            if not (far[shows] > 1.0 and gone[shows] > 0.0):
                break
            i, equal = self.chosen(left, np.where(
                far * np.array(scatter.limit) > policy.varied, gone, -np.inf))
            name, step = left.names[i], float(amount[i])
            before = self.error(self.at_best(now))
            more = now | {name: now.get(name, 0.0) + step}
            after = self.error(self.at_best(more, (name,)))
            rivals = tuple(dict.fromkeys([*self.of[name].twins, *(
                other for j in equal if j != i
                and (other := self.of[left.names[j]].effect) != self.of[name].effect)]))
            moved = self.moved(scatter, replace(left, value=scatter.mean + amount), i, t[i],
                               scatter.limit[i], before - after, rivals)
            if changes and not self.beyond(name, step, now):
                return changes, now, True, largest, None
            # Nor is it told within three of its own deviations, the form of its columns in them.
            if abs(step) < policy.varied * moved.apart or not self.matters(
                    self.owned(name), step, before, after):
                surely = abs(moved.deviations) > moved.limit
                return changes, now, True, largest, _small(moved) if surely else None
            changes.append(moved)
            now = more
            left, free_oil = (each.moved(i, step) for each in (left, free_oil))
        return changes, now, True, largest, None

    def together(self, changes: list[Moved], now: dict[str, float]
                 ) -> tuple[list[Moved], dict[str, float]]:
        """Return several changes fitted at once, beside the oil: the first was found alone.

        So another shape of it may have taken what is the next one's: one that leaves less than
        ``near`` of the squares stands in its place.  As they were found where all that leaves more
        on unseen parts, or makes one less than nothing.
        """
        found = tuple(moved.candidate.name for moved in changes)
        if len(found) < 2:
            return changes, now
        own = [name for name in self.one.scatter.names if name in self.table.places]
        sets = [found, *((*found[:i], other, *found[i + 1 :]) for i, name in enumerate(found)
                         for other in own if other not in found
                         and self.of[other].quantity == self.of[name].quantity)]
        fits = {names: self.joint(names) for names in sets}
        errors = {names: self.error(self.at_best(more, names)) for names, more in fits.items()
                  if not any(self.less_than_nothing(name, more[name]) for name in names)}
        if not errors or min(errors.values()) > self.error(self.at_best(now, found)):
            return changes, now
        best = list(errors)[ties.largest(
            -np.log(np.maximum(list(errors.values()), 1e-12)), self.policy.gain)]
        if found in errors and errors[best] ** 2 > self.policy.near * errors[found] ** 2:
            best = found  # which shape a seal's friction has, the first search has said
        scatter, made = self.one.scatter.only(own), []
        for moved, name in zip(changes, best, strict=True):
            others = [other for other in best if other != name]
            left = amplitudes_of(
                self.table, self.held, [*self.free, *others], own,
                {other: spread for other, spread in self.oil.items() if other not in best},
                self.one.errors_of)
            at = own.index(name)
            made.append(self.moved(scatter, left, at, moved.deviations, moved.limit,
                                   moved.removed, moved.rivals))
        return made, fits[best]

    def sure(self, alone: list[Moved], changes: list[Moved], now: dict[str, float]
             ) -> tuple[list[Moved], dict[str, float]]:
        """Return several changes without those that are within their own deviations.

        A second one is what the first, found alone, has left: of a leak that has grown fourfold
        0.9 +- 0.5 beside 71.

        Parameters
        ----------
        alone : the changes as they were found; ``changes``, ``now`` as fitted together.
        """
        unsure = next((moved for moved in reversed(changes[1:]) if abs(
            moved.here - moved.machine) < self.policy.varied * moved.apart), None)
        if unsure is None:
            return changes, now
        left = [moved for moved in changes if moved is not unsure]
        now = self.joint([moved.candidate.name for moved in left])
        if len(left) > 1:
            return self.sure(alone, *self.together(left, now))
        first = left[0].candidate.name
        return [next((one for one in alone if one.candidate.name == first), left[0])], now

    def joint(self, names: Sequence[str]) -> dict[str, float]:
        """Return the parameters with some of them fitted at once, beside the oil."""
        table, oil = self.table, {
            name: spread for name, spread in self.oil.items() if name not in names}
        places = [table.places[name] for name in (*names, *self.free, *oil)]
        gram = table.gram[np.ix_(places, places)]
        gram += np.diag([*np.zeros(len(places) - len(oil)), *ridge_of(table, oil)])
        steps = weights_of(gram, table.gram[places] @ table.mixture(table.gram, (), self.held))
        return self.held | {name: self.held.get(name, 0.0) + float(step)
                            for name, step in zip(names, steps, strict=False)}

    def gone(self, left: Amplitudes, scatter: Scatter, now: dict[str, float],
             taken: set[tuple[str, str]]) -> tuple[np.ndarray, np.ndarray]:
        """Return by how much each term has moved and the squares that are gone with it, (k,)."""
        amount, gone = np.array([left.gone_with(self.oil, self.policy.varied, i, mean)
                                 for i, mean in enumerate(scatter.mean)]).T
        known = np.linalg.norm([left.stddev, scatter.spread, scatter.owed(left)], axis=0)
        for i, name in enumerate(left.names):
            less = self.less_than_nothing(name, now.get(name, 0.0) + amount[i])
            if self.of[name].quantity in taken or less > self.policy.varied * known[i]:
                gone[i] = -np.inf
            amount[i] += less * self.of[name].sign  # a spring that broke is nothing at all
        return amount, gone

    def less_than_nothing(self, name: str, value: float) -> float:
        """Return by how much a term would be less than nothing, 0 if not: a leak that makes oil.

        Dry friction of one shape may be less where the machine has it in another.
        """
        c = self.of[name]
        value += sum(self.part(c, other) * self.held[other] for other in self.held
                     if other != name and self.of[other].adds_to(c))
        return max(c.least - c.sign * value, 0.0) if name in self.signed else 0.0

    def chosen(self, left: Amplitudes, removed: np.ndarray) -> tuple[int, list[int]]:
        """Return the term that explains a recording, and those that remove nearly as much.

        Of what leaves the same, a number that the machine has comes first, then what stands first
        among the candidates.  But a seal wears before a load or a spring comes to a machine; its
        oil is another matter.

        Parameters
        ----------
        removed : (k,) squares that are gone with each term.
        """
        alone, order = self.policy.alone, list(self.of)
        most = float(removed.max())
        _, squares = left.gone_with(self.oil, self.policy.varied)
        by_oil = min(max(squares, 0.0), most)  # which is free beside each
        equal = [i for i in range(len(removed)) if removed[i] - by_oil >= (
            most - by_oil) * np.exp(-2.0 * alone)]
        least = max(left.left - most, self.table.n * self.table.floor**2) * np.exp(2.0 * alone)
        i = min((i for i in equal if left.left - removed[i] <= least), key=lambda i: (
            left.names[i] != WEARS, left.names[i] not in self.held, order.index(left.names[i])))
        if not self.of[left.names[i]].of_oil:
            i = next((j for j in equal if left.names[j] == WEARS), i)
        return i, equal

    def owned(self, name: str) -> float:
        """Return what the machine has of a term's family, by that term, with the config's, SI.

        Every chamber is as compliant as its oil: where timing or noise hides it, as the config's.
        """
        c = self.of[name]
        return max(own_part(name, self.table, self.surely) + c.configured,
                   self.least_soft if c.effect == OIL[0] else -np.inf)

    def matters(self, own: float, step: float, before: float, after: float) -> bool:
        """Tell whether a machine is repaired for a change.

        Parameters
        ----------
        own : what the machine has of it; ``step`` by how much that has moved, SI.
        before, after : share of the signal that is left without and with it.
        """
        policy, usual, own = self.policy, max(self.one.held), abs(own)
        return abs(step) > policy.worse * own and (
            before - after > policy.worse or abs(step) > policy.near * own > 0.0
            or (is_loud(before, usual, self.one.size, self.table)
                and explains(before, after, usual, policy)))

    def beyond(self, name: str, step: float, now: dict[str, float]) -> bool:
        """Tell whether one more change explains what a refit of those before it does not.

        All terms of the balance are free there, and the first change's with them: else the
        second one is what the first, beside the machine's held terms, has left.
        """
        table, own = self.table, set(columns_of(name, self.table))
        others = [other for other in (*now, *self.free) if other not in own]
        places = [table.places[other] for other in dict.fromkeys(others)]
        mine = [table.places[other] for other in own]
        before = unseen(table, mine, places, np.full(len(mine), now.get(name, 0.0)))
        after = unseen(table, [], [*mine, *places], np.zeros(0))
        return self.matters(self.owned(name), step, before, after)

    def instead_of(self, load: Moved) -> tuple[str, ...]:
        """Return the effects that explain as much of a recording as a constant load has moved.

        By the terms of the balance alone, beside the oil: the load is free while they are looked
        for, so each of them is shown only what no load can take up.
        """
        table, own = self.table, columns_of(load.candidate.name, self.table)
        names = [name for name in self.one.scatter.names if name in table.places]
        if len(own) > 1:  # the loads of several recordings are no one column
            return ()
        left = amplitudes_of(table, self.held, self.free, [*own, *names], self.oil)
        gone = np.array([left.gone_with(self.oil, self.policy.varied, i)[1]
                         for i in range(len(left.names))])
        by_oil = max(left.gone_with(self.oil, self.policy.varied)[1], 0.0)
        as_much = gone - by_oil >= (gone[0] - by_oil) * np.exp(-2.0 * self.policy.alone)
        return tuple(dict.fromkeys(
            self.of[name].effect for name, amount, there in zip(
                names, left.value[1:], as_much[1:], strict=True)
            if there and not self.less_than_nothing(
                name, self.held.get(name, 0.0) + amount)))

    def holds(self, moved: Moved, load: Moved) -> bool:
        """Tell whether a load over the stroke has changed by as much as half the constant one."""
        if moved.candidate.effect not in OF_PLACE:
            return False
        table, name = self.table, moved.candidate.name
        most = max(float(np.abs(table.rows[table.good, table.places[own]]).max())
                   for own in columns_of(name, table))
        return most * abs(moved.here - moved.machine) >= 0.5 * abs(load.here - load.machine)

    def columns(self, names: Iterable[str]) -> list[str]:
        """Return the columns of terms, in the order of their names."""
        return [column for name in sorted(names) for column in columns_of(name, self.table)]

    def times(self, names: Iterable[str]) -> float:
        """Return what terms leave, fitted anew, over the most of one of the machine's own."""
        return left_alone(self.table, self.columns(names)) / max(
            *self.one.alone, self.table.floor) if self.one.alone else 0.0

    def newcomer(self, names: Iterable[str]) -> Moved | None:
        """Return the one term beside which the machine's, fitted anew, describe a recording.

        What healthy recordings leave with the machine's numbers may be more than all of it: the
        error says nothing of it then, and what a fit of all terms leaves does.
        """
        table, scatter, policy = self.table, self.one.scatter, self.policy
        tried = [name for name in scatter.names if name in table.places and name not in names]
        if not tried:
            return None
        left = np.array([self.times({*names, name}) for name in tried])
        at = ties.largest(-np.log(np.maximum(left, 1e-12)), policy.gain)
        if left[at] > MANY:
            return None
        name, place = tried[at], scatter.names.index(tried[at])
        columns = [name, *self.columns(names)]
        value, chance = covariance_by_chance(table, columns)
        here, mean = float(value[0]), float(scatter.mean[place])
        # Areas and lateness are the same in all recordings of a machine.
        apart = float(np.sqrt(chance[0, 0] + scatter.spread[place] ** 2))
        # The limit guards against one of many names that happens to be far off; where one alone
        # leaves as little as healthy recordings do, that something has come is no question.
        t, limit = (here - mean) / apart, float(scatter.limit[place])
        owed = policy.owed if left[at] <= 1.0 else max(limit, policy.owed)
        if not abs(t) > owed or self.less_than_nothing(name, here) > 0.0:
            return None
        rivals = tuple(dict.fromkeys([*self.of[name].twins, *(
            self.of[other].effect for other, rest in zip(tried, left, strict=True)
            if other != name and rest <= left[at] * np.exp(policy.alone)
            and self.of[other].effect != self.of[name].effect)]))
        apart = float(np.hypot(apart, self.doubt_of(self.of[name])))
        return Moved(self.of[name], here, apart, mean, float(scatter.spread[place]), float(t),
                     limit, rivals=rivals, apart=apart)

    def judged(self, machine: Machine) -> JudgedBalance:
        """Return what has changed in the balance, its constant load last, beside all else."""
        one, table, free = self.one, self.table, self.free
        changes, now, complete, largest, small = self.search()
        changes, now = self.sure(changes, *self.together(changes, now))
        now = self.at_best(now, {moved.candidate.name for moved in changes})
        load, held = _load(machine, one, table, now, free), self.held
        if load is not None and not any(self.holds(moved, load) for moved in changes):
            name = load.candidate.name
            beside = replace(self, held=held | {name: load.machine}, free=[
                own for own in free if own not in columns_of(name, table)])
            held, free, now = beside.held, beside.free, now | {name: load.here}
            others = beside.instead_of(load)
            load = replace(load, rivals=(*load.rivals, *others), given=", which cannot be told "
                           f"here from {listed([*map(effect_words, others)], 'or')}" if others
                           else "")
            before, after = beside.error(held), beside.error(now)
            own = load.machine + load.candidate.configured
            if self.matters(own, load.here - load.machine, before, after):
                changes.append(replace(load, removed=before - after))
            else:
                held, free, now = self.held, self.free, {
                    own: value for own, value in now.items() if own != name}
                small = small or _small(load)
        last = replace(self, held=held, free=free)
        held = last.at_best(held)
        error, after, usual = last.error(held), last.error(now), max(one.held)
        if changes and error > usual and not explains(error, after, usual, self.policy):
            # What leaves most of what came is not what came.
            small, complete = small or _small(changes[0]), error - usual <= self.policy.worse
            changes, now, after = [], held, error
        return JudgedBalance(one.balance, table, held, now, error, after, usual, tuple(changes),
                             complete, largest, one.size, tuple(free), small=small,
                             loose=dict.fromkeys(self.free, np.inf) | self.oil)


def _small(moved: Moved) -> Moved:
    """Return what surely differs but too little to matter, with the difference's deviation."""
    return replace(moved, apart=abs(moved.here - moved.machine) / max(
        abs(moved.deviations), 1e-300))


def _farther(scatter: Scatter, left: Amplitudes, beside: Scatter, loose: Amplitudes,
             policy: Policy) -> tuple[np.ndarray, np.ndarray]:
    """Return Student's t of each term, (k,), and how far it is in limits, by what says more.

    Beyond 1 it is farther than a healthy recording goes, and than this one's own deviations.
    """
    rows = []
    for own, found in ((scatter, left), (beside, loose)):
        t, mean = own.t_of(found), np.array(own.mean)
        known = np.abs(found.value - mean) > policy.varied * np.hypot(
            found.stddev, own.owed(found))
        limits = np.abs(t) / np.array(own.limit)
        rows.append((t * np.array(scatter.limit) / np.array(own.limit),
                     np.where(np.isfinite(t) & known, limits, 0.0)))
    (t, far), (other, farther) = rows
    return np.where(farther > far, other, t), np.maximum(far, farther)


def own_part(name: str, table: Table, held: dict[str, float]) -> float:
    """Return what the machine has of a term's family, by that term, SI.

    Its dry friction may have another shape, its oil be written as air: what they make, projected
    on the term's column over the motion.
    """
    of = {c.name: c for c in table.candidates}
    family = [other for other in held if of[other].kind == of[name].kind]
    place = table.places[name]
    return sum(held[other] * table.gram[place, table.places[other]] for other in family) / max(
        float(table.gram[place, place]), 1e-300)


def _load(machine: Machine, one: MachineBalance, table: Table, now: dict[str, float],
          free: list[str]) -> Moved | None:
    """Return the constant load where it differs from those of the machine's recordings.

    By more than they differ among themselves; or the zero of a pressure sensor does.
    """
    load = next((s for s in one.settings if s.effect == LOAD), None)
    own = [] if load is None else [name for name in columns_of(load.name, table) if name in free]
    if not own:
        return None
    policy, runs = machine.policy, len(load.value)
    found, stddevs = setting_of(
        table, [table.places[name] for name in now], [table.places[name] for name in free],
        np.array(list(now.values())))
    rows = [free.index(name) for name in own]
    here, stddev = float(found[rows].mean()), float(np.sqrt(np.mean(stddevs[rows] ** 2)))
    mean = float(np.mean(load.value))
    spread = float(np.hypot(np.std(load.value, ddof=1), machine.pieces * policy.between * mean))
    # Areas that are off are off in all recordings: by what the pressures differ, and no more.
    shared = movement(table, own).mean(axis=0) - np.mean(load.doubts, axis=0) if (
        load.doubts) else np.zeros(1)
    apart = float(np.linalg.norm((
        max(spread, float(np.median(load.own_stddev))) * np.sqrt(1.0 + 1.0 / runs), stddev,
        *shared)))
    t = (here - mean) / apart
    limit = limit_of(runs, 1.0, policy.false)
    if not abs(t) > limit or not abs(here - mean) > policy.worse * table.size:
        return None
    c = replace(table.candidates[table.places[own[0]] - 1], name=load.name)
    spread = max(spread, float(np.median(load.stddev)))
    return Moved(c, here, float(np.hypot(stddev, spread)), mean, spread, float(t), limit, 0.0,
                 c.twins, apart)
