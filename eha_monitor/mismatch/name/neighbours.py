"""Sets beside a fitted one: without a member, with a simpler law in its place."""

from dataclasses import replace

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit, with_unknowns
from eha_monitor.mismatch.name.columns import rig_free
from eha_monitor.mismatch.name.nominal import with_rig
from eha_monitor.mismatch.name.posterior import Names, Refits
from eha_monitor.mismatch.name.refit import at_level, settled, wide
from eha_monitor.mismatch.name.starts import sharing, starts_of, with_effect, without_effect
from eha_monitor.physics.effects import CATALOGUE
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
    return ties.best(found, lambda fit: fit.log_likelihood, within=ties.GUESS) if found else None
