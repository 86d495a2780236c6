"""The actuator in motion: classical Runge-Kutta steps, drive and sensors with their delays.

The state y of the whole actuator is

    x, v, p1, p2, omega        position m, velocity m/s, absolute pressures Pa, shaft speed rad/s
    force, flow, speed         what no equation accounts for: N, m^3/s, rad/s; 0 in a simulation
    played, acceleration       position behind the sensor's play m; v' of the last step m/s^2

The past is a ring of (x, v, p1, p2) at the end of each integration step.
"""

import math
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.physics import contributions as effects
from eha_monitor.physics import signals as of
from eha_monitor.physics.balances import acceleration, drive_speed, rates

(Y_X, Y_V, Y_P1, Y_P2, Y_OMEGA, Y_FORCE, Y_FLOW, Y_SPEED, Y_PLAYED, Y_ACCELERATION) = range(10)
N_STATE = 10
RING = 1024  # steps of the past that are kept
N_OUTPUTS = 5  # what sensors show: x, v, p1, p2, omega
SHORTEST_LAG = 0.4  # integration steps: a lag below is not resolved
SHORTEST_HELD = 0.2  # the same behind a held command, which a lag follows exactly
STEP_DECAY = 1.5  # times the fastest decay in one; Runge-Kutta runs away from 2.8
MOST_PARTS = 64  # of an integration step while a valve is open
AHEAD = 2.0  # steps in which a valve that opens is foreseen


class Actuator(NamedTuple):
    """What an actuator carries on from step to step, written in place."""

    y: np.ndarray  # (N_STATE,) state
    memory: np.ndarray  # (N_EFFECTS, MAX_MEMORY) of the effects
    past: np.ndarray  # (RING, 4) ring of the past
    newest: np.ndarray  # (1,) its newest entry


class Given(NamedTuple):
    """What drives an actuator."""

    u: np.ndarray  # the input (:func:`input_at`)
    pieces: int
    lead: int  # place of the first sample in it
    closed: bool  # u is x_d in m and the drive closes the loop; else u is the shaft speed in rad/s
    # A digital controller, of a closed loop: the drive reads x_d and x at the start of each sample
    # and holds what it wants.
    held: bool
    # (m,) position that such a drive has read at each of the first samples, m; NaN, and after
    # them, where it reads the state's.
    heard: np.ndarray


class Step(NamedTuple):
    """Length of a sample in s, and the Runge-Kutta steps in it.

    10 at 1 kHz keep a 75 Hz resonance to 1e-7.
    """

    dt: float
    steps: int


class Equations(NamedTuple):
    """Parameters, active effects that add and that remember, the circuit; and scratch.

    c, s : (N_CONTRIBUTIONS,), zero where no effect is active, and (N_SIGNALS,).
    """

    theta: np.ndarray
    terms: np.ndarray
    updates: np.ndarray
    w: np.ndarray
    c: np.ndarray
    s: np.ndarray


def actuator_of(y: np.ndarray, memory: np.ndarray) -> Actuator:
    """Return an actuator that has rested at ``y``, (N_STATE,), with its effects' memory."""
    past = np.tile(y[:4], (RING, 1))
    past[:, Y_V] = 0.0
    return Actuator(y, memory, past, np.zeros(1, dtype=np.int64))


def new_state(x: float, p1: float, p2: float) -> np.ndarray:
    """Return the state at rest at ``x`` (m) with the given pressures (Pa), (N_STATE,)."""
    y = np.zeros(N_STATE)
    y[Y_X], y[Y_P1], y[Y_P2], y[Y_PLAYED] = x, p1, p2, x
    return y


@njit(forceinline=True)
def come_to_rest(y, memory, equations, x, load):
    """Set the state at rest at ``x`` (m), in place: the pressures hold what loads the rod.

    A1 p1 - A2 p2 = F beside an unchanged sum of both, which make-up keeps; where one would be
    below zero it is zero, and the other holds the load alone.

    y, memory : (N_STATE,) written; of the effects.
    load : force against positive motion that no effect accounts for, N.
    """
    theta, s, c = equations.theta, equations.s, equations.c
    area_1, area_2, charge = theta[of.AREA_1], theta[of.AREA_2], theta[of.P_CHARGE]
    p1, p2 = charge, charge * area_1 / area_2
    s[:] = 0.0
    s[of.X], s[of.P1], s[of.P2] = x, p1, p2
    effects.add_contributions(s, theta, equations.terms, memory, c)
    force = c[of.FORCE] + load
    p1, p2 = p1 + force / (area_1 + area_2), p2 - force / (area_1 + area_2)
    if p1 < 0.0 or p2 < 0.0:
        p1, p2 = max(force, 0.0) / area_1, max(-force, 0.0) / area_2
    y[:] = 0.0
    y[Y_X], y[Y_P1], y[Y_P2], y[Y_PLAYED] = x, p1, p2, x


def at_rest(theta: np.ndarray, active: np.ndarray, x: float) -> np.ndarray:
    """Return the state at rest at ``x`` (m), (N_STATE,): :func:`come_to_rest`."""
    y, none = np.zeros(N_STATE), np.zeros(0, dtype=np.int64)
    equations = Equations(theta, effects.with_term(active), none, np.zeros(0),
                          np.zeros(of.N_CONTRIBUTIONS), np.zeros(of.N_SIGNALS))
    come_to_rest(y, effects.new_memory(), equations, x, 0.0)
    return y


@njit(forceinline=True)
def input_at(u, pieces, place):
    """Return an input at ``place`` samples after the first.

    u : (n*pieces, 4) cubic on each of ``pieces`` equal pieces of a sample, argument 0 to 1.
    """
    along = place * pieces
    i = math.floor(along)
    i = max(0, min(i, u.shape[0] - 1))
    f = min(max(along - i, 0.0), 1.0)
    return u[i, 0] + f * (u[i, 1] + f * (u[i, 2] + f * u[i, 3]))


NOT_HEARD = np.empty(0)


@njit(forceinline=True)
def piece_at(u, i, f):
    """Return the cubic of piece ``i`` at ``f`` from 0 to 1: at 1 still its own end."""
    return u[i, 0] + f * (u[i, 1] + f * (u[i, 2] + f * u[i, 3]))


@njit(forceinline=True)
def piece_of(k, f, late, n):
    """Return piece and place in it, 0 to 1, ``late`` samples after ``f`` of piece ``k``."""
    if late == 0.0:
        return k, f
    at = min(max(k + f + late, 0.0), float(n))
    j = min(math.floor(at), n - 1)
    return j, at - j


@njit(forceinline=True)
def delayed_position(past, last, step, delay, offset, x, v, acceleration):
    """Return x ``delay`` seconds before the time ``offset`` steps after entry ``last``, m.

    x, v, acceleration : at that time; ``step`` in s.  Within a step it is their Taylor series.
    """
    if delay == 0.0:
        return x
    back = delay / step - offset
    if back < 0.0:
        return x - delay * (v - 0.5 * delay * acceleration)
    j = min(math.floor(back), RING - 2)
    new, old = (last - j) % RING, (last - j - 1) % RING
    # Cubic Hermite between two ends, g from the older to the newer.
    g = 1.0 - min(back - j, 1.0)
    a, b = past[old, 0], past[new, 0]
    da, db = past[old, 1] * step, past[new, 1] * step
    return a + g * (da + g * (3.0 * (b - a) - 2.0 * da - db + g * (2.0 * (a - b) + da + db)))


@njit(forceinline=True)
def delayed_pressure(past, last, step, delay, which, y):
    """Return a pressure (``which`` 2 or 3) ``delay`` seconds before entry ``last``."""
    if delay <= 0.0:
        return y[which]
    back = delay / step
    j = min(math.floor(back), RING - 2)
    f = min(back - j, 1.0)
    return (1.0 - f) * past[(last - j) % RING, which] + f * past[(last - j - 1) % RING, which]


@njit(forceinline=True)
def behind_play(x, played, play):
    """Return the position behind a play of width ``play``, m: moved only at its ends."""
    half = 0.5 * play
    return min(max(played, x - half), x + half)


@njit(forceinline=True)
def shown_position(x, w):
    """Return what the position sensor shows at ``x`` m, behind its delay and its play."""
    return (1.0 + w[of.POSITION_SCALE]) * x


@njit(forceinline=True)
def seen_by_drive(x_late, played, w):
    """Return the position that the drive reads, m, from the late true one."""
    if w[of.IN_LOOP] == 0.0:
        return x_late
    if w[of.PLAY] > 0.0:
        x_late = behind_play(x_late, played, w[of.PLAY])
    return shown_position(x_late, w)


@njit(forceinline=True)
def shaft_speed(wanted, w):
    """Return the shaft speed without lag: the wanted one within the limit, rad/s."""
    return min(max(wanted, -w[of.SPEED_LIMIT]), w[of.SPEED_LIMIT])


@njit(forceinline=True)
def drive_rate(wanted, omega, lag, slew):
    """Return omega' of a drive with lag and slew limit, rad/s^2."""
    return min(max((wanted - omega) / lag, -slew), slew)


@njit(forceinline=True, allocates=False)
def wanted_now(actuator, k, given, step, theta, w):
    """Return the input at the start of sample ``k``, and the shaft speed wanted there, rad/s.

    The input itself where no loop is closed.
    """
    y, _, past, newest = actuator
    u, pieces, lead, closed, held, heard = given
    dt, steps = step
    first = lead + k
    if w[of.COMMAND_DELAY] == 0.0:
        value = piece_at(u, first * pieces, 0.0)
    else:
        value = input_at(u, pieces, first - w[of.COMMAND_DELAY] / dt)
    if not closed:
        return value, value
    read = heard[k] if held and k < heard.shape[0] else math.nan
    if math.isnan(read):
        read = seen_by_drive(
            delayed_position(past, newest[0], dt / steps, w[of.FEEDBACK_DELAY], 0.0, y[Y_X],
                             y[Y_V], y[Y_ACCELERATION]), y[Y_PLAYED], w)
    return value, shaft_speed(drive_speed(value, read, theta, w), w)


@njit(forceinline=True, allocates=False)
def advance(actuator, t, k, given, step, equations):
    """Carry an actuator over sample ``k``, which begins at ``t`` s, in place.

    A chamber behind an open valve of conductance k settles with beta_e k / V.  While one is open,
    or opens soon, each step is taken in parts that are short beside that.

    Returns
    -------
    int
        Steps and parts that were taken.
    """
    y, memory, past, newest = actuator
    u, pieces, lead, closed, held, _ = given
    dt, steps = step
    theta, terms, updates, w, c, s = equations
    last, first = newest[0], lead + k
    h = dt / steps
    slow = closed and (w[of.DRIVE_LAG] > 0.0 or w[of.SLEW_LIMIT] < np.inf)
    slew, play = w[of.SLEW_LIMIT], w[of.PLAY]
    steady = held and slew == np.inf  # omega decays towards what is wanted for the whole sample
    lag = max(w[of.DRIVE_LAG], (SHORTEST_HELD if steady else SHORTEST_LAG) * h)
    command_delay, feedback_delay = w[of.COMMAND_DELAY], w[of.FEEDBACK_DELAY]
    any_active, any_memory = len(terms) > 0, len(updates) > 0
    unknown_force, unknown_flow, unknown_speed = y[Y_FORCE], y[Y_FLOW], y[Y_SPEED]
    x, v, p1, p2, omega = y[Y_X], y[Y_V], y[Y_P1], y[Y_P2], y[Y_OMEGA]
    played, before = y[Y_PLAYED], y[Y_ACCELERATION]
    # Numbers, not places in memory that might change: their quotients are taken once.
    base = (theta[0], theta[1], theta[2], theta[3], theta[4], theta[5], theta[6], theta[7],
            theta[8], theta[9], theta[10], theta[11])
    alone = (unknown_force, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    wanted = wanted_now(actuator, k, given, step, base, w)[1] if held else 0.0
    below, beyond, conductance = effects.valves_of(theta, terms)
    settling = conductance * base[of.BETA_E] * h / STEP_DECAY  # times a chamber's volume
    count = 0
    for i in range(steps):
        parts, smallest = 1, min(base[of.VOL_1] + c[of.VOLUME_1], base[of.VOL_2] + c[of.VOLUME_2])
        if settling > smallest > 0.0:
            back = (last - 1) % RING
            next_1, next_2 = (p1 + AHEAD * (p1 - past[back, 2]), p2 + AHEAD * (p2 - past[back, 3]))
            if min(p1, p2, next_1, next_2) < below or max(
                    abs(p1 - p2), abs(next_1 - next_2)) > beyond:
                parts = min(math.ceil(settling / smallest), MOST_PARTS)
        part_h, turned = h / parts, 0.0
        faded = math.exp(-0.5 * part_h / lag) if steady and slow else 0.0
        count += parts
        for part in range(parts):
            sum_v = sum_a = sum_1 = sum_2 = sum_o = sum_turning = 0.0
            xs, vs, p1s, p2s, os = x, v, p1, p2, omega
            a = d1 = d2 = do = turning = 0.0
            for stage in range(4):
                offset = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                if stage > 0:
                    g = offset * part_h
                    xs, vs, p1s, p2s, os = x + g * vs, v + g * a, p1 + g * d1, p2 + g * d2, (
                        omega + g * do)
                offset = (part + offset) / parts  # in the step
                if command_delay == 0.0:
                    place = (i + offset) * pieces / steps
                    piece = min(int(place), pieces - 1)
                    if stage == 3:  # a jump at the end of the step belongs to the next
                        piece = math.ceil(place - 1e-9) - 1
                    value = piece_at(u, first * pieces + piece, place - piece)
                else:
                    value = input_at(u, pieces, first + (i + offset) / steps - command_delay / dt)
                turning = value
                if closed:
                    if not held:
                        late = xs
                        if feedback_delay > 0.0:
                            late = delayed_position(past, last, h, feedback_delay, offset, xs, vs,
                                                    before)
                        wanted = shaft_speed(
                            drive_speed(value, seen_by_drive(late, played, w), base, w), w)
                    turning = wanted
                    if slow and steady:
                        left = 1.0 if stage == 0 else (faded * faded if stage == 3 else faded)
                        turning = wanted + left * (omega - wanted)
                    elif slow:
                        do = drive_rate(wanted, os, lag, slew)
                        turning = os
                turning += unknown_speed
                if any_active:
                    s[of.T], s[of.X], s[of.V] = t + (i + offset) * h, xs, vs
                    s[of.P1], s[of.P2], s[of.OMEGA], s[of.X_D] = p1s, p2s, turning, value
                    effects.add_contributions(s, theta, terms, memory, c)
                    c[of.FORCE] += unknown_force
                    a, d1, d2 = rates(vs, p1s, p2s, turning, unknown_flow, base, c)
                else:
                    a, d1, d2 = rates(vs, p1s, p2s, turning, unknown_flow, base, alone)
                weight = 1.0 if stage == 0 or stage == 3 else 2.0
                sum_v += weight * vs
                sum_a += weight * a
                sum_1 += weight * d1
                sum_2 += weight * d2
                sum_o += weight * do
                sum_turning += weight * turning
            g = part_h / 6.0
            x += g * sum_v
            v += g * sum_a
            p1 += g * sum_1
            p2 += g * sum_2
            omega = wanted + faded * faded * (omega - wanted) if steady and slow else (
                omega + g * sum_o)
            before = sum_a / 6.0
            played = behind_play(x, played, play) if play > 0.0 else x
            if not slow:
                omega = turning - unknown_speed
            turned += sum_turning
        if any_memory:
            s[of.T], s[of.X], s[of.V], s[of.P1], s[of.P2] = t + (i + 1) * h, x, v, p1, p2
            s[of.OMEGA] = turned / (6.0 * parts)
            effects.update_memory(s, theta, updates, h, memory)
        last = (last + 1) % RING
        past[last, 0], past[last, 1], past[last, 2], past[last, 3] = x, v, p1, p2
    y[Y_X], y[Y_V], y[Y_P1], y[Y_P2], y[Y_OMEGA] = x, v, p1, p2, omega
    y[Y_PLAYED], y[Y_ACCELERATION] = played, before
    newest[0] = last
    return count


@njit(forceinline=True, allocates=False)
def speed_now(actuator, k, given, step, equations):
    """Return the input and the shaft speed (rad/s) at the start of sample ``k``."""
    y, w = actuator.y, equations.w
    value, wanted = wanted_now(actuator, k, given, step, equations.theta, w)
    if given.closed and (w[of.DRIVE_LAG] > 0.0 or w[of.SLEW_LIMIT] < np.inf):
        wanted = y[Y_OMEGA]
    return value, wanted + y[Y_SPEED]


@njit(forceinline=True, allocates=False)
def sense(actuator, t, step, w, out):
    """Write what the sensors show at time ``t`` s: x, v, p1, p2 (SI) into ``out``.

    w : the circuit.
    """
    y, _, past, newest = actuator
    last, h = newest[0], step.dt / step.steps
    late = delayed_position(past, last, h, w[of.POSITION_DELAY], 0.0, y[Y_X], y[Y_V],
                            y[Y_ACCELERATION])
    if w[of.PLAY] > 0.0:
        late = behind_play(late, y[Y_PLAYED], w[of.PLAY])
    out[0] = shown_position(late, w)
    out[1] = y[Y_V]
    delay = w[of.PRESSURE_DELAY]
    out[2] = ((1.0 + w[of.PRESSURE_SCALE_1]) * delayed_pressure(past, last, h, delay, 2, y)
              + w[of.PRESSURE_OFFSET_1] + w[of.PRESSURE_DRIFT_1] * t)
    out[3] = ((1.0 + w[of.PRESSURE_SCALE_2]) * delayed_pressure(past, last, h, delay, 3, y)
              + w[of.PRESSURE_OFFSET_2] + w[of.PRESSURE_DRIFT_2] * t)


@njit
def run(actuator, t0, given, step, theta, active, out, shown):
    """Simulate samples t0 + k dt, writing signals at each *before* stepping to the next.

    Parameters
    ----------
    actuator : at ``t0``; left as it is after the last sample's step.
    given : demanded position.
    theta : (n, N_THETA) or (1, N_THETA) parameters for each sample, or one row for all.
    out : (n, N_SIGNALS) written: the true signals, but for the shaft's angle.
    shown : (n, N_OUTPUTS) written: x, v, p1, p2, omega as the sensors show them, without noise.
    """
    c, s = np.zeros(of.N_CONTRIBUTIONS), np.zeros(of.N_SIGNALS)
    terms, updates = effects.with_term(active), effects.with_update(active, theta[0])
    equations = Equations(theta[0], terms, updates, effects.circuit_of(theta[0], active), c, s)
    y = actuator.y
    for k in range(out.shape[0]):
        if theta.shape[0] > 1:
            w = effects.circuit_of(theta[k], active)
            equations = Equations(theta[k], terms, updates, w, c, s)
        t = t0 + k * step.dt
        _, omega = speed_now(actuator, k, given, step, equations)
        out[k, of.T] = t
        out[k, of.X], out[k, of.V], out[k, of.P1], out[k, of.P2] = y[Y_X], y[Y_V], y[Y_P1], y[Y_P2]
        out[k, of.OMEGA] = omega
        out[k, of.X_D] = piece_at(given.u, (given.lead + k) * given.pieces, 0.0)
        sense(actuator, t, step, equations.w, shown[k])
        shown[k, 4] = omega
        advance(actuator, t, k, given, step, equations)


@njit(forceinline=True, allocates=False)
def advance_forced(actuator, t, k, u, pressures, step, equations):
    """Carry position and velocity over sample ``k`` under a given force, in place.

    Parameters
    ----------
    actuator : pressures and drive are left alone.
    u : (n, 4) driving force in N, a cubic on each sample.
    pressures : (n,) p1 and (n,) p2 for effects that depend on them, Pa, linear between samples.
    """
    y, memory, _, _ = actuator
    (p1, p2), (dt, steps) = pressures, step
    theta, terms, updates, w, c, s = equations
    h = dt / steps
    any_active, any_memory = len(terms) > 0, len(updates) > 0
    x, v = y[Y_X], y[Y_V]
    # What measures the force is late, or the position is: only the difference shows.
    late = (w[of.PRESSURE_DELAY] - w[of.POSITION_DELAY]) / dt
    for i in range(steps):
        sum_v = sum_a = a = 0.0
        xs, vs = x, v
        for stage in range(4):
            offset = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            if stage > 0:
                since = offset * h
                xs, vs = x + since * vs, v + since * a
            f = (i + offset) / steps
            j, g = piece_of(k, f, late, u.shape[0])
            if any_active:
                after = min(j + 1, p1.shape[0] - 1)
                s[of.T], s[of.X], s[of.V] = t + f * dt, xs, vs
                s[of.P1] = (1.0 - g) * p1[j] + g * p1[after]
                s[of.P2] = (1.0 - g) * p2[j] + g * p2[after]
                effects.add_contributions(s, theta, terms, memory, c)
            c[of.FORCE] += y[Y_FORCE]
            a = acceleration(piece_at(u, j, g), vs, theta, c)
            c[of.FORCE] -= y[Y_FORCE]
            weight = 1.0 if stage == 0 or stage == 3 else 2.0
            sum_v += weight * vs
            sum_a += weight * a
        x += h / 6.0 * sum_v
        v += h / 6.0 * sum_a
        if any_memory:
            s[of.T], s[of.X], s[of.V] = t + (i + 1) * h, x, v
            effects.update_memory(s, theta, updates, h, memory)
    y[Y_X], y[Y_V] = x, v
    y[Y_PLAYED] = behind_play(x, y[Y_PLAYED], w[of.PLAY]) if w[of.PLAY] > 0.0 else x
