"""The HTML page of a folder of bags: trends, what needs a look, and every recording."""

import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from eha_monitor.archive.history import History, history
from eha_monitor.archive.store import INDICATORS, PARAMETERS
from eha_monitor.health.alarms import NOT_JUDGED
from eha_monitor.mismatch.diagnosis import Value
from eha_monitor.output import write_text
from eha_monitor.quantity import number, quantity
from eha_monitor.reports.diagnosis_words import probability, value_words
from eha_monitor.reports.estimate_words import STATUS_WORDS
from eha_monitor.reports.history_figures import history_block
from eha_monitor.reports.page import Cell, Table, render, table
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import effect_words, listed

# Verdict -> class of its badge, which are those of the model's status.
_FITS = {"consistent": "consistent", "mismatch": "mismatch", "unexplained": "mismatch"}


def write_archive_report(path: str | Path, rows: Sequence[dict], command: str,
                         settings: Settings, folder: Path, made_with: str,
                         reports: Mapping[str, str] | None = None) -> None:
    """Write the page of a table as a single HTML file.

    Parameters
    ----------
    path : file to write.
    rows : of the table, in any order.
    command : ``estimate`` or ``diagnose``.
    settings : its thresholds are drawn.
    folder : of the bags.
    made_with : digest of what the rows are made with now; others are marked as older.
    reports : bag -> address of its report, relative to the page.

    Raises
    ------
    InputError
        If ``path`` cannot be written.
    """
    write_text(path, archive_page(rows, command, settings, folder, made_with, reports))


def archive_page(rows: Sequence[dict], command: str, settings: Settings, folder: Path,
                 made_with: str, reports: Mapping[str, str] | None = None) -> str:
    """Return the page as HTML text."""
    reports = reports or {}
    shown = sorted(rows, key=lambda row: (row.get("start") or "", row["bag"]), reverse=True)
    name = folder.resolve().name or str(folder)  # of "." too
    diagnosed = command == "diagnose"
    heads = "recording | start, UTC | length | B | βe | alarm | model" + (
        " | wrong or left out" if diagnosed else "")
    return render(
        "archive.html.j2", title=f"EHA monitor: {command} of {name}", name=name,
        facts=_facts(rows, command, settings), summary=summary_words(rows, command),
        kind=_kind(rows), diagnosed=diagnosed, linked=any(row["bag"] in reports for row in shown),
        histories=[history_block(one, settings)
                   for one in histories_of(rows, command, made_with, settings)],
        effects=_effect_counts(rows),
        broken=table("recording | why", [(row["bag"], row["error"]) for row in shown
                                         if row.get("error")], " | message error-text", "broken"),
        recordings=table(heads, [_row(row, command, made_with, reports.get(row["bag"], ""))
                                 for row in shown], key="recordings"),
        command=f"eha-monitor {command} {shlex.quote(str(folder))}/BAG --report BAG.html")


def histories_of(rows: Sequence[dict], command: str, made_with: str, settings: Settings
                 ) -> list[History]:
    """Return the histories of B and beta_e, and of the indicators that any recording has."""
    found = [history(rows, name, command, made_with, settings)
             for name in (*PARAMETERS, *INDICATORS.values())]
    return [one for one in found if one.name in PARAMETERS or len(one.time)]


def _facts(rows: Sequence[dict], command: str, settings: Settings) -> list[tuple[str, str]]:
    """Return the facts at the head of the page."""
    facts = [("Command", command), ("Rig", settings.rig.name),
             ("Recordings", str(len(rows)))]
    starts = sorted(row["start"] for row in rows if row.get("start"))
    if starts:
        facts.append(("From", _moment(starts[0])))
        facts.append(("To", _moment(starts[-1])))
    seconds = sum(row.get("duration_s") or 0.0 for row in rows)
    facts.append(("Recorded", f"{number(seconds / 3600, 3)} h" if seconds > 3600 else
                  f"{number(seconds / 60, 3)} min" if seconds > 120 else
                  quantity(seconds, "s", 3)))
    last = max((row["answered"] for row in rows if row.get("answered")), default=None)
    if last:
        facts.append(("Last answer", _moment(last)))
    return facts


def summary_words(rows: Sequence[dict], command: str) -> str:
    """Return the count of what was found, in one or two sentences."""
    broken = sum(bool(row.get("error")) for row in rows)
    answered = [row for row in rows if not row.get("error")]
    alarms = Counter(row.get("alarm") for row in answered)
    parts = [f"{alarms[level]} with {level}" for level in ("ERROR", "WARN") if alarms[level]]
    if alarms[NOT_JUDGED]:
        parts.append(f"{alarms[NOT_JUDGED]} {NOT_JUDGED}")
    words = [", ".join(parts) if parts else "no alarm at the end of any recording"]
    misfits = sum(row.get("model") == "mismatch" for row in answered)
    if misfits:
        words.append(f"in {misfits} the model does not fit")
    if command == "diagnose":
        verdicts = Counter(row.get("verdict") for row in answered)
        words.append("verdicts: " + (", ".join(
            f"{count} {str(name).replace('_', ' ')}" for name, count in verdicts.most_common())
            or "none"))
    text = f"{len(answered)} of {len(rows)} recordings were processed: {'; '.join(words)}."
    if broken:
        text += f" {broken} failed."
    return text


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
    return [*map(rig_phrase, row.get("rig_data") or ()),
            *map(effect_phrase, row.get("effects") or ())]


def effect_phrase(effect: dict) -> str:
    """Return an effect with its values: ``Coulomb friction (F_c = 40.0 ± 0.2 N), 97 %``."""
    values = ", ".join(f"{one['name']} = {_value(one['value'], one['stddev'], one['unit'])}"
                       for one in effect["parameters"] or ())
    return _phrase(effect_words(effect["name"]) + (f" ({values})" if values else ""), effect)


def rig_phrase(number: dict) -> str:
    """Return a wrong number of the rig with both values, and how probable it is."""
    return _phrase(number["statement"], number)


def _phrase(words: str, found: dict) -> str:
    chance = found.get("probability")
    rivals = [effect_words(name) for name in found["indistinguishable_from"] or ()]
    return (words + ("" if chance is None else f", {probability(chance)}")
            + (f", or {listed(rivals, 'or')}" if rivals else ""))


def _kind(rows: Sequence[dict]) -> str:
    """Return the colour of the summary."""
    levels = {row.get("alarm") for row in rows}
    if "ERROR" in levels:
        return "error"
    doubtful = any(row.get("error") or row.get("model") == "mismatch" for row in rows)
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
             Cell("", "message", row.get("alarm_message") or "", row.get("alarm") or ""),
             Cell("", "message", "; ".join(filter(None, (row.get("model_balance"), error))),
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
