"""Products and solutions of small matrices are numpy's."""

import numpy as np
import pytest

from eha_monitor.estimation.small_matrices import (
    add,
    solved,
    symmetric,
    times,
    times_transposed,
    transposed,
)

RNG = np.random.default_rng(0)


def test_products():
    a, b, c = RNG.normal(size=(3, 5)), RNG.normal(size=(5, 2)), RNG.normal(size=(4, 5))
    assert times(a, b) == pytest.approx(a @ b)
    assert times_transposed(a, c) == pytest.approx(a @ c.T)
    assert (transposed(a) == a.T).all() and transposed(a).flags.c_contiguous
    square, more = RNG.normal(size=(5, 5)), RNG.normal(size=(5, 5))
    assert symmetric(square) == pytest.approx(0.5 * (square + square.T))
    expected = square + more
    add(square, more)
    assert (square == expected).all()


@pytest.mark.parametrize("n", [1, 2, 5, 8])
def test_solutions_with_rows_that_must_change_places(n):
    for _ in range(20):
        a, b = RNG.normal(size=(n, n)), RNG.normal(size=(n, 3))
        if n > 1:
            a[0, 0] = 0.0
        assert solved(a.copy(), b.copy()) == pytest.approx(np.linalg.solve(a, b), rel=1e-7)


def test_a_singular_matrix_is_told():
    with pytest.raises(np.linalg.LinAlgError):
        solved(np.ones((2, 2)), np.eye(2))
