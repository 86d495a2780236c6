"""Search for the effects that a record supports: screen all, refit the best, add, prune."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.mismatch.experiment import Experiment
from eha_monitor.mismatch.fit import (
    Fit,
    Free,
    refine,
    spread,
    tune,
    with_unknowns,
)
from eha_monitor.mismatch.gains import Unknowns, gains_of, smallest_unknowns
from eha_monitor.mismatch.innovations import FORCED
from eha_monitor.mismatch.screen import (
    Score,
    Start,
    entered,
    free_of,
    possible,
    screen,
    starts_of,
)
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of

LARGEST_UNKNOWN = 3e4  # times the smallest: three times what the record covers
MOST_EFFECTS = 4
SHORTLIST = 8  # effects that are refitted in each round
THRESHOLD = 12.0  # log units, where no calibration is at hand


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


@dataclass(frozen=True)
class Round:
    """One round of the search: what was screened, what was refitted, what was taken."""

    before: Fit
    scores: tuple[Score, ...]
    candidates: tuple[Candidate, ...]
    taken: str


def base_free(experiment: Experiment) -> tuple[Free, ...]:
    """Return the base parameters that this experiment's input mode can tell."""
    one, two = experiment.settings.stage_one, experiment.settings.stage_two
    rig = experiment.settings.rig
    scale = max(one.prior_stddev, one.prior, rig.viscous_damping)
    found = [Free("B", s.B, -1e3 * scale, 1e5 * scale, one.prior, 10.0 * scale)]
    if experiment.mode != FORCED:
        found.append(Free("beta_e", s.BETA_E, 1e5, 1e12, float(np.log(two.prior)), 3.0, True))
    return tuple(found)


def limits_of(experiment: Experiment) -> tuple[Unknowns, Unknowns]:
    """Return the smallest and the largest unknowns that are tried."""
    small = smallest_unknowns(experiment).as_array()
    large = LARGEST_UNKNOWN * small
    if experiment.mode == FORCED:
        large[1:] = small[1:]
    elif experiment.mode != 0 or not experiment.used[4]:
        large[2] = small[2]  # without a measured speed it is the same as an unknown flow
    return Unknowns(*small), Unknowns(*large)


def settle(experiment: Experiment, fit: Fit, rounds: int = 2, steps: int = 6) -> Fit:
    """Fit parameters and unknowns in turn, gains renewed at each turn."""
    small, large = limits_of(experiment)
    fit = refine(experiment, with_unknowns(experiment, fit, fit.unknowns), steps)
    for i in range(rounds):
        before = fit.log_likelihood
        fit = tune(experiment, fit, small, large, (10.0, 3.0) if i == 0 else (3.0,))
        fit = refine(experiment, with_unknowns(experiment, fit, fit.unknowns), steps)
        if fit.log_likelihood < before + 1.0:
            break
    return fit


def first_fit(experiment: Experiment) -> Fit:
    """Fit the nominal model: B and beta_e, and the unknowns that it needs."""
    theta = experiment.theta.copy()
    free = base_free(experiment)
    for f in free:
        theta[f.place] = f.outward(f.prior)
    small, _ = limits_of(experiment)
    middle = Unknowns(*(300.0 * small.as_array()))
    empty = np.zeros((len(free), len(free)))
    fit = Fit(theta, experiment.active, free, middle,
              gains_of(experiment, theta, experiment.active, middle), np.zeros((0, 0)),
              np.zeros((0, 0)), -np.inf, empty)
    return settle(experiment, fit)


def named_in(fit: Fit, experiment: Experiment) -> list[str]:
    """Return the effects that the fit has beyond the config's."""
    return [name for i, name in enumerate(NAMES) if fit.active[i] and not experiment.active[i]]


def with_effect(fit: Fit, start: Start, amplitudes: tuple[float, ...]) -> Fit:
    """Return a fit with an effect entered at a multiple of its start, not yet refitted."""
    effect = CATALOGUE[start.effect]
    values = dict(start.values)
    sizes = [p for p in effect.sizes if values[p.name] != p.neutral]
    for p, a in zip(sizes, amplitudes, strict=True):
        if np.isfinite(p.neutral):
            value = a * values[p.name]
            if p.lower >= 0:
                value = max(value, 0.05 * values[p.name])
            values[p.name] = min(max(value, p.lower), p.upper)
    placed = replace(start, values=tuple(values.items()))
    theta, active = entered(fit.theta, fit.active, placed)
    free = tuple(f for f in fit.free if not (
        start.replaces and f.name.startswith(start.replaces + ".")))
    return replace(fit, theta=theta, active=active, free=free + free_of(start))


def without_effect(fit: Fit, name: str) -> Fit:
    """Return a fit with an effect taken out, not yet refitted."""
    active = fit.active.copy()
    active[NAMES.index(name)] = False
    theta = fit.theta.copy()
    for p in CATALOGUE[name].parameters:
        theta[place_of(f"{name}.{p.name}")] = 0.0
    return replace(fit, theta=theta, active=active,
                   free=tuple(f for f in fit.free if not f.name.startswith(name + ".")))


def refit(experiment: Experiment, fit: Fit, score: Score) -> Fit:
    """Enter a screened effect and fit everything anew."""
    return settle(experiment, with_effect(fit, score.start, score.amplitudes))


def round_of(experiment: Experiment, fit: Fit, report: Callable[[str], None] | None = None,
             exclude: tuple[str, ...] = ()) -> tuple[Fit, list[Score], list[Candidate]]:
    """Screen the catalogue at a fit and refit the best; candidates best first."""
    present = [name for i, name in enumerate(NAMES) if fit.active[i]]
    starts = [start for name in NAMES if name not in present and name not in exclude
              and possible(name, experiment) for start in starts_of(name, experiment)]
    scores = screen(experiment, fit, starts)
    chosen: dict[str, list[Score]] = {}
    for score in scores:
        if score.gain < 2.0:
            continue
        if score.start.effect not in chosen and len(chosen) >= SHORTLIST:
            continue
        kept = chosen.setdefault(score.start.effect, [])
        if len(kept) < 2:
            kept.append(score)
    flat = [score for kept in chosen.values() for score in kept]
    fits = spread(lambda score: refit(experiment, fit, score), flat)
    found = [Candidate(score.start, other, other.log_likelihood - fit.log_likelihood)
             for score, other in zip(flat, fits, strict=True)]
    best: dict[str, Candidate] = {}
    for candidate in found:
        if (candidate.effect not in best
                or candidate.gain > best[candidate.effect].gain):
            best[candidate.effect] = candidate
    return fit, scores, sorted(best.values(), key=lambda c: -c.gain)
