"""Stamps of all kinds onto one grid: what is repaired, what is said."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eha_monitor.errors import InputError
from eha_monitor.recordings.align import align, interpolate
from eha_monitor.recordings.cdr import Series
from eha_monitor.settings import Settings, settings_from_tree

SETTINGS = Settings()
START = 1_700_000_000_000_000_000
N = 2000


def wave(t):
    return 0.04 * np.sin(2 * np.pi * 0.5 * np.asarray(t))


def stamps_of(t):
    return START + np.round(np.asarray(t) * 1e9).astype(np.int64)


def series(t, values, topic="a", log=None, stamped=True):
    stamps = stamps_of(t)
    return Series(stamps, stamps if log is None else stamps_of(log), np.asarray(values, float),
                  stamped), topic


def of(t, values, **options):
    return align({"x": series(t, values, **options)}, SETTINGS, source="test")


TIME = np.arange(N) * 1e-3


def test_clean():
    recording = of(TIME, wave(TIME))
    assert recording.losses == () and recording.sample_time == 1e-3
    np.testing.assert_array_equal(recording.channels["x"], wave(TIME))


def test_repeated_stamps():
    t = np.insert(TIME, [100, 100, 500], [TIME[99], TIME[99], TIME[499]])
    recording = of(t, wave(t))
    np.testing.assert_array_equal(recording.channels["x"], wave(TIME))
    assert recording.losses == ("a: 3 samples with a repeated stamp dropped",)


def test_late_messages_are_put_in_order():
    order = np.arange(N)
    order[[100, 101]] = order[[101, 100]]
    order[500:510] = np.roll(order[500:510], 3)
    recording = of(TIME[order], wave(TIME[order]))
    np.testing.assert_array_equal(recording.channels["x"], wave(TIME))
    assert recording.losses == ("a: 2 reversed stamps put in order",)


@pytest.mark.parametrize("back", [0.5, 0.3005, 0.30025, 5.0])
def test_clock_jumps_back(back):
    t = TIME.copy()
    t[1200:] -= back
    recording = of(t, wave(TIME), log=TIME)
    assert len(recording) == 1200
    np.testing.assert_array_equal(recording.channels["x"], wave(TIME[:1200]))
    assert "the clock jumps back 1 time (up to " in recording.losses[0]
    assert "800 samples dropped" in recording.losses[0]


def test_other_topics_follow_the_stretch_of_x():
    t = TIME.copy()
    t[900:] -= 0.9  # the clock starts anew: x keeps the second part
    recording = align({"x": series(t, wave(TIME), log=TIME),
                       "p1": series(t[:-150], 5 * TIME[:-150], "b", log=TIME[:-150])},
                      SETTINGS)
    assert len(recording) == 1100
    p1 = recording.channels["p1"]
    np.testing.assert_allclose(p1[:900], 5 * TIME[900:1800])


def test_dropped_second_stays_a_gap():
    keep = (TIME < 0.5) | (TIME >= 1.5)
    recording = of(TIME[keep], wave(TIME[keep]))
    assert len(recording) == N
    assert np.isnan(recording.channels["x"][500:1500]).all()
    assert np.isfinite(recording.channels["x"]).sum() == N - 1000
    assert recording.losses == ("no data from 0.500 s for 1.000 s",)


def test_many_gaps_are_summed_up():
    keep = np.ones(N, bool)
    for start in range(100, 1900, 200):
        keep[start:start + 20] = False
    losses = of(TIME[keep], wave(TIME[keep])).losses
    assert len(losses) == 4 and losses[-1] == "no data in 6 more gaps, 0.120 s in all"


def test_nan_infinite_and_absurd_values():
    x = wave(TIME)
    x[[3, 7, 9]] = np.nan
    x[11], x[12] = np.inf, -1e305
    recording = of(TIME, x)
    assert np.isnan(recording.channels["x"][[3, 7, 9, 11, 12]]).all()
    assert recording.losses[:3] == (
        f"x: 3 of {N} values are NaN", f"x: 1 of {N} values are infinite, left out",
        f"x: 1 of {N} values are not valid measurements (-1e+305 m at t = 0.012 s, beyond ±1e+09 "
        "m), "
        "left out")


def test_jitter_of_the_stamps_only():
    rng = np.random.default_rng(1)
    late = rng.uniform(0, 4e-4, N)
    recording = of(TIME + late, wave(TIME) + 1e-6 * rng.standard_normal(N))
    assert len(recording) == N and recording.sample_time == 1e-3
    np.testing.assert_allclose(recording.channels["x"], wave(TIME), atol=6e-6)
    assert "stamps jitter by 0.1" in recording.losses[0]


def test_uneven_sampling_is_interpolated():
    rng = np.random.default_rng(1)
    t = TIME + rng.uniform(0, 4e-4, N)
    recording = of(t, wave(t))
    grid = t[0] + recording.time
    np.testing.assert_allclose(recording.channels["x"], wave(grid), atol=1e-9)
    assert "sampled unevenly" in recording.losses[0]


def test_jitter_with_lost_samples():
    rng = np.random.default_rng(2)
    keep = rng.random(N) > 0.02
    keep[700:900] = False
    late = rng.uniform(0, 3e-4, N)
    recording = of((TIME + late)[keep], wave(TIME)[keep])
    x = recording.channels["x"]
    good = np.isfinite(x)
    assert good.sum() == keep.sum() and abs(len(x) - N) < 3
    np.testing.assert_allclose(x[good], wave(recording.time[good]), atol=1.5e-4)


def test_own_sample_time_beats_the_config():
    t = np.arange(N) * 1.02e-3
    recording = of(t, wave(t))
    assert recording.sample_time == pytest.approx(1.02e-3, rel=1e-9)
    assert "the stamps give a sample time of 1.02 ms" in recording.losses[0]
    assert np.isfinite(recording.channels["x"]).all()


def test_clock_that_drifts_against_the_config():
    t = np.arange(60_000) * 1e-3 * (1 + 5e-5)  # 3 samples in a minute
    recording = of(t, wave(t))
    assert len(recording) == 60_000 and np.isfinite(recording.channels["x"]).all()


def test_slower_topic_is_interpolated_but_not_over_gaps():
    slow = np.arange(0, 2, 0.01)
    slow = slow[(slow < 1.0) | (slow > 1.2)]
    recording = align({"x": series(TIME, wave(TIME)), "p1": series(slow, 3 * slow, "b")}, SETTINGS)
    p1 = recording.channels["p1"]
    assert np.isnan(p1[(TIME > 0.991) & (TIME < 1.209)]).all()
    np.testing.assert_allclose(p1[:990], 3 * TIME[:990], atol=1e-12)
    np.testing.assert_allclose(p1[1211:1990], 3 * TIME[1211:1990])
    assert any(loss.startswith("p1: no data from 0.99") for loss in recording.losses)


@pytest.mark.parametrize("jitter", [0.0, 2e-4])
def test_each_channel_at_a_rate_of_its_own(jitter):
    rng = np.random.default_rng(1)

    def own(rate, topic, quantity):
        t = np.arange(0, 2.0005, 1 / rate)
        return series(t + jitter * rng.standard_normal(len(t)), quantity(t), topic)

    recording = align({"x": series(TIME, wave(TIME)), "x_d": own(100, "b", wave),
                       "p1": own(500, "c", wave), "p2": own(500, "d", lambda t: -wave(t)),
                       "omega": own(5000, "e", wave)}, SETTINGS)
    assert recording.sample_time == 1e-3 and len(recording) == N
    speed, bend = 0.04 * np.pi, 0.04 * np.pi ** 2
    for name, step, sign in (("x_d", 0.01, 1), ("p1", 0.002, 1), ("p2", 0.002, -1),
                             ("omega", 0.0002, 1)):
        off = sign * recording.channels[name] - wave(TIME)
        assert np.isfinite(off[1:1990]).all(), name  # no holes, but for the very ends
        line = bend * step ** 2 / 8  # a straight line under the wave
        phase = speed * 4 * 1.25 * jitter * np.sqrt(step / 2)  # of a grid by the median stamp
        assert np.abs(off[1:1990]).max() <= 1.01 * line + phase + 1e-12, name
    for said in ("x_d: 100 Hz", "p1: 500 Hz", "p2: 500 Hz", "omega: 5000 Hz"):
        assert f"{said}, interpolated to 1000 Hz" in recording.losses


def test_position_at_half_the_rate_of_its_topic():
    x = wave(TIME)
    x[1::2] = np.nan
    recording = align({"x": series(TIME, x), "omega": series(TIME, 2 * TIME),
                       "p1": series(TIME, 7 * TIME, "b")}, SETTINGS)
    assert recording.sample_time == 1e-3 and len(recording) == N
    np.testing.assert_array_equal(recording.channels["x"], x)
    np.testing.assert_array_equal(recording.channels["omega"], 2 * TIME)
    np.testing.assert_array_equal(recording.channels["p1"], 7 * TIME)
    assert recording.losses == (f"x: {N // 2} of {N} values are NaN",)


def test_delay_of_whole_and_part_samples():
    for delay in (3e-3, 2.5e-3):
        recording = align({"x": series(TIME, wave(TIME)),
                           "p1": series(TIME - delay, 7 * TIME, "b")}, SETTINGS)
        np.testing.assert_allclose(recording.channels["p1"][:1990], 7 * (TIME[:1990] + delay))


def test_topic_on_another_clock_is_joined_by_log_time():
    log = TIME + 3600.0
    recording = align({"x": series(TIME, wave(TIME), log=log),
                       "p1": series(log, 7 * TIME, "b", log=log, stamped=False)}, SETTINGS)
    np.testing.assert_allclose(recording.channels["p1"], 7 * TIME)
    assert "b: its clock is 3600 s off, aligned by log time" in recording.losses


def test_channel_outside_the_range_of_x_is_absent():
    later = TIME + 100
    recording = align({"x": series(TIME, wave(TIME)), "p1": series(later, TIME, "b")}, SETTINGS)
    assert list(recording.channels) == ["x"]


def test_without_x_the_densest_channel_leads():
    slow = TIME[::10]
    recording = align({"p1": series(slow, slow, "b"), "p2": series(TIME, TIME, "c")}, SETTINGS)
    assert recording.sample_time == 1e-3 and len(recording) == N


@pytest.mark.parametrize("wild", [-1000.0, 5.0, 3e7, 1e8])
def test_one_wild_stamp(wild):
    for place in (0, 1000, N - 1):
        t = TIME.copy()
        t[place] = wild
        recording = of(t, wave(TIME))
        assert len(recording) <= max(N, 5001)
        good = np.isfinite(recording.channels["x"])
        assert good.sum() >= N - 2, recording.losses
        assert recording.losses


def test_stamps_without_a_grid_are_refused():
    t = np.cumsum(np.geomspace(1e-3, 3e3, 60))
    try:
        recording = of(t, t)
        assert len(recording) < 10**6
    except InputError as problem:
        assert "too sparse" in str(problem)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_tiny(n):
    recording = of(TIME[:n], wave(TIME[:n]))
    assert len(recording) == n
    assert len(of(np.zeros(n), wave(TIME[:n]))) == 1


@settings(max_examples=150)
@given(stamps=st.lists(st.integers(0, 2**62) | st.integers(0, 40).map(lambda k: k * 10**6),
                       min_size=1, max_size=40),
       other=st.lists(st.integers(0, 2**62) | st.integers(0, 40).map(lambda k: k * 10**6),
                      min_size=1, max_size=40), data=st.data())
def test_any_stamps(stamps, other, data):
    def drawn(found):
        stamp = np.array(found, dtype=np.int64)
        values = np.array(data.draw(st.lists(st.floats(), min_size=len(found),
                                             max_size=len(found))))
        return Series(stamp, stamp, values, True)

    try:
        recording = align({"x": (drawn(stamps), "a"), "p1": (drawn(other), "b")}, SETTINGS,
                          source="test")
    except InputError as problem:
        assert "\n" not in str(problem)
        return
    assert 1 <= len(recording) < 10**6
    assert all(len(values) == len(recording) for values in recording.channels.values())
    assert not any(np.isinf(values).any() for values in recording.channels.values())


def test_rate_of_the_config_is_only_a_hint():
    slow = settings_from_tree({"rig": {"sample_time": 0.01}}, "test")
    recording = align({"x": series(TIME, wave(TIME))}, slow)
    assert recording.sample_time == pytest.approx(1e-3)


def test_interpolation_of_straight_lines_is_exact():
    t = np.array([0.0, 1.0, 2.1, 3.0, 10.0, 11.0])
    at = np.linspace(-1, 12, 131)
    out = interpolate(t, 2 * t + 1, at, cubic=True)
    inside = ((at >= 0) & (at <= 3)) | ((at >= 10) & (at <= 11))
    np.testing.assert_allclose(out[inside], 2 * at[inside] + 1)
    assert np.isnan(out[~inside & (np.abs(at - 10) > 0.05)]).all()
