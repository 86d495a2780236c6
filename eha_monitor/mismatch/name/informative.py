"""The most informative windows of a long recording: effects are named on these.

Names need a minute of rich motion, not an hour of it.  What each window says of what every model
fits is a Gram matrix of whitened slopes, the innovations themselves among them, so that a window
in which the model fails says something too; the windows are taken one by one whose log det
together is the largest (D-optimal, greedy).
"""

from itertools import pairwise

import numpy as np

from eha_monitor.mismatch.data.experiment import SHORTEST, Experiment, Stretch
from eha_monitor.mismatch.data.stretch import cut, most_informative
from eha_monitor.mismatch.likelihood.fit import spread
from eha_monitor.mismatch.name.columns import columns_at
from eha_monitor.mismatch.name.gram import grams_of
from eha_monitor.mismatch.name.refit import unfitted

WINDOW = 4_000  # samples
MOST = 24_000  # samples that effects are named on


def informative(experiment: Experiment, most: int = MOST, window: int = WINDOW) -> Experiment:
    """Return an experiment with the most informative windows; itself where it is short.

    Parameters
    ----------
    most : samples that are kept; ``window`` samples in each window.
    """
    if experiment.n <= most:
        return experiment
    windows = [part for stretch in experiment.stretches
               for part in windows_of(stretch, experiment.dt, window)]
    if not windows:
        return experiment
    grams = spread(lambda one: information_of(experiment.only((one,))), windows)
    chosen = most_informative(grams, list(map(len, windows)), most, window)
    return experiment.only(tuple(windows[i] for i in chosen)) if chosen else experiment


def windows_of(stretch: Stretch, dt: float, window: int) -> list[Stretch]:
    """Return a stretch in windows of about ``window`` samples, equally long."""
    count = max(round(len(stretch) / window), 1)
    bounds = np.linspace(0, len(stretch), count + 1).astype(int)
    return [cut(stretch, first, last, dt) for first, last in pairwise(bounds)
            if (last - first) * dt >= SHORTEST]


def information_of(window: Experiment) -> np.ndarray:
    """Return the Gram matrix of a window at the config's model; empty where no filter runs."""
    try:
        fit = unfitted(window)
        if not np.isfinite(fit.log_likelihood):
            return np.zeros((0, 0))
        columns = columns_at(window, fit, unnamed=False, suspects=False)
        (gram,) = grams_of(window, fit, columns.values, [fit.unknowns])
    except (np.linalg.LinAlgError, ValueError):
        return np.zeros((0, 0))
    return gram.products if np.isfinite(gram.products).all() else np.zeros((0, 0))
