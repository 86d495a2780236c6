"""The monitor's pipeline over a whole recording: stage one, hand-over, stage two, verdicts."""

import time
from dataclasses import replace

import numpy as np

from eha_monitor.balances.parameters import along, leakage_of
from eha_monitor.breakdown import computing
from eha_monitor.estimation.consistency import Window, stage_verdict
from eha_monitor.estimation.hold_choice import (
    SAMPLED,
    HoldDecision,
    for_stages,
    resolved,
    with_hold,
)
from eha_monitor.estimation.inputs import Inputs, inputs_of, time_of
from eha_monitor.estimation.joint import fits, run_joint
from eha_monitor.estimation.model_watch import beyond, model_status, ranges_of, tainted_by, within
from eha_monitor.estimation.results import (
    BALANCE,
    CONVERGED,
    GAINED,
    ONE,
    STAGES,
    TWO,
    Beside,
    Estimate,
    Event,
    Mismatch,
    ModelStatus,
    ParameterEstimate,
    Stage,
    StageResult,
    Taint,
    stands,
    units_of,
)
from eha_monitor.estimation.stages import Changes, run_stage_one_kernel, run_stage_two_kernel
from eha_monitor.estimation.supervision import gave_up
from eha_monitor.quantity import SYMBOLS, quantity, with_uncertainty
from eha_monitor.recordings.columns import any_of, first_where, mapped, steps_to
from eha_monitor.recordings.position import trusted
from eha_monitor.recordings.recording import Recording, sample_of
from eha_monitor.settings.monitor import Settings

COARSE = 1.5  # rad of the resonance in a sample
MATTERS = 0.3  # standard deviations by which two holds must differ to be worth a word


def estimate(recording: Recording, settings: Settings) -> Estimate:
    """Run both stages over a recording.

    Stage one runs first; its damping, piecewise constant between detected changes and each piece
    with the value that it had at its end, is handed to stage two, which runs over the whole
    recording again (``Estimate.events`` tells each step).  Before that it is asked whether the
    drive holds its command over each sample (:mod:`hold_choice`); where the recording cannot
    tell, both answers are in the uncertainty.

    Raises
    ------
    InputError
        If the recording's numbers break the calculation.
    """
    with computing(recording.source):
        return _estimated(recording, settings)


def _estimated(recording: Recording, settings: Settings) -> Estimate:
    started = time.perf_counter()
    given, recording = recording, trusted(recording)
    settings, decision = resolved([recording], settings)
    settings = for_stages(settings, decision)
    found = estimate_held(recording, settings)
    if decision is not None and not decision.decided:
        found = either(found, estimate_held(recording, with_hold(settings, SAMPLED),
                                            beside=found.beside), decision)
    if recording is not given:
        left = np.isfinite(given.get("x")).sum() - np.isfinite(recording.get("x")).sum()
        found = replace(found, warnings=(*found.warnings, (
            f"x: {left} outlier{'s' if left > 1 else ''} left out, that no piston makes")))
    if found.joint is None or found.joint_doubt:
        found = replace(found, leakage=leakage_of(recording, settings))
    return replace(found, wall_s=time.perf_counter() - started,
                   channels=decision.findings if decision is not None else ())


def estimate_held(recording: Recording, settings: Settings, size: int | None = None,
                  beside: tuple[Beside, ...] = ()) -> Estimate:
    """Run both stages with the hold that the settings say.

    ``size`` : rows of a piece; without it a long recording is taken in pieces, others at once.
    ``beside`` : least squares along the recording, whatever the hold, where they are known.
    """
    inputs = inputs_of(recording, settings, size)
    events: list[Event] = []
    one = run_stage_one(inputs, recording, settings, events)
    damping = hand_over(one, settings, recording, events, inputs)
    two = run_stage_two(inputs, recording, settings, damping, events)
    seen = [row for stage in (one, two) if fits(stage) for row in stage.changes]
    since = max((int(row[0]) + 1 for row in seen), default=0)
    joint = run_joint(inputs, recording, settings, one, two, since)
    status = model_status((one.consistency, two.consistency), joint)
    known = any(stage.estimate.status == "converged" for stage in (one, two))
    if status.status == "consistent" or (status.status == "not_judged" and not known):
        beside = ()
    elif not beside:
        beside = tuple(along(recording, settings))
    model = within(tested_model(status, (one, two), beside),
                   beyond(ranges_of(settings), sample_of(recording).channels,
                          recording.sample_time, settings.rig.position_gain), 0.0)
    return Estimate(
        recording, settings, one, two, joint, model,
        tuple(sorted((as_it_stands(event, model, (one, two)) for event in events),
                     key=lambda event: event.time_s)), inputs.noise,
        warnings=tuple(warnings_of(inputs)), beside=beside)


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
    stddev = float(np.hypot(p.stddev, off))
    stage = next((stage for stage in STAGES.values() if stage.parameter == p.name), None)
    if stage is None:
        return replace(p, stddev=stddev)
    wide = stage.judged(settings, p.value, stddev)
    return replace(wide, message="; ".join(filter(None, (wide.message, why))))


def run_stage_one(inputs: Inputs, recording: Recording, settings: Settings,
                  events: list[Event]) -> StageResult:
    """Run stage one."""
    if inputs.no_force:
        return empty_stage(ONE, settings, inputs.no_force)
    out, seen, watch = run_stage_one_kernel(inputs, settings)
    if gave_up(watch):  # the model does not fit: an average with an honest sigma, not a chase
        out, seen, _ = run_stage_one_kernel(inputs, settings, frozen=True)
        events.append(Event(0.0, "one", "B varies with the motion or diverges, which is no real "
                                        "change: held constant over the record"))
    return stage_result(ONE, out, seen, inputs, recording, settings, events)


def run_stage_two(inputs: Inputs, recording: Recording, settings: Settings,
                  damping: tuple[np.ndarray, np.ndarray], events: list[Event]) -> StageResult:
    """Run stage two with the damping handed over, value and variance."""
    if inputs.no_drive:
        return empty_stage(TWO, settings, inputs.no_drive)
    if settings.discretisation == "euler":
        from eha_monitor.estimation.reference_stages import run_printed

        out = list(run_printed(inputs.part(0, inputs.rows), settings, damping[0]))
        seen = Changes()
    else:
        found = run_stage_two_kernel(inputs, settings, *damping)
        out, seen = found.out, Changes(found.changes)
    return stage_result(TWO, out, seen, inputs, recording, settings, events)


def empty_stage(stage: Stage, settings: Settings, reason: str) -> StageResult:
    """Return a stage that had no data."""
    return StageResult(stage.key, stage.no_data(settings, reason), *(np.empty(0),) * 8, None)


def stage_result(stage: Stage, out: list[np.ndarray], seen: Changes, inputs: Inputs,
                 recording: Recording, settings: Settings, events: list[Event]) -> StageResult:
    """Judge what a stage's kernel has written; ``events`` gets its story."""
    value, stddev, innovation, sigma = (out[row] for row in (
        stage.value, stage.stddev, stage.innovation, stage.innovation_stddev))
    if not any_of((innovation,), np.isfinite):
        if inputs.rest.all():
            prior = stage.prior(settings)
            still = stage.judged(settings, prior.prior, prior.prior_stddev)
            return replace(empty_stage(stage, settings, ""), estimate=replace(
                still, message=f"nothing moves: {still.message}"))
        lacks = "force" if stage is ONE else "drive"
        return empty_stage(stage, settings, f"{stage.words} found no stretch with position and "
                                            f"{lacks} together")
    parameter, unit = stage.judged(settings, value[-1], stddev[-1]), stage.unit(settings)
    verdict = stage_verdict(stage, parameter, innovation, sigma,
                            Window(inputs.dt, inputs.quantum), seen.rows)
    prior_stddev = stage.prior(settings).prior_stddev
    first = first_where(lambda v, s: (s < CONVERGED * v) & (s < prior_stddev / GAINED),
                        value, stddev)
    if first is not None:
        events.append(Event(first * inputs.dt, stage.key,
                            f"{SYMBOLS[stage.parameter]} converged at "
                            f"{with_uncertainty(value[first], stddev[first], unit)}",
                            stage.parameter))
    events += change_events(seen, inputs.dt, stage, unit)
    return StageResult(stage.key, parameter, time_of(recording), value, stddev, out[0], out[1],
                       out[6] if stage is ONE else out[2], innovation, sigma, verdict,
                       changes=seen.rows)


def change_events(seen: Changes, dt: float, stage: Stage, unit: str) -> list[Event]:
    """Return one event for each run of changes that follow one another within a second."""
    changes, found, symbol = seen.rows, seen.found, SYMBOLS[stage.parameter]
    events = []
    runs = np.split(changes, np.flatnonzero(np.diff(changes[:, 0]) * dt > 1.0) + 1)
    for run in runs:
        before, after = (quantity(value, unit) for value in (run[0, 1], run[-1, 2])) if len(
            run) else ("", "")
        if before != after:  # both may be at the bound
            since = ("" if len(run) == 1
                     else f" in {len(run)} steps from t = {run[0, 0] * dt:.2f} s")
            events.append(Event(float(run[-1, 0] * dt), stage.key,
                                f"{symbol} changed from {before} to {after}{since}",
                                stage.parameter))
    if found > len(changes):
        events.append(Event(float(changes[-1, 0] * dt), stage.key,
                            f"{found - len(changes)} further changes of {symbol} are not "
                            "listed"))
    return events


def as_it_stands(event: Event, model: ModelStatus, stages: tuple[StageResult, StageResult]
                 ) -> Event:
    """Return an event that told a value, and that it does not stand where it does not."""
    taint = model.tainted.get(event.parameter)
    ended = {stage.estimate.name: stage.estimate for stage in stages}.get(event.parameter)
    said = ""
    if taint is not None and not taint.testing:
        said = f"in doubt: {taint.reason.partition(' (')[0]}" + (
            f"; {taint.instead.shown} by least squares stands instead" if taint.instead else "")
    elif ended is not None and ended.status != "converged":
        said = f"it did not stay so: {ended.status} at the end"
    return replace(event, message=f"{event.message} ({said})") if said else event


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
                "stage one", "B"))
    return steps_to(n, rows, dampings), steps_to(n, rows, variances)


def tested_model(status: ModelStatus, stages: tuple[StageResult, StageResult],
                 beside: tuple[Beside, ...]) -> ModelStatus:
    """Return the verdict on the model with the misfits behind it and what they taint.

    ``beside`` : least squares along the recording; what stands of them at its end.
    """
    if status.status == "consistent":
        return status
    now = beside[-1].time_s if beside else 0.0
    if status.status == "not_judged":
        return replace(status, tainted={
            name: Taint("nothing has tested the model on this recording: it needs more samples, "
                        "or more motion", 0.0, instead=stands(beside, now, name))
            for name in (one.estimate.name for one in stages
                         if one.estimate.status == "converged")})
    found = [Mismatch.of(stage.stage, v) for stage in stages
             if (v := stage.consistency) is not None and not v.consistent]
    if not found:
        found = [Mismatch("joint", BALANCE["joint"], 0.0, np.nan, np.nan, np.nan, status.message)]
    return replace(status, mismatches=tuple(found), tainted=tainted_by(
        found, {stage.estimate.name: stage.estimate for stage in stages}, beside, now))


def warnings_of(inputs: Inputs) -> list[str]:
    """Return what a user should know about the recording beyond the estimates."""
    notes = []
    for name, level in inputs.noise.items():
        if not level.measured and name in ("x", "p1", "p2", "omega", "force"):
            notes.append(f"{name}: too few samples to measure the noise, the config's level is "
                         "assumed")
    for name, count in inputs.spikes.items():
        notes.append(f"{name}: {count} isolated outlier{'s' if count > 1 else ''} left out")
    if inputs.model.active.any() and {"p1", "p2", "omega"} <= set(inputs.noise):
        notes.append("the config has effects: B, βe and leakage are not estimated together")
    if inputs.model.hydraulics is not None and inputs.no_drive is None:
        ring = inputs.model.ringing
        if ring * inputs.dt > COARSE:
            notes.append(f"the samples are {inputs.dt * 1e3:.3g} ms apart, too far for the oil "
                         f"column's resonance of {ring / 2 / np.pi:.0f} Hz: the values may be "
                         "biased by more than their standard deviation")
    return notes
