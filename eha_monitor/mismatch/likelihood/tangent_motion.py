"""A model's motion between its samples, its rates there and their Jacobian, compiled.

The filter keeps the states after each correction; with the gains they give those before it, and
with the rates at both ends of a sample the cubic between them.
"""

import math
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.innovations import FREE, N_FILTERED
from eha_monitor.physics.balances import acceleration, drive_speed, rates
from eha_monitor.physics.contributions import add_contributions, update_memory
from eha_monitor.physics.plant import (
    N_OUTPUTS,
    Y_P1,
    Y_P2,
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


@njit(forceinline=True)
def state_at(motion, dt, k, f, y):
    """Write the moved states at ``f`` of sample k."""
    for i in range(N_MOVED):
        y[i] = between(motion.states[k, i], motion.ends[k + 1, i], motion.slopes[k, i],
                       motion.slopes_end[k + 1, i], dt, f)


@njit
def was(motion, i, dt, place):
    """Return state ``i`` at ``place`` samples after the first; before it all rests."""
    j = min(max(math.floor(place), 0), motion.states.shape[0] - 2)
    f = min(max(place - j, 0.0), 1.0)
    return between(motion.states[j, i], motion.ends[j + 1, i], motion.slopes[j, i],
                   motion.slopes_end[j + 1, i], dt, f)


@njit
def late_by(motion, i, k, delay, dt, steps):
    """Return state ``i`` as it was ``delay`` s before sample k, before its correction."""
    if delay == 0.0:
        return motion.ends[k, i]
    if delay < 0.0 or k == 0:
        return motion.ends[k, i] - delay * motion.slopes_end[k, i]
    if i == 0:
        return was(motion, i, dt, k - delay / dt)
    # Of the pressures the filter knows the ends of its steps, and goes straight between them.
    step = dt / steps
    j = math.floor(delay / step)
    f = delay / step - j
    new = motion.ends[k, i] if j == 0 else was(motion, i, dt, k - j / steps)
    return (1.0 - f) * new + f * was(motion, i, dt, k - (j + 1) / steps)


@njit
def told(u, k, f, delay, dt):
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


@njit
def inputs_at(model, motion, k, f, x, v):
    """Return the input at ``f`` of sample k, and by how much the late x exceeds x - T v, m."""
    value = told(motion.u, k, f, model.w[COMMAND_DELAY], model.dt)
    delay, behind = model.w[FEEDBACK_DELAY], 0.0
    if delay > 0.0 and k + f - delay / model.dt <= k:
        behind = was(motion, 0, model.dt, k + f - delay / model.dt) - x + delay * v
    return value, behind


@njit(forceinline=True)
def balanced(mode, value, y, turning, unknown, theta, c, out):
    """Write v', p1', p2' at given contributions."""
    c[FORCE] += unknown[0]
    if mode == FORCED:
        out[0], out[1], out[2] = acceleration(value, y[1], theta, c), 0.0, 0.0
    else:
        out[0], out[1], out[2] = rates(y[1], y[2], y[3], turning, unknown[1], theta, c)
    c[FORCE] -= unknown[0]


@njit
def course(model, y, unknown, t, value, behind, memory, s, c, out):
    """Write the rates at a state and leave the signals there in ``s``; return the shaft's speed.

    Parameters
    ----------
    y : (N_MOVED,) state; unknown : (3,) force, flow, speed.
    value, behind : of :func:`inputs_at`.
    memory, s, c : the effects' memory and scratch.
    out : (N_RATES,) written.
    """
    turning = value
    out[3] = 0.0
    if model.mode == CLOSED:
        late = y[0] - model.w[FEEDBACK_DELAY] * y[1] + behind
        turning = wanted_speed(value, late, model.theta, model.w)
        if model.slow:
            out[3] = drive_rate(turning, y[4], model.lag, model.w[SLEW_LIMIT])
            turning = y[4]
    turning += unknown[2]
    s[T], s[X], s[V], s[P1], s[P2] = t, y[0], y[1], y[2], y[3]
    s[OMEGA], s[X_D] = turning, value
    if model.mode == FORCED:
        s[OMEGA] = s[X_D] = 0.0
    if len(model.terms):
        contribute(s, model.theta, model.terms, memory, c)
    balanced(model.mode, value, y, turning, unknown, model.theta, c, out)
    return turning


@njit
def jacobian(model, y, unknown, span, t, value, behind, memory, s, c, up, down, jac):
    """Write the rates' derivatives by all filtered states, (N_RATES, N_FILTERED).

    span : (N_FILTERED,) half of each difference.
    """
    for i in range(N_FILTERED):
        d = span[i]
        for side in range(2):
            move = d if side == 0 else -d
            to = up if side == 0 else down
            if i < N_MOVED:
                kept = y[i]
                y[i] = kept + move
                course(model, y, unknown, t, value, behind, memory, s, c, to)
                y[i] = kept
            else:
                kept = unknown[i - N_MOVED]
                unknown[i - N_MOVED] = kept + move
                course(model, y, unknown, t, value, behind, memory, s, c, to)
                unknown[i - N_MOVED] = kept
        for r in range(N_RATES):
            jac[r, i] = (up[r] - down[r]) / (2.0 * d)


@njit(nogil=True)
def before_corrections(states, e, gains, role, dt, theta, ends, shifts):
    """Write the states before their correction, (n, N_FILTERED).

    shifts : (n,) written: half the pressure difference that a role took from the sensors, Pa.
    """
    for k in range(states.shape[0]):
        gain = gains[min(k, gains.shape[0] - 1)]
        for i in range(N_FILTERED):
            ends[k, i] = states[k, i]
        if role[k] == FREE:
            continue
        by_1 = by_2 = 0.0
        for j in range(N_OUTPUTS):
            if math.isfinite(e[k, j]):
                for i in range(N_FILTERED):
                    ends[k, i] -= gain[i, j] * e[k, j]
                by_1 += gain[Y_P1, j] * e[k, j]
                by_2 += gain[Y_P2, j] * e[k, j]
        if role[k] > 0.0 and math.isfinite(e[k, 2]) and math.isfinite(e[k, 3]):
            half = 0.5 * role[k] * (e[k, 2] - by_1 - e[k, 3] + by_2)
            shifts[k] = half
            ends[k, Y_P1] -= half
            ends[k, Y_P2] += half
            ends[k, Y_V] -= 0.5 * dt * half * (theta[AREA_1] + theta[AREA_2]) / theta[M]


@njit(forceinline=True)
def recall(model, motion, k, memory):
    """Write the effects' memory after the correction of sample k."""
    for i in range(len(model.updates)):
        memory[model.updates[i], 0] = motion.states[k, N_FILTERED + 2 * i]
        memory[model.updates[i], 1] = motion.states[k, N_FILTERED + 2 * i + 1]


@njit(nogil=True)
def slopes_along(model, motion, memory):
    """Write the rates (x', v', p1', p2', omega') after and before each correction."""
    n = motion.states.shape[0]
    s, c, out = np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS), np.zeros(N_RATES)
    y, unknown = np.zeros(N_MOVED), np.zeros(3)
    for k in range(n):
        for side in range(2):
            here = k + side
            if here == n:
                break
            for i in range(N_MOVED):
                y[i] = motion.states[k, i] if side == 0 else motion.ends[here, i]
            for i in range(3):
                unknown[i] = motion.states[k, N_MOVED + i]
            if model.mode == FORCED:
                y[2], y[3] = motion.p1[here], motion.p2[here]
            recall(model, motion, here, memory)
            if side == 1:  # its place was corrected with the position
                for which in model.places:
                    memory[which, 1] -= motion.states[here, 0] - motion.ends[here, 0]
            value, behind = inputs_at(model, motion, k, float(side), y[0], y[1])
            course(model, y, unknown, here * model.dt, value, behind, memory, s, c, out)
            written = motion.slopes if side == 0 else motion.slopes_end
            written[here, 0] = y[1]
            for i in range(N_RATES):
                written[here, 1 + i] = out[i]
    motion.slopes_end[0] = motion.slopes[0]


@njit(nogil=True)
def jacobians(model, motion, size, tiny, memory, every, jacs):
    """Write the rates' Jacobians in the middle of each ``every``-th sample.

    Differences span what the state moves in a sample, at least ``tiny`` of its ``size``: what
    turns over faster counts by its mean.
    """
    n = motion.states.shape[0]
    s, c = np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS)
    up, down = np.zeros(N_RATES), np.zeros(N_RATES)
    y, unknown, span = np.zeros(N_MOVED), np.zeros(3), np.zeros(N_FILTERED)
    for at in range(jacs.shape[0]):
        k = min(at * every, n - 2)
        state_at(motion, model.dt, k, 0.5, y)
        for i in range(N_MOVED):
            span[i] = max(tiny * size[i], 0.5 * abs(motion.ends[k + 1, i] - motion.states[k, i]))
        for i in range(3):
            unknown[i] = motion.states[k, N_MOVED + i]
            span[N_MOVED + i] = 1e-3 * size[N_MOVED + i]
        if model.mode == FORCED:
            y[2], y[3] = (0.5 * (motion.p1[k] + motion.p1[k + 1]),
                          0.5 * (motion.p2[k] + motion.p2[k + 1]))
        recall(model, motion, k, memory)
        value, behind = inputs_at(model, motion, k, 0.5, y[0], y[1])
        jacobian(model, y, unknown, span, (k + 0.5) * model.dt, value, behind, memory, s, c, up,
                 down, jacs[at])
