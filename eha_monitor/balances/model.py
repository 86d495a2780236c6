"""The model of one balance that recordings support, however many they are.

One recording, or two pooled: terms that come up on random halves (:mod:`alone`); three or more:
terms that gain on recordings left out (:mod:`machine`).  Either way with what is left on parts
that the fit has not seen, before and after.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtr

from eha_monitor import ties
from eha_monitor.balances.alone import (
    Alone,
    Refused,
    alone,
    form_and_doubts,
    parameters_of,
    wholes_of,
)
from eha_monitor.balances.bends import by_falls
from eha_monitor.balances.candidates import FIRST_VIEW, Candidate, Scale, candidates_of
from eha_monitor.balances.course import Course
from eha_monitor.balances.learned_curve import NAME as LEARNED
from eha_monitor.balances.learned_curve import LearnedCurve, learned_curve, with_columns
from eha_monitor.balances.least_squares import from_absent, rms
from eha_monitor.balances.machine import MachineBalance, forms_of
from eha_monitor.balances.policy import Policy
from eha_monitor.balances.table import Table, nominal_of, pooled_table, tables_of
from eha_monitor.balances.together import Named, Recordings, setting_of
from eha_monitor.mismatch.diagnosis import LearnedTerm
from eha_monitor.settings.rig import Rig

LOAD = "constant_load"


@dataclass(frozen=True)
class Term:
    """A term of a model.

    Attributes
    ----------
    candidate : what it is.
    value, stddev, between : SI; of a setting's number the mean over the recordings.
    each : its value in every recording, where it belongs to the setting.
    probability, stability : that it is there; share of halves, or probability of its gain.
    gained : log units that the balance loses without it.
    named : it is an answer.
    rivals : effects that do as well in its place.
    whole : (value, stddev) of the quantity that it is a part of, the sum of its terms; of a
        setting's number by how much it is usually off nil.  None: its own.
    fall : of the deviation what is open of how friction falls with speed: a size, no name.
    offset : constant that it is told with beyond its column, SI: see :func:`relaxed_at_zero`.
    """

    candidate: Candidate
    value: float
    stddev: float
    between: float = 0.0
    each: tuple[float, ...] = ()
    probability: float = np.nan
    stability: float = 1.0
    gained: float = 0.0
    named: bool = False
    rivals: tuple[str, ...] = ()
    whole: tuple[float, float] | None = None
    fall: float = 0.0
    offset: float = 0.0

    @property
    def quantity(self) -> tuple[float, float]:
        """Value and deviation of what it is, or is a part of."""
        return self.whole or (self.value, self.stddev)

    @property
    def presence(self) -> tuple[float, float]:
        """The same with the deviation that says whether it is there at all."""
        value, stddev = self.quantity
        return value, float(np.sqrt(max(stddev**2 - self.fall**2, 0.0)))


@dataclass(frozen=True)
class Model:
    """One balance over some recordings.

    Attributes
    ----------
    balance : its name; ``size`` rms of its signal, ``floor`` what the sensors leave of it, SI.
    tables : of the recordings; ``weights`` the parameters in each of them.
    terms : of the model; ``refused`` what did not pass a gate.
    nominal : (name, value, stddev) of the config's linear model, fitted.
    before, after : (m,) of each recording shown, what is left on unseen parts with the config's
        linear model and with the terms.
    shown : tables that these belong to: the recordings themselves, or one held out.
    effective : independent samples.
    learned : what has no name, as a curve; its term is among the named ones.
    """

    balance: str
    tables: tuple[Table, ...]
    weights: tuple[dict[str, float], ...]
    terms: tuple[Term, ...]
    refused: tuple[Refused, ...]
    nominal: tuple[tuple[str, float, float], ...]
    before: tuple[np.ndarray, ...]
    after: tuple[np.ndarray, ...]
    shown: tuple[Table, ...]
    effective: float
    learned: LearnedTerm | None = None

    @property
    def size(self) -> float:
        """Rms of the signal, SI."""
        return float(np.sqrt(np.mean([table.size**2 for table in self.shown])))

    @property
    def floor(self) -> float:
        """Rms that the sensors leave, SI."""
        return float(np.sqrt(np.mean([table.floor**2 for table in self.shown])))

    def share(self, left: Sequence[np.ndarray]) -> float:
        """Return the rms of what is left, as a share of the signal's."""
        return _whole_share(self.shown, left)

    @property
    def error(self) -> float:
        """Share of the signal that the model leaves on unseen parts."""
        return self.share(self.after)

    @property
    def nominal_error(self) -> float:
        """Share of the signal that the config's linear model leaves on unseen parts."""
        return self.share(self.before)

    @property
    def named(self) -> tuple[Term, ...]:
        """Terms that are answers."""
        return tuple(term for term in self.terms if term.named)

    def __getitem__(self, name: str) -> Term | None:
        return next((term for term in self.terms if term.candidate.name == name), None)

    @property
    def load(self) -> Term | None:
        """The constant load, if it is an answer."""
        return next((term for term in self.named if term.candidate.effect == LOAD), None)

    def load_alone(self) -> "Model":
        """Return the model with its constant load as its only answer; the rest is its form."""
        return replace(self, terms=tuple(replace(
            term, named=term.named and term.candidate.effect == LOAD) for term in self.terms))

    def plain(self) -> "Model":
        """Return the model without an answer: the config's own, and what was learned."""
        if self.learned is not None:
            return replace(self, terms=tuple(replace(
                term, named=term.candidate.name == LEARNED) for term in self.terms))
        return replace(self, terms=tuple(replace(term, named=False) for term in self.terms),
                       after=self.before)


def of_recordings(courses: Sequence[Course], rig: Rig, scale: Scale, balance: str, policy: Policy,
                  how: tuple[Sequence[str], Sequence[str]], more: tuple[Candidate, ...] = ()
                  ) -> Model:
    """Return the model of one balance of one recording, or of two.

    Parameters
    ----------
    how : what was varied; effects that are not considered.
    more : candidates beside the usual ones.
    """
    tables = tables_of(courses, rig, balance, (*candidates_of(balance, scale, rig, *how), *more),
                       policy)
    whole = pooled_table(tables)
    model = _of_table(whole, tables, rig, policy)
    if model.error <= max(policy.worse, policy.clean * model.floor / model.size):
        return model
    own = {term.candidate.effect for term in model.terms}
    curve = learned_curve(courses, whole, rig, {}, {
        one.name: np.inf for one in whole.candidates
        if one.always or one.name in FIRST_VIEW or (one.effect in own and model[one.name])},
        np.sqrt(policy.near) * min(model.error, model.nominal_error) * whole.size, policy)
    if curve is None:
        return model
    more = _of_table(whole, tables, rig, policy, curve)
    return more if more.error <= np.sqrt(policy.near) * model.error else model


def _of_table(whole: Table, tables: Sequence[Table], rig: Rig, policy: Policy,
              curve: LearnedCurve | None = None) -> Model:
    """Return the model of recordings' tables, which are one ``whole``, beside a learned curve."""
    balance, left, own = whole.balance, whole, {}
    lengths = np.cumsum([len(table.rows) for table in tables])[:-1]
    if curve is not None:
        left, own = replace(whole, rows=np.column_stack(
            [whole.rows[:, 0] - curve.column, whole.rows[:, 1:]])), {LEARNED: 1.0}
        tables = with_columns(tables, curve)
    found = alone(left, policy)
    names = [name.term for name in found.names]
    bare, held = nominal_of(balance, rig)
    weights = [{name: found.weights.get(f"{name} {i + 1}", found.weights.get(name))
                for name in (one.name for one in table.candidates)} for i, table in
               enumerate(tables)]
    terms = relaxed_at_zero(_terms_alone(left, found, len(tables), policy), policy)
    if curve is not None:
        terms += (Term(tables[0].candidates[-1], 1.0, 0.0, named=True),)
    model = Model(
        balance, tuple(tables), tuple({k: v for k, v in row.items() if v is not None} | own
                                      for row in weights),
        terms, found.refused, _nominal(whole, balance, rig, policy),
        tuple(np.split(whole.crosswise(bare, held), lengths)),
        tuple(np.split(left.crosswise(names), lengths)), tuple(tables), found.effective_samples,
        None if curve is None else curve.term)
    return _unseen_gate(model, policy)


def _terms_alone(whole: Table, found: Alone, count: int, policy: Policy) -> tuple[Term, ...]:
    """Return the terms of a pooled table; a setting's numbers as one term."""
    of = {one.name: one for one in whole.candidates}
    terms, loads = [], [name for name in found.names if of[name.term].always
                        and of[name.term].effect == LOAD]
    for name in found.names:
        if name not in loads:
            terms.append(Term(of[name.term], name.value, name.stddev, 0.0, (), name.probability,
                              name.frequency, name.gained, name.named, name.rivals,
                              name.whole, name.fall))
    if loads:
        values = [name.value for name in loads]
        stddev, fall = (rms([getattr(name, which) for name in loads])
                        for which in ("stddev", "fall"))
        names = [name.term for name in found.names]
        rest = [name for name in names if name not in {one.term for one in loads}]
        both = [_left(whole, names), _left(whole, rest)]
        there = np.sqrt(max(stddev**2 - fall**2, 0.0))
        named = max(map(abs, values)) > max(
            policy.varied * there, policy.small * whole.size) and (
                both[1] > both[0] * np.exp(policy.alone))
        one = of[loads[0].term]
        terms.append(Term(
            replace(one, name="F_0"), float(np.mean(values)), stddev, 0.0,
            tuple(values) if count > 1 and len(loads) > 1 else (), policy.certain, 1.0,
            whole.effective * float(np.log(both[1] / both[0])), named,
            _instead(whole, rest, both[0], LOAD, policy) if named else (),
            (rms(values), stddev), fall))
    return tuple(terms)


def relaxed_at_zero(terms: tuple[Term, ...], policy: Policy) -> tuple[Term, ...]:
    """Return terms in which a spring beside a load is relaxed at x = 0, alone if that is all.

    The column of a spring is k (x - x_0) with x_0 amid the motion, so that it is not that
    of a load F_0.  Of k (x - x_0) + F_0 no recording tells x_0 from F_0: what it knows is the
    force at x = 0, F_0 - k x_0, and that is what the load is then.
    """
    spring = next((t for t in terms if t.named and t.candidate.effect == "spring_load"), None)
    load = next((t for t in terms if t.named and t.candidate.effect == LOAD), None)
    if spring is None or load is None or spring.candidate.configured:  # relaxed at the config's
        return terms
    x_0 = dict(spring.candidate.shape)["x_0"]
    shift, stddev = spring.value * x_0, float(np.hypot(load.stddev, x_0 * spring.stddev))
    value, each = load.value - shift, tuple(value - shift for value in load.each)
    there = bool(each) or abs(value) > policy.varied * stddev
    size = rms(each) if each else value
    moved = replace(load, value=value, stddev=stddev, each=each, named=there, offset=-shift,
                    whole=None if load.whole is None else (size, stddev))
    relaxed = replace(spring, offset=shift, candidate=replace(spring.candidate,
                                                              shape=(("x_0", 0.0),)))
    return tuple(relaxed if term is spring else moved if term is load else term for term in terms)


def _left(table: Table, names: Sequence[str]) -> float:
    """Return the rms that terms leave where each half is fitted on the other, at least noise."""
    return max(table.rms(table.crosswise(names)), 1e-9)


def _instead(table: Table, rest: Sequence[str], error: float, effect: str, policy: Policy
             ) -> tuple[str, ...]:
    """Return the effects of which one, in place of what was left out, fits as well."""
    of = {one.name: one for one in table.candidates}
    there = {of[name].effect for name in rest}
    return tuple(dict.fromkeys(
        of[name].effect for name in of
        if of[name].effect not in (effect, *there) and not of[name].always
        and _left(table, [*rest, name]) <= error * np.exp(policy.gain)))


def of_machine(one: MachineBalance, courses: Sequence[Course], rig: Rig, scale: Scale,
               policy: Policy) -> Model:
    """Return the model of one balance that several recordings show."""
    bare, held = nominal_of(one.balance, rig)
    tables = tables_of(courses, rig, one.balance, [
        c for c in candidates_of(one.balance, scale, rig)
        if c.name in {*one.terms, *one.scatter.names, *bare, *held}], policy)
    of = {c.name: c for c in tables[0].candidates}
    plain = [replace(table, rows=np.column_stack([table.left(held), table.rows[:, 1:]]))
             for table in tables]
    together, whole = Recordings(tables, own_oil=True), pooled_table(tables)
    names = _with_one_of_unsure(one, together, whole, policy)
    if len(names) < len(one.terms):
        one = _refitted(one, names, tables_of(
            courses, rig, one.balance, candidates_of(one.balance, scale, rig), policy), policy)
    named = {name: family for family in one.named for name in family.terms}
    count, terms = max(len(one.error) - 1, 1), []
    own = {name: f"{name} 1" if f"{name} 1" in whole.places else name for name in one.terms}
    after = together.left_out(one.terms)
    lasting = form_and_doubts(whole, list(own.values()), _whole_share(tables, after), policy)
    biases = dict(zip(own, np.sqrt(np.diag(lasting)).tolist(), strict=True))
    found = {p.name: p for p in (*one.parameters, *one.settings)}
    forms = one.form_of
    sizes = [rms(np.atleast_1d(found[name].value)) for name in own]
    covariance = lasting + np.diag([rms(np.atleast_1d(found[name].stddev)) ** 2 for name in own])
    wholes = dict(zip(own, wholes_of(
        [of[name] for name in own], sizes, covariance, np.zeros((1, len(own)))), strict=True))
    load = "F_0" if "F_0" in one.terms else ""
    if load:
        gained, t = together.gain(
            together.errors([name for name in one.terms if name != load]),
            together.errors(one.terms))
        rows = next(((s.value, s.stddev) for s in one.settings if s.name == load), None) or next(
            ((p.value,), (p.stddev,)) for p in one.parameters if p.name == load)
        if gained >= policy.named and t >= policy.repeats and max(
                np.abs(rows[0]) - policy.varied * np.array(rows[1])) > policy.small * one.size:
            named[load] = Named((load,), gained, t)
    for p in (*one.parameters, *one.settings):
        family, c = named.get(p.name), of[p.name]
        values, sure = np.atleast_1d(p.value), np.nan
        if family is not None:
            sure = float(stdtr(count, family.t))
        shared = not c.setting
        stddev = float(np.hypot(np.max(p.stddev) if shared else values.std(), np.hypot(
            biases[p.name], forms.get(p.name, 0.0))))
        shows = policy.varied < from_absent(sizes, covariance, [
            of[name].kind == c.kind and of[name].always == c.always for name in own])
        terms.append(Term(
            c, float(values.mean()), stddev,
            p.between if shared else 0.0, () if shared else p.value, min(sure, policy.certain),
            1.0 if family is None else sure,
            0.0 if family is None else family.gain * one.effective,
            family is not None and shows and (not c.always or p.name == load),
            () if family is None else family.rivals,
            wholes[p.name] or (None if shared else (rms(values), float(np.hypot(
                rms(p.stddev), biases[p.name]))))))
    shared = {p.name: p.value for p in one.parameters}
    weights = tuple(shared | {s.name: s.value[i] for s in one.settings}
                    for i in range(len(tables)))
    model = Model(one.balance, tuple(tables), weights, relaxed_at_zero(tuple(terms), policy),
                  one.refused,
                  _nominal(whole, one.balance, rig, policy),
                  tuple(Recordings(plain).left_out(bare)),
                  tuple(after), tuple(tables), one.effective)
    return _unseen_gate(model, policy)


def _with_one_of_unsure(one: MachineBalance, together: Recordings, whole: Table, policy: Policy
                        ) -> list[str]:
    """Return the terms, one of them for a named family whose members are all unsure.

    Friction that grows with pressure and friction that does not share what each is (500 +- 700 N
    of 750): the term without whose rivals recordings left out lose least, and no more than
    ``worse`` of the signal.
    """
    names, found = list(one.terms), {p.name: p for p in one.parameters}
    own = [f"{name} 1" if f"{name} 1" in whole.places else name for name in names]
    lasting = dict(zip(names, np.diag(form_and_doubts(
        whole, own, one.unexplained, policy)).tolist(), strict=True))
    for family in one.named:
        members = [name for name in family.terms if name in found]
        if len(members) < 2 or any(policy.sure(p.value, float(np.sqrt(
                p.stddev**2 + lasting[p.name]))) for p in map(found.get, members)):
            continue
        rest = [name for name in names if name not in members]
        least, stays = ties.best(
            [(rms(together.errors([*rest, name])), name) for name in members], lambda of: -of[0])
        if least <= rms(together.errors(names)) + policy.worse:
            names = [name for name in names if name in rest or name == stays]
    return names


def _refitted(one: MachineBalance, names: Sequence[str], tables: list[Table], policy: Policy
              ) -> MachineBalance:
    """Return a balance with fewer terms, of tables that hold all candidates."""
    recordings, beside = Recordings(tables), Recordings(tables, own_oil=True)
    fit, of = recordings.fit(names), {p.name: p for p in (*one.parameters, *one.settings)}
    parameters = tuple(replace(of[name], value=float(value), between=float(between),
                               stddev=float(stddev)) for name, value, between, stddev in zip(
        fit.names, fit.value, fit.between, fit.stddev, strict=True))
    settings = tuple(replace(of[name], value=tuple(value.tolist()))
                     for name, value in zip(fit.settings, fit.setting.T, strict=True))
    return replace(
        one, parameters=parameters, settings=settings,
        forms=forms_of(recordings, beside, names, [*recordings.candidates], policy),
        named=tuple(replace(family, terms=tuple(
            name for name in family.terms if name in names)) for family in one.named))


def on_held_out(model: Model, course: Course, rig: Rig, policy: Policy) -> Model:
    """Return the model shown on another recording, whose load alone is fitted there."""
    (table,) = tables_of([course], rig, model.balance, tuple(model.tables[0].candidates), policy)
    before = table.left({name: value for name, value, _ in model.nominal})
    free = [t.candidate.name for t in model.terms if t.candidate.setting]
    held = {t.candidate.name: t.value for t in model.terms
            if not t.candidate.setting and t.candidate.name in table.places}
    after = table.crosswise([name for name in free if name in table.places], held)
    return _unseen_gate(replace(model, before=(before,), after=(after,), shown=(table,)), policy)


def _whole_share(tables: Sequence[Table], left: Sequence[np.ndarray]) -> float:
    """Return the rms of what is left of all recordings, as a share of the rms of their signals.

    The mean of each one's own share would be that of the recording in which least moves.
    """
    sizes = np.array([table.size for table in tables])
    return rms(sizes * [table.rms(one) for table, one in zip(tables, left, strict=True)]) / rms(
        sizes)


def _nominal(whole: Table, balance: str, rig: Rig, policy: Policy
             ) -> tuple[tuple[str, float, float], ...]:
    """Return the parameters of the config's linear model on a pooled table."""
    names, held = nominal_of(balance, rig)
    values, chance = parameters_of(whole, names, held)
    lasting = form_and_doubts(whole, names, whole.rms(whole.crosswise(names, held)), policy)
    stddev = np.hypot(chance, np.sqrt(np.diag(lasting + by_falls(whole, names, values)))).tolist()
    return (*zip(names, values, stddev, strict=True),
            *((name, value, 0.0) for name, value in held.items()))


def _unseen_gate(model: Model, policy: Policy) -> Model:
    """Return the model, or the config's own where it leaves less on unseen parts."""
    if not model.named and model.error > model.nominal_error:
        return model.plain()  # nothing is said, and nothing is won
    if not model.error > model.nominal_error + policy.worse:
        return model
    refused = Refused("unseen_error", model.balance, (
        f"on unseen parts {100 * model.error:.2g} % of the {model.balance} would stay open, with "
        f"the config's own model {100 * model.nominal_error:.2g} %"))
    return replace(model.plain(), refused=(*model.refused, refused))


def of_judged(tables: Sequence[Table], held: dict[str, float], now: dict[str, float],
              free: Sequence[str]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return what a machine's parameters leave of the next recordings, and the changed ones."""
    found: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for table in tables:
        for rows, weights in zip(found, (held, now), strict=True):
            value, _ = setting_of(table, [table.places[name] for name in weights],
                                  [table.places[name] for name in free],
                                  np.array(list(weights.values())))
            rows.append(table.left(weights | dict(zip(free, value, strict=True))))
    return found
