"""The HTML report of ``diagnose``: what is missing, where, how it is known, what it did."""

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eha_monitor.balances.baseline import Baseline
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.mismatch import diagnosis
from eha_monitor.mismatch.diagnosis import Diagnosis, Value
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import SYMBOLS, number, quantity
from eha_monitor.reports import diagnosis_figures as figures
from eha_monitor.reports import diagnosis_words as words
from eha_monitor.reports.figure import Block
from eha_monitor.reports.page import (
    FirstScreen,
    Table,
    config_tables,
    indicator_table,
    interval_timeline,
    law_table,
    render,
    table,
    with_limits,
)
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.own_terms import is_own
from eha_monitor.settings.rig import Tolerance, corrected
from eha_monitor.words import effect_words, listed
from eha_monitor.words import probability as probability_words

_MOST_CURVES = 6


def diagnosis_page(found: Diagnosis, settings: Settings, losses: Sequence[str] = (),
                   command: str = "", indicators: Sequence[Indicator] = ()) -> str:
    """Return the report of a diagnosis, made with these settings, as HTML text.

    ``losses`` are sentences on what was lost in reading; ``command`` makes the answer again.
    """
    found = figures.presentable(found)
    name = listed([Path(bag).name or bag for bag in found.bags]) or settings.rig.name
    curves = figures.informative(found)
    _, statistics = words.advice_in_parts(found)
    return render(
        "diagnosis.html.j2", plus_minus=words.footnote(found),
        title=f"EHA diagnosis: {name}", name=name,
        first=with_limits(_first_screen(found, curves, settings), indicators, settings),
        facts=_facts(found, settings), losses=losses,
        verdict=found.verdict, references=_healthy(found), compared=words.compared(found),
        indicators=indicator_table(indicators, settings), laws=law_table(indicators),
        changes=_changes(found), pieces=_pieces(found), machine=_machine(found),
        wrong=_rig_table(found.rig_data, settings.rig.tolerance),
        within=_rig_table(found.rig_within, settings.rig.tolerance, "rig-within"),
        learned=[_learned(term) for term in found.learned],
        effects=[_effect(effect, found.duration_s) for effect in found.effects],
        location=_location(found), remarks=tuple(map(words.sentence, found.remarks)),
        against=tuple(map(words.sentence, words.against_config(found, settings))),
        curves=[figures.curve_figure(found, curve)
                for curve in curves[0 if found.learned else 1 : _MOST_CURVES]],
        fit=_fit(found), fit_data=words.DATA.get(found.data, found.data),
        by_balances="position" not in found.signals, overlays=_overlays(found),
        evidence=_evidence(found), gates=[words.sentence(one.statement) for one in found.gates],
        considered=_considered(found.considered), agreement=_agreement(found),
        first_view=_first_view(found.baselines), memory=_memory_table(found),
        statistics=[words.sentence(text) for text in statistics],
        certainty=words.certainty(found), windows=words.windows_words(found),
        command=command, config=config_tables(settings), **_for_config(found, settings),
        rotary=settings.rig.motion == "rotary")


# ---- the first screen -----------------------------------------------------------------------

def _first_screen(found: Diagnosis, curves: list[diagnosis.Curve], settings: Settings
                  ) -> FirstScreen:
    """Return the verdict, the missing term, B and beta_e before and after, what to do."""
    picture, caption = None, ""
    if found.learned:
        picture = figures.learned_figure(found.learned[0])
        caption = _learned_note(found.learned[0])
    elif curves:
        picture = figures.curve_figure(found, curves[0], large=True)
        caption = _curve_note(found, curves[0])
    both = words.compared(found)
    shown = (found.before, found.after) if both else (found.before,)
    heads = ("parameter", *(words.model_names(found) if both else ("model of the config",)))
    parameters = table(heads, [
        (words.parameter_name(name), *words.parameter_words(found, name)[:len(shown)])
        for name in dict.fromkeys((*found.before, *found.after))],
        ("", *["value"] * len(shown)), "summary")
    return FirstScreen(
        words.head_of(found)[0], words.head_words(found), words.message_words(found, True),
        tuple(f"{words.recordings_words(found)} {effect_words(effect.name)} is indistinguishable "
              f"from {words.rivals(effect.indistinguishable_from)}." for effect in found.effects
              if effect.indistinguishable_from),
        tuple((words.rig_words(one), (one.indistinguishable_from
               and f"{words.recordings_words(found)} {one.key} is indistinguishable from "
                   f"{words.rivals(one.indistinguishable_from)}.") or "")
              for one in found.rig_data),
        picture, caption, parameters or None,
        tuple(map(words.sentence, (*words.off_words(found), *found.health))),
        words.next_steps(found, shlex.join(found.bags) + words.own_config(settings.rig)),
        found.verdict, tuple(map(words.sentence, words.channels_in_parts(found)[0])))


def _curve_note(found: Diagnosis, curve: diagnosis.Curve) -> str:
    dots, line = ("Grey", "Blue") if curve.against == "time" else ("Dots", "Line")
    if not (found.changes or found.effects or found.rig_data) and found.verdict == "consistent":
        return "Residual of the model: noise about zero."
    model, rest = next((model, rest) for holds, model, rest in (
        (found.changes, "the model of the healthy recordings", f" {line}: what has changed."),
        (found.effects, "the linear model", f" {line}: the identified effects."),
        (found.rig_data, "the model of the config", ""),
        (found.references, "the model", " None of the machine's numbers explains it."),
        (True, "the model", " No effect of the catalogue fits.")) if holds)
    return f"{dots}: measured term that {model} lacks.{rest}"


def _learned_note(term: diagnosis.LearnedTerm) -> str:
    formula = ("Dashed: the formula, which explains as much as the curve to within 5 %."
               if term.formula else "Dashed: the best formula; the curve fits better."
               if term.rivals else "")
    return ("Dots: measured term that the model lacks. Blue: learned from the whole recording, "
            f"with its band. {formula} Outside the ends there are no data.")


def _healthy(found: Diagnosis) -> int:
    """Return how many references an answer compares with, without those that were left out."""
    whole = found.references and found.machine is not None and not found.machine.pieces
    return len(found.machine.sources) if whole else len(found.references)


def _facts(found: Diagnosis, settings: Settings) -> list[tuple[str, str]]:
    facts = [("Recordings" if len(found.bags) > 1 else "Recording",
              ", ".join(found.bags) or "no file"), ("Rig", settings.rig.name)]
    if found.duration_s > 0:
        facts.append(("Duration", f"{number(found.duration_s)} s"))
    if found.wall_s > 0:
        facts.append(("Computed in", f"{number(found.wall_s, 3)} s"))
    return facts


# ---- what was found -------------------------------------------------------------------------

def _changes(found: Diagnosis) -> Table:
    """Return what has changed against healthy recordings."""
    return table("number | healthy | now | indistinguishable from", words.change_rows(found),
                 " | value | value | ",
                 note=f"Healthy: mean of {_healthy(found)} recordings, ± their standard "
                      "deviation from one to the next. Now: this recording, ± its uncertainty "
                      "due to noise.")


def _pieces(found: Diagnosis) -> Table | None:
    """Return the data in pieces, or None where nothing changed."""
    if not found.pieces:
        return None
    names = list(found.pieces[0].values)
    return table(("recording", "from, s", "to, s", *map(words.parameter_name, names)), [
        (one.bag, f"{one.start_s:.1f}", f"{one.stop_s:.1f}",
         *(words.value_words(one.values.get(name)) for name in names)) for one in found.pieces],
        ("", "number", "number", *["value"] * len(names)),
        note="Each piece was fitted separately with the model of the config. The intervals "
             "between pieces, where the parameter changes, are left out.")


def _machine(found: Diagnosis) -> tuple[Table, Table] | None:
    """Return what several recordings of a machine share, and what differs; None without one."""
    machine = found.machine
    if machine is None or found.references:
        return None
    parameters = [
        (p.words, one.balance, words.value_words(Value(p.value, p.stddev, p.unit)),
         f"± {words.percent(p.between / abs(p.value))}" if p.value and p.between else "none seen")
        for one in machine.balances for p in one.parameters]
    settings = [s for one in machine.balances for s in one.settings]
    rows = [(source, *(words.value_words(Value(s.value[i], s.stddev[i], s.unit))
                       for s in settings),
             *(words.percent(one.error[i]) for one in machine.balances))
            for i, source in enumerate(machine.sources)]
    heads = ("recording", *(s.words for s in settings),
             *(f"{one.balance} unexplained" for one in machine.balances))
    return (table("number | balance | value | between recordings", parameters,
                  " |  | value | value",
                  note=f"Parameters that all {len(machine.sources)} recordings share, ± the "
                       "deviation of the value, and the spread from one recording to the next."),
            table(heads, rows, ("", *["value"] * (len(heads) - 1)),
                  note="What belongs to each recording's setting, and the share of each balance "
                       "that stays unexplained when the fit leaves that recording out."))


def _rig_table(findings: Sequence[diagnosis.RigFinding], tolerance: Tolerance, key: str = ""
               ) -> Table:
    """Return numbers of the rig as configured and as the recording has them."""
    wrong = not key
    rows = []
    for one in findings:
        configured, said = words.rig_values(one)
        row = [one.key, configured, words.tolerance_words(tolerance, one.key), said]
        if wrong:
            row += [words.beyond_words(tolerance, one), probability_words(one.probability),
                    words.rivals(one.indistinguishable_from) or "–"]
        rows.append(row)
    return table("number | config | its tolerance | recording"
                 + (" | off by | probability | indistinguishable from" if wrong else ""), rows,
                 "key | number | number | value" + (" | number | value | " if wrong else ""), key)


def _learned(term: diagnosis.LearnedTerm) -> dict[str, Any]:
    """Return what the page says of a learned term."""
    rivals = [f"{shown} ({words.log_units(behind)} log units "
              f"{'better' if behind < 0 else 'worse'})" for shown, behind in term.rivals]
    ends = [quantity(end, term.against_unit, 3) for end in (term.x[0], term.x[-1])]
    return {"statement": words.sentence(term.statement), "facts": [
        ("formula", term.formula or "none fits as well as the curve"),
        *(("other formulas" if not i else "", one) for i, one in enumerate(rivals)),
        ("unseen data", f"{words.percent(term.removed)} less squared error beyond the sensor "
                        "noise than the same model without it"),
        ("valid from", f"{ends[0]} to {ends[1]}; outside, there are no data, and the curve keeps "
                       "its last value")]}


def _effect(effect: diagnosis.NamedEffect, duration_s: float) -> dict[str, Any]:
    """Return what the page says of an effect."""
    known = CATALOGUE.get(effect.name)
    about = {p.name: p.description for p in known.parameters} if known else {}
    source = f" ({known.source})" if known and known.source else ""
    probability = probability_words(effect.probability)
    balance = words.BALANCES.get(effect.balance, effect.balance)
    facts = [("probability", probability if probability != "—" else ""),
             ("indistinguishable from", words.rivals(effect.indistinguishable_from)
              or "none of the alternatives that were compared"),
             ("check at the rig", words.sentence(effect.rig_check)),
             ("equation", effect.equation and effect.equation + source)]
    return {"key": effect.name, "name": effect_words(effect.name),
            "balance": f"{balance}, {effect.size}" if effect.size else balance,
            "statement": words.sentence(effect.statement),
            "intervals": words.interval_words(effect.intervals_s),
            "timeline": interval_timeline("acts", effect.intervals_s, duration_s),
            "facts": [(label, text) for label, text in facts if text],
            "parameters": table("parameter | value | what it is", [
                (symbol, words.value_words(value), about.get(symbol, ""))
                for symbol, value in effect.parameters.items()], "key | value | ")}


def _location(found: Diagnosis) -> dict[str, Any] | None:
    """Return the share of each balance, the regime and the intervals on the time axis, or None."""
    shares = sorted(((name, share) for name, share in found.location.balance.items()
                     if math.isfinite(share)), key=lambda item: -item[1])
    if not any(share > 0 for _, share in shares):
        return None
    worst = words.worst_words(found)
    return {"bars": [(words.BALANCES.get(name, name), words.percent(share),
                      round(100 * min(max(share, 0.0), 1.0), 2)) for name, share in shares],
            "regime": words.regime_words(found), "intervals": worst,
            "timeline": interval_timeline("worst", found.location.intervals_s, found.duration_s)
            if worst else None}


def _fit(found: Diagnosis) -> Table:
    """Return the errors on unseen data."""
    heads, rows = words.fit_rows(found)
    both = words.compared(found)
    return table(heads, rows, ("number", "value", *(["value", "number"] * both), "number"),
                 "errors", "Root mean square."
                 + " Removed: of what exceeds the sensor noise." * both)


def _overlays(found: Diagnosis) -> list:
    names = ("healthy model", "model now") if found.references else ("model before", "model after")
    return [*filter(None, (figures.overlay_figure(overlay, words.compared(found), names)
                           for overlay in found.overlays))]


# ---- for the researcher ---------------------------------------------------------------------

def _evidence(found: Diagnosis) -> Table:
    """Return the evidence of each effect and of each learned term."""
    return table("effect | log units lost without it", [
        *((effect_words(one.name), words.log_units(one.log_evidence)) for one in found.effects),
        *((f"learned: missing {one.balance}", words.log_units(one.gained))
          for one in found.learned)], " | number")


def _memory_table(found: Diagnosis) -> Table:
    """Return how far the one-step errors are from white."""
    first, second = words.model_names(found)
    return table(f"memory of the one-step errors | {first} | {second}", [
        (name.replace("_", " "), _memory(fit.before_whiteness), _memory(fit.after_whiteness))
        for name, fit in found.signals.items()], " | number | number",
        note="Variance of sums of one-step errors over that of white noise; 1 if the model is "
             "right.")


def _memory(ratio: float) -> str:
    return f"{ratio:.2f}" if 0 <= ratio < 10 else number(ratio, 3)


def _first_view(baselines: Sequence[Baseline]) -> Table:
    """Return what least squares on a recording's balances give."""
    rows = []
    for balance, fit in ((name, fit) for one in baselines
                         for name, fit in (("force", one.force), ("flow", one.flow))):
        for term in fit.terms if fit is not None else ():
            shown = (words.value_words(Value(term.value, term.stddev, term.unit))
                     if term.determined else "none" if term.at_bound and np.isfinite(term.stddev)
                     else "not determined")
            rows.append((term.words, balance, shown, words.percent(fit.unseen_share)))
    return table("number | balance | value | of the balance unexplained", rows,
                 " |  | value | number",
                 note="Each balance by itself, on the samples that move; no search. An "
                      "explanation that leaves more of the force on unseen data than this is "
                      "refused.")


def _considered(considered: tuple[diagnosis.Considered, ...]) -> list[tuple[str, Table]]:
    """Return what was tried: title and table, one for each set of effects named by then."""
    found = []
    for beside in sorted(dict.fromkeys(one.beside for one in considered), key=len):
        members = sorted((one for one in considered if one.beside == beside),
                         key=lambda one: -one.gain if math.isfinite(one.gain) else math.inf)
        rows = [(effect_words(one.name),
                 words.BALANCES.get(CATALOGUE[one.name].balance, "")
                 if one.name in CATALOGUE else "", words.log_units(one.gain),
                 words.sentence(one.why)) for one in members]
        title = "Beside " + listed([effect_words(b) for b in beside]) if beside \
            else "Before any effect is identified"
        found.append((title, table("effect | balance | gain, log units | why it was rejected",
                                   rows, " |  | number | message", fold=True)))
    return found


def _span_words(values: list[Value | None]) -> str:
    known = [value for value in values if value and math.isfinite(value.value)]
    return " to ".join(quantity(end(one.value for one in known), known[0].unit)
                       for end in (min, max)) if known else "unknown"


def _agreement(found: Diagnosis) -> Block | None:
    """Return the pictures of each parameter by part of the record, with a sentence for each."""
    names = dict.fromkeys(name for part in found.agreement for name in (*part.before, *part.after))
    pictures, notes = [], []
    for name in names:
        one = figures.agreement_figure(name, found.agreement, found.before.get(name),
                                       found.after.get(name))
        if one is None:
            continue
        pictures.append(one)
        before, after = (_span_words([values.get(name) for values in parts]) for parts in (
            [part.before for part in found.agreement], [part.after for part in found.agreement]))
        notes.append(f"{SYMBOLS.get(name, name)} from the parts: {before} before, {after} after.")
    return Block("agreement", "", tuple(pictures), tuple(notes)) if pictures else None


# ---- the config -----------------------------------------------------------------------------

def _for_config(found: Diagnosis, settings: Settings) -> dict[str, Any]:
    """Return what ``--write-config`` would put into a config, and what it cannot."""
    if found.verdict != "mismatch" and not found.learned:
        return {"config_lines": "", "config_lacks": ""}
    rig, _ = corrected(settings.rig, {finding.key: finding.found.value
                                      for finding in found.rig_data})
    effects = {name: _flow_text(values) for name, values in found.config_effects.items()
               if name in CATALOGUE or is_own(values)}
    lines = [*(["rig:"] if rig else []), *(f"  {key}: {value:.6g}" for key, value in rig.items()),
             *(["effects:"] if effects else []),
             *(f"  {name}: {text}" for name, text in effects.items())]
    return {"config_lines": "\n".join(lines),
            "config_lacks": "; ".join(f"{effect_words(name)}, for {why}"
                                      for name, why in words.not_in_config(found).items())}


def _flow_text(values: dict) -> str:
    """Return an entry of ``effects`` on one line of YAML."""
    def text(value) -> str:
        if isinstance(value, str):
            return f'"{value}"' if "(" in value or "*" in value else value
        if isinstance(value, (list, tuple)):
            return f"[{', '.join(map(text, value))}]"
        return f"{value:.6g}"

    return "{" + ", ".join(f"{key}: {text(value)}" for key, value in values.items()) + "}"
