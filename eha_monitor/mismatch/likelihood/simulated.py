"""A recording as the fitted model would have made it: for what a record of its kind can tell."""

from dataclasses import replace

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment, Stretch
from eha_monitor.mismatch.data.inputs import CLOSED, cubics
from eha_monitor.mismatch.likelihood.fit import Fit, free_run


def simulated(experiment: Experiment, fit: Fit, seed: int) -> Experiment:
    """Return the experiment with the fitted model's own outputs in place of the measured ones."""
    rng = np.random.default_rng(seed)
    parts = []
    for stretch in experiment.stretches:
        clean = free_run(experiment, stretch, fit)
        z = clean + np.nan_to_num(experiment.noise) * rng.standard_normal(clean.shape)
        step = experiment.position_step
        if step > 0:
            z[:, 0] = step * np.round(
                (clean[:, 0] + white_part(experiment) * rng.standard_normal(len(stretch))) / step)
        z[~np.isfinite(stretch.z)] = np.nan
        parts.append(replace(stretch, z=z, u=noisy_input(experiment, stretch, rng)))
    return experiment.only(tuple(parts))


def white_part(experiment: Experiment) -> float:
    """Return the position noise that is not rounding, m."""
    rounding = experiment.position_step / np.sqrt(12.0)
    return float(np.sqrt(max(experiment.noise[0] ** 2 - rounding**2, 0.0)))


def noisy_input(experiment: Experiment, stretch: Stretch, rng: np.random.Generator) -> np.ndarray:
    """Return the input as it would be measured: x_d is known, a sensor's is not."""
    if experiment.mode == CLOSED:
        return stretch.u
    noise = experiment.input_noise
    if noise <= 0:
        return stretch.u
    return cubics(stretch.u[:, 0] + noise * rng.standard_normal(len(stretch)), noise,
                  experiment.held)
