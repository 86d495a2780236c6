"""What is shown, for other programs: as CSV, and as Prometheus metrics."""

import math
import time
from collections.abc import Iterator, Mapping
from types import SimpleNamespace

from eha_monitor.dashboard.events import ACKNOWLEDGED, csv_text, utc
from eha_monitor.dashboard.state import (
    ESTIMATES_EVERY,
    HEALTH_STALE_AFTER,
    STAGES,
    Row,
    State,
    View,
    alarms,
)
from eha_monitor.estimation.results import units_of
from eha_monitor.health.alarms import NOT_JUDGED, WATCHED
from eha_monitor.health.judge import MISMATCH

# As in diagnostic_msgs/DiagnosticStatus; what is not judged is no level of its own there.
LEVELS = {"OK": 0, "WARN": 1, "ERROR": 2, "STALE": 3, NOT_JUDGED: 3}
STATUSES = ("converged", "not_excited", "diverged", "no_data")
# Unit in the metric's name, by parameter and kind of motion.
UNITS = {("B", "linear"): "newton_seconds_per_meter",
         ("B", "rotary"): "newton_meter_seconds_per_radian",
         ("beta_e", "linear"): "pascals", ("beta_e", "rotary"): "pascals"}


def estimates_csv(state: State, now: float, since: float = -math.inf,
                  until: float = math.inf) -> str:
    """Return the estimates and innovations of a stretch of time, SI, as they were kept.

    Values of the same moment, within half of the spacing at which they are kept, are one row.

    Parameters
    ----------
    now : s, monotonic.
    since, until : time of day, s since the epoch.
    """
    units = units_of(state.settings.rig.motion)
    header = ["time_utc", "time_s"]
    series: list[tuple[int, list[Row]]] = []
    for watched in WATCHED:
        unit = units[watched.symbol]
        series.append((len(header) - 2, state.history(watched.symbol, now, since)))
        header += [f"{watched.section} [{unit}]", f"{watched.section}_stddev [{unit}]",
                   f"{watched.section}_in_doubt"]
    for stage in STAGES:
        series.append((len(header) - 2, state.history(stage, now, since)))
        header += [f"{stage}_innovation_nis", f"{stage}_innovation_variance_ratio"]
    cells = sorted((row[0], column, row[1:]) for column, rows in series for row in rows
                   if row[0] <= until and math.isfinite(row[1]))
    table: list[tuple[float, list]] = []
    for time_s, column, values in cells:
        if not table or time_s - table[-1][0] > 0.5 * ESTIMATES_EVERY or (
                table[-1][1][column] != ""):
            table.append((time_s, [""] * (len(header) - 2)))
        table[-1][1][column:column + len(values)] = [
            f"{value:.9g}" if math.isfinite(value) else "" for value in values]
    return csv_text([tuple(header), *((utc(time_s), f"{time_s:.3f}", *values)
                                      for time_s, values in table)])


def metrics(states: Mapping[str, State]) -> bytes:
    """Return all metrics in Prometheus' text form; ``states`` by the label ``actuator``.

    Raises ImportError if prometheus_client is not installed.
    """
    from prometheus_client import generate_latest
    from prometheus_client.core import GaugeMetricFamily

    now = time.monotonic()
    families: dict[str, GaugeMetricFamily] = {}
    for actuator, state in states.items():
        view = state.view(now)
        for name, help_, labels, value in (*_estimates(state, view), *_health(state, view)):
            if name not in families:
                families[name] = GaugeMetricFamily(
                    f"eha_monitor_{name}", help_, labels=["actuator", *labels])
            families[name].add_metric([actuator, *labels.values()], value)
    return generate_latest(SimpleNamespace(collect=families.values))  # all it asks a registry for


Sample = tuple[str, str, dict[str, str], float]


def _estimates(state: State, view: View) -> Iterator[Sample]:
    """Give value, deviation and status; a value that is no longer fed is left out."""
    monitor = state.settings.monitor
    limit = monitor.stale_after + 1.0 / monitor.publish_rate
    for stage, watched in STAGES.items():
        symbol, section = watched.symbol, watched.section
        unit = UNITS[symbol, state.settings.rig.motion]
        if view.silence[symbol] <= limit:
            yield f"{section}_{unit}", f"Estimate of {watched.words}.", {}, view.value[symbol]
            yield (f"{section}_stddev_{unit}", f"Standard deviation of {watched.words}.", {},
                   view.stddev[symbol])
        found = view.findings.get(stage)
        status = str(found.values.get("status", "")) if found else ""
        if found is None or found.level == "STALE" or not status:
            status = "no_data"
        for each in STATUSES:
            yield ("estimate_status", "1 for the status that the estimate has, 0 for the others.",
                   {"parameter": section, "status": each}, float(each == status))


def _health(state: State, view: View) -> Iterator[Sample]:
    for alarm in alarms(view):
        labels = {"alarm": alarm.name}
        yield ("alarm_level", "Level of the alarm: 0 OK, 1 WARN, 2 ERROR, 3 STALE or not judged.",
               labels, LEVELS[alarm.word])
        yield ("alarm_not_judged", "1 where data come and nothing can be said about the limit.",
               labels, float(alarm.word == NOT_JUDGED))
    for name in ACKNOWLEDGED:
        yield ("alarm_acknowledged", "1 where the alarm has been acknowledged.", {"alarm": name},
               float(name in view.acknowledged))
    mismatch = view.findings.get(MISMATCH)
    yield ("model_level", "Whether the model fits: 0 OK, 1 WARN, 3 STALE or not judged.", {},
           LEVELS[mismatch.word] if mismatch else LEVELS["STALE"])
    yield ("up", "1 where the monitor's health was heard in the last "
           f"{HEALTH_STALE_AFTER:g} seconds.", {},
           float(view.silence["health"] <= HEALTH_STALE_AFTER))
    for topic in ("measured", "estimates", "health"):
        yield ("data_age_seconds", "Seconds since the last message; +Inf where none has come.",
               {"source": topic}, max(0.0, view.silence[topic]) if math.isfinite(
                   view.silence[topic]) else math.inf)
