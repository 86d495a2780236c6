"""Pictures of a ground of the proof: its parameters, found against true."""

import numpy as np

from eha_monitor.reports.drawing import (
    ERROR_LINE,
    INK,
    MEASURED,
    OTHER,
    Picture,
    new_figure,
    picture,
)
from eha_monitor.words import effect_words

ROW = 21  # pixels of a parameter's row
MOST_ROWS = 40  # in one picture
SHOWN = 0.5  # of the truth: farther off is drawn at the edge


def parameter_pictures(rows: list[dict]) -> list[Picture]:
    """Draw each parameter's found value over its true one, ± one standard deviation."""
    rows = [row for row in rows if row["true"]]
    return [drawn(rows[i:i + MOST_ROWS]) for i in range(0, len(rows), MOST_ROWS)]


def drawn(rows: list[dict]) -> Picture:
    """Draw some rows, the first on top."""
    figure, (axis,) = new_figure(height=100 + ROW * max(len(rows), 4))
    aims = [row["aim"] for row in rows if row["aim"]]
    if aims:
        axis.axvspan(-100.0 * max(aims), 100.0 * max(aims), color=OTHER, alpha=0.12, linewidth=0)
    axis.axvline(0.0, color=INK, linewidth=1.0)
    edge = 100.0 * limit_of(rows)
    for place, row in enumerate(reversed(rows)):
        if row["said"] is None:
            axis.text(0.0, place, " not named ", va="center", ha="center", color=ERROR_LINE,
                      fontsize=9, backgroundcolor="white")
            continue
        off = 100.0 * (row["said"] / row["true"] - 1.0)
        bar = 100.0 * row["stddev"] / abs(row["true"])
        colour = MEASURED if not row["aim"] else OTHER if row["within"] else ERROR_LINE
        at = float(np.clip(off, -edge, edge))
        axis.errorbar([at], [place], xerr=[[min(bar, edge)], [min(bar, edge)]], marker="o",
                      markersize=6, color=colour, elinewidth=1.6)
        if abs(off) > edge:
            axis.annotate(f"{off:+.0f} %", (at, place), textcoords="offset points",
                          xytext=(-9 if off > 0 else 9, 0), va="center", fontsize=9,
                          ha="right" if off > 0 else "left", color=colour)
    axis.set_yticks(range(len(rows)), [label(row) for row in reversed(rows)])
    axis.set_ylim(-0.8, len(rows) - 0.2)
    axis.set_xlim(-1.12 * edge, 1.12 * edge)
    axis.set_xlabel("found, in % off the truth; bars are ± one standard deviation")
    return picture(figure, "parameters found against true ones")


def limit_of(rows: list[dict]) -> float:
    """Return how far the axis reaches, relative: what most need, at least twice the aim."""
    errors = [row["relative"] for row in rows if row["relative"] is not None]
    aim = max((row["aim"] for row in rows), default=0.0)
    return float(np.clip(max(errors, default=0.0), max(1.5 * aim, 0.02), SHOWN))


def label(row: dict) -> str:
    """Return a row's name: group, then the parameter in words."""
    effect, dot, symbol = row["name"].partition(".")
    name = f"{symbol} of {effect_words(effect)}" if dot else row["name"]
    return f"{row['group']}: {name}"
