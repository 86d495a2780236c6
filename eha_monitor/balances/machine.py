"""One machine from many recordings: structure, parameters, their spread, and what stays open."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter, ValidationError

from eha_monitor.balances.alone import Refused, between_forms, form_and_doubts, movement
from eha_monitor.balances.candidates import (
    BASE,
    FIRST_VIEW,
    Candidate,
    Scale,
    balances_in,
    candidates_of,
    sum_of_pressures,
)
from eha_monitor.balances.contact import contacts_of
from eha_monitor.balances.course import BAND, Course
from eha_monitor.balances.discrepancy import Regime, learned, regimes, signals_of
from eha_monitor.balances.least_squares import rms
from eha_monitor.balances.oil import UNKNOWN, Stiffness, stiffness_of
from eha_monitor.balances.policy import POLICY, Policy
from eha_monitor.balances.scatter import Scatter, scatter_of
from eha_monitor.balances.table import Table, nominal_of, tables_of
from eha_monitor.balances.together import (
    Chosen,
    Named,
    Recordings,
    left_alone,
    of_one_machine,
    pooled,
)
from eha_monitor.errors import InputError
from eha_monitor.output import finite, write_json
from eha_monitor.quantity import quantity, share
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig

SCHEMA = "eha_monitor/balances/1"
SHORTEST_S = 1.0  # of a part
OTHER = 2.0  # times a number of the config: it is of another machine
PIECES = 8  # in which fewer recordings than a machine needs are cut, together
# Numbers of the rig that a balance takes as known.
NUMBERS = ("mass", "leakage", "makeup_conductance", "pump_displacement", "position_gain",
           "volume_1", "volume_2", "charge_pressure")
LEAST = 0.25  # of the typical spread: a few others may agree by chance
LEVELS = (0.05, 0.95)  # quantiles of the force that stand for the load in the flexible reference


@dataclass(frozen=True)
class Parameter:
    """A number of the machine; SI.

    Attributes
    ----------
    between : spread between recordings; ``stddev`` of the value, which contains that spread.
    """

    name: str
    effect: str
    words: str
    unit: str
    value: float
    between: float
    stddev: float


@dataclass(frozen=True)
class Setting:
    """A number that belongs to the setting of each recording; ``varies`` beyond its deviations.

    Attributes
    ----------
    doubts : per recording, how far it goes with each doubt of the left side (areas, lateness),
        which are in ``stddev``, and the same in all recordings of a machine; empty in older files.
    """

    name: str
    effect: str
    words: str
    unit: str
    value: tuple[float, ...]
    stddev: tuple[float, ...]
    varies: bool
    doubts: tuple[tuple[float, ...], ...] = ()

    @property
    def own_stddev(self) -> np.ndarray:
        """Standard deviations without what the recordings of a machine have in common."""
        shared = np.array([np.linalg.norm(one) for one in self.doubts] or [0.0])
        return np.sqrt(np.maximum(np.array(self.stddev) ** 2 - shared**2, 0.0))


@dataclass(frozen=True)
class MachineBalance:
    """One balance of the machine.

    Attributes
    ----------
    balance : ``force``, ``flow`` or ``drive``.
    parameters, settings : of its terms.
    each, each_stddev : recording x parameter, each fitted to that recording alone.
    nominal, error : of each recording left out, over the standard deviation of its balance:
        with the terms of the config, and with those chosen on the others.  ``held`` the latter
        with what goes with the oil held as well: what the next recording is judged by.
    learned, reference : the same with what repeats but has no name beside the chosen terms, and
        with a flexible function of the signals in place of all physics.
    repeats : share of the squared error that repeats from recording to recording without a name.
    regimes : where the error lies.
    size : usual standard deviation of the balance, SI; ``floor`` what the sensors leave of it;
        ``effective`` independent samples in all recordings.
    named : families of terms that are named; the rest corrects their form.
    scatter : by how much each term would move in one recording or another; ``beside`` the same
        where what goes with the oil is free within its spread.
    refused : gates that something did not pass.
    forms : of each term, by how much it goes with the shapes of its family that fit as well.
    levers : of each parameter, rms of its column over that of the signal, 1/SI.
    alone : what each recording leaves where the terms are fitted to itself, SI.
    errors : (m, m) of each parameter, how far it goes with each independent error of the fit, SI;
        empty in older files.
    """

    balance: str
    parameters: tuple[Parameter, ...]
    settings: tuple[Setting, ...]
    each: tuple[tuple[float, ...], ...]
    each_stddev: tuple[tuple[float, ...], ...]
    nominal: tuple[float, ...]
    error: tuple[float, ...]
    learned: tuple[float, ...]
    reference: tuple[float, ...]
    repeats: float
    regimes: tuple[Regime, ...]
    size: float
    floor: float
    effective: float
    named: tuple[Named, ...]
    scatter: Scatter
    beside: Scatter
    refused: tuple[Refused, ...] = ()
    held: tuple[float, ...] = ()
    forms: tuple[float, ...] = ()
    levers: tuple[float, ...] = ()
    alone: tuple[float, ...] = ()
    errors: tuple[tuple[float, ...], ...] = ()

    @property
    def errors_of(self) -> dict[str, np.ndarray]:
        """``errors`` by the parameters' names."""
        return {p.name: np.array(row) for p, row in zip(
            self.parameters, self.errors, strict=False)}

    @property
    def form_of(self) -> dict[str, float]:
        """``forms`` by the terms' names; files of an older version hold none."""
        return dict(zip(self.terms, self.forms, strict=False))

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of all its terms."""
        return tuple(one.name for one in (*self.parameters, *self.settings))

    @property
    def effects(self) -> frozenset[str]:
        """What is in it."""
        return frozenset(one.effect for one in (*self.parameters, *self.settings))

    @property
    def unexplained(self) -> float:
        """RMS of the error on recordings left out, over the standard deviation."""
        return rms(self.error)


@dataclass(frozen=True)
class Odd:
    """A recording that does not belong, and why; ``place`` among the machine's recordings."""

    source: str
    why: str
    place: int = -1


@dataclass(frozen=True)
class Machine:
    """A machine: what its recordings have in common, and how they differ.

    Attributes
    ----------
    rig : its name; ``sources`` the recordings.
    scale : shapes of the candidates are shares of it.
    load_varied : whether the recordings differ in load, or in mean pressure.
    pieces : they are parts of fewer recordings.
    stiffness : of the oil, by least squares.
    areas : of the rig, m^2; None of a file that does not hold them.
    mass, displacement : of the config that its balances were made with, kg and m^3/rad; None of a
        file that does not hold them, or of a rig without.
    oil, apart : whose oil its pump presses, and how its areas differ (:class:`Course`).
    viscosity : of the oil in each recording, over that at the reference temperature; empty where
        not all of them measure its temperature.
    lowest : absolute pressure of either chamber in each recording, (2, r) Pa
        (:meth:`Course.lowest`); empty of a chamber where not all say it, and in older files.
    band : Hz, of its balances.
    effects, numbers : of the config and its rig that the balances were made with, SI; None in
        older files.
    """

    rig: str
    sources: tuple[str, ...]
    scale: Scale
    load_varied: bool
    pieces: bool
    balances: tuple[MachineBalance, ...]
    odd: tuple[Odd, ...]
    policy: Policy
    stiffness: Stiffness = UNKNOWN
    areas: tuple[float, float] | None = None
    mass: float | None = None
    displacement: float | None = None
    oil: str = ""
    apart: float = 0.0
    viscosity: tuple[float, ...] = ()
    lowest: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())
    effects: dict[str, dict[str, float | str | list[float]]] | None = None
    numbers: dict[str, float] | None = None
    band: float = BAND

    def as_made(self, settings: Settings) -> Settings:
        """Return a config with the numbers and effects that the machine's balances were made with.

        Its terms are what comes on top of them: beside another config, that of a diagnosis for
        example, the same leak or lag would count twice in the machine and once in a recording.
        """
        if self.effects is None or self.numbers is None:
            return settings
        return settings.model_copy(update={
            "effects": self.effects, "rig": settings.rig.model_copy(update=self.numbers)})

    def of_references(self, name: str) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return a parameter in each reference and its deviations, (r,) each, of each balance."""
        return [(np.array(one.each)[:, j], np.array(one.each_stddev)[:, j])
                for one in self.balances for j, p in enumerate(one.parameters) if p.name == name]

    @property
    def known_leakage(self) -> float:
        """Leakage across the piston that the config has, which L is beyond, m³/(s·Pa)."""
        return 0.5 * (self.numbers or {}).get("leakage", 0.0) + (self.effects or {}).get(
            "cross_port_leakage", {}).get("L", 0.0)

    @property
    def runs(self) -> str:
        """What a recording of it is compared with, in words."""
        return f"{len(self.sources)} {'parts of the ' if self.pieces else ''}healthy recordings"

    def taken_as_sure(self) -> "Machine":
        """Return it as if its parameters were known exactly."""
        return replace(self, balances=tuple(replace(one, errors=()) for one in self.balances))

    def __getitem__(self, balance: str) -> MachineBalance:
        return next(one for one in self.balances if one.balance == balance)

    def moved(self, courses: Sequence[Course]) -> list[Course]:
        """Return motions of it with the chamber that its pump acts on."""
        return [replace(course, oil=self.oil, apart=self.apart) for course in courses]

    def to_dict(self) -> dict:
        """Return the JSON form, key ``machine``."""
        settings = []
        for i, source in enumerate(self.sources):
            row: dict = {"recording": source}
            for one in self.balances:
                row |= {s.name: {"value": s.value[i], "stddev": s.stddev[i], "unit": s.unit}
                        for s in one.settings}
            settings.append(row)
        return finite({
            "schema": SCHEMA, "rig": self.rig, "recordings": len(self.sources),
            "parameters": [asdict(p) | {"balance": one.balance} for one in self.balances
                           for p in one.parameters],
            "settings": settings,
            "unexplained_share": {one.balance: one.unexplained for one in self.balances},
            "repeating_share": {one.balance: one.repeats for one in self.balances},
            "load_varied": self.load_varied, "turns": self.scale.turns, "pieces": self.pieces,
            "odd": self.odd,
            "stiffness": self.stiffness, "areas": self.areas, "mass": self.mass,
            "displacement": self.displacement, "scale": self.scale,
            "oil": self.oil, "apart": self.apart, "viscosity": self.viscosity,
            "lowest": self.lowest, "band": self.band,
            "effects": self.effects, "numbers": self.numbers,
            "policy": self.policy, "balances": self.balances})


def healthy_machine_of(courses: Sequence[Course], settings: Settings, policy: Policy = POLICY
                       ) -> Machine:
    """Return the machine of healthy motions, of however few, without those that differ.

    Fewer than it needs are cut in parts; these do not hold what differs from one recording to
    the next, so a typical spread is added.

    Raises
    ------
    InputError
        If nothing moves in them, or so few are too short to be cut.
    """
    if not any(course.shows for course in courses):
        raise InputError(f"{courses[0].source}: expected a reference recording in which the "
                         "piston moves, found none")
    courses = of_one_machine(courses, settings.rig, policy)
    if len(courses) >= policy.fewest:
        machine = machine_from(courses, settings.rig, (), (), policy)
        return of_those_that_belong(machine, courses, settings.rig, (), ())
    seconds = sum(course.seconds for course in courses)
    if seconds < PIECES * SHORTEST_S:
        raise InputError(
            f"{courses[0].source}: expected at least {policy.fewest} reference recordings, or "
            f"{PIECES * SHORTEST_S:g} s of motion in them to cut in parts, found {seconds:.1f} s")
    return machine_from([part for one in courses for part in _parts(
        one, -(-PIECES // len(courses)))], settings.rig, (), (), policy, pieces=True)


def of_those_that_belong(machine: Machine, courses: Sequence[Course], rig: Rig,
                         vary: Sequence[str], without: Sequence[str]) -> Machine:
    """Return a machine without the recordings that differ, where enough are left.

    One of another machine would widen what healthy means until nothing has changed.
    """
    strange, policy = {one.place for one in machine.odd}, machine.policy
    if not strange or len(courses) - len(strange) < policy.fewest:
        return machine
    kept = machine_from([course for i, course in enumerate(courses) if i not in strange],
                        rig, vary, without, policy)
    return replace(kept, odd=tuple(replace(one, why=f"left out: {one.why}")
                                   for one in machine.odd))


def _parts(course: Course, count: int) -> list[Course]:
    """Return a recording as so many, each with a part of its compared samples."""
    part = np.minimum(np.cumsum(course.moving) * count // max(course.moving.sum(), 1), count - 1)
    return [replace(course, source=f"{course.source}, part {i + 1}",
                    good=course.good & (part == i), moving=course.moving & (part == i))
            for i in range(count)]


def machine_from(courses: Sequence[Course], rig: Rig, vary: Sequence[str], without: Sequence[str],
                 policy: Policy, pieces: bool = False) -> Machine:
    """Return the machine that measured motions show.

    Parameters
    ----------
    vary : what is known to differ between them.
    pieces : they are parts of few recordings, of one setting.
    """
    scale = Scale.of(courses, contacts_of(courses, policy))
    if pieces:
        scale = replace(scale, turns=False)
    varied, found = list(vary), []
    if pressure_varied(courses, policy):
        varied.append("pressure")
    for kind in balances_in(courses, rig):
        one = _balance(kind, courses, scale, rig, (varied, without, pieces), policy)
        if kind == "force" and "load" not in varied and any(
                s.varies and s.effect != "presliding_friction" for s in one.settings):
            varied.append("load")  # now friction that grows with pressure can be separated
            one = _balance(kind, courses, scale, rig, (varied, without, pieces), policy)
        found.append(one)
    sources = tuple(Path(one.source).name or f"recording {i + 1}" for i, one in enumerate(courses))
    viscosity = tuple(course.viscosity for course in courses)
    lowest = tuple(row if np.isfinite(row).all() else ()
                   for row in zip(*(course.lowest(rig) for course in courses), strict=True))
    return Machine(rig.name, sources, scale, bool(varied), pieces, tuple(found),
                   _odd(sources, found, {
                       c.name: c.between for one in found
                       for c in candidates_of(one.balance, scale, rig)}, policy), policy,
                   stiffness_of(courses, rig),
                   (rig.area_1, rig.area_2), rig.mass, rig.pump_displacement,
                   courses[0].oil, courses[0].apart,
                   viscosity if np.isfinite(viscosity).all() else (),
                   lowest, {name: dict(one) for name, one in courses[0].effects.items()},
                   {name: value for name in NUMBERS
                    if (value := getattr(rig, name)) is not None}, courses[0].band)


def pressure_varied(courses: Sequence[Course], policy: Policy) -> bool:
    """Tell whether the mean pressure was set otherwise in some recordings, whatever the force.

    What of it goes with the force, which the pressures make, is no setting.
    """
    if len(courses) < 2 or any(course.p1 is None for course in courses):
        return False
    sums = [sum_of_pressures(course)[course.good] for course in courses]
    forces = [np.abs(course.force[course.good]) for course in courses]
    within = [[row - row.mean() for row in rows] for rows in (forces, sums)]
    x, y = (np.concatenate(rows) for rows in within)
    slope = float(x @ y) / max(float(x @ x), 1e-300)
    own = [one - slope * force for one, force in zip(sums, forces, strict=True)]
    levels = np.array([np.median(one) for one in own])
    moves = float(np.median([np.std(one) for one in own]))
    largest = max(float(np.median(one)) for one in sums)
    return bool(np.ptp(levels) > max(policy.varied * moves, 0.2 * largest))


def _balance(kind: str, courses: Sequence[Course], scale: Scale, rig: Rig,
             how: tuple[Sequence[str], Sequence[str], bool], policy: Policy) -> MachineBalance:
    varied, out, pieces = how
    tables = tables_of(courses, rig, kind, [
        one for one in candidates_of(kind, scale, rig, varied, out) if not one.lasting], policy)
    recordings = Recordings(tables)
    of, allowed = recordings.candidates, [one.name for one in tables[0].candidates]
    # What is named is named beside them; what they are on the mean, and their spread, is the
    # machine's.  Parts of one recording have one oil.
    beside = recordings if pieces else Recordings(tables, own_oil=True)
    chosen, refused = gated(beside, allowed, kind, policy)
    fit = recordings.fit(chosen.names)
    between = fit.between
    if pieces:
        between = np.hypot(between, policy.between * np.abs(fit.value))
    left = beside.left_out(chosen.names)
    sizes = [table.size for table in tables]
    after = reference = chosen.errors
    repeats = 0.0
    if kind != "drive":
        signals, good = [signals_of(c, kind, scale) for c in courses], [
            c.compared(c.counted(kind)) for c in courses]
        named = learned(signals, left, good, sizes)
        whole = [table.rows[:, 0] - table.rows[table.good, 0].mean() for table in tables]
        if kind == "force":
            signals = [np.column_stack([part, np.tile(np.quantile(
                table.rows[table.good, 0], LEVELS), (len(part), 1))])
                for part, table in zip(signals, tables, strict=True)]
        repeats = named.removed if named.removed >= policy.small else 0.0
        after, reference = (named.after if repeats else named.before), learned(
            signals, whole, good, sizes).after
    parameters = tuple(
        Parameter(name, of[name].effect, of[name].words, of[name].unit, *map(float, row))
        for name, *row in zip(fit.names, fit.value, between, fit.stddev, strict=True))
    # The area and the form of the laws are common to all recordings: no load varies by them.
    lasting = np.array([np.sqrt(np.diag(form_and_doubts(table, fit.settings, error, policy)))
                        for table, error in zip(tables, chosen.errors, strict=True)])
    settings = tuple(
        Setting(name, of[name].effect, of[name].words, of[name].unit, tuple(value.tolist()),
                tuple(np.hypot(stddev, more).tolist()),
                varies(value, stddev, float(np.median(sizes)), policy), _rows(doubts))
        for name, value, stddev, more, doubts in zip(
            fit.settings, fit.setting.T, fit.setting_stddev.T, lasting.T,
            np.array([movement(table, fit.settings) for table in tables]).swapaxes(0, 1),
            strict=True))
    weights = dict(zip(fit.names, fit.value.tolist(), strict=True))
    usual, loose = usual_of(settings, of)
    weights |= usual
    errors = factor_of(fit.covariance)
    errors_of = dict(zip(fit.names, errors, strict=True))
    spreads = {}, oil_of(parameters, of, policy)
    return MachineBalance(
        kind, parameters, settings, _rows(fit.each), _rows(fit.each_stddev),
        tuple(nominal_errors(kind, tables, rig).tolist()), tuple(chosen.errors.tolist()),
        tuple(after.tolist()), tuple(reference.tolist()), repeats, regimes(kind, courses, left),
        float(np.median(sizes)), float(np.median([table.floor for table in tables])),
        float(sum(table.effective for table in tables)),
        chosen.named, *(scatter_of(
            tables, weights, [s.name for s in settings if s.name not in usual], allowed, policy,
            loose | oil, pieces, errors_of) for oil in spreads), refused,
        tuple(recordings.errors(chosen.names).tolist()),
        forms_of(recordings, beside, chosen.names, allowed, policy), levers_of(tables, fit.names),
        tuple(left_alone(table, [*fit.names, *fit.settings]) for table in tables), _rows(errors))


def factor_of(covariance: np.ndarray) -> np.ndarray:
    """Return F of a covariance FF', (m, m); nothing of what no recording says."""
    known = np.isfinite(np.diag(covariance))
    scale = np.sqrt(np.where(known, np.diag(covariance), 0.0))
    size = np.outer(scale, scale)
    values, vectors = np.linalg.eigh(np.divide(
        covariance, size, out=np.zeros_like(size), where=size > 0.0))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


def usual_of(settings: Sequence[Setting], of: Mapping[str, Candidate]
             ) -> tuple[dict[str, float], dict[str, float]]:
    """Return mean and spread of what a setting has beside its constant load, by name, SI.

    Another recording is free within that spread and no farther: a load that acts in one direction
    and a constant one together are just a dry friction.
    """
    means, spreads = {}, {}
    for one in settings:
        spread = max(float(np.std(one.value, ddof=1)) if len(one.value) > 1 else np.inf,
                     float(np.median(one.stddev)))
        if one.name in of and not of[one.name].always and 0.0 < spread < np.inf:
            means[one.name], spreads[one.name] = float(np.mean(one.value)), spread
    return means, spreads


def oil_of(parameters: Sequence[Parameter], of: Mapping[str, Candidate], policy: Policy
           ) -> dict[str, float]:
    """Return by how much what goes with more than the machine differs between recordings, SI.

    The oil; and a spring that is not always the same: the air on a surface.
    """
    spreads = {p.name: max(p.between, LEAST * policy.between * abs(p.value))
               for p in parameters if of[p.name].of_oil or (
                   of[p.name].family == "position" and p.between > policy.worse * abs(p.value))}
    return {name: spread for name, spread in spreads.items() if spread > 0.0}


def forms_of(recordings: Recordings, beside: Recordings, names: Sequence[str],
           allowed: Sequence[str], policy: Policy) -> tuple[float, ...]:
    """Return how far each term goes with other shapes of its family; 0 of a setting's own."""
    def parameters(terms):
        shared, _, _ = recordings.split(terms)
        of = dict(zip(shared, recordings.shared_fit(terms)[0].tolist(), strict=True))
        return [of.get(recordings.tables[0].places[name], 0.0) for name in terms]

    moved = between_forms(recordings.candidates, allowed, names,
                          lambda terms: beside.rms(beside.errors(terms)), parameters, policy)
    by_name = dict(zip(names, np.abs(moved).max(axis=0).tolist(), strict=True))
    shared, settings, _ = recordings.split(names)
    of = recordings.tables[0].candidates
    return tuple(by_name[of[i - 1].name] for i in (*shared, *settings))


def levers_of(tables: Sequence[Table], names: Sequence[str]) -> tuple[float, ...]:
    """Return what one unit of each parameter makes of the signal, usual rms over its size."""
    return tuple(float(np.median([
        np.sqrt(np.mean(table.rows[table.good, table.places[name]] ** 2)) / table.size
        for table in tables])) for name in names)


def gated(recordings: Recordings, allowed: Sequence[str], kind: str, policy: Policy
          ) -> tuple[Chosen, tuple[Refused, ...]]:
    """Return the choice; it begins anew from the first view where that leaves less unseen.

    Two of its terms may pay only together, and a choice of one after the other finds neither.
    Where what it comes to leaves more still, the first view's terms stand without names.
    """
    chosen = recordings.choose(policy, allowed)
    first = [name for name, one in recordings.candidates.items()
             if one.always or (kind == "force" and name in FIRST_VIEW)]
    errors = recordings.errors(first)
    if rms(chosen.errors) <= rms(errors) + policy.worse:
        return chosen, ()
    again = recordings.choose(policy, allowed, first)
    if rms(again.errors) <= rms(errors) + policy.worse:
        return again, ()
    return Chosen(tuple(first), errors, ()), (Refused(
        "unseen_error", kind, f"least squares leave {share(rms(errors), 2)} of the "
        f"{kind} on recordings left out, what was chosen "
        f"{share(rms(chosen.errors), 2)}: their terms stand in its place"),)


def nominal_errors(kind: str, tables: Sequence[Table], rig: Rig) -> np.ndarray:
    """Return the error of the config's linear model on each recording left out, (r,)."""
    names, held = nominal_of(kind, rig)
    bare = [replace(table, rows=np.column_stack([table.left(held), table.rows[:, 1:]]))
            for table in tables]
    return Recordings(bare).errors(names)


def _rows(values: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, values.tolist()))


def varies(value: np.ndarray, stddev: np.ndarray, size: float, policy: Policy) -> bool:
    """Tell whether a setting's number differs between recordings beyond its deviations.

    And by a fifth of itself, and of the signal's ``size`` by what a machine is repaired for.
    """
    weight = 1.0 / np.maximum(stddev, 1e-300) ** 2
    mean = float(weight @ value / weight.sum())
    far = np.abs(value - mean) > policy.varied * stddev
    return bool(far.sum() >= 2 and np.ptp(value) > max(
        0.2 * np.abs(value).max(), policy.worse * size))


def _odd(sources: Sequence[str], balances: Sequence[MachineBalance],
         typical: Mapping[str, float | None], policy: Policy) -> tuple[Odd, ...]:
    """Return recordings whose error or parameter is far from those of all others.

    Parameters
    ----------
    typical : relative spread of each term between recordings, None the policy's: a pump of
        another machine is none of 5 %.
    """
    found: dict[int, Odd] = {}
    for one in balances:
        log = np.log(np.maximum(one.error, 1e-12))
        middle = np.median(log)
        spread = max(1.4826 * float(np.median(np.abs(log - middle))), 0.1)
        for i, (source, value, error) in enumerate(zip(sources, log, one.error, strict=True)):
            if (value - middle) / spread > policy.odd and (error - np.exp(middle) > policy.worse):
                found.setdefault(i, Odd(source, (
                    f"its {one.balance} is {100 * error:.0f} % unexplained, the others "
                    f"{100 * np.exp(middle):.0f} %"), i))
        each, stddevs = np.array(one.each), np.array(one.each_stddev)
        sure = {*BASE, "C_h", *(name for family in one.named for name in family.terms)}
        for j, p in enumerate(one.parameters):
            if p.name not in sure:  # a correction of form is of the motion, not of the machine
                continue
            for i, source in enumerate(sources):
                rest = np.arange(len(sources)) != i
                value, between, stddev = pooled(each[rest, j], stddevs[rest, j], p.value)
                between = max(between, LEAST * abs(value) * (
                    typical.get(p.name) or policy.between))
                far = abs(each[i, j] - value) / max(
                    np.sqrt(between**2 + stddev**2 + stddevs[i, j] ** 2), 1e-300)
                # Compressed oil is a small part of any flow, and the health of the machine.
                small = one.levers and p.name != "C_h" and (
                    abs(each[i, j] - value) * one.levers[j] < policy.worse)
                if np.isfinite(far) and far > policy.odd and not small:
                    found.setdefault(i, Odd(source, f"its {p.words} is {far:.1f} deviations "
                                            "from that of the others", i))
    return tuple(found.values())


def save(machine: Machine, path: Path) -> None:
    """Write a machine as a small JSON file."""
    write_json(path, machine.to_dict())


def of_another(value: float, expected: float) -> bool:
    """Tell whether a mass or a displacement is so far from the expected one that it is another's.

    Parameters
    ----------
    value, expected : SI; the latter positive.
    """
    return not 1.0 / OTHER < value / expected < OTHER


def load(path: Path, rig: Rig) -> Machine:
    """Read a machine that :func:`save` wrote, to be compared on a rig.

    Raises
    ------
    InputError
        Naming the file, if it holds none, or one with other areas than the rig's, or that does not
        say with which it was made: every force and flow of its balances would be another.
    """
    machine = _read(path)
    own, within = (rig.area_1, rig.area_2), machine.policy.varied * rig.tolerance.log_spread(
        "area_1")
    theirs = machine.areas
    if theirs is None and any(own):
        raise InputError(f"{path}: a machine of an older version, which does not say for which "
                         "areas it was made; make it again from its recordings: eha-monitor "
                         f"diagnose {' '.join(machine.sources)} --config CONFIG --machine "
                         f"{path}")
    if theirs is not None and any(bool(here) != bool(there) or (
            here and abs(np.log(here / there)) > within)
            for here, there in zip(own, theirs, strict=True)):
        others, mine = (" and ".join(quantity(one, "m²", 3) if one else "none" for one in areas)
                        for areas in (theirs, own))
        raise InputError(f"{path}: a machine with areas of {others}, expected those of the "
                         f"config, {mine}")
    for words, unit, there, here in (
            ("mass", "kg", machine.mass, rig.mass),
            ("pump displacement", "m³/rad", machine.displacement, rig.pump_displacement)):
        if there and here and of_another(here, there):
            raise InputError(f"{path}: a machine made with a {words} of {quantity(there, unit, 3)}"
                             f", expected that of the config, {quantity(here, unit, 3)}")
    return machine


def _read(path: Path) -> Machine:
    wanted = "expected a machine, as `diagnose A B C --machine FILE` writes it"
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as problem:
        raise InputError(f"{path}: {wanted}: {problem.strerror}") from problem
    except ValueError as problem:
        raise InputError(f"{path}: {wanted}, found a file that is not JSON, or only a part of "
                         "one") from problem
    schema = data.get("schema") if isinstance(data, dict) else None
    if schema != SCHEMA:
        raise InputError(f"{path}: {wanted}, with schema {SCHEMA}; found "
                         f"{f'schema {schema}' if schema else 'JSON of another kind'}")
    try:
        data["sources"] = [row["recording"] for row in data["settings"]]
        # Files of older versions did not tell oils apart, nor hold the machine's own.
        data["balances"] = [_with_infinities({
            "held": one["error"], "beside": one["scatter"]} | one) for one in data["balances"]]
        if not all(isinstance(row, list) for row in data.get("lowest") or [None]):
            data.pop("lowest", None)  # of both chambers as one
        data["scale"].setdefault("relaxed", data["scale"]["origin"])
        data["stiffness"] = _with_infinities(data.get("stiffness") or asdict(UNKNOWN))
        return TypeAdapter(Machine).validate_python(data)
    except ValidationError as problem:
        first = problem.errors()[0]
        raise InputError(f"{path}: {wanted}; {'.'.join(map(str, first['loc']))}: {first['msg']}"
                         ) from problem
    except KeyError as problem:
        raise InputError(f"{path}: {wanted}, with the key {problem}") from problem
    except (ValueError, TypeError, AttributeError) as problem:
        raise InputError(f"{path}: {wanted}; {' '.join(str(problem).split())[:300]}") from problem


def _with_infinities(tree):
    """Return a tree with infinities for its nulls, as which they are written."""
    if isinstance(tree, dict):
        return {key: _with_infinities(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_with_infinities(value) for value in tree]
    return np.inf if tree is None else tree
