"""Stages to compare with: both on ``filterpy``, and stage two as the paper prints it.

``engine: filterpy`` in the config runs ``filterpy.kalman.ExtendedKalmanFilter`` in place of the
compiled stages.  Both take the same arguments, call the same model functions and the same
supervision, and leave the same state; a test holds them to the same numbers.

``discretisation: euler`` runs Eq. 5 in forward Euler, states (x, v, a, beta_e).  At 1 ms this step
is unstable (largest pole modulus 1.094 at 6e8 Pa), so the estimate settles too low; it is here to
show what that costs, not to be used.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation import modelled as modelled
from eha_monitor.estimation import stage_one as one
from eha_monitor.estimation import stage_two as two
from eha_monitor.estimation import supervision as watch
from eha_monitor.estimation.discretisation import BETA_0, C_PLACE, MASS, column, place
from eha_monitor.estimation.inputs import StageInputs
from eha_monitor.estimation.small_matrices import symmetric, times, times_transposed
from eha_monitor.physics import signals as s
from eha_monitor.physics.signals import P1, P2
from eha_monitor.settings.monitor import Settings

if TYPE_CHECKING:
    from filterpy.kalman import ExtendedKalmanFilter

B_PLACE = 2  # of the damping among stage one's states (x, v, B)


def _filter(state: np.ndarray, covariance: np.ndarray, r: float) -> "ExtendedKalmanFilter":
    """Return a filter that goes on from a state."""
    from filterpy.kalman import ExtendedKalmanFilter  # what is printed runs without it

    ekf = ExtendedKalmanFilter(dim_x=len(state), dim_z=1)
    ekf.x, ekf.P, ekf.R = state.copy(), covariance.copy(), np.array([[r]])
    return ekf


def _predict(ekf: "ExtendedKalmanFilter", f: np.ndarray, state: np.ndarray, q: np.ndarray) -> None:
    ekf.F, ekf.Q = f, q
    ekf.predict_x = lambda u=0: setattr(ekf, "x", state)  # the model's own step, not F x
    ekf.predict()


def _innovation(ekf: "ExtendedKalmanFilter", z: float) -> tuple[float, float]:
    """Return the innovation and its standard deviation, m."""
    return z - ekf.x[0], math.sqrt(ekf.P[0, 0] + ekf.R[0, 0])


def _correct(ekf: "ExtendedKalmanFilter", z: float, at: int, w: np.ndarray) -> bool:
    """Update unless the measurement is a lone spike; tell whether it was taken.

    ``at`` is the parameter's place; its score goes into ``w``.
    """
    nu, sd = _innovation(ekf, z)
    s = sd * sd
    if nu * nu > one.GATE * s and w[watch.SPIKED] < one.SPIKES:
        w[watch.SPIKED] += 1
        return False
    w[watch.SPIKED] = 0
    h = ekf.P[0, at] / ekf.P[at, at]
    w[watch.SCORE] += h * nu / s
    w[watch.INFORMATION] += h * h / s
    measured = np.eye(1, len(ekf.x))
    own = ekf.x[at], ekf.P[at, at]
    ekf.update(np.array([z]), lambda x: measured, lambda x: x[:1])
    if w[watch.FROZEN] == watch.HELD:  # considered, not estimated: no gain
        ekf.K[at] = 0.0
        ekf.x[at], ekf.P[at, at] = own
    return True


def _at_block_end(w: np.ndarray, value: float, variance: float, prior_variance: float
                  ) -> tuple[float, float, int] | None:
    """Count a sample; return (delta, information, samples) of a change that a block shows."""
    w[watch.SAMPLES] += 1
    if w[watch.SAMPLES] < watch.BLOCK:
        return None
    w[watch.SAMPLES] = 0
    change = watch.look(w, value, variance, prior_variance)
    return change if change[1] > 0.0 else None


def _note(events: np.ndarray, found: int, event: tuple) -> int:
    if found < len(events):
        events[found] = event
    return found + 1


def _packed(p: np.ndarray) -> np.ndarray:
    return np.array([p[0, 0], p[0, 1], p[0, 2], p[1, 1], p[1, 2], p[2, 2]])


def _unpacked(p: np.ndarray) -> np.ndarray:
    return np.array([[p[0], p[1], p[2]], [p[1], p[3], p[4]], [p[2], p[4], p[5]]])


def run_one(rows: one.RowsOne, constants: one.ConstantsOne, effects: modelled.Effects,
            state: one.StateOne, first: int, out: np.ndarray, events: np.ndarray) -> int:
    """Run stage one; arguments and answer as those of :func:`stage_one.run_one`."""
    dt, mass, R, prior_variance, euler = constants
    w, memory, z = state.watch, state.memory, rows.z
    ekf = _filter(state.x, _unpacked(state.P), R)
    work, found = modelled.new_work(memory), 0
    steps = modelled.steps_in_sample(dt, effects, memory, work)
    lowest = -one.NEGATIVE * mass / dt

    def advance(u0, u1, q, p1, p2):
        x, v, b = ekf.x
        slope_x = slope_v = unknown = 0.0
        if len(effects.plain) + len(effects.remembering) > 0:
            work.s[P1], work.s[P2] = p1, p2
            force, slope_x, slope_v, unknown = modelled.modelled_force(
                modelled.Motion(x, v, ekf.P[0, 0], ekf.P[1, 1]),
                modelled.Push(u0, u1, b, mass, dt, steps), effects, memory, True, work)
            u0, u1 = u0 - force, u1 - force
        if euler:
            x1, v1, fxv, fxb, fvv, fvb, *g = one.predict_one_euler(x, v, b, u0, dt, mass)
        else:
            x1, v1, fxv, fxb, fvv, fvb, *g = one.predict_one(x, v, b, u0, u1, dt, mass)
        w[watch.SLOW] += one.MEMORY * (v - w[watch.SLOW])
        if not euler:
            P_vv = ekf.P[1, 1] - ekf.P[1, 2] ** 2 / ekf.P[2, 2]
            fxb, fvb = one.slopes_one(v, w[watch.SLOW], P_vv, b, fxb, fvb, dt, mass)
        F = np.array([[1.0, fxv, fxb], [0.0, fvv, fvb], [0.0, 0.0, 1.0]])
        g = np.array([*g, 0.0])
        F -= np.outer(g, [slope_x, slope_v, 0.0])  # the modelled force follows the states
        _predict(ekf, F, np.array([x1, v1, b]), (q + unknown) * np.outer(g, g))

    def with_packed(change, *arguments):
        packed = _packed(ekf.P)
        change(ekf.x, packed, *arguments)
        ekf.P = _unpacked(packed)

    for k in range(first, len(z)):
        lost = math.isnan(ekf.x[0])
        if not lost and k > 0:
            u0, u1 = rows.u_start[k - 1], rows.u_end[k]
            lost = math.isnan(u0 + u1)
            if not lost:
                i = k if len(rows.p1) > 1 else 0
                advance(u0, u1, rows.Q[k], rows.p1[i], rows.p2[i])
        out[4:, k] = math.nan
        if not math.isnan(z[k]):
            if lost:
                with_packed(one.start_one, z[k], R, dt)
            else:
                out[4:, k] = _innovation(ekf, z[k])
                if _correct(ekf, z[k], B_PLACE, w):
                    ekf.x[B_PLACE] = max(ekf.x[B_PLACE], lowest)
        elif lost:
            ekf.x[0] = math.nan
        change = _at_block_end(w, ekf.x[B_PLACE], ekf.P[B_PLACE, B_PLACE], prior_variance)
        if change is not None:
            delta, information, window = change
            found = _note(events, found, (k, ekf.x[B_PLACE], ekf.x[B_PLACE] + delta, window))
            with_packed(one.jump_one, delta, information)
            ekf.x[B_PLACE] = max(ekf.x[B_PLACE], lowest)
        out[:3, k] = ekf.x
        out[3, k] = watch.honest_factor(w) * math.sqrt(ekf.P[B_PLACE, B_PLACE])
    state.x[:], state.P[:] = ekf.x, _packed(ekf.P)
    return found


def run_two(rows: two.RowsTwo, constants: two.ConstantsTwo, effects: modelled.Effects,
            state: two.StateTwo, first: int, out: np.ndarray, events: np.ndarray) -> int:
    """Run stage two; arguments and answer as those of :func:`stage_two.run_two`."""
    z, b, w, sens, matrices, at = (rows.z, rows.b, state.watch, state.sens, state.matrices,
                                   state.at)
    ekf = _filter(state.x, state.P, constants.R)
    work, steps_work, found = modelled.new_work(state.memory), two.new_steps_work(constants.k), 0
    walk = two.position_walk(constants.k, constants.dt)
    at[two.STEPS] = modelled.steps_in_sample(constants.dt, effects, state.memory, work)
    beside_c = range(len(state.x) - 1)
    places, columns = [place(i) for i in beside_c], [column(i) for i in beside_c]

    def advance(sample: two.SampleTwo) -> bool:
        new = state._replace(x=ekf.x.copy(), P=ekf.P.copy(), sens=sens.copy())
        if not two.advance_two(new, sample, constants, effects, True, work, steps_work):
            return False
        step, slope = matrices[5:].reshape(2, -1, len(beside_c)).transpose(0, 2, 1)
        force, flow, noise_force = (at[which] for which in (
            two.CONSTANT_FORCE, two.CONSTANT_FLOW, two.NOISE_FORCE))
        F, g_u, g_f = np.eye(len(new.x)), np.zeros(len(new.x)), np.zeros(len(new.x))
        F[np.ix_(places, places)] = step[:, columns]
        F[places, C_PLACE] = (slope[:, columns] @ ekf.x[places]
                              + slope[:, 3:7] @ (sample.u0, sample.u1, force, flow))
        bend = slope[2, columns]
        lean = bend @ ekf.P[places, C_PLACE]
        noise = (bend @ ekf.P[np.ix_(places, places)] @ bend - lean**2 / ekf.P[C_PLACE, C_PLACE]
                 + sample.Q_u * (slope[2, 3] + slope[2, 4]) ** 2)
        if F[2, C_PLACE] ** 2 < one.UNSEEN * noise:
            F[places, C_PLACE] = 0.0
        g_u[places], g_f[places] = step[:, 3] + step[:, 4], step[:, 5]
        sens[:] = new.sens
        Q = sample.Q_u * np.outer(g_u, g_u) + noise_force * np.outer(g_f, g_f)
        Q[0, 0] += sample.Q_x
        _predict(ekf, F, new.x, Q)
        return True

    for k in range(first, len(z)):
        lost = math.isnan(ekf.x[0])
        if not lost and k > 0:
            sample = two.SampleTwo(rows.u_start[k - 1], rows.u_end[k], rows.Q_u[k],
                                   walk * rows.slow[k], b[k], rows.leak_flow[k],
                                   rows.mean[k if len(rows.mean) > 1 else 0])
            known = sample.u0 + sample.u1 + b[k] + rows.leak_flow[k]
            lost = math.isnan(known) or not advance(sample)
        if lost:
            at[two.MODELLED_FORCE] = 0.0
        out[6:, k] = math.nan
        if not math.isnan(z[k]):
            if lost:
                two.restart_two(state._replace(x=ekf.x, P=ekf.P), z[k], constants)
            else:
                out[6:, k] = _innovation(ekf, z[k])
                if _correct(ekf, z[k], C_PLACE, w):
                    sens -= ekf.K[:, 0] * sens[0]
                    ekf.x[C_PLACE] = max(ekf.x[C_PLACE], two.STIFFEST)
        elif lost:
            ekf.x[0] = math.nan
        change = _at_block_end(w, ekf.x[C_PLACE], ekf.P[C_PLACE, C_PLACE],
                               constants.prior_variance)
        if change is not None:
            delta, information, window = change
            before = constants.k[BETA_0] / ekf.x[C_PLACE]
            two.jump_two(ekf.x, ekf.P, delta, information)
            found = _note(events, found, (k, before, constants.k[BETA_0] / ekf.x[C_PLACE], window))
        compliance, factor = max(ekf.x[C_PLACE], 1e-9), watch.honest_factor(w)
        beta = constants.k[BETA_0] / compliance
        own = factor**2 * ekf.P[C_PLACE, C_PLACE]
        out[:2, k] = ekf.x[:2]
        out[2, k] = (ekf.x[2] - b[k] * ekf.x[1] - at[two.MODELLED_FORCE]) / constants.k[MASS]
        out[3, k] = beta
        out[4, k] = beta / compliance * math.sqrt(own)
        out[5, k] = beta / compliance * math.sqrt(own + sens[C_PLACE] ** 2 * rows.b_variance[k])
    state.x[:], state.P[:] = ekf.x, ekf.P
    return found


ACCELERATION_NOISE = 1.0  # m/s^2 a sample, where the config gives none: Eq. 5 needs some


class Printed(NamedTuple):
    """Constants of Eq. 5 for equal areas and volumes (chamber 1's).

    ``stiff`` = 2 A^2/V, ``gain`` = 2 D_p A K_pos/V, ``leak`` = C_T/V.
    """

    dt: float
    mass: float
    stiff: float
    gain: float
    leak: float

    @classmethod
    def of(cls, theta: np.ndarray, mass: float, dt: float) -> "Printed":
        """Return the constants of a rig."""
        area, volume = theta[s.AREA_1], theta[s.VOL_1]
        return cls(dt, mass, 2 * area**2 / volume,
                   2 * theta[s.D_P] * area * theta[s.K_POS] / volume, theta[s.C_T] / volume)


@njit
def printed_step(m, b, u, printed, F):
    """Carry (x4, x5, x6, x7) over one sample as Eq. 5 does and write its Jacobian ``F`` (4, 4).

    u = x_d.
    """
    dt, mass, stiff, gain, leak = printed
    x, v, a, beta = m[0], m[1], m[2], m[3]
    push = gain / mass * (u - x) - stiff / mass * v - leak * a
    m[0] = x + dt * v
    m[1] = v + dt * a
    m[2] = a + dt * (beta * push - b / mass * a)
    F[:] = 0.0
    F[0, 0], F[0, 1] = 1.0, dt
    F[1, 1], F[1, 2] = 1.0, dt
    F[2, 0] = -dt * beta * gain / mass
    F[2, 1] = -dt * beta * stiff / mass
    F[2, 2] = 1.0 - dt * (b / mass + beta * leak)
    F[2, 3] = dt * push
    F[3, 3] = 1.0


@njit
def _run(rows, printed, R, q, m, P, out):
    z, u, b = rows
    F = np.empty((4, 4))
    K = np.empty(4)
    for i in range(z.shape[0]):
        if i > 0 and not math.isnan(u[i - 1]):
            printed_step(m, b[i], u[i - 1], printed, F)
            P = times_transposed(times(F, P), F)
            P[2, 2] += q * printed.dt * printed.dt
        nu, sd = math.nan, math.nan
        if not math.isnan(z[i]):
            S = P[0, 0] + R
            nu, sd = z[i] - m[0], math.sqrt(S)
            for j in range(4):
                K[j] = P[j, 0] / S
                m[j] += K[j] * nu
            for j in range(3, -1, -1):  # the first row, by which all are changed, last
                for other in range(3, -1, -1):
                    P[j, other] -= K[j] * P[0, other]
            P = symmetric(P)
        out[0, i], out[1, i], out[2, i], out[3, i] = m[0], m[1], m[2], m[3]
        out[4, i] = out[5, i] = math.sqrt(max(P[3, 3], 0.0))
        out[6, i], out[7, i] = nu, sd


def run_printed(inputs: StageInputs, settings: Settings, damping: np.ndarray) -> np.ndarray:
    """Return the (8, n) output of stage two as printed, in the form of stage_two.run_two."""
    q = settings.stage_two.acceleration_noise or ACCELERATION_NOISE
    first = np.flatnonzero(np.isfinite(inputs.x))
    m = np.array([inputs.x[first[0]] if len(first) else 0.0, 0.0, 0.0, settings.stage_two.prior])
    P = np.diag([inputs.position_variance, 1e-2, 1e2, settings.stage_two.prior_stddev**2])
    out = np.empty((8, len(inputs.x)))
    printed = Printed.of(inputs.model.theta, settings.rig.mass, inputs.dt)
    _run((inputs.x, inputs.drive.start, damping), printed, inputs.position_variance,
         (q / inputs.dt) ** 2 * inputs.dt**2, m, P, out)
    return out
