"""The monitor's pipeline over a whole recording: stage one, hand-over, stage two, verdicts."""

import time
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from eha_monitor.breakdown import computing
from eha_monitor.filters.consistency import judge
from eha_monitor.filters.covered import beyond, ranges_of, within
from eha_monitor.filters.engine import engine_of
from eha_monitor.filters.hold_choice import SAMPLED, HoldDecision, resolved, with_hold
from eha_monitor.filters.inputs import StageInputs, moved_mass
from eha_monitor.filters.joint import fits, run_joint
from eha_monitor.filters.known import new_known_memory
from eha_monitor.filters.model_watch import BALANCE, tainted_by
from eha_monitor.filters.pieces import inputs_of, time_of
from eha_monitor.filters.reach import WINDOW_S, Reaches, finished, reaches_of
from eha_monitor.filters.results import (
    Consistency,
    Estimate,
    Event,
    JointResult,
    Mismatch,
    ModelStatus,
    ParameterEstimate,
    StageResult,
)
from eha_monitor.filters.run_two import MOST_EVENTS, Changes, Inputs, run_stage_two_kernel
from eha_monitor.filters.status import CONVERGED, judge_parameter, no_data, units_of
from eha_monitor.filters.supervision import gave_up, new_supervision
from eha_monitor.physics.signals import M as MASS_PLACE
from eha_monitor.quantity import SYMBOLS, quantity, with_uncertainty
from eha_monitor.recordings.columns import Table, any_of, first_where, mapped, steps_to
from eha_monitor.recordings.recording import Recording, sample_of
from eha_monitor.settings.monitor import Settings

MISSING_ONE = "the force balance M x'' = F - B x' lacks an effect, or a sensor is wrong"
MISSING_TWO = ("the flow balance or the drive lacks an effect, a sensor is late or wrong, or B "
               "is wrong here")
NO_CHANGES = np.empty((0, 4))
GROSS = 25.0  # variance ratio
COARSE = 1.5  # rad of the resonance in a sample
MATTERS = 0.3  # standard deviations by which two holds must differ to be worth a word
LOOKS = 3  # stretches from which the reach of a misfit is read


def estimate(recording: Recording, settings: Settings) -> Estimate:
    """Run both stages over a recording.

    Stage one runs first; its damping, piecewise constant between detected changes and each piece
    with the value that it had at its end, is handed to stage two, which runs over the whole
    recording again (``Estimate.events`` tells each step).  Before that it is asked whether the
    drive holds its command over each sample (:mod:`hold_choice`); where the recording cannot
    tell, both answers are in the uncertainty.

    Parameters
    ----------
    recording : aligned channels.
    settings : config.

    Raises
    ------
    InputError
        If the recording's numbers break the calculation.
    """
    with computing(recording.source):
        return _estimated(recording, settings)


def _estimated(recording: Recording, settings: Settings) -> Estimate:
    started = time.perf_counter()
    settings, decision = resolved([recording], settings)
    found = estimate_held(recording, settings)
    if decision is not None and not decision.decided:
        found = either(found, estimate_held(recording, with_hold(settings, SAMPLED)), decision)
    return replace(found, wall_s=time.perf_counter() - started,
                   channels=decision.findings if decision is not None else ())


def estimate_held(recording: Recording, settings: Settings, size: int | None = None) -> Estimate:
    """Run both stages with the hold that the settings say.

    ``size`` : rows of a piece; without it a long recording is taken in pieces, others at once.
    """
    inputs = inputs_of(recording, settings, size)
    events: list[Event] = []
    one = run_stage_one(inputs, recording, settings, events)
    damping, damping_variance = hand_over(one, settings, recording, events, inputs)
    two = run_stage_two(inputs, recording, settings, damping, damping_variance, events)
    seen = [row for stage in (one, two) if fits(stage) for row in stage.changes]
    since = max((int(row[0]) + 1 for row in seen), default=0)
    joint = run_joint(inputs, recording, settings, one, two, since)
    return Estimate(
        recording, settings, one, two, joint,
        within(tested_model(one, two, joint, settings, inputs, damping),
               beyond(ranges_of(settings), sample_of(recording).channels, recording.sample_time,
                      settings.rig.position_gain), 0.0),
        tuple(sorted(events, key=lambda event: event.time_s)), inputs.noise,
        warnings=tuple(warnings_of(inputs, settings)))


def either(one: Estimate, other: Estimate, decision: HoldDecision) -> Estimate:
    """Return an answer that is as uncertain as two holds differ that cannot be told apart.

    The one that fits goes before the one that does not.
    """
    if one.model.status == "mismatch" and other.model.status == "consistent":
        one, other = other, one
    if not any(stage.estimate.status == "converged" for stage in (one.stage_one, one.stage_two)):
        return one  # too little is known for the hold to matter
    two = apart(one.stage_two, other.stage_two, one.settings, decision.sentence)
    joint = one.joint
    if joint is not None and other.joint is not None:
        joint = replace(joint, parameters={
            name: wider(p, other.joint.parameters[name].value, one.settings, decision.sentence)
            for name, p in joint.parameters.items()})
    return replace(
        one, stage_one=apart(one.stage_one, other.stage_one, one.settings, decision.sentence),
        stage_two=two, joint=joint)


def apart(stage: StageResult, other: StageResult, settings: Settings, why: str) -> StageResult:
    """Return a stage with the difference to another run of it in its standard deviations."""
    if len(stage.value) != len(other.value):
        return stage
    stddev = mapped(lambda own, mine, others: np.hypot(own, np.nan_to_num(mine - others)),
                    stage.stddev, stage.value, other.value)
    return replace(stage, estimate=wider(stage.estimate, other.estimate.value, settings, why),
                   stddev=stddev)


def wider(p: ParameterEstimate, other: float, settings: Settings, why: str) -> ParameterEstimate:
    """Return an estimate whose standard deviation reaches to another value of it."""
    off = abs(p.value - other)
    if p.status != "converged" or not off > MATTERS * p.stddev:
        return p
    stage = {"B": settings.stage_one, "beta_e": settings.stage_two}.get(p.name)
    stddev = float(np.hypot(p.stddev, off))
    if stage is None:
        return replace(p, stddev=stddev)
    wide = judge_parameter(p.name, p.value, stddev, p.unit, stage.prior, stage.prior_stddev)
    return replace(wide, message="; ".join(filter(None, (wide.message, why))))


def empty_stage(stage: str, estimate: ParameterEstimate) -> StageResult:
    """Return a stage that had no data."""
    none = np.empty(0)
    return StageResult(stage, estimate, none, none, none, none, none, none, none, none, None)


def run_stage_one(inputs: Inputs, recording: Recording, settings: Settings,
                  events: list[Event]) -> StageResult:
    """Run stage one."""
    unit = units_of(settings.rig.motion)["B"]
    if inputs.no_force:
        return empty_stage("one", no_data("B", unit, inputs.no_force))
    prior, spread = settings.stage_one.prior, settings.stage_one.prior_stddev
    watch = new_supervision()
    out, seen = run_one_kernel(inputs, settings, watch)
    if gave_up(watch):  # the model does not fit: an average with an honest sigma, not a chase
        out, seen = run_one_kernel(inputs, settings, new_supervision(True))
        events.append(Event(0.0, "one", "B varies with the motion or diverges, which is no real "
                                        "change: held constant over the record"))
    changes = seen.rows
    if not any_of((out[4],), np.isfinite):
        return empty_stage("one", no_data(
            "B", unit, "stage one found no stretch with position and force together"))
    parameter = judge_parameter("B", out[2][-1], out[3][-1], unit, prior, spread)
    verdict = unless_unexcited(parameter, judge(
        out[4], out[5], inputs.dt, "stage one", MISSING_ONE, changes, inputs.quantum))
    result = StageResult("one", parameter, time_of(recording), out[2], out[3], out[0], out[1],
                         out[6], out[4], out[5], verdict, changes=changes)
    first = first_converged(out[2], out[3], spread)
    if first is not None:
        events.append(Event(first * inputs.dt, "one",
                            "B converged at "
                            f"{with_uncertainty(out[2][first], out[3][first], unit)}"))
    events += change_events(changes, seen.found, inputs.dt, "one", "B", unit)
    return result


def run_one_kernel(inputs: Inputs, settings: Settings, watch: np.ndarray
                   ) -> tuple[list[np.ndarray], Changes]:
    """Run stage one over a recording; its six outputs and the acceleration (n,), the changes.

    ``watch`` is updated.
    """
    spread = settings.stage_one.prior_stddev
    m = np.array([np.nan, 0.0, settings.stage_one.prior])
    p = np.zeros(6)
    p[5] = spread**2
    model, memory = inputs.model, new_known_memory()
    written, seen = Table(), Changes()
    for piece in inputs.pieces():
        part, force = piece.inputs, piece.inputs.force
        out, changes = np.empty((6, part.rows)), np.empty((MOST_EVENTS, 4))
        found = engine_of(settings)[0](
            part.x, force.start, force.end, force.variance, part.p1, part.p2, inputs.dt,
            moved_mass(model, inputs.dt), inputs.position_variance, spread**2,
            settings.discretisation == "euler", model.theta, model.plain,
            model.remembering, memory, m, p, watch, piece.first, out, changes)
        seen.add(changes, found, piece.row - piece.first)
        acceleration = (force.start - out[2] * out[1]) / model.theta[MASS_PLACE]
        written.append(np.vstack([out, acceleration])[:, piece.first:])
    return written.values(), seen


def change_events(changes: np.ndarray, found: int, dt: float, stage: str, name: str,
                  unit: str) -> list[Event]:
    """Return one event for each run of changes that follow one another within a second."""
    events = []
    runs = np.split(changes, np.flatnonzero(np.diff(changes[:, 0]) * dt > 1.0) + 1)
    for run in runs:
        if len(run):
            since = ("" if len(run) == 1
                     else f" in {len(run)} steps from t = {run[0, 0] * dt:.2f} s")
            events.append(Event(float(run[-1, 0] * dt), stage,
                                f"{SYMBOLS[name]} changed from {quantity(run[0, 1], unit)} to "
                                f"{quantity(run[-1, 2], unit)}{since}"))
    if found > len(changes):
        events.append(Event(float(changes[-1, 0] * dt), stage,
                            f"{found - len(changes)} further changes of {SYMBOLS[name]} are not "
                            "listed"))
    return events


def first_converged(value: np.ndarray, stddev: np.ndarray, prior_stddev: float) -> int | None:
    """Return the first sample at which a parameter counts as converged."""
    return first_where(lambda v, s: (s < 0.1 * np.abs(v)) & (s < 0.5 * prior_stddev),
                       value, stddev)


def unless_unexcited(parameter: ParameterEstimate,
                     verdict: Consistency | None) -> Consistency | None:
    """Return the verdict, but none on a parameter that nothing told, except on a gross misfit.

    A model that nothing moves is not tested: zeros fit any.  A parameter that stays at its prior
    fits a little badly; only a gross misfit is the model's.
    """
    if verdict is None or parameter.status != "not_excited":
        return verdict
    return verdict if not verdict.consistent and verdict.variance_ratio > GROSS else None


def hand_over(one: StageResult, settings: Settings, recording: Recording, events: list[Event],
              inputs: Inputs) -> tuple[np.ndarray, np.ndarray]:
    """Return the damping that stage two takes at each sample and its variance, (n,) each."""
    n, changes = len(recording), one.changes
    unit = units_of(settings.rig.motion)["B"]
    if one.estimate.status != "converged":
        nominal, spread = settings.rig.viscous_damping, settings.stage_two.damping_stddev
        if inputs.no_drive is None:
            events.append(Event(0.0, "two", f"stage one provides no B ({one.estimate.status}): "
                                f"stage two takes {with_uncertainty(nominal, spread, unit)}"))
        return steps_to(n, [0], [nominal]), steps_to(n, [0], [spread**2])
    rows: list[int] = []
    dampings: list[float] = []
    variances: list[float] = []
    # A change is dated to the start of the window that showed it; what B was before it is read
    # another window earlier, where the change had not yet pulled at it.
    starts = [0, *(max(0, int(row[0] - row[3]) + 1) for row in changes)]
    ends = [*(max(0, int(row[0] - 2 * row[3])) for row in changes), n - 1]
    handed = False
    for i, (start, last) in enumerate(zip(starts, ends, strict=True)):
        last = max(last, min(int(changes[i - 1, 0]) if i else 0, n - 1))
        if one.stddev[last] > CONVERGED * abs(one.value[last]):
            continue  # before stage one knew: the next piece's value serves backwards too
        start = 0 if not handed else start
        handed = True
        rows.append(start)
        dampings.append(float(one.value[last]))
        variances.append(float(one.stddev[last]) ** 2)
        if inputs.no_drive is None and (i == len(starts) - 1
                                        or starts[i + 1] - start > 1.0 / inputs.dt):
            events.append(Event(
                start * inputs.dt, "two",
                f"{'re-run' if start else 'runs'} with B = "
                f"{with_uncertainty(one.value[last], one.stddev[last], unit)} handed over by "
                "stage one"))
    return steps_to(n, rows, dampings), steps_to(n, rows, variances)


def run_stage_two(inputs: Inputs, recording: Recording, settings: Settings,
                  damping: np.ndarray, damping_variance: np.ndarray,
                  events: list[Event]) -> StageResult:
    """Run stage two with the damping handed over."""
    unit = units_of(settings.rig.motion)["beta_e"]
    if inputs.no_drive:
        return empty_stage("two", no_data("beta_e", unit, inputs.no_drive))
    if settings.discretisation == "euler":
        from eha_monitor.filters.euler import run_printed

        out = list(run_printed(inputs.part(0, inputs.rows), settings, damping))
        changes, sensitivity = NO_CHANGES, np.nan
    else:
        found = run_stage_two_kernel(inputs, settings, damping, damping_variance)
        out, changes = found.out, found.changes
        sensitivity = -float(found.sensitivity[3] / max(found.state[3], 1e-9))
    if not any_of((out[6],), np.isfinite):
        return empty_stage("two", no_data(
            "beta_e", unit, "stage two found no stretch with position and drive together"))
    prior = settings.stage_two
    parameter = judge_parameter("beta_e", out[3][-1], out[5][-1], unit, prior.prior,
                                prior.prior_stddev, prior.largest)
    verdict = unless_unexcited(parameter, judge(
        out[6], out[7], inputs.dt, "stage two", MISSING_TWO, changes, inputs.quantum))
    first = first_converged(out[3], out[5], prior.prior_stddev)
    if first is not None:
        events.append(Event(first * inputs.dt, "two",
                            "βe converged at "
                            f"{with_uncertainty(out[3][first], out[5][first], unit)}"))
    events += change_events(changes, len(changes), inputs.dt, "two", "beta_e", unit)
    result = StageResult(
        "two", parameter,
        time_of(recording), out[3], out[5], out[0], out[1], out[2], out[6], out[7], verdict,
        sensitivity, changes)
    return result


def model_status(verdicts: Iterable[Consistency | None],
                 joint: JointResult | None = None) -> ModelStatus:
    """Return one verdict from the stages' innovations and from the joint filter's fit."""
    judged = [verdict for verdict in verdicts if verdict is not None]
    wrong = [verdict for verdict in judged if not verdict.consistent]
    if wrong:
        return ModelStatus("mismatch", "; ".join(verdict.message for verdict in wrong))
    if joint is not None and not joint.fits:
        return ModelStatus("mismatch", "each stage fits its own channels, but position, pressure "
                           f"and drive do not fit together ({joint.message}): check the scale of "
                           "the sensors and the pump")
    if not judged:
        return ModelStatus("not_judged", "no stage has had enough data, or motion, to test the "
                           "model")
    return ModelStatus("consistent", "; ".join(verdict.message for verdict in judged))


def tested_model(one: StageResult, two: StageResult, joint: JointResult | None,
                 settings: Settings, inputs: Inputs, damping: np.ndarray) -> ModelStatus:
    """Return the verdict on the model with the misfits behind it and what they taint.

    ``damping`` is the (n,) B that stage two had.
    """
    status = model_status((one.consistency, two.consistency), joint)
    if status.status != "mismatch":
        return status
    found = [Mismatch(stage.stage, BALANCE[stage.stage], v.first_time_s, v.nis, v.variance_ratio,
                      v.peak_time_s, v.message)
             for stage in (one, two) if (v := stage.consistency) is not None
             and not v.consistent]
    if not found:
        found = [Mismatch("joint", BALANCE["joint"], 0.0, np.nan, np.nan, np.nan, status.message)]
    bias = one.estimate.value - settings.rig.viscous_damping
    reaches = Reaches()
    for part in _looks(found, (one, two), inputs):
        reaches.note(0.0, finished(reaches_of(
            [m.stage for m in found], part, settings,
            {"B": one.estimate, "beta_e": two.estimate}, damping[-1], two.sensitivity)))
    return replace(status, mismatches=tuple(found),
                   tainted=tainted_by(found, abs(two.sensitivity * bias), reaches.most()))


def _looks(found: list[Mismatch], stages: tuple[StageResult, StageResult], inputs: Inputs
           ) -> list[StageInputs]:
    """Return stretches from which it is read how far a misfit can have moved the parameters.

    They lie between its beginning, or the last change of a parameter, and the end.
    """
    n = inputs.rows
    length = min(n, round(WINDOW_S / inputs.dt))
    first = [m.since_s / inputs.dt for m in found if np.isfinite(m.since_s)]
    changed = [row[0] for stage in stages for row in stage.changes[-1:]]
    begin = min(max((min(first, default=0), *changed)), n - length)
    starts = np.unique(np.linspace(begin, n - length, LOOKS).astype(int))
    return [inputs.part(start, start + length) for start in starts.tolist()]


def warnings_of(inputs: Inputs, settings: Settings) -> list[str]:
    """Return what a user should know about the recording beyond the estimates."""
    notes = []
    for name, level in inputs.noise.items():
        if not level.measured and name in ("x", "p1", "p2", "omega", "force"):
            notes.append(f"{name}: too few samples to measure the noise, the config's level is "
                         "assumed")
    for name, count in inputs.spikes.items():
        notes.append(f"{name}: {count} isolated outlier{'s' if count > 1 else ''} left out")
    if inputs.model.active.any() and {"p1", "p2", "omega"} <= set(inputs.noise):
        notes.append("effects are modelled: B, beta_e and leakage are not estimated together")
    if inputs.model.hydraulics is not None and inputs.no_drive is None:
        stiff, mass = inputs.model.hydraulics[1], inputs.model.hydraulics[0]
        ring = np.sqrt(settings.rig.bulk_modulus * stiff / mass)
        if ring * inputs.dt > COARSE:
            notes.append(f"the samples are {inputs.dt * 1e3:.3g} ms apart, too far for the oil "
                         f"column's resonance of {ring / 2 / np.pi:.0f} Hz: the values may be "
                         "biased by more than their standard deviation")
    return notes
