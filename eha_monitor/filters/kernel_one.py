"""Stage one over rows, of a recording or live, compiled."""

import math

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.filters.known import modelled_force, steps_in_sample
from eha_monitor.filters.stage_one import MEMORY, predict_one, predict_one_euler, slopes_one
from eha_monitor.filters.supervision import (
    BLOCK,
    INFORMATION,
    SAMPLES,
    SCORE,
    SLOW,
    SPIKED,
    honest_factor,
    look,
)
from eha_monitor.physics.signals import N_CONTRIBUTIONS, N_SIGNALS

GATE = 1e4  # squared standard deviations: a spike, not a mismatch
NEGATIVE = 0.02  # growth a sample that a damping below zero may make, before it is held
SPIKES = 3  # so many in a row are no spike
BROAD = 1e3  # fresh velocity: uncertain by this many position sigmas a sample


@njit(allocates=False)
def start_one(m, p, x, r, dt, keep):
    """(Re)start (x, v) at a measurement; ``keep`` leaves B and its variance as they are.

    m : (3,) x, v, B;  p : (6,) xx, xv, xb, vv, vb, bb.
    """
    m[0] = x
    m[1] = 0.0
    p[0], p[1], p[2], p[4] = r, 0.0, 0.0, 0.0
    p[3] = BROAD * BROAD * r / (dt * dt)
    if not keep:
        p[5] = 0.0


@njit
def run_one(x, start, end, q, p1, p2, dt, mass, r, prior_variance, euler, theta, plain,
            remembering, memory, m, p, w, first, out, events):
    """Run the stage over the samples from ``first`` on.

    Its state is ``memory``, ``m``, ``p`` and ``w``: rows taken in two runs, the second with the
    last sample of the first before its own, give the same numbers as in one.

    Parameters
    ----------
    x : (n,) position, m; NaN where missing.
    start, end, q : (n,) force hold, N (:class:`filters.hold.Hold`), and the force's variance over
        the sample before each, N^2.
    p1, p2 : (n,) or (1,) absolute pressures over the sample before each, for
        pressure-dependent effects, Pa.
    r : variance of the position, m^2.
    euler : run Eq. 4 as printed.
    theta, plain, remembering, memory : modelled effects (:func:`known.mean_force`); their memory
        is updated.
    m, p : state (3,) and covariance (6,), updated; m[0] NaN asks for a fresh start.
    w : supervision, updated.
    out : (6, n) written: x, v, B, sigma_B, innovation, innovation sigma.
    events : (k, 4) written: sample, B before, B after, samples in the window that showed it.

    Returns
    -------
    int
        Number of events (may exceed k; those beyond are counted only).
    """
    n = x.shape[0]
    s_scratch, c_scratch = np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS)
    trial = memory.copy()
    any_force = len(plain) + len(remembering) > 0
    steps = steps_in_sample(dt, theta, plain, remembering, memory, s_scratch, c_scratch)
    spikes = int(w[SPIKED])
    samples = int(w[SAMPLES])
    found = 0
    nan = math.nan
    factor = honest_factor(w)
    for k in range(first, n):
        lost = math.isnan(m[0])
        if not lost and k > 0:
            u0, u1 = start[k - 1], end[k]
            if math.isnan(u0) or math.isnan(u1):
                lost = True
            else:
                b = m[2]
                slope_x = slope_v = unknown = 0.0
                if any_force:
                    i = k if p1.shape[0] > 1 else 0
                    force, slope_x, slope_v, unknown = modelled_force(
                        m[0], m[1], p[0], p[3], u0, u1, b, mass, dt, steps, p1[i], p2[i], theta,
                        plain, remembering, memory, trial, True, s_scratch, c_scratch)
                    u0 -= force
                    u1 -= force
                if euler:
                    x1, v1, fxv, fxb, fvv, fvb, q_x, q_v = predict_one_euler(
                        m[0], m[1], b, u0, dt, mass)
                else:
                    x1, v1, fxv, fxb, fvv, fvb, q_x, q_v = predict_one(
                        m[0], m[1], b, u0, u1, dt, mass)
                w[SLOW] += MEMORY * (m[1] - w[SLOW])
                if not euler:
                    p_vv = p[3] - p[4] * p[4] / p[5]
                    fxb, fvb = slopes_one(m[1], w[SLOW], p_vv, b, fxb, fvb, dt, mass)
                m[0], m[1] = x1, v1
                # The modelled force follows the states: it takes its slopes off theirs.
                fxx, fvx = 1.0 - q_x * slope_x, -q_v * slope_x
                fxv -= q_x * slope_v
                fvv -= q_v * slope_v
                # P = F P F' + Q with F = [[fxx, fxv, fxb], [fvx, fvv, fvb], [0, 0, 1]]
                bb, noise = p[5], q[k] + unknown
                xb = fxx * p[2] + fxv * p[4] + fxb * bb
                vb = fvx * p[2] + fvv * p[4] + fvb * bb
                row_x = fxx * p[0] + fxv * p[1] + fxb * p[2]
                row_v = fxx * p[1] + fxv * p[3] + fxb * p[4]
                vv_x = fvx * p[0] + fvv * p[1] + fvb * p[2]
                vv_v = fvx * p[1] + fvv * p[3] + fvb * p[4]
                p[0] = fxx * row_x + fxv * row_v + fxb * xb + noise * q_x * q_x
                p[1] = fvx * row_x + fvv * row_v + fvb * xb + noise * q_x * q_v
                p[3] = fvx * vv_x + fvv * vv_v + fvb * vb + noise * q_v * q_v
                p[2] = xb
                p[4] = vb
        z = x[k]
        nu, sd = nan, nan
        if not math.isnan(z):
            if lost:
                start_one(m, p, z, r, dt, True)
            else:
                s = p[0] + r
                nu = z - m[0]
                sd = math.sqrt(s)
                if nu * nu > GATE * s and spikes < SPIKES:
                    spikes += 1
                else:
                    spikes = 0
                    h = p[2] / p[5]
                    w[SCORE] += h * nu / s
                    w[INFORMATION] += h * h / s
                    kx, kv, kb = p[0] / s, p[1] / s, p[2] / s
                    m[0] += kx * nu
                    m[1] += kv * nu
                    m[2] = max(m[2] + kb * nu, -NEGATIVE * mass / dt)
                    p[5] -= kb * p[2]
                    p[4] -= kv * p[2]
                    p[3] -= kv * p[1]
                    p[2] -= kx * p[2]
                    p[1] -= kx * p[1]
                    p[0] -= kx * p[0]
        elif lost:
            m[0] = nan
        samples += 1
        if samples == BLOCK:
            samples = 0
            delta, information, window = look(w, m[2], p[5], prior_variance)
            if information > 0.0:
                if found < events.shape[0]:
                    events[found, 0], events[found, 1] = k, m[2]
                    events[found, 2], events[found, 3] = m[2] + delta, window
                found += 1
                jump_one(m, p, delta, information)
                m[2] = max(m[2], -NEGATIVE * mass / dt)
            factor = honest_factor(w)
        out[0, k], out[1, k], out[2, k] = m[0], m[1], m[2]
        out[3, k] = factor * math.sqrt(p[5])
        out[4, k], out[5, k] = nu, sd
    w[SPIKED], w[SAMPLES] = spikes, samples
    return found


@njit(allocates=False)
def jump_one(m, p, delta, information):
    """Move B by ``delta`` and forget: variance 4/information, states moved with h = P_sB/P_BB."""
    h_x, h_v = p[2] / p[5], p[4] / p[5]
    grown = max(4.0 / information, p[5]) - p[5]
    m[0] += h_x * delta
    m[1] += h_v * delta
    m[2] += delta
    p[0] += h_x * h_x * grown
    p[1] += h_x * h_v * grown
    p[3] += h_v * h_v * grown
    p[5] += grown
    p[2] = h_x * p[5]
    p[4] = h_v * p[5]
