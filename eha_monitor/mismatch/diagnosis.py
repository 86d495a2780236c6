"""What a diagnosis says; immutable records, made by :mod:`name`, :mod:`locate`, :mod:`show`."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.constants import g

from eha_monitor.balances.baseline import Baseline
from eha_monitor.balances.machine import Machine
from eha_monitor.balances.policy import POLICY
from eha_monitor.quantity import quantity, share, side_by_side
from eha_monitor.recordings.recording import ChannelFinding
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig
from eha_monitor.words import effect_words, listed

INTERMITTENT = "intermittent_load"  # a load that comes and goes
VERDICTS = ("consistent", "mismatch", "unexplained", "insufficient_data")


@dataclass(frozen=True)
class Value:
    """A number with its standard deviation, both in ``unit``."""

    value: float
    stddev: float
    unit: str


@dataclass(frozen=True)
class NamedEffect:
    """One piece of left-out physics that the recording supports.

    Attributes
    ----------
    name, balance, equation, rig_check : from the catalogue.
    statement : one sentence with numbers.
    parameters : symbol -> value.
    log_evidence : log units that the model loses without it.
    indistinguishable_from : rivals that this very recording cannot tell from it.
    size : how much it does at its largest here, in words ("40 N", "0.3 l/min", "4 ms").
    probability : that it is there, from the evidence of all sets that were compared; 0 to 1.
    intervals_s : when it acts, s, where it comes and goes (``intermittent_load``).
    effective_samples, stability : how many independent samples the recording is worth, and in
        which share of its halves the effect comes up; NaN where a filter judges it.
    """

    name: str
    balance: str
    statement: str
    parameters: dict[str, Value]
    log_evidence: float
    indistinguishable_from: tuple[str, ...] = ()
    equation: str = ""
    rig_check: str = ""
    size: str = ""
    probability: float = np.nan
    intervals_s: tuple[tuple[float, float], ...] = ()
    effective_samples: float = np.nan
    stability: float = np.nan


def intermittent_load(statement: str, force: float, log_evidence: float, probability: float,
                      when: tuple[tuple[float, float], ...], rivals: tuple[str, ...] = ()
                      ) -> NamedEffect:
    """Return a load that comes and goes, ``force`` N at its largest."""
    return NamedEffect(INTERMITTENT, "force", statement, {"F": Value(force, np.nan, "N")},
                       log_evidence, rivals, "F(t), constant over stretches of time",
                       "Check what touches the rod at these times.",
                       quantity(abs(force), "N", 2), probability, when)


@dataclass(frozen=True)
class RigFinding:
    """A number of the rig of which the recording says another value than the config.

    Attributes
    ----------
    key : of the config's ``rig``; ``configured`` its value there, SI.
    found : what the recording says, with its standard deviation, SI.
    probability : that it is wrong by more than its tolerance, 0 to 1; NaN where it is within.
    statement : one sentence with both numbers.
    indistinguishable_from : effects that would do the same on this very recording.
    """

    key: str
    configured: float
    found: Value
    probability: float
    statement: str
    indistinguishable_from: tuple[str, ...] = ()


def beside_config(key: str, configured: float, found: Value) -> str:
    """Return what the config says of a number of the rig, and what the recording, in words."""
    one, other = side_by_side(configured, found.value, found.stddev, found.unit)
    said = f"{key}: the config says {one}, the recording {other}"
    twice = " (C_T, twice the flow over the pressure difference)"
    return said + twice * (key == "leakage")


class Adjusted(NamedTuple):
    """A number of the config that a recording moves; ``beyond`` its tolerance or within it."""

    key: str
    configured: float
    found: Value
    beyond: bool


def adjusted_of(findings: Sequence[RigFinding], rig: Rig) -> list[Adjusted]:
    """Return numbers of the rig that a recording moves within three tolerances."""
    return [Adjusted(one.key, one.configured, one.found, abs(np.log(
        one.found.value / one.configured)) > rig.tolerance.log_spread(one.key))
        for one in findings]


def adjusted_words(numbers: Sequence[Adjusted]) -> tuple[str, str]:
    """Return what an agreement says of numbers within three tolerances: what moved, what if.

    Within one tolerance only which they are; beyond it with what each would have to be, since a
    leakage known to a factor of three hides one that is ten times as large.
    """
    far = [one for one in numbers if one.beyond]
    near = [one.key for one in numbers if one not in far]
    asked = [f"{one.key} is {other}, where it has {given}" for one in far
             for given, other in [side_by_side(one.configured, one.found.value, one.found.stddev,
                                               one.found.unit)]]
    return (f"{listed(near)} moved within the tolerance" if near else "",
            f"{listed(asked)} (within three tolerances)" if asked else "")


def within_words(moved: float, spread: float) -> str:
    """Return within what a number lies: its logarithm off by ``moved``, known to ``spread``."""
    return f"within {'its tolerance' if abs(moved) <= spread else 'three of its tolerances'}"


@dataclass(frozen=True)
class Location:
    """Where the model and the recording disagree.

    ``balance`` : share of the disagreement, force, flow, drive, sensor; adds up to 1, or all 0
    where nothing disagrees.  ``regime`` : ``velocity_reversal``, ``high_speed``,
    ``high_pressure``, ``near_limit``, ``always`` or "".  ``intervals_s`` : where it is worst.
    """

    balance: dict[str, float]
    regime: str
    intervals_s: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class SignalFit:
    """Free-run error of one signal over short windows of unseen data, in ``unit``.

    ``before_rms`` nominal model with B and beta_e fitted, ``after_rms`` with the effects,
    ``noise_rms`` the sensor's own noise.  ``before_whiteness``, ``after_whiteness`` : largest
    variance ratio of block sums of the one-step innovations; 1 is white.  ``signal_rms`` : of
    the signal itself, where its size matters.
    """

    unit: str
    before_rms: float
    after_rms: float
    noise_rms: float
    before_whiteness: float = np.nan
    after_whiteness: float = np.nan
    signal_rms: float = np.nan


@dataclass(frozen=True)
class Curve:
    """The missing term against one quantity: what the record shows and what the model makes.

    ``against``/``against_unit`` e.g. ``velocity``/``m/s``; ``measured``, ``spread``, ``modelled``
    (n,) in ``unit`` at ``x`` (n,).  ``balance`` is whose missing term it is.
    """

    balance: str
    against: str
    against_unit: str
    unit: str
    x: np.ndarray
    measured: np.ndarray
    spread: np.ndarray
    modelled: np.ndarray


@dataclass(frozen=True)
class Overlay:
    """A stretch of unseen data: a signal measured, and both models running free; (n,) each."""

    signal: str
    unit: str
    time: np.ndarray
    measured: np.ndarray
    before: np.ndarray
    after: np.ndarray


@dataclass(frozen=True)
class LearnedTerm:
    """A model of what has no name, learned from the recording: a curve over one signal.

    Attributes
    ----------
    balance : whose missing part it is; ``adds`` to what, as an own term of a config.
    of : signals that it is a function of, the curve's first.
    statement : one sentence with numbers; ``size`` at its largest here, in words.
    unit, against_unit : of the curve and of its signal.
    x, curve, band : (n,) the curve and its standard deviation; nothing is known beyond its ends.
    at, measured, spread : (k,) the same from the recording, bin by bin.
    formula : where one explains as much as the curve, to 5 %, else empty; ``shape``
        its name.
    rivals : other formulas and by how many log units each is worse than the formula that is given,
        or else than the curve.
    formula_curve : (n,) of the best formula, NaN where there is none.
    removed : share of the squared error on unseen data, beyond the noise, that it takes away from
        the same model without it.
    gained : log units over that model.
    entry : of a config's ``effects``.
    """

    balance: str
    adds: str
    of: tuple[str, ...]
    statement: str
    size: str
    unit: str
    against_unit: str
    x: np.ndarray
    curve: np.ndarray
    band: np.ndarray
    at: np.ndarray
    measured: np.ndarray
    spread: np.ndarray
    formula: str
    shape: str
    rivals: tuple[tuple[str, float], ...]
    formula_curve: np.ndarray
    removed: float
    gained: float
    entry: dict

    @property
    def sentence(self) -> str:
        """What it is, and what it takes away."""
        return (f"{self.statement}. It removes {share(min(self.removed, 0.999))} of the squared "
                "error on unseen data")

    @property
    def message(self) -> str:
        """What a balance lacks beside the catalogue."""
        return (f"the {self.balance} balance lacks an effect that is not in the catalogue: "
                f"{self.sentence}")


@dataclass(frozen=True)
class Considered:
    """A catalogue entry that was tried, and why it is not named.

    ``gain`` in log units over the model at hand, beside ``beside`` (effects already named).
    """

    name: str
    gain: float
    beside: tuple[str, ...]
    why: str


@dataclass(frozen=True)
class Agreement:
    """The same parameter from different parts of the record, before and after modelling."""

    part: str
    before: dict[str, Value]
    after: dict[str, Value]


@dataclass(frozen=True)
class Piece:
    """A time of a recording in which the nominal model holds, with its own B and beta_e; s."""

    bag: str
    start_s: float
    stop_s: float
    values: dict[str, Value]


@dataclass(frozen=True)
class ChangePoint:
    """When and how a number of the machine changed while a recording ran."""

    bag: str
    before_s: float  # until when it is of one state, s from the recording's start
    since_s: float  # from when it is of the other
    what: str  # effect
    symbol: str  # parameter
    balance: str  # where it acts
    step: Value  # by how much, with the standard deviation
    removed: float  # share of the balance's error on unseen parts that goes with it
    statement: str


@dataclass(frozen=True)
class Event:
    """What disturbed a recording for a while, and was left out."""

    bag: str  # the recording
    start_s: float  # from and until when, s from the recording's start
    stop_s: float
    balance: str  # the one that was off most
    size: float  # by how much it was off, rms, in its unit (SI)
    mean: float  # and in the mean
    times: float  # the rms is so many times what it is off else
    statement: str  # one sentence
    also: tuple[str, ...] = ()  # the other balances that were off
    by_pressures: bool = True  # whether the pressures are the measure of its force

    @property
    def is_load(self) -> bool:
        """Whether it is a force of one direction while the flow is as else."""
        return self.balance == "force" and not self.also and abs(self.mean) > 0.5 * self.size


@dataclass(frozen=True)
class Change:
    """A number that is not what healthy recordings of the machine have.

    Attributes
    ----------
    what : ``B``, ``beta_e``, ``charge_pressure``, an effect, or ``learned <balance>``.
    symbol : of the effect's parameter, or "".
    balance : where it acts.
    reference : mean of the healthy recordings, with its spread from one to the next; ``now`` of
        this recording, with the standard deviation of its noise.
    statement : one sentence with both.
    indistinguishable_from : what explains this recording as well.
    """

    what: str
    symbol: str
    balance: str
    reference: Value
    now: Value
    unit: str
    statement: str
    indistinguishable_from: tuple[str, ...] = ()


@dataclass(frozen=True)
class Fitted:
    """Every number that the last model was fitted with, and how they hang together."""

    names: tuple[str, ...]  # ``B``, ``beta_e``, ``rig.<key>``, ``<effect>.<parameter>``
    values: np.ndarray  # (k,) SI
    covariance: np.ndarray  # (k, k), the tolerances of the rig numbers in it


@dataclass(frozen=True)
class Gate:
    """A check that an answer did not pass, so that it is not given."""

    # ``unseen_error``, ``bound``, ``member``, ``added``, ``sign``, ``curve`` or ``least_squares``
    gate: str
    what: str  # effect, ``rig.<key>`` or signal that failed
    statement: str  # one sentence: which check, with its numbers


@dataclass(frozen=True)
class Window:
    """A part of a recording, s."""

    bag: str
    start_s: float
    stop_s: float


@dataclass(frozen=True)
class Diagnosis:
    """The whole answer.

    Attributes
    ----------
    bags : names of the recordings.
    verdict : one of ``VERDICTS``; ``message`` says it in a sentence.
    before, after : ``B`` and ``beta_e`` without and with the named effects.
    data : ``held_out`` or ``held_out_bag``: on what the fit was shown.
    health : sentences on what the mismatch did to the health estimate.
    remarks : what else several recordings of a machine say together, for the researcher.
    config_effects : the ``effects:`` section that holds the named physics.
    pieces : where a parameter changed and nothing else is missing, the data in pieces; ``after``
        and ``signals`` are then of the last one.
    channels : what was found out about the channels; ``command_hold`` of the config, the
        hold in place of ``auto`` where the recordings tell it.
    probability : of ``consistent`` and of ``unexplained``, 0 to 1.
    rig_data : numbers of the rig that the recordings contradict.
    rig_within : numbers of the rig that they know better than the config, within its tolerance.
    named_on : windows of long recordings on which the effects were named; empty where they were
        named on all of it.
    learned : where the verdict is ``unexplained``: a model of what has no name, if one holds on
        unseen data; ``after`` and ``signals`` are then of it.
    references : healthy recordings that it was compared with, or none; ``changes`` against them.
    looked_s : of a long recording the models saw so many seconds; 0 where they saw all of it.
    fitted : all numbers behind ``after`` with their joint covariance; None where there are none.
    gates : checks that refused an answer or a member of it, in the order in which they did.
    baselines : least squares on the balances of each recording, beside which the answer stands.
    belonging : the machine of those of the recordings that belong, for others to be judged by.
    machine : what several recordings of one machine show together, or the machine that the
        recording was judged against.
    policy : the numbers that decided names.
    change_points : where a number changed while a recording ran; all else is of the state since.
    events : what disturbed a recording for a while; all else is of the rest.
    drift : by how much viscous damping changes from start to end, where it surely does.
    blind : balances that the references leave mostly unexplained, so that a change may be missed.
    """

    bags: tuple[str, ...]
    verdict: str
    message: str
    location: Location
    effects: tuple[NamedEffect, ...]
    before: dict[str, Value]
    after: dict[str, Value]
    data: str
    signals: dict[str, SignalFit]
    curves: tuple[Curve, ...] = ()
    overlays: tuple[Overlay, ...] = ()
    considered: tuple[Considered, ...] = ()
    agreement: tuple[Agreement, ...] = ()
    health: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()
    config_effects: dict[str, dict[str, float]] = field(default_factory=dict)
    duration_s: float = 0.0
    wall_s: float = 0.0
    pieces: tuple[Piece, ...] = ()
    channels: tuple[ChannelFinding, ...] = ()
    command_hold: str = "auto"
    probability: dict[str, float] = field(default_factory=dict)
    rig_data: tuple[RigFinding, ...] = ()
    rig_within: tuple[RigFinding, ...] = ()
    named_on: tuple[Window, ...] = ()
    looked_s: float = 0.0
    learned: tuple[LearnedTerm, ...] = ()
    references: tuple[str, ...] = ()
    changes: tuple[Change, ...] = ()
    fitted: Fitted | None = None
    gates: tuple[Gate, ...] = ()
    baselines: tuple[Baseline, ...] = ()
    machine: Machine | None = None
    belonging: Machine | None = None
    policy: dict[str, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    change_points: tuple[ChangePoint, ...] = ()
    drift: Value | None = None
    blind: tuple[str, ...] = ()
    events: tuple[Event, ...] = ()

    def around(self, events: tuple[Event, ...]) -> "Diagnosis":
        """Return it as the answer for what some events have left of the recordings.

        A load that comes and goes is named, and makes a mismatch; else its message tells them.
        """
        if not events:
            return self
        said = "; ".join(one.statement for one in events)
        found = replace(self, events=events, message=f"{said}; in the rest: {self.message}")
        loads = [one for one in events if one.is_load]
        if not loads or self.references or self.verdict not in ("consistent", "mismatch"):
            return found
        largest = max(loads, key=lambda one: abs(one.mean))
        when = tuple((one.start_s, one.stop_s) for one in loads)
        effect = intermittent_load(
            "; ".join(one.statement for one in loads), largest.mean, np.nan, POLICY.certain, when,
            ("pressure_offset",) if largest.by_pressures else ())
        where = self.location
        if self.verdict == "consistent":
            where = Location(dict.fromkeys(where.balance, 0.0) | {"force": 1.0}, "", when)
        return replace(found, verdict="mismatch", effects=(*self.effects, effect), location=where,
                       probability=self.probability | {"consistent": 0.0})

    def since(self, points: tuple[ChangePoint, ...], started: float) -> "Diagnosis":
        """Return it as the answer for what came after some changes, which its message names.

        ``started`` : when all of it began, s of ``time.perf_counter``.
        """
        found = replace(self, wall_s=time.perf_counter() - started)
        if not points:
            return found
        said = "; ".join(one.statement for one in points)
        return replace(found, change_points=points,
                       message=f"{said}; in the state since: {self.message}")


QUANTISATION = "position_quantisation"
NOTABLE = 0.02  # relative change of a health parameter that is worth a sentence
BALANCE_OF = {"B": "force", "beta_e": "flow"}
HEALTH_WORDS = {"B": "B", "beta_e": "the effective bulk modulus"}


def health_sentences(before: dict[str, Value], after: dict[str, Value],
                     effects: Sequence[NamedEffect]) -> tuple[str, ...]:
    """Return in plain words what the mismatch did to the health estimates.

    Stage one reads B from the force balance: what the flow lacks bends only the nominal model's.
    An encoder's step is noise, and bends nothing.
    """
    found = []
    effects = [effect for effect in effects if effect.name != QUANTISATION]
    plant = [effect for effect in effects if effect.balance in ("force", "flow")] or list(effects)
    for name, first in before.items():
        if name not in after or not effects:
            continue
        own = [effect for effect in plant if effect.balance == BALANCE_OF[name]] or plant
        if name == "B" and not any(e.balance in ("force", "sensor") for e in effects):
            continue
        then = after[name].value
        change = first.value - then
        if abs(change) < NOTABLE * abs(then) or abs(change) < 3.0 * after[name].stddev:
            continue
        cause = " and ".join(effect_words(effect.name) for effect in own[:3])
        read = f"{HEALTH_WORDS[name]} read {quantity(first.value, first.unit, 3)}"
        sense = "not wear" if name == "B" else "not the fluid"
        if change > 0:
            found.append(f"{read}; {quantity(change, first.unit, 3)} of it is {cause}, {sense}")
        else:
            found.append(f"{read}, {quantity(-change, first.unit, 3)} too little, because of "
                         f"{cause}")
    return tuple(found)


def payload_sentences(effects: Sequence[NamedEffect], wrong: Sequence[RigFinding],
                      settings: Settings) -> tuple[str, ...]:
    """Return in plain words that a load and a mass that came are one: the load is its weight."""
    if settings.rig.motion == "rotary":
        return ()
    of = {symbol: one for effect in effects for symbol, one in effect.parameters.items()}
    beyond = (replace(one.found, value=one.found.value - one.configured)
              for one in wrong if one.key == "mass")
    mass, load = next(beyond, of.get("dM")), of.get("F_0")
    if mass is None or load is None:
        return ()
    had = settings.effects.get("constant_load", {}).get("F_0", 0.0)
    weight = abs(load.value - had) / g
    if abs(weight - mass.value) > POLICY.varied * np.hypot(mass.stddev, load.stddev / g):
        return ()
    return ("constant load and moving mass are those of one payload of "
            f"{quantity(weight, 'kg', 3)}: the load is its weight",)
