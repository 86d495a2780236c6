"""Models that differ a little from the one at hand: how much at the same state, compiled."""

import math
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.tangent_motion import (
    N_RATES,
    balanced,
    contribute,
    lags,
    late_by,
    remembered,
    told,
    wanted_speed,
    was,
)
from eha_monitor.physics.plant import N_OUTPUTS, Y_OMEGA, drive_rate
from eha_monitor.physics.signals import (
    COMMAND_DELAY,
    DRIVE_LAG,
    FEEDBACK_DELAY,
    N_CONTRIBUTIONS,
    OMEGA,
    POSITION_DELAY,
    POSITION_SCALE,
    PRESSURE_DELAY,
    PRESSURE_DRIFT_1,
    PRESSURE_DRIFT_2,
    PRESSURE_OFFSET_1,
    PRESSURE_OFFSET_2,
    PRESSURE_SCALE_1,
    PRESSURE_SCALE_2,
    SLEW_LIMIT,
    P1,
    P2,
    T,
    V,
    X,
)

BALANCE, DRIVE, TERM = 0, 1, 2  # what a lane has different: a base parameter, drive or sensors


class Lanes(NamedTuple):
    """Models beside the one at hand.

    kinds, which : (L,) what they have different; the effect's place for ``TERM``.
    thetas, circuits : (L, N_THETA), (L, N_CIRCUIT) of each.
    updates, places : (L,) bool, its effect remembers; it remembers a place.
    inverse : (L,) one over each lane's step.
    own, same : (L, 2) memory of the lane's effect, and of the same effect as the model at hand
        has it, both along the model's motion.
    spinning, before : (L,) speed of a drive that lags where the model's does not, rad/s, and the
        speed that it wanted last.
    """

    kinds: np.ndarray
    which: np.ndarray
    thetas: np.ndarray
    circuits: np.ndarray
    updates: np.ndarray
    places: np.ndarray
    inverse: np.ndarray
    own: np.ndarray
    same: np.ndarray
    spinning: np.ndarray
    before: np.ndarray


@njit(forceinline=True)
def shown_by(j, t, value, w):
    """Return what a sensor shows at time ``t`` of a late position (m) or pressure (Pa)."""
    if j == 0:
        return (1.0 + w[POSITION_SCALE]) * value
    if j == 2:
        return (1.0 + w[PRESSURE_SCALE_1]) * value + w[PRESSURE_OFFSET_1] + w[PRESSURE_DRIFT_1] * t
    return (1.0 + w[PRESSURE_SCALE_2]) * value + w[PRESSURE_OFFSET_2] + w[PRESSURE_DRIFT_2] * t


@njit
def sensed(model, motion, lanes, k, gain, e, shown):
    """Write what the lanes' sensors show beyond the model's before sample k, (N_OUTPUTS, L)."""
    if model.mode == FORCED:
        return
    w, dt, t = model.w, model.dt, k * model.dt
    for lane in range(len(lanes.kinds)):
        if lanes.kinds[lane] != DRIVE:
            continue
        other, inverse = lanes.circuits[lane], lanes.inverse[lane]
        for j in (0, 2, 3):
            place = POSITION_DELAY if j == 0 else PRESSURE_DELAY
            here = late_by(motion, j, k, w[place], dt, model.steps)
            there = here
            if other[place] != w[place]:
                there = late_by(motion, j, k, other[place], dt, model.steps)
            shown[j, lane] = (shown_by(j, t, there, other) - shown_by(j, t, here, w)) * inverse
        if model.slow:
            continue
        value = told(motion.u, k, 0.0, w[COMMAND_DELAY], dt)
        there = told(motion.u, k, 0.0, other[COMMAND_DELAY], dt)
        if model.mode == CLOSED:
            late = late_by(motion, 0, k, w[FEEDBACK_DELAY], dt, model.steps)
            value = wanted_speed(value, late, model.theta, w)
            late = late_by(motion, 0, k, other[FEEDBACK_DELAY], dt, model.steps)
            there = wanted_speed(there, late, lanes.thetas[lane], other)
            if lags(other):
                if k == 0:
                    lanes.spinning[lane] = lanes.before[lane] = there
                there = lanes.spinning[lane]
                for j in range(N_OUTPUTS):  # the gains correct its speed too
                    if math.isfinite(e[j]):
                        lanes.spinning[lane] += gain[Y_OMEGA, j] * e[j]
        shown[4, lane] = (there - value) * inverse


@njit
def followed(omega, before, wanted, h, lag, slew):
    """Return a lagging drive's speed after ``h`` s of a wanted speed that is linear in time."""
    slope = (wanted - before) / h
    target = wanted - slope * lag + (omega - before + slope * lag) * math.exp(-h / lag)
    return omega + min(max(target - omega, -slew * h), slew * h)


@njit
def driven(model, motion, lanes, k, f, since, x, v, omega, out):
    """Write by how much the lanes' drives turn faster, or gain speed where the model's lags, (L,).

    f, since : places in sample k, of now and of the last call.
    """
    if model.mode == FORCED:
        return
    dt, w = model.dt, model.w
    for lane in range(len(lanes.kinds)):
        if lanes.kinds[lane] != DRIVE:
            continue
        other = lanes.circuits[lane]
        value = told(motion.u, k, f, w[COMMAND_DELAY], dt)
        there = value
        if other[COMMAND_DELAY] != w[COMMAND_DELAY]:
            there = told(motion.u, k, f, other[COMMAND_DELAY], dt)
        if model.mode == CLOSED:
            here = x
            if w[FEEDBACK_DELAY] > 0.0:
                here = was(motion, 0, dt, k + f - w[FEEDBACK_DELAY] / dt)
            late = here
            if other[FEEDBACK_DELAY] != w[FEEDBACK_DELAY]:
                late = was(motion, 0, dt, k + f - other[FEEDBACK_DELAY] / dt)
            value = wanted_speed(value, here, model.theta, w)
            there = wanted_speed(there, late, lanes.thetas[lane], other)
            if model.slow:
                value = drive_rate(value, omega, model.lag, w[SLEW_LIMIT])
                there = drive_rate(there, omega, max(other[DRIVE_LAG], model.shortest),
                                   other[SLEW_LIMIT])
            elif lags(other):
                lanes.spinning[lane] = followed(
                    lanes.spinning[lane], lanes.before[lane], there, (f - since) * dt,
                    max(other[DRIVE_LAG], model.shortest), other[SLEW_LIMIT])
                lanes.before[lane] = there
                there = lanes.spinning[lane]
        out[lane] = (there - value) * lanes.inverse[lane]


@njit
def per_turn(model, value, y, turning, unknown, memory, s, c, scratch, plus, minus, out):
    """Write v', p1', p2' for a shaft that turns 1 rad/s faster; ``c`` is left."""
    if model.mode == FORCED:
        out[:] = 0.0
        return
    d = 1e-3 * (1.0 + abs(turning))
    for side in range(2):
        there = turning + (d if side == 0 else -d)
        scratch[:] = c
        if len(model.terms):
            s[OMEGA] = there
            contribute(s, model.theta, model.terms, memory, scratch)
        balanced(model.mode, value, y, there, unknown, model.theta, scratch,
                 plus if side == 0 else minus)
    s[OMEGA] = turning
    for r in range(3):
        out[r] = (plus[r] - minus[r]) / (2.0 * d)


@njit
def apart(model, lanes, value, y, turning, unknown, turned, faster, memory, s, c, rates, room,
          work, g):
    """Write the lanes' rates at a state beyond the model's, (N_RATES, L), over their steps.

    Parameters
    ----------
    turning, s, c, rates : the model's own there, of :func:`course`.
    turned : (L,) of :func:`driven`; faster : (N_RATES,) of :func:`per_turn`.
    memory : (N_EFFECTS, 2) scratch.
    room, work : (2, N_CONTRIBUTIONS), (N_RATES,) scratch.
    """
    for lane in range(len(lanes.kinds)):
        kind, inverse = lanes.kinds[lane], lanes.inverse[lane]
        if kind == TERM:
            which, one = lanes.which[lane], lanes.which[lane : lane + 1]
            if lanes.updates[lane]:
                memory[which] = lanes.own[lane]
            contribute(s, lanes.thetas[lane], one, memory, room[0])
            for i in range(N_CONTRIBUTIONS):
                room[0, i] += c[i]
            for place in model.terms:
                if place == which:
                    if lanes.updates[lane]:
                        memory[which] = lanes.same[lane]
                    contribute(s, model.theta, one, memory, room[1])
                    for i in range(N_CONTRIBUTIONS):
                        room[0, i] -= room[1, i]
            balanced(model.mode, value, y, turning, unknown, model.theta, room[0], work)
        elif kind == BALANCE:
            balanced(model.mode, value, y, turning, unknown, lanes.thetas[lane], c, work)
        elif model.slow:
            g[3, lane] = turned[lane]
            continue
        else:
            for r in range(3):
                g[r, lane] = faster[r] * turned[lane]
            continue
        for r in range(3):
            g[r, lane] = (work[r] - rates[r]) * inverse


@njit
def remember_all(model, lanes, t, y, h, memory, s):
    """Carry the lanes' memories over ``h`` s that have ended at the state ``y``."""
    s[T], s[X], s[V], s[P1], s[P2] = t, y[0], y[1], y[2], y[3]
    for lane in range(len(lanes.kinds)):
        if not lanes.updates[lane]:
            continue
        which, one = lanes.which[lane], lanes.which[lane : lane + 1]
        memory[which] = lanes.own[lane]
        remembered(s, lanes.thetas[lane], one, h, memory)
        lanes.own[lane] = memory[which]
        memory[which] = lanes.same[lane]
        remembered(s, model.theta, one, h, memory)
        lanes.same[lane] = memory[which]


@njit
def shift_all(lanes, by):
    """Move the lanes' remembered places with a correction of the position by ``by`` m."""
    for lane in range(len(lanes.kinds)):
        if lanes.places[lane]:
            lanes.own[lane, 1] += by
            lanes.same[lane, 1] += by


__all__ = ["BALANCE", "DRIVE", "N_RATES", "TERM"]
