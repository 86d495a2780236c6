"""B and beta_e as they converge, with their band and the alarm limits."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eha_monitor.estimation.results import Estimate, StageResult
from eha_monitor.quantity import SYMBOLS, quantity
from eha_monitor.reports.axes import axis_scale, stated, time_scale
from eha_monitor.reports.drawing import (
    ERROR_LINE,
    HEIGHT,
    INK,
    STAGE_ONE,
    STAGE_TWO,
    WARN_LINE,
    Block,
    arranged,
    draw,
    legend_above,
    new_figure,
    pad_limits,
    picture,
)
from eha_monitor.reports.traces import band_envelope
from eha_monitor.settings.monitor import Limits

NAMES = {"B": "viscous damping", "beta_e": "effective bulk modulus", "L": "leakage"}
_LIMITS = (("low_error", "ERROR below"), ("low_warn", "WARN below"),
           ("high_warn", "WARN above"), ("high_error", "ERROR above"))


def parameter_block(estimate: Estimate, name: str) -> Block:
    """Return the convergence of ``B`` or ``beta_e``: all of it with the limits, and its end."""
    stage, limits, colour = _stage_of(estimate, name)
    key, title = f"parameter-{name}", f"{NAMES[name].capitalize()} {SYMBOLS[name]}"
    value = stage.value
    if not len(value) or not np.isfinite(value).any():
        reason = stage.estimate.message or "the stage had no data"
        return Block(key, title, notes=(f"No curve: {reason}",))
    unit = stage.estimate.unit
    notes = []
    lines = limits_of(limits)
    low, high = core_range(stage, 0.4)
    near = [limit for limit, _ in lines if is_near(limit, low, high)]
    far = [f"{words} {quantity(limit, unit)}" for limit, words in lines if limit not in near]
    if far:
        notes.append(f"Outside the plot: {', '.join(far)}.")
    view = (min([low, *near]), max([high, *near]))
    margin = 0.08 * (view[1] - view[0])
    early = value[np.isfinite(value)]
    if early.min() < view[0] - margin or early.max() > view[1] + margin:
        notes.append("The start of the curve, from the prior, is outside the plot.")
    begin = _settled(stage)
    pictures = [_picture(stage, name, slice(None), view, lines, colour, "whole record")]
    if stage.estimate.status == "converged" and 0 < begin < len(value) - 10:
        tail = core_range(stage, begin / len(value))
        pictures.append(_picture(stage, name, slice(begin, None), tail, lines, colour,
                                 "after convergence, enlarged"))
    if name == "B" and estimate.recording.has("temperature"):
        notes.append("A temperature was recorded: the limits apply at "
                     "{estimate.settings.viscosity.reference_temperature:g} °C, to which B is "
                     "converted by the viscosity law before it is compared; the curve shows B as "
                     "estimated.")
    return Block(key, title, tuple(pictures), tuple(notes))


def parameter_figure(estimate: Estimate, names: Sequence[str]) -> Figure | None:
    """Draw ``B``, ``beta_e`` or both over the whole record; None where neither has a curve."""
    shown = [name for name in names
             if np.isfinite(_stage_of(estimate, name)[0].value).any()]
    if not shown:
        return None
    figure, axes = new_figure(len(shown), height=HEIGHT - 100 if len(shown) == 1 else 560)
    for axis, name in zip(axes, shown, strict=True):
        stage, limits, colour = _stage_of(estimate, name)
        lines, (low, high) = limits_of(limits), core_range(stage, 0.4)
        near = [limit for limit, _ in lines if is_near(limit, low, high)]
        draw_parameter(axis, stage, name, slice(None), (min([low, *near]), max([high, *near])),
                       lines, colour, "whole record" if name == shown[-1] else "")
    return arranged(figure)


def _stage_of(estimate: Estimate, name: str) -> tuple[StageResult, Limits, str]:
    """Return the stage, the limits and the colour of ``B`` or ``beta_e``."""
    return {
        "B": (estimate.stage_one, estimate.settings.thresholds.viscous_damping, STAGE_ONE),
        "beta_e": (estimate.stage_two, estimate.settings.thresholds.bulk_modulus, STAGE_TWO)}[name]


def core_range(stage: StageResult, from_share: float) -> tuple[float, float]:
    """Return the range of the curve and its band behind a share of the record, SI.

    Percentiles and medians keep single jumps from hiding the rest.
    """
    start = int(from_share * len(stage.value))
    value, stddev = stage.value[start:], stage.stddev[start:]
    if not np.isfinite(value).any():
        value, stddev = stage.value, stage.stddev
    finite = np.isfinite(value)
    value = value[finite]
    spread = 2 * stated(value, np.nan_to_num(stddev[finite], nan=0.0, posinf=0.0))
    half = len(value) // 2
    low, high = np.percentile(value, (0.5, 99.5))
    late, wide = value[half:], spread[half:]
    return (float(min(low, np.median(late - 1.5 * wide))),
            float(max(high, np.median(late + 1.5 * wide))))


def is_near(limit: float, low: float, high: float) -> bool:
    """Whether a limit can share the picture without squeezing the curve flat."""
    size = max(abs(low), abs(high), 3 * (high - low))
    return low - 2.5 * size <= limit <= high + 2.5 * size


def _settled(stage: StageResult) -> int:
    """Return the sample from which the curve is worth enlarging."""
    finite = np.flatnonzero(np.isfinite(stage.value))
    last = finite[len(finite) // 2:]
    centre, width = np.median(stage.value[last]), np.ptp(np.percentile(
        stage.value[last], (1, 99)))
    width = max(4 * width, 8 * float(np.nanmedian(stage.stddev[last])), 1e-9 * abs(centre))
    outside = finite[np.abs(stage.value[finite] - centre) > width]
    first = outside[-1] + 1 if len(outside) else finite[0]
    return int(min(max(first, finite[0] + len(finite) // 10), last[0]))


def _picture(stage: StageResult, name: str, part: slice, view: tuple[float, float],
             lines: list[tuple[float, str]], colour: str, words: str):
    """Return :func:`draw_parameter` as a picture of a page."""
    figure, (axis,) = new_figure()
    draw_parameter(axis, stage, name, part, view, lines, colour, words)
    last = stage.value[np.isfinite(stage.value)][-1]
    clock = time_scale(float(stage.time[-1] - stage.time[0]))
    return picture(figure, f"{NAMES[name]} against time with its one-sigma band and limits, "
                           f"{words}; last value {quantity(last, stage.estimate.unit)}",
                   clock.factor, "" if part.start else "record")


def draw_parameter(axis: Axes, stage: StageResult, name: str, part: slice,
                   view: tuple[float, float], lines: list[tuple[float, str]], colour: str,
                   words: str) -> None:
    """Draw the curve, its band and the limits that fall into ``view``.

    Parameters
    ----------
    part : of the record; ``words`` say which, "" without a label of the time.
    view : least and largest value that are to be seen, SI.
    lines : limit, SI, and its words.
    """
    whole = stage.time
    clock = time_scale(float(whole[-1] - whole[0]))
    scale = axis_scale(max(map(abs, view)), stage.estimate.unit)
    t, value = whole[part] * clock.factor, stage.value[part] * scale.factor
    spread = stated(stage.value[part], stage.stddev[part]) * scale.factor
    pad_limits(axis, view[0] * scale.factor, view[1] * scale.factor, 0.12)
    bottom, top = axis.get_ylim()
    band_t, lower, upper = band_envelope(
        t, np.clip(value - spread, bottom - 9 * (top - bottom), None),
        np.clip(value + spread, None, top + 9 * (top - bottom)))
    if len(band_t):
        thin = 2 * np.nanmedian(spread) < 0.006 * (top - bottom)
        axis.fill_between(band_t, lower, upper, color=colour, alpha=0.22, linewidth=0,
                          label="± 1σ (mostly thinner than the line)" if thin else "± 1σ")
    draw(axis, t, value, color=colour, linewidth=1.8, label=f"{SYMBOLS[name]} estimated")
    draw_limits(axis, value, lines, scale.factor, stage.estimate.unit)
    if len(t) > 1 and t[-1] > t[0]:
        axis.set_xlim(t[0], t[-1])
    if words:
        axis.set_xlabel(f"time, {clock.unit} — {words}", color=INK)
    axis.set_ylabel(f"{SYMBOLS[name]}, {scale.unit}")
    legend_above(axis)


def draw_limits(axis: Axes, value: np.ndarray, lines: list[tuple[float, str]], factor: float,
                unit: str) -> None:
    """Draw the limits that fall into the picture, each with its name where ``value`` leaves room.

    Parameters
    ----------
    value : (n,) what is drawn, in the unit of the axis, in order of time.
    lines : limit, SI, and its words.
    factor, unit : of the axis, and the SI unit of the limits.
    """
    bottom, top = axis.get_ylim()
    taken: list[float] = []  # heights of labels, share of the picture
    for limit, label in lines:
        place = limit * factor
        if not bottom < place < top:
            continue
        line = WARN_LINE if label.startswith("WARN") else ERROR_LINE
        axis.axhline(place, color=line, linewidth=1.3,
                     linestyle=":" if line == ERROR_LINE else "--")
        # Labels stand apart where a WARN and an ERROR limit lie close together.
        above = label in ("WARN below", "ERROR above", "limit, above")
        height = (place - bottom) / (top - bottom) + (0.025 if above else -0.025)
        if any(abs(height - other) < 0.045 for other in taken):
            continue
        taken.append(height)
        left = not _clear(value, place, top - bottom, -1) and _clear(value, place, top - bottom, 1)
        axis.annotate(f"{label} {quantity(limit, unit)}",
                      (0.0 if left else 1.0, place),
                      xycoords=("axes fraction", "data"),
                      xytext=(3 if left else -3, 3 if above else -3),
                      textcoords="offset points", ha="left" if left else "right",
                      va="bottom" if above else "top", fontsize=9,
                      color=line, bbox={"facecolor": "white", "edgecolor": "none",
                                        "pad": 0.8, "alpha": 0.75})


def _clear(value: np.ndarray, place: float, height: float, end: int) -> bool:
    """Whether the curve leaves room for a label at a limit, at the start (1) or the end (-1)."""
    part = value[::end][: len(value) * 2 // 5]
    part = part[np.isfinite(part)]
    return not (np.abs(part - place) < 0.07 * height).mean() > 0.02 if part.size else True


def limits_of(limits: Limits) -> list[tuple[float, str]]:
    """Return the limits that there are, SI, each with its words."""
    return [(getattr(limits, which), words) for which, words in _LIMITS
            if getattr(limits, which) is not None]


def limits_in_words(limits: Limits, unit: str) -> str:
    """Return the limits of a parameter as one phrase."""
    words = [f"{words} {quantity(limit, unit)}" for limit, words in limits_of(limits)]
    return ", ".join(words) or "no limits configured"
