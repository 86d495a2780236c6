"""One steady Kalman filter over all channels, around the simulator's own plant, compiled.

The prediction is :func:`physics.plant.advance`, so every effect of the catalogue is in it as soon
as it is active.  The correction uses gains that were computed beforehand
(:mod:`eha_monitor.mismatch.likelihood.gains`), so that innovations are smooth functions of the
parameters.  Besides the plant's own states three unknowns are tracked: a force, a flow and a pump
speed that nothing accounts for, each an Ornstein-Uhlenbeck process.
"""

import math
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.small_matrices import (
    copied,
    solved,
    symmetric,
    times,
    times_transposed,
    transposed,
)
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.physics import plant
from eha_monitor.physics import signals as of
from eha_monitor.physics.contributions import (
    N_EFFECTS,
    circuit_of,
    shift_memory,
    with_place,
    with_term,
    with_update,
)

FREE = -1.0  # role of a sample that corrects nothing
SLID = 1.0  # m, without a reversal: no seal is still bent the other way
N_FILTERED = 8  # x, v, p1, p2, omega, force, flow, speed: the head of the plant's state


class Record(NamedTuple):
    """A stretch of a record, as a filter takes it.

    mode, held, hears : what ``u`` is, whether a closed loop holds its command over each sample,
        and whether it has computed it from ``z``.
    start : when it begins in its recording, s: a sensor has drifted since the recording began.
    z : (n, N_OUTPUTS) measured x, v, p1, p2, omega; NaN where missing.
    u : (n, 4) input as a cubic on each sample: x_d, pump speed or force after ``mode``.
    pressures : (n,) p1 and (n,) p2 for ``FORCED``, Pa.
    role : (n,) what is done with each sample: ``FREE`` (nothing), or the share, 0 to 1, of the
        pressure difference that is taken from the sensors because the volume that entered since
        the last sample is not known.
    """

    mode: int
    held: bool
    hears: bool
    start: float
    z: np.ndarray
    u: np.ndarray
    pressures: tuple[np.ndarray, np.ndarray]
    role: np.ndarray


class Correction(NamedTuple):
    """Gains, and what is forgotten.

    gains : (m, N_FILTERED, N_OUTPUTS), of the first m samples; the last serves from there on.
    decay : share of the unknowns that is left after a sample.
    """

    gains: np.ndarray
    decay: float


@njit(forceinline=True)
def known_to_drive(w):
    """Tell whether the recorded position tells what the drive reads: not from behind a play."""
    return w[of.IN_LOOP] != 0.0 or w[of.PLAY] == 0.0


@njit
def read_by_drive(z, role, w, dt):
    """Return the position that a drive reads at each sample, m (n,); NaN where nobody knows.

    A digital controller computes from the sensor's reading, noise and rounding included; of
    sensors whose error it does not share, from one that is as noisy.  Where a model runs free it
    closes its own loop.
    """
    n = z.shape[0]
    heard = np.full(n, math.nan)
    if not known_to_drive(w):
        return heard
    late = (w[of.FEEDBACK_DELAY] - w[of.POSITION_DELAY]) / dt  # behind the recording, or before it
    whole = math.floor(late)
    rest = late - whole
    scale = 1.0 if w[of.IN_LOOP] != 0.0 else 1.0 + w[of.POSITION_SCALE]
    for k in range(n):
        at = k - whole
        before = at - 1 if rest > 0.0 else at
        if role[k] != FREE and before >= 0 and at < n:
            heard[k] = ((1.0 - rest) * z[at, 0] + rest * z[before, 0]) / scale
    return heard


@njit(nogil=True)
def innovate(record, step, theta, active, correction, actuator, e, states):
    """Filter one stretch of a record.

    Parameters
    ----------
    record, step : :class:`Record`; :class:`eha_monitor.physics.plant.Step`.
    theta, active : parameters and active effects.
    correction : :class:`Correction`.
    actuator : at the start, carried on.
    e : (n, N_OUTPUTS) written: innovations, NaN where nothing was measured.
    states : (n, N_FILTERED) written after the correction, or (0, N_FILTERED) where not wanted.

    Returns
    -------
    int
        Integration steps that were taken.
    """
    mode, held, hears, start, z, u, pressures, role = record
    gains, decay = correction
    y, memory, past, newest = actuator
    dt, n, count = step.dt, z.shape[0], 0
    w = circuit_of(theta, active)
    given = plant.Given(u, 1, 0, mode == CLOSED, held,
                        read_by_drive(z, role, w, dt) if held and hears else plant.NOT_HEARD)
    terms, updates, places = with_term(active), with_update(active, theta), with_place(active)
    equations = plant.Equations(theta, terms, updates, w, np.zeros(of.N_CONTRIBUTIONS),
                          np.zeros(of.N_SIGNALS))
    shown = np.zeros(plant.N_OUTPUTS)
    by_output = np.empty((gains.shape[0], plant.N_OUTPUTS, gains.shape[1]))
    for at in range(gains.shape[0]):  # a sensor's gains side by side
        for j in range(plant.N_OUTPUTS):
            for i in range(gains.shape[1]):
                by_output[at, j, i] = gains[at, i, j]
    for k in range(n):
        t = k * dt
        if mode == FORCED:
            shown[0], shown[1] = y[plant.Y_X], y[plant.Y_V]
            if w[of.PLAY] > 0.0:
                shown[0] = plant.behind_play(shown[0], y[plant.Y_PLAYED], w[of.PLAY])
            shown[0] = plant.shown_position(shown[0], w)
            shown[2] = shown[3] = shown[4] = math.nan
        else:
            plant.sense(actuator, start + t, step, w, shown)
            shown[4] = plant.speed_now(actuator, k, given, step, equations)[1]
        at = min(k, gains.shape[0] - 1)
        predicted, before_1, before_2 = y[plant.Y_X], y[plant.Y_P1], y[plant.Y_P2]
        for j in range(plant.N_OUTPUTS):
            difference = z[k, j] - shown[j]
            e[k, j] = difference
            if math.isfinite(difference) and role[k] != FREE:
                for i in range(N_FILTERED):
                    y[i] += by_output[at, j, i] * difference
        if role[k] > 0.0 and math.isfinite(z[k, 2]) and math.isfinite(z[k, 3]):
            # Less what the gains have corrected; the innovations know the sensors' own errors.
            half = 0.5 * role[k] * (e[k, 2] - y[plant.Y_P1] + before_1
                                    - e[k, 3] + y[plant.Y_P2] - before_2)
            y[plant.Y_P1] += half
            y[plant.Y_P2] -= half
            # On the mean it entered in the middle of the sample, and has pushed since.
            y[plant.Y_V] += 0.5 * dt * half * (theta[of.AREA_1] + theta[of.AREA_2]) / theta[of.M]
        if not math.isfinite(y[0]):
            e[k:] = 1e30
            return count
        shift_memory(places, y[plant.Y_X] - predicted, memory)
        for j in range(4):
            past[newest[0], j] = y[j]
        if states.shape[0]:
            for i in range(N_FILTERED):
                states[k, i] = y[i]
        if mode == FORCED:
            plant.advance_forced(actuator, t, k, u, pressures, step, equations)
            count += step.steps
        else:
            count += plant.advance(actuator, t, k, given, step, equations)
        y[plant.Y_FORCE] *= decay
        y[plant.Y_FLOW] *= decay
        y[plant.Y_SPEED] *= decay
    return count


@njit(nogil=True)
def transition(mode, held, hears, step, theta, active, decay, y, u, shifts):
    """Linearise the map over one sample, and the outputs, at ``y`` by central differences.

    Parameters
    ----------
    y : (N_STATE,) operating point; u : (1, 4) input there.
    shifts : (N_FILTERED,) size of the differences, in each state's unit.

    Returns
    -------
    a, h : (N_FILTERED, N_FILTERED) and (N_OUTPUTS, N_FILTERED).
    """
    a, h = np.zeros((N_FILTERED, N_FILTERED)), np.zeros((plant.N_OUTPUTS, N_FILTERED))
    w = circuit_of(theta, active)
    equations = plant.Equations(theta, with_term(active), with_update(active, theta), w,
                          np.zeros(of.N_CONTRIBUTIONS), np.zeros(of.N_SIGNALS))
    # What the drive has read is known: an error of the state does not come into it.
    read = plant.seen_by_drive(y[plant.Y_X], y[plant.Y_X], w)
    heard = np.full(1, read if hears and known_to_drive(w) else math.nan)
    given, pressures = plant.Given(u, 1, 0, mode == CLOSED, held, heard), (y[2:3], y[3:4])
    shown = np.zeros((2, plant.N_OUTPUTS))
    ends = np.zeros((2, y.shape[0]))
    actuator = plant.Actuator(y.copy(), np.zeros((N_EFFECTS, of.MAX_MEMORY)),
                              np.zeros((plant.RING, 4)), np.zeros(1, dtype=np.int64))
    moved, memory, past, newest = actuator
    places = with_place(active)
    for i in range(N_FILTERED):
        for side in range(2):
            moved[:] = y
            moved[i] += shifts[i] * (1.0 if side == 0 else -1.0)
            moved[8] = moved[0]
            memory[:] = 0.0
            for which in places:  # in typical motion a seal slides, wherever x = 0 lies
                memory[which, 1] = moved[0] - SLID
            newest[0] = 0
            for r in range(plant.RING):  # the past of a steady motion to this point
                steps_ago = (plant.RING - r) % plant.RING
                past[r, 0] = moved[0] - steps_ago * step.dt / step.steps * moved[1]
                past[r, 1], past[r, 2], past[r, 3] = moved[1], moved[2], moved[3]
            if mode == FORCED:
                shown[side, 0], shown[side, 1] = plant.shown_position(moved[0], w), moved[1]
                plant.advance_forced(actuator, 0.0, 0, u, pressures, step, equations)
            else:
                plant.sense(actuator, 0.0, step, w, shown[side])
                shown[side, 4] = plant.speed_now(actuator, 0, given, step, equations)[1]
                plant.advance(actuator, 0.0, 0, given, step, equations)
            moved[plant.Y_FORCE] *= decay
            moved[plant.Y_FLOW] *= decay
            moved[plant.Y_SPEED] *= decay
            copied(ends[side], moved)
        for j in range(N_FILTERED):
            a[j, i] = (ends[0, j] - ends[1, j]) / (2.0 * shifts[i])
        for j in range(plant.N_OUTPUTS):
            h[j, i] = (shown[0, j] - shown[1, j]) / (2.0 * shifts[i])
    return a, h


@njit(nogil=True)
def riccati(a, h, q, r, p, used, gains):
    """Iterate the Riccati equation from ``p``, and write the gains of each step.

    Parameters
    ----------
    a : (N, N); h : (N_OUTPUTS, N), N = N_FILTERED or more.
    q : (N,) variances of the process noise of a sample.
    r : (N_OUTPUTS,) variances of the sensors.
    p : (N, N) covariance at the start, overwritten.
    used : (N_OUTPUTS,) bool, channels that are measured.
    gains : (m, N, N_OUTPUTS) written; ends early, repeating, when nothing changes.

    Returns
    -------
    int
        How many of the gains differ; the last of them is the steady one.
    """
    places = np.flatnonzero(used)
    m, states = len(places), a.shape[0]
    hs = np.zeros((m, states))
    for i in range(m):
        for j in range(states):
            hs[i, j] = h[places[i], j]
    old = np.zeros((states, m))
    for k in range(gains.shape[0]):
        ph = times_transposed(p, hs)
        s = times(hs, ph)
        for i in range(m):
            s[i, i] += r[places[i]]
        gain = transposed(solved(s, transposed(ph)))
        gains[k] = 0.0
        size = 1e-300
        for i in range(m):
            for j in range(states):
                gains[k, j, places[i]] = gain[j, i]
                size = max(size, abs(gain[j, i]))
        taken = times_transposed(gain, ph)
        for i in range(states):
            for j in range(states):
                taken[i, j] = p[i, j] - taken[i, j]
        p = times_transposed(times(a, symmetric(taken)), a)
        for i in range(states):
            p[i, i] += q[i]
        change = 0.0
        for i in range(states):
            for j in range(m):
                change = max(change, abs(gain[i, j] - old[i, j]) / (1e-3 * size + abs(gain[i, j])))
        old = gain
        if change < 1e-6 and k > 50:
            return k + 1
    return gains.shape[0]
