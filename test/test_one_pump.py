"""A single-rod cylinder whose one pump fills the chamber of the higher pressure, by arithmetic."""

import numpy as np
import pytest

from eha_monitor.balances.baseline import baseline
from eha_monitor.balances.course import ONE_PUMP
from eha_monitor.balances.measured import courses_of
from eha_monitor.balances.together import of_one_machine
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import settings_from_tree

A_1, A_2, D, SOFT, LEAK = 3.1e-3, 1.5e-3, 1.6e-6, 2e-13, 8e-12  # SI; SOFT = V / beta_e


def recorded(load, seed):
    """Return a motion beside an accumulator at 0.6 MPa, under a load of each moment, N."""
    rng, dt = np.random.default_rng(seed), 0.002
    t = dt * np.arange(12_000)
    x = 0.02 * np.sin(2.0 * np.pi * 0.3 * t) + 0.006 * np.sin(2.0 * np.pi * 1.1 * t + seed)
    v = np.gradient(x, dt)
    force = load(t) + 2000.0 * v + 150.0 * np.tanh(v / 1e-3)
    first, low = force > 0.0, 6e5
    p1 = low + np.where(first, force / A_1, 0.0)
    p2 = low + np.where(first, 0.0, -force / A_2)
    # Into the chamber of the higher pressure: its area's flow, its oil and what leaks out of it.
    flow = np.where(first, A_1 * v + SOFT * np.gradient(p1, dt),
                    A_2 * v - SOFT * np.gradient(p2, dt)) + LEAK * (p1 - p2)
    channels = {"x": x + 1e-7 * rng.standard_normal(len(t)), "omega": flow / D,
                "p1": p1 + 200.0 * rng.standard_normal(len(t)),
                "p2": p2 + 200.0 * rng.standard_normal(len(t))}
    return Recording(dt, channels, source=f"run_{seed}")


@pytest.mark.parametrize("load", [
    lambda t: np.full(len(t), -4000.0),  # hangs: it is always chamber 2
    lambda t: 4000.0 * np.sign(np.sin(2.0 * np.pi * 0.05 * t + 0.1))], ids=["hangs", "turns"])
def test_its_displacement_and_its_leak_are_those_of_the_chamber_it_fills(load):
    settings = settings_from_tree({"rig": {
        "area_1": A_1, "area_2": A_2, "pump_displacement": 1.02 * D, "volume_1": 2e-4,
        "volume_2": 2e-4, "leakage": 1e-12, "charge_pressure": 6e5, "position_gain": None,
        "mass": 1.0}}, "rig.yaml")
    recordings = [recorded(load, seed) for seed in range(4)]
    courses = of_one_machine(courses_of(recordings, settings)[1], settings.rig)
    assert {course.oil for course in courses} == {ONE_PUMP}
    for recording in recordings:
        flow = baseline(recording, settings).flow
        assert flow["D_p"].value == pytest.approx(D, rel=0.01)
        assert flow["C_L"].value == pytest.approx(LEAK, rel=0.05)
