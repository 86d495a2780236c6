"""The linearised filter along a trajectory, compiled: many parameters side by side.

Over a sample the difference delta of two filters whose models differ a little follows

    delta+ = Phi (delta + K d_e) + Gamma g,   d_e = -(H delta + d_shown)

with g the difference of the rates (v', p1', p2', omega') that the two models have at the same
state, and d_shown that of what their sensors show.  Phi is the plant's own Runge-Kutta map, constant;
what active effects add to it, which changes along the way, is a kick in the middle of the sample,
implicit, so that a friction that turns over within a step stays stable.
"""

import math

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.mismatch.innovations import CLOSED, FORCED, FREE, N_FILTERED
from eha_monitor.physics.balances import acceleration, drive_speed, rates
from eha_monitor.physics.contributions import add_contributions, shift_memory, update_memory
from eha_monitor.physics.plant import (
    N_OUTPUTS,
    Y_FLOW,
    Y_FORCE,
    Y_OMEGA,
    Y_P1,
    Y_P2,
    Y_SPEED,
    Y_V,
    Y_X,
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
    N_BASE,
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
    X_D,
    M,
    T,
    V,
    X,
)

BASE, TERM, CIRCUIT = 0, 1, 2  # what a lane's model has different
N_RATES = 4  # v', p1', p2', omega'
N_MOVED = 5  # x, v, p1, p2, omega: the states that the rates move
EARLY, LATE = 0.5 - 0.5 / math.sqrt(3.0), 0.5 + 0.5 / math.sqrt(3.0)  # of a sample: Gauss
TINY = 1e-6  # of a state's size: for its derivative


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
def was(starts, ends, slopes, slopes_end, i, dt, place):
    """Return state ``i`` at ``place`` samples after the first; before it all rests."""
    j = min(max(math.floor(place), 0), starts.shape[0] - 2)
    f = min(max(place - j, 0.0), 1.0)
    return between(starts[j, i], ends[j + 1, i], slopes[j, i], slopes_end[j + 1, i], dt, f)


@njit
def told(u, k, f, delay, dt):
    """Return the input ``f`` into sample k as it reaches the drive."""
    if delay == 0.0:
        return piece_at(u, k, f)
    return input_at(u, 1, k + f - delay / dt)


@njit(forceinline=True)
def wanted_speed(value, late, theta, w):
    """Return the shaft speed that the drive wants, within its limit, rad/s."""
    return shaft_speed(drive_speed(value, seen_by_drive(late, late, w), theta, w), w)


@njit
def course(mode, slow, y, unknown, t, value, behind, theta, w, lag, terms, memory, s, c, out):
    """Write the rates at a state and leave the signals there in ``s``; return the shaft's speed.

    Parameters
    ----------
    y : (N_MOVED,) state; unknown : (3,) force, flow, speed.
    value : input as it reaches the drive.
    behind : what the drive's late position is ahead of x - T v, m.
    lag : s, where the drive is ``slow``.
    out : (N_RATES,) written.
    """
    turning = value
    out[3] = 0.0
    if mode == CLOSED:
        turning = wanted_speed(value, y[0] - w[FEEDBACK_DELAY] * y[1] + behind, theta, w)
        if slow:
            out[3] = drive_rate(turning, y[4], lag, w[SLEW_LIMIT])
            turning = y[4]
    turning += unknown[2]
    s[T], s[X], s[V], s[P1], s[P2] = t, y[0], y[1], y[2], y[3]
    s[OMEGA], s[X_D] = turning, value
    if mode == FORCED:
        s[OMEGA] = s[X_D] = 0.0
    if len(terms):
        contribute(s, theta, terms, memory, c)
    rest(mode, value, y, turning, unknown, theta, c, out)
    return turning


@njit(forceinline=True)
def rest(mode, value, y, turning, unknown, theta, c, out):
    """Write v', p1', p2' at given contributions."""
    c[FORCE] += unknown[0]
    if mode == FORCED:
        out[0], out[1], out[2] = acceleration(value, y[1], theta, c), 0.0, 0.0
    else:
        out[0], out[1], out[2] = rates(y[1], y[2], y[3], turning, unknown[1], theta, c)
    c[FORCE] -= unknown[0]


@njit
def jacobian(mode, slow, y, unknown, span, t, value, behind, theta, w, lag, terms, memory, s, c,
             up, down, jac):
    """Write the rates' derivatives by all filtered states, (N_RATES, N_FILTERED).

    span : (N_FILTERED,) half of each difference: over what the state moves in a sample, so that
    what turns over faster counts by its mean.
    """
    for i in range(N_FILTERED):
        d = span[i]
        if i < N_MOVED:
            kept = y[i]
            y[i] = kept + d
            course(mode, slow, y, unknown, t, value, behind, theta, w, lag, terms, memory, s, c, up)
            y[i] = kept - d
            course(mode, slow, y, unknown, t, value, behind, theta, w, lag, terms, memory, s, c,
                   down)
            y[i] = kept
        else:
            kept = unknown[i - N_MOVED]
            unknown[i - N_MOVED] = kept + d
            course(mode, slow, y, unknown, t, value, behind, theta, w, lag, terms, memory, s, c, up)
            unknown[i - N_MOVED] = kept - d
            course(mode, slow, y, unknown, t, value, behind, theta, w, lag, terms, memory, s, c,
                   down)
            unknown[i - N_MOVED] = kept
        for r in range(N_RATES):
            jac[r, i] = (up[r] - down[r]) / (2.0 * d)


@njit(nogil=True)
def predicted_states(states, e, gains, role, dt, theta, ends, shifts):
    """Write the states before their correction, (n, N_FILTERED), and what a role took over.

    shifts : (n,) half the pressure difference that was taken from the sensors, Pa.
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


@njit(nogil=True)
def slopes_along(mode, slow, states, ends, u, p1, p2, dt, theta, w, lag, terms, places, updates,
                 slopes, slopes_end, memories):
    """Write the rates (x', v', p1', p2', omega') after and before each correction, and memories.

    memories : (n, 3, E, 2), of the ``updates`` at the start, middle and end of each sample.
    """
    n = states.shape[0]
    s, c, out = np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS), np.zeros(N_RATES)
    y, unknown = np.zeros(N_MOVED), np.zeros(3)
    memory = np.zeros((memories.shape[2], 2))
    for k in range(n):
        shift_memory(places, states[k, 0] - ends[k, 0], memory)
        if memories.shape[0] > 1:
            memories[k, 0] = memory
        for side in range(2):
            here = k if side == 0 else k + 1
            if here == n:
                break
            for i in range(N_MOVED):
                y[i] = states[k, i] if side == 0 else ends[k + 1, i]
            for i in range(3):
                unknown[i] = states[k, N_MOVED + i]
            if mode == FORCED:
                y[2], y[3] = p1[here], p2[here]
            value = told(u, k, float(side), w[COMMAND_DELAY], dt)
            behind = 0.0
            if w[FEEDBACK_DELAY] > 0.0 and k > 0:  # slopes up to here are known
                place = k + side - w[FEEDBACK_DELAY] / dt
                if place <= k - 1e-9:
                    behind = (was(states, ends, slopes, slopes_end, 0, dt, place)
                              - y[0] + w[FEEDBACK_DELAY] * y[1])
            if side == 1 and len(updates):
                s[T], s[V], s[P1], s[P2] = (k + 0.5) * dt, 0.5 * (states[k, 1] + y[1]), 0.5 * (
                    states[k, 2] + y[2]), 0.5 * (states[k, 3] + y[3])
                s[X] = between(states[k, 0], y[0], states[k, 1], y[1], dt, 0.5)
                remembered(s, theta, updates, 0.5 * dt, memory)
                memories[k, 1] = memory
                s[T], s[X], s[V], s[P1], s[P2] = (k + 1) * dt, y[0], y[1], y[2], y[3]
                remembered(s, theta, updates, 0.5 * dt, memory)
                memories[k, 2] = memory
            course(mode, slow, y, unknown, (k + side) * dt, value, behind, theta, w, lag, terms,
                   memory, s, c, out)
            written = slopes if side == 0 else slopes_end
            written[here, 0] = y[1]
            for i in range(N_RATES):
                written[here, 1 + i] = out[i]
    slopes_end[0] = slopes[0]


@njit(forceinline=True)
def shown_by(j, t, position, v, pressure, w):
    """Return what a sensor shows of the late position (m) or pressure (Pa)."""
    if j == 0:
        return (1.0 + w[POSITION_SCALE]) * position
    if j == 1:
        return v
    if j == 2:
        return (1.0 + w[PRESSURE_SCALE_1]) * pressure + w[PRESSURE_OFFSET_1] + (
            w[PRESSURE_DRIFT_1] * t)
    return (1.0 + w[PRESSURE_SCALE_2]) * pressure + w[PRESSURE_OFFSET_2] + w[PRESSURE_DRIFT_2] * t


@njit
def late_by(starts, ends, slopes, slopes_end, i, k, delay, dt, steps):
    """Return state ``i`` as it was ``delay`` s before sample k, before its correction."""
    if delay == 0.0:
        return ends[k, i]
    if delay < 0.0 or k == 0:
        return ends[k, i] - delay * slopes_end[k, i]
    if i == 0:
        return was(starts, ends, slopes, slopes_end, i, dt, k - delay / dt)
    # Of the pressures the filter knows the ends of its steps, and goes straight between them.
    step = dt / steps
    j = math.floor(delay / step)
    f = delay / step - j
    new = ends[k, i] if j == 0 else was(starts, ends, slopes, slopes_end, i, dt, k - j / steps)
    return (1.0 - f) * new + f * was(starts, ends, slopes, slopes_end, i, dt,
                                     k - (j + 1) / steps)


@njit(nogil=True)
def forced(mode, slow, states, ends, slopes, slopes_end, memories, u, p1, p2, dt, steps, theta, w, lag,
           shortest, terms, kinds, thetas, circuits, which, has_update, has_place, inverse, gains, e,
           node_g, shown):
    """Write what drives the lanes: differences of the rates at two nodes, and of the sensors.

    Parameters
    ----------
    states, ends : (n, N_FILTERED) after and before each correction; slopes of the first five.
    memories : (n, 3, E, 2) of the model at hand, or (1, ...) where none remembers.
    kinds, thetas, circuits, which : (L,), (L, N_THETA), (L, N_CIRCUIT), (L,) of the lanes' models.
    inverse : (L,) one over each lane's step.
    node_g : (n, 2, N_RATES, L), shown : (n, N_OUTPUTS, L) written, over the step.
    """
    n, lanes = states.shape[0], len(kinds)
    s, c, out = np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS), np.zeros(N_RATES)
    plus, minus = np.zeros(N_RATES), np.zeros(N_RATES)
    other = np.zeros(N_CONTRIBUTIONS)
    each = np.zeros((len(terms), N_CONTRIBUTIONS))
    y, unknown = np.zeros(N_MOVED), np.zeros(3)
    per_turn = np.zeros(N_RATES)
    effects = memories.shape[2]
    memory = np.zeros((effects, 2))
    own = np.zeros((lanes, effects if has_update.any() else 1, 2))
    spinning = np.zeros(lanes)  # speed of lanes whose drive lags where the model's does not
    before_wanted = np.zeros(lanes)
    for k in range(n):
        # ---- what the sensors show of the state before its correction
        t = k * dt
        if mode != FORCED:
            for lane in range(lanes):
                if kinds[lane] == TERM:
                    continue
                for j in range(4):
                    if kinds[lane] == BASE or j == 1:
                        continue
                    place = POSITION_DELAY if j == 0 else PRESSURE_DELAY
                    there = late_by(states, ends, slopes, slopes_end, j, k,
                                    circuits[lane, place], dt, steps)
                    here = late_by(states, ends, slopes, slopes_end, j, k, w[place], dt, steps)
                    shown[k, j, lane] = (
                        shown_by(j, t, there, 0.0, there, circuits[lane])
                        - shown_by(j, t, here, 0.0, here, w)) * inverse[lane]
                if slow and mode == CLOSED:
                    continue
                value = told(u, k, 0.0, w[COMMAND_DELAY], dt)
                there = told(u, k, 0.0, circuits[lane, COMMAND_DELAY], dt)
                if mode == CLOSED:
                    late = late_by(states, ends, slopes, slopes_end, 0, k, w[FEEDBACK_DELAY], dt, steps)
                    value = wanted_speed(value, late, theta, w)
                    late = late_by(states, ends, slopes, slopes_end, 0, k,
                                   circuits[lane, FEEDBACK_DELAY], dt, steps)
                    there = wanted_speed(there, late, thetas[lane], circuits[lane])
                    if lags(circuits[lane]):
                        if k == 0:
                            spinning[lane] = there
                        there = spinning[lane]
                        for j in range(N_OUTPUTS):  # gains correct its speed too
                            if math.isfinite(e[k, j]):
                                spinning[lane] += gains[min(k, gains.shape[0] - 1), Y_OMEGA, j] * (
                                    e[k, j])
                shown[k, 4, lane] = (there - value) * inverse[lane]
        if k == n - 1:
            break
        for i in range(3):
            unknown[i] = states[k, N_MOVED + i]
        if memories.shape[0] > 1:
            memory[:] = memories[k, 0]
        for lane in range(lanes):
            if kinds[lane] == TERM and has_place[lane]:
                own[lane, which[lane], 1] += states[k, 0] - ends[k, 0]
        last_f = 0.0
        for node in range(3):  # two nodes, and the end for what is remembered
            f = EARLY if node == 0 else (LATE if node == 1 else 1.0)
            t = (k + f) * dt
            for i in range(N_MOVED):
                y[i] = between(states[k, i], ends[k + 1, i], slopes[k, i], slopes_end[k + 1, i],
                               dt, f)
            if mode == FORCED:
                y[2], y[3] = (1.0 - f) * p1[k] + f * p1[k + 1], (1.0 - f) * p2[k] + f * p2[k + 1]
            value = told(u, k, f, w[COMMAND_DELAY], dt)
            behind = 0.0
            if w[FEEDBACK_DELAY] > 0.0:
                behind = (was(states, ends, slopes, slopes_end, 0, dt,
                              k + f - w[FEEDBACK_DELAY] / dt)
                          - y[0] + w[FEEDBACK_DELAY] * y[1])
            if node < 2:
                turning = course(mode, slow, y, unknown, t, value, behind, theta, w, lag, terms,
                                 memory, s, c, out)
                for i in range(len(terms)):
                    contribute(s, theta, terms[i : i + 1], memory, each[i])
                per_turn_at(mode, value, y, turning, unknown, theta, terms, memory, s, c, plus,
                            minus, per_turn)
                s[OMEGA] = turning if mode != FORCED else 0.0
                g = node_g[k, node]
            else:
                s[T], s[X], s[V], s[P1], s[P2] = t, y[0], y[1], y[2], y[3]
            for lane in range(lanes):
                if kinds[lane] == TERM:
                    place = which[lane]
                    if node < 2:
                        contribute(s, thetas[lane], which[lane : lane + 1], own[lane], other)
                        for i in range(N_CONTRIBUTIONS):
                            other[i] += c[i]
                        for r in range(len(terms)):
                            if terms[r] == place:
                                for i in range(N_CONTRIBUTIONS):
                                    other[i] -= each[r, i]
                        rest(mode, value, y, s[OMEGA], unknown, theta, other, plus)
                        for r in range(3):
                            g[r, lane] = (plus[r] - out[r]) * inverse[lane]
                    if node > 0 and has_update[lane]:
                        remembered(s, thetas[lane], which[lane : lane + 1], (f - last_f) * dt,
                                   own[lane])
                elif node < 2 and kinds[lane] == BASE and which[lane] >= 0:
                    rest(mode, value, y, turning, unknown, thetas[lane], c, plus)
                    for r in range(3):
                        g[r, lane] = (plus[r] - out[r]) * inverse[lane]
                if kinds[lane] == CIRCUIT or (kinds[lane] == BASE and which[lane] < 0):
                    if mode == FORCED:
                        continue
                    there = told(u, k, f, circuits[lane, COMMAND_DELAY], dt)
                    if mode == CLOSED:
                        late = y[0]
                        delay = circuits[lane, FEEDBACK_DELAY]
                        if delay > 0.0:
                            late = was(states, ends, slopes, slopes_end, 0, dt, k + f - delay / dt)
                        there = wanted_speed(there, late, thetas[lane], circuits[lane])
                        if slow:
                            if node < 2:
                                g[3, lane] = (drive_rate(
                                    there, y[4], max(circuits[lane, DRIVE_LAG], shortest),
                                    circuits[lane, SLEW_LIMIT]) - out[3]) * inverse[lane]
                            continue
                        if lags(circuits[lane]):
                            if k == 0 and node == 0:
                                before_wanted[lane] = there
                            spinning[lane] = followed(
                                spinning[lane], before_wanted[lane], there, (f - last_f) * dt,
                                max(circuits[lane, DRIVE_LAG], shortest),
                                circuits[lane, SLEW_LIMIT])
                            before_wanted[lane] = there
                            there = spinning[lane]
                    if node < 2:
                        change = (there + unknown[2] - turning) * inverse[lane]
                        for r in range(3):
                            g[r, lane] = per_turn[r] * change
            last_f = f


@njit(forceinline=True)
def lags(w):
    """Tell whether a drive is slow."""
    return w[DRIVE_LAG] > 0.0 or w[SLEW_LIMIT] < np.inf


@njit
def followed(omega, before, wanted, h, lag, slew):
    """Return the speed of a lagging drive after ``h`` s of a wanted speed that is linear in time."""
    slope = (wanted - before) / h
    target = wanted - slope * lag + (omega - before + slope * lag) * math.exp(-h / lag)
    limit = slew * h
    return omega + min(max(target - omega, -limit), limit)


@njit
def per_turn_at(mode, value, y, turning, unknown, theta, terms, memory, s, c, plus, minus, out):
    """Write the rates' derivative by the shaft's speed; the contributions ``c`` are left."""
    out[:] = 0.0
    if mode == FORCED:
        return
    d = 1e-3 * (1.0 + abs(turning))
    kept = c.copy()
    for side in range(2):
        moved = turning + (d if side == 0 else -d)
        if len(terms):
            s[OMEGA] = moved
            contribute(s, theta, terms, memory, c)
        rest(mode, value, y, moved, unknown, theta, c, plus if side == 0 else minus)
    c[:] = kept
    for r in range(3):
        out[r] = (plus[r] - minus[r]) / (2.0 * d)


@njit(forceinline=True)
def kicked(jac, constant, dt, matrix, right, kick):
    """Write the kick (S - 1), (N_RATES, N_FILTERED), of what the rates' Jacobian has beyond.

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


@njit(nogil=True)
def carried_on(e, gains, role, decay, dt, theta, areas, shifts, w, shaft, phi, gamma, half,
               half_gamma, jacs, constant, node_g, shown, used, out):
    """Carry all lanes along; write the innovations' tangents.

    Parameters
    ----------
    areas : (L,) what each lane's parameter does to (A1 + A2)/M.
    shaft : (n, N_FILTERED) the shown speed's derivative by the state.
    phi, gamma : (N, N), (2, N, N_RATES) of a sample; ``half``, ``half_gamma`` up to its middle.
    jacs : (n, N_RATES, N_FILTERED) rates' Jacobians, or (0, ...) where they are ``constant``.
    out : (n, len(used), L) written, NaN where nothing was measured.
    """
    n, lanes = e.shape[0], areas.shape[0]
    delta, other = np.zeros((N_FILTERED, lanes)), np.zeros((N_FILTERED, lanes))
    middle = np.zeros((N_FILTERED, lanes))
    depth = 2 + int(math.ceil(max(w[POSITION_DELAY], w[PRESSURE_DELAY], 0.0) / dt))
    old_start, old_end = np.zeros((depth, 4, lanes)), np.zeros((depth, 4, lanes))
    matrix, right = np.zeros((N_RATES, N_RATES)), np.zeros((N_RATES, N_FILTERED))
    kick = np.zeros((N_RATES, N_FILTERED))
    row, taken = np.zeros(lanes), np.zeros(lanes)
    varying = jacs.shape[0] > 0
    for k in range(n):
        gain = gains[min(k, gains.shape[0] - 1)]
        for i in range(4):
            old_end[k % depth, i] = delta[i]
        for i in range(N_FILTERED):
            other[i] = delta[i]
        both = role[k] > 0.0 and math.isfinite(e[k, 2]) and math.isfinite(e[k, 3])
        for place in range(len(used)):
            j = used[place]
            if not math.isfinite(e[k, j]):
                out[k, place] = math.nan
                continue
            for lane in range(lanes):
                row[lane] = shown[k, j, lane]
            if j == 4:
                for i in range(N_FILTERED):
                    value = shaft[k, i]
                    if value != 0.0:
                        for lane in range(lanes):
                            row[lane] += value * delta[i, lane]
            elif j == 1:
                for lane in range(lanes):
                    row[lane] += delta[1, lane]
            else:
                scale = 1.0 + (w[POSITION_SCALE] if j == 0 else (
                    w[PRESSURE_SCALE_1] if j == 2 else w[PRESSURE_SCALE_2]))
                delay = w[POSITION_DELAY] if j == 0 else w[PRESSURE_DELAY]
                if delay <= 0.0 or k == 0:
                    ahead = -delay if j == 0 else 0.0
                    for lane in range(lanes):
                        row[lane] += scale * (delta[j, lane] + ahead * delta[1, lane])
                else:
                    since = min(k - delay / dt, float(k))
                    first = max(min(math.floor(since), k - 1), 0)
                    f = max(since - first, 0.0)
                    for lane in range(lanes):
                        a, b = old_start[first % depth, j, lane], old_end[(first + 1) % depth, j,
                                                                          lane]
                        if j == 0:
                            value = between(a, b, old_start[first % depth, 1, lane],
                                            old_end[(first + 1) % depth, 1, lane], dt, f)
                        else:
                            value = a + f * (b - a)
                        row[lane] += scale * value
            for lane in range(lanes):
                out[k, place, lane] = -row[lane]
            if role[k] == FREE:
                continue
            for i in range(N_FILTERED):
                value = -gain[i, j]
                if value != 0.0:
                    for lane in range(lanes):
                        other[i, lane] += value * row[lane]
            if both and (j == 2 or j == 3):
                sign = 1.0 if j == 2 else -1.0
                for lane in range(lanes):
                    taken[lane] = (taken[lane] if j == 3 else 0.0) - sign * row[lane]
        if both:
            for lane in range(lanes):
                value = 0.5 * role[k] * (taken[lane] - (other[Y_P1, lane] - delta[Y_P1, lane])
                                         + other[Y_P2, lane] - delta[Y_P2, lane])
                other[Y_P1, lane] += value
                other[Y_P2, lane] -= value
                other[Y_V, lane] += 0.5 * dt * (
                    value * (theta[AREA_1] + theta[AREA_2]) / theta[M]
                    + shifts[k] * areas[lane])
        for i in range(4):
            old_start[k % depth, i] = other[i]
        if k == n - 1:
            break
        g = node_g[k]
        pushed(other, phi, gamma, g, delta)
        if varying:
            pushed(other, half, half_gamma, g, middle)
            kicked(jacs[k], constant, dt, matrix, right, kick)
            for r in range(N_RATES):
                for lane in range(lanes):
                    row[lane] = 0.0
                for i in range(N_FILTERED):
                    value = kick[r, i]
                    if value != 0.0:
                        for lane in range(lanes):
                            row[lane] += value * middle[i, lane]
                for i in range(N_MOVED):
                    value = half[i, 1 + r]
                    if value != 0.0:
                        for lane in range(lanes):
                            delta[i, lane] += value * row[lane]
        for i in range(Y_FORCE, N_FILTERED):
            for lane in range(lanes):
                delta[i, lane] = decay * other[i, lane]


@njit
def pushed(start, phi, gamma, g, end):
    """Write Phi start + Gamma g of the moved states."""
    lanes = start.shape[1]
    for i in range(N_MOVED):
        a = phi[i]
        b, d = gamma[0, i], gamma[1, i]
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


@njit(nogil=True)
def jacobians(mode, slow, states, ends, slopes, slopes_end, memories, u, p1, p2, dt, theta, w,
              lag, terms, size, every, jacs):
    """Write the rates' Jacobians in the middle of each ``every``-th sample."""
    n = states.shape[0]
    s, c = np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS)
    up, down = np.zeros(N_RATES), np.zeros(N_RATES)
    y, unknown, span = np.zeros(N_MOVED), np.zeros(3), np.zeros(N_FILTERED)
    memory = np.zeros((memories.shape[2], 2))
    for at in range(jacs.shape[0]):
        k = min(at * every, n - 2)
        for i in range(N_MOVED):
            y[i] = between(states[k, i], ends[k + 1, i], slopes[k, i], slopes_end[k + 1, i], dt,
                           0.5)
            span[i] = max(TINY * size[i], 0.5 * abs(ends[k + 1, i] - states[k, i]))
        for i in range(3):
            unknown[i] = states[k, N_MOVED + i]
            span[N_MOVED + i] = 1e-3 * size[N_MOVED + i]
        if mode == FORCED:
            y[2], y[3] = 0.5 * (p1[k] + p1[k + 1]), 0.5 * (p2[k] + p2[k + 1])
        if memories.shape[0] > 1:
            memory[:] = memories[k, 0]
        value = told(u, k, 0.5, w[COMMAND_DELAY], dt)
        behind = 0.0
        if w[FEEDBACK_DELAY] > 0.0:
            behind = (was(states, ends, slopes, slopes_end, 0, dt,
                          k + 0.5 - w[FEEDBACK_DELAY] / dt) - y[0] + w[FEEDBACK_DELAY] * y[1])
        jacobian(mode, slow, y, unknown, span, (k + 0.5) * dt, value, behind, theta, w, lag,
                 terms, memory, s, c, up, down, jacs[at])


@njit(nogil=True)
def shafts(mode, slow, states, ends, slopes, slopes_end, u, dt, steps, theta, w, shaft):
    """Write the shown speed's derivative by the state before each correction."""
    for k in range(states.shape[0]):
        shaft[k, Y_SPEED] = 1.0
        if mode == CLOSED and slow:
            shaft[k, Y_OMEGA] = 1.0
        elif mode == CLOSED:
            value = told(u, k, 0.0, w[COMMAND_DELAY], dt)
            late = late_by(states, ends, slopes, slopes_end, 0, k, w[FEEDBACK_DELAY], dt, steps)
            d = 1e-7
            slope = (wanted_speed(value, late + d, theta, w)
                     - wanted_speed(value, late - d, theta, w)) / (2.0 * d)
            shaft[k, Y_X] = slope
            shaft[k, Y_V] = -slope * w[FEEDBACK_DELAY]


__all__ = ["BASE", "CIRCUIT", "N_BASE", "TERM", "Y_FLOW"]
