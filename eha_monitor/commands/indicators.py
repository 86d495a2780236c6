"""Indicators of health in the answers of ``estimate`` and ``diagnose``."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from eha_monitor.indicators.indicator import AVAILABLE, NEEDS, NONE, NOT_LOOKED_FOR, Indicator
from eha_monitor.words import listed

if TYPE_CHECKING:
    from eha_monitor.filters.results import Estimate
    from eha_monitor.mismatch.diagnosis import Diagnosis
    from eha_monitor.recordings.recording import Recording
    from eha_monitor.settings import Settings


def of_estimate(found: "Estimate") -> tuple[Indicator, ...]:
    """Return the indicators of an estimate."""
    from eha_monitor.indicators import found as evidence
    from eha_monitor.indicators.assemble import indicators

    return indicators(evidence.of_estimate(found), found.settings)


def of_diagnosis(found: "Diagnosis", recordings: list["Recording"], settings: "Settings"
                 ) -> tuple[Indicator, ...]:
    """Return the indicators of a diagnosis."""
    from eha_monitor.indicators import diagnosed
    from eha_monitor.indicators.assemble import indicators

    return indicators(diagnosed.of_diagnosis(found, recordings, settings), settings)


def trees(indicators: Sequence[Indicator]) -> list[dict]:
    """Return the indicators as they stand in a JSON answer."""
    return [one.tree() for one in indicators]


def show(console: Console, indicators: Sequence[Indicator], settings: "Settings") -> None:
    """Print those that are told, why others are not, and which keys are missing."""
    from eha_monitor.indicators.limits import passed

    shown = [one for one in indicators if one.status not in (NEEDS, NONE)
             and one.message != NOT_LOOKED_FOR]
    if any(one.status == AVAILABLE for one in shown):
        table = Table("indicator", "value", "conditions, or why there is none", box=None,
                      header_style="bold", padding=(0, 2, 0, 0))
        for one in shown:
            limit = "[red]beyond its limit[/], " if passed(one, settings) else ""
            table.add_row(one.words, one.shown, limit + escape(one.message))
        console.print(table)
    if others := [one.words for one in indicators if one.message == NOT_LOOKED_FOR
                 and one.name != "friction_share"]:
        console.print(escape(f"`diagnose` looks for {listed(others)}"), style="dim")
    missing = dict.fromkeys(key for one in indicators for key in one.missing)
    if missing:
        lacking = listed([one.words for one in indicators if one.status == NEEDS])
        console.print(escape(f"not told: {lacking}; set {listed(list(missing))} in the config "
                             "(docs/health.md)"), style="dim")
