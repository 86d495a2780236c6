"""All that the live estimator knows, in one record that is copied whole; its stages; going back.

That a sensor has frozen shows only once it has been still for a while.  What the filters made of
it meanwhile is undone: the estimator goes back to its last state before, and takes the rows anew
without the channel.  To wait for the parameters to come back instead takes longer than a window
of the model's test, and what the windows hold of the fault keeps a mismatch standing.
"""

import copy
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from eha_monitor.estimation import supervision as watch
from eha_monitor.estimation.discretisation import BETA_0, C_PLACE
from eha_monitor.estimation.inputs import StageInputs
from eha_monitor.estimation.results import NoiseEstimate
from eha_monitor.estimation.rig_model import RigModel
from eha_monitor.estimation.stage_one import NEGATIVE, ConstantsOne, StateOne, new_state_one
from eha_monitor.estimation.stage_two import ConstantsTwo, StateTwo
from eha_monitor.live.checks import Handover, LiveModel
from eha_monitor.settings.monitor import Settings

EVERY_S, KEPT = 1.0, 6  # a copy each so many seconds, so many of them
BROKEN = "the filter's covariance is no longer positive"
Change = tuple[int, float, float, int]  # sample, before, after, samples that showed it
B_PLACE = 2
VV_PLACE, BB_PLACE = 3, 5  # of the variances of velocity and B in the packed covariance
ROUNDING = 1e-3  # of a sample's variance, by which rounding may make one negative


def check(out: np.ndarray, sigma: int) -> None:
    """Raise FloatingPointError where a stage's variance is no longer positive.

    Numbers that no rig has came then.

    Parameters
    ----------
    out : with the innovations and their standard deviations as the last two rows.
    sigma : row of the parameter's standard deviation.
    """
    measured = np.isfinite(out[-2])
    if not (np.isfinite(out[sigma]).all() and np.isfinite(out[-1][measured]).all()):
        raise FloatingPointError(BROKEN)


@dataclass(kw_only=True)
class LiveStage:
    """What both stages share: the very step that runs over recordings, batch by batch."""

    run: Callable[..., int]  # runs the stage over rows (:func:`stages.engine_of`)
    model: RigModel  # the rig and its modelled effects
    # constants, state: of the stage; ``state`` is updated in place
    constants: ConstantsOne | ConstantsTwo
    state: StateOne | StateTwo

    def __deepcopy__(self, memo: dict) -> "LiveStage":
        """Copy the state; what runs it, and the model, are never changed in place."""
        return replace(self, state=type(self.state)(*(one.copy() for one in self.state)))

    def take(self, inputs: StageInputs, first: int, stop: int, *damping: float
             ) -> tuple[np.ndarray, list[Change]]:
        """Take samples ``first`` to ``stop`` of some inputs.

        ``damping`` : for stage two, B and its variance.  Returns (rows, stop) as the stage writes
        it, from ``first`` on, and the changes seen.  Raises FloatingPointError if numbers that no
        rig has broke the filter.
        """
        out, changes = np.empty((self.rows, stop)), []
        while first < stop:  # block by block, as a change may end in another beginning
            end = min(stop, first + watch.BLOCK - int(self.state.watch[watch.SAMPLES]))
            events = np.empty((1, 4))
            found = self.run(self._rows(inputs, end, *damping), self.constants,
                             self.model.effects, self.state, first, out, events)
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
        of_x, of_v = (float(self.state.P[place]) for place in self.motion)
        r = self.constants.R
        if not (of_x > -ROUNDING * r and of_v > -ROUNDING * r / self.constants.dt**2):
            raise FloatingPointError(BROKEN)

    def _changed(self) -> None:
        """Do what a change asks for."""

    def set_noise(self, r: float) -> None:
        """Take another variance of the position, m^2."""
        self.constants = self.constants._replace(R=r)

    def lose(self) -> None:
        """Find position and velocity anew at the next sample; the parameter stays."""
        self.state.x[0] = math.nan

    def forget_scores(self) -> None:
        """Look for changes only in what comes from now on."""
        self.state.watch[[watch.SCORE, watch.INFORMATION, watch.BLOCKS]] = 0.0

    def forget(self, changes: float, memory: float) -> None:
        """Let old changes count less, and what a parameter that is held rests on.

        What is hours ago is no hopping to and fro; and an average over hours would hide wear.

        ``changes``, ``memory`` : shares that are kept.
        """
        if self.state.watch[watch.FROZEN] == 0.0:
            self.state.watch[[watch.CHANGES, watch.NET, watch.TRAVEL]] *= changes
        elif not self.held:
            self.variance = min(self.variance / memory,
                                max(self.variance, self.constants.prior_variance))

    @property
    def variance(self) -> float:
        """Variance as the filter has it: of B, or of the compliance."""
        return float(self.state.P[self.place])

    @variance.setter
    def variance(self, value: float) -> None:
        self.state.P[self.place] = value

    @property
    def held(self) -> bool:
        """Whether the parameter stays at its prior, because nothing has excited it yet."""
        return bool(self.state.watch[watch.FROZEN] == watch.HELD)

    @property
    def factor(self) -> float:
        """Factor on sigma that the scores ask for."""
        return watch.honest_factor(self.state.watch)


@dataclass(kw_only=True)
class LiveStageOne(LiveStage):
    """Stage one; ``prior`` is that of B, N·s/m."""

    prior: float
    rows, sigma = 6, 3  # of what the stage writes; the place of the parameter's sigma
    # Places in the covariance: of the parameter; of position and velocity.
    place, motion = BB_PLACE, (0, VV_PLACE)

    @classmethod
    def new(cls, run: Callable[..., int], model: RigModel, constants: ConstantsOne,
            prior: float) -> "LiveStageOne":
        """Return a stage that knows the prior."""
        return cls(run=run, model=model, constants=constants, prior=prior,
                   state=new_state_one(prior, constants.prior_variance))

    @staticmethod
    def _rows(inputs: StageInputs, stop: int):
        return inputs.rows_one(stop)

    def _changed(self) -> None:
        if watch.gave_up(self.state.watch):  # estimate B anew: its changes were the model's misfit
            self._set(self.prior, self.constants.prior_variance)
            self.state = self.state._replace(watch=watch.new_supervision(frozen=True))

    def use(self, model: RigModel, mass: float) -> None:
        """Go on with another model of the same effects, by which the force is read otherwise."""
        self.model, self.constants = model, self.constants._replace(mass=mass)

    def carry_on(self, value: float, stddev: float) -> None:
        """Go on from a B that the last seconds gave, and look for changes again."""
        self._set(value, stddev**2)
        self.state = self.state._replace(watch=watch.new_supervision())

    def _set(self, value: float, variance: float) -> None:
        self.state.x[B_PLACE] = max(value, -NEGATIVE * self.constants.mass / self.constants.dt)
        self.state.P[[2, 4, BB_PLACE]] = 0.0, 0.0, variance

    @property
    def value(self) -> float:
        """B, N·s/m."""
        return float(self.state.x[B_PLACE])

    @property
    def stddev(self) -> float:
        """Its standard deviation, N·s/m."""
        return self.factor * math.sqrt(self.variance)


@dataclass(kw_only=True)
class LiveStageTwo(LiveStage):
    """Stage two, from a state that a run left; ``b_variance`` is of the damping taken last."""

    b_variance: float
    rows, sigma = 8, 4
    place, motion = (C_PLACE, C_PLACE), ((0, 0), (1, 1))

    def _rows(self, inputs: StageInputs, stop: int, b: float, b_variance: float):
        self.b_variance = b_variance
        return inputs.rows_two(b, b_variance, stop)

    @property
    def value(self) -> float:
        """Effective bulk modulus, Pa."""
        return float(self.model.hydraulics[BETA_0]) / self._compliance

    @property
    def stddev(self) -> float:
        """Its standard deviation with the uncertainty of B, Pa."""
        to_b = float(self.state.sens[C_PLACE])
        return self.value / self._compliance * math.sqrt(
            self.factor**2 * self.variance + to_b**2 * self.b_variance)

    @property
    def _compliance(self) -> float:
        return max(float(self.state.x[C_PLACE]), 1e-9)


@dataclass
class LiveState:
    """What the filters know; rows and events are not part of it."""

    settings: Settings  # those of the start; never changed in place
    # handover, tester: when stage two gets a damping; the test of the model
    handover: Handover
    tester: LiveModel
    noise_at: list[float]  # when the noise is measured again, s after the start
    taken: int = 0  # rows that have been filtered
    # one, two: the stages, once they run
    one: LiveStageOne | None = None
    two: LiveStageTwo | None = None
    damping: tuple[float, float] = (math.nan, math.nan)  # B that stage two takes, and its variance
    piece: int = 0  # first row that the present damping holds for
    stale_piece: bool = False  # B has changed since stage two was run over the buffer
    clean: int = 0  # row from which on stage two is run again
    # of each stage (row, before, after, samples that showed it), the last 200
    changes: dict[str, list[Change]] = field(default_factory=lambda: {"one": [], "two": []})
    # noise, quantum, r: of the channels; resolution (m) and variance (m^2) of the position
    noise: dict[str, NoiseEstimate] = field(default_factory=dict)
    quantum: float = 0.0
    r: float = math.nan
    # parameters whose convergence has been reported
    announced: set[str] = field(default_factory=set)

    @property
    def stages(self) -> list[LiveStage]:
        """The stages that run."""
        return [stage for stage in (self.one, self.two) if stage is not None]

    def copied(self) -> "LiveState":
        """Return a copy of all but the settings."""
        return copy.deepcopy(self, {id(self.settings): self.settings})

    def restart_rows(self) -> None:
        """Count rows anew, after a long gap: parameters stay, positions do not."""
        self.taken = self.piece = self.clean = 0
        self.tester.restart_rows()
        self.changes = {"one": [], "two": []}
        for stage in self.stages:
            stage.lose()


class Checkpoints:
    """The states of the last some seconds."""

    def __init__(self):
        self._kept: deque[LiveState] = deque(maxlen=KEPT)

    def clear(self) -> None:
        """Forget all, e.g. when rows are counted anew."""
        self._kept.clear()

    def keep(self, state: LiveState, dt: float) -> None:
        """Keep a copy, unless the last one is recent."""
        if not self._kept or state.taken - self._kept[-1].taken >= EVERY_S / dt:
            self._kept.append(state.copied())

    def before(self, row: int) -> LiveState | None:
        """Return the last state before ``row``, None without one; later ones are dropped."""
        while self._kept and self._kept[-1].taken > row:
            self._kept.pop()
        return self._kept[-1].copied() if self._kept else None
