"""From what a search has named to the answer that a person gets.

What is named passes the gates on unseen data; what it leaves may be a term that no catalogue has;
what is more likely than not becomes an effect or a number of the rig, and the rest is said to be
open.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from eha_monitor import ties
from eha_monitor.balances.baseline import Baseline, baseline
from eha_monitor.balances.candidates import FORCE_OF_SENSORS
from eha_monitor.balances.policy import POLICY
from eha_monitor.mismatch.advise import advice as advise
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.diagnosis import (
    INTERMITTENT,
    Considered,
    Curve,
    Diagnosis,
    Gate,
    Location,
    NamedEffect,
    RigFinding,
    SignalFit,
    Value,
    adjusted_of,
    adjusted_words,
    health_sentences,
    intermittent_load,
    payload_sentences,
)
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
from eha_monitor.mismatch.name.naming import Naming, beyond_form, near_to
from eha_monitor.mismatch.policy import SearchPolicy
from eha_monitor.mismatch.show import held_out as show
from eha_monitor.mismatch.show import model
from eha_monitor.mismatch.show.changed import change_words
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import effect_values
from eha_monitor.progress import Report
from eha_monitor.quantity import quantity
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.hypothesis import Hypothesis
from eha_monitor.words import effect_words, listed, odds


def verdict_of(naming: Naming) -> str:
    """Return the verdict: what is more likely than not."""
    if naming.unexplained > naming.experiment.policy.likely:
        return "unexplained"
    if naming.after.named or naming.wrong or naming.loads:
        return "mismatch"
    return "consistent"


@dataclass(frozen=True)
class _Draft:
    """An answer on its way to the record."""

    shown: Experiment  # the experiment of the data on which the fit is shown
    asked: Naming  # what the search named, as it is
    # The same with the deviations of its fits as they are stated, and what gates and a
    # learned term change of it
    naming: Naming
    verdict: str
    gates: tuple[Gate, ...]
    signals: dict[str, SignalFit]  # errors on unseen data before and after
    test: Tested | None = None  # of the user's hypothesis
    told: ValidatedTerm | None = None  # a model with a term that no catalogue has
    effects: tuple[NamedEffect, ...] = ()  # that are an answer
    wrong: tuple[RigFinding, ...] = ()  # numbers of the rig that are
    within: tuple[RigFinding, ...] = ()  # those that moved within their tolerance
    refitted: tuple[str, ...] = ()  # effects of the model
    as_written: tuple[str, ...] = ()  # those of them that are as the config says
    unnoticed: tuple[NamedEffect, ...] = ()  # and those that no one would call a mismatch

    @property
    def experiment(self) -> Experiment:
        """Recordings on which the models were fitted."""
        return self.naming.experiment

    @property
    def is_open(self) -> bool:
        """No name and no term explains what there is."""
        return self.verdict == "unexplained" and self.told is None

    @property
    def before(self) -> Fit:
        """The nominal model."""
        return self.naming.before

    @property
    def after(self) -> Fit:
        """The model of the answer: the nominal one where it is open."""
        return self.naming.before if self.is_open else self.naming.after


def assemble(recordings: list[Recording], shown: Experiment, naming: Naming, started: float,
             other_bag: bool, say: Report, hypothesis: Hypothesis | None) -> Diagnosis:
    """Put the answer together.

    Parameters
    ----------
    recordings : as they were given; ``shown`` those on which the fit is shown.
    started : when the diagnosis began, s of :func:`time.perf_counter`.
    other_bag : the fit is shown on another recording.
    """
    baselines = tuple(baseline(one, naming.experiment.settings) for one in recordings)
    draft = _gated(shown, naming, baselines)
    if not naming.loads:  # no model runs with a load that comes and goes
        draft = _with_learned(_with_hypothesis(draft, hypothesis, say), say)
    draft = _answers(draft)
    if draft.is_open:  # no name is an answer, no number but the nominal model's, in doubt
        draft = replace(draft, effects=(), wrong=(), within=(), refitted=(),
                        signals=show.without_answer(draft.signals))
    step = model.quantised(draft.experiment)
    if step is not None:
        draft = replace(draft, effects=(*draft.effects, step), verdict=(
            "mismatch" if draft.verdict == "consistent" else draft.verdict))
    return _record(recordings, draft, baselines, started, other_bag, step is not None)


def _gated(shown: Experiment, naming: Naming, baselines: Sequence[Baseline]) -> _Draft:
    """Return what is named behind the gates on unseen data: what fails there names nothing."""
    experiment, asked = naming.experiment, naming
    naming = replace(naming, before=model.robust(experiment, naming.before),
                     after=model.robust(experiment, naming.after))
    after = naming.after
    signals = show.shown(shown, naming.before, after)
    # No model runs with an intermittent load.
    answers = (after.named or naming.wrong) and not naming.loads
    failed = show.unseen_gates(signals, experiment.policy) if answers else ()
    if not naming.loads and not naming.pieces:
        failed += show.baseline_gates(shown, baselines, after, signals.get("force"))
    draft = _Draft(shown, asked, naming, verdict_of(naming), naming.gates, signals)
    if not failed:
        return draft
    return replace(draft, verdict="unexplained", gates=(*draft.gates, *failed),
                   naming=replace(naming, unexplained=1.0 - naming.consistent))


def _with_hypothesis(draft: _Draft, hypothesis: Hypothesis | None, say: Report) -> _Draft:
    """Return the draft with the user's own law, where unseen data support it."""
    if hypothesis is None:
        return draft
    say("testing the hypothesis", 0.9)
    test = tested(draft.experiment, draft.naming, hypothesis)
    if test is None:
        return draft
    told = supported(draft.experiment, draft.shown, draft.naming, test)
    return _beside(replace(draft, test=test), told)


def _with_learned(draft: _Draft, say: Report) -> _Draft:
    """Return the draft with a term that is learned from what the names leave, where one holds."""
    doubted = draft.verdict == "unexplained" or (
        draft.verdict == "mismatch"
        and draft.naming.unexplained > draft.experiment.policy.rival)
    if draft.told is not None or not doubted:
        return draft
    say("learning effects not in the catalogue", 0.92)
    told = validated_term(draft.experiment, draft.shown, draft.naming)
    if told is not None and not near_to(draft.experiment, draft.before, told.fit):
        draft, told = replace(draft, gates=(*draft.gates, Gate("curve", told.name, (
            f"with {told.term.message.partition(': ')[2] or told.name} the model does not "
            "follow the recording either")))), None
    if draft.verdict == "mismatch" and told is not None and not told.decides:
        told = None  # more likely than not it has names
    return _beside(draft, told)


def _beside(draft: _Draft, told: ValidatedTerm | None) -> _Draft:
    """Return the draft with a term of its own; its names are those that stand beside the term."""
    if told is None:
        return draft
    naming = beside_own(draft.experiment, draft.naming, told)
    return replace(draft, told=told, signals=told.signals, naming=naming, verdict=(
        "unexplained" if told.effect is None else verdict_of(naming)))


def _answers(draft: _Draft) -> _Draft:
    """Return the draft with what is more likely than not, and the verdict that goes with it."""
    experiment, naming, verdict, told = draft.experiment, draft.naming, draft.verdict, draft.told
    after, policy = naming.after, experiment.policy
    tracks = filtered_tracks(experiment, after) if after.named else []
    effects = tuple(named_effect(experiment, naming, name, tracks) for name in sorted(
        after.named, key=lambda name: -naming.evidence[name]))
    if naming.loads:
        effects = (*effects, intermittent(naming))
    if told is not None and told.effect is not None:
        effects, verdict = (told.effect, *effects), (
            "mismatch" if verdict == "consistent" else verdict)
    wrong = model.rig_findings(experiment, naming)
    if verdict == "mismatch":  # what is less likely than not is no answer
        claims = naming.claims
        effects = tuple(one for one in effects if is_answer(
            one.probability, claims.get(one.name, 0.0), policy))
        wrong = tuple(one for one in wrong if is_answer(
            one.probability, claims.get(f"rig.{one.key}", 0.0), policy))
        if not (effects or wrong):  # many names share what is there, and none may stand for it
            verdict = "consistent" if naming.consistent > policy.rival else "unexplained"
    refitted = tuple(one.name for one in effects)
    as_written = tuple(one.name for one in effects if as_configured(experiment, one))
    unnoticed = tuple(one for one in effects if hardly_drifts(draft, one))
    effects = tuple(one for one in effects if one.name not in as_written and one not in unnoticed)
    if verdict == "mismatch" and not (effects or wrong):
        verdict, naming = "consistent", replace(naming, consistent=1.0 - naming.unexplained)
    return replace(draft, naming=naming, verdict=verdict, effects=effects, wrong=wrong,
                   within=model.rig_within(experiment, naming), refitted=refitted,
                   as_written=as_written, unnoticed=unnoticed)


def hardly_drifts(draft: _Draft, effect: NamedEffect) -> bool:
    """Tell whether an effect is a drift of pressure sensors that is no fault of theirs.

    Over the whole recording it is less than ``worse`` of what the pressures do: all sensors warm.
    """
    if effect.name != "pressure_drift":
        return False
    lasts = max(one.start + len(one) * draft.shown.dt for one in draft.shown.stretches)
    drifts = [(effect.parameters[f"d_{chamber}"], draft.signals.get(f"pressure_{chamber}"))
              for chamber in (1, 2)]
    return all(fit is None or abs(one.value) * lasts < draft.experiment.policy.worse
               * fit.signal_rms for one, fit in drifts)


def _located(draft: _Draft, evidence: Mapping[str, float]) -> tuple[Location, tuple[Curve, ...]]:
    """Return where the recordings and the nominal model differ, and the curve of what lacks."""
    experiment, naming, told = draft.experiment, draft.naming, draft.told
    if draft.verdict == "consistent":
        between = tuple((one.stop_s, other.start_s) for one, other in pairwise(naming.pieces)
                        if one.bag == other.bag)
        return Location(dict.fromkeys(BALANCES, 0.0), "", between), ()
    if told is not None:
        evidence = {name: gained for name, gained in evidence.items() if name != told.name}
        evidence[f"{locate.LEARNED}{told.missing.balance}"] = told.gained
        return (locate.location_of(experiment, draft.before, draft.after, evidence,
                                   [told.missing]),
                locate.latent_curves(experiment, [told.missing]))
    # What no model explains shows where the best one has taken away all else.
    base = naming.after if draft.is_open else draft.before
    terms = missing_terms(experiment, base, draft.after if draft.effects else None)
    named = draft.verdict == "mismatch"  # else it is what has no name that is looked for
    return (locate.location_of(experiment, base, naming.after, evidence if named else {},
                               terms if named else None),
            locate.latent_curves(experiment, terms))


def _record(recordings: Sequence[Recording], draft: _Draft, baselines: tuple[Baseline, ...],
            started: float, other_bag: bool, stepped: bool) -> Diagnosis:
    """Return the record of an answer; ``stepped`` where a sensor's step is read off the data."""
    experiment, naming, told = draft.experiment, draft.naming, draft.told
    before, after, pieces = draft.before, draft.after, naming.pieces
    evidence = {effect.name: effect.log_evidence for effect in draft.effects} | {
        f"rig.{one.key}": naming.evidence.get(f"rig.{one.key}", 0.0) for one in draft.wrong}
    where, curves = _located(draft, evidence)
    parts = show.agreement(experiment, before, after)
    known = model.values_of(experiment, before), model.values_of(experiment, after)
    if draft.is_open:
        known = model.in_doubt(known[0], parts), {}
    elif draft.verdict == "unexplained":
        known = known[0], model.in_doubt(known[1], parts)
    elif told is None:
        known = known[0], model.between_models(known[1], draft.asked)
    if pieces:
        message = change_words(pieces, experiment.policy)
    elif told is not None and told.term is not None:
        message = told.term.message
    else:
        message = message_of(draft, where)
    return Diagnosis(
        tuple(one.source for one in recordings), draft.verdict, message, where, draft.effects,
        *known, "held_out_bag" if other_bag else "held_out", draft.signals, curves,
        show.overlays(draft.shown, before, after), considered_of(naming, draft.test, told),
        parts, health_sentences(*known, draft.effects) + payload_sentences(
            draft.effects, draft.wrong, experiment.settings),
        advise.advice_for(experiment, draft.asked),
        model.config_effects(experiment, after, draft.refitted,
                       (told.name, told.entry) if told is not None else None),
        duration_s=sum(one.duration for one in recordings),
        wall_s=time.perf_counter() - started, pieces=pieces,
        # A step that is read off the data is there, whatever the rest.
        probability={"consistent": 0.0 if stepped else naming.consistent,
                     "unexplained": naming.unexplained},
        rig_data=draft.wrong, rig_within=draft.within,
        learned=(told.term,) if told is not None and told.term is not None else (),
        fitted=None if draft.is_open else model.fitted_of(after), gates=draft.gates,
        baselines=baselines)


def is_answer(probability: float, claim: float, policy: SearchPolicy) -> bool:
    """Tell whether a name of the best set stands: more likely than not, or nothing else may.

    What is there may have many names that share what the recording says; the best of them stands,
    with its own probability, where it can be excluded that none is true.

    ``probability`` : of the name and those that are listed as its like; NaN where nobody asked.
    ``claim`` : that it, or anything in its place, is there.
    """
    return not probability < policy.likely or claim > 1.0 - policy.rival


def as_configured(experiment: Experiment, effect: NamedEffect) -> bool:
    """Tell whether an effect is one of the config's, refitted, and no other than it says.

    Its sizes are the config's within ``sure`` deviations and tolerances (``rig.tolerance``); how a
    friction turns at a reversal is shape.
    """
    written, policy = experiment.settings.effects.get(effect.name), experiment.policy
    if not written:
        return False
    pairs = [(effect.parameters[one.name], written.get(one.name, one.neutral))
             for one in CATALOGUE[effect.name].sizes if one.name in effect.parameters]
    width = experiment.settings.rig.tolerance.effects
    return bool(pairs) and all(
        abs(found.value - value) <= policy.sure * float(np.hypot(found.stddev, width * value))
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
    """Return the record of a named effect; ``tracks`` as :func:`model.size_of` takes them."""
    entry, fit, parameters = CATALOGUE[name], naming.after, {}
    numbers, fitted = effect_values(fit.theta, name), {f.name for f in fit.free}
    for p in entry.parameters:
        key, value = f"{name}.{p.name}", numbers[p.name]
        if key in fitted or np.isfinite(value):
            stddev = model.stated_stddev(experiment, fit, key) if key in fitted else 0.0
            parameters[p.name] = Value(value, stddev, p.unit.replace("*", "·"))
    said = entry.said(numbers) + held_command(name, parameters, experiment.dt)
    sizes = [parameters[p.name] for p in entry.sizes if p.name in parameters]
    if len(sizes) > 1 and all(abs(one.value) < experiment.policy.sure * one.stddev
                              for one in sizes):
        said += ", of which only a combination is known: each alone is ± " + listed(list(
            dict.fromkeys(quantity(one.stddev, one.unit, 2) for one in sizes)), "or")
    if gone := [effect_words(one) for one in model.replaced(experiment, fit)
                if one in entry.contains]:
        said += f", in place of the config's {listed(gone)}"
    if own := experiment.settings.effects.get(name):
        said += "; the config has " + listed([quantity(own[p.name], p.unit, 3)
                                              for p in entry.sizes if p.name in own])
    return NamedEffect(name, entry.balance, said, parameters, naming.evidence[name],
                       rivals_of(experiment, naming, name), entry.equation, entry.rig_check,
                       model.size_of(experiment, fit, name, tracks),
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
    return intermittent_load(
        f"an intermittent load acts against positive motion at {when}", largest,
        naming.evidence[INTERMITTENT], naming.probability[INTERMITTENT],
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


def message_of(draft: _Draft, where: Location) -> str:
    """Return the verdict in a sentence."""
    if draft.verdict == "consistent":
        near, asked = adjusted_words(adjusted_of(draft.within, draft.experiment.settings.rig))
        parts = [near] if near else []
        if draft.as_written:
            own = listed([effect_words(name) for name in draft.as_written])
            parts.append(f"its {own} refitted")
        if draft.unnoticed:
            parts.append(listed([f"a {effect_words(one.name)} of {one.size}"
                                 for one in draft.unnoticed]))
        moved = f", with {' and '.join(parts)}," if parts else ""
        return f"the nominal model{moved} explains this recording down to the sensors' noise" + (
            f" only if {asked}" if asked else "")
    if draft.verdict == "mismatch":
        return "; ".join(one.statement for one in (*draft.wrong, *draft.effects))
    balance = ties.best(where.balance, where.balance.get)
    return f"the {balance} balance lacks an effect that is not in the catalogue"


def considered_of(naming: Naming, test: Tested | None, told: ValidatedTerm | None
                  ) -> tuple[Considered, ...]:
    """Return what was tried and why it is not named."""
    found: dict[str, Considered] = {}
    if test is not None and (told is None or told.effect is None):
        why = (f"the best model without it is ahead by {odds(-test.gained)}"
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
                why = f"the best set with it is behind by {odds(behind)}"
            found[plain] = Considered(plain, -behind, beside, why)
    return tuple(found.values())
