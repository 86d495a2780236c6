"""Effects that the config names, as the stages need them: the mean force of a sample, the flow.

What an effect does in a sample is integrated along the predicted motion in short steps, because a
dry friction turns over within one.  An effect that remembers sees the *predicted path*: a
correction of the estimate is no motion, and must not wear the memory of a seal that sticks.
"""

import math
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.discretisation import BETA_0, EXTRA_C, GAIN, STIFF
from eha_monitor.estimation.small_matrices import copied
from eha_monitor.physics import signals as of
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import (
    N_EFFECTS,
    add_contributions,
    new_memory,
    update_memory,
    with_term,
    with_update,
)

PATH = N_EFFECTS  # row of the memory that holds how far the predicted motion has gone, m
FEWEST, FEWEST_REMEMBERING, MOST = 2, 8, 64  # integration steps in a sample
FAR = 1e6  # m along the path: an effect has forgotten where it came from
SWING = 0.2  # rad of a mass on its seal, in a step
STICKING = 20.0  # a force of unknown share counts as so many times uncertain: it is not white


class Effects(NamedTuple):
    """The modelled effects.

    Attributes
    ----------
    theta : (N_THETA,) parameters of rig and effects.
    plain, remembering : places of the effects that make force, without and with memory.
    flows : places of those in the flow balance.
    """

    theta: np.ndarray
    plain: np.ndarray
    remembering: np.ndarray
    flows: np.ndarray


class Work(NamedTuple):
    """Scratch: a second memory, signals and contributions."""

    trial: np.ndarray
    s: np.ndarray
    c: np.ndarray


class Push(NamedTuple):
    """What moves a mass over a sample.

    Attributes
    ----------
    f0, f1 : driving force at the sample's two ends, N.
    b, mass, dt : damping (N·s/m), kg, s.
    steps : of the integration.
    """

    f0: float
    f1: float
    b: float
    mass: float
    dt: float
    steps: int


class Motion(NamedTuple):
    """Position and velocity at a sample's start, m and m/s, and their variances."""

    x: float
    v: float
    var_x: float
    var_v: float


class OilState(NamedTuple):
    """Where the flow balance is evaluated.

    Attributes
    ----------
    x, v, omega, force : m, m/s, rad/s, N.
    mean : mean of both pressures, Pa.
    compliance : c = beta_0/beta_e.
    """

    x: float
    v: float
    omega: float
    force: float
    mean: float
    compliance: float


def new_known_memory() -> np.ndarray:
    """Return the memory of all effects at the start and the path, (N_EFFECTS + 1, MAX_MEMORY)."""
    memory = new_memory()
    return np.vstack([memory, np.zeros((1, memory.shape[1]))])


@njit
def new_work(memory):
    """Return scratch for effects with this memory."""
    return Work(memory.copy(), np.zeros(of.N_SIGNALS), np.zeros(of.N_CONTRIBUTIONS))


@njit(allocates=False)
def contributions(s, theta, terms, memory, c):
    """Compile :func:`add_contributions` once; inlined everywhere it makes the filters large."""
    add_contributions(s, theta, terms, memory, c)


@njit(allocates=False)
def remember(s, theta, updates, h, memory):
    """Compile :func:`update_memory` once."""
    update_memory(s, theta, updates, h, memory)


@njit(allocates=False)
def force_at(x, path, v, effects, memory, work):
    """Return the modelled force in N at position ``x``, place on the path and velocity."""
    s, c = work.s, work.c
    force = 0.0
    s[of.V] = v
    if len(effects.plain) > 0:
        s[of.X] = x
        contributions(s, effects.theta, effects.plain, memory, c)
        force = c[of.FORCE]
    if len(effects.remembering) > 0:
        s[of.X] = path
        contributions(s, effects.theta, effects.remembering, memory, c)
        force += c[of.FORCE]
    return force


@njit(allocates=False)
def steps_in_sample(dt, effects, memory, work):
    """Return how many steps follow a friction as it turns over.

    One without a seal turns over with v, within v_e: a rate of dF/dv / M.  A seal holds what it
    has at v = 0 and turns over with x: only its micro damping goes with v, and on its stiffness
    the mass swings with sqrt(k / M).
    """
    h, near = 1e-6, 1e-8
    s, theta, trial = work.s, effects.theta, work.trial
    s[of.P1] = s[of.P2] = theta[of.P_CHARGE]
    for which in range(memory.shape[0]):
        copied(trial[which], memory[which])
    s[of.X], s[of.V] = FAR, h
    if len(effects.remembering) > 0:
        remember(s, theta, effects.remembering, h, trial)
    ahead = force_at(0.0, FAR, h, effects, trial, work)
    behind = force_at(0.0, FAR, -h, effects, trial, work)
    rate = abs(ahead - behind) / (2.0 * h) / theta[of.M]
    if not rate * dt < 1e6:
        return MOST
    steps = 2.0 * rate * dt
    if len(effects.remembering) == 0:
        return min(max(math.ceil(steps), FEWEST), MOST)
    stiff = abs(force_at(0.0, FAR - near, -h, effects, trial, work) - behind) / near
    steps = max(steps, math.sqrt(stiff / theta[of.M]) * dt / SWING)
    return min(max(math.ceil(steps), FEWEST_REMEMBERING), MOST)


@njit(allocates=False)
def mean_force(x, v, push, effects, memory, work):
    """Return the modelled force, N, averaged over a sample (Heun).

    Parameters
    ----------
    x, v : at the sample's start.
    push : :class:`Push`.
    memory : (N_EFFECTS + 1, MAX_MEMORY), goes with the motion.
    work : the pressures among its signals are set.
    """
    f0, f1, b, mass, dt, steps = push
    h = dt / steps
    path = memory[PATH, 0]
    total = 0.0
    for i in range(steps):
        u_0 = f0 + (f1 - f0) * i / steps
        u_1 = f0 + (f1 - f0) * (i + 1) / steps
        here = force_at(x, path, v, effects, memory, work)
        a = (u_0 - b * v - here) / mass
        along = h * (v + 0.5 * h * a)
        ahead = force_at(x + along, path + along, v + h * a, effects, memory, work)
        a = 0.5 * (a + (u_1 - b * (v + h * a) - ahead) / mass)
        along = h * (v + 0.5 * h * a)
        v += h * a
        x += along
        path += along
        total += 0.5 * (here + ahead)
        if len(effects.remembering) > 0:
            work.s[of.X], work.s[of.V] = path, v
            remember(work.s, effects.theta, effects.remembering, h, memory)
    memory[PATH, 0] = path
    return total / steps


@njit(allocates=False)
def modelled_force(motion, push, effects, memory, slopes, work):
    """Return the mean force of a sample, its slopes to x and v, and its own variance.

    The slopes are central differences over the states' standard deviations.  The slope to x is
    that of the effects without memory: an error of x is also one of the place remembered.  While
    the velocity is no larger than its uncertainty, the share of a dry friction that acts is not
    known; what the slope does not cover of that counts as noise (N^2).  Without ``slopes`` all
    three are 0.  The pressures among the signals of ``work`` are set.
    """
    x, v, var_x, var_v = motion
    if not slopes:
        return mean_force(x, v, push, effects, memory, work), 0.0, 0.0, 0.0
    s, c, theta, trial = work.s, work.c, effects.theta, work.trial
    h = max(math.sqrt(max(var_v, 0.0)), 1e-9)
    slope_x = slope_v = unknown = 0.0
    for side in (1.0, -1.0):
        for which in range(memory.shape[0]):
            copied(trial[which], memory[which])
        slope_v += side * mean_force(x, v + side * h, push, effects, trial, work)
    slope_v /= 2.0 * h
    if len(effects.plain) > 0:
        h_x = max(math.sqrt(max(var_x, 0.0)), 1e-9)
        s[of.V] = v
        for side in (1.0, -1.0):
            s[of.X] = x + side * h_x
            contributions(s, theta, effects.plain, memory, c)
            slope_x += side * c[of.FORCE]
        slope_x /= 2.0 * h_x
    if len(effects.remembering) > 0:
        s[of.X] = memory[PATH, 0] + FAR
        for side in (1.0, -1.0):
            s[of.V] = v + 2.0 * side * h
            contributions(s, theta, effects.remembering, memory, c)
            unknown += 0.5 * side * c[of.FORCE]
        unknown = STICKING * max(abs(unknown) - 2.0 * h * abs(slope_v), 0.0)
    force = mean_force(x, v, push, effects, memory, work)
    return force, slope_x, slope_v, unknown * unknown


@njit(allocates=False)
def flow_balance(oil, k, effects, memory, work):
    """Return the compliance that acts, its slope to the filter's, and the effects' flow.

    With each chamber's own volume and compliance F' = S (D_p omega/A1 - v) + ..., with
    S = sum A_i^2/(V_i (1/beta_e + C_i)).  The lumped step has S = beta_0 S2/(c + extra); the c
    that gives it the same S is returned, and the flow in N/Pa/s as that step takes it.

    Parameters
    ----------
    oil : :class:`OilState`;  both pressures come from its force and the mean of the two.
    k : lumped hydraulics.
    """
    s, c, theta = work.s, work.c, effects.theta
    a_1, a_2 = theta[of.AREA_1], theta[of.AREA_2]
    s[of.X], s[of.V], s[of.OMEGA] = oil.x, oil.v, oil.omega
    s[of.P1] = (oil.force + 2.0 * a_2 * oil.mean) / (a_1 + a_2)
    s[of.P2] = 2.0 * oil.mean - s[of.P1]
    contributions(s, theta, effects.flows, memory, c)
    soft_1 = (theta[of.VOL_1] + c[of.VOLUME_1]) * (oil.compliance / k[BETA_0] + c[of.COMPLIANCE_1])
    soft_2 = (theta[of.VOL_2] + c[of.VOLUME_2]) * (oil.compliance / k[BETA_0] + c[of.COMPLIANCE_2])
    stiff = a_1 * a_1 / soft_1 + a_2 * a_2 / soft_2
    lumped = k[BETA_0] * k[STIFF] / stiff
    slope = k[STIFF] / (stiff * stiff) * (
        a_1 * a_1 * (theta[of.VOL_1] + c[of.VOLUME_1]) / (soft_1 * soft_1)
        + a_2 * a_2 * (theta[of.VOL_2] + c[of.VOLUME_2]) / (soft_2 * soft_2))
    flow = (a_1 * c[of.FLOW_1] / soft_1 - a_2 * c[of.FLOW_2] / soft_2) * k[STIFF] / stiff
    return lumped - k[EXTRA_C], slope, flow + k[GAIN] * c[of.SPEED]


@njit(nogil=True)
def contributions_along(trajectory, dt, steps, theta, active, memory, out):
    """Write what the active effects contribute on a trajectory.

    Parameters
    ----------
    trajectory : (n, N_SIGNALS) signals, linear between samples.
    steps : steps of the effects' memory in a sample of ``dt`` s.
    out : (n, N_CONTRIBUTIONS) written.
    """
    terms, updates = with_term(active), with_update(active, theta)
    now = np.zeros(s.N_SIGNALS)
    c = np.zeros(s.N_CONTRIBUTIONS)
    n = trajectory.shape[0]
    for k in range(n):
        copied(now, trajectory[k])
        add_contributions(now, theta, terms, memory, c)
        copied(out[k], c)
        if k + 1 < n and len(updates):
            for i in range(1, steps + 1):
                f = i / steps
                for j in range(now.shape[0]):
                    now[j] = (1.0 - f) * trajectory[k, j] + f * trajectory[k + 1, j]
                f -= 0.5 / steps
                now[s.OMEGA] = (1.0 - f) * trajectory[k, s.OMEGA] + f * trajectory[k + 1, s.OMEGA]
                update_memory(now, theta, updates, dt / steps, memory)
