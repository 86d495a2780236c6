"""The diagnosis from end to end: locate, name, model, show, advise."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from eha_monitor import ties
from eha_monitor.balances.answer import Asked, answered, first_answer
from eha_monitor.balances.baseline import baseline
from eha_monitor.balances.candidates import FORCE_OF_SENSORS
from eha_monitor.balances.change_point import since_change
from eha_monitor.balances.course import TRAVEL
from eha_monitor.balances.event import without_events
from eha_monitor.balances.policy import POLICY
from eha_monitor.breakdown import computing
from eha_monitor.estimation.hold_choice import resolved
from eha_monitor.mismatch.advise import advice as advise
from eha_monitor.mismatch.beside_balances import (
    Filtered,
    agrees_closely,
    far_from_config,
    force_is_closed,
    instead_of_filter,
)
from eha_monitor.mismatch.data.experiment import (
    Experiment,
    by_balances,
    by_held_side,
    experiment_of,
)
from eha_monitor.mismatch.diagnosis import (
    INTERMITTENT,
    Considered,
    Diagnosis,
    Gate,
    Location,
    NamedEffect,
    RigFinding,
    Value,
    Window,
    health_sentences,
)
from eha_monitor.mismatch.holds import as_it_reads, searched
from eha_monitor.mismatch.learn.validated import (
    Tested,
    ValidatedTerm,
    supported,
    tested,
    validated_term,
)
from eha_monitor.mismatch.likelihood.along import filtered_tracks
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.mismatch.locate import location as locate
from eha_monitor.mismatch.locate.terms import BALANCES, missing_terms
from eha_monitor.mismatch.name.before import FirstView, at_its_angle, informative
from eha_monitor.mismatch.name.naming import (
    Naming,
    beyond_form,
    follows,
    name_effects,
    near_to,
    on_all_of,
)
from eha_monitor.mismatch.name.select import Elsewhere, Search, begun, lack_of
from eha_monitor.mismatch.policy import SearchPolicy
from eha_monitor.mismatch.show import held_out as show
from eha_monitor.mismatch.show.changed import change_words, changed_between
from eha_monitor.mismatch.show.model import (
    between_models,
    config_effects,
    fitted_of,
    in_doubt,
    quantised,
    replaced,
    rig_findings,
    rig_within,
    robust,
    size_of,
    stated_stddev,
    values_of,
)
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import place_of
from eha_monitor.quantity import number, quantity
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.hypothesis import Hypothesis
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import effect_words, listed

FINER = ("With these effects in the config (diagnose --write-config FILE, then --config FILE) "
         "another diagnosis looks for what is smaller.")
UNNAMED = ("A filter still sees more than the sensors' noise, too little for a balance of forces "
           "or flows and with no name: compare with a healthy recording of this machine (diagnose "
           "--reference) rather than with its config.")
HELD = ("The pressure of one side is held, by an accumulator or check valves, so the balances "
        "answer.  If one pump turns, and not two that match the areas, set "
        "rig.makeup_conductance: 0 (docs/machines.md).")
Report = Callable[[str, float], None]


def diagnose(recordings: list[Recording], settings: Settings, held_out: Recording | None = None,
             progress: Report | None = None, hypothesis: Hypothesis | None = None,
             without: tuple[str, ...] = (), vary: tuple[str, ...] = ()) -> Diagnosis:
    """Say where model and recordings differ, which physics that is, and show the fit improve.

    Parameters
    ----------
    recordings : of one rig, explained together, each in the state in which it ends.
    settings : nominal config; its effects count as known.
    held_out : recording on which the fit is shown; without it the last fifth of every 5 s of
        the recordings is kept aside and enters no fit.
    progress : told what is done and how far it is, 0 to 1.
    hypothesis : the user's own, ranked beside all that has a name.
    without : effects of the catalogue that are not considered.
    vary : what is known to differ between the recordings, such as ``load``.

    Raises
    ------
    InputError
        If the recordings hold nothing that a model predicts, or numbers that break the
        calculation.
    """
    started = time.perf_counter()
    with computing(*(recording.source for recording in recordings)):
        recordings, events = without_events(recordings, settings)
        recordings, points = since_change(recordings, settings)
        found = _diagnosed(recordings, settings, held_out, progress or (lambda text, share: None),
                           hypothesis, without, vary).diagnosis
    return found.around(events).since(points, started)


class Answered(NamedTuple):
    """A diagnosis, and the sets and fits that a filter has found, whoever answers.

    naming : None where no filter was asked, or none follows.
    by_filter : False where the balances answer.
    """

    diagnosis: Diagnosis
    naming: Naming | None
    by_filter: bool


def diagnose_and_name(recordings: list[Recording], settings: Settings,
                      progress: Report | None = None, known: Sequence[Fit] = ()) -> Answered:
    """Diagnose, and return the sets and fits as well: for what to do next.

    The recordings are one experiment: of dry friction a filter is asked as of a single one, and
    begins with the models that are ``known`` from a part of it.  See :func:`diagnose`.
    """
    with computing(*(recording.source for recording in recordings)):
        return _diagnosed(recordings, settings, None, progress or (lambda text, share: None),
                          None, (), (), known)


def _diagnosed(recordings: list[Recording], settings: Settings, held_out: Recording | None,
               say: Report, hypothesis: Hypothesis | None, without: tuple[str, ...],
               vary: tuple[str, ...], known: Sequence[Fit] | None = None) -> Answered:
    if by_balances(recordings, settings):
        say("least squares on the balances", 0.1)
        found = answered(recordings, settings, Asked(held_out, hypothesis, without, vary))
        if by_held_side(recordings, settings):
            found = replace(found, advice=(HELD, *found.advice))
        return Answered(found, None, False)
    started = time.perf_counter()
    say("least squares on the balances", 0.02)
    asked = Asked(held_out, None, without, vary)
    first = first_answer(recordings, settings, asked)
    far = hypothesis is None and far_from_config(first)
    # Several say more together than a filter of one law can.
    if far and first.machine is not None and known is None:
        return Answered(by_first(first, started), None, False)
    # What least squares say stands where no set of laws brings a filter near the recording.
    stands = hypothesis is None and first is not None and (far or not force_is_closed(first))
    held, decision = resolved(recordings, settings)
    end = searched(
        lambda under: as_it_reads(at_its_angle(experiment_of(
            recordings, under, held_out is None, without))),
        held, decision, stands,
        lambda experiment, may_end, elsewhere: begun_in(experiment, say, first, may_end,
                                                        known or (), elsewhere),
        lambda search: name_effects(search, lambda text, share: say(text, 0.85 * share)))
    experiment, decision, named = end.experiment, end.decision, end.named
    if not end.followed:
        if first is None or hypothesis is not None:
            raise np.linalg.LinAlgError("no filter runs on the nominal model")
        return Answered(by_first(first, started), None, False)
    naming = named and named[1]
    found = diagnosed(recordings, experiment, named, held_out, started, say, hypothesis)
    if hypothesis is None and first is not None:
        instead = instead_of_filter(first, Filtered(
            found, experiment.settings, bool(naming and follows(naming)), bool(named and (
                lack_of(named[0], named[1].after) > experiment.policy.lacking))),
            recordings, settings, asked)
        if instead is not None:
            return Answered(by_first(instead, started), naming, False)
    decided = decision is not None and decision.decided
    after = {name: replace(one, stddev=float(np.hypot(one.stddev, end.apart.get(name, 0.0))))
             for name, one in found.after.items()}
    return Answered(replace(
        found, after=after, machine=None if first is None else first.machine,
        policy=experiment.policy.to_dict(), channels=decision.findings if decided else (),
        command_hold=(experiment.settings if decided else settings).command_hold,
        wall_s=time.perf_counter() - started), naming, True)


def by_first(first: Diagnosis, started: float) -> Diagnosis:
    """Return what the balances answer where no filter follows, with what may be done about it."""
    notes = {"consistent": (UNNAMED,), "mismatch": (FINER,)}.get(first.verdict, ())
    return replace(first, advice=(*notes, *first.advice), wall_s=time.perf_counter() - started)


def begun_in(experiment: Experiment, say: Report, first: Diagnosis | None = None,
             may_end: bool = False, known: Sequence[Fit] = (),
             elsewhere: Elsewhere | None = None) -> tuple[Experiment, Search] | None:
    """Begin a search in the most informative windows; None where the piston hardly moves.

    Parameters
    ----------
    first : what the balances answer.
    may_end, known, elsewhere : see :class:`select.Search` and :func:`select.begun`.
    """
    if experiment.ranges.position < TRAVEL * experiment.noise[0]:
        return None
    windows = informative(experiment)
    return windows, begun(windows, lambda text, share: say(text, 0.85 * share),
                          view_of(first), may_end, known, elsewhere,
                          first is not None and agrees_closely(first))


def view_of(first: Diagnosis | None) -> FirstView | None:
    """Return what the balances name, as a place for the filter's fit to begin."""
    if first is None or first.verdict != "mismatch":
        return None
    damping = first.after.get("B")
    effects = {effect.name: first.config_effects[effect.name] for effect in first.effects
               if effect.name in first.config_effects}
    return FirstView(effects, None if damping is None else damping.value)


def diagnosed(recordings: list[Recording], experiment: Experiment,
              named: tuple[Experiment, Naming] | None, held_out: Recording | None,
              started: float, say: Report, hypothesis: Hypothesis | None = None) -> Diagnosis:
    """Return the answer for what was named on the most informative windows."""
    if named is None:
        return insufficient(recordings, started,
                            f"the piston moves by {quantity(experiment.ranges.position, 'm', 2)} "
                            f"only, with {quantity(experiment.noise[0], 'm', 2)} of noise: "
                            "too little motion to identify anything")
    settings, whole, told = experiment.settings, experiment.stretches, named[0]
    naming = on_all_of(experiment, named[1])
    if verdict_of(naming) != "consistent" or naming.unexplained > experiment.policy.rival:
        say("testing whether a parameter changed", 0.86)
        changed = changed_between(naming.experiment, recordings, naming)
        if changed is not None:
            naming = Naming(changed.experiment, changed.whole, changed.fit,
                            consistent=naming.unexplained, unexplained=0.0,
                            pieces=changed.pieces)
    say("showing the fit on unseen data", 0.88)
    shown = naming.experiment if held_out is None else replace(
        experiment_of([held_out], settings, False), steps=naming.experiment.steps)
    found = assemble(recordings, shown, naming, started, held_out is not None, say, hypothesis)
    windows = told.stretches if told.windows or told.stretches is not whole else ()
    return replace(found, named_on=tuple(Window(
        one.source, round(one.start, 4), round(one.start + len(one) * told.dt, 4))
        for one in windows),
        looked_s=sum(map(len, whole)) * told.dt if told.windows else 0.0)


def insufficient(recordings: list[Recording], started: float, why: str) -> Diagnosis:
    """Return the answer for a record that says nothing."""
    nowhere = Location(dict.fromkeys(BALANCES, 0.0), "", ())
    return Diagnosis(tuple(one.source for one in recordings), "insufficient_data", why, nowhere,
                     (), {}, {}, "held_out", {},
                     duration_s=sum(one.duration for one in recordings),
                     wall_s=time.perf_counter() - started)


def verdict_of(naming: Naming) -> str:
    """Return the verdict: what is more likely than not."""
    if naming.unexplained > naming.experiment.policy.likely:
        return "unexplained"
    if naming.after.named or naming.wrong or naming.loads:
        return "mismatch"
    return "consistent"


def assemble(recordings: list[Recording], shown: Experiment, naming: Naming, started: float,
             other_bag: bool, say: Report, hypothesis: Hypothesis | None) -> Diagnosis:
    """Put the answer together."""
    experiment, pieces = naming.experiment, naming.pieces
    baselines = tuple(baseline(recording, experiment.settings) for recording in recordings)
    asked, naming = naming, replace(naming, before=robust(experiment, naming.before),
                                    after=robust(experiment, naming.after))
    verdict, gates, policy = verdict_of(naming), naming.gates, experiment.policy
    before, after = naming.before, naming.after
    signals = show.shown(shown, before, after)
    tracks = filtered_tracks(experiment, after) if after.named else []
    # A fit that fails on unseen data has named nothing.  No model runs with an intermittent load.
    answers = (after.named or naming.wrong) and not naming.loads
    failed = show.unseen_gates(signals, policy) if answers else ()
    if not naming.loads and not pieces:
        failed += show.baseline_gates(shown, baselines, after, signals.get("force"))
    if failed:
        verdict, gates = "unexplained", (*gates, *failed)
        naming = replace(naming, unexplained=1.0 - naming.consistent)
    test = told = None
    if hypothesis is not None and not naming.loads:
        say("testing the hypothesis", 0.9)
        test = tested(experiment, naming, hypothesis)
        told = supported(experiment, shown, naming, test) if test is not None else None
    doubted = verdict == "unexplained" or (
        verdict == "mismatch" and naming.unexplained > policy.rival)
    if told is None and doubted and not naming.loads:
        say("learning effects not in the catalogue", 0.92)
        told = validated_term(experiment, shown, naming)
        if told is not None and not near_to(experiment, naming.before, told.fit):
            gates += (Gate("curve", told.name, (
                f"with {told.term.message.partition(': ')[2] or told.name} the model does not "
                "follow the recording either")),)
            told = None
        if verdict == "mismatch" and told is not None:  # more likely than not it has names
            verdict, told = ("unexplained", told) if told.decides else (verdict, None)
    if told is not None:  # its names are those that stand beside it
        signals, naming = told.signals, beside_own(experiment, naming, told)
        after = naming.after
        verdict = "unexplained" if told.effect is None else verdict_of(naming)
        tracks = filtered_tracks(experiment, after) if after.named else []
    effects = tuple(named_effect(experiment, naming, name, tracks) for name in sorted(
        after.named, key=lambda name: -naming.evidence[name]))
    if naming.loads:
        effects = (*effects, intermittent(naming))
    if told is not None and told.effect is not None:
        effects, verdict = (told.effect, *effects), (
            "mismatch" if verdict == "consistent" else verdict)
    wrong = rig_findings(experiment, naming)
    within = rig_within(experiment, naming)
    if verdict == "mismatch":  # what is less likely than not is no answer
        claims = naming.claims
        effects = tuple(one for one in effects if is_answer(
            one.probability, claims.get(one.name, 0.0), policy))
        wrong = tuple(one for one in wrong if is_answer(
            one.probability, claims.get(f"rig.{one.key}", 0.0), policy))
        if not (effects or wrong):  # many names share what is there, and none may stand for it
            verdict = "consistent" if naming.consistent > policy.rival else "unexplained"
    as_written = tuple(one.name for one in effects if as_configured(experiment, one))
    effects, refitted = tuple(one for one in effects if one.name not in as_written), effects
    if verdict == "mismatch" and not (effects or wrong):
        verdict, naming = "consistent", replace(naming, consistent=1.0 - naming.unexplained)
    open_end = verdict == "unexplained" and told is None
    nearest = after  # what no model explains shows where the best one has taken away all else
    if open_end:  # nothing is an answer: no name, no number but the nominal model's, in doubt
        effects, wrong, within = (), (), ()
        after, signals = before, show.without_answer(signals)
    step = quantised(experiment)
    if step is not None:
        effects = (*effects, step)
        verdict = "mismatch" if verdict == "consistent" else verdict
    evidence = {effect.name: effect.log_evidence for effect in effects} | {
        f"rig.{one.key}": naming.evidence.get(f"rig.{one.key}", 0.0) for one in wrong}
    if verdict == "consistent":
        between = tuple((one.stop_s, other.start_s) for one, other in pairwise(pieces)
                        if one.bag == other.bag)
        where, curves = Location(dict.fromkeys(BALANCES, 0.0), "", between), ()
    elif told is not None:
        evidence.pop(told.name, None)
        evidence |= {f"{locate.LEARNED}{told.missing.balance}": told.gained}
        where = locate.location_of(experiment, before, after, evidence, [told.missing])
        curves = locate.latent_curves(experiment, [told.missing])
    else:
        base = nearest if open_end else before
        terms = missing_terms(experiment, base, after if effects else None)
        named = verdict == "mismatch"  # else it is what has no name that is looked for
        where = locate.location_of(experiment, base, nearest, evidence if named else {},
                                   terms if named else None)
        curves = locate.latent_curves(experiment, terms)
    known = values_of(experiment, before), values_of(experiment, after)
    parts = show.agreement(experiment, before, after)
    if open_end:
        known = in_doubt(known[0], parts), {}
    elif verdict == "unexplained":
        known = known[0], in_doubt(known[1], parts)
    elif told is None:
        known = known[0], between_models(known[1], asked)
    return Diagnosis(
        tuple(one.source for one in recordings), verdict,
        change_words(pieces, policy) if pieces else told.term.message
        if told is not None and told.term is not None else message_of(
            verdict, effects, where, wrong, within, as_written), where, effects, *known,
        "held_out_bag" if other_bag else "held_out", signals, curves,
        show.overlays(shown, before, after), considered_of(naming, test, told),
        parts,
        health_sentences(*known, effects), advise.advice_for(experiment, asked),
        config_effects(experiment, after, tuple(
            effect.name for effect in (() if open_end else refitted)),
                       (told.name, told.entry) if told is not None else None),
        duration_s=sum(one.duration for one in recordings),
        wall_s=time.perf_counter() - started, pieces=pieces,
        # A step that is read off the data is there, whatever the rest.
        probability={"consistent": naming.consistent if step is None else 0.0,
                     "unexplained": naming.unexplained},
        rig_data=wrong, rig_within=within,
        learned=(told.term,) if told is not None and told.term is not None else (),
        fitted=None if open_end else fitted_of(after), gates=gates, baselines=baselines)


def is_answer(probability: float, claim: float, policy: SearchPolicy) -> bool:
    """Tell whether a name of the best set stands: more likely than not, or nothing else may.

    What is there may have many names that share what the recording says; the best of them stands,
    with its own probability, where it can be excluded that none is true.

    Parameters
    ----------
    probability : of the name and those that are listed as its like; NaN where nobody asked.
    claim : that it, or anything in its place, is there.
    """
    return not probability < policy.likely or claim > 1.0 - policy.rival


def as_configured(experiment: Experiment, effect: NamedEffect) -> bool:
    """Tell whether an effect is one of the config's, refitted, and no other than it says.

    Its sizes are within ``sure`` deviations, or the form error of laws (``law``), of the config's;
    how a friction turns at a reversal is shape.
    """
    written, policy = experiment.settings.effects.get(effect.name), experiment.policy
    if not written:
        return False
    pairs = [(effect.parameters[one.name], written.get(one.name, one.neutral))
             for one in CATALOGUE[effect.name].sizes if one.name in effect.parameters]
    return bool(pairs) and all(
        abs(found.value - value) <= max(policy.sure * found.stddev, policy.law * abs(value))
        for found, value in pairs)


def beside_own(experiment: Experiment, naming: Naming, told: ValidatedTerm) -> Naming:
    """Return a naming with the names that stand beside a term that no catalogue has."""
    fit, other = told.fit, float(np.exp(-experiment.policy.temper * max(told.gained, 0.0)))
    # A learned term has no name; beside one of the user's, what the model still lacks has none.
    unexplained = (1.0 - (1.0 - naming.unexplained) * other if told.effect is None else
                   beyond_form(experiment, naming.before, fit, fit.unknowns))
    return replace(  # nothing was asked of how probable they are beside it
        naming, probability={}, consistent=naming.consistent * other, unexplained=unexplained,
        after=replace(fit, named=tuple(n for n in fit.named if n in CATALOGUE)),
        wrong=tuple(n.removeprefix("rig.") for n in fit.named if n.startswith("rig.")))


def named_effect(experiment: Experiment, naming: Naming, name: str, tracks: list[np.ndarray]
                 ) -> NamedEffect:
    """Return the record of a named effect; ``tracks`` as :func:`sizes.size_of` takes them."""
    entry, fit = CATALOGUE[name], naming.after
    parameters, numbers = {}, {}
    fitted = {f.name for f in fit.free}
    for p in entry.parameters:
        key = f"{name}.{p.name}"
        value = float(fit.theta[place_of(key)])
        numbers[p.name] = value
        if key in fitted:
            parameters[p.name] = Value(value, stated_stddev(experiment, fit, key),
                                       p.unit.replace("*", "·"))
        elif np.isfinite(value):
            parameters[p.name] = Value(value, 0.0, p.unit.replace("*", "·"))
    said = entry.said(numbers) + held_command(name, parameters, experiment.dt)
    if gone := [effect_words(one) for one in replaced(experiment, fit) if one in entry.contains]:
        said += f", in place of the config's {listed(gone)}"
    return NamedEffect(name, entry.balance, said, parameters, naming.evidence[name],
                       rivals_of(experiment, naming, name), entry.equation, entry.rig_check,
                       size_of(experiment, fit, name, tracks),
                       naming.probability.get(name, np.nan))


def held_command(name: str, parameters: Mapping[str, Value], dt: float) -> str:
    """Return that a delay of half a sample is a digital controller's, in words; "" of another.

    One that computes its command once in a sample, of both its inputs, and holds it is half a
    sample late on average.
    """
    late = parameters.get("T")
    if name not in ("command_delay", "feedback_delay") or late is None or not (
            abs(late.value - 0.5 * dt) <= POLICY.varied * late.stddev < 0.5 * dt):
        return ""
    return ", half a sample: so does a controller that holds its command over each sample"


def intermittent(naming: Naming) -> NamedEffect:
    """Return a load that comes and goes: somebody pushes, a process load is there at times."""
    largest = ties.best(naming.loads, lambda load: abs(load[2]))[2]
    when = listed([f"{start:.1f}–{stop:.1f} s ({quantity(force, 'N', 2)})"
                   for start, stop, force in naming.loads])
    return NamedEffect(
        INTERMITTENT, "force", f"an intermittent load acts against positive motion at {when}",
        {"F": Value(largest, np.nan, "N")}, naming.evidence[INTERMITTENT], (),
        "F(t), constant over stretches of time", "Check what touches the rod at these times.",
        quantity(abs(largest), "N", 2), naming.probability[INTERMITTENT],
        tuple((start, stop) for start, stop, _ in naming.loads))


def rivals_of(experiment: Experiment, naming: Naming, name: str) -> tuple[str, ...]:
    """Return what this record cannot tell from a named effect.

    Where the pressures are the only measure of the force, an error of theirs is a force.
    """
    found = naming.rivals.get(name, ())
    if experiment.by_pressures:
        found += tuple(other for other in FORCE_OF_SENSORS
                       if name == "constant_load" and other not in found)
    return found


def message_of(verdict: str, effects: tuple[NamedEffect, ...], where: Location,
               wrong: tuple[RigFinding, ...] = (), within: tuple[RigFinding, ...] = (),
               refitted: tuple[str, ...] = ()) -> str:
    """Return the verdict in a sentence; ``refitted`` are effects of the config."""
    if verdict == "consistent":
        parts = []
        if within:
            parts.append(f"{listed([one.key for one in within])} moved within the tolerance")
        if refitted:
            parts.append(f"its {listed([effect_words(name) for name in refitted])} refitted")
        moved = f", with {' and '.join(parts)}," if parts else ""
        return f"the nominal model{moved} explains this recording down to the sensors' noise"
    if verdict == "mismatch":
        return "; ".join([*(finding.statement for finding in wrong),
                          *(effect.statement for effect in effects)])
    balance = ties.best(where.balance, where.balance.get)
    return f"the {balance} balance lacks an effect that is not in the catalogue"


def considered_of(naming: Naming, test: Tested | None, told: ValidatedTerm | None
                  ) -> tuple[Considered, ...]:
    """Return what was tried and why it is not named."""
    found: dict[str, Considered] = {}
    if test is not None and (told is None or told.effect is None):
        why = (f"the best model without it is {number(-test.gained, 3)} log units ahead"
               if test.gained < 0.0 else "it removes too little of the error on unseen data")
        found[test.hypothesis.name] = Considered(test.hypothesis.name, test.gained, (), why)
    best = {*naming.after.named, *(f"rig.{key}" for key in naming.wrong)}
    for names, _, behind in naming.tried:
        for name in sorted(names - best):
            plain = name.removeprefix("rig.")
            if plain in found:
                continue
            beside = tuple(sorted(names - {name}))
            if any(plain in rivals for rivals in naming.rivals.values()):
                why = "indistinguishable in this recording from an identified effect"
            elif best <= names:
                why = "the identified effects fit as well without it"
            else:
                why = f"the best set with it is {number(behind, 3)} log units behind"
            found[plain] = Considered(plain, -behind, beside, why)
    return tuple(found.values())
