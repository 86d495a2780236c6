"""The one module that fills messages: plain floats, level constants, stamps."""

import math
from collections.abc import Iterable

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from eha_monitor.filters.results import ParameterEstimate
from eha_monitor.health.alarms import WATCHED, Alarm
from eha_monitor.health.judge import Finding

LEVELS = {"OK": DiagnosticStatus.OK, "WARN": DiagnosticStatus.WARN,
          "ERROR": DiagnosticStatus.ERROR, "STALE": DiagnosticStatus.STALE}
# How serious it is that a parameter has a status.
ESTIMATE_LEVELS = {"converged": "OK", "not_excited": "OK", "diverged": "ERROR",
                   "no_data": "STALE"}
_SECTIONS = {watched.symbol: watched.section for watched in WATCHED}
_LEVEL_NAMES = {level: name for name, level in LEVELS.items()}


def stamp(time_ns: int) -> Time:
    """Return a stamp; ``time_ns`` since the epoch, in the range that the type holds."""
    seconds, nanoseconds = divmod(int(time_ns), 1_000_000_000)
    return Time(sec=min(max(seconds, -2**31), 2**31 - 1), nanosec=nanoseconds)


def number(value: float) -> Float64:
    """Return a number as a message."""
    return Float64(data=float(value))


def joint_state(time_ns: int, name: str, position: float, velocity: float,
                frame: str = "") -> JointState:
    """Return the estimated state of one joint, m and m/s; an unknown velocity is left out."""
    message = JointState(name=[name], position=[float(position)])
    if math.isfinite(velocity):
        message.velocity = [float(velocity)]
    message.header.stamp, message.header.frame_id = stamp(time_ns), frame
    return message


def estimates(time_ns: int, frame: str, found: Iterable[ParameterEstimate], hardware: str
              ) -> DiagnosticArray:
    """Return estimates as one message, each a status with value and standard deviation.

    The numbers are text from which the very float is read again; an estimate without data has
    none.
    """
    statuses = []
    for estimate in found:
        there = estimate.status != "no_data"
        values = {"value": repr(float(estimate.value)), "stddev": repr(float(estimate.stddev))
                  } if there else {}
        values |= {"unit": estimate.unit, "status": estimate.status}
        statuses.append(DiagnosticStatus(
            level=LEVELS[ESTIMATE_LEVELS[estimate.status]],
            name=f"{hardware}: {_SECTIONS[estimate.name]}",
            message=estimate.message or estimate.status, hardware_id=hardware,
            values=[KeyValue(key=key, value=value) for key, value in values.items()]))
    message = DiagnosticArray(status=statuses)
    message.header.stamp, message.header.frame_id = stamp(time_ns), frame
    return message


def plain(value: float | int | str) -> str:
    """Return a value of the diagnostics; a number is nothing but a number.

    >>> plain(600.12345678), plain(6e8), plain(3), plain("text"), plain(float("nan"))
    ('600.123', '6e+08', '3', 'text', '')
    """
    if isinstance(value, str):
        return value
    if not math.isfinite(value):
        return ""
    return str(value) if isinstance(value, int) else f"{float(value):.6g}"


def status(finding: Finding, hardware: str) -> DiagnosticStatus:
    """Return one status; name and hardware_id stay the same, dashboards match on them."""
    return DiagnosticStatus(
        level=LEVELS[finding.level], name=f"{hardware}: {finding.name}",
        message=finding.message, hardware_id=hardware,
        values=[KeyValue(key=key, value=plain(value)) for key, value in finding.values.items()])


def diagnostics(time_ns: int, findings: list[Finding], hardware: str) -> DiagnosticArray:
    """Return all findings as one message."""
    message = DiagnosticArray(status=[status(finding, hardware) for finding in findings])
    message.header.stamp = stamp(time_ns)
    return message


def findings_of(message: DiagnosticArray) -> list[Finding]:
    """Return the findings of a message, the values as text; statuses of no known level are not.

    The inverse of :func:`diagnostics`, as far as another process can tell.
    """
    return [Finding(entry.name.rpartition(": ")[2], _LEVEL_NAMES[entry.level], entry.message,
                    {pair.key: pair.value for pair in entry.values})
            for entry in message.status if entry.level in _LEVEL_NAMES]


def alarm_finding(alarm: Alarm, values: dict[str, float]) -> Finding:
    """Return an alarm as a finding, with the numbers that it was judged on."""
    return Finding(alarm.name, alarm.level, alarm.message,
                   {**values, "since_s": float(alarm.time_s),
                    "not_judged": int(alarm.not_judged)})
