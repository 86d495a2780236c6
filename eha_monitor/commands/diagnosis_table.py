"""The answer of ``diagnose`` as a person reads it on a terminal."""

import math
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from eha_monitor.commands.table import PIPE_WIDTH, PipeConsole
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.quantity import NOTE, SYMBOLS, number
from eha_monitor.reports.diagnosis_words import (
    DATA,
    certainty,
    effect_words,
    error_words,
    head_of,
    interval_words,
    listed,
    log_units,
    percent,
    place_words,
    removed,
    sentence,
    value_words,
)

_COLOURS = {"ok": "green", "warn": "yellow", "error": "red", "unknown": "dim"}


def show(found: Diagnosis, written: list[Path], notes: list[str] = ()) -> None:
    """Print verdict, place, effects, parameters before and after, the proof, and ``notes``."""
    console = PipeConsole(highlight=False)
    if not console.is_terminal:
        console = PipeConsole(highlight=False, width=PIPE_WIDTH)
    kind, head = head_of(found)
    console.print(f"{escape(', '.join(found.bags))}: {number(found.duration_s)} s "
                  f"(answered in {found.wall_s:.1f} s)")
    console.print(f"[bold {_COLOURS[kind]}]{escape(head)}[/]: {escape(sentence(found.message))}")
    _print_place(console, found)
    if found.effects:
        console.print(_effects(found))
        for effect in found.effects:
            if effect.statement not in found.message:
                console.print(escape(sentence(effect.statement)))
    if found.before or found.after:
        console.print(_parameters(found))
    if found.signals:
        console.print(_fit(found))
    for title, sentences in (("health", found.health), ("advice", found.advice),
                             ("note", notes)):
        for text in sentences:
            console.print(f"[yellow]{title}[/]: {escape(sentence(text))}")
    if found.verdict != "insufficient_data":
        console.print(escape(certainty(found)), style="dim")
    if found.before or found.after:
        console.print(NOTE, style="dim")
    for path in written:
        console.print(f"written: {escape(str(path))}", soft_wrap=True)


def _print_place(console: Console, found: Diagnosis) -> None:
    place = place_words(found)
    if found.verdict in ("mismatch", "unexplained") and place:
        worst = interval_words(found)
        console.print(escape(f"where: {place}{f'; worst at {worst}' if worst else ''}"))


def _table(*columns: str) -> Table:
    return Table(*columns, box=None, header_style="bold", padding=(0, 2, 0, 0))


def _effects(found: Diagnosis) -> Table:
    table = _table("left out", "balance", "size", "parameters", "log evidence",
                   "not told apart from")
    for effect in found.effects:
        table.add_row(effect.name, effect.balance, escape(effect.size),
                      escape("\n".join(f"{name} = {value_words(value)}"
                                       for name, value in effect.parameters.items())),
                      log_units(effect.log_evidence),
                      escape(listed([effect_words(r) for r in effect.indistinguishable_from],
                                    "or")) or "–")
    return table


def _parameters(found: Diagnosis) -> Table:
    table = _table("parameter", "before", "after")
    for name in dict.fromkeys((*found.before, *found.after)):
        table.add_row(SYMBOLS.get(name, name), *(value_words(values.get(name))
                              for values in (found.before, found.after)))
    return table


def _fit(found: Diagnosis) -> Table:
    table = _table("error on unseen data", "before", "after", "noise", "removed")
    for name, fit in found.signals.items():
        cells = [error_words(value, fit)
                 for value in (fit.before_rms, fit.after_rms, fit.noise_rms)]
        share = removed(fit)
        table.add_row(escape(name.replace("_", " ")), *cells,
                      percent(share) if math.isfinite(share) else "—")
    how = "free run" if "position" in found.signals else "what is left of each balance below 5 Hz"
    table.caption = f"root mean square, {how}; on {DATA.get(found.data, found.data)}"
    table.caption_justify = "left"
    return table

