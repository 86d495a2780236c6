"""The best sets of a search: fitted to the end under the same unknowns, and judged."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri, erfc

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.diagnosis import Gate
from eha_monitor.mismatch.likelihood.fit import Fit, spread, with_unknowns
from eha_monitor.mismatch.name.candidates import candidate
from eha_monitor.mismatch.name.gates import ends_of_tolerance, failures, shaped, shapes_at_bound
from eha_monitor.mismatch.name.neighbours import (
    CLOSE,
    crossed,
    lesser,
    plainer_of,
    simplified,
    without,
    without_each,
)
from eha_monitor.mismatch.name.nominal import likelier
from eha_monitor.mismatch.name.posterior import Names, Refits, form_error, plainness
from eha_monitor.mismatch.name.refit import settled, wide
from eha_monitor.mismatch.name.starts import possible
from eha_monitor.physics.effects import CATALOGUE

WITHIN_REACH, FINALISTS = 20.0, 3  # log units; sets that are fitted to the end


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
        for other in sorted({*CATALOGUE[name].contains, *(
                one for one in candidate(name).kin if len(CATALOGUE[one].sizes) == 1)}):
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
