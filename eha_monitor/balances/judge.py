"""The next recording of a machine: what of it has changed, in a fraction of a second."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from eha_monitor import ties
from eha_monitor.balances.alone import covariance_by_chance, form_and_doubts
from eha_monitor.balances.candidates import balances_in, candidates_of
from eha_monitor.balances.course import Course
from eha_monitor.balances.machine import Machine, MachineBalance, Setting, oil_of, usual_of
from eha_monitor.balances.model import LOAD
from eha_monitor.balances.named import FORCE_OF_SENSORS
from eha_monitor.balances.policy import POLICY, Policy
from eha_monitor.balances.scatter import Amplitudes, Scatter, amplitudes_of, limit_of, ridge_of
from eha_monitor.balances.table import Table, pooled_table, tables_of
from eha_monitor.balances.together import minimum_norms, setting_of, unseen
from eha_monitor.settings.monitor import Settings

MOST_CHANGES = 3  # that are looked for in one balance
WEARS, WEAR = "F_c", "dry"
OIL = ("compliance", "entrained_air")  # that every machine has, however little it does
OF_PLACE = ("spring_load", "position_load")  # they hold a load of their own
ERROR = 1.5  # times the largest of the machine's own recordings: the balance does not belong


@dataclass(frozen=True)
class Moved:
    """A parameter in the next recording.

    Attributes
    ----------
    name, effect, balance, words, unit, symbol : of its candidate.
    here, stddev : in the recording; ``machine``, ``spread`` over the machine's own.
    deviations : Student's t; ``limit`` beyond which it has changed.
    removed : by how much the change lowers the error, as a share of the signal.
    rivals : effects that explain the recording as well.
    apart : deviation of the difference, which does not hold what both values share.
    """

    name: str
    effect: str
    balance: str
    words: str
    unit: str
    here: float
    stddev: float
    machine: float
    spread: float
    deviations: float
    limit: float
    removed: float = 0.0
    rivals: tuple[str, ...] = ()
    symbol: str = ""
    apart: float = np.nan


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
    free : terms of the recording's own setting.
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


@dataclass(frozen=True)
class Judged:
    """The next recording beside the machine.

    Attributes
    ----------
    settings : the numbers of its setting, by name: (value, stddev).
    values : each of the machine's parameters, as the recording has it, the same.
    """

    source: str
    balances: tuple[JudgedBalance, ...]
    settings: dict[str, tuple[float, float]] = field(default_factory=dict)
    values: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def changed(self) -> tuple[Moved, ...]:
        """Parameters beyond what the machine's own recordings do, what explains most first."""
        return tuple(sorted((moved for one in self.balances for moved in one.changed),
                            key=lambda moved: -moved.removed))

    @property
    def loud(self) -> tuple[JudgedBalance, ...]:
        """Balances that leave more than any of the machine's own recordings."""
        return tuple(one for one in self.balances if is_loud(
            one.error, one.usual, one.size, one.table) and one.error - one.usual > POLICY.worse)

    @property
    def belongs(self) -> bool:
        """Whether it is like the machine's own recordings."""
        return not self.loud and all(one.complete and not one.changed for one in self.balances)

    @property
    def explained(self) -> bool:
        """Whether what has changed has names: nothing else has, little, or less than they do."""
        return bool(self.changed) and all(
            one.complete or one.after - one.usual <= POLICY.worse
            or explains(one.error, one.after, one.usual) for one in self.balances)


def judge(machine: Machine, courses: Sequence[Course], settings: Settings) -> Judged:
    """Judge motions of one state against a machine: together, by their balances alone."""
    rig = settings.rig
    found, own, values, there = [], {}, {}, balances_in(courses, rig)
    for one in machine.balances:
        if one.balance not in there:
            continue
        loading = next((s for s in one.settings if s.effect == LOAD), None)
        candidates = tuple(c for c in candidates_of(one.balance, machine.scale, rig)
                           if c.name in {*one.terms, *one.scatter.names})
        compared = courses if one.balance != "drive" else within_speed(
            courses, machine.scale.tops[:1])
        if not all(course.good.any() for course in compared):
            continue
        tables = tables_of(compared, rig, one.balance, candidates, machine.policy)
        table = pooled_table(tables)
        usual, loose = usual_of(one.settings, {
            c.name: c for c in candidates if c.name in table.places})
        held = {p.name: p.value for p in one.parameters if p.name in table.places} | usual
        loads = {s.name for s in one.settings if s.name not in usual}
        free = [name for name in table.places if name.partition(" ")[0] in loads]
        value, stddev = setting_of(table, [table.places[name] for name in held],
                                   [table.places[name] for name in free],
                                   np.array(list(held.values())))
        own |= {name: (float(v), float(d)) for name, v, d in zip(free, value, stddev,
                                                                 strict=True)}
        signed = {c.name for c in candidates if c.sign and c.effect not in settings.effects}
        given = Given(loading, signed, loose, rig.mass)
        found.append(replace(_judged(machine, one, table, held, free, given),
                             each=tuple(tables)))
        fitted = list(dict.fromkeys([
            *(name for name in found[-1].now if name in table.places), *free]))
        # All together: else damping takes up the friction that came.
        here, chance = covariance_by_chance(table, fitted)
        covariance = chance + form_and_doubts(table, fitted, found[-1].after, machine.policy)
        values |= {name: row for name, *row in zip(
            fitted, here, np.sqrt(np.diag(covariance)).tolist(), strict=True) if name in held}
    return Judged(", ".join(one.source for one in courses), tuple(found), own, values)


def within_speed(courses: Sequence[Course], tops: Sequence[float]) -> list[Course]:
    """Return motions without the samples that ask for more speed than any healthy recording.

    What a drive does there, at its limit for example, nobody has seen in health.
    """
    return [replace(course, good=course.good & (np.abs(course.wanted) <= top))
            for course in courses for top in tops] or list(courses)


class Given(NamedTuple):
    """What is known of a setting and of the config.

    Attributes
    ----------
    load : of the machine's recordings; compared last, beside all else.
    signed : terms of which the config holds nothing, so that their sign is that of physics.
    loose : spread of what a setting has beside its load.
    mass : of the config, kg.
    """

    load: Setting | None
    signed: set[str]
    loose: dict[str, float]
    mass: float


def _judged(machine: Machine, one: MachineBalance, table: Table, held: dict[str, float],
            free: list[str], given: Given) -> JudgedBalance:
    """Return what has changed in one balance: one more term at a time, until none is far."""
    load, signed, loose, mass = given
    policy = machine.policy

    def error(weights: dict[str, float]) -> float:
        known = {own: value for name, value in weights.items() for own in columns_of(name, table)}
        return unseen(table, [table.places[name] for name in known],
                      [table.places[name] for name in free if name not in known],
                      np.array(list(known.values())))

    def with_step(weights: dict[str, float], name: str, step: float
                  ) -> tuple[float, dict[str, float]]:
        """Return the error with a term moved, the oil at its best beside it, and the weights."""
        more = weights | {name: weights.get(name, 0.0) + float(step)}
        others = {key: value for key, value in oil.items() if key != name}
        return error(with_oil(table, more, free, others, policy)), more

    of = {c.name: c for c in table.candidates}
    surely = {name: value for name, value in held.items()
              if of[name].always or of[name].effect in OIL or any(
                  name in family.terms for family in one.named)}
    forms = one.form_of
    if "dM" in of:
        surely["dM"] = mass + held.get("dM", 0.0)
    order = {c.name: i for i, c in enumerate(table.candidates)}
    oil = loose | oil_of([p for p in one.parameters if p.name in of], of, policy)
    names = [name for name in one.scatter.names
             if name in table.places and name in one.beside.names]
    scatter, beside = one.scatter.only(names), one.beside.only(names)
    left, free_oil = (amplitudes_of(table, held, free, names, spreads)
                      for spreads in (loose, oil))
    first, changes, now = left, [], dict(held)
    largest, complete = None, not names
    while names:
        # Beyond what its own recordings do, the oil held or free within its spread.
        t, far = _farther(scatter, left, beside, free_oil, policy)
        place = ties.largest(far)
        if largest is None:
            largest = _moved(scatter, table, (held, forms), first, place, t[place],
                             scatter.limit[place])
        complete = bool(far[place] <= 1.0)
        if complete or len(changes) == MOST_CHANGES:
            break
        amount, gone = left.with_others(oil, scatter.mean, policy.varied)
        taken = [name for name, _ in changes]
        gone[[name in taken or (name in signed and of[name].sign * (
            now.get(name, 0.0) + step) < 0.0) for name, step in zip(
                left.names, amount, strict=True)]] = -np.inf
        before = error(with_oil(table, now, free, oil, policy))
        # That something has changed, a term shows that goes farther than healthy recordings do;
        # which it is, what explains the recording; and whether it matters, what is named.
        shows = ties.largest(np.where(far > 1.0, gone, -np.inf))
        if not (far[shows] > 1.0 and gone[shows] > 0.0):
            complete = True  # what is far is no physics: the balance's error says whether it is
            break
        removed = np.where(far * np.array(scatter.limit) > policy.varied, gone, -np.inf)
        most = float(removed.max())
        # What removes nearly as much is a rival.  Of what leaves the same, a number that the
        # machine has comes first, then what stands first among the candidates.  But a seal wears
        # before a load or a spring comes to a machine; its oil is another matter.
        by_oil = min(left.gone_with(oil, policy.varied), most)  # which is free beside each
        equal = [i for i in range(len(removed)) if removed[i] - by_oil >= (
            most - by_oil) * np.exp(-2.0 * policy.alone)]
        i = min((i for i in equal if left.left - removed[i] <= max(
            left.left - most, table.n * table.floor**2) * np.exp(2.0 * policy.alone)),
                key=lambda i: (left.names[i] != WEARS, left.names[i] not in held,
                               order[left.names[i]]))
        if not of[left.names[i]].of_oil:
            i = next((j for j in equal if left.names[j] == WEARS), i)
        name, step, usual = left.names[i], float(amount[i]), max(one.held)
        (after, more), own = with_step(now, name, step), abs(own_part(name, table, surely))
        if not abs(step) > policy.worse * own or not (
                before - after > policy.worse or abs(step) > policy.near * own > 0.0
                or (is_loud(before, usual, one.size, table) and explains(before, after, usual))):
            complete = True  # too little to repair a machine for
            break
        equal.remove(i)
        rivals = tuple(dict.fromkeys([*of[name].twins, *(
            other for j in equal if (other := of[left.names[j]].effect) != of[name].effect)]))
        changes.append((name, _moved(scatter, table, (held, forms), replace(
            left, value=scatter.mean + amount), i, t[i], scatter.limit[i], before - after,
                rivals)))
        now = more
        left, free_oil = (each.moved(i, float(amount[i])) for each in (left, free_oil))

    now = with_oil(table, now, free, {
        key: value for key, value in oil.items() if key not in dict(changes)}, policy)
    moved = _load(machine, table, now, free, load)
    if moved is not None and not any(m.effect in OF_PLACE for _, m in changes):
        free = [name for name in free if name not in columns_of(moved.name, table)]
        held, now = held | {moved.name: moved.machine}, now | {moved.name: moved.here}
        changes.append((moved.name, replace(moved, removed=error(held) - error(now))))
    held = with_oil(table, held, free, oil, policy)
    return JudgedBalance(one.balance, table, held, now, error(held), error(now),
                         max(one.held),
                         tuple(moved for _, moved in changes), complete, largest, one.size,
                         tuple(free))


def _farther(scatter: Scatter, left: Amplitudes, beside: Scatter, loose: Amplitudes,
             policy: Policy) -> tuple[np.ndarray, np.ndarray]:
    """Return Student's t of each term, (k,), and how far it is in limits, by what says more.

    Beyond 1 it is farther than a healthy recording goes, and than this one's own deviations.
    """
    rows = []
    for own, found in ((scatter, left), (beside, loose)):
        t, mean = own.t_of(found), np.array(own.mean)
        known = np.abs(found.value - mean) > policy.varied * np.array(found.stddev)
        limits = np.abs(t) / np.array(own.limit)
        rows.append((t * np.array(scatter.limit) / np.array(own.limit),
                     np.where(np.isfinite(t) & known, limits, 0.0)))
    (t, far), (other, farther) = rows
    return np.where(farther > far, other, t), np.maximum(far, farther)


def explains(before: float, after: float, usual: float) -> bool:
    """Tell whether a change explains half of the squared error beyond the usual one."""
    return before**2 - after**2 > 0.5 * (before**2 - usual**2)


def is_loud(error: float, usual: float, size: float, table: Table) -> bool:
    """Tell whether a balance leaves more than any of the machine's own recordings.

    Parameters
    ----------
    error, usual : shares of this signal, and of the machine's own, whose usual size is ``size``:
        in a quiet motion the same newtons are a larger share.
    """
    return error > ERROR * max(usual * max(size / table.size, 1.0), table.floor / table.size)


def with_oil(table: Table, weights: dict[str, float], free: Sequence[str],
             oil: dict[str, float], policy: Policy) -> dict[str, float]:
    """Return parameters with those of the oil moved to what fits best, within their spread."""
    if not oil:
        return weights
    places = [table.places[name] for name in (*free, *oil)]
    ridge = np.diag([*np.zeros(len(free)), *ridge_of(table, oil)])
    side = table.gram[places] @ table.mixture(table.gram, (), weights)
    moved = minimum_norms(table.gram[np.ix_(places, places)] + ridge,
                          side[:, None])[len(free) :, 0]
    most = policy.varied * np.fromiter(oil.values(), float, len(oil))
    return weights | {name: weights.get(name, 0.0) + float(step)
                      for name, step in zip(oil, np.clip(moved, -most, most), strict=True)}


def columns_of(name: str, table: Table) -> list[str]:
    """Return the columns of a term: of a setting's number one for each of several recordings."""
    return [own for own in table.places if own == name or own.rpartition(" ")[0] == name]


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


def _load(machine: Machine, table: Table, now: dict[str, float], free: list[str],
          load: Setting | None) -> Moved | None:
    """Return the constant load where it differs from those of the machine's recordings.

    By more than they differ among themselves; or the zero of a pressure sensor does.
    """
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
    spread = max(spread, float(np.median(load.stddev)))
    t = (here - mean) / np.hypot(spread * np.sqrt(1.0 + 1.0 / runs), stddev)
    limit = limit_of(runs, 1.0, policy.false)
    if not abs(t) > limit or not abs(here - mean) > policy.worse * table.size:
        return None
    c = table.candidates[table.places[own[0]] - 1]
    return Moved(load.name, c.effect, c.balance, c.words, c.unit, here,
                 float(np.hypot(stddev, spread)), mean, spread, float(t), limit, 0.0,
                 FORCE_OF_SENSORS, c.symbol)


def _moved(scatter: Scatter, table: Table, own: tuple[dict[str, float], dict[str, float]],
           found: Amplitudes, i: int, t: float, limit: float, removed: float = 0.0,
           rivals: tuple[str, ...] = ()) -> Moved:
    """Return a term of a recording beside the machine's.

    Parameters
    ----------
    own : the machine's parameters, and how far each goes with other shapes of its family that
        fit as well: healthy and present value share it, their difference does not.
    """
    name, (held, forms) = found.names[i], own
    c = table.candidates[table.places[name] - 1]
    if c.family == WEAR and not c.upon:  # of any shape it is a force
        base = own_part(name, table, held)
        form = float(np.linalg.norm([own_part(name, table, {other: value})
                                     for other, value in forms.items() if other in held]))
    else:
        base, form = held.get(name, 0.0), forms.get(name, 0.0)
    spread = float(np.hypot(scatter.spread[i], form))
    return Moved(name, c.effect, c.balance, c.words, c.unit, base + float(found.value[i]),
                 float(np.hypot(found.stddev[i], spread)), base + scatter.mean[i], spread,
                 float(t), limit, removed, rivals, c.symbol,
                 float(np.hypot(found.stddev[i], scatter.spread[i])))
