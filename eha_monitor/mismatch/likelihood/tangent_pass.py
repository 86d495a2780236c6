"""The linearised filter along a trajectory, compiled: many parameters side by side.

Over a sample the difference delta of two filters whose models differ a little follows

    delta+ = Phi (delta + K d_e) + Gamma g,   d_e = -(H delta + d_shown)

with g the difference of the rates (v', p1', p2', omega') that the two models have at the same
state, and d_shown that of what their sensors show.  Phi is the plant's own Runge-Kutta map and
constant.  What active effects add to it is a kick in the middle of the sample, implicit, or,
where they turn over within it, the tangent of each Runge-Kutta step and of the effects' memory.
"""

import math
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.small_matrices import copied
from eha_monitor.mismatch.data.inputs import CLOSED
from eha_monitor.mismatch.likelihood.innovations import FREE, N_FILTERED
from eha_monitor.mismatch.likelihood.tangent_lanes import Block, compare
from eha_monitor.mismatch.likelihood.tangent_motion import (
    N_MOVED,
    N_RATES,
    SOFT,
    STAGES,
    between,
    commanded,
    late_by,
    wanted_speed,
)
from eha_monitor.physics.plant import (
    N_OUTPUTS,
    Y_FORCE,
    Y_OMEGA,
    Y_P1,
    Y_P2,
    Y_SPEED,
    Y_V,
    Y_X,
)
from eha_monitor.physics.signals import (
    AREA_1,
    AREA_2,
    COMMAND_DELAY,
    FEEDBACK_DELAY,
    POSITION_DELAY,
    POSITION_SCALE,
    PRESSURE_DELAY,
    PRESSURE_SCALE_1,
    PRESSURE_SCALE_2,
    M,
)

BLOCK = 64  # samples whose lanes are compared at once: what drives them stays in the cache


class Linear(NamedTuple):
    """The linearised filter along a motion.

    phi, gamma : (N, N), (2, N, N_RATES) of a sample; ``half``, ``half_gamma`` up to its middle.
    constant, jacs : (N_RATES, N_FILTERED) Jacobian of the rates, and of each sample (n, ...), or
        (0, ...) where it is the same.
    shaft : (n, N_FILTERED) the shown speed's derivative by the state before each correction.
    shifts : (n,) half the pressure difference that was taken from the sensors, Pa.
    """

    phi: np.ndarray
    gamma: np.ndarray
    half: np.ndarray
    half_gamma: np.ndarray
    constant: np.ndarray
    jacs: np.ndarray
    shaft: np.ndarray
    shifts: np.ndarray


@njit(nogil=True)
def shafts(model, motion, shaft):
    """Write the shown speed's derivative by the state before each correction."""
    theta, w = model.theta, model.w
    for k in range(motion.states.shape[0]):
        shaft[k, Y_SPEED] = 1.0
        if model.mode == CLOSED and model.slow:
            shaft[k, Y_OMEGA] = 1.0
        elif model.mode == CLOSED:
            value = commanded(motion.u, k, 0.0, w[COMMAND_DELAY], model.dt)
            late = late_by(model, motion, 0, k, w[FEEDBACK_DELAY])
            d = 1e-7
            slope = (wanted_speed(value, late + d, theta, w)
                     - wanted_speed(value, late - d, theta, w)) / (2.0 * d)
            shaft[k, Y_X] = slope
            shaft[k, Y_V] = -slope * w[FEEDBACK_DELAY]


@njit(forceinline=True)
def add_times(value, row, to):
    """Add ``value`` times ``row`` to ``to``, (L,)."""
    if value != 0.0:
        for lane in range(row.shape[0]):
            to[lane] += value * row[lane]


@njit
def kicked(jac, constant, dt, matrix, right, kick):
    """Write the kick S - 1, (N_RATES, N_FILTERED), of what the rates' Jacobian has beyond.

    S = (1 - Z + Z^2/2)^-1 with Z = dt (J - J0): of second order, and nothing that is stiff stays.
    """
    for r in range(N_RATES):
        for i in range(N_FILTERED):
            right[r, i] = dt * (jac[r, i] - constant[r, i])
    for r in range(N_RATES):
        for i in range(N_FILTERED):
            square = 0.0
            for j in range(N_RATES):
                square += right[r, 1 + j] * right[j, i]
            kick[r, i] = right[r, i] - 0.5 * square
            if 1 <= i < N_MOVED:
                matrix[r, i - 1] = (1.0 if r == i - 1 else 0.0) - kick[r, i]
    for i in range(N_RATES):  # elimination: it is near 1, or its diagonal is large
        pivot = 1.0 / matrix[i, i]
        for r in range(i + 1, N_RATES):
            factor = matrix[r, i] * pivot
            if factor != 0.0:
                for j in range(i + 1, N_RATES):
                    matrix[r, j] -= factor * matrix[i, j]
                for j in range(N_FILTERED):
                    kick[r, j] -= factor * kick[i, j]
    for i in range(N_RATES - 1, -1, -1):
        pivot = 1.0 / matrix[i, i]
        for j in range(N_FILTERED):
            value = kick[i, j]
            for r in range(i + 1, N_RATES):
                value -= matrix[i, r] * kick[r, j]
            kick[i, j] = value * pivot


@njit
def pushed(start, phi, gamma, g, end):
    """Write Phi start + Gamma g of the moved states; g (2, N_RATES, L)."""
    lanes = start.shape[1]
    for i in range(N_MOVED):
        a0, a1, a2, a3 = phi[i, 0], phi[i, 1], phi[i, 2], phi[i, 3]
        a4, a5, a6, a7 = phi[i, 4], phi[i, 5], phi[i, 6], phi[i, 7]
        b0, b1, b2, b3 = gamma[0, i, 0], gamma[0, i, 1], gamma[0, i, 2], gamma[0, i, 3]
        d0, d1, d2, d3 = gamma[1, i, 0], gamma[1, i, 1], gamma[1, i, 2], gamma[1, i, 3]
        for lane in range(lanes):
            end[i, lane] = (
                a0 * start[0, lane] + a1 * start[1, lane] + a2 * start[2, lane]
                + a3 * start[3, lane] + a4 * start[4, lane] + a5 * start[5, lane]
                + a6 * start[6, lane] + a7 * start[7, lane])
        for lane in range(lanes):
            end[i, lane] += (
                b0 * g[0, 0, lane] + b1 * g[0, 1, lane] + b2 * g[0, 2, lane]
                + b3 * g[0, 3, lane] + d0 * g[1, 0, lane] + d1 * g[1, 1, lane]
                + d2 * g[1, 2, lane] + d3 * g[1, 3, lane])


@njit
def kick_lanes(kick, half, middle, row, delta):
    """Add what a kick in the middle of the sample does by its end."""
    for r in range(N_RATES):
        row[:] = 0.0
        for i in range(N_FILTERED):
            add_times(kick[r, i], middle[i], row)
        for i in range(N_MOVED):
            add_times(half[i, 1 + r], row, delta[i])


@njit
def stepped(points, number, g, h, delta, kept, scratch):
    """Carry delta (N_FILTERED, L) over a sample by the tangent of each Runge-Kutta step.

    Parameters
    ----------
    points, number : :class:`Points`, and which of the samples gone through by stages.
    g : (stages, N_RATES, L).
    kept : (E, 2, L) tangents of the effects' memories, carried on.
    scratch : (N_FILTERED, L), (N_MOVED, L), (N_MOVED, L).
    """
    jacs, by_memory = points.jacs[number], points.by_memory[number]
    renewed, (inside, rate, whole) = points.renewed[number], scratch
    for step in range(renewed.shape[0]):
        whole[:] = 0.0
        for stage in range(STAGES):
            at = STAGES * step + stage
            offset = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            for i in range(N_FILTERED):
                copied(inside[i], delta[i])
            if stage > 0:
                for i in range(N_MOVED):
                    add_times(offset * h, rate[i], inside[i])
            copied(rate[0], inside[1])
            for r in range(N_RATES):
                copied(rate[1 + r], g[at, r])
                for i in range(N_FILTERED):
                    add_times(jacs[at, r, i], inside[i], rate[1 + r])
                for e in range(kept.shape[0]):
                    for m in range(2):
                        add_times(by_memory[at, e, m, r], kept[e, m], rate[1 + r])
            for i in range(N_MOVED):
                add_times(h / (6.0 if stage == 0 or stage == 3 else 3.0), rate[i], whole[i])
        for i in range(N_MOVED):
            add_times(1.0, whole[i], delta[i])
        for e in range(kept.shape[0]):
            for m in range(2):
                inside[m] = 0.0
                for i in range(4):
                    add_times(renewed[step, e, m, i], delta[i], inside[m])
                for i in range(2):
                    add_times(renewed[step, e, m, 4 + i], kept[e, i], inside[m])
            for m in range(2):
                copied(kept[e, m], inside[m])


@njit(nogil=True)
def carried_on(model, motion, points, linear, lanes, corrections, used, out):
    """Carry all lanes along; write the innovations' tangents.

    Parameters
    ----------
    used : places of the channels that are measured.
    out : (n, len(used), L) written, NaN where nothing was measured.
    """
    gains, e, role, decay = corrections
    n, count, w, dt = e.shape[0], len(lanes.kinds), model.w, model.dt
    theta, updates, places = model.theta, model.updates, model.places
    phi, gamma, half, half_gamma, constant, jacs, shaft, shifts = linear
    first, hard = points.first, points.hard
    delta, other = np.zeros((N_FILTERED, count)), np.zeros((N_FILTERED, count))
    middle, kept = np.zeros((N_FILTERED, count)), np.zeros((len(updates), 2, count))
    rate, whole = np.zeros((N_MOVED, count)), np.zeros((N_MOVED, count))
    depth = 2 + math.ceil(max(w[POSITION_DELAY], w[PRESSURE_DELAY], 0.0) / dt)
    old_start, old_end = np.zeros((depth, 4, count)), np.zeros((depth, 4, count))
    matrix, right = np.zeros((N_RATES, N_RATES)), np.zeros((N_RATES, N_FILTERED))
    kick, row, taken = np.zeros((N_RATES, N_FILTERED)), np.zeros(count), np.zeros(count)
    stages = STAGES * model.steps
    shown = np.zeros((BLOCK, N_OUTPUTS, count))
    g = np.zeros((BLOCK * (stages if len(points.jacs) else SOFT), N_RATES, count))
    late = w[POSITION_DELAY] > 0.0 or w[PRESSURE_DELAY] > 0.0
    push = (theta[AREA_1] + theta[AREA_2]) / theta[M]
    begin = 0
    for k in range(n):
        if k % BLOCK == 0:
            begin = k
            compare(model, motion, points, lanes, corrections,
                    Block(k, min(k + BLOCK, n), g, shown))
        at = min(k, gains.shape[0] - 1)
        if late:
            for i in range(4):
                copied(old_end[k % depth, i], delta[i])
        for i in range(N_FILTERED):
            copied(other[i], delta[i])
        both = role[k] > 0.0 and math.isfinite(e[k, 2]) and math.isfinite(e[k, 3])
        for place in range(len(used)):
            j = used[place]
            if not math.isfinite(e[k, j]):
                out[k, place] = math.nan
                continue
            copied(row, shown[k - begin, j])
            if j == 4:
                for i in range(N_FILTERED):
                    add_times(shaft[k, i], delta[i], row)
            elif j == 1:
                add_times(1.0, delta[1], row)
            else:
                scale = 1.0 + (w[POSITION_SCALE] if j == 0 else (
                    w[PRESSURE_SCALE_1] if j == 2 else w[PRESSURE_SCALE_2]))
                delay = w[POSITION_DELAY] if j == 0 else w[PRESSURE_DELAY]
                if delay <= 0.0 or k == 0:
                    add_times(scale, delta[j], row)
                    if j == 0:
                        add_times(-scale * delay, delta[1], row)
                else:
                    since = k - delay / dt
                    ago = max(min(math.floor(since), k - 1), 0)
                    f = max(since - ago, 0.0)
                    a, b = old_start[ago % depth], old_end[(ago + 1) % depth]
                    if j == 0:
                        add_times(scale * between(1.0, 0.0, 0.0, 0.0, dt, f), a[0], row)
                        add_times(scale * between(0.0, 1.0, 0.0, 0.0, dt, f), b[0], row)
                        add_times(scale * between(0.0, 0.0, 1.0, 0.0, dt, f), a[1], row)
                        add_times(scale * between(0.0, 0.0, 0.0, 1.0, dt, f), b[1], row)
                    else:
                        add_times(scale * (1.0 - f), a[j], row)
                        add_times(scale * f, b[j], row)
            for lane in range(count):
                out[k, place, lane] = -row[lane]
            if role[k] == FREE:
                continue
            for i in range(N_FILTERED):
                add_times(-gains[at, i, j], row, other[i])
            if both and (j == 2 or j == 3):
                for lane in range(count):
                    taken[lane] = -row[lane] if j == 2 else taken[lane] + row[lane]
        if both:
            for lane in range(count):
                value = 0.5 * role[k] * (taken[lane] - (other[Y_P1, lane] - delta[Y_P1, lane])
                                         + other[Y_P2, lane] - delta[Y_P2, lane])
                other[Y_P1, lane] += value
                other[Y_P2, lane] -= value
                other[Y_V, lane] += 0.5 * dt * (value * push + shifts[k] * lanes.areas[lane])
        for i in range(len(updates)):  # remembered places move with the position
            for which in places:
                if which == updates[i]:
                    add_times(1.0, other[0], kept[i, 1])
                    add_times(-1.0, delta[0], kept[i, 1])
        if late:
            for i in range(4):
                copied(old_start[k % depth, i], other[i])
        if k == n - 1:
            break
        p = first[k] - first[begin]
        number = hard[k]
        if number >= 0:
            for i in range(N_FILTERED):
                copied(delta[i], other[i])
            stepped(points, number, g[p : p + stages], dt / model.steps, delta, kept,
                    (middle, rate, whole))
        else:
            pushed(other, phi, gamma, g[p : p + SOFT], delta)
            if len(jacs):
                for i in range(N_MOVED, N_FILTERED):
                    copied(middle[i], other[i])
                pushed(other, half, half_gamma, g[p : p + SOFT], middle)
                kicked(jacs[k], constant, dt, matrix, right, kick)
                kick_lanes(kick, half, middle, row, delta)
                for i in range(len(updates)):  # it slides, and forgets
                    kept[i, 0] = 0.0
                    copied(kept[i, 1], delta[0])
        for i in range(Y_FORCE, N_FILTERED):
            for lane in range(count):
                delta[i, lane] = decay * other[i, lane]


__all__ = ["Linear", "carried_on", "shafts"]
