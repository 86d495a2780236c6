"""What is drawn: the charts as ECharts options, and the actuator as a cylinder.

Of a chart the frame is sent once, then only what moves.  The drawing of the cylinder is sent
once; its piston follows two CSS variables, so that the browser moves it smoothly between two
positions.
"""

import math
import time
from collections.abc import Iterable
from html import escape

import numpy as np

from eha_monitor.dashboard.state import POSITION_SPAN, STAGES, Limit, Row
from eha_monitor.quantity import FLOOR, Scale, readable

_INK, _LINE, _MEASURED, _DOUBTED = "#37474f", "#1565c0", "#6d4c41", "#78909c"
_BAND = "rgba(21, 101, 192, 0.18)"
_LIMIT_COLOURS = {"WARN": "#b26a00", "ERROR": "#b3261e"}
_STAGE_COLOURS = ("#1565c0", "#b34700")  # apart for every kind of colour vision
_STAGE_WORDS = ("stage one", "stage two")
_MARGIN = 0.13
_OFF_THE_LINE = (5, 8)  # of a line's label along and across it, pixels
# The time axis is at least this long; it grows to the whole span as the history does, s.
_LEAST_SPAN = 30.0
_UNSURE = 0.3  # a value that is less sure than this share of itself does not stretch the axis


def _frame(time_axis: dict, value_name: str, series: list[dict], legend: list,
           value_type: str = "value") -> dict:
    """Return what all charts have in common; nothing in it is animated."""
    return {
        "animation": False,
        # One clock everywhere on the page, the rig's: times are handed over as those of its zone.
        "useUTC": True,
        "textStyle": {"color": _INK},
        "grid": {"left": 22, "right": 52, "top": 42, "bottom": 6, "containLabel": True},
        "legend": {"data": legend, "top": 0, "left": 0, "itemWidth": 26, "itemHeight": 8,
                   "itemStyle": {"opacity": 0}},
        "tooltip": {"trigger": "axis", "confine": True},
        "xAxis": time_axis,
        "yAxis": {"type": value_type, "name": value_name, "nameLocation": "end", "scale": True,
                  "nameTextStyle": {"align": "left"}, "nameGap": 8, "position": "right",
                  "axisLabel": {"showMinLabel": False, "showMaxLabel": False}},
        "series": series}


def _zoomable(frame: dict) -> dict:
    """Return a frame in which a stretch of time is chosen by dragging, without its buttons."""
    unseen = {"zoom": "path://M0,0", "back": "path://M0,0"}
    frame["toolbox"] = {"itemSize": 1, "showTitle": False, "right": 0, "top": 0,
                        "feature": {"dataZoom": {"yAxisIndex": "none", "icon": unseen,
                                                 "filterMode": "none"}}}
    return frame


def zone_s() -> int:
    """Return how far the rig's zone is ahead of UTC, s."""
    return time.localtime().tm_gmtoff


def _milliseconds(time_s: float, zone: int) -> int:
    return round(1e3 * (time_s + zone))


def ends_of(first: float, now: float, span: float | None) -> tuple[float, float]:
    """Return the ends of a time axis, s: the last ``span`` s, as far as there is data.

    ``first`` is the time of the oldest row, infinite where there is none; a ``span`` of None is
    all.
    """
    oldest = min(first, now - _LEAST_SPAN)
    return (oldest if span is None else max(oldest, now - span)), now


def _time_of_day() -> dict:
    return {"type": "time", "splitNumber": 4, "axisLabel": {"hideOverlap": True},
            "axisLine": {"onZero": False}}


def _line(key: str, name: str, colour: str, **more) -> dict:
    return {"id": key, "name": name, "type": "line", "symbol": "none", "data": [],
            "lineStyle": {"color": colour, "width": 2}, "itemStyle": {"color": colour}, **more}


def estimate_frame(scale: Scale) -> dict:
    """Return the chart of one estimate: value, ±1σ band, thresholds."""
    # ECharts draws a band as two stacked lines: the lower edge, unseen, and the width on it.
    edge = {"stack": "band", "stackStrategy": "all", "lineStyle": {"opacity": 0},
            "silent": True, "tooltip": {"show": False}}
    filled = {"areaStyle": {"color": _BAND, "opacity": 1}}
    series = [
        _line("lower", "", _LINE) | edge,
        _line("width", "±1σ", _BAND) | edge | filled,
        _line("value", "estimate", _LINE),
        _line("doubted", "in doubt", _DOUBTED, lineStyle={
            "color": _DOUBTED, "width": 1.5, "type": "dotted"}),
        _line("limits", "", _INK)]
    legend = ["estimate", {"name": "±1σ", "icon": "rect", "itemStyle": {"opacity": 1}}, "in doubt"]
    return _zoomable(_frame(_time_of_day(), scale.unit, series, legend))


def estimate_data(rows: list[Row], limits: list[Limit], scale: Scale,
                  ends: tuple[float, float]) -> dict:
    """Return what moves in the chart of an estimate.

    Parameters
    ----------
    rows : (time of day s, value, stddev, 1 where it is in doubt), SI.
    limits : the thresholds.
    ends : of the time axis, time of day, s.
    """
    zone = zone_s()
    marks = [_limit_mark(limit, scale) for limit in limits]
    values = [(_milliseconds(t, zone), value * scale.factor,
               scale.factor * max(stddev, FLOOR * abs(value)), doubt != 0.0)
              for t, value, stddev, doubt in rows]
    # What is in doubt stretches no axis, unless there is nothing else.
    sure = [v for _, v, s, doubt in values if s < _UNSURE * abs(v) and not doubt] or [
        v for _, v, s, _ in values if s < _UNSURE * abs(v)]
    low, high = value_range(sure, (mark["yAxis"] for mark in marks))
    return {
        "xAxis": _time_range(ends, zone),
        "yAxis": {"min": low, "max": high},
        "series": [
            {"id": "lower", "data": [[t, _shown(v - s, not d)] for t, v, s, d in values]},
            {"id": "width", "data": [[t, _shown(2 * s, not d)] for t, v, s, d in values]},
            {"id": "value", "data": [[t, _shown(v, not d)] for t, v, _, d in values]},
            {"id": "doubted", "data": [[t, _shown(v, d)] for t, v, _, d in values]},
            {"id": "limits", "markLine": {"symbol": "none", "silent": True, "data": marks}}]}


def _limit_mark(limit: Limit, scale: Scale) -> dict:
    """Return a threshold; ERROR is written on the far side of its line, WARN on the near one.

    High ones at the left end, low ones at the right: close ones do not lie over each other.
    """
    high, error = limit.side == "high", limit.degree == "ERROR"
    end, above = "Start" if high else "End", high == error
    colour = _LIMIT_COLOURS[limit.degree]
    at = "" if limit.drawn == limit.value else f" at {limit.temperature:g} °C"
    return {"yAxis": limit.drawn * scale.factor,
            "label": {"formatter": f"{limit.degree} {limit.value * scale.factor:g}{at}",
                      "color": colour,
                      "position": f"inside{end}{'Top' if above else 'Bottom'}",
                      "distance": _OFF_THE_LINE},
            "lineStyle": {"color": colour, "type": "solid" if error else "dashed"}}


def _time_range(ends: tuple[float, float], zone: int) -> dict:
    return {"min": _milliseconds(ends[0], zone), "max": _milliseconds(ends[1], zone)}


def value_range(values: list[float], limits: Iterable[float]) -> tuple[float, float]:
    """Return the ends of an axis that shows the thresholds and nearly all values.

    The first values of a filter lie anywhere; one in fifty may leave the axis at either end,
    but never the last one.
    """
    shown = [v for v in values if math.isfinite(v)]
    ends = list(limits)
    if shown:
        ends += [*np.percentile(shown, (2, 98)), shown[-1]]
    if not ends:
        return 0.0, 1.0
    low, high = min(ends), max(ends)
    margin = _MARGIN * (high - low) or 0.1 * abs(high) or 1.0
    floor = 0.0 if low >= 0 else -math.inf
    step = 10.0 ** math.floor(math.log10(high - low + 2 * margin)) / 10
    return (max(floor, float(step * math.floor((low - margin) / step))),
            float(step * math.ceil((high + margin) / step)))


def residual_frame() -> dict:
    """Return the chart of the innovations of both stages; 1 is what the filter expects."""
    series = []
    for stage, words, colour in zip(STAGES, _STAGE_WORDS, _STAGE_COLOURS, strict=True):
        series.append(_line(f"{stage}_nis", f"{words}, size", colour))
        dashed = {"color": colour, "width": 2, "type": "dashed"}
        series.append(_line(f"{stage}_variance", f"{words}, drift", colour, lineStyle=dashed))
    series[0]["markLine"] = {"symbol": "none", "silent": True, "data": [
        {"yAxis": 1.0,
         "label": {"formatter": "1: the model fits", "position": "insideStartBottom",
                   "distance": _OFF_THE_LINE},
         "lineStyle": {"color": _INK, "type": "dotted"}}]}
    frame = _frame(_time_of_day(), "", series, [s["name"] for s in series], "log")
    frame["grid"]["top"] = 62  # the legend takes two lines on a phone
    frame["yAxis"]["axisLabel"] = {}  # the ends are powers of ten
    return _zoomable(frame)


def residual_data(histories: dict[str, list[Row]], ends: tuple[float, float]) -> dict:
    """Return what moves in the chart of the innovations; rows (time of day s, NIS, ratio)."""
    series, largest, least, zone = [], 10.0, 0.1, zone_s()
    for stage, rows in histories.items():
        for place, key in ((1, "nis"), (2, "variance")):
            data = [[_milliseconds(row[0], zone), _round(row[place]) if row[place] > 0 else None]
                    for row in rows]
            numbers = [v for _, v in data if v]
            largest, least = max([largest, *numbers]), min([least, *numbers])
            series.append({"id": f"{stage}_{key}", "data": data})
    return {"xAxis": _time_range(ends, zone),
            "yAxis": {"min": 10.0 ** math.floor(math.log10(least)),
                      "max": 10.0 ** math.ceil(math.log10(largest))},
            "series": series}


def position_frame(scale: Scale) -> dict:
    """Return the chart of measured and estimated position over the last seconds."""
    axis = {"type": "value", "min": -POSITION_SPAN, "max": 0, "interval": 5,
            "axisLabel": {"formatter": "{value} s"}, "axisLine": {"onZero": False}}
    series = [_line("measured", "measured", _MEASURED),
              _line("estimated", "estimated", _LINE,
                    lineStyle={"color": _LINE, "width": 2, "type": "dashed"})]
    return _frame(axis, scale.unit, series, ["measured", "estimated"])


def position_data(histories: dict[str, list[Row]], scale: Scale) -> dict:
    """Return what moves in the chart of the position; rows (stamp s, position)."""
    last = max((rows[-1][0] for rows in histories.values() if rows), default=0.0)
    return {"series": [
        {"id": name, "data": [[_round(t - last), _round(x * scale.factor)] for t, x in rows]}
        for name, rows in histories.items()]}


def _shown(value: float, here: bool) -> float | None:
    return _round(value) if here else None


def _round(value: float) -> float | None:
    """Return six digits, which halves what is sent; None, a gap, for NaN."""
    return float(f"{value:.6g}") if math.isfinite(value) else None


# ---- the cylinder ---------------------------------------------------------------------------

# Drawing units: the barrel, and how far the piston goes to either side of its middle.
WIDTH, HEIGHT = 640, 150
_LEFT, _RIGHT, _TOP, _BOTTOM = 130, 510, 30, 100
_MIDDLE, _REACH = 0.5 * (_LEFT + _RIGHT), 150.0
_PISTON, _ROD = 24, 14
_LEAST = 1e-3


def half_range(positions: list[float]) -> float:
    """Return the position at the end of the scale: the next 1, 2 or 5 above what is shown, SI.

    >>> half_range([0.0312, -0.0399]), half_range([])
    (0.05, 0.001)
    """
    largest = max((abs(x) for x in positions if math.isfinite(x)), default=0.0)
    largest = max(largest, _LEAST)
    power = 10.0 ** math.floor(math.log10(largest * (1 - 1e-9)))
    return next(float(f"{step * power:.3g}") for step in (1, 2, 5, 10)
                if step * power >= largest * (1 - 1e-9))


def place(position: float, half: float) -> float:
    """Return how far the piston stands from the middle, in drawing units, inside the barrel."""
    if not math.isfinite(position):
        return 0.0
    return round(_REACH * max(-1.1, min(1.1, position / half)), 1)


def drawing(half: float, unit: str) -> str:
    """Return the SVG for a scale of ±``half`` (SI)."""
    scale = readable(half, unit)
    end = f"{half * scale.factor:g} {scale.unit}"
    tall = _BOTTOM - _TOP
    marks = "".join(
        f'<line x1="{x}" x2="{x}" y1="{_BOTTOM + 5}" y2="{_BOTTOM + 13}"/>'
        f'<text x="{x}" y="{_BOTTOM + 34}">{escape(text)}</text>'
        for x, text in ((_MIDDLE - _REACH, f"−{end}"), (_MIDDLE, "0"), (_MIDDLE + _REACH, end)))
    rod = f'x="-400" width="800" y="{_TOP + tall / 2 - _ROD / 2}" height="{_ROD}"'
    body = f'x="{_MIDDLE - _PISTON / 2}" width="{_PISTON}" y="{_TOP}" height="{tall}"'
    return f"""
<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img"
     aria-label="The actuator: the piston where it is measured, dashed where it is estimated">
  <defs><clipPath id="barrel">
    <rect x="{_LEFT}" y="{_TOP}" width="{_RIGHT - _LEFT}" height="{tall}"/></clipPath></defs>
  <rect class="chamber-2" x="{_LEFT}" y="{_TOP}" width="{_RIGHT - _LEFT}" height="{tall}"/>
  <g clip-path="url(#barrel)"><rect class="chamber-1 moves" x="{_MIDDLE - 1000}" y="{_TOP}"
     width="1000" height="{tall}"/></g>
  <g class="moves"><rect class="rod" transform="translate({_MIDDLE} 0)" {rod}/>
     <rect class="piston" {body}/></g>
  <rect class="barrel" x="{_LEFT}" y="{_TOP}" width="{_RIGHT - _LEFT}" height="{tall}"/>
  <rect class="estimated moves-estimated" x="{_MIDDLE - _PISTON / 2}" width="{_PISTON}"
        y="{_TOP - 9}" height="{tall + 18}"/>
  <g class="scale">{marks}</g>
</svg>"""
