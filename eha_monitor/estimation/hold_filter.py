"""How well a recording fits a drive input: a steady Kalman filter with an unknown force and flow.

Its states are those of stage two, x, v and the hydraulic force F, an unknown force and an unknown
flow (Ornstein-Uhlenbeck, 20 ms).  Friction, leakage or a dead zone that the model lacks go into
the unknowns, which are as large as the recording asks for; what no unknown of that length makes up
for is when within a sample the pump turned.  The bulk modulus is fitted anew for each input.  With
innovations e of position and force, log L = -(n/2) log det(1/n sum e e').
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from eha_monitor import ties
from eha_monitor.compiled import njit
from eha_monitor.estimation.discretisation import discretise_at
from eha_monitor.estimation.small_matrices import (
    add,
    solved,
    symmetric,
    times,
    times_transposed,
    transposed,
)

LASTS = 0.02  # s that an unknown force or flow lasts
SETTLES = 0.2  # s until the filter has found the state
STATES = 5
DOUBLINGS = 30
AFTER = 5  # samples that do not count after one whose input is not known
# Axis -> smallest, largest, and the ratio of the first step.
AXES = {"compliance": (0.03, 30.0, 1.3), "damping": (0.0, np.inf, 1.3),
        "force": (1e-6, 3.0, 10.0), "flow": (1e-6, 3.0, 10.0)}
FINER, FINER_BY = 3, 0.3  # how often the steps are made finer, in logarithm by this
GRID = tuple(1.7 ** np.arange(-4, 5))
LEANING = ((1e-3, 1e-5), (3e-2, 3e-3))  # unknowns as shares of what the stretch covers


class Stretch(NamedTuple):
    """The samples that are examined, and what they are compared with.

    Attributes
    ----------
    z : (n, m) position in m, and force in N where it is measured; NaN where missing.
    noise : (m,) standard deviations of ``z``.
    known : (n,) force against the motion that the recording tells by itself, N.
    unsure : (n,) bool, samples before which the input's course is not known (a corner, a jump):
        the force is then taken from the sensors, and a few innovations do not count.
    constants, leak : lumped hydraulics of :func:`discretisation.hydraulics`, the loop open.
    dt : s.
    input_noise : of the speed on each sample, rad/s.
    damping : (value, standard deviation) of B, N s/m; the deviation infinite where the
        recording tells it.
    force, speed : what the stretch covers, N and rad/s (rms).
    """

    z: np.ndarray
    noise: np.ndarray
    known: np.ndarray
    unsure: np.ndarray
    constants: np.ndarray
    leak: float
    dt: float
    input_noise: float
    damping: tuple[float, float]
    force: float
    speed: float


class Steady(NamedTuple):
    """The steady filter.

    Attributes
    ----------
    F : (5, 5) step of (x, v, F, unknown force, unknown flow).
    g_0, g_1, g_f : (5,) of the input at the sample's two ends and of a force.
    K : (5, m) gain.
    """

    F: np.ndarray
    g_0: np.ndarray
    g_1: np.ndarray
    g_f: np.ndarray
    K: np.ndarray


@njit
def steady_covariance(a, h, q, r):
    """Return the steady covariance before a measurement, (5, 5), by doubling.

    P = A P A' - A P H' (H P H' + R)^-1 H P A' + Q; each step carries twice as many samples as the
    one before (Anderson 1978).
    """
    x, g, step = q.copy(), np.zeros((STATES, STATES)), transposed(a)
    for j in range(h.shape[0]):
        for i in range(STATES):
            for k in range(STATES):
                g[i, k] += h[j, i] * h[j, k] / r[j]
    for _ in range(DOUBLINGS):
        gx = times(g, x)
        for i in range(STATES):
            gx[i, i] += 1.0
        kept = solved(gx.copy(), step.copy())
        more = times(times(transposed(step), x), kept)
        add(g, times(step, solved(gx, times_transposed(g, step))))
        add(x, symmetric(more))
        g = symmetric(g)
        step = times(step, kept)
        change = 0.0
        for i in range(STATES):
            if abs(more[i, i]) > 1e-4 * abs(x[i, i]):
                change = 1.0
        if change == 0.0:
            break
    return x


@njit
def squares(stretch, start, end, steady, y, first, total):
    """Filter the samples with a steady gain; add up the products of their innovations.

    Parameters
    ----------
    stretch, steady : :class:`Stretch`, :class:`Steady`.
    start, end : (n,) line of the pump's speed in each sample, rad/s.
    y : (5,) state at the start, overwritten.
    first : sample from which the innovations count.
    total : (m, m) written.

    Returns
    -------
    int
        Samples that count; -1 where the filter ran away.
    """
    z, known, unsure = stretch.z, stretch.known, stretch.unsure
    F, g_0, g_1, g_f, K = steady
    n, m = z.shape
    new, e = np.empty(STATES), np.empty(m)
    count = 0
    counts_from = first
    total[:] = 0.0
    for k in range(n):
        if unsure[k]:
            counts_from = max(counts_from, k + AFTER)
        whole = k >= counts_from
        for j in range(m):
            e[j] = z[k, j] - y[0 if j == 0 else 2]
            if math.isnan(e[j]):
                whole = False
        for j in range(m):
            if not math.isnan(e[j]):
                for i in range(STATES):
                    y[i] += K[i, j] * e[j]
        if unsure[k] and m > 1 and not math.isnan(z[k, 1]):
            y[2] = z[k, 1]
        if whole:
            count += 1
            for i in range(m):
                for j in range(m):
                    total[i, j] += e[i] * e[j]
        if k + 1 == n:
            break
        for i in range(STATES):
            move = (g_0[i] * start[k] + g_1[i] * end[k + 1]
                    + 0.5 * g_f[i] * (known[k] + known[k + 1]))
            for j in range(STATES):
                move += F[i, j] * y[j]
            new[i] = move
        for i in range(STATES):
            y[i] = new[i]
        if not abs(y[0]) < 1e6:
            return -1
    return count


@njit
def log_likelihood(stretch, start, end, damping, compliance, force, flow):
    """Return the log likelihood of a stretch under an input and fixed parameters.

    Parameters
    ----------
    start, end : (n,) line of the pump's speed in each sample, rad/s.
    damping, compliance : N s/m, and beta_0/beta_e.
    force, flow : deviations of the unknown force, N, and of the unknown flow as a speed, rad/s.
    """
    z, noise, dt, constants = stretch.z, stretch.noise, stretch.dt, stretch.constants
    input_noise = stretch.input_noise
    step = np.empty((3, 7))
    discretise_at(constants, damping, compliance, stretch.leak, dt, np.empty((10, 3, 3)), step)
    kept = math.exp(-dt / LASTS)
    a, q = np.zeros((STATES, STATES)), np.zeros((STATES, STATES))
    g_0, g_1, g_f = np.zeros(STATES), np.zeros(STATES), np.zeros(STATES)
    for i in range(3):
        g_0[i], g_1[i], g_f[i] = step[i, 3], step[i, 4], step[i, 5]
        for j in range(3):
            a[i, j] = step[i, j]
        a[i, 3] = step[i, 5]
        a[i, 4] = step[i, 3] + step[i, 4]  # an unknown flow is an unknown speed
    a[3, 3] = a[4, 4] = kept
    for i in range(3):
        for j in range(3):
            q[i, j] = input_noise * input_noise * a[i, 4] * a[j, 4]
    q[3, 3] = force * force * (1.0 - kept * kept)
    q[4, 4] = flow * flow * (1.0 - kept * kept)
    m = z.shape[1]
    # In units in which the sensors' noise and a sample are about one.
    unit = np.array([noise[0], noise[0] / dt, constants[0] * noise[0] / dt**2, 1.0, 1.0])
    unit[3] = unit[4] = 1.0
    if m > 1:
        unit[2] = noise[1]
    if force > 0.0:
        unit[3] = force
    if flow > 0.0:
        unit[4] = flow
    h, gain = np.zeros((m, STATES)), np.zeros((STATES, m))
    h[0, 0] = unit[0] / noise[0]
    if m > 1:
        h[1, 2] = unit[2] / noise[1]
    scaled, scaled_q = np.empty((STATES, STATES)), np.empty((STATES, STATES))
    for i in range(STATES):
        for j in range(STATES):
            scaled[i, j] = a[i, j] * unit[j] / unit[i]
            scaled_q[i, j] = q[i, j] / (unit[i] * unit[j])
    p = steady_covariance(scaled, h, scaled_q, np.ones(m))
    ph = times_transposed(p, h)
    s = times(h, ph)
    for j in range(m):
        s[j, j] += 1.0
    whole = solved(s, transposed(ph))
    for i in range(STATES):
        for j in range(m):
            gain[i, j] = whole[j, i] * unit[i] / noise[j]
    y = np.zeros(STATES)
    for j in range(m):
        if not math.isnan(z[0, j]):
            y[0 if j == 0 else 2] = z[0, j]
    total = np.empty((m, m))
    count = squares(stretch, start, end, Steady(a, g_0, g_1, g_f, gain), y, round(SETTLES / dt),
                    total)
    if count < 1:
        return -np.inf
    for j in range(m):
        for i in range(m):
            total[j, i] /= count
    spread = total[0, 0] if m == 1 else total[0, 0] * total[1, 1] - total[0, 1] ** 2
    if not spread > 0.0:
        return -np.inf
    return -0.5 * count * math.log(spread)


@dataclass(frozen=True)
class Point:
    """Where the likelihood is asked: B and the compliance over the prior's, and both unknowns.

    The unknowns are shares of what the stretch covers.
    """

    damping: float
    compliance: float = 1.0
    force: float = 1e-3
    flow: float = 1e-3


def likelihood_at(stretch: Stretch, lines: tuple[np.ndarray, np.ndarray], at: Point) -> float:
    """Return the log likelihood of a stretch under an input, with B's own prior.

    Parameters that no filter can follow have a likelihood of zero.
    """
    b, spread = stretch.damping
    try:
        reached = log_likelihood(stretch, *lines, at.damping, at.compliance,
                                 at.force * stretch.force, at.flow * stretch.speed)
    except np.linalg.LinAlgError:
        return -np.inf
    return reached - 0.5 * ((at.damping - b) / spread) ** 2


def climbed(stretch: Stretch, lines: tuple[np.ndarray, np.ndarray], at: Point
            ) -> tuple[float, Point]:
    """Return the greatest log likelihood near a point and where, along one axis at a time."""
    best = likelihood_at(stretch, lines, at)
    for fineness in range(FINER):
        moved = True
        while moved:
            moved = False
            for name, (low, high, width) in AXES.items():
                ratio = width ** (FINER_BY**fineness)
                if ratio < 1.5 and name in ("force", "flow"):
                    continue
                for factor in (ratio, 1.0 / ratio):
                    stepped = False
                    while True:
                        value = getattr(at, name) * factor
                        if name != "damping" and not low <= value <= high:
                            break
                        other = replace(at, **{name: value})
                        reached = likelihood_at(stretch, lines, other)
                        if reached <= best + 0.1:
                            break
                        best, at, stepped = reached, other, True
                    if stepped:
                        moved = True
                        break
    return best, at


def fitted(stretches: list[Stretch], lines: tuple[np.ndarray, np.ndarray]
           ) -> tuple[float, Stretch, Point]:
    """Return the greatest log likelihood under an input, and where it is.

    A filter that leans on the model and one that yields start on a grid of the compliance: what is
    missing can stand between the one and the other.

    ``stretches`` : the same samples with different forces that the recording tells.
    """
    starts = [(stretch, Point(stretch.damping[0], c, force, flow)) for stretch in stretches
              for force, flow in LEANING for c in GRID]
    stretch, at = ties.best(
        starts, lambda one: likelihood_at(one[0], lines, one[1]), within=ties.GUESS)
    best, at = climbed(stretch, lines, at)
    return best, stretch, at
