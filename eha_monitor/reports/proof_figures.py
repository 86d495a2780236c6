"""Pictures of a trial: who was found at which strength, and the pooled detection curve."""

import numpy as np
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from eha_monitor.mismatch.diagnosis import Curve, Diagnosis, Location, NamedEffect
from eha_monitor.prove.curves import wilson
from eha_monitor.reports.diagnosis_figures import curve_picture, telling
from eha_monitor.reports.drawing import (
    ERROR_LINE,
    INK,
    MEASURED,
    OTHER,
    STAGE_ONE,
    Picture,
    legend_above,
    new_figure,
    picture,
)
from eha_monitor.words import effect_words

# What was said -> colour, marker, words; drawn in this order.
MARKS = {
    "nothing": (MEASURED, "o", "nothing"),
    "unexplained": ("#E69F00", "s", "unexplained"),
    "wrong": (ERROR_LINE, "X", "another name"),
    "class": (STAGE_ONE, "D", "its declared class"),
    "exact": (OTHER, "o", "its name"),
}
ROW = 19  # pixels of an effect's row
LEAST = 0.1  # units at which the axis begins
RELIABILITY = 470  # pixels of the height of the reliability diagram


def detection_picture(found: dict) -> Picture | None:
    """Draw every single effect as a mark: effect against strength, coloured by what was said."""
    detection = found["detection"]
    if not detection:
        return None
    by_units = any(one["units"] is not None for one in detection)
    names = sorted({one["effect"] for one in detection}, reverse=True)
    figure, (axis,) = new_figure(height=110 + ROW * max(len(names), 4))
    for said, (colour, marker, words) in MARKS.items():
        mine = [one for one in detection if one["said"] == said
                and (not by_units or one["units"] is not None)]
        if mine:
            at = [max(one["units"], LEAST) if by_units else one["strength"] for one in mine]
            axis.plot(at, [names.index(one["effect"]) for one in mine], linestyle="",
                      marker=marker, markersize=6, color=colour, label=words, alpha=0.85,
                      markeredgecolor="white", markeredgewidth=0.5)
    axis.set_xscale("log")
    if by_units:
        axis.axvline(1.0, color=INK, linewidth=1.0, linestyle=":")
        for name, curve in found["detection_curves"].items():
            if name in names:
                place = names.index(name)
                axis.plot([curve["point_95"]] * 2, [place - 0.42, place + 0.42], color=INK,
                          linewidth=2.0)
    axis.set_yticks(range(len(names)), [effect_words(name) for name in names])
    axis.set_ylim(-0.8, len(names) - 0.2)
    axis.margins(x=0.04)
    axis.set_xlabel("strength, relative to what an oracle just detects" if by_units
                    else "strength; 1 is clear")
    axis.legend(ncols=3, loc="lower right", bbox_to_anchor=(1.02, 1.0), borderaxespad=0.1,
                columnspacing=1.4, frameon=False, fontsize=9.5)
    return picture(figure, "result for each single concealed effect, by its strength")


def curve_of_all(found: dict) -> Picture | None:
    """Draw the share of right names against strength in units of what can just be seen."""
    curve, bins = found["detection_curves"].get("all"), found["detection_bins"]
    if curve is None or not bins:
        return None
    figure, (axis,) = new_figure()
    units = np.geomspace(LEAST, max(30.0, bins[-1]["units"]), 200)
    axis.plot(units, 1.0 / (1.0 + (curve["middle"] / units) ** curve["slope"]), color=STAGE_ONE,
              linewidth=2.0, label="fitted curve")
    at = np.array([one["units"] for one in bins])
    value = np.array([one["share"] for one in bins])
    bars = [value - [one["low"] for one in bins], [one["high"] for one in bins] - value]
    axis.errorbar(at, value, np.maximum(bars, 0.0), linestyle="", marker="o", color=INK,
                  elinewidth=0.9, label="share, with its 68 % interval")
    axis.axvline(1.0, color=INK, linewidth=1.0, linestyle=":")
    axis.axvline(curve["point_95"], color=ERROR_LINE, linewidth=1.4,
                 label=f"95 % at {curve['point_95']:.2g}")
    axis.set_xscale("log")
    axis.set_ylim(-0.04, 1.06)
    axis.set_xlabel("strength, relative to what an oracle just detects")
    axis.set_ylabel("right name or declared class")
    legend_above(axis)
    return picture(figure, "probability of the right name against strength")


def reliability_picture(found: dict) -> Picture | None:
    """Draw the share that was correct against the stated probability, counts below it."""
    bins = found.get("reliability") or []
    if not bins:
        return None
    figure, (above, below) = new_figure(2, ratios=(3.0, 1.0), height=RELIABILITY)
    said = np.array([one["said"] for one in bins])
    right = np.array([one["right"] for one in bins])
    count = np.array([one["n"] for one in bins])
    above.plot([0.0, 1.0], [0.0, 1.0], color=INK, linewidth=1.0, linestyle=":",
               label="calibrated: right as often as stated")
    low, high = wilson(right, count)
    above.vlines(said, np.minimum(right, said), np.maximum(right, said), color=ERROR_LINE,
                 linewidth=5.0, alpha=0.35, label="from stated to actual")
    above.errorbar(said, right, [right - low, high - right], linestyle="", marker="o",
                   color=STAGE_ONE, elinewidth=0.9, capsize=2.5,
                   label="share that was correct, with its 68 % interval")
    above.set_ylim(-0.04, 1.06)
    above.set_ylabel("share that was correct")
    legend_above(above)
    middles = [0.5 * (one["low"] + one["high"]) for one in bins]
    below.bar(middles, count, width=0.092, color=MEASURED)
    for at, n in zip(middles, count, strict=True):
        below.annotate(str(n), (at, n), xytext=(0, 2), textcoords="offset points",
                       ha="center", va="bottom", fontsize=9.5, color=INK)
    # Most statements are sure ones: on a linear scale the bins between could not be seen.
    below.set_yscale("log")
    below.set_ylim(0.6, 6.0 * count.max())
    below.yaxis.set_major_locator(LogLocator(10.0, numticks=4))
    below.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    below.yaxis.set_minor_locator(NullLocator())
    below.set_ylabel("statements")
    below.set_xlim(-0.02, 1.02)
    below.set_xticks(np.linspace(0.0, 1.0, 11))
    below.set_xlabel("stated probability")
    error = found["score"].get("calibration_error")
    words = "" if error is None else f", expected calibration error {100 * error:.1f} %"
    return picture(figure, f"how often a statement was correct against its probability{words}")


def missing_term(answer: dict | None) -> Picture | None:
    """Draw the curve that an answer holds as most telling; None where it has none."""
    if not answer or not answer.get("curves"):
        return None

    def numbers(values: list) -> np.ndarray:
        return np.array([np.nan if value is None else value for value in values], dtype=float)

    curves = tuple(Curve(one["balance"], one["against"], one["against_unit"], one["unit"],
                         *(numbers(one[name]) for name in ("x", "measured", "spread",
                                                           "modelled")))
                   for one in answer["curves"])
    effects = tuple(NamedEffect(one["name"], one["balance"], "", {}, 0.0)
                    for one in answer["effects"])
    said = Diagnosis((), answer["verdict"], "", Location(answer["location"]["balance"], "", ()),
                     effects, {}, {}, "", {}, curves)
    shown = telling(said)
    return curve_picture(said, shown[0]) if shown else None
