"""What has changed in recordings of a machine, as an answer."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from eha_monitor.balances.alone import covariance_by_chance
from eha_monitor.balances.answer import overlay_of, place_of, still
from eha_monitor.balances.candidates import SIDES, balances_in
from eha_monitor.balances.change_words import WORDS, advice_beside, change_of, in_share, message_of
from eha_monitor.balances.course import Course
from eha_monitor.balances.judge import source_of, within_stroke
from eha_monitor.balances.judged import Judged, JudgedBalance, Moved, explains, left_unseen
from eha_monitor.balances.least_squares import beside, rms
from eha_monitor.balances.machine import LEAST, Machine, of_another
from eha_monitor.balances.measured import courses_of
from eha_monitor.balances.model import LOAD, Model, Term, of_judged
from eha_monitor.balances.named import size_of
from eha_monitor.balances.oil import Stiffness, clearest, flow_of, stiffness_of
from eha_monitor.balances.places import binned
from eha_monitor.balances.policy import POLICY
from eha_monitor.balances.scatter import limit_of
from eha_monitor.balances.sensor_error import without_sensor_error
from eha_monitor.balances.warmth import at_oil, viscosity_of
from eha_monitor.errors import InputError
from eha_monitor.indicators.laws import LEAKS
from eha_monitor.mismatch.diagnosis import (
    Change,
    Curve,
    Diagnosis,
    Location,
    NamedEffect,
    SignalFit,
    Value,
)
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import quantity, share, with_uncertainty
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig
from eha_monitor.words import listed

# What the make-up path's flow from another source may be taken for.
FED = ("external_leakage", *LEAKS)


def against(machine: Machine, recordings: Sequence[Recording], settings: Settings,
            references: tuple[str, ...]) -> Diagnosis:
    """Return what has changed in recordings of a machine, or that nothing has.

    Parameters
    ----------
    machine : of the healthy recordings ``references``.

    Raises
    ------
    InputError
        If none of them has a force balance.
    """
    started, settings = time.perf_counter(), machine.as_made(settings)
    rig = settings.rig
    recordings, courses, left_out = courses_of(recordings, settings, machine.band)
    if not any(course.shows for course in courses):
        return replace(still(recordings, courses, (), started), references=references)
    courses, outside = within_stroke(machine, courses)
    if outside > machine.policy.open:
        return replace(still(recordings, courses, (), started), references=references, message=(
            f"{share(outside, 2)} of its motion is where none of the healthy recordings has "
            "been: record it on the same part of the stroke"))
    apart = _apart(machine, balances_in(courses, rig), settings, references)
    read, reading, sensor = without_sensor_error(machine, recordings, settings, courses)
    blind = _blind(machine, [one.balance for one in read.balances])
    judged, courses = reading.judged, reading.courses
    # Of a drive of unknown law the numbers are the motion's; and of what the machine's own terms
    # describe no better than a constant does, nothing is known.
    lost = {one for one, left in blind.items() if left >= 1.0} | (
        set() if sensor else blind.keys() & {"drive"})
    read, judged = (replace(some, balances=tuple(
        one for one in some.balances if one.balance not in lost)) for some in (read, judged))
    apart += (*_other_pump(machine, judged), *_other_areas(machine, judged, rig))
    viscosity = viscosity_of(courses)
    stiffness = stiffness_of(courses, rig)
    judged = replace(judged, balances=tuple(replace(one, changed=tuple(
        moved for moved in one.changed if not _as_stiff(moved, machine, stiffness)))
        for one in judged.balances))
    judged = replace(judged, balances=tuple(_at_zero(one) for one in judged.balances))
    moved = judged.changed
    verdict = ("consistent" if judged.belongs else "mismatch" if judged.explained
               else "unexplained")
    changes = tuple(change_of(one, machine, settings, stiffness) for one in moved
                    ) if verdict == "mismatch" else ()
    if sensor:
        verdict, changes = "mismatch", (*changes, *sensor)
    oil = None if judged.broken or any(one.what == "beta_e" for one in changes) else _oil(
        machine, stiffness)
    loud = {one.balance for one in judged.loud}
    if oil is not None and verdict == "unexplained" and "flow" not in loud:
        verdict, changes = "mismatch", (oil,)  # and something else as well
    elif oil is not None and loud <= {"flow"}:
        softer = judged if changes else _with_oil(machine, judged, stiffness, rig)
        if softer is not None:
            verdict, changes, judged = "mismatch", (*changes, oil), softer
        else:
            verdict = "unexplained"
    if judged.broken:
        apart += ("check the channels (unit, sign, sensor): what no numbers of a machine come "
                  "near is seldom the machine",)
    seconds, asked = sum(course.seconds for course in courses), 2.0 * machine.policy.block
    if verdict == "unexplained" and seconds < asked:  # so little may leave anything
        return replace(still(recordings, courses, (), started), references=references, message=(
            f"{seconds:.2g} s of its motion can be compared, and expected are {asked:g} s where "
            "something is unlike the healthy recordings"))
    source = source_of(machine, courses, rig, next(
        (one for one in moved if one.candidate.effect == LOAD), None))
    if source is not None and source.now.value < source.reference.value and changes:
        kept = [not _fed(one, judged, source, rig) for one in moved]
        changes = (*(one for one, stays in zip(changes, kept, strict=False) if stays),
                   *changes[len(moved):])
        moved = tuple(one for one, stays in zip(moved, kept, strict=True) if stays)
    # More oil through a leak or from a pump holds an emptier chamber higher by itself.
    if source is not None and verdict != "unexplained" and not (
            source.now.value > source.reference.value
            and any(one.balance == "flow" for one in changes)):
        verdict, changes = "mismatch", (*changes, source)
    if verdict == "consistent" and {one.balance for one in judged.balances} <= blind.keys():
        verdict = "insufficient_data"
    if verdict in ("unexplained", "mismatch"):
        judged = judged.with_curves(courses, rig, machine.policy)
    models = [_model(one) for one in judged.balances]
    if sensor:
        models = [replace(one, before=_model(raw).before)
                  for one, raw in zip(models, read.balances, strict=True)]
    effects = tuple(_effect(one, change, models) for one, change in zip(
        moved, changes, strict=False) if change.symbol)
    # What no numbers of the machine describe has a place, and not what is left of another balance.
    where, curves = place_of(
        [one for one in models if verdict != "unexplained" or one.balance in loud or not loud],
        courses, changes, (), verdict, {one.balance: one.usual for one in judged.balances})
    signals = {one.balance: SignalFit(
        SIDES[one.balance], one.nominal_error * one.size, one.error * one.size, one.floor,
        signal_rms=one.size) for one in models}
    if oil is not None and {one.what for one in changes if one.balance == "flow"} == {"beta_e"}:
        shown = softened(courses, rig, machine.stiffness.value, stiffness.value)
        if shown is not None:  # it shows in a wider band than what else may change
            curve, signals["flow"] = shown
            curves = (curve, *(one for one in curves if one.balance != "flow"))
    if changes:
        where = Location(shares_of(changes, where.balance), where.regime, where.intervals_s)
    return Diagnosis(
        tuple(one.source for one in recordings), verdict,
        message_of(verdict, changes, judged, machine.runs, tuple(
            in_share(one, change_of(one, machine, settings, stiffness)) for one in judged.small
            if one.candidate.balance not in {change.balance for change in changes}), tuple(
            change_of(one, machine, settings, stiffness).statement for balance in judged.balances
            for one in balance.nearest)) + "".join(
                f"; a change of the {one} may be missed: what is known of the machine leaves "
                f"{share(left, 2)} of it unexplained in its own recordings (diagnose these "
                "together: what is missing there?)" for one, left in blind.items()),
        where, effects,
        _health(machine, judged, stiffness, viscosity, before=True),
        _health(machine, judged, stiffness, viscosity, before=False),
        "held_out", signals, curves,
        () if verdict == "consistent" else tuple(
            o for one in models if (o := overlay_of(one)) is not None),
        advice=advice_beside(machine, courses, references, verdict, outside),
        health=(*left_out, *apart),
        learned=tuple(one.curve.term for one in judged.balances if one.curve is not None),
        changes=changes, references=references, blind=tuple(blind),
        probability={"consistent": np.nan, "unexplained": np.nan},
        duration_s=sum(one.duration for one in recordings), machine=machine,
        policy=machine.policy.to_dict(), wall_s=time.perf_counter() - started)


def _fed(moved: Moved, judged: Judged, source: Change, rig: Rig) -> bool:
    """Tell whether a leakage is no more than what the make-up path lacks from a lower source.

    By its conductance within two tolerances: 6 bar less of it had been a leak of 25 ml/min.
    """
    if moved.candidate.effect not in FED:
        return False
    table = next(one.table for one in judged.balances if one.balance == "flow")
    column = table.rows[table.good, table.places[moved.candidate.name]]
    made = rms(column) * abs(moved.here - moved.machine)
    most = rig.makeup_conductance * float(np.exp(
        2.0 * rig.tolerance.log_spread("makeup_conductance")))
    return bool(made <= most * abs(source.now.value - source.reference.value))


def _apart(machine: Machine, there: Sequence[str], settings: Settings,
           references: tuple[str, ...]) -> tuple[str, ...]:
    """Return what says that the references may be of another machine, as sentences.

    Balances that only one side has, and a mass or displacement far from the config's.

    Raises
    ------
    InputError
        If no balance is common to both.
    """
    rig, own = settings.rig, [one.balance for one in machine.balances]
    name = references[0] if len(references) == 1 else "the references"
    if not set(own) & set(there):
        raise InputError(f"{name}: expected a reference with the signals of the recording, found "
                         f"the {listed(own)} there and the {listed(there)} in the recording only")
    found = [f"the {one} is not compared: {name if one in there else 'the recording'} lacks its "
             "signals" for one in sorted({*own} ^ {*there})]
    if machine.rig and rig.name and machine.rig != rig.name:
        found.append(f"{name}: the machine of {machine.rig}, where the config is of {rig.name} "
                     "(rig.name): check whether it is this machine")
    for one in machine.balances:
        for p in one.parameters:
            value, configured, words = {
                "D_p": (p.value, rig.pump_displacement, "a pump displacement"),
                "dM": (rig.mass + p.value, rig.mass, "a moving mass"),
            }.get(p.name, (0.0, None, ""))
            if configured and of_another(value, configured):
                unit = "kg" if p.name == "dM" else p.unit
                found.append(f"{name}: {words} of {quantity(value, unit, 3)} where the config has "
                             f"{quantity(configured, unit, 3)}: check whether it is this machine")
    return tuple(found)


def _other_pump(machine: Machine, judged: Judged) -> tuple[str, ...]:
    """Return what says that the recordings may be of another machine: a pump does not wear so."""
    return tuple(
        f"{judged.source}: a pump displacement of {quantity(judged.values[p.name][0], p.unit, 3)} "
        f"where the machine has {quantity(p.value, p.unit, 3)}: check whether it is a recording "
        "of this machine" for one in machine.balances for p in one.parameters
        if p.name == "D_p" and p.value > 0.0 and p.name in judged.values
        and of_another(judged.values[p.name][0], p.value))


def _other_areas(machine: Machine, judged: Judged, rig: Rig) -> tuple[str, ...]:
    """Return what says that the areas are others: pump and mass are off by the same share.

    The flow is the area's times the speed, the force the area's times the pressure: with areas
    that are larger both read less.
    """
    own = {p.name: p.value for one in machine.balances for p in one.parameters}
    force = next((one for one in judged.balances if one.balance == "force"), None)
    scatter = next((one.scatter for one in machine.balances if one.balance == "force"), None)
    if not own.get("D_p") or "D_p" not in judged.values or force is None or (
            "dM" not in force.table.places or "dM" not in (*own, *scatter.names)):
        return ()
    usual = own["dM"] if "dM" in own else scatter.mean[scatter.names.index("dM")]
    names = list(dict.fromkeys(["dM", *force.free, *force.now]))
    here = covariance_by_chance(force.table, [n for n in names if n in force.table.places])[0][0]
    pump = judged.values["D_p"][0] / own["D_p"]
    mass = (rig.mass + here) / (rig.mass + usual)
    off, policy = pump - 1.0, machine.policy
    if abs(off) < policy.worse or abs(mass - pump) > policy.small * abs(off):
        return ()
    return (f"{judged.source}: pump displacement and moving mass are both {share(abs(off), 2)} "
            f"{'less' if off < 0.0 else 'more'} than the machine's, as with piston areas that are "
            f"{'larger' if off < 0.0 else 'smaller'} by that: check whether it is a recording of "
            "this cylinder",)


def _blind(machine: Machine, there: Sequence[str]) -> dict[str, float]:
    """Return the balances of which the machine's own terms leave most, and how much; share.

    What comes there is no farther from them than healthy recordings are, unless it is a number
    that they know all the same.
    """
    usual = {one.balance: float(np.median(one.held)) for one in machine.balances
             if one.balance in there}
    return {balance: left for balance, left in usual.items() if left > (
        machine.policy.near if balance == "drive" else machine.policy.open)}


def shares_of(changes: Sequence[Change], balances: Iterable[str]) -> dict[str, float]:
    """Return each balance's share of the changes."""
    return {balance: sum(one.balance == balance for one in changes) / len(changes)
            for balance in balances}


def _at_zero(one: JudgedBalance) -> JudgedBalance:
    """Return a balance whose constant load is that at x = 0, see :func:`model.relaxed_at_zero`.

    The column of a spring that the config does not have is relaxed amid the motion.
    """
    spring = next((c for c in one.table.candidates if c.name == "k"
                   and c.effect == "spring_load" and not c.configured), None)
    if spring is None:
        return one
    x_0 = dict(spring.shape)["x_0"]
    before, now = (weights.get("k", 0.0) * x_0 for weights in (one.held, one.now))

    def there(moved: Moved | None) -> Moved | None:
        if moved is None or moved.candidate.effect != LOAD:
            return moved
        return replace(moved, machine=moved.machine - before, here=moved.here - now)

    return replace(one, changed=tuple(map(there, one.changed)), small=there(one.small),
                   nearest=tuple(map(there, one.nearest)))


def _model(one: JudgedBalance) -> Model:
    """Return a balance of the recordings as a model: the machine before, the changes after."""
    free = [name for name in one.each[0].places if name in {
        own.partition(" ")[0] for own in one.free}]
    before, after = of_judged(one.each, one.held, one.now, free)
    terms = tuple(Term(moved.candidate, moved.here, moved.stddev, named=True,
                       rivals=moved.rivals) for moved in one.changed)
    if one.curve is not None:
        terms += (Term(one.table.candidates[-1], 1.0, 0.0, named=True),)
    weights = {name: one.now.get(name, 0.0) - one.held.get(name, 0.0) for name in one.now}
    return Model(one.balance, one.each, (weights,) * len(one.each), terms, (), (), tuple(before),
                 tuple(after), one.each, float(sum(table.effective for table in one.each)),
                 None if one.curve is None else one.curve.term)


def _as_stiff(moved: Moved, machine: Machine, stiffness: Stiffness) -> bool:
    """Tell whether a compliance has moved as the oil has by itself, or has not.

    That over the stroke is the area's over the bulk modulus: it moves as the chambers' do.
    """
    oils = machine.stiffness, stiffness
    if moved.candidate.name not in ("C_h", "C_x") or not all(
            POLICY.sure(*one.modulus) for one in oils):
        return False
    spreads = [float(np.hypot(one.between, one.stddev)) for one in oils]
    if moved.candidate.name == "C_h":
        return abs(oils[0].value - oils[1].value) < np.hypot(*spreads)
    ratio = oils[1].value / oils[0].value
    doubt = ratio * np.hypot(*(s / one.value for s, one in zip(spreads, oils, strict=True)))
    return POLICY.varied * np.hypot(moved.apart, moved.machine * doubt) > abs(
        moved.here - ratio * moved.machine)


def _with_oil(machine: Machine, judged: Judged, stiffness: Stiffness, rig: Rig) -> Judged | None:
    """Return a recording with its oil in the flow balance; None where that is no explanation.

    A balance that leaves more than any healthy recording has to leave less with it.
    """
    flow = next((one for one in judged.balances if one.balance == "flow"), None)
    if flow is None or "C_h" not in flow.table.places or not rig.volume_1:
        return judged
    before = flow.now.get("C_h", 0.0)
    here = before + rig.volume_1 * (stiffness.value - machine.stiffness.value)
    after = left_unseen(flow.table, flow.now | {"C_h": here}, flow.free)
    if flow in judged.loud and (flow.leaves_much(after) or not explains(
            flow.after, after, flow.usual, machine.policy)):
        return None
    return replace(judged, balances=tuple(
        replace(one, now=one.now | {"C_h": here}, after=after)
        if one is flow and after < flow.after else one for one in judged.balances))


def _oil(machine: Machine, stiffness: Stiffness) -> Change | None:
    """Return how the oil has changed, if farther than another healthy recording of them would be.

    By the prediction interval of Student's t for one further observation.
    """
    of, count = machine.stiffness, machine.stiffness.count
    if count < machine.policy.fewest or not machine.policy.sure(*stiffness.modulus):
        return None
    spread = np.hypot(of.between, of.stddev * np.sqrt(count)) * np.sqrt(1.0 + 1.0 / count)
    limit = limit_of(count, 1.0, machine.policy.false)
    if not abs(stiffness.value - of.value) > np.hypot(
            limit * spread, machine.policy.varied * stiffness.stddev):
        return None
    healthy, now = Value(*of.modulus, "Pa"), Value(*stiffness.modulus, "Pa")
    return Change("beta_e", "", "flow", healthy, now, "Pa", (
        f"{WORDS['C_h']} is {with_uncertainty(now.value, now.stddev, 'Pa')}, where "
        f"{machine.runs} have {with_uncertainty(healthy.value, healthy.stddev, 'Pa')}"))


def _effect(moved: Moved, change: Change, models: Sequence[Model]) -> NamedEffect:
    """Return the record of an effect that has changed."""
    c = moved.candidate
    model = next(one for one in models if one.balance == c.balance)
    terms = [t for t in model.terms if t.candidate.effect == c.effect]
    entry = CATALOGUE.get(c.effect)
    gained = model.effective * float(np.log(max(model.nominal_error, 1e-9)
                                            / max(model.error, 1e-9)))
    values = {change.symbol: change.now}
    return NamedEffect(c.effect, c.balance, change.statement, values, max(gained, 0.0),
                       moved.rivals, entry.equation if entry else "",
                       entry.rig_check if entry else "", size_of(terms, model),
                       effective_samples=model.effective)


def _health(machine: Machine, judged: Judged, stiffness: Stiffness, viscosity: float, before: bool
            ) -> dict[str, Value]:
    """Return B and beta_e of the machine with their spread, or those of the recordings.

    The machine's B is that of the recordings' oil where their temperature is measured.
    """
    found = {}
    of = [(balance, p) for balance in at_oil(machine, viscosity) for p in balance.parameters]
    for balance, p in [pair for pair in of if pair[1].name == "B"]:
        form = balance.form_of.get("B", 0.0)
        between = max(p.between, LEAST * machine.policy.between * abs(p.value))  # its oil's
        value, stddev = p.value, float(np.linalg.norm((between, p.stddev, form)))
        if not before:
            value, stddev, *_ = judged.values.get(p.name, (value, stddev))
        if value > 0.0 and stddev < value:  # else these recordings do not determine it
            found["B"] = Value(value, stddev, "N·s/m")
    modulus, stddev = (machine.stiffness if before else stiffness).modulus
    if machine.policy.sure(modulus, stddev):
        found["beta_e"] = Value(modulus, stddev, "Pa")
    return found


def softened(courses: Sequence[Course], rig: Rig, healthy: float, now: float
             ) -> tuple[Curve, SignalFit] | None:
    """Return the flow that another stiffness takes up, against the rate of the pressure.

    And what either stiffness leaves of the flow on unseen parts, all else fitted.

    Parameters
    ----------
    healthy, now : 1/beta_e, 1/Pa.
    """
    rates, missing, made, squares = [], [], [], []
    for course in courses:
        found = clearest(course, rig)
        balance = None if found is None else flow_of(found[0], rig)
        fits = [] if balance is None else [
            (fit, pressed) for pressed in balance.pressed
            if (fit := balance.left(pressed, now)) is not None]
        if not fits:
            continue
        fit, pressed = min(fits, key=lambda one: one[0].error_share)
        rows = balance.rows(balance.flow, pressed, *(column[-1] for column in balance.columns),
                            *balance.off)
        rest = beside(rows[:, 0] + now * rows[:, 1], rows[:, 2:])
        taken = (healthy - now) * rows[:, 1]
        rates.append(rows[:, 1] / rig.volume_1)
        missing.append(rest + taken)
        made.append(taken)
        before = balance.left(pressed, healthy)
        squares.append(fit.samples * np.square([
            before.unseen_share * np.std(rows[:, 0] + healthy * rows[:, 1]),
            fit.unseen_share * np.std(rows[:, 0] + now * rows[:, 1]),
            balance.course.floor("flow", rig), np.std(rows[:, 0]), 1.0]))
    if not rates:
        return None
    x, middle, width, shown = binned(*map(np.concatenate, (rates, missing, made)))
    total = np.sum(squares, axis=0)
    left = np.sqrt(total[:-1] / total[-1]).tolist()
    unit = SIDES["flow"]
    return (Curve("flow", "pressure_rate", "Pa/s", unit, x, middle, width, shown),
            SignalFit(unit, *left[:3], signal_rms=left[3]))
