"""Smooth unknown functions: their hats, and what they do to the innovations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from mismatch_tools import fitted

from eha_monitor.mismatch.likelihood.fit import with_unknowns
from eha_monitor.mismatch.likelihood.gains import Unknowns, smallest_unknowns
from eha_monitor.mismatch.name.columns import (
    HATS,
    INTERMITTENT,
    columns_of,
    hats,
    runs_of,
    unnamed_of,
)
from eha_monitor.mismatch.name.starts import Start, entered
from eha_monitor.mismatch.policy import POLICY


@given(st.integers(2, 30), st.integers(0, 10**6), st.sampled_from([1e-6, 1.0, 1e7]))
@hypothesis_settings(max_examples=40)
def test_hats_are_a_partition_of_unity(count, seed, scale):
    """So a constant is one of the functions, and so is a straight line within the range."""
    rng = np.random.default_rng(seed)
    parts = [scale * rng.standard_normal(n) for n in (200, 57)]
    found = hats(parts, count)
    whole = np.concatenate(parts)
    low, high = np.quantile(whole, [0.002, 0.998])
    for values, basis in zip(parts, found, strict=True):
        assert basis.shape == (len(values), count)
        assert (basis >= 0.0).all() and ((basis > 1e-12).sum(axis=1) <= 2).all()
        assert basis.sum(axis=1) == pytest.approx(1.0, abs=1e-9)
        line = basis @ np.linspace(low, high, count)
        assert line == pytest.approx(np.clip(values, low, high), abs=1e-9 * scale)


def test_what_does_not_vary_has_no_hats():
    assert [basis.shape for basis in hats([np.ones(10), np.ones(5)], 7)] == [(10, 0), (5, 0)]


@pytest.fixture(scope="module")
def clean():
    """A clean recording, linearised where its unknowns follow what is missing a little."""
    case = fitted()
    small = smallest_unknowns(case.experiment).as_array()
    return case.experiment, with_unknowns(case.experiment, case.before, Unknowns(*(100.0 * small)))


def columns(experiment, fit, term):
    into = [np.zeros((len(stretch), len(experiment.columns), term.basis[i].shape[1]))
            for i, stretch in enumerate(experiment.stretches)]
    columns_of(experiment, fit, [term], into)
    return into


def test_each_balance_has_its_rivals_without_a_name(clean):
    terms = {term.name: term for term in unnamed_of(*clean)}
    assert {term.balance for term in terms.values()} == {"force", "flow", "drive"}
    stretch = clean[0].stretches[0]
    for term in terms.values():
        assert all(np.isfinite(basis).all() and len(basis) == len(stretch)
                   for basis in term.basis)
    assert terms["force of v"].basis[0].shape[1] == HATS
    blocks = terms[INTERMITTENT].basis[0]
    assert (blocks.sum(axis=1) == 1.0).all() and set(np.unique(blocks)) == {0.0, 1.0}
    assert (np.diff(blocks.argmax(axis=1)) >= 0).all()  # stretches of time, in turn


@pytest.mark.parametrize("name", ["force of v", INTERMITTENT])
def test_hats_together_do_what_a_constant_load_does(clean, name):
    """Against a run of the plant with that load in it, no linearisation."""
    experiment, fit = clean
    term = next(one for one in unnamed_of(experiment, fit) if one.name == name)
    (part,) = columns(experiment, fit, term)
    unit = POLICY.matters * smallest_unknowns(experiment).force  # N that a unit stands for
    # Both act against the positive direction.
    theta, active = entered(fit.theta, fit.active, Start("constant_load", (("F_0", 1.0),)))
    (with_it,) = runs_of(experiment, theta, active, fit.gains)
    (plain,) = runs_of(experiment, fit.theta, fit.active, fit.gains)
    counted = experiment.stretches[0].counted
    noise = experiment.noise[experiment.columns]
    wanted = ((with_it - plain) / noise)[counted]
    found = (part.sum(axis=2) / unit / noise)[counted]
    assert np.linalg.norm(found - wanted) < 0.01 * np.linalg.norm(wanted)
