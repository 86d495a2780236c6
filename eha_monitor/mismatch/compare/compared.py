"""The answer of a comparison: what has changed against healthy recordings, and the proof."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from eha_monitor.balances.answer import far_from_config, first_answer
from eha_monitor.balances.changed import against
from eha_monitor.balances.course import courses_of
from eha_monitor.balances.machine import healthy_machine
from eha_monitor.breakdown import computing
from eha_monitor.errors import InputError
from eha_monitor.estimation.hold_choice import resolved
from eha_monitor.mismatch.compare.changes import Comparison, Explanation
from eha_monitor.mismatch.compare.healthy import FALSE, Healthy, healthy_of
from eha_monitor.mismatch.data.experiment import Experiment, by_balances, experiment_of
from eha_monitor.mismatch.diagnosis import (
    Change,
    Diagnosis,
    LearnedTerm,
    Location,
    NamedEffect,
    Value,
)
from eha_monitor.mismatch.learn.validated import LARGEST, validated_term
from eha_monitor.mismatch.likelihood.along import filtered_tracks
from eha_monitor.mismatch.likelihood.fit import Fit, with_unknowns
from eha_monitor.mismatch.locate import location as locate
from eha_monitor.mismatch.locate.terms import BALANCES, Missing, missing_terms
from eha_monitor.mismatch.name.columns import ALWAYS
from eha_monitor.mismatch.name.naming import Naming
from eha_monitor.mismatch.name.select import credible
from eha_monitor.mismatch.show import held_out as show
from eha_monitor.mismatch.show.model import config_effects, size_of, values_of
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import number, share, with_uncertainty
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import effect_words, listed

Report = Callable[[str, float], None]
FASTER = 1.2  # times the references' top speed: beyond it nothing is known of the healthy machine
OWN_BALANCES = {"B": "force", "beta_e": "flow", "rig.charge_pressure": "flow"}
OWN_WORDS = {"B": "viscous damping B", "beta_e": "the effective bulk modulus",
             "rig.charge_pressure": "the charge pressure"}
OWN_UNITS = {"B": "N·s/m", "beta_e": "Pa", "rig.charge_pressure": "Pa"}


def compared(recordings: list[Recording], references: list[Recording], settings: Settings,
             progress: Report | None = None) -> Diagnosis:
    """Say what has changed in recordings of a machine against healthy ones.

    Parameters
    ----------
    recordings : of the machine now, explained together.
    references : of a healthy machine, of the same or of one like it.
    settings : nominal config; its effects count as known.
    progress : called with what is done and how far it is, 0 to 1.

    Raises
    ------
    InputError
        If the references are too few or too short, or nothing in them moves.
    """
    say, started = progress or (lambda text, share: None), time.perf_counter()
    with computing(*(one.source for one in (*recordings, *references))):
        references, left_out = _that_move(references, settings)
        found = _compared(recordings, references, settings, say)
    return replace(found, wall_s=time.perf_counter() - started, advice=left_out + found.advice)


def _that_move(references: list[Recording], settings: Settings
               ) -> tuple[list[Recording], tuple[str, ...]]:
    """Return the references that hold a motion, and a line about each that does not."""
    try:
        moving, _, lines = courses_of(references, settings)
    except InputError:  # none has a force balance: what else they hold is looked at below
        return references, ()
    return moving, tuple(f"reference {line}, so it says nothing of the healthy machine"
                         for line in lines)


def _compared(recordings: list[Recording], references: list[Recording], settings: Settings,
              say: Report) -> Diagnosis:
    if by_balances([*recordings, *references], settings):
        return _by_balances(recordings, references, settings)
    first, coarse = first_answer(references, settings), None
    if first is not None and first.verdict == "insufficient_data":
        raise InputError(f"{references[0].source}: expected references that move: "
                         f"{first.message}")
    if first is not None:
        with suppress(InputError):  # too little motion for a spread of parts
            coarse = _by_balances(recordings, references, settings)
    # A filter of the config's laws is for what is smaller than a balance shows.
    if coarse is not None and (coarse.verdict != "consistent" or far_from_config(first)):
        return coarse
    held, _ = resolved(references, settings)
    if coarse is not None and not credible(experiment_of(references, held, False),
                                           first.config_effects):
        return coarse
    say("learning the spread of healthy recordings", 0.1)
    healthy = healthy_of(references, held)
    say("comparing", 0.6)
    here = [experiment_of(recordings, held, hold_out) for hold_out in (False, True)]
    found = _answer(healthy, recordings, references, *(
        healthy.experiment.only(one.stretches) for one in here), say)
    return replace(found, advice=_advice(healthy, references, here[0], found.verdict))


def _by_balances(recordings: list[Recording], references: list[Recording], settings: Settings
                 ) -> Diagnosis:
    return against(healthy_machine(references, settings), recordings, settings,
                   tuple(one.source for one in references))


def _answer(healthy: Healthy, recordings: list[Recording], references: list[Recording],
            whole: Experiment, fitted: Experiment, say: Report) -> Diagnosis:
    bags = tuple(one.source for one in recordings)
    duration = sum(one.duration for one in recordings)
    comparison = Comparison(healthy, whole)
    best = comparison.before
    if comparison.changed:
        say("testing what has changed", 0.7)
        best = comparison.explained()
    verdict = "consistent" if not comparison.changed else (
        "mismatch" if best.places and (best.complete or comparison.share_of(
            best) > whole.policy.explained) else "unexplained")
    places = best.places if verdict == "mismatch" else ()
    say("showing the fit on unseen data", 0.9)
    before, plain = (with_unknowns(fitted, one)
                     for one in (healthy.usual(), healthy.fit))
    after = Comparison(healthy, fitted).fitted(best.fit, places) or plain
    names = tuple(dict.fromkeys(comparison.what[i].owner for i in places
                                if comparison.what[i].owner in CATALOGUE))
    model = _named(after, names)
    changes = tuple(_change(healthy, comparison, best, place) for place in places)
    signals = show.shown(fitted, before, model)
    effects = tuple(_effect(fitted, model, name, changes, comparison.before.left - best.left)
                    for name in names)
    where, curves = _place(fitted, before, model, verdict, changes)
    message, term = _message(healthy, comparison, best, verdict, changes, references), None
    if verdict == "unexplained" and healthy.naming.unexplained < whole.policy.rival:
        say("learning effects not in the catalogue", 0.95)
        found = validated_term(fitted, fitted, _on(healthy.naming, healthy.fit, fitted))
        if found is not None and found.term is not None:
            term, model = found.term, found.fit
            signals = show.shown(fitted, before, model)
            changes = (_learned(found.term, found.missing),)
            curves = locate.latent_curves(fitted, before, model, [found.missing])
            message = f"an effect that is not in the catalogue has changed: {term.statement}"
    return Diagnosis(
        bags, verdict, message, where, effects, _reference_values(healthy),
        values_of(fitted, model), "held_out", signals, curves,
        () if verdict == "consistent" else show.overlays(fitted, before, model),
        config_effects=config_effects(fitted, model, model.named, None if term is None else (
            f"learned_{term.adds}", term.entry)), duration_s=duration,
        command_hold=healthy.experiment.settings.command_hold,
        learned=() if term is None else (term,),
        references=tuple(one.source for one in references), changes=changes,
        policy=whole.policy.to_dict())


def _learned(term: LearnedTerm, missing: Missing) -> Change:
    """Return a learned term as a change: nothing in healthy recordings, its largest size now."""
    size = float(np.quantile(np.abs(np.concatenate(missing.modelled)), LARGEST))
    return Change(f"learned {term.balance}", "", term.balance, Value(0.0, np.nan, missing.unit),
                  Value(size, np.nan, missing.unit), missing.unit, term.statement)


def _on(naming: Naming, fit: Fit, experiment: Experiment) -> Naming:
    """Return what was named of the healthy machine as the beginning for another recording."""
    before, after = (with_unknowns(experiment, one) for one in (naming.before, fit))
    return replace(naming, experiment=experiment, before=before, after=after)


def _named(fit: Fit, names: tuple[str, ...]) -> Fit:
    """Return a model that says which effects it has."""
    return replace(fit, named=tuple(dict.fromkeys((*fit.named, *names))))


def _reference(healthy: Healthy, place: int) -> tuple[float, float]:
    """Return what healthy runs have of a number, and how it varies from one to the next, SI."""
    column = healthy.runs[0].what[place]
    f = column.free
    now = f.inward(healthy.fit.theta[f.place]) if column.variant < 0 else f.prior
    own = healthy.own.places.tolist()
    if place in own:
        mean = healthy.own.mean[own.index(place)]
        spread = float(np.sqrt(healthy.own.variance[own.index(place)]))
    else:
        at = healthy.kept.tolist().index(place)
        mean, spread = healthy.mean[at], float(healthy.spread[at])
    value = now + mean * f.spread
    if f.log:
        return float(np.exp(value)), float(np.exp(value)) * spread * f.spread
    return float(value), spread * f.spread


def _reference_values(healthy: Healthy) -> dict[str, Value]:
    """Return B and beta_e of the healthy runs, with their spread from one to the next."""
    found = values_of(healthy.experiment, healthy.fit)
    for place in healthy.own.places:
        name = healthy.runs[0].what[place].name
        if name in found:
            found[name] = Value(*_reference(healthy, int(place)), found[name].unit)
    return found


def _change(healthy: Healthy, comparison: Comparison, best: Explanation, place: int) -> Change:
    """Return the record of a number that has changed."""
    column = comparison.what[place]
    reference, spread = _reference(healthy, place)
    now, stddev = best.fit.value(column.name), best.fit.stddev(column.name)
    if column.owner == ALWAYS:
        what, symbol, balance = column.name.removeprefix("rig."), "", OWN_BALANCES[column.name]
        unit, words = OWN_UNITS[column.name], OWN_WORDS[column.name]
    else:
        entry, symbol = CATALOGUE[column.owner], column.name.partition(".")[2]
        p = next(p for p in entry.parameters if p.name == symbol)
        what, balance, unit = column.owner, entry.balance, p.unit.replace("*", "·")
        words = f"{effect_words(what)} ({symbol}, {p.description})"
    rivals = dict.fromkeys(comparison.what[i].owner or comparison.what[i].name.removeprefix("rig.")
                           for i in best.rivals.get(place, ()))
    runs = (f"{len(healthy.runs)} pieces of the healthy recordings" if healthy.pieces
            else f"{len(healthy.runs)} healthy recordings")
    statement = (f"{words} is {with_uncertainty(now, stddev, unit)}, where {runs} have "
                 f"{with_uncertainty(reference, spread, unit)}")
    return Change(what, symbol, balance, Value(reference, spread, unit), Value(now, stddev, unit),
                  unit, statement, tuple(name for name in rivals if name != what))


def _effect(experiment: Experiment, fit: Fit, name: str, changes: tuple[Change, ...],
            gained: float) -> NamedEffect:
    """Return the record of an effect that has changed."""
    mine = [change for change in changes if change.what == name]
    entry = CATALOGUE[name]
    return NamedEffect(
        name, entry.balance, "; ".join(change.statement for change in mine),
        {change.symbol: change.now for change in mine}, gained,
        tuple(dict.fromkeys(rival for change in mine for rival in change.indistinguishable_from)),
        entry.equation, entry.rig_check,
        size_of(experiment, fit, name, filtered_tracks(experiment, fit)))


def _place(experiment: Experiment, before: Fit, after: Fit, verdict: str,
           changes: tuple[Change, ...]) -> tuple[Location, tuple]:
    """Return where the recording leaves the healthy model, and the curves that show it."""
    weights = dict.fromkeys(BALANCES, 0.0)
    if verdict == "consistent":
        return Location(weights, "", ()), ()
    effects = any(change.symbol for change in changes)
    terms = missing_terms(experiment, before, after if effects else None)
    found = locate.location_of(experiment, before, after, {}, None)
    curves = locate.latent_curves(experiment, before, after, terms)
    if changes:
        for change in changes:
            weights[change.balance] += 1.0 / len(changes)
        found = Location(weights, found.regime, found.intervals_s)
    return found, curves


def _message(healthy: Healthy, comparison: Comparison, best: Explanation, verdict: str,
             changes: tuple[Change, ...], references: list[Recording]) -> str:
    """Return the answer in a sentence."""
    if verdict == "mismatch":
        return "; ".join(change.statement for change in changes)
    t = healthy.t_of(comparison.before.reading.amplitudes, comparison.before.reading.power)
    at = int(np.nanargmax(np.abs(t) / healthy.limits))
    column = comparison.what[healthy.kept[at]]
    words = OWN_WORDS.get(column.name) or effect_words(column.owner)
    if verdict == "consistent":
        return (f"nothing has changed from {len(references)} healthy recordings: the largest "
                f"difference is {words}, by {number(abs(t[at]), 2)} of their standard "
                f"deviations; the limit is {number(healthy.limits[at], 2)} ({share(FALSE)} false "
                "alarms)")
    named = [effect_words(comparison.what[i].owner or comparison.what[i].name)
             for i in best.places]
    part = (f"; {listed(named)} would explain {share(comparison.share_of(best), 2)} of it"
            if named else "")
    return (f"an effect that is not in the catalogue has changed: {words} differs by "
            f"{number(abs(t[at]), 2)} standard deviations of the healthy recordings{part}")


def _advice(healthy: Healthy, references: list[Recording], here: Experiment, verdict: str
            ) -> tuple[str, ...]:
    """Return what to know of the references, and what to do next; ``here`` the recordings."""
    found = []
    if healthy.pieces:
        found.append(f"{len(references)} reference recordings are too few to estimate how "
                     "recordings differ; pieces of them were compared instead, so a normal "
                     "difference between recordings may be reported as a change")
    odd = [references[i].source for i in healthy.odd_ones()] if not healthy.pieces else []
    if odd:
        found.append(f"{listed(odd)} differ{'' if len(odd) > 1 else 's'} from the other "
                     "references more than a healthy recording should: check whether it belongs "
                     "to them")
    if here.ranges.speed > FASTER * healthy.experiment.ranges.speed:
        found.append("it moves faster than any reference; above their speed nothing can be "
                     "compared")
    if verdict == "unexplained":
        found.append("diagnose it without --reference: a learned term shows the shape of the "
                     "unknown effect")
    return tuple(found)
