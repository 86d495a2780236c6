"""A described figure as a chart of plotly.js, which zooms and reads values off in a browser.

The script comes from the Python package ``plotly``, of which nothing is imported.  Packed (gzip,
base64) it takes 2 MB of a page instead of 5; a browser unpacks it in a few hundredths of a
second.  Where the package is missing, pages hold the still images alone.
"""

import base64
import gzip
import importlib.util
import json
import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from eha_monitor.output import finite
from eha_monitor.reports import figure as fig

_GAP, _GAP_WITH_LABEL = 0.07, 0.22  # between panels, share of the height
_LETTER = 9.5  # of an axis' title with the room about it, pixels
_FINEST = 2e-5  # share of the range below which a rounding is invisible


@lru_cache(maxsize=1)
def packed_library() -> str:
    """Return plotly.js as base64 of its gzip; empty where the package is not installed."""
    found = importlib.util.find_spec("plotly")
    for folder in found.submodule_search_locations or () if found else ():
        script = Path(folder, "package_data", "plotly.min.js")
        if script.is_file():
            # Without a time of its own, so that the same answer gives the same page.
            return base64.b64encode(gzip.compress(script.read_bytes(), 6, mtime=0)).decode("ascii")
    return ""


def chart_json(figure: fig.Figure) -> str:
    """Return :func:`chart` as JSON."""
    return json.dumps(finite(chart(figure)), separators=(",", ":"), ensure_ascii=False,
                      allow_nan=False)


def chart(figure: fig.Figure) -> dict[str, Any]:
    """Return ``data`` and ``layout`` of plotly.js, and what the page's script needs to know.

    That is the ``clock``, the units of the x axis for each second of the recording where that is
    its axis, and whether the y axis has ``rows``.
    """
    layout: dict[str, Any] = {"shapes": [], "annotations": []}
    data: list[dict[str, Any]] = []
    for place, (panel, domain) in enumerate(zip(figure.panels, _domains(figure), strict=True), 1):
        number = "" if place == 1 else str(place)
        own = "" if figure.shared else number
        _Drawing(fig.in_units(panel, 1e3), f"x{own}", f"y{number}", layout, data).draw(
            own, number, domain, (domain[1] - domain[0]) * figure.size[1])
    clock = figure.panels[-1].x.scale.factor if figure.on_time else None
    return {"data": data, "layout": layout, "clock": clock, "rows": bool(figure.panels[0].y.rows)}


def _domains(figure: fig.Figure) -> list[tuple[float, float]]:
    """Return the share of the height that each panel has, the first on top."""
    ratios = np.array(figure.ratios, dtype=float)
    gaps = [_GAP if figure.shared else _GAP_WITH_LABEL for _ in figure.panels[1:]]
    heights = (1.0 - sum(gaps)) * ratios / ratios.sum()
    top, found = 1.0, []
    for height, gap in zip(heights, [*gaps, 0.0], strict=True):
        found.append((round(max(top - height, 0.0), 4), round(top, 4)))
        top -= height + gap
    return found


class _Drawing:
    """Adds one panel to the data and the layout of a chart."""

    def __init__(self, panel: fig.Panel, x: str, y: str, layout: dict, data: list):
        self.panel, self.x, self.y, self.layout, self.data = panel, x, y, layout, data
        self.legend = f"legend{y[1:]}"
        self.hover = "%{x:.4~g}" if panel.y.rows else (
            "%{y:.5~g}" + (f" {panel.y.unit}" if panel.y.unit else ""))

    def draw(self, x_number: str, y_number: str, domain: tuple[float, float], height: float
             ) -> None:
        """Add scales, legend and all that is shown."""
        self.layout[f"xaxis{x_number}"] = self._scale("x", self.y)  # the lowest has the words
        upright = self._scale("y", self.x) | {"domain": list(domain)}
        if len(upright["title"]["text"]) * _LETTER > height:
            upright["title"]["text"] = upright["title"]["text"].replace(", ", ",<br>")
        self.layout[f"yaxis{y_number}"] = upright
        self.layout[self.legend] = {"y": round(domain[1] + 0.01, 4)}
        for one in self.panel.shown:
            getattr(self, f"_{type(one).__name__.lower()}")(one)

    def _scale(self, which: str, anchor: str) -> dict[str, Any]:
        side, ends = getattr(self.panel, which), self.panel.ends(which)
        found: dict[str, Any] = {"anchor": anchor,
                                 "title": {"text": side.words.replace("\n", "<br>")}}
        if which == "x" and not self.panel.y.rows:
            found["unifiedhovertitle"] = {"text": f"%{{x:.6~g}} {side.unit}" if side.unit
                                          and not side.dates else "%{x}"}
        if side.log:
            found["type"], ends = "log", tuple(math.log10(end) for end in ends)
        elif side.dates:
            found["type"] = "date"
        if (ticks := self.panel.ticks(which)) is not None:
            found["tickvals"], found["ticktext"] = ticks
        found["range"] = [end if side.dates else float(f"{end:.8g}") for end in ends]
        return found

    def _trace(self, x: np.ndarray, y: np.ndarray, label: str, colour: str, legend: bool = True,
               **more: Any) -> None:
        again = any(one["legend"] == self.legend and one["name"] == label for one in self.data)
        self.data.append({
            "type": "scatter", "x": numbers(x, exact=self.panel.x.dates), "y": numbers(y),
            "xaxis": self.x, "yaxis": self.y, "legend": self.legend, "legendgroup": colour,
            "showlegend": bool(label) and legend and not again, "name": label,
            "hovertemplate": self.hover} | more)

    def _curve(self, one: fig.Curve) -> None:
        mode = [*(["lines"] if one.width else []), *(["markers"] if one.marker else [])]
        look: dict[str, Any] = {"mode": "+".join(mode)}
        if not mode:  # strokes, at whose ends the cursor reads
            look = {"mode": "markers", "marker": {"opacity": 0, "size": one.size}}
        if one.width:
            look["line"] = {"color": rgba(one.colour, one.opacity), "width": one.width,
                            "dash": one.dash}
        if one.marker:
            look["marker"] = {"symbol": one.marker, "size": one.size,
                              "color": rgba(one.face or one.colour, one.opacity),
                              "line": {"color": one.colour, "width": 1.0}}
        for key, error in (("error_x", one.x_error), ("error_y", one.y_error)):
            if error is not None:
                below, above = np.broadcast_to(error, (2, len(one.x)))
                look[key] = {"type": "data", "symmetric": False, "width": one.cap,
                             "array": numbers(above), "arrayminus": numbers(below),
                             "color": rgba(one.error_colour or one.colour, one.opacity),
                             "thickness": one.error_width}
        self._trace(one.x, one.y, one.label, one.colour, one.legend, **look)

    def _band(self, one: fig.Band) -> None:
        colour = rgba(one.colour, one.opacity)
        here = np.flatnonzero(np.isfinite(one.low) & np.isfinite(one.high))
        parts = np.split(here, np.flatnonzero(np.diff(here) > 1) + 1) if len(here) else []
        nothing = np.array([np.nan])
        # Out along the upper edge and back along the lower one, each part by itself.
        x, y = (np.concatenate([np.r_[a[part], b[part][::-1], nothing] for part in parts])[:-1]
                if parts else nothing for a, b in ((one.x, one.x), (one.high, one.low)))
        self._trace(x, y, one.label, one.colour, mode="lines", fill="toself", fillcolor=colour,
                    line={"width": 0, "color": colour}, hoverinfo="skip", hovertemplate=None)

    def _bars(self, one: fig.Bars) -> None:
        self._trace(one.x, one.height, self.panel.y.name, fig.MEASURED, False, type="bar",
                    width=one.width, marker={"color": fig.MEASURED})
        for number in one.numbers:
            self._text(number)

    def _level(self, one: fig.Level) -> None:
        self._shape(one, one.at, one.at, {
            "type": "line", "layer": "above",
            "line": {"color": one.colour, "width": one.width, "dash": one.dash}})

    def _span(self, one: fig.Span) -> None:
        self._shape(one, one.low, one.high, {
            "type": "rect", "layer": "below", "line": {"width": 0},
            "fillcolor": rgba(one.colour, one.opacity)})

    def _shape(self, one: fig.Level | fig.Span, low: float, high: float, shape: dict[str, Any]
               ) -> None:
        """Add a shape that goes all across the panel."""
        if one.upright:
            shape |= {"x0": low, "x1": high, "xref": self.x, "y0": 0, "y1": 1,
                      "yref": f"{self.y} domain"}
        else:
            shape |= {"x0": 0, "x1": 1, "xref": f"{self.x} domain", "y0": low, "y1": high,
                      "yref": self.y}
        if one.label:
            shape |= {"name": one.label, "showlegend": True, "legend": self.legend}
        self.layout["shapes"].append(shape)

    def _text(self, one: fig.Text) -> None:
        x = math.log10(one.x) if self.panel.x.log and not one.x_share else one.x
        y = math.log10(one.y) if self.panel.y.log and not one.y_share else one.y
        self.layout["annotations"].append({
            "text": one.words.replace("\n", "<br>"), "showarrow": False, "x": float(x),
            "y": float(y), "xref": self.x + (" domain" if one.x_share else ""),
            "yref": self.y + (" domain" if one.y_share else ""), "xanchor": one.across,
            "yanchor": one.up, "xshift": one.shift[0], "yshift": one.shift[1], "borderpad": 1,
            "font": {"size": 12, "color": one.colour}, "bgcolor": "rgba(255,255,255,0.75)"})


def numbers(values: np.ndarray, exact: bool = False) -> dict[str, str]:
    """Return an array as plotly.js reads it: base64 of little-endian floats.

    Four bytes a number where no eye sees the rounding, else eight.
    """
    values = np.asarray(values, dtype=float)
    finite = values[np.isfinite(values)]
    with np.errstate(over="ignore"):  # of a filter that has diverged, beyond what four bytes hold
        short = finite.size and not exact and float(np.spacing(np.float32(
            np.abs(finite).max()))) <= _FINEST * float(np.ptp(finite))
        raw = values.astype("<f4" if short else "<f8")
    return {"dtype": "f4" if short else "f8", "bdata": base64.b64encode(raw).decode("ascii")}


def rgba(colour: str, opacity: float) -> str:
    """Return ``#rrggbb`` with an opacity, as the page's script and CSS know it.

    >>> rgba("#0072B2", 0.2), rgba("#0072B2", 1.0)
    ('rgba(0,114,178,0.2)', '#0072B2')
    """
    if opacity >= 1.0:
        return colour
    red, green, blue = (int(colour[i:i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity:.3g})"
