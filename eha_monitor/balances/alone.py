"""The terms of a balance that one recording alone can carry, or two together, and how surely.

Terms are chosen on random halves of the recording's blocks, each judged on the other half: a
term enters where it takes the share ``alone`` of the error there.  A name is what comes up in
``stable`` of the halves (Meinshausen and Buehlmann 2010); its probability is that frequency,
flattened to what replicates of real recordings allow, and capped.  What is chosen passes the
gates: a term stays where it is 3 deviations from absent and within its limits, and the model where
it leaves no more on unseen parts than the config's own does, and than ten lines of least squares.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations

import numpy as np

from eha_monitor.balances.bends import by_falls
from eha_monitor.balances.candidates import BENT_DAMPING, FIRST_VIEW, Candidate, founded
from eha_monitor.balances.least_squares import from_absent, inverse_of, signed_solution
from eha_monitor.balances.policy import Policy
from eha_monitor.balances.table import Table
from eha_monitor.quantity import quantity, share

MOST_TERMS = 8


@dataclass(frozen=True)
class Name:
    """A term of the model of one balance.

    Attributes
    ----------
    term, effect : the candidate's.
    value, stddev : SI.
    fall : of the deviation that of :func:`bends.by_falls`, which leaves a size open, no name.
    frequency : share of the halves in which the effect, or one of its family, came up.
    probability : calibrated and capped.
    gained : log units that the balance loses without it.
    named : it is an answer, as far from absent as :attr:`Policy.owed` says; else it corrects the
        form, or belongs to every model.
    rivals : effects that fit as well in its place.
    whole : (value, deviation) of the quantity that it is a part of, the sum of its terms.
    """

    term: str
    effect: str
    value: float
    stddev: float
    frequency: float
    probability: float
    gained: float
    named: bool
    rivals: tuple[str, ...]
    whole: tuple[float, float]
    fall: float


@dataclass(frozen=True)
class Refused:
    """A gate that a term or a model did not pass: see :class:`mismatch.diagnosis.Gate`."""

    gate: str
    what: str
    statement: str


@dataclass(frozen=True)
class Alone:
    """What one balance of one recording says.

    Attributes
    ----------
    names : terms of the model, those that every model has first.
    refused : gates that something did not pass.
    effective_samples : of the fullest model's residual.
    error, nominal : share of the signal that is left on the half left out, mean over the halves;
        ``nominal`` with the terms that every model has.
    """

    names: tuple[Name, ...]
    refused: tuple[Refused, ...]
    effective_samples: float
    error: float
    nominal: float

    @property
    def effects(self) -> frozenset[str]:
        """Effects that are named."""
        return frozenset(name.effect for name in self.names if name.named)

    @property
    def weights(self) -> dict[str, float]:
        """Parameter of each term."""
        return {name.term: name.value for name in self.names}


def alone(table: Table, policy: Policy, seed: int = 0) -> Alone:
    """Return what one balance of one recording says, or of two that are pooled."""
    return _Choice(table, policy, seed).answer()


class _Choice:
    """Halves of a table, and what sets of terms leave of them."""

    def __init__(self, table: Table, policy: Policy, seed: int):
        self.table, self.policy = table, policy
        self.of = {one.name: one for one in table.candidates}
        self.always = [one.name for one in table.candidates if one.always]
        self.allowed = [one for one in self.of
                        if one in self.always or not self.beyond([*self.always, one])]
        rng, count, self.halves = np.random.default_rng(seed), len(table.blocks), []
        for _ in range(policy.halves):
            first = np.zeros(count, dtype=bool)
            first[rng.permutation(count)[: (count + 1) // 2]] = True
            self.halves.append((table.blocks[first].sum(axis=0),
                                table.blocks[~first].sum(axis=0)))

    def answer(self) -> Alone:
        """Return the model."""
        table, policy = self.table, self.policy
        nominal = self.unseen(self.always)
        refused: list[Refused] = []
        kept, named, often, rivals = list(self.always), set(), {}, {}
        clean = policy.clean * table.floor / table.size
        if nominal > clean:
            among = self.allowed if nominal > policy.worse else self.numbers_explaining(nominal)
            if among:
                kept, often, rivals = self.stable(among)
                kept, named = self.gated(kept, refused)
        kept = self.as_good_as_first_view(kept, refused)
        found, error = [], self.unseen(kept)
        values, chance = covariance_by_chance(table, kept)
        covariance = chance + form_and_doubts(table, kept, error, policy)
        families = {self.of[name].kind for name in kept}
        falls = by_falls(table, kept, values)
        stated = covariance + falls
        moved = between_forms(
            self.of, self.allowed, kept, self.unseen, lambda names: self.parameters(names)[0],
            policy)
        wholes = wholes_of([self.of[name] for name in kept], values, stated, moved)
        stddev = np.hypot(np.sqrt(np.diag(stated)), np.max(np.abs(moved), axis=0))
        for name, value, total, whole, fall in zip(
                kept, values, stddev.tolist(), wholes, np.sqrt(np.diag(falls)).tolist(),
                strict=True):
            one = self.of[name]
            if one.always:  # no half says whether it is there: its own value does
                frequency, gained = 1.0, 0.0
                apart = abs(value) / total if total > 0.0 else 0.0
                if one.configured > 0.0 and apart > policy.owed:
                    rivals[one.kind] = self.as_well_as(name, kept, error)
            else:
                frequency = often.get(one.kind, 0.0)
                apart = from_absent(values, covariance, [
                    self.of[other].kind == one.kind and not self.of[other].always
                    for other in kept])
                rest = [other for other in kept if other != name]
                gained = table.effective * float(np.log(self.unseen(rest) / error))
            found.append(Name(
                name, one.effect, value, total, frequency,
                policy.probability(frequency, apart),
                gained, name in named and apart > policy.owed,
                tuple(e for e in rivals.get(one.kind, ()) if e not in {
                    self.of[other].effect for other in kept} and one.kind in families),
                whole or (value, total), fall))
        return Alone(tuple(found), tuple(refused), table.effective, error, nominal)

    def numbers_explaining(self, nominal: float) -> list[str]:
        """Return the numbers of the config that explain most of an error, however small it is.

        An error of 2 % of a force is nothing to repair a machine for; a mass that is a third
        larger than the config's may be no more, where weight and friction are most of the force.
        """
        return [name for name in self.allowed
                if self.of[name].configured > 0.0 and not self.of[name].always
                and self.unseen([*self.always, name]) < self.policy.open * nominal]

    def as_well_as(self, name: str, kept: list[str], error: float) -> tuple[str, ...]:
        """Return the effects of which a term does as well in the place of a number of the config.

        The number is then the config's: a leak to ambient beside pressures that hardly vary may be
        one between the chambers.
        """
        rest, most = [other for other in kept if other != name], error * np.exp(self.policy.alone)
        forms = {one.name: [*rest, one.name] for one in self.of.values()
                 if not one.always and one.name not in kept}
        return tuple(dict.fromkeys(
            self.of[other].effect for other, form in forms.items()
            if founded(form, self.of) == form and not self.beyond(form)
            and self.unseen(form) <= most))

    def stable(self, among: Sequence[str]
               ) -> tuple[list[str], dict[str, float], dict[str, tuple[str, ...]]]:
        """Return the terms that most halves choose, how often each family is, and rivals.

        ``among`` : terms of which they choose; what does as well in their place may be another.
        """
        of, policy = self.of, self.policy
        effects, families, terms = Counter(), Counter(), Counter()
        for fit, judge in self.halves:
            chosen = chosen_on(self.table, (fit, judge), self.always, among, policy)
            # In the order of the choice: a set's own is another one in each process.
            effects.update(list(dict.fromkeys(of[name].effect for name in chosen)))
            families.update(list(dict.fromkeys(of[name].kind for name in chosen
                                               if not of[name].always)))
            terms.update(chosen)
        kept = list(self.always)
        for family, count in families.most_common():
            if count < policy.stable * policy.halves:
                continue
            members = [name for name, _ in terms.most_common()
                       if of[name].kind == family and not of[name].always]
            shapes: dict[str, str] = {}  # effect -> the shape of it that most halves choose
            for name in members:
                if effects[of[name].effect] >= policy.stable * policy.halves:
                    shapes.setdefault(of[name].effect, name)
            steady = list(shapes.values()) or members[:1]
            # Halves share what is added, not what it adds to.
            for name in [name for name in steady if name not in founded([*kept, *steady], of)]:
                ground = next((other for other in (*members, *self.allowed) if of[other].bears
                               and of[other].family == of[name].upon and not of[other].upon), None)
                if ground is None:
                    steady.remove(name)
                elif ground not in steady:
                    steady.insert(0, ground)
            for name in steady[:1] if of[members[0]].exclusive == "kind" else steady:
                if of[name].effect not in {of[other].effect for other in kept}:
                    kept.append(name)
        rivals = {}
        for i, name in enumerate(kept):
            if not of[name].always:
                kept[i], rivals[of[name].kind] = self.plainest(kept, i)
        return kept, {k: v / policy.halves for k, v in families.items()}, rivals

    def plainest(self, kept: list[str], i: int) -> tuple[str, tuple[str, ...]]:
        """Return the first member of a family that fits as well as any, and the others that do.

        Within a family the difference is one of form; a recording alone rarely decides it, and
        what it cannot decide goes to the one that stands first among the candidates.
        """
        of = self.of
        own, taken = of[kept[i]], {of[name].effect for name in kept}
        members = [name for name in self.allowed if not of[name].always and (
            of[name].effect == own.effect or (own.family and of[name].family == own.family
                                              and of[name].effect not in taken))]
        forms = {name: [*kept[:i], name, *kept[i + 1 :]] for name in members}
        found = {name: self.unseen(form) for name, form in forms.items()
                 if founded(form, of) == form}
        best: dict[str, str] = {}  # effect -> its best shape
        for name in found:
            effect = of[name].effect
            if effect not in best or found[name] < found[best[effect]]:
                best[effect] = name
        least = min(found.values())
        equal = [effect for effect, name in best.items()
                 if found[name] <= least * np.exp(self.policy.alone)]
        return best[equal[0]], tuple(equal[1:])

    def gated(self, kept: list[str], refused: list[Refused]) -> tuple[list[str], set[str]]:
        """Return the terms that are there for sure and within their limits, and the names.

        What a doubt of the left side makes as well is no name, and corrects the form: without it
        what it takes up is an error of the others.
        """
        while True:
            values, sure = self.parameters(kept)
            out, form, doubts = None, set(), moved_by_doubts(self.table, kept)
            for name, value, stddev, doubt in zip(kept, values, sure, doubts, strict=True):
                one = self.of[name]
                if one.always:
                    continue
                rest = founded([other for other in kept if other != name], self.of)
                shown = quantity(value, one.unit, 3)
                if abs(value) > self.table.reach[self.table.places[name]]:
                    out = Refused("bound", one.effect, f"{one.words} of {shown} is beyond what "
                                  "this rig can have")
                elif not self.policy.sure(value, stddev) and self.unseen(
                        rest) < self.unseen(kept) * np.exp(self.policy.alone):
                    out = Refused("member", one.effect, f"{one.words} of {shown} is not "
                                  f"{self.policy.varied:g} deviations from absent, and the model "
                                  "without it is no worse")
                elif not self.policy.sure(value, doubt):
                    form.add(name)  # channels half a sample late, areas within their tolerance
                if out is not None:
                    refused.append(out)
                    kept = rest
                    break
            if out is None:
                break
        error, before = self.unseen(kept), self.unseen(self.always)
        if error > before + self.policy.worse:
            refused.append(Refused(
                "unseen_error", self.table.balance,
                f"on unseen parts {share(error, 2)} of it would stay open, {share(before, 2)} "
                "without the names"))
            kept = list(self.always)
        return kept, set(kept) - set(self.always) - form

    def as_good_as_first_view(self, kept: list[str], refused: list[Refused]) -> list[str]:
        """Return the terms with those of the first view where these leave less."""
        more = [name for name in FIRST_VIEW if name in self.of and name not in kept]
        if self.table.balance != "force" or not more:
            return kept
        first = [*self.always, *(name for name in FIRST_VIEW if name in self.of)]
        table = self.table
        mine, view = table.rms(table.crosswise(kept)), table.rms(table.crosswise(first))
        if mine <= view + self.policy.worse or self.beyond(first):
            return kept
        refused.append(Refused(
            "unseen_error", "force", f"least squares on the force balance leave {share(view, 2)} "
            f"on unseen parts, what is named {share(mine, 2)}: their terms correct the model"))
        return [*kept, *more]

    def unseen(self, names: Sequence[str]) -> float:
        """Return the rms on the halves left out, as a share of the signal."""
        squares = np.sum([_error(self.table, half, names) ** 2 for half in self.halves])
        count = sum(judge[0, 0] for _, judge in self.halves) / max(self.table.gram[0, 0], 1e-300)
        return max(float(np.sqrt(squares / max(count * self.table.n, 1.0))) / self.table.size,
                   1e-12)

    def beyond(self, names: Sequence[str]) -> bool:
        """Tell whether a parameter of a set is beyond its limit on the whole recording."""
        w = -self.table.mixture(self.table.gram, names)
        return bool((np.abs(w) > self.table.reach).any())

    def parameters(self, names: Sequence[str]) -> tuple[list[float], list[float]]:
        """Return values, and deviations of as many independent samples as there are."""
        return parameters_of(self.table, names)


def between_forms(of: Mapping[str, Candidate], allowed: Sequence[str], kept: Sequence[str],
                  unseen: Callable[[Sequence[str]], float],
                  parameters: Callable[[Sequence[str]], Sequence[float]], policy: Policy
                  ) -> np.ndarray:
    """Return how parameters go with each shape of a family that fits as well, (shapes, k) SI.

    Which of them is the machine's the recordings do not say: its friction may fall with speed, or
    turn round more slowly, and damping takes up what they do not hold.

    Parameters
    ----------
    of, allowed : candidates by name; those that may be terms.
    kept : (k,) terms of the model.
    unseen, parameters : of names of terms: what they leave on unseen parts; their values.
    """
    kept = list(kept)
    values, least = np.asarray(parameters(kept)), unseen(kept)
    most = least * np.exp(policy.alone)
    moved = [np.zeros(len(kept))]
    for i, name in enumerate(kept):
        others = [other for other in allowed if of[name].exclusive
                  and other not in kept and of[other].kind == of[name].kind]
        for other in others:
            more = bool(of[other].upon) and not of[name].upon
            form = [*kept, other] if more else [*kept[:i], other, *kept[i + 1 :]]
            if founded(form, of) == form and unseen(form) <= most:
                found = np.asarray(parameters(form))[: len(kept)]
                if form[i] != name and of[other].unit != of[name].unit:
                    found[i] = values[i]  # another quantity
                moved.append(found - values)
    grow = np.array([of[name].power > 0 for name in kept])
    for more in _laws_beside(kept, of, allowed):
        if unseen([*kept, *more]) <= least:
            found = np.asarray(parameters([*kept, *more]))[: len(kept)]
            moved.append(np.where(grow, found - values, 0.0))
    return np.array(moved)


def _laws_beside(kept: Sequence[str], of: Mapping[str, Candidate], allowed: Sequence[str]
                 ) -> Iterator[tuple[str, ...]]:
    """Yield what damping may have taken up: laws of friction and the mass, each and together.

    Along one motion B stands for dry friction and quadratic damping as well, which are as large
    together as neither is alone.
    """
    kinds = {of[name].kind for name in kept}
    free = [name for name in (*FIRST_VIEW, BENT_DAMPING) if name in allowed and name not in kept
            and of[name].kind not in kinds]
    yield from chain.from_iterable(combinations(free, count + 1) for count in range(len(free)))


def wholes_of(terms: Sequence[Candidate], values: Sequence[float], covariance: np.ndarray,
              moved: np.ndarray) -> list[tuple[float, float] | None]:
    """Return the sum and its deviation of the quantity of each term; None of one with no other.

    Two shapes of a seal's friction are one force, and how they share it nobody asks.

    Parameters
    ----------
    covariance : (k, k) of the values; ``moved`` (shapes, k) see :func:`between_forms`.
    """
    found: list[tuple[float, float] | None] = []
    for one in terms:
        own = [i for i, other in enumerate(terms)
               if other.quantity == one.quantity and other.unit == one.unit]
        found.append(None if len(own) == 1 else (
            float(np.sum(np.asarray(values)[own])),
            float(np.hypot(np.sqrt(covariance[np.ix_(own, own)].sum()),
                           np.abs(moved[:, own].sum(axis=1)).max()))))
    return found


def parameters_of(table: Table, names: Sequence[str], held: dict[str, float] | None = None
                  ) -> tuple[list[float], list[float]]:
    """Return the parameters of terms on a whole table, and their deviations by chance."""
    values, chance = covariance_by_chance(table, names, held)
    return values, np.sqrt(np.maximum(np.diag(chance), 0.0)).tolist()


def covariance_by_chance(table: Table, names: Sequence[str], held: dict[str, float] | None = None
                         ) -> tuple[list[float], np.ndarray]:
    """Return the parameters of terms, and their covariance by as many independent samples."""
    places = [table.places[name] for name in names]
    mixture = table.mixture(table.gram, names, held)
    left = max(float(mixture @ table.gram @ mixture), 0.0) / max(table.n, 1)
    effective = table.effective
    scale = left * table.full[1] * effective / max(effective - len(names), 1.0)
    return (-mixture[places]).tolist(), scale * inverse_of(table.gram[np.ix_(places, places)])


def form_and_doubts(table: Table, names: Sequence[str], error: float, policy: Policy
                    ) -> np.ndarray:
    """Return the covariance of parameters that no longer record takes away, (k, k) SI.

    A law that is missing may look like a term's own column.  What is in doubt of the left side
    moves all of the parameters together.

    Parameters
    ----------
    error : share of the signal that is left on unseen parts.
    """
    places = [table.places[name] for name in names]
    form = policy.alike((error * table.size) ** 2, table.floor**2) * table.n
    moved = movement(table, names)
    lasting = moved @ moved.T
    if form > 0.0:
        lasting += form * inverse_of(table.gram[np.ix_(places, places)])
    return lasting


def moved_by_doubts(table: Table, names: Sequence[str]) -> np.ndarray:
    """Return how far each parameter goes with what is in doubt of the left side, (k,) SI."""
    return np.linalg.norm(movement(table, names), axis=1)


def movement(table: Table, names: Sequence[str]) -> np.ndarray:
    """Return how far each parameter goes with each doubt of the left side, (k, doubts) SI."""
    places = [table.places[name] for name in names]
    inverse = inverse_of(table.gram[np.ix_(places, places)])
    inverse[~np.isfinite(inverse)] = 0.0  # of what has no data, chance says it
    return inverse @ (table.rows[table.good][:, places].T @ table.doubts[table.good])


def chosen_on(table: Table, half: tuple[np.ndarray, np.ndarray], always: Sequence[str],
              allowed: Sequence[str], policy: Policy) -> list[str]:
    """Return the terms that gain on one half, fitted on the other."""
    names: list[str] = list(always)
    of: dict[str, Candidate] = {one.name: one for one in table.candidates}
    error = _error(table, half, names)
    while len(names) < MOST_TERMS:
        best, least = None, error * np.exp(-policy.alone)
        for name in allowed:
            if name in names or name not in founded([*names, name], of) or any(
                    of[name].excludes(of[other]) for other in names):
                continue
            found = _error(table, half, [*names, name])
            if found < least:
                best, least = name, found
        if best is None:
            break
        names.append(best)
        error = least
        for name in [one for one in names if one not in always and one != best]:
            rest = founded([one for one in names if one != name], of)
            found = _error(table, half, rest)
            if found < error * np.exp(policy.alone):
                names, error = rest, found
    return names


def _error(table: Table, half: tuple[np.ndarray, np.ndarray], names: Sequence[str]) -> float:
    """Return the RMS on the judging half, in the unit of y times the root of the samples."""
    fit, judge = half
    places = [table.places[name] for name in names]
    w = signed_solution(fit[np.ix_(places, places)], fit[places, 0], table.signs[places],
                        table.least[places])
    left = judge[0, 0] - 2.0 * w @ judge[places, 0] + w @ judge[np.ix_(places, places)] @ w
    return float(np.sqrt(max(left, 1e-300)))
