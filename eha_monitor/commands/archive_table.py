"""A folder of bags as a person reads it on a terminal: counts, what needs a look, trends."""

from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from eha_monitor.commands.table import PIPE_WIDTH, PipeConsole
from eha_monitor.health.alarms import NOT_JUDGED
from eha_monitor.quantity import NOTE
from eha_monitor.reports.archive_report import histories_of, phrases, summary_words
from eha_monitor.reports.history_figures import outlook_words, trend_words
from eha_monitor.settings import Settings

MOST = 20  # recordings shown; all are in the table
_COLOURS = {"ERROR": "red", "WARN": "yellow", "STALE": "dim", NOT_JUDGED: "cyan"}


def unhealthy(row: dict) -> bool:
    """Tell whether a row has an alarm, or a model that does not fit; a broken bag has neither."""
    return row.get("alarm") in ("WARN", "ERROR") or row.get("model") == "mismatch" or (
        row.get("verdict") in ("mismatch", "unexplained"))


def show(rows: Sequence[dict], command: str, settings: Settings, made_with: str, folder: Path,
         answered: int, written: list[Path]) -> None:
    """Print what was done, which recordings need a look, and the trends."""
    console = PipeConsole(highlight=False)
    if not console.is_terminal:
        console = PipeConsole(highlight=False, width=PIPE_WIDTH)
    gone = sum(bool(row.get("gone")) for row in rows)
    console.print(f"{escape(str(folder))}: {len(rows) - gone} bags, {answered} processed now, "
                  f"{len(rows) - gone - answered} unchanged"
                  + (f"; {gone} more no longer in the folder" if gone else ""))
    console.print(escape(summary_words(rows, command)))
    newest = sorted(rows, key=lambda row: (bool(row.get("error")), row.get("start") or "",
                                           row["bag"]), reverse=True)
    looked = [row for row in newest if row.get("error") or unhealthy(row)]
    if looked:
        table = Table("recording", "start", "alarm", "why", box=None, header_style="bold",
                      padding=(0, 2, 0, 0))
        for row in looked[:MOST]:
            level = row.get("alarm") or ""
            colour = _COLOURS.get(level)
            table.add_row(escape(row["bag"]), (row.get("start") or "–")[:16].replace("T", " "),
                          f"[{colour}]{level}[/]" if colour else level, escape(_why(row)))
        console.print(table)
        if len(looked) > MOST:
            console.print(f"and {len(looked) - MOST} more")
    for one in histories_of(rows, command, made_with, settings):
        console.print(escape(" ".join(filter(None, (trend_words(one), outlook_words(one))))))
    console.print(NOTE, style="dim")
    for path in written:
        console.print(f"written: {escape(str(path))}", soft_wrap=True)


def _why(row: dict) -> str:
    """Return what is wrong with a recording, the worst first."""
    if row.get("error"):
        return row["error"]
    if told := phrases(row):
        return "; ".join(told)
    if row.get("alarm") in ("WARN", "ERROR", NOT_JUDGED):
        return row["alarm_message"]
    return row.get("verdict_message") or row.get("model_message") or ""
