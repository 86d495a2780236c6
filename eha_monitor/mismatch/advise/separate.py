"""Questions that a recording leaves open, the cheapest motion that settles them, and its check."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.advise.identifiability import Confusion, DetectionLimit, Known
from eha_monitor.mismatch.advise.motions import (
    Limits,
    Motion,
    candidates,
    planned,
    share_within,
    strained,
)
from eha_monitor.mismatch.data.experiment import Experiment, Stretch
from eha_monitor.mismatch.data.inputs import CLOSED, cubics
from eha_monitor.mismatch.likelihood.fit import Fit, free_run, with_unknowns
from eha_monitor.mismatch.likelihood.information import Gram, Slope, Traces, free_slopes, gain_of
from eha_monitor.mismatch.name.refit import settled
from eha_monitor.mismatch.name.starts import (
    continuing,
    directions_of,
    starts_of,
    with_effect,
    without_effect,
)
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import effect_values, place_of


def simulated(experiment: Experiment, fit: Fit) -> Experiment:
    """Return the experiment with the fitted model's own outputs in place of the measured ones.

    Its drive has read the position without the noise that is added here.
    """
    rng = np.random.default_rng(0)
    parts = []
    for stretch in experiment.stretches:
        clean = free_run(experiment, stretch, fit)
        z = clean + np.nan_to_num(experiment.noise) * rng.standard_normal(clean.shape)
        step = experiment.position_step
        if step > 0:  # of the noise a part is rounding
            white = float(np.sqrt(max(experiment.noise[0] ** 2 - (step / np.sqrt(12.0))**2, 0.0)))
            z[:, 0] = step * np.round(
                (clean[:, 0] + white * rng.standard_normal(len(stretch))) / step)
        z[~np.isfinite(stretch.z)] = np.nan
        parts.append(replace(stretch, z=z, u=noisy_input(experiment, stretch, rng)))
    return replace(experiment.only(tuple(parts)), hears=False)


def noisy_input(experiment: Experiment, stretch: Stretch, rng: np.random.Generator) -> np.ndarray:
    """Return the input as it would be measured: x_d is known, a sensor's is not."""
    noise = experiment.input_noise
    if experiment.mode == CLOSED or noise <= 0:
        return stretch.u
    return cubics(stretch.u[:, 0] + noise * rng.standard_normal(len(stretch)), noise,
                  experiment.held)


DECISIVE = 20.0  # log units that settle a question
WANTED = 40.0  # log units that a prediction must reach, so that they do
LONGEST = 16.0  # s of two motions together
USUAL = ("sine_2_hz", "sine_10_hz", "sine_places", "triangle_half", "multisine")  # quick search
FORM = 1e-3  # of a trace's squares: no model is right to 3 % of an effect, so less says nothing


@dataclass(frozen=True)
class _Asked:
    """What may be there, beside what else it may be."""

    effect: str
    rival: str
    parameter: str
    steady: bool  # the answer then does not hang on how friction reverses
    amount: float  # of the effect in which the two differ, SI
    symbol: str  # its size
    unit: str


@dataclass(frozen=True)
class Doubt(_Asked):
    """A question that the recording leaves open.

    ``effect`` or ``rival`` ("": B and beta_e alone); ``parameter`` where the question is what of
    it is the effect; ``steady``: from the plateaus of speed alone.  ``now`` : log units that the
    recording has on it; ``then`` : with the proposed motion; both at ``amount``.
    """

    now: float
    then: float


@dataclass(frozen=True)
class Question(_Asked):
    """Two models between which the recording is to decide."""

    truth: Fit  # the model with the effect
    other: Fit  # the other one
    reference: str = "truth"  # which of the two is the fit at which slopes are taken

    @property
    def label(self) -> str:
        """Name of the difference between the two models."""
        return f"{self.effect}|{self.rival}|{self.parameter}|{self.steady}"

    def slopes(self) -> list[Slope]:
        """Return the difference of the two models, and what the rival adjusts."""
        away = self.other if self.reference == "truth" else self.truth
        model = (away.theta, away.active)
        found = [Slope(self.label, model)]
        if self.rival:
            own = [f for f in self.other.free if f.name.startswith(f"{self.rival}.")]
            found += free_slopes(replace(self.other, free=tuple(own)), model,
                                 [f"{self.label}:{f.name}" for f in own])
        return found

    def absorbing(self, base: Sequence[Slope]) -> list[Slope]:
        """Return the slopes with which the other model may make up for the difference."""
        held = f"{self.effect}." + ("" if self.rival else self.symbol)
        shared = [slope for slope in base if not slope.label.startswith(held)]
        return shared + self.slopes()[1:]

    def gain(self, gram: Gram, base: Sequence[Slope], steady: bool | None = None) -> float:
        """Return the log units by which the data of a Gram decide the question."""
        steady = self.steady if steady is None else steady
        slopes = self.absorbing(base)
        left = gram.remaining([self.label], [slope.label for slope in slopes],
                              {slope.label: slope.weight for slope in slopes}, steady)
        squares = float(left[0, 0])
        if steady:
            (place,) = gram.places([self.label])
            squares -= FORM * float(gram.part[place, place])
        return gain_of(squares, gram.count_part if steady else gram.count)


@dataclass(frozen=True)
class Tried:
    """A motion with the log units by which it decides each question, with the recording."""

    motion: Motion
    gains: tuple[float, ...]

    def settles(self, wanted: float = WANTED) -> int:
        """Return how many questions it decides by the log units that must be predicted."""
        return sum(gain >= wanted for gain in self.gains)


@dataclass(frozen=True)
class Check:
    """A question put to simulated data: the recording's own motion and the proposed one.

    ``predicted`` and ``found`` in log units; ``values`` of B and beta_e as the right model finds
    them, (found, stddev, true).
    """

    effect: str
    rival: str
    predicted: float
    found: float
    values: dict[str, tuple[float, float, float]]


@dataclass(frozen=True)
class Advice:
    """What a recording separates, what it leaves open, and what to record next."""

    known: tuple[Known, ...]  # the fitted parameters
    plateaus: float  # share of the recording in which the speed is steady
    confusions: tuple[Confusion, ...]  # health parameters and effects that take one another's part
    detection_limits: tuple[DetectionLimit, ...]  # from which size on each effect shows
    groups: tuple[tuple[str, ...], ...]  # effects that show, but not which of them it is
    doubts: tuple[Doubt, ...]  # what is to be settled
    motion: Motion | None  # the cheapest that does; None where none does, or nothing is in doubt
    tried: tuple[Tried, ...]  # what was considered, with log units for each doubt
    checks: tuple[Check, ...]  # the proposed motion in simulation
    plannable: bool  # False where the config has too little to simulate a motion
    damping_unit: str = "N·s/m"
    said: tuple[str, ...] = ()  # what the balances advise, where they answer


def instead(experiment: Experiment, fit: Fit, effect: str, rival: Fit, name: str) -> Fit:
    """Return a fit with one named effect replaced by another, as a rival fit has it."""
    bare = without_effect(experiment, fit, effect)
    theta, active = bare.theta.copy(), bare.active.copy()
    active[NAMES.index(name)] = True
    for p in CATALOGUE[name].parameters:
        place = place_of(f"{name}.{p.name}")
        theta[place] = rival.theta[place]
    free = tuple(f for f in bare.free if not f.name.startswith(f"{name}."))
    own = tuple(f for f in rival.free if f.name.startswith(f"{name}."))
    return replace(bare, theta=theta, active=active, free=free + own, named=(*bare.named, name))


def entered_at(experiment: Experiment, traces: Traces, effect: str, name: str,
               base: Sequence[Slope]) -> Fit:
    """Return a fit with one named effect replaced by another, its sizes by linear regression.

    What both have, such as the way in which friction reverses, begins where the named one has
    it.
    """
    fit = traces.fit
    bare = without_effect(experiment, fit, effect)
    held, shapes = effect_values(fit.theta, effect), [
        p.name for p in CATALOGUE[effect].parameters if p.default is not None]
    start = continuing(starts_of(name, experiment)[0], {key: held[key] for key in shapes})
    origin, gone = (bare.theta, bare.active), f"{effect}|{name}|gone"
    own = [Slope(f"{effect}|{name}|size {i}", model, 1.0, 0.0, origin)
           for i, model in enumerate(directions_of(bare, start))]
    traces.add([Slope(gone, origin), *own])
    shared = [slope for slope in base if not slope.label.startswith(f"{effect}.")]
    labels = [slope.label for slope in [*shared, *own]]
    moved = traces.gram([gone, *labels]).absorbed(
        gone, labels, {slope.label: slope.weight for slope in shared})
    return with_effect(bare, start, tuple(-moved[slope.label] for slope in own))


def try_motions(experiment: Experiment, fit: Fit, questions: Sequence[Question], here: Gram,
                limits: Limits, base: Sequence[Slope], every: bool = True) -> list[Tried]:
    """Return motions with what they tell; two after one another where one does not do.

    ``here`` : what the recording says; a motion is judged together with it.
    ``every`` : try all motions, for the table; otherwise a few, until one will do.
    """
    slopes = [*base, *(slope for q in questions for slope in q.slopes())]
    labels = [slope.label for slope in slopes]
    tried, grams = [], []
    for motion in candidates(limits):
        if not every and motion.name not in USUAL:
            continue
        ran = planned(experiment, fit, limits, motion)
        if strained(experiment, ran):
            continue
        traces = Traces(ran, fit, slopes, True)
        if not traces.straight(base):
            continue
        there = traces.gram(labels)
        grams.append(there)
        gains = tuple(q.gain(here + there, base) for q in questions)
        tried.append(Tried(motion, gains))
        if min(gains) >= WANTED and not every:
            break
    if not tried:
        return []
    most = max(one.settles() for one in tried)
    if most < len(questions):
        pairs = ties.ordered(((tried[i].motion.duration + tried[j].motion.duration, i, j)
                              for i, j in combinations(range(len(tried)), 2)),
                             lambda row: -row[0])
        for duration, i, j in pairs:
            if duration > LONGEST:
                break
            if share_within(limits, joined(tried[i].motion, tried[j].motion).segments) < 1.0:
                continue  # the jump from one to the other is too far
            both = Tried(joined(tried[i].motion, tried[j].motion), tuple(
                q.gain(here + grams[i] + grams[j], base) for q in questions))
            if both.settles() > most:
                tried.append(both)
                most = both.settles()
    return tried


def cheapest(tried: Sequence[Tried], rejected: Sequence[str] = (), wanted: float = WANTED
             ) -> Motion | None:
    """Return the shortest of the motions that settle most questions; None where none does.

    Of motions that take as long the one with fewer segments, then the first of the candidates.

    ``wanted`` : log units that must be predicted.
    """
    left = [one for one in tried if one.motion.name not in rejected]
    most = max((one.settles(wanted) for one in left), default=0)
    if most == 0:
        return None
    return ties.best((one.motion for one in left if one.settles(wanted) == most),
                     lambda motion: -motion.duration, lambda motion: len(motion.segments))


def joined(first: Motion, second: Motion) -> Motion:
    """Return two motions, one after the other."""
    segments = dict(first.segments)
    for name, segment in second.segments.items():
        segments[name if name not in segments else f"{name}_2"] = segment
    return Motion(f"{first.name}_then_{second.name}", f"{first.words}, then {second.words}",
                  segments)


def checked(experiment: Experiment, fit: Fit, question: Question, motion: Motion,
            limits: Limits) -> Check:
    """Simulate a motion with the effect and noise, fit both models, and compare.

    The recording's own motion is simulated with it, where both are driven alike: the two are
    diagnosed together.
    """
    truth = question.truth
    there = planned(experiment, truth, limits, motion)
    both = there.only((*experiment.stretches, *there.stretches)
                      if experiment.mode == there.mode else there.stretches)
    data = simulated(both, truth)
    right = settled(data, with_unknowns(data, truth))
    wrong = settled(data, with_unknowns(data, question.other, right.unknowns))
    # What the recording itself lacks is not in the simulation: predicted for its conditions.
    like = replace(fit, gains=right.gains, s=right.s)
    base = free_slopes(like)
    slopes = [*base, *question.slopes()]
    gram = Traces(both, like, slopes).gram([slope.label for slope in slopes])
    values = {f.name: (right.value(f.name), right.stddev(f.name), float(truth.theta[f.place]))
              for f in right.free if f.name in ("B", "beta_e")}
    return Check(question.effect, question.rival, question.gain(gram, base, steady=False),
                 right.log_likelihood - wrong.log_likelihood, values)
