"""The diagnosis from end to end: locate, name, model, show, advise."""

import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from eha_monitor.breakdown import computing
from eha_monitor.filters.hold_choice import resolved
from eha_monitor.mismatch import advise, balance_show, locate, show
from eha_monitor.mismatch.calibrate import DRAWS, Calibration, calibrate
from eha_monitor.mismatch.changed import change_words, changed_between
from eha_monitor.mismatch.choice import (
    EXPLAINED,
    NOTHING,
    Naming,
    lacking,
    little_left,
    name_effects,
)
from eha_monitor.mismatch.diagnosis import (
    Considered,
    Diagnosis,
    Location,
    NamedEffect,
    Piece,
    SignalFit,
    Value,
)
from eha_monitor.mismatch.experiment import Experiment, experiment_of
from eha_monitor.mismatch.fit import Fit, with_unknowns
from eha_monitor.mismatch.innovations import CLOSED
from eha_monitor.mismatch.model import (
    config_effects,
    health_sentences,
    in_doubt,
    quantised,
    robust,
    spoken,
    stated_stddev,
    values_of,
)
from eha_monitor.mismatch.search import THRESHOLD, expected_likelihood, nominal
from eha_monitor.mismatch.sizes import filtered_tracks, size_of
from eha_monitor.mismatch.terms import BALANCES, missing_terms
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import place_of
from eha_monitor.quantity import number, quantity
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

LEAST_MOTION = 20.0  # times the position's noise: less motion says nothing
MOSTLY = 0.5  # share of a balance's variance, where no clean record says how little may be left
LARGE_PART = 0.5  # of the evidence: what an effect must take away to be named beside an unknown
# Effect of the force balance -> errors of pressure sensors that make the same force: an offset,
# and a scale by the mean pressure.
FORCE_OF_SENSORS = {"constant_load": ("pressure_offset", "pressure_scale")}
HIGH = 30.0  # log units of a threshold that a user must know of
WORSE = 1.02  # ratio of squared errors on unseen data that is beyond chance

Report = Callable[[str, float], None]


def diagnose(recordings: list[Recording], settings: Settings, held_out: Recording | None = None,
             progress: Report | None = None, calibrate: bool = True) -> Diagnosis:
    """Say where model and recordings differ, which physics that is, and show the fit improve.

    Parameters
    ----------
    recordings : of one rig, explained together.
    settings : nominal config; its effects count as known.
    held_out : recording on which the fit is shown; without it the last fifth of every 5 s of
        the recordings is kept aside and enters no fit.
    progress : told what is done and how far it is, 0 to 1.
    calibrate : set the threshold of evidence by simulated clean recordings of this rig.

    Raises
    ------
    InputError
        If the recordings hold nothing that a model predicts, or numbers that break the
        calculation.
    """
    with computing(*(recording.source for recording in recordings)):
        return _diagnosed(recordings, settings, held_out, progress or (lambda text, share: None),
                          calibrate)


def _diagnosed(recordings: list[Recording], settings: Settings, held_out: Recording | None,
               say: Report, calibrate: bool) -> Diagnosis:
    started = time.perf_counter()
    held, decision = resolved(recordings, settings)
    found = diagnose_held(recordings, held, held_out, say, calibrate)
    told = decision is not None and decision.decided
    return replace(found, channels=decision.findings if told else (),
                   command_hold=(held if told else settings).command_hold,
                   wall_s=time.perf_counter() - started)


def diagnose_held(recordings: list[Recording], settings: Settings, held_out: Recording | None,
                  say: Report, calibrate: bool) -> Diagnosis:
    """Diagnose with the hold that the settings say."""
    started = time.perf_counter()
    experiment = experiment_of(recordings, settings, hold_out=held_out is None)
    bags = tuple(recording.source for recording in recordings)
    duration = sum(recording.duration for recording in recordings)
    if experiment.ranges.position < LEAST_MOTION * experiment.noise[0]:
        return insufficient(bags, duration, started,
                            f"the piston moves by {quantity(experiment.ranges.position, 'm', 2)} "
                            f"only, with {quantity(experiment.noise[0], 'm', 2)} of noise: "
                            "nothing can be told")
    say("fitting the nominal model", 0.02)
    experiment, first = nominal(experiment)
    calibration = calibrated(experiment, first, say, calibrate)
    threshold = calibration.threshold if calibrate and calibration else THRESHOLD
    base = 0.5 if calibrate else 0.05
    naming = name_effects(experiment, threshold,
                          lambda text, share: say(text, base + (0.85 - base) * share), first)
    pieces: tuple[Piece, ...] = ()
    if not experiment.inverse and verdict_of(experiment, naming, calibration)[0] != "consistent":
        say("asking whether a parameter changed", 0.86)
        changed = changed_between(experiment, recordings, naming.after, threshold)
        if changed is not None:
            pieces, experiment = changed.pieces, changed.experiment
            whole = with_unknowns(experiment, first, first.unknowns)
            naming = Naming(whole, changed.fit, naming.rounds, {}, {})
    say("showing the fit on unseen data", 0.88)
    shown = experiment if held_out is None else replace(
        experiment_of([held_out], settings, False), steps=experiment.steps)
    return assemble(experiment, shown, naming, calibration, bags, duration, started,
                    held_out is not None, threshold if calibrate else np.nan, pieces)


def calibrated(experiment: Experiment, first: Fit, say: Report, whole: bool
               ) -> Calibration | None:
    """Return the threshold of evidence and the likelihood of a right model; 5 to 50 % done.

    Not ``whole``: where a measured input brings its own noise into every innovation, two draws
    tell the likelihood; else the sensors' noise does.
    """
    if not whole and (experiment.inverse or experiment.mode == CLOSED):
        return None
    return calibrate(experiment, first, DRAWS if whole else 2,
                     lambda text, share: say(text, 0.05 + 0.45 * share))


def insufficient(bags: tuple[str, ...], duration: float, started: float, why: str) -> Diagnosis:
    """Return the answer for a record that says nothing."""
    nowhere = Location(dict.fromkeys(BALANCES, 0.0), "", ())
    return Diagnosis(bags, "insufficient_data", why, nowhere, (), {}, {}, "held_out", {},
                     duration_s=duration, wall_s=time.perf_counter() - started)


def verdict_of(experiment: Experiment, naming: Naming, calibration: Calibration | None,
               ) -> tuple[str, float]:
    """Return the verdict and the share of the evidence that the named effects take away."""
    before, after = naming.before, naming.after
    if experiment.inverse:
        closed = balance_show.balances_of(experiment, before, after)
        if not after.named:
            return ("unexplained" if closed.open.any() else "consistent"), 0.0
        explained = variance_removed(before, after)
        return ("mismatch" if explained >= MOSTLY or not closed.open.any()
                else "unexplained"), explained
    floor = (calibration.per_sample * len(before.e) if calibration
             else expected_likelihood(experiment, before))
    against = floor - before.log_likelihood
    taken = after.log_likelihood - before.log_likelihood
    explained = float(np.clip(taken / max(against, taken, 1e-9), 0.0, 1.0)) if taken > 0 else 0.0
    left = floor - after.log_likelihood
    if after.named:
        right = explained >= EXPLAINED or (
            explained >= LARGE_PART and little_left(experiment, naming, left))
        return ("mismatch" if right else "unexplained"), explained
    return ("unexplained" if lacking(experiment, after) and left > NOTHING * len(after.e)
            else "consistent"), explained


def variance_removed(before: Fit, after: Fit) -> float:
    """Return the share of the variance left in the balances that the named effects take away.

    Of the balance in which they take away most.
    """
    left = np.diag(after.s) / np.diag(before.s)
    return float(np.clip(1.0 - left.min(), 0.0, 1.0))


def worse(signals: dict[str, SignalFit]) -> bool:
    """Tell whether the error on unseen data, in units of the noise, has grown."""
    pairs = [(fit.before_rms / fit.noise_rms, fit.after_rms / fit.noise_rms)
             for fit in signals.values() if fit.noise_rms > 0]
    return sum(after**2 for _, after in pairs) > WORSE * sum(before**2 for before, _ in pairs)


def assemble(experiment: Experiment, shown: Experiment, naming: Naming,
             calibration: Calibration | None, bags: tuple[str, ...], duration: float,
             started: float, other_bag: bool, threshold: float, pieces: tuple[Piece, ...] = ()
             ) -> Diagnosis:
    """Put the answer together; ``threshold`` NaN where it was not calibrated."""
    naming = replace(naming, before=robust(experiment, naming.before),
                     after=robust(experiment, naming.after))
    verdict, explained = verdict_of(experiment, naming, calibration)
    before, after = naming.before, naming.after
    by_equations = experiment.inverse
    if by_equations:
        closed = balance_show.balances_of(experiment, before, after)
        signals = balance_show.signals_of(shown, before, after, closed.floor)
        tracks = balance_show.tracks_of(experiment)
    else:
        signals = show.shown(shown, before, after)
        tracks = filtered_tracks(experiment, after) if after.named else []
    # A fit that fails on unseen data has named nothing.
    if after.named and worse(signals):
        verdict, explained = "unexplained", min(explained, 1.0 - EXPLAINED)
    effects = tuple(named_effect(experiment, naming, name, tracks) for name in sorted(
        after.named, key=lambda name: -naming.evidence[name]))
    if verdict == "unexplained":  # what takes away a small part only is a confident wrong name
        against = max(after.log_likelihood - before.log_likelihood, 1e-9) / max(explained, 1e-9)
        effects = tuple(e for e in effects if e.log_evidence >= LARGE_PART * against)
    step = quantised(experiment)
    if step is not None:
        effects = (*effects, step)
        verdict = "mismatch" if verdict == "consistent" else verdict
    evidence = {effect.name: effect.log_evidence for effect in effects}
    if verdict == "consistent":
        between = tuple((one.stop_s, other.start_s) for one, other in pairwise(pieces)
                        if one.bag == other.bag)
        where, curves = Location(dict.fromkeys(BALANCES, 0.0), "", between), ()
    elif by_equations:
        terms = balance_show.terms_of(experiment, before, after)
        where = balance_show.location_of(experiment, effects, terms, closed)
        curves = tuple(curve for term in terms for curve in locate.curves_of(experiment, term))
    else:
        terms = missing_terms(experiment, before, after)
        where = locate.location_of(experiment, before, after, evidence,
                                   terms if verdict == "mismatch" else None)
        curves = locate.latent_curves(experiment, before, after, terms)
    how = balance_show if by_equations else show
    known = values_of(experiment, before), values_of(experiment, after)
    parts = how.agreement(experiment, before, after)
    if verdict == "unexplained":
        known = known[0], in_doubt(known[1], parts)
    return Diagnosis(
        bags, verdict, change_words(pieces) if pieces else message_of(
            verdict, effects, where, explained), where, effects, *known,
        "held_out_bag" if other_bag else "held_out", signals, curves,
        how.overlays(shown, before, after), considered_of(naming),
        parts,
        health_sentences(experiment, *known, effects),
        (*(balance_show.doubts(effects) if by_equations
           else advise.advice_for(experiment, naming)), *high_threshold(threshold)),
        config_effects(experiment, after, tuple(effect.name for effect in effects)),
        threshold if np.isfinite(threshold) else THRESHOLD, bool(np.isfinite(threshold)),
        explained, duration, time.perf_counter() - started, pieces)


def high_threshold(threshold: float) -> tuple[str, ...]:
    """Say so where an effect needs far more evidence than usual to be named."""
    if not threshold > HIGH:
        return ()
    return (f"on simulated clean recordings of this rig and motion chance alone comes near "
            f"{threshold:.0f} log units, far more than the usual 10 to 20: small effects stay "
            "unnamed here; check rig and noise levels of the config, or record at a higher rate",)


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
    return NamedEffect(name, entry.balance, entry.said(numbers), parameters,
                       naming.evidence[name], rivals_of(experiment, naming, name), entry.equation,
                       entry.rig_check, size_of(experiment, fit, name, tracks))


def rivals_of(experiment: Experiment, naming: Naming, name: str) -> tuple[str, ...]:
    """Return what this record cannot tell from a named effect.

    Where the pressures are the only measure of the force, an error of theirs is a force.
    """
    found = naming.rivals.get(name, ())
    if experiment.by_pressures:
        found += tuple(other for other in FORCE_OF_SENSORS.get(name, ()) if other not in found)
    return found


def message_of(verdict: str, effects: tuple[NamedEffect, ...], where: Location,
               explained: float) -> str:
    """Return the verdict in a sentence."""
    if verdict == "consistent":
        return "the nominal model explains this recording down to the sensors' noise"
    if verdict == "mismatch":
        return "; ".join(effect.statement for effect in effects)
    balance = max(where.balance, key=where.balance.get)
    named = (f"; of the evidence {', '.join(effect.name for effect in effects)} would take away "
             f"{100 * explained:.0f} % only" if effects else "")
    return (f"something in the {balance} balance is left out that no entry of the catalogue "
            f"explains{named}")


def considered_of(naming: Naming) -> tuple[Considered, ...]:
    """Return what was tried and why it is not named."""
    found: dict[str, Considered] = {}
    for place, step in enumerate(naming.rounds):
        beside = step.before.named
        following = naming.rounds[place + 1].before if place + 1 < len(naming.rounds) else None
        took = following.log_likelihood - step.before.log_likelihood if following else 0.0
        for candidate in step.candidates:
            name = candidate.effect
            if name in naming.after.named:
                continue
            gain = max(candidate.gain, 0.0)
            if any(name in rivals for rivals in naming.rivals.values()):
                why = "this recording cannot tell it from what is named"
            elif following is not None and name in following.named and name not in beside:
                heirs = [other for other in naming.after.named
                         if name in CATALOGUE[other].contains]
                why = (f"taken at first, then gave way to {spoken((heirs or ['the others'])[0])}"
                       if naming.after.named else "taken at first, but it does not explain enough")
            elif following is not None:
                why = (f"gains {number(gain, 3)} log units where what was taken gains "
                       f"{number(took, 3)}")
            else:
                why = f"gains only {number(gain, 3)} log units, or is of no size that matters"
            found[name] = Considered(name, gain, beside, why)
        for score in step.scores:
            name = score.start.effect
            if name not in found and name not in naming.after.named:
                found[name] = Considered(name, score.gain, beside, "hardly moves the innovations "
                                         f"the right way: {number(score.gain, 2)} log units in "
                                         "the score test")
    return tuple(sorted(found.values(), key=lambda c: -c.gain))


