"""Evidence of every set of suspects from one Gram matrix, and a beam over the sets.

With innovations r, columns D in units of their priors, prior means m and amplitudes a,

    -log posterior = 1/2 |r + D a|^2 + 1/2 |a - m|^2 + const,
    log evidence   = -1/2 (r'r + m'm - q'(G + 1)^-1 q) - 1/2 log det(G + 1) - sum log det S / 2,

G = D'D, q = m - D'r: Laplace's approximation, exact where the model is linear.  What every model
has is taken out once (a Schur complement); a set is then a small linear solve.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from eha_monitor.mismatch.likelihood.fit import spread
from eha_monitor.mismatch.name.acceptance import (
    BEAM,
    EFFECT,
    KIN,
    LARGEST_SET,
    RARE,
    UNNAMED,
    WRONG_RIG,
)
from eha_monitor.mismatch.name.columns import ALWAYS, ASTRAY_OWNER, Column
from eha_monitor.mismatch.name.gram import Gram
from eha_monitor.physics.effects import CATALOGUE

PASSES = 4  # of a solution within bounds


@dataclass(frozen=True)
class Member:
    """A suspect in a set: an owner at one of its starts, or as the model has it (-1).

    ``replaces`` : effect of the model that it contains and grows out of; both are in the set.
    """

    owner: str
    variant: int
    replaces: str = ""


@dataclass(frozen=True)
class Ranked:
    """A set with its evidence, by the linear guess.

    Attributes
    ----------
    members : sorted.
    evidence : log units, ``prior`` odds included; comparable at one linearisation.
    gram : of the level that suits it best.
    amplitudes : column's place (in ``what``) -> amplitude.
    """

    members: tuple[Member, ...]
    evidence: float
    prior: float
    gram: Gram = field(repr=False, compare=False)
    amplitudes: dict[int, float] = field(repr=False, compare=False)

    @property
    def names(self) -> frozenset[str]:
        """Owners in the set."""
        return frozenset(member.owner for member in self.members) - {
            member.replaces for member in self.members}


class Ranking:
    """The columns of one linearisation, grouped by suspect."""

    def __init__(self, what: tuple[Column, ...], named: tuple[str, ...]):
        self.what, self.named = what, named
        self.always = np.array([i for i, c in enumerate(what) if c.owner == ALWAYS], dtype=int)
        groups: dict[Member, list[int]] = {}
        for i, column in enumerate(what):
            if column.owner not in (ALWAYS, ASTRAY_OWNER):
                replaces = column.start.replaces if column.start else ""
                groups.setdefault(Member(column.owner, column.variant, replaces), []).append(i)
        self.groups = {member: np.array(places) for member, places in groups.items()}
        self.starts: dict[str, int] = {}
        for member in groups:
            if not member.replaces:
                self.starts[member.owner] = self.starts.get(member.owner, 0) + 1
        self.centre = np.array([c.centre for c in what])
        self.lower = np.array([c.lower for c in what])
        self.upper = np.array([c.upper for c in what])

    def log_prior(self, member: Member) -> float:
        """Return the logarithm of a suspect's prior odds."""
        if member.owner.startswith("rig."):
            return WRONG_RIG
        if member.owner not in CATALOGUE:
            return UNNAMED
        several = (np.log(self.starts[member.owner])
                   if member.variant >= 0 and not member.replaces else 0.0)
        return EFFECT + RARE * CATALOGUE[member.owner].rarity - several

    def roots(self) -> list[tuple[Member, ...]]:
        """Return the subsets of what the model has, each a set to begin with.

        A limit cannot be taken away by a linear guess: it has no size that goes to nil.
        """
        have = [Member(name, -1) for name in self.named]
        kept = tuple(member for member in have if limited(member.owner))
        free = [member for member in have if member not in kept]
        return [(*kept, *subset) for k in range(len(free) + 1)
                for subset in combinations(free, k)]

    def fits(self, members: tuple[Member, ...], other: Member) -> bool:
        """Tell whether a suspect can join: one of a kind, and none that another contains."""
        if other.replaces and Member(other.replaces, -1) not in members:
            return False
        gone = {member.replaces for member in members} | {other.replaces}
        for member in members:
            if member.owner == other.owner or twins(member.owner, other.owner):
                return False
            if member.owner in gone:
                if other.replaces and any(one.replaces == other.replaces for one in members):
                    return False
                continue
            one, two = CATALOGUE.get(member.owner), CATALOGUE.get(other.owner)
            if one and two:
                if {one.name, *one.contains} & {two.name, *two.contains}:
                    return False
            elif not one and not two and not member.owner.startswith("rig.") \
                    and not other.owner.startswith("rig."):
                return False  # one unknown function at a time
        return True

    def at_level(self, gram: Gram) -> list[Ranked]:
        """Return the best sets at one level, best first."""
        level = Level(self, gram)
        found: dict[tuple[Member, ...], Ranked] = {}
        beam = []
        for root in self.roots():
            one = level.evaluated(root)
            if one is not None:
                found[one.members] = one
                beam.append(one)
        for _ in range(LARGEST_SET):
            grown: dict[tuple[Member, ...], float] = {}
            for one in sorted(beam, key=lambda r: -r.evidence)[:BEAM]:
                if len(one.members) >= LARGEST_SET:
                    continue
                for member, gain in level.gains(one):
                    key = tuple(sorted((*one.members, member),
                                       key=lambda m: (m.owner, m.variant, m.replaces)))
                    grown[key] = max(grown.get(key, -np.inf), one.evidence + gain)
            best = sorted(grown, key=lambda key: -grown[key])
            beam = []
            for key in best:
                if len(beam) >= BEAM:
                    break
                if key in found:
                    continue
                one = level.evaluated(key)
                if one is not None:
                    found[key] = one
                    beam.append(one)
            if not beam:
                break
        return sorted(found.values(), key=lambda one: -one.evidence)


class Level:
    """Evidence of sets at one level of the unknowns."""

    def __init__(self, ranking: Ranking, gram: Gram):
        self.ranking, self.gram = ranking, gram
        self.whole = gram.products.sum(axis=0)

    def shifted(self, members: tuple[Member, ...]) -> tuple[np.ndarray, float]:
        """Return D'r and r'r where what the model has and the set has not is taken out."""
        gone = [i for name in self.ranking.named if Member(name, -1) not in members
                for i in self.ranking.groups.get(Member(name, -1), ())
                if self.ranking.what[i].size]
        b, power = self.whole[1:, 0].copy(), float(self.whole[0, 0])
        for i in gone:
            t = self.ranking.centre[i]  # back to the prior's mean, which is absence
            power += 2.0 * t * b[i] + t * t * self.whole[1 + i, 1 + i]
            b += t * self.whole[1:, 1 + i]
        return b, power

    def places(self, members: tuple[Member, ...]) -> np.ndarray:
        """Return the places of a set's columns, what every model has first."""
        return np.concatenate([self.ranking.always, *(
            self.ranking.groups[member] for member in members)]).astype(int)

    def solved(self, members: tuple[Member, ...], fixed: dict[int, float] | None = None):
        """Return places, factor, amplitudes and evidence without its prior, or None.

        ``fixed`` : place of a column -> amplitude at which it is held.
        """
        b, power = self.shifted(members)
        here = self.places(members)
        for i, value in (fixed or {}).items():
            power += 2.0 * value * b[i] + value**2 * self.whole[1 + i, 1 + i]
            power += (value - self.ranking.centre[i]) ** 2
            b = b + value * self.whole[1:, 1 + i]
            here = here[here != i]
        matrix = self.whole[np.ix_(1 + here, 1 + here)] + np.eye(len(here))
        m = self.ranking.centre[here]
        try:
            factor = cho_factor(matrix, lower=True)
        except (np.linalg.LinAlgError, ValueError):
            return None
        q = m - b[here]
        a = cho_solve(factor, q)
        evidence = (-0.5 * (power + m @ m - q @ a) - np.log(np.diag(factor[0])).sum()
                    - self.gram.logdet)
        return here, factor, a, evidence

    def evaluated(self, members: tuple[Member, ...]) -> Ranked | None:
        """Return a set with its evidence; None where an amplitude is impossible."""
        fixed: dict[int, float] = {}
        r = self.ranking
        wrong = {member.owner for member in members}
        for _ in range(PASSES):
            found = self.solved(members, fixed)
            if found is None:
                return None
            here, _, a, evidence = found
            # What every model has stays within its bounds: a damping is positive, a number of the
            # rig no further off than its tolerance allows unless it is wrong.
            out = [(int(i), float(min(max(value, r.lower[i]), r.upper[i])))
                   for i, value in zip(here, a, strict=True) if r.what[i].owner == ALWAYS
                   and r.what[i].name not in wrong
                   and not r.lower[i] <= value <= r.upper[i]]
            if not out:
                break
            fixed.update(out)
        if members and any("." not in r.what[i].name for i in fixed):
            return None  # what can only be with no damping, or no stiffness, cannot be
        own = np.array([r.what[i].owner != ALWAYS and r.what[i].size for i in here], dtype=bool)
        slack = 1e-9
        if (own & ((a < r.lower[here] - slack) | (a > r.upper[here] + slack))).any():
            return None
        here, a = np.concatenate([here, list(fixed)]).astype(int), np.concatenate(
            [a, list(fixed.values())])
        gone = {member.replaces for member in members}
        prior = log_kin({member.owner for member in members} - gone) + float(sum(
            r.log_prior(member) for member in members if member.owner not in gone))
        return Ranked(members, float(evidence) + prior, prior, self.gram,
                      {int(i): float(v) for i, v in zip(here, a, strict=True)})

    def gains(self, one: Ranked) -> list[tuple[Member, float]]:
        """Return what each suspect that can join would gain, prior included."""
        found = self.solved(one.members)
        if found is None:
            return []
        here, factor, a, _ = found
        r = self.ranking
        b, _ = self.shifted(one.members)
        joining = [member for member in r.groups
                   if member.variant >= 0 and r.fits(one.members, member)]
        if not joining:
            return []
        others = np.concatenate([r.groups[member] for member in joining])
        cross = self.whole[np.ix_(1 + here, 1 + others)]
        solved = cho_solve(factor, cross)
        block = self.whole[np.ix_(1 + others, 1 + others)] - cross.T @ solved + np.eye(len(others))
        q = r.centre[others] - b[others] - cross.T @ a
        gains, at = [], 0
        for member in joining:
            k = len(r.groups[member])
            part, side = block[at : at + k, at : at + k], q[at : at + k]
            at += k
            if not (np.isfinite(part).all() and (np.diag(part) > 0.0).all()):
                continue
            if k == 1:
                gain = 0.5 * side[0] ** 2 / part[0, 0] - 0.5 * np.log(part[0, 0])
            else:
                try:
                    c = np.linalg.cholesky(part)
                except np.linalg.LinAlgError:
                    continue
                y = np.linalg.solve(c, side)
                gain = 0.5 * y @ y - np.log(np.diag(c)).sum()
            prior = r.log_prior(member) - (
                r.log_prior(Member(member.replaces, -1)) if member.replaces else 0.0)
            gains.append((member, float(gain) + prior))
        return gains


def log_kin(names: Iterable[str]) -> float:
    """Return the prior of what a set has of one family: each beyond the first costs more."""
    families = [CATALOGUE[name].family for name in names
                if name in CATALOGUE and CATALOGUE[name].family]
    return KIN * (len(families) - len(set(families)))


def limited(name: str) -> bool:
    """Tell whether an effect is a limit, or is fitted as a logarithm: it has no linear size."""
    return name in CATALOGUE and any(p.log or not np.isfinite(p.neutral)
                                     for p in CATALOGUE[name].sizes)


def is_named(name: str) -> bool:
    """Tell whether a suspect is an entry of the catalogue or a number of the rig."""
    return name in CATALOGUE or name.startswith("rig.")


def twins(one: str, other: str) -> bool:
    """Tell whether an effect and a number of the rig are one equation."""
    return any(name in CATALOGUE and f"rig.{CATALOGUE[name].rig_twin}" == key
               for name, key in ((one, other), (other, one)))


def ranked_at(what: tuple[Column, ...], named: tuple[str, ...], grams: list[Gram]
              ) -> list[list[Ranked]]:
    """Return for each level the best sets there, best first."""
    ranking = Ranking(what, named)
    return spread(ranking.at_level, grams)


def best_over(levels: list[list[Ranked]]) -> list[Ranked]:
    """Return the sets of all levels, best first; each set at the level that suits it best."""
    best: dict[tuple[Member, ...], Ranked] = {}
    for found in levels:
        for one in found:
            if one.members not in best or one.evidence > best[one.members].evidence:
                best[one.members] = one
    return sorted(best.values(), key=lambda one: -one.evidence)
