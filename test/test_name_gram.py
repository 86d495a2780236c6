"""Products under other gains, without a run of the plant, against that very run."""

from dataclasses import replace

import numpy as np
import pytest
from mismatch_tools import fitted, nominal_fit
from rig_tools import MULTISINE, settings, simulated, with_channels

from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.likelihood.fit import with_unknowns
from eha_monitor.mismatch.likelihood.gains import Unknowns, expected_covariance
from eha_monitor.mismatch.name.columns import columns_at, runs_of
from eha_monitor.mismatch.name.gram import (
    Regained,
    evidences_at,
    grams_of,
    injected,
    mapped,
    powers_at,
    under,
)
from eha_monitor.mismatch.name.starts import limits_of

AGREES = 1e-3  # what was measured, of the size of a column: the plant is not quite linear
# They push the plant, or shift what is measured, alike wherever it is.
EXTERNAL = ("constant_load.F_0", "pressure_offset.b_1", "pressure_offset.b_2", "command_delay.T",
            "rig.charge_pressure")


class Plant:
    """A linear plant with two filters, in numpy: x+ = A (x + K e), e = z - H x."""

    def __init__(self, seed=0, n=300, states=4, channels=2, m=3):
        rng = np.random.default_rng(seed)
        a = rng.standard_normal((states, states))
        self.a = 0.9 * a / np.abs(np.linalg.eigvals(a)).max()
        self.h = rng.standard_normal((channels, states))
        # The first gains of a run differ from sample to sample; the last one serves from there on.
        self.old, self.new = 0.1 * rng.standard_normal((2, 20, states, channels))
        self.z = rng.standard_normal((n, channels, m))
        self.missing = rng.random((n, channels)) < 0.1
        self.counted = rng.random(n) < 0.8
        self.w = np.linalg.inv(np.linalg.cholesky(np.array([[2.0, 0.3], [0.3, 1.0]])))

    def filtered(self, gains):
        """The innovations of every lane, (n, c, m), 0 where nothing was measured."""
        e = np.zeros(self.z.shape)
        for lane in range(self.z.shape[2]):
            x = np.zeros(len(self.a))
            for k in range(len(self.z)):
                e[k, :, lane] = np.where(self.missing[k], 0.0, self.z[k, :, lane] - self.h @ x)
                x = self.a @ (x + gains[min(k, len(gains) - 1)] @ e[k, :, lane])
        return e


@pytest.mark.parametrize("seed", range(3))
def test_of_a_linear_plant_the_map_is_exact(seed):
    plant = Plant(seed)
    old, new = plant.filtered(plant.old), plant.filtered(plant.new)
    given = np.where(plant.missing[:, :, None], 0.0, old)
    out = np.empty_like(given)
    mapped(given, plant.missing, Regained(plant.a, plant.h, plant.old, plant.new, np.eye(2)), 0,
           np.zeros((4, 3)), out)
    assert out == pytest.approx(new, abs=1e-9)

    white = np.einsum("ij,kjl->kil", plant.w, new)[plant.counted]
    delta, first = np.zeros((4, 3)), 0
    for length in (7, len(given) - 7):  # in pieces that carry the filters' difference on
        piece = np.empty((length, 2, 3))
        mapped(given, plant.missing, Regained(plant.a, plant.h, plant.old, plant.new, plant.w),
               first, delta, piece)
        wanted = np.einsum("ij,kjl->kil", plant.w, new[first : first + length])
        assert piece == pytest.approx(wanted, abs=1e-9)
        first += length
    power = powers_at(  # at two levels of which one weighs all twice
        np.ascontiguousarray(given[:, :, 0]), plant.missing, plant.counted, plant.a, plant.h,
        plant.old, np.stack([plant.new, plant.new], axis=3), np.stack([plant.w, 2.0 * plant.w], 2))
    wanted = float(np.sum(white[:, :, 0] ** 2))
    assert power == pytest.approx(np.array([wanted, 4.0 * wanted]), rel=1e-9)


def test_an_input_to_the_plant_shows_as_the_filter_would_see_it():
    plant = Plant(1)
    n, m = len(plant.z), 3
    rng = np.random.default_rng(5)
    forcing, into = rng.standard_normal((n, m)), rng.standard_normal((4, m))
    out = np.zeros((n, 2, m))
    injected(forcing, plant.missing, plant.a, plant.h, plant.old, into, out)
    for lane in range(m):
        # The true state less the filter's; a filter that knows nothing of the input lags behind.
        x, wanted = np.zeros(4), np.zeros((n, 2))
        for k in range(n):
            wanted[k] = np.where(plant.missing[k], 0.0, -plant.h @ x)
            x = plant.a @ (x + plant.old[min(k, 19)] @ wanted[k])
            x = x + into[:, lane] * forcing[k, lane]
        seen = np.where(plant.missing, 0.0, out[:, :, lane])
        assert seen == pytest.approx(wanted, abs=1e-9)


# ---- the real plant ----------------------------------------------------------------------------


def level_of(experiment, force: float, flow: float, speed: float) -> Unknowns:
    """Unknowns in times of the smallest."""
    return Unknowns(*(np.array([force, flow, speed]) * limits_of(experiment)[0].as_array()))


@pytest.fixture(scope="module")
def clear():
    """A recording with dry friction, linearised under unknowns that follow it a little."""
    case = fitted("coulomb_friction", told=False)
    experiment = case.experiment
    return experiment, with_unknowns(experiment, case.before, level_of(
        experiment, 100.0, 100.0, 100.0))


def white(experiment, fit, e):
    """Innovations or columns at the counted samples, as the fit's filter weighs them."""
    s = expected_covariance(experiment, fit.theta, fit.active, fit.unknowns, fit.gains)
    w = np.linalg.inv(np.linalg.cholesky(0.5 * (s + s.T)))
    return np.einsum("ij,kj...->ki...", w, e[experiment.stretches[0].counted])


@pytest.mark.parametrize("level", [(1.0, 1.0, 1.0), (1e3, 1.0, 1.0), (10.0, 30.0, 300.0)])
def test_innovations_under_other_gains_are_those_of_a_second_run(clear, level):
    experiment, fit = clear
    (present,) = runs_of(experiment, fit.theta, fit.active, fit.gains)
    other = with_unknowns(experiment, fit, level_of(experiment, *level))
    (again,) = runs_of(experiment, fit.theta, fit.active, other.gains)
    (quick,) = under(experiment, fit, [present[:, :, None]], other.gains)
    wanted, found = white(experiment, other, again), white(experiment, other, quick[:, :, 0])
    assert np.linalg.norm(found - wanted) < 2.0 * AGREES * np.linalg.norm(wanted)
    s = expected_covariance(experiment, fit.theta, fit.active, other.unknowns, other.gains)
    density = -0.5 * np.sum(wanted**2) - 0.5 * len(wanted) * np.linalg.slogdet(s)[1]
    assert evidences_at(experiment, fit, [present], [other.unknowns])[0] == pytest.approx(
        density, rel=4.0 * AGREES)


@pytest.mark.parametrize("level", [(1e3, 10.0, 1.0), (1.0, 1.0, 1.0)])
def test_columns_under_other_gains_are_those_taken_there(level):
    """An outside push is mapped exactly.  Of the others a slope depends on where the filter is.

    On a clean recording it is everywhere at the same place, to a per cent or so.
    """
    experiment = fitted().experiment
    fit = with_unknowns(experiment, fitted().before, level_of(experiment, 1e2, 1e2, 1e2))
    other = with_unknowns(experiment, fit, level_of(experiment, *level))
    here, there = columns_at(experiment, fit), columns_at(experiment, other)
    assert [c.name for c in here.what] == [c.name for c in there.what]
    quick = white(experiment, other, under(experiment, fit, here.values, other.gains)[0])
    wanted = white(experiment, other, there.values[0])
    size = np.linalg.norm(wanted, axis=(0, 1))
    left = np.linalg.norm(quick - wanted, axis=(0, 1)) / np.maximum(size, 1e-9 * size.max())
    assert np.median(left) < 0.02
    for c, value in zip(here.what, left[1:], strict=False):
        if c.name in EXTERNAL:
            assert value < 2.0 * AGREES, c.name


def test_gram_matrices_hold_the_products_of_the_columns_taken_there(clear):
    experiment, fit = clear
    columns = columns_at(experiment, fit)
    gram, = grams_of(experiment, fit, columns.values, [fit.unknowns], columns.copies)
    assert gram.products.shape == (1 + len(columns.what),) * 2
    s = expected_covariance(experiment, fit.theta, fit.active, fit.unknowns, fit.gains)
    here = experiment.stretches[0].counted
    parts = white(experiment, fit, columns.values[0])
    taken = parts.shape[2]
    wanted = np.einsum("kil,kim->lm", parts, parts)
    scale = np.sqrt(np.diag(wanted)) + 1e-12
    found = gram.products
    assert found[:taken, :taken] / np.outer(scale, scale) == pytest.approx(
        wanted / np.outer(scale, scale), abs=1e-6)
    for extra, (place, factor) in enumerate(columns.copies):
        assert found[taken + extra, 0] == pytest.approx(factor * found[place, 0], rel=1e-9)
    assert gram.counts == pytest.approx(np.full(len(experiment.columns), here.sum()))
    assert gram.logdet == pytest.approx(0.5 * here.sum() * np.linalg.slogdet(s)[1], rel=1e-9)


def test_what_was_not_measured_has_no_part_in_the_products():
    """A pressure at half the rate: counted as often as it was measured."""
    recording = with_channels(simulated(MULTISINE, 3.0).recording(0))
    p1 = recording.channels["p1"].copy()
    p1[1::2] = np.nan
    recording = replace(recording, channels={**recording.channels, "p1": p1})
    experiment = experiment_of([recording], settings())
    fit = nominal_fit(experiment)
    present = runs_of(experiment, fit.theta, fit.active, fit.gains)
    gram, = grams_of(experiment, fit, [part[:, :, None] for part in present], [fit.unknowns])
    counted = np.isfinite(present[0])[experiment.stretches[0].counted].sum(axis=0)
    assert list(gram.counts) == list(counted)
    assert gram.counts.min() < 0.6 * gram.counts.max()
