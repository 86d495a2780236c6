"""What healthy recordings have in common, and by how much they differ from run to run."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.special import stdtrit

from eha_monitor.balances.policy import POLICY
from eha_monitor.errors import InputError
from eha_monitor.mismatch.compare.runs import Own, Reading, Run, posterior_of, reading_of, run_of
from eha_monitor.mismatch.data.experiment import Experiment, experiment_of
from eha_monitor.mismatch.data.stretch import cut
from eha_monitor.mismatch.likelihood.fit import Fit, spread, with_unknowns
from eha_monitor.mismatch.name.before import informative
from eha_monitor.mismatch.name.naming import Naming, name_effects
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

FEWEST = 4  # recordings that tell how runs differ; fewer are cut in pieces
PIECES = 8  # that they are cut in then, together
SHORTEST_S = 1.0  # of a piece
ANSWERS = 0.01  # of the usual power: a run that answers less says nothing of a number
ROUNDS, LEAST = 200, 1e-12  # of expectation and maximisation; variance that stays
FALSE = POLICY.false  # of healthy recordings that may be called changed


@dataclass(frozen=True)
class Healthy:
    """A healthy machine.

    Attributes
    ----------
    experiment : of all references; ``naming`` what was named on them; ``fit`` the model.
    runs : what each reference says; ``own`` the model's own numbers over them, ``readings`` what
        each says beside these.
    kept : (k,) places of the numbers that every run answers to.
    mean, spread : (k,) of their amplitudes over the runs; ``power`` (k,) as it usually is there.
    count : how many different numbers these are.
    pieces : the runs are pieces of so few recordings that runs cannot be compared.
    """

    experiment: Experiment
    naming: Naming
    fit: Fit
    runs: tuple[Run, ...]
    own: Own
    readings: tuple[Reading, ...]
    kept: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    power: np.ndarray
    count: float
    pieces: bool

    def read(self, experiment: Experiment, fit: Fit, changed: tuple[int, ...] = ()) -> Reading:
        """Return what a recording says of a model beside the own numbers, from their mean.

        Parameters
        ----------
        changed : places of numbers that stay where the recording has them.
        """
        own = self.own
        stay = np.isin(own.places, changed)
        own = replace(own, mean=np.where(stay, 0.0, own.mean - own.away(fit.theta, self.fit)),
                      variance=np.where(stay, 1.0, own.variance))
        return reading_of(run_of(experiment, fit).ordered(self.runs[0].what), own)

    def t_of(self, amplitudes: np.ndarray, power: np.ndarray) -> np.ndarray:
        """Return Student's t of a new run's amplitudes, (k,): n - 1 degrees of freedom.

        One new run differs from the mean of n by a standard deviation of sqrt(1 + 1/n) spreads;
        NaN where it does not answer to a number.

        Parameters
        ----------
        amplitudes, power : (m,) see :class:`Reading`.
        """
        n = len(self.runs)
        return weight_of(power[self.kept], self.power) * (
            amplitudes[self.kept] - self.mean) / (self.spread * np.sqrt(1.0 + 1.0 / n))

    def usual(self) -> Fit:
        """Return the model with its own numbers at the mean of the healthy runs."""
        theta = self.fit.theta.copy()
        for f, mean in zip(self.own.free, self.own.mean, strict=True):
            theta[f.place] = f.outward(f.inward(theta[f.place]) + mean * f.spread)
        return replace(self.fit, theta=theta)

    @property
    def limit(self) -> float:
        """Student's t so that a share ``FALSE`` of healthy runs goes beyond it in any number."""
        return limit_of(len(self.runs), self.count)

    @cached_property
    def own_t(self) -> np.ndarray:
        """Student's t of each reference against all the others, (n, k)."""
        found = []
        for i, one in enumerate(self.readings):
            others = [reading for j, reading in enumerate(self.readings) if j != i]
            mean, spread, power = scatter(others, self.kept)
            rest = replace(self, runs=self.runs[:i] + self.runs[i + 1 :], mean=mean,
                           spread=spread, power=power)
            found.append(rest.t_of(one.amplitudes, one.power))
        return np.array(found)

    @cached_property
    def limits(self) -> np.ndarray:
        """How far each number may be, (k,) of t: what a healthy run did once, one may do again."""
        widest = np.nanmax(np.abs(self.own_t), axis=0)
        return np.maximum(widest, self.limit) if len(self.runs) > FEWEST else np.full(
            len(self.kept), self.limit)

    def odd_ones(self) -> list[int]:
        """Return references that differ from all the others as no healthy run should."""
        limit = limit_of(len(self.runs) - 1, self.count, FALSE / len(self.runs))
        return np.flatnonzero((np.abs(self.own_t) > limit).any(axis=1)).tolist()


def weight_of(power: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """Return the weights of amplitudes: a run that answers less determines them less well."""
    return np.sqrt(np.minimum(power / usual, 1.0))


def scatter(readings: Sequence[Reading], kept: np.ndarray
            ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean and spread of the runs' amplitudes, and their usual power, (k,) each."""
    rows = np.array([one.amplitudes[kept] for one in readings])
    powers = np.array([one.power[kept] for one in readings])
    usual = np.median(powers, axis=0)
    weights = weight_of(powers, usual) ** 2
    mean = (weights * rows).sum(axis=0) / weights.sum(axis=0)
    spread = np.sqrt((weights * (rows - mean) ** 2).sum(axis=0) / (len(readings) - 1))
    return mean, spread, usual


def runs_in(experiments: list[Experiment]) -> tuple[list[Experiment], bool]:
    """Return the runs of references, and whether they are pieces of too few."""
    if len(experiments) >= FEWEST:
        return experiments, False
    total = sum(one.n for one in experiments)
    found = []
    for one in experiments:
        longest = max(one.stretches, key=len)
        count = max(round(PIECES * one.n / total), 1)
        bounds = np.linspace(0, len(longest), count + 1).astype(int)
        found += [one.only((cut(longest, int(first), int(last), one.dt),))
                  for first, last in pairwise(bounds)]
    short = min(one.n * one.dt for one in found)
    if short < SHORTEST_S:
        raise InputError(
            f"{experiments[0].stretches[0].source}: expected at least {FEWEST} reference "
            f"recordings, or {PIECES * SHORTEST_S:g} s of them without a gap to cut in pieces")
    return found, True


def healthy_of(references: list[Recording], settings: Settings) -> Healthy:
    """Learn what healthy recordings have in common, and how they differ.

    The model is named on the longest of them; by how much the others differ from it is what the
    machine's own spread is.

    Raises
    ------
    InputError
        If there are too few to tell how healthy runs differ, or they do not move.
    """
    joint = experiment_of(references, settings, hold_out=False, each=True)
    parts = [joint.only(tuple(stretch for stretch in joint.stretches
                              if stretch.source == recording.source))
             for recording in references]
    naming = name_effects(informative(max(parts, key=lambda one: one.n)))
    joint = replace(naming.experiment, stretches=joint.stretches)
    fit = with_unknowns(joint, naming.after)
    parts, pieces = runs_in(parts)
    runs = spread(lambda one: run_of(joint.only(one.stretches), fit), parts)
    runs = tuple(run.ordered(runs[0].what) for run in runs)
    own = own_over(runs)
    readings = tuple(reading_of(run, own) for run in runs)
    rows, powers = (np.array([getattr(one, name) for one in readings])
                    for name in ("amplitudes", "power"))
    kept = np.flatnonzero(np.isfinite(rows).all(axis=0) & (np.ptp(rows, axis=0) > 0.0)
                          & (powers.min(axis=0) > ANSWERS * np.median(powers, axis=0)))
    return Healthy(joint, naming, fit, runs, own, readings, kept,
                   *scatter(readings, kept), count_of(runs, kept), pieces)


def own_over(runs: tuple[Run, ...]) -> Own:
    """Return how the model's own numbers vary over the runs: expectation and maximisation.

    Each run's are a ~ N(m, s^2), which the run's products G and sides g determine (Dempster, Laird
    and Rubin 1977; Laird and Ware 1982):

        V = (G + s^-2)^-1,  a = V (m s^-2 - g);    m = mean a,  s^2 = mean V + (a - m)^2
    """
    places = np.flatnonzero([column.variant < 0 and column.free is not None
                             for column in runs[0].what])
    rows = [np.ix_(1 + places, 1 + places) for _ in runs]
    grams = [run.products[at] for run, at in zip(runs, rows, strict=True)]
    sides = [run.products[0, 1 + places] for run in runs]
    mean, variance = np.zeros(len(places)), np.ones(len(places))
    for _ in range(ROUNDS):
        inner, of_data = zip(*(posterior_of(gram, variance) for gram in grams), strict=True)
        found = np.array([v @ (mean / variance) - w @ side
                          for v, w, side in zip(inner, of_data, sides, strict=True)])
        mean = found.mean(axis=0)
        variance = np.maximum(np.mean([np.diag(v) for v in inner], axis=0)
                              + found.var(axis=0), LEAST)
    return Own(places, mean, variance, tuple(runs[0].what[i].free for i in places))


def count_of(runs: tuple[Run, ...], kept: np.ndarray) -> float:
    """Return how many of the numbers are different ones.

    Numbers that move the same innovations are one: their effective count is that of the
    eigenvalues of their correlations, (sum l)^2 / sum l^2.
    """
    rows = 1 + kept
    products = sum(run.products for run in runs)[np.ix_(rows, rows)]
    scale = np.sqrt(np.diag(products))
    eigen = np.linalg.eigvalsh(products / np.outer(scale, scale))
    return float(eigen.sum() ** 2 / (eigen**2).sum())


def limit_of(runs: int, count: float, share: float = FALSE) -> float:
    """Return the |t| beyond which one of ``count`` numbers goes in a share of healthy runs."""
    return float(-stdtrit(runs - 1, 0.5 * share / count))
