"""What a balance lacks and no candidate makes: a curve over one signal, learned on blocks.

    y = X w + f K c + rest,    least |rest|^2 + w'Rw + lambda |D c|^2

with the columns X that are free, K the knots' share of a table (:func:`own_term.cardinal`) over
the signal, f what it is multiplied by, and D second differences: a straight line costs nothing
(Eilers and Marx 1996).  Signal and lambda are those that leave least on blocks left out.  The term
is one of the config's own (``effects``), so every command runs with it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from eha_monitor import ties
from eha_monitor.balances.candidates import SIDES, Candidate, own_column
from eha_monitor.balances.course import STANDING, Course
from eha_monitor.balances.least_squares import independent, inverse_of, rms
from eha_monitor.balances.policy import Policy
from eha_monitor.balances.scatter import ridge_of
from eha_monitor.balances.table import FOLDS, Table
from eha_monitor.mismatch.diagnosis import LearnedTerm
from eha_monitor.mismatch.learn import formula as formulas
from eha_monitor.mismatch.learn.learned import Form, factor_along, signal_along
from eha_monitor.mismatch.learn.learned import Table as Knots
from eha_monitor.mismatch.learn.validated import LARGEST, PLACES, signals_of, statement_of
from eha_monitor.physics.own_term import OF_UNITS, cardinal
from eha_monitor.quantity import number, quantity, readable
from eha_monitor.settings.rig import Rig

# What the candidates have no law of.  No pressure of the force, which is made of them: |dp|
# against the motion is the force itself.  No speed: what a law over it leaves open is in the
# deviations of friction and damping (:mod:`bends`), and a curve would take it from them.
FORMS = {
    "force": (Form("force", "x", "direction"), Form("force", "x")),
    "flow": (Form("flow", "dp"), Form("flow", "x", "dp")),
}
# The law whose number is a constant curve, by what a table is multiplied by.
PARALLEL = {"direction": "F_c", "none": "F_0", "dp": "L"}
NAME = "learned"  # of its column in a table
KNOTS = 33
SMOOTH = tuple(10.0**k for k in range(-3, 5))  # lambda, of the mean square of a knot's column
COVERED = 0.002  # quantile of the signal at which a table ends
BARE = 1e-4  # of that mean square: what holds a knot of which nothing says anything, or a level
SHARP = 0.3  # of the standing speed: a moving piston has a direction
FEWEST = 2 * FOLDS  # blocks
BINS, IN_A_BIN = 33, 6  # of what was measured; samples in one
TRIED = 4  # formulas that are fitted to the recording


@dataclass(frozen=True)
class LearnedCurve:
    """A curve that holds on blocks that it was not fitted to.

    Attributes
    ----------
    column : (m,) what it makes in the table's band, of each block as learned without it, SI.
    error : rms that is left there, SI.
    beside : name -> by how much each free term differs from what is held of it beside the curve.
    term : its record.
    """

    column: np.ndarray
    error: float
    beside: dict[str, float]
    term: LearnedTerm


@dataclass(frozen=True)
class _Fit:
    """A penalised fit: ``left`` (m,) on blocks left out, ``made`` of the curve there."""

    smooth: float
    left: np.ndarray
    made: np.ndarray
    error: float


@dataclass(frozen=True)
class _Balance:
    """A balance with free columns.

    Attributes
    ----------
    names : (k,) of the free columns.
    y : (m,) what is open; ``free`` (m, k) columns; ``ridge`` (k,) what holds each.
    """

    table: Table
    names: tuple[str, ...]
    y: np.ndarray
    free: np.ndarray
    ridge: np.ndarray

    def without(self, at: int, made: np.ndarray) -> "_Balance":
        """Return the balance with a free column held, of which all is ``made``, (m,)."""
        return _Balance(self.table, (*self.names[:at], *self.names[at + 1 :]), self.y - made,
                        np.delete(self.free, at, axis=1), np.delete(self.ridge, at))

    def fits(self, curve: np.ndarray, penalty: np.ndarray, smooth: Sequence[float]) -> list[_Fit]:
        """Return the fit with columns (m, n) of a curve, for each weight of its penalty."""
        table, first = self.table, self.free.shape[1]
        rows = np.column_stack([self.y, self.free, curve])
        blocks = np.array([part.T @ part for part in (
            rows[table.good & (table.block == number)] for number in table.numbers)])
        # Either direction of a periodic motion is in a pair of blocks.
        fold, found = np.arange(len(table.numbers)) // 2 % FOLDS, []
        for weight in smooth:
            left, made = np.zeros(len(rows)), np.zeros(len(rows))
            for one in np.unique(fold):
                here = np.isin(table.block, table.numbers[fold == one])
                w = self.solved(blocks[fold != one].sum(axis=0), penalty, weight)
                made[here] = curve[here] @ w[first:]
                left[here] = self.y[here] - self.free[here] @ w[:first] - made[here]
            found.append(_Fit(weight, left, made, rms(left[table.good])))
        return found

    def products(self, curve: np.ndarray) -> np.ndarray:
        """Return the products of y, the free columns and those of a curve over the recordings."""
        rows = np.column_stack([self.y, self.free, curve])[self.table.good]
        return rows.T @ rows

    def whole(self, curve: "_Curve") -> np.ndarray:
        """Return the weights of the free columns and of a curve's, on all of the recordings."""
        return self.solved(self.products(curve.columns), curve.penalty, curve.fit.smooth)

    def inner(self, gram: np.ndarray, penalty: np.ndarray, weight: float) -> np.ndarray:
        """Return the matrix of the normal equations of products with y first."""
        inner, first = gram[1:, 1:].copy(), self.free.shape[1]
        share = gram[0, 0] / max(float(self.y[self.table.good] @ self.y[self.table.good]), 1e-300)
        inner[np.arange(first), np.arange(first)] += share * self.ridge
        knots = slice(first, None)
        mean = float(np.mean(np.diag(inner)[knots])) if len(penalty) else 0.0
        inner[knots, knots] += mean * (weight * penalty + BARE * np.eye(len(penalty)))
        return inner

    def solved(self, gram: np.ndarray, penalty: np.ndarray, weight: float) -> np.ndarray:
        """Return the weights of the free columns and of the curve's."""
        inner = self.inner(gram, penalty, weight)
        size = np.sqrt(np.maximum(np.diag(inner), 1e-300))
        return np.linalg.lstsq(inner / np.outer(size, size), gram[1:, 0] / size,
                               rcond=1e-12)[0] / size


@dataclass(frozen=True)
class _Curve:
    """A form over the range that recordings cover, with its fit."""

    knots: Knots
    columns: np.ndarray
    penalty: np.ndarray
    fit: _Fit


def learned_curve(courses: Sequence[Course], table: Table, rig: Rig, held: Mapping[str, float],
                  free: Mapping[str, float], most: float, policy: Policy) -> LearnedCurve | None:
    """Learn what a force or flow balance lacks; None where no curve leaves as little as it must.

    Parameters
    ----------
    courses : motions of the table, in their order.
    held : name -> parameter of the terms that are as they are.
    free : name -> spread of those that move, about the held value if they have one; infinite of
        those that may be anything.
    most : rms that it may leave on blocks left out, SI; and no more than ``near`` of the squares
        that are left without it, and what either direction says of it holds for the other.
    """
    if table.balance not in FORMS or len(table.numbers) < FEWEST:
        return None
    spreads = {name: spread for name, spread in free.items() if np.isfinite(spread)}
    ridge = np.zeros(len(free))
    ridge[np.isfinite(list(free.values()))] = ridge_of(table, spreads)
    balance = _Balance(table, tuple(free), table.left(dict(held)),
                       table.rows[:, [table.places[name] for name in free]], ridge)
    curves = [curve for form in FORMS[table.balance]
              if (curve := _curve(form, courses, balance, rig, policy)) is not None]
    if not curves:
        return None
    best = curves[ties.largest([-np.log(max(one.fit.error, 1e-300)) for one in curves],
                               policy.gain)]
    # A level of the curve is no place: its law's own number may be free, and stand in its stead.
    law = PARALLEL[best.knots.form.times]
    level = table.rows[:, [table.places[law]]] if law in table.places and law not in free else (
        np.zeros((len(balance.y), 0)))
    none = np.zeros((level.shape[1], level.shape[1]))
    before = balance.fits(level, none, (0.0,))[0].error
    best, balance, fixed = _within(best, balance, free, policy)
    w = balance.whole(best)
    if best.fit.error > min(most, np.sqrt(policy.near) * before) or not _either_way(
            best, w, courses, balance, policy):
        return None
    found = _learned(best, w, courses, balance, rig, before, policy)
    return replace(found, beside=found.beside | fixed)


def _within(curve: _Curve, balance: _Balance, free: Mapping[str, float], policy: Policy
            ) -> tuple[_Curve, _Balance, dict[str, float]]:
    """Return a curve and its balance with what is free within its spread, and what that holds.

    What the oil cannot be stays as far as it can be: else a damping that nobody has lets a curve
    be friction at every place.
    """
    fixed: dict[str, float] = {}
    while balance.names:
        spreads = np.array([free[name] for name in balance.names])
        moved = balance.whole(curve)[:len(spreads)]
        at = int(np.argmax(np.abs(moved) / spreads))
        if abs(moved[at]) <= policy.varied * spreads[at]:
            break
        value = float(np.sign(moved[at]) * policy.varied * spreads[at])
        fixed[balance.names[at]] = value
        balance = balance.without(at, value * balance.free[:, at])
        curve = replace(curve, fit=balance.fits(
            curve.columns, curve.penalty, (curve.fit.smooth,))[0])
    return curve, balance, fixed


def _either_way(curve: _Curve, w: np.ndarray, courses: Sequence[Course], balance: _Balance,
                policy: Policy) -> bool:
    """Tell whether the curve of either direction explains the other: leaves ``open`` of it.

    On a motion that repeats, place and direction say when it is: what follows each reversal is a
    function of them, and another one on the way back.
    """
    table = balance.table
    missing = balance.y - balance.free @ w[:balance.free.shape[1]]
    forwards = np.concatenate([course.compared(course.v) for course in courses]) > 0.0
    bare = replace(balance, names=(), y=missing, free=balance.free[:, :0], ridge=np.zeros(0))
    left = np.zeros(len(missing))
    for here, there in ((forwards, ~forwards), (~forwards, forwards)):
        own = np.column_stack([missing, curve.columns])[table.good & here]
        if not len(own) or not (table.good & there).any():
            return False
        left[there] = missing[there] - curve.columns[there] @ bare.solved(
            own.T @ own, curve.penalty, curve.fit.smooth)
    return rms(left[table.good]) ** 2 <= policy.open * rms(missing[table.good]) ** 2


def with_column(table: Table, curve: LearnedCurve) -> Table:
    """Return a table with the column of a curve, whose parameter is 1."""
    unit = SIDES[table.balance]
    return replace(table, rows=np.column_stack([table.rows, curve.column]), candidates=(
        *table.candidates, Candidate(NAME, NAME, table.balance, unit, "the learned term", 0,
                                     lambda course, rig: None, odd=False)))


def with_columns(tables: Sequence[Table], curve: LearnedCurve) -> tuple[Table, ...]:
    """Return the tables of which a curve's is made, each with its part of the column."""
    lengths = np.cumsum([len(table.rows) for table in tables])[:-1]
    return tuple(with_column(table, replace(curve, column=part)) for table, part in zip(
        tables, np.split(curve.column, lengths), strict=True))


def _curve(form: Form, courses: Sequence[Course], balance: _Balance, rig: Rig, policy: Policy
           ) -> _Curve | None:
    """Return a form's best fit; None where channels or motion are missing."""
    if {form.of, form.times} & {"dp", "p"} and any(c.p1 is None or c.p2 is None for c in courses):
        return None
    tracks, table = [course.track() for course in courses], balance.table
    signal = [signal_along(track, form.of) for track in tracks]
    whole = np.concatenate([one[course.counted(table.balance)]
                            for one, course in zip(signal, courses, strict=True)])
    first, last = np.quantile(whole, [COVERED, 1.0 - COVERED])
    if not last - first > 1e-6 * max(float(np.abs(whole).max()), 1e-300):
        return None
    scale = {"direction": SHARP * STANDING * max(course.speed for course in courses),
             "dp": max(float(np.abs(signal_along(track, "dp")).max()) for track in tracks)
             }.get(form.times, 1.0)
    columns = np.vstack([course.in_band(_in_balance(
        form.adds, cardinal(along, KNOTS, first, last) * factor_along(
            track, form.times, scale)[:, None], course, rig))
        for along, track, course in zip(signal, tracks, courses, strict=True)])
    bend = np.diff(np.eye(KNOTS), 2, axis=0)
    penalty = bend.T @ bend
    fits = balance.fits(columns, penalty, SMOOTH)
    best = ties.largest([-np.log(max(fit.error, 1e-300)) for fit in fits[::-1]], policy.gain)
    return _Curve(Knots(form, float(first), float(last), float(scale), np.nan), columns, penalty,
                  fits[::-1][best])


def _in_balance(adds: str, values: np.ndarray, course: Course, rig: Rig) -> np.ndarray:
    """Return what own terms (n, k) add to the balance, as :func:`candidates.own_column`."""
    if adds == "force":
        return values
    return np.stack([course.of_filled(one, one * rig.area_1 / rig.area_2) for one in values.T],
                    axis=1)


def _learned(curve: _Curve, w: np.ndarray, courses: Sequence[Course], balance: _Balance, rig: Rig,
             before: float, policy: Policy) -> LearnedCurve:
    """Return a curve with its formula, if one says as much, as a record.

    Parameters
    ----------
    w : weights of the free columns and of the curve's, of the whole recordings.
    before : rms that is left without it.
    """
    table, knots, form = balance.table, curve.knots, curve.knots.form
    gram, first = balance.products(curve.columns), balance.free.shape[1]
    left = np.where(table.good, curve.fit.left, np.nan)
    noise = curve.fit.error**2 * independent(left)
    covariance = noise * inverse_of(
        balance.inner(gram, curve.penalty, curve.fit.smooth))[first:, first:]
    values, places = w[first:], knots.knots(KNOTS)
    beside = balance
    if PARALLEL[form.times] in balance.names:
        # Only the sum of that law's number and a level of the curve is known: the law's it is.
        at, level = balance.names.index(PARALLEL[form.times]), float(np.median(values))
        values, made = values - level, level * curve.columns.sum(axis=1)
        curve = replace(curve, fit=replace(curve.fit, made=curve.fit.made - made))
        beside = balance.without(at, w[at] * balance.free[:, at] + made)
    divisor = knots.scale if form.times == "dp" else 1.0
    fits = sorted((fit for shape in formulas.SHAPES if (fit := formulas.on_curve(
        shape, places, values / divisor, covariance / divisor**2, form.of))),
        key=lambda fit: fit[0])
    made = sorted((_in_recording(fit, curve, values / divisor, courses, beside, rig)
                   for fit in fits[:TRIED]), key=lambda one: one.fit.error)
    made = [one for one in made if one.lies_within(knots)]
    honest = bool(made and made[0].fit.error <= curve.fit.error * np.exp(policy.gain))
    best = made[0].fit if honest else curve.fit
    size = quantity(float(np.quantile(np.abs(best.made[table.good]), LARGEST)),
                    SIDES[table.balance], 3)
    x = np.linspace(knots.first, knots.last, PLACES)
    basis = cardinal(x, KNOTS, knots.first, knots.last)
    band = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", basis, covariance, basis), 0.0))
    beyond = before**2 - table.floor**2
    at, measured, spread = _measured(curve, courses, balance)
    formula = made[0].shown if honest else ""
    term = LearnedTerm(
        table.balance, form.adds, signals_of(form), statement_of(
            form, formula, size) + ("" if formula else extent(form, x, basis @ values)), size,
        formulas.unit_of(form, "y"), OF_UNITS[form.of], x, basis @ values / divisor,
        band / divisor, at, measured / divisor, spread / divisor, formula,
        made[0].shape if honest else "",
        tuple((one.shown, table.effective * float(np.log(one.fit.error / best.error)))
              for one in made[honest:]),
        made[0].along(x) if made else np.full(PLACES, np.nan),
        1.0 - max(best.error**2 - table.floor**2, 0.0) / beyond if beyond > 0.0 else 0.0,
        table.effective * float(np.log(before / best.error)),
        made[0].entry if honest else knots.entry(values))
    return LearnedCurve(best.made, best.error, dict(zip(
        balance.names, w[:first].tolist(), strict=True)), term)


def extent(form: Form, x: np.ndarray, curve: np.ndarray) -> str:
    """Return where a curve is more than half as large as at its largest, in words.

    "" where that is more than half of what was recorded, or not in one piece.
    """
    large = np.abs(curve) > 0.5 * np.abs(curve).max()
    there = np.flatnonzero(large)
    if len(there) > 0.5 * len(x) or not large[there[0] : there[-1] + 1].all():
        return ""
    of, unit = formulas.SHOWN.get(form.of, form.of), OF_UNITS[form.of]
    scale = readable(float(np.abs(x).max()), unit)
    first, last = (number(float(at) * scale.factor, 2) for at in x[there[[0, -1]]])
    return f", between {of} = {first} and {last} {scale.unit}"


@dataclass(frozen=True)
class _Formula:
    """A formula fitted to recordings; ``along`` gives its curve over the signal."""

    shape: str
    shown: str
    entry: dict
    values: dict[str, float]
    along: Callable[[np.ndarray], np.ndarray]
    fit: _Fit

    def lies_within(self, knots: Knots) -> bool:
        """Tell whether a bump or a threshold lies in what was recorded; a wave lies everywhere."""
        place = self.values.get(formulas.PLACE)
        return place is None or "sin(" in self.entry["expression"] or (
            knots.first <= place <= knots.last)


def _in_recording(found: tuple, curve: _Curve, y: np.ndarray, courses: Sequence[Course],
                  balance: _Balance, rig: Rig) -> _Formula:
    """Return a formula, fitted to a curve (n,) before, fitted to the recordings themselves."""
    _, shape, start = found
    form, good = curve.knots.form, balance.table.good
    held = np.diag(np.sqrt(balance.ridge))[balance.ridge > 0.0]
    basis = np.linalg.qr(np.vstack([balance.free[good], held]))[0]

    def column(values: dict[str, float]) -> np.ndarray:
        text, all_ = formulas.as_expression(shape, form, values, curve.knots.scale)
        return np.nan_to_num(np.concatenate([course.in_band(own_column(
            {"adds": form.adds, "expression": text, **all_}, course, rig))
            for course in courses]), posinf=0.0, neginf=0.0)

    def left(values: dict[str, float]) -> np.ndarray:
        rest = np.concatenate([(balance.y - column(values))[good], np.zeros(len(held))])
        return rest - basis @ (basis.T @ rest)

    _, values = formulas.fitted_shape(shape, start, curve.knots.knots(KNOTS), y, left)
    text, all_ = formulas.as_expression(shape, form, values, curve.knots.scale)
    fit = balance.fits(column(values)[:, None], np.zeros((1, 1)), (0.0,))[0]
    return _Formula(shape.name, formulas.shown_as(shape, form, values),
                    {"adds": form.adds, "expression": text, **all_}, values,
                    lambda at: formulas.curve_of(formulas.in_signal(shape.text, form.of), values,
                                                 form.of, at), fit)


def _measured(curve: _Curve, courses: Sequence[Course], balance: _Balance
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places, values and spread of a curve as the recordings show it, (k,) each.

    In each bin of the signal the value g that makes g times the factor nearest to what is missing.
    """
    knots, form = curve.knots, curve.knots.form
    tracks = [course.track() for course in courses]
    at = np.concatenate([course.compared(signal_along(track, form.of))
                         for track, course in zip(tracks, courses, strict=True)])
    factor = curve.columns.sum(axis=1)  # of a curve of one
    missing = curve.fit.left + curve.fit.made
    edges, rows = np.linspace(knots.first, knots.last, BINS + 1), []
    for low, high in pairwise(edges):
        here = balance.table.good & (low <= at) & (at < high)
        power = float(factor[here] @ factor[here])
        if here.sum() >= IN_A_BIN and power > 0.0:
            value = float(factor[here] @ missing[here]) / power
            rows.append((0.5 * (low + high), value, np.sqrt(np.mean(
                (missing[here] - value * factor[here]) ** 2) * here.sum() / power)))
    return tuple(np.array(rows).T) if rows else (np.zeros(0),) * 3
