"""Exact sensitivities: the innovations' tangents to many parameters in one pass.

A lane is a model beside the one at hand: one parameter moved a little, or an effect that enters.
Its difference in the rates and in what the sensors show, taken along the trajectory of the model
at hand, drives the linearised filter (:mod:`eha_monitor.mismatch.tangent_pass`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eha_monitor.mismatch import tangent_pass as pass_
from eha_monitor.mismatch.experiment import Experiment, Stretch
from eha_monitor.mismatch.fit import Fit, filtered, spread, step_of
from eha_monitor.mismatch.gains import decay_of
from eha_monitor.mismatch.innovations import CLOSED, N_FILTERED
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import (
    N_EFFECTS,
    circuit_of,
    with_place,
    with_term,
    with_update,
)
from eha_monitor.physics.effects import NAMES
from eha_monitor.physics.plant import N_OUTPUTS, SHORTEST_LAG

LANES = 32  # that one pass carries
POINTS = 64  # of a stretch, at which the constant Jacobian is looked for
# Their memory is a motion of its own (a line that rings) or a place that is not the piston's.
BEYOND = ("line_dynamics", "backlash")


@dataclass(frozen=True)
class Lane:
    """A model beside the one at hand; the tangent is its difference over ``step``."""

    theta: np.ndarray
    active: np.ndarray
    step: float


def lane_of(fit: Fit, name: str) -> Lane:
    """Return the lane of a fitted parameter, in its fitted coordinate."""
    f = next(f for f in fit.free if f.name == name)
    theta, step = step_of(f, fit.theta)
    return Lane(theta, fit.active, step)


def can(experiment: Experiment, fit: Fit, lane: Lane) -> bool:
    """Tell whether a lane can be carried along; else take its difference by another run."""
    changed = differing(fit, lane)
    active = {NAMES[i] for i in np.flatnonzero(fit.active)}
    own = {NAMES[i] for i in changed if i >= 0}
    return (not experiment.inverse and not (active | own) & set(BEYOND) and len(changed) == 1)


def differing(fit: Fit, lane: Lane) -> list[int]:
    """Return the effects in which a lane's model differs; -1 stands for the base parameters."""
    moved = np.flatnonzero(lane.theta != fit.theta)
    found = {-1 if place < s.N_BASE else int((place - s.N_BASE) // s.MAX_PARAMETERS)
             for place in moved}
    found |= set(np.flatnonzero(lane.active != fit.active).tolist())
    # What stands in theta of an effect that acts in neither is nothing.
    return sorted(i for i in found if i < 0 or lane.active[i] or fit.active[i])


def tangents(experiment: Experiment, fit: Fit, wanted: Sequence[str]) -> dict[str, list]:
    """Return name -> (n, c) tangents for each stretch, in the fitted coordinate, all samples."""
    carried = along(experiment, fit, [lane_of(fit, name) for name in wanted])
    return {name: [part[:, :, i] for part in carried] for i, name in enumerate(wanted)}


def along(experiment: Experiment, fit: Fit, lanes: Sequence[Lane]) -> list[np.ndarray]:
    """Return the tangents of all lanes, (n, c, len(lanes)) of the used channels per stretch.

    NaN where nothing was measured; infinite where the model's own run goes astray.
    """
    tasks = []
    for stretch in experiment.stretches:
        track = Track(experiment, fit, stretch)
        tasks += [(track, lanes[i : i + LANES]) for i in range(0, len(lanes), LANES)]
    made = spread(lambda task: task[0].carry(task[1]), tasks)
    per = -(-len(lanes) // LANES)
    return [np.concatenate(made[i * per : (i + 1) * per], axis=2) if per > 1 else made[i]
            for i in range(len(experiment.stretches))]


class Track:
    """The trajectory of a model along a stretch, and its linearisation there."""

    def __init__(self, experiment: Experiment, fit: Fit, stretch: Stretch):
        theta, active = fit.theta, fit.active
        self.experiment, self.fit, self.stretch = experiment, fit, stretch
        self.e, self.states = filtered(experiment, stretch, theta, active, fit.gains, states=True)
        self.astray = not np.nanmax(np.abs(self.e), initial=0.0) < 1e29
        if self.astray:
            return
        dt, mode = experiment.dt, experiment.mode
        self.role = np.zeros(len(stretch)) if stretch.loose is None else stretch.loose
        self.w = circuit_of(theta, active)
        self.slow = bool(mode == CLOSED and pass_.lags(self.w))
        self.shortest = SHORTEST_LAG * dt / experiment.steps
        self.lag = max(self.w[s.DRIVE_LAG], self.shortest)
        self.terms, updates = with_term(active), with_update(active)
        n = len(stretch)
        self.ends, self.shifts = np.empty((n, N_FILTERED)), np.zeros(n)
        pass_.predicted_states(self.states, self.e, fit.gains, self.role, dt, theta, self.ends,
                               self.shifts)
        self.slopes, self.slopes_end = np.empty((2, n, pass_.N_MOVED))
        self.memories = np.zeros((n if len(updates) else 1, 3, N_EFFECTS, s.MAX_MEMORY))
        self.motion = (mode, self.slow, self.states, self.ends)
        pass_.slopes_along(*self.motion, stretch.u, stretch.p1, stretch.p2, dt, theta, self.w,
                           self.lag, self.terms, with_place(active), updates, self.slopes,
                           self.slopes_end, self.memories)
        self.motion += (self.slopes, self.slopes_end)
        self.linearise()

    def linearise(self) -> None:
        """Take the rates' Jacobians: the median, and each sample's where it changes."""
        fit, stretch, dt = self.fit, self.stretch, self.experiment.dt
        n = len(stretch)
        size = np.abs(self.states).max(axis=0) + 1e-12
        size[5:] = np.maximum(size[5:], 1e-6 * np.array([
            np.abs(stretch.p1).max() * (fit.theta[s.AREA_1] or 1.0), 1.0, size[4]]))
        size[6] = max(size[6], 1e-12)
        given = (*self.motion, self.memories, stretch.u, stretch.p1, stretch.p2, dt, fit.theta,
                 self.w, self.lag, self.terms, size)
        varying = len(self.terms) > 0 or np.isfinite(self.w[[s.SPEED_LIMIT, s.SLEW_LIMIT]]).any()
        self.jacs = np.empty((n if varying else 0, pass_.N_RATES, N_FILTERED))
        if varying:
            pass_.jacobians(*given, 1, self.jacs)
            self.constant = np.median(self.jacs[:: max(n // (8 * POINTS), 1)], axis=0)
        else:
            one = np.empty((1, pass_.N_RATES, N_FILTERED))
            pass_.jacobians(*given, n // 2, one)
            self.constant = one[0]
        steps = self.experiment.steps
        self.phi, self.gamma = maps_of(self.constant, dt, dt, steps)
        self.half, self.half_gamma = maps_of(self.constant, dt, 0.5 * dt, -(-steps // 2))
        self.shaft = np.zeros((n, N_FILTERED))
        if self.experiment.used[4]:
            pass_.shafts(*self.motion, stretch.u, dt, steps, fit.theta, self.w, self.shaft)

    def carry(self, lanes: Sequence[Lane]) -> np.ndarray:
        """Return the tangents of some lanes, (n, c, len(lanes))."""
        n, used, fit = len(self.stretch), self.experiment.columns, self.fit
        out = np.empty((n, len(used), len(lanes)))
        if self.astray:
            out[:] = np.inf
            return out
        dt, stretch, theta = self.experiment.dt, self.stretch, fit.theta
        steps = self.experiment.steps
        kinds, which = np.zeros((2, len(lanes)), dtype=np.int64)
        for i, lane in enumerate(lanes):
            (which[i],) = differing(fit, lane) or [0]
            if which[i] < 0:
                kinds[i] = pass_.BASE
                if lane.theta[s.K_POS] == theta[s.K_POS]:
                    which[i] = 0  # its rates differ, its drive does not
            else:
                one = np.arange(N_EFFECTS) == which[i]
                kinds[i] = pass_.TERM if len(with_term(one)) else pass_.CIRCUIT
        thetas = np.array([lane.theta for lane in lanes])
        circuits = np.array([circuit_of(lane.theta, lane.active) for lane in lanes])
        flags = [[len(has(np.arange(N_EFFECTS) == place)) > 0 and kind == pass_.TERM
                  for place, kind in zip(which, kinds, strict=True)]
                 for has in (with_update, with_place)]
        inverse = 1.0 / np.array([lane.step for lane in lanes])
        gone = np.array([pass_.TERM == kind and not lane.active[place] for kind, place, lane in
                         zip(kinds, which, lanes, strict=True)])
        assert not gone.any()
        areas = inverse * ((thetas[:, s.AREA_1] + thetas[:, s.AREA_2]) / thetas[:, s.M]
                           - (theta[s.AREA_1] + theta[s.AREA_2]) / theta[s.M])
        node_g = np.zeros((n, 2, pass_.N_RATES, len(lanes)))
        shown = np.zeros((n, N_OUTPUTS, len(lanes)))
        pass_.forced(*self.motion, self.memories, stretch.u, stretch.p1, stretch.p2, dt, steps,
                     theta, self.w, self.lag, self.shortest, self.terms, kinds, thetas, circuits, which,
                     np.array(flags[0]), np.array(flags[1]), inverse, fit.gains, self.e, node_g,
                     shown)
        pass_.carried_on(self.e, fit.gains, self.role, decay_of(self.experiment), dt, theta,
                         areas, self.shifts, self.w, self.shaft, self.phi, self.gamma, self.half,
                         self.half_gamma, self.jacs, self.constant, node_g, shown, used, out)
        return out


def maps_of(jacobian: np.ndarray, dt: float, length: float, steps: int
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return Phi (N, N) and Gamma (2, N, N_RATES) of Runge-Kutta steps over ``length`` s.

    What drives the rates is linear in time through its values at the two nodes of a sample.
    """
    size, rates = N_FILTERED, pass_.N_RATES
    whole = np.zeros((size + 2 * rates,) * 2)
    whole[0, s.V - 1] = 1.0  # x' = v
    whole[1 : 1 + rates, :size] = jacobian
    whole[1 : 1 + rates, size : size + rates] = np.eye(rates)
    whole[size : size + rates, size + rates :] = np.eye(rates)
    z = whole * (length / steps)
    one = np.eye(len(z)) + z @ (np.eye(len(z)) + z / 2 @ (np.eye(len(z)) + z / 3 @ (
        np.eye(len(z)) + z / 4)))
    power = np.linalg.matrix_power(one, steps)[:size]
    constant, ramp = power[:, size : size + rates], power[:, size + rates :] / dt
    apart = pass_.LATE - pass_.EARLY
    gamma = np.stack([constant * pass_.LATE - ramp, ramp - constant * pass_.EARLY]) / apart
    return np.ascontiguousarray(power[:, :size]), gamma
