"""The answer in one plain sentence."""

from dataclasses import dataclass

from eha_monitor.estimation.results import Estimate, ParameterEstimate
from eha_monitor.health.alarms import Alarm
from eha_monitor.quantity import SYMBOLS
from eha_monitor.reports.parameter_figures import NAMES

STATUS_WORDS = {"converged": "converged", "not_excited": "not excited by this motion",
                "diverged": "diverged", "no_data": "no data"}
_ALARM_WORDS = {"viscous_damping_high": "the viscous damping B is too high",
                "viscous_damping_low": "the viscous damping B is too low",
                "bulk_modulus_high": "the effective bulk modulus βe is too high",
                "bulk_modulus_low": "the effective bulk modulus βe is too low"}


@dataclass(frozen=True)
class Verdict:
    """``kind`` is ``ok``, ``warn``, ``error`` or ``unknown`` and sets the colour."""

    kind: str
    headline: str
    sentence: str


def verdict(estimate: Estimate, alarms: tuple[Alarm, ...]) -> Verdict:
    """Return what the recording says about the actuator, and what it does not say."""
    errors = [a for a in alarms if a.word == "ERROR"]
    warnings = [a for a in alarms if a.word == "WARN"]
    told = [p for p in estimate.parameters.values() if p.status == "converged"]
    untold = [p for p in estimate.parameters.values() if p.status != "converged"]
    mismatch = estimate.model.status == "mismatch"
    parts = []
    if errors or warnings:
        parts.append(" and ".join(_alarm_phrase(alarm) for alarm in (*errors, *warnings)))
    if mismatch:
        parts.append("the model does not fit this recording" + (
            ", so the values are biased by the model error" if told else ""))
    if told and not (errors or warnings):
        parts.append(_values(told, alarms))
    if untold:
        parts.append("no estimate of " + " and ".join(
            f"{NAMES[p.name]} {SYMBOLS[p.name]} ({STATUS_WORDS.get(p.status, p.status)})"
            for p in untold))
    if estimate.model.status == "consistent":
        parts.append("the model fits the recording")
    elif told and not mismatch:
        parts.append("the recording does not show whether the model fits")
    held = [a for a in alarms if a.not_judged]
    kind, headline = _head(errors, warnings, mismatch, told, untold or held,
                           estimate.model.status)
    if held and kind == "ok":
        kind = "unknown"
    return Verdict(kind, headline, f"{headline}: {'; '.join(parts)}.")


def _values(told: list[ParameterEstimate], alarms: tuple[Alarm, ...]) -> str:
    """Return the values that no alarm complains about, and whether one could have."""
    doubtful = [p for p in told if any(a.not_judged for a in _of(p, alarms))]
    sure = [p for p in told if p not in doubtful]
    parts = []
    if sure:
        judged = all(_of(p, alarms) for p in sure)
        parts.append(_shown(sure) + (f" {'is' if len(sure) == 1 else 'are'} within the limits"
                                     if judged else ", without configured limits"))
    if doubtful:
        parts.append(f"{_shown(doubtful)} {'is' if len(doubtful) == 1 else 'are'} not judged")
    return "; ".join(parts)


def _shown(told: list[ParameterEstimate]) -> str:
    return " and ".join(f"{SYMBOLS[p.name]} = {p.shown}"
                        for p in told)


def _of(parameter: ParameterEstimate, alarms: tuple[Alarm, ...]) -> list[Alarm]:
    """Return the alarms on a parameter."""
    return [a for a in alarms if a.name.startswith(_PREFIX[parameter.name])]


_PREFIX = {"B": "viscous_damping", "beta_e": "bulk_modulus"}


def _head(errors, warnings, mismatch, told, untold, model) -> tuple[str, str]:
    """Return colour and first words: the gravest thing leads."""
    if errors or warnings:
        words = "Alarm" if errors else "Warning"
        return ("error" if errors else "warn"), words + (" and mismatch" if mismatch else "")
    if mismatch:
        return "warn", "Mismatch"
    if not told:
        return "unknown", "No answer"
    if untold or model != "consistent":
        kind = "ok" if model == "consistent" else "unknown"
        return kind, "No fault found in what could be judged"
    return "ok", "Healthy"


def _alarm_phrase(alarm: Alarm) -> str:
    words = _ALARM_WORDS.get(alarm.name, alarm.name.replace("_", " "))
    return f"{words} ({alarm.level})"
