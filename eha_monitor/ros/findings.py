"""What the monitor knows, as lines of the diagnostics; names and keys are stable."""

import math
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from eha_monitor.estimation.results import Consistency, Event, ModelStatus, ParameterEstimate
from eha_monitor.health.alarms import WATCHED, AlarmBoard
from eha_monitor.health.judge import MISMATCH, Finding
from eha_monitor.health.overload import Overload
from eha_monitor.live.diagnosing import UNKNOWN, Cause
from eha_monitor.ros.messages import ESTIMATE_LEVELS
from eha_monitor.ros.subscriptions import TopicInput
from eha_monitor.settings.monitor import Settings

STAGES = {"one": WATCHED[0], "two": WATCHED[1]}
# Keys of the values that dashboards plot.
KEYS = {"B": "viscous_damping_Ns_per_m", "beta_e": "bulk_modulus_Pa"}
# Channels that a parameter needs, besides the position: one of these sets.
NEEDS = {"B": (("force",), ("p1", "p2")), "beta_e": (("x_d",),)}
_MODEL_LEVEL = {"consistent": "OK", "mismatch": "WARN"}  # else STALE: it has not been tested


@dataclass
class DataState:
    """How the data come."""

    stopped: str | None = "no data yet"  # why there are no rows now, or None
    # sentences about missing channels and the like
    problems: list[str] = field(default_factory=list)
    # symbols of parameters that have diverged only just now
    unsettled: set[str] = field(default_factory=set)
    # what contradicts the config (signs, units, channels), "" where nothing does
    implausible: str = ""
    refused: bool = False  # nothing is estimated for it
    overload: Overload | None = None  # that the monitor cannot keep up, or None
    unsaved: str | None = None  # why the last bag could not be written, or None
    # numbers for the diagnostics: rates, counts, latencies, CPU share
    values: dict[str, float | int | str] = field(default_factory=dict)


def all_findings(settings: Settings, board: AlarmBoard,
                 parameters: dict[str, ParameterEstimate],
                 consistency: dict[str, Consistency | None], model: ModelStatus,
                 events: dict[str, Event], data: DataState, cause: Cause = UNKNOWN
                 ) -> Iterator[Finding]:
    """Yield the alarms, the two stages, the model, its mismatch and the data, in this order.

    Parameters
    ----------
    parameters, consistency : by symbol and by stage; empty before the first row.
    events : the last event of each stage, ``one`` and ``two``, and of the ``monitor``.
    cause : what is known of why the model does not fit.
    """
    for alarm in board.alarms:
        watched = next(w for w in WATCHED if alarm.name.startswith(w.section))
        side = alarm.name.removeprefix(f"{watched.section}_")
        limits = getattr(settings.thresholds, watched.section)
        values = _numbers(model.best(parameters).get(watched.symbol)) | _doubts(
            model, watched.symbol)
        for degree in ("warn", "error"):
            limit = getattr(limits, f"{side}_{degree}")
            values[f"limit_{degree}"] = math.nan if limit is None else float(limit)
        if watched.symbol in board.carried:
            values["at_reference"] = board.carried[watched.symbol]
        yield Finding(alarm.name, alarm.level, alarm.message, values | {
            "since_s": float(alarm.time_s), "not_judged": int(alarm.not_judged)})
    for stage, watched in STAGES.items():
        yield _stage(stage, parameters.get(watched.symbol), consistency.get(stage),
                     events.get(stage), data, model)
    level = "STALE" if data.stopped else _MODEL_LEVEL.get(model.status, "STALE")
    yield Finding("model", level, data.stopped or model.message or model.status,
                  {"status": model.status})
    yield _mismatch(model, consistency, data, cause)
    wrong = data.problems or data.unsaved or data.implausible
    level = ("STALE" if data.stopped else "ERROR" if data.refused else "WARN" if wrong else "OK")
    if data.overload is not None and not data.refused:  # why data may seem to have stopped
        level = data.overload.level
    sentences = [each for each in (
        data.overload.sentence if data.overload else "", data.stopped, data.implausible,
        *data.problems) if each] or ["data come"]
    message = "; ".join([*sentences, *([data.unsaved] if data.unsaved else [])])
    yield Finding("data", level, message, {**data.values, **_last(events.get("monitor"))})


def levels(board: AlarmBoard, parameters: dict[str, ParameterEstimate], model: ModelStatus,
           data: DataState) -> tuple:
    """Return what the levels of :func:`all_findings` follow from, without making any words."""
    overload = data.overload.level if data.overload is not None else None
    return (board.levels, tuple(estimate.status for estimate in parameters.values()),
            frozenset(data.unsettled), model.status, bool(model.mismatches),
            frozenset(name for name, taint in model.tainted.items() if taint.standing),
            data.stopped is None, data.refused, bool(data.problems), data.unsaved is None,
            bool(data.implausible), overload)


def _numbers(estimate: ParameterEstimate | None) -> dict[str, float | int | str]:
    if estimate is None:
        return {}
    key = KEYS[estimate.name]
    return {key: estimate.value, f"{key}_stddev": estimate.stddev}


def _doubts(model: ModelStatus, symbol: str) -> dict[str, float | int | str]:
    taint = model.tainted.get(symbol)
    standing = taint is not None and not taint.testing
    values: dict[str, float | int | str] = {
        "tainted": int(standing), "on_trial": int(taint is not None and taint.testing)}
    if standing:
        values["tainted_since_s"] = float(taint.since_s)
        values["by_least_squares"] = int(taint.instead is not None)
        if taint.instead is not None:
            values["least_squares_age_s"] = taint.instead.age_s
    return values


def _mismatch(model: ModelStatus, consistency: dict[str, Consistency | None],
              data: DataState, cause: Cause) -> Finding:
    """Return the test of the model as a finding of its own; plain numbers, for plotting.

    A filter sees more than the sensors' noise on any real machine: that the balances are
    explained all the same, as its diagnosis says, is what tells a healthy one.
    """
    values: dict[str, float | int | str] = {"mismatch": int(bool(model.mismatches))}
    for stage in STAGES:
        verdict = consistency.get(stage)
        standing = next((m for m in model.mismatches if m.stage == stage), None)
        values[f"stage_{stage}_mismatch"] = int(standing is not None)
        if standing is not None:
            values[f"stage_{stage}_since_s"] = float(standing.since_s)
        if verdict is not None:
            values |= {f"stage_{stage}_nis_ratio": verdict.nis,
                       f"stage_{stage}_variance_ratio": verdict.variance_ratio,
                       f"stage_{stage}_block_s": verdict.block_length_s,
                       f"stage_{stage}_worst_time_s": verdict.peak_time_s}
    for watched in WATCHED:
        values[f"{watched.section}_tainted"] = _doubts(model, watched.symbol)["tainted"]
    if data.stopped or model.status in ("unknown", "not_judged"):
        values["not_judged"] = int(not data.stopped and model.status == "not_judged")
        return Finding(MISMATCH, "STALE", data.stopped or f"not judged: {model.message}", values)
    if not model.mismatches:
        return Finding(MISMATCH, "OK", model.message, values)
    first = min(model.mismatches, key=lambda m: m.since_s)
    values |= {"balance": "; ".join(m.balance for m in model.mismatches),
               "since_s": float(first.since_s)}
    doubted = [w.words for w in WATCHED if values[f"{w.section}_tainted"]]
    in_doubt = f"; in doubt: {' and '.join(doubted)}" if doubted else ""
    why = f": {model.message}"
    if cause.verdict:  # which says why
        why, values["diagnosed"] = "", cause.verdict
    return Finding(MISMATCH, "WARN", f"the model does not fit since t = {first.since_s:.1f} s"
                   f"{why}{in_doubt}; {cause.words}", values)


def _last(event: Event | None) -> dict[str, float | str]:
    if event is None:
        return {}
    return {"last_event": event.message, "last_event_s": float(event.time_s)}


def _stage(stage: str, estimate: ParameterEstimate | None, consistency: Consistency | None,
           event: Event | None, data: DataState, model: ModelStatus) -> Finding:
    name = f"stage_{stage}"
    if estimate is None:
        return Finding(name, "STALE", data.stopped or "no data yet")
    values = {"status": estimate.status, **_numbers(estimate)}
    if consistency is not None:
        values |= {"innovation_nis": consistency.nis,
                   "innovation_variance_ratio": consistency.variance_ratio,
                   "innovation_samples": consistency.samples}
    values |= _last(event)
    level = "STALE" if data.stopped else ESTIMATE_LEVELS[estimate.status]
    taint = model.tainted.get(estimate.name)
    standing = taint is not None and taint.standing
    # A stage that a misfit has led astray is no second fault beside it.
    if level == "ERROR" and (estimate.name in data.unsettled or standing):
        level = "WARN"
    message = estimate.message or estimate.status
    values["in_doubt"] = int(standing)
    if standing and level == "OK":
        level = "WARN"
        message = f"in doubt, {taint.reason}: {message}"
    if standing and taint.instead is not None:
        message = f"{message}; by least squares {taint.instead.message}"
    return Finding(name, level, data.stopped or message, values)


def unfed(symbol: str, seen: Mapping[str, int], row_ns: int, inputs: Sequence[TopicInput],
          settings: Settings, frozen: Collection[str] = ()) -> str | None:
    """Return why a parameter has no data now, or None if its channels come.

    A channel that comes, or waits to be taken, but is in no row has another reason than one that
    does not come.

    Parameters
    ----------
    seen : by channel, stamp of the last row that held it, ns.
    row_ns : stamp of the last row, ns.
    frozen : channels whose value stands still, and is left out for that.
    """
    limit = settings.monitor.stale_after * 1e9
    topic_of = {channel: each.topic.full_name for each in inputs for entry in each.topic.entries
                for channel, _ in entry.channels}
    lacking = [[name for name in ("x", *choice) if row_ns - seen.get(name, -limit * 2) > limit]
               for choice in NEEDS.get(symbol, ())]
    if not lacking or not all(lacking):
        return None
    if held := sorted(set(lacking[-1]).intersection(frozen)):
        return f"{' and '.join(held)} {'are' if len(held) > 1 else 'is'} frozen"
    if coming := sorted(_coming(inputs, settings).intersection(lacking[-1])):
        return (f"{' and '.join(coming)} {'come' if len(coming) > 1 else 'comes'}, but too late "
                "for the samples of x, which wait no longer than "
                f"{settings.monitor.latency:g} s (monitor.latency)")
    named = [" and ".join(f"{name} (topic {topic_of.get(name, 'not configured')})"
                          for name in missing) for missing in lacking]
    return f"no data for {', or '.join(named)}"


def _coming(inputs: Sequence[TopicInput], settings: Settings) -> set[str]:
    """Return the channels beside those of the position's stream that came of late, or wait."""
    now = time.monotonic()
    return {channel for each in inputs for entry in each.topic.entries
            for channel in entry.source.channels if "x" not in entry.source.channels
            if each.waits or now - entry.source.heard_s <= settings.monitor.stale_after}


def with_bags(findings: Iterable[Finding], bags: Mapping[str, str]) -> list[Finding]:
    """Return findings of which each alarm names its bag: by alarm, "" while that is due."""
    return [one if (bag := bags.get(one.name)) is None else replace(
        one, values=one.values | ({"bag": bag} if bag else {"bag_due": 1})) for one in findings]
