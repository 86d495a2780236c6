"""Pictures of a diagnosis: the missing term, both fits on unseen data, parameters by part."""

import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eha_monitor.mismatch.diagnosis import (
    Agreement,
    Curve,
    Diagnosis,
    LearnedTerm,
    Overlay,
    Value,
)
from eha_monitor.quantity import SYMBOLS
from eha_monitor.reports.axes import axis_scale, scale_of, stated, time_scale
from eha_monitor.reports.drawing import (
    INK,
    STAGE_ONE,
    STAGE_TWO,
    Picture,
    draw,
    new_figure,
    pad_limits,
    picture,
)
from eha_monitor.reports.parameter_figures import NAMES
from eha_monitor.reports.traces import robust_range
from eha_monitor.words import effect_words, listed

# What is measured is dark grey, the model before orange, the model after blue.
SEEN, BEFORE, AFTER = "#5b6873", STAGE_TWO, STAGE_ONE
LARGE, SMALL = (520, 380), (380, 290)  # CSS pixels; three small ones side by side at 1280
_PIXELS_PER_INCH = 96
MISSING = {"force": "missing force", "flow": "missing flow", "drive": "missing drive speed",
           "sensor": "sensor error"}
_SYMBOL_OF = {"velocity": "velocity v", "position": "position x", "omega": "pump speed ω",
              "pump_speed": "pump speed ω", "pressure_difference": "pressure difference Δp",
              "time": "time", "x": "position x", "v": "velocity v",
              "dp": "pressure difference Δp", "p": "mean pressure p", "p1": "pressure p₁",
              "p2": "pressure p₂", "angle": "angle of the shaft θ"}
FACTORS = {"dp": "Δp", "v": "v", "omega": "ω"}
# In steady motion pump and piston go together; a force hangs on the piston.
_INDIRECT, _STAND_IN = ("force", "pump_speed"), 0.5
_MOST_BARS = 70  # points with a bar each; more get a band


def axis_words(name: str) -> str:
    """Return what a curve is drawn against, as words."""
    return _SYMBOL_OF.get(name.replace(" ", "_"), name.replace("_", " "))


def telling(found: Diagnosis) -> list[Curve]:
    """Return the curves that have something to draw, the most telling one first.

    A curve tells much where its quantity decides the missing term: what it varies by is then
    large against the spread at each place.  The balance that is blamed goes first; time goes last,
    for it decides nothing by itself, unless what is named comes and goes.
    """
    timed = bool(found.effects and found.effects[0].intervals_s)
    blamed = found.effects[0].balance if found.effects else max(
        found.location.balance, key=found.location.balance.get, default="")
    drawable = [curve for curve in found.curves
                if np.isfinite(curve.measured * curve.x).sum() >= 2]
    return sorted(drawable, key=lambda curve: (
        curve.balance != blamed, (curve.against == "time") != timed,
        -_contrast(curve) * (_STAND_IN if (curve.balance, curve.against) == _INDIRECT else 1.0)))


def _contrast(curve: Curve) -> float:
    """Return how much of the curve is a function of its quantity: variance over spread²."""
    known = np.isfinite(curve.measured) & np.isfinite(curve.x)
    measured = curve.measured[known]
    spread = curve.spread[known]
    varies = float(np.var(measured))
    spread = spread[np.isfinite(spread)]
    return varies / max(float(np.mean(spread**2)) if spread.size else varies, 1e-4 * varies,
                        1e-300)


def curve_picture(found: Diagnosis, curve: Curve, large: bool = False) -> Picture:
    """Return :func:`curve_figure` as a picture of a page."""
    return picture(*curve_figure(found, curve, large))


def curve_figure(found: Diagnosis, curve: Curve, large: bool = False
                 ) -> tuple[Figure, str, float | None]:
    """Draw the missing term against one quantity: dots measured, a line modelled."""
    figure, (axis,) = _figure(LARGE if large else SMALL)
    order = np.argsort(curve.x)
    x, measured, spread, modelled = (values[order] for values in (
        curve.x, curve.measured, curve.spread, curve.modelled))
    across = scale_of(x, curve.against_unit)
    named = listed([effect_words(effect.name) for effect in found.effects
                    if effect.balance == curve.balance]
                   + ["the learned term" for term in found.learned
                      if term.balance == curve.balance])
    with_line = bool(named) and bool(np.isfinite(modelled).any())
    spread = np.where(np.isfinite(spread), spread, 0.0)
    drawn = [measured, measured - spread, measured + spread, *([modelled] if with_line else [])]
    low, high, _ = robust_range(drawn)
    scale = axis_scale(max(abs(low), abs(high)), curve.unit)
    x, measured, spread, modelled = (x * across.factor, measured * scale.factor,
                                     spread * scale.factor, modelled * scale.factor)
    axis.axhline(0.0, color=INK, linewidth=0.8)
    label, width = "measured, with its spread", 2.2
    if curve.against == "time":  # it hops to and fro: lines, the model's thin on top
        axis.plot(x, measured, color=SEEN, alpha=0.5, linewidth=3.0, label="measured")
        width = 0.9
    elif len(x) > _MOST_BARS:
        axis.fill_between(x, measured - spread, measured + spread, color=SEEN, alpha=0.22,
                          linewidth=0)
        axis.plot(x, measured, linestyle="", marker="o", markersize=2.6, color=SEEN, label=label)
    else:
        axis.errorbar(x, measured, spread, linestyle="", marker="o", color=SEEN, label=label,
                      markersize=4.5 if large else 3.4, elinewidth=0.9, ecolor="#b4bcc4")
    if with_line:
        axis.plot(x, modelled, color=AFTER, linewidth=width, label=f"modelled: {named}")
    _legend(axis, large)
    pad_limits(axis, low * scale.factor, high * scale.factor)
    axis.margins(x=0.02)
    axis.set_xlabel(f"{axis_words(curve.against)}{_bracket(across.unit)}")
    axis.set_ylabel(f"{MISSING.get(curve.balance, curve.balance)}{_bracket(scale.unit)}")
    return figure, (f"{MISSING.get(curve.balance, curve.balance)} against "
                    f"{curve.against.replace('_', ' ')}: measured"
                    f"{' and modelled' if with_line else ''}"), (
                        across.factor if curve.against == "time" else None)


def learned_picture(term: LearnedTerm) -> Picture:
    """Return :func:`learned_figure` as a picture of a page."""
    return picture(*learned_figure(term))


def learned_figure(term: LearnedTerm) -> tuple[Figure, str]:
    """Draw a learned curve with its band, what was measured of it, and its best formula."""
    figure, (axis,) = _figure(LARGE)
    shown = [term.curve, *([term.formula_curve] if np.isfinite(term.formula_curve).all() else [])]
    low, high, _ = robust_range([*shown, term.measured])
    scale, across = axis_scale(max(abs(low), abs(high)), term.unit), scale_of(
        term.x, term.against_unit)
    x, curve, band = term.x * across.factor, term.curve * scale.factor, term.band * scale.factor
    axis.axhline(0.0, color=INK, linewidth=0.8)
    axis.errorbar(term.at * across.factor, term.measured * scale.factor,
                  term.spread * scale.factor, linestyle="", marker="o", color=SEEN,
                  markersize=4.5, elinewidth=0.9, ecolor="#b4bcc4",
                  label="measured, with its spread")
    axis.fill_between(x, curve - 2.0 * band, curve + 2.0 * band, color=AFTER, alpha=0.25,
                      linewidth=0, label="learned, ± 2 standard deviations")
    axis.plot(x, curve, color=AFTER, linewidth=2.2, label="learned")
    if len(shown) > 1:
        axis.plot(x, term.formula_curve * scale.factor, color=BEFORE, linewidth=1.6,
                  linestyle="--", label="formula" if term.formula else "best formula, worse")
    _legend(axis, True)
    pad_limits(axis, low * scale.factor, high * scale.factor)
    axis.margins(x=0.02)
    name = axis_words(term.of[0])
    axis.set_xlabel(f"{name}{_bracket(across.unit)}")
    axis.set_ylabel(f"{learned_words(term)}{_bracket(scale.unit)}")
    return figure, (f"{learned_words(term)} against {name}: measured, learned, and the "
                    "formula")


def learned_words(term: LearnedTerm) -> str:
    """Return what a learned curve is, as a label of an axis."""
    what = MISSING.get(term.balance, term.balance)
    if len(term.of) == 1:
        return what
    if term.unit in ("N", "m³/s", "rad/s"):
        return f"{what} against motion"
    return f"{what} for each unit of {FACTORS[term.of[1]]}"


def overlay_picture(overlay: Overlay, with_after: bool = True,
                    names: tuple[str, str] = ("model before", "model after")) -> Picture | None:
    """Return :func:`overlay_figure` as a picture of a page."""
    made = overlay_figure(overlay, with_after, names)
    return None if made is None else picture(*made)


def overlay_figure(overlay: Overlay, with_after: bool = True,
                   names: tuple[str, str] = ("model before", "model after")
                   ) -> tuple[Figure, str, float, str] | None:
    """Draw a signal with both models running free, and below what remains of it."""
    known = np.isfinite(overlay.measured) & np.isfinite(overlay.time)
    if known.sum() < 2:
        return None
    start, stop = (float(overlay.time[known][place]) for place in (0, -1))
    clock = time_scale(stop - start)
    # A time of day tells nobody where in the recording it is; seconds since its start do.
    t = overlay.time * (clock.factor if clock.unit != "ms" else 1.0)
    unit = clock.unit if clock.unit != "ms" else "s"
    models = [(names[0] if with_after else "model", overlay.before, BEFORE)]
    models += [(names[1], overlay.after, AFTER)] if with_after else []
    figure, (top, bottom) = _figure((LARGE[0], LARGE[1] + 40), rows=2, ratios=(1.0, 1.0))
    scale = scale_of(overlay.measured, overlay.unit)
    draw(top, t, overlay.measured * scale.factor, color=SEEN, linewidth=3.2, label="measured",
         alpha=0.55)
    errors = [overlay.measured - values for _, values, _ in models]
    low, high, _ = robust_range(errors)
    error_scale = axis_scale(max(abs(low), abs(high)), overlay.unit)
    for (name, values, colour), error in zip(models, errors, strict=True):
        dashes = "--" if with_after and values is overlay.before else "-"
        draw(top, t, values * scale.factor, color=colour, linewidth=1.3, linestyle=dashes,
             label=name)
        draw(bottom, t, error * error_scale.factor, color=colour, linewidth=1.1,
             linestyle=dashes)
    _legend(top, True)
    low, high, _ = robust_range([overlay.measured, *(values for _, values, _ in models)])
    pad_limits(top, low * scale.factor, high * scale.factor)
    low, high, _ = robust_range(errors)
    pad_limits(bottom, low * error_scale.factor, high * error_scale.factor)
    words = overlay.signal.replace("_", " ")
    top.set_ylabel(f"{words}{_bracket(scale.unit)}")
    bottom.set_ylabel(f"measured − model{_bracket(error_scale.unit)}")
    bottom.axhline(0.0, color=INK, linewidth=0.8, zorder=1)
    bottom.set_xlabel(f"time, {unit}")
    return (figure, f"{words}: measured and simulated by both models, and their errors",
            clock.factor if clock.unit != "ms" else 1.0, f"{start:.4g} to {stop:.4g} s")


def agreement_picture(name: str, parts: tuple[Agreement, ...], before: Value | None,
                      after: Value | None) -> Picture | None:
    """Return :func:`agreement_figure` as a picture of a page."""
    made = agreement_figure(name, parts, before, after)
    return None if made is None else picture(*made)


def agreement_figure(name: str, parts: tuple[Agreement, ...], before: Value | None,
                     after: Value | None) -> tuple[Figure, str] | None:
    """Draw one parameter as each part of the record gives it, with error bars of one sigma."""
    rows = [(part.part.replace("_", " "), part.before.get(name), part.after.get(name))
            for part in parts] + [("whole record", before, after)]
    rows = [row for row in rows if _drawable(row[1]) or _drawable(row[2])]
    if len(rows) < 2:
        return None
    figure, (axis,) = _figure((LARGE[0], 110 + 44 * len(rows)))
    known = [value for _, *pair in rows for value in pair if _drawable(value)]
    ends = [end for value in known for end in (value.value, *_ends(value, known))]
    scale = axis_scale(max(map(abs, ends)), known[0].unit)
    for place, (_, *pair) in enumerate(reversed(rows)):
        for value, colour, shift, label, marker in ((pair[0], BEFORE, 0.14, "before", "s"),
                                                    (pair[1], AFTER, -0.14, "after", "o")):
            if not _drawable(value):
                continue
            low, high = _ends(value, known)
            axis.errorbar(value.value * scale.factor, place + shift, color=colour, marker=marker,
                          xerr=[[(value.value - low) * scale.factor],
                                [(high - value.value) * scale.factor]], markersize=6,
                          linewidth=2, capsize=4, linestyle="",
                          label=f"{label}, ± 1σ")
    if _drawable(after):
        axis.axvline(after.value * scale.factor, color=AFTER, linewidth=1.0, zorder=0,
                     linestyle=(0, (4, 3)))
    axis.set_yticks(range(len(rows)), [row[0] for row in reversed(rows)])
    axis.yaxis.set_major_formatter(_fixed([row[0] for row in reversed(rows)]))
    axis.set_ylim(-0.6, len(rows) - 0.4)
    low, high = min(ends) * scale.factor, max(ends) * scale.factor
    margin = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    axis.set_xlim(low - margin, high + margin)
    axis.set_xlabel(f"{NAMES.get(name, name)} {SYMBOLS.get(name, name)}{_bracket(scale.unit)}")
    _legend(axis, True)
    return figure, (f"{NAMES.get(name, name)} from each part of the record, before and after "
                    "modelling")


def _drawable(value: Value | None) -> bool:
    return value is not None and np.isfinite(value.value)


def _ends(value: Value, all_of_them: list[Value]) -> tuple[float, float]:
    """Return the ends of an error bar, cut where it would squeeze all others flat."""
    centres = [other.value for other in all_of_them]
    reach = max(1.5 * (max(centres) - min(centres)), 0.2 * max(map(abs, centres)))
    half = float(stated(value.value, value.stddev)) if value.stddev > 0 else 0.0
    return value.value - min(half, reach), value.value + min(half, reach)


def _fixed(labels: list[str]):
    from matplotlib.ticker import FixedFormatter

    return FixedFormatter(labels)


def _figure(size: tuple[int, int], rows: int = 1, ratios: tuple[float, ...] | None = None):
    figure, axes = new_figure(rows, ratios, size[1])
    figure.set_size_inches(size[0] / _PIXELS_PER_INCH, size[1] / _PIXELS_PER_INCH)
    return figure, axes


def _legend(axis: Axes, large: bool) -> None:
    """Put the legend above the axes, one entry below the other where the picture is narrow."""
    handles, labels = axis.get_legend_handles_labels()
    named = dict(zip(labels, handles, strict=True))  # each label once
    labels, handles = list(named), list(named.values())
    if not labels:
        return
    # matplotlib puts what has error bars last; what is measured comes first here.
    order = sorted(range(len(labels)), key=lambda i: not labels[i].startswith("measured"))
    handles, labels = [handles[i] for i in order], [labels[i] for i in order]
    letters = sum(map(len, labels))
    axis.legend(handles, [textwrap.fill(label, 56 if large else 40) for label in labels],
                ncols=len(labels) if large and letters < 50 else 1, loc="lower left",
                bbox_to_anchor=(-0.01, 1.0), borderaxespad=0.1, handlelength=1.6,
                columnspacing=1.4, labelspacing=0.25, frameon=False, fontsize=9.5)


def _bracket(unit: str) -> str:
    return "" if unit in ("", "1") else f", {unit}"

