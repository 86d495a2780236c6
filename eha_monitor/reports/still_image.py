"""A described figure drawn by matplotlib: the image of a printed page, and the API's ``plot()``.

Only matplotlib's object interface is used: pyplot costs import time and keeps global state.
"""

import base64
import io
import textwrap

import matplotlib
import matplotlib.dates
import matplotlib.figure
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.ticker import MaxNLocator, NullLocator, ScalarFormatter
from PIL import Image

from eha_monitor.reports import figure as fig

_DAYS = 1.0 / 86400.0  # of a second; matplotlib counts dates in them
_PIXELS_PER_INCH = 96
_POINT = 72 / _PIXELS_PER_INCH  # points of a CSS pixel
_COLOURS = 128  # of an image
_LETTER = 7.0  # mean width of a letter of the legend, pixels
_DIGIT = 8.1  # width of a digit of a tick label, pixels
_STEPS = [1, 2, 2.5, 5, 10]  # between ticks
_DASHES = {"solid": "-", "dash": (0, (4, 3)), "dot": ":"}
_MARKERS = {"": "", "circle": "o", "square": "s", "x": "X", "diamond": "D", "triangle-up": "^",
            "triangle-down": "v"}
_STYLE = {
    "font.family": ["DejaVu Sans"], "font.size": 10, "text.usetex": False,
    "axes.edgecolor": "#98a2ab", "axes.labelcolor": fig.INK, "text.color": fig.INK,
    "xtick.color": fig.INK, "ytick.color": fig.INK, "axes.grid": True, "grid.color": fig.GRID,
    "grid.linewidth": 0.8, "axes.axisbelow": True, "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.labelsize": 10, "xtick.labelsize": 9.5, "ytick.labelsize": 9.5,
    "figure.facecolor": "white", "savefig.facecolor": "white", "path.simplify": True,
    "axes.unicode_minus": True}


class Drawing(matplotlib.figure.Figure):
    """A matplotlib figure that a notebook shows, whether or not pyplot is there to do it."""

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        """Return the picture at twice its size, and its size in CSS pixels."""
        width, height = (self.get_size_inches() * _PIXELS_PER_INCH).round().astype(int)
        return png(self), {"width": int(width), "height": int(height)}


def image_uri(figure: fig.Figure) -> str:
    """Return a figure at twice its CSS size as a PNG in a data URI."""
    return f"data:image/png;base64,{base64.b64encode(png(drawn(figure))).decode('ascii')}"


def drawn(figure: fig.Figure) -> Drawing:
    """Draw a described figure."""
    with matplotlib.rc_context(_STYLE):
        made = Drawing(figsize=[side / _PIXELS_PER_INCH for side in figure.size],
                       dpi=_PIXELS_PER_INCH)
        FigureCanvasAgg(made)
        grid = made.subplots(len(figure.panels), 1, sharex=figure.shared, squeeze=False)[:, 0]
        for axis, panel in zip(grid, (fig.in_units(one, _DAYS) for one in figure.panels),
                               strict=True):
            for one in panel.shown:
                _SHOW[type(one)](axis, one)
            _scale(axis, panel, "x")
            _scale(axis, panel, "y")
            _legend(axis, figure.size[0])
        _arrange(made, figure)
    return made


def words_drawn(words: str) -> Drawing:
    """Return a drawing that says why there is nothing to draw."""
    unit, text = fig.Side(limits=(0.0, 1.0)), fig.Text(0.5, 0.5, textwrap.fill(words, 70))
    made = drawn(fig.Figure((fig.Panel(unit, unit, [text]),), words, size=(fig.WIDTH, 120)))
    made.axes[0].set_axis_off()
    return made


def png(made: matplotlib.figure.Figure) -> bytes:
    """Return a drawing as a PNG at twice its CSS size."""
    with matplotlib.rc_context(_STYLE):
        made.set_dpi(2 * _PIXELS_PER_INCH)
        made.canvas.draw()
        image = Image.fromarray(np.asarray(made.canvas.buffer_rgba())[:, :, :3].copy())
    memory = io.BytesIO()
    # A third of the size in half the time: few colours, and their shades at the edges of lines.
    image.quantize(_COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
        memory, format="png", compress_level=6)
    return memory.getvalue()


def _curve(axis: Axes, one: fig.Curve) -> None:
    look = {"color": one.colour, "linewidth": one.width, "marker": _MARKERS[one.marker],
            "linestyle": _DASHES[one.dash] if one.width else "", "alpha": one.opacity,
            "markersize": one.size * _POINT, "markerfacecolor": one.face or one.colour,
            "markeredgecolor": one.colour, "solid_joinstyle": "round",
            "label": one.label if one.legend else None}
    if one.x_error is None and one.y_error is None:
        axis.plot(one.x, one.y, **look)
        return
    axis.errorbar(one.x, one.y, one.y_error, one.x_error, ecolor=one.error_colour or one.colour,
                  elinewidth=one.error_width, capsize=one.cap, **look)


def _band(axis: Axes, one: fig.Band) -> None:
    axis.fill_between(one.x, one.low, one.high, color=one.colour, alpha=one.opacity,
                      linewidth=0, label=one.label or None)


def _bars(axis: Axes, one: fig.Bars) -> None:
    axis.bar(one.x, one.height, width=one.width, color=fig.MEASURED)
    for number in one.numbers:
        _text(axis, number)


def _level(axis: Axes, one: fig.Level) -> None:
    draw = axis.axvline if one.upright else axis.axhline
    draw(one.at, color=one.colour, linewidth=one.width, linestyle=_DASHES[one.dash],
         label=one.label or None)


def _span(axis: Axes, one: fig.Span) -> None:
    draw = axis.axvspan if one.upright else axis.axhspan
    draw(one.low, one.high, color=one.colour, alpha=one.opacity, linewidth=0, zorder=0,
         label=one.label or None)


def _text(axis: Axes, one: fig.Text) -> None:
    axis.annotate(one.words, (one.x, one.y),
                  xycoords=("axes fraction" if one.x_share else "data",
                            "axes fraction" if one.y_share else "data"),
                  xytext=[_POINT * shift for shift in one.shift], textcoords="offset points",
                  ha=one.across, va={"middle": "center"}.get(one.up, one.up), fontsize=9,
                  color=one.colour, bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8,
                                          "alpha": 0.75})


_SHOW = {fig.Curve: _curve, fig.Band: _band, fig.Bars: _bars, fig.Level: _level, fig.Span: _span,
         fig.Text: _text}


def _scale(axis: Axes, panel: fig.Panel, which: str) -> None:
    """Set scale, limits, ticks and words of the axis ``x`` or ``y``."""
    about, side = getattr(panel, which), getattr(axis, f"{which}axis")
    if about.log:
        getattr(axis, f"set_{which}scale")("log")
    if about.dates:
        locator = matplotlib.dates.AutoDateLocator(minticks=3, maxticks=7)
        side.set_major_locator(locator)
        side.set_major_formatter(matplotlib.dates.ConciseDateFormatter(
            locator, show_offset=False,
            formats=["%Y", "%b", "%d %b", "%H:%M", "%H:%M", "%H:%M:%S"],
            zero_formats=["", "%Y", "%d %b", "%d %b", "%H:%M", "%H:%M"]))
    elif (ticks := panel.ticks(which)) is not None:
        side.set_ticks(*ticks)
        side.set_minor_locator(NullLocator())
    else:
        plain = ScalarFormatter(useOffset=False)
        plain.set_powerlimits((-9, 9))
        side.set_major_formatter(plain)
        side.set_major_locator(MaxNLocator(8 if which == "x" else 6, steps=_STEPS))
    getattr(axis, f"set_{which}lim")(*panel.ends(which))
    side.set_label_text(about.words)


def _legend(axis: Axes, width: int) -> None:
    """Put the legend above the axes, where it covers nothing, in as few rows as fit."""
    handles, labels = axis.get_legend_handles_labels()
    named = dict(zip(labels, handles, strict=True))  # each label once
    labels = sorted(named, key=lambda label: not label.startswith("measured"))
    if not labels:
        return
    columns = len(labels)
    while columns > 1 and _legend_width(labels, columns) > width - 90:
        columns -= 1
    axis.legend([named[label] for label in labels],
                [textwrap.fill(label, width // 10) for label in labels], ncols=columns,
                loc="lower left", bbox_to_anchor=(-0.01, 1.0), borderaxespad=0.1,
                handlelength=1.8, columnspacing=1.4, labelspacing=0.3, frameon=False,
                fontsize=9.5)


def _legend_width(labels: list[str], columns: int) -> float:
    """Return about how many pixels a legend takes; matplotlib fills it column by column."""
    parts = np.array_split(np.array([len(label) for label in labels]), columns)
    return sum(50 + _LETTER * part.max() for part in parts)


def _arrange(made: Drawing, figure: fig.Figure) -> None:
    """Put each axes in its place, with room for legend, ticks and labels.

    Constrained layout does the same by drawing everything once more, which would be a third of
    the time of a report; and here the axes of all pictures of a page line up.
    """
    width, height = figure.size
    renderer = made.canvas.get_renderer()
    left, above, below = 70.0, [], []
    for axis in made.axes:
        ticks = axis.yaxis.get_major_formatter().format_ticks(axis.get_yticks())
        lines = axis.get_ylabel().count("\n") + 1
        left = max(left, 16 + 17 * lines + _DIGIT * max(map(len, ticks), default=0))
        legend = axis.get_legend()
        above.append(10 + (legend.get_window_extent(renderer).height if legend else 0))
        below.append(46 if axis.get_xlabel() else 4)
    ratios = np.array(figure.ratios, dtype=float)
    heights = (height - sum(above) - sum(below)) * ratios / ratios.sum()
    top = float(height)
    for axis, over, size, under in zip(made.axes, above, heights, below, strict=True):
        top -= over + size
        axis.set_position((left / width, top / height, (width - left - 14) / width, size / height))
        _thin_ticks(axis, width - left - 14)
        middle = 4 + 8.5 * (axis.get_ylabel().count("\n") + 1)
        axis.yaxis.set_label_coords(-(left - middle) / (width - left - 14), 0.5)
        axis.yaxis.label.set_verticalalignment("center")
        top -= under


def _thin_ticks(axis: Axes, width: float) -> None:
    """Leave out time ticks where their labels would run into each other."""
    locator = axis.xaxis.get_major_locator()
    if isinstance(locator, MaxNLocator):
        ticks = axis.xaxis.get_major_formatter().format_ticks(axis.get_xticks())
        locator.set_params(nbins=int(np.clip(
            width / (_DIGIT * max(map(len, ticks), default=1) + 16), 2, 8)))
