"""Models that differ a little from the one at hand: by how much at the same state, compiled."""

import math
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.tangent_motion import (
    N_RATES,
    STAGES,
    balanced,
    commanded,
    contribute,
    lags,
    late_by,
    remembered,
    wanted_speed,
    was,
)
from eha_monitor.physics.balances import acceleration
from eha_monitor.physics.balances import rates as balance_rates
from eha_monitor.physics.plant import N_OUTPUTS, Y_OMEGA, Y_P1, Y_P2, Y_V, Y_X, drive_rate
from eha_monitor.physics.signals import (
    COMMAND_DELAY,
    DRIVE_GAIN,
    DRIVE_LAG,
    FEEDBACK_DELAY,
    IN_LOOP,
    K_POS,
    N_CONTRIBUTIONS,
    N_SIGNALS,
    OMEGA,
    P1,
    P2,
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
    SPEED_LIMIT,
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
    inverse : (L,) one over each lane's step; areas : (L,) what its parameter does to (A1 + A2)/M.
    own, same : (L, N_EFFECTS, 2) memory with the lane's effect, and with the same effect as the
        model at hand has it, both along the model's motion.
    spinning : (L, 2) speed of a drive that lags where the model's does not, rad/s, and the speed
        that it wanted last.
    """

    kinds: np.ndarray
    which: np.ndarray
    thetas: np.ndarray
    circuits: np.ndarray
    updates: np.ndarray
    places: np.ndarray
    inverse: np.ndarray
    areas: np.ndarray
    own: np.ndarray
    same: np.ndarray
    spinning: np.ndarray


class Corrections(NamedTuple):
    """What the filter corrected: gains, innovations (n, N_OUTPUTS), role (n,), decay.

    As :class:`~eha_monitor.mismatch.likelihood.innovations.Record` and ``Correction`` have them.
    """

    gains: np.ndarray
    e: np.ndarray
    role: np.ndarray
    decay: float


class Block(NamedTuple):
    """Samples ``begin`` to ``end``, of which lanes are compared.

    g, shown : (points there, N_RATES, L), (samples, N_OUTPUTS, L) written: the lanes' rates and
        sensors beyond the model's, over their steps.
    """

    begin: int
    end: int
    g: np.ndarray
    shown: np.ndarray


@njit(nogil=True)
def compare(model, motion, points, lanes, corrections, block):
    """Write the lanes' rates and sensors beyond the model's for the samples of a block."""
    for lane in range(len(lanes.kinds)):
        if lanes.kinds[lane] == BALANCE:
            other_balance(model.mode, points, lanes, lane, block)
        elif lanes.kinds[lane] == TERM:
            other_term(model, motion, points, lanes, lane, block)
        elif model.mode != FORCED:
            other_drive(model, motion, points, lanes, lane, corrections, block)


@njit
def other_balance(mode, points, lanes, lane, block):
    """Compare balances with another base parameter."""
    theta, inverse, (begin, end, g, _) = lanes.thetas[lane], lanes.inverse[lane], block
    first, signals, inner, values, rates = (points.first, points.signals, points.inner,
                                            points.value, points.rates)
    added = points.added
    several = added.shape[0] > 1
    c, y, out = np.zeros(N_CONTRIBUTIONS), np.zeros(4), np.zeros(N_RATES)
    unknown = np.zeros(2)
    base = (theta[0], theta[1], theta[2], theta[3], theta[4], theta[5], theta[6], theta[7],
            theta[8], theta[9], theta[10], theta[11])
    start = first[begin]
    stop = first[end] if end < len(first) else len(values)
    for p in range(start, stop):
        if several:
            for i in range(N_CONTRIBUTIONS):
                c[i] = added[p, i]
            y[1], y[2], y[3] = signals[p, V], signals[p, P1], signals[p, P2]
            unknown[0], unknown[1] = inner[p, 0], inner[p, 1]
            balanced(mode, values[p], y, signals[p, OMEGA], unknown, theta, c, out)
            for r in range(3):
                g[p - start, r, lane] = (out[r] - rates[p, r]) * inverse
            g[p - start, 3, lane] = 0.0
            continue
        # Numbers, not places in memory that might change: their quotients are taken once.
        alone = (inner[p, 0], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        g[p - start, 1, lane] = g[p - start, 2, lane] = g[p - start, 3, lane] = 0.0
        if mode == FORCED:
            dv = acceleration(values[p], signals[p, V], base, alone)
        else:
            dv, d1, d2 = balance_rates(signals[p, V], signals[p, P1], signals[p, P2],
                                       signals[p, OMEGA], inner[p, 1], base, alone)
            g[p - start, 1, lane] = (d1 - rates[p, 1]) * inverse
            g[p - start, 2, lane] = (d2 - rates[p, 2]) * inverse
        g[p - start, 0, lane] = (dv - rates[p, 0]) * inverse


@njit
def other_term(model, motion, points, lanes, lane, block):
    """Compare with another value of an effect's parameter, or with an effect that enters."""
    mode, dt, steps, here, terms = model.mode, model.dt, model.steps, model.theta, model.terms
    begin, end, g, _ = block
    theta, one, inverse = lanes.thetas[lane], lanes.which[lane : lane + 1], lanes.inverse[lane]
    remembers, by_place = lanes.updates[lane], lanes.places[lane]
    own, same = lanes.own[lane], lanes.same[lane]
    states, ends = motion.states, motion.ends
    first, signals, inner, values, rates, added = (
        points.first, points.signals, points.inner, points.value, points.rates, points.added)
    hard, reached = points.hard, points.reached
    c, there, s = np.zeros(N_CONTRIBUTIONS), np.zeros(N_CONTRIBUTIONS), np.zeros(N_SIGNALS)
    y, out, unknown = np.zeros(4), np.zeros(N_RATES), np.zeros(2)
    which = one[0]
    inside = False
    for place in terms:
        inside |= place == which
    start = first[begin]
    for k in range(begin, min(end, states.shape[0] - 1)):
        stages = STAGES * steps if hard[k] >= 0 else 2
        if by_place:
            own[which, 1] += states[k, 0] - ends[k, 0]
            same[which, 1] += states[k, 0] - ends[k, 0]
        for point in range(stages):
            p = first[k] + point
            for i in range(N_SIGNALS):
                s[i] = signals[p, i]
            y[1], y[2], y[3] = s[V], s[P1], s[P2]
            contribute(s, theta, one, own, c)
            if inside:
                contribute(s, here, one, same, there)
                for i in range(N_CONTRIBUTIONS):
                    c[i] += added[p, i] - there[i]
            elif len(terms):
                for i in range(N_CONTRIBUTIONS):
                    c[i] += added[p, i]
            unknown[0], unknown[1] = inner[p, 0], inner[p, 1]
            balanced(mode, values[p], y, s[OMEGA], unknown, here, c, out)
            for r in range(3):
                g[p - start, r, lane] = (out[r] - rates[p, r]) * inverse
            g[p - start, 3, lane] = 0.0
            if not remembers:
                continue
            if hard[k] >= 0 and point % STAGES == STAGES - 1:
                step = point // STAGES
                s[X], s[V] = reached[hard[k], step, 0], reached[hard[k], step, 1]
                s[P1], s[P2] = reached[hard[k], step, 2], reached[hard[k], step, 3]
                remembered(s, theta, one, dt / steps, own)
                if inside:
                    remembered(s, here, one, dt / steps, same)
            elif hard[k] < 0 and point == 1:
                s[T] = (k + 1) * dt
                s[X], s[V], s[P1], s[P2] = (ends[k + 1, Y_X], ends[k + 1, Y_V],
                                            ends[k + 1, Y_P1], ends[k + 1, Y_P2])
                remembered(s, theta, one, dt, own)
                if inside:
                    remembered(s, here, one, dt, same)


@njit(forceinline=True)
def shown_by(j, t, value, w):
    """Return what a sensor shows at time ``t`` of a late position (m) or pressure (Pa)."""
    if j == 0:
        return (1.0 + w[POSITION_SCALE]) * value
    if j == 2:
        return (1.0 + w[PRESSURE_SCALE_1]) * value + w[PRESSURE_OFFSET_1] + w[PRESSURE_DRIFT_1] * t
    return (1.0 + w[PRESSURE_SCALE_2]) * value + w[PRESSURE_OFFSET_2] + w[PRESSURE_DRIFT_2] * t


@njit
def followed(omega, before, wanted, h, lag, slew):
    """Return a lagging drive's speed after ``h`` s of a wanted speed that is linear in time."""
    if h <= 0.0:
        return omega
    slope = (wanted - before) / h
    target = wanted - slope * lag + (omega - before + slope * lag) * math.exp(-h / lag)
    return omega + min(max(target - omega, -slew * h), slew * h)


@njit(forceinline=True)
def differ(other, w, places):
    """Tell whether two circuits differ at any of some places."""
    found = False
    for i in places:
        found |= other[i] != w[i]
    return found


@njit
def other_drive(model, motion, points, lanes, lane, corrections, block):
    """Compare another drive and other sensors, along the motion."""
    mode, dt, steps, here, w, slow, lag, shortest, _, _, _ = model
    u, states, ends = motion.u, motion.states, motion.ends
    begin, end, g, shown = block
    gains, e, _, _ = corrections
    theta, other, inverse = lanes.thetas[lane], lanes.circuits[lane], lanes.inverse[lane]
    spinning = lanes.spinning[lane]
    first, places, rates, faster, hard = (points.first, points.place, points.signals,
                                          points.faster, points.hard)
    own_lag, lagging = max(other[DRIVE_LAG], shortest), lags(other) and not slow
    sensors_only = theta[K_POS] == here[K_POS] and not differ(other, w, (
        DRIVE_GAIN, DRIVE_LAG, SPEED_LIMIT, SLEW_LIMIT, COMMAND_DELAY, FEEDBACK_DELAY, IN_LOOP))
    if other[IN_LOOP] != 0.0:
        sensors_only = sensors_only and other[POSITION_SCALE] == w[POSITION_SCALE]
    start = first[begin]
    showing = (differ(other, w, (POSITION_DELAY, POSITION_SCALE)),
               False,
               differ(other, w, (PRESSURE_DELAY, PRESSURE_SCALE_1, PRESSURE_OFFSET_1,
                                        PRESSURE_DRIFT_1)),
               differ(other, w, (PRESSURE_DELAY, PRESSURE_SCALE_2, PRESSURE_OFFSET_2,
                                 PRESSURE_DRIFT_2)))
    for k in range(begin, end):
        t = k * dt
        for j in (0, 2, 3):
            if not showing[j]:
                continue
            place = POSITION_DELAY if j == 0 else PRESSURE_DELAY
            now = late_by(model, motion, j, k, w[place])
            then = now
            if other[place] != w[place]:
                then = late_by(model, motion, j, k, other[place])
            shown[k - begin, j, lane] = (shown_by(j, t, then, other)
                                         - shown_by(j, t, now, w)) * inverse
        if not slow and not sensors_only:
            value = commanded(u, k, 0.0, w[COMMAND_DELAY], dt)
            then = commanded(u, k, 0.0, other[COMMAND_DELAY], dt)
            if mode == CLOSED:
                late = late_by(model, motion, 0, k, w[FEEDBACK_DELAY])
                value = wanted_speed(value, late, here, w)
                late = late_by(model, motion, 0, k, other[FEEDBACK_DELAY])
                then = wanted_speed(then, late, theta, other)
                if lagging:
                    if k == 0:
                        spinning[0] = spinning[1] = then
                    then = spinning[0]
                    for j in range(N_OUTPUTS):  # the gains correct its speed too
                        if math.isfinite(e[k, j]):
                            spinning[0] += gains[min(k, gains.shape[0] - 1), Y_OMEGA, j] * e[k, j]
            shown[k - begin, 4, lane] = (then - value) * inverse
        if k == states.shape[0] - 1:
            break
        stages = STAGES * steps if hard[k] >= 0 else 2
        if sensors_only:
            for point in range(stages):
                for r in range(N_RATES):
                    g[first[k] - start + point, r, lane] = 0.0
            continue
        since = 0.0
        for point in range(stages + (1 if lagging else 0)):
            p = first[k] + point
            f = places[p] if point < stages else 1.0
            x = rates[p, X] if point < stages else ends[k + 1, Y_X]
            value = commanded(u, k, f, w[COMMAND_DELAY], dt)
            then = commanded(u, k, f, other[COMMAND_DELAY], dt)
            if mode == CLOSED:
                now = late = x
                if w[FEEDBACK_DELAY] > 0.0:
                    now = was(motion, 0, dt, k + f - w[FEEDBACK_DELAY] / dt)
                if other[FEEDBACK_DELAY] > 0.0:
                    late = was(motion, 0, dt, k + f - other[FEEDBACK_DELAY] / dt)
                value = wanted_speed(value, now, here, w)
                then = wanted_speed(then, late, theta, other)
                if slow:
                    omega = rates[p, OMEGA] - states[k, 7]
                    g[p - start, 3, lane] = (
                        drive_rate(then, omega, own_lag, other[SLEW_LIMIT])
                        - drive_rate(value, omega, lag, w[SLEW_LIMIT])) * inverse
                elif lagging:
                    spinning[0] = followed(spinning[0], spinning[1], then, (f - since) * dt,
                                           own_lag, other[SLEW_LIMIT])
                    spinning[1], then = then, spinning[0]
                    since = f
            if not slow and point < stages:
                change = (then - value) * inverse
                for r in range(3):
                    g[p - start, r, lane] = faster[p, r] * change
                g[p - start, 3, lane] = 0.0
            elif slow:
                for r in range(3):
                    g[p - start, r, lane] = 0.0


__all__ = ["BALANCE", "DRIVE", "TERM"]
