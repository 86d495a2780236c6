"""From tables, figures and sentences to one HTML file that needs nothing else."""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup, escape

from eha_monitor import __version__
from eha_monitor.estimation.results import Event
from eha_monitor.health.alarms import NO_LIMIT, Alarm
from eha_monitor.indicators import indicator
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.own_term import ADDED_UNITS
from eha_monitor.quantity import NOTE, number, quantity
from eha_monitor.reports.figure import Figure, time_scale
from eha_monitor.reports.plotly_chart import chart_json, packed_library
from eha_monitor.reports.still_image import image_uri
from eha_monitor.reports.traces import LARGEST
from eha_monitor.settings.monitor import Settings
from eha_monitor.units import keys_of
from eha_monitor.words import effect_words, listed

_HEADING = re.compile(r"<h2(?: id=\"([^\"]*)\")?>(.*?)</h2>", re.DOTALL)
_MOST_OPEN = 6  # rows of a long table that are shown without a click


@dataclass(frozen=True)
class Cell:
    """A cell of a table."""

    text: str
    kind: str = ""  # classes of its look: ``value``, ``number``, ``key``, ``message``, ``good``
    note: str = ""  # in small letters under the text
    badge: str = ""  # level or status that is set off by its colour, behind the text
    level: str = ""  # names that colour where the badge itself does not
    # value and standard deviation, SI, for whoever reads the page by program
    exact: tuple[float, float | None] | None = None
    title: str = ""  # what a mouse that rests there reads
    mark: str = ""  # name of the number for programs
    link: str = ""  # address that the text leads to


@dataclass(frozen=True)
class Table:
    """Rows of cells under a head; on a phone each row is a card with the heads as labels.

    ``rest`` rows are shown on request; ``key`` is the id in the page, ``note`` stands below.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    key: str = ""
    note: str = ""
    rest: tuple[tuple[Cell, ...], ...] = ()

    def __bool__(self) -> bool:
        return bool(self.rows)


@dataclass(frozen=True)
class FirstScreen:
    """What fits on one screen: the verdict, the picture, B and beta_e, and what to do."""

    kind: str  # ``ok``, ``warn``, ``error`` or ``unknown``: the colour of the verdict
    head: str  # its first words; ``message`` is its sentence, which the ``doubts`` limit
    message: str
    doubts: tuple[str, ...] = ()
    # what is wrong with the config, said before the verdict, each with its doubt or ""
    wrong: tuple[tuple[str, str], ...] = ()
    picture: Figure | None = None
    caption: str = ""
    parameters: Table | None = None  # B and beta_e, and what is to be read of them
    sentences: tuple[str, ...] = ()  # what the verdict means for them
    actions: tuple[str, ...] = ()  # what to do, the most important first
    verdict: str = ""  # for programs
    channels: tuple[str, ...] = ()  # what stands against the channels, said before all


@dataclass(frozen=True)
class Contents:
    """A page's text with an id at each heading, and id and words of each."""

    body: Markup
    links: tuple[tuple[str, Markup], ...]


def table(head: str | Sequence[str], rows: Sequence[Sequence[str | Cell]],
          kinds: str | Sequence[str] = "", key: str = "", note: str = "", fold: bool = False
          ) -> Table:
    """Return a table.

    Parameters
    ----------
    head : names of the columns, one by one or with ``|`` between.
    rows : of cells; those that are text get the look of their column.
    kinds : looks of the columns, in the same way.
    fold : whether a long one shows its first rows only, until more are requested.
    """
    names, looks = (tuple(part.strip() for part in one.split("|")) if isinstance(one, str)
                    else tuple(one) for one in (head, kinds or [""] * len(head)))
    made = tuple(tuple(one if isinstance(one, Cell) else Cell(str(one), looks[i])
                       for i, one in enumerate(row)) for row in rows)
    shown = _MOST_OPEN if fold and len(made) > _MOST_OPEN + 2 else len(made)
    return Table(names, made[:shown], key, note, made[shown:])


@lru_cache(maxsize=1)
def _environment() -> jinja2.Environment:
    made = jinja2.Environment(
        loader=jinja2.PackageLoader("eha_monitor.reports"), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.filters |= {"contents": contents, "for_script": for_script, "image": image_uri,
                     "chart": chart_json, "coded": coded}
    return made


def render(template: str, **context: Any) -> str:
    """Return a page of ``templates/``; every value is HTML-escaped.

    plotly.js and the page's own script go into it where there is a chart to draw.
    """
    library = packed_library()
    text = _environment().get_template(template).render(
        **{"version": __version__, "plus_minus": NOTE, "interactive": bool(library), **context})
    if library and '<script type="application/json">' in text:
        own = resources.files("eha_monitor.reports").joinpath("templates/charts.js").read_text(
            encoding="utf-8")
        text = text.replace("</body>", f'<script type="text/plain" id="plotly">{library}</script>'
                                       f"\n<script>\n{own}</script>\n</body>")
    return text


def contents(body: Markup) -> Contents:
    """Return what a list of contents needs: headings without an id get one of their words.

    >>> contents(Markup("<h2>Measured and estimated motion</h2>")).links
    (('measured-and-estimated-motion', Markup('Measured and estimated motion')),)
    """
    links: list[tuple[str, Markup]] = []

    def marked(found: re.Match) -> str:
        words = Markup(found[2])
        key = found[1] or "-".join(re.findall(r"\w+", words.striptags().lower()))
        links.append((key, words))
        return f'<h2 id="{key}">{words}</h2>'

    return Contents(Markup(_HEADING.sub(marked, str(body))), tuple(links))


def coded(text: str) -> Markup:
    """Return an escaped text in which what stands between backticks is code.

    No line ends behind the hyphens of an option.

    >>> coded("run `advise <bag> --json A`")
    Markup('run <code>advise &lt;bag&gt; <span>--json</span> A</code>')
    """
    def code(found: re.Match) -> str:
        words = re.sub(r"(?<!\S)--[a-z-]+", r"<span>\g<0></span>", found[1])
        return f"<code>{words}</code>"

    return Markup(re.sub("`([^`]*)`", code, str(escape(text))))


def for_script(text: str) -> Markup:
    """Return JSON so that nothing in it ends the script element that holds it."""
    return Markup(text.replace("<", "\\u003c").replace("\u2028", "\\u2028"))


_SECTIONS = ("rig", "noise", "stage_one", "stage_two", "thresholds", "viscosity", "health")
_GENERAL = ("discretisation", "command_hold")


def with_limits(first: FirstScreen, indicators: Sequence[Indicator], settings: Settings
                ) -> FirstScreen:
    """Return a first screen that leads with the indicators beyond their limits, if any are."""
    beyond = [f"{one.words} of {one.shown} is beyond its limit" for one in indicators
              if indicator.passed(one, settings)]
    if not beyond:
        return first
    head = first.head if first.head.startswith("Alarm") else "Alarm" if first.kind in (
        "ok", "unknown") else f"Alarm and {first.head[:1].lower()}{first.head[1:]}"
    return replace(first, kind="error", head=head, message=f"{listed(beyond)}; {first.message}")


def indicator_table(indicators: Sequence[Indicator], settings: Settings) -> Table | None:
    """Return the indicators with their limits, those without a value last; None without any."""
    if not indicators:
        return None
    first = [one for one in indicators if not one.silent]
    last = [one for one in indicators if one.silent]
    rows = tuple(
        (Cell(one.words, title=one.law),
         Cell(one.shown, "value", exact=(one.value, one.stddev)
              if one.status == indicator.AVAILABLE else None),
         Cell(_limit_words(one, settings), "number", level="ERROR",
              badge="beyond its limit" if indicator.passed(one, settings) else ""),
         Cell(one.message, "message")) for one in (*first, *last))
    shown = len(first) or len(rows)
    return Table(("indicator", "value", "limit", "conditions, or why there is no value"),
                 rows[:shown], "indicators", "", rows[shown:])


def law_table(indicators: Sequence[Indicator]) -> Table:
    """Return the equation of each indicator."""
    return table("indicator | equation, and its limits",
                 [(one.words, one.law) for one in indicators], " | message")


def _limit_words(one: Indicator, settings: Settings) -> str:
    """Return the limits of an indicator, ``below 50 mL/min``, or ``not set``."""
    low, high = indicator.limits_of_indicator(one.name, settings)
    parts = [f"{words} {number(limit, 3)} {one.unit}"
             for words, limit in (("above", low), ("below", high)) if limit is not None]
    return ", ".join(parts) or "not set"


def config_tables(settings: Settings) -> list[tuple[str, Table]]:
    """Return the values of the config, in words: title and table of each section."""
    def titled(title: str, rows: Iterator | list) -> tuple[str, Table]:
        return title, table("key | value | what it is", list(rows), " | number | note")

    found = [titled(f"{_plain(key).capitalize()}: {Settings.model_fields[key].description or ''}",
                    [(_plain(name), _config_value(value, unit), about or "")
                     for name, value, unit, about in keys_of(getattr(settings, key))])
             for key in _SECTIONS]
    found.append(titled("Equations", [
        (_plain(key), str(getattr(settings, key)), Settings.model_fields[key].description or "")
        for key in _GENERAL]))
    terms = [(f"{effect_words(effect)}, {p.name}", quantity(values[p.name], p.unit, 6),
              p.description)
             for effect, values in settings.effects.items() if effect in CATALOGUE
             for p in CATALOGUE[effect].parameters if p.name in values]
    if terms := terms + [_own_row(name, values) for name, values in settings.effects.items()
                         if name not in CATALOGUE]:
        found.append(titled("Effects beyond the linear model", terms))
    return found


def _own_row(name: str, values: dict) -> tuple[str, str, str]:
    """Return the row of a term of the rig's own."""
    if "expression" in values:
        with_ = ", ".join(f"{key} = {value:g}" for key, value in values.items()
                          if key not in ("adds", "expression"))
        text = f"{values['expression']}{f' with {with_}' if with_ else ''}"
    else:
        text = (f"{len(values['values'])} values over {values['of']}, {values['first']:g} to "
                f"{values['last']:g}")
    return (_plain(name), text, f"user-defined term, adds to the {values['adds']} in "
                                f"{ADDED_UNITS[values['adds']]}")


def _plain(key: str) -> str:
    return key.replace("_", " ").replace(".", ", ")


def _config_value(value: Any, unit: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return quantity(float(value), unit, 6)
    return "not set" if value is None else str(value)


# ---- lanes over the time of a recording ---------------------------------------------------------
#
# They are HTML, not a picture, so that they fill a wide screen and stay readable on a phone.

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
    groups: list[tuple[float, list[str]]] = []
    for i, event in enumerate(events, start=1):
        if not np.isfinite(event.time_s):
            continue
        place = float(np.clip(100 * event.time_s / duration, 0, 100))
        if not groups or place - groups[-1][0] >= _OVERLAP:
            groups.append((place, []))
        groups[-1][1].append(str(i))
    return tuple(Mark(round(place, 3), "–".join(dict.fromkeys((numbers[0], numbers[-1]))))
                 for place, numbers in groups)
