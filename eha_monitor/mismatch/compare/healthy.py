"""What healthy recordings have in common, and by how much they differ from run to run."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from eha_monitor.errors import InputError
from eha_monitor.mismatch.compare.runs import Run, of_parts, run_of
from eha_monitor.mismatch.data.experiment import Experiment, experiment_of
from eha_monitor.mismatch.data.stretch import cut
from eha_monitor.mismatch.likelihood.fit import Fit, spread, with_unknowns
from eha_monitor.mismatch.name.naming import Naming, name_effects
from eha_monitor.mismatch.name.telling import telling
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

FEWEST = 4  # recordings that tell how runs differ; fewer are cut in pieces
PIECES = 8  # that they are cut in then, together
SHORTEST_S = 1.0  # of a piece
FALSE = 0.01  # of healthy recordings that may be called changed
KINDS = 2  # what has a name, and unknown functions: each has half of that


@dataclass(frozen=True)
class Healthy:
    """A healthy machine.

    Attributes
    ----------
    experiment : of all references; ``naming`` what was named on them; ``fit`` the model.
    scales : (c,) of the balances, see :func:`run_of`.
    runs : what each reference says.
    kept : (k,) places of the numbers that every run answers to.
    mean, spread : (k,) of their amplitudes over the runs.
    limit : (k,) of Student's t, so that ``FALSE`` of the healthy runs go beyond any.
    pieces : the runs are pieces of so few recordings that runs cannot be compared.
    """

    experiment: Experiment
    naming: Naming
    fit: Fit
    scales: np.ndarray
    runs: tuple[Run, ...]
    kept: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    limit: np.ndarray
    pieces: bool

    def t_of(self, amplitudes: np.ndarray) -> np.ndarray:
        """Return Student's t of amplitudes (m,) of another run, (k,): n - 1 degrees of freedom.

        One new run differs from the mean of n by a standard deviation of sqrt(1 + 1/n) spreads.
        """
        n = len(self.runs)
        return (amplitudes[self.kept] - self.mean) / (self.spread * np.sqrt(1.0 + 1.0 / n))

    def odd_ones(self) -> list[int]:
        """Return references that differ from all the others as no healthy run should."""
        rows = np.array([run.amplitudes[self.kept] for run in self.runs])
        found = []
        for i in range(len(rows)) if len(rows) > 3 else ():
            others = np.delete(rows, i, axis=0)
            n = len(others)
            t = (rows[i] - others.mean(axis=0)) / (
                others.std(axis=0, ddof=1) * np.sqrt(1.0 + 1.0 / n))
            if (np.abs(t) > self.limit).any():
                found.append(i)
        return found


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
                  for first, last in zip(bounds, bounds[1:], strict=False)]
    short = min(one.n * one.dt for one in found)
    if short < SHORTEST_S:
        raise InputError(
            f"{experiments[0].stretches[0].source}: expected at least {FEWEST} reference "
            f"recordings, or {PIECES * SHORTEST_S:g} s of them without a gap to cut in pieces")
    return found, True


def healthy_of(references: list[Recording], settings: Settings) -> Healthy:
    """Learn what healthy recordings have in common, and how they differ.

    Raises
    ------
    InputError
        If there are too few to tell how healthy runs differ, or they do not move.
    """
    joint = experiment_of(references, settings, hold_out=False)
    naming = name_effects(telling(joint))
    joint = replace(naming.experiment, stretches=joint.stretches)
    parts, pieces = runs_in([joint.only(tuple(
        stretch for stretch in joint.stretches if stretch.source == recording.source))
        for recording in references])
    fit = with_unknowns(joint, naming.after, naming.after.unknowns)
    scales = np.sqrt(np.nanmean(fit.e**2, axis=0))
    runs = tuple(spread(lambda one: run_of(one, fit, scales), of_parts(joint, parts)))
    return healthy_from(joint, naming, fit, scales, alike(runs), pieces)


def alike(runs: tuple[Run, ...]) -> tuple[Run, ...]:
    """Return runs with the numbers that all of them have, in one order."""
    common = set.intersection(*(set(run.keys) for run in runs))
    found = []
    for run in runs:
        places = [i for i, key in enumerate(run.keys) if key in common]
        rows = np.array([0, *(1 + i for i in places)])
        found.append(replace(run, what=tuple(run.what[i] for i in places),
                             products=run.products[np.ix_(rows, rows)]))
    return tuple(found)


def healthy_from(joint: Experiment, naming: Naming, fit: Fit, scales: np.ndarray,
                 runs: tuple[Run, ...], pieces: bool) -> Healthy:
    """Return what runs have in common."""
    rows = np.array([run.amplitudes for run in runs])
    with np.errstate(invalid="ignore"):
        deviation = rows.std(axis=0, ddof=1)
    kept = np.flatnonzero(np.isfinite(rows).all(axis=0) & (deviation > 0.0))
    what = runs[0].what
    products = sum(run.products for run in runs)[1:, 1:]
    limit = np.zeros(len(kept))
    named = np.array([what[i].owner in CATALOGUE or what[i].free is not None for i in kept])
    for kind in (named, ~named):
        if kind.any():
            limit[kind] = limit_of(products[np.ix_(kept[kind], kept[kind])], len(runs))
    return Healthy(joint, naming, fit, scales, runs, kept, rows[:, kept].mean(axis=0),
                   deviation[kept], limit, pieces)


def limit_of(products: np.ndarray, runs: int) -> float:
    """Return the |t| beyond which one of several numbers goes in a share of ``FALSE / KINDS``.

    Numbers that move the same innovations are one: their effective count is that of the
    eigenvalues of their correlations, (sum l)^2 / sum l^2.
    """
    scale = np.sqrt(np.diag(products))
    eigen = np.linalg.eigvalsh(products / np.outer(scale, scale))
    count = eigen.sum() ** 2 / (eigen**2).sum()
    return float(-stdtrit(runs - 1, 0.5 * FALSE / KINDS / count))
