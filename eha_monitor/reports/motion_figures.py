"""The curves of one recording: pressure, position, velocity, acceleration."""

from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.estimation.results import Estimate
from eha_monitor.quantity import quantity
from eha_monitor.reports.axes import axis_scale, scale_of, time_scale
from eha_monitor.reports.drawing import (
    HEIGHT,
    INK,
    MEASURED,
    STAGE_ONE,
    STAGE_TWO,
    Block,
    Picture,
    draw,
    legend_above,
    mark_window,
    new_figure,
    note_cut,
    pad_limits,
    picture,
)
from eha_monitor.reports.traces import (
    choose_smoother,
    in_gap,
    robust_peak,
    robust_range,
    telling_window,
)


@dataclass(frozen=True)
class Curve:
    """One line: (n,) SI values on the recording's grid, and how it is drawn."""

    label: str
    values: np.ndarray
    colour: str
    width: float = 1.4
    dashes: str = "-"

    @property
    def drawable(self) -> bool:
        """Whether there is a finite value to draw."""
        return bool(np.isfinite(self.values).any())


@dataclass(frozen=True)
class Window:
    """Samples ``start`` to ``stop`` that are shown enlarged, and what they show."""

    start: int
    stop: int
    words: str


def motion_unit(estimate: Estimate, order: int) -> str:
    """Return the unit of the ``order``-th derivative of the position: m or rad, per s^order."""
    base = "rad" if estimate.settings.rig.motion == "rotary" else "m"
    return base + ("", "/s", "/s²")[order]


def find_window(estimate: Estimate) -> Window:
    """Choose the enlarged part: where the model fits worst if it does not, else a reversal."""
    recording = estimate.recording
    motion = recording.get("x")
    if not np.isfinite(motion).any():
        motion = recording.get("x_d")
    peak = None
    if estimate.model.status == "mismatch":
        verdicts = [s.consistency for s in (estimate.stage_one, estimate.stage_two)
                    if s.consistency is not None and not s.consistency.consistent]
        times = [v.peak_time_s for v in verdicts if np.isfinite(v.peak_time_s)]
        peak = times[0] if times else None
    start, stop, words = telling_window(motion, recording.sample_time, peak)
    if peak is not None:
        words += " near the worst misfit"
    return Window(start, stop, words)


def draw_curves(estimate: Estimate, window: Window, curves: list[Curve],
                residuals: list[Curve], name: str, unit: str) -> tuple[Picture, ...]:
    """Return two pictures, whole record and window, each with curves above their residuals.

    Parameters
    ----------
    curves : SI values in ``unit``, drawn in this order.
    residuals : measured minus estimated in the colours of the estimates; may be empty.
    name : quantity on the axis, e.g. ``position``.
    """
    n = len(estimate.recording)
    curves = [curve for curve in curves if curve.drawable]
    residuals = sorted((curve for curve in residuals if curve.drawable), reverse=True,
                       key=lambda curve: float(np.nanstd(curve.values)))  # small ones on top
    shown = np.concatenate([curve.values for curve in curves])
    scale = scale_of(shown, unit)
    parts = [(0, n, "whole record")]
    if window.stop - window.start < n:
        parts.append((window.start, window.stop, window.words))
    return tuple(_part(estimate, part, window, curves, residuals, name, unit, scale)
                 for part in parts)


def _part(estimate, part, window, curves, residuals, name, unit, scale) -> Picture:
    """Draw one picture: samples ``part[0]`` to ``part[1]``."""
    start, stop, words = part
    whole = stop - start == len(estimate.recording)
    clock = time_scale(estimate.recording.duration if whole else 1.0)
    t = estimate.recording.time[start:stop] * clock.factor
    figure, axes = new_figure(2 if residuals else 1, (2.0, 1.0) if residuals else None,
                              HEIGHT + (60 if residuals else -60))
    for curve in curves:
        draw(axes[0], t, curve.values[start:stop] * scale.factor, color=curve.colour,
             linewidth=curve.width, linestyle=curve.dashes, label=curve.label)
    low, high, peak = robust_range([curve.values[start:stop] for curve in curves])
    pad_limits(axes[0], low * scale.factor, high * scale.factor)
    if peak:
        note_cut(axes[0], quantity(peak, unit, 2))
    axes[0].set_ylabel(f"{name}, {scale.unit}")
    legend_above(axes[0])
    if residuals:
        _draw_residuals(axes[1], t, [(c, c.values[start:stop]) for c in residuals], unit)
    if whole and window.stop - window.start < len(t):
        mark_window(axes[0], t[window.start], t[window.stop - 1])
    if len(t) > 1:
        axes[-1].set_xlim(t[0], t[-1])
    axes[-1].set_xlabel(f"time, {clock.unit} — {words}")
    return picture(figure, f"{name} against time, {words}: "
                           + ", ".join(curve.label for curve in curves),
                   clock.factor, "record" if whole else "part")


def _draw_residuals(axis, t, curves, unit) -> None:
    """Draw measured minus estimated about zero; say so where single peaks are cut off."""
    half, peak = robust_peak(np.concatenate([values for _, values in curves]))
    scale = axis_scale(half or 1.0, unit)
    for curve, values in curves:
        draw(axis, t, values * scale.factor, color=curve.colour, linewidth=1.0)
    axis.axhline(0, color=INK, linewidth=0.8)
    pad_limits(axis, -half * scale.factor, half * scale.factor)
    axis.set_ylabel(f"residual, {scale.unit}")
    if peak > 1.01 * half:
        note_cut(axis, quantity(peak, unit, 2))


def _stage_curves(estimate: Estimate, attribute: str) -> list[Curve]:
    """Return the states of both stages that have data; nothing where the data have a gap."""
    found = []
    gap = in_gap(estimate.recording.get("x"))
    for stage, label, colour, dashes in (
            (estimate.stage_one, "stage one", STAGE_ONE, "-"),
            (estimate.stage_two, "stage two", STAGE_TWO, "--")):
        values = getattr(stage, attribute)
        if len(values) == len(estimate.recording):
            curve = Curve(label, np.where(gap, np.nan, values), colour, 1.5, dashes)
            if curve.drawable:
                found.append(curve)
    return found


def pressure_block(estimate: Estimate, window: Window) -> Block:
    """Return the pressure difference, or the measured force where there is no pressure."""
    recording, rig = estimate.recording, estimate.settings.rig
    key = "pressure"
    p1, p2 = recording.get("p1"), recording.get("p2")
    curves, notes = [Curve("p₁ − p₂, measured", p1 - p2, STAGE_ONE)], ()
    if curves[0].drawable:
        if rig.area_1 and rig.area_2 and abs(rig.area_2 / rig.area_1 - 1) > 1e-3:
            load = p1 - p2 * rig.area_2 / rig.area_1
            curves.append(Curve("load pressure p₁ − p₂·A₂/A₁", load, STAGE_TWO))
            notes = ("The areas differ, so the load pressure is plotted.",)
        return Block(key, "Pressure difference", draw_curves(
            estimate, window, curves, [], "pressure difference", "Pa"), notes)
    if recording.has("force"):
        unit, word = ("N·m", "torque") if rig.motion == "rotary" else ("N", "force")
        curve = Curve(f"measured {word}", recording.get("force"), STAGE_ONE)
        return Block(key, f"Driving {word}", draw_curves(
            estimate, window, [curve], [], word, unit),
            (f"The pressures were not both recorded; the measured {word} replaces A·Δp.",))
    return Block(key, "Pressure difference", notes=(
        "Neither both pressures nor a force were recorded, so there is nothing to show.",))


def position_block(estimate: Estimate, window: Window) -> Block:
    """Return position measured and estimated."""
    unit = motion_unit(estimate, 0)
    word = "angle" if unit == "rad" else "position"
    title = word.capitalize()
    measured = Curve("measured", estimate.recording.get("x"), MEASURED, 4.0)
    estimated = _stage_curves(estimate, "position")
    if not measured.drawable and not estimated:
        return Block("position", title,
                     notes=("No position was recorded and none was estimated.",))
    residuals = [replace(curve, values=measured.values - curve.values) for curve in estimated]
    notes = () if estimated else ("No stage had data, so there is no estimate to compare.",)
    return Block("position", title, draw_curves(
        estimate, window, [measured, *estimated], residuals, word, unit), notes)


def derivative_block(estimate: Estimate, window: Window, order: int) -> Block:
    """Return velocity (order 1) or acceleration (order 2), measured and estimated."""
    name = ("velocity", "acceleration")[order - 1]
    recording, estimated = estimate.recording, _stage_curves(estimate, name)
    smoother = None
    if order == 1 and recording.has("v"):
        measured = Curve("measured", recording.get("v"), MEASURED, 4.0)
    else:
        smoother = choose_smoother(recording.get("x"), recording.sample_time, order)
        which = ("derivative", "second derivative")[order - 1]
        values = smoother.of(recording.get("x")) if smoother else recording.get("none")
        length = quantity(smoother.length, "s", 2) if smoother else ""
        measured = Curve(f"{which} of measured position, over {length}", values, MEASURED,
                         4.0)
    if not measured.drawable and not estimated:
        return Block(name, name.capitalize(), notes=(
            f"No {name} was measured or estimated, and there are too few position samples to "
            "differentiate.",))
    notes: tuple[str, ...] = ()
    if smoother:
        notes = (f"The {name} was not measured: the grey line is the numerical {which} of the "
                 f"position, smoothed over {length}. For the residual the estimate is smoothed in "
                 "the same way.",)
    if not estimated:
        notes += (f"No stage had data to estimate the {name}.",)
    residuals = [replace(curve, values=measured.values - (
        smoother.alike(curve.values, recording.get("x")) if smoother else curve.values))
        for curve in estimated]
    return Block(name, name.capitalize(), draw_curves(
        estimate, window, [measured, *estimated], residuals, name,
        motion_unit(estimate, order)), notes)


def motion_blocks(estimate: Estimate) -> list[Block]:
    """Return pressure difference, position, velocity and acceleration, in that order."""
    window = find_window(estimate)
    return [pressure_block(estimate, window), position_block(estimate, window),
            derivative_block(estimate, window, 1), derivative_block(estimate, window, 2)]
