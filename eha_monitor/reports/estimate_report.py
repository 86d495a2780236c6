"""The HTML report of ``estimate``: verdict, figures, innovations, alarms."""

from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eha_monitor.estimation.results import Estimate
from eha_monitor.health.alarms import Alarm
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.output import write_text
from eha_monitor.reports import tables
from eha_monitor.reports.alarm_timeline import alarm_timeline
from eha_monitor.reports.indicator_rows import indicator_rows
from eha_monitor.reports.innovation_figures import innovation_block
from eha_monitor.reports.motion_figures import motion_blocks
from eha_monitor.reports.page import render
from eha_monitor.reports.parameter_figures import parameter_block
from eha_monitor.reports.verdict import verdict

if TYPE_CHECKING:
    from eha_monitor.estimation.observability import ObservabilityTable

_LARGEST = 1e60  # SI; beyond it squares and matplotlib's own sums overflow


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
    indicators : of the health, told or not.

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
    recording = estimate.recording
    name = Path(recording.source).name or estimate.settings.rig.name
    return render(
        "estimate.html.j2",
        title=f"EHA monitor: {name}",
        name=name,
        heading=tables.heading(estimate),
        verdict=verdict(estimate, alarms),
        parameters=tables.parameter_rows(estimate),
        model=estimate.model,
        indicators=indicator_rows(indicators, estimate.settings),
        warnings=estimate.warnings,
        losses=recording.losses,
        motion=motion_blocks(estimate),
        convergence=[parameter_block(estimate, "B"), parameter_block(estimate, "beta_e")],
        innovations=[innovation_block(estimate, estimate.stage_one),
                     innovation_block(estimate, estimate.stage_two)],
        timeline=alarm_timeline(alarms, history, estimate.events, recording.duration),
        alarms=tables.alarm_rows(alarms),
        history=tables.alarm_rows(history),
        events=[{"time": tables.seconds(e.time_s), "stage": e.stage, "message": e.message}
                for e in estimate.events],
        joint=tables.joint_table(estimate.joint),
        observability=tables.observability_table(observability, recording),
        noise=tables.noise_rows(estimate),
        config=tables.config_sections(estimate.settings),
        rotary=estimate.settings.rig.motion == "rotary",
    )


def presentable(estimate: Estimate) -> Estimate:
    """Return the estimate with NaN for infinities and for sizes that no picture can show."""
    recording = replace(estimate.recording, channels={
        name: _tame(values) for name, values in estimate.recording.channels.items()})
    one, two = (replace(stage, **{f.name: _tame(getattr(stage, f.name)) for f in fields(stage)
                                  if isinstance(getattr(stage, f.name), np.ndarray)})
                for stage in (estimate.stage_one, estimate.stage_two))
    return replace(estimate, recording=recording, stage_one=one, stage_two=two)


def _tame(values: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        wild = ~(np.abs(values) < _LARGEST)
    return np.where(wild, np.nan, values) if wild.any() else values
