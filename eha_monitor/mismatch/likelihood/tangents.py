"""Exact sensitivities: the innovations' tangents to many parameters in one pass.

A lane is a model beside the one at hand: one parameter moved a little, or an effect that enters.
Its difference in the rates and in what the sensors show, taken along the trajectory of the model
at hand, drives the linearised filter (:mod:`eha_monitor.mismatch.likelihood.tangent_pass`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment, Stretch
from eha_monitor.mismatch.data.inputs import CLOSED
from eha_monitor.mismatch.likelihood.fit import Fit, spread, start_of, step_of
from eha_monitor.mismatch.likelihood.gains import decay_of
from eha_monitor.mismatch.likelihood.innovations import (
    N_FILTERED,
    Correction,
    Record,
    innovate,
)
from eha_monitor.mismatch.likelihood.tangent_lanes import BALANCE, DRIVE, TERM, Corrections, Lanes
from eha_monitor.mismatch.likelihood.tangent_motion import (
    EARLY,
    LATE,
    N_MOVED,
    N_RATES,
    Model,
    Motion,
    before_corrections,
    jacobians,
    lags,
    points_of,
    slopes_along,
    turns_over,
)
from eha_monitor.mismatch.likelihood.tangent_pass import Linear, carried_on, shafts
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import (
    ALL_NAMES,
    N_EFFECTS,
    circuit_of,
    effect_at,
    turned_memory,
    with_place,
    with_term,
    with_update,
)
from eha_monitor.physics.plant import N_OUTPUTS, SHORTEST_LAG, Step, actuator_of

# From where a sample is gone through by its Runge-Kutta stages: what an effect adds to a rate in
# it by its own slope, of the rate's size; decay in the sample, and angle squared, that are the
# effect's alone.  What forgets is left to the kick, unless Runge-Kutta itself is pressed by it.
REMEMBERING, FORGETTING = (0.02, 0.02, 1e-4), (np.inf, 1.0, 1.0)
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
    active = {ALL_NAMES[i] for i in np.flatnonzero(fit.active)}
    own = {ALL_NAMES[i] for i in changed if i >= 0}
    return not (active | own) & set(BEYOND) and len(changed) == 1


def differing(fit: Fit, lane: Lane) -> list[int]:
    """Return the effects in which a lane's model differs; -1 stands for the base parameters."""
    moved = np.flatnonzero(lane.theta != fit.theta)
    found = {effect_at(int(place)) for place in moved}
    found |= set(np.flatnonzero(lane.active != fit.active).tolist())
    # What stands in theta of an effect that acts in neither is nothing.
    return sorted(i for i in found if i < 0 or lane.active[i] or fit.active[i])


def along(experiment: Experiment, fit: Fit, lanes: Sequence[Lane]) -> list[np.ndarray]:
    """Return the tangents of all lanes, (n, c, len(lanes)) of the used channels per stretch.

    NaN where nothing was measured; infinite where the model's own run goes astray.
    """
    made = [np.empty((len(stretch), len(experiment.columns), len(lanes)))
            for stretch in experiment.stretches]
    along_into(experiment, fit, lanes, made, list(range(len(lanes))))
    return made


def along_into(experiment: Experiment, fit: Fit, lanes: Sequence[Lane], into: list[np.ndarray],
               places: list[int]) -> None:
    """Write the tangents of lanes to ``places`` of columns, (n, c, m) for each stretch."""
    def carry(task) -> None:
        track, first, columns = task
        columns[:, :, places[first : first + LANES]] = track.carry(lanes[first : first + LANES])

    for stretch, columns in zip(experiment.stretches, into, strict=True):
        # One stretch after the other: what a track holds is as large as many columns.
        track = Track(experiment, fit, stretch)
        spread(carry, [(track, i, columns) for i in range(0, len(lanes), LANES)])


class Track:
    """The trajectory of a model along a stretch, and its linearisation there."""

    def __init__(self, experiment: Experiment, fit: Fit, stretch: Stretch):
        theta, active = fit.theta, fit.active
        self.experiment, self.fit, self.stretch = experiment, fit, stretch
        dt, mode, n = experiment.dt, experiment.mode, len(stretch)
        self.role = np.zeros(n) if stretch.loose is None else stretch.loose
        w = circuit_of(theta, active)
        slow = bool(mode == CLOSED and lags(w))
        shortest = SHORTEST_LAG * dt / experiment.steps
        updates = with_update(active, theta)
        self.model = Model(mode, dt, experiment.steps, theta, w, slow,
                           max(w[s.DRIVE_LAG], shortest), shortest, with_term(active), updates,
                           with_place(active))
        self.e, states = np.empty((n, N_OUTPUTS)), np.zeros((n, N_FILTERED + 2 * len(updates)))
        decay = decay_of(experiment)
        innovate(Record(mode, stretch.z, stretch.u, (stretch.p1, stretch.p2), self.role),
                 Step(dt, experiment.steps), theta, active, Correction(fit.gains, decay),
                 actuator_of(start_of(experiment, stretch), turned_memory(stretch.begins_at)),
                 self.e, states)
        self.corrections = Corrections(fit.gains, self.e, self.role, decay)
        self.astray = not np.nanmax(np.abs(self.e), initial=0.0) < 1e29
        if self.astray:
            return
        ends, self.shifts = np.empty((n, N_FILTERED)), np.zeros(n)
        before_corrections(states, self.e, fit.gains, self.role, dt, theta, ends, self.shifts)
        slopes, slopes_end = np.zeros((2, n, N_MOVED))
        self.motion = Motion(stretch.u, stretch.p1, stretch.p2, states, ends, slopes, slopes_end)
        slopes_along(self.model, self.motion, turned_memory(stretch.begins_at))
        self.linearise()

    def linearise(self) -> None:
        """Take the rates' Jacobians: the median, and each sample's where it changes."""
        model, motion, steps = self.model, self.motion, self.experiment.steps
        n, dt = len(self.stretch), model.dt
        size = np.abs(motion.states[:, :N_FILTERED]).max(axis=0)
        rate = np.sqrt(np.mean(motion.slopes**2, axis=0))[1:] + 1e-30
        size[5] = max(size[5], 1e-3 * rate[0] * model.theta[s.M])
        size[6] = max(size[6], 1e-3 * size[1] * (model.theta[s.AREA_1] or 1.0))
        size[7] = max(size[7], 1e-3 * size[4])
        size += 1e-12
        varying = len(model.terms) > 0 or np.isfinite(model.w[[s.SPEED_LIMIT, s.SLEW_LIMIT]]).any()
        jacs = np.zeros((n if varying else 1, N_RATES, N_FILTERED))
        hard = np.zeros(n, dtype=np.bool_)
        memory = turned_memory(self.stretch.begins_at)
        jacobians(model, motion, size, memory, jacs)
        constant = jacs[0]
        if varying:
            constant = np.median(jacs[:: max(n // POINTS, 1)], axis=0)
            limits = REMEMBERING if len(model.updates) else FORGETTING
            turns_over(model, motion, jacs, constant, rate, limits, hard)
        self.points = points_of(model, motion, hard, size,
                                turned_memory(self.stretch.begins_at))
        shaft = np.zeros((n, N_FILTERED))
        if self.experiment.used[4]:
            shafts(model, motion, shaft)
        self.linear = Linear(*maps_of(constant, dt, dt, steps),
                             *maps_of(constant, dt, 0.5 * dt, -(-steps // 2)), constant,
                             jacs if varying else jacs[:0], shaft, self.shifts)

    def carry(self, lanes: Sequence[Lane]) -> np.ndarray:
        """Return the tangents of some lanes, (n, c, len(lanes))."""
        n, used = len(self.stretch), self.experiment.columns
        out = np.empty((n, len(used), len(lanes)))
        if self.astray:
            out[:] = np.inf
            return out
        carried_on(self.model, self.motion, self.points, self.linear, lanes_of(self.fit, lanes),
                   self.corrections, used, out)
        return out


def lanes_of(fit: Fit, lanes: Sequence[Lane]) -> Lanes:
    """Return lanes as the compiled pass takes them."""
    kinds, which = np.zeros((2, len(lanes)), dtype=np.int64)
    for i, lane in enumerate(lanes):
        places = differing(fit, lane)
        which[i] = places[0] if places else 0
        if which[i] < 0:
            which[i] = 0
            kinds[i] = BALANCE if lane.theta[s.K_POS] == fit.theta[s.K_POS] else DRIVE
        else:
            kinds[i] = TERM if len(with_term(np.arange(N_EFFECTS) == which[i])) else DRIVE
    alone = [np.arange(N_EFFECTS) == place for place in which]
    terms = kinds == TERM
    flags = [terms & np.array([len(with_update(one, lane.theta)) > 0
                               for one, lane in zip(alone, lanes, strict=True)], dtype=bool),
             terms & np.array([len(with_place(one)) > 0 for one in alone], dtype=bool)]
    count, thetas = len(lanes), np.array([lane.theta for lane in lanes])
    inverse = 1.0 / np.array([lane.step for lane in lanes])
    push = (thetas[:, s.AREA_1] + thetas[:, s.AREA_2]) / thetas[:, s.M]
    here = (fit.theta[s.AREA_1] + fit.theta[s.AREA_2]) / fit.theta[s.M]
    return Lanes(kinds, which, thetas,
                 np.array([circuit_of(lane.theta, lane.active) for lane in lanes]), *flags,
                 inverse, inverse * (push - here),
                 np.zeros((count, N_EFFECTS, s.MAX_MEMORY)),
                 np.zeros((count, N_EFFECTS, s.MAX_MEMORY)), np.zeros((count, 2)))


def maps_of(jacobian: np.ndarray, dt: float, length: float, steps: int
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return Phi (N, N) and Gamma (2, N, N_RATES) of Runge-Kutta steps over ``length`` s.

    What drives the rates is linear in time through its values at the two nodes of a sample.
    """
    size, rates = N_FILTERED, N_RATES
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
    apart = LATE - EARLY
    gamma = np.stack([constant * LATE - ramp, ramp - constant * EARLY]) / apart
    return np.ascontiguousarray(power[:, :size]), gamma
