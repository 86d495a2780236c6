"""The state as Prometheus metrics, in its text form."""

import math
import time
from collections.abc import Iterator, Mapping

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4 as CONTENT_TYPE
from prometheus_client.registry import Collector

from eha_monitor.dashboard.events import ACKNOWLEDGED, MISMATCH
from eha_monitor.dashboard.state import HEALTH_STALE_AFTER, STAGES, State, View, alarms
from eha_monitor.health.alarms import NOT_JUDGED, WATCHED

__all__ = ["CONTENT_TYPE", "text"]
# As in diagnostic_msgs/DiagnosticStatus; what is not judged is no level of its own there.
LEVELS = {"OK": 0, "WARN": 1, "ERROR": 2, "STALE": 3, NOT_JUDGED: 3}
STATUSES = ("converged", "not_excited", "diverged", "no_data")
# Unit in the metric's name, by parameter and kind of motion.
UNITS = {("B", "linear"): "newton_seconds_per_meter",
         ("B", "rotary"): "newton_meter_seconds_per_radian",
         ("beta_e", "linear"): "pascals", ("beta_e", "rotary"): "pascals"}


def text(states: Mapping[str, State]) -> bytes:
    """Return all metrics; ``states`` by the label ``actuator``."""
    registry = CollectorRegistry()
    registry.register(_Collector(states))
    return generate_latest(registry)


class _Collector(Collector):
    """Makes the metrics when they are asked for, so that none is older than the request."""

    def __init__(self, states: Mapping[str, State]):
        self._states = states

    def describe(self) -> list:
        return []  # else the registry would collect once more to learn the names

    def collect(self) -> Iterator[GaugeMetricFamily]:
        now = time.monotonic()
        families: dict[str, GaugeMetricFamily] = {}
        for actuator, state in self._states.items():
            view = state.view(now)
            for name, help_, labels, value in (*_estimates(state, view), *_health(state, view)):
                if name not in families:
                    families[name] = GaugeMetricFamily(
                        f"eha_monitor_{name}", help_, labels=["actuator", *labels])
                families[name].add_metric([actuator, *labels.values()], value)
        yield from families.values()


Sample = tuple[str, str, dict[str, str], float]


def _estimates(state: State, view: View) -> Iterator[Sample]:
    """Give value, deviation and status; a value that is no longer fed is left out."""
    monitor = state.settings.monitor
    limit = monitor.stale_after + 1.0 / monitor.publish_rate
    for stage, watched in zip(STAGES, WATCHED, strict=True):
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
