"""Stage two (Eq. 5) over rows, of a recording or live, compiled: effective bulk modulus.

State (x, v, F, c), and with a line its n and dp_l (:mod:`discretisation`); input the demanded
position or the pump's speed; measurement x.  Beside it goes the sensitivity of the state to the
damping B that stage one hands over.
"""

import math
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.discretisation import (
    BETA_0,
    C_PLACE,
    GAIN,
    LINE_DAMPING,
    LINE_IMPEDANCE,
    LINE_LOAD,
    LOOP,
    MASS,
    STIFF,
    column,
    discretise,
    place,
    states_beside_c,
)
from eha_monitor.estimation.modelled import (
    Motion,
    OilState,
    Push,
    flow_balance,
    modelled_force,
    new_known_memory,
    new_work,
    steps_in_sample,
)
from eha_monitor.estimation.small_matrices import on_stack
from eha_monitor.estimation.stage_one import BROAD, GATE, SPIKES, UNSEEN
from eha_monitor.estimation.supervision import (
    BLOCK,
    FROZEN,
    HELD,
    INFORMATION,
    N_SUPERVISION,
    SAMPLES,
    SCORE,
    SPIKED,
    honest_factor,
    look,
    new_supervision,
)
from eha_monitor.physics.contributions import N_EFFECTS
from eha_monitor.physics.signals import MAX_MEMORY, P1, P2

STIFFEST = 1e-2  # smallest compliance beta_0/beta_e: a hundred times stiffer than the prior
# Places in ``StateTwo.at``: where the matrices were made, the c that they were last expanded to,
# force of the sample, its part that does not follow the states, flow likewise, variance of the
# force, integration steps in a sample.
(AT_C, AT_B, LAST_C, MODELLED_FORCE, CONSTANT_FORCE, CONSTANT_FLOW, NOISE_FORCE, STEPS) = range(8)
N_AT = 8
REFRESH = 5e-3  # relative change of c that asks for a new exact step; between, second order


class RowsTwo(NamedTuple):
    """What stage two takes of each sample.

    Attributes
    ----------
    z : (n,) measured position, m; NaN where missing.
    u_start, u_end, Q_u, slow : (n,) the drive input's line over the sample (x_d in m, or omega
        in rad/s) and its variances, :class:`drive.Hold`.
    b, b_variance : (n,) damping of stage one and its variance.
    leak_flow : (n,) :func:`rig_model.measured_leakage` over the sample before each; 0 where
        ``ConstantsTwo.leak`` stands for it.
    mean : (n,) or (1,) mean of both absolute pressures over the sample before each, Pa.
    """

    z: np.ndarray
    u_start: np.ndarray
    u_end: np.ndarray
    Q_u: np.ndarray
    slow: np.ndarray
    b: np.ndarray
    b_variance: np.ndarray
    leak_flow: np.ndarray
    mean: np.ndarray


class ConstantsTwo(NamedTuple):
    """What stays the same over a recording.

    Attributes
    ----------
    k, leak : lumped hydraulics of :func:`discretisation.hydraulics`.
    dt : s.
    R, Q_f : variances of the position (m^2) and of an unmodelled force (N^2).
    prior_variance : of c.
    """

    k: np.ndarray
    leak: float
    dt: float
    R: float
    Q_f: float
    prior_variance: float


class StateTwo(NamedTuple):
    """All that stage two carries from sample to sample; updated in place.

    Attributes
    ----------
    x, P : (n,) x, v, F, c, and with a line n, dp_l;  (n, n) covariance.  x[0] NaN: fresh start.
    sens : (n,) d x/d B.
    watch : supervision.
    memory : of the modelled effects.
    matrices : (7, 7*3), with a line (7, 9*5), each column by column: the exact step at
        ``at[AT_C]``, its first and second derivative to c, those to B and to the leakage, then
        the step and its slope to c as taken.
    at : (N_AT,) where they were made, and what the last sample had.
    """

    x: np.ndarray
    P: np.ndarray
    sens: np.ndarray
    watch: np.ndarray
    memory: np.ndarray
    matrices: np.ndarray
    at: np.ndarray


class SampleTwo(NamedTuple):
    """One sample of :class:`RowsTwo`; ``Q_x`` (m^2) is what a slow error of the speed moves."""

    u0: float
    u1: float
    Q_u: float
    Q_x: float
    b: float
    leak_flow: float
    mean: float


@njit
def blank_state_two(k):
    """Return a state of zeros, its matrices made nowhere; ``k``: lumped hydraulics."""
    rows = states_beside_c(k)
    n = rows + 1
    at = np.zeros(N_AT)
    at[AT_C] = math.nan
    return StateTwo(np.zeros(n), np.zeros((n, n)), np.zeros(n), np.zeros(N_SUPERVISION),
                    np.zeros((N_EFFECTS + 1, MAX_MEMORY)), np.zeros((7, rows * (rows + 4))), at)


def new_state_two(k: np.ndarray, c: float, variance: float, frozen: bool = False,
                  held: bool = False) -> StateTwo:
    """Return the state before the first sample.

    Parameters
    ----------
    k : lumped hydraulics.
    c, variance : of the compliance.
    frozen : no change of c is looked for.
    held : c is not even estimated, only its uncertainty carried along.
    """
    state = blank_state_two(k)._replace(watch=new_supervision(frozen), memory=new_known_memory())
    state.x[0], state.x[C_PLACE], state.P[C_PLACE, C_PLACE] = math.nan, c, variance
    if held:
        state.watch[FROZEN] = HELD
    return state


@njit
def position_walk(k, dt):
    """Return the variance of the position over that of the pump's speed, kept for a sample."""
    return (k[GAIN] / k[STIFF] * dt) ** 2


@njit
def new_steps_work(k):
    """Return the scratch in which the exact steps are made."""
    rows = states_beside_c(k)
    return np.empty((10, rows, rows))


@njit(allocates=False)
def start_two(x, P, z, R, dt, mass):
    """(Re)start (x, v, F) at a measurement; the compliance and its variance stay.

    x : (n,) position, velocity, F, then parameters;  P : (n, n).
    """
    x[0], x[1], x[2] = z, 0.0, 0.0
    broad_v = BROAD * math.sqrt(R) / dt
    for i in range(3):
        for j in range(P.shape[0]):
            P[i, j] = 0.0
            P[j, i] = 0.0
    P[0, 0] = R
    P[1, 1] = broad_v * broad_v
    P[2, 2] = (mass * broad_v / dt) ** 2


@njit(allocates=False)
def restart_two(state, z, constants):
    """(Re)start all states at a measurement, a line's too."""
    x, P, k = state.x, state.P, constants.k
    start_two(x, P, z, constants.R, constants.dt, k[MASS])
    for i in range(x.shape[0]):
        if i != C_PLACE:
            state.sens[i] = 0.0
    if x.shape[0] == C_PLACE + 1:
        return
    speed = math.sqrt(P[1, 1]) * k[STIFF] / k[GAIN]
    load = k[LINE_LOAD] * math.sqrt(P[2, 2])
    for i, broad in ((4, speed), (5, load + (1.0 + k[LINE_DAMPING]) * k[LINE_IMPEDANCE] * speed)):
        x[i] = 0.0
        for j in range(x.shape[0]):
            P[i, j] = 0.0
            P[j, i] = 0.0
        P[i, i] = broad * broad


def predict_with(rows, forceinline):
    """Return the prediction for so many states beside c: their loops unroll."""
    n = rows + 1
    U0, U1, FORCE, FLOW = 3 * rows, 4 * rows, 5 * rows, 6 * rows  # where columns of a step begin

    @njit(forceinline=forceinline, allocates=False)
    def predict(state, sample):
        """Predict state, covariance and the sensitivity to B over one sample.

        The step at the present (B, c) is ``matrices[5]``, its derivatives to c and to B are
        ``matrices[6]`` and ``[3]``; the modelled force (N) and flow (N/Pa/s), and the variance of
        what is not modelled of the force, are in ``at``.
        """
        x, P, sens = state.x, state.P, state.sens
        step, c_step, d_b = state.matrices[5], state.matrices[6], state.matrices[3]
        u0, u1 = sample.u0, sample.u1
        force, flow = state.at[CONSTANT_FORCE], state.at[CONSTANT_FLOW]
        Q_f, Q_u = state.at[NOISE_FORCE], sample.Q_u
        F, FP, made = on_stack(n, n), on_stack(n, n), on_stack(3, n)  # F transposed
        for i in range(rows):
            row = place(i)
            new = (step[U0 + i] * u0 + step[U1 + i] * u1 + step[FORCE + i] * force
                   + step[FLOW + i] * flow)
            slope = (c_step[U0 + i] * u0 + c_step[U1 + i] * u1 + c_step[FORCE + i] * force
                     + c_step[FLOW + i] * flow)
            from_b = d_b[U0 + i] * u0 + d_b[U1 + i] * u1
            for j in range(rows):
                value, along = x[place(j)], column(j) * rows + i
                new += step[along] * value
                slope += c_step[along] * value
                from_b += d_b[along] * value
                F[place(j), row] = step[along]
            F[C_PLACE, row] = slope
            made[0, row], made[1, row] = new, from_b
            made[2, row] = step[U0 + i] + step[U1 + i]
        # Where the slope is no larger than what the states' own uncertainty makes of it, it is
        # noise and tells nothing about c; a filter that takes it for information drifts at rest.
        noise, lean = Q_u * (c_step[U0 + 2] + c_step[U1 + 2]) ** 2, 0.0
        for i in range(rows):
            along = c_step[column(i) * rows + 2]
            lean += along * P[place(i), C_PLACE]
            for j in range(rows):
                noise += along * P[place(i), place(j)] * c_step[column(j) * rows + 2]
        if F[C_PLACE, 2] ** 2 < UNSEEN * (noise - lean * lean / P[C_PLACE, C_PLACE]):
            for i in range(rows):
                F[C_PLACE, place(i)] = 0.0
        for i in range(rows):  # d x/d B goes with F, and with what B itself does
            row = place(i)
            for j in range(n):
                made[1, row] += F[j, row] * sens[j]
            for j in range(n):
                FP[row, j] = 0.0
                for k in range(n):
                    FP[row, j] += F[k, row] * P[k, j]
        for i in range(rows):
            row = place(i)
            x[row], sens[row] = made[0, row], made[1, row]
            P[row, C_PLACE] = P[C_PLACE, row] = FP[row, C_PLACE]  # c stays, and so does its row
            for j in range(i, rows):  # P = F P F' + Q
                total = (Q_f * step[FORCE + i] * step[FORCE + j]
                         + Q_u * made[2, row] * made[2, place(j)])
                for k in range(n):
                    total += FP[row, k] * F[k, place(j)]
                P[row, place(j)] = total
                P[place(j), row] = total
        P[0, 0] += sample.Q_x

    return predict


def correct_with(rows, forceinline):
    """Return the correction for so many states beside c."""
    n = rows + 1

    @njit(forceinline=forceinline, allocates=False)
    def correct(state, z, R):
        """Update with a position and its variance; the caller has gated it.

        A held c is considered and not estimated (Schmidt 1966): its gain is zero.
        """
        x, P, sens, w = state.x, state.P, state.sens, state.watch
        S = P[0, 0] + R
        nu = z - x[0]
        c, own, to_b = x[C_PLACE], P[C_PLACE, C_PLACE], sens[C_PLACE]
        h = P[0, C_PLACE] / own
        w[SCORE] += h * nu / S
        w[INFORMATION] += h * h / S
        lead, first = sens[0], on_stack(1, n)  # P's first row, by which all are changed
        for i in range(n):
            first[0, i] = P[0, i]
        for i in range(n):
            K = first[0, i] / S
            x[i] += K * nu
            sens[i] -= K * lead
            for j in range(i, n):
                P[i, j] -= K * first[0, j]
                P[j, i] = P[i, j]
        x[C_PLACE] = max(x[C_PLACE], STIFFEST)
        if w[FROZEN] == HELD:
            x[C_PLACE], P[C_PLACE, C_PLACE], sens[C_PLACE] = c, own, to_b

    return correct


# The chambers' are in every sample of every rig; written into their callers they cost no call.
predict_chambers, predict_line = predict_with(3, True), predict_with(5, False)
correct_chambers, correct_line = correct_with(3, True), correct_with(5, False)


@njit(forceinline=True, allocates=False)
def correct_two(state, z, R):
    """Update with a position and its variance; the caller has gated it."""
    if state.x.shape[0] == C_PLACE + 1:
        correct_chambers(state, z, R)
    else:
        correct_line(state, z, R)


@njit
def jump_two(x, P, delta, information):
    """Move c by ``delta`` and forget, as :func:`stage_one.jump_one`."""
    h = P[:, 3] / P[3, 3]
    grown = max(4.0 / information, P[3, 3]) - P[3, 3]
    for i in range(x.shape[0]):
        x[i] += h[i] * delta
        for j in range(x.shape[0]):
            P[i, j] += h[i] * h[j] * grown
    x[3] = max(x[3], STIFFEST)


@njit
def make_step(own, b, constants, state, steps_work):
    """Write the exact step at (B, c) and its derivatives (:func:`discretisation.discretise`)."""
    rows = steps_work.shape[1]
    columns = rows + 4
    made = np.empty((5, rows, columns))
    discretise(constants.k, b, own, constants.leak, constants.dt, steps_work, made)
    for which in range(5):
        for i in range(rows):
            for j in range(columns):
                state.matrices[which, j * rows + i] = made[which, i, j]
    state.at[AT_C], state.at[AT_B], state.at[LAST_C] = own, b, math.nan


@njit(allocates=False)
def modelled_terms(state, sample, omega, flow, constants, effects, slopes, work):
    """Return force, flow and the variance of that force as the modelled effects have them.

    Their slopes to the states go into the step and its slope to c.  ``flow`` is theirs at the
    sample's start; other arguments as :func:`advance_two`.
    """
    x, P, memory, at = state.x, state.P, state.memory, state.at
    step, c_step = state.matrices[5], state.matrices[6]
    theta, dt, mean = effects.theta, constants.dt, sample.mean
    compliance = max(x[3], STIFFEST)
    rows = x.shape[0] - 1
    force, to_force, unknown, middle_x = 0.0, 0.0, 0.0, x[0] + 0.5 * dt * x[1]
    on_force, on_flow = 5 * rows, 6 * rows  # where these columns of the step begin
    ahead = (step[3 * rows + 2] * sample.u0 + step[4 * rows + 2] * sample.u1
             + step[on_force + 2] * at[MODELLED_FORCE]
             + step[on_flow + 2] * (flow + sample.leak_flow))
    for i in range(rows):
        ahead += step[column(i) * rows + 2] * x[place(i)]
    if len(effects.flows) > 0:  # at the middle of the sample, and how it follows the force
        h = max(math.sqrt(max(P[2, 2], 0.0)), 1e-3)
        middle = 0.5 * (x[2] + ahead)
        for side in (1.0, -1.0):
            _, _, flow = flow_balance(
                OilState(middle_x, x[1], omega, middle + side * h, mean, compliance), constants.k,
                effects, memory, work)
            to_force += side * flow
        to_force *= 0.5 * (1.0 + step[2 * rows + 2]) / (2.0 * h)
        _, _, flow = flow_balance(OilState(middle_x, x[1], omega, middle, mean, compliance),
                                  constants.k, effects, memory, work)
    if len(effects.plain) + len(effects.remembering) > 0:
        p1 = (x[2] + 2.0 * theta[1] * mean) / (theta[0] + theta[1])
        work.s[P1], work.s[P2] = p1, 2.0 * mean - p1
        force, slope_x, slope_v, unknown = modelled_force(
            Motion(x[0], x[1], P[0, 0], P[1, 1]),
            Push(x[2], ahead, sample.b, constants.k[MASS], dt, int(at[STEPS])), effects, memory,
            slopes, work)
        at[MODELLED_FORCE] = force
        force -= slope_x * x[0] + slope_v * x[1]
        for i in range(rows):
            step[i] += step[on_force + i] * slope_x
            step[rows + i] += step[on_force + i] * slope_v
            c_step[i] += c_step[on_force + i] * slope_x
            c_step[rows + i] += c_step[on_force + i] * slope_v
    flow -= to_force * x[2]
    for i in range(rows):
        step[2 * rows + i] += step[on_flow + i] * to_force
        c_step[2 * rows + i] += c_step[on_flow + i] * to_force
    return force, flow, unknown


@njit(forceinline=True, allocates=False)
def advance_two(state, sample, constants, effects, slopes, work, steps_work):
    """Carry the stage over one sample with the modelled effects; False where it cannot.

    Parameters
    ----------
    state, sample, constants : :class:`StateTwo`, updated, :class:`SampleTwo`,
        :class:`ConstantsTwo`.
    slopes : whether the states' covariance is to follow the modelled force.
    work, steps_work : :func:`modelled.new_work`, :func:`new_steps_work`.
    """
    x, at, k = state.x, state.at, constants.k
    modelled = len(effects.plain) + len(effects.remembering) + len(effects.flows) > 0
    if modelled and math.isnan(sample.mean):  # a pressure that an effect needs
        return False
    compliance = max(x[3], STIFFEST)
    own, to_own, flow, omega = compliance, 1.0, 0.0, 0.5 * (sample.u0 + sample.u1)
    if k[LOOP] > 0.0:
        omega = k[LOOP] * (omega - x[0])
    if len(effects.flows) > 0:
        own, to_own, flow = flow_balance(
            OilState(x[0] + 0.5 * constants.dt * x[1], x[1], omega, x[2], sample.mean, compliance),
            k, effects, state.memory, work)
        own = max(own, 0.1 * STIFFEST)
    b = sample.b
    if not (abs(own - at[AT_C]) <= REFRESH * at[AT_C] and abs(b - at[AT_B]) <= 1e-6 * abs(b)):
        make_step(own, b, constants, state, steps_work)
    if modelled or not abs(own - at[LAST_C]) <= 1e-6 * own:
        step, c_step = state.matrices[5], state.matrices[6]
        exact, d_c, d_cc = state.matrices[0], state.matrices[1], state.matrices[2]
        e = own - at[AT_C]
        for i in range(step.shape[0]):
            step[i] = exact[i] + e * (d_c[i] + 0.5 * e * d_cc[i])
            c_step[i] = to_own * (d_c[i] + e * d_cc[i])
        at[LAST_C] = own
    force, Q_f = 0.0, constants.Q_f
    if modelled:
        force, flow, unknown = modelled_terms(state, sample, omega, flow, constants, effects,
                                              slopes, work)
        Q_f += unknown
    flow += sample.leak_flow
    if math.isnan(force + flow):
        return False
    at[CONSTANT_FORCE], at[CONSTANT_FLOW], at[NOISE_FORCE] = force, flow, Q_f
    if x.shape[0] == C_PLACE + 1:
        predict_chambers(state, sample)
    else:
        predict_line(state, sample)
    return True


@njit(allocates=False)
def as_modulus(c, own, total, S, beta_0):
    """Turn a compliance and its two variances into a modulus, Pa, and standard deviations.

    So for ``S``, the innovation's variance.  All (n,), in place; beside the loop of the filter
    since roots and divisions go several at once here.
    """
    for k in range(c.shape[0]):
        compliance = max(c[k], 1e-9)
        c[k] = beta_0 / compliance
        per_c = c[k] / compliance
        own[k], total[k], S[k] = (
            per_c * math.sqrt(own[k]), per_c * math.sqrt(total[k]), math.sqrt(S[k]))


@njit
def run_two(rows, constants, effects, state, first, out, events):
    """Run the stage over the samples from ``first`` on.

    Rows taken in two runs, the second with the last sample of the first before its own, give the
    same numbers as in one.

    Parameters
    ----------
    rows, constants, state : :class:`RowsTwo`, :class:`ConstantsTwo`, :class:`StateTwo`.
    effects : the modelled ones.
    out : (8, n) written: x, v, a, beta_e, sigma of the filter, sigma with the uncertainty of B,
        innovation, innovation sigma.
    events : (k, 4) written: sample, beta before, beta after, samples in the window.

    Returns
    -------
    int
        Number of events.
    """
    z, u_start, u_end, Q_u, slow, b, b_variance, leak_flow, mean = rows
    x, P, sens, w, at, k_lumped = (state.x, state.P, state.sens, state.watch, state.at,
                                   constants.k)
    n, R, walk = z.shape[0], constants.R, position_walk(k_lumped, constants.dt)
    work, steps_work = new_work(state.memory), new_steps_work(k_lumped)
    at[STEPS] = steps_in_sample(constants.dt, effects, state.memory, work)
    mass = k_lumped[MASS]
    spikes, samples, found = int(w[SPIKED]), int(w[SAMPLES]), 0
    nan = math.nan
    factor = honest_factor(w)
    for k in range(first, n):
        lost = math.isnan(x[0])
        if not lost and k > 0:
            i = k if mean.shape[0] > 1 else 0
            sample = SampleTwo(u_start[k - 1], u_end[k], Q_u[k], walk * slow[k], b[k],
                               leak_flow[k], mean[i])
            lost = math.isnan(sample.u0 + sample.u1 + b[k] + leak_flow[k])
            if not lost:
                lost = not advance_two(state, sample, constants, effects, True, work, steps_work)
        if lost:
            at[MODELLED_FORCE] = 0.0
        nu, S = nan, nan
        if not math.isnan(z[k]):
            if lost:
                restart_two(state, z[k], constants)
            else:
                S = P[0, 0] + R
                nu = z[k] - x[0]
                if nu * nu > GATE * S and spikes < SPIKES:
                    spikes += 1
                else:
                    spikes = 0
                    correct_two(state, z[k], R)
        elif lost:
            x[0] = nan
        samples += 1
        if samples == BLOCK:
            samples = 0
            delta, information, window = look(w, x[3], P[3, 3], constants.prior_variance)
            if information > 0.0:
                before = k_lumped[BETA_0] / x[3]
                jump_two(x, P, delta, information)
                if found < events.shape[0]:
                    events[found, 0], events[found, 1] = k, before
                    events[found, 2] = k_lumped[BETA_0] / x[3]
                    events[found, 3] = window
                found += 1
            factor = honest_factor(w)
        out[0, k], out[1, k] = x[0], x[1]
        out[2, k] = (x[2] - b[k] * x[1] - at[MODELLED_FORCE]) / mass
        own = factor * factor * P[3, 3]
        out[3, k], out[4, k] = x[3], own
        out[5, k] = own + sens[3] * sens[3] * b_variance[k]
        out[6, k], out[7, k] = nu, S
    w[SPIKED], w[SAMPLES] = spikes, samples
    as_modulus(out[3, first:n], out[4, first:n], out[5, first:n], out[7, first:n],
               k_lumped[BETA_0])
    return found


@njit
def log_likelihood_two(rows, constants, effects, c):
    """Return the log likelihood of a stretch under a fixed compliance ``c``.

    The resonance makes the likelihood of beta_e many-peaked: an extended filter that starts
    more than a few per cent away may lock on a wrong peak while the oil column rings.  A bank
    of these linear filters finds the right one.  Arguments as :func:`run_two`.
    """
    z, u_start, u_end, Q_u, slow, b, _, leak_flow, mean = rows
    state = blank_state_two(constants.k)
    x, P, R, walk = state.x, state.P, constants.R, position_walk(constants.k, constants.dt)
    work, steps_work = new_work(state.memory), new_steps_work(constants.k)
    state.at[STEPS] = steps_in_sample(constants.dt, effects, state.memory, work)
    x[3] = c
    lost = True
    spikes = 0
    total = 0.0
    for k in range(z.shape[0]):
        if not lost:
            i = k if mean.shape[0] > 1 else 0
            sample = SampleTwo(u_start[k - 1], u_end[k], Q_u[k], walk * slow[k], b[k],
                               leak_flow[k], mean[i])
            lost = math.isnan(sample.u0 + sample.u1 + leak_flow[k])
            if not lost:
                P[3, 3] = 1e-30  # c is fixed here
                lost = not advance_two(state, sample, constants, effects, False, work, steps_work)
                x[3] = c
        if math.isnan(z[k]):
            continue
        if lost:
            restart_two(state, z[k], constants)
            P[3, 3] = 1e-30
            state.at[MODELLED_FORCE] = 0.0
            lost = False
            continue
        S = P[0, 0] + R
        nu = z[k] - x[0]
        if nu * nu > GATE * S and spikes < SPIKES:  # as in run_two, and no prize for it
            spikes += 1
            total -= 0.5 * (GATE + math.log(S))
            continue
        spikes = 0
        total -= 0.5 * (nu * nu / S + math.log(S))
        correct_two(state, z[k], R)
    return total
