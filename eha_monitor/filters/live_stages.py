"""Both stages on live rows, batch by batch, with the very step that runs over recordings.

A stage's state is a few arrays, which a copy takes whole: so a rewind puts a stage back to where
it was.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from eha_monitor.filters.inputs import RigModel, StageInputs
from eha_monitor.filters.kernel_one import NEGATIVE
from eha_monitor.filters.known import new_known_memory
from eha_monitor.filters.run_two import KernelTwoResult
from eha_monitor.filters.stage_two import BETA_0, C_PLACE
from eha_monitor.filters.supervision import (
    BLOCK,
    BLOCKS,
    CHANGES,
    FROZEN,
    HELD,
    INFORMATION,
    NET,
    SAMPLES,
    SCORE,
    TRAVEL,
    gave_up,
    honest_factor,
    new_supervision,
)

BROKEN = "the filter's covariance is no longer positive"
Change = tuple[int, float, float, int]  # sample, before, after, samples that showed it
B_PLACE = 2
VV_PLACE, BB_PLACE = 3, 5  # of the variances of velocity and B in the packed covariance
ROUNDING = 1e-3  # of a sample's variance, by which rounding may make one negative


def check(out: np.ndarray, sigma: int) -> None:
    """Refuse what a stage wrote over some rows where its covariance broke down.

    Parameters
    ----------
    out : with the innovations and their standard deviations as the last two rows.
    sigma : row of the parameter's standard deviation.

    Raises
    ------
    FloatingPointError
        If a variance is no longer positive: numbers that no rig has came.
    """
    measured = np.isfinite(out[-2])
    if not (np.isfinite(out[sigma]).all() and np.isfinite(out[-1][measured]).all()):
        raise FloatingPointError(BROKEN)


@dataclass(kw_only=True)
class LiveStage:
    """What both stages share.

    Attributes
    ----------
    run : runs the stage over rows (:func:`engine.engine_of`).
    model : the rig and its modelled effects.
    dt, r : s, m^2.
    prior_variance : of the parameter.
    m : (n,) state, NaN first where it must be found anew.
    watch, memory : supervision, and what the effects remember.
    """

    run: Callable[..., int]
    model: RigModel
    dt: float
    r: float
    prior_variance: float
    m: np.ndarray
    watch: np.ndarray
    memory: np.ndarray

    def __deepcopy__(self, memo: dict) -> "LiveStage":
        """Copy the state; what runs it, and the model, are never changed in place."""
        return replace(self, **{one.name: value.copy() for one in fields(self)
                                if isinstance(value := getattr(self, one.name), np.ndarray)})

    def take(self, inputs: StageInputs, first: int, stop: int, *others
             ) -> tuple[np.ndarray, list[Change]]:
        """Take samples ``first`` to ``stop`` of some inputs.

        Returns
        -------
        out, changes
            (rows, stop) as the stage writes it, from ``first`` on; and the changes seen.

        Raises
        ------
        FloatingPointError
            If numbers that no rig has broke the filter.
        """
        out, changes = np.empty((self.rows, stop)), []
        while first < stop:  # block by block, as a change may end in another beginning
            end = min(stop, first + BLOCK - int(self.watch[SAMPLES]))
            events = np.empty((1, 4))
            found = self._run(inputs, first, end, out, events, *others)
            check(out[:, first:end], self.sigma)
            self._check()
            if found:
                self._changed()
                sample, before, _, window = events[0]
                changes.append((int(sample), float(before), self.value, int(window)))
            first = end
        return out, changes

    def _check(self) -> None:
        """Refuse variances of position and velocity that are, beyond rounding, negative."""
        of_x, of_v = self.motion
        if not (of_x > -ROUNDING * self.r and of_v > -ROUNDING * self.r / self.dt**2):
            raise FloatingPointError(BROKEN)

    @property
    def motion(self) -> tuple[float, float]:
        """Variances of position and velocity."""
        raise NotImplementedError

    def _changed(self) -> None:
        """Do what a change asks for."""

    @property
    def variance(self) -> float:
        """Variance of the parameter as the filter has it."""
        raise NotImplementedError

    def lose(self) -> None:
        """Find position and velocity anew at the next sample; the parameter stays."""
        self.m[0] = math.nan

    def forget_scores(self) -> None:
        """Look for changes only in what comes from now on."""
        self.watch[[SCORE, INFORMATION, BLOCKS]] = 0.0

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
            self.variance = min(self.variance / memory, max(self.variance, self.prior_variance))

    @property
    def held(self) -> bool:
        """Whether the parameter stays at its prior, because nothing has told it yet."""
        return bool(self.watch[FROZEN] == HELD)

    @property
    def factor(self) -> float:
        """Factor on sigma that the scores ask for."""
        return honest_factor(self.watch)


@dataclass(kw_only=True)
class LiveStageOne(LiveStage):
    """Stage one.

    Attributes
    ----------
    mass : kg.
    prior : of B, N·s/m.
    euler : run Eq. 4 as printed.
    p : (6,) covariance.
    """

    mass: float
    prior: float
    euler: bool
    p: np.ndarray
    rows, sigma = 6, 3  # of what the stage writes; the place of the parameter's sigma

    @classmethod
    def new(cls, run: Callable[..., int], model: RigModel, mass: float, dt: float, r: float,
            prior: float, prior_stddev: float, euler: bool = False) -> "LiveStageOne":
        """Return a stage that knows the prior."""
        p = np.zeros(6)
        p[BB_PLACE] = prior_stddev**2
        return cls(run=run, model=model, dt=dt, r=r, prior_variance=prior_stddev**2,
                   m=np.array([math.nan, 0.0, prior]), watch=new_supervision(),
                   memory=new_known_memory(), mass=mass, prior=prior, euler=euler, p=p)

    def _run(self, inputs, first, stop, out, events) -> int:
        force, model, n = inputs.force, self.model, len(inputs.p1)
        return self.run(
            inputs.x[:stop], force.start[:stop], force.end[:stop], force.variance[:stop],
            inputs.p1[: min(stop, n)], inputs.p2[: min(stop, n)], self.dt, self.mass, self.r,
            self.prior_variance, self.euler, model.theta, model.plain, model.remembering,
            self.memory, self.m, self.p, self.watch, first, out, events)

    def _changed(self) -> None:
        if gave_up(self.watch):  # estimate B anew: its changes were the model's misfit
            self._set(self.prior, self.prior_variance)
            self.watch = new_supervision(frozen=True)

    def use(self, model: RigModel, mass: float) -> None:
        """Go on with another model of the same effects, by which the force is read otherwise."""
        self.model, self.mass = model, mass

    def carry_on(self, value: float, stddev: float) -> None:
        """Go on from a B that the last seconds gave, and look for changes again."""
        self._set(value, stddev**2)
        self.watch = new_supervision()

    def _set(self, value: float, variance: float) -> None:
        self.m[B_PLACE] = max(value, -NEGATIVE * self.mass / self.dt)
        self.p[[2, 4, BB_PLACE]] = 0.0, 0.0, variance

    @property
    def value(self) -> float:
        """B, N·s/m."""
        return float(self.m[B_PLACE])

    @property
    def stddev(self) -> float:
        """Its standard deviation, N·s/m."""
        return self.factor * math.sqrt(self.variance)

    @property
    def variance(self) -> float:
        """Variance of B as the filter has it."""
        return float(self.p[BB_PLACE])

    @property
    def motion(self) -> tuple[float, float]:
        """Variances of position and velocity."""
        return float(self.p[0]), float(self.p[VV_PLACE])

    @variance.setter
    def variance(self, value: float) -> None:
        self.p[BB_PLACE] = value


@dataclass(kw_only=True)
class LiveStageTwo(LiveStage):
    """Stage two, from a state that a run over some rows left.

    Attributes
    ----------
    q_f : variance of an unmodelled force on a sample, N^2.
    p, sens : (n, n) covariance, (n,) sensitivity to B.
    matrices, at : :func:`kernel_two.new_step`.
    b_variance : of the damping taken last.
    """

    q_f: float
    p: np.ndarray
    sens: np.ndarray
    matrices: np.ndarray
    at: np.ndarray
    b_variance: float = 0.0
    rows, sigma = 8, 4

    @classmethod
    def after(cls, found: KernelTwoResult, run: Callable[..., int], model: RigModel, dt: float,
              r: float, q_f: float, prior_variance: float) -> "LiveStageTwo":
        """Return a stage that goes on where a run ended."""
        return cls(run=run, model=model, dt=dt, r=r, prior_variance=prior_variance, m=found.state,
                   watch=found.watch, memory=found.memory, q_f=q_f, p=found.covariance,
                   sens=found.sensitivity, matrices=found.matrices, at=found.at)

    def _run(self, inputs, first, stop, out, events, b, b_variance) -> int:
        drive, model, n = inputs.drive, self.model, len(inputs.mean)
        self.b_variance = b_variance
        return self.run(
            inputs.x[:stop], drive.start[:stop], drive.end[:stop], drive.variance[:stop],
            drive.instrument[:stop], np.full(stop, b), np.full(stop, b_variance),
            model.hydraulics, model.leak, inputs.leak_flow[:stop], self.dt, self.r, self.q_f,
            self.prior_variance, inputs.mean[: min(stop, n)], model.theta, model.plain,
            model.remembering, model.flows, self.memory, self.m, self.p, self.sens, self.watch,
            self.matrices, self.at, first, out, events)

    @property
    def value(self) -> float:
        """Effective bulk modulus, Pa."""
        return float(self.model.hydraulics[BETA_0]) / self._compliance

    @property
    def stddev(self) -> float:
        """Its standard deviation with the uncertainty of B, Pa."""
        return self.value / self._compliance * math.sqrt(
            self.factor**2 * self.variance + float(self.sens[C_PLACE]) ** 2 * self.b_variance)

    @property
    def sensitivity(self) -> float:
        """Relative change of the effective bulk modulus with B, per N·s/m."""
        return -float(self.sens[C_PLACE]) / self._compliance

    @property
    def variance(self) -> float:
        """Variance of the compliance as the filter has it."""
        return float(self.p[C_PLACE, C_PLACE])

    @property
    def motion(self) -> tuple[float, float]:
        """Variances of position and velocity."""
        return float(self.p[0, 0]), float(self.p[1, 1])

    @variance.setter
    def variance(self, value: float) -> None:
        self.p[C_PLACE, C_PLACE] = value

    @property
    def _compliance(self) -> float:
        return max(float(self.m[C_PLACE]), 1e-9)
