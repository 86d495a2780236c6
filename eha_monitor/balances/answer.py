"""What the balances of recordings answer: names, numbers, place, and the proof on unseen parts."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from eha_monitor.balances import places
from eha_monitor.balances.advice import STIFF, advice_of
from eha_monitor.balances.baseline import absent_effects, baseline
from eha_monitor.balances.candidates import (
    LINEAR,
    SIDES,
    Scale,
    balances_in,
    candidate_of,
)
from eha_monitor.balances.contact import contacts_of
from eha_monitor.balances.course import NO_MOTION, Course
from eha_monitor.balances.least_squares import rms
from eha_monitor.balances.machine import (
    Machine,
    machine_from,
    of_those_that_belong,
    pressure_varied,
)
from eha_monitor.balances.mean_pressure import leak_or_source
from eha_monitor.balances.measured import course_of, courses_of
from eha_monitor.balances.model import LOAD, Model, of_machine, of_recordings, on_held_out
from eha_monitor.balances.named import (
    config_effects,
    effects_of,
    error_of_area,
    gainless,
    made_by,
    numbers_within,
    within_tolerance,
    wrong_numbers,
)
from eha_monitor.balances.oil import Stiffness, stiffness_of
from eha_monitor.balances.policy import POLICY, Policy
from eha_monitor.balances.together import of_one_machine
from eha_monitor.errors import InputError
from eha_monitor.mismatch.diagnosis import (
    BALANCE_OF,
    Adjusted,
    Agreement,
    Change,
    Considered,
    Diagnosis,
    Fitted,
    Gate,
    Location,
    NamedEffect,
    Overlay,
    RigFinding,
    SignalFit,
    Value,
    adjusted_of,
    adjusted_words,
    health_sentences,
    payload_sentences,
)
from eha_monitor.quantity import quantity, share, with_uncertainty
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.hypothesis import Hypothesis
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig
from eha_monitor.words import listed

SIDE_OF = {"mass": "force", "pump_displacement": "flow", "position_gain": "drive",
           "charge_pressure": "flow", "leakage": "flow"}
OVERLAY = 4.0  # s of an overlay
WHERE = ("force", "flow", "drive", "sensor")


@dataclass(frozen=True)
class Asked:
    """What a diagnosis is asked beside its recordings; see :func:`mismatch.diagnose.diagnose`.

    ``newest`` : the first recording is, and its load goes into the config.
    """

    held_out: Recording | None = None
    hypothesis: Hypothesis | None = None
    without: tuple[str, ...] = ()
    vary: tuple[str, ...] = ()
    newest: bool = False


def answered(recordings: Sequence[Recording], settings: Settings, asked: Asked = Asked(),
             policy: Policy = POLICY) -> Diagnosis:
    """Return the answer that recordings of one rig give by their balances.

    Raises
    ------
    InputError
        If one of them has no force balance.
    """
    started, rig = time.perf_counter(), settings.rig
    recordings, courses, left_out = courses_of(recordings, settings)
    baselines = tuple(baseline(recording, settings) for recording in recordings)
    if not any(course.shows for course in courses):
        return still(recordings, courses, baselines, started)
    courses, scale, machine = of_one_machine(courses, rig, policy), Scale.of(
        courses, contacts_of(courses, policy)), None
    own, untestable = (), ()
    if asked.hypothesis is not None:
        candidate = candidate_of(asked.hypothesis, rig) if len(courses) < policy.fewest else None
        own = () if candidate is None else (candidate,)
        untestable = () if own else (Considered(
            asked.hypothesis.name, np.nan, (), "these recordings are judged by their balances, "
            "which test what is proportional to one of its parameters, on one recording or two"),)
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
        shown = [replace(course_of(asked.held_out, settings, courses[0].band),
                         oil=courses[0].oil)]
        there = balances_in(shown, rig)
        models = [on_held_out(one, shown[0], rig, policy) for one in models
                  if one.balance in there]
    flow = next((one["D_p"] for one in models if one.balance == "flow"), None)
    found = _composed(models, shown, settings, policy, leak_or_source(
        courses, settings, None if flow is None else flow.value, policy), asked.newest)
    return replace(
        found, bags=tuple(one.source for one in recordings),
        data="held_out" if asked.held_out is None else "held_out_bag", baselines=baselines,
        advice=advice_of(models, machine) + found.advice + ((STIFF,) if _no_oil(
            models, found, rig) else ()),
        health=found.health + (() if machine is None else tuple(
            f"{one.source} does not belong: {one.why}" for one in machine.odd)) + left_out
        + absent_effects(courses, baselines, settings, policy),
        remarks=() if machine is None else lines_of(machine),
        considered=untestable, machine=machine,
        belonging=None if machine is None else of_those_that_belong(
            machine, courses, rig, asked.vary, asked.without),
        agreement=_agreement(models, courses), policy=policy.to_dict(),
        duration_s=sum(one.duration for one in recordings),
        wall_s=time.perf_counter() - started)


def _no_oil(models: Sequence[Model], found: Diagnosis, rig: Rig) -> bool:
    """Tell whether an answer states no beta_e, although it has the flow and the volumes."""
    return (found.verdict in ("consistent", "mismatch") and "beta_e" not in found.after
            and bool(rig.volume_1 and rig.volume_2)
            and any(one.balance == "flow" for one in models))


def first_answer(recordings: Sequence[Recording], settings: Settings, asked: Asked = Asked()
                 ) -> Diagnosis | None:
    """Return what the balances answer; None where they hold no force."""
    try:
        return answered(recordings, settings, asked)
    except InputError:
        return None


def still(recordings: Sequence[Recording], courses: Sequence[Course], baselines: tuple,
          started: float) -> Diagnosis:
    """Return the answer for recordings in which nothing moves."""
    moved = max(float(np.ptp(course.x)) for course in courses)
    noise = max(course.sensors["x"] for course in courses)
    why = next((f", but {one.still}" for one in courses if one.still != NO_MOTION),
               f" only, with {quantity(noise, 'm', 2)} of noise: too little motion to identify "
               "anything")
    return Diagnosis(
        tuple(one.source for one in recordings), "insufficient_data",
        f"the piston moves by {quantity(moved, 'm', 2)}{why}",
        Location(dict.fromkeys(WHERE, 0.0), "", ()), (), {}, {}, "held_out", {},
        baselines=baselines, duration_s=sum(one.duration for one in recordings),
        wall_s=time.perf_counter() - started)


def _composed(models: Sequence[Model], courses: Sequence[Course], settings: Settings,
              policy: Policy, charge: NamedEffect | RigFinding | None, newest: bool
              ) -> Diagnosis:
    """Return verdict, names, numbers, place and proof of models.

    Parameters
    ----------
    charge : what the mean pressure says.
    newest : as :class:`Asked`.
    """
    rig = settings.rig
    varying = [one.balance for one in models if only_load(one, policy)]
    models = [one.load_alone() if one.balance in varying else one for one in models]
    # A number that leaves its balance open is no explanation: a drive at its limit has no gain.
    wrong = tuple(finding for one in models if one.named or one.error <= policy.near
                  for finding in wrong_numbers(one, rig, policy))
    within = tuple(finding for one in models for finding in numbers_within(one, rig, policy))
    effects = [effect for one in models for effect in effects_of(one, rig, policy,
                                                                settings.effects)]
    if isinstance(charge, RigFinding):
        wrong += (charge,)
    elif charge is not None and charge.name not in {effect.name for effect in effects}:
        effects.append(charge)
    effects.sort(key=lambda effect: -effect.log_evidence)
    open_ = [one for one in models if is_open(one, policy) and one.balance not in varying]
    # Each balance is measured by channels of its own: one that stays open hides no worn pump.
    nameless = {one.balance for one in (
        *open_, *(one for one in models if gainless(one, policy)))}
    effects = [effect for effect in effects if effect.balance not in nameless]
    wrong, within = (tuple(one for one in some if SIDE_OF[one.key] not in nameless)
                     for some in (wrong, within))
    models = [one.plain() if one.balance in nameless else one for one in models]
    blamed = {one.balance for one in effects} | {SIDE_OF[one.key] for one in wrong}
    learned = {one.balance: one.learned for one in models if one.learned is not None}
    unsure = [one for one in models if one.balance not in {*blamed, *learned}
              and not agrees(one, rig, policy)]
    verdict = "mismatch" if blamed else (
        "unexplained" if open_ or unsure or learned else "consistent")
    stiffness = stiffness_of(courses, rig)
    before, after = (known_of(
        [one for one in models if nominal or one.balance not in (*varying, *nameless)], rig,
        policy, stiffness,
        nominal) for nominal in (True, False))
    shown = models
    if verdict == "unexplained":
        shown = [one.plain() for one in models]
        effects, wrong, within = [], (), ()
        after = {name: value for name, value in after.items() if BALANCE_OF[name] in learned}
    where, curves = place_of(shown, courses, effects, wrong, verdict)
    drift = _drift_of(models, policy)
    warmed = () if drift is None else (_warmed(drift, len(courses)),)
    found = [
        *(one.statement for one in (*wrong, *effects)),
        *(f"of what varies in the {one.balance}, {share(one.error, 2)} has no name"
          for one in models if one.balance in varying),
        *(f"nothing of the catalogue explains {share(one.error, 2)} of the {one.balance} balance"
          for one in open_),
        *(term.message for term in learned.values()),
        *map(_unsure_words, [one for one in unsure if one.balance not in nameless])]
    message = "; ".join(found or (_agreeing_words(models, rig, within, policy), *warmed))
    return Diagnosis(
        (), verdict, message, where, tuple(effects), before, after, "held_out",
        {one.balance: SignalFit(SIDES[one.balance], one.nominal_error * one.size,
                                one.error * one.size, one.floor, signal_rms=one.size)
         for one in models},
        curves=curves, overlays=tuple(o for one in models if (o := overlay_of(one)) is not None),
        # What a balance lacks bends its own parameter; least squares on the other do not see it.
        health=tuple(sentence for name, value in before.items() for sentence in health_sentences(
            {name: value}, after, [e for e in effects if e.balance == BALANCE_OF[name]])
        ) + (warmed if found else ()) + payload_sentences(effects, wrong, settings),
        drift=drift,
        config_effects=config_effects(models, effects, settings, newest) | {
            f"learned_{term.adds}": term.entry for term in learned.values()},
        learned=tuple(learned.values()),
        probability={"consistent": np.nan, "unexplained": np.nan}, rig_data=wrong,
        rig_within=within,
        fitted=_fitted(after, effects, wrong), gates=tuple(
            Gate(one.gate, one.what, one.statement) for model in models
            for one in model.refused))


def _drift_of(models: Sequence[Model], policy: Policy) -> Value | None:
    """Return by how much damping changes from start to end of a recording, usually."""
    drift = next((term for one in models if (term := one["B_t"]) is not None), None)
    if drift is None or not policy.sure(*drift.quantity):
        return None
    return Value(2.0 * float(np.median(drift.each or (drift.value,))), 2.0 * drift.quantity[1],
                 drift.candidate.unit)


def _warmed(drift: Value, recordings: int) -> str:
    """Return that damping changes along the recordings, in words."""
    return (f"viscous damping {'falls' if drift.value < 0.0 else 'rises'} by "
            f"{with_uncertainty(abs(drift.value), drift.stddev, drift.unit)} within "
            f"{'the usual' if recordings > 1 else 'the'} recording, as in oil that warms or cools")


def _agreeing_words(models: Sequence[Model], rig: Rig, within: Sequence[RigFinding],
                    policy: Policy) -> str:
    """Return that nothing is missing that has a name, and what is left all the same."""
    left = [f"{share(one.error, 2)} of the {one.balance}" for one in models
            if one.error > max(policy.worse, policy.clean * one.floor / one.size)]
    off = adjusted_of(within, rig)
    off += [Adjusted(f"{term.candidate.effect}.{term.candidate.symbol}", term.candidate.held,
                  Value(term.candidate.held + value, stddev, term.candidate.unit),
                  abs(value) > rig.tolerance.effects * term.candidate.held)
            for one in models for term in one.terms
            if term.candidate.held and within_tolerance(term, rig, policy)
            for value, stddev in [term.quantity] if policy.sure(value, stddev)]
    judged = f"{listed([one.balance for one in models])} balance{'s' * (len(models) > 1)}"
    near, asked = adjusted_words(off)
    said = "the config's own model" + (f", with {near}," if near else "")
    said += f" explains the {judged} of this recording"
    if asked:
        said += f" only if {asked}{',' if left else ''}"
    if left:
        said += f" but for {listed(left)}, of which no effect of the catalogue explains more"
    return said


def _unsure_words(one: Model) -> str:
    """Return what a balance leaves that has no name."""
    terms = [t.candidate.words for t in one.terms if t.candidate.name not in LINEAR]
    removed = 1.0 - one.error / one.nominal_error
    left = f"the config's model leaves {share(one.nominal_error, 2)} of the {one.balance}; "
    if not terms or removed < POLICY.worse:
        return f"{left}nothing of the catalogue explains it"
    how = "explains {} of that, not surely" if len(terms) == 1 else (
        "together explain {} of that, none of them surely")
    return f"{left}{listed(terms)} {how.format(share(removed, 2))}"


def is_open(model: Model, policy: Policy) -> bool:
    """Tell whether a balance leaves more than an answer may, and more than the sensors make."""
    return model.error > max(policy.open, policy.clean * model.floor / model.size)


def only_load(model: Model, policy: Policy) -> bool:
    """Tell whether a constant load is sure while what varies beside it stays open.

    It is most of what the config leaves: a boom that stands on its cylinder, for example.
    """
    return (is_open(model, policy) and model.load is not None
            and model.error <= policy.open * model.nominal_error)


def agrees(model: Model, rig: Rig, policy: Policy) -> bool:
    """Tell whether the config's own model explains a balance.

    It leaves less than ``near``, and a model with more terms no less than ``open`` of that; or
    little.  Or what it leaves is within the config's tolerances: a mass, or a constant load, of
    which areas that are a little off make some with each bar of mean pressure.
    """
    little = max(policy.clean * model.floor / model.size, policy.small)
    more = [term for term in model.terms if term.candidate.name not in LINEAR]
    if more and model.error <= little and all(
            within_tolerance(term, rig, policy) or (
                term.candidate.effect == LOAD and not policy.sure(*term.presence))
            for term in more):
        return True
    return model.nominal_error <= little or (
        model.nominal_error <= policy.near
        and model.error >= policy.open * model.nominal_error)


def known_of(models: Sequence[Model], rig: Rig, policy: Policy, stiffness: Stiffness,
             nominal: bool = False) -> dict[str, Value]:
    """Return B and beta_e, of the config's linear model or of the whole one.

    The oil's is by itself: of a model's terms several may share what the oil takes up.

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
                found["B"] = Value(
                    value, float(np.hypot(stddev, error_of_area(rig) * value)), "N·s/m")
    modulus, stddev = stiffness.modulus
    if policy.sure(modulus, stddev):
        volume = rig.tolerance.log_spread("volume_1")
        found["beta_e"] = Value(modulus, float(np.hypot(stddev, volume * modulus)), "Pa")
    return found


def place_of(models: Sequence[Model], courses: Sequence[Course],
             effects: Sequence[NamedEffect | Change], wrong: Sequence[RigFinding], verdict: str,
             usual: Mapping[str, float] = MappingProxyType({})) -> tuple[Location, tuple]:
    """Return where the disagreement lies, and its shape.

    Parameters
    ----------
    courses : that the models are shown on.
    usual : balance -> error of the machine's own recordings, as a share of the signal: only more
        than that has come.
    """
    nowhere = dict.fromkeys(WHERE, 0.0)
    if verdict == "consistent":
        return Location(nowhere, "", ()), ()
    blamed = {effect.balance for effect in effects} | {SIDE_OF[one.key] for one in wrong}
    by_sensor = blamed == {"sensor"}
    if verdict == "unexplained":
        weights = {one.balance: max((one.error if one.learned is None else one.nominal_error)**2
                                    - usual.get(one.balance, 0.0)**2, 0.0) for one in models}
    else:  # a sensor's error shows in every balance that it spoils
        weights = {one.balance: max(one.nominal_error**2 - one.error**2, 1e-12)
                   for one in models if one.balance in blamed or by_sensor}
    total = sum(weights.values())
    if not total:
        return Location(nowhere, "always", ()), ()
    shares = {name: weight / total for name, weight in weights.items()}
    worst = max(models, key=lambda one: shares.get(one.balance, 0.0))
    curves, where = [], None
    for one in models:
        if shares.get(one.balance, 0.0) <= 0.0:
            continue
        parts = parts_of(one, courses, by_sensor)
        curves += places.curves_of(one.balance, SIDES[one.balance], parts)
        if one is worst:
            regime, weight = places.regime_of(one.balance, parts)
            where = Location(
                nowhere | ({"sensor": 1.0} if by_sensor else shares), regime,
                places.worst_intervals(parts, weight) if regime != "always"
                else places.whole_of(parts))
    return where, tuple(curves)


def parts_of(model: Model, courses: Sequence[Course], by_sensor: bool = False
             ) -> list[places.Part]:
    """Return what a balance lacks along the recordings: what is left, and what its names make.

    ``by_sensor``: what goes with the error of a sensor is made by that.
    """
    made = [None] * len(model.shown)
    if by_sensor:
        made = [before - after for before, after in zip(model.before, model.after, strict=True)]
    elif model.named and len(model.shown) == len(model.tables):
        made = made_by(model.named, model)
    found = []
    for table, left, course, one in zip(model.shown, model.after, courses, made, strict=True):
        x, v = course.compared(course.x), course.compared(course.v)
        dp = None if course.p1 is None else course.compared(course.p1 - course.p2)
        omega = None if course.omega is None else course.compared(course.omega)
        found.append(places.Part(
            0.0, table.dt, x, v, dp, omega, table.good,
            np.where(table.good, left + (0.0 if one is None else one), np.nan), one))
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
        speed[table.good] for speed, table in zip(
            speeds, force.tables, strict=True)] or [np.zeros(1)]))
    found = []
    for name, fast in (("slow half", False), ("fast half", True)):
        values = []
        for model in (None, force):
            gram, count, left, n = np.zeros(2), 0, 0.0, 1.0
            for table, weights, speed in zip(force.tables, force.weights, speeds, strict=True):
                here = table.good & ((speed > middle) == fast)
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


def _fitted(after: dict[str, Value], effects: Sequence[NamedEffect],
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
    return tuple(found)
