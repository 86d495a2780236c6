"""What ``estimate`` answers: the alarms of a recording, and the JSON of the contract."""

import math
from dataclasses import replace

import numpy as np

from eha_monitor.estimation.inputs import time_of
from eha_monitor.estimation.joint import ObservabilityTable
from eha_monitor.estimation.results import (
    NEAR_S,
    Estimate,
    ParameterEstimate,
    StageResult,
    converged_where,
    stands,
)
from eha_monitor.health.alarms import Alarm, ParameterSeries, judge_series
from eha_monitor.output import finite
from eha_monitor.recordings.columns import blocks
from eha_monitor.recordings.recording import Recording

SCHEMA = "eha_monitor/estimate/1"


def judged(found: Estimate) -> tuple[tuple[Alarm, ...], tuple[Alarm, ...]]:
    """Return the alarms at the end of the recording, and every change of a level."""
    recording = found.recording
    temperature = recording.get("temperature") if recording.has("temperature") else None
    measured = recording.get("x") if recording.has("x") else None
    return judge_series(found.settings, time_of(recording), series_of(found), temperature,
                        measured, found.model.tainted, found.beside)


def series_of(found: Estimate) -> dict[str, ParameterSeries]:
    """Return each parameter as it converged, as the alarms judge it."""
    stages = {"B": found.stage_one, "beta_e": found.stage_two}
    first, second = found.settings.stage_one, found.settings.stage_two
    priors = {"B": (first.prior, first.prior_stddev),
              "beta_e": (second.prior, second.prior_stddev, second.largest)}
    return {name: ParameterSeries(
        stage.estimate, stage.value, stage.stddev,
        lambda value, stddev, prior=priors[name]: converged_where(value, stddev, *prior))
        for name, stage in stages.items()}


def judged_series(found: Estimate) -> dict[str, ParameterSeries]:
    """Return each parameter as the alarms judge it: by least squares where its stage is in doubt.

    What nothing determines has not converged.  The stage's value from before the mismatch showed
    counts no more: a model that does not fit did not fit before either.
    """
    series, time = series_of(found), time_of(found.recording)
    times = [one.time_s for one in found.beside]
    for name, taint in found.model.tainted.items():
        one = series[name]
        if not len(one.value):
            continue
        looks = [stands(found.beside, at, name) for at in times]
        place = np.searchsorted(times, time - time[0] + NEAR_S, side="right")
        value, stddev = (np.array([math.nan, *(
            getattr(look, key) if look else math.nan for look in looks)])[place]
            for key in ("value", "stddev"))
        series[name] = ParameterSeries(
            found.parameters[name] if taint.instead else replace(one.final, status="not_excited"),
            value, stddev, np.isfinite(value))
    return series


def unhealthy(found: Estimate, alarms: tuple[Alarm, ...]) -> bool:
    """Tell whether an alarm stands or the model does not fit."""
    return found.model.status == "mismatch" or any(
        alarm.level in ("WARN", "ERROR") for alarm in alarms)


def answer(found: Estimate, alarms: tuple[Alarm, ...], history: tuple[Alarm, ...],
           observable: ObservabilityTable | None = None) -> dict:
    """Return the JSON tree: the contract's keys, then what extends it.  NaN becomes null."""
    recording = found.recording
    tree = {
        "schema": SCHEMA,
        "bag": recording.source,
        "samples": len(recording),
        "duration_s": recording.duration,
        "wall_s": found.wall_s,
        "parameters": {name: {**_parameter(p), "by": found.model.origin(name),
                              "in_doubt": found.model.in_doubt(name)}
                       for name, p in found.parameters.items()},
        "alarms": alarms,
        "model": found.model,
        "stages": {stage.stage: _stage(stage) for stage in (found.stage_one, found.stage_two)},
        "joint": _joint(found),
        "least_squares": [{"time_s": one.time_s, "parameters": {
            name: _parameter(p) for name, p in one.parameters.items()}} for one in found.beside],
        "observability": None if observable is None else observable.rows,
        "noise": found.noise,
        "channel_samples": {name: sum(int(np.isfinite(rows).sum())
                                      for _, _, (rows,) in blocks(values))
                            for name, values in recording.channels.items()},
        "events": found.events,
        "alarm_history": history,
        "losses": list(recording.losses),
        "warnings": list(found.warnings),
    }
    return finite(tree)


def refusal(recording: Recording, message: str, channels: list[dict]) -> dict:
    """Return the JSON tree of a recording that contradicts its config; no number is given."""
    nothing = {"value": None, "stddev": None, "status": "no_data", "message": message}
    return finite({
        "schema": SCHEMA,
        "bag": recording.source,
        "samples": len(recording),
        "duration_s": recording.duration,
        "wall_s": 0.0,
        "parameters": {"B": nothing, "beta_e": nothing},
        "alarms": [],
        "model": {"status": "not_judged", "message": message, "mismatches": [], "tainted": {}},
        "channels": channels,
        "losses": list(recording.losses),
        "warnings": [message],
    })


def _parameter(p: ParameterEstimate) -> dict:
    return {"value": p.value, "stddev": p.stddev, "unit": p.unit, "status": p.status,
            "message": p.message}


def _stage(stage: StageResult) -> dict:
    return {"parameter": stage.estimate.name, **_parameter(stage.estimate),
            "consistency": stage.consistency}


def _joint(found: Estimate) -> dict | None:
    if found.joint is None:
        return None
    return {"parameters": {n: _parameter(p) for n, p in found.joint.parameters.items()},
            "correlation": found.joint.correlation,
            "message": found.joint.message}
