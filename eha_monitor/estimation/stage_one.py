"""Stage one (Eq. 3, 4): viscous damping from the pressure force and the position.

State (x, v, B); input the force u = A1 p1 - A2 p2 (or a measured force); measurement x.
"""

import math
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.discretisation import damped_mass_integrals
from eha_monitor.estimation.modelled import (
    Motion,
    Push,
    modelled_force,
    new_known_memory,
    new_work,
    steps_in_sample,
)
from eha_monitor.estimation.supervision import (
    BLOCK,
    INFORMATION,
    SAMPLES,
    SCORE,
    SLOW,
    SPIKED,
    honest_factor,
    look,
    new_supervision,
)
from eha_monitor.physics.signals import P1, P2

UNSEEN = 16.0  # squared sigmas below which a regressor is taken for noise
UNSEEN_SLOW = 4.0  # the same for the running mean, in the sigma of a single sample
MEMORY = 1.0 / 32.0  # weight of a new velocity in the running mean
STIFF = 0.5  # B T/M
GATE = 1e4  # squared standard deviations: a spike, not a mismatch
NEGATIVE = 0.02  # growth a sample that a damping below zero may make, before it is held
SPIKES = 3  # so many in a row are no spike
BROAD = 1e3  # fresh velocity: uncertain by this many position sigmas a sample


@njit(inline="always")
def predict_one(x, v, b, u0, u1, dt, mass):
    """Carry (x, v) over one sample, exactly for a force that runs linearly from u0 to u1.

    M v' = u(t) - B v, x' = v; the variation of constants gives, with g = B T/M and the
    integrals E_k of :func:`damped_mass_integrals`,

        v1 = E0 v + T/M   [u0 (E1 - E2) + u1 E2]
        x1 = x + T E1 v + T^2/M [u0 (E2 - E3) + u1 E3]

    Returns
    -------
    x1, v1 : m, m/s.
    f_xv, f_xb, f_vv, f_vb : derivatives of x1 and v1 to v and B.
    g_x, g_v : response of x1 and v1 to a unit force held over the sample, m/N, m/(s·N).
    """
    e0, e1, e2, e3, e4 = damped_mass_integrals(b * dt / mass)
    d0 = -e0
    d1 = e2 - e1
    d2 = 2.0 * e3 - e2
    d3 = 3.0 * e4 - e3
    per_mass = dt / mass
    v1 = e0 * v + per_mass * (u0 * (e1 - e2) + u1 * e2)
    x1 = x + dt * (e1 * v + per_mass * (u0 * (e2 - e3) + u1 * e3))
    f_vb = per_mass * (d0 * v + per_mass * (u0 * (d1 - d2) + u1 * d2))
    f_xb = per_mass * dt * (d1 * v + per_mass * (u0 * (d2 - d3) + u1 * d3))
    return x1, v1, dt * e1, f_xb, e0, f_vb, per_mass * dt * e2, per_mass * e1


@njit(inline="always")
def predict_one_euler(x, v, b, u0, dt, mass):
    """The same step as the paper prints it, Eq. 4: forward Euler."""
    v1 = v + dt * (u0 / mass - b / mass * v)
    return (x + dt * v, v1, dt, 0.0, 1.0 - dt * b / mass, -dt * v / mass,
            0.5 * dt * dt / mass, dt / mass)


@njit(inline="always")
def slopes_one(v, slow, p_vv, b, f_xb, f_vb, dt, mass):
    """Return the derivatives of (x, v) to B that the filter may learn from.

    Where the velocity is no larger than its own noise it tells nothing about B, and a filter
    that takes the noise for information drifts.  Then, and where the damping is so stiff
    (B T/M > 1/2) that the velocity follows the noisy force within a sample, the running mean
    ``slow`` of the velocity stands in as an instrument whose noise is not the sample's own:
    steady motion, u = B v, in the equations of :func:`predict_one`.

    Parameters
    ----------
    v, slow : velocity and its running mean, m/s.  p_vv : variance of v, given B.
    f_xb, f_vb : derivatives at the filter's own state.
    """
    if b * dt / mass <= STIFF and v * v >= UNSEEN * p_vv:
        return f_xb, f_vb
    if slow * slow < UNSEEN_SLOW * p_vv:
        return 0.0, 0.0
    u = b * slow
    _, _, _, g_xb, _, g_vb, _, _ = predict_one(0.0, slow, b, u, u, dt, mass)
    return g_xb, g_vb


class RowsOne(NamedTuple):
    """What stage one takes of each sample.

    Attributes
    ----------
    z : (n,) measured position, m; NaN where missing.
    u_start, u_end : (n,) the force's line over the sample (:class:`hold.Hold`), N.
    Q : (n,) variance of the force over the sample before each, N^2.
    p1, p2 : (n,) or (1,) absolute pressures over the sample before each, for effects that depend
        on them, Pa.
    """

    z: np.ndarray
    u_start: np.ndarray
    u_end: np.ndarray
    Q: np.ndarray
    p1: np.ndarray
    p2: np.ndarray


class ConstantsOne(NamedTuple):
    """Sample time (s), mass (kg), variance of the position (m^2), prior variance of B.

    ``euler`` runs Eq. 4 as printed.
    """

    dt: float
    mass: float
    R: float
    prior_variance: float
    euler: bool


class StateOne(NamedTuple):
    """All that stage one carries from sample to sample; updated in place.

    Attributes
    ----------
    x : (3,) position, velocity, B; x[0] NaN asks for a fresh start.
    P : (6,) covariance: xx, xv, xB, vv, vB, BB.
    watch : supervision.
    memory : of the modelled effects.
    """

    x: np.ndarray
    P: np.ndarray
    watch: np.ndarray
    memory: np.ndarray


def new_state_one(b: float, variance: float, frozen: bool = False) -> StateOne:
    """Return the state before the first sample; one that is ``frozen`` sees no change of B."""
    return StateOne(np.array([math.nan, 0.0, b]), np.array([0.0, 0.0, 0.0, 0.0, 0.0, variance]),
                    new_supervision(frozen), new_known_memory())


@njit(allocates=False)
def start_one(x, P, z, R, dt):
    """(Re)start position and velocity at a measurement; B and its variance stay."""
    x[0] = z
    x[1] = 0.0
    P[0], P[1], P[2], P[4] = R, 0.0, 0.0, 0.0
    P[3] = BROAD * BROAD * R / (dt * dt)


@njit
def run_one(rows, constants, effects, state, first, out, events):
    """Run the stage over the samples from ``first`` on.

    Rows taken in two runs, the second with the last sample of the first before its own, give the
    same numbers as in one.

    Parameters
    ----------
    rows, constants, state : :class:`RowsOne`, :class:`ConstantsOne`, :class:`StateOne`.
    effects : the modelled ones.
    out : (6, n) written: x, v, B, sigma_B, innovation, innovation sigma.
    events : (k, 4) written: sample, B before, B after, samples in the window that showed it.

    Returns
    -------
    int
        Number of events (may exceed k; those beyond are counted only).
    """
    z, u_start, u_end, Q, p1, p2 = rows
    dt, mass, R, prior_variance, euler = constants
    x, P, w, memory = state
    n = z.shape[0]
    work = new_work(memory)
    any_force = len(effects.plain) + len(effects.remembering) > 0
    steps = steps_in_sample(dt, effects, memory, work)
    spikes = int(w[SPIKED])
    samples = int(w[SAMPLES])
    found = 0
    nan = math.nan
    factor = honest_factor(w)
    for k in range(first, n):
        lost = math.isnan(x[0])
        if not lost and k > 0:
            u0, u1 = u_start[k - 1], u_end[k]
            if math.isnan(u0) or math.isnan(u1):
                lost = True
            else:
                b = x[2]
                slope_x = slope_v = unknown = 0.0
                if any_force:
                    i = k if p1.shape[0] > 1 else 0
                    work.s[P1], work.s[P2] = p1[i], p2[i]
                    force, slope_x, slope_v, unknown = modelled_force(
                        Motion(x[0], x[1], P[0], P[3]), Push(u0, u1, b, mass, dt, steps), effects,
                        memory, True, work)
                    u0 -= force
                    u1 -= force
                if euler:
                    x1, v1, fxv, fxb, fvv, fvb, q_x, q_v = predict_one_euler(
                        x[0], x[1], b, u0, dt, mass)
                else:
                    x1, v1, fxv, fxb, fvv, fvb, q_x, q_v = predict_one(
                        x[0], x[1], b, u0, u1, dt, mass)
                w[SLOW] += MEMORY * (x[1] - w[SLOW])
                if not euler:
                    P_vv = P[3] - P[4] * P[4] / P[5]
                    fxb, fvb = slopes_one(x[1], w[SLOW], P_vv, b, fxb, fvb, dt, mass)
                x[0], x[1] = x1, v1
                # The modelled force follows the states: it takes its slopes off theirs.
                fxx, fvx = 1.0 - q_x * slope_x, -q_v * slope_x
                fxv -= q_x * slope_v
                fvv -= q_v * slope_v
                # P = F P F' + Q with F = [[fxx, fxv, fxb], [fvx, fvv, fvb], [0, 0, 1]]
                bb, noise = P[5], Q[k] + unknown
                xb = fxx * P[2] + fxv * P[4] + fxb * bb
                vb = fvx * P[2] + fvv * P[4] + fvb * bb
                row_x = fxx * P[0] + fxv * P[1] + fxb * P[2]
                row_v = fxx * P[1] + fxv * P[3] + fxb * P[4]
                vv_x = fvx * P[0] + fvv * P[1] + fvb * P[2]
                vv_v = fvx * P[1] + fvv * P[3] + fvb * P[4]
                P[0] = fxx * row_x + fxv * row_v + fxb * xb + noise * q_x * q_x
                P[1] = fvx * row_x + fvv * row_v + fvb * xb + noise * q_x * q_v
                P[3] = fvx * vv_x + fvv * vv_v + fvb * vb + noise * q_v * q_v
                P[2] = xb
                P[4] = vb
        nu, sd = nan, nan
        if not math.isnan(z[k]):
            if lost:
                start_one(x, P, z[k], R, dt)
            else:
                S = P[0] + R
                nu = z[k] - x[0]
                sd = math.sqrt(S)
                if nu * nu > GATE * S and spikes < SPIKES:
                    spikes += 1
                else:
                    spikes = 0
                    h = P[2] / P[5]
                    w[SCORE] += h * nu / S
                    w[INFORMATION] += h * h / S
                    K_x, K_v, K_b = P[0] / S, P[1] / S, P[2] / S
                    x[0] += K_x * nu
                    x[1] += K_v * nu
                    x[2] = max(x[2] + K_b * nu, -NEGATIVE * mass / dt)
                    P[5] -= K_b * P[2]
                    P[4] -= K_v * P[2]
                    P[3] -= K_v * P[1]
                    P[2] -= K_x * P[2]
                    P[1] -= K_x * P[1]
                    P[0] -= K_x * P[0]
        elif lost:
            x[0] = nan
        samples += 1
        if samples == BLOCK:
            samples = 0
            delta, information, window = look(w, x[2], P[5], prior_variance)
            if information > 0.0:
                if found < events.shape[0]:
                    events[found, 0], events[found, 1] = k, x[2]
                    events[found, 2], events[found, 3] = x[2] + delta, window
                found += 1
                jump_one(x, P, delta, information)
                x[2] = max(x[2], -NEGATIVE * mass / dt)
            factor = honest_factor(w)
        out[0, k], out[1, k], out[2, k] = x[0], x[1], x[2]
        out[3, k] = factor * math.sqrt(P[5])
        out[4, k], out[5, k] = nu, sd
    w[SPIKED], w[SAMPLES] = spikes, samples
    return found


@njit(allocates=False)
def jump_one(x, P, delta, information):
    """Move B by ``delta`` and forget: variance 4/information, states moved with h = P_sB/P_BB."""
    h_x, h_v = P[2] / P[5], P[4] / P[5]
    grown = max(4.0 / information, P[5]) - P[5]
    x[0] += h_x * delta
    x[1] += h_v * delta
    x[2] += delta
    P[0] += h_x * h_x * grown
    P[1] += h_x * h_v * grown
    P[3] += h_v * h_v * grown
    P[5] += grown
    P[2] = h_x * P[5]
    P[4] = h_v * P[5]
