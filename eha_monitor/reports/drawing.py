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

from eha_monitor.reports.traces import envelope

# Okabe and Ito's palette, told apart by colour-blind people; measured data are grey.
INK, GRID = "#22303c", "#dfe4e8"
MEASURED, STAGE_ONE, STAGE_TWO, OTHER = "#8c96a0", "#0072B2", "#D55E00", "#009E73"
LEVEL_COLOURS = {"OK": "#56B4A0", "WARN": "#E69F00", "ERROR": "#C4361A", "STALE": "#B8BEC4"}
WARN_LINE, ERROR_LINE = "#8A6100", "#A3150B"

WIDTH, HEIGHT = 580, 400  # CSS pixels of one picture; two stand side by side at 1280
_PIXELS_PER_INCH = 96
_STYLE = {
    "font.family": ["DejaVu Sans"], "font.size": 10, "text.usetex": False,
    "axes.edgecolor": "#98a2ab", "axes.labelcolor": INK, "text.color": INK,
    "xtick.color": INK, "ytick.color": INK, "axes.grid": True, "grid.color": GRID,
    "grid.linewidth": 0.8, "axes.axisbelow": True, "axes.spines.top": False,
    "axes.spines.right": False, "legend.frameon": False, "legend.fontsize": 9.5,
    "axes.labelsize": 10, "xtick.labelsize": 9.5, "ytick.labelsize": 9.5,
    "figure.facecolor": "white", "savefig.facecolor": "white", "path.simplify": True,
    "axes.unicode_minus": True, "axes.xmargin": 0.0,
}


@dataclass(frozen=True)
class Picture:
    """One image of a page: PNG as a data URI, size in CSS pixels, and what it shows."""

    source: str
    width: int
    height: int
    alt: str


@dataclass(frozen=True)
class Block:
    """A titled group of pictures; without pictures the notes say why.

    Attributes
    ----------
    key : id in the page.
    title, paper : heading, and which of the paper's figures it stands for.
    pictures : side by side where there is room.
    notes : sentences under the pictures.
    """

    key: str
    title: str
    paper: str = ""
    pictures: tuple[Picture, ...] = ()
    notes: tuple[str, ...] = field(default=())


def new_figure(rows: int = 1, ratios: tuple[float, ...] | None = None, height: int = HEIGHT,
               width: int = WIDTH, share: bool = True) -> tuple[Figure, list[Axes]]:
    """Return a figure of ``rows`` axes one above the other, by default on one time axis."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width / _PIXELS_PER_INCH, height / _PIXELS_PER_INCH),
                        dpi=_PIXELS_PER_INCH, layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplots(rows, 1, sharex=share, squeeze=False,
                               gridspec_kw={"height_ratios": ratios} if ratios else None)
    axes = list(grid[:, 0])
    for axis in axes:
        for side in (axis.xaxis, axis.yaxis):
            plain = ScalarFormatter(useOffset=False)
            plain.set_powerlimits((-4, 6))
            side.set_major_formatter(plain)
        axis.yaxis.set_major_locator(MaxNLocator(6))
        axis.xaxis.set_major_locator(MaxNLocator(8))
    figure.align_ylabels()
    return figure, axes


def picture(figure: Figure, alt: str) -> Picture:
    """Render a figure at twice its CSS size, lossless, and embed it."""
    width, height = (figure.get_size_inches() * _PIXELS_PER_INCH).round().astype(int)
    memory = io.BytesIO()
    with matplotlib.rc_context(_STYLE):
        figure.savefig(memory, format="png", dpi=2 * _PIXELS_PER_INCH,
                       pil_kwargs={"compress_level": 7})
    data = base64.b64encode(memory.getvalue()).decode("ascii")
    return Picture(f"data:image/png;base64,{data}", int(width), int(height), alt)


def draw(axis: Axes, time: np.ndarray, values: np.ndarray, **style) -> None:
    """Draw a long signal as an envelope that keeps peaks and gaps; few samples get dots."""
    t, v = envelope(time, values)
    if 0 < np.isfinite(v).sum() <= 40:
        style.setdefault("marker", "o")
        style.setdefault("markersize", 4)
    style.setdefault("linewidth", 1.4)
    axis.plot(t, v, solid_joinstyle="round", **style)


def legend_above(axis: Axes, columns: int = 3) -> None:
    """Put the legend above the axes, where it covers nothing."""
    handles, labels = axis.get_legend_handles_labels()
    if not labels:
        return
    while columns > 1 and sum(sorted(map(len, labels))[-columns:]) > 78 - 7 * columns:
        columns -= 1
    axis.legend(handles, [textwrap.fill(label, 74) for label in labels], ncols=columns,
                loc="lower left", bbox_to_anchor=(-0.01, 1.0), borderaxespad=0.1,
                handlelength=1.8, columnspacing=1.4)


def pad_limits(axis: Axes, low: float, high: float, share: float = 0.06) -> None:
    """Set the y limits with a margin; equal limits get a margin of their own."""
    span = high - low
    if not span > 1e-9 * max(abs(low), abs(high)):
        span = 0.2 * max(abs(low), abs(high)) or 1.0
        low, high = low - 0.5 * span, high + 0.5 * span
    axis.set_ylim(low - share * span, high + share * span)


def mark_window(axis: Axes, start: float, stop: float) -> None:
    """Shade the stretch that the picture beside it shows enlarged."""
    axis.axvspan(start, stop, color="#F0E442", alpha=0.45, linewidth=0, zorder=0)
