"""Joint selection: linearise, rank every set, refit the best, linearise there again."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtri, erfc

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import JAGGED, SMOOTH, Experiment, resolving
from eha_monitor.mismatch.data.inputs import FORCED
from eha_monitor.mismatch.diagnosis import Gate
from eha_monitor.mismatch.likelihood.along import filtered_tracks
from eha_monitor.mismatch.likelihood.fit import (
    Fit,
    innovations,
    remade,
    sensitivities,
    spread,
    step_of,
    whitener,
    with_unknowns,
)
from eha_monitor.mismatch.name.before import FirstView, informative
from eha_monitor.mismatch.name.candidates import candidate
from eha_monitor.mismatch.name.columns import FAR_OFF, LOOSE, rig_free
from eha_monitor.mismatch.name.gates import ends_of_tolerance, failures, shaped, shapes_at_bound
from eha_monitor.mismatch.name.polish import Slopes, polished
from eha_monitor.mismatch.name.posterior import (
    STRAYED,
    Names,
    Refits,
    evidence_at_start,
    form_error,
    plainness,
)
from eha_monitor.mismatch.name.proposals import (
    Linearised,
    beside,
    chosen_at,
    linearised,
    rivals_at,
)
from eha_monitor.mismatch.name.rank import Ranked
from eha_monitor.mismatch.name.refit import (
    FIRST,
    at_level,
    entered_at_best,
    from_each_start,
    joined,
    looked,
    settled,
    unfitted,
    wide,
)
from eha_monitor.mismatch.name.starts import (
    expected_likelihood,
    limits_of,
    needs,
    possible,
    sharing,
    starts_of,
    with_effect,
    without_effect,
)
from eha_monitor.physics import signals as of
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import effect_values
from eha_monitor.physics.signals import BETA_E, B
from eha_monitor.progress import Report, silent

LARGER = (FIRST, 10.0 * FIRST, 100.0 * FIRST)  # where a model far off runs away under less
LEANING = 30.0  # times the smallest unknowns: below, the nominal model needs next to nothing
CATCHING_UP = 0.9  # of the best refitted set's gain, after a few steps, to be fitted to the end
MOST_GOING = 2  # of these
LOOKS = 3  # handfuls that are refitted from one linearisation
WITHIN_REACH, FINALISTS = 20.0, 3  # log units; sets that are fitted to the end
BENT = 0.2  # of the logarithm of B or beta_e
CLOSE = 300.0  # log units: within them a set is a rival that is fitted to the end
LADDER = (1.0, 4.0, 16.0, 64.0, 256.0)  # times an effect's start
ROUNDS = 8
GAINED = 0.1  # of what a model lacks, that another round of a search must remove
# Integration steps of a search beside which an answer of least squares stands; what the sealed
# trial names takes 0.2e8 to 1.7e8 (one to four times 10 s of a plain two-core machine).
ENOUGH = 4e8
SKETCH, SKETCH_WINDOW = 8_000, 2_000  # samples that a search begins on, in windows


Elsewhere = Callable[[Fit], bool]


class Unfollowed(Exception):
    """No set of the catalogue's laws brings the filter near a recording.

    Each sample's innovation is then the form of a law that nobody wrote down.
    """


@dataclass(frozen=True)
class Selection:
    """What the joint selection found.

    Attributes
    ----------
    experiment : with integration steps that resolve the damping that was found.
    nominal : the model without effects.
    refits : every refitted set.
    view : sets with names by the linear guess from the best model, if the search came there;
        ``beside`` what has no name, beside parts of the best.
    """

    experiment: Experiment
    nominal: Fit
    refits: Refits
    view: Linearised | None
    beside: Linearised


@dataclass
class Search:
    """A search for the best set.

    Attributes
    ----------
    experiment, nominal : the samples that it is made on, and the nominal model fitted to them.
    refits : every refitted set.
    sketch : on some of the samples, to begin with: nothing is fitted to the end.
    widely : also from other places of the nominal model; else from what a sketch has found.
    views : names -> linearisation at a refitted model.
    done : names -> evidence with which a model was linearised.
    ended : what is best was fitted to the end, or need not be; ``far`` the last of the other
        places was tried.
    view : what least squares name, until it was looked at.
    may_end : ends by :class:`Unfollowed` where no law follows; ``lack`` what the best model lacked
        after the round before, log units a sample.
    close : the config's own model closes every balance: what has a name shows from there, and a
        round that gains nothing is the last.  A filter then sees the form of a law; ``vain`` where
        no set has begun to explain it.
    elsewhere : asked once where no law follows: is a fit better off under another input?
    bare : the nominal model with nothing of the rig free.
    """

    experiment: Experiment
    nominal: Fit
    refits: Refits
    sketch: bool = False
    widely: bool = True
    views: dict[Names, Linearised] = field(default_factory=dict)
    done: dict[Names, float] = field(default_factory=dict)
    ended: bool = False
    far: bool = False
    view: FirstView | None = None
    may_end: bool = False
    close: bool = False
    vain: bool = False
    lack: float = np.inf
    bare: Fit | None = None
    elsewhere: Elsewhere | None = None

    @classmethod
    def at(cls, experiment: Experiment, nominal: Fit, **more) -> "Search":
        """Return a search at its beginning; ``more`` of its attributes."""
        refits = Refits(experiment.policy)
        refits.add(experiment, frozenset(), nominal)
        return cls(experiment, nominal, refits, ended=more.get("sketch", False), **more)

    def gained_nothing(self) -> bool:
        """Tell whether the best model lacks something, after the last round as before."""
        before, self.lack = self.lack, lack_of(self.experiment, self.found)
        return self.lack > (1.0 - GAINED) * before and lacks(self.experiment, self.found)

    def leave(self) -> None:
        """Ask once, where the best model lacks a log unit a sample, whether to go elsewhere.

        Raises
        ------
        Unfollowed
            If so.
        """
        if self.elsewhere is None or not (
                lack_of(self.experiment, self.found) > self.experiment.policy.lacking):
            return
        asked, self.elsewhere = self.elsewhere, None
        if asked(self.found):
            raise Unfollowed

    @property
    def out_of_time(self) -> bool:
        """Tell whether it may end without an answer, and has had its time."""
        return self.may_end and self.experiment.work.steps > ENOUGH

    @property
    def found(self) -> Fit:
        """The best model so far."""
        return self.refits.fits[self.refits.best()]

    @property
    def doubtful(self) -> bool:
        """Tell whether a gate refused what was found, or it lacks something."""
        return bool(self.refits.refused) or lacks(self.experiment, self.found)

    def look_at_first_view(self) -> None:
        """Fit what least squares name, where what was found lacks something.

        A fit that begins far off may stay between two models, where the unknowns that each asks
        for hold it; least squares are linear and need no start.
        """
        view, self.view = self.view, None
        if view is None or not lacks(self.experiment, self.found):
            return
        fit = view.entered(self.experiment, self.nominal)
        if fit is not None and np.isfinite(fit.log_likelihood):
            fit = settled(self.experiment, with_rig(self.experiment, fit))
            self.refits.add(self.experiment, frozenset(fit.named), fit)

    def going_on_from(self, found: Sequence[Fit]) -> None:
        """Fit models of other samples to these, the best first; look no wider if one is better."""
        refits, experiment = self.refits, self.experiment
        for fit in found[:FINALISTS]:
            worth = max(fit.log_likelihood for fit in refits.fits.values()) - CLOSE
            refits.add(experiment, frozenset(fit.named), settled(
                experiment, with_unknowns(experiment, fit), worth=worth))
        if refits.best():
            self.widely, self.done[frozenset()] = False, refits.evidence[frozenset()]


def nominal_model(experiment: Experiment, within: bool = False) -> Fit:
    """Fit the nominal model, first with unknowns so large that it cannot run away.

    Parameters
    ----------
    within : with the rig's numbers free within their tolerances.  Where only B and beta_e may
        give, they make up for all that the config has a little wrong, and go where nothing is
        linear.
    """
    for factor in LARGER:
        start = unfitted(experiment, factor)
        held = polished(experiment, with_rig(experiment, start) if within else start,
                        Slopes(experiment), 8, 0.5)
        if held.gains.size and np.isfinite(held.log_likelihood):
            break
    else:
        raise np.linalg.LinAlgError("the nominal model's likelihood is singular")
    if not leans_less(experiment, at_level(experiment, held)):
        return held
    return settled(experiment, held)


def needing_least(experiment: Experiment, first: Fit) -> Fit:
    """Return the nominal model fitted to the end: from a first fit, and from the config itself.

    Numbers and unknowns are fitted in turn, and a first fit begins with large unknowns.  In slow
    motion it may end there with a soft fluid and a large unknown flow, where the config's fluid
    needs none: a right model is found from the config without unknowns, in a few steps.
    """
    bare = polished(experiment, unfitted(experiment, 1.0), Slopes(experiment))
    found = settled(experiment, first)
    if not np.isfinite(bare.log_likelihood):
        return found
    return likelier(found, settled(experiment, at_level(experiment, bare)))


def from_config(experiment: Experiment) -> Fit:
    """Return the nominal model with the rig's numbers free, fitted from the config itself.

    What B and beta_e make up for alone they are fitted to first, and a narrow valley leads no
    further: in slow motion a leak nine times the config's ended as an oil less than half as stiff.
    """
    bare = polished(experiment, with_rig(experiment, unfitted(experiment, 1.0)),
                    Slopes(experiment))
    if not np.isfinite(bare.log_likelihood):
        return bare
    return with_unknowns(experiment, settled(experiment, at_level(experiment, bare)))


def refit(experiment: Experiment, view: Linearised, chosen: list[Ranked], refits: Refits) -> None:
    """Refit sets from their linear guess: a first look at all, to the end what keeps up."""
    def entered(one: Ranked) -> Fit:
        return entered_at_best(experiment, view.fit, view.what, one)

    def quick(one: Ranked) -> Fit:
        made = ties.best([looked(experiment, entered(each), view.slopes)
                          for each in from_each_start(view.what, one)],
                         lambda fit: fit.log_likelihood, within=ties.GUESS)
        if not np.isfinite(made.log_likelihood) or made.unknowns == view.fit.unknowns:
            return made
        # The guess is ranked by the innovations that a filter expects, the fit by those it has: a
        # model is not judged under unknowns that suit it less than those it came from.
        return likelier(made, with_unknowns(experiment, made, view.fit.unknowns))

    own = view.own
    if own is not None and not view.here and chosen[0].evidence < own.evidence + CLOSE:
        # With the same numbers of the rig free as in its rivals: else their evidence differs.
        made = settled(experiment, entered(own), view.slopes)
        if made.log_likelihood < view.fit.log_likelihood:  # the guess has led away
            made = likelier(made, settled(experiment, joined(
                experiment, view.fit, view.what, own, 0.0), view.slopes))
        refits.add(experiment, view.here, made, True)
    refits.tried.update((view.here, one.names) for one in chosen)
    looks = [made for made in spread(quick, chosen) if np.isfinite(made.log_likelihood)]
    if not looks:
        return
    looks = ties.ordered(looks, lambda made: made.log_likelihood,
                         lambda made: plainness(frozenset(made.named)), ties.GUESS)
    reach = looks[0].log_likelihood
    base = min(looks[-1].log_likelihood, view.fit.log_likelihood)
    going = [made for made in looks
             if made.log_likelihood >= base + CATCHING_UP * (reach - base)][:MOST_GOING]
    refits.dropped.update((frozenset(made.named), made) for made in looks[::-1]
                        if all(made is not one for one in going))
    for made in spread(lambda made: settled(experiment, made, view.slopes), going):
        refits.add(experiment, frozenset(made.named), made)


def likelier(fit: Fit, other: Fit) -> Fit:
    """Return the likelier of two fits of one set, the first where they are the same fit."""
    return ties.best((fit, other), lambda one: one.log_likelihood, within=ties.GUESS)


def held(experiment: Experiment, view: Linearised, refits: Refits) -> None:
    """Fit a model again under the unknowns that suit it best, from its own linear guess."""
    if view.own is not None:
        refits.add(experiment, view.here, settled(
            experiment, entered_at_best(experiment, view.fit, view.what, view.own), view.slopes))


def strayed(view: Linearised, refits: Refits) -> bool:
    """Tell whether a model is far from the optimum that a guess from itself promises."""
    own = view.own
    return own is not None and (
        own.evidence - own.prior > evidence_at_start(refits, view.here) + STRAYED)


def begun(experiment: Experiment, say: Report = silent,
          first_view: FirstView | None = None, may_end: bool = False,
          known: Sequence[Fit] = (), elsewhere: Elsewhere | None = None, close: bool = False
          ) -> Search:
    """Begin to find the set of effects and wrong numbers of the rig that a recording supports.

    The search comes back after its first pass, judged by the gates.

    What is missing and large shows in a third of the samples as well as in all of them: the
    search is made there, and goes on with all of them from what it has found.

    Parameters
    ----------
    first_view : what least squares name: a set that is fitted from their numbers where all that
        was found lacks something.
    may_end, elsewhere, close : see :class:`Search`.
    known : models with names that were found on other recordings of the same rig, the best first.

    Raises
    ------
    Unfollowed
        If it may end so, or is better off elsewhere.
    """
    say("fitting the nominal model", 0.05)
    experiment, first = resolved_nominal(experiment)
    near = leans_less(experiment, first)
    if lacks(experiment, first):
        first = needing_least(experiment, first)
    start = settled(experiment, with_rig(experiment, first))
    if not near:
        start = likelier(nominal_model(experiment, within=True), start)
    start = likelier(start, from_config(experiment))
    search = Search.at(experiment, start, view=first_view, may_end=may_end, bare=first,
                       elsewhere=elsewhere, close=close)
    if not search.refits.evidence:
        raise np.linalg.LinAlgError("the nominal model's evidence is singular")
    search.going_on_from(known)
    if not search.widely and lack_of(experiment, search.found) > experiment.policy.lacking:
        search.widely, search.done = True, {}  # what was known is not this
    sketch = sketch_of(experiment, start) if search.widely else None
    if sketch is not None:
        say("searching a third of the samples", 0.1)
        found = explored(Search.at(sketch, with_unknowns(sketch, start), sketch=True,
                                   view=first_view, may_end=may_end, close=close,
                                   elsewhere=elsewhere), say)
        if may_end and lack_of(sketch, found.found) > experiment.policy.lacking:
            raise Unfollowed
        caught_up(sketch, found.refits)
        search.going_on_from([found.refits.fits[names] for names in within_reach(found.refits)
                              if names])
    explored(search, say)
    if not search.vain:
        gated(experiment, search.refits)
    return search


def finished(search: Search, say: Report = silent) -> Selection:
    """Return what a search ends with: what hid behind a set that is no answer is sought as well.

    Raises
    ------
    Unfollowed
        If it may end so.
    """
    refits, experiment, judged = search.refits, search.experiment, {}
    while refits.refused != judged:
        judged = dict(refits.refused)
        gated(experiment, explored(search, say).refits)
    best = refits.best()
    say("weighing effects not in the catalogue", 0.85)
    return Selection(experiment, search.bare, refits, search.views.get(best),
                     beside(experiment, best, refits.fits[best]))


def sketch_of(experiment: Experiment, start: Fit) -> Experiment | None:
    """Return the samples that a search begins on; None where it needs all, or has few."""
    if experiment.n < 2 * SKETCH or not lacks(experiment, start):
        return None
    found = informative(experiment, SKETCH, SKETCH_WINDOW)
    runs = found is not experiment and np.isfinite(with_unknowns(found, start).log_likelihood)
    return found if runs else None


def explored(search: Search, say: Report) -> Search:
    """Linearise, rank, refit, and again at the best, until the best set stays."""
    experiment, refits, done = search.experiment, search.refits, search.done
    for turn in range(ROUNDS + 1):
        place = next_place(search, turn)
        if place is None or turn == ROUNDS:
            break
        say(f"weighing all sets, round {turn + 1}", 0.1 + 0.1 * turn)
        here, fit = place
        view = linearised(experiment, here, fit)
        if fit is refits.fits.get(here):
            search.views[here] = replace(view, slopes=None)
        done[here] = evidence_at_start(refits, here)
        if strayed(view, refits) and (here or not chosen_at(view, refits)):
            held(experiment, view, refits)
            if evidence_at_start(refits, here) > done[here] + STRAYED:
                continue
        if view.own is None:  # a part of it has vanished: nothing in the ranking compares to it
            without(experiment, refits, here)
            continue
        for _ in range(LOOKS if search.widely else 1):
            chosen = chosen_at(view, refits) or rivals_at(view, refits)
            if not chosen:
                break
            refit(experiment, view, chosen, refits)
            search.leave()
            if refits.ahead(done, STRAYED) is not None:
                break
    return search


def next_place(search: Search, turn: int) -> tuple[Names, Fit] | None:
    """Return the model at which a search goes on; None where it has been everywhere.

    What is best is fitted to the end before, which may put another set ahead.

    Raises
    ------
    Unfollowed
        If it may end so, and there is no other place or no time left.
    """
    if search.out_of_time:
        raise Unfollowed
    nothing = search.gained_nothing()
    if nothing and search.close:
        start = unbent(search) if turn == 1 else None
        search.vain = start is None and not search.refits.best()
        return None if start is None else (frozenset(), start)
    if nothing and search.may_end and search.lack > search.experiment.policy.lacking:
        other = None if search.far else far_off(search)
        if other is None:
            raise Unfollowed
        search.far, search.lack = True, np.inf
        return frozenset(), other
    at = search.refits.ahead(search.done, STRAYED)
    if at is None and search.view is not None:
        search.look_at_first_view()
        at = search.refits.ahead(search.done, STRAYED)
    if at is None and not search.ended:
        finish(search.experiment, search.refits)
        search.ended = True
        at = search.refits.ahead(search.done, STRAYED)
    elsewhere = search.widely and not search.close
    other = unbent(search) if turn == 1 and elsewhere else None
    if other is None and at is None and elsewhere and not search.far:
        search.far, other = True, far_off(search)
    if other is None:
        return at
    search.ended = search.sketch
    return frozenset(), other


def lacks(experiment: Experiment, fit: Fit) -> bool:
    """Tell whether a model needs unknowns that show."""
    return needs(experiment, fit, LEANING)


def leans_less(experiment: Experiment, fit: Fit) -> bool:
    """Tell whether a nominal model asks for smaller unknowns than it was first given."""
    small = limits_of(experiment)[0].as_array()
    return bool((fit.unknowns.as_array() < FIRST * small).all())


def unbent(search: Search) -> Fit | None:
    """Return the nominal model at the config's B and beta_e, if what is left out has bent them.

    Where a first look has found nothing that explains the recording, this is the second place,
    before what was found is followed: what is linear at the config may not be so where the fit
    went.
    """
    if not lacks(search.experiment, search.refits.fits[search.refits.best()]):
        return None
    start = unfitted(search.experiment)
    return start if bent(start, search.nominal) else None


def far_off(search: Search) -> Fit | None:
    """Return a further place of the nominal model, if what was found in the end lacks something.

    It has a number that is known to a factor far from the config's: a leakage that is a hundred
    times too large leaves nothing that is linear where it stands.
    """
    experiment, first, refits = search.experiment, search.nominal, search.refits
    if not lacks(experiment, refits.fits[refits.best()]):
        return None
    found = []
    for f in rig_free(experiment):
        for step in (-FAR_OFF * f.spread, FAR_OFF * f.spread) if f.spread > LOOSE else ():
            theta = experiment.theta.copy()
            theta[f.place] *= np.exp(step)
            found.append(with_unknowns(experiment, replace(first, theta=theta), first.unknowns))
    best = ties.best(found or [first], lambda fit: fit.log_likelihood, within=ties.GUESS)
    return best if best.log_likelihood > first.log_likelihood else None


def bent(start: Fit, fit: Fit) -> bool:
    """Tell whether a fit of the nominal model has gone far from the config.

    What is left out bends B and beta_e, and what is linear at the config is not so there.
    """
    return any(abs(np.log(fit.theta[place] / start.theta[place])) > BENT for place in (B, BETA_E)
               if fit.theta[place] != start.theta[place])


def resolved_nominal(experiment: Experiment) -> tuple[Experiment, Fit]:
    """Fit the nominal model with integration steps that resolve the damping it finds.

    The experiment that is returned has the ranges of the pressures that this model finds, where
    no sensor reads them: a relief valve is sought where the pressures are.
    """
    while True:
        first = nominal_model(experiment)
        finer = resolving(experiment, first.theta[B])
        if jagged(finer, first):
            finer = replace(finer, log_step=JAGGED)
        if (finer.steps, finer.log_step) == (experiment.steps, experiment.log_step):
            found = with_pressures(experiment, first)
            return found, first if found is experiment else with_unknowns(found, first)
        experiment = finer


def jagged(experiment: Experiment, fit: Fit) -> bool:
    """Tell whether the innovations leap with beta_e over a small step, and not over a large one.

    A check valve that opens within an integration step makes them so.  A slope over the small step
    is then one of leaps: no fit moves, and what it is sure of is nothing.
    """
    f = next((one for one in fit.free if one.name == "beta_e"), None)
    if f is None or experiment.log_step == JAGGED or not np.isfinite(fit.log_likelihood):
        return False
    small, large = (np.nan_to_num(slope) @ whitener(fit.s).T for slope in sensitivities(
        experiment, fit.theta, fit.active, fit.gains, innovations(
            experiment, fit.theta, fit.active, fit.gains),
        [step_of(f, fit.theta, step) for step in (SMOOTH, JAGGED)]))
    return bool(np.linalg.norm(small - large) > np.linalg.norm(large))


def with_pressures(experiment: Experiment, fit: Fit) -> Experiment:
    """Return an experiment with the ranges of the pressures that a fit finds and nobody reads."""
    if experiment.mode == FORCED or (experiment.used[2] and experiment.used[3]):
        return experiment
    # A filter that starts from a wrong pressure is off until its gains are steady.
    tracks = np.concatenate([track[len(fit.gains) :]
                             for track in filtered_tracks(experiment, fit)])
    p1, p2 = tracks[:, of.P1], tracks[:, of.P2]
    if not len(tracks) or not (np.isfinite(p1) & np.isfinite(p2)).all():
        return experiment
    low = np.quantile(np.minimum(p1, p2), [0.002, 0.02, 0.2])  # as ranges_of, no extremes
    apart = np.quantile(np.abs(p1 - p2), [0.5, 0.9, 0.98, 0.998])
    return replace(experiment, ranges=replace(
        experiment.ranges, pressure_difference=tuple(apart.tolist()),
        lowest_pressure=tuple(low.tolist()), mean_pressure=float(np.median(p1 + p2)) / 2.0))


def nominal(experiment: Experiment) -> tuple[Experiment, Fit]:
    """Fit the nominal model to the end; returns the experiment with steps that resolve its B."""
    experiment, first = resolved_nominal(experiment)
    return experiment, needing_least(experiment, first)


def crossed(fit: Fit, best: Fit) -> Fit | None:
    """Return a model that starts where the best one stands, with its own effect of one kind.

    Rivals of one family share their shapes, and sizes of one name; each is judged from the same
    place.  What a law has beyond one that it contains begins at nothing: from elsewhere it may end
    where friction acts in one direction only.  None where the two do not differ by one effect of
    a family.
    """
    mine, other = set(fit.named) - set(best.named), set(best.named) - set(fit.named)
    if len(mine) != 1 or len(other) != 1:
        return None
    one, two = (CATALOGUE.get(next(iter(names))) for names in (mine, other))
    if one is None or two is None or not one.family or one.family != two.family:
        return None
    theta = fit.theta.copy()
    there = {f.name: f for f in best.free}
    beyond = {p.name: p.neutral for p in one.sizes if two.name in one.contains and not p.log}
    for f in fit.free:
        own = f.owner == one.name
        same = there.get(f"{two.name}.{f.symbol}" if own else f.name)
        if same is not None:
            theta[f.place] = f.outward(f.inward(best.theta[same.place]))
        elif own and f.symbol in beyond:
            theta[f.place] = f.outward(beyond[f.symbol])
    return replace(fit, theta=theta)


def simplified(experiment: Experiment, fit: Fit, name: str, other: str) -> Fit:
    """Return a fit with a law as simple, or simpler, in an effect's place, where that stands.

    Its size is the likeliest of a ladder: a start that is 60 times too small needs more steps than
    a fit that is far behind is given.
    """
    start, has = starts_of(other, experiment)[0], effect_values(fit.theta, name)
    least = {p.name: dict(start.values)[p.name] for p in CATALOGUE[other].sizes}
    # A size that vanishes in the law is none of the simpler one's (Stribeck with F_c = 0).
    start = sharing(start, {key: value for key, value in has.items()
                            if abs(value) >= abs(least.get(key, 0.0))})
    bare, sizes = without_effect(experiment, fit, name), len(CATALOGUE[other].sizes)
    return ties.best(
        [with_unknowns(experiment, with_effect(bare, start, (times,) * sizes), fit.unknowns)
         for times in LADDER], lambda one: one.log_likelihood, within=ties.GUESS)


def lesser(experiment: Experiment, fit: Fit, name: str) -> Fit:
    """Return a fit without one of its members, where it stands, not yet refitted.

    What the member hid may now be seen, so every number of the rig is free: a leakage within its
    tolerance explains what a cross-port leakage did.  Of two places the likelier is returned:
    where the others stand, under the unknowns that this asks for, and where they go along the
    valley of the fit's own covariance when the member vanishes, under the fit's own unknowns.
    Where a scale of the encoder trades with displacement, mass and B, only the second is near.
    """
    def bare(theta: np.ndarray) -> Fit:
        moved = replace(fit, theta=theta)
        if name in CATALOGUE:
            return with_rig(experiment, without_effect(experiment, moved, name))
        own = next(f for f in rig_free(experiment) if f.name == name)
        theta = theta.copy()
        theta[own.place] = min(max(theta[own.place], own.lower), own.upper)
        return with_rig(experiment, replace(
            moved, theta=theta, named=tuple(n for n in fit.named if n != name),
            free=tuple(own if f.name == name else f for f in fit.free)))

    here, along = at_level(experiment, bare(fit.theta)), bare(without_along(fit, name))
    return ties.best((here, along), lambda one: one.log_likelihood, within=ties.SAME_FIT)


def traded(experiment: Experiment, fit: Fit, name: str) -> Fit | None:
    """Return a fit with a wrong number of the rig in a member's place, not yet refitted.

    Where a member vanishes, the valley of the fit's own covariance may lead one number of the rig
    beyond its tolerance: the two are one for this recording, as equal zero errors of both
    pressure sensors and a charge pressure are.  None where it leads none, or several, there.
    """
    wider = {f.name: wide(f, experiment.policy) for f in rig_free(experiment)
             if f.name not in fit.named}
    free = tuple(wider.get(f.name, f) for f in fit.free)
    theta = without_along(replace(fit, free=free), name)
    gone = [f for f in fit.free if f.name in wider and f.at_bound(f.outward(
        f.inward(theta[f.place])))]
    if len(gone) != 1 or name not in CATALOGUE:
        return None
    bare = without_effect(experiment, replace(fit, theta=theta, free=tuple(
        wider[f.name] if f in gone else f for f in fit.free)), name)
    for f in bare.free:
        bare.theta[f.place] = f.outward(f.inward(bare.theta[f.place]))
    return with_rig(experiment, replace(bare, named=(*bare.named, gone[0].name)))


def without_along(fit: Fit, name: str) -> np.ndarray:
    """Return theta where a fit's other numbers go when a member vanishes, by its covariance.

    With the member's sizes m and all others o, o moves by C_om C_mm^-1 (absent - m): the mean of
    a normal distribution given m.  What is fitted as a logarithm grows in proportion to the step
    and not by its exponential: a leakage takes over the flow of another.
    """
    entry = CATALOGUE.get(name)
    sizes = {f"{name}.{p.name}": p.neutral for p in entry.sizes if not p.log} if entry else {}
    own = [i for i, f in enumerate(fit.free) if f.name == name or f.name in sizes]
    others = [i for i, f in enumerate(fit.free)
              if f.owner != name]
    absent = np.array([sizes.get(fit.free[i].name, fit.free[i].prior) for i in own])
    theta = fit.theta.copy()
    if not own or not np.isfinite(absent).all() or len(fit.covariance) != len(fit.free):
        return theta  # absence is no number, or the fit has none of its own yet
    now = np.array([f.inward(theta[f.place]) for f in fit.free])
    moved = fit.covariance[np.ix_(others, own)] @ (
        np.linalg.pinv(fit.covariance[np.ix_(own, own)], hermitian=True) @ (absent - now[own]))
    if np.isfinite(moved).all():
        for i, step in zip(others, moved, strict=True):
            f = fit.free[i]
            theta[f.place] = f.outward(now[i] + (np.log1p(step) if f.log and step > 0.0 else step))
    return theta


def with_rig(experiment: Experiment, fit: Fit) -> Fit:
    """Return a fit with every number of the rig free within its tolerance, not yet refitted.

    One that is the same equation as an effect of the model stays at the config's.
    """
    known = {f.name for f in fit.free}
    free = fit.free + tuple(f for f in rig_free(experiment, fit.named) if f.name not in known)
    return remade(experiment, fit, free=free)


def without_each(experiment: Experiment, refits: Refits) -> None:
    """Fit the best set, and the likeliest, without each of their members from where they stand.

    A member is named only if the others cannot do without it, and they may have been fitted from
    a worse place.  The likeliest set may hold the right one beside a member too many.
    """
    while (names := next((names for names in (refits.best(), refits.highest())
                          if refits.parted.get(names) is not refits.fits[names]), None)
           ) is not None:
        refits.parted[names] = refits.fits[names]
        without(experiment, refits, names)


def without(experiment: Experiment, refits: Refits, names: Names) -> None:
    """Fit a set without each of its members from where it stands."""
    fit = refits.fits.get(names)
    for name in sorted(names) if fit is not None else ():
        for other in filter(None, (lesser(experiment, fit, name), traded(experiment, fit, name))):
            refits.add(experiment, frozenset(other.named), settled(
                experiment, other, worth=fit.log_likelihood - CLOSE))


def gated(experiment: Experiment, refits: Refits) -> None:
    """Refuse best sets that no recording can support, until the best one passes the gates.

    In the place of each the sets without its failing members are fitted; where a number of the
    rig has gone to the end of its tolerance, also the set that calls it wrong.
    """
    widened: set[str] = set()
    while True:
        best = refits.best()
        fit = refits.fits[best]
        failed = not_needed(experiment, refits, best, failures(experiment, fit))
        plain = at_defaults(experiment, fit) if failed else None
        if plain is not None:
            refits.add(experiment, best, plain, anyway=True)
            continue
        if failed:
            refits.refused[best] = tuple(failed)
            for name in dict.fromkeys(gate.what for gate in failed):
                if best - {name} not in refits.fits:
                    refits.add(experiment, best - {name}, settled(experiment, lesser(
                        experiment, fit, name), worth=fit.log_likelihood - CLOSE))
            continue
        without_each(experiment, refits)
        if refits.fits[refits.best()] is not fit:
            continue
        ends = [f for f in ends_of_tolerance(fit) if f.name not in widened]
        if not ends:
            return
        for f in ends:
            widened.add(f.name)
            if best | {f.name} not in refits.fits:
                free = tuple(wide(one, experiment.policy) if one.name == f.name else one
                             for one in fit.free)
                refits.add(experiment, best | {f.name}, settled(experiment, replace(
                    fit, free=free, named=(*fit.named, f.name), converged=False)))


def not_needed(experiment: Experiment, refits: Refits, names: Names, failed: Sequence[Gate]
               ) -> list[Gate]:
    """Return the gates without those of members that the others cannot do without.

    How far a size is from nil its deviation says where the model is linear in it.  Beside a
    threshold or an exponent it is not: a valve that holds a pressure does so by any conductance
    from some on, 1900 +- 3000, and nothing else does.  There the set is fitted without it, from
    where it stands, and has to lose what ``sure`` deviations of all its numbers are
    (likelihood-ratio test, Wilks 1938), and more than the others' laws may have wrong.
    """
    def needed(name: str) -> bool:
        rest = refits.fits.get(names - {name})
        surely = 0.5 * chdtri(sum(f.owner == name for f in fit.free),
                              erfc(experiment.policy.sure / np.sqrt(2.0)))
        return rest is not None and fit.log_likelihood - rest.log_likelihood >= max(
            surely, form_error(refits, refits.evidence[names]))

    fit = refits.fits[names]
    doubtful = [gate for gate in failed if gate.gate == "member" and shaped(fit, gate.what)]
    if doubtful and refits.parted.get(names) is not fit:
        refits.parted[names] = fit
        without(experiment, refits, names)
    return [gate for gate in failed if gate not in doubtful or not needed(gate.what)]


def at_defaults(experiment: Experiment, fit: Fit) -> Fit | None:
    """Return a fit whose shapes at an end of their range stay at their defaults instead.

    None where none does, or where it loses more than ``sure`` deviations: of a little air a
    recording does not say how it is compressed.
    """
    ends, theta = shapes_at_bound(fit), fit.theta.copy()
    if not ends:
        return None
    for f, default in ends:
        theta[f.place] = default
    gone = {f.name for f, _ in ends}
    held = settled(experiment, with_unknowns(experiment, replace(
        fit, theta=theta, free=tuple(f for f in fit.free if f.name not in gone),
        converged=False)), worth=fit.log_likelihood - CLOSE)
    lost = fit.log_likelihood - held.log_likelihood
    return held if lost < 0.5 * experiment.policy.sure**2 else None


def within_reach(refits: Refits) -> list[Names]:
    """Return the sets that are within reach of the best one, best first."""
    scores, best = refits.scores(), refits.best()
    return [names for names in ties.ordered(scores, scores.get, plainness, ties.GUESS)
            if scores[names] > scores[best] - WITHIN_REACH]


def caught_up(experiment: Experiment, refits: Refits) -> None:
    """Fit what a first look has dropped and has no more members than the best set.

    What was slow, from far off, may be as good in the end.
    """
    best = refits.best()
    worth = refits.fits[best].log_likelihood - CLOSE
    slow = [(names, fit) for names, fit in refits.dropped.items()
            if names not in refits.fits and len(names) <= len(best)]
    fits = spread(lambda item: settled(experiment, item[1], worth=worth), slow)
    for (names, _), fit in zip(slow, fits, strict=True):
        refits.add(experiment, names, fit)


def finish(experiment: Experiment, refits: Refits) -> None:
    """Fit the sets that are within reach of the best to the end, under the same unknowns.

    A refit that is cut short ranks the wrong set first where effects trade.
    """
    without_each(experiment, refits)
    caught_up(experiment, refits)
    best = refits.best()
    lead = refits.fits[best]
    for name in sorted(best & CATALOGUE.keys()):  # a law as simple, from the same place
        for other in sorted({*CATALOGUE[name].contains, *candidate(name).simple_kin}):
            swapped, worth = best - {name} | {other}, lead.log_likelihood - CLOSE
            stuck = swapped not in refits.fits or refits.fits[swapped].log_likelihood < worth
            if possible(other, experiment) and stuck:
                refits.add(experiment, swapped, settled(
                    experiment, simplified(experiment, lead, name, other), worth=worth))
    # That nothing is missing is never judged by half a fit.
    able = within_reach(refits)
    plainer = {names: plainer_of(refits, names) for names in able}
    more = [names for names in able[FINALISTS:] if plainer[names] is not None]
    near = list(dict.fromkeys([*able[:FINALISTS], *more, frozenset[str]()]))
    level = refits.fits[refits.best()].unknowns
    lead = refits.fits[refits.likeliest(near)]
    worth = lead.log_likelihood - CLOSE

    def ended(names: frozenset[str]) -> Fit:
        fit = refits.fits[names]
        if fit.unknowns != level:
            fit = with_unknowns(experiment, fit, level)
        whole = fit if fit.converged and fit is refits.fits[names] else settled(
            experiment, fit, worth=worth)
        other = crossed(fit, plainer.get(names) or lead)
        if other is None:
            return whole
        other = settled(experiment, with_unknowns(experiment, other, level),
                        worth=max(worth, whole.log_likelihood - WITHIN_REACH))
        return likelier(whole, other)

    for names, fit in zip(near, spread(ended, near), strict=True):
        refits.add(experiment, names, fit)


def plainer_of(refits: Refits, names: Names) -> Fit | None:
    """Return the likeliest fit of a set with a law in one's place that this one contains."""
    found = [refits.fits[some] for name in sorted(names & CATALOGUE.keys())
             for other in CATALOGUE[name].contains
             if (some := names - {name} | {other}) in refits.fits]
    return ties.best(found, lambda fit: fit.log_likelihood, within=ties.GUESS) if found else None


def lack_of(experiment: Experiment, fit: Fit) -> float:
    """Return what a model lacks on the expected likelihood of a right one, log units a sample."""
    return float(expected_likelihood(experiment, fit) - fit.log_likelihood) / experiment.n
