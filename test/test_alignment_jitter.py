"""Stamps that jitter by much: nothing is dropped, and the estimate stays what it is."""

from functools import cache

import numpy as np
import pytest

from eha_monitor.recordings.align import align
from eha_monitor.recordings.cdr import Series
from eha_monitor.settings import Settings

SETTINGS = Settings()
START = 1_700_000_000_000_000_000
TOPICS = {"x": "joints", "omega": "joints", "x_d": "command", "p1": "first", "p2": "second"}
N = 12_000
TAKEN = START + np.arange(N) * 1_000_000


@cache
def plant():
    from eha_monitor.physics.simulator import Simulator

    return Simulator(SETTINGS, 1).advance(N)


def jitters(kind, shared, seed=0, count=N):
    """Return topic -> (n,) ns that its stamps are off."""
    rng = np.random.default_rng(seed)
    draw = {"uniform 200": lambda: rng.uniform(-2e5, 2e5, count),
            "normal 200": lambda: 2e5 * rng.standard_normal(count),
            "normal 500": lambda: 5e5 * rng.standard_normal(count),
            "exponential 300": lambda: rng.exponential(3e5, count)}[kind]
    off = {topic: np.round(draw()).astype(np.int64) for topic in dict.fromkeys(TOPICS.values())}
    return {topic: off["joints"] if shared else off[topic] for topic in off}


def jittered(kind, shared, kept=None):
    off, series = jitters(kind, shared), {}
    for name, topic in TOPICS.items():
        keep = slice(None) if kept is None else kept[topic]
        series[name] = (Series((TAKEN + off[topic])[keep], TAKEN[keep], plant()[name][keep],
                               True), topic)
    return align(series, SETTINGS, source="test")


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("kind", ["uniform 200", "normal 200", "normal 500", "exponential 300"])
def test_every_sample_keeps_its_place(kind, shared):
    recording = jittered(kind, shared)
    assert recording.sample_time == 1e-3 and len(recording) == N
    for name in TOPICS:
        np.testing.assert_array_equal(recording.channels[name], plant()[name], err_msg=name)
    for topic in jitters(kind, shared):
        assert any(loss.startswith(f"{topic}: stamps jitter by") for loss in recording.losses)
    assert not any("drop" in loss or "jumps" in loss for loss in recording.losses)
    if kind.startswith("normal"):
        assert any("reversed by jitter, the order of arrival is kept" in loss
                   for loss in recording.losses)


@pytest.mark.parametrize("shared", [False, True])
def test_the_estimate_does_not_mind(shared):
    from eha_monitor.estimation.pipeline import estimate

    for kind in ("uniform 200", "normal 200"):
        found = estimate(jittered(kind, shared), SETTINGS).parameters
        assert found["B"].value == pytest.approx(SETTINGS.rig.viscous_damping, rel=0.01)
        assert found["beta_e"].value == pytest.approx(SETTINGS.rig.bulk_modulus, rel=0.05)


@pytest.mark.parametrize("kind, misplaced", [("uniform 200", 0), ("normal 200", 20)])
def test_jitter_with_lost_samples_of_each_topic(kind, misplaced):
    rng = np.random.default_rng(3)
    kept = {topic: rng.random(N) > 0.01 for topic in TOPICS.values()}
    for keep in kept.values():
        keep[0] = keep[-1] = True
    recording = jittered(kind, False, kept)
    assert recording.sample_time == 1e-3 and len(recording) == N
    for name, topic in TOPICS.items():
        expected = np.where(kept[topic], plant()[name], np.nan)
        wrong = ~((recording.channels[name] == expected)
                  | (np.isnan(expected) & np.isnan(recording.channels[name])))
        assert wrong.sum() <= misplaced, name


def of(stamps, values, log=None):
    stamps = np.asarray(stamps)
    series = Series(stamps, stamps if log is None else log, np.asarray(values, float), True)
    return align({"x": (series, "a")}, SETTINGS, source="test")


def test_a_late_message_under_jitter_goes_where_it_belongs():
    x = plant()["x"]
    stamps = TAKEN + jitters("uniform 200", True)["joints"]
    order = np.arange(N)
    for place in (1000, 5000, 9000):
        order[place:place + 8] = np.roll(order[place:place + 8], -1)  # seven overtake one
    recording = of(stamps[order], x[order])
    np.testing.assert_array_equal(recording.channels["x"], x)
    assert any("put in order" in loss for loss in recording.losses)


@pytest.mark.parametrize("back", [0.004, 0.0155, 0.045])
def test_a_small_setback_is_no_clock_jump(back):
    x = plant()["x"]
    stamps = TAKEN.copy()
    stamps[7000:] -= round(back * 1e9)
    recording = of(stamps, x, log=TAKEN)
    assert recording.sample_time == pytest.approx(1e-3, rel=1e-6)
    np.testing.assert_array_equal(recording.channels["x"], x)
    assert not any("drop" in loss or "jumps" in loss for loss in recording.losses)


def test_a_clock_jump_under_jitter_keeps_the_longest_stretch():
    x = plant()["x"]
    stamps = TAKEN + jitters("normal 500", True)["joints"]
    stamps[8000:] -= 3_000_000_000
    recording = of(stamps, x, log=TAKEN)
    np.testing.assert_array_equal(recording.channels["x"], x[:8000])
    assert "the clock jumps back 1 time" in recording.losses[0]
    assert "4000 samples dropped" in recording.losses[0]


def test_own_rate_under_jitter():
    x = plant()["x"]
    stamps = START + np.arange(N) * 1_234_567 + jitters("normal 200", True)["joints"]
    recording = of(stamps, x)
    assert recording.sample_time == pytest.approx(1.234567e-3, rel=1e-6)
    np.testing.assert_array_equal(recording.channels["x"], x)


@pytest.mark.parametrize("step", [1_040_000, 10_400_000, 247_000])
def test_own_rate_near_the_config_with_jitter_and_losses(step):
    rng = np.random.default_rng(4)
    keep = rng.random(N) > 0.01
    keep[0] = keep[-1] = True
    stamps = START + np.arange(N) * step + np.round(
        0.1 * step * rng.uniform(-1, 1, N)).astype(np.int64)
    recording = of(stamps[keep], plant()["x"][keep])
    assert recording.sample_time == pytest.approx(step * 1e-9, rel=1e-4)
    assert abs(len(recording) - N) <= 2
    assert abs(np.isfinite(recording.channels["x"]).sum() - keep.sum()) <= 1
