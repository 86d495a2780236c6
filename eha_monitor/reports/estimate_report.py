"""The HTML report of ``estimate``: verdict and what to do, figures, alarms, innovations."""

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eha_monitor.estimation.results import Estimate, JointResult, ParameterEstimate
from eha_monitor.health.alarms import WATCHED, Alarm
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.output import write_text
from eha_monitor.quantity import FLOOR, SYMBOLS, number, quantity, share
from eha_monitor.recordings.recording import Recording
from eha_monitor.reports.estimate_figures import (
    NAMES,
    innovation_block,
    limits_in_words,
    motion_blocks,
    parameter_block,
    parameter_figure,
    presentable,
)
from eha_monitor.reports.estimate_words import (
    STATUS_WORDS,
    effect_of_mismatch,
    next_steps,
    verdict,
)
from eha_monitor.reports.page import Cell, FirstScreen, Table, render, table
from eha_monitor.reports.shared_tables import config_tables, indicator_table, law_table
from eha_monitor.reports.timeline import alarm_timeline, alarm_words
from eha_monitor.settings.channels import CHANNEL_UNITS

if TYPE_CHECKING:
    from eha_monitor.estimation.observability import ObservabilityTable

_CHANNEL_WORDS = {"x": "position x", "v": "velocity v", "x_d": "demanded position x_d",
                  "omega": "pump speed ω", "p1": "pressure p₁", "p2": "pressure p₂",
                  "force": "force", "temperature": "temperature"}
_ROTARY_UNITS = {"m": "rad", "m/s": "rad/s", "N": "N·m"}
_HERO = 330  # pixels of the height of the first picture
_STRONG = 0.9  # correlation that is marked


def write_estimate_report(path: str | Path, estimate: Estimate, alarms: tuple[Alarm, ...],
                          history: tuple[Alarm, ...],
                          observability: "ObservabilityTable | None" = None,
                          indicators: tuple[Indicator, ...] = ()) -> None:
    """Write the report of one recording as a single HTML file.

    Parameters
    ----------
    path : file to write; an existing one is replaced at once when the new one is complete.
    estimate : what the pipeline found.
    alarms : state of each alarm at the end of the recording.
    history : every change of a level, in order of time.
    observability : standard deviations that each combination of channels would reach, or None.
    indicators : of the health, with a value or without.

    Raises
    ------
    InputError
        If ``path`` cannot be written.
    """
    write_text(path, estimate_page(estimate, alarms, history, observability, indicators))


def estimate_page(estimate: Estimate, alarms: tuple[Alarm, ...], history: tuple[Alarm, ...],
                  observability: "ObservabilityTable | None" = None,
                  indicators: tuple[Indicator, ...] = ()) -> str:
    """Return the report as HTML text."""
    estimate = presentable(estimate)
    recording, settings = estimate.recording, estimate.settings
    name = Path(recording.source).name or settings.rig.name
    return render(
        "estimate.html.j2", title=f"EHA monitor: {name}", name=name, facts=heading(estimate),
        first=_first_screen(estimate, alarms), model=estimate.model,
        indicators=indicator_table(indicators, settings), laws=law_table(indicators),
        warnings=(*estimate.warnings, *recording.losses),
        motion=motion_blocks(estimate),
        convergence=[parameter_block(estimate, "B"), parameter_block(estimate, "beta_e")],
        innovations=[innovation_block(estimate, estimate.stage_one),
                     innovation_block(estimate, estimate.stage_two)],
        timeline=alarm_timeline(alarms, history, estimate.events, recording.duration),
        alarms=_alarm_table(alarms, "alarms"), history=_alarm_table(history, "history"),
        events=table("no. | time | stage | event", [
            (i, _seconds(one.time_s), one.stage, one.message)
            for i, one in enumerate(estimate.events, 1)], " | number |  | message", "events"),
        joint=estimate.joint and _joint_table(estimate.joint),
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
    raised = [watched.symbol for watched in WATCHED for a in alarms
              if a.word in ("WARN", "ERROR") and a.name.startswith(watched.section)]
    order = [*raised, *(p.name for p in estimate.parameters.values()
                        if p.status == "converged"), *estimate.parameters]
    pictures = (parameter_figure(estimate, (name,), _HERO) for name in order)
    return FirstScreen(
        said.kind, said.headline, said.text,
        picture=next(filter(None, pictures), None),
        parameters=table("parameter | value | limits", [
            (f"{NAMES[key]} {SYMBOLS[key]}", _value_cell(p, key in estimate.model.tainted), Cell(
                limits_in_words(limits[key], p.unit), "message desk"))
            for key, p in estimate.parameters.items()], key="parameters"),
        sentences=effect_of_mismatch(estimate), actions=next_steps(estimate, alarms))


def _value_cell(p: ParameterEstimate, tainted: bool = False) -> Cell:
    """Return value and status, exact in SI; what must not be used is not set in bold."""
    known = math.isfinite(p.value)
    sure = p.status == "converged"
    badge, level = ("in doubt", "WARN") if sure and tainted else (
        STATUS_WORDS.get(p.status, p.status), p.status)
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
        (alarm_words(a.name), Cell("", badge=a.word), _seconds(a.time_s), a.message)
        for a in alarms], "number |  | number | message", key)


def _joint_table(joint: JointResult) -> Table:
    """Return the parameters of the joint estimator."""
    return table("parameter | value | in words", [
        (f"{NAMES.get(p.name, p.name)} {SYMBOLS.get(p.name, p.name)}", _value_cell(p),
         p.message if p.status == "converged" else "") for p in joint.parameters.values()],
        " |  | message", "joint")


def _correlation_table(joint: JointResult) -> Table:
    """Return the correlations of the joint estimator; strong ones are marked, and listed below."""
    correlation = np.asarray(joint.correlation, dtype=float)
    names = [SYMBOLS.get(name, name) for name in joint.parameters]
    strong = [f"{names[i]} and {names[j]}" for i in range(len(names)) for j in range(i)
              if i < len(correlation) and abs(correlation[i, j]) > _STRONG]
    return table(" | ".join(("correlation", *names)), [
        (names[i], *(Cell(f"{value:+.2f}".replace("-", "−") if math.isfinite(value) else "—",
                          "number strong" if i != j and abs(value) > _STRONG else "number")
                     for j, value in enumerate(row))) for i, row in enumerate(correlation)],
        key="correlation",
        note=f"Strongly correlated in this recording: {'; '.join(strong)}." if strong else "")


def _observability_table(found: "ObservabilityTable | None", recording: Recording) -> Table | None:
    """Return what combinations of channels determine, or None.

    Parameters
    ----------
    found : has ``rows``, each with ``channels`` and ``relative_stddev`` (name -> ratio).
    recording : its channels mark the rows that this recording can answer.
    """
    if found is None or not found.rows:
        return None
    names = list(dict.fromkeys(name for row in found.rows for name in row.relative_stddev))
    here = [bool(row.channels) and recording.has(*row.channels) for row in found.rows]
    mixed = not all(here)
    return table(" | ".join(("channels", *(SYMBOLS.get(name, name) for name in names))), [
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
    rotary = estimate.settings.rig.motion == "rotary"
    rows = []
    for name, noise in estimate.noise.items():
        unit = CHANNEL_UNITS.get(name, "")
        rows.append((_CHANNEL_WORDS.get(name, name), quantity(
            noise.value, _ROTARY_UNITS.get(unit, unit) if rotary else unit, 3),
            "measured from this recording" if noise.measured else "taken from the config"))
    return table("channel | standard deviation of a sample | source", rows, " | number | ",
                 "noise")
