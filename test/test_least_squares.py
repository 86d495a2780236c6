"""The fits that the estimate makes without scipy answer as scipy does."""

import numpy as np
import pytest

from eha_monitor.estimation.hold_choice import fitted_with_signs, local_derivatives

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(("n", "window"), [(7, 7), (50, 13), (5000, 13), (5000, 7)])
def test_local_derivatives_are_those_of_savitzky_and_golay(n, window):
    from scipy.signal import savgol_filter

    x = 0.1 + 1e-3 * np.cumsum(RNG.normal(size=n))
    for order, found in zip((1, 2), local_derivatives(x, window, 1e-3), strict=True):
        expected = savgol_filter(x, window, 3, deriv=order, delta=1e-3)
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-11 * np.abs(expected).max())


def test_too_few_samples_are_refused():
    with pytest.raises(ValueError, match="at least 7 samples"):
        local_derivatives(np.zeros(6), 7, 1e-3)


def test_weights_with_signs_are_those_of_the_bounded_fit():
    from scipy.optimize import lsq_linear

    for _ in range(50):
        columns = np.column_stack([np.ones(400), RNG.normal(size=(400, 3)) * [1.0, 30.0, 0.1]])
        y = columns @ RNG.normal(size=4) + RNG.normal(size=400)
        expected = lsq_linear(columns, y, ([-np.inf, 0, 0, 0], np.inf), method="bvls").x
        assert fitted_with_signs(columns, y) == pytest.approx(expected, rel=1e-8, abs=1e-8)


def test_a_column_of_zeros_takes_no_weight():
    columns = np.column_stack([np.ones(9), np.zeros(9)])
    assert fitted_with_signs(columns, np.full(9, 2.0)) == pytest.approx([2.0, 0.0])
