"""What the diagnosis looks at: inputs between their samples, stretches, what is kept aside."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rig_tools import MULTISINE, TRIANGLE, A, settings, simulated, with_channels, without

from eha_monitor.concealed.cases import Case
from eha_monitor.concealed.generate import nominal_config, recording_of
from eha_monitor.errors import InputError
from eha_monitor.mismatch.data.experiment import BURN_IN, experiment_of, present, stretches_of
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED, OPEN, course_of, cubics
from eha_monitor.physics import signals as s
from eha_monitor.recordings.grid import filled
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.load import settings_from_tree

NO_RIG = {"area_1": None, "area_2": None}


@pytest.fixture(scope="module")
def run():
    return simulated(MULTISINE, 12.0)


@pytest.fixture(scope="module")
def recording(run):
    """All channels that there are; the simulator's own rig has no velocity and no force."""
    rng = np.random.default_rng(1)
    n = len(run.truth)
    force = A * (run.truth[:, s.P1] - run.truth[:, s.P2]) + rng.normal(0.0, 2.0, n)
    return with_channels(run.recording(1), force=force,
                         v=run.truth[:, s.V] + rng.normal(0.0, 1e-3, n))


# ---- an input between its samples --------------------------------------------------------------


def value(c, f):
    return c[:, 0] + c[:, 1] * f + c[:, 2] * f**2 + c[:, 3] * f**3


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4), st.floats(0, 1), st.floats(0, 1e-3))
def test_a_cubic_comes_back_exactly(coefficients, f, sigma):
    curve = np.polynomial.Polynomial(coefficients, domain=[0, 40])
    u = curve(np.arange(41.0))
    inner = slice(3, 35)  # at its ends the input goes on in a line: a corner
    assert value(cubics(u, sigma), f)[inner] == pytest.approx(
        curve(np.arange(41.0) + f)[inner], abs=1e-11)


def test_noise_is_neither_jump_nor_corner():
    """Every piece is the cubic through four samples, by the inverse of Vandermonde's matrix."""
    rng = np.random.default_rng(5)
    u = 3.0 * rng.standard_normal(5000)
    four = np.stack([u[:-3], u[1:-2], u[2:-1], u[3:]])
    expected = np.linalg.inv(np.vander([-1.0, 0.0, 1.0, 2.0], increasing=True)) @ four
    assert cubics(u, 3.0)[1:-2] == pytest.approx(expected.T, abs=1e-12)


@given(left=st.floats(-1, 1), right=st.floats(-1, 1), corner=st.floats(0, 1))
def test_a_corner_between_two_samples_keeps_the_mean(left, right, corner):
    place = 15.0 + corner
    def u(t):
        return np.where(t < place, left, right) * (t - place)

    c = cubics(u(np.arange(31.0)), 0.0)
    means = c @ [1, 1 / 2, 1 / 3, 1 / 4]
    fine = (np.arange(4000) + 0.5) / 4000
    exact = np.array([u(k + fine).mean() for k in range(31)])
    assert means[2:-2] == pytest.approx(exact[2:-2], abs=2e-7 + 1e-3 * abs(left - right) * (
        min(corner, 1 - corner) < 0.02))
    away = np.r_[2:14, 17:28]
    assert value(c, 0.3)[away] == pytest.approx(u(np.arange(31) + 0.3)[away], abs=1e-12)


@pytest.mark.parametrize("height", [0.1, -3.0])
def test_a_jump_is_held_until_its_stamp(height):
    k = np.arange(60.0)
    u = 1e-3 * np.sin(0.1 * k) + height * (k >= 30)
    c = cubics(u, 1e-6)
    assert np.array_equal(c[29], [u[29], 0, 0, 0])
    assert value(c, 1.0)[28] == pytest.approx(u[29]) and c[30, 0] == u[30]
    assert np.abs(value(c, 0.5) - u).max() < 2e-4  # no ringing beside it


def test_a_sampled_drive_holds_its_input():
    u = np.random.default_rng(0).standard_normal(20)
    c = cubics(u, 0.0, sampled=True)
    assert np.array_equal(c[:, 0], u) and not c[:, 1:].any()
    assert np.array_equal(cubics(u[:3], 0.0)[:, 0], u[:3])  # too few for a cubic


def smooth_step(k, start, length, height):
    """A demand that leaves rest and comes to rest in ``length`` samples, 3 s^2 - 2 s^3."""
    s = np.clip((k - start) / length, 0.0, 1.0)
    return height * s**2 * (3.0 - 2.0 * s)


def test_where_a_demand_begins_to_move_its_course_is_not_known():
    """No cubic through four samples knows when between two of them a motion began."""
    k, fine = np.arange(80.0), (np.arange(4000) + 0.5) / 4000
    c, off = course_of(smooth_step(k, 40, 5, 0.012), 0.0)
    exact = np.array([smooth_step(at + fine, 40, 5, 0.012).mean() for at in k])
    wrong = np.abs(c @ [1, 1 / 2, 1 / 3, 1 / 4] - exact)
    assert off.max() == pytest.approx(wrong.max(), rel=0.5) and wrong.max() > 5e-5
    assert (off[wrong > 1e-6] > 0.2 * wrong[wrong > 1e-6]).all()
    assert not off[:36].any() and not off[49:].any()


@pytest.mark.parametrize("u", [
    lambda k: 1e-3 * np.abs(k - 40.0), lambda k: 1e-3 * np.abs(k - 40.4),
    lambda k: 2e-3 * np.clip(k - 40.0, 0.0, 6.0)])
def test_lines_and_corners_are_taken_as_they_are(u):
    assert course_of(u(np.arange(80.0)), 0.0)[1].max() < 1e-15


def test_when_between_two_stamps_a_demand_jumps_is_not_known():
    _, off = course_of(0.01 * (np.arange(80.0) >= 40), 0.0)
    assert off[39] == pytest.approx(0.01 / np.sqrt(3.0)) and np.flatnonzero(off).tolist() == [39]
    assert not course_of(0.01 * (np.arange(80.0) >= 40), 0.0, True)[1].any()  # a digital drive


def test_only_such_samples_take_the_pressures_from_the_sensors():
    k = np.arange(3000.0)
    x_d = smooth_step(k, 1500, 5, 0.012)
    case = Case("a", demand=x_d, seed=1)
    channels, _ = recording_of(case)
    config = settings_from_tree(nominal_config(case), "a")
    stretch, = experiment_of([Recording(1e-3, channels)], config).stretches
    loose = np.flatnonzero(stretch.loose)
    assert 1499 <= loose.min() < loose.max() <= 1507
    assert (stretch.loose[loose] < 1.0).all() and not stretch.counted[loose].any()


def test_gaps_of_an_input_are_bridged_by_lines():
    nan = np.nan
    assert filled(np.array([nan, 1.0, nan, nan, 4.0, nan])) == pytest.approx([1, 1, 2, 3, 4, 4])
    assert np.isnan(filled(np.full(3, nan))).all()


# ---- stretches, what is counted and what is kept aside -----------------------------------------


def test_every_fifth_second_is_kept_aside_and_its_echo_is_not_counted(recording):
    stretch, = experiment_of([recording], recording_settings()).stretches
    time = np.arange(len(stretch)) * 1e-3
    assert np.array_equal(np.flatnonzero(stretch.held_out), np.r_[4000:5000, 9000:10000])
    for k in np.flatnonzero(stretch.counted):
        burn = slice(max(0, k - round(BURN_IN * 1e3)), k + 1)
        assert not stretch.held_out[burn].any() and time[k] >= BURN_IN
    # 12 s, less 2 s aside, less a burn-in at the start and after each part aside
    assert stretch.counted.sum() == pytest.approx(12000 - 2000 - 3 * 150, abs=3)


def recording_settings(**rig):
    return settings(rig=rig)


def test_a_short_record_keeps_its_last_fifth_aside(recording):
    stretch, = experiment_of([recording.part(0, 6000)], recording_settings()).stretches
    assert np.array_equal(np.flatnonzero(stretch.held_out), np.arange(4800, 6000))
    whole, = experiment_of([recording], recording_settings(), hold_out=False).stretches
    assert not whole.held_out.any() and whole.counted.sum() == 12000 - 150


@pytest.mark.parametrize("channel", ["x", "x_d"])
def test_a_long_gap_makes_two_stretches_and_a_short_one_is_bridged(recording, channel):
    values = recording.channels[channel].copy()
    values[2000:2010] = np.nan  # 10 ms
    values[7000:7100] = np.nan  # 100 ms
    first, second = experiment_of(
        [with_channels(recording, **{channel: values})], recording_settings()).stretches
    assert (first.start, len(first)) == (0.0, 7000)
    assert (second.start, len(second)) == (pytest.approx(7.1), 4900)
    assert np.isfinite(first.u).all() and np.isfinite(second.u).all()
    assert np.isnan(first.z[2000:2010, 0]).all() == (channel == "x")
    assert not second.counted[:150].any() and second.counted[151:3000].all()


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 60)), min_size=1, max_size=30),
       st.integers(0, 30))
def test_stretches_hold_every_good_sample_and_no_long_gap(blocks, longest):
    good = np.concatenate([np.full(n, here) for here, n in blocks])
    u = np.where(good, 1.0, np.nan)
    found = present(u, np.zeros(len(u)), longest)
    inside = np.zeros(len(u), dtype=int)
    for start, stop in found:
        assert good[start] and good[stop - 1]
        inside[start:stop] += 1
        gaps = np.diff(np.flatnonzero(good[start:stop])) - 1
        assert gaps.max(initial=0) <= max(longest, 1)
    assert inside.max(initial=0) <= 1 and (inside[good] == 1).all()
    for (_, stop), (start, _) in pairwise(found):
        assert start - stop > max(longest, 1)


@pytest.mark.parametrize("rig, lacking, hold, mode, used", [
    ({}, (), "continuous", CLOSED, "x v p1 p2 omega"),
    ({}, ("v", "omega"), "continuous", CLOSED, "x p1 p2"),
    ({}, (), "sampled", CLOSED, "x v p1 p2 omega"),
    ({"position_gain": None}, (), "continuous", OPEN, "x v p1 p2"),
    ({}, ("x_d",), "continuous", OPEN, "x v p1 p2"),
    ({"volume_1": None}, (), "continuous", FORCED, "x v"),
    (NO_RIG, ("p1", "p2"), "continuous", FORCED, "x v"),
])
def test_channels_and_constants_tell_what_drives_the_model(recording, rig, lacking, hold, mode,
                                                           used):
    part = without(recording.part(0, 3000), *lacking)
    config = recording_settings(**rig).model_copy(update={"command_hold": hold})
    experiment = experiment_of([part], config)
    assert experiment.mode == mode
    names = np.array(["x", "v", "p1", "p2", "omega"])
    assert list(names[experiment.columns]) == used.split()


def test_noise_levels_and_ranges_are_those_of_the_record(run):
    level = {"position": 4e-6, "pressure": 3e3, "pump_speed": 0.4}
    experiment = experiment_of([run.recording(2, **level)], recording_settings())
    assert experiment.noise[experiment.columns] == pytest.approx([4e-6, 3e3, 3e3, 0.4], rel=0.15)
    truth = run.truth
    assert experiment.ranges.speed == pytest.approx(np.abs(truth[:, s.V]).max(), rel=0.15)
    assert experiment.ranges.position == pytest.approx(np.ptp(truth[:, s.X]) / 2, rel=0.01)
    assert experiment.ranges.duration == pytest.approx(12.0)


def test_several_recordings_are_one_experiment(recording):
    one, two = recording.part(0, 3000), recording.part(5000, 8000)
    experiment = experiment_of([replace(one, source="a"), replace(two, source="b")],
                               recording_settings())
    assert [stretch.source for stretch in experiment.stretches] == ["a", "b"]
    assert experiment.n == 6000


@pytest.mark.parametrize("make, rig, words", [
    (lambda r: without(r, "x"), {}, "expected a position"),
    (lambda r: with_channels(r, x=np.full(len(r), np.nan)), {}, "expected a position"),
    (lambda r: without(r, "x_d", "omega", "force", "p1"), {}, "expected what moves the piston"),
    (lambda r: without(r, "force"), NO_RIG, "expected what moves the piston"),
    (lambda r: r.part(0, 300), {}, "without a gap"),
    (lambda r: with_channels(r, x=np.where(np.arange(len(r)) % 400 < 350, r.get("x"), np.nan)),
     {}, "without a gap"),
])
def test_what_cannot_be_answered_is_one_line(recording, make, rig, words):
    bad = replace(make(recording), source="bags/r.mcap")
    with pytest.raises(InputError, match=words) as error:
        experiment_of([bad], recording_settings(**rig))
    assert str(error.value).startswith("bags/r.mcap: ") and "\n" not in str(error.value)


def test_recordings_of_other_sample_times_are_refused(recording):
    other = replace(recording, sample_time=2e-3, source="slow.mcap")
    with pytest.raises(InputError, match=r"slow.mcap: expected the sample time of fast.mcap, "
                                         r"0.001 s, got 0.002 s"):
        experiment_of([replace(recording, source="fast.mcap"), other], recording_settings())


def test_a_triangle_s_corners_are_corners_of_the_input():
    """The command of the paper: a corner on the grid bends the input nowhere."""
    recording = simulated(TRIANGLE, 3.0).recording(0)
    stretch, = experiment_of([recording], recording_settings()).stretches
    assert np.abs(stretch.u[:, 2:]).max() < 1e-9
    assert value(stretch.u, 1.0)[:-2] == pytest.approx(recording.get("x_d")[1:-1], abs=1e-12)


def test_a_window_without_its_demand_holds_no_stretch(recording):
    """Of a long recording whose demand is missing for a whole window the others are taken."""
    gone = with_channels(without(recording, "omega"), x_d=np.full(len(recording), np.nan))
    held = settings(command_hold="sampled")
    assert stretches_of(gone, gone.channels, held, CLOSED, {}, True) == []
