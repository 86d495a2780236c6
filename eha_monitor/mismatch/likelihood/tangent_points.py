"""Points along a motion at which the models beside it are compared, compiled.

A sample has two, at Gauss's places, or the stages of its Runge-Kutta steps where an effect turns
over within it; there the Jacobians of rates and memories are kept as well.
"""

from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.small_matrices import copied
from eha_monitor.mismatch.data.inputs import FORCED
from eha_monitor.mismatch.likelihood.innovations import N_FILTERED
from eha_monitor.mismatch.likelihood.tangent_motion import (
    EARLY,
    LATE,
    N_MOVED,
    N_RATES,
    Model,
    Motion,
    Scratch,
    balanced,
    contribute,
    course,
    here_at,
    jacobian,
    recall,
    remembered,
    state_at,
)
from eha_monitor.physics.plant import Y_SPEED
from eha_monitor.physics.signals import (
    N_CONTRIBUTIONS,
    N_SIGNALS,
    OMEGA,
    P1,
    P2,
    X_D,
    T,
    V,
    X,
)

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
