"""A two-chamber cylinder with pump, make-up and friction, written from textbooks.

None of the equations of eha_monitor is used here, so that nothing is proved by inverting itself.

State: x (m), v (m/s), p1, p2 (absolute Pa), f (Dahl's friction force, N, or the deflection of
LuGre's bristles, m), w (shaft speed, rad/s), p_a (pressure of the reservoir, Pa), theta (how far
the oil has warmed up, 0 to 1), x_e (where the encoder stands, m).

    M v' = A1 p1 - A2 p2 - B (1 - d theta) v - F_f(v, f) - F_0
    p1' (V1 + A1 x)/beta = -A1 v + D1 w - L (p1 - p2) - E1 (p1 - p_t) + q_1
    p2' (V2 - A2 x)/beta = +A2 v - D2 w + L (p1 - p2) - E2 (p2 - p_t) + q_2
    q_i = G (p_a - p_i) + K_c max(0, p_a - p_crack - p_i)          make-up, line and check valve
    p_a' = -n p_a/V_g * drawn,  V_g = V_0 (p_0/p_a)^(1/n)          gas; V_0 = 0 holds p_a
    w' = (w_wanted - w)/tau                                        tau = 0: w is what is wanted
    theta' = (1 - theta)/tau_h                                     d = 0: B stays
    |x - x_e| <= b/2                                               x_e is carried along at its ends

The drive is P about x_d with a feedforward of x_d'; it runs either at every instant on the
encoder's position or, digital, every ``period`` on what the encoder shows, and holds the speed.

Dry friction F_f with F_c at speed, F_s at breakaway, Stribeck speed v_s, smoothing speed v_e:

    STRIBECK    (F_c + (F_s - F_c) exp(-(v/v_s)^2)) tanh(v/v_e)
    RATIONAL    (F_c + (F_s - F_c)/(1 + (v/v_s)^2)) v/sqrt(v^2 + v_e^2)     Hess, Soom 1990
    TANH        (F_s - F_c)(tanh(v/v_e) - tanh(v/v_s)) + F_c tanh(v/v_e)    Makkar et al. 2005
    GAUSSIAN    (F_c + (F_s - F_c) exp(-(v/v_s)^2)) (2/pi) atan(v/v_e)
    KARNOPP     |v| < v_e: stands, F_f is what is needed, at most F_s;      Karnopp 1985
                else (F_c + (F_s - F_c) exp(-|v|/v_s)) sign v
    DAHL        f' = sigma (1 - f sign(v)/F_c) v                            Dahl 1968
    LUGRE       f' = v - sigma |v| f/g,  F_f = sigma f + sigma_1 f',        Canudas de Wit 1995
                g = F_c + (F_s - F_c) exp(-(v/v_s)^2), with a stiffness
                sigma = F_c/z (1 + k/(1 + |v|/v_s)) that falls with speed
"""

from math import atan, exp, floor, pi, sqrt, tanh
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit

X, V, P1, P2, F, W, PA, WARM, XE = range(9)
N_STATE = 9
NO_FRICTION, STRIBECK, DAHL, RATIONAL, TANH, GAUSSIAN, KARNOPP, LUGRE = range(8)
MICRO_DAMPING = 0.3  # sigma_1 of LuGre, of sqrt(sigma_0 M)


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
    case_leakage_2: float = -1.0  # E of chamber 2 where another
    damping_drop: float = 0.0  # d, share of B that is gone when the oil is warm
    warming: float = 10.0  # tau_h, s
    play: float = 0.0  # b, m, between rod and encoder, end to end
    stiffening: float = 0.0  # k of LuGre


@njit
def friction_force(v, f, push, c):
    """Return the dry friction, N, and f'; ``push`` is the sum of the other forces, N."""
    if c.friction == STRIBECK:
        level = c.dry + (c.breakaway - c.dry) * exp(-(v / c.stribeck_speed) ** 2)
        return level * tanh(v / c.smooth_speed), 0.0
    if c.friction == RATIONAL:
        level = c.dry + (c.breakaway - c.dry) / (1.0 + (v / c.stribeck_speed) ** 2)
        return level * v / sqrt(v * v + c.smooth_speed ** 2), 0.0
    if c.friction == TANH:
        sign = tanh(v / c.smooth_speed)
        return (c.breakaway - c.dry) * (sign - tanh(v / c.stribeck_speed)) + c.dry * sign, 0.0
    if c.friction == GAUSSIAN:
        level = c.dry + (c.breakaway - c.dry) * exp(-(v / c.stribeck_speed) ** 2)
        return level * atan(v / c.smooth_speed) * 2.0 / pi, 0.0
    sign = 1.0 if v > 0.0 else (-1.0 if v < 0.0 else 0.0)
    if c.friction == KARNOPP:
        if abs(v) < c.smooth_speed:
            return min(max(push, -c.breakaway), c.breakaway), 0.0
        drop = exp(-abs(v) / c.stribeck_speed)
        return sign * (c.dry + (c.breakaway - c.dry) * drop), 0.0
    if c.friction == DAHL:
        return f, c.dry / c.dahl_travel * (1.0 - sign * f / c.dry) * v
    if c.friction == LUGRE:
        sigma = c.dry / c.dahl_travel * (1.0 + c.stiffening / (1.0 + abs(v) / c.stribeck_speed))
        level = c.dry + (c.breakaway - c.dry) * exp(-(v / c.stribeck_speed) ** 2)
        bent = v - sigma * abs(v) * f / level
        micro = MICRO_DAMPING * sqrt(sigma * c.mass) * exp(-(v / c.stribeck_speed) ** 2)
        return sigma * f + micro * bent, bent
    return 0.0, 0.0


@njit
def moving(v, c):
    """Return the speed at which the piston moves, m/s: none within Karnopp's band."""
    return 0.0 if c.friction == KARNOPP and abs(v) < c.smooth_speed else v


@njit
def rates(y, wanted, c, out):
    """Write y' into ``out`` (N_STATE,) for a wanted shaft speed, rad/s."""
    w = y[W] if c.lag > 0.0 else wanted
    v = moving(y[V], c)
    push = (c.area_1 * y[P1] - c.area_2 * y[P2]
            - c.damping * (1.0 - c.damping_drop * y[WARM]) * v - c.load)
    dry, out[F] = friction_force(y[V], y[F], push, c)
    second = c.makeup if c.makeup_2 < 0.0 else c.makeup_2
    case_2 = c.case_leakage if c.case_leakage_2 < 0.0 else c.case_leakage_2
    q_1 = (c.makeup * (y[PA] - y[P1])
           + c.check_valve * max(0.0, y[PA] - c.cracking - y[P1]))
    q_2 = (second * (y[PA] - y[P2])
           + c.check_valve * max(0.0, y[PA] - c.cracking - y[P2]))
    across = c.cross_leakage * (y[P1] - y[P2])
    into_1 = (-c.area_1 * v + c.displacement_1 * w - across
              - c.case_leakage * (y[P1] - c.tank) + q_1)
    into_2 = (c.area_2 * v - c.displacement_2 * w + across
              - case_2 * (y[P2] - c.tank) + q_2)
    out[X] = v
    out[V] = (push - dry) / c.mass
    out[P1] = into_1 * c.bulk_modulus / (c.volume_1 + c.area_1 * y[X])
    out[P2] = into_2 * c.bulk_modulus / (c.volume_2 - c.area_2 * y[X])
    out[W] = (wanted - y[W]) / c.lag if c.lag > 0.0 else 0.0
    out[WARM] = (1.0 - y[WARM]) / c.warming
    out[XE] = 0.0  # carried along after each step
    out[PA] = 0.0
    if c.gas_volume > 0.0:
        drawn = (c.displacement_1 - c.displacement_2) * w + q_1 + q_2
        gas = c.gas_volume * (c.reservoir / y[PA]) ** (1.0 / c.polytropic)
        out[PA] = -c.polytropic * y[PA] / gas * drawn


@njit
def shown_place(y, c):
    """Return where the encoder stands, m."""
    return y[XE] if c.play > 0.0 else y[X]


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
    k1, k2, k3, k4 = np.empty(N_STATE), np.empty(N_STATE), np.empty(N_STATE), np.empty(N_STATE)
    held, tick = wanted_speed(demand[0], demand_rate[0], shown_place(y, c), c), 0
    for i in range(steps + 1):
        if period > 0:
            if i >= phase and (i - phase) % period == 0:
                read = shown_place(y, c) + noise[tick % len(noise)]
                if encoder > 0.0:
                    read = encoder * floor(read / encoder + 0.5)
                held = wanted_speed(demand[2 * i], demand_rate[2 * i], read, c)
                tick += 1
            begin = held
        else:
            begin = wanted_speed(demand[2 * i], demand_rate[2 * i], shown_place(y, c), c)
        out[i] = y
        if c.lag <= 0.0:
            out[i, W] = begin
        if i == steps:
            return
        u_1 = begin
        rates(y, u_1, c, k1)
        z = y + 0.5 * h * k1
        m, n = 2 * i + 1, 2 * i + 2
        u_2 = held if period > 0 else wanted_speed(
            demand[m], demand_rate[m], shown_place(z, c), c)
        rates(z, u_2, c, k2)
        z = y + 0.5 * h * k2
        u_3 = held if period > 0 else wanted_speed(
            demand[m], demand_rate[m], shown_place(z, c), c)
        rates(z, u_3, c, k3)
        z = y + h * k3
        u_4 = held if period > 0 else wanted_speed(
            demand[n], demand_rate[n], shown_place(z, c), c)
        rates(z, u_4, c, k4)
        for j in range(N_STATE):
            y[j] += h / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j])
        y[XE] = min(max(y[XE], y[X] - 0.5 * c.play), y[X] + 0.5 * c.play)


def rest(c: Constants, x_d: float) -> np.ndarray:
    """Return the state (N_STATE,) that stands still with the drive on at ``x_d``, m."""
    from scipy.optimize import root

    # Dry friction holds any state near this one.
    c, y, out = c._replace(friction=float(NO_FRICTION)), np.zeros(N_STATE), np.empty(N_STATE)
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
    y[X] = y[XE] = x_d - y[W] / c.gain
    return y
