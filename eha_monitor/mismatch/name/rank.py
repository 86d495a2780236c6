"""Evidence of every set of suspects from one Gram matrix, and a beam over the sets.

With innovations r, columns D in units of their priors, prior means m and amplitudes a,

    -log posterior = 1/2 |r + D a|^2 + 1/2 |a - m|^2 + const,
    log evidence   = -1/2 (r'r + m'm - q'(G + 1)^-1 q) - 1/2 log det(G + 1) - sum log det S / 2,

G = D'D, q = m - D'r: Laplace's approximation, exact where the model is linear.  What every model
has is taken out once a level (a Schur complement); a set is then a solve of its few columns.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from eha_monitor import ties
from eha_monitor.mismatch.likelihood.fit import spread
from eha_monitor.mismatch.name.candidates import candidate
from eha_monitor.mismatch.name.columns import ALWAYS, ASTRAY_OWNER, Column
from eha_monitor.mismatch.name.gram import Gram
from eha_monitor.mismatch.policy import SearchPolicy
from eha_monitor.physics.effects import CATALOGUE

LARGEST_SET = 4  # suspects in a set
BEAM = 30  # sets that are carried on
NEXT = 3  # sets that grow out of each part of the model, however far behind
PASSES = 4  # of a solution within bounds


class Member(NamedTuple):
    """A suspect in a set: an owner at one of its starts, or as the model has it (-1).

    ``replaces`` : effect of the model that it contains and grows out of; both are in the set.
    """

    owner: str
    variant: int
    replaces: str = ""


@dataclass(frozen=True)
class Ranked:
    """A set with its evidence, by the linear guess."""

    members: tuple[Member, ...]  # sorted
    evidence: float  # log units, ``prior`` odds included; comparable at one linearisation
    prior: float
    gram: Gram = field(repr=False, compare=False)  # of the level that suits it best
    # Column's place (in ``what``) -> amplitude
    amplitudes: dict[int, float] = field(repr=False, compare=False)

    @property
    def names(self) -> frozenset[str]:
        """Owners in the set."""
        return frozenset(member.owner for member in self.members) - {
            member.replaces for member in self.members}


class Ranking:
    """The columns of one linearisation, grouped by suspect."""

    def __init__(self, what: tuple[Column, ...], named: tuple[str, ...], policy: SearchPolicy):
        self.what, self.named, self.policy = what, named, policy
        self.always = np.array([i for i, c in enumerate(what) if c.owner == ALWAYS], dtype=int)
        groups: dict[Member, list[int]] = {}
        for i, column in enumerate(what):
            if column.owner not in (ALWAYS, ASTRAY_OWNER):
                replaces = column.start.replaces if column.start else ""
                groups.setdefault(Member(column.owner, column.variant, replaces), []).append(i)
        for name in named:
            groups.setdefault(Member(name, -1), [])
        self.groups = {member: np.array(places, dtype=int) for member, places in groups.items()}
        self.starts: dict[str, int] = {}
        for member in groups:
            if not member.replaces:
                self.starts[member.owner] = self.starts.get(member.owner, 0) + 1
        self.order = {member: i for i, member in enumerate(self.groups)}
        self.growing = [(i, one) for i, one in enumerate(groups) if one.replaces]
        self.standing = np.array([not one.replaces for one in groups], dtype=bool)
        of, square = [candidate(one.owner) for one in groups], (len(groups),) * 2
        self.same = np.array([[two.name in (one.name, one.equals) for two in of]
                              for one in of], dtype=bool).reshape(square)
        self.excluded = self.same | np.array(
            [[two.replaces != one.name and one.excludes(other)
              for two, other in zip(groups, of, strict=True)] for one in of],
            dtype=bool).reshape(square)
        self.centre = np.array([c.centre for c in what])
        self.lower = np.array([c.lower for c in what])
        self.upper = np.array([c.upper for c in what])
        self.size = np.array([c.size for c in what], dtype=bool)
        self.members = list(groups)
        # Odds that a suspect brings; those of what it replaces are in the set already.
        self.odds = np.array([self.log_prior(member) - (
            self.log_prior(Member(member.replaces, -1)) if member.replaces else 0.0)
            for member in groups])
        # Columns of all suspects, one after the other, and which of them is whose by number.
        self.owned = np.concatenate([np.zeros(0, dtype=int), *self.groups.values()]).astype(int)
        counts = np.array([len(places) for places in groups.values()], dtype=int)
        first = np.cumsum(counts) - counts
        self.blocks = []
        for k in sorted(set(counts.tolist())):
            suspects = np.flatnonzero(counts == k)
            self.blocks.append((first[suspects][:, None] + np.arange(k), suspects))

    def log_prior(self, member: Member) -> float:
        """Return the logarithm of a suspect's prior odds."""
        several = (np.log(self.starts[member.owner]) if member.variant >= 0
                   and not member.replaces and member.owner in CATALOGUE else 0.0)
        return candidate(member.owner).log_odds(self.policy) - several

    def roots(self) -> list[tuple[Member, ...]]:
        """Return the subsets of what the model has, each a set to begin with.

        A limit cannot be taken away by a linear guess: it has no size that goes to nil.  Nor can
        what has lost a column, since the model runs away a little beside where it stands.
        """
        have = [Member(name, -1) for name in self.named]
        lost = {c.name.partition(".")[0] for c in self.what
                if c.owner == ASTRAY_OWNER and c.variant < 0 and c.size}
        kept = tuple(member for member in have if candidate(member.owner).limit
                     or not len(self.groups[member]) or member.owner in lost)
        free = [member for member in have if member not in kept]
        return [tuple(sorted((*kept, *subset))) for k in range(len(free) + 1)
                for subset in combinations(free, k)]

    def joining(self, members: tuple[Member, ...]) -> np.ndarray:
        """Return which suspects can join a set, bool, in the order of ``groups``.

        One of a kind, and none that another contains.  What grows out of an effect of the model
        needs it in the set, and stands in its place.
        """
        gone = {member.replaces for member in members if member.replaces}
        able = self.standing.copy()
        for i, one in self.growing:
            able[i] = one.replaces not in gone and Member(one.replaces, -1) in members
        for member in members:
            row = self.order[member]
            able &= ~(self.same if member.owner in gone else self.excluded)[row]
        return able

    def at_level(self, gram: Gram, more: int = LARGEST_SET) -> list[Ranked]:
        """Return the best sets at one level, best first; ``more`` suspects join at most."""
        level = Level(self, gram)
        found: dict[tuple[Member, ...], Ranked] = {}
        beam, roots = [], self.roots()
        for root in roots:
            one = level.evaluated(root)
            if one is not None:
                found[one.members] = one
                beam.append(one)
        for _ in range(more):
            grown: dict[tuple[Member, ...], float] = {}
            kept: list[tuple[Member, ...]] = []
            for one in best_first(beam)[:BEAM]:
                if len(one.members) >= LARGEST_SET:
                    continue
                own = {}
                for member, gain in level.gains(one):
                    key = tuple(sorted((*one.members, member)))
                    own[key] = one.evidence + gain
                    grown[key] = max(grown.get(key, -np.inf), own[key])
                if one.members in roots:  # what comes next in the place of what the model has
                    kept += by_gain(own)[:NEXT]
            best = kept + by_gain(grown)
            beam = []
            for key in best:
                if len(beam) >= BEAM + len(kept):
                    break
                if key in found:
                    continue
                one = level.evaluated(key)
                if one is not None:
                    found[key] = one
                    beam.append(one)
            if not beam:
                break
        return best_first(found.values())


@dataclass(frozen=True)
class Reduced:
    """Products with what every model has taken out; its rows and columns are r, then ``what``."""

    products: np.ndarray  # (1 + m, 1 + m) of what is left
    back: np.ndarray  # (a, 1 + m) amplitudes of what every model has, per unit of each
    free: np.ndarray  # (a,) places of these
    fixed: tuple[tuple[int, float], ...]  # (place, amplitude) of those that are held
    logdet: float  # sum of the logarithms of the factor's diagonal


class Level:
    """Evidence of sets at one level of the unknowns."""

    def __init__(self, ranking: Ranking, gram: Gram):
        self.ranking, self.gram = ranking, gram
        # A column that runs away under this level's gains says nothing.
        good = np.isfinite(np.diag(gram.products))
        self.whole = np.where(good[:, None] & good, gram.products, 0.0)
        self._reduced: dict[tuple[tuple[int, float], ...], Reduced | None] = {}

    def reduced(self, fixed: tuple[tuple[int, float], ...] = ()) -> Reduced | None:
        """Return the products without what every model has; None where they are singular.

        ``fixed`` : (place, amplitude) of what is held there.
        """
        if fixed not in self._reduced:
            self._reduced[fixed] = self._reduce(fixed)
        return self._reduced[fixed]

    def _reduce(self, fixed: tuple[tuple[int, float], ...]) -> Reduced | None:
        whole, centre = self.whole.copy(), self.ranking.centre
        for place, value in fixed:  # r becomes r + d value
            whole[0] += value * whole[1 + place]
            whole[:, 0] += value * whole[:, 1 + place]
            whole[0, 0] += (value - centre[place]) ** 2
        held = {place for place, _ in fixed}
        free = np.array([i for i in self.ranking.always if i not in held], dtype=int)
        m = centre[free]
        whole[1 + free, 1 + free] += 1.0
        whole[0, 1 + free] -= m
        whole[1 + free, 0] -= m
        whole[0, 0] += m @ m
        try:
            factor = cho_factor(whole[np.ix_(1 + free, 1 + free)], lower=True)
        except (np.linalg.LinAlgError, ValueError):
            return None
        back = -cho_solve(factor, whole[1 + free])
        return Reduced(whole + whole[:, 1 + free] @ back, back, free, fixed,
                       float(np.log(np.diag(factor[0])).sum()))

    def shift(self, members: tuple[Member, ...]) -> np.ndarray:
        """Return the (1 + m,) mixture of columns that is r without what the set has not.

        What the model has goes back to the prior's mean, which is absence.
        """
        mixture = np.zeros(len(self.whole))
        mixture[0] = 1.0
        for name in self.ranking.named:
            if Member(name, -1) not in members:
                for i in self.ranking.groups.get(Member(name, -1), ()):
                    if self.ranking.what[i].size:
                        mixture[1 + i] = self.ranking.centre[i]
        return mixture

    def solved(self, members: tuple[Member, ...], reduced: Reduced):
        """Return places, factor, amplitudes, what is left of r and the evidence without its prior.

        None where the set's columns are singular.
        """
        mixture = self.shift(members)
        left = reduced.products @ mixture
        here = np.concatenate([np.zeros(0, dtype=int), *(
            self.ranking.groups[member] for member in members)]).astype(int)
        matrix = reduced.products[np.ix_(1 + here, 1 + here)] + np.eye(len(here))
        m = self.ranking.centre[here]
        try:
            factor = np.linalg.cholesky(matrix)
        except np.linalg.LinAlgError:
            return None
        q = m - left[1 + here]
        a = cho_solve((factor, True), q, check_finite=False) if len(here) else q
        power = float(mixture @ left) + float(m @ m)
        evidence = (-0.5 * (power - float(q @ a)) - float(np.log(np.diag(factor)).sum())
                    - reduced.logdet - self.gram.logdet)
        return here, factor, a, mixture, left, evidence

    def evaluated(self, members: tuple[Member, ...]) -> Ranked | None:
        """Return a set with its evidence; None where an amplitude is impossible."""
        fixed: dict[int, float] = {}
        r = self.ranking
        wrong = {member.owner for member in members}
        for _ in range(PASSES):
            reduced = self.reduced(tuple(sorted(fixed.items())))
            found = self.solved(members, reduced) if reduced is not None else None
            if found is None:
                return None
            here, _, a, mixture, _, evidence = found
            mixture[1 + here] = a
            always = reduced.back @ mixture
            # What every model has stays within its bounds: a damping is positive, a number of the
            # rig no further off than its tolerance allows unless it is wrong.
            out = [(int(i), float(min(max(value, r.lower[i]), r.upper[i])))
                   for i, value in zip(reduced.free, always, strict=True)
                   if r.what[i].name not in wrong and not r.lower[i] <= value <= r.upper[i]]
            if not out:
                break
            fixed.update(out)
        slack = 1e-9
        if (r.size[here] & ((a < r.lower[here] - slack) | (a > r.upper[here] + slack))).any():
            return None
        amplitudes = dict(zip(here.tolist(), a.tolist(), strict=True))
        amplitudes |= dict(zip(reduced.free.tolist(), always.tolist(), strict=True)) | fixed
        gone = {member.replaces for member in members}
        prior = float(sum(r.log_prior(member) for member in members if member.owner not in gone))
        return Ranked(members, float(evidence) + prior, prior, self.gram, amplitudes)

    def gains(self, one: Ranked) -> list[tuple[Member, float]]:
        """Return what each suspect that can join would gain, prior included."""
        reduced = self.reduced()
        found = self.solved(one.members, reduced) if reduced is not None else None
        if found is None:
            return []
        here, factor, a, _, left, _ = found
        r = self.ranking
        products = reduced.products
        white = np.linalg.solve(factor, products[np.ix_(1 + here, 1 + r.owned)])
        q = (r.centre[r.owned] - left[1 + r.owned] - products[np.ix_(1 + r.owned, 1 + here)] @ a)
        able, gains = r.joining(one.members), []
        for columns, places in r.blocks:  # suspects with as many columns, all at once
            which = places[able[places]]
            if not len(which):
                continue
            at = columns[able[places]]
            own = 1 + r.owned[at]
            w = white[:, at]  # (k, suspects, columns)
            part = (products[own[:, :, None], own[:, None, :]] + np.eye(at.shape[1])
                    - np.einsum("kij,kil->ijl", w, w))
            gains += [(r.members[i], gain + r.odds[i]) for i, gain in zip(
                which, gained(part, q[at]).tolist(), strict=True) if np.isfinite(gain)]
        return gains


def gained(blocks: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return the evidence that groups of columns add, (s,); NaN where they are singular.

    blocks : (s, k, k) products of each group, sides : (s, k) those with r.
    """
    found = np.full(len(blocks), np.nan)
    good = np.isfinite(blocks).all(axis=(1, 2)) & (
        np.diagonal(blocks, axis1=1, axis2=2) > 0.0).all(axis=1)
    if blocks.shape[1] == 1:
        one = blocks[good, 0, 0]
        found[good] = 0.5 * sides[good, 0] ** 2 / one - 0.5 * np.log(one)
        return found
    try:
        found[good] = gained_by(blocks[good], sides[good])
    except np.linalg.LinAlgError:  # one of them is singular
        for i in np.flatnonzero(good):
            with suppress(np.linalg.LinAlgError):
                found[i] = gained_by(blocks[i : i + 1], sides[i : i + 1])[0]
    return found


def gained_by(blocks: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return :func:`gained` where no group is singular."""
    factor = np.linalg.cholesky(blocks)
    y = np.linalg.solve(factor, sides[:, :, None])[:, :, 0]
    return 0.5 * (y * y).sum(axis=1) - np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)


def ranked_at(what: tuple[Column, ...], named: tuple[str, ...], grams: list[Gram],
              policy: SearchPolicy, more: int = LARGEST_SET) -> list[list[Ranked]]:
    """Return for each level the best sets there, best first; see :meth:`Ranking.at_level`."""
    ranking = Ranking(what, named, policy)
    return spread(lambda gram: ranking.at_level(gram, more), grams)


def best_over(levels: list[list[Ranked]]) -> list[Ranked]:
    """Return the sets of all levels, best first; each set at the level that suits it best."""
    best: dict[tuple[Member, ...], Ranked] = {}
    for found in levels:
        for one in found:
            if (one.members not in best or one.evidence > best[one.members].evidence + ties.GUESS):
                best[one.members] = one
    return best_first(best.values())


def best_first(found: Iterable[Ranked]) -> list[Ranked]:
    """Return sets from the highest evidence to the lowest, the plainest of equals first."""
    return ties.ordered(found, lambda one: one.evidence,
                        lambda one: (len(one.members), -one.prior, one.members), ties.GUESS)


def by_gain(scores: dict[tuple[Member, ...], float]) -> list[tuple[Member, ...]]:
    """Return the members of sets in that order, from their evidence."""
    return ties.ordered(scores, scores.__getitem__, lambda key: (len(key), key), ties.GUESS)
