"""The terms of a balance, chosen by what they gain on recordings that the fit leaves out.

Machine parameters are shared, those of the settings belong to each recording.  With G_i the
products of recording i, weighted, and T its settings' columns,

    G_i' = G_i - G_iT (G_TT)^-1 G_Ti,     w_-i = argmin over signs of sum over j != i of G_j',

e_i is the RMS on i under w_-i, its settings fitted on half of its blocks and judged on the rest.
A term enters with the largest mean of d_i = ln(e_i / e_i with it), if that is ``gain`` at least
with a t of ``repeats``; then all terms are tried for removal by the same rule.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from eha_monitor import ties
from eha_monitor.balances.candidates import PUMP, Scale, flow_candidates, founded
from eha_monitor.balances.course import (
    CHAMBER_1,
    HIGHER,
    IN_TURN,
    ONE_PUMP,
    ROUNDING,
    Course,
    oil_of,
)
from eha_monitor.balances.least_squares import (
    independent,
    inverse_of,
    random_effects,
    signed_solution,
    weights_of,
)
from eha_monitor.balances.policy import POLICY, Policy
from eha_monitor.balances.table import Table, areas_apart, flow_columns, tables_of
from eha_monitor.settings.rig import Rig

SOFT = 1e-3  # of the other half's products, so that a half without motion leaves nothing open
ALIKE = 0.9  # correlation beyond which two columns of a family are nearly one
MOST_TERMS = 10  # a choice that has not ended by then is none




def of_one_machine(courses: Sequence[Course], rig: Rig, policy: Policy = POLICY) -> list[Course]:
    """Return motions of one machine with the chamber that its pump acts on.

    Behind valves it fills either chamber of a single-rod cylinder in turn; beside check valves it
    acts on that of the higher pressure, beside an accumulator on chamber 1, whichever way it
    turns.  It is one of these where the flow balances leave less with it on unseen parts, by what
    a name owes.  Where that of the higher pressure is always the same one, they cannot say whether
    a second pump matches the areas: the config's displacement does.  Of equal areas see
    :func:`oil_of`.
    """
    courses = list(courses)
    if not all(course.has_flow for course in courses):
        return courses
    if any(course.ratio == 1.0 for course in courses):
        oil = oil_of(courses)
        return _apart([replace(course, oil=oil) for course in courses], rig, policy)
    wanted = [one for one in flow_candidates(Scale.of(courses), rig) if one.name in PUMP]
    owed = policy.gain if len(courses) > 1 else policy.alone
    ways, gains, displacements, first = {}, {}, {}, None
    for oil in (IN_TURN, HIGHER, CHAMBER_1, ONE_PUMP):
        ways[oil] = [replace(course, oil=oil) for course in courses]
        tables = Recordings(tables_of(ways[oil], rig, "flow", wanted, policy), own_oil=True)
        names = list(tables.candidates)
        errors = tables.errors(names) if len(courses) > 1 else np.array(
            [table.rms(table.crosswise(names)) for table in tables.tables])
        first = errors if first is None else first
        gain, t = tables.gain(first, errors)
        # Gains of unlike motions scatter by more than they are sure: as sure is what each says.
        each = len(courses) == 1 or t >= policy.repeats or bool((errors < first).all())
        gains[oil] = gain if oil == IN_TURN or (gain >= owed and each) else -np.inf
        displacements[oil] = -np.median([table.mixture(table.gram, names)[table.places["D_p"]]
                                         for table in tables.tables])
    best = list(ways)[ties.largest(list(gains.values()))]
    alike = abs(gains[HIGHER] - gains[ONE_PUMP]) < policy.gain
    if best in (HIGHER, ONE_PUMP) and alike and rig.pump_displacement:
        best = min((HIGHER, ONE_PUMP), key=lambda oil: round(abs(np.log(
            max(displacements[oil], 1e-300) / rig.pump_displacement)), 6))
    return _apart(ways[best], rig, policy)


def _apart(courses: list[Course], rig: Rig, policy: Policy) -> list[Course]:
    """Return motions of one machine with the share by which its pump moves chamber 2 farther.

    Areas that differ by half a per cent, within their tolerance, are more than what the oil takes
    up under a spring's load, or a small leak: the machine's displacement and that share are fitted
    to all motions, each with an oil and a leakage of its own.  A share of more than three
    deviations is no tolerance but another circuit.
    """
    gram = np.zeros((3, 3))
    for course in courses:
        columns = flow_columns(course, rig)
        (off,) = areas_apart(course, rig) or (None,)
        if columns is None or off is None:
            return courses
        flow, others = columns
        rows = course.in_band(np.column_stack([
            flow - course.added("flow"), off, *(one[-1] for one in others)]))[
            course.compared(course.counted("flow"))]
        whole = rows.T @ rows
        left = rows[:, 0] - rows[:, 1:] @ weights_of(whole[1:, 1:], whole[1:, 0])
        own = without(whole, [0, 1, 2], [3, 4], np.zeros(len(whole)))
        square, floor = float(np.mean(left**2)), course.floor("flow", rig)
        form = policy.alike(square, floor**2) * len(left)
        gram += own / max(square * independent(left) + form, 1e-300)
    gram[1, 1] += 1.0
    off = float(weights_of(gram[1:, 1:], gram[1:, 0])[0])
    if abs(off) > policy.varied:
        return courses
    return [replace(course, apart=off * rig.tolerance.log_spread("area_2")) for course in courses]


@dataclass(frozen=True)
class Named:
    """A family of terms that is named: ``terms`` as they entered, what they gain together, t.

    ``rivals`` : effects of the family that do as well on recordings left out.
    """

    terms: tuple[str, ...]
    gain: float
    t: float
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True)
class Chosen:
    """Terms of one balance.

    Attributes
    ----------
    names : of all terms, those that every model has first.
    errors : (r,) of each recording left out, over its standard deviation.
    named : families of terms that gain enough to be named.
    """

    names: tuple[str, ...]
    errors: np.ndarray
    named: tuple[Named, ...]


@dataclass(frozen=True)
class Fitted:
    """Parameters of one balance over all recordings.

    Attributes
    ----------
    names : machine parameters; ``settings`` those of each recording.
    value, between : (m,) weighted mean over the recordings, spread between them.
    covariance : (m, m) of the mean, which contains the spread.
    each, each_stddev : (r, m) fitted to each recording alone.
    setting, setting_stddev : (r, s) with the machine parameters held.
    """

    names: tuple[str, ...]
    settings: tuple[str, ...]
    value: np.ndarray
    between: np.ndarray
    covariance: np.ndarray
    each: np.ndarray
    each_stddev: np.ndarray
    setting: np.ndarray
    setting_stddev: np.ndarray

    @property
    def stddev(self) -> np.ndarray:
        """Deviation of the mean, (m,) SI."""
        return np.sqrt(np.diag(self.covariance))


class Recordings:
    """Tables of one balance, and what sets of terms leave of them.

    Parameters
    ----------
    own_oil : what goes with the viscosity is free in each recording, as its oil may be warmer or
        colder: else a load or a loss that is free there takes its place.
    """

    def __init__(self, tables: list[Table], own_oil: bool = False):
        self.tables, self.own_oil = tables, own_oil
        self.candidates = {one.name: one for one in tables[0].candidates}
        self.grams = [table.gram * table.weight for table in tables]
        # One that hardly moves is mostly rest, where a seal holds whatever load there is.
        motion = np.array([float(table.moving) for table in tables])
        self.motion = (np.minimum(motion / np.median(motion[motion > 0.0]), 1.0)
                       if motion.any() else np.ones(len(tables)))
        self._reduced: dict[tuple[int, ...], list[np.ndarray]] = {}

    def split(self, names: Iterable[str]
              ) -> tuple[list[int], list[int], tuple[np.ndarray, np.ndarray]]:
        """Return columns of machine and settings' parameters; signs and bounds of the former."""
        places, own = self.tables[0].places, self.candidates
        shared, settings = [], []
        for name in names:
            free = own[name].setting or (self.own_oil and own[name].of_oil)
            (settings if free else shared).append(places[name])
        table = self.tables[0]
        return shared, settings, (table.signs[shared], table.least[shared])

    def reduced(self, settings: list[int]) -> list[np.ndarray]:
        """Return the products of all columns without what a set of settings' explains."""
        key = tuple(settings)
        if key not in self._reduced:
            every = list(range(len(self.grams[0])))
            self._reduced[key] = [without(gram, every, settings) for gram in self.grams]
        return self._reduced[key]

    def shared_fit(self, names: Iterable[str]) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return machine parameters fitted to all recordings, and reduced products of each."""
        shared, settings, bounds = self.split(names)
        there = np.ix_([0, *shared], [0, *shared])
        reduced = [gram[there] for gram in self.reduced(settings)]
        total = sum(reduced)
        return signed_solution(total[1:, 1:], total[1:, 0], *bounds), reduced

    def without_each(self, names: Iterable[str]
                     ) -> Iterator[tuple[Table, list[int], list[int], np.ndarray]]:
        """Yield each recording with the columns and the fit of the machine to all others."""
        names = list(names)
        shared, settings, bounds = self.split(names)
        _, reduced = self.shared_fit(names)
        total = sum(reduced)
        for table, own in zip(self.tables, reduced, strict=True):
            rest = total - own
            yield table, shared, settings, signed_solution(rest[1:, 1:], rest[1:, 0], *bounds)

    def errors(self, names: Iterable[str]) -> np.ndarray:
        """Return the error of each recording left out, (r,) over its standard deviation."""
        return np.array([unseen(*one) for one in self.without_each(names)])

    def left_out(self, names: Iterable[str]) -> list[np.ndarray]:
        """Return what is left of each recording under the fit to the others, (m,) each.

        Its settings are fitted on half of its blocks and applied to the rest.
        """
        found = []
        for table, shared, settings, w in self.without_each(names):
            first, left = table.first_half, np.zeros(len(table.rows))
            for (fit, judge), which in ((table.halves, ~first), (table.halves[::-1], first)):
                here = np.isin(table.block, table.numbers[which])
                left[here] = table.rows[here] @ crosswise(table, fit, judge, shared, settings, w)
            found.append(left)
        return found

    def rms(self, errors: np.ndarray) -> float:
        """Return the root of the mean square of errors over the recordings' motion."""
        return float(np.sqrt(np.average(np.square(errors), weights=self.motion)))

    def gain(self, before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
        """Return the mean of ln(before / after) over the recordings, and Student's t."""
        d = np.log(np.maximum(before, 1e-12) / np.maximum(after, 1e-12))
        share, count = self.motion / self.motion.sum(), len(d)
        mean = float(share @ d)
        if count < 2:
            return mean, 0.0
        error = float(np.sqrt(share**2 @ (d - mean) ** 2 * count / (count - 1)))
        return mean, mean / max(error, 1e-12)

    def choose(self, policy: Policy, allowed: Iterable[str], start: Iterable[str] = ()) -> Chosen:
        """Choose the terms of the balance among those that are allowed, from a start on."""
        always = [one.name for one in self.candidates.values() if one.always]
        allowed = [name for name in allowed if name not in always]
        names = [*always, *(name for name in start if name not in always)]
        errors = self.errors(names)
        tried: dict[tuple[str, ...], str] = {}  # set -> the term that entered it
        spent: set[str] = set()  # what entered led back to where it had been
        while len(names) < MOST_TERMS:
            here, best = tuple(sorted(names)), None
            if here in tried:
                spent.add(tried[here])
            for name in allowed:
                if name in names or name in spent or self._has_variant(name, names) or (
                        name not in founded([*names, name], self.candidates)):
                    continue
                with_it = self.errors([*names, name])
                mean, t = self.gain(errors, with_it)
                if mean >= self.owed(name, names, policy) and t >= policy.repeats and (
                        best is None or mean > best[1]) and self._possible(names, name):
                    best = name, mean, with_it
            if best is None:
                break
            tried[here] = best[0]
            names, errors = self._pruned([*names, best[0]], best[2], policy)
            names, errors = self._reshaped(names, errors, allowed)
        return Chosen(tuple(names), errors, self._named(names, errors, allowed, policy))

    def _named(self, names: list[str], errors: np.ndarray, allowed: list[str], policy: Policy
               ) -> tuple[Named, ...]:
        """Return the families of terms without which the error grows by what a name owes."""
        families: dict[str, list[str]] = {}
        for name in names:
            one = self.candidates[name]
            if not one.always:
                families.setdefault(one.kind, []).append(name)
        found = []
        for family, terms in families.items():
            rest = [name for name in names if name not in terms]
            bare = self.errors(rest)
            mean, t = self.gain(bare, errors)
            # What is less than ``worse`` of the signal nobody would repair a machine for.
            if mean >= policy.named and t >= policy.repeats and (
                    self.rms(bare) - self.rms(errors) > policy.worse):
                effects = {self.candidates[name].effect for name in terms}
                rivals = [name for name in allowed if self.candidates[name].kind == family
                          and self.candidates[name].effect not in effects
                          and name in founded([*rest, name], self.candidates)
                          and self.gain(self.errors([*rest, name]), errors)[0] > -policy.alone]
                found.append(Named(tuple(terms), mean, t, tuple(dict.fromkeys(
                    self.candidates[name].effect for name in rivals))))
        return tuple(sorted(found, key=lambda one: -one.gain))

    def owed(self, name: str, names: Iterable[str], policy: Policy) -> float:
        """Return the share of the error that a term must gain beside others.

        Beside one of its family that is nearly the same column, as much as a name: else neither
        has a number of its own (a spring, and half a cosine over the stroke).
        """
        one = self.candidates[name]
        if any(other != name and self.candidates[other].kind == one.kind
               and self.candidates[other].effect != one.effect
               and self._alike[self._places[name], self._places[other]] > ALIKE
               for other in names):
            return policy.named
        return policy.small if one.setting else policy.gain

    @property
    def _places(self) -> dict[str, int]:
        return self.tables[0].places

    @cached_property
    def _alike(self) -> np.ndarray:
        """Correlations of all columns over all recordings, beside a load, absolute, (k, k)."""
        total = sum(self.reduced([self._places[c.name] for c in self.candidates.values()
                                  if c.always and c.effect == "constant_load"]))
        size = np.sqrt(np.maximum(np.diag(total), 0.0))  # of what a load makes up for, rounding
        return np.abs(total) / np.maximum(np.outer(size, size), 1e-300)

    def _has_variant(self, name: str, names: list[str]) -> bool:
        one = self.candidates[name]
        return any(one.excludes(self.candidates[other]) for other in names)

    def _possible(self, names: list[str], more: str) -> bool:
        """Tell whether all shared parameters stay within their limits beside one more term.

        One that leaves nothing of another (damping by the square of speed, of B) is that other
        under a worse name.
        """
        with_it = [*names, more]
        w, _ = self.shared_fit(with_it)
        shared, _, _ = self.split(with_it)
        reach = np.max([table.reach[shared] for table in self.tables], axis=0)
        return bool((np.abs(w) <= reach).all()) and not (
            self._absent(with_it) - self._absent(names))

    @cached_property
    def of_one_oil(self) -> "Recordings":
        """The same recordings with what goes with the viscosity shared."""
        return Recordings(self.tables) if self.own_oil else self

    def _absent(self, names: list[str]) -> set[str]:
        """Return the machine's terms, of one oil, that physics' sign holds at nothing."""
        w, _ = self.of_one_oil.shared_fit(names)
        shared, _, (signs, least) = self.of_one_oil.split(names)
        of = self.tables[0].candidates
        return {of[i - 1].name for i, value, sign, low in zip(shared, w, signs, least, strict=True)
                if sign and value == low}

    def _pruned(self, names: list[str], errors: np.ndarray, policy: Policy
                ) -> tuple[list[str], np.ndarray]:
        """Take out terms that no longer gain what a name owes, the least useful first."""
        while True:
            worst = None
            for name in names:
                if self.candidates[name].always:
                    continue
                rest = founded([other for other in names if other != name], self.candidates)
                without_it = self.errors(rest)
                mean, t = self.gain(without_it, errors)
                if (mean < self.owed(name, names, policy) or t < policy.repeats) and (
                        worst is None or mean < worst[0]):
                    worst = mean, rest, without_it
            if worst is None:
                return names, errors
            names, errors = worst[1:]

    def _reshaped(self, names: list[str], errors: np.ndarray, allowed: list[str]
                  ) -> tuple[list[str], np.ndarray]:
        """Move each shape to the variant that fits best beside the other terms."""
        for i, name in enumerate(names):
            one = self.candidates[name]
            if not one.exclusive:
                continue
            for other in self.candidates.values():
                if (other.effect == one.effect and other.name != names[i]
                        and other.name in allowed):
                    trial = [*names[:i], other.name, *names[i + 1 :]]
                    found = self.errors(trial)
                    if self.gain(errors, found)[0] > 1e-9:
                        names, errors = trial, found
        return names, errors

    def fit(self, names: Iterable[str]) -> Fitted:
        """Return the parameters of a set of terms, their spread between recordings, settings."""
        names = list(names)
        shared, settings, bounds = self.split(names)
        w, reduced = self.shared_fit(names)
        each, stddev = (np.empty((len(self.tables), len(shared))) for _ in range(2))
        chance, whole = [], []
        for i, (table, own) in enumerate(zip(self.tables, reduced, strict=True)):
            each[i] = signed_solution(own[1:, 1:], own[1:, 0], *bounds)
            # As few samples as terms are fitted to the last bit, and would weigh infinitely.
            left = max(own[0, 0] - own[1:, 0] @ each[i], ROUNDING * own[0, 0])
            scale = max(left / max(table.effective - len(names), 1.0), 1e-300)
            stddev[i] = np.sqrt(np.diag(inverse_of(own[1:, 1:])) * scale)
            form = POLICY.alike(left, table.n * table.weight * table.floor**2)
            chance.append(own[1:] / scale)
            whole.append(own[1:] / (scale + form))
        start = POLICY.between * np.abs(w)
        _, between, _ = random_effects(np.array(chance), *bounds, start)
        value, _, covariance = random_effects(np.array(whole), *bounds, start)
        setting, setting_stddev = self.settings_of(shared, settings, value)
        of = self.tables[0].candidates
        return Fitted(tuple(of[i - 1].name for i in shared),
                      tuple(of[i - 1].name for i in settings), value, between, covariance, each,
                      stddev, setting, setting_stddev)

    def settings_of(self, shared: list[int], settings: list[int], w: np.ndarray
                    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the settings' parameters of each recording and their deviations, (r, s)."""
        rows, deviations = [], []
        for table in self.tables:
            value, stddev = setting_of(table, shared, settings, w)
            rows.append(value)
            deviations.append(stddev)
        return np.array(rows), np.array(deviations)


def pooled(each: np.ndarray, stddev: np.ndarray, joint: float) -> tuple[float, float, float]:
    """Return mean, spread between recordings and deviation of the mean (DerSimonian, Laird 1986).

    Recordings that say nothing of a parameter have little weight; the joint value stands where
    none says anything alone.
    """
    good = np.isfinite(stddev) & (stddev > 0.0)
    if good.sum() < 2:
        return joint, 0.0, float(stddev[good][0]) if good.any() else np.inf
    x, c = each[good], stddev[good] ** 2
    w = 1.0 / c
    mean = float(w @ x / w.sum())
    excess = float(w @ (x - mean) ** 2) - (len(x) - 1)
    tau = max(0.0, excess / (w.sum() - float(w @ w) / w.sum()))
    w = 1.0 / (c + tau)
    return float(w @ x / w.sum()), float(np.sqrt(tau)), float(np.sqrt(1.0 / w.sum()))


def without(gram: np.ndarray, kept: list[int], out: list[int],
            ridge: np.ndarray | None = None) -> np.ndarray:
    """Return products of columns with what others explain taken out (a Schur complement).

    Parameters
    ----------
    ridge : (k,) what holds each parameter that is taken out to its value, squares per SI^2.
    """
    inner = gram[np.ix_(kept, kept)]
    if not out:
        return inner
    across = gram[np.ix_(out, kept)]
    own = gram[np.ix_(out, out)]
    return inner - across.T @ weights_of(
        own if ridge is None else own + np.diag(ridge[out]), across)


def setting_of(table: Table, shared: list[int], settings: list[int], w: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray]:
    """Return a recording's settings' parameters under machine parameters, and deviations."""
    if not settings:
        return np.zeros(0), np.zeros(0)
    mixture = _mixture(table, shared, w)
    inner = table.gram[np.ix_(settings, settings)]
    t = weights_of(inner, table.gram[settings] @ mixture)
    mixture[settings] = -t
    left = np.where(table.good, table.rows @ mixture, np.nan)
    return t, np.sqrt(np.diag(inverse_of(inner)) * float(np.nanmean(left**2)) * independent(left))


def _mixture(table: Table, shared: list[int], w: np.ndarray) -> np.ndarray:
    """Return the mixture of columns that is y less the machine's terms, (1 + k,)."""
    mixture = np.zeros(table.rows.shape[1])
    mixture[0], mixture[shared] = 1.0, -w
    return mixture


def unseen(table: Table, shared: list[int], settings: list[int], w: np.ndarray) -> float:
    """Return the RMS on a recording over its standard deviation, settings fitted crosswise."""
    squares = 0.0
    for fit, judge in (table.halves, table.halves[::-1]):
        mixture = crosswise(table, fit, judge, shared, settings, w)
        squares += float(mixture @ judge @ mixture)
    return float(np.sqrt(max(squares, 0.0) / max(table.n, 1))) / table.size


def left_alone(table: Table, names: Iterable[str]) -> float:
    """Return the RMS that terms leave where they are fitted to the recording itself, SI."""
    return table.size * unseen(table, [], [table.places[name] for name in names
                                           if name in table.places], np.empty(0))


def crosswise(table: Table, fit: np.ndarray, judge: np.ndarray, shared: list[int],
              settings: list[int], w: np.ndarray) -> np.ndarray:
    """Return the mixture of columns that is left, settings fitted on one half, (1 + k,)."""
    mixture = _mixture(table, shared, w)
    if settings:
        part = fit + SOFT * judge
        gram, side = part[np.ix_(settings, settings)], part[settings] @ mixture
        signs, least = table.signs[settings], table.least[settings]
        w = weights_of(gram, side)
        mixture[settings] = -(w if ((w - least) * signs >= 0.0).all()
                              else signed_solution(gram, side, signs, least))
    return mixture
