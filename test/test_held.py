"""Channels that a logger repeats: found, and only they, and put where they were measured."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eha_monitor.recordings.align import align, fresh_rows, hold_of, released
from eha_monitor.recordings.cdr import Series
from eha_monitor.settings import Settings

N, STEP = 6000, 1e-3
TIME = np.arange(N) * STEP


def pressure(rng, noise, resolution, still):
    """A pressure in motion about 2 MPa, with a pause, noise and the resolution of its sensor."""
    t = np.minimum(TIME, 2.0) + np.maximum(TIME - 2.0 - still * STEP, 0.0)
    wave = 3e5 * np.sin(2 * np.pi * 1.3 * t) + 1e5 * np.sin(2 * np.pi * 2.9 * t)
    wave = 2e6 + wave + noise * rng.standard_normal(N)
    return np.round(wave / resolution) * resolution if resolution else wave


signals = dict(seed=st.integers(0, 2**32 - 1), noise=st.sampled_from([0.0, 300.0, 5e3]),
               resolution=st.sampled_from([0.0, 100.0, 6103.5, 20e3]),
               still=st.integers(0, 2000))


@settings(deadline=None, max_examples=60)
@given(**signals)
def test_what_is_measured_in_every_row_is_held_nowhere(seed, noise, resolution, still):
    assert hold_of(pressure(np.random.default_rng(seed), noise, resolution, still)) == 1


@settings(deadline=None, max_examples=60)
@given(**signals, rows=st.floats(2.0, 40.0), phase=st.floats(0.0, 1.0))
def test_a_held_channel_is_put_where_it_was_measured(seed, noise, resolution, still, rows, phase):
    if resolution > 2e3 or noise > 1e3:
        resolution, noise = 100.0, 300.0  # of what is coarser than its steps nothing is claimed
    clean = pressure(np.random.default_rng(seed), noise, resolution, still)
    # Another clock: the newest sample of a source that is a whole number of rows apart or not.
    taken = np.floor(np.floor(np.arange(N) / rows + phase) * rows - phase * rows + 0.999)
    held = clean[np.clip(taken, 0, N - 1).astype(int)]
    found = hold_of(held)
    assert abs(found - rows) <= 1
    said = []
    out = released({"p1": held}, STEP, said)["p1"]
    assert len(said) == 1 and said[0].startswith("p1: ") and "repeated over" in said[0]
    inner = slice(100, -100)
    truth = pressure(np.random.default_rng(seed), 0.0, 0.0, still)
    error, before, row = (np.sqrt(np.mean(one[inner] ** 2)) for one in (
        out - truth, held - truth, np.diff(truth)))
    # Of a source with a clock of its own nobody knows when in the last row it measured.
    assert error < 0.3 * before + 3 * (noise + resolution) + row


@pytest.mark.parametrize("hold, released_too", [(10, True), (6, False)])
def test_the_speed_of_a_drive_is_released_with_sensors_of_the_same_hold(hold, released_too):
    rng = np.random.default_rng(2)
    p, omega = (np.repeat(pressure(rng, 300.0, 0.0, 0)[::n], n) for n in (10, hold))
    out = released({"omega": omega[:len(p)], "p1": p}, STEP, [])
    assert (out["omega"][:-10] != omega[:len(p)][:-10]).any() == released_too


def test_gaps_stay_gaps_and_demands_stay_held():
    held = np.repeat(pressure(np.random.default_rng(1), 300.0, 100.0, 0)[::10], 10)
    held[3000:3400] = np.nan
    out = released({"p1": held, "omega_d": held}, STEP, [])
    np.testing.assert_array_equal(np.isnan(out["p1"]), np.isnan(held))
    assert out["omega_d"] is held
    assert released({"omega": held}, STEP, [])["omega"] is held


def test_the_rows_of_a_constant_value_are_measured_again():
    held = np.repeat([1.0, 2.0, 2.0, 2.0, 3.0], 5)
    np.testing.assert_array_equal(fresh_rows(held, 5), [0, 5, 10, 15, 20])


@pytest.mark.parametrize("leader", ["held", "fresh"])
def test_a_recording_says_what_was_held(leader):
    rng = np.random.default_rng(3)
    x = 0.04 * np.sin(2 * np.pi * 0.5 * TIME) + 1e-6 * rng.standard_normal(N)
    p = pressure(rng, 300.0, 100.0, 0)
    x, p = (np.repeat(x[::5], 5), p) if leader == "held" else (x, np.repeat(p[::5], 5))
    stamps = 10**18 + np.arange(N) * 10**6
    found = align({"x": (Series(stamps, stamps, x, True), "a"),
                   "p1": (Series(stamps, stamps, p, True), "a")}, Settings())
    name = "x" if leader == "held" else "p1"
    assert found.losses == (f"{name}: 200 Hz, each value repeated over 5 rows; interpolated to "
                            "1000 Hz",)
    assert found.sample_time == STEP
