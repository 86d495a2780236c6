"""The paper's curves for one recording: pressure, position, velocity, acceleration."""

from dataclasses import dataclass

import numpy as np

from eha_monitor.filters.results import Estimate
from eha_monitor.reports.drawing import (
    HEIGHT,
    INK,
    MEASURED,
    OTHER,
    STAGE_ONE,
    STAGE_TWO,
    Block,
    Picture,
    draw,
    legend_above,
    mark_window,
    new_figure,
    pad_limits,
    picture,
)
from eha_monitor.reports.quantities import quantity, readable, scale_of, time_scale
from eha_monitor.reports.traces import robust_peak, smoothed_derivative, telling_window


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


def compare(estimate: Estimate, window: Window, measured: Curve, estimated: list[Curve],
            name: str, unit: str, residual_unit: str) -> tuple[Picture, ...]:
    """Return two pictures, whole record and window, each with curves and their residuals.

    Parameters
    ----------
    measured : the reference; the residual is measured minus estimated.
    estimated : curves to compare; those without a finite value are left out.
    name : quantity on the axis, e.g. ``position``.
    unit : SI unit of the curves; residual_unit : SI unit of their difference.
    """
    time = estimate.recording.time
    curves = [curve for curve in [measured, *estimated] if curve.drawable]
    residuals = [Curve(f"− {curve.label}" if len(estimated) > 1 else "", measured.values
                       - curve.values, curve.colour, 1.1, "-")
                 for curve in estimated if measured.drawable and curve.drawable]
    residuals = [curve for curve in residuals if curve.drawable]
    shown = np.concatenate([curve.values for curve in curves]) if curves else np.empty(0)
    scale = scale_of(shown, unit)
    pictures = []
    for part, words in ((slice(None), "whole record"),
                        (slice(window.start, window.stop), window.words)):
        if part != slice(None) and window.stop - window.start >= len(time):
            continue
        clock = time_scale(estimate.recording.duration) if part == slice(None) else \
            time_scale(0)
        t = time[part] * clock.factor
        rows = 2 if residuals else 1
        figure, axes = new_figure(rows, (2.0, 1.0) if rows == 2 else None,
                                  HEIGHT + (60 if rows == 2 else -60))
        for curve in curves:
            draw(axes[0], t, curve.values[part] * scale.factor, color=curve.colour,
                 linewidth=curve.width, linestyle=curve.dashes, label=curve.label)
        axes[0].set_ylabel(f"{name}, {scale.unit}")
        legend_above(axes[0])
        if residuals:
            _draw_residuals(axes[1], t, [(c, c.values[part]) for c in residuals],
                            residual_unit)
        if part == slice(None):
            mark_window(axes[0], time[window.start], time[window.stop - 1])\
                if clock.unit == "s" else mark_window(
                    axes[0], time[window.start] * clock.factor,
                    time[window.stop - 1] * clock.factor)
        if len(t) > 1:
            axes[-1].set_xlim(t[0], t[-1])
        axes[-1].set_xlabel(f"time, {clock.unit} — {words}")
        pictures.append(picture(figure, f"{name} against time, {words}: "
                                + ", ".join(curve.label for curve in curves)))
    return tuple(pictures)


def _draw_residuals(axis, t, curves, unit) -> None:
    """Draw measured minus estimated about zero; say so where single peaks are cut off."""
    half, peak = robust_peak(np.concatenate([values for _, values in curves]))
    scale = readable(half or 1.0, unit)
    for curve, values in curves:
        draw(axis, t, values * scale.factor, color=curve.colour, linewidth=curve.width)
    axis.axhline(0, color=INK, linewidth=0.8)
    pad_limits(axis, -half * scale.factor, half * scale.factor)
    axis.set_ylabel(f"measured −\nestimated, {scale.unit}")
    if peak > 1.01 * half:
        axis.text(0.995, 0.97, f"peak {quantity(peak, unit, 2)} cut off",
                  transform=axis.transAxes, ha="right", va="top", fontsize=9,
                  bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5, "alpha": 0.85})


def _stage_curves(estimate: Estimate, attribute: str) -> list[Curve]:
    """Return the states of both stages that have data."""
    found = []
    for stage, label, colour, dashes in (
            (estimate.stage_one, "estimated, stage one", STAGE_ONE, "-"),
            (estimate.stage_two, "estimated, stage two", STAGE_TWO, "--")):
        values = getattr(stage, attribute)
        if len(values) == len(estimate.recording):
            curve = Curve(label, values, colour, 1.5, dashes)
            if curve.drawable:
                found.append(curve)
    return found


def pressure_block(estimate: Estimate, window: Window) -> Block:
    """Return the pressure difference, or the measured force where there is no pressure."""
    recording, rig = estimate.recording, estimate.settings.rig
    key, paper = "pressure", "the paper's Fig. 3 and 8"
    if recording.has("p1", "p2"):
        p1, p2 = recording.get("p1"), recording.get("p2")
        curve = Curve("p₁ − p₂, measured", p1 - p2, STAGE_ONE)
        others, notes = [], ()
        if rig.area_1 and rig.area_2 and abs(rig.area_2 / rig.area_1 - 1) > 1e-3:
            load = p1 - p2 * rig.area_2 / rig.area_1
            others = [Curve("load pressure p₁ − p₂·A₂/A₁", load, OTHER, 1.3, "--")]
            notes = ("The areas differ, so the load pressure is what moves the piston.",)
        if curve.drawable:
            return Block(key, "Pressure difference", paper, _plain(
                estimate, window, [curve, *others], "pressure difference", "Pa"), notes)
    if recording.has("force"):
        unit, word = ("N·m", "torque") if rig.motion == "rotary" else ("N", "force")
        curve = Curve(f"measured {word}", recording.get("force"), STAGE_ONE)
        return Block(key, f"Driving {word}", paper, _plain(
            estimate, window, [curve], word, unit),
            (f"No pressures were recorded; the measured {word} takes the place of A·Δp.",))
    return Block(key, "Pressure difference", paper, notes=(
        "No pair of pressures and no force was recorded, so there is nothing to show.",))


def _plain(estimate, window, curves, name, unit) -> tuple[Picture, ...]:
    """Pictures of curves that are compared with nothing."""
    return compare(estimate, window, curves[0], [], name, unit, unit) if len(curves) == 1 \
        else compare_all(estimate, window, curves, name, unit)


def compare_all(estimate, window, curves, name, unit) -> tuple[Picture, ...]:
    """Pictures of several curves without residuals."""
    nothing = Curve("", np.full(len(estimate.recording), np.nan), MEASURED)
    return compare(estimate, window, nothing, curves, name, unit, unit)


def position_block(estimate: Estimate, window: Window) -> Block:
    """Return position measured and estimated, with the demand where stage two has none."""
    unit = motion_unit(estimate, 0)
    word = "angle" if unit == "rad" else "position"
    measured = Curve(f"measured {word}", estimate.recording.get("x"), MEASURED, 4.0)
    estimated = _stage_curves(estimate, "position")
    title, paper = f"{word.capitalize()}", "the paper's Fig. 4, 9 and 12"
    if not measured.drawable and not estimated:
        return Block("position", title, paper,
                     notes=("No position was recorded and none was estimated.",))
    notes = () if estimated else ("No stage had data, so there is no estimate to compare.",)
    return Block("position", title, paper,
                 compare(estimate, window, measured, estimated, word, unit, unit), notes)


def derivative_block(estimate: Estimate, window: Window, order: int) -> Block:
    """Return velocity (order 1) or acceleration (order 2), measured and estimated."""
    name = ("velocity", "acceleration")[order - 1]
    key, title = name, name.capitalize()
    paper = ("the paper's Fig. 5, 10 and 13", "the paper's Fig. 14 and 19")[order - 1]
    recording, unit = estimate.recording, motion_unit(estimate, order)
    notes: tuple[str, ...] = ()
    if order == 1 and recording.has("v"):
        measured = Curve("measured velocity", recording.get("v"), MEASURED, 4.0)
    else:
        values, length = smoothed_derivative(recording.get("x"), recording.sample_time, order)
        which = ("derivative", "second derivative")[order - 1]
        measured = Curve(f"{which} of the measured position, smoothed over "
                         f"{quantity(length, 's', 2)}", values, MEASURED, 4.0)
        if measured.drawable:
            notes = (f"The {name} was not measured: the grey line is the numerical {which} of "
                     "the position. Smoothing rounds its corners, so residuals at sharp "
                     "reversals are partly its own.",)
    estimated = _stage_curves(estimate, name)
    if not measured.drawable and not estimated:
        return Block(key, title, paper, notes=(
            f"No {name} was measured or estimated, and there is too little position to "
            "differentiate.",))
    if not estimated:
        notes += (f"No stage had data to estimate the {name}.",)
    return Block(key, title, paper,
                 compare(estimate, window, measured, estimated, name, unit, unit), notes)


def motion_blocks(estimate: Estimate) -> list[Block]:
    """Return pressure difference, position, velocity and acceleration, in that order."""
    window = find_window(estimate)
    return [pressure_block(estimate, window), position_block(estimate, window),
            derivative_block(estimate, window, 1), derivative_block(estimate, window, 2)]
