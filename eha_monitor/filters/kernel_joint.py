"""B, beta_e and leakage as constant states of one filter over position, force and drive."""

import math

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.filters.kernel_one import GATE, SPIKES
from eha_monitor.filters.stage_one import UNSEEN
from eha_monitor.filters.stage_two import BETA_0, MASS, discretise
from eha_monitor.filters.steps_two import start_two

# x, v, F, B, c = beta_0/beta_e, leak = C_T/2 (1/V1 + 1/V2), and the present sample's error of the
# input: it acts in this step and the next, so it must be a state for the innovations to be white.
STATES = 7

REFRESH_C, REFRESH_B, REFRESH_LEAK = 5e-3, 1e-2, 1e-3


@njit
def update_scalar(m, p, index, z, r, frozen, k):
    """Update with a scalar measurement of state ``index``; return innovation and variance.

    ``frozen``: see :func:`run_joint`.
    """
    s = p[index, index] + r
    nu = z - m[index]
    for i in range(STATES):
        k[i] = p[i, index] / s
        if not frozen:
            m[i] += k[i] * nu
    for i in range(STATES):
        row = p[index, i]
        if i != index:
            for j in range(STATES):
                if j != index:
                    p[j, i] -= k[j] * row
    lead = 1.0 - k[index]
    for i in range(STATES):
        if i != index:
            p[index, i] *= lead
            p[i, index] = p[index, i]
    p[index, index] *= lead
    return nu, s


@njit
def run_joint(x, force, start, end, q_u, instrument, constants, dt, r_x, r_f, q_f, frozen,
              m, p, matrices, at, first, out):
    """Run the filter over the samples from ``first`` on.

    Its state is ``m``, ``p``, ``matrices`` and ``at``: rows taken in two runs, the second with
    the last sample of the first before its own, give the same numbers as in one.

    Parameters
    ----------
    x, force : (n,) measured position m and force N; NaN where missing.
    start, end, q_u, instrument : (n,), (n, 2) hold of the drive input (:class:`hold.Hold`).
    constants : lumped hydraulics (:func:`stage_two.hydraulics`).
    r_x, r_f : variances of the measurements; r_f infinite leaves the force out.
    q_f : variance of an unmodelled force, N^2.
    frozen : the measurements move neither states nor parameters (the model's own motion under
        the drive input); P learns all the same and ends as the inverse of prior plus Fisher
        information.
    m, p : (7,), (7, 7) updated; m[0] NaN asks for a fresh start.
    matrices, at : :func:`new_step`, updated.
    out : (7, n) written: B, beta_e, leak, innovation and sigma of x, of the force.
    """
    work = np.empty((10, 3, 3))
    base, d_c, d_cc, d_b, d_leak = matrices
    step = np.empty((3, 7))
    f = np.zeros((3, STATES))
    temp = np.empty((3, STATES))
    gain = np.empty(STATES)
    at_b, at_c, at_l, spikes = at
    mass = constants[MASS]
    nan = math.nan
    for k in range(first, x.shape[0]):
        lost = math.isnan(m[0])
        if not lost and k > 0:
            u0, u1 = start[k - 1], end[k]
            if math.isnan(u0 + u1 + instrument[k - 1, 0] + instrument[k, 1]):
                lost = True
            else:
                b, c, leak = m[3], max(m[4], 1e-3), m[5]
                beta = constants[BETA_0] / c
                if not (abs(c - at_c) <= REFRESH_C * at_c
                        and abs(b - at_b) <= REFRESH_B * (abs(at_b) + 0.01 * mass / dt)
                        and abs(leak - at_l) * beta * dt <= REFRESH_LEAK):
                    at_b, at_c, at_l = b, c, leak
                    discretise(constants, b, c, leak, dt, work, base, d_c, d_cc, d_b, d_leak)
                e_c, e_b, e_l = c - at_c, b - at_b, leak - at_l
                for i in range(3):
                    for j in range(7):
                        step[i, j] = (base[i, j] + e_c * (d_c[i, j] + 0.5 * e_c * d_cc[i, j])
                                      + e_b * d_b[i, j] + e_l * d_leak[i, j])
                predict(m, p, step, d_b, d_c, d_leak, u0, u1, instrument[k - 1, 0],
                        instrument[k, 1], q_u[k], q_f, f, temp)
        nu_x, sd_x, nu_f, sd_f = nan, nan, nan, nan
        if lost and not math.isnan(x[k]):
            restart(m, p, x[k], r_x, mass, dt)
        elif lost:
            m[0] = nan
        elif not math.isnan(x[k]):
            far = (x[k] - m[0]) ** 2 > GATE * (p[0, 0] + r_x)
            if far and not frozen and spikes < SPIKES:  # as the stages do
                spikes += 1
            else:
                spikes = 0.0
                nu_x, s = update_scalar(m, p, 0, x[k], r_x, frozen, gain)
                sd_x = math.sqrt(s)
        if not math.isnan(m[0]) and r_f < math.inf and not math.isnan(force[k]):
            nu_f, s = update_scalar(m, p, 2, force[k], r_f, frozen, gain)
            sd_f = math.sqrt(s)
        out[0, k], out[1, k], out[2, k] = m[3], constants[BETA_0] / max(m[4], 1e-9), m[5]
        out[3, k], out[4, k], out[5, k], out[6, k] = nu_x, sd_x, nu_f, sd_f
    at[0], at[1], at[2], at[3] = at_b, at_c, at_l, spikes


def new_step() -> tuple[np.ndarray, np.ndarray]:
    """Return the matrices of a step and where they hold (B, c, leak; spikes in a row): nowhere."""
    return np.empty((5, 3, 7)), np.array([np.nan, np.nan, np.nan, 0.0])


@njit
def restart(m, p, x, r, mass, dt):
    """(Re)start the states and the input's error; parameters and their variance stay."""
    start_two(m, p, x, r, dt, mass)
    m[6] = 0.0
    for j in range(STATES):
        p[6, j] = 0.0
        p[j, 6] = 0.0


@njit
def predict(m, p, step, d_b, d_c, d_leak, u0, u1, i0, i1, q_u, q_f, f, temp):
    """Predict over one sample; regressors that are no larger than noise carry no information."""
    y = (m[0], m[1], m[2], u0 - m[6], u1)
    told = (m[0], m[1], m[2], i0, i1)  # what multiplies the parameters, without fresh noise
    new = np.zeros(3)
    for i in range(3):
        to_b, to_c, to_l = 0.0, 0.0, 0.0
        for j in range(5):
            new[i] += step[i, j] * y[j]
            to_b += d_b[i, j] * told[j]
            to_c += d_c[i, j] * told[j]
            to_l += d_leak[i, j] * told[j]
        for j in range(3):
            f[i, j] = step[i, j]
        f[i, 3], f[i, 4], f[i, 5] = to_b, to_c, to_l
    noise = q_u * (d_c[2, 3] + d_c[2, 4]) ** 2
    for i in range(3):
        for j in range(3):
            noise += d_c[2, i] * p[i, j] * d_c[2, j]
    lean = d_c[2, 0] * p[0, 4] + d_c[2, 1] * p[1, 4] + d_c[2, 2] * p[2, 4]
    noise -= lean * lean / p[4, 4]  # what the parameter's own uncertainty makes is no noise
    seen_b = m[1] * m[1] >= UNSEEN * (p[1, 1] - p[1, 3] * p[1, 3] / p[3, 3])
    seen_c = f[2, 4] * f[2, 4] >= UNSEEN * noise
    seen_l = m[2] * m[2] >= UNSEEN * (p[2, 2] - p[2, 5] * p[2, 5] / p[5, 5])
    for i in range(3):
        if not seen_b:
            f[i, 3] = 0.0
        if not seen_c:
            f[i, 4] = 0.0
        if not seen_l:
            f[i, 5] = 0.0
    for i in range(3):
        for j in range(STATES):
            total = -step[i, 3] * p[6, j]
            for k in range(6):
                total += f[i, k] * p[k, j]
            temp[i, j] = total
    for i in range(3):
        for j in range(i, 3):
            total = -temp[i, 6] * step[j, 3]
            for k in range(6):
                total += temp[i, k] * f[j, k]
            total += q_u * step[i, 4] * step[j, 4] + q_f * step[i, 5] * step[j, 5]
            p[i, j] = total
            p[j, i] = total
        for j in range(3, 6):
            p[i, j] = temp[i, j]
            p[j, i] = temp[i, j]
        p[i, 6] = -q_u * step[i, 4]
        p[6, i] = p[i, 6]
    for j in range(3, 6):
        p[6, j] = 0.0
        p[j, 6] = 0.0
    p[6, 6] = q_u
    m[0], m[1], m[2], m[6] = new[0], new[1], new[2], 0.0
