"""The page's texts: numbers as people write them, levels, and what to say of silence."""

import math
import time
from dataclasses import dataclass

from eha_monitor.dashboard.state import (
    HEALTH_STALE_AFTER,
    NIS,
    SAMPLES,
    VARIANCE_RATIO,
    View,
    alarms,
)
from eha_monitor.filters.status import units_of
from eha_monitor.health.alarms import NOT_JUDGED, SEVERITY
from eha_monitor.health.finding import Finding
from eha_monitor.quantity import Scale, number, readable, with_uncertainty
from eha_monitor.settings import Settings

# A level has a sign and a word, so that it is told without its colour.
SIGNS = {"OK": "✓", NOT_JUDGED: "?", "WARN": "▲", "ERROR": "✖", "STALE": "◌"}
# Of all that the status `data` holds, what tells whether messages arrive, and its words.
_DATA = {"rows": "{} rows so far", "rate_joint_states_Hz": "{} messages a second on joint_states",
         "lost_messages": "{} messages lost", "missing_samples": "{} samples missing",
         "latency_p50_ms": "half of the rows done within {} ms",
         "cpu_share_percent": "{} % of a processor"}
# A thousandth of the units in which positions are shown.
_FINE = {"mm": "µm", "mrad": "µrad"}
_STATUS_WORDS = {"not_excited": "not excited", "no_data": "no data"}


@dataclass(frozen=True)
class Shown:
    """A number with its uncertainty, as texts."""

    value: str
    stddev: str
    unit: str


def scales(settings: Settings) -> dict[str, Scale]:
    """Return the scale of each parameter: one for good, so that the numbers do not hop."""
    units = units_of(settings.rig.motion)
    return {"B": readable(settings.stage_one.prior, units["B"]),
            "beta_e": readable(settings.stage_two.prior, units["beta_e"])}


def shown(value: float, stddev: float, scale: Scale) -> Shown:
    """Return a number with the digits that its uncertainty supports.

    >>> shown(6.0012e8, 2.3e6, Scale(1e-6, "MPa"))
    Shown(value='600.1', stddev='± 2.3', unit='MPa')
    """
    if not math.isfinite(value):
        return Shown("–", "", scale.unit)
    if not math.isfinite(stddev):
        return Shown(number(value * scale.factor), "± not known", scale.unit)
    text = with_uncertainty(value, stddev, "", Scale(scale.factor, ""))
    if text.startswith("("):  # with a power of ten: no two numbers on their own
        return Shown(text, "", scale.unit)
    known, _, uncertainty = text.partition(" ± ")
    return Shown(known, f"± {uncertainty}", scale.unit)


def level_text(level: str) -> str:
    """Return a level as sign and word."""
    return f"{SIGNS[level]} {level}"


def plain_name(name: str) -> str:
    """Return the name of a finding in words: ``viscous_damping_high`` -> Viscous damping high."""
    return name.replace("_", " ").capitalize()


def worst(findings: list[Finding]) -> str:
    """Return the level that counts most."""
    return max((f.word for f in findings), key=SEVERITY.index, default="STALE")


def overall(view: View) -> tuple[str, str]:
    """Return the level of the header and its words.

    It is the worst of what is judged.  STALE is for data that do not come; while they come, an
    alarm that nothing can be said about is counted beside the level and does not hide the rest.
    """
    data = view.findings.get("data")
    if not view.findings or (data is not None and data.level == "STALE"):
        return "STALE", level_text("STALE")
    mismatch = [view.findings["model_mismatch"]] if "model_mismatch" in view.findings else []
    listed = alarms(view)
    judged = [finding for finding in listed if finding.word not in ("STALE", NOT_JUDGED)]
    # A value beyond its limit that a misfit holds back must be seen.
    held = [one for one in listed if one.word == NOT_JUDGED and one.level == "WARN"]
    if not (judged or held):
        return "STALE", "◌ not judged yet"
    level = worst([*judged, *held, *(one for one in mismatch if one.level != "STALE")])
    left = len(listed) - len(judged)
    return level, level_text(level) + (f", {left} of {len(listed)} not judged" if left else "")


def stage_status(view: View, stage: str) -> str:
    """Return the status of a parameter in words: converged, not excited, ..."""
    finding = view.findings.get(stage)
    status = str(finding.values.get("status", "")) if finding else ""
    if finding is None or not status:
        return "no data yet"
    words = _STATUS_WORDS.get(status, status)
    return f"{words} (last heard)" if finding.level == "STALE" else words


def model_status(view: View) -> str:
    """Return whether the model fits, in words."""
    finding = view.findings.get("model")
    words = plain_name(str(finding.values.get("status") or "unknown")) if finding else "Unknown"
    return f"{words} (last heard)" if finding and finding.level == "STALE" else words


def innovation_texts(view: View, stage: str) -> tuple[str, str, str]:
    """Return NIS, variance ratio and number of innovations of a stage."""
    values = view.findings[stage].values if stage in view.findings else {}
    nis, ratio, samples = (_written(values.get(key, ""), 3) or "–"
                           for key in (NIS, VARIANCE_RATIO, SAMPLES))
    return nis, ratio, samples


def _written(value: float | int | str, digits: int) -> str:
    """Return a number of a diagnostic with ``digits`` digits, or all those before its point."""
    try:
        return number(float(value), digits)
    except ValueError:
        return str(value)


def silence_text(view: View, settings: Settings, topics: dict[str, str]) -> str:
    """Return what has stopped, since when and what may be the reason; empty if all comes.

    Parameters
    ----------
    topics : full names of the topics, by those keys of ``view.silence`` that are looked at.
    """
    limits = dict.fromkeys(topics, settings.monitor.stale_after)
    # The monitor's rate may be slow by choice; one period late is not silent.
    for name in {"estimates", "estimated"} & set(topics):
        limits[name] += 1.0 / settings.monitor.publish_rate
    limits["health"] = HEALTH_STALE_AFTER
    silent = {name: view.silence[name] for name in topics if view.silence[name] > limits[name]}
    if not silent:
        return ""
    never = [topics[name] for name, age in silent.items() if math.isinf(age)]
    parts = []
    stopped = {name: age for name, age in silent.items() if math.isfinite(age)}
    if stopped:
        age = max(stopped.values())
        since = time.strftime("%H:%M:%S", time.localtime(time.time() - age))
        parts.append(f"No data since {since} ({age:.0f} s): nothing on "
                     f"{', '.join(topics[name] for name in stopped)}")
    if never:
        parts.append(f"{'no' if parts else 'No'} data yet on {', '.join(never)}")
    finding = view.findings.get("data")
    if "health" in silent:
        parts.append("nothing is received from the monitor")
    elif finding is not None and finding.level == "STALE":
        parts.append(f"monitor: {finding.message}")
    return "; ".join(parts)


def position_texts(view: View, scale: Scale) -> tuple[str, str, str]:
    """Return measured and estimated position, and their difference where it means something."""
    texts = [f"{name} {value * scale.factor:.2f} {scale.unit}" if math.isfinite(value)
             else f"{name} –" for name, value in (("measured", view.measured),
                                                  ("estimated", view.estimated))]
    if not view.same_stamp:
        return texts[0], texts[1], ""
    difference = (view.measured - view.estimated) * scale.factor * 1e3
    return texts[0], texts[1], f"difference {difference:+.1f} {_FINE[scale.unit]}"


def data_text(view: View) -> str:
    """Return how the data come, as the monitor says it, in one line."""
    finding = view.findings.get("data")
    if finding is None:
        return "data: nothing received from the monitor yet"
    numbers = ", ".join(words.format(_written(finding.values[key], 3))
                        for key, words in _DATA.items() if finding.values.get(key, "") != "")
    return f"data: {finding.message}" + (f"; {numbers}" if numbers else "")
