"""A health number of many recordings against the date: limits, steps, line, time to the limit."""

from datetime import UTC, datetime

import matplotlib.dates
import numpy as np

from eha_monitor.archive.history import LEAST, MONTH, History
from eha_monitor.indicators.indicator import WORDS, limits_of_indicator
from eha_monitor.quantity import SYMBOLS, number, quantity, with_uncertainty
from eha_monitor.reports.axes import axis_scale, stated
from eha_monitor.reports.drawing import (
    INK,
    STAGE_ONE,
    STAGE_TWO,
    Block,
    Picture,
    legend_above,
    new_figure,
    pad_limits,
    picture,
)
from eha_monitor.reports.outlook import draw_outlook, horizon, outlook_words
from eha_monitor.reports.parameter_figures import (
    NAMES,
    draw_limits,
    is_near,
    limits_of,
)
from eha_monitor.settings.monitor import Settings

_DAY = 86400.0  # s
_ENLARGED = 0.4  # share of the picture with the limits below which the values get one of their own
WHOLE = "with the limits"
INDICATOR = "#007A5A"
_SOON = 60.0  # s that a picture of a single recording spans


def history_block(found: History, settings: Settings) -> Block:
    """Return the picture of one parameter over time, with what it says in sentences."""
    title = title_of(found.name)
    if found.at_reference:
        title += f" at {settings.viscosity.reference_temperature:g} °C"
    if not len(found.time):
        reason = ("the stamps of the recordings are not calendar times" if found.undated
                  else "no recording gives a value")
        return Block(f"history-{found.name}", title, notes=(f"No picture: {reason}.",))
    lines = lines_of(found.name, settings)
    low, high = _range(found, everything=True)
    near = [limit for limit, _ in lines if is_near(limit, low, high)]
    view = (min([low, *near]), max([high, *near]))
    notes = [*filter(None, (trend_words(found), outlook_words(found)))]
    pictures = [_picture(found, view, lines, WHOLE)]
    close = _range(found, everything=False)
    if close[1] - close[0] < _ENLARGED * (view[1] - view[0]):
        pictures.append(_picture(found, close, lines, "enlarged"))
    far = [f"{words} {quantity(limit, found.unit)}" for limit, words in lines
           if limit not in near]
    if far:
        notes.append(f"Outside the plot: {', '.join(far)}.")
    if found.undated:
        notes.append(f"{found.undated} more with stamps that are not calendar times: not shown.")
    return Block(f"history-{found.name}", title, pictures=tuple(pictures),
                 notes=tuple(notes))


def title_of(name: str) -> str:
    """Return the heading of a parameter or an indicator."""
    return (f"{NAMES[name].capitalize()} {SYMBOLS[name]}" if name in NAMES and name != "L"
            else WORDS[name][0].upper() + WORDS[name][1:])


def lines_of(name: str, settings: Settings) -> list[tuple[float, str]]:
    """Return the limits to draw, each with its words."""
    sections = {"B": settings.thresholds.viscous_damping,
                "beta_e": settings.thresholds.bulk_modulus}
    if name in sections:
        return limits_of(sections[name])
    low, high = limits_of_indicator(name, settings)
    return [(limit, words) for limit, words in ((low, "limit, below"), (high, "limit, above"))
            if limit is not None]


def trend_words(found: History) -> str:
    """Return what the line says, in one or two sentences."""
    line = found.line
    if line is None:
        name = SYMBOLS.get(found.name) or WORDS[found.name]
        lately = int((found.usable & (found.time >= found.since)).sum())
        return (f"No trend of {name}: it needs {LEAST} values at different times that converged, "
                f"{lately} there{' since the last step' if found.outlook.jumps else ''}.")
    slope, spread = MONTH * line.slope, MONTH * line.slope_stddev
    words = (f"Trend of {SYMBOLS.get(found.name) or WORDS[found.name]}: "
             f"{'+' if slope > 0 else ''}{with_uncertainty(slope, spread, found.unit)} per 30 "
             f"days, through {line.count} recordings")
    if line.level:
        words += (f" ({'+' if slope > 0 else ''}{number(100 * slope / abs(line.level), 2)} % "
                  "per 30 days)")
    words += "." if abs(slope) > 2 * spread else ": not significant."
    if line.scatter > 0:
        words += (f" They scatter by {quantity(line.scatter, found.unit, 2)} more than their own "
                  "uncertainty, which is included in that of the slope.")
    if found.doubtful:
        words += (" Fewer than three are from a model that fits: the line goes through values of "
                  "a model that does not fit and shows changes only.")
    return words


def _range(found: History, everything: bool) -> tuple[float, float]:
    """Return the range of the values that the line goes through, with the others that are near."""
    good = found.usable if found.usable.any() else np.ones(len(found.time), dtype=bool)
    spread = 2 * stated(found.value[good], np.nan_to_num(found.stddev[good], posinf=0.0))
    # A bar may be longer than all that there is to see.
    spread = np.minimum(spread, 2 * np.median(spread) + np.ptp(found.value[good]))
    low, high = np.min(found.value[good] - spread), np.max(found.value[good] + spread)
    if not everything:
        return float(low), float(high)
    others = found.value[~good]
    reach = 1.5 * max(high - low, 0.2 * max(abs(low), abs(high)))
    near = others[(others > low - reach) & (others < high + reach)]
    return (float(np.min(near, initial=low)), float(np.max(near, initial=high)))


def _picture(found: History, view: tuple[float, float], lines: list[tuple[float, str]],
             which: str) -> Picture:
    """Draw the values, their bars and the line, with the limits that fall into ``view``."""
    colour = {"B": STAGE_ONE, "beta_e": STAGE_TWO}.get(found.name, INDICATOR)
    scale = axis_scale(max(map(abs, view)), found.unit)
    days, value = found.time / _DAY, found.value * scale.factor
    spread = stated(found.value, np.nan_to_num(found.stddev, posinf=0.0)) * scale.factor
    figure, (axis,) = new_figure()
    pad_limits(axis, view[0] * scale.factor, view[1] * scale.factor, 0.12)
    bottom, top = axis.get_ylim()
    last = horizon(found) / _DAY if which == WHOLE else days[-1]
    margin = 0.04 * (last - days[0]) or _SOON / _DAY
    axis.set_xlim(days[0] - margin, last + margin)
    if found.line is not None:
        _draw_line(axis, found, scale.factor)
    for chosen, face, words in ((found.reliable, colour, "value ± 1σ"),
                                (~found.reliable, "white", "in doubt ± 1σ")):
        here = chosen & (value > bottom) & (value < top)
        if here.any():
            axis.errorbar(days[here], value[here], np.minimum(spread[here], 9 * (top - bottom)),
                          linestyle="", marker="o", markersize=5.5, color=colour,
                          markerfacecolor=face, markeredgewidth=1.2, elinewidth=1.0,
                          label=words)
    for outside, place, marker in ((value >= top, 0.985, "^"), (value <= bottom, 0.015, "v")):
        if outside.any():
            axis.plot(days[outside], np.full(outside.sum(), bottom + place * (top - bottom)),
                      linestyle="", marker=marker, markersize=7, color=colour,
                      markerfacecolor="white", clip_on=False,
                      label=f"outside the plot ({int(outside.sum())})")
    draw_limits(axis, value, lines, scale.factor, found.unit)
    draw_outlook(axis, found, scale.factor)
    axis.set_ylim(bottom, top)
    locator = matplotlib.dates.AutoDateLocator(minticks=3, maxticks=7)
    axis.xaxis.set_major_locator(locator)
    axis.xaxis.set_major_formatter(matplotlib.dates.ConciseDateFormatter(
        locator, show_offset=False, formats=["%Y", "%b", "%d %b", "%H:%M", "%H:%M", "%H:%M:%S"],
        zero_formats=["", "%Y", "%d %b", "%d %b", "%H:%M", "%H:%M"]))
    first, last = (datetime.fromtimestamp(at, tz=UTC).strftime("%Y-%m-%d")
                   for at in (found.time[0], found.time[-1]))
    dates = f"{first} to {last}" if first != last else first
    axis.set_xlabel(f"{dates}, UTC — {which}", color=INK)
    axis.set_ylabel(f"{SYMBOLS.get(found.name) or WORDS[found.name]}, {scale.unit}")
    legend_above(axis)
    return picture(figure, f"{title_of(found.name)} of {len(value)} recordings against the "
                           f"date, {which}; {trend_words(found)} {outlook_words(found)}".rstrip())


def _draw_line(axis, found: History, factor: float) -> None:
    used = found.time[found.usable & (found.time >= found.since)]
    time = np.linspace(used[0], used[-1], 60)
    line, stddev = found.line.at(time)
    axis.fill_between(time / _DAY, (line - stddev) * factor, (line + stddev) * factor,
                      color=INK, alpha=0.13, linewidth=0)
    axis.plot(time / _DAY, line * factor, color=INK, linewidth=1.4,
              linestyle=(0, (5, 3)) if found.doubtful else "-", label="trend ± 1σ")
