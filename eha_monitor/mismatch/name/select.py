"""Joint selection: linearise, rank every set, refit the best, linearise there again."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit, likeliest, spread, with_unknowns
from eha_monitor.mismatch.name.before import (
    FirstView,
    beyond_config,
    informative,
    with_effects,
)
from eha_monitor.mismatch.name.columns import FAR_OFF, LOOSE, columns_at, rig_free
from eha_monitor.mismatch.name.finalists import (
    CLOSE,
    FINALISTS,
    caught_up,
    finish,
    gated,
    within_reach,
    without,
)
from eha_monitor.mismatch.name.nominal import (
    bent,
    from_config,
    lack_of,
    lacks,
    leans_less,
    needing_least,
    nominal_model,
    resolved_nominal,
    with_rig,
)
from eha_monitor.mismatch.name.posterior import (
    STRAYED,
    Names,
    Refits,
    evidence_at_start,
    plainness,
)
from eha_monitor.mismatch.name.proposals import Linearised, beside, chosen_at, rivals_at, weighed
from eha_monitor.mismatch.name.rank import Ranked
from eha_monitor.mismatch.name.refit import (
    entered_at_best,
    from_each_start,
    joined,
    looked,
    settled,
    unfitted,
)
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import effect_values
from eha_monitor.progress import Report, silent

CATCHING_UP = 0.9  # of the best refitted set's gain, after a few steps, to be fitted to the end
MOST_GOING = 2  # of these
LOOKS = 3  # handfuls that are refitted from one linearisation
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
class Manner:
    """What a search is told of the recording."""

    # What least squares name: a set that is fitted from their numbers where all that was
    # found lacks something
    view: FirstView | None = None
    may_end: bool = False  # ends by :class:`Unfollowed` where no law follows
    # The config's own model closes every balance: what has a name shows from there, and a
    # round that gains nothing is the last. A filter then sees the form of a law
    close: bool = False
    # Asked once where no law follows: is a fit better off under another input?
    elsewhere: Elsewhere | None = None


PLAINLY = Manner()


@dataclass
class Search:
    """A search for the best set."""

    experiment: Experiment  # the samples that it is made on
    nominal: Fit  # model fitted to them
    manner: Manner = PLAINLY  # what it is told
    # It is made on some of the samples, to begin with, and nothing is fitted to the end
    sketch: bool = False
    bare: Fit | None = None  # the nominal model with nothing of the rig free
    # One in which effects of the config are larger or smaller than it says; None where it was
    # looked at, or none is
    grown: Fit | None = None
    refits: Refits = field(init=False)  # every refitted set
    # Also from other places of the nominal model; else from what a sketch has found
    widely: bool = True
    # Names -> linearisation at a refitted model
    views: dict[Names, Linearised] = field(default_factory=dict)
    # Names -> evidence with which a model was linearised
    done: dict[Names, float] = field(default_factory=dict)
    ended: bool = False  # what is best was fitted to the end, or need not be
    far: bool = False  # the last of the other places was tried
    viewed: bool = False  # what least squares name was looked at
    asked: bool = False  # whether to go elsewhere
    lack: float = np.inf  # what the best model lacked after the round before, log units a sample
    # The balances are closed, and no set has begun to explain what a filter lacks
    vain: bool = False

    def __post_init__(self):
        self.refits, self.ended = Refits(self.experiment.policy), self.sketch
        self.refits.add(self.experiment, frozenset(), self.nominal)

    def leave(self) -> None:
        """Ask once, where the best model lacks a log unit a sample, whether to go elsewhere.

        Raises
        ------
        Unfollowed
            If so.
        """
        if self.asked or self.manner.elsewhere is None or not (
                lack_of(self.experiment, self.found) > self.experiment.policy.lacking):
            return
        self.asked = True
        if self.manner.elsewhere(self.found):
            raise Unfollowed

    @property
    def found(self) -> Fit:
        """The best model so far."""
        return self.refits.fits[self.refits.best()]

    @property
    def doubtful(self) -> bool:
        """Tell whether a gate refused what was found, or it lacks something."""
        return bool(self.refits.refused) or lacks(self.experiment, self.found)

    def look_at_grown(self) -> None:
        """Take effects of the config beyond their tolerance for names."""
        self.refits.add(self.experiment, frozenset(self.grown.named), self.grown)
        self.grown = None

    def look_at_first_view(self) -> None:
        """Fit what least squares name, where what was found lacks something.

        A fit that begins far off may stay between two models, where the unknowns that each asks
        for hold it; least squares are linear and need no start.
        """
        view, self.viewed = self.manner.view, True
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


def refit(experiment: Experiment, view: Linearised, chosen: list[Ranked], refits: Refits) -> None:
    """Refit sets from their linear guess: a first look at all, to the end what keeps up."""
    def entered(one: Ranked) -> Fit:
        return entered_at_best(experiment, view.fit, view.what, one)

    def quick(one: Ranked) -> Fit:
        made = likeliest(looked(experiment, entered(each), view.slopes)
                         for each in from_each_start(view.what, one))
        if not np.isfinite(made.log_likelihood) or made.unknowns == view.fit.unknowns:
            return made
        # The guess is ranked by the innovations that a filter expects, the fit by those it has: a
        # model is not judged under unknowns that suit it less than those it came from.
        return likeliest((made, with_unknowns(experiment, made, view.fit.unknowns)))

    own = view.own
    if own is not None and not view.here and chosen[0].evidence < own.evidence + CLOSE:
        # With the same numbers of the rig free as in its rivals: else their evidence differs.
        made = settled(experiment, entered(own), view.slopes)
        if made.log_likelihood < view.fit.log_likelihood:  # the guess has led away
            made = likeliest((made, settled(experiment, joined(
                experiment, view.fit, view.what, own, 0.0), view.slopes)))
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

    def ended(made: Fit) -> Fit:
        done = settled(experiment, made, view.slopes)
        return done if np.isfinite(done.log_likelihood) else afresh(experiment, made)

    for made in spread(ended, going):
        refits.add(experiment, frozenset(made.named), made)


def afresh(experiment: Experiment, broken: Fit) -> Fit:
    """Return a model whose fit broke down, with its effects fitted from the config itself.

    Large unknowns make a filter quick, and a quick one of a sensor that is some samples late runs
    away; what is wrong beside it bends the rig's numbers to the ends of their tolerances.
    """
    if not set(broken.named) <= CATALOGUE.keys():
        return broken
    bare = unfitted(experiment, 1.0)
    start = with_effects(experiment, with_rig(experiment, bare), {
        name: effect_values(broken.theta, name) for name in broken.named})
    return settled(experiment, with_unknowns(experiment, start, bare.unknowns))


def begun(experiment: Experiment, say: Report = silent, manner: Manner = PLAINLY,
          known: Sequence[Fit] = ()) -> Search:
    """Begin to find the set of effects and wrong numbers of the rig that a recording supports.

    The search comes back after its first pass, judged by the gates.

    What is missing and large shows in a third of the samples as well as in all of them: the
    search is made there, and goes on with all of them from what it has found.

    Parameters
    ----------
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
        start = likeliest((nominal_model(experiment, within=True), start))
    start = likeliest((start, from_config(experiment)))
    search = Search(experiment, start, manner, bare=first)
    if not search.refits.evidence:
        raise np.linalg.LinAlgError("the nominal model's evidence is singular")
    if grown := beyond_config(experiment, start):
        search.grown = settled(experiment, grown)
        if not lacks(experiment, search.grown):
            search.look_at_grown()
    search.going_on_from(known)
    if not search.widely and lack_of(experiment, search.found) > experiment.policy.lacking:
        search.widely, search.done = True, {}  # what was known is not this
    sketch = sketch_of(experiment, start) if search.widely and not known else None
    if sketch is not None:
        say("searching a third of the samples", 0.1)
        found = explored(Search(sketch, with_unknowns(sketch, start), manner, sketch=True), say)
        if manner.may_end and lack_of(sketch, found.found) > experiment.policy.lacking:
            raise Unfollowed
        caught_up(sketch, found.refits)
        search.going_on_from([found.refits.fits[names] for names in within_reach(found.refits)
                              if names])
    explored(search, say)
    if not search.vain:
        gated(experiment, search.refits)
    return search


def finished(search: Search, say: Report = silent) -> tuple[Linearised | None, Linearised]:
    """Make a search to its end: what hid behind a set that is no answer is sought as well.

    Returns
    -------
    view : sets with names by the linear guess from the best model, if the search came there.
    beside : what has no name, beside parts of the best.

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
    return search.views.get(best), beside(experiment, best, refits.fits[best])


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
        view = weighed(experiment, here, fit, columns_at(experiment, fit, unnamed=False))
        own = view.own
        if fit is refits.fits.get(here):
            search.views[here] = replace(view, slopes=None)
        done[here] = evidence_at_start(refits, here)
        # Far from the optimum that the guess from itself promises, a model is fitted again under
        # the unknowns that suit it best.
        if own is not None and own.evidence - own.prior > done[here] + STRAYED and (
                here or not chosen_at(view, refits)):
            refits.add(experiment, here, settled(experiment, entered_at_best(
                experiment, fit, view.what, own), view.slopes))
            if evidence_at_start(refits, here) > done[here] + STRAYED:
                continue
        if own is None:  # a part of it has vanished: nothing in the ranking compares to it
            without(experiment, refits, here)
            continue
        for _ in range(LOOKS if search.widely else 1):
            chosen = chosen_at(view, refits) or rivals_at(view, refits)
            if not chosen:
                break
            refit(experiment, view, chosen, refits)
            search.leave()
            if refits.ahead(done) is not None:
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
    experiment = search.experiment
    if search.manner.may_end and experiment.work.steps > ENOUGH:
        raise Unfollowed
    before, search.lack = search.lack, lack_of(experiment, search.found)
    nothing = search.lack > (1.0 - GAINED) * before and lacks(experiment, search.found)
    if nothing and search.manner.close:
        start = unbent(search) if turn == 1 else None
        search.vain = start is None and not search.refits.best()
        return None if start is None else (frozenset(), start)
    if nothing and search.manner.may_end and search.lack > experiment.policy.lacking:
        other = None if search.far else far_off(search)
        if other is None:
            raise Unfollowed
        search.far, search.lack = True, np.inf
        return frozenset(), other
    at = search.refits.ahead(search.done)
    if at is None and search.grown is not None:
        search.look_at_grown()
        at = search.refits.ahead(search.done)
    if at is None and not search.viewed:
        search.look_at_first_view()
        at = search.refits.ahead(search.done)
    if at is None and not search.ended:
        finish(experiment, search.refits)
        search.ended = True
        at = search.refits.ahead(search.done)
    wider = search.widely and not search.manner.close
    other = unbent(search) if turn == 1 and wider else None
    if other is None and at is None and wider and not search.far:
        search.far, other = True, far_off(search)
    if other is None:
        return at
    search.ended = search.sketch
    return frozenset(), other


def unbent(search: Search) -> Fit | None:
    """Return the nominal model at the config's B and beta_e, if what is left out has bent them.

    Where a first look has found nothing that explains the recording, this is the second place,
    before what was found is followed: what is linear at the config may not be so where the fit
    went.
    """
    if not lacks(search.experiment, search.found):
        return None
    start = unfitted(search.experiment)
    return start if bent(start, search.nominal) else None


def far_off(search: Search) -> Fit | None:
    """Return a further place of the nominal model, if what was found in the end lacks something.

    It has a number that is known to a factor far from the config's: a leakage that is a hundred
    times too large leaves nothing that is linear where it stands.
    """
    experiment, first = search.experiment, search.nominal
    if not lacks(experiment, search.found):
        return None
    found = []
    for f in rig_free(experiment):
        for step in (-FAR_OFF * f.spread, FAR_OFF * f.spread) if f.spread > LOOSE else ():
            theta = experiment.theta.copy()
            theta[f.place] *= np.exp(step)
            found.append(with_unknowns(experiment, replace(first, theta=theta), first.unknowns))
    best = likeliest(found or [first])
    return best if best.log_likelihood > first.log_likelihood else None
