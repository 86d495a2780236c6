"""The alarm timeline: one lane for each alarm, events as numbered marks."""

from dataclasses import dataclass

import numpy as np
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from eha_monitor.filters.results import Event
from eha_monitor.health.alarms import Alarm
from eha_monitor.reports.drawing import (
    INK,
    LEVEL_COLOURS,
    Block,
    new_figure,
    picture,
)
from eha_monitor.reports.quantities import time_scale

ALARM_WORDS = {"viscous_damping_high": "viscous damping B high",
               "viscous_damping_low": "viscous damping B low",
               "bulk_modulus_high": "bulk modulus βe high",
               "bulk_modulus_low": "bulk modulus βe low"}


@dataclass(frozen=True)
class Span:
    """A level that an alarm had from ``start`` to ``stop``, s."""

    start: float
    stop: float
    level: str


def alarm_words(name: str) -> str:
    """Return an alarm's name as people say it."""
    return ALARM_WORDS.get(name, name.replace("_", " "))


def spans(name: str, alarms: tuple[Alarm, ...], history: tuple[Alarm, ...], duration: float
          ) -> list[Span]:
    """Return the levels of one alarm over the record, from its changes.

    Before the first known change nothing is claimed.
    """
    changes = sorted((a for a in (*history, *alarms) if a.name == name
                      and np.isfinite(a.time_s)), key=lambda a: a.time_s)
    found: list[Span] = []
    for i, change in enumerate(changes):
        stop = changes[i + 1].time_s if i + 1 < len(changes) else duration
        start = float(np.clip(change.time_s, 0, duration))
        stop = float(np.clip(stop, start, duration))
        if found and found[-1].level == change.level and found[-1].stop >= start:
            found[-1] = Span(found[-1].start, stop, change.level)
        elif stop > start or i + 1 == len(changes):
            found.append(Span(start, stop, change.level))
    return found


def alarm_block(alarms: tuple[Alarm, ...], history: tuple[Alarm, ...],
                events: tuple[Event, ...], duration: float) -> Block:
    """Return the timeline with a lane for each alarm and a mark for each event."""
    names = list(dict.fromkeys(alarm.name for alarm in (*alarms, *history)))
    if not names and not events:
        return Block("alarms", "Alarm timeline",
                     notes=("No alarm is configured and no event happened.",))
    if not duration > 0:
        return Block("alarms", "Alarm timeline", notes=("The recording has no duration.",))
    clock = time_scale(duration)
    lanes = max(len(names), 1)
    figure, (axis,) = new_figure(height=120 + 44 * lanes + (40 if events else 0), width=1180)
    end = duration * clock.factor
    for row, name in enumerate(names):
        for span in spans(name, alarms, history, duration):
            _lane(axis, row, span, clock.factor, end)
    axis.set_ylim(lanes - 0.4, -0.6 - (0.75 if events else 0.0))
    axis.set_yticks(range(len(names)), [alarm_words(name) for name in names])
    axis.tick_params(axis="y", length=0)
    axis.grid(False, axis="y")
    axis.spines["left"].set_visible(False)
    axis.set_xlim(0, end)
    axis.xaxis.set_major_locator(MaxNLocator(12))
    axis.set_xlabel(f"time, {clock.unit}")
    for place, label in _event_labels(events, clock.factor, end):
        axis.axvline(place, color=INK, linewidth=1.0, linestyle=(0, (2, 2)))
        axis.text(place, -0.95, label, ha="center", va="center", fontsize=9, color="white",
                  bbox={"boxstyle": "round,pad=0.28", "facecolor": INK, "edgecolor": "none"},
                  clip_on=False)
    axis.legend(handles=[Patch(facecolor=colour, label=level,
                               hatch="////" if level == "STALE" else None, edgecolor="white")
                         for level, colour in LEVEL_COLOURS.items()],
                loc="lower left", bbox_to_anchor=(0, 1.0), ncols=4, borderaxespad=0.1)
    notes = ("Numbered marks are the events of the table below.",) if events else ()
    return Block("alarms", "Alarm timeline", pictures=(picture(
        figure, "level of each alarm over time: " + "; ".join(
            f"{alarm_words(a.name)} {a.level}" for a in alarms)),), notes=notes)


def _lane(axis, row: int, span: Span, factor: float, end: float) -> None:
    start, length = span.start * factor, (span.stop - span.start) * factor
    length = max(length, 0.002 * end)  # the last change may come with the last sample
    start = min(start, end - length)
    axis.broken_barh([(start, length)], (row - 0.36, 0.72), linewidth=0.8, edgecolor="white",
                     facecolor=LEVEL_COLOURS.get(span.level, LEVEL_COLOURS["STALE"]),
                     hatch="////" if span.level == "STALE" else None)
    if length > 0.07 * end:
        axis.text(start + 0.5 * length, row, span.level, ha="center", va="center", fontsize=9,
                  color="white" if span.level == "ERROR" else INK, fontweight="bold",
                  bbox={"facecolor": LEVEL_COLOURS["STALE"], "edgecolor": "none", "pad": 1.0}
                  if span.level == "STALE" else None)


def _event_labels(events: tuple[Event, ...], factor: float, end: float
                  ) -> list[tuple[float, str]]:
    """Return places and labels; marks that would overlap share a label such as ``2–4``."""
    groups: list[list[tuple[float, int]]] = []
    for i, event in enumerate(events, start=1):
        if not np.isfinite(event.time_s):
            continue
        place = float(np.clip(event.time_s * factor, 0, end))
        if groups and place - groups[-1][0][0] < 0.035 * end:
            groups[-1].append((place, i))
        else:
            groups.append([(place, i)])
    return [(group[0][0], str(group[0][1]) if len(group) == 1
             else f"{group[0][1]}–{group[-1][1]}") for group in groups]
