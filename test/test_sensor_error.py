"""A sensor's error is told from what one balance takes it for by what else moves with it."""

from dataclasses import replace

import numpy as np
import pytest
from rig_tools import settings, simulated

from eha_monitor.mismatch.compared import compared

LEAKS = {"leakage": 4e-12, "makeup_conductance": 4e-13}
MOTION = {"kind": "chirp", "amplitude": 0.02, "frequency": 0.2, "frequency_end": 1.5}
LOADED = {"constant_load": {"F_0": 150.0}}


@pytest.fixture(scope="module")
def healthy():
    return [simulated(MOTION | {"amplitude": a}, 20.0, rig=LEAKS).recording(seed)
            for seed, a in enumerate((0.018, 0.02, 0.022, 0.019))]


def now(effects=None):
    return simulated(MOTION, 20.0, rig=LEAKS, effects=effects or {}).recording(9)


@pytest.mark.parametrize("channel, off", [("p1", 3e5), ("p1", -2e5), ("p2", 3e5)])
def test_a_sensor_that_reads_too_high_is_no_load_and_no_leak(healthy, channel, off):
    recording = now()
    channels = recording.channels | {channel: recording.channels[channel] + off}
    found = compared([replace(recording, channels=channels)], healthy, settings(rig=LEAKS))
    (change,) = found.changes
    assert (found.verdict, change.what, change.balance) == ("mismatch", "pressure_offset",
                                                            "sensor")
    assert f"sensor of {channel} reads" in found.message and not found.effects
    right = off if change.symbol == {"p1": "b_1", "p2": "b_2"}[channel] else -off
    assert abs(change.now.value - right) < 3.0 * change.now.stddev < 0.1 * abs(off)
    assert found.location.balance["sensor"] == 1.0


@pytest.mark.parametrize("late", [0.004, 0.008])
def test_a_position_that_is_late_is_no_slower_pump_and_no_smaller_gain(healthy, late):
    recording = now()
    t = recording.sample_time * np.arange(len(recording))
    x = np.interp(t - late, t, recording.channels["x"])
    found = compared([replace(recording, channels=recording.channels | {"x": x})], healthy,
                     settings(rig=LEAKS))
    (change,) = found.changes
    assert (found.verdict, change.what, change.symbol) == ("mismatch", "position_delay", "T")
    assert change.now.value == pytest.approx(late, rel=0.03) and "ms late" in found.message


def test_a_smaller_gain_of_the_drive_is_no_late_position(healthy):
    slow = simulated(MOTION, 20.0, rig=LEAKS | {"position_gain": 0.9 * 23000.0}).recording(9)
    (change,) = compared([slow], healthy, settings(rig=LEAKS)).changes
    assert change.what == "drive_gain" and "position_delay" not in change.indistinguishable_from


@pytest.mark.parametrize("off", [0.04, -0.04])
def test_a_pressure_sensor_of_another_scale_is_among_what_is_told(healthy, off):
    recording = now()
    channels = recording.channels | {"p1": recording.channels["p1"] * (1.0 + off)}
    found = compared([replace(recording, channels=channels)], healthy, settings(rig=LEAKS))
    change, *others = found.changes
    assert not others and (
        change.what == "pressure_scale" or "too much" in change.statement
        or "too little" in change.statement or "pressure_scale" in change.indistinguishable_from)


def test_a_transmitter_of_another_range_is_no_load_and_no_leak(healthy):
    # What its scale makes of a load is but the first guess of it.
    recording = now()
    channels = recording.channels | {"p1": recording.channels["p1"] * 0.64}
    found = compared([replace(recording, channels=channels)], healthy, settings(rig=LEAKS))
    (change,) = found.changes
    assert (found.verdict, change.what, change.symbol) == ("mismatch", "pressure_scale", "k_1")
    assert change.now.value == pytest.approx(-0.36, abs=2.0 * change.now.stddev)
    assert change.now.stddev < 0.05


def test_a_load_is_no_error_of_a_sensor(healthy):
    found = compared([now(LOADED)], healthy, settings(rig=LEAKS))
    (change,) = found.changes
    assert change.what == "constant_load" and "pressure_offset" not in (
        change.indistinguishable_from)
    assert change.now.value == pytest.approx(150.0, abs=3.0 * change.now.stddev)
    assert np.isfinite(change.now.stddev)


def test_gaps_of_a_logger_are_no_change(healthy):
    recording = now()
    holes = np.zeros(len(recording), dtype=bool)
    for first, last in ((5.0, 7.0), (11.0, 11.5), (16.0, 16.05)):
        holes[round(first / recording.sample_time):round(last / recording.sample_time)] = True
    channels = {name: np.where(holes, np.nan, values)
                for name, values in recording.channels.items()}
    found = compared([replace(recording, channels=channels)], healthy, settings(rig=LEAKS))
    assert (found.verdict, found.changes) == ("consistent", ())
    assert "a change shows from" in found.advice[-1]


def test_too_short_a_motion_is_no_change(healthy):
    recording = now()
    short = {name: values[4000:4800] for name, values in recording.channels.items()}
    found = compared([replace(recording, channels=short)], healthy, settings(rig=LEAKS))
    assert found.verdict in ("consistent", "insufficient_data")
