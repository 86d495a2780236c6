"""A model's motion between its samples, its rates there, and where models are compared: compiled.

The filter keeps the states after each correction; with the gains they give those before it, and
with the rates at both ends of a sample the cubic between them.  What is inlined says that it
allocates nothing: numba would count references to the members of its tuples at each call.

A sample has two points, at Gauss's places, or the stages of its Runge-Kutta steps where an effect
turns over within it; there the Jacobians of rates and memories are kept as well.
"""

import math
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.small_matrices import copied
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.innovations import FREE, N_FILTERED
from eha_monitor.physics.balances import acceleration, drive_speed, rates
from eha_monitor.physics.contributions import add_contributions, update_memory
from eha_monitor.physics.plant import (
    N_OUTPUTS,
    Y_FLOW,
    Y_FORCE,
    Y_OMEGA,
    Y_P1,
    Y_P2,
    Y_SPEED,
    Y_V,
    drive_rate,
    input_at,
    piece_at,
    seen_by_drive,
    shaft_speed,
)
from eha_monitor.physics.signals import (
    AREA_1,
    AREA_2,
    COMMAND_DELAY,
    DRIVE_LAG,
    FEEDBACK_DELAY,
    FORCE,
    N_CONTRIBUTIONS,
    N_SIGNALS,
    OMEGA,
    P1,
    P2,
    SLEW_LIMIT,
    X_D,
    M,
    T,
    V,
    X,
)

N_RATES = 4  # v', p1', p2', omega'
N_MOVED = 5  # x, v, p1, p2, omega: the states that the rates move
TINY = 1e-6  # of a state's size: for its derivative
EARLY, LATE = 0.5 - 0.5 / math.sqrt(3.0), 0.5 + 0.5 / math.sqrt(3.0)  # of a sample: Gauss


class Model(NamedTuple):
    """Parameters of the model at hand.

    ``w`` its circuit, ``slow`` whether its drive lags, by ``lag`` s but no less than ``shortest``;
    ``terms``, ``updates`` and ``places`` of the effects that add, remember, and remember a place.
    """

    mode: int
    dt: float
    steps: int
    theta: np.ndarray
    w: np.ndarray
    slow: bool
    lag: float
    shortest: float
    terms: np.ndarray
    updates: np.ndarray
    places: np.ndarray


class Motion(NamedTuple):
    """What the model did along a stretch.

    u, p1, p2 : inputs as :func:`innovate` takes them.
    states, ends : (n, N_FILTERED + 2 E) after, and before each correction (n, N_FILTERED); the
        former with the memories of the E ``updates``.
    slopes, slopes_end : (n, N_MOVED) the moved states' rates there.
    """

    u: np.ndarray
    p1: np.ndarray
    p2: np.ndarray
    states: np.ndarray
    ends: np.ndarray
    slopes: np.ndarray
    slopes_end: np.ndarray


class Here(NamedTuple):
    """Where the rates are looked at.

    t : s; value : input as it reaches the drive; behind : :func:`ahead_of`.
    """

    t: float
    value: float
    behind: float


class Scratch(NamedTuple):
    """The effects' memory (N_EFFECTS, 2); s (N_SIGNALS,) signals, c (N_CONTRIBUTIONS,)."""

    memory: np.ndarray
    s: np.ndarray
    c: np.ndarray


@njit
def contribute(s, theta, terms, memory, c):
    """:func:`add_contributions`, compiled once."""
    add_contributions(s, theta, terms, memory, c)


@njit
def remembered(s, theta, updates, h, memory):
    """:func:`update_memory`, compiled once."""
    update_memory(s, theta, updates, h, memory)


@njit(forceinline=True)
def between(a, b, da, db, dt, f):
    """Return the cubic from a to b with slopes da, db at ``f`` of the sample."""
    return a + f * (da * dt + f * (3.0 * (b - a) - (2.0 * da + db) * dt
                                   + f * (2.0 * (a - b) + (da + db) * dt)))


@njit(forceinline=True, allocates=False)
def moved_by(motion, i, j, k, dt, f):
    """Return state ``i`` at ``f`` of the sample from row ``j`` to row ``k``."""
    return between(motion.states[j, i], motion.ends[k, i], motion.slopes[j, i],
                   motion.slopes_end[k, i], dt, f)


@njit(forceinline=True, allocates=False)
def state_at(motion, dt, k, f, y):
    """Write the moved states at ``f`` of sample k."""
    for i in range(N_MOVED):
        y[i] = moved_by(motion, i, k, k + 1, dt, f)


@njit(forceinline=True, allocates=False)
def was(motion, i, dt, place):
    """Return state ``i`` at ``place`` samples after the first; before it all rests."""
    j = min(max(math.floor(place), 0), motion.states.shape[0] - 2)
    return moved_by(motion, i, j, j + 1, dt, min(max(place - j, 0.0), 1.0))


@njit(allocates=False)
def late_by(model, motion, i, k, delay):
    """Return state ``i`` as it was ``delay`` s before sample k, before its correction."""
    ends, dt, steps = motion.ends, model.dt, model.steps
    if delay == 0.0:
        return ends[k, i]
    if delay < 0.0 or k == 0:
        return ends[k, i] - delay * motion.slopes_end[k, i]
    if i == 0:
        return was(motion, i, dt, k - delay / dt)
    # Of the pressures the filter knows the ends of its steps, and goes straight between them.
    step = dt / steps
    j = math.floor(delay / step)
    f = delay / step - j
    new = ends[k, i] if j == 0 else was(motion, i, dt, k - j / steps)
    return (1.0 - f) * new + f * was(motion, i, dt, k - (j + 1) / steps)


@njit(forceinline=True)
def commanded(u, k, f, delay, dt):
    """Return the input ``f`` into sample k as it reaches the drive."""
    if delay == 0.0:
        return piece_at(u, k, f)
    return input_at(u, 1, k + f - delay / dt)


@njit(forceinline=True)
def lags(w):
    """Tell whether a drive is slow."""
    return w[DRIVE_LAG] > 0.0 or w[SLEW_LIMIT] < np.inf


@njit(forceinline=True)
def wanted_speed(value, late, theta, w):
    """Return the shaft speed that the drive wants, within its limit, rad/s."""
    return shaft_speed(drive_speed(value, seen_by_drive(late, late, w), theta, w), w)


@njit(forceinline=True, allocates=False)
def ahead_of(motion, delay, dt, k, f, y):
    """Return by how much the position ``delay`` s ago exceeds x - T v, m; nil within a sample."""
    if delay <= 0.0 or k + f - delay / dt > k:
        return 0.0
    return was(motion, 0, dt, k + f - delay / dt) - y[0] + delay * y[1]


@njit(forceinline=True, allocates=False)
def here_at(model, motion, k, f, y):
    """Return where the rates of a state at ``f`` of sample k are looked at."""
    w, dt = model.w, model.dt
    return Here((k + f) * dt, commanded(motion.u, k, f, w[COMMAND_DELAY], dt),
                ahead_of(motion, w[FEEDBACK_DELAY], dt, k, f, y))


@njit(forceinline=True, allocates=False)
def balanced(mode, value, y, turning, unknown, theta, c, out):
    """Write v', p1', p2' at given contributions and unknown force and flow."""
    c[FORCE] += unknown[0]
    if mode == FORCED:
        out[0], out[1], out[2] = acceleration(value, y[1], theta, c), 0.0, 0.0
    else:
        out[0], out[1], out[2] = rates(y[1], y[2], y[3], turning, unknown[1], theta, c)
    c[FORCE] -= unknown[0]


@njit(forceinline=True, allocates=False)
def course(model, y, unknown, here, scratch, out):
    """Write the rates at a state and leave the signals there in ``s``; return the shaft's speed.

    Parameters
    ----------
    y : (N_MOVED,) state; unknown : (3,) force, flow, speed.
    out : (N_RATES,) written.
    """
    mode, w, theta = model.mode, model.w, model.theta
    s, c = scratch.s, scratch.c
    turning = here.value
    out[3] = 0.0
    if mode == CLOSED:
        turning = wanted_speed(here.value, y[0] - w[FEEDBACK_DELAY] * y[1] + here.behind, theta, w)
        if model.slow:
            out[3] = drive_rate(turning, y[4], model.lag, w[SLEW_LIMIT])
            turning = y[4]
    turning += unknown[2]
    if mode == FORCED:
        turning = 0.0
    if len(model.terms):
        s[T], s[X], s[V], s[P1], s[P2] = here.t, y[0], y[1], y[2], y[3]
        s[OMEGA], s[X_D] = turning, (0.0 if mode == FORCED else here.value)
        contribute(s, theta, model.terms, scratch.memory, c)
    balanced(mode, here.value, y, turning, unknown, theta, c, out)
    return turning


@njit
def jacobian(model, y, unknown, span, here, scratch, rates, jac):
    """Write the rates at a state and their derivatives by all filtered states; return the speed.

    span : (N_FILTERED,) the differences, with their sign.
    rates : (N_RATES,), jac : (N_RATES, N_FILTERED) written.
    """
    out = np.empty(N_RATES)
    turning = course(model, y, unknown, here, scratch, rates)
    kept = scratch.c.copy()
    for i in range(N_FILTERED):
        if i == Y_OMEGA and not model.slow:
            copied(out, rates)
        else:
            moved, place = (y, i) if i < N_MOVED else (unknown, i - N_MOVED)
            was_here = moved[place]
            moved[place] += span[i]
            if i in (Y_FORCE, Y_FLOW):  # no effect looks at them
                balanced(model.mode, here.value, y, turning, unknown, model.theta, kept, out)
                out[3] = rates[3]
            else:
                course(model, y, unknown, here, scratch, out)
            moved[place] = was_here
        for r in range(N_RATES):
            jac[r, i] = (out[r] - rates[r]) / span[i]
    copied(scratch.c, kept)
    return turning


@njit(nogil=True)
def before_corrections(states, e, gains, role, dt, theta, ends, shifts):
    """Write the states before their correction, (n, N_FILTERED).

    shifts : (n,) written: half the pressure difference that a role took from the sensors, Pa.
    """
    for k in range(states.shape[0]):
        at = min(k, gains.shape[0] - 1)
        for i in range(N_FILTERED):
            ends[k, i] = states[k, i]
        if role[k] == FREE:
            continue
        by_1 = by_2 = 0.0
        for j in range(N_OUTPUTS):
            if math.isfinite(e[k, j]):
                for i in range(N_FILTERED):
                    ends[k, i] -= gains[at, i, j] * e[k, j]
                by_1 += gains[at, Y_P1, j] * e[k, j]
                by_2 += gains[at, Y_P2, j] * e[k, j]
        if role[k] > 0.0 and math.isfinite(e[k, 2]) and math.isfinite(e[k, 3]):
            half = 0.5 * role[k] * (e[k, 2] - by_1 - e[k, 3] + by_2)
            shifts[k] = half
            ends[k, Y_P1] -= half
            ends[k, Y_P2] += half
            ends[k, Y_V] -= 0.5 * dt * half * (theta[AREA_1] + theta[AREA_2]) / theta[M]


@njit(forceinline=True)
def recall(states, updates, k, memory):
    """Write the effects' memory after the correction of sample k."""
    for i in range(len(updates)):
        memory[updates[i], 0] = states[k, N_FILTERED + 2 * i]
        memory[updates[i], 1] = states[k, N_FILTERED + 2 * i + 1]


@njit(nogil=True)
def slopes_along(model, motion, memory):
    """Write the rates (x', v', p1', p2', omega') after and before each correction."""
    states, ends, slopes, slopes_end = motion.states, motion.ends, motion.slopes, motion.slopes_end
    n = states.shape[0]
    scratch = Scratch(memory, np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS))
    out, y, unknown = np.zeros(N_RATES), np.zeros(N_MOVED), np.zeros(3)
    for k in range(n):
        for side in range(2):
            here = k + side
            if here == n:
                break
            for i in range(N_MOVED):
                y[i] = states[k, i] if side == 0 else ends[here, i]
            for i in range(3):
                unknown[i] = states[k, N_MOVED + i]
            if model.mode == FORCED:
                y[2], y[3] = motion.p1[here], motion.p2[here]
            recall(states, model.updates, here, memory)
            if side == 1:  # its place was corrected with the position
                for which in model.places:
                    memory[which, 1] -= states[here, 0] - ends[here, 0]
            course(model, y, unknown, here_at(model, motion, k, float(side), y), scratch, out)
            written = slopes if side == 0 else slopes_end
            written[here, 0] = y[1]
            for i in range(N_RATES):
                written[here, 1 + i] = out[i]
    copied(slopes_end[0], slopes[0])


@njit(nogil=True)
def jacobians(model, motion, size, memory, jacs):
    """Write the rates' Jacobians of each sample, (m, N_RATES, N_FILTERED).

    Differences span what the state moves in the sample: what turns over counts by its mean.
    """
    states, ends, p1, p2 = motion.states, motion.ends, motion.p1, motion.p2
    scratch = Scratch(memory, np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS))
    out, y, unknown, span = np.zeros(N_RATES), np.zeros(N_MOVED), np.zeros(3), np.zeros(N_FILTERED)
    for k in range(min(jacs.shape[0], states.shape[0] - 1)):
        state_at(motion, model.dt, k, 0.5, y)
        for i in range(N_MOVED):
            span[i] = 0.5 * (ends[k + 1, i] - states[k, i])
            if abs(span[i]) < TINY * size[i]:
                span[i] = TINY * size[i]
        for i in range(3):
            unknown[i] = states[k, N_MOVED + i]
            span[N_MOVED + i] = 1e-3 * size[N_MOVED + i]
        if model.mode == FORCED:
            y[2], y[3] = 0.5 * (p1[k] + p1[k + 1]), 0.5 * (p2[k] + p2[k + 1])
        recall(states, model.updates, k, memory)
        jacobian(model, y, unknown, span, here_at(model, motion, k, 0.5, y), scratch, out, jacs[k])


@njit(nogil=True)
def turns_over(model, motion, jacs, constant, typical, limits, hard):
    """Mark the samples in which an effect turns over, (n,) bool.

    typical : (N_RATES,) size of each rate.
    limits : of what an effect adds to a rate in a sample by its own slope, over the rate's size;
        of decay in a sample, and of angle squared, that are an effect's alone.
    """
    dt = model.dt
    sudden, stiff, spring = limits
    states, ends = motion.states, motion.ends
    for k in range(len(hard) - 1):
        for r in range(N_RATES):
            for i in range(N_MOVED):
                more = abs(jacs[k, r, i] - constant[r, i])
                if more * abs(ends[k + 1, i] - states[k, i]) > sudden * typical[r]:
                    hard[k] = True
            if dt * abs(jacs[k, r, 1 + r] - constant[r, 1 + r]) > stiff:
                hard[k] = True
        if dt * dt * abs(jacs[k, 0, 0] - constant[0, 0]) > spring:
            hard[k] = True


SOFT = 2  # points of a sample
STAGES = 4  # of a Runge-Kutta step
FINE = 1e-7  # of a size: for the derivatives at a stage
FINER = 1e-9  # of the travel: a seal turns over within micrometres


class Points(NamedTuple):
    """Where the models are compared.

    first : (n,) of each sample; place : (P,) of each in its sample.
    signals : (P, N_SIGNALS), inner : (P, 2) unknown force and flow, value : (P,) of the input.
    rates : (P, N_RATES), faster : (P, N_RATES) of a shaft that turns 1 rad/s faster.
    added : (P, N_CONTRIBUTIONS) of the model's effects, or (1, ...) where it has none.
    hard : (n,) number of the sample among those gone through by stages, or -1.
    jacs, by_memory : (H, stages, N_RATES, N_FILTERED), (H, stages, E, 2, N_RATES).
    reached, renewed : (H, steps, N_MOVED) ends of the steps; (H, steps, E, 2, 6) derivatives of
        the memories there by x, v, p1, p2 and themselves.
    """

    first: np.ndarray
    place: np.ndarray
    signals: np.ndarray
    inner: np.ndarray
    value: np.ndarray
    rates: np.ndarray
    faster: np.ndarray
    added: np.ndarray
    hard: np.ndarray
    jacs: np.ndarray
    by_memory: np.ndarray
    reached: np.ndarray
    renewed: np.ndarray


def points_of(model: Model, motion: Motion, hard: np.ndarray, size: np.ndarray,
              memory: np.ndarray) -> Points:
    """Return the points along a motion; ``hard`` (n,) bool tells which samples need stages."""
    effects = len(model.updates)
    stages = STAGES * model.steps
    counts = np.where(hard, stages, SOFT)
    counts[-1] = 0
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    total, many = int(counts.sum()), int(hard.sum())
    numbers = np.where(hard, np.cumsum(hard) - 1, -1)
    points = Points(
        first, np.empty(total), np.zeros((total, N_SIGNALS)), np.empty((total, 2)),
        np.empty(total), np.zeros((total, N_RATES)), np.zeros((total, N_RATES)),
        np.zeros((total if len(model.terms) else 1, N_CONTRIBUTIONS)), numbers,
        np.zeros((many, stages, N_RATES, N_FILTERED)),
        np.zeros((many, stages, effects, 2, N_RATES)),
        np.zeros((many, model.steps, N_MOVED)), np.zeros((many, model.steps, effects, 2, 6)))
    look(model, motion, points, size, memory)
    return points


@njit(nogil=True)
def look(model, motion, points, size, memory):
    """Fill the points."""
    mode, theta, terms, updates = model.mode, model.theta, model.terms, model.updates
    states, p1, p2 = motion.states, motion.p1, motion.p2
    first, hard, all_rates, faster, added = (points.first, points.hard, points.rates,
                                             points.faster, points.added)
    s, c = np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS)
    scratch = Scratch(memory, s, c)
    rates, work, moved = np.zeros(N_RATES), np.zeros(N_CONTRIBUTIONS), np.zeros(N_RATES)
    y, unknown, span = np.zeros(N_MOVED), np.zeros(3), FINE * size
    for k in range(states.shape[0] - 1):
        if hard[k] >= 0:
            by_stages(model, motion, points, size, k, scratch, span)
            continue
        for i in range(3):
            unknown[i] = states[k, N_MOVED + i]
        recall(states, updates, k, memory)
        for node in range(SOFT):
            f, p = EARLY if node == 0 else LATE, first[k] + node
            state_at(motion, model.dt, k, f, y)
            if mode == FORCED:
                y[2], y[3] = (1.0 - f) * p1[k] + f * p1[k + 1], (1.0 - f) * p2[k] + f * p2[k + 1]
            here = here_at(model, motion, k, f, y)
            turning = course(model, y, unknown, here, scratch, rates)
            note(points, p, f, mode, y, turning, here, unknown)
            for r in range(N_RATES):
                all_rates[p, r] = rates[r]
            if mode == FORCED:
                if len(terms):
                    copied(added[p], c)
                continue
            d = 1e-3 * (1.0 + abs(turning))
            if len(terms):
                copied(added[p], c)
                s[OMEGA] = turning + d
                contribute(s, theta, terms, memory, work)
            balanced(mode, here.value, y, turning + d, unknown, theta, work, moved)
            for r in range(3):
                faster[p, r] = (moved[r] - rates[r]) / d


@njit(allocates=False)
def note(points, p, f, mode, y, turning, here, unknown):
    """Write point ``p``, at ``f`` of its sample: signals, input, unknown force and flow."""
    points.place[p], points.value[p] = f, here.value
    row = points.signals[p]
    row[T], row[X], row[V], row[P1], row[P2] = here.t, y[0], y[1], y[2], y[3]
    row[OMEGA] = turning
    if mode != FORCED:
        row[X_D] = here.value
    points.inner[p, 0], points.inner[p, 1] = unknown[0], unknown[1]


@njit
def by_stages(model, motion, points, size, k, scratch, span):
    """Fill the points of sample k: the stages of its Runge-Kutta steps; ``span`` is written."""
    mode, dt, steps, updates = model.mode, model.dt, model.steps, model.updates
    states, p1, p2, memory = motion.states, motion.p1, motion.p2, scratch.memory
    rates, up, unknown = np.zeros(N_RATES), np.zeros(N_RATES), np.zeros(3)
    y, at = np.zeros(N_MOVED), np.zeros(N_MOVED)
    slope, total = np.zeros(N_MOVED), np.zeros(N_MOVED)
    h, number = dt / steps, points.hard[k]
    for i in range(N_MOVED):
        y[i] = states[k, i]
    for i in range(3):
        unknown[i] = states[k, N_MOVED + i]
    recall(states, updates, k, memory)
    for step in range(steps):
        total[:] = 0.0
        for stage in range(STAGES):
            offset = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            f, p = (step + offset) / steps, points.first[k] + STAGES * step + stage
            for i in range(N_MOVED):
                at[i] = y[i] + (offset * h * slope[i] if stage > 0 else 0.0)
            if mode == FORCED:
                at[2] = (1.0 - f) * p1[k] + f * p1[k + 1]
                at[3] = (1.0 - f) * p2[k] + f * p2[k + 1]
            here = here_at(model, motion, k, f, at)
            jac = points.jacs[number, STAGES * step + stage]
            # A seal knows how far it has slid, not which way: its slopes hold along the motion.
            span[0] = FINER * size[0] if at[1] >= 0.0 else -FINER * size[0]
            turning = jacobian(model, at, unknown, span, here, scratch, rates, jac)
            note(points, p, f, mode, at, turning, here, unknown)
            copied(points.rates[p], rates)
            for r in range(3):
                points.faster[p, r] = jac[r, Y_SPEED]
            if len(model.terms):
                copied(points.added[p], scratch.c)
            for e in range(len(updates)):
                for m in range(2):
                    kept = memory[updates[e], m]
                    d = FINE * (abs(kept) + 1e-6) if m == 0 else -span[0]
                    memory[updates[e], m] += d
                    course(model, at, unknown, here, scratch, up)
                    memory[updates[e], m] = kept
                    for r in range(N_RATES):
                        points.by_memory[number, STAGES * step + stage, e, m, r] = (
                            up[r] - rates[r]) / d
            slope[0] = at[1]
            for r in range(N_RATES):
                slope[1 + r] = rates[r]
            for i in range(N_MOVED):
                total[i] += (1.0 if stage == 0 or stage == 3 else 2.0) * slope[i]
        for i in range(N_MOVED):
            y[i] += h / 6.0 * total[i]
        if mode == FORCED:
            f = (step + 1.0) / steps
            y[2], y[3] = (1.0 - f) * p1[k] + f * p1[k + 1], (1.0 - f) * p2[k] + f * p2[k + 1]
        copied(points.reached[number, step], y)
        span[0] = FINER * size[0] if y[1] >= 0.0 else -FINER * size[0]
        for e in range(len(updates)):
            renew(model.theta, updates[e : e + 1], (k * dt) + (step + 1) * h, y, h, span, scratch,
                  points.renewed[number, step, e])


@njit
def renew(theta, one, t, y, h, span, scratch, derivative):
    """Carry an effect's memory over ``h`` s that have ended at ``y``; write its derivatives.

    derivative : (2, 6) of both numbers by x, v, p1, p2 and themselves.
    """
    which, memory, s = one[0], scratch.memory, scratch.s
    first, second = memory[which, 0], memory[which, 1]
    s[T], s[X], s[V], s[P1], s[P2] = t, y[0], y[1], y[2], y[3]
    remembered(s, theta, one, h, memory)
    after_1, after_2 = memory[which, 0], memory[which, 1]
    for i in range(6):
        s[X], s[V], s[P1], s[P2] = y[0], y[1], y[2], y[3]
        memory[which, 0], memory[which, 1] = first, second
        if i < 4:
            d = span[i]
            s[X + i] += d
        elif i == 4:
            d = FINE * (abs(first) + 1e-6)
            memory[which, 0] += d
        else:
            d = -span[0]
            memory[which, 1] += d
        remembered(s, theta, one, h, memory)
        derivative[0, i] = (memory[which, 0] - after_1) / d
        derivative[1, i] = (memory[which, 1] - after_2) / d
    memory[which, 0], memory[which, 1] = after_1, after_2
