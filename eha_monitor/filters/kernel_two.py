"""Stage two over rows, of a recording or live, compiled."""

import math

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.filters.kernel_one import GATE, SPIKES
from eha_monitor.filters.known import flow_balance, modelled_force, steps_in_sample
from eha_monitor.filters.stage_two import (
    BETA_0,
    LOOP,
    MASS,
    column,
    discretise,
    place,
    states_beside_c,
)
from eha_monitor.filters.steps_two import (
    STIFFEST,
    correct_two,
    jump_two,
    predict_chambers,
    predict_line,
    restart_two,
)
from eha_monitor.filters.supervision import (
    BLOCK,
    N_SUPERVISION,
    SAMPLES,
    SPIKED,
    honest_factor,
    look,
)
from eha_monitor.physics.signals import N_CONTRIBUTIONS, N_SIGNALS

# Places in what advance_two finds: where the matrices were made, the c that they were last
# expanded to, force of the sample, its part that does not follow the states, flow likewise,
# variance of the force, integration steps in a sample.
(AT_C, AT_B, LAST_C, TOLD_FORCE, CONSTANT_FORCE, CONSTANT_FLOW, NOISE_FORCE, STEPS) = range(8)
N_AT = 8
REFRESH = 5e-3  # relative change of c that asks for a new exact step; between, second order


@njit
def new_step(constants):
    """Return what :func:`advance_two` keeps from sample to sample: matrices, and what it found.

    The matrices (7, 7*3), with a line (7, 9*5), each column by column: the exact step at
    ``at[AT_C]``, its first and second derivative to c, those to B and to the leakage, then the
    step and its slope to c as taken.
    """
    at = np.zeros(N_AT)
    at[AT_C] = math.nan
    rows = states_beside_c(constants)
    return np.zeros((7, rows * (rows + 4))), at


@njit
def new_work(constants):
    """Return the scratch of :func:`advance_two`."""
    rows = states_beside_c(constants)
    return np.empty((10, rows, rows)), np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS)


@njit
def make_step(own, b, constants, leak, dt, matrices, at, work):
    """Write the exact step at (B, c) and its derivatives (:func:`stage_two.discretise`)."""
    rows = work.shape[1]
    columns = rows + 4
    made = np.empty((5, rows, columns))
    discretise(constants, b, own, leak, dt, work, made[0], made[1], made[2], made[3], made[4])
    for which in range(5):
        for i in range(rows):
            for j in range(columns):
                matrices[which, j * rows + i] = made[which, i, j]
    at[AT_C], at[AT_B], at[LAST_C] = own, b, math.nan


@njit(allocates=False)
def modelled_terms(m, p, omega, compliance, flow, b, u0, u1, constants, leak_flow, dt, mean, theta,
                   plain, remembering, flows, memory, trial, slopes, step, slope, at, s, c):
    """Return force, flow and the variance of that force as the modelled effects have them.

    Their slopes to the states go into ``step`` and its slope to c.  ``flow`` is theirs at the
    sample's start; other arguments as :func:`advance_two`.
    """
    rows = m.shape[0] - 1
    force, to_force, unknown, middle_x = 0.0, 0.0, 0.0, m[0] + 0.5 * dt * m[1]
    on_force, on_flow = 5 * rows, 6 * rows  # where these columns of the step begin
    ahead = (step[3 * rows + 2] * u0 + step[4 * rows + 2] * u1
             + step[on_force + 2] * at[TOLD_FORCE] + step[on_flow + 2] * (flow + leak_flow))
    for i in range(rows):
        ahead += step[column(i) * rows + 2] * m[place(i)]
    if len(flows) > 0:  # the flow at the middle of the sample, and how it follows the force
        h = max(math.sqrt(max(p[2, 2], 0.0)), 1e-3)
        middle = 0.5 * (m[2] + ahead)
        for side in (1.0, -1.0):
            _, _, flow = flow_balance(middle_x, m[1], omega, middle + side * h, mean, compliance,
                                      constants, theta, flows, memory, s, c)
            to_force += side * flow
        to_force *= 0.5 * (1.0 + step[2 * rows + 2]) / (2.0 * h)
        _, _, flow = flow_balance(middle_x, m[1], omega, middle, mean, compliance, constants,
                                  theta, flows, memory, s, c)
    if len(plain) + len(remembering) > 0:
        p1 = (m[2] + 2.0 * theta[1] * mean) / (theta[0] + theta[1])
        force, slope_x, slope_v, unknown = modelled_force(
            m[0], m[1], p[0, 0], p[1, 1], m[2], ahead, b, constants[MASS], dt, int(at[STEPS]), p1,
            2.0 * mean - p1, theta, plain, remembering, memory, trial, slopes, s, c)
        at[TOLD_FORCE] = force
        force -= slope_x * m[0] + slope_v * m[1]
        for i in range(rows):
            step[i] += step[on_force + i] * slope_x
            step[rows + i] += step[on_force + i] * slope_v
            slope[i] += slope[on_force + i] * slope_x
            slope[rows + i] += slope[on_force + i] * slope_v
    flow -= to_force * m[2]
    for i in range(rows):
        step[2 * rows + i] += step[on_flow + i] * to_force
        slope[2 * rows + i] += slope[on_flow + i] * to_force
    return force, flow, unknown


@njit(forceinline=True, allocates=False)
def advance_two(m, p, sens, u0, u1, i0, i1, b, constants, leak, leak_flow, dt, q_f, q_u, mean,
                theta, plain, remembering, flows, memory, trial, slopes, matrices, at, work, s, c):
    """Carry the stage over one sample with the modelled effects; False where it cannot.

    Parameters
    ----------
    m, p, sens : updated, as :func:`steps_two.predict_with`.
    b, leak_flow, mean : damping, measured leakage and mean pressure over the sample.
    plain, remembering, flows : places of the modelled effects that make force, without and with
        memory, and of those in the flow balance.
    memory, trial : their memory, updated, and a copy of it.
    slopes : whether the states' covariance is to follow the modelled force.
    matrices, at : :func:`new_step`.  work, s, c : :func:`new_work`.
    """
    modelled = len(plain) + len(remembering) + len(flows) > 0
    if modelled and math.isnan(mean):  # a pressure that an effect needs
        return False
    compliance = max(m[3], STIFFEST)
    own, to_own, flow, omega = compliance, 1.0, 0.0, 0.5 * (u0 + u1)
    if constants[LOOP] > 0.0:
        omega = constants[LOOP] * (omega - m[0])
    if len(flows) > 0:
        own, to_own, flow = flow_balance(m[0] + 0.5 * dt * m[1], m[1], omega, m[2], mean,
                                         compliance, constants, theta, flows, memory, s, c)
        own = max(own, 0.1 * STIFFEST)
    if not (abs(own - at[AT_C]) <= REFRESH * at[AT_C] and abs(b - at[AT_B]) <= 1e-6 * abs(b)):
        make_step(own, b, constants, leak, dt, matrices, at, work)
    step, slope = matrices[5], matrices[6]
    if modelled or not abs(own - at[LAST_C]) <= 1e-6 * own:
        exact, d_c, d_cc, e = matrices[0], matrices[1], matrices[2], own - at[AT_C]
        for i in range(step.shape[0]):
            step[i] = exact[i] + e * (d_c[i] + 0.5 * e * d_cc[i])
            slope[i] = to_own * (d_c[i] + e * d_cc[i])
        at[LAST_C] = own
    force = 0.0
    if modelled:
        force, flow, unknown = modelled_terms(
            m, p, omega, compliance, flow, b, u0, u1, constants, leak_flow, dt, mean, theta, plain,
            remembering, flows, memory, trial, slopes, step, slope, at, s, c)
        q_f += unknown
    flow += leak_flow
    if math.isnan(force + flow):
        return False
    at[CONSTANT_FORCE], at[CONSTANT_FLOW], at[NOISE_FORCE] = force, flow, q_f
    if m.shape[0] == 4:
        predict_chambers(m, p, sens, step, slope, matrices[3], u0, u1, i0, i1, force, flow, q_f,
                         q_u)
    else:
        predict_line(m, p, sens, step, slope, matrices[3], u0, u1, i0, i1, force, flow, q_f, q_u)
    return True


@njit(allocates=False)
def as_modulus(c, own, total, s, beta_0):
    """Turn a compliance and its two variances into a modulus, Pa, and standard deviations.

    So for ``s``, the innovation's variance.  All (n,), in place; beside the loop of the filter
    since roots and divisions go several at once here.
    """
    for k in range(c.shape[0]):
        compliance = max(c[k], 1e-9)
        c[k] = beta_0 / compliance
        per_c = c[k] / compliance
        own[k], total[k], s[k] = (
            per_c * math.sqrt(own[k]), per_c * math.sqrt(total[k]), math.sqrt(s[k]))


@njit
def run_two(x, start, end, q_u, instrument, b, b_variance, constants, leak, leak_flow, dt, r, q_f,
            prior_variance, mean, theta, plain, remembering, flows, memory, m, p, sens, w,
            matrices, at, first, out, events):
    """Run the stage over the samples from ``first`` on.

    Its state is ``memory``, ``m``, ``p``, ``sens``, ``w``, ``matrices`` and ``at``: rows taken in
    two runs, the second with the last sample of the first before its own, give the same numbers
    as in one.

    Parameters
    ----------
    x : (n,) position, m; NaN where missing.
    start, end, q_u, instrument : (n,), (n, 2) hold of the drive input (x_d in m, or omega in
        rad/s), :class:`hold.Hold`.
    b, b_variance : (n,) damping of stage one and its variance.
    constants, leak : lumped hydraulics of :func:`stage_two.hydraulics`.
    leak_flow : (n,) :func:`inputs.measured_leakage` over the sample before each; 0 where
        ``leak`` stands for it.
    r, q_f : variances of the position (m^2) and of an unmodelled force (N^2).
    mean : (n,) or (1,) mean of both absolute pressures over the sample before each, Pa.
    theta, plain, remembering, flows, memory : modelled effects (:func:`advance_two`); their
        memory is updated.
    m, p, sens : (4,) x, v, F, c; (4, 4); (4,) sensitivity to B; updated.  With a line 6 of them:
        its n and dp_l.  m[0] NaN: fresh start.
    w : supervision, updated.  matrices, at : :func:`new_step`, updated.
    out : (8, n) written: x, v, a, beta_e, sigma of the filter, sigma with the uncertainty of B,
        innovation, innovation sigma.
    events : (k, 4) written: sample, beta before, beta after, samples in the window.

    Returns
    -------
    int
        Number of events.
    """
    n = x.shape[0]
    work, s_scratch, c_scratch = new_work(constants)
    trial = memory.copy()
    at[STEPS] = steps_in_sample(dt, theta, plain, remembering, memory, s_scratch, c_scratch)
    mass = constants[MASS]
    spikes, samples, found = int(w[SPIKED]), int(w[SAMPLES]), 0
    nan = math.nan
    factor = honest_factor(w)
    for k in range(first, n):
        lost = math.isnan(m[0])
        if not lost and k > 0:
            u0, u1, i0, i1 = start[k - 1], end[k], instrument[k - 1, 0], instrument[k, 1]
            i = k if mean.shape[0] > 1 else 0
            lost = math.isnan(u0 + u1 + i0 + i1 + b[k] + leak_flow[k])
            if not lost:
                lost = not advance_two(
                    m, p, sens, u0, u1, i0, i1, b[k], constants, leak, leak_flow[k], dt, q_f,
                    q_u[k], mean[i], theta, plain, remembering, flows, memory, trial, True,
                    matrices, at, work, s_scratch, c_scratch)
        if lost:
            at[TOLD_FORCE] = 0.0
        z = x[k]
        nu, s = nan, nan
        if not math.isnan(z):
            if lost:
                restart_two(m, p, sens, z, r, dt, constants)
            else:
                s = p[0, 0] + r
                nu = z - m[0]
                if nu * nu > GATE * s and spikes < SPIKES:
                    spikes += 1
                else:
                    spikes = 0
                    correct_two(m, p, sens, z, r, w)
        elif lost:
            m[0] = nan
        samples += 1
        if samples == BLOCK:
            samples = 0
            delta, information, window = look(w, m[3], p[3, 3], prior_variance)
            if information > 0.0:
                before = constants[BETA_0] / m[3]
                jump_two(m, p, delta, information)
                if found < events.shape[0]:
                    events[found, 0], events[found, 1] = k, before
                    events[found, 2] = constants[BETA_0] / m[3]
                    events[found, 3] = window
                found += 1
            factor = honest_factor(w)
        out[0, k], out[1, k] = m[0], m[1]
        out[2, k] = (m[2] - b[k] * m[1] - at[TOLD_FORCE]) / mass
        own = factor * factor * p[3, 3]
        out[3, k], out[4, k] = m[3], own
        out[5, k] = own + sens[3] * sens[3] * b_variance[k]
        out[6, k], out[7, k] = nu, s
    w[SPIKED], w[SAMPLES] = spikes, samples
    as_modulus(out[3, first:n], out[4, first:n], out[5, first:n], out[7, first:n],
               constants[BETA_0])
    return found


@njit
def log_likelihood_two(x, start, end, q_u, instrument, b, c, constants, leak, leak_flow, dt, r,
                       q_f, mean, theta, plain, remembering, flows, memory):
    """Return the log likelihood of a stretch under a fixed compliance ``c``.

    The resonance makes the likelihood of beta_e many-peaked: an extended filter that starts
    more than a few per cent away may lock on a wrong peak while the oil column rings.  A bank
    of these linear filters finds the right one.  Arguments as :func:`run_two`; ``b`` is one
    number.
    """
    matrices, at = new_step(constants)
    work, s_scratch, c_scratch = new_work(constants)
    memory, trial = memory.copy(), memory.copy()
    at[STEPS] = steps_in_sample(dt, theta, plain, remembering, memory, s_scratch, c_scratch)
    size = states_beside_c(constants) + 1
    m, p, sens, w = np.zeros(size), np.zeros((size, size)), np.zeros(size), np.zeros(N_SUPERVISION)
    m[3] = c
    lost = True
    spikes = 0
    total = 0.0
    for k in range(x.shape[0]):
        if not lost:
            u0, u1 = start[k - 1], end[k]
            i = k if mean.shape[0] > 1 else 0
            lost = math.isnan(u0 + u1 + leak_flow[k])
            if not lost:
                p[3, 3] = 1e-30  # c is fixed here
                lost = not advance_two(
                    m, p, sens, u0, u1, instrument[k - 1, 0], instrument[k, 1], b, constants, leak,
                    leak_flow[k], dt, q_f, q_u[k], mean[i], theta, plain, remembering, flows,
                    memory, trial, False, matrices, at, work, s_scratch, c_scratch)
                m[3] = c
        if math.isnan(x[k]):
            continue
        if lost:
            restart_two(m, p, sens, x[k], r, dt, constants)
            p[3, 3] = 1e-30
            at[TOLD_FORCE] = 0.0
            lost = False
            continue
        s = p[0, 0] + r
        nu = x[k] - m[0]
        if nu * nu > GATE * s and spikes < SPIKES:  # as in run_two, and no prize for it
            spikes += 1
            total -= 0.5 * (GATE + math.log(s))
            continue
        spikes = 0
        total -= 0.5 * (nu * nu / s + math.log(s))
        correct_two(m, p, sens, x[k], r, w)
    return total


def bank_two(x, start, end, q_u, instrument, b, grid, constants, leak, leak_flow, dt, r, q_f,
             mean, theta, plain, remembering, flows, memory):
    """Return the log likelihood at each compliance of ``grid``; (len(grid),)."""
    return np.array([log_likelihood_two(
        x, start, end, q_u, instrument, b, c, constants, leak, leak_flow, dt, r, q_f, mean, theta,
        plain, remembering, flows, memory) for c in grid])
