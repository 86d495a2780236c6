"""The HTML page of a folder of bags: trends, what needs a look, and every recording."""

import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from eha_monitor.archive.history import History, history
from eha_monitor.archive.store import INDICATORS, PARAMETERS
from eha_monitor.health.alarms import NOT_JUDGED
from eha_monitor.mismatch.diagnosis import Value
from eha_monitor.output import write_text
from eha_monitor.quantity import SYMBOLS, number, quantity
from eha_monitor.reports.archive_figures import history_block
from eha_monitor.reports.diagnosis_words import probability, value_words
from eha_monitor.reports.page import render
from eha_monitor.reports.verdict import STATUS_WORDS
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
    reports : bag -> address of its report, seen from the page.

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
    cells = [_row(row, command, made_with) | {"report": reports.get(row["bag"], "")}
             for row in shown]
    name = folder.resolve().name or str(folder)  # of "." too
    return render(
        "archive.html.j2", title=f"EHA monitor: {command} of {name}", name=name,
        heading=heading(rows, command, settings), summary=summary_words(rows, command),
        kind=_kind(rows), diagnosed=command == "diagnose",
        histories=[history_block(one, settings)
                   for one in histories_of(rows, command, made_with, settings)],
        effects=effect_counts(rows), rows=cells,
        linked=any(row["report"] for row in cells),
        broken=[row for row in cells if row["error"]],
        command=f"eha-monitor {command} {shlex.quote(str(folder))}/BAG --report BAG.html")


def histories_of(rows: Sequence[dict], command: str, made_with: str, settings: Settings
                 ) -> list[History]:
    """Return the histories of B and beta_e, and of the indicators that any recording tells."""
    found = [history(rows, name, command, made_with, settings)
             for name in (*PARAMETERS, *INDICATORS.values())]
    return [one for one in found if one.name in PARAMETERS or len(one.time)]


def heading(rows: Sequence[dict], command: str, settings: Settings) -> list[tuple[str, str]]:
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
    told = [row for row in rows if not row.get("error")]
    alarms = Counter(row.get("alarm") for row in told)
    parts = [f"{alarms[level]} with {level}" for level in ("ERROR", "WARN") if alarms[level]]
    if alarms[NOT_JUDGED]:
        parts.append(f"{alarms[NOT_JUDGED]} {NOT_JUDGED}")
    words = [", ".join(parts) if parts else "no alarm at the end of any recording"]
    misfits = sum(row.get("model") == "mismatch" for row in told)
    if misfits:
        words.append(f"in {misfits} the model does not fit")
    if command == "diagnose":
        verdicts = Counter(row.get("verdict") for row in told)
        words.append("verdicts: " + (", ".join(
            f"{count} {str(name).replace('_', ' ')}" for name, count in verdicts.most_common())
            or "none"))
    text = f"{len(told)} of {len(rows)} recordings were processed: {'; '.join(words)}."
    if broken:
        text += f" {broken} failed."
    return text


def effect_counts(rows: Sequence[dict]) -> list[dict]:
    """Return each named effect with the recordings that show it, the frequent ones first."""
    found: dict[str, list[dict]] = {}
    for row in rows:
        for effect in row.get("effects") or ():
            found.setdefault(effect["name"], []).append(row)
    ordered = sorted(found.items(), key=lambda one: (-len(one[1]), one[0]))
    return [{"name": effect_words(name), "count": len(mine),
             "last": max((_moment(row["start"]) for row in mine if row.get("start")),
                         default="—")} for name, mine in ordered]


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


def _row(row: dict, command: str, made_with: str) -> dict:
    """Return a row as the template shows it."""
    marks = []
    if row.get("gone"):
        marks.append("no longer in the folder")
    if row["made_with"] != made_with:
        marks.append("of another config or source")
    return {
        "bag": row["bag"], "marks": ", ".join(marks), "error": row.get("error") or "",
        "start": _moment(row["start"]).removesuffix(" UTC") if row.get("start") else "—",
        "duration": quantity(row["duration_s"], "s") if row.get("duration_s") else "—",
        "parameters": [] if row.get("error") and row.get("B_status") is None else [
            _parameter(row, name, command) for name in PARAMETERS],
        "alarm": row.get("alarm") or "", "alarm_message": row.get("alarm_message") or "",
        "model": row.get("model") or "", "balance": row.get("model_balance") or "",
        "verdict": (row.get("verdict") or "").replace("_", " "),
        "fits": _FITS.get(row.get("verdict"), "") if command == "diagnose" else (
            row.get("model") or ""),
        "effects": phrases(row),
        "losses": row.get("losses") or "",
    }


def _parameter(row: dict, name: str, command: str) -> dict:
    """Return one parameter of a row: of a diagnosis the value with the named effects."""
    status = row.get(f"{name}_status") or ""
    found = {"symbol": SYMBOLS[name], "unit": row.get(f"{name}_unit") or "", "status": status,
             "words": STATUS_WORDS.get(status, status), "doubt": row.get(f"{name}_doubt") or ""}
    key = name
    if command == "diagnose":
        key = f"{name}_after"
        found |= {"words": "", "doubt": ""}
    value, stddev = row.get(key), row.get(f"{key}_stddev")
    return found | {"value": value, "stddev": stddev,
                    "shown": "—" if value is None else _value(value, stddev, found["unit"])}


def _value(value: float | None, stddev: float | None, unit: str) -> str:
    if value is None:
        return "—"
    return value_words(Value(value, float("nan") if stddev is None else stddev, unit or ""))


def _moment(text: str) -> str:
    return text[:16].replace("T", " ") + " UTC"
