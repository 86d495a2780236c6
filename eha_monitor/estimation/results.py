"""What estimation returns: immutable records with a status and a sentence."""

import bisect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from eha_monitor.quantity import FLOOR, SYMBOLS, quantity, share, with_uncertainty
from eha_monitor.recordings.recording import ChannelFinding, Recording
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import listed

CONVERGED = 0.10  # relative standard deviation
GAINED = 2.0  # so many times sharper than the prior, or the motion has told nothing
NEGATIVE = 3.0  # standard deviations below zero that no physical coefficient can be
LARGEST_NIS = 1.5  # of the joint filter; above it its standard deviations grow, and are in doubt
LOOK_S = 20.0  # of rows that least squares look at: for so long a look may stand
EVERY_S = 2.0  # between two looks, at least
NEAR_S = 1e-6  # s: two times are the same
HUGE = 100.0  # times the prior and its sigma: no longer a coefficient of this rig
BALANCE = {"one": "force balance or a sensor", "two": "flow balance, drive or a sensor",
           "joint": "a sensor's scale or the pump"}
Status = Literal["converged", "not_excited", "diverged", "no_data"]


@dataclass(frozen=True)
class ParameterEstimate:
    """One estimated parameter.

    Attributes
    ----------
    name : ``B``, ``beta_e`` or ``L`` (leakage coefficient C_T of the joint estimator).
    value, stddev : SI; NaN (null in JSON) when the status is ``no_data``.
    unit : as shown to people, e.g. ``N·s/m``.
    status : see the interface contract.
    message : the status as a full sentence with its reason.
    age_s : how long ago the rows end that least squares were made of; 0 of a filter's.
    """

    name: str
    value: float
    stddev: float
    unit: str
    status: Status
    message: str = ""
    age_s: float = 0.0

    @property
    def shown(self) -> str:
        """The value as people read it, ``600.0 ± 0.2 MPa``; a dash where that is no number."""
        if self.status == "not_excited" and self.stddev > abs(self.value):
            return "—"
        return with_uncertainty(self.value, self.stddev, self.unit)


@dataclass(frozen=True)
class Consistency:
    """How the innovations compare with what the filter expects of them.

    Attributes
    ----------
    samples : innovations judged.
    nis : mean normalised innovation squared; 1 when the noise levels are right.
    variance_ratio : largest ratio of the variance of block sums of the whitened innovations to
        that of white noise, over block lengths; 1 when they are white.
    block_length_s : length of the blocks where the ratio is largest, s.
    peak_time_s : where the largest windowed excess lies, s; NaN if none.
    consistent : the verdict.
    message : the verdict as a sentence.
    first_time_s : where the first windowed excess lies; the start where none stands out.
    decisive : False where chance, asked anew for days, would bring such a mismatch about.
    """

    samples: int
    nis: float
    variance_ratio: float
    block_length_s: float
    peak_time_s: float
    consistent: bool
    message: str
    first_time_s: float = math.nan
    decisive: bool = False


@dataclass(frozen=True)
class StageResult:
    """One stage over a recording.

    Attributes
    ----------
    stage : ``one`` or ``two``.
    estimate : the final parameter.
    time : (n,) s, on the recording's grid; empty arrays throughout when there is no data.
    value, stddev : (n,) the parameter as it converges, SI.
    position, velocity, acceleration : (n,) estimated states, SI; NaN where the stage has none.
    innovation, innovation_stddev : (n,) m; NaN where nothing was measured.
    consistency : verdict on the innovations, or None without data.
    changes : (k, 4) detected changes of the parameter: sample, before, after, samples that
        showed it.
    """

    stage: str
    estimate: ParameterEstimate
    time: np.ndarray
    value: np.ndarray
    stddev: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    innovation: np.ndarray
    innovation_stddev: np.ndarray
    consistency: Consistency | None
    changes: np.ndarray = field(default_factory=lambda: np.empty((0, 4)))


@dataclass(frozen=True)
class Event:
    """Something that a stage did: converged, handed over, re-ran, saw a change, was reset.

    ``parameter`` : ``B`` or ``beta_e`` where the message tells a value of it.
    """

    time_s: float
    stage: str
    message: str
    parameter: str = ""


@dataclass(frozen=True)
class JointResult:
    """B, beta_e and leakage at once, from dp and omega.

    ``parameters`` maps ``B``, ``beta_e``, ``L`` to estimates; ``correlation`` is (3, 3) in that
    order; ``fits`` tells whether position, force and drive agree on them at all, ``nis`` how
    well: the median of the normalised innovations squared over that of white ones.
    """

    parameters: dict[str, ParameterEstimate]
    correlation: np.ndarray
    message: str
    fits: bool
    nis: float = 1.0


@dataclass(frozen=True)
class Mismatch:
    """A misfit that stands.

    Attributes
    ----------
    stage : ``one``, ``two`` or ``joint``: whose innovations show it.
    balance : what it points to, in words.
    since_s : when it began, s.
    nis, variance_ratio, worst_time_s : of the last window that showed it, see
        :class:`Consistency`; NaN for ``joint``.
    message : a sentence.
    """

    stage: str
    balance: str
    since_s: float
    nis: float
    variance_ratio: float
    worst_time_s: float
    message: str

    @classmethod
    def of(cls, stage: str, verdict: Consistency) -> "Mismatch":
        """Return the misfit that a verdict on a stage's innovations shows."""
        return cls(stage, BALANCE[stage], verdict.first_time_s, verdict.nis,
                   verdict.variance_ratio, verdict.peak_time_s, verdict.message)


@dataclass(frozen=True)
class Taint:
    """Why a parameter deserves doubt, and since when, s.

    ``testing``: it has just moved, and the model is being tested on what came since;
    ``untested``: no test has had enough data lately, ``never``: none has at all.
    ``instead``: what least squares on the balances of the last seconds give
    (:mod:`balances.parameters`), None where the motion does not determine it.
    """

    reason: str
    since_s: float
    testing: bool = False
    untested: bool = False
    never: bool = False
    instead: ParameterEstimate | None = None

    @property
    def standing(self) -> bool:
        """Whether the stage's value is not to be used now: a misfit, or nothing has tested it."""
        return self.never or not self.testing


@dataclass(frozen=True)
class ModelStatus:
    """Whether the model explains the recording: ``consistent``, ``mismatch``, ``not_judged``.

    ``mismatches`` are those that stand; ``tainted`` maps ``B`` and ``beta_e`` to the reason for
    which the value is in doubt.
    """

    status: str
    message: str
    mismatches: tuple[Mismatch, ...] = ()
    tainted: dict[str, Taint] = field(default_factory=dict)

    def best(self, parameters: Mapping[str, ParameterEstimate]) -> dict[str, ParameterEstimate]:
        """Return parameters by what stands instead of those in doubt, where something does."""
        instead = {name: taint.instead for name, taint in self.tainted.items()}
        return {name: instead.get(name) or one for name, one in parameters.items()}

    def origin(self, symbol: str) -> str:
        """Return what a parameter of :attr:`best` comes from: ``least squares`` or its stage."""
        taint = self.tainted.get(symbol)
        return "least squares" if taint and taint.instead else _STAGE_OF[symbol]

    def in_doubt(self, symbol: str) -> bool:
        """Tell whether a parameter of :attr:`best` is in doubt all the same."""
        taint = self.tainted.get(symbol)
        return taint is not None and taint.standing and taint.instead is None


@dataclass(frozen=True)
class LiveSnapshot:
    """What the live estimator knows now; ``events`` are those since the last snapshot.

    ``state_time_s`` is the time of position and velocity: they lag ``time_s`` by the rows that
    wait for their neighbours, and a piston goes millimetres meanwhile.  ``implausible`` is what
    in the rows contradicts the config, "" where nothing does.
    """

    time_s: float
    parameters: dict[str, ParameterEstimate]
    position: float
    velocity: float
    model: ModelStatus
    events: tuple[Event, ...]
    temperature: float | None
    consistency: dict[str, Consistency | None]
    state_time_s: float = math.nan
    implausible: str = ""


@dataclass(frozen=True)
class NoiseEstimate:
    """White noise of a channel: what was assumed, SI, and whether the data told it."""

    value: float
    measured: bool


@dataclass(frozen=True)
class Beside:
    """Least squares on the balances of the seconds before ``time_s``.

    ``parameters`` : ``B`` and ``beta_e``, each with its status; one without a balance is missing.
    """

    time_s: float
    parameters: dict[str, ParameterEstimate]

    def determined(self, symbol: str) -> ParameterEstimate | None:
        """Return a parameter, None where the motion does not determine it."""
        found = self.parameters.get(symbol)
        return found if found is not None and found.status == "converged" else None


def stands(looks: Sequence[Beside], elapsed_s: float, symbol: str) -> ParameterEstimate | None:
    """Return what the last look before a time that determined a parameter made of it.

    A look stands for as long as the rows that it was made of are partly among the last: from look
    to look the same motion is now just enough, now just not.  None where there is none.

    ``looks`` : in order of time.
    """
    place = bisect.bisect_right(looks, elapsed_s + NEAR_S, key=lambda one: one.time_s)
    for one in reversed(looks[:place]):
        if elapsed_s - one.time_s > LOOK_S:
            break
        if (found := one.determined(symbol)) is not None:
            return replace(found, age_s=max(elapsed_s - one.time_s, 0.0))
    return None


@dataclass(frozen=True)
class Estimate:
    """Everything that ``estimate`` finds in one recording.

    ``settings`` have the hold decided; ``channels`` is what was found out about the channels;
    ``beside`` are least squares along the recording where the model does not fit; ``leakage`` is
    C_T by them where no joint filter knows it.
    """

    recording: Recording
    settings: Settings
    stage_one: StageResult
    stage_two: StageResult
    joint: JointResult | None
    model: ModelStatus
    events: tuple[Event, ...]
    noise: dict[str, NoiseEstimate]
    wall_s: float = 0.0
    warnings: tuple[str, ...] = field(default=())
    channels: tuple[ChannelFinding, ...] = ()
    beside: tuple[Beside, ...] = ()
    leakage: ParameterEstimate | None = None

    @property
    def by_stages(self) -> dict[str, ParameterEstimate]:
        """``B`` of stage one and ``beta_e`` of stage two, in doubt or not."""
        return {"B": self.stage_one.estimate, "beta_e": self.stage_two.estimate}

    @property
    def parameters(self) -> dict[str, ParameterEstimate]:
        """``B`` and ``beta_e``: of the stages, and by least squares where those are in doubt."""
        return self.model.best(self.by_stages)

    @property
    def doubted(self) -> dict[str, Taint]:
        """What of :attr:`parameters` is in doubt all the same."""
        return {name: taint for name, taint in self.model.tainted.items() if taint.instead is None}

    @property
    def joint_doubt(self) -> str:
        """Why the joint filter's numbers are in doubt, "" where they are not.

        It holds the force balance that stage one holds.  Its flow balance knows the leakage,
        which stage two takes from the config, so that one's mismatch need not be its own.
        """
        if self.joint is None:
            return ""
        if "B" in self.model.tainted:
            return "the force balance does not fit"
        lost = [SYMBOLS.get(name, name) for name, p in self.joint.parameters.items()
                if p.status == "diverged"]
        if lost:  # what one of them has run away with, the others have taken up
            return f"{listed(lost)} diverged in the joint filter"
        return (f"the joint filter's innovations are off, NIS {self.joint.nis:.3g}"
                if self.joint.nis > LARGEST_NIS else "")

    @property
    def told(self) -> tuple[Event, ...]:
        """The events that are the machine's: not what a filter does whose model does not fit."""
        lost = {stage.stage for stage in (self.stage_one, self.stage_two)
                if stage.estimate.status != "converged" or stage.estimate.name in
                self.model.tainted}
        return tuple(event for event in self.events if event.stage not in lost or not any(
            word in event.message for word in (" converged at ", " changed from ")))


def units_of(motion: str) -> dict[str, str]:
    """Return the units of B, beta_e and L as people write them."""
    damping = "N·m·s/rad" if motion == "rotary" else "N·s/m"
    return {"B": damping, "beta_e": "Pa", "L": "m³/(s·Pa)"}


def no_data(name: str, unit: str, reason: str) -> ParameterEstimate:
    """Return an estimate without a number."""
    return ParameterEstimate(name, math.nan, math.nan, unit, "no_data", reason)


def judge_parameter(name: str, value: float, stddev: float, unit: str, prior: float,
                    prior_stddev: float, largest: float = math.inf) -> ParameterEstimate:
    """Give a value its status from how much sharper it is than its prior.

    ``largest`` is more than the parameter can be.
    """
    symbol = SYMBOLS.get(name, name)
    if not (math.isfinite(value) and math.isfinite(stddev)):
        return ParameterEstimate(name, math.nan, math.nan, unit, "diverged",
                                 f"{symbol} is no longer a finite number")
    limit = min(HUGE * (prior + prior_stddev), largest)
    # Beyond the limit, the inverse of the value (a compliance) must be so within its own sigma.
    beyond = abs(value) > limit and (1.0 + NEGATIVE * stddev / abs(value)) / abs(value) < 1 / limit
    if value < -NEGATIVE * stddev or beyond:
        return ParameterEstimate(
            name, math.nan, math.nan, unit, "diverged",
            f"{symbol} went to {quantity(value, unit, 3)}, which is not physical: the model, the "
            "config or a sign is wrong")
    shown = with_uncertainty(value, stddev, unit)
    if stddev > CONVERGED * abs(value) or GAINED * stddev > prior_stddev:
        before = with_uncertainty(prior, prior_stddev, unit)
        known = f"{shown}, prior {before}" if stddev < prior_stddev else (
            f"no more is known of it than before, {before}")  # 30 ± 190 GPa is no number
        return ParameterEstimate(
            name, value, stddev, unit, "not_excited",
            f"too little motion to identify {symbol}: {known}")
    told = share(max(stddev / abs(value) if value else 0.0, FLOOR), 2)
    return ParameterEstimate(name, value, stddev, unit, "converged",
                             f"{symbol} = {shown}, identified to ± {told}")


def converged_where(value: np.ndarray, stddev: np.ndarray, prior: float, prior_stddev: float,
                    largest: float = math.inf) -> np.ndarray:
    """Return (n,) bool, where :func:`judge_parameter` would say ``converged``."""
    limit = min(HUGE * (prior + prior_stddev), largest)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        size = np.abs(value)
        beyond = (size > limit) & ((1.0 + NEGATIVE * stddev / size) / size < 1.0 / limit)
        lost = (value < -NEGATIVE * stddev) | beyond
        return (np.isfinite(value) & np.isfinite(stddev) & ~lost
                & ~(stddev > CONVERGED * size) & ~(prior_stddev < 2.0 * stddev))


@dataclass(frozen=True)
class Stage:
    """What tells the stages apart.

    Attributes
    ----------
    key, words : ``one`` or ``two``; "stage one".
    parameter : symbol of what it estimates.
    missing : what a misfit of its innovations points to, in words.
    value, stddev, innovation, innovation_stddev : rows of what its kernel writes.
    """

    key: str
    words: str
    parameter: str
    missing: str
    value: int
    stddev: int
    innovation: int
    innovation_stddev: int

    def unit(self, settings: Settings) -> str:
        """Return the unit of its parameter as people write it."""
        return units_of(settings.rig.motion)[self.parameter]

    def prior(self, settings: Settings):
        """Return its section of the config."""
        return settings.stage_one if self.key == "one" else settings.stage_two

    def judged(self, settings: Settings, value: float, stddev: float) -> ParameterEstimate:
        """Return the parameter with its status."""
        prior = self.prior(settings)
        return judge_parameter(self.parameter, value, stddev, self.unit(settings), prior.prior,
                               prior.prior_stddev, getattr(prior, "largest", math.inf))

    def by_balance(self, settings: Settings, value: float, stddev: float) -> ParameterEstimate:
        """Return the parameter of least squares with its status; they begin with no prior."""
        found = judge_parameter(self.parameter, value, stddev, self.unit(settings), 0.0, math.inf,
                                getattr(self.prior(settings), "largest", math.inf))
        if found.status != "not_excited":
            return found
        beside = "dry friction" if self.key == "one" else "leakage and what the pump loses"
        symbol = SYMBOLS.get(self.parameter, self.parameter)
        return replace(found, message=f"the motion does not tell {symbol} from {beside}")

    def no_data(self, settings: Settings, reason: str) -> ParameterEstimate:
        """Return the parameter without a number."""
        return no_data(self.parameter, self.unit(settings), reason)


ONE = Stage("one", "stage one", "B",
            "the force balance M x'' = F - B x' lacks an effect, or a sensor is wrong", 2, 3, 4, 5)
TWO = Stage("two", "stage two", "beta_e",
            "the flow balance or the drive lacks an effect, a sensor is late or wrong, or B is "
            "wrong here", 3, 5, 6, 7)
STAGES = {stage.key: stage for stage in (ONE, TWO)}
_STAGE_OF = {stage.parameter: stage.words for stage in STAGES.values()}
