"""Refit of a set of effects to the end, from the linear guess, and its evidence."""

from dataclasses import replace

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit, Free, remade, with_unknowns
from eha_monitor.mismatch.likelihood.gains import Unknowns, expected_covariance, gains_of
from eha_monitor.mismatch.name.candidates import candidate
from eha_monitor.mismatch.name.columns import ALWAYS, MAKEUP, Column, placed, rig_free, runs_of
from eha_monitor.mismatch.name.gram import evidences_at
from eha_monitor.mismatch.name.polish import ROUGHLY, Slopes, keep_within, polished, polished_on
from eha_monitor.mismatch.name.rank import Ranked
from eha_monitor.mismatch.name.starts import (
    LEAST_SHARE,
    base_free,
    entered,
    free_of,
    limits_of,
    own_sizes,
    sharing,
    timing_free,
)
from eha_monitor.mismatch.policy import SearchPolicy
from eha_monitor.physics.contributions import with_update
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import BASE_KEYS, effect_values, place_of

FIRST = 100.0  # times the smallest unknowns: where a nominal model begins
SHARES = (1.0, 0.3)  # of the way to a linear guess
SHORTER = (0.1, 0.03, 0.01)  # where no model can run there
FARTHEST = 6.0  # of a logarithm: how far a number of the rig is moved by a linear guess
WRONG_BY = 1e3  # how far a number of the rig may be off; what is less is absent
QUICK = 10  # steps of a first look
ROUGH_STEPS = 8  # of a fit whose unknowns will change
HALVINGS = 3  # of the way to other unknowns
SETTLING = 4  # rounds of parameters and unknowns in turn, at most
FACTORS = (10.0, 3.0)  # of the unknowns' grid


def unfitted(experiment: Experiment, factor: float = FIRST) -> Fit:
    """Return the nominal model before any fit, unknowns at ``factor`` times the smallest."""
    theta, active = experiment.theta.copy(), experiment.active.copy()
    free = base_free(experiment) + timing_free(experiment)
    for f in free:
        if f.owner:
            active[NAMES.index(f.owner)] = True
    small, large = (limit.as_array() for limit in limits_of(experiment))
    unknowns = Unknowns(*np.minimum(factor * small, large))
    k = len(free)
    fit = Fit(theta, active, free, unknowns, np.zeros((0, 0, 0)), np.zeros((0, 0)),
              np.zeros((0, 0)), -np.inf, np.zeros((k, k)), converged=False)
    return with_unknowns(experiment, fit, unknowns)


def at_level(experiment: Experiment, fit: Fit, limits: tuple[Unknowns, Unknowns] | None = None
             ) -> Fit:
    """Return a fit under the unknowns that its innovations ask for, between ``limits``.

    The likelihood at other unknowns is that of the innovations mapped to their gains.
    """
    present = runs_of(experiment, fit.theta, fit.active, fit.gains)
    small, large = (limit.as_array() for limit in limits or limits_of(experiment))
    known: dict[tuple, float] = {}

    def likelihood(levels: list[np.ndarray]) -> None:
        todo = list(dict.fromkeys(tuple(level) for level in levels if tuple(level) not in known))
        if todo:
            known.update(zip(todo, evidences_at(experiment, fit, present, [
                Unknowns(*level) for level in todo]).tolist(), strict=True))

    best = fit.unknowns.as_array()
    for factor in FACTORS:
        moved = True
        while moved:
            tried = []
            for i in range(3):
                for step in (factor, 1.0 / factor):
                    other = best.copy()
                    other[i] = min(max(other[i] * step, small[i]), large[i])
                    tried.append(other)
            likelihood([best, *tried])
            first = ties.best(tried, lambda level: known[tuple(level)], within=ties.GUESS)
            moved = known[tuple(first)] > known[tuple(best)] + 0.1
            best = first if moved else best
    now = fit.unknowns.as_array()
    for _ in range(HALVINGS):
        if np.allclose(best, now, rtol=1e-9):
            break
        other = with_unknowns(experiment, fit, Unknowns(*best))
        if other.log_likelihood > fit.log_likelihood:
            fit = other
            break
        best = np.sqrt(best * now)  # what is not linear there shows at the smaller unknowns
    if limits is None and len(with_update(fit.active, fit.theta)) and not np.allclose(
            fit.unknowns.as_array(), small, rtol=1e-9):
        # The map knows no memory (a line that rings): whether nothing is unknown says a run.
        least = with_unknowns(experiment, fit, Unknowns(*small))
        return ties.best((fit, least), lambda one: one.log_likelihood, within=ties.SAME_FIT)
    return fit


def settled(experiment: Experiment, fit: Fit, slopes: Slopes | None = None,
            worth: float = -np.inf) -> Fit:
    """Fit parameters and unknowns in turn until neither gains.

    A fit that is further below ``worth`` log units after a round than that round gained is not
    carried further: the next one gains less.
    """
    slopes, known = slopes or Slopes(experiment), None
    for _ in range(SETTLING):
        before = fit.log_likelihood
        made, known = polished_on(experiment, fit, slopes.of(fit) if known is None else known,
                                  ROUGH_STEPS, ROUGHLY)
        if not np.isfinite(made.log_likelihood):
            return made
        fit = at_level(experiment, made)
        if worth - fit.log_likelihood > fit.log_likelihood - before:
            return fit
        if fit is made:
            break
        known = None  # under other gains the slopes are others
    return polished_on(experiment, fit, slopes.of(fit) if known is None else known, 12, 0.3)[0]


def looked(experiment: Experiment, start: Fit, slopes: Slopes | None = None) -> Fit:
    """Return a model after a first look: a few steps, then the unknowns that it asks for.

    Large unknowns hide how far off a model still is.
    """
    made = polished(experiment, start, slopes or Slopes(experiment), QUICK, ROUGHLY)
    return at_level(experiment, made) if np.isfinite(made.log_likelihood) else made


def entered_at_best(experiment: Experiment, fit: Fit, what: tuple[Column, ...], ranked: Ranked
                    ) -> Fit:
    """Return the model of a ranked set at its linear guess, or a shorter way along it.

    What is far off does not act in proportion, and a guess may lie beyond it.
    """
    best = max((joined(experiment, fit, what, ranked, share) for share in SHARES),
               key=lambda one: one.log_likelihood)
    for share in SHORTER:
        if np.isfinite(best.log_likelihood):
            break
        best = joined(experiment, fit, what, ranked, share)
    return best


def from_each_start(what: tuple[Column, ...], ranked: Ranked) -> list[Ranked]:
    """Return a ranked set, and it with each other start of what enters where it starts.

    A size that is known to a factor (the length of a line) is not moved by the linear guess, so
    the guess does not say from which start a fit gets there.
    """
    found = [ranked]
    for member in ranked.members:
        if member.variant < 0 or not any(
                p.log for p in getattr(CATALOGUE.get(member.owner), "sizes", ())):
            continue
        others = {column.variant for column in what
                  if column.owner == member.owner and column.variant >= 0} - {member.variant}
        found += [replace(ranked, members=tuple(
            one._replace(variant=other) if one is member else one for one in ranked.members))
            for other in sorted(others)]
    return found


def joined(experiment: Experiment, fit: Fit, what: tuple[Column, ...], ranked: Ranked,
           share: float = 1.0) -> Fit:
    """Return the model of a ranked set under its level's gains, ``share`` of the way there."""
    theta, active = fit.theta.copy(), fit.active.copy()
    keep = {member.owner for member in ranked.members if member.variant < 0}
    gone = [name for name in fit.named if name not in keep]
    free = [f for f in fit.free if f.owner not in gone]
    for name in (name for name in gone if name in CATALOGUE):
        active[NAMES.index(name)] = False
    named = tuple(name for name in fit.named if name in keep)
    values: dict[str, float] = {}
    for place, amplitude in ranked.amplitudes.items():
        column, amplitude = what[place], share * amplitude
        if column.free is None:
            continue
        f = column.free
        if f.of_rig:  # twice, where it is wrong: both ways together
            step = f.spread if column.owner == ALWAYS else column.step
            theta[f.place] *= np.exp(np.clip(amplitude * step, -FARTHEST, FARTHEST))
        elif column.variant < 0:  # it is there, and moves
            now = f.inward(theta[f.place]) + amplitude * f.spread
            theta[f.place] = f.outward(now)
        elif own_sizes(column.start):
            values[column.name] = guess(column, amplitude)
    free = [f for f in free if not f.of_rig] + informed(experiment, what, ranked)
    for member in ranked.members:
        if member.variant < 0:
            continue
        if candidate(member.owner).key:
            named = (*named, member.owner)
            continue
        column = next(c for c in what if (c.owner, c.variant) == (member.owner, member.variant))
        start = column.start
        if start.replaces:
            # Its numbers were moved by the linear guess.
            start = sharing(start, effect_values(theta, start.replaces))
            free = [f for f in free if f.owner != start.replaces]
            named = tuple(name for name in named if name != start.replaces)
        theta, active = entered(theta, active, start)
        for name, value in values.items():
            if name.startswith(member.owner + "."):
                theta[place_of(name)] = value
        free = [f for f in free if f.owner != member.owner] + list(free_of(start))
        named = (*named, member.owner)
    keep_within(theta, named)
    for f in timing_free(experiment):  # what is named no more may err a little again
        if f.owner not in named and all(one.name != f.name for one in free):
            free.append(f)
            active[NAMES.index(f.owner)] = True
            theta[f.place] = f.outward(f.prior)
    fitted = {f.place for f in free}
    for place in BASE_KEYS:
        if place not in fitted:
            theta[place] = experiment.theta[place]
    for f in free:
        theta[f.place] = f.outward(f.inward(theta[f.place]))
    return remade(experiment, fit, theta=theta, active=active, free=tuple(free), named=named,
                  unknowns=ranked.gram.unknowns)


def informed(experiment: Experiment, what: tuple[Column, ...], ranked: Ranked) -> list[Free]:
    """Return the numbers of the rig that the recording says something of, or that are wrong.

    The others stay where the config has them: a number that nothing is known of is its prior's.
    """
    here = np.array(sorted(ranked.amplitudes), dtype=int)  # of an empty set too
    whole = ranked.gram.products[np.ix_(1 + here, 1 + here)] + np.eye(len(here))
    deviation = 1.0 / np.sqrt(np.diag(whole))
    own = {f.name: f for f in rig_free(experiment)}
    found = {}
    for place, sigma in zip(here, deviation, strict=True):
        column = what[place]
        if candidate(column.owner).key:
            found[column.name] = wide(own[column.name], experiment.policy)
        elif column.name in own and column.name not in found and (
                sigma < experiment.policy.informed or abs(ranked.amplitudes[int(place)]) > 1.0):
            found[column.name] = own[column.name]
    return list(found.values())


def wide(f: Free, policy: SearchPolicy) -> Free:
    """Return a number of the rig that may be wrong altogether.

    A path to the make-up source stays a part of the leakage: with a larger one the rest, across
    the piston, would flow from the lower pressure to the higher.
    """
    value = float(np.exp(f.prior))
    return replace(f, spread=min(policy.wrong * f.spread, float(np.log(WRONG_BY))),
                   lower=value / WRONG_BY,
                   upper=f.upper if f.symbol == MAKEUP else value * WRONG_BY)


def guess(column: Column, amplitude: float) -> float:
    """Return where a size enters, SI: the linear guess, but no nearer to nothing than visible."""
    values = dict(column.start.values)
    p = next(p for p in CATALOGUE[column.owner].parameters if p.name == column.free.symbol)
    start = values[p.name]
    if p.log or not np.isfinite(p.neutral):
        return start
    value = placed(column, amplitude)
    least = p.neutral + LEAST_SHARE * (start - p.neutral)
    if p.lower >= 0 and abs(value - p.neutral) < abs(least - p.neutral):
        value = least
    if column.start.among > 1 and p.unit in ("s", "m"):  # a shift is linear near itself only
        value = min(value, 3.0 * start)
    return float(min(max(value, p.lower), p.upper))


def evidence_of(fit: Fit) -> float:
    """Return Laplace's evidence of a fitted set, without its prior odds, log units.

    Comparable with :class:`Ranked`: both are of innovations with their own scale.
    """
    likelihood = fit.log_likelihood - 0.5 * fit.e.size
    spreads = np.array([f.spread for f in fit.free])
    sign, logdet = np.linalg.slogdet(fit.covariance / np.outer(spreads, spreads))
    return float(likelihood + (0.5 * logdet if sign > 0 else -np.inf))


def discrepancy(experiment: Experiment, fit: Fit) -> float:
    """Return what a model's unknowns cost, log units: 0 where it needs next to none.

    The innovations that its filter expects are larger than those of the same model without
    unknowns; N/2 log det of their ratio is what a right model would gain.
    """
    found = []
    for level in (fit.unknowns, limits_of(experiment)[0]):
        gains = gains_of(experiment, fit.theta, fit.active, level)
        s = expected_covariance(experiment, fit.theta, fit.active, level, gains)
        found.append(np.linalg.slogdet(s)[1])
    return float(0.5 * len(fit.e) * (found[0] - found[1]))


def impossible(fit: Fit, sure: float) -> bool:
    """Tell whether a fit stands on something that cannot be: B or a stiffness at its bound.

    It does where the recording says so: one that hardly shows B stands there by chance, with the
    config's own value within ``sure`` standard deviations.
    """
    deviations = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    return any(not f.owner and f.at_bound(value := fit.theta[f.place])
               and not abs(f.inward(value) - f.prior) <= sure * deviation
               for f, deviation in zip(fit.free, deviations, strict=True))
