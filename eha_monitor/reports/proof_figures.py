"""Figures of a trial: detection by strength, reliability, and parameters found against true."""

import numpy as np

from eha_monitor.mismatch.diagnosis import Curve as MissingTerm
from eha_monitor.mismatch.diagnosis import Diagnosis, Location, NamedEffect
from eha_monitor.prove.curves import wilson
from eha_monitor.reports.diagnosis_figures import curve_figure, informative
from eha_monitor.reports.figure import (
    ERROR_LINE,
    INK,
    MEASURED,
    OTHER,
    STAGE_ONE,
    WIDTH,
    Bars,
    Curve,
    Figure,
    Level,
    Panel,
    Side,
    Span,
    Text,
)
from eha_monitor.words import effect_words

# What was said -> colour, marker, words; drawn in this order.
_MARKS = {
    "nothing": (MEASURED, "circle", "nothing"),
    "unexplained": ("#E69F00", "square", "unexplained"),
    "wrong": (ERROR_LINE, "x", "another name"),
    "class": (STAGE_ONE, "diamond", "its declared class"),
    "exact": (OTHER, "circle", "its name"),
}
_ROW, _PARAMETER_ROW = 19, 21  # pixels of a row
_LEAST = 0.1  # units at which the axis begins
_RELIABILITY = 470  # pixels of the height of the reliability diagram
_MOST_ROWS = 40  # in one picture
_SHOWN = 0.5  # of the truth: farther off is drawn at the edge
_STRENGTH = "strength, relative to what an oracle just detects"


def detection_figure(found: dict) -> Figure | None:
    """Draw every single effect as a mark: effect against strength, coloured by what was said."""
    detection = found["detection"]
    if not detection:
        return None
    by_units = any(one["units"] is not None for one in detection)
    names = sorted({one["effect"] for one in detection}, reverse=True)
    panel = Panel(Side(_STRENGTH if by_units else "strength; 1 is clear", log=True),
                  Side(rows=tuple(effect_words(name) for name in names)))
    if by_units:
        panel.add(Level(1.0, dash="dot", upright=True))
        points = [(names.index(name), curve["point_95"])
                  for name, curve in found["detection_curves"].items() if name in names]
        if points:
            row, at = np.array(points, dtype=float).T
            panel.add(Curve(at, row, "95 % point", width=0.0, error_width=2.0, legend=False,
                                y_error=np.full(len(at), 0.42)))
    for said, (colour, marker, words) in _MARKS.items():
        mine = [one for one in detection if one["said"] == said
                and (not by_units or one["units"] is not None)]
        if mine:
            at = [max(one["units"], _LEAST) if by_units else one["strength"] for one in mine]
            panel.add(Curve(np.array(at), np.array([names.index(one["effect"]) for one in mine]),
                            words, colour, 0.0, marker=marker, size=7.5, opacity=0.85,
                            edge="#ffffff"))
    return Figure((panel,), "result for each single concealed effect, by its strength",
                  size=(WIDTH, 110 + _ROW * max(len(names), 4)))


def detection_curve(found: dict) -> Figure | None:
    """Draw the share of right names against strength in units of what can just be detected."""
    curve, bins = found["detection_curves"].get("all"), found["detection_bins"]
    if curve is None or not bins:
        return None
    units = np.geomspace(_LEAST, max(30.0, bins[-1]["units"]), 200)
    at, value, low, high = (np.array([one[key] for one in bins])
                            for key in ("units", "share", "low", "high"))
    panel = Panel(Side(_STRENGTH, log=True), Side("right name or declared class",
                                                  limits=(-0.04, 1.06)))
    panel.add(Curve(units, 1.0 / (1.0 + (curve["middle"] / units) ** curve["slope"]),
                    "fitted curve", STAGE_ONE, 2.0),
              Curve(at, value, "share, with its 68 % interval", INK, 0.0, marker="circle",
                    y_error=np.maximum([value - low, high - value], 0.0)),
              Level(1.0, dash="dot", upright=True),
              Level(curve["point_95"], f"95 % at {curve['point_95']:.2g}", ERROR_LINE, 1.4,
                    upright=True))
    return Figure((panel,), "probability of the right name against strength")


def reliability_figure(found: dict) -> Figure | None:
    """Draw the share that was correct against the stated probability, counts below it."""
    bins = found.get("reliability") or []
    if not bins:
        return None
    said, right, count = (np.array([one[key] for one in bins]) for key in ("said", "right", "n"))
    low, high = wilson(right, count)
    ends = (-0.02, 1.02)
    above = Panel(Side(limits=ends), Side("share that was correct", limits=(-0.04, 1.06)))
    above.add(Curve(np.array([0.0, 1.0]), np.array([0.0, 1.0]),
                    "calibrated: right as often as stated", INK, 1.0, "dot"),
              Curve(said, right, "from stated to actual", ERROR_LINE, 0.0, opacity=0.35,
                        error_width=5.0, y_error=np.maximum([right - said, said - right], 0.0)),
              Curve(said, right, "share that was correct, with its 68 % interval", STAGE_ONE, 0.0,
                    marker="circle", cap=2.5,
                    y_error=np.maximum([right - low, high - right], 0.0)))
    # Most statements are sure ones: on a linear scale the bins between would be invisible.
    below = Panel(Side("stated probability", limits=ends),
                  Side("statements", log=True, limits=(0.6, 6.0 * count.max())))
    below.add(Bars(np.array([0.5 * (one["low"] + one["high"]) for one in bins]), count, 0.092))
    error = found["score"].get("calibration_error")
    words = "" if error is None else f", expected calibration error {100 * error:.1f} %"
    return Figure((above, below), f"how often a statement was correct against its "
                                  f"probability{words}", (3.0, 1.0), (WIDTH, _RELIABILITY))


def missing_term(answer: dict | None) -> Figure | None:
    """Draw the most informative curve of an answer; None where it has none."""
    if not answer or not answer.get("curves"):
        return None

    def numbers(values: list) -> np.ndarray:
        return np.array([np.nan if value is None else value for value in values], dtype=float)

    curves = tuple(MissingTerm(one["balance"], one["against"], one["against_unit"], one["unit"],
                               *(numbers(one[name]) for name in ("x", "measured", "spread",
                                                                 "modelled")))
                   for one in answer["curves"])
    effects = tuple(NamedEffect(one["name"], one["balance"], "", {}, 0.0)
                    for one in answer["effects"])
    said = Diagnosis((), answer["verdict"], "", Location(answer["location"]["balance"], "", ()),
                     effects, {}, {}, "", {}, curves)
    shown = informative(said)
    return curve_figure(said, shown[0]) if shown else None


def parameter_figures(rows: list[dict]) -> list[Figure]:
    """Draw each parameter's found value over its true one, ± one standard deviation."""
    rows = [row for row in rows if row["true"]]
    return [_parameters(rows[i:i + _MOST_ROWS][::-1]) for i in range(0, len(rows), _MOST_ROWS)]


def _parameters(rows: list[dict]) -> Figure:
    """Draw some rows, the last on top."""
    edge = 100.0 * _reach(rows)
    panel = Panel(Side("found, in % off the truth; bars are ± one standard deviation",
                       limits=(-1.12 * edge, 1.12 * edge)),
                  Side(rows=tuple(_label(row) for row in rows)))
    aims = [row["aim"] for row in rows if row["aim"]]
    if aims:
        panel.add(Span(-100.0 * max(aims), 100.0 * max(aims), "", OTHER, 0.12, True))
    panel.add(Level(0.0, upright=True))
    for place, row in enumerate(rows):
        if row["said"] is None:
            panel.add(Text(0.0, place, "not named", ERROR_LINE))
            continue
        off = 100.0 * (row["said"] / row["true"] - 1.0)
        bar = min(100.0 * row["stddev"] / abs(row["true"]), edge)
        colour = MEASURED if not row["aim"] else OTHER if row["within"] else ERROR_LINE
        at = float(np.clip(off, -edge, edge))
        panel.add(Curve(np.array([at]), np.array([place]), "", colour, 0.0, marker="circle",
                        size=7.5, x_error=np.array([bar]), error_width=1.6))
        if abs(off) > edge:
            panel.add(Text(at, place, f"{off:+.0f} %", colour, "right" if off > 0 else "left",
                           shift=(-12 if off > 0 else 12, 0)))
    return Figure((panel,), "parameters found against true ones",
                  size=(WIDTH, 100 + _PARAMETER_ROW * max(len(rows), 4)))


def _reach(rows: list[dict]) -> float:
    """Return how far the axis reaches, relative: what most need, at least twice the aim."""
    errors = [row["relative"] for row in rows if row["relative"] is not None]
    aim = max((row["aim"] for row in rows), default=0.0)
    return float(np.clip(max(errors, default=0.0), max(1.5 * aim, 0.02), _SHOWN))


def _label(row: dict) -> str:
    """Return a row's name: group, then the parameter in words."""
    effect, dot, symbol = row["name"].partition(".")
    name = f"{symbol} of {effect_words(effect)}" if dot else row["name"]
    return f"{row['group']}: {name}"
