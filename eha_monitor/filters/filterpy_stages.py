"""Both stages on ``filterpy.kalman.ExtendedKalmanFilter``: the readable reference.

``engine: filterpy`` in the config runs them in place of the compiled stages.  They take the same
arguments, call the same model functions and the same supervision, and leave the same state; a
test holds both to the same numbers.
"""

import math

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from eha_monitor.filters import kernel_two, steps_two
from eha_monitor.filters.kernel_one import GATE, NEGATIVE, SPIKES, jump_one, start_one
from eha_monitor.filters.known import modelled_force, steps_in_sample
from eha_monitor.filters.stage_one import (
    MEMORY,
    UNSEEN,
    predict_one,
    predict_one_euler,
    slopes_one,
)
from eha_monitor.filters.stage_two import BETA_0, C_PLACE, MASS, column, place
from eha_monitor.filters.supervision import (
    BLOCK,
    FROZEN,
    HELD,
    INFORMATION,
    SAMPLES,
    SCORE,
    SLOW,
    SPIKED,
    honest_factor,
    look,
)
from eha_monitor.physics.signals import N_CONTRIBUTIONS, N_SIGNALS

B_PLACE = 2  # of the damping among stage one's states (x, v, B)


def _filter(state: np.ndarray, covariance: np.ndarray, r: float) -> ExtendedKalmanFilter:
    """Return a filter that goes on from a state."""
    ekf = ExtendedKalmanFilter(dim_x=len(state), dim_z=1)
    ekf.x, ekf.P, ekf.R = state.copy(), covariance.copy(), np.array([[r]])
    return ekf


def _predict(ekf: ExtendedKalmanFilter, f: np.ndarray, state: np.ndarray, q: np.ndarray) -> None:
    ekf.F, ekf.Q = f, q
    ekf.predict_x = lambda u=0: setattr(ekf, "x", state)  # the model's own step, not F x
    ekf.predict()


def _innovation(ekf: ExtendedKalmanFilter, z: float) -> tuple[float, float]:
    """Return the innovation and its standard deviation, m."""
    return z - ekf.x[0], math.sqrt(ekf.P[0, 0] + ekf.R[0, 0])


def _correct(ekf: ExtendedKalmanFilter, z: float, at: int, w: np.ndarray) -> bool:
    """Update unless the measurement is a lone spike; tell whether it was taken.

    ``at`` is the parameter's place; its score goes into ``w``.
    """
    nu, sd = _innovation(ekf, z)
    s = sd * sd
    if nu * nu > GATE * s and w[SPIKED] < SPIKES:
        w[SPIKED] += 1
        return False
    w[SPIKED] = 0
    h = ekf.P[0, at] / ekf.P[at, at]
    w[SCORE] += h * nu / s
    w[INFORMATION] += h * h / s
    measured = np.eye(1, len(ekf.x))
    own = ekf.x[at], ekf.P[at, at]
    ekf.update(np.array([z]), lambda x: measured, lambda x: x[:1])
    if w[FROZEN] == HELD:  # considered, not estimated: no gain
        ekf.K[at] = 0.0
        ekf.x[at], ekf.P[at, at] = own
    return True


def _at_block_end(w: np.ndarray, value: float, variance: float, prior_variance: float
                  ) -> tuple[float, float, int] | None:
    """Count a sample; return (delta, information, samples) of a change that a block shows."""
    w[SAMPLES] += 1
    if w[SAMPLES] < BLOCK:
        return None
    w[SAMPLES] = 0
    change = look(w, value, variance, prior_variance)
    return change if change[1] > 0.0 else None


def _note(events: np.ndarray, found: int, event: tuple) -> int:
    if found < len(events):
        events[found] = event
    return found + 1


def _packed(p: np.ndarray) -> np.ndarray:
    return np.array([p[0, 0], p[0, 1], p[0, 2], p[1, 1], p[1, 2], p[2, 2]])


def _unpacked(p: np.ndarray) -> np.ndarray:
    return np.array([[p[0], p[1], p[2]], [p[1], p[3], p[4]], [p[2], p[4], p[5]]])


def run_one(x, start, end, q, p1, p2, dt, mass, r, prior_variance, euler, theta, plain,
            remembering, memory, m, p, w, first, out, events) -> int:
    """Run stage one; arguments and answer as those of :func:`kernel_one.run_one`."""
    ekf = _filter(m, _unpacked(p), r)
    effects = theta, plain, remembering
    scratch, trial, found = (np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS)), memory.copy(), 0
    steps = steps_in_sample(dt, *effects, memory, *scratch)
    lowest = -NEGATIVE * mass / dt

    def advance(u0, u1, q, p1, p2):
        x, v, b = ekf.x
        slope_x = slope_v = unknown = 0.0
        if len(plain) + len(remembering) > 0:
            force, slope_x, slope_v, unknown = modelled_force(
                x, v, ekf.P[0, 0], ekf.P[1, 1], u0, u1, b, mass, dt, steps, p1, p2, *effects,
                memory, trial, True, *scratch)
            u0, u1 = u0 - force, u1 - force
        if euler:
            x1, v1, fxv, fxb, fvv, fvb, *g = predict_one_euler(x, v, b, u0, dt, mass)
        else:
            x1, v1, fxv, fxb, fvv, fvb, *g = predict_one(x, v, b, u0, u1, dt, mass)
        w[SLOW] += MEMORY * (v - w[SLOW])
        if not euler:
            p_vv = ekf.P[1, 1] - ekf.P[1, 2] ** 2 / ekf.P[2, 2]
            fxb, fvb = slopes_one(v, w[SLOW], p_vv, b, fxb, fvb, dt, mass)
        f = np.array([[1.0, fxv, fxb], [0.0, fvv, fvb], [0.0, 0.0, 1.0]])
        g = np.array([*g, 0.0])
        f -= np.outer(g, [slope_x, slope_v, 0.0])  # the modelled force follows the states
        _predict(ekf, f, np.array([x1, v1, b]), (q + unknown) * np.outer(g, g))

    def with_packed(change, *arguments):
        packed = _packed(ekf.P)
        change(ekf.x, packed, *arguments)
        ekf.P = _unpacked(packed)

    for k in range(first, len(x)):
        lost = math.isnan(ekf.x[0])
        if not lost and k > 0:
            u0, u1 = start[k - 1], end[k]
            lost = math.isnan(u0 + u1)
            if not lost:
                i = k if len(p1) > 1 else 0
                advance(u0, u1, q[k], p1[i], p2[i])
        out[4:, k] = math.nan
        if not math.isnan(x[k]):
            if lost:
                with_packed(start_one, x[k], r, dt, True)
            else:
                out[4:, k] = _innovation(ekf, x[k])
                if _correct(ekf, x[k], B_PLACE, w):
                    ekf.x[B_PLACE] = max(ekf.x[B_PLACE], lowest)
        elif lost:
            ekf.x[0] = math.nan
        change = _at_block_end(w, ekf.x[B_PLACE], ekf.P[B_PLACE, B_PLACE], prior_variance)
        if change is not None:
            delta, information, window = change
            found = _note(events, found, (k, ekf.x[B_PLACE], ekf.x[B_PLACE] + delta, window))
            with_packed(jump_one, delta, information)
            ekf.x[B_PLACE] = max(ekf.x[B_PLACE], lowest)
        out[:3, k] = ekf.x
        out[3, k] = honest_factor(w) * math.sqrt(ekf.P[B_PLACE, B_PLACE])
    m[:], p[:] = ekf.x, _packed(ekf.P)
    return found


def run_two(x, start, end, q_u, instrument, b, b_variance, constants, leak, leak_flow, dt, r, q_f,
            prior_variance, mean, theta, plain, remembering, flows, memory, m, p, sens, w,
            matrices, at, first, out, events) -> int:
    """Run stage two; arguments and answer as those of :func:`kernel_two.run_two`."""
    ekf = _filter(m, p, r)
    effects = theta, plain, remembering, flows
    work, s, c = kernel_two.new_work(constants)
    trial, found = memory.copy(), 0
    at[kernel_two.STEPS] = steps_in_sample(dt, *effects[:3], memory, s, c)
    rows = range(len(m) - 1)
    places, columns = [place(i) for i in rows], [column(i) for i in rows]

    def advance(u0, u1, i0, i1, q_u, b, leak_flow, mean) -> bool:
        new, covariance, new_sens = ekf.x.copy(), ekf.P.copy(), sens.copy()
        if not kernel_two.advance_two(
                new, covariance, new_sens, u0, u1, i0, i1, b, constants, leak, leak_flow, dt, q_f,
                q_u, mean, *effects, memory, trial, True, matrices, at, work, s, c):
            return False
        step, slope = matrices[5:].reshape(2, -1, len(rows)).transpose(0, 2, 1)
        force, flow, noise_force = (at[which] for which in (
            kernel_two.CONSTANT_FORCE, kernel_two.CONSTANT_FLOW, kernel_two.NOISE_FORCE))
        f, g_u, g_f = np.eye(len(new)), np.zeros(len(new)), np.zeros(len(new))
        f[np.ix_(places, places)] = step[:, columns]
        f[places, C_PLACE] = (slope[:, columns] @ ekf.x[places]
                              + slope[:, 3:7] @ (i0, i1, force, flow))
        bend = slope[2, columns]
        lean = bend @ ekf.P[places, C_PLACE]
        noise = (bend @ ekf.P[np.ix_(places, places)] @ bend
                 - lean**2 / ekf.P[C_PLACE, C_PLACE] + q_u * (slope[2, 3] + slope[2, 4]) ** 2)
        if f[2, C_PLACE] ** 2 < UNSEEN * noise:
            f[places, C_PLACE] = 0.0
        g_u[places], g_f[places] = step[:, 3] + step[:, 4], step[:, 5]
        sens[:] = new_sens
        _predict(ekf, f, new, q_u * np.outer(g_u, g_u) + noise_force * np.outer(g_f, g_f))
        return True

    for k in range(first, len(x)):
        lost = math.isnan(ekf.x[0])
        if not lost and k > 0:
            u0, u1, i0, i1 = start[k - 1], end[k], instrument[k - 1, 0], instrument[k, 1]
            lost = math.isnan(u0 + u1 + i0 + i1 + b[k] + leak_flow[k]) or not advance(
                u0, u1, i0, i1, q_u[k], b[k], leak_flow[k], mean[k if len(mean) > 1 else 0])
        if lost:
            at[kernel_two.TOLD_FORCE] = 0.0
        out[6:, k] = math.nan
        if not math.isnan(x[k]):
            if lost:
                steps_two.restart_two(ekf.x, ekf.P, sens, x[k], r, dt, constants)
            else:
                out[6:, k] = _innovation(ekf, x[k])
                if _correct(ekf, x[k], C_PLACE, w):
                    sens -= ekf.K[:, 0] * sens[0]
                    ekf.x[C_PLACE] = max(ekf.x[C_PLACE], steps_two.STIFFEST)
        elif lost:
            ekf.x[0] = math.nan
        change = _at_block_end(w, ekf.x[C_PLACE], ekf.P[C_PLACE, C_PLACE], prior_variance)
        if change is not None:
            delta, information, window = change
            before = constants[BETA_0] / ekf.x[C_PLACE]
            steps_two.jump_two(ekf.x, ekf.P, delta, information)
            found = _note(events, found, (k, before, constants[BETA_0] / ekf.x[C_PLACE], window))
        compliance, factor = max(ekf.x[C_PLACE], 1e-9), honest_factor(w)
        beta = constants[BETA_0] / compliance
        own = factor**2 * ekf.P[C_PLACE, C_PLACE]
        out[:2, k] = ekf.x[:2]
        out[2, k] = (ekf.x[2] - b[k] * ekf.x[1] - at[kernel_two.TOLD_FORCE]) / constants[MASS]
        out[3, k] = beta
        out[4, k] = beta / compliance * math.sqrt(own)
        out[5, k] = beta / compliance * math.sqrt(own + sens[C_PLACE] ** 2 * b_variance[k])
    m[:], p[:] = ekf.x, ekf.P
    return found
