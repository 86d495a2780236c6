"""Score test of the whole catalogue at a fitted model: one run of the filter per direction."""

from dataclasses import dataclass

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.fit import (
    Fit,
    Free,
    innovations,
    log_likelihood_of,
    sensitivities,
    spread,
    step_of,
    whitener,
)
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of

SPREAD = 100.0  # times its start: a size's prior deviation, that is about the record's range
SHAPE_SPREAD = 1.5  # of the logarithm of a shape
# Where balances are compared as they stand: a line is beyond their band; what swallows oil acts
# while the pressure rises, and there the flow is not compared.  The sensors' errors move them all.
UNSEEN = ("backlash", "line_dynamics", "entrained_air", "position_dependent_volume")
LOOP_ONLY = ("feedback_delay",)  # shows only where the position loop is part of the model
TANGENT = 0.05  # of a start's sizes: where the innovations answer in proportion


@dataclass(frozen=True)
class Start:
    """One way in which an effect might enter a model.

    Attributes
    ----------
    effect : its name.
    values : all parameters, a small but visible instance.
    replaces : named effect that it contains and takes the place of, or "".
    among : how many starts the effect has.
    """

    effect: str
    values: tuple[tuple[str, float], ...]
    replaces: str = ""
    among: int = 1


@dataclass(frozen=True)
class Score:
    """What the score test says of one start.

    ``gain`` in log units, ``amplitudes`` times the start's sizes, one for each size.
    """

    start: Start
    gain: float
    amplitudes: tuple[float, ...]


def possible(name: str, experiment: Experiment) -> bool:
    """Tell whether an effect can show in these channels at all."""
    effect = CATALOGUE[name]
    if experiment.inverse and (effect.balance == "sensor" or name in UNSEEN):
        return False
    if effect.balance == "force":
        return name != "backlash" or experiment.mode == CLOSED
    if experiment.mode == FORCED:
        return False
    if experiment.wanted_speed and name in LOOP_ONLY:
        return False
    pressures = experiment.used[2] or experiment.used[3]
    if effect.balance == "drive":
        return experiment.mode == CLOSED
    if name.startswith("pressure_"):
        return bool(pressures)
    return True


def starts_of(name: str, experiment: Experiment) -> list[Start]:
    """Return where a fit of an effect begins, within its bounds."""
    effect = CATALOGUE[name]
    found, places = [], effect.starts(experiment.ranges)
    for given in places:
        values = []
        for p in effect.parameters:
            value = given.get(p.name, p.default if p.default is not None else p.neutral)
            if np.isfinite(value):  # a limit that is not there stays at infinity
                value = min(max(value, p.lower), p.upper)
            if experiment.inverse and p.name == "dB":
                # Ramps at one speed cannot tell it from dF, and friction would push one way.
                value = p.neutral
            values.append((p.name, float(value)))
        found.append(Start(name, tuple(values), among=len(places)))
    return found


def entered(theta: np.ndarray, active: np.ndarray, start: Start) -> tuple[np.ndarray, np.ndarray]:
    """Return theta and active with an effect at its start."""
    theta, active = theta.copy(), active.copy()
    if start.replaces:
        active[NAMES.index(start.replaces)] = False
    active[NAMES.index(start.effect)] = True
    for name, value in start.values:
        theta[place_of(f"{start.effect}.{name}")] = value
    return theta, active


def free_parameter(effect: Effect, p: Parameter, value: float) -> Free:
    """Return how a parameter is fitted that starts at ``value``."""
    place = place_of(f"{effect.name}.{p.name}")
    name = f"{effect.name}.{p.name}"
    if p.log:
        return Free(name, place, max(p.lower, value / SPREAD), p.upper, float(np.log(value)),
                    float(np.log(SPREAD)), True)
    if p.default is None and np.isfinite(p.neutral):
        return Free(name, place, p.lower, p.upper, p.neutral,
                    max(SPREAD * abs(value), 1e-3 * p.scale))
    if p.lower > 0:
        return Free(name, place, p.lower, p.upper, float(np.log(value)), SHAPE_SPREAD, True)
    return Free(name, place, p.lower, p.upper, value, 2.0 * p.scale)


def free_of(start: Start, whole: bool = True) -> tuple[Free, ...]:
    """Return the fitted parameters of an effect at its start, the late ones only if ``whole``."""
    effect, values = CATALOGUE[start.effect], dict(start.values)
    return tuple(free_parameter(effect, p, values[p.name]) for p in effect.parameters
                 if p.fitted and np.isfinite(values[p.name]) and (whole or not p.late))


def own_sizes(start: Start) -> list[Parameter]:
    """Return the sizes that a start brings in: those of the effect that it replaces are there.

    Empty where it brings in another shape only.
    """
    values = dict(start.values)
    shared = {p.name for p in CATALOGUE[start.replaces].sizes} if start.replaces else set()
    return [p for p in CATALOGUE[start.effect].sizes
            if values[p.name] != p.neutral and p.name not in shared]


def directions_of(fit: Fit, start: Start, share: float = 1.0
                  ) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return (theta, active) with one size of the start at a time, or with all of its shape.

    Parameters
    ----------
    share : of the start's sizes.
    """
    sizes = own_sizes(start)
    if not sizes:
        return [entered(fit.theta, fit.active, start)]
    values, found = dict(start.values), []
    for size in sizes:
        theta, active = entered(fit.theta, fit.active, start)
        for other in sizes:
            theta[place_of(f"{start.effect}.{other.name}")] = other.neutral
        value = values[size.name]
        if share != 1.0:
            value = size.neutral + share * (value - size.neutral)
        theta[place_of(f"{start.effect}.{size.name}")] = value
        found.append((theta, active))
    return found


def shares_of(start: Start) -> tuple[float, ...]:
    """Return at which shares of its sizes a start is scored.

    One that stands for its surroundings, among others, is scored where it is.  What enters
    smoothly is scored near zero too: a mass of 2 % takes the ringing of a column out of step.
    """
    sizes = own_sizes(start)
    smooth = start.among == 1 and sizes and all(np.isfinite(p.neutral) for p in sizes)
    return (1.0, TANGENT) if smooth else (1.0,)


def screen(experiment: Experiment, fit: Fit, starts: list[Start]) -> list[Score]:
    """Score all starts at a fit, best first.

    With whitened innovations r and their change d for a start, base and named parameters
    projected out of both, the start explains r down to |r + a d|, a = -(d.r)/(d.d); the gain is
    what that does to the likelihood.  A parameter that stands on its bound is not projected out:
    a delay that is too long for the timing which needs no name would be taken for explained.
    """
    w = whitener(fit.s)
    white = np.nan_to_num(fit.e) @ w.T
    own = sensitivities(experiment, fit.theta, fit.active, fit.gains, fit.e,
                        [step_of(f, fit.theta) for f in fit.free
                         if f.log or not f.at_bound(fit.theta[f.place])])
    basis = [(np.nan_to_num(d) @ w.T).ravel() for d in own]
    q = np.linalg.qr(np.stack(basis, axis=1))[0] if basis else np.zeros((white.size, 0))
    r = white.ravel()
    r = r - q @ (q.T @ r)
    missing = ~np.isfinite(fit.e)
    before = log_likelihood_of(np.where(missing, np.nan, r.reshape(white.shape)))
    tasks = [(i, share, theta, active) for i, start in enumerate(starts)
             for share in shares_of(start)
             for theta, active in directions_of(fit, start, share)]

    def one(task):
        _, _, theta, active = task
        e = innovations(experiment, theta, active, fit.gains)
        d = (np.nan_to_num(e - fit.e) @ w.T).ravel()
        if not np.isfinite(d).all() or np.abs(d).max() > 1e12:
            return None
        return d - q @ (q.T @ d)

    moved = spread(one, tasks)
    scores = []
    for i, start in enumerate(starts):
        found = []
        for share in shares_of(start):
            block = [d for task, d in zip(tasks, moved, strict=True) if task[:2] == (i, share)]
            if block and all(d is not None for d in block):
                found.append(score_of(start, np.stack(block) / share, r, missing, before))
        scores += [max(found, key=lambda score: score.gain)] if found else []
    return sorted(scores, key=lambda score: -score.gain)


def score_of(start: Start, d: np.ndarray, r: np.ndarray, missing: np.ndarray,
             before: float) -> Score:
    """Return the score of a start from its projected directions ``d`` (k, N*c).

    ``missing`` (N, c) marks what was not measured; ``before`` is the likelihood without it.
    """
    sizes = own_sizes(start)
    matrix = d @ d.T
    scale = np.sqrt(np.diag(matrix))
    if (scale < 1e-9).any():  # nothing moves: this record does not show it
        return Score(start, 0.0, (0.0,) * len(d))
    a = -np.linalg.lstsq(matrix / np.outer(scale, scale), d @ r / scale, rcond=1e-9)[0] / scale
    for j, p in enumerate(sizes):  # a size on the wrong side of its bound is none
        one_sided = (p.lower >= 0 and np.isfinite(p.neutral)) or not np.isfinite(p.neutral)
        if one_sided and a[j] < 0:
            a[j] = 0.0
    if not sizes:
        a = np.clip(a, 0.0, 1.0)
    gain = log_likelihood_of(
        np.where(missing, np.nan, (r + a @ d).reshape(missing.shape))) - before
    return Score(start, float(max(gain, 0.0)), tuple(float(v) for v in a))
