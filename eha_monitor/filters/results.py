"""What the filters return: immutable records with a status and a sentence."""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from eha_monitor.quantity import with_uncertainty
from eha_monitor.recordings.recording import ChannelFinding, Recording
from eha_monitor.settings.monitor import Settings

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
    """

    name: str
    value: float
    stddev: float
    unit: str
    status: Status
    message: str = ""

    @property
    def shown(self) -> str:
        """The value as people read it, ``600.0 ± 0.2 MPa``."""
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
    sensitivity : of stage two: relative change of its parameter with B, per N·s/m.
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
    sensitivity: float = math.nan
    changes: np.ndarray = field(default_factory=lambda: np.empty((0, 4)))


@dataclass(frozen=True)
class Event:
    """Something that a stage did: converged, handed over, re-ran, saw a change, was reset."""

    time_s: float
    stage: str
    message: str


@dataclass(frozen=True)
class JointResult:
    """B, beta_e and leakage at once, from dp and omega.

    ``parameters`` maps ``B``, ``beta_e``, ``L`` to estimates; ``correlation`` is (3, 3) in that
    order; ``fits`` tells whether position, force and drive agree on them at all.
    """

    parameters: dict[str, ParameterEstimate]
    correlation: np.ndarray
    message: str
    fits: bool


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


@dataclass(frozen=True)
class Taint:
    """Why a parameter deserves doubt, and since when, s.

    ``testing``: it has just moved, and the model is being tested on what came since.
    ``reach``: how far what the model lacks can have moved it (:mod:`filters.reach`), B in its
    unit, beta_e as a logarithm; inf where that is not known.
    """

    reason: str
    since_s: float
    testing: bool = False
    reach: float = math.inf


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
class Estimate:
    """Everything that ``estimate`` finds in one recording.

    ``settings`` have the hold decided; ``channels`` is what was found out about the channels.
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

    @property
    def parameters(self) -> dict[str, ParameterEstimate]:
        """``B`` of stage one and ``beta_e`` of stage two."""
        return {"B": self.stage_one.estimate, "beta_e": self.stage_two.estimate}
