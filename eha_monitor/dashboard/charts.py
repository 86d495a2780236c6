"""The charts as ECharts options: the frame once, then only what moves."""

import math
from collections.abc import Iterable

import numpy as np

from eha_monitor.dashboard.history import Row
from eha_monitor.dashboard.state import ESTIMATES_SPAN, POSITION_SPAN, STAGES
from eha_monitor.quantity import FLOOR, Scale

_INK, _LINE, _MEASURED = "#37474f", "#1565c0", "#6d4c41"
_BAND = "rgba(21, 101, 192, 0.18)"
_LIMIT_COLOURS = {"WARN": "#b26a00", "ERROR": "#b3261e"}
_STAGE_COLOURS = ("#1565c0", "#00695c")
_STAGE_WORDS = ("stage one", "stage two")
_MARGIN = 0.08
_OFF_THE_LINE = (5, 8)  # of a line's label along and across it, pixels
# The time axis is at least this long; it grows to the whole span as the history does, s.
_LEAST_SPAN = 30.0
# A value that is less sure than this share of itself does not stretch the axis.
_UNSURE = 0.3


def _frame(time_axis: dict, value_name: str, series: list[dict], legend: list,
           value_type: str = "value") -> dict:
    """Return what all charts have in common; nothing in it is animated."""
    return {
        "animation": False,
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
        _line("limits", "", _INK)]
    legend = ["estimate", {"name": "±1σ", "icon": "rect", "itemStyle": {"opacity": 1}}]
    return _frame(_time_of_day(), scale.unit, series, legend)


def estimate_data(rows: list[Row], limits: list[tuple[str, str, float]], scale: Scale,
                  now: float) -> dict:
    """Return what moves in the chart of an estimate.

    Parameters
    ----------
    rows : (time of day s, value, stddev), SI.
    limits : side (``low``, ``high``), degree and SI value of each threshold.
    now : time of day, the right end of the axis, s.
    """
    marks = [_limit_mark(side, degree, limit * scale.factor) for side, degree, limit in limits]
    values = [(1e3 * t, value * scale.factor,
               scale.factor * max(stddev, FLOOR * abs(value))) for t, value, stddev in rows]
    sure = [v for _, v, s in values if s < _UNSURE * abs(v)]
    low, high = value_range(sure, (mark["yAxis"] for mark in marks))
    return {
        "xAxis": _time_range(rows, now),
        "yAxis": {"min": low, "max": high},
        "series": [
            {"id": "lower", "data": [[t, _round(v - s)] for t, v, s in values]},
            {"id": "width", "data": [[t, _round(2 * s)] for t, v, s in values]},
            {"id": "value", "data": [[t, _round(v)] for t, v, _ in values]},
            {"id": "limits", "markLine": {"symbol": "none", "silent": True, "data": marks}}]}


def _limit_mark(side: str, degree: str, limit: float) -> dict:
    """Return a threshold; ERROR is written on the far side of its line, WARN on the near one."""
    above = (side == "high") == (degree == "ERROR")
    colour = _LIMIT_COLOURS[degree]
    return {"yAxis": limit,
            "label": {"formatter": f"{degree} {limit:g}", "color": colour,
                      "position": "insideStartTop" if above else "insideStartBottom",
                      "distance": _OFF_THE_LINE},
            "lineStyle": {"color": colour, "type": "dashed" if degree == "WARN" else "solid"}}


def _time_range(rows: list[Row], now: float) -> dict:
    """Return the ends of the time axis, ms: from the oldest row, within bounds."""
    first = min(rows[0][0] if rows else now, now - _LEAST_SPAN)
    return {"min": round(1e3 * max(first, now - ESTIMATES_SPAN)), "max": round(1e3 * now)}


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
    return frame


def residual_data(histories: dict[str, list[Row]], now: float) -> dict:
    """Return what moves in the chart of the innovations; rows (time of day s, NIS, ratio)."""
    series, largest, least = [], 10.0, 0.1
    for stage, rows in histories.items():
        for place, key in ((1, "nis"), (2, "variance")):
            data = [[1e3 * row[0], _round(row[place]) if row[place] > 0 else None] for row in rows]
            numbers = [v for _, v in data if v]
            largest, least = max([largest, *numbers]), min([least, *numbers])
            series.append({"id": f"{stage}_{key}", "data": data})
    return {"xAxis": _time_range(min(histories.values(), key=_first), now),
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


def _first(rows: list[Row]) -> float:
    return rows[0][0] if rows else math.inf


def _round(value: float) -> float | None:
    """Return six digits, which halves what is sent; None, a gap, for NaN."""
    return float(f"{value:.6g}") if math.isfinite(value) else None
