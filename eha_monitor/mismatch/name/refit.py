"""A fit carried to its optimum with few runs of the filter; a set refitted to the end."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment, damping_steps
from eha_monitor.mismatch.likelihood.fit import (
    Fit,
    Free,
    covariance_of,
    innovations,
    likeliest,
    log_likelihood_of,
    prior_exponent,
    remade,
    sensitivities,
    step_of,
    step_within,
    whitener,
    with_unknowns,
)
from eha_monitor.mismatch.likelihood.gains import Unknowns, expected_covariance, gains_of
from eha_monitor.mismatch.likelihood.invariance import PRESSURE, SCALES, at_prior
from eha_monitor.mismatch.name.candidates import candidate
from eha_monitor.mismatch.name.columns import (
    ALWAYS,
    MAKEUP,
    Column,
    Columns,
    placed,
    rig_free,
    runs_of,
)
from eha_monitor.mismatch.name.gram import evidences_at, under
from eha_monitor.mismatch.name.rank import Ranked
from eha_monitor.mismatch.name.starts import (
    LEAST_SHARE,
    always_free,
    base_free,
    entered,
    free_of,
    limits_of,
    own_sizes,
    sharing,
    stand_again,
)
from eha_monitor.mismatch.policy import SearchPolicy
from eha_monitor.physics.contributions import with_place, with_update
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import BASE_KEYS, effect_values, place_of
from eha_monitor.physics.signals import B, M

# Of a step: shorter first, because inside a threshold the direction is right and the length not.
SHORTENED = (1.0, 0.3, 0.1, 0.03)
COARSER = 3.0  # times the integration step, for differences
LARGEST = 1e100  # slope of an innovation that is a slope; its square must still be a number
ROUGHLY = 5.0  # log units: a tolerance at which slopes are not taken afresh
DAMPED, MOST_DAMPED = 1e-2, 1e2  # of the information: where a step has failed, and at most


def coarse(experiment: Experiment, active: np.ndarray) -> Experiment:
    """Return the experiment with integration steps that do for differences.

    A slope that is one per cent off leads to the same optimum; the innovations themselves are
    taken with the fine steps.  A seal turns over within such a step: it keeps the fine ones.
    """
    if len(with_place(active)):
        return experiment
    least = damping_steps(experiment.settings, 2.0 * experiment.theta[B], experiment.dt)
    steps = max(int(np.ceil(experiment.steps / COARSER)), int(np.ceil(0.75 * least)), 1)
    return replace(experiment, steps=min(steps, experiment.steps))


def keep_within(theta: np.ndarray, named: Sequence[str]) -> None:
    """Write laws within their limits: |dF| <= F_c.

    Beyond, a law is cut off: friction of F_c + dF in positive motion and of F_c - dF < 0 in
    negative motion is one of F_c + dF and of none.  Written as such, with the same sum and F_c =
    dF, it does the same, but a step leads back.
    """
    for name in named:
        for part, whole in CATALOGUE[name].within if name in CATALOGUE else ():
            at, of = place_of(f"{name}.{part}"), place_of(f"{name}.{whole}")
            if abs(theta[at]) > theta[of]:
                half = 0.5 * (abs(theta[at]) + theta[of])
                theta[at], theta[of] = np.copysign(half, theta[at]), half


class Slopes:
    """Slopes of the innovations that are at hand from a linearisation, under any gains."""

    def __init__(self, experiment: Experiment, fit: Fit | None = None,
                 columns: Columns | None = None):
        self.experiment, self.fit = experiment, fit
        self.places: dict[str, int] = {}
        self.spreads: list[float] = []
        own = []
        for i, column in enumerate(columns.what if columns else ()):
            if column.name in self.places:  # a number that is wrong stands there twice
                continue
            if column.free is not None and (column.owner == ALWAYS or column.variant < 0):
                self.places[column.name] = len(own)
                self.spreads.append(column.free.spread)
                own.append(1 + i)
        # These alone: all columns of a minute take a hundred megabytes.
        self.values = [part[:, :, own] for part in (columns.values if columns else ())]

    def of(self, fit: Fit) -> dict[str, np.ndarray]:
        """Return name -> (N, c) slope in the fitted coordinate, of what is known."""
        wanted = [f for f in fit.free if f.name in self.places]
        if not wanted:
            return {}
        places = [self.places[f.name] for f in wanted]
        parts = under(self.experiment, self.fit, [
            np.ascontiguousarray(part[:, :, places]) for part in self.values], fit.gains)
        whole = self.experiment.counted(parts)
        usable = np.abs(whole).max(axis=(0, 1)) < LARGEST  # nor is NaN
        return {f.name: whole[:, :, i] / self.spreads[self.places[f.name]]
                for i, f in enumerate(wanted) if usable[i]}


def polished(experiment: Experiment, fit: Fit, slopes: Slopes, steps: int = 12,
             tolerance: float = 0.3) -> Fit:
    """Carry a fit to its optimum with held gains: Gauss-Newton, slopes brought up to date.

    Slopes come from the linearisation where it has them, else from differences; each step then
    corrects them by what it has seen (Broyden 1965), in the metric of the information.  They are
    taken afresh where a step fails.
    """
    return polished_on(experiment, fit, slopes.of(fit), steps, tolerance)[0]


def polished_on(experiment: Experiment, fit: Fit, known: dict[str, np.ndarray], steps: int,
                tolerance: float) -> tuple[Fit, dict[str, np.ndarray]]:
    """Return :func:`polished` from slopes that are known, name -> (N, c), and those at its end."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a run may go astray
        return _polished(experiment, fit, known, steps, tolerance)


def _polished(experiment: Experiment, fit: Fit, known: dict[str, np.ndarray], steps: int,
              tolerance: float) -> tuple[Fit, dict[str, np.ndarray]]:
    theta, free = fit.theta.copy(), fit.free
    e = innovations(experiment, theta, fit.active, fit.gains)
    best = log_likelihood_of(e) + prior_exponent(free, theta)
    if not np.isfinite(best):
        return replace(fit, e=e, log_likelihood=-np.inf), {}
    bounds = np.array([[f.inward(f.lower), f.inward(f.upper)] for f in free]).reshape(-1, 2)
    prior, weight = np.array([f.prior for f in free]), np.array([f.spread for f in free]) ** -2.0
    rough = coarse(experiment, fit.active)

    def taken(which: list[int]) -> None:
        if not which:
            return
        plain = innovations(rough, theta, fit.active, fit.gains)
        fresh = sensitivities(rough, fit.active, fit.gains, plain,
                              [step_of(free[i], theta, experiment.log_step) for i in which])
        for i, slope in zip(which, fresh, strict=True):
            d[i] = np.nan_to_num(slope)

    d = np.stack([known.get(f.name, np.zeros(e.shape)) for f in free])
    taken([i for i, f in enumerate(free) if f.name not in known])
    every = list(range(len(free)))
    fresh, damping, converged, left = not known, 1e-9, False, 1 if tolerance >= ROUGHLY else steps
    white = information = None
    for _ in range(steps):
        w = whitener(covariance_of(e))
        white = (np.nan_to_num(e) @ w.T).ravel()
        flat = (d @ w.T).reshape(len(free), -1)
        information = flat @ flat.T
        now = np.array([f.inward(theta[f.place]) for f in free])
        gradient = -(flat @ white) - weight * (now - prior)
        scale = np.sqrt(np.diag(information) + weight)
        matrix = (information + np.diag(weight)) / np.outer(scale, scale)
        if not np.isfinite(matrix).all():
            return replace(fit, log_likelihood=-np.inf), {}
        whole = step_within(matrix + damping * np.eye(len(free)), gradient / scale,
                            scale[:, None] * (bounds - now[:, None])) / scale
        improved = False
        for share in SHORTENED:
            step = share * whole
            other = theta.copy()
            for f, value in zip(free, now + step, strict=True):
                other[f.place] = f.outward(value)
            keep_within(other, fit.named)
            moved = innovations(experiment, other, fit.active, fit.gains)
            reached = log_likelihood_of(moved) + prior_exponent(free, other)
            if reached > best:
                improved = True
                break
        if not improved:
            scaled = scale * whole
            promised = float(gradient @ whole - 0.5 * scaled @ matrix @ scaled)
            if promised < tolerance or damping >= MOST_DAMPED or not (fresh or left):
                converged = promised < tolerance
                break
            if not fresh:
                taken(every)
                fresh, left, damping = True, left - 1, 1e-9
            else:  # the direction is not to be trusted either: towards the gradient's (Levenberg)
                damping = max(10.0 * damping, DAMPED)
            continue
        step = np.array([f.inward(other[f.place]) for f in free]) - now
        missed = np.nan_to_num(moved - e) - np.tensordot(step, d, axes=1)
        metric = scale**2 * step
        d += (metric / max(float(metric @ step), 1e-300))[:, None, None] * missed[None]
        gained, theta, e, best = reached - best, other, moved, reached
        damping = max(damping / 10.0, 1e-9)
        if gained < tolerance:
            if fresh or tolerance >= ROUGHLY:
                converged = True
                break
            taken(every)
            fresh = True
        else:  # near the optimum a step leaves fresh slopes as good as fresh
            fresh = fresh and gained < ROUGHLY
    # Where no recording can tell, what is known beforehand decides, and no slope's last digit.
    for other in at_prior(free, theta, fit.active):
        moved = innovations(experiment, other, fit.active, fit.gains)
        reached = log_likelihood_of(moved) + prior_exponent(free, other)
        if reached > best:
            theta, e, best = other, moved, reached
    covariance = fit.covariance
    if information is not None:
        try:  # in units of each parameter's own deviation: a leakage is 1e-12, a modulus 1e9
            covariance = np.linalg.inv((information + np.diag(weight)) / np.outer(
                scale, scale)) / np.outer(scale, scale)
        except np.linalg.LinAlgError:  # two parameters are one there: no model to be judged
            return replace(fit, e=e, log_likelihood=-np.inf), {}
    made = replace(fit, theta=theta, e=e, s=covariance_of(e), log_likelihood=best,
                   covariance=covariance, converged=converged)
    return made, {f.name: slope for f, slope in zip(free, d, strict=True)}


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
    free = (*base_free(experiment), *always_free(experiment))
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
        return likeliest((fit, least), ties.SAME_FIT)
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
        fit = at_likeliest_kilogram(experiment, fit)
        if worth - fit.log_likelihood > fit.log_likelihood - before:
            return fit
        if fit is made:
            break
        known = None  # under other gains the slopes are others
    return polished_on(experiment, fit, slopes.of(fit) if known is None else known, 12, 0.3)[0]


def at_likeliest_kilogram(experiment: Experiment, fit: Fit) -> Fit:
    """Return a fit where the priors are likeliest of all that both sensors' scales make up for.

    The gains are other ones there, so no step with held gains goes that way.
    """
    if not fit.active[SCALES]:
        return fit
    here = with_unknowns(experiment, fit)  # with gains of its own, as the others have
    best = likeliest([here, *(with_unknowns(
        experiment, replace(fit, theta=other), replace(
            fit.unknowns, force=fit.unknowns.force * other[M] / fit.theta[M]))
        for other in at_prior(fit.free, fit.theta, fit.active, [PRESSURE]))], ties.SAME_FIT)
    return fit if best is here else best


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
    stand_again(experiment, theta, active, free, named)
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
