"""The HTML report of ``estimate``: verdict and what to do, figures, alarms, innovations."""

import math
import shlex
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eha_monitor.estimation.results import Estimate, JointResult, ParameterEstimate
from eha_monitor.health.alarms import BALANCES, NO_LIMIT, SECTIONS, Alarm
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.quantity import FLOOR, ROTARY, SYMBOLS, number, quantity, share
from eha_monitor.recordings.recording import Recording
from eha_monitor.reports import estimate_figures as figures
from eha_monitor.reports.diagnosis_words import LOOK_FOR, own_config, parameter_name, sentence
from eha_monitor.reports.page import (
    Cell,
    FirstScreen,
    Table,
    alarm_timeline,
    alarm_words,
    config_tables,
    indicator_table,
    law_table,
    render,
    table,
    with_limits,
)
from eha_monitor.settings.channels import CHANNEL_UNITS
from eha_monitor.words import listed

if TYPE_CHECKING:
    from eha_monitor.estimation.joint import ObservabilityTable

STATUS_WORDS = {"converged": "converged", "not_excited": "not excited by this motion",
                "diverged": "diverged", "no_data": "no data"}
# Alarm -> what is wrong, and where to look first.
_ALARMS = {
    "viscous_damping_high": ("the viscous damping B is too high", LOOK_FOR["B", True]),
    "viscous_damping_low": ("the viscous damping B is too low", LOOK_FOR["B", False]),
    "bulk_modulus_high": ("the effective bulk modulus βe is too high", LOOK_FOR["beta_e", True]),
    "bulk_modulus_low": ("the effective bulk modulus βe is too low", LOOK_FOR["beta_e", False])}
_STEPS = {"not_excited": "record a motion that excites {name}: `eha-monitor advise {bag}` "
                         "proposes one",
          "diverged": "check the channels and the rig data in the config: the estimate of {name} "
                      "diverged",
          "no_data": "record what {name} needs: {message}"}


@dataclass(frozen=True)
class Verdict:
    """``kind`` is ``ok``, ``warn``, ``error`` or ``unknown`` and sets the colour."""

    kind: str
    headline: str
    text: str


def verdict(estimate: Estimate, alarms: tuple[Alarm, ...]) -> Verdict:
    """Return what the recording says about the actuator, and what it does not say."""
    raised = _raised(alarms)
    known = [p for p in estimate.parameters.values() if p.status == "converged"]
    unknown = [p for p in estimate.parameters.values() if p.status != "converged"]
    mismatch = estimate.model.status == "mismatch"
    parts = [" and ".join(
        f"{_ALARMS[a.name][0] if a.name in _ALARMS else a.name.replace('_', ' ')} ({a.level})"
        for a in raised)] if raised else []
    if mismatch:
        biased = [SYMBOLS[p.name] for p in known if p.name in estimate.doubted]
        beside = [SYMBOLS[p.name] for p in known if p.name in estimate.model.tainted
                  and p.name not in estimate.doubted]
        parts.append("the model does not fit this recording" + (
            f", so {listed(biased)} {'is' if len(biased) == 1 else 'are'} biased by the model "
            "error" if biased else "") + (
            f"; {listed(beside)} by least squares on the balances instead" if beside else ""))
    if known and not raised:
        parts.append(_values(known, alarms))
    if unknown:
        parts.append("no estimate of " + " and ".join(
            f"{parameter_name(p.name)} ({STATUS_WORDS.get(p.status, p.status)})"
            for p in unknown))
    if estimate.model.status == "consistent":
        parts.append("the model fits the recording")
    elif known and not mismatch:
        parts.append("the recording does not show whether the model fits")
    held = any(a.not_judged for a in alarms)
    kind, headline = _head(raised, estimate.model.status, bool(known), bool(unknown) or held)
    if held and kind == "ok":
        kind = "unknown"
    return Verdict(kind, headline, f"{'; '.join(parts)}.")


def _raised(alarms: tuple[Alarm, ...]) -> list[Alarm]:
    """Return the raised alarms, errors first."""
    return [a for word in ("ERROR", "WARN") for a in alarms if a.word == word]


def _head(raised: list[Alarm], model: str, known: bool, open_questions: bool) -> tuple[str, str]:
    """Return colour and first words: the gravest thing leads."""
    if raised:
        kind, words = ("error", "Alarm") if raised[0].word == "ERROR" else ("warn", "Warning")
        return kind, words + (" and mismatch" if model == "mismatch" else "")
    if model == "mismatch":
        return "warn", "Mismatch"
    if not known:
        return "unknown", "No answer"
    if open_questions or model != "consistent":
        return ("ok" if model == "consistent" else "unknown",
                "No fault found in what could be judged")
    return "ok", "Healthy"


def _limited(alarms: tuple[Alarm, ...], name: str) -> list[Alarm]:
    """Return the alarms of a parameter that have a limit."""
    return [a for a in alarms if a.name.startswith(SECTIONS[name]) and a.message != NO_LIMIT]


def _values(known: list[ParameterEstimate], alarms: tuple[Alarm, ...]) -> str:
    """Return the values that no alarm complains about, and whether one could have."""
    def shown(some: list[ParameterEstimate]) -> str:
        return " and ".join(f"{SYMBOLS[p.name]} = {p.shown}" for p in some)

    doubtful = [p for p in known if any(a.not_judged for a in _limited(alarms, p.name))]
    sure = [p for p in known if p not in doubtful]
    parts = []
    if sure:
        limited = all(_limited(alarms, p.name) for p in sure)
        parts.append(shown(sure) + (f" {'is' if len(sure) == 1 else 'are'} within the limits"
                                    if limited else ", without configured limits"))
    if doubtful:
        parts.append(f"{shown(doubtful)} {'is' if len(doubtful) == 1 else 'are'} not judged")
    return "; ".join(parts)


def effect_of_mismatch(estimate: Estimate) -> tuple[str, ...]:
    """Return what a model that does not fit does to B and beta_e, a sentence each."""
    return tuple(sentence(
        f"{SYMBOLS[name]} of the filter cannot be used" if taint.instead is None else
        f"{SYMBOLS[name]} of the filter is not used: {taint.instead.shown} by least squares on "
        f"the {BALANCES[name]} balance, which the alarms judge")
        for name, taint in estimate.model.tainted.items())


def next_steps(estimate: Estimate, alarms: tuple[Alarm, ...]) -> tuple[str, ...]:
    """Return what to do, the most important first; commands stand between backticks."""
    bag = shlex.quote(estimate.recording.source or "BAG")
    steps, own = [], own_config(estimate.settings.rig)
    if estimate.model.status == "mismatch":
        wrong = listed([SYMBOLS[name] for name in estimate.doubted])
        steps.append((f"do not act on {wrong} yet: " if wrong else "")
                     + f"`eha-monitor diagnose {bag}{own}` identifies what the model lacks")
    steps += [_ALARMS[a.name][1] for a in _raised(alarms) if a.name in _ALARMS]
    for p in estimate.parameters.values():
        if p.status in _STEPS:
            steps.append(_STEPS[p.status].format(
                name=parameter_name(p.name), bag=bag + own,
                message=p.message.rstrip(".") or "its channels are missing"))
    if without := [SYMBOLS[name] for name in estimate.parameters if not _limited(alarms, name)]:
        steps.append(f"set limits for {listed(without)}: `eha-monitor thresholds` derives them "
                     "from healthy recordings")
    return tuple(map(sentence, steps)) or ("Nothing.",)


# ---- the page -----------------------------------------------------------------------------------

_CHANNEL_WORDS = {"x": "position x", "v": "velocity v", "x_d": "demanded position x_d",
                  "omega": "pump speed ω", "p1": "pressure p₁", "p2": "pressure p₂",
                  "force": "force", "temperature": "temperature"}
_HERO = 330  # pixels of the height of the first picture
_STRONG = 0.9  # correlation that is marked


def estimate_page(estimate: Estimate, alarms: tuple[Alarm, ...], history: tuple[Alarm, ...],
                  observability: "ObservabilityTable | None" = None,
                  indicators: tuple[Indicator, ...] = ()) -> str:
    """Return the report of one recording as HTML text.

    ``alarms`` are those at its end, ``history`` every change of a level in order.
    """
    estimate = figures.presentable(estimate)
    recording, settings = estimate.recording, estimate.settings
    name = Path(recording.source).name or settings.rig.name
    return render(
        "estimate.html.j2", title=f"EHA monitor: {name}", name=name, facts=heading(estimate),
        first=with_limits(_first_screen(estimate, alarms), indicators, settings),
        model=estimate.model,
        indicators=indicator_table(indicators, settings), laws=law_table(indicators),
        warnings=(*estimate.warnings, *recording.losses),
        motion=figures.motion_blocks(estimate),
        convergence=[figures.parameter_block(estimate, name) for name in ("B", "beta_e")],
        innovations=[figures.innovation_block(estimate, estimate.stage_one),
                     figures.innovation_block(estimate, estimate.stage_two)],
        timeline=alarm_timeline(alarms, history, estimate.told, recording.duration),
        alarms=_alarm_table(alarms, "alarms"), history=_alarm_table(history, "history"),
        events=table("no. | time | stage | event", [
            (i, _seconds(one.time_s), one.stage, one.message)
            for i, one in enumerate(estimate.told, 1)], " | number |  | message", "events"),
        joint=estimate.joint and _joint_table(estimate.joint, bool(estimate.joint_doubt)),
        joint_message=estimate.joint.message if estimate.joint else "",
        correlation=estimate.joint and _correlation_table(estimate.joint),
        observability=_observability_table(observability, recording),
        observability_message=getattr(observability, "message", ""),
        noise=_noise_table(estimate),
        config=config_tables(settings), rotary=settings.rig.motion == "rotary")


def _first_screen(estimate: Estimate, alarms: tuple[Alarm, ...]) -> FirstScreen:
    """Return verdict, the curve that shows it, B and beta_e, what to do."""
    said = verdict(estimate, alarms)
    thresholds = estimate.settings.thresholds
    limits = {"B": thresholds.viscous_damping, "beta_e": thresholds.bulk_modulus}
    # One curve, which a phone can show: of the raised alarm, else of what converged.
    raised = [name for name in SECTIONS if any(a.raised for a in _limited(alarms, name))]
    order = [*raised, *(p.name for p in estimate.parameters.values()
                        if p.status == "converged"), *estimate.parameters]
    pictures = (figures.parameter_figure(estimate, (name,), _HERO) for name in order)
    return FirstScreen(
        said.kind, said.headline, said.text,
        picture=next(filter(None, pictures), None),
        parameters=table("parameter | value | limits", [
            (parameter_name(key), _value_cell(
                p, key in estimate.doubted, key in estimate.model.tainted), Cell(
                figures.limits_in_words(limits[key], p.unit), "message desk"))
            for key, p in estimate.parameters.items()], key="parameters"),
        sentences=effect_of_mismatch(estimate), actions=next_steps(estimate, alarms))


def _value_cell(p: ParameterEstimate, tainted: bool, beside: bool = False) -> Cell:
    """Return value and status, exact in SI; what must not be used is not set in bold."""
    known, sure = math.isfinite(p.value), p.status == "converged"
    badge, level = ("in doubt", "WARN") if sure and tainted else (
        "least squares" if sure and beside else STATUS_WORDS.get(p.status, p.status), p.status)
    return Cell(p.shown if known else "—", "value" if sure and not tainted else "value doubt",
                note="" if sure else p.message, badge=badge, level=level,
                exact=(float(p.value), float(p.stddev)) if known else None,
                title=f"{p.value} {p.unit}, standard deviation {p.stddev}" if known else "")


def heading(estimate: Estimate) -> list[tuple[str, str]]:
    """Return the facts about the recording as (label, text)."""
    recording = estimate.recording
    facts = [("Recording", recording.source or "no file"),
             ("Rig", estimate.settings.rig.name),
             ("Duration", quantity(recording.duration, "s") if recording.duration < 120 else
              f"{recording.duration:.0f} s ({recording.duration / 60:.1f} min)"),
             ("Samples", f"{len(recording):,}".replace(",", " ")
              + f" at {number(1 / recording.sample_time)} Hz"),
             ("Channels", ", ".join(name for name in recording.channels
                                    if recording.has(name)) or "none with a value"),
             ("Start", _moment(recording.start_ns) if recording.dated else
              "no date: the stamps count from 0")]
    if estimate.wall_s > 0:
        facts.append(("Computed in", quantity(estimate.wall_s, "s", 3)))
    return facts


def _moment(start_ns: int) -> str:
    try:
        return datetime.fromtimestamp(start_ns // 10**9, tz=UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (ValueError, OverflowError, OSError):
        return "no date: the stamps are beyond the calendar"


def _seconds(time_s: float) -> str:
    """Return a time of the recording to hundredths, so that columns of them can be compared."""
    return f"{time_s:.2f} s" if math.isfinite(time_s) else "—"


def _alarm_table(alarms: tuple[Alarm, ...], key: str) -> Table:
    """Return one row for each alarm, or for each change of one."""
    return table("alarm | level | since | message", [
        (alarm_words(a.name), Cell("–") if a.message == NO_LIMIT else Cell("", badge=a.word),
         _seconds(a.time_s), a.message) for a in alarms], "number |  | number | message", key)


def _joint_table(joint: JointResult, doubted: bool) -> Table:
    """Return the parameters of the joint estimator."""
    return table("parameter | value | in words", [
        (parameter_name(p.name), _value_cell(p, doubted),
         p.message if p.status == "converged" else "") for p in joint.parameters.values()],
        " |  | message", "joint")


def _correlation_table(joint: JointResult) -> Table:
    """Return the correlations of the joint estimator; strong ones are marked, and listed below."""
    correlation = np.asarray(joint.correlation, dtype=float)
    names = [SYMBOLS.get(name, name) for name in joint.parameters]
    strong = [f"{names[i]} and {names[j]}" for i in range(len(names)) for j in range(i)
              if i < len(correlation) and abs(correlation[i, j]) > _STRONG]
    return table(("correlation", *names), [
        (names[i], *(Cell(f"{value:+.2f}".replace("-", "−") if math.isfinite(value) else "—",
                          "number strong" if i != j and abs(value) > _STRONG else "number")
                     for j, value in enumerate(row))) for i, row in enumerate(correlation)],
        key="correlation",
        note=f"Strongly correlated in this recording: {'; '.join(strong)}." if strong else "")


def _observability_table(found: "ObservabilityTable | None", recording: Recording) -> Table | None:
    """Return what combinations of channels determine, those of the recording marked; or None."""
    if found is None or not found.rows:
        return None
    names = list(dict.fromkeys(name for row in found.rows for name in row.relative_stddev))
    here = [bool(row.channels) and recording.has(*row.channels) for row in found.rows]
    mixed = not all(here)
    return table(("channels", *(SYMBOLS.get(name, name) for name in names)), [
        (Cell(", ".join(row.channels), "strong" if mine and mixed else ""),
         *(_relative(row.relative_stddev.get(name)) for name in names))
        for row, mine in zip(found.rows, here, strict=True)], key="observability",
        note="Smallest uncertainty (relative) that any estimator could reach with these channels "
             "and this motion, all parameters unknown at once."
             + (" Bold: channels that this recording has." if mixed else ""))


def _relative(ratio: float | None) -> Cell:
    """Return a relative standard deviation."""
    if ratio is None or not math.isfinite(ratio):
        return Cell("not observable", "number none")
    kind = "good" if ratio <= 0.05 else "fair" if ratio <= 0.5 else "poor"
    return Cell(f"± {share(ratio, 2)}" if ratio > FLOOR else f"below ± {share(FLOOR)}",
                f"number {kind}")


def _noise_table(estimate: Estimate) -> Table:
    """Return the noise level of each channel and where it comes from."""
    units = CHANNEL_UNITS if estimate.settings.rig.motion != "rotary" else {
        name: ROTARY.get(unit, unit) for name, unit in CHANNEL_UNITS.items()}
    return table("channel | standard deviation of a sample | source", [
        (_CHANNEL_WORDS.get(name, name), quantity(noise.value, units.get(name, ""), 3),
         "measured from this recording" if noise.measured else "taken from the config")
        for name, noise in estimate.noise.items()], " | number | ", "noise")
