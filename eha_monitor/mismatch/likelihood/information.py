"""What a recording, or a planned motion, determines: whitened slopes and their products.

At a fitted model the log likelihood falls by |d|^2 / 2 when something moves the whitened
innovations by d and nothing else moves with it.  What parameters can absorb is projected out.
All that takes is the products of the slopes with one another (a Gram matrix); those of two
recordings add up, so a second motion is judged together with what is there already.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eha_monitor.mismatch.data.experiment import SMOOTH, Experiment
from eha_monitor.mismatch.likelihood.fit import (
    Fit,
    free_run,
    innovations,
    spread,
    step_of,
    whitener,
)

STEADY_SPAN = 0.05  # s to either side in which a plateau's speed hardly changes
STEADY_CHANGE = 0.01  # of the record's largest speed
SLIDING = 0.2  # of the largest speed: slower is near a reversal
STRAIGHT = 0.3  # of the innovations' size: further from the sum of slopes they are no slopes
LEAST_STEADY = 0.3  # share of a record from which on it has plateaus to speak of

Model = tuple[np.ndarray, np.ndarray]  # theta, active


@dataclass(frozen=True)
class Slope:
    """A move of the model whose trace in the innovations is wanted."""

    label: str  # its name in a :class:`Gram`
    model: Model  # theta and active effects after the move
    step: float = 1.0  # length of the move; the trace is divided by it
    weight: float = 0.0  # of the prior on it, per unit of the move squared
    origin: Model | None = None  # before the move; None: at the fit


@dataclass(frozen=True)
class Gram:
    """Products of whitened slopes, (m, m), over all samples and over some."""

    labels: tuple[str, ...]  # names of the rows
    whole: np.ndarray  # over all counted samples
    part: np.ndarray  # over plateaus, or away from reversals
    count: int  # counted samples
    count_part: int  # those of ``part``

    def __add__(self, other: "Gram") -> "Gram":
        """Return what two recordings tell together; their rows are the same."""
        if self.labels != other.labels:
            raise ValueError("expected the same slopes")
        return Gram(self.labels, self.whole + other.whole, self.part + other.part,
                    self.count + other.count, self.count_part + other.count_part)

    def places(self, labels: Sequence[str]) -> list[int]:
        """Return the rows of some labels."""
        return [self.labels.index(label) for label in labels]

    def remaining(self, wanted: Sequence[str], absorbing: Sequence[str],
                  weights: dict[str, float], steady: bool = False) -> np.ndarray:
        """Return the products of ``wanted`` with the ``absorbing`` slopes projected out.

        ``weights`` : prior weights of the absorbing slopes; a prior limits what they absorb.
        ``steady`` : over the part, not the whole.
        """
        g = self.part if steady else self.whole
        i, j = self.places(wanted), self.places(absorbing)
        if not j:
            return g[np.ix_(i, i)]
        inner, scale = scaled(g[np.ix_(j, j)], absorbing, weights)
        cross = g[np.ix_(j, i)] / scale[:, None]
        left = g[np.ix_(i, i)] - cross.T @ np.linalg.solve(inner, cross)
        return 0.5 * (left + left.T)

    def absorbed(self, moved: str, absorbing: Sequence[str], weights: dict[str, float],
                 steady: bool = False) -> dict[str, float]:
        """Return by how much each absorbing slope moves when ``moved`` is there and left out."""
        g = self.part if steady else self.whole
        (i,), j = self.places([moved]), self.places(absorbing)
        inner, scale = scaled(g[np.ix_(j, j)], absorbing, weights)
        found = np.linalg.solve(inner, g[j, i] / scale) / scale
        return dict(zip(absorbing, map(float, found), strict=True))


def scaled(inner: np.ndarray, labels: Sequence[str], weights: dict[str, float]
           ) -> tuple[np.ndarray, np.ndarray]:
    """Return products of slopes and their priors in units of their roots, and these, (k,)."""
    inner = inner + np.diag([weights.get(label, 0.0) for label in labels])
    scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    return inner / np.outer(scale, scale) + 1e-13 * np.eye(len(scale)), scale


def gain_of(squares: float, count: int) -> float:
    """Return log units for a remaining sum of squares: the likelihood's S is estimated too."""
    return 0.5 * count * float(np.log1p(max(squares, 0.0) / max(count, 1)))


def free_slopes(fit: Fit, model: Model | None = None, names: Sequence[str] = ()) -> list[Slope]:
    """Return the slopes of a fit's free parameters, in their fitted coordinates.

    Those of a rival that stand at a bound are held there.

    ``model`` : where they are taken, where that is another than the fit.
    ``names`` : labels that they get.
    """
    theta, active = model or (fit.theta, fit.active)
    found = []
    for i, f in enumerate(fit.free):
        other, step = step_of(f, theta, SMOOTH)
        if model is not None and min(abs(theta[f.place] - f.lower), abs(
                theta[f.place] - f.upper)) <= 1e-6 * abs(theta[f.place]):
            continue
        found.append(Slope(names[i] if names else f.name, (other, active), step, f.spread**-2.0,
                           None if model is None else model))
    return found


class Traces:
    """Whitened traces of slopes in the innovations of one experiment.

    Parameters
    ----------
    fit : gives gains and the innovations' covariance; slopes without origin start at it.
    planned : a motion that is only simulated: its part is what is away from reversals; that of
        a recording is its plateaus.
    """

    def __init__(self, experiment: Experiment, fit: Fit, slopes: Sequence[Slope],
                 planned: bool = False):
        self.experiment, self.fit = experiment, fit
        self.part = sliding(experiment) if planned else steady(experiment, fit)
        self.runs: list[tuple[Model, np.ndarray]] = []
        self.rows: dict[str, np.ndarray] = {}
        self.w = whitener(fit.s)
        self.add(slopes)

    def add(self, slopes: Sequence[Slope]) -> None:
        """Run the filter for slopes that are not there yet."""
        slopes = [slope for slope in slopes if slope.label not in self.rows]
        here = (self.fit.theta, self.fit.active)
        wanted = [here, *(model for slope in slopes for model in (slope.model, slope.origin)
                          if model is not None)]
        new: list[Model] = []
        for model in wanted:
            if self.run(model) is None and not any(model[0] is other[0] for other in new):
                new.append(model)
        found = spread(lambda m: np.nan_to_num(innovations(self.experiment, *m, self.fit.gains)),
                       new)
        self.runs += zip(new, found, strict=True)
        for slope in slopes:
            d = self.run(slope.model) - self.run(slope.origin or here)
            # Not by @: BLAS would start threads for it that wait for one another.
            d = np.stack([sum(w * d[:, j] for j, w in enumerate(row) if w) for row in self.w],
                         axis=1) / slope.step
            good = np.isfinite(d).all() and np.abs(d).max() < 1e9
            self.rows[slope.label] = d if good else np.zeros_like(d)
        self.runs = self.runs[:1]

    def run(self, model: Model) -> np.ndarray | None:
        """Return the innovations of a model, None where it was not run."""
        return next((e for known, e in self.runs if known[0] is model[0]), None)

    def straight(self, slopes: Sequence[Slope]) -> bool:
        """Tell whether half a step along all slopes at once leads where half of each would.

        Friction that reverses within an integration step magnifies the last bit of a sum by many
        powers of ten: what is then divided by a step is no slope, and predicts nothing.

        ``slopes`` : of the fit's parameters, at the fit.
        """
        theta = self.fit.theta + 0.5 * sum(slope.model[0] - self.fit.theta for slope in slopes)
        half = Slope("half of all", (theta, self.fit.active))
        self.add([half])
        wanted = 0.5 * sum(slope.step * self.rows[slope.label] for slope in slopes)
        missed = self.rows[half.label] - wanted
        return bool(np.sum(missed**2) <= STRAIGHT**2 * np.sum(wanted**2))

    def gram(self, labels: Sequence[str]) -> Gram:
        """Return the products of some traces."""
        d = [self.rows[label] for label in labels]
        few = [row[self.part] for row in d]
        return Gram(tuple(labels), products(d), products(few), len(self.part),
                    int(self.part.sum()))


def products(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Return the products of traces with one another, (m, m)."""
    found = np.zeros((len(rows), len(rows)))
    for i, a in enumerate(rows):
        for j, b in enumerate(rows[:i + 1]):
            found[i, j] = found[j, i] = np.einsum("nc,nc->", a, b)
    return found


def steady(experiment: Experiment, fit: Fit) -> np.ndarray:
    """Tell which counted samples lie on plateaus of the speed, (N,) bool."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    span = 2 * max(1, round(STEADY_SPAN / experiment.dt)) + 1
    found = [np.gradient(free_run(experiment, stretch, fit)[:, 0], experiment.dt)
             for stretch in experiment.stretches]  # speeds of the model, running free
    largest = max((float(np.quantile(np.abs(v), 0.99)) for v in found), default=0.0)
    return experiment.counted([maximum_filter1d(v, span) - minimum_filter1d(v, span)
                               < STEADY_CHANGE * largest for v in found])


def sliding(experiment: Experiment) -> np.ndarray:
    """Tell which counted samples lie away from reversals, (N,) bool."""
    found = []
    for stretch in experiment.stretches:
        v = np.abs(np.gradient(stretch.z[:, 0], experiment.dt))  # planned: there is no noise on it
        found.append(v > SLIDING * max(float(np.quantile(v, 0.99)), 1e-12))
    return experiment.counted(found)
