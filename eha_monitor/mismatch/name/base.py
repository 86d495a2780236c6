"""Search for the effects that a record supports: screen all, refit the best, add, prune."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment, resolving
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.fit import (
    Fit,
    Free,
    refine,
    spread,
    tune,
    with_unknowns,
)
from eha_monitor.mismatch.likelihood.gains import Unknowns, gains_of, smallest_unknowns
from eha_monitor.mismatch.name.starts import (
    Score,
    Start,
    entered,
    free_of,
    own_sizes,
    possible,
    screen,
    starts_of,
)
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import effect_values, place_of

PROMISE = 0.1  # of the best score: what an effect must score to be refitted
SHORTLIST = 8  # effects that are refitted in each round
LIKELY = 0.4  # of the demanded gain
STIFF, YIELDING = 30.0, 300.0  # times the smallest unknowns
STRAYED = 0.7  # of the logarithm: B or beta_e is off its prior by a factor of two
FINALISTS, WORTH = 3, 0.6  # how many are fitted to the end, and what share of the best they have
OUTRUN = 0.3  # of the best: what gained less on the first way is not tried on the second
AFAR = 2  # how many more that start at the priors
LEAST_SHARE, LEAST_OF_MANY = 0.05, 0.3  # of its start: where a size enters at least
THRESHOLD = 12.0  # log units, where no calibration is at hand
OUT_OF_BAND = (".v_e", ".z_0", ".t_1", ".v_d", ".dB")  # and dB: :func:`screen.starts_of`
TIMING = 0.05  # samples: timing errors up to here need no name


@dataclass(frozen=True)
class Candidate:
    """An effect that was refitted beside the named ones.

    ``gain`` in log units over the model without it; ``fit`` the refitted model.
    """

    start: Start
    fit: Fit
    gain: float

    @property
    def effect(self) -> str:
        """Name of the effect."""
        return self.start.effect


def candidate_of(start: Start, before: Fit, after: Fit) -> Candidate:
    """Return a refitted model as a candidate, with what it gained over ``before``."""
    return Candidate(start, after, after.log_likelihood - before.log_likelihood)


@dataclass(frozen=True)
class Round:
    """One round of the search: what was screened, what was refitted, what was taken."""

    before: Fit
    scores: tuple[Score, ...]
    candidates: tuple[Candidate, ...]


def base_free(experiment: Experiment) -> tuple[Free, ...]:
    """Return the base parameters that this experiment's input mode can tell."""
    one, two = experiment.settings.stage_one, experiment.settings.stage_two
    rig = experiment.settings.rig
    scale = max(one.prior_stddev, one.prior, rig.viscous_damping)
    # Beside dry and quadratic friction at one speed nothing but this keeps B off a negative value.
    lowest = 0.01 * one.prior if experiment.inverse else -1e3 * scale
    found = [Free("B", s.B, lowest, 1e5 * scale, one.prior, 10.0 * scale)]
    if experiment.mode != FORCED:
        found.append(Free("beta_e", s.BETA_E, 1e5, 1e12, float(np.log(two.prior)), 3.0, True))
    return tuple(found)


def timing_free(experiment: Experiment) -> tuple[Free, ...]:
    """Return the small timing errors that every record has, each at most ``TIMING`` samples.

    Sensors lag by some microseconds and stamps jitter; with 24 000 samples a delay of 2 % of a
    sample is beyond doubt, and is nobody's fault.  What is larger must be named.
    """
    if experiment.inverse:  # far below the band of the balances
        return ()
    limit = TIMING * experiment.dt
    found = []
    for name in ("command_delay", "position_delay", "pressure_delay"):
        if possible(name, experiment) and not experiment.active[NAMES.index(name)]:
            # A pump speed that is read late looks like a late command and an early position.
            lower = -limit if name == "position_delay" else 0.0
            found.append(Free(f"{name}.T", place_of(f"{name}.T"), lower, limit, 0.0, limit))
    return tuple(found)


def limits_of(experiment: Experiment) -> tuple[Unknowns, Unknowns]:
    """Return the smallest and the largest unknowns that are tried."""
    small = smallest_unknowns(experiment).as_array()
    large = experiment.largest_unknown * small
    if experiment.mode == FORCED:
        large[1:] = small[1:]
    elif experiment.mode != CLOSED or not experiment.used[4]:
        large[2] = small[2]  # without a measured speed it is the same as an unknown flow
    return Unknowns(*small), Unknowns(*large)


def settle(experiment: Experiment, fit: Fit, rounds: int = 2, steps: int = 6,
           upward: bool = True, tolerance: float = 0.02) -> Fit:
    """Fit parameters and unknowns in turn, gains renewed at each turn."""
    if experiment.inverse:
        # One fit does: nothing is tuned in turn.  The seals' shapes act over micrometres and
        # milliseconds, outside the band of the balances.
        fit = replace(fit, free=tuple(f for f in fit.free if not f.name.endswith(OUT_OF_BAND)))
        return refine(experiment, fit, 2 * steps, tolerance)
    small, large = limits_of(experiment)
    fit = refine(experiment, with_unknowns(experiment, fit, fit.unknowns), steps, tolerance)
    for i in range(rounds):
        before = fit.log_likelihood
        fit = tune(experiment, fit, small, large, (10.0, 3.0) if i == 0 else (3.0,), upward)
        fit = refine(experiment, with_unknowns(experiment, fit, fit.unknowns), steps, tolerance)
        if fit.log_likelihood < before + 1.0:
            break
    return fit


def first_fit(experiment: Experiment) -> Fit:
    """Fit the nominal model: B and beta_e, and the unknowns that it needs."""
    theta, active = experiment.theta.copy(), experiment.active.copy()
    free = base_free(experiment) + timing_free(experiment)
    for f in free:
        theta[f.place] = f.outward(f.prior)
        effect, dot, _ = f.name.partition(".")
        if dot:
            active[NAMES.index(effect)] = True
    small = limits_of(experiment)[0].as_array()
    empty = np.zeros((len(free), len(free)))

    def started(factor: float, nominal: bool) -> Fit:
        begin = theta.copy()
        if nominal:
            begin[s.B], begin[s.BETA_E] = experiment.theta[s.B], experiment.theta[s.BETA_E]
        unknowns = Unknowns(*(factor * small))
        fit = Fit(begin, active, free, unknowns, gains_of(experiment, begin, active, unknowns),
                  np.zeros((0, 0)), np.zeros((0, 0)), -np.inf, empty)
        return settle(experiment, fit)

    # Where the oil column rings the likelihood has many peaks; a stiff and a yielding filter,
    # from the config's values and from the priors, do not fall into the same wrong one.
    fits = spread(lambda start: started(*start), ((YIELDING, False), (STIFF, True)))
    return max(fits, key=lambda fit: fit.log_likelihood)


def nominal(experiment: Experiment) -> tuple[Experiment, Fit]:
    """Fit the nominal model; returns the experiment with steps that resolve the B it finds."""
    while True:
        fit = first_fit(experiment)
        finer = experiment if experiment.inverse else resolving(experiment, fit.theta[s.B])
        if finer.steps == experiment.steps:
            return experiment, fit
        experiment = finer


def with_effect(fit: Fit, start: Start, amplitudes: tuple[float, ...],
                whole: bool = True) -> Fit:
    """Return a fit with an effect entered at a multiple of its start, not yet refitted.

    ``whole`` False leaves the ``late`` shapes where they start: enough for a ranking.
    """
    values = dict(start.values)
    # Of several starts each stands for its surroundings; the linear guess leads out of them.
    least = LEAST_OF_MANY if start.among > 1 else LEAST_SHARE
    for p, a in zip(own_sizes(start), amplitudes, strict=False):
        if np.isfinite(p.neutral):
            value = a * values[p.name]
            if p.lower >= 0:
                value = max(value, least * values[p.name])
            if start.among > 1 and p.unit in ("s", "m"):  # a shift is linear near itself only
                value = min(value, values[p.name] / LEAST_OF_MANY)
            values[p.name] = min(max(value, p.lower), p.upper)
    placed = replace(start, values=tuple(values.items()))
    theta, active = entered(fit.theta, fit.active, placed)
    gone = (start.replaces + "." if start.replaces else None, start.effect + ".")
    free = tuple(f for f in fit.free if not any(g and f.name.startswith(g) for g in gone))
    named = (*(name for name in fit.named if name != start.replaces), start.effect)
    return replace(fit, theta=theta, active=active, free=free + free_of(start, whole), named=named)


def without_effect(experiment: Experiment, fit: Fit, name: str) -> Fit:
    """Return a fit with an effect taken out, not yet refitted."""
    timing = tuple(f for f in timing_free(experiment) if f.name.startswith(name + "."))
    active, theta = fit.active.copy(), fit.theta.copy()
    active[NAMES.index(name)] = bool(timing)
    for p in CATALOGUE[name].parameters:
        theta[place_of(f"{name}.{p.name}")] = 0.0
    free = tuple(f for f in fit.free if not f.name.startswith(name + ".")) + timing
    return replace(fit, theta=theta, active=active, free=free,
                   named=tuple(other for other in fit.named if other != name))


def replacements_of(experiment: Experiment, fit: Fit) -> list[Start]:
    """Return starts of effects that contain a named one, or share what it contains.

    They begin where the named one stands, so that only what they add is judged.
    """
    found = []
    for name in fit.named:
        family = {name, *CATALOGUE[name].contains}
        for other in NAMES:
            if other in fit.named or not family & {other, *CATALOGUE[other].contains}:
                continue
            bounds = {p.name: p for p in CATALOGUE[other].parameters}
            for start in starts_of(other, experiment):
                values = dict(start.values)
                for key, now in effect_values(fit.theta, name).items():
                    # What both have starts where it stands.
                    if key in values and bounds[key].lower <= now <= bounds[key].upper:
                        values[key] = now
                found.append(replace(start, values=tuple(values.items()), replaces=name))
    return found


def round_of(experiment: Experiment, fit: Fit, demanded: Callable[[str], float] | None = None
             ) -> Round:
    """Screen the catalogue at a fit and refit the best; candidates best first.

    Of effects that contain one another the simplest enters by itself (:func:`enters_alone`); the
    others may take its place in a later round.  Where the balances' own errors are compared all
    enter: a friction that differs by direction may be nothing at all on average.

    Parameters
    ----------
    demanded : log units that an effect must gain to be named; what scores far below is not
        refitted.
    """
    families = {member for name in fit.named for member in (name, *CATALOGUE[name].contains)}
    starts = [start for name in NAMES
              if (experiment.inverse or enters_alone(name)) and name not in families
              and not experiment.active[NAMES.index(name)] and possible(name, experiment)
              for start in starts_of(name, experiment)]
    starts += replacements_of(experiment, fit)
    scores = screen(experiment, fit, starts)

    def least(name: str) -> float:
        wanted = LIKELY * demanded(name) if demanded is not None else 0.0
        return max(2.0, PROMISE * scores[0].gain, wanted) if scores else np.inf

    promising = shortlist([score for score in scores if score.gain >= least(score.start.effect)],
                          SHORTLIST)

    def tried(task: tuple[Fit, Score]) -> Candidate:
        base, score = task
        entered_fit = with_effect(base, score.start, score.amplitudes, False)
        astray = base is not fit
        return candidate_of(score.start, fit, settle(
            experiment, entered_fit, 1, 4 if astray else 2, astray, 1.0))

    quick: list[Candidate] = []
    far: list[Candidate] = []
    enough = np.inf if experiment.inverse else expected_likelihood(experiment, fit)

    def reached() -> bool:
        return any(c.fit.log_likelihood >= enough for c in quick)

    for base in ways_of(experiment, fit):
        if reached():
            break  # nothing is left that another way could show
        if base is fit:
            quick += spread(tried, [(fit, score) for score in promising
                                    if not outrun(score.start.effect, quick)])
        else:
            own = shortlist(screen(experiment, base, starts), FINALISTS)
            known = {score.start for score in own}
            far = spread(tried, [(base, score) for score in (
                *own, *(score for score in promising if score.start not in known))])
            quick += far
    ranked = best_of_each(quick)
    # What is far behind after a few steps does not catch up: only the front runners go on, and
    # two of those that came from elsewhere, which have the longer way.
    front = [c for c in ranked if c.gain > WORTH * ranked[0].gain][:FINALISTS]
    ahead = {c.effect for c in front}
    afar = [c for c in best_of_each(far) if c.effect not in ahead][:0 if reached() else AFAR]
    final = spread(lambda c: candidate_of(c.start, fit, settle(
        experiment, c.fit, 2, *((4, False) if c.effect in ahead else (6, True)), 1.0)),
        [*front, *afar])
    ranked = best_of_each([*final, *ranked])
    return Round(fit, tuple(scores), tuple(ranked))


def outrun(effect: str, tried: list[Candidate]) -> bool:
    """Tell whether an effect found its way in the first attempt and is far behind the best."""
    gains = {c.effect: c.gain for c in best_of_each(tried)}
    return 0.0 < gains.get(effect, 0.0) < OUTRUN * max(gains.values(), default=0.0)


def ways_of(experiment: Experiment, fit: Fit) -> list[Fit]:
    """Return the fits from which the effects of a round are tried, in turn.

    A wrong model needs unknowns that take most of what the right effect would show, and can carry
    B and beta_e so far that it points the wrong way there, and does not find back.  With small
    unknowns the filter leans on the model, and what the model lacks shows at its full size.
    """
    if experiment.largest_unknown <= YIELDING:  # it leans already
        return [fit]
    near = near_prior(fit)
    if yielding(experiment, fit):
        return [stiffened(experiment, fit if near else from_prior(fit)), fit]
    return [fit] if near else [fit, stiffened(experiment, from_prior(fit))]


def expected_likelihood(experiment: Experiment, fit: Fit) -> float:
    """Return the likelihood of a right model, whose innovations are the sensors' noise."""
    return float(-np.sum(np.log(experiment.noise[experiment.columns])
                         * np.isfinite(fit.e).sum(axis=0)))


def best_of_each(candidates: list[Candidate]) -> list[Candidate]:
    """Return the best candidate of each effect, best first."""
    best: dict[str, Candidate] = {}
    for candidate in candidates:
        if np.isfinite(candidate.gain) and (candidate.effect not in best
                                            or candidate.gain > best[candidate.effect].gain):
            best[candidate.effect] = candidate
    return sorted(best.values(), key=lambda c: -c.gain)


def stiffened(experiment: Experiment, fit: Fit) -> Fit:
    """Return a fit whose filter leans on the model: little may stay unknown."""
    small, large = (limit.as_array() for limit in limits_of(experiment))
    return with_unknowns(experiment, fit, Unknowns(*np.minimum(STIFF * small, large)))


def yielding(experiment: Experiment, fit: Fit) -> bool:
    """Tell whether a fit's unknowns are so large that they take what an effect would show."""
    if experiment.inverse:
        return False
    small = limits_of(experiment)[0].as_array()
    return bool((fit.unknowns.as_array() > STIFF * small).any())


def enters_alone(name: str) -> bool:
    """Tell whether an effect is a first guess: those with more sizes than what they contain wait.

    Each is then judged by what it adds, when it takes the place of the simpler one.
    """
    return not CATALOGUE[name].contains or len(CATALOGUE[name].sizes) == 1


def shortlist(scores: list[Score], most: int) -> list[Score]:
    """Return the two best starts of each of the ``most`` best effects; scores are best first."""
    chosen: dict[str, list[Score]] = {}
    for score in scores:
        name = score.start.effect
        if name in chosen or len(chosen) < most:
            kept = chosen.setdefault(name, [])
            if len(kept) < 2:
                kept.append(score)
    return [score for kept in chosen.values() for score in kept]


def near_prior(fit: Fit) -> bool:
    """Tell whether B and beta_e lie near their priors."""
    base = [f for f in fit.free if "." not in f.name]
    values = [fit.theta[f.place] for f in base]
    prior = [f.outward(f.prior) for f in base]
    return all(value > 0 and abs(np.log(value / p)) < STRAYED
               for value, p in zip(values, prior, strict=True))


def from_prior(fit: Fit) -> Fit:
    """Return a fit with B and beta_e at their priors, for a new effect to start from."""
    theta = fit.theta.copy()
    for f in fit.free:
        if "." not in f.name:
            theta[f.place] = f.outward(f.prior)
    return replace(fit, theta=theta)


def completed(fit: Fit) -> Fit:
    """Return a fit in which the late shapes of the named effects are free too."""
    have = {f.name for f in fit.free}
    found = []
    for name in fit.named:
        start = Start(name, tuple(effect_values(fit.theta, name).items()))
        found += [f for f in free_of(start) if f.name not in have]
    return replace(fit, free=fit.free + tuple(found))
