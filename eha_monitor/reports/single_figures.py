"""One figure each of a recording, an estimate, a diagnosis, a proposed motion: for notebooks."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from eha_monitor.estimation.results import Estimate
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.physics.excitation import demanded_position, total_duration
from eha_monitor.recordings.columns import sampled
from eha_monitor.recordings.recording import Recording
from eha_monitor.reports.axes import scale_of, time_scale
from eha_monitor.reports.diagnosis_figures import (
    agreement_figure,
    curve_figure,
    learned_figure,
    overlay_figure,
    telling,
)
from eha_monitor.reports.diagnosis_report import presentable as presentable_diagnosis
from eha_monitor.reports.drawing import (
    INK,
    OTHER,
    STAGE_ONE,
    STAGE_TWO,
    arranged,
    draw,
    legend_above,
    new_figure,
    pad_limits,
)
from eha_monitor.reports.estimate_report import presentable as presentable_estimate
from eha_monitor.reports.parameter_figures import NAMES, parameter_figure
from eha_monitor.reports.traces import robust_range
from eha_monitor.settings.rig import Segment

# Channels that are drawn on the same axes, and what these are called.
_TOGETHER = {"x": "position", "x_d": "position", "v": "velocity", "omega": "pump speed",
             "omega_d": "pump speed", "p1": "pressure", "p2": "pressure", "force": "force",
             "temperature": "temperature"}
_LABELS = {"x": "x", "x_d": "x_d, demanded", "v": "v", "omega": "ω", "omega_d": "ω_d, demanded",
           "p1": "p₁", "p2": "p₂", "force": "force", "temperature": "temperature"}
_COLOURS = (STAGE_ONE, STAGE_TWO)
_ROW, _FOOT = 150, 60  # CSS pixels
_SAMPLES = 4000  # of a demanded motion


def words_figure(words: str) -> Figure:
    """Return a figure that says why there is nothing to draw."""
    figure, (axis,) = new_figure(height=120)
    axis.set_axis_off()
    axis.text(0.5, 0.5, words, ha="center", va="center", color=INK, wrap=True,
              transform=axis.transAxes)
    return figure


def recording_figure(recording: Recording, names: Sequence[str], units: Mapping[str, str]
                     ) -> Figure:
    """Draw channels against time, those of one quantity on the same axes.

    Parameters
    ----------
    names : channels, in order.
    units : channel -> SI unit.
    """
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(_TOGETHER[name], []).append(name)
    clock = time_scale(recording.duration)
    figure, axes = new_figure(len(groups), height=_ROW * len(groups) + _FOOT)
    step = recording.sample_time * clock.factor
    for axis, (quantity, members) in zip(axes, groups.items(), strict=True):
        columns = [sampled(recording.channels[name]) for name in members]
        scale = scale_of(np.concatenate(columns), units[members[0]])
        for name, values, colour in zip(members, columns, _COLOURS, strict=False):
            every = -(-len(recording) // max(len(values), 1))
            draw(axis, np.arange(len(values)) * every * step, values * scale.factor,
                 color=colour, linewidth=1.2, label=_LABELS[name])
        low, high, _ = robust_range(columns)
        pad_limits(axis, low * scale.factor, high * scale.factor)
        axis.set_ylabel(f"{quantity}, {scale.unit}")
        if len(members) > 1:
            legend_above(axis)
    axes[-1].set_xlim(0.0, max(len(recording) - 1, 1) * step)
    axes[-1].set_xlabel(f"time, {clock.unit}")
    return arranged(figure)


def estimate_figure(estimate: Estimate, names: Sequence[str]) -> Figure:
    """Draw ``B``, ``beta_e`` or both as they converge, with band and limits."""
    return parameter_figure(presentable_estimate(estimate), names) or words_figure("; ".join(
        f"{NAMES[name]}: {estimate.parameters[name].message or 'no data'}" for name in names))


def missing_figure(found: Diagnosis) -> Figure:
    """Draw what the recording shows and the model lacks: the head of the report."""
    if found.learned:
        return arranged(learned_figure(found.learned[0])[0])
    curves = telling(found)
    if not curves:
        return words_figure(found.message)
    return arranged(curve_figure(found, curves[0], large=True)[0])


def fit_figure(found: Diagnosis) -> Figure:
    """Draw the first signal of unseen data with both models running free."""
    for overlay in found.overlays:
        made = overlay_figure(overlay, bool(found.effects or found.rig_data or found.learned
                                            or found.pieces or found.references))
        if made is not None:
            return arranged(made[0])
    return words_figure("No data were held out to run the models on.")


def part_figure(name: str, found: Diagnosis) -> Figure:
    """Draw a parameter as each part of the record gives it."""
    made = agreement_figure(name, found.agreement, found.before.get(name), found.after.get(name))
    return words_figure(f"{NAMES[name]}: no value from parts of the recording") if (
        made is None) else arranged(made[0])


def _shown(draw: Callable[[Diagnosis], Figure], found: Diagnosis) -> Figure:
    return draw(presentable_diagnosis(found))


DIAGNOSIS_FIGURES: dict[str, Callable[[Diagnosis], Figure]] = {
    name: partial(_shown, draw) for name, draw in {
        "missing": missing_figure, "fit": fit_figure, "B": partial(part_figure, "B"),
        "beta_e": partial(part_figure, "beta_e")}.items()}


def motion_figure(proposed: tuple[dict[str, Segment], str] | None, motion: str) -> Figure:
    """Draw a proposed motion, demanded position against time.

    Parameters
    ----------
    proposed : its segments and its sentence, or None.
    motion : of the rig, ``linear`` or ``rotary``.
    """
    if proposed is None:
        return words_figure("No motion is proposed: nothing is in doubt, or no motion resolves "
                            "it.")
    segments, words = proposed
    time = np.linspace(0.0, total_duration(segments), _SAMPLES, endpoint=False)
    values = demanded_position(segments, time)
    scale = scale_of(values, "rad" if motion == "rotary" else "m")
    figure, (axis,) = new_figure(height=_ROW + 2 * _FOOT)
    draw(axis, time, values * scale.factor, color=OTHER, linewidth=1.5, label=words)
    pad_limits(axis, values.min() * scale.factor, values.max() * scale.factor)
    axis.set_xlabel("time, s")
    axis.set_ylabel(f"demanded position, {scale.unit}")
    legend_above(axis)
    return arranged(figure)
