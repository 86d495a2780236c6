"""The two stages on ``filterpy.kalman.ExtendedKalmanFilter``: the filters that run live.

They call the same compiled model functions and the same supervision as the kernels that run
over recordings; a test holds both to the same numbers.
"""

import math

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from eha_monitor.filters import kernel_one, kernel_two, steps_two
from eha_monitor.filters.inputs import RigModel
from eha_monitor.filters.known import modelled_force, new_known_memory, steps_in_sample
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
    BLOCKS,
    CHANGES,
    FROZEN,
    HELD,
    INFORMATION,
    NET,
    SCORE,
    SLOW,
    TRAVEL,
    gave_up,
    honest_factor,
    look,
    new_supervision,
)
from eha_monitor.physics.signals import N_CONTRIBUTIONS, N_SIGNALS


def _first(state: np.ndarray) -> np.ndarray:
    return state[:1]


class _Stage:
    """What both stages share: gating, scoring, closing a block.

    Attributes
    ----------
    ekf : the filterpy filter; ``ekf.x`` is (n,), ``ekf.P`` (n, n).
    place : of the parameter among the states.
    innovation, innovation_stddev : of the last sample, m; NaN where nothing was measured.
    changes : detected changes as (value before, value after) since the last look.
    """

    def __init__(self, size: int, place: int, r: float, prior_variance: float):
        self.ekf = ExtendedKalmanFilter(dim_x=size, dim_z=1)
        self.ekf.x = np.zeros(size)
        self.ekf.P = np.zeros((size, size))
        self.ekf.R = np.array([[r]])
        self._h = np.eye(1, size)
        self.place = place
        self.prior_variance = prior_variance
        self.watch = new_supervision()
        self.samples = 0
        self.spikes = 0
        self.lost = True
        self.innovation = math.nan
        self.innovation_stddev = math.nan

    def _set_effects(self, model: RigModel, memory: np.ndarray) -> None:
        self.model, self.memory, self._trial = model, memory.copy(), memory.copy()
        self._effects = model.theta, model.plain, model.remembering
        self._any_force = len(model.plain) + len(model.remembering) > 0

    def _predict(self, f: np.ndarray, state: np.ndarray, q: np.ndarray) -> None:
        ekf = self.ekf
        ekf.F, ekf.Q = f, q
        ekf.predict_x = lambda u=0: setattr(ekf, "x", state)  # the model's own step, not F x
        ekf.predict()

    def _correct(self, z: float) -> bool:
        """Update unless the measurement is a lone spike; tell whether it was taken."""
        ekf = self.ekf
        s = ekf.P[0, 0] + ekf.R[0, 0]
        nu = z - ekf.x[0]
        self.innovation, self.innovation_stddev = nu, math.sqrt(s)
        if nu * nu > kernel_one.GATE * s and self.spikes < kernel_one.SPIKES:
            self.spikes += 1
            return False
        self.spikes = 0
        h = ekf.P[0, self.place] / ekf.P[self.place, self.place]
        self.watch[SCORE] += h * nu / s
        self.watch[INFORMATION] += h * h / s
        at = self.place
        own = (ekf.x[at], ekf.P[at, at]) if self.held else None
        ekf.update(np.array([z]), lambda x: self._h, _first)
        if own is not None:  # considered, not estimated: no gain
            ekf.K[at] = 0.0
            ekf.x[at], ekf.P[at, at] = own
        return True

    def _close_block(self) -> tuple[float, float, int] | None:
        """At the end of a block look for a change; return (delta, information, samples) of one."""
        self.samples += 1
        if self.samples % BLOCK:
            return None
        at = self.place
        delta, information, window = look(self.watch, self.ekf.x[at], self.ekf.P[at, at],
                                          self.prior_variance)
        return (delta, information, window) if information > 0 else None

    def forget_scores(self) -> None:
        """Look for changes only in what comes from now on."""
        self.watch[SCORE] = self.watch[INFORMATION] = self.watch[BLOCKS] = 0.0

    def forget(self, changes: float, memory: float) -> None:
        """Let old changes count less, and what a parameter that is held rests on.

        What is hours ago is no hopping to and fro; and an average over hours would hide wear.

        Parameters
        ----------
        changes, memory : shares that are kept.
        """
        if self.watch[FROZEN] == 0.0:
            self.watch[[CHANGES, NET, TRAVEL]] *= changes
        elif not self.held:
            now = self.ekf.P[self.place, self.place]
            self.ekf.P[self.place, self.place] = min(now / memory, max(now, self.prior_variance))

    @property
    def held(self) -> bool:
        """Whether the parameter stays at its prior, because nothing has told it yet."""
        return self.watch[FROZEN] == HELD

    @property
    def factor(self) -> float:
        """Factor on sigma that the scores ask for."""
        return honest_factor(self.watch)


class FilterpyStageOne(_Stage):
    """Stage one, sample by sample.

    Parameters
    ----------
    model : the rig and its modelled effects.
    mass, dt : kg, s.
    r : variance of the position, m^2.
    prior, prior_stddev : of B, N·s/m.
    euler : run Eq. 4 as printed.
    """

    def __init__(self, model: RigModel, mass: float, dt: float, r: float, prior: float,
                 prior_stddev: float, euler: bool = False):
        super().__init__(3, 2, r, prior_stddev**2)
        self.mass, self.dt, self.euler = mass, dt, euler
        self._lowest = -kernel_one.NEGATIVE * mass / dt
        self._set_effects(model, new_known_memory())
        self._scratch = np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS)
        self._substeps = steps_in_sample(dt, *self._effects, self.memory, *self._scratch)
        self.ekf.x[2] = self._prior = prior
        self.ekf.P[2, 2] = prior_stddev**2

    def use(self, model: RigModel, mass: float) -> None:
        """Go on with another model of the same effects, by which the force is read otherwise."""
        self.model, self.mass = model, mass

    def step(self, x: float, u0: float, u1: float, q: float, p1: float, p2: float
             ) -> tuple[float, float, int] | None:
        """Take one sample: position, force at the step's two ends and its variance, pressures.

        NaN where missing.  Returns (B before, B after, samples that showed it) of a change.
        """
        ekf = self.ekf
        self.innovation = self.innovation_stddev = math.nan
        if not self.lost:
            if math.isnan(u0 + u1):
                self.lost = True
            else:
                self._advance(u0, u1, q, p1, p2)
        if not math.isnan(x):
            if self.lost:
                packed = np.array([*ekf.P[0], ekf.P[1, 1], ekf.P[1, 2], ekf.P[2, 2]])
                kernel_one.start_one(ekf.x, packed, x, ekf.R[0, 0], self.dt, True)
                ekf.P = _unpack(packed)
                self.lost = False
            else:
                self._correct(x)
                ekf.x[2] = max(ekf.x[2], self._lowest)
        change = self._close_block()
        if change is None:
            return None
        before = float(ekf.x[2])
        packed = np.array([*ekf.P[0], ekf.P[1, 1], ekf.P[1, 2], ekf.P[2, 2]])
        kernel_one.jump_one(ekf.x, packed, *change[:2])
        ekf.x[2] = max(ekf.x[2], self._lowest)
        ekf.P = _unpack(packed)
        if gave_up(self.watch):
            self._begin_again()
        return before, float(ekf.x[2]), change[2]

    def _begin_again(self) -> None:
        """Estimate B anew from the prior as a constant: its changes were the model's misfit."""
        self.ekf.x[2] = self._prior
        self.ekf.P[2, :] = self.ekf.P[:, 2] = 0.0
        self.ekf.P[2, 2] = self.prior_variance
        self.watch = new_supervision(frozen=True)

    def carry_on(self, value: float, stddev: float) -> None:
        """Go on from a B that the last seconds gave, and look for changes again."""
        self.ekf.x[2] = value
        self.ekf.P[2, :] = self.ekf.P[:, 2] = 0.0
        self.ekf.P[2, 2] = stddev**2
        self.watch = new_supervision()

    def _advance(self, u0, u1, q, p1, p2):
        x, v, b = self.ekf.x
        p = self.ekf.P
        slope_x = slope_v = unknown = 0.0
        if self._any_force:
            force, slope_x, slope_v, unknown = modelled_force(
                x, v, p[0, 0], p[1, 1], u0, u1, b, self.mass, self.dt, self._substeps, p1, p2,
                *self._effects, self.memory, self._trial, True, *self._scratch)
            u0 -= force
            u1 -= force
        if self.euler:
            x1, v1, fxv, fxb, fvv, fvb, *g = predict_one_euler(x, v, b, u0, self.dt, self.mass)
        else:
            x1, v1, fxv, fxb, fvv, fvb, *g = predict_one(x, v, b, u0, u1, self.dt, self.mass)
        self.watch[SLOW] += MEMORY * (v - self.watch[SLOW])
        if not self.euler:
            fxb, fvb = slopes_one(v, self.watch[SLOW], p[1, 1] - p[1, 2] ** 2 / p[2, 2], b,
                                  fxb, fvb, self.dt, self.mass)
        f = np.array([[1.0, fxv, fxb], [0.0, fvv, fvb], [0.0, 0.0, 1.0]])
        g = np.array([*g, 0.0])
        f -= np.outer(g, [slope_x, slope_v, 0.0])  # the modelled force follows the states
        self._predict(f, np.array([x1, v1, b]), (q + unknown) * np.outer(g, g))

    @property
    def value(self) -> float:
        """B, N·s/m."""
        return float(self.ekf.x[2])

    @property
    def stddev(self) -> float:
        """Its standard deviation, N·s/m."""
        return self.factor * math.sqrt(self.ekf.P[2, 2])


def _unpack(p: np.ndarray) -> np.ndarray:
    return np.array([[p[0], p[1], p[2]], [p[1], p[3], p[4]], [p[2], p[4], p[5]]])


class FilterpyStageTwo(_Stage):
    """Stage two, sample by sample, from a state that :func:`kernel_two.run_two` left.

    Parameters
    ----------
    model : the rig and its modelled effects.
    dt, r, q_f : s, m^2, N^2.
    prior_variance : of c = beta_0/beta_e.
    m, p, sens, watch, memory : state (n,), covariance (n, n), sensitivity (n,), supervision,
        what the effects remember.
    """

    def __init__(self, model: RigModel, dt: float, r: float, q_f: float, prior_variance: float,
                 m: np.ndarray, p: np.ndarray, sens: np.ndarray, watch: np.ndarray,
                 memory: np.ndarray):
        super().__init__(len(m), C_PLACE, r, prior_variance)
        self.dt, self.q_f = dt, q_f
        self.ekf.x, self.ekf.P = m.copy(), p.copy()
        self.sens, self.watch = sens.copy(), watch.copy()
        self.lost = bool(np.isnan(m[0]))
        self._set_effects(model, memory)
        self._matrices, self._found, *self._work, s, c = kernel_two.new_work(model.hydraulics)
        self._scratch = s, c
        self._found[kernel_two.STEPS] = steps_in_sample(dt, *self._effects, self.memory,
                                                        *self._scratch)
        self._damping = math.nan
        self._b_variance = 0.0

    def step(self, x: float, u0: float, u1: float, i0: float, i1: float, q_u: float, b: float,
             b_variance: float, leak_flow: float, mean: float
             ) -> tuple[float, float, int] | None:
        """Take one sample; arguments as the kernel's.  Returns (before, after, samples), Pa."""
        ekf = self.ekf
        self.innovation = self.innovation_stddev = math.nan
        self._damping, self._b_variance = b, b_variance
        if not self.lost:
            if math.isnan(u0 + u1 + i0 + i1 + b + leak_flow):
                self.lost = True
            else:
                self._advance(u0, u1, i0, i1, q_u, b, leak_flow, mean)
        if self.lost:
            self._found[kernel_two.TOLD_FORCE] = 0.0
        if not math.isnan(x):
            if self.lost:
                steps_two.restart_two(ekf.x, ekf.P, self.sens, x, ekf.R[0, 0], self.dt,
                                      self.model.hydraulics)
                self.lost = False
            elif self._correct(x):
                self.sens = self.sens - ekf.K[:, 0] * self.sens[0]
                ekf.x[3] = max(ekf.x[3], steps_two.STIFFEST)
        change = self._close_block()
        if change is None:
            return None
        before = self.value
        steps_two.jump_two(ekf.x, ekf.P, *change[:2])
        return before, self.value, change[2]

    def _advance(self, u0, u1, i0, i1, q_u, b, leak_flow, mean):
        ekf, model = self.ekf, self.model
        new, covariance, sens = ekf.x.copy(), ekf.P.copy(), self.sens.copy()
        if not kernel_two.advance_two(
                new, covariance, sens, u0, u1, i0, i1, b, model.hydraulics, model.leak, leak_flow,
                self.dt, self.q_f, q_u, mean, *self._effects, model.flows, self.memory,
                self._trial, True, self._matrices, self._found, *self._work, *self._scratch):
            self.lost = True
            return
        step, slope = self._matrices[5], self._matrices[6]
        force, flow, q_f = (self._found[place] for place in (
            kernel_two.CONSTANT_FORCE, kernel_two.CONSTANT_FLOW, kernel_two.NOISE_FORCE))
        rows = range(len(step))
        at, own = [place(i) for i in rows], [column(i) for i in rows]
        f, g_u, g_f = np.eye(len(new)), np.zeros(len(new)), np.zeros(len(new))
        f[np.ix_(at, at)] = step[:, own]
        f[at, C_PLACE] = slope[:, own] @ ekf.x[at] + slope[:, 3:7] @ (i0, i1, force, flow)
        bend = slope[2, own]
        lean = bend @ ekf.P[at, C_PLACE]
        noise = (bend @ ekf.P[np.ix_(at, at)] @ bend - lean**2 / ekf.P[C_PLACE, C_PLACE]
                 + q_u * (slope[2, 3] + slope[2, 4]) ** 2)
        if f[2, C_PLACE] ** 2 < UNSEEN * noise:
            f[at, C_PLACE] = 0.0
        g_u[at], g_f[at] = step[:, 3] + step[:, 4], step[:, 5]
        self.sens = sens
        self._predict(f, new, q_u * np.outer(g_u, g_u) + q_f * np.outer(g_f, g_f))

    @property
    def value(self) -> float:
        """Effective bulk modulus, Pa."""
        return float(self.model.hydraulics[BETA_0] / max(self.ekf.x[3], 1e-9))

    @property
    def stddev(self) -> float:
        """Its standard deviation with the uncertainty of B, Pa."""
        per_c = self.value / max(self.ekf.x[3], 1e-9)
        return float(per_c) * math.sqrt(self.factor**2 * self.ekf.P[3, 3]
                                 + self.sens[3] ** 2 * self._b_variance)

    @property
    def sensitivity(self) -> float:
        """Relative change of the effective bulk modulus with B, per N·s/m."""
        return float(-self.sens[3] / max(self.ekf.x[3], 1e-9))

    @property
    def acceleration(self) -> float:
        """m/s^2 from the force balance."""
        x = self.ekf.x
        return float((x[2] - self._damping * x[1] - self._found[kernel_two.TOLD_FORCE])
                     / self.model.hydraulics[MASS])
