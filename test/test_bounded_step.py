"""A step within bounds is the best one there, also in a valley that crosses them."""

import numpy as np
from hypothesis import given, settings, strategies

from eha_monitor.mismatch.likelihood.fit import step_within


@settings(max_examples=100, deadline=None)
@given(size=strategies.integers(1, 20), valley=strategies.floats(0.0, 0.9999999),
       seed=strategies.integers(0, 2**31))
def test_it_meets_the_conditions_of_karush_kuhn_and_tucker(size, valley, seed):
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(size, 2 * size))
    columns /= np.linalg.norm(columns, axis=1)[:, None]
    matrix = (1.0 - valley) * columns @ columns.T + valley + 1e-9 * np.eye(size)
    gradient = rng.normal(size=size)
    bounds = np.stack([-rng.uniform(0.0, 1.0, size), rng.uniform(0.0, 1.0, size)], axis=1)
    step = step_within(matrix, gradient, bounds)
    assert np.all(step >= bounds[:, 0]) and np.all(step <= bounds[:, 1])
    slope = gradient - matrix @ step
    assert np.all(slope[step < bounds[:, 1] - 1e-9] <= 1e-6)  # it would go on wherever it may
    assert np.all(slope[step > bounds[:, 0] + 1e-9] >= -1e-6)


def test_a_valley_does_not_stop_all_that_crosses():
    """To stop each number where it crosses, and solve for the rest, went uphill here."""
    matrix = np.array([[1.0, 0.999], [0.999, 1.0]])
    gradient = matrix @ np.array([3.0, -2.0])
    bounds = np.array([[-1.0, 1.0], [-1.0, 1.0]])
    step = step_within(matrix, gradient, bounds)
    gained = gradient @ step - 0.5 * step @ matrix @ step
    corner = np.array([1.0, -1.0])
    assert gained > gradient @ corner - 0.5 * corner @ matrix @ corner
    assert gained > 0.49
