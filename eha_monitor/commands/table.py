"""What the commands print on a terminal: the answers of ``estimate`` and ``diagnose``."""

import math
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path

import click
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from eha_monitor.api.estimate import by_estimator
from eha_monitor.balances.baseline import Baseline, baseline
from eha_monitor.balances.baseline import sentence as baseline_sentence
from eha_monitor.estimation.results import Estimate
from eha_monitor.health.alarms import BALANCES, NO_LIMIT, NOT_JUDGED, Alarm
from eha_monitor.indicators.indicator import AVAILABLE, NEEDS, NOT_LOOKED_FOR, Indicator, passed
from eha_monitor.mismatch.diagnosis import Diagnosis, LearnedTerm
from eha_monitor.plausibility.sheet import against_sheet
from eha_monitor.quantity import NOTE, SYMBOLS, number
from eha_monitor.reports import diagnosis_words as words
from eha_monitor.settings import Settings
from eha_monitor.words import listed, probability

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


def table(*columns: str, rows: Iterable[Sequence[str]] = (), **more) -> Table:
    """Return a table as all answers have it; ``rows`` hold text, not markup."""
    made = Table(*columns, box=None, header_style="bold", padding=(0, 2, 0, 0), **more)
    for row in rows:
        made.add_row(*map(escape, row))
    return made


def print_end(to: Console, note: str, written: Sequence[Path]) -> None:
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
    to.print(_estimated(found))
    for parameter in found.parameters.values():
        if parameter.name in found.model.tainted and parameter.name not in found.doubted:
            continue
        if found.model.status == "mismatch" and parameter.status == "not_excited":
            to.print(f"{SYMBOLS.get(parameter.name, parameter.name)} is not determined while the "
                     "model does not fit (below)")
        elif parameter.message and not (
                parameter.status == "converged" and parameter.name in found.model.tainted):
            to.print(escape(parameter.message))
    show_indicators(to, indicators, found.settings)
    to.print(_alarms(alarms))
    to.print(f"model: {coloured(found.model.status)}: {escape(found.model.message)}")
    if found.model.status == "mismatch":
        first = baseline(recording, found.settings)
        show_baselines(to, (first,))
        for sentence in against_sheet(first, found.settings):
            to.print(f"[yellow]config[/]: {escape(sentence)}")
        given = f" --config {config}" if config else ""
        own = "" if config else (f"if this is not the paper's EHA, eha-monitor init "
                                 f"{recording.source} drafts your rig's config; if it is, ")
        to.print(f"[bold]what to do[/]: {escape(own)}eha-monitor diagnose "
                 f"{escape(recording.source + given)}", soft_wrap=True)
    for title, sentences in (("lost", recording.losses), ("note", found.warnings)):
        for sentence in sentences:
            to.print(f"[yellow]{title}[/]: {escape(sentence)}")
    for event in found.told:
        to.print(f"{event.time_s:8.2f} s  stage {event.stage}: {escape(event.message)}")
    known = any(math.isfinite(p.value) for p in found.parameters.values())
    print_end(to, NOTE if known else "", written)


def show_baselines(to: Console, baselines: Sequence[Baseline]) -> None:
    """Print what ten lines of least squares say, which hold where a filter does not."""
    for one in baselines:
        of = f" of {Path(one.source).name}" if len(baselines) > 1 else ""
        for balance, fit in (("force", one.force), ("flow", one.flow)):
            said = baseline_sentence(fit) if fit else f"none: {one.missing[balance]}"
            to.print(escape(f"least squares, {balance}{of}: {said}"))


def coloured(word: str) -> str:
    """Return a level or a status in its colour, as markup."""
    colour = COLOURS.get(word)
    return f"[{colour}]{word}[/]" if colour else word


def _estimated(found: Estimate) -> Table:
    shown = table("estimator", "parameter", "value", "status")
    for estimator, p in by_estimator(found):
        # What must not be used does not speak like what may.
        value = p.shown if p.status == "converged" or p.shown == "—" else f"[dim]({p.shown})[/]"
        status = coloured(p.status)
        doubted = found.joint_doubt if estimator == "joint" else p.name in found.model.tainted
        if p.status == "converged" and doubted:
            value, status = f"[dim]({p.shown})[/]", "converged, [yellow]in doubt[/]"
        shown.add_row(estimator, SYMBOLS.get(p.name, p.name), value, status)
    looked = found.beside[-1].parameters if found.beside else {}
    for name, taint in found.model.tainted.items():
        row = f"{BALANCES[name]} balance", SYMBOLS.get(name, name)
        if taint.instead:
            shown.add_row(*row, taint.instead.shown, "[green]least squares[/], used by the alarms")
        elif name in looked and math.isfinite(looked[name].value):
            shown.add_row(*row, f"[dim]({looked[name].shown})[/]",
                          f"least squares, not determined: {looked[name].message}")
    return shown


def _alarms(alarms: tuple[Alarm, ...]) -> Table:
    shown = table("alarm", "level", "since", "why")
    for alarm in alarms:
        word = "[dim]–[/]" if alarm.message == NO_LIMIT else coloured(alarm.word)
        shown.add_row(alarm.name, word, f"{alarm.time_s:.2f} s", escape(alarm.message))
    return shown


def show_indicators(to: Console, indicators: Sequence[Indicator], settings: Settings,
                    looks: str = "`diagnose`") -> None:
    """Print those that are told, and which keys or which look, ``looks``, others need."""
    shown = [one for one in indicators if not one.silent]
    if any(one.status == AVAILABLE for one in shown):
        rows = table("indicator", "value", "conditions, or why there is no value")
        for one in shown:
            limit = "[red]beyond its limit[/], " if passed(one, settings) else ""
            rows.add_row(one.words, one.shown, limit + escape(one.message))
        to.print(rows)
    if others := [one.words for one in indicators if one.message == NOT_LOOKED_FOR
                 and one.name != "friction_share"]:
        to.print(escape(f"run {looks} for {listed(others)}"), style="dim")
    if missing := dict.fromkeys(key for one in indicators for key in one.missing):
        lacking = listed([one.words for one in indicators if one.status == NEEDS])
        to.print(escape(f"not computed: {lacking}; set {listed(list(missing))} in the "
                        "config (docs/health.md)"), style="dim")


# ---- diagnose -----------------------------------------------------------------------------------

RIVAL_FORMULA = 20.0  # log units: a formula that is worse by more is not worth a line
_COLOURS = {"ok": "green", "warn": "yellow", "error": "red", "unknown": "dim"}


def show_diagnosis(found: Diagnosis, settings: Settings, written: Sequence[Path] = (),
                   notes: Sequence[str] = (), indicators: Sequence[Indicator] = ()) -> None:
    """Print wrong numbers of the rig, verdict, place, effects, parameters, indicators, proof."""
    to = console()
    kind = words.head_of(found)[0]
    to.print(f"{escape(', '.join(found.bags))}: {number(found.duration_s)} s "
                  f"(computed in {found.wall_s:.1f} s)")
    for text in words.channels_in_parts(found)[0]:  # no answer is better than its channels
        to.print(f"[bold yellow]channel[/]: {escape(words.sentence(text))}")
    for finding in found.rig_data:  # first of all: what follows rests on them
        to.print(f"[bold yellow]wrong rig data[/]: {escape(words.rig_words(finding))}")
        if finding.indistinguishable_from:
            to.print(escape(f"  {words.recordings_words(found).lower()} {finding.key} is "
                                 "indistinguishable from "
                                 f"{words.rivals(finding.indistinguishable_from)}"))
    to.print(f"[bold {_COLOURS[kind]}]{escape(words.head_words(found))}[/]: "
                  f"{escape(words.message_words(found))}".rstrip(": "))
    for gate in found.gates:
        to.print(escape(f"refused: {gate.statement}"))
    place, worst = words.place_words(found), words.worst_words(found)
    if found.verdict in ("mismatch", "unexplained") and place:
        to.print(escape(f"where: {place}{f'; worst at {worst}' if worst else ''}"))
    if found.changes:
        to.print(table("changed", "healthy", "now", "indistinguishable from",
                       rows=words.change_rows(found)))
    if found.effects and not found.references:
        to.print(_effects(found))
        for effect in found.effects:
            if effect.statement not in found.message:
                to.print(escape(words.sentence(effect.statement)))
            if effect.intervals_s:
                to.print(escape(f"{effect.name} acts at "
                                     f"{words.interval_words(effect.intervals_s)}"))
    if found.learned:
        to.print(_learned(found))
    if found.before or found.after:
        to.print(table("parameter", *words.model_names(found), rows=(
            (SYMBOLS.get(name, name), *words.parameter_words(found, name))
            for name in dict.fromkeys((*found.before, *found.after)))))
    show_indicators(to, indicators, settings, "`diagnose` of it alone"
                    if found.references else "`diagnose`")
    if found.signals:
        to.print(_fit(found))
    show_baselines(to, found.baselines)
    for line in words.against_config(found, settings):
        to.print(f"[yellow]config[/]: {escape(line)}")
    for finding in found.rig_within:
        to.print(f"[yellow]rig data[/]: {escape(finding.statement)}")
    unknown = words.nameless(found)
    todo = words.next_steps(found, shlex.join(found.bags) + words.own_config(settings.rig)
                            ) if unknown else ()
    for title, sentences in (("health", (*words.off_words(found), *found.health)),
                             ("what to do", todo), ("advice", () if unknown else found.advice),
                             ("note", notes)):
        for text in sentences:
            to.print(f"[yellow]{title}[/]: {escape(words.sentence(text))}")
    for text in filter(None, (words.certainty(found), words.windows_words(found))):
        to.print(escape(text), style="dim")
    print_end(to, words.footnote(found) if found.before or found.after else "", written)


def _effects(found: Diagnosis) -> Table:
    return table("left out", "probability", "balance", "size", "parameters",
                 "indistinguishable from", rows=(
        (effect.name, probability(effect.probability), effect.balance, effect.size,
         "\n".join(f"{name} = {words.value_words(value)}"
                   for name, value in effect.parameters.items()),
         words.rivals(effect.indistinguishable_from) or "–") for effect in found.effects))


def _learned(found: Diagnosis) -> Table:
    def formulas(term: LearnedTerm) -> str:
        return "\n".join([term.formula or "none fits as well as the curve",
                          *(f"or {shown}, {words.log_units(behind)} log units worse"
                            for shown, behind in term.rivals if behind < RIVAL_FORMULA)])

    return table("learned", "function of", "size", "removed on unseen data", "formula", rows=(
        (f"missing {term.balance}", ", ".join(term.of), term.size, words.percent(term.removed),
         formulas(term)) for term in found.learned))


def _fit(found: Diagnosis) -> Table:
    heads, rows = words.fit_rows(found)
    how = "free run" if "position" in found.signals else "low-passed residual of each balance"
    return table(*heads, rows=rows, caption_justify="left", caption=(
        f"root mean square, {how}; on {words.DATA.get(found.data, found.data)}"))
