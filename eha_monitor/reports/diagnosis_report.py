"""The HTML report of ``diagnose``: what is missing, where, how it is known, what it did."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from eha_monitor.balances.baseline import Baseline
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.mismatch.diagnosis import (
    Change,
    Considered,
    Curve,
    Diagnosis,
    LearnedTerm,
    NamedEffect,
    RigFinding,
    Value,
)
from eha_monitor.output import write_text
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import DIAGNOSED, SYMBOLS, number, quantity
from eha_monitor.reports import diagnosis_words as words
from eha_monitor.reports.alarm_timeline import time_ticks
from eha_monitor.reports.diagnosis_figures import (
    agreement_picture,
    curve_picture,
    learned_picture,
    overlay_picture,
    telling,
)
from eha_monitor.reports.drawing import Block, Picture
from eha_monitor.reports.indicator_rows import indicator_rows
from eha_monitor.reports.page import render
from eha_monitor.reports.parameter_figures import NAMES
from eha_monitor.reports.tables import config_sections
from eha_monitor.settings.corrected import corrected
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.own_terms import is_own
from eha_monitor.settings.tolerance import Tolerance
from eha_monitor.words import effect_words, listed

_LARGEST = 1e60  # SI; beyond it squares and matplotlib's own sums overflow
_MOST_CURVES = 6
_MOST_OPEN = 6  # rows of a table of rivals that are shown without a click


def write_diagnosis_report(path: str | Path, found: Diagnosis, settings: Settings,
                           losses: Sequence[str] = (), command: str = "",
                           indicators: Sequence[Indicator] = ()) -> None:
    """Write the report of a diagnosis as a single HTML file.

    Parameters
    ----------
    path : file to write; an existing one is replaced at once when the new one is complete.
    found : the diagnosis.
    settings : the config it was made with.
    losses : sentences about what was lost in reading the recordings.
    command : the command that makes the same answer again.
    indicators : of the health, told or not.

    Raises
    ------
    InputError
        If ``path`` cannot be written.
    """
    write_text(path, diagnosis_page(found, settings, losses, command, indicators))


def diagnosis_page(found: Diagnosis, settings: Settings, losses: Sequence[str] = (),
                   command: str = "", indicators: Sequence[Indicator] = ()) -> str:
    """Return the report as HTML text."""
    found = presentable(found)
    name = listed([Path(bag).name or bag for bag in found.bags]) or settings.rig.name
    kind = words.head_of(found)[0]
    curves = telling(found)
    return render(
        "diagnosis.html.j2",
        plus_minus=DIAGNOSED,
        title=f"EHA diagnosis: {name}",
        name=name,
        heading=_heading(found, settings),
        kind=kind,
        verdict=found.verdict,
        head=words.head_words(found),
        message=words.message_words(found, probable=True),
        wrong=[_rig(finding, settings.rig.tolerance) for finding in found.rig_data],
        within=[_rig(finding, settings.rig.tolerance) for finding in found.rig_within],
        doubts=[f"In this recording {effect_words(effect.name)} is indistinguishable from "
                f"{_rivals(effect.indistinguishable_from)}." for effect in found.effects
                if effect.indistinguishable_from],
        hero=learned_picture(found.learned[0]) if found.learned else
        curve_picture(found, curves[0], large=True) if curves else None,
        hero_words=_learned_note(found.learned[0]) if found.learned else
        _curve_note(found, curves[0]) if curves else "",
        summary=_summary(found),
        indicators=indicator_rows(indicators, settings),
        health=[words.sentence(text) for text in found.health],
        learned=[_learned(term) for term in found.learned],
        changes=[_change(one) for one in found.changes],
        references=len(found.references),
        compared=_compared(found),
        pieces=_pieces(found),
        gates=[words.sentence(gate.statement) for gate in found.gates],
        machine=_machine(found),
        first_view=[row for one in found.baselines for row in _first_view(one)],
        location=_location(found),
        curves=[curve_picture(found, curve)
                for curve in curves[0 if found.learned else 1 : _MOST_CURVES]],
        effects=[_effect(effect, found.duration_s) for effect in found.effects],
        considered=_considered(found.considered),
        fit=_fit(found),
        by_balances="position" not in found.signals,
        fit_data=words.DATA.get(found.data, found.data),
        overlays=_overlays(found),
        agreement=_agreement(found),
        advice=[words.sentence(text) for text in found.advice],
        certainty=words.certainty(found),
        windows=words.windows_words(found),
        losses=losses,
        command=command,
        config=config_sections(settings),
        **_for_config(found, settings),
        rotary=settings.rig.motion == "rotary",
    )


def _compared(found: Diagnosis) -> bool:
    """Tell whether there is a model after the one of the config."""
    return bool(found.effects or found.rig_data or found.rig_within or found.pieces
                or found.learned or found.references)


def _change(change: Change) -> dict[str, str]:
    """Return a row of what has changed."""
    name = (f"{effect_words(change.what)} {change.symbol}" if change.symbol
            else f"{NAMES.get(change.what, change.what)} {SYMBOLS.get(change.what, '')}")
    return {"name": name.strip(), "reference": words.value_words(change.reference),
            "now": words.value_words(change.now),
            "rivals": _rivals(change.indistinguishable_from)}


def _first_view(one: Baseline) -> list[dict[str, str]]:
    """Return the rows of what least squares on a recording's balances say."""
    rows = []
    for balance, fit in (("force", one.force), ("flow", one.flow)):
        for term in fit.terms if fit is not None else ():
            value = Value(term.value, term.stddev, term.unit)
            shown = (words.value_words(value) if term.determined else "none" if term.at_bound
                     and np.isfinite(term.stddev) else "not determined")
            rows.append({"balance": balance, "what": term.words, "value": shown,
                         "left": words.percent(fit.unseen_share)})
    return rows


def _machine(found: Diagnosis) -> dict[str, Any] | None:
    """Return what the page says of the machine that several recordings show; None without one."""
    machine = found.machine
    if machine is None or found.references:
        return None
    parameters = [
        {"what": p.words, "balance": one.balance,
         "value": words.value_words(Value(p.value, p.stddev, p.unit)),
         "between": f"± {words.percent(p.between / abs(p.value))}" if p.value and p.between
         else "none seen"} for one in machine.balances for p in one.parameters]
    settings = [s for one in machine.balances for s in one.settings]
    rows = [{"name": source, "shown": [
        *(words.value_words(Value(s.value[i], s.stddev[i], s.unit)) for s in settings),
        *(words.percent(one.error[i]) for one in machine.balances)]}
        for i, source in enumerate(machine.sources)]
    return {"count": len(machine.sources), "parameters": parameters, "rows": rows,
            "heads": [*(s.words for s in settings),
                      *(f"{one.balance} unexplained" for one in machine.balances)]}


def _learned(term: LearnedTerm) -> dict[str, Any]:
    """Return what the page says of a learned term."""
    ends = (quantity(term.x[0], term.against_unit, 3), quantity(term.x[-1], term.against_unit, 3))
    return {"statement": words.sentence(term.statement),
            "formula": term.formula, "removed": words.percent(term.removed),
            "gained": words.log_units(term.gained), "ends": ends,
            "rivals": [(shown, words.log_units(behind)) for shown, behind in term.rivals]}


def _rig(finding: RigFinding, tolerance: Tolerance) -> dict[str, str]:
    configured, said = words.rig_values(finding)
    return {"key": finding.key, "words": words.rig_words(finding), "configured": configured,
            "found": said, "tolerance": words.tolerance_words(tolerance, finding.key),
            "beyond": words.beyond_words(tolerance, finding),
            "probability": words.probability(finding.probability),
            "rivals": _rivals(finding.indistinguishable_from)}


def _for_config(found: Diagnosis, settings: Settings) -> dict[str, Any]:
    """Return what ``--write-config`` would put into a config, and what it cannot."""
    if found.verdict != "mismatch" and not found.learned:
        return {"config_rig": {}, "config_effects": {}, "config_lacks": ""}
    rig, _ = corrected(settings.rig, {finding.key: finding.found.value
                                      for finding in found.rig_data})
    return {"config_rig": rig,
            "config_effects": {name: _flow_text(values)
                               for name, values in found.config_effects.items()
                               if name in CATALOGUE or is_own(values)},
            "config_lacks": listed([effect_words(effect.name)
                                          for effect in found.effects
                                          if effect.name not in found.config_effects])}


def _flow_text(values: dict) -> str:
    """Return an entry of ``effects`` on one line of YAML."""
    def text(value) -> str:
        if isinstance(value, str):
            return f'"{value}"' if "(" in value or "*" in value else value
        if isinstance(value, (list, tuple)):
            return f"[{', '.join(map(text, value))}]"
        return f"{value:.6g}"

    return "{" + ", ".join(f"{key}: {text(value)}" for key, value in values.items()) + "}"


def presentable(found: Diagnosis) -> Diagnosis:
    """Return the diagnosis with NaN for sizes that no picture can show, spreads positive."""
    curves = tuple(replace(curve, x=_tame(curve.x), measured=_tame(curve.measured),
                           spread=np.abs(_tame(curve.spread)), modelled=_tame(curve.modelled))
                   for curve in found.curves)
    overlays = tuple(replace(one, time=_tame(one.time), measured=_tame(one.measured),
                             before=_tame(one.before), after=_tame(one.after))
                     for one in found.overlays)
    agreement = tuple(replace(part, before=_known(part.before), after=_known(part.after))
                      for part in found.agreement)
    return replace(found, curves=curves, overlays=overlays, agreement=agreement,
                   before=_known(found.before), after=_known(found.after))


def _tame(values: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) < _LARGEST, values, np.nan)


def _known(values: dict[str, Value]) -> dict[str, Value]:
    return {name: value for name, value in values.items() if abs(value.value) < _LARGEST}


def _heading(found: Diagnosis, settings: Settings) -> list[tuple[str, str]]:
    facts = [("Recordings" if len(found.bags) > 1 else "Recording",
              ", ".join(found.bags) or "no file"), ("Rig", settings.rig.name)]
    if found.duration_s > 0:
        facts.append(("Duration", f"{number(found.duration_s)} s"))
    if found.wall_s > 0:
        facts.append(("Computed in", f"{number(found.wall_s, 3)} s"))
    return facts


def _curve_note(found: Diagnosis, curve: Curve) -> str:
    dots, line = ("Grey", "Blue") if curve.against == "time" else ("Dots", "Line")
    if found.effects:
        return (f"{dots}: measured term that the linear model lacks. {line}: the identified "
                "effects.")
    if found.rig_data:
        return f"{dots}: measured term that the model of the config lacks."
    if found.verdict == "consistent":
        return "Residual of the model: noise about zero."
    return f"{dots}: measured term that the model lacks. No effect of the catalogue fits."


def _learned_note(term: LearnedTerm) -> str:
    formula = ("Dashed: the formula, which explains as much as the curve to within 5 %."
               if term.formula else "Dashed: the best formula; the curve fits better."
               if term.rivals else "")
    return ("Dots: measured term that the model lacks. Blue: learned from the whole recording, "
            f"with its band. {formula} Outside the ends there are no data.")


def _summary(found: Diagnosis) -> list[dict[str, str]]:
    """Return the rows beside the first picture: parameters, then the errors."""
    rows = []
    for name in dict.fromkeys((*found.before, *found.after)):
        before, after = found.before.get(name), found.after.get(name)
        rows.append({"name": f"{NAMES.get(name, name)} {SYMBOLS.get(name, name)}",
                     "before": words.value_words(before), "after": words.value_words(after),
                     "noise": ""})
    for name, fit in found.signals.items():
        rows.append({"name": f"{name.replace('_', ' ')} error",
                     "before": words.error_words(fit.before_rms, fit),
                     "after": words.error_words(fit.after_rms, fit),
                     "noise": words.error_words(fit.noise_rms, fit)})
    return rows


def _pieces(found: Diagnosis) -> dict[str, Any] | None:
    """Return the table of what changed, or None where nothing did."""
    if not found.pieces:
        return None
    names = list(found.pieces[0].values)
    return {"names": [f"{NAMES.get(name, name)} {SYMBOLS.get(name, name)}" for name in names],
            "rows": [{"bag": piece.bag, "start": f"{piece.start_s:.1f}",
                      "stop": f"{piece.stop_s:.1f}",
                      "shown": [words.value_words(piece.values.get(name)) for name in names]}
                     for piece in found.pieces]}


def _location(found: Diagnosis) -> dict[str, Any] | None:
    """Return bars of the balances, the regime and the intervals on the time axis, or None."""
    shares = {name: share for name, share in found.location.balance.items()
              if math.isfinite(share)}
    if not any(share > 0 for share in shares.values()):
        return None
    spans, ticks = _spans(found.location.intervals_s, found.duration_s)
    return {"bars": [{"name": words.BALANCES.get(name, name), "share": words.percent(share),
                      "width": round(100 * min(max(share, 0.0), 1.0), 2)}
                     for name, share in sorted(shares.items(), key=lambda item: -item[1])],
            "regime": words.REGIMES.get(found.location.regime,
                                        found.location.regime.replace("_", " ")),
            "spans": spans, "ticks": ticks,
            "intervals": words.interval_words(found.location.intervals_s)}


def _spans(intervals_s: tuple[tuple[float, float], ...], duration_s: float
           ) -> tuple[list[dict[str, Any]], Sequence]:
    """Return intervals as places on the time axis of the recording, in per cent, and its ticks."""
    known = [(start, stop) for start, stop in intervals_s
             if math.isfinite(start) and math.isfinite(stop)]
    end = max([duration_s, *(stop for _, stop in known)])
    if not (known and 0 < end < _LARGEST):
        return [], ()
    return [{"left": round(100 * max(start, 0.0) / end, 3),
             "width": round(max(100 * (stop - start) / end, 0.4), 3),
             "title": f"{number(start)} s to {number(stop)} s"}
            for start, stop in known], time_ticks(end)


def _effect(effect: NamedEffect, duration_s: float) -> dict[str, Any]:
    known = CATALOGUE.get(effect.name)
    about = {p.name: p.description for p in known.parameters} if known else {}
    spans, ticks = _spans(effect.intervals_s, duration_s)
    return {"key": effect.name, "name": effect_words(effect.name),
            "balance": words.BALANCES.get(effect.balance, effect.balance), "size": effect.size,
            "statement": words.sentence(effect.statement), "equation": effect.equation,
            "source": known.source if known else "",
            "rig_check": words.sentence(effect.rig_check),
            "probability": words.probability(effect.probability),
            "evidence": words.log_units(effect.log_evidence),
            "intervals": words.interval_words(effect.intervals_s), "spans": spans,
            "ticks": ticks,
            "parameters": [{"symbol": symbol, "shown": words.value_words(value),
                            "about": about.get(symbol, "")}
                           for symbol, value in effect.parameters.items()],
            "rivals": _rivals(effect.indistinguishable_from)}


def _rivals(names: tuple[str, ...]) -> str:
    return listed([effect_words(name) for name in names], "or")


def _considered(considered: tuple[Considered, ...]) -> list[dict[str, Any]]:
    """Return the tables of what was tried, one for each set of effects named by then."""
    groups: dict[tuple[str, ...], list[Considered]] = {}
    for one in considered:
        groups.setdefault(one.beside, []).append(one)
    tables = []
    for beside, members in sorted(groups.items(), key=lambda item: len(item[0])):
        members = sorted(members, key=lambda one: -one.gain if math.isfinite(one.gain)
                         else math.inf)
        rows = [{"name": effect_words(one.name), "gain": words.log_units(one.gain),
                 "balance": words.BALANCES.get(CATALOGUE[one.name].balance)
                 if one.name in CATALOGUE else "", "why": words.sentence(one.why)}
                for one in members]
        title = "Beside " + listed([effect_words(b) for b in beside]) if beside \
            else "Before any effect is identified"
        shown = _MOST_OPEN if len(rows) > _MOST_OPEN + 2 else len(rows)
        tables.append({"title": title, "open": rows[:shown], "rest": rows[shown:]})
    return tables


def _fit(found: Diagnosis) -> list[dict[str, str]]:
    rows = []
    for name, fit in found.signals.items():
        share = words.removed(fit)
        rows.append({"name": name.replace("_", " "),
                     "before": words.error_words(fit.before_rms, fit),
                     "after": words.error_words(fit.after_rms, fit),
                     "noise": words.error_words(fit.noise_rms, fit),
                     "removed": words.percent(share) if math.isfinite(share) else "—",
                     "memory_before": _memory(fit.before_whiteness),
                     "memory_after": _memory(fit.after_whiteness)})
    return rows


def _memory(ratio: float) -> str:
    return f"{ratio:.2f}" if 0 <= ratio < 10 else number(ratio, 3)


def _overlays(found: Diagnosis) -> list[Picture]:
    names = ("healthy model", "model now") if found.references else ("model before", "model after")
    made = [overlay_picture(overlay, _compared(found), names) for overlay in found.overlays]
    return [one for one in made if one is not None]


def _agreement(found: Diagnosis) -> Block | None:
    """Return the pictures of each parameter by part of the record, with a sentence for each."""
    names = dict.fromkeys(name for part in found.agreement for name in (*part.before, *part.after))
    pictures, notes = [], []
    for name in names:
        one = agreement_picture(name, found.agreement, found.before.get(name),
                                found.after.get(name))
        if one is None:
            continue
        pictures.append(one)
        spans = []
        for values in ([part.before.get(name) for part in found.agreement],
                       [part.after.get(name) for part in found.agreement]):
            known = [value for value in values if value and math.isfinite(value.value)]
            spans.append(f"{quantity(min(v.value for v in known), known[0].unit)} to "
                         f"{quantity(max(v.value for v in known), known[0].unit)}"
                         if known else "unknown")
        notes.append(f"{SYMBOLS.get(name, name)} from the parts: {spans[0]} before, "
                     f"{spans[1]} after.")
    if not pictures:
        return None
    return Block("agreement", "", tuple(pictures), tuple(notes))
