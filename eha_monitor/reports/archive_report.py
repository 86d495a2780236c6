"""The HTML page of a folder of bags: trends, what needs a look, and every recording."""

import math
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from eha_monitor.archive.history import (
    BEYOND,
    LEAST,
    MONTH,
    NO_LIMIT,
    NOT_YET,
    TOLD,
    Forecast,
    History,
    first_of_copies,
    history,
)
from eha_monitor.archive.store import INDICATORS, PARAMETERS, misfits
from eha_monitor.health.alarms import NOT_JUDGED
from eha_monitor.indicators.indicator import WORDS, limits_of_indicator
from eha_monitor.mismatch.diagnosis import Value
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import SYMBOLS, Scale, number, quantity, with_uncertainty
from eha_monitor.reports import figure as fig
from eha_monitor.reports.diagnosis_words import rivals, value_words
from eha_monitor.reports.estimate_figures import add_limits, far_limits, is_near, limits_of
from eha_monitor.reports.estimate_report import STATUS_WORDS
from eha_monitor.reports.page import Cell, Table, render, table
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import PARAMETER_WORDS, effect_words, probability

DAY = 86400.0  # s
_ENLARGED = 0.4  # share of the picture with the limits below which the values get one of their own
_CLOSE = "enlarged"
_INDICATOR = "#007A5A"
_SOON = 60.0  # s that a picture of a single recording spans
_FAR = 1.0  # times what has been recorded: so far ahead a picture shows
_NEVER = 50.0  # years: beyond that a date is no date


# ---- in words -------------------------------------------------------------------------------

def title_of(name: str) -> str:
    """Return the heading of a parameter or an indicator."""
    return (f"{PARAMETER_WORDS[name].capitalize()} {SYMBOLS[name]}"
            if name in PARAMETER_WORDS and name != "L"
            else WORDS[name][0].upper() + WORDS[name][1:])


def trend_words(found: History) -> str:
    """Return what the line says, in one or two sentences."""
    line = found.line
    name = SYMBOLS.get(found.name) or WORDS[found.name]
    if line is None:
        lately = int((found.reliable & (found.time >= found.since)).sum())
        undated = f", {found.undated} without a date" if found.undated else ""
        return (f"No trend of {name}: it needs {LEAST} values at different times, of a model that "
                f"fits or by least squares, {lately} there"
                f"{' since the last step' if found.outlook.jumps else ''}{undated}.")
    slope, spread = MONTH * line.slope, MONTH * line.slope_stddev
    sign = "+" if slope > 0 else ""
    words = (f"Trend of {name}: {sign}{with_uncertainty(slope, spread, found.unit)} per 30 "
             f"days, through {line.count} recordings")
    significant = abs(slope) > 2 * spread
    if line.level and significant:
        words += f" ({sign}{number(100 * slope / abs(line.level), 2)} % per 30 days)"
    words += "." if significant else ": not significant."
    if line.scatter > 0:
        words += (f" They scatter by {quantity(line.scatter, found.unit, 2)} more than their own "
                  "uncertainty, which is included in that of the slope.")
    return words


def outlook_words(found: History) -> str:
    """Return steps and the time to each limit, in sentences; empty where nothing is to say."""
    words = []
    if jumps := found.outlook.jumps:
        words.append(f"Step{'s' if len(jumps) > 1 else ''} at {', '.join(map(_day, jumps))} (a "
                     "repair, other oil): the trend restarts there.")
    words += [_forecast_words(one, found) for one in found.outlook.forecasts
              if one.status != NO_LIMIT]
    return " ".join(filter(None, words))


def _forecast_words(one: Forecast, found: History) -> str:
    """Return when a limit is reached, or why that is not known."""
    name = SYMBOLS.get(found.name) or WORDS[found.name].capitalize()
    limit = quantity(one.limit, found.unit)
    if one.status == BEYOND:
        return f"{name} is at its limit of {limit} or beyond it."
    if one.status == NOT_YET:
        return (f"Time to {limit}: cannot be predicted yet"
                + (f" (odds of growth {number(one.odds, 2)} to 1; predicted from 200 on)."
                   if math.isfinite(one.odds) else " (fewer than eight values)."))
    if one.status != TOLD:
        return f"Time to {limit}: no growth towards it."
    if not math.isfinite(one.early):
        return f"{name} grows, but does not reach {limit} within the forecast horizon."
    now = float(found.time[found.reliable][-1])

    def near(time: float) -> bool:
        return math.isfinite(time) and time - now < _NEVER * 365.25 * DAY

    late = _day(one.late) if near(one.late) else "no upper bound"
    middle = (f", median {_day(one.middle)} ({_from_now(one.middle - now)})"
              if near(one.middle) else "")
    return f"{name} reaches {limit} between {_day(one.early)} and {late} (90 % interval){middle}."


def _day(time: float) -> str:
    """Return a time, s since the epoch, as a date, UTC."""
    return datetime.fromtimestamp(time, tz=UTC).strftime("%Y-%m-%d")


def _from_now(seconds: float) -> str:
    days = seconds / DAY
    return "now" if days < 1.0 else (
        f"in {days:.0f} days" if days < 100 else f"in {days / 30.4:.0f} months")


# ---- drawn ----------------------------------------------------------------------------------

def history_block(found: History, settings: Settings) -> fig.Block:
    """Return the picture of one parameter over time, with what it says in sentences."""
    title = title_of(found.name)
    if found.at_reference:
        title += f" at {settings.viscosity.reference_temperature:g} °C"
    if not len(found.time):
        reason = ("the stamps of the recordings are not calendar times" if found.undated
                  else "no recording gives a value")
        return fig.Block(f"history-{found.name}", title, notes=(f"No picture: {reason}.",))
    lines = _lines_of(found.name, settings)
    low, high = _range(found, everything=True)
    near = [limit for limit, _ in lines if is_near(limit, low, high)]
    view = (min([low, *near]), max([high, *near]))
    notes = [*filter(None, (trend_words(found), outlook_words(found)))]
    pictures = [_figure(found, view, lines, "with the limits" if near else "all of it")]
    close = _range(found, everything=False)
    if close[1] - close[0] < _ENLARGED * (view[1] - view[0]):
        pictures.append(_figure(found, close, lines, _CLOSE))
    notes += far_limits([line for line in lines if line[0] not in near], found.unit)
    if found.undated:
        notes.append(f"{found.undated} more with stamps that are not calendar times: not shown.")
    return fig.Block(f"history-{found.name}", title, tuple(pictures), tuple(notes))


def _lines_of(name: str, settings: Settings) -> list[tuple[float, str]]:
    """Return the limits to draw, SI, each with its words."""
    sections = {"B": settings.thresholds.viscous_damping,
                "beta_e": settings.thresholds.bulk_modulus}
    if name in sections:
        return limits_of(sections[name])
    low, high = limits_of_indicator(name, settings)
    return [(limit, words) for limit, words in ((low, "limit, below"), (high, "limit, above"))
            if limit is not None]


def _range(found: History, everything: bool) -> tuple[float, float]:
    """Return the range of the values that the line goes through, with the others that are near."""
    good = found.reliable if found.reliable.any() else np.ones(len(found.time), dtype=bool)
    spread = 2 * fig.stated(found.value[good], np.nan_to_num(found.stddev[good], posinf=0.0))
    # A bar may be longer than all that there is to see.
    spread = np.minimum(spread, 2 * np.median(spread) + np.ptp(found.value[good]))
    low, high = np.min(found.value[good] - spread), np.max(found.value[good] + spread)
    if not everything:
        return float(low), float(high)
    others = found.value[~good]
    reach = 1.5 * max(high - low, 0.2 * max(abs(low), abs(high)))
    near = others[(others > low - reach) & (others < high + reach)]
    return (float(np.min(near, initial=low)), float(np.max(near, initial=high)))


def _figure(found: History, view: tuple[float, float], lines: list[tuple[float, str]],
            which: str) -> fig.Figure:
    """Draw the values, their bars and the line, with the limits that fall into ``view``, SI."""
    colour = {"B": fig.STAGE_ONE, "beta_e": fig.STAGE_TWO}.get(found.name, _INDICATOR)
    scale = fig.axis_scale(max(map(abs, view)), found.unit)
    value = found.value
    spread = fig.stated(value, np.nan_to_num(found.stddev, posinf=0.0))
    bottom, top = fig.padded(*view, 0.12)
    start, stop = float(found.time[0]), float(found.time[-1])
    last = stop if which == _CLOSE else horizon(found)
    margin = 0.04 * (last - start) or _SOON
    dates = f"{_day(start)} to {_day(stop)}" if _day(start) != _day(stop) else _day(start)
    panel = fig.Panel(fig.Side(dates, Scale(1.0, "UTC"), which, (start - margin, last + margin),
                               dates=True),
                      fig.Side(SYMBOLS.get(found.name) or WORDS[found.name], scale,
                               limits=(bottom, top)))
    if found.line is not None:
        used = found.time[found.reliable & (found.time >= found.since)]
        time = np.linspace(used[0], used[-1], 60)
        line, stddev = found.line.at(time)
        panel.add(fig.Band(time, line - stddev, line + stddev, opacity=0.13),
                  fig.Curve(time, line, "trend ± 1σ"))
    for chosen, face, words in ((found.reliable, colour, "value ± 1σ"),
                                (~found.reliable, "#ffffff", "in doubt ± 1σ")):
        here = chosen & (value > bottom) & (value < top)
        if here.any():
            panel.add(fig.Curve(found.time[here], value[here], words, colour, 0.0, marker="circle",
                                size=7.0, face=face, error_width=1.0,
                                y_error=np.minimum(spread[here], 9 * (top - bottom))))
    for outside, place, marker in ((value >= top, 0.965, "triangle-up"),
                                   (value <= bottom, 0.035, "triangle-down")):
        if outside.any():
            panel.add(fig.Curve(found.time[outside], np.full(outside.sum(), bottom + place * (
                top - bottom)), f"outside the plot ({int(outside.sum())})", colour, 0.0,
                marker=marker, size=9.0, face="#ffffff"))
    first, end = panel.ends("x")
    add_limits(panel, value, lines, found.unit, (found.time - first) / (end - first))
    _add_outlook(panel, found)
    words = (f"{title_of(found.name)} of {len(value)} recordings against the date, {which}; "
             f"{trend_words(found)} {outlook_words(found)}")
    return fig.Figure((panel,), words.rstrip())


def _add_outlook(panel: fig.Panel, found: History) -> None:
    """Add steps as upright lines and the interval of the passage as a bar on the limit."""
    for place, jump in enumerate(found.outlook.jumps):
        panel.add(fig.Level(jump, "" if place else "step", fig.INK, 1.2, "dot", upright=True))
    bottom, top = panel.ends("y")
    right = panel.ends("x")[1]
    for one in _predicted(found):
        height = one.limit
        if not bottom <= height <= top or one.early >= right:
            continue
        panel.add(fig.Curve(np.array([one.early, min(one.late, right)]), np.full(2, height),
                            "limit reached, 90 % interval", fig.ERROR_LINE, 9.0, opacity=0.35))
        if one.middle < right:
            panel.add(fig.Curve(np.array([one.middle]), np.array([height]), "median",
                                fig.ERROR_LINE, 0.0, marker="diamond", size=8.0))


def _predicted(found: History) -> list[Forecast]:
    """Return the forecasts that give a date."""
    return [one for one in found.outlook.forecasts
            if one.status == TOLD and math.isfinite(one.early)]


def horizon(found: History) -> float:
    """Return the end of a picture, s since the epoch: that of the interval, within reason."""
    last = float(found.time[-1])
    ahead = _FAR * max(last - float(found.time[0]), DAY)
    ends = [min(one.late, last + ahead) for one in _predicted(found) if one.early < last + ahead]
    return max([last, *ends])


# ---- the page -----------------------------------------------------------------------------------

# Verdict -> class of its badge, which are those of the model's status.
_FITS = {"consistent": "consistent", "mismatch": "mismatch", "unexplained": "mismatch"}


def archive_page(rows: Sequence[dict], command: str, settings: Settings, folder: Path,
                 made_with: str, reports: Mapping[str, str] | None = None,
                 machine: Path | None = None) -> str:
    """Return the page of a table as HTML text.

    Parameters
    ----------
    rows : of the table, in any order; those with another digest than ``made_with`` are marked.
    folder : of the bags.
    reports : bag -> address of its report, relative to the page.
    machine : file of the healthy machine that each bag is judged against.
    """
    reports = reports or {}
    shown = sorted(rows, key=lambda row: (row.get("start") or "", row["bag"]), reverse=True)
    name = folder.resolve().name or str(folder)  # of "." too
    diagnosed = command == "diagnose"
    heads = "recording | start, UTC | length | B | βe | alarm | model" + (
        "" if not diagnosed else " | changed" if machine else " | wrong or left out")
    return render(
        "archive.html.j2", title=f"EHA monitor: {command} of {name}", name=name,
        facts=_facts(rows, command, settings), summary=summary_words(rows, command),
        kind=_kind(rows), diagnosed=diagnosed, linked=any(row["bag"] in reports for row in shown),
        histories=[history_block(one, settings)
                   for one in histories_of(rows, command, made_with, settings)],
        effects=_effect_counts(rows), compared=machine is not None,
        broken=table("recording | why", [(row["bag"], row["error"]) for row in shown
                                         if row.get("error")], " | message error-text", "broken"),
        recordings=table(heads, [_row(row, command, made_with, reports.get(row["bag"], ""))
                                 for row in shown], key="recordings"),
        command=f"eha-monitor {command} {shlex.quote(str(folder))}/BAG "
                + (f"--machine {shlex.quote(str(machine))} " if machine else "")
                + "--report BAG.html")


def histories_of(rows: Sequence[dict], command: str, made_with: str, settings: Settings
                 ) -> list[History]:
    """Return the histories of B and beta_e, and of the indicators that any recording has."""
    found = [history(rows, name, command, made_with, settings)
             for name in (*PARAMETERS, *INDICATORS.values())]
    return [one for one in found if one.name in PARAMETERS or len(one.time)]


def _facts(rows: Sequence[dict], command: str, settings: Settings) -> list[tuple[str, str]]:
    """Return the facts at the head of the page."""
    facts = [("Command", command), ("Rig", settings.rig.name), ("Recordings", str(len(rows)))]
    if starts := [row["start"] for row in rows if row.get("start")]:
        facts += [("From", _moment(min(starts))), ("To", _moment(max(starts)))]
    seconds = sum(row.get("duration_s") or 0.0 for row in rows)
    facts.append(("Recorded", f"{number(seconds / 3600, 3)} h" if seconds > 3600 else
                  f"{number(seconds / 60, 3)} min" if seconds > 120 else
                  quantity(seconds, "s", 3)))
    if last := max((row["answered"] for row in rows if row.get("answered")), default=None):
        facts.append(("Last answer", _moment(last)))
    return facts


def summary_words(rows: Sequence[dict], command: str) -> str:
    """Return the count of what was found, in one or two sentences."""
    answered = [row for row in rows if not row.get("error")]
    broken = len(rows) - len(answered)
    alarms = Counter(row.get("alarm") for row in answered)
    parts = [f"{alarms[level]} {how}{level}" for level, how in (
        ("ERROR", "with "), ("WARN", "with "), (NOT_JUDGED, "")) if alarms[level]]
    nothing = ("no limit is set, so that no alarm was judged" if answered and set(alarms) == {None}
               else "no alarm at the end of any recording")
    words = [", ".join(parts) or nothing]
    if copies := len(answered) - len(first_of_copies(answered)):
        words.append(f"{copies} of the same moment as another count once")
    unfit = sum(row.get("model") == "mismatch" for row in answered)
    if unfit and command == "estimate":  # of a diagnosis its verdict says it
        words.append(f"in {unfit} the model does not fit")
    if command == "diagnose":
        verdicts = Counter(row.get("verdict") for row in answered)
        words.append("verdicts: " + (", ".join(
            f"{count} {str(name).replace('_', ' ')}" for name, count in verdicts.most_common())
            or "none"))
    return (f"{len(answered)} of {len(rows)} recordings were processed: {'; '.join(words)}."
            + (f" {broken} failed." if broken else ""))


def _effect_counts(rows: Sequence[dict]) -> Table:
    """Return each named effect with the recordings that show it, the frequent ones first."""
    found: dict[str, list[dict]] = {}
    for row in rows:
        for effect in row.get("effects") or ():
            found.setdefault(effect["name"], []).append(row)
    ordered = sorted(found.items(), key=lambda one: (-len(one[1]), one[0]))
    return table("effect | recordings | last seen", [
        (effect_words(name), len(mine),
         max((_moment(row["start"]) for row in mine if row.get("start")), default="—"))
        for name, mine in ordered], " | number | number", "effects")


def phrases(row: dict) -> list[str]:
    """Return what was found in a row: wrong numbers of the rig first, then the effects."""
    return [*(_phrase(one["statement"], one) for one in row.get("rig_data") or ()),
            *map(effect_phrase, row.get("effects") or ())]


def effect_phrase(effect: dict) -> str:
    """Return an effect with its sizes: ``Coulomb friction (F_c = 40.0 ± 0.2 N), 97 %``.

    What the catalogue has a default for is its shape, and stands in the recording's own report.
    """
    entry = CATALOGUE.get(effect["name"])
    shape = {p.name for p in entry.parameters if p.default is not None} if entry else set()
    values = ", ".join(f"{one['name']} = {_value(one['value'], one['stddev'], one['unit'])}"
                       for one in effect["parameters"] or () if one["name"] not in shape)
    return _phrase(effect_words(effect["name"]) + (f" ({values})" if values else ""), effect)


def _phrase(words: str, found: dict) -> str:
    """Return what was found, how probable it is, and what else it may be."""
    chance = found.get("probability")
    others = rivals(found["indistinguishable_from"] or ())
    return (words + ("" if chance is None else f", {probability(chance)}")
            + (f", or {others}" if others else ""))


def _kind(rows: Sequence[dict]) -> str:
    """Return the colour of the summary."""
    levels = {row.get("alarm") for row in rows}
    if "ERROR" in levels:
        return "error"
    doubtful = any(row.get("error") or misfits(row) for row in rows)
    if "WARN" in levels or doubtful:
        return "warn"
    return "unknown" if NOT_JUDGED in levels else "ok"


def _row(row: dict, command: str, made_with: str, report: str) -> tuple[Cell, ...]:
    """Return the cells of a recording."""
    marks = [words for words, holds in (
        ("no longer in the folder", row.get("gone")),
        ("of another config or source", row["made_with"] != made_with)) if holds]
    error = row.get("error") or ""
    cells = [Cell(row["bag"], note="; ".join(filter(None, (", ".join(marks), row.get("losses")))),
                  link=report),
             Cell(_moment(row["start"]).removesuffix(" UTC") if row.get("start") else "—",
                  "number"),
             Cell(quantity(row["duration_s"], "s") if row.get("duration_s") else "—", "number"),
             *(_parameter(row, name, command) for name in PARAMETERS),
             Cell("", "message", (row.get("alarm_message") or "").removeprefix(
                 f"{row.get('alarm')}: "), row.get("alarm") or ""),
             Cell("", "message", "; ".join(filter(None, (
                 None if row.get("verdict") else row.get("model_balance"), error))),
                  (row.get("verdict") or "").replace("_", " ") or row.get("model") or "",
                  _FITS.get(row.get("verdict"), "none") if command == "diagnose" else "")]
    if command == "diagnose":
        cells.append(Cell("; ".join(phrases(row)) or "—", "effects"))
    return tuple(replace(one, kind=f"{one.kind} none") for one in cells) if marks else tuple(cells)


def _parameter(row: dict, name: str, command: str) -> Cell:
    """Return one parameter of a row: of a diagnosis the value with the named effects."""
    status, unit = row.get(f"{name}_status") or "", row.get(f"{name}_unit") or ""
    doubt = row.get(f"{name}_doubt") or ""
    key = name
    if command == "diagnose":
        key, status, doubt = f"{name}_after", "", ""
    value, stddev = row.get(key), row.get(f"{key}_stddev")
    known = value is not None
    badge, level = ("in doubt", "WARN") if doubt and status == "converged" else (
        STATUS_WORDS.get(status, status), status)
    return Cell(_value(value, stddev, unit), "value doubt" if doubt else "value", doubt, badge,
                level,
                (value, stddev) if known else None,
                f"{value} {unit}, standard deviation {stddev}" if known else "")


def _value(value: float | None, stddev: float | None, unit: str) -> str:
    if value is None:
        return "—"
    return value_words(Value(value, float("nan") if stddev is None else stddev, unit or ""))


def _moment(text: str) -> str:
    return text[:16].replace("T", " ") + " UTC"
