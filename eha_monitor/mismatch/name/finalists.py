"""The best sets of a search and those beside them: fitted under the same unknowns, and judged."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri, erfc

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.diagnosis import Gate
from eha_monitor.mismatch.likelihood.fit import Fit, likeliest, spread, with_unknowns
from eha_monitor.mismatch.name.candidates import candidate
from eha_monitor.mismatch.name.columns import rig_free
from eha_monitor.mismatch.name.gates import ends_of_tolerance, failures, shaped, shapes_at_bound
from eha_monitor.mismatch.name.nominal import with_rig
from eha_monitor.mismatch.name.posterior import Names, Refits, form_error, plainness
from eha_monitor.mismatch.name.refit import at_level, settled, wide
from eha_monitor.mismatch.name.starts import (
    possible,
    sharing,
    starts_of,
    with_effect,
    without_effect,
)
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import effect_values

CLOSE = 300.0  # log units: within them a set is a rival that is fitted to the end
LADDER = (1.0, 4.0, 16.0, 64.0, 256.0)  # times an effect's start


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
    # Where the effect has the place of a law of the config, so has what comes in its place.
    start = replace(start, replaces=next((
        one for one in CATALOGUE[name].contains if one in CATALOGUE[other].contains
        and experiment.active[NAMES.index(one)]), ""))
    bare, sizes = without_effect(experiment, fit, name), len(CATALOGUE[other].sizes)
    return likeliest(with_unknowns(experiment, with_effect(bare, start, (times,) * sizes),
                                   fit.unknowns) for times in LADDER)


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
    return likeliest((here, along), ties.SAME_FIT)


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
    others = [i for i, f in enumerate(fit.free) if f.owner != name]
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


def plainer_of(refits: Refits, names: Names) -> Fit | None:
    """Return the likeliest fit of a set with a law in one's place that this one contains."""
    found = [refits.fits[some] for name in sorted(names & CATALOGUE.keys())
             for other in CATALOGUE[name].contains
             if (some := names - {name} | {other}) in refits.fits]
    return likeliest(found) if found else None


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
            if any(gate.gate == "added" for gate in failed):
                with_simpler_laws(experiment, refits, best)
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
    def needed(gate: Gate) -> bool:
        rest = [refits.fits[less] for less in [
            *(names - {gate.what} | {other} for other in simpler_laws(gate.what)
              if gate.gate == "added"), names - {gate.what}] if less in refits.fits]
        surely = 0.5 * chdtri(sum(f.owner == gate.what for f in fit.free),
                              erfc(experiment.policy.sure / np.sqrt(2.0)))
        return bool(rest) and fit.log_likelihood - likeliest(rest).log_likelihood >= max(
            surely, form_error(refits, refits.evidence[names]))

    fit = refits.fits[names]
    doubtful = [gate for gate in failed
                if gate.gate in ("member", "added") and shaped(fit, gate.what)]
    if doubtful and refits.parted.get(names) is not fit:
        refits.parted[names] = fit
        without(experiment, refits, names)
        if any(gate.gate == "added" for gate in doubtful):
            with_simpler_laws(experiment, refits, names)
    return [gate for gate in failed if gate not in doubtful or not needed(gate)]


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


def simpler_laws(name: str) -> list[str]:
    """Return the laws that an effect contains, and those of its family with one size."""
    return sorted({*CATALOGUE[name].contains, *(
        one for one in candidate(name).kin if len(CATALOGUE[one].sizes) == 1)})


def with_simpler_laws(experiment: Experiment, refits: Refits, names: Names) -> None:
    """Fit a set with each law as simple, or simpler, in the place of one, from where it stands."""
    lead = refits.fits[names]
    worth = lead.log_likelihood - CLOSE
    for name in sorted(names & CATALOGUE.keys()):
        for other in simpler_laws(name):
            swapped = names - {name} | {other}
            stuck = swapped not in refits.fits or refits.fits[swapped].log_likelihood < worth
            if possible(other, experiment) and stuck:
                refits.add(experiment, swapped, settled(
                    experiment, simplified(experiment, lead, name, other), worth=worth))


def finish(experiment: Experiment, refits: Refits) -> None:
    """Fit the sets that are within reach of the best to the end, under the same unknowns.

    A refit that is cut short ranks the wrong set first where effects trade.
    """
    without_each(experiment, refits)
    caught_up(experiment, refits)
    with_simpler_laws(experiment, refits, refits.best())
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
        return likeliest((whole, other))

    for names, fit in zip(near, spread(ended, near), strict=True):
        refits.add(experiment, names, fit)
