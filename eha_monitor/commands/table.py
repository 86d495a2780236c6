"""The answer of ``estimate`` as a person reads it on a terminal."""

import math
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from eha_monitor.commands.indicators import show as show_indicators
from eha_monitor.estimation.results import Estimate
from eha_monitor.health.alarms import NOT_JUDGED, Alarm
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.quantity import NOTE, SYMBOLS

_COLOURS = {"OK": "green", "WARN": "yellow", "ERROR": "red", "STALE": "dim", NOT_JUDGED: "cyan",
            "converged": "green", "not_excited": "yellow", "diverged": "red", "no_data": "dim",
            "consistent": "green", "mismatch": "red", "unknown": "dim",
            "not_judged": "cyan"}
PIPE_WIDTH = 120  # where there is no terminal whose width could be asked for


class PipeConsole(Console):
    """Leaves a broken pipe to the command line, which knows its exit status."""

    def on_broken_pipe(self) -> None:
        """Let the caller see it."""
        raise BrokenPipeError


def show(found: Estimate, alarms: tuple[Alarm, ...], written: list[Path],
         indicators: tuple[Indicator, ...] = ()) -> None:
    """Print parameters, indicators, alarms, model status, losses and events."""
    console = PipeConsole(highlight=False, soft_wrap=False)
    if not console.is_terminal:
        console = PipeConsole(highlight=False, width=PIPE_WIDTH)
    recording = found.recording
    faster = recording.duration / found.wall_s if found.wall_s else 0.0
    speed = f", {faster:.0f}x real time" if faster >= 1.0 else ""
    console.print(f"{escape(recording.source)}: {recording.duration:.3f} s, {len(recording)} "
                  f"samples, channels {', '.join(recording.channels)}"
                  f" (computed in {found.wall_s:.2f} s{speed})")
    console.print(_parameters(found))
    for parameter in found.parameters.values():
        if parameter.message:
            console.print(escape(parameter.message))
    show_indicators(console, indicators, found.settings)
    console.print(_alarms(alarms))
    console.print(f"model: {_coloured(found.model.status)}: {escape(found.model.message)}")
    for title, sentences in (("lost", recording.losses), ("note", found.warnings)):
        for sentence in sentences:
            console.print(f"[yellow]{title}[/]: {escape(sentence)}")
    for event in found.events:
        console.print(f"{event.time_s:8.2f} s  stage {event.stage}: {escape(event.message)}")
    if any(math.isfinite(p.value) for p in found.parameters.values()):
        console.print(NOTE, style="dim")
    for path in written:
        console.print(f"written: {escape(str(path))}", soft_wrap=True)


def _coloured(word: str) -> str:
    colour = _COLOURS.get(word)
    return f"[{colour}]{word}[/]" if colour else word


def _parameters(found: Estimate) -> Table:
    table = Table("estimator", "parameter", "value", "status", box=None, header_style="bold",
                  padding=(0, 2, 0, 0))
    rows = [(f"stage {stage.stage}", stage.estimate)
            for stage in (found.stage_one, found.stage_two)]
    if found.joint is not None:
        rows += [("joint", parameter) for parameter in found.joint.parameters.values()]
    for estimator, p in rows:
        table.add_row(estimator, SYMBOLS.get(p.name, p.name), p.shown, _coloured(p.status))
    return table


def _alarms(alarms: tuple[Alarm, ...]) -> Table:
    table = Table("alarm", "level", "since", "why", box=None, header_style="bold",
                  padding=(0, 2, 0, 0))
    for alarm in alarms:
        table.add_row(alarm.name, _coloured(alarm.word), f"{alarm.time_s:.2f} s",
                      escape(alarm.message))
    return table
