"""A two-chamber cylinder with pump, make-up and friction, written from textbooks.

Nothing of eha_monitor is used here, so that nothing is proved by inverting itself.

State: x (m), v (m/s), p1, p2 (absolute Pa), f (Dahl's friction force, N), w (shaft speed, rad/s),
p_a (pressure of the reservoir, Pa).

    M v' = A1 p1 - A2 p2 - B v - F_f(v, f) - F_0
    p1' (V1 + A1 x)/beta = -A1 v + D1 w - L (p1 - p2) - E (p1 - p_t) + q_1
    p2' (V2 - A2 x)/beta = +A2 v - D2 w + L (p1 - p2) - E (p2 - p_t) + q_2
    q_i = G (p_a - p_i) + K_c max(0, p_a - p_crack - p_i)          make-up, line and check valve
    p_a' = -n p_a/V_g * drawn,  V_g = V_0 (p_0/p_a)^(1/n)          gas; V_0 = 0 holds p_a
    w' = (w_wanted - w)/tau                                        tau = 0: w is what is wanted

The drive is P about x_d with a feedforward of x_d'; it runs either at every instant on the true
position or, digital, every ``period`` on what the encoder shows, and holds the speed.
"""

from math import exp, floor, tanh
from typing import NamedTuple

import numpy as np
from numba import njit

X, V, P1, P2, F, W, PA = range(7)
N_STATE = 7
NO_FRICTION, STRIBECK, DAHL = 0, 1, 2


class Constants(NamedTuple):
    """Constants of one plant, SI; every one a float, so that it compiles once."""

    area_1: float  # m^2
    area_2: float
    volume_1: float  # m^3 at x = 0
    volume_2: float
    mass: float  # kg
    damping: float  # B, N s/m
    bulk_modulus: float  # Pa
    displacement_1: float  # m^3/rad into chamber 1
    displacement_2: float  # m^3/rad out of chamber 2
    gain: float  # rad/(s m)
    cross_leakage: float = 0.0  # L, m^3/(s Pa)
    case_leakage: float = 0.0  # E, m^3/(s Pa), each chamber to the tank
    makeup: float = 0.0  # G, m^3/(s Pa)
    makeup_2: float = -1.0  # G of chamber 2 where another
    check_valve: float = 0.0  # K_c, m^3/(s Pa)
    cracking: float = 2e4  # Pa
    reservoir: float = 1e6  # p_0, absolute Pa
    gas_volume: float = 0.0  # V_0, m^3; 0: a source that holds its pressure, or an open tank
    friction: float = 0.0  # law
    dry: float = 0.0  # F_c, N
    breakaway: float = 0.0  # F_s, N
    stribeck_speed: float = 5e-3  # m/s
    smooth_speed: float = 1e-3  # m/s, of the tanh
    dahl_travel: float = 1e-5  # m, F_c over the rest stiffness
    load: float = 0.0  # F_0, N, against positive motion
    lag: float = 0.0  # tau, s
    feedforward: float = 0.0  # rad/m: shaft angle over demanded travel
    speed_limit: float = 1e6  # rad/s
    tank: float = 101325.0  # p_t, Pa
    polytropic: float = 1.25  # n


@njit
def friction_force(v, f, c):
    """Return the dry friction, N, and Dahl's f' , N/s."""
    if c.friction == STRIBECK:
        level = c.dry + (c.breakaway - c.dry) * exp(-(v / c.stribeck_speed) ** 2)
        return level * tanh(v / c.smooth_speed), 0.0
    if c.friction == DAHL:
        sign = 1.0 if v > 0.0 else (-1.0 if v < 0.0 else 0.0)
        return f, c.dry / c.dahl_travel * (1.0 - sign * f / c.dry) * v
    return 0.0, 0.0


@njit
def rates(y, wanted, c, out):
    """Write y' into ``out`` (N_STATE,) for a wanted shaft speed, rad/s."""
    w = y[W] if c.lag > 0.0 else wanted
    dry, out[F] = friction_force(y[V], y[F], c)
    second = c.makeup if c.makeup_2 < 0.0 else c.makeup_2
    q_1 = (c.makeup * (y[PA] - y[P1])
           + c.check_valve * max(0.0, y[PA] - c.cracking - y[P1]))
    q_2 = (second * (y[PA] - y[P2])
           + c.check_valve * max(0.0, y[PA] - c.cracking - y[P2]))
    across = c.cross_leakage * (y[P1] - y[P2])
    into_1 = (-c.area_1 * y[V] + c.displacement_1 * w - across
              - c.case_leakage * (y[P1] - c.tank) + q_1)
    into_2 = (c.area_2 * y[V] - c.displacement_2 * w + across
              - c.case_leakage * (y[P2] - c.tank) + q_2)
    out[X] = y[V]
    out[V] = (c.area_1 * y[P1] - c.area_2 * y[P2] - c.damping * y[V] - dry - c.load) / c.mass
    out[P1] = into_1 * c.bulk_modulus / (c.volume_1 + c.area_1 * y[X])
    out[P2] = into_2 * c.bulk_modulus / (c.volume_2 - c.area_2 * y[X])
    out[W] = (wanted - y[W]) / c.lag if c.lag > 0.0 else 0.0
    out[PA] = 0.0
    if c.gas_volume > 0.0:
        drawn = (c.displacement_1 - c.displacement_2) * w + q_1 + q_2
        gas = c.gas_volume * (c.reservoir / y[PA]) ** (1.0 / c.polytropic)
        out[PA] = -c.polytropic * y[PA] / gas * drawn


@njit
def wanted_speed(x_d, rate, x, c):
    """Return what the controller asks of the pump, rad/s."""
    w = c.gain * (x_d - x) + c.feedforward * rate
    return min(max(w, -c.speed_limit), c.speed_limit)


@njit
def run(y, c, demand, demand_rate, h, steps, period, phase, encoder, noise, out):
    """Integrate by the classical Runge-Kutta rule; ``y`` is carried along in place.

    Parameters
    ----------
    demand, demand_rate : (2*steps + 1,) x_d (m) and x_d' (m/s) at every half step.
    h : step, s.
    period, phase : steps between two computations of a digital drive (0: at every instant) and
        the step of the first.
    encoder, noise : what the digital drive reads: its step (m; 0 none), and (m,) noise in m for
        each computation.
    out : (steps + 1, N_STATE) the trajectory; its column W is the speed of the shaft.
    """
    k1, k2, k3, k4 = np.empty(7), np.empty(7), np.empty(7), np.empty(7)
    held, tick = wanted_speed(demand[0], demand_rate[0], y[X], c), 0
    for i in range(steps + 1):
        if period > 0:
            if i >= phase and (i - phase) % period == 0:
                seen = y[X] + noise[tick % len(noise)]
                if encoder > 0.0:
                    seen = encoder * floor(seen / encoder + 0.5)
                held = wanted_speed(demand[2 * i], demand_rate[2 * i], seen, c)
                tick += 1
            begin = held
        else:
            begin = wanted_speed(demand[2 * i], demand_rate[2 * i], y[X], c)
        out[i] = y
        if c.lag <= 0.0:
            out[i, W] = begin
        if i == steps:
            return
        u_1 = begin
        rates(y, u_1, c, k1)
        z = y + 0.5 * h * k1
        m, n = 2 * i + 1, 2 * i + 2
        u_2 = held if period > 0 else wanted_speed(demand[m], demand_rate[m], z[X], c)
        rates(z, u_2, c, k2)
        z = y + 0.5 * h * k2
        u_3 = held if period > 0 else wanted_speed(demand[m], demand_rate[m], z[X], c)
        rates(z, u_3, c, k3)
        z = y + h * k3
        u_4 = held if period > 0 else wanted_speed(demand[n], demand_rate[n], z[X], c)
        rates(z, u_4, c, k4)
        for j in range(7):
            y[j] += h / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j])


def rest(c: Constants, x_d: float) -> np.ndarray:
    """Return the state (N_STATE,) that stands still with the drive on at ``x_d``, m."""
    from scipy.optimize import root

    y, out = np.zeros(N_STATE), np.empty(N_STATE)
    y[PA] = c.reservoir
    # The reservoir's own rate is left out: it is where it is.
    scale = np.array([c.reservoir, c.reservoir, 1.0])

    def missing(u):
        y[P1], y[P2], y[W] = u * scale
        y[X] = x_d - y[W] / c.gain
        rates(y, y[W], c, out)
        return [out[V], out[P1] / c.bulk_modulus, out[P2] / c.bulk_modulus]

    level = (c.load / c.reservoir + c.area_2) / c.area_1
    found = root(missing, np.array([level, 1.0, 0.0]), method="hybr", tol=1e-13)
    y[P1], y[P2], y[W] = found.x * scale
    y[X] = x_d - y[W] / c.gain
    return y
