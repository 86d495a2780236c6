"""What the joint selection names, with a probability for each name and for none."""

from dataclasses import dataclass, field, replace

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import FORCED, OPEN
from eha_monitor.mismatch.diagnosis import INTERMITTENT, Gate, Piece
from eha_monitor.mismatch.likelihood.fit import Fit, with_unknowns
from eha_monitor.mismatch.likelihood.gains import Unknowns
from eha_monitor.mismatch.name.candidates import RIG, all_named, candidate
from eha_monitor.mismatch.name.columns import loads_of, runs_of
from eha_monitor.mismatch.name.gram import evidences_at
from eha_monitor.mismatch.name.nominal import lack_of, lacks
from eha_monitor.mismatch.name.posterior import (
    Names,
    Refits,
    plainness,
    posterior,
    refused_evidence,
)
from eha_monitor.mismatch.name.proposals import Linearised
from eha_monitor.mismatch.name.refit import settled
from eha_monitor.mismatch.name.select import Search, finished
from eha_monitor.mismatch.name.starts import limits_of
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.progress import Report, silent


@dataclass(frozen=True)
class Naming:
    """What was named."""

    experiment: Experiment  # with integration steps that resolve the damping that was found
    before: Fit  # nominal model with B and beta_e fitted
    after: Fit  # the model with what is named
    # Numbers of the rig that ``after`` calls wrong, ``mass`` and so on
    wrong: tuple[str, ...] = ()
    # Effect, ``rig.<key>`` -> probability that it, or what looks like it here, is there, and
    # that nothing without a name is missing beside it
    probability: dict[str, float] = field(default_factory=dict)
    consistent: float = np.nan  # probabilities of these answers
    unexplained: float = np.nan
    # Effect, ``rig.<key>`` -> log units that the model loses without it
    evidence: dict[str, float] = field(default_factory=dict)
    # Effect, ``rig.<key>`` -> names that this record cannot tell from it
    rivals: dict[str, tuple[str, ...]] = field(default_factory=dict)
    # Set -> its model and the log units by which it is behind, best first
    tried: tuple[tuple[Names, Fit, float], ...] = ()
    # When a load without a name of its own acts, (from s, to s, N); ``intermittent_load``
    loads: tuple[tuple[float, float, float], ...] = ()
    # Checks that a set with more evidence, or a member of one, did not pass
    gates: tuple[Gate, ...] = ()
    # Set -> probability that it is all that is there, and nothing without a name
    weights: dict[Names, float] = field(default_factory=dict)
    pieces: tuple[Piece, ...] = ()  # of the recordings, between which a parameter changed
    # Names as of ``probability`` -> that something is there in its place, be it one of many
    claims: dict[str, float] = field(default_factory=dict)


def in_place_of(name: str, best: Names, weights: dict[Names, float]) -> dict[str, float]:
    """Return what stands for a name in sets that have all the others of the best one.

    A law of the same family stands for one of them: friction that differs by direction is Coulomb
    friction in the place of a constant load.
    """
    others: dict[str, float] = {}
    for names, weight in weights.items():
        if name not in names and all(one in names or names & candidate(one).kin
                                     for one in best - {name}):
            for other in sorted(names - best):
                others[other] = others.get(other, 0.0) + weight
    return others


def beyond_form(experiment: Experiment, before: Fit, after: Fit, needs: Unknowns) -> float:
    """Return the probability that a model's unknowns are more than its form error.

    Named physics is right to a share of its size only, and a filter needs unknowns for the rest:
    a ``share`` of those that it has taken the place of.  What needs more lacks something else, and
    a model that names nothing has no form error to blame.
    """
    small, policy = limits_of(experiment)[0].as_array(), experiment.policy
    if experiment.mode == FORCED and after.named and form_only(experiment, before, after):
        return 0.0
    needed, still = (level.as_array() / small for level in (before.unknowns, needs))
    taken = needed - still if after.named else 0.0 * still
    least = np.maximum(policy.few, policy.share * taken)
    if experiment.mode == FORCED:  # the noise of what measures the force acts like a force
        least[0] = max(least[0], policy.sure * experiment.input_noise / small[0])
    elif experiment.mode == OPEN:  # and that of a measured pump speed like a flow
        flow = experiment.input_noise * (experiment.settings.rig.pump_displacement or 0.0)
        least[1] = max(least[1], policy.sure * flow / small[1])
    ratio = float((still / least).max())
    odds = ratio**4
    # Only what the recording asks for counts: where unknowns gain nothing their size says nothing.
    present = runs_of(experiment, after.theta, after.active, after.gains)
    with_needs, without = evidences_at(experiment, after, present, [needs, Unknowns(*small)])
    gained = float(with_needs - without)
    return odds / (1.0 + odds) * float(-np.expm1(-policy.temper * max(gained, 0.0)))


def form_only(experiment: Experiment, before: Fit, after: Fit) -> bool:
    """Tell whether names leave no more than the form error of laws, run nearly free.

    What measures the force brings an unknown force to every model, the best as much as the
    nominal one: its size says nothing of what is missing.  What the models leave without it does.
    """
    few = Unknowns(*(experiment.policy.few * limits_of(experiment)[0].as_array()))
    left = [np.nanmean(with_unknowns(experiment, fit, few).e ** 2) for fit in (before, after)]
    return bool(left[1] < experiment.policy.law * left[0])


def name_effects(search: Search, report: Report | None = None) -> Naming:
    """Find the effects and the wrong numbers of the rig that an experiment supports.

    Parameters
    ----------
    search : begun in it, see :func:`select.begun`.
    report : called with what is done and how far it is, 0 to 1.

    Raises
    ------
    Unfollowed
        If the search may end so.
    """
    say = report or silent
    views = finished(search, say)
    say("fitting the nominal model to the end", 0.9)
    return naming_of(search.experiment, search.refits, views,
                     settled(search.experiment, search.bare))


def naming_of(experiment: Experiment, refits: Refits,
              views: tuple[Linearised | None, Linearised], before: Fit) -> Naming:
    """Return names and probabilities of a search; ``views`` as :func:`finished` returns them."""
    best, beside = refits.best(), views[1]
    weights = posterior(refits, [(view.here, view.ranking) for view in views if view is not None])
    scores = refits.scores()
    after = refits.fits[best]
    gates = tuple(gate for failed in refits.refused.values() for gate in failed)
    # What speaks for a set that no gate lets through speaks for something that has no name, as far
    # as the answer does not explain it as well, nor the form of its laws.
    refused = sum(weights.get(names, 0.0) for names, value in refused_evidence(refits).items()
                  if value > refits.evidence[best])
    weights = {names: weight for names, weight in weights.items() if names not in refits.refused}
    whole = refused + sum(weights.values())
    refused, weights = refused / whole, {names: one / whole for names, one in weights.items()}
    rivals, probability, evidence, claims = {}, {}, {}, {}
    for name in sorted(best):
        stands = in_place_of(name, best, weights)
        near = [other for other in ties.ordered(stands, stands.__getitem__, str)
                if stands[other] >= experiment.policy.rival and candidate(other).named]
        near = list(dict.fromkeys([*near, *filter(None, [candidate(name).equals])]))
        rivals[name] = tuple(other.removeprefix(RIG) for other in near)
        # Laws of one family are one claim: which of them it is, the curve says, not the name.
        held = {name, *near, *(candidate(name).kin - best)}
        for found_by, any_of in ((probability, held), (claims, held | stands.keys())):
            found_by[name] = float(sum(
                weight for names, weight in weights.items()
                if any_of & names and all_named(names - {INTERMITTENT})))
        without = [value for names, value in refits.evidence.items()
                   if not held & names and names not in refits.refused]
        evidence[name] = float(refits.evidence[best] - max(without, default=-np.inf))
    unnamed = refused + float(sum(weight for names, weight in weights.items()
                                  if not all_named(names)))
    loads: tuple[tuple[float, float, float], ...] = ()
    acting = float(sum(weight for names, weight in weights.items() if INTERMITTENT in names))
    needs = after.unknowns
    if acting > experiment.policy.likely:  # a load that comes and goes has a name, and intervals
        one = next(one for one in beside.ranking if INTERMITTENT in one.names)
        loads = loads_of(experiment, np.array([
            value for place, value in sorted(one.amplitudes.items())
            if beside.what[place].owner == INTERMITTENT]))
        probability[INTERMITTENT], rivals[INTERMITTENT] = acting, ()
        own = beside.own
        evidence[INTERMITTENT] = max(one.evidence - own.evidence, 0.0) if own else np.inf
        unnamed, needs = unnamed - acting, one.gram.unknowns
    beyond = beyond_form(experiment, before, after, needs)
    probability, claims = ({name: value * (1.0 - beyond) for name, value in stated.items()}
                           for stated in (probability, claims))
    empty = weights.get(frozenset(), 0.0) * (1.0 - beyond)
    unnamed = 1.0 - (1.0 - unnamed) * (1.0 - beyond)
    order = ties.ordered(scores, lambda names: scores[names], plainness, ties.GUESS)
    return Naming(
        experiment, before, replace(after, named=tuple(n for n in after.named if n in CATALOGUE)),
        tuple(key for name in after.named if (key := candidate(name).key)),
        probability, float(empty), unnamed, evidence, rivals,
        tuple((names, refits.fits[names], scores[best] - scores[names]) for names in order),
        loads, gates, {names: weight * (1.0 - beyond) for names, weight in weights.items()},
        claims=claims)


def on_all_of(experiment: Experiment, naming: Naming) -> Naming:
    """Return what was named on some windows with its models run over the whole recording."""
    if naming.experiment.stretches is experiment.stretches:
        return naming
    whole = naming.experiment.only(experiment.stretches)

    def over(fit):
        return replace(with_unknowns(whole, fit), covariance=fit.covariance)

    return replace(naming, experiment=whole, before=over(naming.before), after=over(naming.after))


def follows(naming: Naming) -> bool:
    """Tell whether the model that was found follows the recording, and least squares cannot more.

    It needs no unknown force, flow or speed that shows, or lacks no more of what the nominal
    model does than may be the form error of its laws.
    """
    return near_to(naming.experiment, naming.before, naming.after)


def near_to(experiment: Experiment, before: Fit, after: Fit) -> bool:
    """Tell whether a model lacks nothing, or no more than the form error of its laws."""
    return not lacks(experiment, after) or within_form(experiment, before, after)


def within_form(experiment: Experiment, before: Fit, after: Fit) -> bool:
    """Tell whether a model lacks no more than ``law`` of what the nominal one does."""
    most = lack_of(experiment, before)
    return bool(np.isfinite(most)
                and lack_of(experiment, after) <= experiment.policy.law * most)
