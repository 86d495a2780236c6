"""The answer of ``diagnose`` as a person reads it on a terminal."""

import math
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from eha_monitor.commands.table import (
    console,
    print_end,
    show_baselines,
    show_indicators,
    table,
)
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.quantity import DIAGNOSED, SYMBOLS, number
from eha_monitor.reports.diagnosis_words import (
    DATA,
    certainty,
    error_words,
    head_of,
    head_words,
    interval_words,
    log_units,
    message_words,
    percent,
    place_words,
    probability,
    removed,
    rig_words,
    sentence,
    value_words,
    windows_words,
)
from eha_monitor.settings import Settings
from eha_monitor.words import effect_words, listed

RIVAL_FORMULA = 20.0  # log units: a formula that is worse by more is not worth a line
_COLOURS = {"ok": "green", "warn": "yellow", "error": "red", "unknown": "dim"}


def show(found: Diagnosis, written: list[Path], notes: list[str] = (),
         indicators: tuple[Indicator, ...] = (), settings: Settings | None = None) -> None:
    """Print wrong numbers of the rig, verdict, place, effects, parameters, indicators, proof."""
    to = console()
    kind = head_of(found)[0]
    to.print(f"{escape(', '.join(found.bags))}: {number(found.duration_s)} s "
                  f"(computed in {found.wall_s:.1f} s)")
    for finding in found.rig_data:  # first of all: what follows rests on them
        to.print(f"[bold yellow]wrong rig data[/]: {escape(rig_words(finding))}")
        if finding.indistinguishable_from:
            to.print(escape(f"  in this recording {finding.key} is indistinguishable from "
                                 f"{_rivals(finding.indistinguishable_from)}"))
    to.print(f"[bold {_COLOURS[kind]}]{escape(head_words(found))}[/]: "
                  f"{escape(message_words(found))}".rstrip(": "))
    for gate in found.gates:
        to.print(escape(f"refused: {gate.statement}"))
    _print_place(to, found)
    if found.changes:
        to.print(_changes(found))
    if found.effects and not found.references:
        to.print(_effects(found))
        for effect in found.effects:
            if effect.statement not in found.message:
                to.print(escape(sentence(effect.statement)))
            if effect.intervals_s:
                to.print(escape(f"{effect.name} acts at "
                                     f"{interval_words(effect.intervals_s)}"))
    if found.learned:
        to.print(_learned(found))
    if found.before or found.after:
        to.print(_parameters(found))
    if settings is not None:
        show_indicators(to, indicators, settings)
    if found.signals:
        to.print(_fit(found))
    show_baselines(to, found.baselines)
    for finding in found.rig_within:
        to.print(f"[yellow]rig data[/]: {escape(finding.statement)}")
    for title, sentences in (("health", found.health), ("advice", found.advice),
                             ("note", notes)):
        for text in sentences:
            to.print(f"[yellow]{title}[/]: {escape(sentence(text))}")
    for text in filter(None, (certainty(found), windows_words(found))):
        to.print(escape(text), style="dim")
    print_end(to, DIAGNOSED if found.before or found.after else "", written)


def _print_place(to: Console, found: Diagnosis) -> None:
    place = place_words(found)
    if found.verdict in ("mismatch", "unexplained") and place:
        worst = interval_words(found.location.intervals_s)
        to.print(escape(f"where: {place}{f'; worst at {worst}' if worst else ''}"))


def _effects(found: Diagnosis) -> Table:
    shown = table("left out", "probability", "balance", "size", "parameters",
                   "indistinguishable from")
    for effect in found.effects:
        shown.add_row(effect.name, probability(effect.probability), effect.balance,
                      escape(effect.size),
                      escape("\n".join(f"{name} = {value_words(value)}"
                                       for name, value in effect.parameters.items())),
                      escape(_rivals(effect.indistinguishable_from)) or "–")
    return shown


def _changes(found: Diagnosis) -> Table:
    shown = table("changed", "healthy", "now", "indistinguishable from")
    for change in found.changes:
        name = f"{effect_words(change.what)} {change.symbol}" if change.symbol else SYMBOLS.get(
            change.what, change.what)
        shown.add_row(name, value_words(change.reference), value_words(change.now),
                      escape(_rivals(change.indistinguishable_from)) or "–")
    return shown


def _learned(found: Diagnosis) -> Table:
    shown = table("learned", "function of", "size", "removed on unseen data", "formula")
    for term in found.learned:
        rivals = [f"or {shown}, {log_units(behind)} log units worse"
                  for shown, behind in term.rivals if behind < RIVAL_FORMULA]
        shown.add_row(f"missing {term.balance}", ", ".join(term.of), term.size,
                      percent(term.removed),
                      escape("\n".join([term.formula or "none fits as well as the curve",
                                         *rivals])))
    return shown


def _rivals(names: tuple[str, ...]) -> str:
    return listed([effect_words(name) for name in names], "or")


def _parameters(found: Diagnosis) -> Table:
    shown = table("parameter", *("healthy", "now") if found.references else ("before", "after"))
    for name in dict.fromkeys((*found.before, *found.after)):
        shown.add_row(SYMBOLS.get(name, name), *(value_words(values.get(name))
                              for values in (found.before, found.after)))
    return shown


def _fit(found: Diagnosis) -> Table:
    shown = table("error on unseen data", "before", "after", "noise", "removed")
    for name, fit in found.signals.items():
        cells = [error_words(value, fit)
                 for value in (fit.before_rms, fit.after_rms, fit.noise_rms)]
        share = removed(fit)
        shown.add_row(escape(name.replace("_", " ")), *cells,
                      percent(share) if math.isfinite(share) else "—")
    how = "free run" if "position" in found.signals else "residual of each balance below 5 Hz"
    shown.caption = f"root mean square, {how}; on {DATA.get(found.data, found.data)}"
    shown.caption_justify = "left"
    return shown
