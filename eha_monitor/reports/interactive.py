"""From a finished matplotlib figure to a chart that a browser zooms and reads off.

A figure is described once, in matplotlib's words; what it was told to draw (lines, bands, error
bars, spans, texts) is read back through its public interface and put into the words of plotly.js.
The picture that matplotlib makes of it stays in the page, for a printer and without a script.
"""

import base64
import json
import math
from typing import Any

import matplotlib.dates
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgba
from matplotlib.container import BarContainer, ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import FixedFormatter, FixedLocator, ScalarFormatter
from matplotlib.transforms import Transform

_DASHES = {"-": "solid", "--": "dash", ":": "dot", "-.": "dashdot"}
_MARKERS = {"o": "circle", "s": "square", "X": "x", "D": "diamond", "^": "triangle-up",
            "v": "triangle-down"}
_DAY = 86_400_000.0  # ms; matplotlib counts days, plotly milliseconds
_GAP, _GAP_WITH_LABEL = 0.07, 0.22  # between subplots, share of the height
_LETTER, _PIXELS = 9.5, 96  # of an axis' title, pixels with the room about it; of an inch
_FINEST = 2e-5  # share of the range below which a rounding cannot be seen


def chart_json(figure: Figure, clock: float | None = None) -> str:
    """Return the chart of a figure as JSON: ``data`` and ``layout`` of plotly.js, ``clock``.

    Parameters
    ----------
    figure : axes one above the other.
    clock : units of the x axis for each second of the recording where that axis is its time;
        charts with a clock share a cursor, and those of one stretch their zoom.
    """
    return json.dumps(_finite(chart(figure, clock)), separators=(",", ":"), ensure_ascii=False,
                      allow_nan=False)


def chart(figure: Figure, clock: float | None = None) -> dict[str, Any]:
    """Return what :func:`chart_json` writes."""
    layout: dict[str, Any] = {"shapes": [], "annotations": []}
    data: list[dict[str, Any]] = []
    for place, (axis, domain) in enumerate(zip(figure.axes, _domains(figure), strict=True), 1):
        _Panel(axis, place, layout, data).read(domain)
        height = (domain[1] - domain[0]) * figure.get_size_inches()[1] * _PIXELS
        title = layout[f"yaxis{place if place > 1 else ''}"]["title"]
        if len(title["text"]) * _LETTER > height:
            title["text"] = title["text"].replace(", ", ",<br>")
    _name_the_nameless(data)
    return {"data": data, "layout": layout, "clock": clock,
            "dates": _is_date(figure.axes[0])}


def _finite(tree: Any) -> Any:
    """Return a tree with null for each number that JSON does not know."""
    if isinstance(tree, dict):
        return {key: _finite(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_finite(value) for value in tree]
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def _domains(figure: Figure) -> list[tuple[float, float]]:
    """Return the share of the height that each axes has, the first on top."""
    axes = figure.axes
    ratios = np.array(axes[0].get_gridspec().get_height_ratios(), dtype=float)
    gaps = [_GAP_WITH_LABEL if upper.get_xlabel() else _GAP for upper in axes[:-1]]
    heights = (1.0 - sum(gaps)) * ratios / ratios.sum()
    top, found = 1.0, []
    for height, gap in zip(heights, [*gaps, 0.0], strict=True):
        found.append((round(max(top - height, 0.0), 4), round(top, 4)))
        top -= height + gap
    return found


def _name_the_nameless(data: list[dict[str, Any]]) -> None:
    """Give a line without a label that of the same colour, with the name of its axis."""
    labels = {one["legendgroup"]: one["name"] for one in data if one.get("name")}
    for one in data:
        axis = one.pop("axis_words")
        if not one["name"]:
            one["name"] = ", ".join(filter(None, (labels.get(one["legendgroup"], ""), axis)))


class _Panel:
    """One axes: adds what it shows to the data and the layout of a chart."""

    def __init__(self, axis: Axes, place: int, layout: dict, data: list):
        self.axis, self.layout, self.data = axis, layout, data
        number = "" if place == 1 else str(place)
        # On one axis of time the cursor goes through all of them.
        first = axis.figure.axes[0]
        self.shared = axis is not first and axis.get_shared_x_axes().joined(axis, first)
        own = "" if self.shared else number
        self.x, self.y = f"x{own}", f"y{number}"
        self.x_key, self.y_key = f"xaxis{own}", f"yaxis{number}"
        self.legend = f"legend{number}"
        self.dates = _is_date(axis)
        self.rows = _has_words(axis.yaxis)
        words, _, unit = axis.get_ylabel().replace("\n", " ").rpartition(", ")
        self.words, self.unit = (words, unit) if words else (unit, "")

    def read(self, domain: tuple[float, float]) -> None:
        """Read the axes."""
        axis = self.axis
        self.layout[self.x_key] = self._scale("x", self.y)  # the lowest has the words
        self.layout[self.y_key] = self._scale("y", self.x) | {"domain": list(domain)}
        self.layout[self.legend] = {"y": round(domain[1] + 0.01, 4)}
        apart = set()  # what belongs to error bars or bars
        for container in axis.containers:
            if isinstance(container, ErrorbarContainer):
                apart |= self._errorbar(container)
            elif isinstance(container, BarContainer):
                apart |= self._bars(container)
        # In the order in which they cover each other.
        for one in sorted(axis.get_children(), key=lambda one: one.get_zorder()):
            if one in apart or not one.get_visible():
                continue
            if isinstance(one, Line2D):
                self._line(one)
            elif isinstance(one, PolyCollection):
                self._band(one)
            elif isinstance(one, LineCollection):
                self._segments(one)
            elif isinstance(one, Rectangle) and one is not axis.patch:
                self._span(one)
        for text in axis.texts:
            self._text(text)

    def _scale(self, which: str, anchor: str) -> dict[str, Any]:
        """Return an axis of the layout."""
        side = getattr(self.axis, f"{which}axis")
        log = side.get_scale() == "log"
        limits = np.array(side.get_view_interval(), dtype=float)
        if log:
            limits = np.log10(limits)
        found: dict[str, Any] = {"anchor": anchor, "title": {
            "text": side.get_label_text().replace("\n", "<br>")}}
        if which == "x" and not self.rows:
            unit = side.get_label_text().partition(" — ")[0].rpartition(", ")[2]
            found["unifiedhovertitle"] = {"text": f"%{{x:.6~g}} {unit}" if ", " in
                                          side.get_label_text() and not self.dates else "%{x}"}
        if which == "x" and self.dates:
            limits = limits * _DAY
            found["type"] = "date"
        elif log:
            found["type"] = "log"
        if log or _has_words(side):
            places = side.get_majorticklocs()
            found |= {"tickvals": [float(one) for one in places],
                      "ticktext": [f"{at:g}" if "$" in text else text for at, text in zip(
                          places, side.get_major_formatter().format_ticks(places), strict=True)]}
        found["range"] = [float(f"{one:.8g}") if found.get("type") != "date" else one
                          for one in limits.tolist()]
        return found

    def _trace(self, x: np.ndarray, y: np.ndarray, label: str, colour: Any, **more: Any) -> dict:
        """Add a trace and return it."""
        if self.dates:
            x = np.asarray(x, dtype=float) * _DAY
        named = bool(label) and not label.startswith("_")
        again = any(one["legend"] == self.legend and one["name"] == label for one in self.data)
        group = to_hex(to_rgba(colour), keep_alpha=False)
        made = {"type": "scatter", "x": numbers(x, exact=self.dates), "y": numbers(y),
                "xaxis": self.x, "yaxis": self.y, "legend": self.legend,
                "legendgroup": group, "showlegend": named and not again,
                "name": label if named else "", "axis_words": self.words,
                "hovertemplate": self._hover()} | more
        self.data.append(made)
        return made

    def _hover(self) -> str:
        """Return how a value is written beside the cursor."""
        if self.rows:
            return "%{x:.4~g}"
        return "%{y:.5~g}" + (f" {self.unit}" if self.unit else "")

    def _line(self, line: Line2D) -> None:
        """Add a curve, marks, or a level across the axes."""
        on_x, on_y = _in_data(line.get_transform(), self.axis)
        if not (on_x and on_y):
            self._level(line, upright=on_x)
            return
        x, y = line.get_xydata().T if len(line.get_xdata()) else np.empty((2, 0))
        if not np.isfinite(y).any():
            return
        self._trace(x, y, str(line.get_label()), line.get_color(), **_look(line))

    def _level(self, line: Line2D, upright: bool) -> None:
        """Add a line all across the axes: axhline or axvline."""
        at = line.get_xdata()[0] if upright else line.get_ydata()[0]
        at = float(at) * (_DAY if upright and self.dates else 1.0)
        label = str(line.get_label())
        shape = {"type": "line", "layer": "below" if line.get_zorder() < 1 else "above",
                 "line": {"color": to_hex(line.get_color()), "width": line.get_linewidth(),
                          "dash": _dash(line)}} | self._box(upright, at, at)
        if label and not label.startswith("_"):
            shape |= {"name": label, "showlegend": True, "legend": self.legend}
        self.layout["shapes"].append(shape)

    def _box(self, upright: bool, low: float, high: float) -> dict[str, Any]:
        """Return where a shape lies that goes all across the axes."""
        if upright:
            return {"x0": low, "x1": high, "xref": self.x, "y0": 0, "y1": 1,
                    "yref": f"{self.y} domain"}
        return {"x0": 0, "x1": 1, "xref": f"{self.x} domain", "y0": low, "y1": high,
                "yref": self.y}

    def _span(self, box: Rectangle) -> None:
        """Add a shaded stretch: axvspan or axhspan."""
        upright, flat = _in_data(box.get_data_transform(), self.axis)
        if upright == flat:
            return
        low = box.get_x() if upright else box.get_y()
        high = low + (box.get_width() if upright else box.get_height())
        scale = _DAY if upright and self.dates else 1.0
        shape = {"type": "rect", "layer": "below", "line": {"width": 0},
                 "fillcolor": _rgba(box.get_facecolor())} | self._box(
                     upright, float(low * scale), float(high * scale))
        label = str(box.get_label())
        if label and not label.startswith("_"):
            shape |= {"name": label, "showlegend": True, "legend": self.legend}
        self.layout["shapes"].append(shape)

    def _band(self, band: PolyCollection) -> None:
        """Add a band between two curves."""
        parts = [path.vertices for path in band.get_paths() if len(path.vertices)]
        if not parts:
            return
        points = np.concatenate([np.vstack([part, [[np.nan, np.nan]]]) for part in parts])[:-1]
        colour = band.get_facecolor()[0]
        self._trace(*points.T, str(band.get_label()), colour, mode="lines", fill="toself",
                    line={"width": 0, "color": _rgba(colour)}, fillcolor=_rgba(colour),
                    hoverinfo="skip", hovertemplate=None)

    def _segments(self, lines: LineCollection) -> None:
        """Add strokes such as those of an autocorrelation; the cursor reads their upper ends."""
        parts = [part for part in lines.get_segments() if len(part)]
        if not parts:
            return
        points = np.concatenate([np.vstack([part, [[np.nan, np.nan]]]) for part in parts])[:-1]
        colour = lines.get_color()[0]
        self._trace(*points.T, str(lines.get_label()), colour, mode="lines", hoverinfo="skip",
                    line={"color": _rgba(colour), "width": float(lines.get_linewidth()[0])},
                    hovertemplate=None)
        ends = np.array([part[-1] for part in parts])
        self._trace(*ends.T, "", colour, mode="markers", marker={"opacity": 0, "size": 6},
                    showlegend=False)

    def _errorbar(self, container: ErrorbarContainer) -> set:
        """Add marks with their bars; returns all that matplotlib made for them."""
        marks, caps, bars = container
        mine = {*([marks] if marks is not None else []), *caps, *bars}
        if marks is None or not len(marks.get_xdata()):
            return mine
        x, y = np.asarray(marks.get_xydata(), dtype=float).T
        more = {}
        for collection in bars:
            ends = np.array([part for part in collection.get_segments() if len(part) == 2])
            if len(ends) != len(x):
                continue
            way = 0 if np.ptp(ends[:, :, 0]) and np.allclose(ends[:, 0, 1], ends[:, 1, 1]) else 1
            centre = (x, y)[way]
            scale = _DAY if way == 0 and self.dates else 1.0
            more["error_x" if way == 0 else "error_y"] = {
                "type": "data", "symmetric": False, "width": 2 if caps else 0,
                "array": numbers(scale * (ends[:, 1, way] - centre)),
                "arrayminus": numbers(scale * (centre - ends[:, 0, way])),
                "color": _rgba(collection.get_color()[0]),
                "thickness": float(collection.get_linewidth()[0])}
        self._trace(x, y, str(container.get_label()), marks.get_color(), **_look(marks), **more)
        return mine

    def _bars(self, container: BarContainer) -> set:
        """Add upright bars."""
        boxes = list(container)
        if boxes:
            self._trace(np.array([box.get_x() + 0.5 * box.get_width() for box in boxes]),
                        np.array([box.get_height() for box in boxes]),
                        str(container.get_label()), boxes[0].get_facecolor(), type="bar",
                        width=float(boxes[0].get_width()),
                        marker={"color": _rgba(boxes[0].get_facecolor())})
        return set(boxes)

    def _text(self, text: Any) -> None:
        """Add a text at its place, which is in data or in shares of the axes."""
        if not text.get_text().strip():
            return
        shift = (0.0, 0.0)
        if hasattr(text, "xyann"):
            (x, y), shift = text.xy, text.xyann
            across, up = ((text.xycoords,) * 2 if isinstance(text.xycoords, str)
                          else text.xycoords)
            on_x, on_y = across == "data", up == "data"
        else:
            x, y = text.get_position()
            on_x, on_y = _in_data(text.get_transform(), self.axis)
        if on_x and self.dates:
            x = matplotlib.dates.date2num(x) * _DAY
        elif on_x and self.axis.get_xscale() == "log":
            x = np.log10(x)
        if on_y and self.axis.get_yscale() == "log":
            y = np.log10(y)
        box = text.get_bbox_patch()
        self.layout["annotations"].append({
            "text": text.get_text().strip().replace("\n", "<br>"), "showarrow": False,
            "x": float(x), "y": float(y), "xref": self.x + ("" if on_x else " domain"),
            "yref": self.y + ("" if on_y else " domain"),
            "xanchor": text.get_horizontalalignment(),
            "yanchor": {"baseline": "bottom", "center_baseline": "middle", "center": "middle"}.get(
                text.get_verticalalignment(), text.get_verticalalignment()),
            "xshift": float(shift[0]) * 4 / 3, "yshift": float(shift[1]) * 4 / 3,
            "font": {"size": 12, "color": to_hex(text.get_color())}, "borderpad": 1,
            **({"bgcolor": "rgba(255,255,255,0.75)"} if box is not None else {})})


def numbers(values: np.ndarray, exact: bool = False) -> dict[str, str]:
    """Return an array as plotly.js reads it: base64 of little-endian floats.

    Four bytes a number where no eye sees the rounding, else eight.
    """
    values = np.asarray(values, dtype=float)
    finite = values[np.isfinite(values)]
    short = finite.size and not exact and float(np.spacing(np.float32(
        np.abs(finite).max()))) <= _FINEST * float(np.ptp(finite))
    with np.errstate(over="ignore"):
        raw = values.astype("<f4" if short else "<f8")
    return {"dtype": "f4" if short else "f8", "bdata": base64.b64encode(raw).decode("ascii")}


def _has_words(side: Axis) -> bool:
    """Tell whether the ticks are rows with names, not a scale."""
    shown = side.get_major_formatter()
    return isinstance(shown, FixedFormatter) or (
        isinstance(side.get_major_locator(), FixedLocator)
        and not isinstance(shown, ScalarFormatter))


def _is_date(axis: Axes) -> bool:
    """Tell whether the x axis counts days."""
    return isinstance(axis.xaxis.get_major_locator(), matplotlib.dates.DateLocator)


def _in_data(transform: Transform, axis: Axes) -> tuple[bool, bool]:
    """Tell for x and for y whether a place is given in the data's numbers."""
    return transform.contains_branch_seperately(axis.transData)


def _look(line: Line2D) -> dict[str, Any]:
    """Return how a line and its marks look."""
    colour = to_rgba(line.get_color(), line.get_alpha())
    found: dict[str, Any] = {}
    drawn, marked = line.get_linestyle() not in ("None", "", " "), line.get_marker() in _MARKERS
    found["mode"] = "+".join([*(["lines"] if drawn else []), *(["markers"] if marked else [])]) \
        or "lines"
    if drawn:
        found["line"] = {"color": _rgba(colour), "width": float(line.get_linewidth()),
                         "dash": _dash(line)}
    if marked:
        found["marker"] = {"symbol": _MARKERS[line.get_marker()],
                           "size": 1.25 * float(line.get_markersize()),
                           "color": _rgba(to_rgba(line.get_markerfacecolor(), line.get_alpha())),
                           "line": {"color": _rgba(to_rgba(line.get_markeredgecolor())),
                                    "width": float(line.get_markeredgewidth())}}
    return found


def _dash(line: Line2D) -> str:
    return _DASHES.get(line.get_linestyle(), "solid")


def _rgba(colour: Any) -> str:
    """Return a colour as the page's script knows it: ``#rrggbb``, or with its opacity."""
    red, green, blue, alpha = to_rgba(colour)
    if alpha >= 1.0:
        return to_hex((red, green, blue))
    return "rgba({},{},{},{:.3g})".format(*(round(255 * one) for one in (red, green, blue)), alpha)
