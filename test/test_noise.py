"""Noise measured from moving signals; what the hold of an input makes of its samples."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from rig_tools import CHIRP, MULTISINE, REST, SINE, STEPS, TRIANGLE, settings, simulated

from eha_monitor.estimation.drive import LONGEST, hold_of, smoothed, speed_hold
from eha_monitor.estimation.sensors import noise_levels, quantum, white_noise
from eha_monitor.physics import signals as s
from eha_monitor.recordings.recording import Recording

SHAPES = {"triangle": TRIANGLE, "sine": SINE, "multisine": MULTISINE, "chirp": CHIRP,
          "steps": STEPS, "rest": REST}


@pytest.fixture(scope="module")
def truths():
    return {name: simulated(shape, 10.0).truth for name, shape in SHAPES.items()}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("place, sigma", [(s.X, 1e-6), (s.X, 1e-5), (s.P1, 500.0), (s.P1, 5e4),
                                          (s.OMEGA, 0.1), (s.V, 1e-3)])
def test_noise_on_a_moving_signal_is_measured_within_five_percent(truths, name, place, sigma):
    values = truths[name][:, place]
    found = [white_noise(values + sigma * np.random.default_rng(k).standard_normal(len(values)))
             for k in range(4)]
    assert np.mean(found) == pytest.approx(sigma, rel=0.05)
    assert np.std(found) < 0.05 * sigma


def test_spikes_and_gaps_do_not_count_as_noise(truths):
    rng = np.random.default_rng(0)
    values = truths["sine"][:, s.X] + 1e-6 * rng.standard_normal(10_000)
    values[rng.integers(0, 10_000, 60)] += 0.01
    values[3000:4000] = np.nan
    assert white_noise(values) == pytest.approx(1e-6, rel=0.1)
    assert np.isnan(white_noise(np.full(1000, np.nan)))
    assert np.isnan(white_noise(np.arange(20.0)))


def test_channels_of_a_recording():
    run = simulated(SINE, 10.0)
    levels = noise_levels(run.recording(3), settings().noise)
    expected = {"x": 1e-6, "p1": 500.0, "p2": 500.0, "omega": 0.1}
    assert set(levels) == set(expected)
    for name, sigma in expected.items():
        assert levels[name].value == pytest.approx(sigma, rel=0.05)
        assert levels[name].measured
    fixed = noise_levels(run.recording(3), settings(noise={"fixed": True, "position": 3e-6}).noise)
    assert fixed["x"].value == 3e-6 and not fixed["x"].measured
    short = noise_levels(run.recording(3).part(0, 20), settings().noise)
    assert short["x"].value == 1e-6 and not short["x"].measured


def test_a_noise_free_channel_gets_a_small_positive_level(truths):
    levels = noise_levels(Recording(1e-3, {"x": truths["sine"][:, s.X], "p1": np.full(10_000, 2e6)}
                                    ), settings().noise)
    assert 0 < levels["x"].value < 1e-7
    assert levels["p1"].value == 500.0  # a constant says nothing: the config's level


@pytest.mark.parametrize("step", [1e-6, 1e-5, 25e-6, 3e-7])
@pytest.mark.parametrize("name", ["triangle", "sine", "multisine"])
def test_resolution_is_found(truths, name, step):
    x = step * np.round((truths[name][:, s.X] + 0.2 * step
                         * np.random.default_rng(1).standard_normal(10_000)) / step)
    assert quantum(x) == pytest.approx(step, rel=1e-6)
    assert white_noise(x) >= step / np.sqrt(12) * 0.999
    assert white_noise(x) < step


def test_a_continuous_channel_has_no_resolution(truths):
    x = truths["sine"][:, s.X]
    assert quantum(x) == 0.0
    assert quantum(x + 1e-6 * np.random.default_rng(0).standard_normal(10_000)) == 0.0
    assert quantum(np.zeros(100)) == 0.0 and quantum(np.empty(0)) == 0.0


# ---- hold ---------------------------------------------------------------------------------------


@given(st.floats(-10, 10), st.floats(-1e3, 1e3))
@hypothesis_settings(max_examples=30)
def test_a_line_is_held_exactly(offset, slope):
    u = offset + slope * 1e-3 * np.arange(200)
    hold = hold_of(u, 0.0)
    size = np.abs(u).max() + 1e-12
    assert hold.start == pytest.approx(u, abs=1e-12 * size)
    assert hold.end == pytest.approx(u, abs=1e-12 * size)
    assert hold.variance.max() <= (1e-12 * size) ** 2
    assert smoothed(u, 0.1)[0] == pytest.approx(u, abs=1e-10 * size)


def interval_means(hold):
    """Mean over each sample of the piece that the hold gives."""
    return 0.5 * (hold.start[:-1] + hold.end[1:])


def sine_error(omega_t):
    """Worst error of the mean over a sample, relative to the amplitude."""
    k = np.arange(2000)
    hold = hold_of(np.sin(omega_t * k + 0.3), 0.0)
    exact = (np.cos(omega_t * k[:-1] + 0.3) - np.cos(omega_t * k[1:] + 0.3)) / omega_t
    return np.abs(interval_means(hold) - exact)[5:-5].max()


def test_a_sine_is_held_to_fourth_order():
    steps = np.array([0.05, 0.1, 0.2, 0.472])
    errors = np.array([sine_error(step) for step in steps])
    plain = steps**2 / 12  # what linear interpolation loses
    assert (errors < 0.2 * plain).all()
    assert errors[3] < 1e-3  # the resonance at 1 kHz: 0.07 %
    orders = np.diff(np.log(errors)) / np.diff(np.log(steps))
    assert orders == pytest.approx([4, 4, 4], abs=0.2)


def test_a_jump_is_held_until_its_stamp():
    u = np.where(np.arange(400) < 200, 0.001, 0.005)
    u[300:] = -0.002
    hold = hold_of(u, 0.0)
    assert np.array_equal(hold.start, u)
    assert hold.end[200] == 0.001 and hold.end[300] == 0.005  # old value up to the stamp
    assert hold.end[201] == 0.005 and hold.end[150] == 0.001
    unsure = np.flatnonzero(hold.variance > 1e-20)
    assert {200, 300} <= set(unsure) <= {*range(197, 204), *range(297, 304)}
    assert hold.variance[200] == pytest.approx((0.3 * 0.004) ** 2)  # uniform over the sample


def test_a_corner_stays_where_it_is_and_says_how_sure_it_is():
    u = 0.04 * 1e-3 * np.abs(np.arange(400) - 200.0)
    hold = hold_of(u, 0.0)
    assert hold.start == pytest.approx(u, abs=1e-15)
    # The kink lies at a sample, so the hold is exact; it cannot know that, and counts an error
    # of a kink between samples: at most 1/8 of the bend, 8e-5 m here.
    assert 0 < hold.variance[200] ** 0.5 < 8e-5 / 8
    assert hold.variance[:190].max() < 1e-20


def test_a_sampled_drive_holds_the_last_sample():
    u = np.random.default_rng(0).standard_normal(50)
    hold = hold_of(u, 0.0, sampled=True)
    assert np.array_equal(hold.end[1:], hold.start[:-1])
    assert np.array_equal(hold.start, u) and not hold.variance.any()


def test_missing_samples_stay_missing_and_touch_only_their_neighbours():
    u = np.sin(0.1 * np.arange(300))
    clean = hold_of(u, 0.0)
    u[100], u[200:230] = np.nan, np.nan
    hold = hold_of(u, 0.0)
    assert np.array_equal(np.isnan(hold.start), np.isnan(u))
    assert np.array_equal(np.isnan(hold.end), np.isnan(u))
    assert np.isfinite(hold.variance).all()
    far = np.ones(300, dtype=bool)
    far[95:106] = far[195:236] = False
    assert np.array_equal(hold.start[far], clean.start[far])
    for n in range(6):
        empty = hold_of(np.full(n, np.nan), 0.0)
        assert len(empty.start) == len(empty.end) == len(empty.variance) == n


def test_noise_does_not_make_jumps_or_corners():
    rng = np.random.default_rng(3)
    u = np.sin(0.02 * np.arange(5000)) + 0.01 * rng.standard_normal(5000)
    hold = hold_of(u, 0.01)
    assert not np.any(hold.end != hold.start)  # no jump
    assert np.count_nonzero(hold.variance) <= 5


def test_smoothing_takes_the_noise_and_leaves_the_signal():
    rng, n, sigma = np.random.default_rng(4), 20_000, 0.5
    u = 40.0 * np.cos(0.01 * np.arange(n))
    found, reach = smoothed(u + sigma * rng.standard_normal(n), sigma)
    middle = slice(LONGEST, -LONGEST)
    assert np.mean(reach[middle] == LONGEST) > 0.8
    # A straight mean of quartics over 49 samples would have 0.27 of the noise.
    assert np.std((found - u)[middle]) < 0.35 * sigma
    assert abs(np.mean((found - u)[middle] * u[middle])) / np.mean(u**2) < 1e-3
    quintic = (np.linspace(-1, 1, 200)[:, None] ** np.arange(6)) @ rng.standard_normal(6)
    assert smoothed(quintic, 0.1)[0] == pytest.approx(quintic, abs=1e-9)


def test_a_jump_of_a_noisy_speed_is_not_smoothed_away():
    rng = np.random.default_rng(5)
    u = np.where(np.arange(2000) < 1000, 0.0, 20.0)
    found, reach = smoothed(u + 0.5 * rng.standard_normal(2000), 0.5)
    assert np.abs(found - u)[[*range(960, 1000), *range(1000, 1040)]].max() < 4 * 0.5
    assert reach[999] <= 2 and reach[1000] <= 2 and reach[900] == LONGEST


def test_smoothing_a_part_is_smoothing_the_whole():
    rng = np.random.default_rng(6)
    u = np.cumsum(rng.standard_normal(400)) * 0.3
    u[200:203] = np.nan
    whole, part = (speed_hold(values, 0.3, 0.5, False) for values in (u, u[100:]))
    for name in ("start", "end", "variance", "slow"):
        one, other = getattr(whole, name)[100:], getattr(part, name)
        beside = LONGEST + 8
        assert np.array_equal(one[beside:-beside], other[beside:-beside], equal_nan=True)


def test_the_variance_left_is_shared_between_oil_column_and_position():
    rng = np.random.default_rng(7)
    u = 30.0 * np.sin(0.01 * np.arange(3000)) + 0.2 * rng.standard_normal(3000)
    hold = speed_hold(u, 0.2, 0.473, False)
    inside = slice(LONGEST, -LONGEST)
    total = hold.variance + hold.slow
    assert (total[inside] >= 0.2**2 * (1 - 1e-12)).all()
    assert np.median(hold.slow) > 0.9 * 0.2**2  # the resonance of the paper's rig at 1 kHz
    assert np.median(speed_hold(u, 0.2, 0.01, False).slow) < 0.1 * 0.2**2
