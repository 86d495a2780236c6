"""Effects that the config names, as the stages need them: the mean force of a sample, the flow.

What an effect does in a sample is integrated along the predicted motion in short steps, because a
dry friction turns over within one.  An effect that remembers sees the *predicted path*: a
correction of the estimate is no motion, and must not wear the memory of a seal that sticks.
"""

import math

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.filters.small_matrices import copied
from eha_monitor.filters.stage_two import BETA_0, EXTRA_C, GAIN, STIFF
from eha_monitor.physics.contributions import (
    N_EFFECTS,
    add_contributions,
    new_memory,
    slot_of,
    update_memory,
)
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.own_term import speaks
from eha_monitor.physics.signals import (
    AREA_1,
    AREA_2,
    COMPLIANCE_1,
    COMPLIANCE_2,
    FLOW_1,
    FLOW_2,
    FORCE,
    OMEGA,
    P1,
    P2,
    P_CHARGE,
    SPEED,
    VOL_1,
    VOL_2,
    VOLUME_1,
    VOLUME_2,
    M,
    V,
    X,
)

PATH = N_EFFECTS  # row of the memory that holds how far the predicted motion has gone, m
FEWEST, FEWEST_REMEMBERING, MOST = 2, 8, 64  # integration steps in a sample
FAR = 1e6  # m along the path: an effect has forgotten where it came from
STICKING = 20.0  # a force of unknown share counts as so many times uncertain: it is not white


def new_known_memory() -> np.ndarray:
    """Return the memory of all effects at the start and the path, (N_EFFECTS + 1, MAX_MEMORY)."""
    memory = new_memory()
    return np.vstack([memory, np.zeros((1, memory.shape[1]))])


def speaks_of(which: int, theta: np.ndarray, *contributions: str) -> bool:
    """Tell whether the term at a place adds to one of these contributions, by their names."""
    if which >= len(NAMES):
        return speaks(theta[slot_of(which)], *contributions)
    term = CATALOGUE[NAMES[which]].term
    names = getattr(term, "py_func", term).__code__.co_names
    return any(name in names for name in contributions)


@njit(allocates=False)
def contributions(s, theta, terms, memory, c):
    """Compile :func:`add_contributions` once; inlined everywhere it makes the filters large."""
    add_contributions(s, theta, terms, memory, c)


@njit(allocates=False)
def remember(s, theta, updates, h, memory):
    """Compile :func:`update_memory` once."""
    update_memory(s, theta, updates, h, memory)


@njit(allocates=False)
def force_at(x, path, v, theta, plain, remembering, memory, s, c):
    """Return the modelled force in N at position ``x``, place on the path and velocity."""
    force = 0.0
    s[V] = v
    if len(plain) > 0:
        s[X] = x
        contributions(s, theta, plain, memory, c)
        force = c[FORCE]
    if len(remembering) > 0:
        s[X] = path
        contributions(s, theta, remembering, memory, c)
        force += c[FORCE]
    return force


@njit(allocates=False)
def steps_in_sample(dt, theta, plain, remembering, memory, s, c):
    """Return how many steps follow a friction that turns over sharply at v = 0."""
    h = 1e-6
    s[P1] = s[P2] = theta[P_CHARGE]
    ahead = force_at(0.0, FAR, h, theta, plain, remembering, memory, s, c)
    behind = force_at(0.0, FAR, -h, theta, plain, remembering, memory, s, c)
    rate = abs(ahead - behind) / (2.0 * h) / theta[M]
    fewest = FEWEST_REMEMBERING if len(remembering) > 0 else FEWEST
    if not rate * dt < 1e6:
        return MOST
    return min(max(math.ceil(2.0 * rate * dt), fewest), MOST)


@njit(allocates=False)
def mean_force(x, v, f0, f1, b, mass, dt, steps, theta, plain, remembering, memory, s, c):
    """Return the modelled force, N, averaged over a sample; its memory goes with the motion.

    Parameters
    ----------
    x, v : at the sample's start; f0, f1 : driving force at its two ends, N.
    b, mass, dt, steps : damping, kg, s, integration steps (Heun).
    plain, remembering : places of the effects without and with memory.
    memory : (N_EFFECTS + 1, MAX_MEMORY) updated.
    s, c : scratch; s[P1], s[P2] are set.
    """
    h = dt / steps
    path = memory[PATH, 0]
    total = 0.0
    for i in range(steps):
        u_0 = f0 + (f1 - f0) * i / steps
        u_1 = f0 + (f1 - f0) * (i + 1) / steps
        here = force_at(x, path, v, theta, plain, remembering, memory, s, c)
        a = (u_0 - b * v - here) / mass
        along = h * (v + 0.5 * h * a)
        ahead = force_at(x + along, path + along, v + h * a, theta, plain, remembering, memory,
                         s, c)
        a = 0.5 * (a + (u_1 - b * (v + h * a) - ahead) / mass)
        along = h * (v + 0.5 * h * a)
        v += h * a
        x += along
        path += along
        total += 0.5 * (here + ahead)
        if len(remembering) > 0:
            s[X], s[V] = path, v
            remember(s, theta, remembering, h, memory)
    memory[PATH, 0] = path
    return total / steps


@njit(allocates=False)
def modelled_force(x, v, var_x, var_v, f0, f1, b, mass, dt, steps, p1, p2, theta, plain,
                   remembering, memory, trial, slopes, s, c):
    """Return the mean force of a sample, its slopes to x and v, and its own variance.

    The slopes are central differences over the states' standard deviations.  The slope to x is
    that of the effects without memory: an error of x is also one of the place remembered.  While
    the velocity is no larger than its uncertainty, the share of a dry friction that acts is not
    known; what the slope does not cover of that counts as noise (N^2).  Without ``slopes`` all
    three are 0.
    """
    s[P1], s[P2] = p1, p2
    if not slopes:
        return mean_force(x, v, f0, f1, b, mass, dt, steps, theta, plain, remembering, memory, s,
                          c), 0.0, 0.0, 0.0
    h = max(math.sqrt(max(var_v, 0.0)), 1e-9)
    slope_x = slope_v = unknown = 0.0
    for side in (1.0, -1.0):
        for which in range(memory.shape[0]):
            copied(trial[which], memory[which])
        slope_v += side * mean_force(x, v + side * h, f0, f1, b, mass, dt, steps, theta, plain,
                                     remembering, trial, s, c)
    slope_v /= 2.0 * h
    if len(plain) > 0:
        h_x = max(math.sqrt(max(var_x, 0.0)), 1e-9)
        s[V] = v
        for side in (1.0, -1.0):
            s[X] = x + side * h_x
            contributions(s, theta, plain, memory, c)
            slope_x += side * c[FORCE]
        slope_x /= 2.0 * h_x
    if len(remembering) > 0:
        s[X] = memory[PATH, 0] + FAR
        for side in (1.0, -1.0):
            s[V] = v + 2.0 * side * h
            contributions(s, theta, remembering, memory, c)
            unknown += 0.5 * side * c[FORCE]
        unknown = STICKING * max(abs(unknown) - 2.0 * h * abs(slope_v), 0.0)
    force = mean_force(x, v, f0, f1, b, mass, dt, steps, theta, plain, remembering, memory, s, c)
    return force, slope_x, slope_v, unknown * unknown


@njit(allocates=False)
def pressures_at(force, mean, theta, s):
    """Set both pressures, Pa, from the force and the mean of the two."""
    s[P1] = (force + 2.0 * theta[AREA_2] * mean) / (theta[AREA_1] + theta[AREA_2])
    s[P2] = 2.0 * mean - s[P1]


@njit(allocates=False)
def flow_balance(x, v, omega, force, mean, compliance, k, theta, flows, memory, s, c):
    """Return the compliance that acts, its slope to the filter's, and the effects' flow.

    With each chamber's own volume and compliance F' = S (D_p omega/A1 - v) + ..., with
    S = sum A_i^2/(V_i (1/beta_e + C_i)).  The lumped step has S = beta_0 S2/(c + extra); the c
    that gives it the same S is returned, and the flow in N/Pa/s as that step takes it.

    Parameters
    ----------
    x, v, omega, force, mean : m, m/s, rad/s, N, and the mean pressure, Pa.
    compliance : c = beta_0/beta_e;  k : lumped hydraulics.
    """
    s[X], s[V], s[OMEGA] = x, v, omega
    pressures_at(force, mean, theta, s)
    contributions(s, theta, flows, memory, c)
    a_1, a_2 = theta[AREA_1], theta[AREA_2]
    soft_1 = (theta[VOL_1] + c[VOLUME_1]) * (compliance / k[BETA_0] + c[COMPLIANCE_1])
    soft_2 = (theta[VOL_2] + c[VOLUME_2]) * (compliance / k[BETA_0] + c[COMPLIANCE_2])
    stiff = a_1 * a_1 / soft_1 + a_2 * a_2 / soft_2
    lumped = k[BETA_0] * k[STIFF] / stiff
    slope = k[STIFF] / (stiff * stiff) * (
        a_1 * a_1 * (theta[VOL_1] + c[VOLUME_1]) / (soft_1 * soft_1)
        + a_2 * a_2 * (theta[VOL_2] + c[VOLUME_2]) / (soft_2 * soft_2))
    flow = (a_1 * c[FLOW_1] / soft_1 - a_2 * c[FLOW_2] / soft_2) * k[STIFF] / stiff
    return lumped - k[EXTRA_C], slope, flow + k[GAIN] * c[SPEED]
