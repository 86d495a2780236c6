"""A figure, described once: its panels, and in SI units what each shows.

:mod:`~eha_monitor.reports.plotly_chart` makes of it the chart that a browser zooms and reads
off, :mod:`~eha_monitor.reports.still_image` the image for paper, for a browser without scripts,
and for a notebook.  Neither looks at what the other has made; both draw :func:`in_units`.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from eha_monitor.quantity import FLOOR, Scale, power_of_ten, readable
from eha_monitor.reports.traces import envelope

# Okabe and Ito's palette, distinguishable by colour-blind people; measured data are grey.
INK, GRID = "#22303c", "#dfe4e8"
MEASURED, STAGE_ONE, STAGE_TWO, OTHER = "#8c96a0", "#0072B2", "#D55E00", "#009E73"
WARN_LINE, ERROR_LINE, WINDOW = "#8A6100", "#A3150B", "#F0E442"

WIDTH, HEIGHT = 580, 400  # CSS pixels of one figure; two stand side by side at 1280
PLAIN = Scale(1.0, "")
_FEW = 40  # samples up to which a line gets a mark at each


@dataclass(frozen=True)
class Curve:
    """A line, marks, or both."""

    x: np.ndarray  # (n,), as ``y``; NaN breaks a line
    y: np.ndarray
    label: str = ""  # in the legend (unless ``legend`` is false) and beside the cursor
    colour: str = INK
    width: float = 1.4  # of the line, pixels; 0 for marks alone
    dash: str = "solid"  # or ``dash`` or ``dot``
    opacity: float = 1.0
    # "", ``circle``, ``square``, ``x``, ``diamond``, ``triangle-up``, ``triangle-down``
    marker: str = ""
    size: float = 6.0  # diameter of the marker, pixels
    face: str = ""  # its colour inside
    # Half lengths of error bars, (n,), or (2, n) below and above; strokes without line and marker.
    x_error: np.ndarray | None = None
    y_error: np.ndarray | None = None
    error_colour: str = ""
    error_width: float = 0.9
    cap: float = 0.0  # length of the bars' ends, pixels
    legend: bool = True


@dataclass(frozen=True)
class Band:
    """The area between two curves, (n,) each; NaN leaves a gap."""

    x: np.ndarray
    low: np.ndarray
    high: np.ndarray
    label: str = ""
    colour: str = INK
    opacity: float = 0.22


@dataclass(frozen=True)
class Bars:
    """Upright grey bars of one width, (n,), with a number above each."""

    x: np.ndarray
    height: np.ndarray
    width: float

    @property
    def numbers(self) -> list["Text"]:
        """The number above each."""
        return [Text(float(x), float(height), f"{height:g}", up="bottom", shift=(0, 2))
                for x, height in zip(self.x, self.height, strict=True)]


@dataclass(frozen=True)
class Level:
    """A line all across the panel: a value of y, or of x where ``upright``."""

    at: float
    label: str = ""
    colour: str = INK
    width: float = 1.0
    dash: str = "solid"
    upright: bool = False


@dataclass(frozen=True)
class Span:
    """A shaded stretch all across the panel, of x where ``upright``, else of y."""

    low: float
    high: float
    label: str = ""
    colour: str = OTHER
    opacity: float = 0.25
    upright: bool = False


@dataclass(frozen=True)
class Text:
    """Words at a place, ``x`` and ``y`` in the data or, with ``x_share``, ``y_share``, in shares.

    ``across`` is ``left``, ``center`` or ``right`` and ``up`` ``bottom``, ``middle`` or ``top``:
    which end of the words lies there; ``shift`` moves them, pixels.
    """

    x: float
    y: float
    words: str
    colour: str = INK
    across: str = "center"
    up: str = "middle"
    x_share: bool = False
    y_share: bool = False
    shift: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Side:
    """An axis: ``time, s — whole record`` is its name, its unit and its note."""

    name: str = ""
    scale: Scale = PLAIN  # from SI to what is written at the axis
    note: str = ""
    limits: tuple[float, float] | None = None  # ends, SI; None for the extent of what is shown
    log: bool = False
    rows: tuple[str, ...] = ()  # names of the rows 0, 1, ... in place of a scale
    dates: bool = False  # whether the values are s since the epoch, shown as dates

    @property
    def unit(self) -> str:
        """The unit at the axis, "" for none."""
        return "" if self.scale.unit == "1" else self.scale.unit

    @property
    def words(self) -> str:
        """What is written beside the axis; nothing where another panel's axis says it."""
        if not self.name:
            return ""
        return ", ".join(filter(None, (self.name, self.unit))) + (
            f" — {self.note}" if self.note else "")


@dataclass
class Panel:
    """One pair of axes: what is shown, in the order in which it is drawn."""

    x: Side
    y: Side
    shown: list = field(default_factory=list)

    def add(self, *more) -> None:
        """Show more, on top."""
        self.shown += more

    def signal(self, time: np.ndarray, values: np.ndarray, label: str, colour: str, **look
               ) -> None:
        """Show a long signal by an envelope that keeps peaks and gaps; few samples get marks."""
        t, v = envelope(time, values)
        if 0 < np.isfinite(v).sum() <= _FEW:
            look = {"marker": "circle", "size": 5.0} | look
        if len(t):
            self.add(Curve(t, v, label, colour, **look))

    def ends(self, side: str) -> tuple[float, float]:
        """Return the limits of the axis ``x`` or ``y``."""
        about: Side = getattr(self, side)
        if about.limits is not None:
            return about.limits
        if about.rows:
            return -0.6, len(about.rows) - 0.4
        values = [np.empty(0)]
        for one in self.shown:
            if isinstance(one, Curve | Band | Bars):
                values += [np.asarray(part, dtype=float) for part in _extent(one, side)]
        known = np.concatenate([part[np.isfinite(part)] for part in values])
        if about.log:
            known = np.log10(known[known > 0.0])
        if not known.size:
            return (0.1, 10.0) if about.log else (0.0, 1.0)
        low, high = padded(known.min(), known.max(), 0.02 if side == "x" else 0.06)
        return (10.0**low, 10.0**high) if about.log else (low, high)

    def ticks(self, side: str) -> tuple[list[float], list[str]] | None:
        """Return places and words of the ticks where these are no plain scale, else None."""
        about: Side = getattr(self, side)
        if about.rows:
            return [float(i) for i in range(len(about.rows))], list(about.rows)
        if not about.log:
            return None
        low, high = (math.log10(end) for end in self.ends(side))
        places = [10.0**power * step for power in range(math.floor(low), math.ceil(high) + 1)
                  for step in ((1.0, 3.0) if high - low < 3.0 else (1.0,))]
        places = [at for at in places if low - 1e-9 <= math.log10(at) <= high + 1e-9]
        return places, [f"{at:g}" for at in places]


def _extent(one, side: str) -> tuple[np.ndarray, ...]:
    if side == "x":
        return (one.x,)
    if isinstance(one, Curve):
        return (one.y,)
    return (one.height, np.zeros(1)) if isinstance(one, Bars) else (one.low, one.high)


@dataclass(frozen=True)
class Figure:
    """Panels one above the other."""

    panels: tuple[Panel, ...]
    alt: str  # what it shows, in words
    ratios: tuple[float, ...] = (1.0,)  # of the panels' heights
    size: tuple[int, int] = (WIDTH, HEIGHT)  # CSS pixels
    shared: bool = True  # whether all panels have the x axis of the last one
    on_time: bool = False  # whether x is the time of the recording: such charts share a cursor
    stretch: str = ""  # charts of one name show the same stretch of time, and zoom together

    def __post_init__(self):
        if self.shared:  # the axis is named below the last
            object.__setattr__(self, "panels", tuple(
                replace(panel, x=replace(panel.x, name="", note="")) for panel in self.panels[:-1]
                ) + self.panels[-1:])


# What of each kind lies along x, and along y.
_ALONG = {Curve: (("x", "x_error"), ("y", "y_error")), Band: (("x",), ("low", "high")),
          Bars: (("x", "width"), ("height",))}


def in_units(panel: Panel, dates: float = 1.0) -> Panel:
    """Return a panel with all numbers in the units of its axes; ``dates`` counts a second."""
    x = dates if panel.x.dates else panel.x.scale.factor
    y = panel.y.scale.factor

    def side(one: Side, factor: float) -> Side:
        return replace(one, scale=Scale(1.0, one.scale.unit), limits=one.limits and (
            one.limits[0] * factor, one.limits[1] * factor))

    return Panel(side(panel.x, x), side(panel.y, y), [_scaled(one, x, y) for one in panel.shown])


def _scaled(one: Any, x: float, y: float) -> Any:
    """Return something that is shown, its numbers times the factor of their axis."""
    if isinstance(one, Text):
        return replace(one, x=one.x * (1.0 if one.x_share else x),
                       y=one.y * (1.0 if one.y_share else y))
    factor = x if isinstance(one, Level | Span) and one.upright else y
    if isinstance(one, Level):
        return replace(one, at=one.at * factor)
    if isinstance(one, Span):
        return replace(one, low=one.low * factor, high=one.high * factor)
    return replace(one, **{name: np.multiply(getattr(one, name), factor)
                           for names, factor in zip(_ALONG[type(one)], (x, y), strict=True)
                           for name in names if getattr(one, name) is not None})


@dataclass(frozen=True)
class Block:
    """A titled group of figures side by side; without figures the notes say why."""

    key: str
    title: str
    pictures: tuple[Figure, ...] = ()
    notes: tuple[str, ...] = ()


def padded(low: float, high: float, share: float = 0.06) -> tuple[float, float]:
    """Return limits with a margin; equal ones get a margin of their own."""
    span = high - low
    if not span > 1e-9 * max(abs(low), abs(high)):
        span = 0.2 * max(abs(low), abs(high)) or 1.0
        low, high = low - 0.5 * span, high + 0.5 * span
    return float(low - share * span), float(high + share * span)


def cut_note(peak: str) -> Text:
    """Return the remark, in a corner, that single samples leave the panel."""
    return Text(0.995, 0.97, f"peak {peak} cut off", INK, "right", "top", True, True)


def scale_of(values: np.ndarray, unit: str) -> Scale:
    """Return the scale for an axis that shows ``values`` (SI, NaN allowed)."""
    size = np.abs(values[np.isfinite(values)])
    return axis_scale(float(np.percentile(size, 99)) if size.size else 0.0, unit)


def axis_scale(magnitude: float, unit: str) -> Scale:
    """Return a readable scale whose tick labels stay short: a power of ten where need be."""
    scale = readable(magnitude, unit)
    size = abs(magnitude * scale.factor)
    if size == 0 or not math.isfinite(size) or 1e-3 <= size < 1e6:
        return scale
    power = math.floor(math.log10(size))
    return Scale(scale.factor * 10.0**-power, f"{power_of_ten(power)} {scale.unit}")


def stated(value: np.ndarray, stddev: np.ndarray) -> np.ndarray:
    """Return the standard deviations as they are written beside the values: no finer than that."""
    return np.maximum(stddev, FLOOR * np.abs(value))


def time_scale(duration: float) -> Scale:
    """Return the scale of a time axis of ``duration`` seconds: ms, s, min or h."""
    if duration < 0.1:
        return Scale(1e3, "ms")
    if duration >= 6 * 3600:
        return Scale(1 / 3600, "h")
    return Scale(1 / 60, "min") if duration >= 600 else Scale(1.0, "s")
