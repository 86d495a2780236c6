"""The linearised filter along a trajectory, compiled: many parameters side by side.

Over a sample the difference delta of two filters whose models differ a little follows

    delta+ = Phi (delta + K d_e) + Gamma g,   d_e = -(H delta + d_shown)

with g the difference of the rates (v', p1', p2', omega') that the two models have at the same
state, and d_shown that of what their sensors show.  Phi is the plant's own Runge-Kutta map and
constant.  What active effects add to it is a kick in the middle of the sample, implicit, or,
where they turn over within it, the tangent of each Runge-Kutta step and of the effects' memory.
"""

import math

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.innovations import FREE, N_FILTERED
from eha_monitor.mismatch.likelihood.tangent_lanes import (
    apart,
    driven,
    per_turn,
    remember_all,
    sensed,
    shift_all,
)
from eha_monitor.mismatch.likelihood.tangent_motion import (
    EARLY,
    LATE,
    N_MOVED,
    N_RATES,
    between,
    course,
    inputs_at,
    jacobian,
    late_by,
    recall,
    remembered,
    state_at,
    told,
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
    N_CONTRIBUTIONS,
    N_SIGNALS,
    OMEGA,
    P1,
    P2,
    POSITION_DELAY,
    POSITION_SCALE,
    PRESSURE_DELAY,
    PRESSURE_SCALE_1,
    PRESSURE_SCALE_2,
    M,
    T,
    V,
    X,
)


@njit(nogil=True)
def shafts(model, motion, shaft):
    """Write the shown speed's derivative by the state before each correction."""
    w = model.w
    for k in range(motion.states.shape[0]):
        shaft[k, Y_SPEED] = 1.0
        if model.mode == CLOSED and model.slow:
            shaft[k, Y_OMEGA] = 1.0
        elif model.mode == CLOSED:
            value = told(motion.u, k, 0.0, w[COMMAND_DELAY], model.dt)
            late = late_by(motion, 0, k, w[FEEDBACK_DELAY], model.dt, model.steps)
            d = 1e-7
            slope = (wanted_speed(value, late + d, model.theta, w)
                     - wanted_speed(value, late - d, model.theta, w)) / (2.0 * d)
            shaft[k, Y_X] = slope
            shaft[k, Y_V] = -slope * w[FEEDBACK_DELAY]


@njit(nogil=True)
def turns_over(jacs, constant, motion, dt, typical, hard):
    """Mark the samples in which an effect turns over, (n,) bool.

    typical : (N_RATES,) size of each rate.
    """
    n = jacs.shape[0]
    for k in range(n - 1):
        for r in range(N_RATES):
            for i in range(N_MOVED):
                more = abs(jacs[k, r, i] - constant[r, i])
                moved = abs(motion.ends[k + 1, i] - motion.states[k, i])
                if more * moved > SUDDEN * typical[r]:
                    hard[k] = True
            if dt * abs(jacs[k, r, 1 + r] - constant[r, 1 + r]) > STIFF:
                hard[k] = True
        if dt * dt * abs(jacs[k, 0, 0] - constant[0, 0]) > SPRING:
            hard[k] = True


SUDDEN, STIFF, SPRING = 0.02, 0.1, 1e-3


@njit(forceinline=True)
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
    """Write Phi start + Gamma g of the moved states, the others as they are."""
    lanes = start.shape[1]
    for i in range(N_MOVED):
        a, b, d = phi[i], gamma[0, i], gamma[1, i]
        for lane in range(lanes):
            end[i, lane] = (
                a[0] * start[0, lane] + a[1] * start[1, lane] + a[2] * start[2, lane]
                + a[3] * start[3, lane] + a[4] * start[4, lane] + a[5] * start[5, lane]
                + a[6] * start[6, lane] + a[7] * start[7, lane])
        for lane in range(lanes):
            end[i, lane] += (
                b[0] * g[0, 0, lane] + b[1] * g[0, 1, lane] + b[2] * g[0, 2, lane]
                + b[3] * g[0, 3, lane] + d[0] * g[1, 0, lane] + d[1] * g[1, 1, lane]
                + d[2] * g[1, 2, lane] + d[3] * g[1, 3, lane])
    for i in range(N_MOVED, N_FILTERED):
        for lane in range(lanes):
            end[i, lane] = start[i, lane]


@njit
def stepped(model, motion, lanes, k, delta, kept, turned, size, memory, room, scratch):
    """Carry delta (N_FILTERED, L) over sample k by the tangent of each Runge-Kutta step.

    Parameters
    ----------
    kept : (E, 2, L) tangents of the effects' memories, carried on.
    turned : (2, L) of :func:`driven` at both nodes.
    size : (N_FILTERED,) of the states.
    """
    count, remembering = len(lanes.kinds), len(model.updates)
    h = model.dt / model.steps
    s, c, out = np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS), np.zeros(N_RATES)
    work, up, down = np.zeros(N_RATES), np.zeros(N_RATES), np.zeros(N_RATES)
    faster, jac = np.zeros(N_RATES), np.zeros((N_RATES, N_FILTERED))
    by_memory = np.zeros((remembering, 2, N_RATES))
    y, at, unknown = np.zeros(N_MOVED), np.zeros(N_MOVED), np.zeros(3)
    slope, total = np.zeros(N_MOVED), np.zeros(N_MOVED)
    span = np.zeros(N_FILTERED)
    g = np.zeros((N_RATES, count))
    inside, rate = np.zeros((N_FILTERED, count)), np.zeros((N_MOVED, count))
    whole, now = np.zeros((N_MOVED, count)), np.zeros(count)
    for i in range(N_FILTERED):
        span[i] = 1e-7 * size[i]
    for i in range(N_MOVED):
        y[i] = motion.states[k, i]
    for i in range(3):
        unknown[i] = motion.states[k, N_MOVED + i]
    recall(model, motion, k, memory)
    for step in range(model.steps):
        total[:], whole[:] = 0.0, 0.0
        for stage in range(4):
            offset = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            f = (step + offset) / model.steps
            for i in range(N_MOVED):
                at[i] = y[i] + offset * h * slope[i] if stage > 0 else y[i]
            for i in range(N_FILTERED):
                for lane in range(count):
                    inside[i, lane] = delta[i, lane]
                if stage > 0 and i < N_MOVED:
                    for lane in range(count):
                        inside[i, lane] += offset * h * rate[i, lane]
            if model.mode == FORCED:
                at[2] = (1.0 - f) * motion.p1[k] + f * motion.p1[k + 1]
                at[3] = (1.0 - f) * motion.p2[k] + f * motion.p2[k + 1]
            value, behind = inputs_at(model, motion, k, f, at[0], at[1])
            t = (k + f) * model.dt
            jacobian(model, at, unknown, span, t, value, behind, memory, s, c, up, down, jac)
            for e in range(remembering):
                for m in range(2):
                    which = model.updates[e]
                    was = memory[which, m]
                    d = 1e-7 * (abs(was) + (1e-6 if m == 0 else size[0]))
                    memory[which, m] = was + d
                    course(model, at, unknown, t, value, behind, memory, s, c, up)
                    memory[which, m] = was - d
                    course(model, at, unknown, t, value, behind, memory, s, c, down)
                    memory[which, m] = was
                    for r in range(N_RATES):
                        by_memory[e, m, r] = (up[r] - down[r]) / (2.0 * d)
            turning = course(model, at, unknown, t, value, behind, memory, s, c, out)
            for r in range(N_RATES):
                faster[r] = jac[r, Y_SPEED]
            along = (f - EARLY) / (LATE - EARLY)
            for lane in range(count):
                now[lane] = turned[0, lane] + along * (turned[1, lane] - turned[0, lane])
            apart(model, lanes, value, at, turning, unknown, now, faster, scratch, s, c, out,
                  room, work, g)
            weight = 1.0 if stage == 0 or stage == 3 else 2.0
            slope[0] = at[1]
            for r in range(N_RATES):
                slope[1 + r] = out[r]
            for i in range(N_MOVED):
                total[i] += weight * slope[i]
            for lane in range(count):
                rate[0, lane] = inside[1, lane]
            for r in range(N_RATES):
                for lane in range(count):
                    rate[1 + r, lane] = g[r, lane]
                for i in range(N_FILTERED):
                    share = jac[r, i]
                    if share != 0.0:
                        for lane in range(count):
                            rate[1 + r, lane] += share * inside[i, lane]
                for e in range(remembering):
                    for m in range(2):
                        share = by_memory[e, m, r]
                        if share != 0.0:
                            for lane in range(count):
                                rate[1 + r, lane] += share * kept[e, m, lane]
            for i in range(N_MOVED):
                for lane in range(count):
                    whole[i, lane] += weight * rate[i, lane]
        for i in range(N_MOVED):
            y[i] += h / 6.0 * total[i]
            for lane in range(count):
                delta[i, lane] += h / 6.0 * whole[i, lane]
        if model.mode == FORCED:
            f = (step + 1.0) / model.steps
            y[2] = (1.0 - f) * motion.p1[k] + f * motion.p1[k + 1]
            y[3] = (1.0 - f) * motion.p2[k] + f * motion.p2[k + 1]
        t = k * model.dt + (step + 1) * h
        if remembering:
            tangent_of_memory(model, t, y, h, size, delta, kept, memory, s)
        remember_all(model, lanes, t, y, h, scratch, s)


@njit
def tangent_of_memory(model, t, y, h, size, delta, kept, memory, s):
    """Carry the memories over ``h`` s that have ended at the state ``y``, and their tangents."""
    count = delta.shape[1]
    ends, derivative = np.zeros((2, 2)), np.zeros((2, 6))
    s[T] = t
    fresh = np.zeros((2, count))
    for e in range(len(model.updates)):
        one = model.updates[e : e + 1]
        which = model.updates[e]
        first, second = memory[which, 0], memory[which, 1]
        for i in range(6):
            for side in range(2):
                s[X], s[V], s[P1], s[P2] = y[0], y[1], y[2], y[3]
                memory[which, 0], memory[which, 1] = first, second
                if i < 4:
                    d = 1e-7 * size[i]
                    s[X + i] += d if side == 0 else -d
                else:
                    d = 1e-7 * (abs(memory[which, i - 4]) + (1e-6 if i == 4 else size[0]))
                    memory[which, i - 4] += d if side == 0 else -d
                remembered(s, model.theta, one, h, memory)
                ends[side] = memory[which]
            for m in range(2):
                derivative[m, i] = (ends[0, m] - ends[1, m]) / (2.0 * d)
        for m in range(2):
            for lane in range(count):
                fresh[m, lane] = (derivative[m, 4] * kept[e, 0, lane]
                                  + derivative[m, 5] * kept[e, 1, lane])
            for i in range(4):
                share = derivative[m, i]
                if share != 0.0:
                    for lane in range(count):
                        fresh[m, lane] += share * delta[i, lane]
        kept[e] = fresh
        s[X], s[V], s[P1], s[P2] = y[0], y[1], y[2], y[3]
        memory[which, 0], memory[which, 1] = first, second
        remembered(s, model.theta, one, h, memory)


@njit(nogil=True)
def carried_on(model, motion, lanes, e, gains, role, decay, areas, shifts, shaft, phi, gamma,
               half, half_gamma, jacs, constant, hard, size, memory, scratch, used, out):
    """Carry all lanes along; write the innovations' tangents.

    Parameters
    ----------
    areas : (L,) what each lane's parameter does to (A1 + A2)/M.
    shaft : (n, N_FILTERED) of :func:`shafts`.
    phi, gamma : (N, N), (2, N, N_RATES) of a sample; ``half``, ``half_gamma`` up to its middle.
    jacs : (n, N_RATES, N_FILTERED) rates' Jacobians, or (0, ...) where they are ``constant``.
    hard : (n,) bool, samples that are gone through step by step.
    memory, scratch : (N_EFFECTS, 2) scratch.
    out : (n, len(used), L) written, NaN where nothing was measured.
    """
    n, count, w, dt = e.shape[0], len(lanes.kinds), model.w, model.dt
    delta, other = np.zeros((N_FILTERED, count)), np.zeros((N_FILTERED, count))
    middle, kept = np.zeros((N_FILTERED, count)), np.zeros((len(model.updates), 2, count))
    depth = 2 + int(math.ceil(max(w[POSITION_DELAY], w[PRESSURE_DELAY], 0.0) / dt))
    old_start, old_end = np.zeros((depth, 4, count)), np.zeros((depth, 4, count))
    matrix, right = np.zeros((N_RATES, N_RATES)), np.zeros((N_RATES, N_FILTERED))
    kick, row = np.zeros((N_RATES, N_FILTERED)), np.zeros(count)
    shown, turned = np.zeros((N_OUTPUTS, count)), np.zeros((2, count))
    g, taken = np.zeros((2, N_RATES, count)), np.zeros(count)
    s, c, rates = np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS), np.zeros(N_RATES)
    room, work = np.zeros((2, N_CONTRIBUTIONS)), np.zeros(N_RATES)
    plus, minus, faster = np.zeros(N_RATES), np.zeros(N_RATES), np.zeros(N_RATES)
    y, unknown = np.zeros(N_MOVED), np.zeros(3)
    varying, drives = jacs.shape[0] > 0, (lanes.kinds == 1).any()
    for k in range(n):
        gain = gains[min(k, gains.shape[0] - 1)]
        for i in range(4):
            old_end[k % depth, i] = delta[i]
        if drives:
            sensed(model, motion, lanes, k, gain, e[k], shown)
        for i in range(N_FILTERED):
            other[i] = delta[i]
        both = role[k] > 0.0 and math.isfinite(e[k, 2]) and math.isfinite(e[k, 3])
        for place in range(len(used)):
            j = used[place]
            if not math.isfinite(e[k, j]):
                out[k, place] = math.nan
                continue
            for lane in range(count):
                row[lane] = shown[j, lane]
            if j == 4:
                for i in range(N_FILTERED):
                    value = shaft[k, i]
                    if value != 0.0:
                        for lane in range(count):
                            row[lane] += value * delta[i, lane]
            elif j == 1:
                for lane in range(count):
                    row[lane] += delta[1, lane]
            else:
                scale = 1.0 + (w[POSITION_SCALE] if j == 0 else (
                    w[PRESSURE_SCALE_1] if j == 2 else w[PRESSURE_SCALE_2]))
                delay = w[POSITION_DELAY] if j == 0 else w[PRESSURE_DELAY]
                if delay <= 0.0 or k == 0:
                    ahead = -delay if j == 0 else 0.0
                    for lane in range(count):
                        row[lane] += scale * (delta[j, lane] + ahead * delta[1, lane])
                else:
                    since = k - delay / dt
                    first = max(min(math.floor(since), k - 1), 0)
                    f = max(since - first, 0.0)
                    a, b = old_start[first % depth], old_end[(first + 1) % depth]
                    for lane in range(count):
                        if j == 0:
                            value = between(a[0, lane], b[0, lane], a[1, lane], b[1, lane], dt, f)
                        else:
                            value = a[j, lane] + f * (b[j, lane] - a[j, lane])
                        row[lane] += scale * value
            for lane in range(count):
                out[k, place, lane] = -row[lane]
            if role[k] == FREE:
                continue
            for i in range(N_FILTERED):
                value = -gain[i, j]
                if value != 0.0:
                    for lane in range(count):
                        other[i, lane] += value * row[lane]
            if both and (j == 2 or j == 3):
                for lane in range(count):
                    taken[lane] = -row[lane] if j == 2 else taken[lane] + row[lane]
        if both:
            for lane in range(count):
                value = 0.5 * role[k] * (taken[lane] - (other[Y_P1, lane] - delta[Y_P1, lane])
                                         + other[Y_P2, lane] - delta[Y_P2, lane])
                other[Y_P1, lane] += value
                other[Y_P2, lane] -= value
                other[Y_V, lane] += 0.5 * dt * (
                    value * (model.theta[AREA_1] + model.theta[AREA_2]) / model.theta[M]
                    + shifts[k] * areas[lane])
        for i in range(len(model.updates)):  # remembered places move with the position
            for which in model.places:
                if which == model.updates[i]:
                    for lane in range(count):
                        kept[i, 1, lane] += other[0, lane] - delta[0, lane]
        for i in range(4):
            old_start[k % depth, i] = other[i]
        if k == n - 1:
            break
        # ---- over the sample
        shift_all(lanes, motion.states[k, 0] - motion.ends[k, 0])
        for i in range(3):
            unknown[i] = motion.states[k, N_MOVED + i]
        recall(model, motion, k, memory)
        slow_way = varying and hard[k]
        since = 0.0
        for node in range(3):
            f = EARLY if node == 0 else (LATE if node == 1 else 1.0)
            state_at(motion, dt, k, f, y)
            if drives:
                driven(model, motion, lanes, k, f, since, y[0], y[1], y[4],
                       turned[node] if node < 2 else row)
            since = f
            if node == 2 or slow_way:
                continue
            if model.mode == FORCED:
                y[2] = (1.0 - f) * motion.p1[k] + f * motion.p1[k + 1]
                y[3] = (1.0 - f) * motion.p2[k] + f * motion.p2[k + 1]
            t = (k + f) * dt
            value, behind = inputs_at(model, motion, k, f, y[0], y[1])
            turning = course(model, y, unknown, t, value, behind, memory, s, c, rates)
            if drives:
                per_turn(model, value, y, turning, unknown, memory, s, c, room[0], plus, minus,
                         faster)
            apart(model, lanes, value, y, s[OMEGA] if model.mode == FORCED else turning, unknown,
                  turned[node], faster, scratch, s, c, rates, room, work, g[node])
            if node == 1:
                remember_all(model, lanes, t, y, f * dt, scratch, s)
                state_at(motion, dt, k, 1.0, y)
                remember_all(model, lanes, (k + 1) * dt, y, (1.0 - f) * dt, scratch, s)
        if slow_way:
            for i in range(N_FILTERED):
                delta[i] = other[i]
            stepped(model, motion, lanes, k, delta, kept, turned, size, memory, room, scratch)
        else:
            pushed(other, phi, gamma, g, delta)
        if varying and not slow_way:
            pushed(other, half, half_gamma, g, middle)
            kicked(jacs[k], constant, dt, matrix, right, kick)
            for r in range(N_RATES):
                for lane in range(count):
                    row[lane] = 0.0
                for i in range(N_FILTERED):
                    value = kick[r, i]
                    if value != 0.0:
                        for lane in range(count):
                            row[lane] += value * middle[i, lane]
                for i in range(N_MOVED):
                    value = half[i, 1 + r]
                    if value != 0.0:
                        for lane in range(count):
                            delta[i, lane] += value * row[lane]
            if len(model.updates):
                state_at(motion, dt, k, 1.0, y)
                tangent_of_memory(model, (k + 1) * dt, y, dt, size, delta, kept, memory, s)
        for i in range(Y_FORCE, N_FILTERED):
            for lane in range(count):
                delta[i, lane] = decay * other[i, lane]


__all__ = ["X", "Y_OMEGA"]
