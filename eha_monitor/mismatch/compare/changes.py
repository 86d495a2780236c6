"""Which numbers have changed: the fewest that bring a run back among the healthy ones."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.compare.healthy import Healthy
from eha_monitor.mismatch.compare.runs import Reading, with_change
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit, remade, spread, with_unknowns
from eha_monitor.mismatch.name.candidates import candidate
from eha_monitor.mismatch.name.columns import ALWAYS
from eha_monitor.mismatch.name.polish import Slopes, polished
from eha_monitor.mismatch.policy import SearchPolicy
from eha_monitor.physics.effects import CATALOGUE, NAMES

MOST = 3  # numbers that change at once
LEAST, NEARLY = 5, 0.9  # numbers that are fitted: those that leave least; share of the best gain
STEPS = 60  # of a fit: priors as narrow as healthy runs are make a long way
NARROWLY = 0.3  # of the limit: by so much what is as good as the best may be beyond it
PARAMETER = 0.5  # rarity of a change of B or beta_e, between what is common and what is not


@dataclass(frozen=True)
class Explanation:
    """Numbers that have changed.

    Attributes
    ----------
    places : of the changed numbers, among those of the healthy runs.
    fit : the recording under the healthy model with these numbers free.
    reading : what it says there; ``left`` how much less likely that is of a healthy run than
        their mean, log units.
    worst : the largest t that is left, over the limit of a healthy run.
    rivals : place -> places of others that explain as much in its stead.
    """

    places: tuple[int, ...]
    fit: Fit
    reading: Reading
    left: float
    worst: float
    rivals: dict[int, tuple[int, ...]] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Whether nothing that is left goes beyond the limit of a healthy run."""
        return self.worst <= 1.0


class Comparison:
    """A recording against the healthy ones.

    Attributes
    ----------
    healthy, experiment : the recording under the healthy experiment.
    what : the numbers that may change.
    """

    def __init__(self, healthy: Healthy, experiment: Experiment):
        self.healthy, self.experiment = healthy, experiment
        self.what = healthy.runs[0].what

    @property
    def policy(self) -> SearchPolicy:
        """The numbers that decide names."""
        return self.experiment.policy

    @property
    def alike(self) -> float:
        """Log units by which what cannot be separated from the best explanation is behind it."""
        return float(-np.log(self.policy.rival))

    @cached_property
    def before(self) -> Explanation:
        """What the recording says of the healthy model."""
        return self.explaining((), with_unknowns(self.experiment, self.healthy.fit,
                                                 self.healthy.fit.unknowns))

    @property
    def changed(self) -> bool:
        """Whether the recording goes beyond what healthy runs do."""
        return not self.before.complete

    def explaining(self, places: tuple[int, ...], fit: Fit) -> Explanation:
        """Return a model with what it leaves."""
        reading = self.healthy.read(self.experiment, fit, places)
        return Explanation(places, fit, reading, *self.left_of(
            reading.amplitudes, reading.power, places))

    def left_of(self, amplitudes: np.ndarray, power: np.ndarray, places: tuple[int, ...]
                ) -> tuple[float, float]:
        """Return what amplitudes leave beside changed numbers, and its worst over the limit."""
        t = self.healthy.t_of(amplitudes, power)
        t[np.isin(self.healthy.kept, places)] = np.nan  # they are where the recording has them
        free = len(self.healthy.runs) - 1
        each = 0.5 * (free + 1) * np.log1p(t**2 / free)  # Student's density
        return (self.healthy.count * float(np.nanmean(each)),
                float(np.nanmax(np.abs(t) / self.healthy.limits, initial=0.0)))

    def moved(self, best: Explanation, place: int) -> Explanation | None:
        """Fit one number more to the recording, beside those that moved; None where none fits.

        The model's own numbers stay as healthy runs have them, each with its spread.
        """
        start = with_change(best.fit, self.what[place], best.reading.amplitudes[place])
        return self.refitted(start, (*best.places, place))

    def refitted(self, start: Fit, places: tuple[int, ...]) -> Explanation | None:
        """Fit changed numbers, see :meth:`fitted`, and say what that leaves."""
        made = self.fitted(start, places)
        return None if made is None else self.explaining(places, made)

    def fitted(self, start: Fit, places: tuple[int, ...]) -> Fit | None:
        """Fit changed numbers, the own ones held as healthy runs have them; None if none fits."""
        own, theta, active = self.healthy.own, start.theta.copy(), start.active.copy()
        entering = {self.what[i].owner for i in places if self.what[i].variant >= 0}
        for i, name in enumerate(NAMES):  # what came in with a number that is no longer there
            active[i] = active[i] and (self.healthy.fit.active[i] or name in entering)
        for i, f in zip(own.places, own.free, strict=True):
            if i not in places:
                theta[f.place] = self.healthy.fit.theta[f.place]
        wide = tuple(self.what[i].free for i in places)
        rest = [(f, held) for i, f, held in zip(
            own.places, own.free, own.held(self.healthy.fit), strict=True) if i not in places]
        free = wide + tuple(held for _, held in rest)
        made = polished(self.experiment, remade(
            self.experiment, start, theta=theta, active=active, free=free),
            Slopes(self.experiment), STEPS)
        absent = any(self.what[i].variant >= 0 and made.theta[self.what[i].free.place]
                     == self.what[i].free.prior for i in places)
        if absent or not np.isfinite(made.log_likelihood):
            return None
        return replace(made, free=wide + tuple(f for f, _ in rest))

    def explained(self) -> Explanation:
        """Return the fewest changes after which the run is like the healthy ones.

        Where no such set is found, those that each take away half of what was left.
        """
        best = self.before
        for _ in range(MOST):
            found = [one for one in spread(partial(self.moved, best), self.promising(best))
                     if one is not None]
            if not found:
                break
            first = self.chosen(found)
            if not first.complete and first.left > self.policy.likely * best.left:
                break
            best = first
            if best.complete:
                break
        return self.fewest(best)

    def share_of(self, one: Explanation) -> float:
        """Return the share of what goes beyond healthy runs that an explanation takes away."""
        return 1.0 - one.left / self.before.left

    def fewest(self, best: Explanation) -> Explanation:
        """Return an explanation less the numbers that it can do without."""
        for place in best.places[:-1] if len(best.places) > 1 else ():
            rest = tuple(i for i in best.places if i != place)
            one = self.refitted(best.fit, rest)
            if one is not None and one.complete >= best.complete and (
                    one.left < best.left + self.alike):
                best = replace(one, rivals={i: best.rivals.get(i, ()) for i in rest})
        return best

    def promising(self, best: Explanation) -> list[int]:
        """Return the own numbers, and those that leave least or gain most by the linear guess."""
        owners = {self.what[i].owner for i in best.places}
        own = [int(i) for i in self.healthy.own.places if i not in best.places]
        able = [i for i in self.healthy.kept.tolist() if i not in own and i not in best.places
                and not any(clash(self.what[i].owner, other) for other in owners)]
        mean = dict(zip(self.healthy.kept.tolist(), self.healthy.mean.tolist(), strict=True))
        off = {i: best.reading.amplitudes[i] - mean[i] for i in able
               if np.isfinite(best.reading.amplitudes[i])}
        left = ties.ordered(off, lambda i: -self.left_of(
            best.reading.without(i, off[i]), best.reading.power, (*best.places, i))[0],
            self.rarity, ties.GUESS)
        gains = {i: off[i] ** 2 * best.reading.power[i] for i in off}
        most = NEARLY * max(gains.values(), default=0.0)
        first = [*dict.fromkeys(self.starts_of(left)[:LEAST] + self.starts_of(
            [i for i in left if gains[i] > most]))]
        # Laws of one family explain one another's errors: none of them is judged without the rest.
        family = {law for i in first for law in candidate(self.what[i].owner).simple_kin}
        return [*own, *dict.fromkeys(first + self.starts_of(
            [i for i in left if self.what[i].owner in family]))]

    def starts_of(self, places: list[int]) -> list[int]:
        """Return numbers in their order, each in the first of its starts only."""
        found: dict[tuple[str, str], int] = {}
        for i in places:
            found.setdefault((self.what[i].owner, self.what[i].name), i)
        return list(found.values())

    def chosen(self, found: Sequence[Explanation]) -> Explanation:
        """Return the commonest of the explanations that are as good as the best, with the others.

        A law is right to a share of what it explains only.
        """
        best = ties.best([one for one in found if one.complete] or found,
                         lambda one: -one.left, self.plainness, ties.GUESS)
        alike = self.alike + self.policy.law * max(self.before.left - best.left, 0.0)
        near = [one for one in found if one.left <= best.left + alike
                and one.worst <= max(best.worst, 1.0) + NARROWLY]
        first = min(near, key=self.plainness)
        last = first.places[-1]
        # What cannot be separated from a complete one needs nothing more.
        worst = min(first.worst, max(best.worst, 1.0))
        return replace(first, worst=worst, rivals={**first.rivals, last: tuple(
            one.places[-1] for one in near if one.places[-1] != last)})

    def plainness(self, one: Explanation) -> tuple[float, float]:
        """Return the key that puts the commonest explanation first, then what leaves least."""
        return sum(map(self.rarity, one.places)), one.left

    def rarity(self, place: int) -> float:
        """Return how uncommon a change is; what can only grow has half the room of the others."""
        column = self.what[place]
        if column.owner == ALWAYS:
            return PARAMETER
        entry = CATALOGUE[column.owner]
        p = next(p for p in entry.parameters if p.name == column.free.symbol)
        one_way = p.lower >= p.neutral
        return entry.rarity + 0.1 * len(entry.contains) - (0.05 if one_way else 0.0)


def clash(one: str, other: str) -> bool:
    """Tell whether two numbers belong to one effect, or to two of which one has the other."""
    return one == other != ALWAYS or (
        ALWAYS not in (one, other) and candidate(one).excludes(candidate(other)))
