"""What a recording can identify: confusions, detection limits, groups that look alike."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.mismatch.likelihood.information import LEAST_STEADY, Gram, Slope, gain_of
from eha_monitor.mismatch.name.starts import (
    Start,
    directions_of,
    own_sizes,
    possible,
    starts_of,
    without_effect,
)
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of

MATTERS = 5.0  # times an effect's start, which is 1 % of what its balance does
SHIFT = 0.05  # of B or beta_e: an effect that shifts them by so much matters
LEAST = 10.0  # log units from which on an effect shows
CONFUSED = 0.9  # correlation from which on two things are listed as confused
HOPELESS = 0.99  # correlation on the plateaus from which on they say nothing
LARGEST_INFLATION = 1e6
BASE = ("B", "beta_e")


@dataclass(frozen=True)
class Direction:
    """One size of one effect and its trace."""

    effect: str  # of the catalogue
    parameter: str
    unit: str
    amount: float  # value of the size at which the trace was taken, SI
    label: str  # its row in the Gram
    start: Start  # that it comes from


@dataclass(frozen=True)
class Known:
    """A fitted parameter: value, standard deviation, and with what it is confused most.

    ``inflation`` : by how much the others increase its variance; ``correlation`` with
    ``most_with``, the parameter that it is most correlated with.
    """

    name: str
    value: float
    stddev: float
    unit: str
    inflation: float
    correlation: float
    most_with: str


@dataclass(frozen=True)
class Confusion:
    """A health parameter and an effect that take one another's part.

    Attributes
    ----------
    parameter : ``B`` or ``beta_e``; ``effect`` and its size ``symbol``, in ``unit``.
    correlation, inflation : of the two estimates, over the whole recording.
    plateau_correlation, plateau_inflation : over the plateaus of speed alone; NaN without any.
    amount : of the effect (SI), that found here or one that matters.
    shift : by how much the parameter is off when that amount is left out (SI);
        ``plateau_shift`` from the plateaus alone.
    named : the fit has the effect, with that amount.
    """

    parameter: str
    effect: str
    symbol: str
    unit: str
    correlation: float
    inflation: float
    plateau_correlation: float
    plateau_inflation: float
    amount: float
    shift: float
    plateau_shift: float
    named: bool


@dataclass(frozen=True)
class DetectionLimit:
    """From which size on an effect shows in this recording.

    ``matters`` : size that would matter; ``visible`` : size that gains ``LEAST`` log units; both
    in ``unit``.  ``gain`` in log units at ``matters``.  ``shifts`` : relative change of B and
    beta_e by a just visible one that is left out.
    """

    effect: str
    symbol: str
    unit: str
    matters: float
    visible: float
    gain: float
    shifts: dict[str, float]


def effects_for(experiment: Experiment, fit: Fit, names: Sequence[str] = NAMES) -> list[str]:
    """Return effects that may be there beside those of a fit, the simplest of each kind."""
    families = {member for name in fit.named for member in (name, *CATALOGUE[name].contains)}
    return [name for name in names
            if not CATALOGUE[name].contains and name not in families
            and not experiment.active[NAMES.index(name)] and possible(name, experiment)]


def directions_for(experiment: Experiment, fit: Fit, names: Sequence[str]
                   ) -> tuple[list[Direction], list[Slope]]:
    """Return the sizes of effects with their slopes, all starts of each."""
    found, slopes = [], []
    for name in names:
        for number, start in enumerate(starts_of(name, experiment)):
            sizes = [p for p in own_sizes(start) if np.isfinite(p.neutral)]
            if len(sizes) != len(own_sizes(start)) or not sizes:
                continue  # a limit, or a shape only: its trace is not in proportion to a size
            for p, model in zip(sizes, directions_of(fit, start), strict=True):
                label = f"{name}#{number}.{p.name}"
                found.append(Direction(name, p.name, p.unit, dict(start.values)[p.name], label,
                                       start))
                slopes.append(Slope(label, model))
    return found, slopes


def best_starts(directions: Sequence[Direction], gram: Gram) -> list[Direction]:
    """Return of each effect the start that shows most, all its sizes."""
    chosen = []
    for name in dict.fromkeys(d.effect for d in directions):
        groups: dict[Start, list[Direction]] = {}
        for d in directions:
            if d.effect == name:
                groups.setdefault(d.start, []).append(d)
        chosen += ties.best(groups.values(), lambda group: max(
            gram.whole[i, i] for i in gram.places([d.label for d in group])))
    return chosen


class Reading:
    """A Gram of one recording at one fit, read in words that people use.

    Parameters
    ----------
    base : slopes of the fit's free parameters.
    directions : effects beside them; ``found`` those that the fit has.
    """

    def __init__(self, fit: Fit, gram: Gram, base: Sequence[Slope],
                 directions: Sequence[Direction], found: Sequence[Direction] = ()):
        self.fit, self.gram, self.found = fit, gram, list(found)
        self.directions = best_starts(directions, gram)
        self.weights = {slope.label: slope.weight for slope in base}
        self.labels = [slope.label for slope in base]
        self.health = [parameter for parameter in BASE if parameter in self.labels]
        self.plateaus = gram.count_part / max(gram.count, 1)
        self.has_plateaus = self.plateaus >= LEAST_STEADY

    def known(self, units: dict[str, str]) -> tuple[Known, ...]:
        """Return the fitted parameters with standard deviations and variance inflation."""
        covariance = self.fit.covariance
        sigma = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        correlation = covariance / np.outer(sigma, sigma) - np.eye(len(sigma))
        found = []
        for i, f in enumerate(self.fit.free):
            if f.name not in self.labels:
                continue
            others = [label for label in self.labels if label != f.name]
            alone = self.gram.remaining([f.name], (), {})[0, 0] + self.weights[f.name]
            left = (self.gram.remaining([f.name], others, self.weights)[0, 0]
                    + self.weights[f.name])
            j = ties.largest(np.abs(correlation[i])) if len(sigma) > 1 else i
            found.append(Known(f.name, self.fit.value(f.name), self.fit.stddev(f.name),
                               units.get(f.name, "1"), inflation(alone, left),
                               float(correlation[i, j]), self.fit.free[j].name if j != i else ""))
        return tuple(found)

    def shift(self, d: Direction, parameter: str, amount: float, steady: bool = False) -> float:
        """Return by how much a parameter is off when an amount of an effect is left out, SI."""
        own = [label for label in self.labels if not label.startswith(f"{d.effect}.")]
        moved = self.gram.absorbed(d.label, own, self.weights, steady)[parameter] * (
            amount / d.amount)
        f = next(f for f in self.fit.free if f.name == parameter)
        return moved * self.fit.value(parameter) if f.log else moved

    def matters(self, d: Direction, steady: bool = False) -> float:
        """Return the size of an effect that matters: by itself, or to B or beta_e."""
        size = MATTERS * abs(d.amount)
        for parameter in self.health:
            one = abs(self.shift(d, parameter, d.amount, steady))
            if one > 0:
                size = min(size, SHIFT * abs(self.fit.value(parameter)) / one * abs(d.amount))
        return size

    def confusions(self) -> tuple[Confusion, ...]:
        """Return pairs of a health parameter and an effect that take one another's part."""
        every = (self.confusion(d, parameter, MATTERS * abs(d.amount))
                 for d in self.directions for parameter in self.health)
        found = ties.ordered(filter(None, every), lambda c: abs(c.correlation))
        return tuple(sorted(found, key=lambda c: CATALOGUE[c.effect].rarity))

    def confusion(self, d: Direction, parameter: str, amount: float, named: bool = False
                  ) -> Confusion | None:
        """Return how an effect and a parameter are confused; None where they are not."""
        others = [label for label in self.labels
                  if label != parameter and not label.startswith(f"{d.effect}.")]
        whole = self.correlation(d.label, parameter, others)
        part = (self.correlation(d.label, parameter, others, True) if self.has_plateaus
                else np.nan)
        shift = self.shift(d, parameter, amount)
        part_shift = self.shift(d, parameter, amount, True) if self.has_plateaus else np.nan
        noticeable = SHIFT * abs(self.fit.value(parameter))
        confused = (abs(whole) > CONFUSED and abs(shift) > noticeable) or (
            abs(part) > HOPELESS and abs(part_shift) > noticeable)
        if not confused:
            return None
        return Confusion(parameter, d.effect, d.parameter, d.unit, whole,
                         inflation(1.0, 1.0 - whole**2), part, inflation(1.0, 1.0 - part**2),
                         amount, shift, part_shift, named)

    def correlation(self, one: str, two: str, others: Sequence[str], steady: bool = False
                    ) -> float:
        """Return the correlation of two estimates, all others estimated as well."""
        left = self.gram.remaining([one, two], others, self.weights, steady)
        full = self.gram.part if steady else self.gram.whole
        # What does not show at all is a blind spot, no confusion; nor is what the prior says.
        if left[0, 0] * MATTERS**2 < 1.0 or left[1, 1] < self.weights[two]:
            return 0.0
        for i, place in enumerate(self.gram.places([one, two])):
            if left[i, i] <= 1e-9 * full[place, place]:
                return 0.0
        return float(np.clip(-left[0, 1] / np.sqrt(left[0, 0] * left[1, 1]), -1.0, 1.0))

    def detection_limits(self) -> tuple[DetectionLimit, ...]:
        """Return from which size on each effect shows, the worst first."""
        found = []
        for d in self.directions:
            left = float(self.gram.remaining([d.label], self.labels, self.weights)[0, 0])
            # From LEAST = N/2 log(1 + a^2 left / N) follows the amplitude a.
            n = max(self.gram.count, 1)
            wanted = n * np.expm1(2.0 * LEAST / n)
            visible = float(np.sqrt(wanted / left)) * abs(d.amount) if left > 0 else np.inf
            size = self.matters(d)
            gain = gain_of(left * (size / d.amount) ** 2, n)
            shifts = {parameter: self.shift(d, parameter, visible) / self.fit.value(parameter)
                      for parameter in self.health} if np.isfinite(visible) else {}
            found.append(DetectionLimit(
                d.effect, d.parameter, d.unit, size, visible, gain, shifts))
        return tuple(ties.ordered(found, lambda limit: -limit.gain))

    def groups(self) -> tuple[tuple[str, ...], ...]:
        """Return effects that show at sizes that matter, but not which of them it is."""
        sizes: dict[str, list[str]] = {}
        for d in self.directions:
            sizes.setdefault(d.effect, []).append(d.label)
        limits = self.detection_limits()
        blind = {one.effect for one in limits if one.gain < LEAST}
        names = [name for name in sizes if name not in blind]
        labels = [label for name in names for label in sizes[name]]
        if len(names) < 2:
            return ()
        left = self.gram.remaining(labels, self.labels, self.weights)
        at = {label: i for i, label in enumerate(labels)}
        gain = {name: max(one.gain for one in limits if one.effect == name) for name in names}

        def alike(a: str, b: str) -> bool:
            i, j = [at[k] for k in sizes[a]], [at[k] for k in sizes[b]]
            cosine = largest_cosine(left[np.ix_(i, i)], left[np.ix_(i, j)], left[np.ix_(j, j)])
            return min(gain[a], gain[b]) * (1.0 - cosine**2) < LEAST

        groups: list[list[str]] = []
        for name in sorted(ties.ordered(names, lambda name: gain[name]),
                           key=lambda name: CATALOGUE[name].rarity):
            home = next((g for g in groups if all(alike(name, other) for other in g)), None)
            if home is None:
                groups.append([name])
            else:
                home.append(name)
        return tuple(tuple(group) for group in groups if len(group) > 1)


def inflation(alone: float, left: float) -> float:
    """Return a variance inflation, at most ``LARGEST_INFLATION``."""
    if np.isnan(left):
        return np.nan
    return float(min(alone / max(left, alone / LARGEST_INFLATION), LARGEST_INFLATION))


def largest_cosine(aa: np.ndarray, ab: np.ndarray, bb: np.ndarray) -> float:
    """Return the cosine of the smallest angle between two spaces, from their products."""
    def root(matrix):
        values, vectors = np.linalg.eigh(matrix)
        keep = values > 1e-9 * max(values.max(), 1e-300)
        return vectors[:, keep] / np.sqrt(values[keep])

    a, b = root(aa), root(bb)
    if not a.size or not b.size:
        return 0.0
    return float(min(np.linalg.norm(a.T @ ab @ b, 2), 1.0))


def named_directions(experiment: Experiment, fit: Fit) -> tuple[list[Direction], list[Slope]]:
    """Return the named effects' first sizes, as found, with the slopes of taking them out."""
    found, slopes = [], []
    for name in fit.named:
        p = CATALOGUE[name].sizes[0]
        value = float(fit.theta[place_of(f"{name}.{p.name}")])
        if not np.isfinite(p.neutral) or value == p.neutral:
            continue
        bare = without_effect(experiment, fit, name)
        label = f"{name}#found.{p.name}"
        start = replace(starts_of(name, experiment)[0], values=((p.name, value),))
        found.append(Direction(name, p.name, p.unit, value, label, start))
        slopes.append(Slope(label, (fit.theta, fit.active), 1.0, 0.0, (bare.theta, bare.active)))
    return found, slopes
