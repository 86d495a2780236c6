"""The page's texts: numbers as people write them, levels, and what to say of silence."""

import contextlib
import math
import time
from dataclasses import dataclass
from datetime import datetime

from eha_monitor.dashboard import state
from eha_monitor.dashboard.events import ACKNOWLEDGED, MISMATCH
from eha_monitor.estimation.results import units_of
from eha_monitor.health.alarms import NO_LIMIT, NOT_JUDGED, WATCHED
from eha_monitor.health.judge import (
    DIAGNOSIS,
    INDICATOR,
    MACHINE,
    MODEL_IN_FORCE,
    SEVERITY,
    Finding,
)
from eha_monitor.quantity import SYMBOLS, Scale, number, readable, with_uncertainty
from eha_monitor.settings import Settings
from eha_monitor.words import probability

# A level has a sign and a word, so that it is readable without its colour.
SIGNS = {"OK": "✓", NOT_JUDGED: "?", "WARN": "▲", "ERROR": "✖", "STALE": "◌"}
# Of all that the status `data` holds, what shows whether messages arrive, and its words.
_DATA = {"rows": "{} rows so far", "lost_messages": "{} messages lost",
         "missing_samples": "{} samples missing",
         "latency_p50_ms": "half of the rows done within {} ms",
         "cpu_share_percent": "{} % of a processor"}
_FINE = {"mm": "µm", "mrad": "µrad"}  # a thousandth of the units in which positions are shown
# Data count as live up to this age, and stamps as of another time beyond this distance, s.
LIVE_WITHIN, STAMPS_DIFFER = 2.0, 5.0
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
    if not math.isfinite(value) or stddev > abs(value):  # 12000 ± 23000 is no number
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


def overall(view: state.View) -> tuple[str, str]:
    """Return the level of the header and its words.

    It is the worst of what is judged, a change of the machine with it.  STALE is for data that do
    not come; while they come, an alarm that nothing can be said about is counted beside the level
    and does not hide the rest.
    """
    data = view.findings.get("data")
    if not view.findings or (data is not None and data.level == "STALE"):
        return "STALE", level_text("STALE")
    mismatch = [view.findings[MISMATCH]] if MISMATCH in view.findings else []
    machine = [one for name, one in view.findings.items() if one.level in ("WARN", "ERROR") and (
        name == MACHINE or name.startswith(INDICATOR))]
    # Without a limit there is no level, and no OK.
    listed = [finding for finding in state.alarms(view) if finding.message != NO_LIMIT]
    judged = [finding for finding in listed if finding.word not in ("STALE", NOT_JUDGED)]
    # A value beyond its limit that a misfit holds back must be visible.
    held = [one for one in listed if one.word == NOT_JUDGED and one.level == "WARN"]
    if not (judged or held or machine or (not listed and worst(mismatch) == "WARN")):
        return "STALE", "◌ not judged yet" if listed else "◌ no limits set"
    level = worst([*judged, *held, *machine, *(one for one in mismatch if one.level != "STALE")])
    left = len(listed) - len(judged)
    return level, level_text(level) + (f", {left} of {len(listed)} not judged" if left else "")


def short(symbol: str, number: Shown) -> str:
    """Return an estimate in one line: B 600.1 ± 2.3 N·s/m."""
    return " ".join(part for part in (SYMBOLS[symbol], number.value, number.stddev, number.unit)
                    if part)


def waiting(view: state.View) -> list[str]:
    """Return the names of what is raised and has not been acknowledged."""
    return [name for name in ACKNOWLEDGED if name in view.findings
            and view.findings[name].raised and name not in view.acknowledged]


def quiet(view: state.View) -> bool:
    """Return whether something is raised and all of that has been acknowledged."""
    raised = any(view.findings[name].raised for name in ACKNOWLEDGED if name in view.findings)
    return raised and not waiting(view)


def acknowledged_text(view: state.View, name: str) -> str:
    """Return who acknowledged an alarm and when, or nothing."""
    given = view.acknowledged.get(name)
    return f"acknowledged by {given.who}, {clock_text(given.time_s)}" if given else ""


def clock_text(time_s: float) -> str:
    """Return a time of day of this machine's zone, with the date where that is not today."""
    then = time.localtime(time_s)
    today = time.strftime("%Y-%m-%d", then) == time.strftime("%Y-%m-%d")
    return time.strftime("%H:%M:%S" if today else "%Y-%m-%d %H:%M:%S", then)


def last_data(view: state.View, now: float) -> tuple[bool, str]:
    """Return whether data come, and when the last did; ``now`` : s since the epoch."""
    age = min(view.silence["measured"], view.silence["estimates"])
    if math.isinf(age):
        return False, "no data yet"
    text = f"last data {clock_text(now - age)} {time.strftime('%Z')}"
    if age >= 1.0:
        text += f" ({duration_text(age)} ago)"
    if math.isfinite(view.stamp) and abs(now - age - view.stamp) > STAMPS_DIFFER:
        stamped = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(view.stamp))
        text += f", stamped {stamped} (a replay, or clocks that differ)"
    return age <= LIVE_WITHIN, text


def duration_text(seconds: float) -> str:
    """Return a duration in its two largest units.

    >>> duration_text(8.2), duration_text(200), duration_text(93_000)
    ('8 s', '3 min 20 s', '1 d 1 h')
    """
    whole = int(seconds)
    parts = [(whole // 86_400, "d"), (whole // 3600 % 24, "h"), (whole // 60 % 60, "min"),
             (whole % 60, "s")]
    first = next((k for k, (count, _) in enumerate(parts) if count), 3)
    return " ".join(f"{count} {unit}" for count, unit in parts[first:first + 2]
                    if count or first == 3)


def diagnosis_lines(view: state.View) -> list[str]:
    """Return what the monitor's own diagnosis says, after its verdict: the model in force first.

    Each effect with its probability; then B and beta_e before and after; what goes on; of which
    recording it is, and its report.
    """
    found = dict(view.diagnosis)
    head, model = found.pop(DIAGNOSIS, None), found.pop(MODEL_IN_FORCE, None)
    machine = found.pop(MACHINE, None)
    if head is None:
        return []
    if machine is not None:  # what its line says already
        found = {name: one for name, one in found.items()
                 if one.message.partition(", since ")[0] not in machine.message}
    # Names are those of the catalogue there, as programs read them too.
    lines = [local_times(model).replace("_", " ")] if model is not None else []
    for one in found.values():
        chance = one.values.get("probability")
        lines.append(local_times(one) + (f" ({probability(float(chance))})" if chance else ""))
    if head.values.get("state") not in ("idle", None):
        lines.append(str(head.values["state"]))
    if head.values.get("bag"):
        lines.append(f"diagnosed: {head.values['bag']}")
    if head.values.get("report"):
        lines.append(f"report: {head.values['report']}")
    return [f"• {line[:1].upper()}{line[1:]}" for line in lines]


def local_times(finding: Finding) -> str:
    """Return a message with its times as all others on the page: of this machine's zone."""
    text = finding.message
    for key in ("time_utc", "since_utc", "begins_utc"):
        when = str(finding.values.get(key) or "")
        with contextlib.suppress(ValueError):
            text = text.replace(when, clock_text(datetime.fromisoformat(when).timestamp()))
    return text


def estimate_status(view: state.View, section: str, stage: str) -> tuple[str, bool]:
    """Return the status of a parameter in words, and whether its value must not be used."""
    finding = view.findings.get(stage)
    status = str(finding.values.get("status", "")) if finding else ""
    if finding is None or not status:
        return "no data yet", False
    words, symbol = _STATUS_WORDS.get(status, status), next(
        one.symbol for one in WATCHED if one.section == section)
    doubted = state.in_doubt(view.findings, symbol)
    misfit = any(name.startswith(section) and int(one.values.get("tainted") or 0)
                 for name, one in view.findings.items())
    if misfit or doubted:
        words = "by least squares: the model does not fit" if not doubted else (
            "in doubt: the model does not fit" if misfit else
            "in doubt: nothing has tested the model yet")
    return (f"{words} (last heard)" if finding.level == "STALE" else words), doubted


def model_status(view: state.View) -> str:
    """Return whether the model fits, in words."""
    finding = view.findings.get("model")
    words = plain_name(str(finding.values.get("status") or "unknown")) if finding else "Unknown"
    return f"{words} (last heard)" if finding and finding.level == "STALE" else words


def innovation_texts(view: state.View, stage: str) -> tuple[str, str, str]:
    """Return NIS, variance ratio and number of innovations of a stage."""
    values = view.findings[stage].values if stage in view.findings else {}
    nis, ratio, samples = (_written(values.get(key, ""), 3) or "–"
                           for key in (state.NIS, state.VARIANCE_RATIO, state.SAMPLES))
    return nis, ratio, samples


def _written(value: float | int | str, digits: int) -> str:
    """Return a number of a diagnostic with ``digits`` digits, or all those before its point."""
    try:
        return number(float(value), digits)
    except ValueError:
        return str(value)


def silence_text(view: state.View, settings: Settings, topics: dict[str, str]) -> str:
    """Return what has stopped, since when and what may be the reason; empty if all comes.

    ``topics`` : full names of the topics, by those keys of ``view.silence`` that are looked at.
    """
    limits = dict.fromkeys(topics, settings.monitor.stale_after)
    # The monitor's rate may be slow by choice; one period late is not silent.
    for name in {"estimates", "estimated"} & set(topics):
        limits[name] += 1.0 / settings.monitor.publish_rate
    limits["health"] = state.HEALTH_STALE_AFTER
    silent = {name: view.silence[name] for name in topics if view.silence[name] > limits[name]}
    if not silent:
        return ""
    never = [topics[name] for name, age in silent.items() if math.isinf(age)]
    parts = []
    stopped = {name: age for name, age in silent.items() if math.isfinite(age)}
    if stopped:
        age = max(stopped.values())
        since = clock_text(time.time() - age)
        parts.append(f"No data since {since} ({duration_text(age)}): nothing on "
                     f"{', '.join(topics[name] for name in stopped)}")
    if never:
        parts.append(f"{'no' if parts else 'No'} data yet on {', '.join(never)}")
    finding = view.findings.get("data")
    if "health" in silent:
        parts.append("nothing is received from the monitor")
    elif finding is not None and finding.level == "STALE":
        # The first reason; the others stand with the data, below.
        parts.append(f"the monitor says: {finding.message.partition('; ')[0]}")
    return "; ".join(parts)


def position_texts(view: state.View, scale: Scale) -> tuple[str, str, str]:
    """Return measured and estimated position, and their difference where it means something."""
    texts = [f"{name} {value * scale.factor:.2f} {scale.unit}" if math.isfinite(value)
             else f"{name} –" for name, value in (("measured", view.measured),
                                                  ("estimated", view.estimated))]
    if not view.same_stamp:
        return texts[0], texts[1], ""
    difference = (view.measured - view.estimated) * scale.factor * 1e3
    return texts[0], texts[1], f"difference {difference:+.1f} {_FINE[scale.unit]}"


def data_text(view: state.View) -> str:
    """Return how the data come, as the monitor says it, in one line."""
    finding = view.findings.get("data")
    if finding is None:
        return "data: nothing received from the monitor yet"
    found = [words.format(_written(finding.values[key], 3)) for key, words in _DATA.items()
             if finding.values.get(key, "") != ""]
    rates = {key[len("rate_"):-len("_Hz")]: value for key, value in finding.values.items()
             if key.startswith("rate_")}
    if rates:
        busiest = max(rates, key=lambda topic: float(rates[topic]))
        found.insert(1, f"{_written(rates[busiest], 3)} messages a second on {busiest}")
    numbers = ", ".join(found)
    return f"data: {finding.message}" + (f"; {numbers}" if numbers else "")
