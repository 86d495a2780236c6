"""What the balances of recordings answer: names, numbers, place, and the proof on unseen parts."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor import ties
from eha_monitor.balances import places
from eha_monitor.balances.advice import advice_of
from eha_monitor.balances.baseline import baseline
from eha_monitor.balances.candidates import SIDES, Scale, balances_in
from eha_monitor.balances.course import Course, course_of
from eha_monitor.balances.hypothesis import candidate_of, untested
from eha_monitor.balances.machine import Machine, machine_from, pressure_varied, rms
from eha_monitor.balances.mean_pressure import leak_or_source
from eha_monitor.balances.model import Model, Term, of_machine, of_recordings, on_held_out
from eha_monitor.balances.policy import POLICY, Policy
from eha_monitor.errors import InputError
from eha_monitor.mismatch.diagnosis import (
    Agreement,
    Change,
    Diagnosis,
    Fitted,
    Gate,
    Location,
    NamedEffect,
    Overlay,
    RigFinding,
    SignalFit,
    Value,
    health_sentences,
)
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import quantity, share, side_by_side, with_uncertainty
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.hypothesis import Hypothesis
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig
from eha_monitor.words import listed

FORCE_OF_SENSORS = ("pressure_offset", "pressure_scale")  # they make a constant force as well
LINEAR = ("B", "D_p", "C_h", "k_d")  # what the config's own model has
SIDE_OF = {"mass": "force", "pump_displacement": "flow", "position_gain": "drive",
           "charge_pressure": "flow"}
TWINS = {"pump_displacement": ("pump_flow_gain",), "position_gain": ("drive_gain",)}
DRY_SYMBOLS = {"F_c", "F_d"}
OVERLAY = 4.0  # s of an overlay
LARGEST = 0.998  # quantile of a term that is its size
WHERE = ("force", "flow", "drive", "sensor")


@dataclass(frozen=True)
class Asked:
    """What a diagnosis is asked beside its recordings; see :func:`mismatch.diagnose.diagnose`."""

    held_out: Recording | None = None
    hypothesis: Hypothesis | None = None
    without: tuple[str, ...] = ()
    vary: tuple[str, ...] = ()


def answered(recordings: Sequence[Recording], settings: Settings, asked: Asked = Asked(),
             policy: Policy = POLICY) -> Diagnosis:
    """Return the answer that recordings of one rig give by their balances.

    Raises
    ------
    InputError
        If one of them has no force balance.
    """
    started, rig = time.perf_counter(), settings.rig
    recordings, courses, left_out = _courses(recordings, settings)
    baselines = tuple(baseline(recording, settings) for recording in recordings)
    if not any(course.moving.any() for course in courses):
        return _still(recordings, courses, baselines, started)
    scale, machine = Scale.of(courses), None
    own, untestable = (), ()
    if asked.hypothesis is not None:
        candidate = candidate_of(asked.hypothesis, rig) if len(courses) < policy.fewest else None
        own = () if candidate is None else (candidate,)
        untestable = () if own else (untested(asked.hypothesis),)
    if len(courses) >= policy.fewest:
        machine = machine_from(courses, rig, asked.vary, asked.without, policy)
        models = [of_machine(one, courses, rig, machine.scale, policy)
                  for one in machine.balances]
    else:
        varied = (*asked.vary, *(("pressure",) if pressure_varied(courses, policy) else ()))
        models = [of_recordings(courses, rig, scale, balance, policy, (varied, asked.without),
                                tuple(c for c in own if c.balance == balance))
                  for balance in balances_in(courses, rig)]
    shown = list(courses)
    if asked.held_out is not None:
        shown = [course_of(asked.held_out, settings)]
        there = balances_in(shown, rig)
        models = [on_held_out(one, shown[0], rig, scale, policy) for one in models
                  if one.balance in there]
    flow = next((one["D_p"] for one in models if one.balance == "flow"), None)
    found = _composed(models, shown, settings, policy, leak_or_source(
        courses, settings, None if flow is None else flow.value, policy))
    return replace(
        found, bags=tuple(one.source for one in recordings),
        data="held_out" if asked.held_out is None else "held_out_bag", baselines=baselines,
        advice=advice_of(models, rig, policy, machine) + found.advice,
        health=found.health + (lines_of(machine) if machine is not None else ()) + left_out,
        considered=untestable, machine=machine,
        agreement=_agreement(models, courses), policy=policy.to_dict(),
        duration_s=sum(one.duration for one in recordings),
        wall_s=time.perf_counter() - started)


def _courses(recordings: Sequence[Recording], settings: Settings
             ) -> tuple[list[Recording], list[Course], tuple[str, ...]]:
    """Return the recordings that hold a motion, their motions, and why others are left out.

    Raises
    ------
    InputError
        If none does.
    """
    kept, courses, problems = [], [], []
    for recording in recordings:
        try:
            courses.append(course_of(recording, settings))
            kept.append(recording)
        except InputError as problem:
            problems.append(problem)
    if not courses:
        raise problems[0]
    return kept, courses, tuple(f"left out: {problem}" for problem in problems)


def first_answer(recordings: Sequence[Recording], settings: Settings, asked: Asked = Asked()
                 ) -> Diagnosis | None:
    """Return what the balances answer; None where they hold no force."""
    try:
        return answered(recordings, settings, asked)
    except InputError:
        return None


def far_from_config(found: Diagnosis | None, policy: Policy = POLICY) -> bool:
    """Tell whether a filter built on the config's laws may be unable to judge what is named.

    A filter weighs each sample's innovation: where the config leaves ``near`` of a balance open,
    or friction is dry, whose law nobody knows, it answers for the form of its laws and not for the
    machine.  The balances have then named what halves the error on unseen parts, or friction.
    """
    if found is None or found.verdict != "mismatch":
        return False
    return any(DRY_SYMBOLS & effect.parameters.keys() for effect in found.effects) or any(
        leaves_more(fit.before_rms / fit.signal_rms, fit.after_rms / fit.signal_rms, policy)
        for fit in found.signals.values())


def leaves_more(before: float, after: float, policy: Policy) -> bool:
    """Tell whether a model leaves ``near`` of a balance open, and another less than half of it."""
    return before > max(policy.near, 2.0 * after)


def _still(recordings, courses: Sequence[Course], baselines: tuple, started: float) -> Diagnosis:
    """Return the answer for recordings in which nothing moves."""
    moved = max(float(np.ptp(course.x)) for course in courses)
    noise = max(course.sensors["x"] for course in courses)
    return Diagnosis(
        tuple(one.source for one in recordings), "insufficient_data",
        f"the piston moves by {quantity(moved, 'm', 2)} only, with {quantity(noise, 'm', 2)} of "
        "noise: too little motion to identify anything",
        Location(dict.fromkeys(WHERE, 0.0), "", ()), (), {}, {}, "held_out", {},
        baselines=baselines, duration_s=sum(one.duration for one in recordings),
        wall_s=time.perf_counter() - started)


def _composed(models: Sequence[Model], courses: Sequence[Course], settings: Settings,
              policy: Policy, charge: NamedEffect | RigFinding | None) -> Diagnosis:
    """Return verdict, names, numbers, place and proof of models.

    Parameters
    ----------
    charge : what the mean pressure says.
    """
    rig = settings.rig
    wrong = tuple(finding for one in models for finding in _wrong(one, rig, policy))
    effects = [effect for one in models for effect in effects_of(one, rig, policy)]
    if isinstance(charge, RigFinding):
        wrong += (charge,)
    elif charge is not None and charge.name not in {effect.name for effect in effects}:
        effects.append(charge)
    effects.sort(key=lambda effect: -effect.log_evidence)
    open_ = [one for one in models if is_open(one, policy)]
    unsure = [] if open_ or effects or wrong else [
        (one, [t.candidate.words for t in one.terms if t.candidate.name not in LINEAR])
        for one in models if leaves_more(one.nominal_error, one.error, policy)]
    verdict = ("unexplained" if open_ or unsure else
               "mismatch" if effects or wrong else "consistent")
    before, after = known_of(models, rig, policy, nominal=True), known_of(
        models, rig, policy)
    if verdict == "unexplained":
        models, effects, wrong, after = [one.plain() for one in models], [], (), {}
    where, curves = place_of(models, courses, effects, wrong, verdict)
    if unsure:
        message = "; ".join(
            f"the config's model leaves {share(one.nominal_error, 2)} of the {one.balance}; "
            f"{listed(terms)} together explain it, none of them surely" for one, terms in unsure)
    elif verdict == "unexplained":
        message = (f"the {listed([one.balance for one in open_])} balance"
                   f"{'s hold' if len(open_) > 1 else ' holds'} more than the catalogue explains")
    else:
        message = "; ".join([*(one.statement for one in wrong),
                             *(one.statement for one in effects)]) or (
            "the config's own model explains the balances of this recording")
    return Diagnosis(
        (), verdict, message, where, tuple(effects), before, after, "held_out",
        {one.balance: SignalFit(SIDES[one.balance], one.nominal_error * one.size,
                                one.error * one.size, one.floor, signal_rms=one.size)
         for one in models},
        curves=curves, overlays=tuple(o for one in models if (o := overlay_of(one)) is not None),
        health=health_sentences(before, after, effects),
        config_effects=config_effects(models, effects, settings),
        probability={"consistent": np.nan, "unexplained": np.nan}, rig_data=wrong,
        fitted=_fitted(models, after, effects, wrong), gates=tuple(
            Gate(one.gate, one.what, one.statement) for model in models
            for one in model.refused))


def is_open(model: Model, policy: Policy) -> bool:
    """Tell whether a balance leaves more than an answer may, and more than the sensors make."""
    return model.error > max(policy.open, policy.clean * model.floor / model.size)


def known_of(models: Sequence[Model], rig: Rig, policy: Policy, nominal: bool = False
             ) -> dict[str, Value]:
    """Return B and beta_e, of the config's linear model or of the whole one.

    They contain the tolerances of the area and of the volume, which no recording knows.
    """
    found: dict[str, Value] = {}
    for one in models:
        rows = one.nominal if nominal else tuple(
            (t.candidate.name, t.value, t.stddev) for t in one.terms)
        for name, value, stddev in rows:
            if not np.isfinite(stddev) or not value > 0.0:
                continue
            if name == "B":
                area = rig.tolerance.log_spread("area_1") if rig.area_1 else 0.0
                found["B"] = Value(value, float(np.hypot(stddev, area * value)), "N·s/m")
            elif name == "C_h" and rig.volume_1 and value > policy.varied * stddev:
                beta, volume = rig.volume_1 / value, rig.tolerance.log_spread("volume_1")
                found["beta_e"] = Value(beta, float(beta * np.hypot(stddev / value, volume)),
                                        "Pa")
    return found


def effects_of(model: Model, rig: Rig, policy: Policy) -> list[NamedEffect]:
    """Return the named terms of a balance as effects; one that contains another holds both."""
    named = [t for t in model.terms if (t.named or _leaks_more(t, policy))
             and t.candidate.name not in LINEAR and not _within_tolerance(t, rig, policy)]
    groups: dict[str, list[Term]] = {}
    for term in named:
        groups.setdefault(term.candidate.effect, []).append(term)
    for effect in list(groups):
        for simpler in CATALOGUE[effect].contains if effect in CATALOGUE else ():
            groups[effect] += groups.pop(simpler, [])
    return [_effect(name, terms, model, rig)
            for name, terms in _surest(_dry_as_one(groups, policy), policy).items()]


def _surest(groups: dict[str, list[Term]], policy: Policy) -> dict[str, list[Term]]:
    """Return the effects without those that only share what their family surely is.

    Friction that grows with pressure and friction that does not are named together; which of them
    it is, each says for itself.
    """
    def sure(name: str) -> float:
        return max(abs(t.value) / t.stddev if t.stddev else np.inf for t in groups[name])

    best: dict[str, float] = {}
    for name, terms in groups.items():
        kind = terms[0].candidate.kind
        best[kind] = max(best.get(kind, 0.0), sure(name))
    return {name: terms for name, terms in groups.items() if sure(name) >= min(
        best[terms[0].candidate.kind], policy.varied)}


def _dry_as_one(groups: dict[str, list[Term]], policy: Policy) -> dict[str, list[Term]]:
    """Return the terms of effects, dry friction of several shapes as the one force that it is.

    It is called by its fall with speed where that is sure of itself, else by its largest shape.
    """
    dry = {effect: terms for effect, terms in groups.items() if terms[0].candidate.family == "dry"
           and DRY_SYMBOLS.issuperset(term.candidate.symbol for term in terms)}
    terms = [term for one in dry.values() for term in one]
    falls = [t for t in terms if t.candidate.symbol == "F_d"]
    stays = [t for t in terms if t.candidate.symbol == "F_c"]
    if len(dry) < 2 or not stays:
        return groups
    sure = [t for t in falls if abs(t.value) > policy.varied * t.stddev]
    name = (sure or [ties.best(stays, lambda t: abs(t.value))])[0].candidate.effect
    return {name: stays + sure, **{effect: terms for effect, terms in groups.items()
                                   if effect not in dry}}


def _effect(name: str, terms: Sequence[Term], model: Model, rig: Rig) -> NamedEffect:
    entry, first = CATALOGUE.get(name), terms[0]
    values: dict[str, Value] = {}
    for term in terms:
        symbol, value = shown_as(term, model, rig)
        if symbol in values:  # dry friction of two shapes is one force
            value = Value(values[symbol].value + value.value,
                          float(np.hypot(values[symbol].stddev, value.stddev)), value.unit)
        values[symbol] = value
    numbers = numbers_of(name, terms, values)
    whole = entry is not None and not any(term.each for term in terms) and all(
        p.name in values for p in entry.sizes if np.isfinite(p.neutral))
    said = entry.said(numbers) if whole else ""
    if not said:
        said = "; ".join(_said(term) for term in terms)
    spread = [f"± {share(t.between / abs(t.value), 2)} between recordings" for t in terms
              if t.between and t.value]
    rivals = tuple(dict.fromkeys(r for term in terms for r in (
        *term.rivals, *term.candidate.twins)))
    if name == "constant_load" and rig.area_1 and rig.area_2:
        rivals += tuple(r for r in FORCE_OF_SENSORS if r not in rivals)
    return NamedEffect(
        name, model.balance, "; ".join([said, *spread]), values,
        max(sum(term.gained for term in terms), 0.0), rivals,
        entry.equation if entry else "", entry.rig_check if entry else "",
        size_of(terms, model), probability=max(
            (t.probability for t in terms if np.isfinite(t.probability)), default=np.nan),
        effective_samples=model.effective, stability=max(first.stability, 0.0))


def shown_as(term: Term, model: Model, rig: Rig) -> tuple[str, Value]:
    """Return the parameter of the catalogue that a term is, and its value there."""
    c, shape = term.candidate, dict(term.candidate.shape)
    if c.symbol == "omega_max":
        return c.symbol, Value(shape["omega_max"], model.floor, "rad/s")
    soft = model["C_h"]
    if c.name == "C_x" and soft is not None and soft.value > 0.0 and rig.volume_1:
        factor = rig.volume_1 / soft.value
        return "A_v", Value(factor * term.value, factor * term.stddev, "m²")
    return c.symbol or c.name, Value(term.value, term.stddev, c.unit)


def numbers_of(name: str, terms: Sequence[Term], values: dict[str, Value]) -> dict[str, float]:
    """Return all parameters of an effect of the catalogue: found, of its shape, and defaults."""
    entry = CATALOGUE.get(name)
    if entry is None:
        return {}
    numbers = {p.name: p.neutral if p.default is None else p.default for p in entry.parameters}
    for term in reversed(terms):
        numbers |= {key: value for key, value in term.candidate.shape if key in numbers}
    numbers |= {key: one.value for key, one in values.items() if key in numbers}
    if name == "external_leakage":
        numbers["L_2"] = numbers["L_1"]
    return numbers


def config_effects(models: Sequence[Model], effects: Sequence[NamedEffect], settings: Settings
                   ) -> dict[str, dict[str, float]]:
    """Return the ``effects:`` section: what the config had, and what of the catalogue is named.

    What the catalogue does not hold, or not that way round, has no place there.
    """
    found = {name: dict(values) for name, values in settings.effects.items()}
    for effect in effects:
        entry, model = CATALOGUE.get(effect.name), next(
            one for one in models if one.balance == effect.balance)
        if entry is None or effect.name in found:
            continue
        terms = [t for t in model.named if t.candidate.effect in (effect.name, *entry.contains)]
        numbers = numbers_of(effect.name, terms, effect.parameters)
        if all(p.name not in effect.parameters or numbers[p.name] >= p.lower
               for p in entry.parameters):
            found[effect.name] = {p.name: float(min(max(numbers[p.name], p.lower), p.upper))
                                  for p in entry.parameters}
    return found


def _said(term: Term) -> str:
    """Return a term with its number, or those of all recordings."""
    c = term.candidate
    if not term.each:
        return f"{c.words}: {with_uncertainty(term.value, term.stddev, c.unit)}"
    low, high = side_by_side(min(term.each), max(term.each), max(term.stddev, 1e-300), c.unit)
    return f"{c.words}: {low} to {high} over the recordings"


def size_of(terms: Sequence[Term], model: Model) -> str:
    """Return how much terms do at their largest, in words."""
    made = np.concatenate([np.abs(one[table.good]) for one, table in zip(
        _made(terms, model), model.tables, strict=True)])
    return quantity(float(np.quantile(made, LARGEST)), SIDES[model.balance], 3)


def _made(terms: Sequence[Term], model: Model) -> list[np.ndarray]:
    """Return what terms make in each recording at the compared points, (m,) each."""
    names = [term.candidate.name for term in terms]
    found = []
    for table, weights in zip(model.tables, model.weights, strict=True):
        total = np.zeros(len(table.rows))
        for name in names:
            if name in table.places:
                total += weights.get(name, 0.0) * table.rows[:, table.places[name]]
        found.append(total)
    return found


def _configured(term: Term, rig: Rig) -> tuple[str, float, Value] | None:
    """Return the config's number that a term corrects: its key, the config's value, what it is.

    The leakage is C_T / 2 of the pressure difference; a mass or a leakage is added to.
    """
    gain = rig.position_gain or 0.0
    key, value, slope = {
        "D_p": ("pump_displacement", term.value, 1.0), "dM": ("mass", rig.mass + term.value, 1.0),
        "k_d": ("position_gain", gain * (1.0 + term.value), gain),
        "L": ("leakage", rig.leakage + 2.0 * term.value, 2.0),
    }.get(term.candidate.name, ("", 0.0, 0.0))
    configured = getattr(rig, key) if key else None
    if not configured or not value > 0.0:
        return None
    unit = type(rig).model_fields[key].json_schema_extra["unit"]
    return key, configured, Value(value, slope * term.stddev, unit)


def _within_tolerance(term: Term, rig: Rig, policy: Policy) -> bool:
    """Tell whether a number of the config may be what a term says of it, by its tolerance."""
    found = _configured(term, rig)
    if found is None:
        return False
    key, configured, now = found
    return abs(np.log(now.value / configured)) <= policy.varied * float(np.hypot(
        rig.tolerance.log_spread(key), now.stddev / now.value))


def _leaks_more(term: Term, policy: Policy) -> bool:
    """Tell whether the leakage that every model has is surely more than the config's."""
    return (term.candidate.name == "L" and term.candidate.always
            and term.value > policy.varied * term.stddev)


def _wrong(model: Model, rig: Rig, policy: Policy) -> list[RigFinding]:
    """Return the numbers of the config that are far from the recordings'."""
    found = []
    for term in model.terms:
        one = _configured(term, rig)
        if one is None or not np.isfinite(term.stddev) or _within_tolerance(term, rig, policy):
            continue
        key, configured, now = one
        if key == "leakage" or (key == "mass" and (term.value > 0.0 or not term.named)):
            continue  # more of either is an effect of the catalogue
        shown = side_by_side(configured, now.value, now.stddev, now.unit)
        found.append(RigFinding(
            key, configured, now, policy.certain,
            f"{key}: the config says {shown[0]}, the recording {shown[1]}", TWINS.get(key, ())))
    return found


def place_of(models: Sequence[Model], courses: Sequence[Course],
             effects: Sequence[NamedEffect | Change], wrong: Sequence[RigFinding], verdict: str
             ) -> tuple[Location, tuple]:
    """Return where the disagreement lies, and its shape.

    Parameters
    ----------
    courses : that the models are shown on.
    """
    shares = dict.fromkeys(WHERE, 0.0)
    if verdict == "consistent":
        return Location(shares, "", ()), ()
    if verdict == "unexplained":
        weights = {one.balance: one.error**2 for one in models}
    else:
        blamed = {effect.balance for effect in effects} | {
            SIDE_OF[one.key] for one in wrong}
        weights = {one.balance: max(one.nominal_error**2 - one.error**2, 1e-12)
                   for one in models if one.balance in blamed}
    total = sum(weights.values()) or 1.0
    shares |= {name: weight / total for name, weight in weights.items()}
    worst = max(models, key=lambda one: shares[one.balance])
    curves, where = [], None
    for one in models:
        if shares[one.balance] <= 0.0:
            continue
        parts = parts_of(one, courses)
        curves += places.curves_of(one.balance, SIDES[one.balance], parts)
        if one is worst:
            regime, weight = places.regime_of(one.balance, parts)
            where = Location(shares, regime, places.worst_intervals(parts, weight)
                             if regime != "always" else places.whole_of(parts))
    return where, tuple(curves)


def parts_of(model: Model, courses: Sequence[Course]) -> list[places.Part]:
    """Return what a balance lacks along the recordings: what is left, and what its names make."""
    made = _made(model.named, model) if model.named and len(model.shown) == len(
        model.tables) else [None] * len(model.shown)
    found = []
    for table, left, course, one in zip(model.shown, model.after, courses, made, strict=True):
        x, v = course.compared(course.x), course.compared(course.v)
        dp = None if course.p1 is None else course.compared(course.p1 - course.p2)
        omega = None if course.omega is None else course.compared(course.omega)
        there = table.good & (table.moving | (model.balance != "force"))
        found.append(places.Part(
            0.0, table.dt, x, v, dp, omega, there,
            np.where(there, left + (0.0 if one is None else one), np.nan), one))
    return found


def overlay_of(model: Model) -> Overlay | None:
    """Return a balance over the seconds in which the config's model is worst on unseen parts."""
    best, found = -1.0, None
    for table, before, after in zip(model.shown, model.before, model.after, strict=True):
        length = min(max(4, round(OVERLAY / table.dt)), len(before))
        squares = np.where(table.good, before**2, 0.0)
        sums = np.convolve(squares, np.ones(length), mode="valid")
        first = int(np.argmax(sums))
        if sums[first] > best and table.good[first : first + length].any():
            best, here = float(sums[first]), slice(first, first + length)
            whole = np.where(table.good, table.rows[:, 0] + table.known, np.nan)[here]
            found = Overlay(model.balance, SIDES[model.balance],
                            np.arange(here.start, here.stop) * table.dt, whole,
                            whole - before[here], whole - after[here])
    return found


def _agreement(models: Sequence[Model], courses: Sequence[Course]) -> tuple[Agreement, ...]:
    """Return B from the slow and the fast half of the motion, all else held."""
    force = next((one for one in models if one.balance == "force"), None)
    if force is None or force["B"] is None:
        return ()
    speeds = [np.abs(course.compared(course.v)) for course in courses]
    middle = np.median(np.concatenate([
        speed[table.good & table.moving] for speed, table in zip(
            speeds, force.tables, strict=True)] or [np.zeros(1)]))
    found = []
    for name, fast in (("slow half", False), ("fast half", True)):
        values = []
        for model in (None, force):
            gram, count, left, n = np.zeros(2), 0, 0.0, 1.0
            for table, weights, speed in zip(force.tables, force.weights, speeds, strict=True):
                here = table.good & table.moving & ((speed > middle) == fast)
                others = {} if model is None else {
                    key: value for key, value in weights.items() if key != "B"}
                y, column = table.left(others)[here], table.rows[here, table.places["B"]]
                gram += column @ column, column @ y
                left, count, n = left + float(y @ y), count + int(here.sum()), table.full[1]
            if count < 2 or not gram[0] > 0.0:
                return ()
            value = float(gram[1] / gram[0])
            noise = max(left - value * gram[1], 0.0) / count * n
            values.append({"B": Value(value, float(np.sqrt(noise / gram[0])), "N·s/m")})
        found.append(Agreement(name, *values))
    return tuple(found)


def _fitted(models: Sequence[Model], after: dict[str, Value], effects: Sequence[NamedEffect],
            wrong: Sequence[RigFinding]) -> Fitted | None:
    """Return the numbers behind an answer; each with its own deviation."""
    rows = [(name, value.value, value.stddev) for name, value in after.items()]
    rows += [(f"{effect.name}.{symbol}", value.value, value.stddev) for effect in effects
             for symbol, value in effect.parameters.items()]
    rows += [(f"rig.{one.key}", one.found.value, one.found.stddev) for one in wrong]
    rows = [row for row in rows if np.isfinite(row[2])]
    if not after:
        return None
    names, values, stddev = zip(*rows, strict=True)
    return Fitted(names, np.array(values), np.diag(np.square(stddev)))


def lines_of(machine: Machine) -> tuple[str, ...]:
    """Return what else the recordings of a machine say together, as sentences."""
    found = []
    for one in machine.balances:
        found.append(
            f"{one.balance}, on recordings left out: {share(rms(one.nominal), 2)} of it open with "
            f"the config, {share(one.unexplained, 2)} with the named terms, "
            f"{share(rms(one.reference), 2)} with a flexible function of the signals instead")
        small = [p.words for p in (*one.parameters, *one.settings)
                 if p.name not in (*LINEAR, "F_0")
                 and not any(p.name in named.terms for named in one.named)]
        if small:
            found.append(f"{one.balance}: corrections of form that help, too small to be named: "
                         f"{listed(small)}")
        if one.repeats:
            where = max(one.regimes, key=lambda regime: regime.energy / max(regime.time, 1e-3))
            found.append(
                f"{one.balance}: the catalogue is incomplete: {share(one.repeats, 2)} of the "
                f"squared error repeats from recording to recording; {share(where.energy, 2)} of "
                f"it lies {where.name}, {share(where.time, 2)} of the time")
    found += [f"{one.source} does not belong: {one.why}" for one in machine.odd]
    return tuple(found)
