"""Advice: what a recording can and cannot tell apart, and the cheapest motion that would."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from eha_monitor.balances.answer import Asked, answered, first_answer
from eha_monitor.balances.candidates import Scale, balances_in, candidates_of
from eha_monitor.balances.contact import contacts_of
from eha_monitor.balances.least_squares import inverse_of
from eha_monitor.balances.measured import course_of
from eha_monitor.balances.policy import POLICY
from eha_monitor.balances.table import pooled_table, tables_of
from eha_monitor.breakdown import computing
from eha_monitor.errors import InputError
from eha_monitor.estimation.hold_choice import resolved
from eha_monitor.estimation.results import units_of
from eha_monitor.mismatch.advise.identifiability import (
    HOPELESS,
    Confusion,
    Known,
    Reading,
    directions_for,
    effects_for,
    named_directions,
)
from eha_monitor.mismatch.advise.motions import Limits, Motion, limits_for, looped
from eha_monitor.mismatch.advise.separate import (
    DECISIVE,
    WANTED,
    Advice,
    Check,
    Doubt,
    Question,
    Tried,
    cheapest,
    checked,
    entered_at,
    instead,
    try_motions,
)
from eha_monitor.mismatch.advise.words import sentences
from eha_monitor.mismatch.beside_balances import far_from_config
from eha_monitor.mismatch.data.experiment import Experiment, by_balances, experiment_of
from eha_monitor.mismatch.data.inputs import FORCED
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.mismatch.likelihood.fit import Fit, with_unknowns
from eha_monitor.mismatch.likelihood.gains import Unknowns
from eha_monitor.mismatch.likelihood.information import Slope, Traces, free_slopes
from eha_monitor.mismatch.name.naming import Naming, follows, name_effects
from eha_monitor.mismatch.name.nominal import nominal
from eha_monitor.mismatch.name.refit import settled
from eha_monitor.mismatch.name.select import Manner, Unfollowed, begun
from eha_monitor.mismatch.name.starts import limits_of, with_effect
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of
from eha_monitor.progress import Report, silent
from eha_monitor.quantity import quantity
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings


def advised_by_balances(found: Diagnosis, recordings: Sequence[Recording], settings: Settings
                        ) -> tuple[tuple[str, ...], Advice]:
    """Return the effects that the balances have ``found``, and what they leave open."""
    names = tuple(one.name for one in found.effects if one.name in CATALOGUE)
    return names, Advice(_known(found, recordings, settings), np.nan, (), (), (), (), None, (), (),
                         False, units_of(settings.rig.motion)["B"], found.advice)


def _known(found: Diagnosis, recordings: Sequence[Recording], settings: Settings
           ) -> tuple[Known, ...]:
    """Return B, beta_e and the effects' parameters, each with what it is confused with most."""
    courses = [course_of(one, settings) for one in recordings]
    scale, known = Scale.of(courses, contacts_of(courses, POLICY)), []
    for balance in balances_in(courses, settings.rig):
        table = pooled_table(tables_of(courses, settings.rig, balance, candidates_of(
            balance, scale, settings.rig), POLICY))
        named = {e.name for e in found.effects if e.balance == balance}
        first = {one.effect: one for one in reversed(table.candidates)}
        terms = [one for one in table.candidates if one.always or one.name == "C_h" or (
            one.effect in named and one is first[one.effect])]
        places = [table.places[one.name] for one in terms]
        gram = table.gram[np.ix_(places, places)]
        inverse = inverse_of(gram)
        sigma = np.sqrt(np.diag(inverse))
        for i, one in enumerate(terms):
            values = {"B": ("B", found.after.get("B", found.before.get("B"))), "C_h": (
                "beta_e", found.after.get("beta_e", found.before.get("beta_e")))}
            name, value = values.get(one.name, (f"{one.effect}.{one.symbol}", next((
                e.parameters.get(one.symbol) for e in found.effects if e.name == one.effect),
                None)))
            if value is None or not len(terms) > 1:
                continue
            others = np.delete(np.arange(len(terms)), i)
            correlation = np.nan_to_num(inverse[i, others] / (sigma[i] * sigma[others]))
            most = int(np.argmax(np.abs(correlation)))
            other = terms[others[most]]
            known.append(Known(
                name, value.value, value.stddev, value.unit, float(inverse[i, i] * gram[i, i]),
                float(correlation[most]), {"B": "B", "C_h": "beta_e"}.get(
                    other.name, f"{other.effect}.{other.symbol or other.name}")))
    return tuple(known)


COMMON = ("coulomb_friction", "quadratic_friction", "spring_load", "added_mass",
          "cross_port_leakage")  # what B and beta_e are most often mistaken for
YIELDING = 300.0  # times the smallest unknowns, with which a filter follows a wrong model
LEAST_MOTION = 20.0  # times the position's noise: less motion says nothing
ATTEMPTS = 3  # motions that are put to a simulation
MOST_QUESTIONS = 4


def yielding(experiment: Experiment, fit: Fit) -> Fit:
    """Return a fit whose filter follows a wrong model.

    Where the noise of a measured force governs, a motion is still judged by what a prediction of
    it shows.
    """
    unknowns = Unknowns(*(YIELDING * limits_of(experiment)[0].as_array()))
    return settled(experiment, with_unknowns(experiment, fit, unknowns))


def with_motion(found: Advice, recordings: list[Recording], settings: Settings, check: bool,
                report: Report | None) -> Advice:
    """Return advice by balances with the motion that a filter plans.

    Unchanged behind a valve circuit, where no model predicts a motion.

    ``settings`` : with the effects that the balances name.
    """
    experiment = experiment_of(recordings, settings, hold_out=False)
    if experiment.mode != FORCED and by_balances(recordings, settings):
        return found
    experiment, first = nominal(experiment)
    planned = advice(experiment, yielding(experiment, first), {}, check=check, report=report)
    return replace(found, doubts=planned.doubts, motion=planned.motion, tried=planned.tried,
                   checks=planned.checks, plannable=planned.plannable)


def advice(experiment: Experiment, fit: Fit, doubts: dict[str, tuple[str, ...]],
           rivals: dict[str, Fit] | None = None, check: bool = True, thorough: bool = True,
           report: Report | None = None) -> Advice:
    """Say what a recording separates, and which motion would separate the rest.

    Parameters
    ----------
    experiment : the recordings; ``fit`` their model, with what was named.
    doubts : named effect -> effects and numbers of the rig that may be there instead; of them a
        motion is looked for that separates the effects.
    rivals : effect -> a fit that has it instead; without it the rival enters at its start.
    check : put the proposed motion to a simulation with noise.
    thorough : look at the whole catalogue and at all motions; otherwise at the usual ones.
    report : called with what is done and how far it is, 0 to 1.
    """
    say = report or silent
    say("computing what this recording identifies", 0.0)
    limits = limits_for(experiment)
    if limits is not None:
        fit = looped(fit, limits)
    units = units_of(experiment.settings.rig.motion) | {
        f"{name}.{p.name}": p.unit for name in NAMES for p in CATALOGUE[name].parameters}
    base = [s for s in free_slopes(fit) if thorough or not small_timing(s.label, fit)]
    directions, slopes = directions_for(experiment, fit, effects_for(
        experiment, fit, NAMES if thorough else COMMON))
    found, found_slopes = named_directions(experiment, fit)
    traces = Traces(experiment, fit, [*base, *slopes, *found_slopes])
    pairs = [pair(experiment, fit, effect, rival,
                  (rivals or {}).get(rival) or entered_at(experiment, traces, effect, rival, base))
             for effect, others in doubts.items() if effect in fit.named
             for rival in others if rival in CATALOGUE]  # a number of the rig is looked up
    here = traces.gram([s.label for s in [*base, *slopes, *found_slopes]])
    reading = Reading(fit, here, base, directions, found)
    named = [c for d in found for parameter in reading.health
             if (c := reading.confusion(d, parameter, d.amount, True)) is not None]
    confusions = (*named, *reading.confusions())
    questions = [*pairs, *(hidden(fit, c, reading) for c in open_ones(confusions))]
    say("looking for a motion", 0.2)
    doubts, now = open_questions(traces, questions, base)
    motion, tried, checks = None, [], []
    if doubts and limits is not None:
        here = traces.gram([s.label for s in [*base, *(s for q in doubts for s in q.slopes())]])
        tried = try_motions(experiment, fit, doubts, here, limits, base, thorough)
        motion = cheapest(tried)
        if check:
            motion, checks = proven(experiment, fit, doubts, tried, limits, say)
    then = next((one.gains for one in tried if one.motion is motion), (np.nan,) * len(doubts))
    return Advice(
        reading.known(units), reading.plateaus, confusions, reading.detection_limits(),
        reading.groups(),
        tuple(Doubt(q.effect, q.rival, q.parameter, q.steady, q.amount, q.symbol, q.unit, a, b)
              for q, a, b in zip(doubts, now, then, strict=True)), motion,
        tuple(tried), tuple(checks), limits is not None, units["B"])


def open_ones(confusions: Sequence[Confusion]) -> list[Confusion]:
    """Return the confusions worth a motion: the commonest effects, one for each parameter."""
    chosen: dict[str, Confusion] = {}
    for c in confusions:
        if c.named or CATALOGUE[c.effect].rarity <= 1:
            chosen.setdefault(c.parameter, c)
    return list(chosen.values())


def hidden(fit: Fit, c: Confusion, reading: Reading) -> Question:
    """Return the question whether an amount that matters is an effect, or B or beta_e."""
    steady = abs(c.plateau_correlation) > HOPELESS
    d = next(d for d in (*reading.directions, *reading.found)
             if d.effect == c.effect and d.parameter == c.symbol)
    size = reading.matters(d, steady)
    if c.named:  # a little less of what was found, and B or beta_e makes up for it
        key = f"{c.effect}.{c.symbol}"
        size = min(size, 0.5 * abs(d.amount))
        theta = fit.theta.copy()
        theta[place_of(key)] -= size * np.sign(d.amount)
        less = replace(fit, theta=theta, free=tuple(f for f in fit.free if f.name != key))
        return Question(c.effect, "", c.parameter, steady, size, c.symbol, c.unit, fit, less)
    share = size / abs(d.amount)
    truth = with_effect(fit, d.start, tuple(share if p.name == c.symbol else 0.0
                                            for p in CATALOGUE[c.effect].sizes))
    return Question(c.effect, "", c.parameter, steady, size, c.symbol, c.unit, truth, fit, "other")


def pair(experiment: Experiment, fit: Fit, effect: str, rival: str, other: Fit) -> Question:
    """Return the question which of two effects is there."""
    p = CATALOGUE[effect].sizes[0]
    return Question(effect, rival, "", False, float(fit.theta[place_of(f"{effect}.{p.name}")]),
                    p.name, p.unit, fit, instead(experiment, fit, effect, other, rival))


def open_questions(traces: Traces, questions: Sequence[Question], base: Sequence[Slope]
                   ) -> tuple[list[Question], list[float]]:
    """Return the questions that the recording leaves open, and the log units it has on each."""
    found = []
    for question in questions:
        traces.add(question.slopes())
        now = question.gain(traces.gram([s.label for s in [*base, *question.slopes()]]), base)
        if now < DECISIVE:
            found.append((question, now))
    found = found[:MOST_QUESTIONS]
    return [question for question, _ in found], [now for _, now in found]


def proven(experiment: Experiment, fit: Fit, doubts: Sequence[Question], tried: Sequence[Tried],
           limits: Limits, say: Report) -> tuple[Motion | None, list[Check]]:
    """Return the cheapest motion that also decides in simulation, with its checks.

    None where none does; the checks then show it.  The prediction is linear, and where friction
    sticks or a limit is reached it can be far off: after a failure the next one must reach more.
    """
    rejected: list[str] = []
    best, most, failed = None, 0, []
    for attempt in range(ATTEMPTS):
        motion = cheapest(tried, rejected, WANTED * 4.0**attempt)
        if motion is None:
            break
        gains = next(one.gains for one in tried if one.motion is motion)
        checks = []
        for i, question in enumerate(doubts):
            say(f"checking in simulation: {motion.words}",
                0.4 + 0.6 * (attempt + i / len(doubts)) / ATTEMPTS)
            if gains[i] >= DECISIVE:
                checks.append(checked(experiment, fit, question, motion, limits))
        held = sum(one.found >= DECISIVE for one in checks)
        if held == len(checks):
            return motion, checks
        if held > most:
            best, most, failed = motion, held, checks
        failed = failed or checks
        rejected.append(motion.name)
    return best, failed


def small_timing(name: str, fit: Fit) -> bool:
    """Tell whether a parameter is one of the small timing errors that every record has."""
    effect, dot, _ = name.partition(".")
    return bool(dot) and effect not in fit.named


def advise(recordings: list[Recording], settings: Settings, check: bool = True,
           report: Report | None = None) -> tuple[tuple[str, ...], Advice]:
    """Name what recordings of one rig support, and say what they leave open.

    Parameters
    ----------
    settings : nominal config; its effects count as known.
    check : put the proposed motion to a simulation with noise.
    report : called with what is done and how far it is, 0 to 1.

    Raises
    ------
    InputError
        If the recordings hold nothing that a model predicts, hardly any motion, or numbers that
        break the calculation.
    """
    with computing(*(recording.source for recording in recordings)):
        if by_balances(recordings, settings):
            names, found = advised_by_balances(answered(recordings, settings, Asked()),
                                               recordings, settings)
            return names, with_motion(found, recordings, settings, check, report)
        return _advised(recordings, settings, check, report or silent)


def _advised(recordings: list[Recording], settings: Settings, check: bool, say: Report
             ) -> tuple[tuple[str, ...], Advice]:
    settings, _ = resolved(recordings, settings)
    experiment = experiment_of(recordings, settings, hold_out=False)
    moved = experiment.ranges.position
    if moved < LEAST_MOTION * experiment.noise[0]:
        raise InputError(f"{recordings[0].source}: expected a piston that moves, found "
                         f"{quantity(moved, 'm', 2)} with "
                         f"{quantity(experiment.noise[0], 'm', 2)} of noise: any motion is more "
                         "informative")
    def said(text, share):
        say(text, 0.6 * share)

    first = first_answer(recordings, settings, Asked())
    far = far_from_config(first)  # as in a diagnosis: no filter may be able to follow
    try:
        naming = name_effects(begun(experiment, said, Manner(may_end=far)), said)
    except Unfollowed:
        naming = None
    if naming is None or (far and not follows(naming)):
        names, by_first = advised_by_balances(first, recordings, settings)
        return names, with_motion(by_first, recordings, settings.model_copy(
            update={"effects": first.config_effects}), check, said)
    found = advice(experiment, naming.after, naming.rivals, rival_fits(naming), check,
                   report=lambda text, share: say(text, 0.6 + 0.4 * share))
    return naming.after.named, found


def rival_fits(naming: Naming) -> dict[str, Fit]:
    """Return the fits of the candidates that were tried, effect -> fit."""
    found = {}
    for names, fit, _ in naming.tried:  # best first
        for name in names:
            if name in CATALOGUE:
                found.setdefault(name, replace(fit, named=tuple(
                    other for other in fit.named if other in CATALOGUE)))
    return found


def advice_for(experiment: Experiment, naming: Naming) -> tuple[str, ...]:
    """Return the advice of a diagnosis in sentences, quickly: its doubts and the usual ones."""
    return sentences(advice(experiment, naming.after, naming.rivals, rival_fits(naming), False,
                            thorough=False))
