"""Lanes over the time of a recording: levels of alarms, intervals in which something acts.

They are HTML, not a picture, so that they fill a wide screen and stay readable on a phone.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eha_monitor.estimation.results import Event
from eha_monitor.health.alarms import NO_LIMIT, Alarm
from eha_monitor.quantity import number
from eha_monitor.reports.figure import time_scale
from eha_monitor.reports.traces import LARGEST

_ALARM_WORDS = {"viscous_damping_high": "B high", "viscous_damping_low": "B low",
                "bulk_modulus_high": "βe high", "bulk_modulus_low": "βe low"}
_OVERLAP = 5.5  # percent of the width within which two marks share a label
_MOST_TICKS = 8
_STEPS = (1.0, 2.0, 2.5, 3.0, 5.0, 6.0, 10.0)  # between ticks, times a power of ten


@dataclass(frozen=True)
class Span:
    """A level, as its word, that an alarm had from ``start`` to ``stop``, s."""

    start: float
    stop: float
    level: str


@dataclass(frozen=True)
class Bar:
    """A span as it is drawn: percent of the width, and whether its name fits inside."""

    left: float
    width: float
    level: str
    title: str
    named: bool


@dataclass(frozen=True)
class Mark:
    """A place on the time axis in percent of the width, with its label."""

    left: float
    label: str


@dataclass(frozen=True)
class Timeline:
    """What the page draws; without lanes and marks ``note`` says why."""

    lanes: tuple[tuple[str, tuple[Bar, ...]], ...] = ()
    marks: tuple[Mark, ...] = ()
    ticks: tuple[Mark, ...] = ()
    unit: str = "s"
    note: str = ""


def alarm_words(name: str) -> str:
    """Return an alarm's name as people say it."""
    return _ALARM_WORDS.get(name, name.replace("_", " "))


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
        if found and found[-1].level == change.word and found[-1].stop >= start:
            found[-1] = Span(found[-1].start, stop, change.word)
        elif stop > start or i + 1 == len(changes):
            found.append(Span(start, stop, change.word))
    return found


def alarm_timeline(alarms: tuple[Alarm, ...], history: tuple[Alarm, ...],
                   events: tuple[Event, ...], duration: float) -> Timeline:
    """Return the timeline of a recording of ``duration`` seconds."""
    # Without a limit there is no level, and no OK.
    alarms, history = (tuple(one for one in several if one.message != NO_LIMIT)
                       for several in (alarms, history))
    names = list(dict.fromkeys(alarm.name for alarm in (*alarms, *history)))
    if not names and not events:
        return Timeline(note="No alarm has a limit, and there was no event.")
    if not duration > 0:
        return Timeline(note="The recording has no duration, so there is no timeline.")
    lanes = tuple((alarm_words(name), tuple(_bar(span, duration) for span in
                                            spans(name, alarms, history, duration)))
                  for name in names)
    return _over(duration, lanes, _marks(events, duration))


def interval_timeline(name: str, intervals_s: Sequence[tuple[float, float]], duration: float
                      ) -> Timeline | None:
    """Return a lane of intervals, s, on the time of the recording; None where there are none."""
    known = [(start, stop) for start, stop in intervals_s
             if math.isfinite(start) and math.isfinite(stop)]
    end = max([duration, *(stop for _, stop in known)])
    if not (known and 0 < end < LARGEST):
        return None
    return _over(end, ((name, tuple(_bar(Span(max(start, 0.0), stop, ""), end)
                                    for start, stop in known)),))


def _over(duration: float, lanes: tuple, marks: tuple[Mark, ...] = ()) -> Timeline:
    """Return lanes over an axis of ``duration`` seconds, in the unit that suits it."""
    clock = time_scale(duration)
    end = duration * clock.factor
    power = 10.0 ** math.floor(math.log10(end / _MOST_TICKS))
    step = next(one * power for one in _STEPS if end / (one * power) <= _MOST_TICKS)
    ticks = tuple(Mark(100 * i * step / end, f"{i * step:g}")
                  for i in range(int(end / step * 1.0001) + 1))
    return Timeline(lanes, marks, ticks, clock.unit)


def _bar(span: Span, duration: float) -> Bar:
    width = max(100 * (span.stop - span.start) / duration, 0.3)  # the last may have no length
    left = min(100 * span.start / duration, 100 - width)
    words = f"{number(span.start)} s to {number(span.stop)} s"
    return Bar(round(left, 3), round(width, 3), span.level,
               f"{span.level} from {words}" if span.level else words,
               bool(span.level) and width > 14)


def _marks(events: tuple[Event, ...], duration: float) -> tuple[Mark, ...]:
    """Return places and labels; marks that would overlap share a label such as ``2–4``."""
    groups: list[tuple[float, list[int]]] = []
    for i, event in enumerate(events, start=1):
        if not np.isfinite(event.time_s):
            continue
        place = float(np.clip(100 * event.time_s / duration, 0, 100))
        if groups and place - groups[-1][0] < _OVERLAP:
            groups[-1][1].append(i)
        else:
            groups.append((place, [i]))
    return tuple(Mark(round(place, 3), str(numbers[0]) if len(numbers) == 1
                      else f"{numbers[0]}–{numbers[-1]}") for place, numbers in groups)
