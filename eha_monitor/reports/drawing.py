"""The look of all figures, and the way from a matplotlib figure into a page.

Only matplotlib's object interface is used: pyplot costs import time and keeps global state.
"""

import base64
import io
import textwrap
from dataclasses import dataclass, field

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from PIL import Image

from eha_monitor.reports.interactive import chart_json
from eha_monitor.reports.traces import envelope

# Okabe and Ito's palette, told apart by colour-blind people; measured data are grey.
INK, GRID = "#22303c", "#dfe4e8"
MEASURED, STAGE_ONE, STAGE_TWO, OTHER = "#8c96a0", "#0072B2", "#D55E00", "#009E73"
WARN_LINE, ERROR_LINE = "#8A6100", "#A3150B"

WIDTH, HEIGHT = 580, 400  # CSS pixels of one picture; two stand side by side at 1280
_PIXELS_PER_INCH = 96
_COLOURS = 128  # of an image
_LETTER = 7.0  # mean width of a letter of the legend, pixels
_DIGIT = 8.1  # width of a digit of a tick label, pixels
_STEPS = [1, 2, 2.5, 5, 10]  # between ticks
_STYLE = {
    "font.family": ["DejaVu Sans"], "font.size": 10, "text.usetex": False,
    "axes.edgecolor": "#98a2ab", "axes.labelcolor": INK, "text.color": INK,
    "xtick.color": INK, "ytick.color": INK, "axes.grid": True, "grid.color": GRID,
    "grid.linewidth": 0.8, "axes.axisbelow": True, "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.labelsize": 10, "xtick.labelsize": 9.5, "ytick.labelsize": 9.5,
    "figure.facecolor": "white", "savefig.facecolor": "white", "path.simplify": True,
    "axes.unicode_minus": True, "axes.xmargin": 0.0,
}


@dataclass(frozen=True)
class Picture:
    """One image of a page.

    Attributes
    ----------
    source : PNG as a data URI: what a printer shows, and a browser without scripts.
    width, height : CSS pixels.
    alt : what it shows, in words.
    chart : the same for :mod:`interactive`, as JSON.
    stretch : charts of one name show the same stretch of time, and zoom together.
    """

    source: str
    width: int
    height: int
    alt: str
    chart: str = ""
    stretch: str = ""


@dataclass(frozen=True)
class Block:
    """A titled group of pictures; without pictures the notes say why.

    Attributes
    ----------
    key : id in the page.
    title : heading.
    pictures : side by side where there is room.
    notes : sentences under the pictures.
    """

    key: str
    title: str
    pictures: tuple[Picture, ...] = ()
    notes: tuple[str, ...] = field(default=())


class Drawing(Figure):
    """A figure that a notebook shows, whether or not pyplot is there to do it."""

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        """Return the picture at twice its size, and its size in CSS pixels."""
        width, height = (self.get_size_inches() * _PIXELS_PER_INCH).round().astype(int)
        return _png(self), {"width": int(width), "height": int(height)}


def new_figure(rows: int = 1, ratios: tuple[float, ...] | None = None, height: int = HEIGHT,
               share: bool = True) -> tuple[Figure, list[Axes]]:
    """Return a figure of ``rows`` axes one above the other, by default on one time axis."""
    with matplotlib.rc_context(_STYLE):
        figure = Drawing(figsize=(WIDTH / _PIXELS_PER_INCH, height / _PIXELS_PER_INCH),
                        dpi=_PIXELS_PER_INCH)
        FigureCanvasAgg(figure)
        grid = figure.subplots(rows, 1, sharex=share, squeeze=False,
                               gridspec_kw={"height_ratios": ratios} if ratios else None)
    axes = list(grid[:, 0])
    for axis in axes:
        for side in (axis.xaxis, axis.yaxis):
            plain = ScalarFormatter(useOffset=False)
            plain.set_powerlimits((-9, 9))
            side.set_major_formatter(plain)
        axis.yaxis.set_major_locator(MaxNLocator(6, steps=_STEPS))
        axis.xaxis.set_major_locator(MaxNLocator(8, steps=_STEPS))
    return figure, axes


def arranged(figure: Figure) -> Figure:
    """Return the figure with each axes in its place, with room for legend, ticks and labels.

    Constrained layout does the same by drawing everything once more, which would be a third of
    the time of a report; and here the axes of all pictures of a page line up.
    """
    width, height = (side * _PIXELS_PER_INCH for side in figure.get_size_inches())
    renderer = figure.canvas.get_renderer()
    left, above, below = 70.0, [], []
    for axis in figure.axes:
        ticks = axis.yaxis.get_major_formatter().format_ticks(axis.get_yticks())
        lines = axis.get_ylabel().count("\n") + 1
        left = max(left, 16 + 17 * lines + _DIGIT * max(map(len, ticks), default=0))
        legend = axis.get_legend()
        above.append(10 + (legend.get_window_extent(renderer).height if legend else 0))
        below.append(46 if axis.get_xlabel() else 4)
    ratios = np.array(figure.axes[0].get_gridspec().get_height_ratios(), dtype=float)
    heights = (height - sum(above) - sum(below)) * ratios / ratios.sum()
    top = height
    for axis, over, size, under in zip(figure.axes, above, heights, below, strict=True):
        top -= over + size
        axis.set_position((left / width, top / height, (width - left - 14) / width,
                           size / height))
        _thin_ticks(axis, width - left - 14)
        middle = 4 + 8.5 * (axis.get_ylabel().count("\n") + 1)
        axis.yaxis.set_label_coords(-(left - middle) / (width - left - 14), 0.5)
        axis.yaxis.label.set_verticalalignment("center")
        top -= under
    return figure


def _thin_ticks(axis: Axes, width: float) -> None:
    """Leave out time ticks where their labels would run into each other."""
    locator = axis.xaxis.get_major_locator()
    if isinstance(locator, MaxNLocator):
        ticks = axis.xaxis.get_major_formatter().format_ticks(axis.get_xticks())
        locator.set_params(nbins=int(np.clip(
            width / (_DIGIT * max(map(len, ticks), default=1) + 16), 2, 8)))


def picture(figure: Figure, alt: str, clock: float | None = None, stretch: str = "") -> Picture:
    """Render a figure at twice its CSS size and embed it, with its interactive form.

    Parameters
    ----------
    figure : what is drawn.
    alt : what it shows, in words.
    clock : units of the x axis for each second of the recording, if that axis is its time.
    stretch : name of the stretch of time, for charts that zoom together.
    """
    arranged(figure)
    width, height = (figure.get_size_inches() * _PIXELS_PER_INCH).round().astype(int)
    data = base64.b64encode(_png(figure)).decode("ascii")
    return Picture(f"data:image/png;base64,{data}", int(width), int(height), alt,
                   chart_json(figure, clock), stretch)


def _png(figure: Figure) -> bytes:
    with matplotlib.rc_context(_STYLE):
        figure.set_dpi(2 * _PIXELS_PER_INCH)
        figure.canvas.draw()
        image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[:, :, :3].copy())
    memory = io.BytesIO()
    # A third of the size in half the time: few colours, and their shades at the edges of lines.
    image.quantize(_COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
        memory, format="png", compress_level=6)
    return memory.getvalue()


def draw(axis: Axes, time: np.ndarray, values: np.ndarray, **style) -> None:
    """Draw a long signal as an envelope that keeps peaks and gaps; few samples get dots."""
    t, v = envelope(time, values)
    if 0 < np.isfinite(v).sum() <= 40:
        style.setdefault("marker", "o")
        style.setdefault("markersize", 4)
    style.setdefault("linewidth", 1.4)
    axis.plot(t, v, solid_joinstyle="round", **style)


def legend_above(axis: Axes) -> None:
    """Put the legend above the axes, where it covers nothing, in as few rows as fit."""
    handles, labels = axis.get_legend_handles_labels()
    if not labels:
        return
    columns = len(labels)  # constrained layout would squeeze the axes under a wide legend
    while columns > 1 and _legend_width(labels, columns) > WIDTH - 90:
        columns -= 1
    axis.legend(handles, [textwrap.fill(label, 58) for label in labels], ncols=columns,
                loc="lower left", bbox_to_anchor=(-0.01, 1.0), borderaxespad=0.1,
                handlelength=1.8, columnspacing=1.4, frameon=False, fontsize=9.5)


def _legend_width(labels: list[str], columns: int) -> float:
    """Return about how many pixels a legend takes; matplotlib fills it column by column."""
    parts = np.array_split(np.array([len(label) for label in labels]), columns)
    return sum(50 + _LETTER * part.max() for part in parts)


def pad_limits(axis: Axes, low: float, high: float, share: float = 0.06) -> None:
    """Set the y limits with a margin; equal limits get a margin of their own."""
    span = high - low
    if not span > 1e-9 * max(abs(low), abs(high)):
        span = 0.2 * max(abs(low), abs(high)) or 1.0
        low, high = low - 0.5 * span, high + 0.5 * span
    axis.set_ylim(low - share * span, high + share * span)


def note_cut(axis: Axes, peak: str) -> None:
    """Say in a corner that single samples leave the picture."""
    axis.text(0.995, 0.97, f"peak {peak} cut off", transform=axis.transAxes, ha="right",
              va="top", fontsize=9,
              bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5, "alpha": 0.85})


def mark_window(axis: Axes, start: float, stop: float) -> None:
    """Shade the stretch that the picture beside it shows enlarged."""
    axis.axvspan(start, stop, color="#F0E442", alpha=0.45, linewidth=0, zorder=0)
