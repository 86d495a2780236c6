"""Indicators of health on the terminal."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from eha_monitor.indicators.indicator import AVAILABLE, NEEDS, NONE, NOT_LOOKED_FOR, Indicator
from eha_monitor.words import listed

if TYPE_CHECKING:
    from eha_monitor.settings import Settings


def show(console: Console, indicators: Sequence[Indicator], settings: "Settings") -> None:
    """Print those that are told, why others are not, and which keys are missing."""
    from eha_monitor.indicators.indicator import passed

    shown = [one for one in indicators if one.status not in (NEEDS, NONE)
             and one.message != NOT_LOOKED_FOR]
    if any(one.status == AVAILABLE for one in shown):
        table = Table("indicator", "value", "conditions, or why there is no value", box=None,
                      header_style="bold", padding=(0, 2, 0, 0))
        for one in shown:
            limit = "[red]beyond its limit[/], " if passed(one, settings) else ""
            table.add_row(one.words, one.shown, limit + escape(one.message))
        console.print(table)
    if others := [one.words for one in indicators if one.message == NOT_LOOKED_FOR
                 and one.name != "friction_share"]:
        console.print(escape(f"run `diagnose` for {listed(others)}"), style="dim")
    missing = dict.fromkeys(key for one in indicators for key in one.missing)
    if missing:
        lacking = listed([one.words for one in indicators if one.status == NEEDS])
        console.print(escape(f"not computed: {lacking}; set {listed(list(missing))} in the "
                             "config "
                             "(docs/health.md)"), style="dim")
