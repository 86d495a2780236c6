"""What every model fits, the limits of its unknowns, and effects put in and taken out."""

from dataclasses import replace

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.fit import Fit, Free
from eha_monitor.mismatch.likelihood.gains import Unknowns, smallest_unknowns
from eha_monitor.mismatch.name.starts import Start, entered, free_of, own_sizes, possible
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of

LEAST_SHARE, LEAST_OF_MANY = 0.05, 0.3  # of its start: where a size enters at least
LEAST_B = 1e-3  # of its prior: below, there is no viscous damping


def base_free(experiment: Experiment) -> tuple[Free, ...]:
    """Return the base parameters that this experiment's input mode can tell."""
    one, two = experiment.settings.stage_one, experiment.settings.stage_two
    rig = experiment.settings.rig
    scale = max(one.prior_stddev, one.prior, rig.viscous_damping)
    # A damping is positive.  Beside dry and quadratic friction nothing else keeps it so.
    lowest = LEAST_B * one.prior
    found = [Free("B", s.B, lowest, 1e5 * scale, one.prior, 10.0 * scale)]
    if experiment.mode != FORCED:
        found.append(Free("beta_e", s.BETA_E, 1e5, 1e12, float(np.log(two.prior)), 3.0, True))
    return tuple(found)


def timing_free(experiment: Experiment) -> tuple[Free, ...]:
    """Return the small timing errors that every record has, each at most ``timing`` samples.

    Sensors lag by some microseconds and stamps jitter; with 24 000 samples a delay of 2 % of a
    sample is beyond doubt, and is nobody's fault.  What is larger must be named.
    """
    limit = experiment.policy.timing * experiment.dt
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


def needs(experiment: Experiment, fit: Fit, times: float) -> bool:
    """Tell whether a fit needs an unknown of more than so many times the smallest."""
    small = limits_of(experiment)[0].as_array()
    return bool((fit.unknowns.as_array() > times * small).any())


def with_effect(fit: Fit, start: Start, amplitudes: tuple[float, ...]) -> Fit:
    """Return a fit with an effect entered at a multiple of its start, not yet refitted."""
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
    free = tuple(f for f in fit.free if f.owner != start.effect)
    return replace(fit, theta=theta, active=active, free=free + free_of(start),
                   named=(*fit.named, start.effect))


def without_effect(experiment: Experiment, fit: Fit, name: str) -> Fit:
    """Return a fit with an effect taken out, not yet refitted."""
    timing = tuple(f for f in timing_free(experiment) if f.owner == name)
    active, theta = fit.active.copy(), fit.theta.copy()
    active[NAMES.index(name)] = bool(timing)
    for p in CATALOGUE[name].parameters:
        theta[place_of(f"{name}.{p.name}")] = 0.0
    free = tuple(f for f in fit.free if f.owner != name) + timing
    return replace(fit, theta=theta, active=active, free=free,
                   named=tuple(other for other in fit.named if other != name))


def expected_likelihood(experiment: Experiment, fit: Fit) -> float:
    """Return the likelihood of a right model, whose innovations are the sensors' noise."""
    return float(-np.sum(np.log(experiment.noise[experiment.columns])
                         * np.isfinite(fit.e).sum(axis=0)))
