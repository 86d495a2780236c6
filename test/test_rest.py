"""A machine that stands under a load is no mismatch; a stuck one is."""

import numpy as np
import pytest
from rig_tools import BETA, MULTISINE, B, settings, simulated

from eha_monitor.errors import InputError
from eha_monitor.estimation.inputs import REST_S, resting
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.estimation.results import NoiseEstimate
from eha_monitor.live.estimator import LiveEstimator
from eha_monitor.mismatch.compared import compared
from eha_monitor.recordings.recording import Recording

DT, NOISE = 1e-3, {"x": 1e-6, "x_d": 0.0, "omega": 0.1, "p1": 500.0, "p2": 500.0}
LEVELS = {name: NoiseEstimate(value, True) for name, value in NOISE.items()}


def standing(seconds=8.0, force=300.0, seed=0):
    """Return a piston that a seal holds under a force, with the sensors' noise."""
    rng, n, area = np.random.default_rng(seed), round(seconds / DT), settings().rig.area_1
    values = {"x": 0.01, "x_d": 0.01, "omega": 0.0, "p1": 2e6 + force / area, "p2": 2e6}
    return Recording(DT, {name: value + NOISE[name] * rng.standard_normal(n)
                          for name, value in values.items()})


def live_end(recording):
    live, time = LiveEstimator(settings()), np.arange(len(recording)) * DT
    for start in range(0, len(recording), 100):
        live.push_rows(time[start:start + 100], {
            name: values[start:start + 100] for name, values in recording.channels.items()})
    return live.snapshot()


@pytest.mark.parametrize("seed", range(3))
def test_a_piston_that_a_seal_holds_is_no_mismatch(seed):
    recording = standing(seed=seed)
    found = estimate(recording, settings())
    assert found.model.status == "not_judged"
    assert {p.status for p in found.parameters.values()} == {"not_excited"}
    assert all("nothing moves" in p.message for p in found.parameters.values())
    end = live_end(recording)
    assert end.model.status == "not_judged"
    assert {p.status for p in end.parameters.values()} == {"not_excited"}


def test_a_reference_that_stands_is_refused_and_a_recording_that_stands_has_no_answer():
    moving = [simulated(MULTISINE, 8.0).recording(seed) for seed in range(3)]
    with pytest.raises(InputError, match="reference recording in which the piston moves"):
        compared(moving[:1], [standing(seed=1)], settings())
    assert compared([standing()], moving, settings()).verdict == "insufficient_data"


def test_dwells_between_steps_change_nothing_that_is_known():
    steps = {"kind": "steps", "amplitude": 0.01, "frequency": 0.5, "seed": 3}
    recording = simulated(steps, 12.0).recording(0)
    levels = {name: NoiseEstimate(value, True) for name, value in {
        "x": 1e-6, "x_d": 0.0, "omega": 0.1, "p1": 500.0, "p2": 500.0}.items()}
    assert 0.2 < np.mean(resting(recording.channels, levels, DT, 0.0)) < 0.9
    for found in (estimate(recording, settings()), live_end(recording)):
        assert found.model.status == "consistent"
        assert found.parameters["B"].value == pytest.approx(B, rel=0.01)
        assert found.parameters["beta_e"].value == pytest.approx(BETA, rel=0.01)


def test_a_piston_that_does_not_follow_its_demand_is_no_rest():
    recording = standing()
    n = len(recording)
    wave = 0.01 * np.sin(2.0 * np.pi * np.arange(n) * DT)
    stuck = Recording(DT, {**recording.channels, "x_d": 0.01 + wave})
    assert resting(recording.channels, LEVELS, DT, 0.0).all()
    assert not resting(stuck.channels, LEVELS, DT, 0.0).any()
    assert estimate(stuck, settings()).model.status == "mismatch"


@pytest.mark.parametrize("speed", [0.0, 3e-5, 1e-3])
def test_motion_is_seen_within_the_window_and_chance_is_not(speed):
    recording = standing(20.0, seed=1)
    n = len(recording)
    path = np.maximum(np.arange(n) * DT - 10.0, 0.0) * speed
    found = resting({"x": recording.channels["x"] + path}, LEVELS, DT, 0.0)
    assert found[: round(10.0 / DT)].all()
    assert found[round((10.0 + REST_S) / DT):].all() == (speed == 0.0)
    assert not speed or not found[round((10.0 + REST_S) / DT):].any()
