"""What the commands print on a terminal, and the answer of ``estimate`` there."""

import math
from collections.abc import Sequence
from pathlib import Path

import click
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from eha_monitor.balances.baseline import Baseline, baseline
from eha_monitor.balances.baseline import sentence as baseline_sentence
from eha_monitor.estimation.results import Estimate
from eha_monitor.health.alarms import NO_LIMIT, NOT_JUDGED, Alarm
from eha_monitor.indicators.indicator import AVAILABLE, NEEDS, NONE, NOT_LOOKED_FOR, Indicator
from eha_monitor.quantity import NOTE, SYMBOLS
from eha_monitor.settings import Settings
from eha_monitor.words import listed

COLOURS = {"OK": "green", "WARN": "yellow", "ERROR": "red", "STALE": "dim", NOT_JUDGED: "cyan",
           "converged": "green", "not_excited": "yellow", "diverged": "red", "no_data": "dim",
           "consistent": "green", "mismatch": "red", "unknown": "dim",
           "not_judged": "cyan"}
PIPE_WIDTH = 120  # where there is no terminal whose width could be asked for


class PipeConsole(Console):
    """Leaves a broken pipe to the command line, which knows its exit status."""

    def on_broken_pipe(self) -> None:
        """Let the caller see it."""
        raise BrokenPipeError


def console() -> Console:
    """Return where the answers are printed."""
    made = PipeConsole(highlight=False)
    return made if made.is_terminal else PipeConsole(highlight=False, width=PIPE_WIDTH)


def table(*columns: str, **more) -> Table:
    """Return a table as all answers have it."""
    return Table(*columns, box=None, header_style="bold", padding=(0, 2, 0, 0), **more)


def print_end(to: Console, note: str, written: list[Path]) -> None:
    """Print what holds for all numbers, and which files were written."""
    if note:
        to.print(note, style="dim")
    show_paper(to)
    for path in written:
        to.print(f"written: {escape(str(path))}", soft_wrap=True)


def show_paper(to: Console) -> None:
    """Say so where a command that takes ``--config`` runs without one."""
    context = click.get_current_context(silent=True)
    if context and context.params.get("config", "") is None:
        to.print("no --config: the rig's values are those of the paper's EHA (eha-monitor config "
                 "prints them; eha-monitor init FILE drafts your own)", soft_wrap=True)


def show(found: Estimate, alarms: tuple[Alarm, ...], written: list[Path],
         indicators: tuple[Indicator, ...] = (), config: Path | None = None) -> None:
    """Print parameters, indicators, alarms, model status, what to do, losses and events."""
    to, recording = console(), found.recording
    faster = recording.duration / found.wall_s if found.wall_s else 0.0
    speed = f", {faster:.0f}x real time" if faster >= 1.0 else ""
    to.print(f"{escape(recording.source)}: {recording.duration:.3f} s, {len(recording)} "
                  f"samples, channels {', '.join(recording.channels)}"
                  f" (computed in {found.wall_s:.2f} s{speed})")
    to.print(_parameters(found))
    for parameter in found.parameters.values():
        if found.model.status == "mismatch" and parameter.status == "not_excited":
            to.print(f"{SYMBOLS.get(parameter.name, parameter.name)} is not determined while the "
                     "model does not fit (below)")
        elif parameter.message:
            to.print(escape(parameter.message))
    show_indicators(to, indicators, found.settings)
    to.print(_alarms(alarms))
    to.print(f"model: {_coloured(found.model.status)}: {escape(found.model.message)}")
    if found.model.status == "mismatch":
        show_baselines(to, (baseline(recording, found.settings),))
        given = f" --config {config}" if config else ""
        to.print(f"[bold]what to do[/]: eha-monitor diagnose {escape(recording.source + given)}",
                 soft_wrap=True)
    for title, sentences in (("lost", recording.losses), ("note", found.warnings)):
        for sentence in sentences:
            to.print(f"[yellow]{title}[/]: {escape(sentence)}")
    converged = {stage.stage for stage in (found.stage_one, found.stage_two)
                 if stage.estimate.status == "converged"}
    for event in found.events:
        if " converged at " in event.message and event.stage not in converged:
            continue  # it has not stayed so
        to.print(f"{event.time_s:8.2f} s  stage {event.stage}: {escape(event.message)}")
    known = any(math.isfinite(p.value) for p in found.parameters.values())
    print_end(to, NOTE if known else "", written)


def show_baselines(to: Console, baselines: Sequence[Baseline]) -> None:
    """Print what ten lines of least squares say, which hold where a filter does not."""
    for one in baselines:
        for balance, fit in (("force", one.force), ("flow", one.flow)):
            if fit is not None:
                to.print(escape(f"least squares, {balance}: {baseline_sentence(fit)}"))


def _coloured(word: str) -> str:
    colour = COLOURS.get(word)
    return f"[{colour}]{word}[/]" if colour else word


def _parameters(found: Estimate) -> Table:
    shown = table("estimator", "parameter", "value", "status")
    rows = [(f"stage {stage.stage}", stage.estimate)
            for stage in (found.stage_one, found.stage_two)]
    if found.joint is not None:
        rows += [("joint", parameter) for parameter in found.joint.parameters.values()]
    for estimator, p in rows:
        # What must not be used does not speak like what may.
        value = p.shown if p.status == "converged" or p.shown == "—" else f"[dim]({p.shown})[/]"
        shown.add_row(estimator, SYMBOLS.get(p.name, p.name), value, _coloured(p.status))
    return shown


def _alarms(alarms: tuple[Alarm, ...]) -> Table:
    shown = table("alarm", "level", "since", "why")
    for alarm in alarms:
        word = "[dim]–[/]" if alarm.message == NO_LIMIT else _coloured(alarm.word)
        shown.add_row(alarm.name, word, f"{alarm.time_s:.2f} s", escape(alarm.message))
    return shown


def show_indicators(to: Console, indicators: Sequence[Indicator], settings: Settings) -> None:
    """Print those that are told, why others are not, and which keys are missing."""
    from eha_monitor.indicators.indicator import passed

    shown = [one for one in indicators if one.status not in (NEEDS, NONE)
             and one.message != NOT_LOOKED_FOR]
    if any(one.status == AVAILABLE for one in shown):
        rows = table("indicator", "value", "conditions, or why there is no value")
        for one in shown:
            limit = "[red]beyond its limit[/], " if passed(one, settings) else ""
            rows.add_row(one.words, one.shown, limit + escape(one.message))
        to.print(rows)
    if others := [one.words for one in indicators if one.message == NOT_LOOKED_FOR
                 and one.name != "friction_share"]:
        to.print(escape(f"run `diagnose` for {listed(others)}"), style="dim")
    missing = dict.fromkeys(key for one in indicators for key in one.missing)
    if missing:
        lacking = listed([one.words for one in indicators if one.status == NEEDS])
        to.print(escape(f"not computed: {lacking}; set {listed(list(missing))} in the "
                        "config (docs/health.md)"), style="dim")
