"""What a recording, or a motion that is only planned, tells: whitened slopes and their products.

At a fitted model the log likelihood falls by |d|^2 / 2 when something moves the whitened
innovations by d and nothing else moves with it.  What parameters can absorb is projected out.
All that takes is the products of the slopes with one another (a Gram matrix); those of two
recordings add up, so a second motion is judged together with what is there already.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.mismatch.calibrate import free_run
from eha_monitor.mismatch.experiment import Experiment
from eha_monitor.mismatch.fit import Fit, innovations, spread, step_of, whitener

STEADY_SPAN = 0.05  # s to either side in which a plateau's speed hardly changes
STEADY_CHANGE = 0.01  # of the record's largest speed
SLIDING = 0.2  # of the largest speed: slower is near a reversal
LEAST_STEADY = 0.3  # share of a record from which on it has plateaus to speak of

Model = tuple[np.ndarray, np.ndarray]  # theta, active


@dataclass(frozen=True)
class Slope:
    """A move of the model whose trace in the innovations is wanted.

    Attributes
    ----------
    label : its name in a :class:`Gram`.
    model : theta and active effects after the move; ``origin`` before it, None at the fit.
    step : length of the move; the trace is divided by it.
    weight : of the prior on it, per unit of the move squared.
    """

    label: str
    model: Model
    step: float = 1.0
    weight: float = 0.0
    origin: Model | None = None


@dataclass(frozen=True)
class Gram:
    """Products of whitened slopes, (m, m), over all samples and over some.

    Attributes
    ----------
    labels : names of the rows.
    whole : over all counted samples; ``part`` over plateaus, or away from reversals.
    count : counted samples; ``count_part`` those of ``part``.
    """

    labels: tuple[str, ...]
    whole: np.ndarray
    part: np.ndarray
    count: int
    count_part: int

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

        Parameters
        ----------
        weights : prior weights of the absorbing slopes; a prior limits what they absorb.
        steady : over the part, not the whole.
        """
        g = self.part if steady else self.whole
        i, j = self.places(wanted), self.places(absorbing)
        if not j:
            return g[np.ix_(i, i)]
        inner = g[np.ix_(j, j)] + np.diag([weights.get(label, 0.0) for label in absorbing])
        scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
        cross = g[np.ix_(j, i)] / scale[:, None]
        inner = inner / np.outer(scale, scale) + 1e-13 * np.eye(len(j))
        left = g[np.ix_(i, i)] - cross.T @ np.linalg.solve(inner, cross)
        return 0.5 * (left + left.T)

    def absorbed(self, moved: str, absorbing: Sequence[str], weights: dict[str, float],
                 steady: bool = False) -> dict[str, float]:
        """Return by how much each absorbing slope moves when ``moved`` is there and left out."""
        g = self.part if steady else self.whole
        (i,), j = self.places([moved]), self.places(absorbing)
        inner = g[np.ix_(j, j)] + np.diag([weights.get(label, 0.0) for label in absorbing])
        scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
        inner = inner / np.outer(scale, scale) + 1e-13 * np.eye(len(j))
        found = np.linalg.solve(inner, g[j, i] / scale) / scale
        return dict(zip(absorbing, map(float, found), strict=True))


def gain_of(squares: float, count: int) -> float:
    """Return log units for a remaining sum of squares: the likelihood's S is estimated too."""
    return 0.5 * count * float(np.log1p(max(squares, 0.0) / max(count, 1)))


def free_slopes(fit: Fit, model: Model | None = None, names: Sequence[str] = ()) -> list[Slope]:
    """Return the slopes of a fit's free parameters, in their fitted coordinates.

    Parameters
    ----------
    model : where they are taken, where that is another than the fit.
    names : labels that they get.
    """
    theta, active = model or (fit.theta, fit.active)
    found = []
    for i, f in enumerate(fit.free):
        other, step = step_of(f, theta)
        found.append(Slope(names[i] if names else f.name, (other, active), step, f.spread**-2.0,
                           None if model is None else model))
    return found


def gram_of(experiment: Experiment, fit: Fit, slopes: Sequence[Slope], planned: bool = False
            ) -> Gram:
    """Return the products of slopes over an experiment, each one or two runs of the filter.

    Parameters
    ----------
    fit : gives gains and the innovations' covariance; slopes without origin start at it.
    planned : a motion that is only simulated: its part is what is away from reversals; that of
        a recording is its plateaus.
    """
    models = [(fit.theta, fit.active)]
    for slope in slopes:
        for model in (slope.model, slope.origin):
            if model is not None and not any(model is known for known in models):
                models.append(model)
    runs = spread(lambda m: np.nan_to_num(innovations(experiment, *m, fit.gains)), models)

    def run(model):
        return runs[next(i for i, known in enumerate(models) if known is model)]

    w = whitener(fit.s).T
    here = []
    for slope in slopes:
        origin = runs[0] if slope.origin is None else run(slope.origin)
        d = (run(slope.model) - origin) @ w / slope.step
        here.append(d if np.isfinite(d).all() and np.abs(d).max() < 1e9 else np.zeros_like(d))
    d = np.stack(here) if here else np.zeros((0, *runs[0].shape))
    part = sliding(experiment) if planned else steady(experiment, fit)
    flat, few = d.reshape(len(d), -1), d[:, part].reshape(len(d), -1)
    return Gram(tuple(slope.label for slope in slopes), flat @ flat.T, few @ few.T,
                d.shape[1], int(part.sum()))


def speeds(experiment: Experiment, fit: Fit) -> list[np.ndarray]:
    """Return the speed of the model along each stretch, running free; (n,) m/s."""
    found = []
    for stretch in experiment.stretches:
        blank = np.zeros_like(stretch.z)
        x = -free_run(experiment, replace(stretch, z=blank), stretch, fit)[:, 0]
        found.append(np.gradient(x, experiment.dt))
    return found


def steady(experiment: Experiment, fit: Fit) -> np.ndarray:
    """Tell which counted samples lie on plateaus of the speed, (N,) bool."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    span = 2 * max(1, round(STEADY_SPAN / experiment.dt)) + 1
    found = speeds(experiment, fit)
    largest = max((float(np.quantile(np.abs(v), 0.99)) for v in found), default=0.0)
    return np.concatenate([
        (maximum_filter1d(v, span) - minimum_filter1d(v, span)
         < STEADY_CHANGE * largest)[stretch.counted]
        for v, stretch in zip(found, experiment.stretches, strict=True)])


def sliding(experiment: Experiment) -> np.ndarray:
    """Tell which counted samples lie away from reversals, (N,) bool."""
    found = []
    for stretch in experiment.stretches:
        v = np.abs(np.gradient(stretch.z[:, 0], experiment.dt))  # planned: there is no noise on it
        found.append((v > SLIDING * max(float(np.quantile(v, 0.99)), 1e-12))[stretch.counted])
    return np.concatenate(found)
