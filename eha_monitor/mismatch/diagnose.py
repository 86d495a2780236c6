"""The diagnosis from end to end: locate, name, model, show, advise."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from eha_monitor.balances.answer import Asked, answered, first_answer
from eha_monitor.balances.change_point import since_change
from eha_monitor.balances.course import TRAVEL
from eha_monitor.balances.event import without_events
from eha_monitor.breakdown import computing
from eha_monitor.estimation.hold_choice import resolved
from eha_monitor.mismatch.answer import assemble, verdict_of
from eha_monitor.mismatch.beside_balances import (
    Filtered,
    agrees_closely,
    differ_in_damping,
    far_from_config,
    force_is_closed,
    instead_of_filter,
)
from eha_monitor.mismatch.data.experiment import Experiment, by_balances, experiment_of, mode_of
from eha_monitor.mismatch.data.inputs import FORCED
from eha_monitor.mismatch.diagnosis import Diagnosis, Location, Window
from eha_monitor.mismatch.holds import Searched, as_it_reads, searched
from eha_monitor.mismatch.likelihood.fit import Fit, with_unknowns
from eha_monitor.mismatch.locate.terms import BALANCES
from eha_monitor.mismatch.name.before import FirstView, at_its_angle, informative
from eha_monitor.mismatch.name.naming import Naming, follows, name_effects, on_all_of, within_form
from eha_monitor.mismatch.name.nominal import lack_of
from eha_monitor.mismatch.name.select import GAINED, PLAINLY, Manner, Search, begun
from eha_monitor.mismatch.show.changed import changed_between
from eha_monitor.physics.effects import DRY_LAWS
from eha_monitor.progress import Report, silent
from eha_monitor.quantity import quantity
from eha_monitor.recordings.position import trusted
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.hypothesis import Hypothesis
from eha_monitor.settings.monitor import Settings

FINER = ("With these effects in the config (diagnose --write-config FILE, then --config FILE) "
         "another diagnosis looks for what is smaller.")
UNNAMED = ("A filter still sees more than the sensors' noise, too little for a balance of forces "
           "or flows and with no name: compare with a healthy recording of this machine (diagnose "
           "--reference) rather than with its config.")
HELD = ("The pressure of one side is held, by an accumulator or check valves, so the balances "
        "answer.  If one pump turns, and not two that match the areas, set "
        "rig.makeup_conductance: 0 (docs/machines.md).")


def diagnose(recordings: list[Recording], settings: Settings, held_out: Recording | None = None,
             progress: Report | None = None, hypothesis: Hypothesis | None = None,
             without: tuple[str, ...] = (), vary: tuple[str, ...] = ()) -> Diagnosis:
    """Say where model and recordings differ, which physics that is, and show the fit improve.

    Parameters
    ----------
    recordings : of one rig, explained together, each in the state in which it ends.
    settings : nominal config; its effects are known to ``law``.
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
        recordings, events = without_events([*map(trusted, recordings)], settings)
        recordings, points = since_change(recordings, settings)
        found = _diagnosed(recordings, settings, held_out, progress or silent,
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
        return _diagnosed([*map(trusted, recordings)], settings, None, progress or silent, None,
                          (), (), known)


def _diagnosed(recordings: list[Recording], settings: Settings, held_out: Recording | None,
               say: Report, hypothesis: Hypothesis | None, without: tuple[str, ...],
               vary: tuple[str, ...], known: Sequence[Fit] | None = None) -> Answered:
    if by_balances(recordings, settings):
        say("least squares on the balances", 0.1)
        found = answered(recordings, settings, Asked(
            held_out, hypothesis, without, vary, known is not None))
        # Where a pump drives a config with a make-up path there is no other reason.
        if mode_of(recordings[0], settings) != FORCED and settings.rig.makeup_conductance > 0.0:
            found = replace(found, advice=(HELD, *found.advice))
        return Answered(found, None, False)
    started = time.perf_counter()
    say("least squares on the balances", 0.02)
    asked = Asked(held_out, None, without, vary, known is not None)
    first = first_answer(recordings, settings, asked)
    far = hypothesis is None and far_from_config(first)
    # Several say more together than a filter of one law can, or of one damping.
    if hypothesis is None and known is None and (
            (far and first.machine is not None) or differ_in_damping(first)):
        return Answered(by_first(first, started), None, False)
    # What least squares say stands where no set of laws brings a filter near the recording; of
    # motions too quick for their band they say nothing.
    stands = hypothesis is None and first is not None and (
        first.verdict != "insufficient_data") and (far or not force_is_closed(first))
    held, decision = resolved(recordings, settings)

    def search(without_own: tuple[str, ...] = ()) -> Searched:
        return searched(
            lambda under: bare_experiment(recordings, under, held_out is None, without,
                                          without_own), held, decision, stands,
            lambda experiment, may_end, elsewhere, fits: begun_in(experiment, say, Manner(
                view_of(first), may_end, first is not None and agrees_closely(first), elsewhere),
                (*fits, *(known or ()))),
            lambda search: name_effects(search, lambda text, share: say(text, 0.85 * share)))

    end = search()
    dry = tuple(name for name in settings.effects if name in DRY_LAWS)
    if dry and end.named and lacks_more(*end.named):
        end = clearer(end, search(dry))
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
        belonging=None if first is None else first.belonging,
        policy=experiment.policy.to_dict(), channels=decision.findings if decided else (),
        command_hold=(experiment.settings if decided else settings).command_hold,
        wall_s=time.perf_counter() - started), naming, True)


def bare_experiment(recordings: list[Recording], under: Settings, held_out: bool,
                    without: tuple[str, ...], without_own: tuple[str, ...]) -> Experiment:
    """Return the experiment in which effects of the config are sought as if it had none.

    Parameters
    ----------
    held_out : the last fifth of every 5 s is kept aside; ``without`` what is not considered.
    without_own : effects of the config that are none of it.
    """
    bare = under.model_copy(update={"effects": {
        name: values for name, values in under.effects.items() if name not in without_own}})
    found = as_it_reads(at_its_angle(experiment_of(recordings, bare, held_out, without)))
    return replace(found, settings=found.settings.model_copy(update={
        "effects": {name: under.effects[name] for name in without_own} | found.settings.effects}))


def lacks_more(windows: Experiment, naming: Naming) -> bool:
    """Tell whether a search leaves more than the form error of the laws that it names."""
    return not (verdict_of(naming) == "consistent" and follows(naming)) and not within_form(
        windows, naming.before, naming.after)


def clearer(end: Searched, bare: Searched) -> Searched:
    """Return the search without the config's dry friction where it leaves clearly less.

    A friction is one law, and that of the config has the size of a data sheet and no form: held
    beside what is named it bends that, the mass and the delays.  What is left out is told beside
    the config's own model all the same.
    """
    if not bare.followed or bare.named is None or verdict_of(bare.named[1]) == "unexplained":
        return end
    before, after = (lack_of(named[0], named[1].after) for named in (end.named, bare.named))
    if after >= (1.0 - GAINED) * before:
        return end
    windows, naming, nominal = *bare.named, end.named[1].before
    return replace(bare, named=(windows, replace(naming, before=replace(
        with_unknowns(naming.experiment, nominal), covariance=nominal.covariance))))


def by_first(first: Diagnosis, started: float) -> Diagnosis:
    """Return what the balances answer where no filter follows, with what may be done about it."""
    notes = {"consistent": (UNNAMED,), "mismatch": (FINER,)}.get(first.verdict, ())
    return replace(first, advice=(*notes, *first.advice), wall_s=time.perf_counter() - started)


def begun_in(experiment: Experiment, say: Report, manner: Manner = PLAINLY,
             known: Sequence[Fit] = ()) -> tuple[Experiment, Search] | None:
    """Begin a search in the most informative windows; None where the piston hardly moves."""
    if experiment.ranges.position < TRAVEL * experiment.noise[0]:
        return None
    windows = informative(experiment)
    return windows, begun(windows, lambda text, share: say(text, 0.85 * share), manner, known)


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
        naming = changed_between(recordings, naming) or naming
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
