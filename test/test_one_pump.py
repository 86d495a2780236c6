"""A single-rod cylinder whose one pump fills the chamber of the higher pressure, by arithmetic."""

from dataclasses import replace

import numpy as np
import pytest

from eha_monitor.balances.baseline import baseline
from eha_monitor.balances.course import HIGHER, ONE_PUMP
from eha_monitor.balances.measured import course_of, courses_of
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


def test_no_flow_is_balanced_where_check_valves_feed_both_chambers():
    """Two seconds in the middle at the source's pressure: a spring moves the piston there."""
    area, t, rng = 1.3e-3, np.arange(0.0, 12.0, 1e-3), np.random.default_rng(1)
    x = 2e-2 * np.sin(2.0 * np.pi * 0.4 * t)
    free = (t > 5.0) & (t < 7.0)
    head = np.where(free, 0.0, 8e5 * np.sin(2.0 * np.pi * 0.4 * t + 0.3))
    recording = Recording(1e-3, {
        "x": x, "omega": area * np.gradient(x, t) / 1e-6 * np.where(free, 3.0, 1.0),
        **{name: 1.3e6 + np.maximum(side * head, 0.0) + 500.0 * rng.standard_normal(len(t))
           for name, side in (("p1", 1.0), ("p2", -1.0))}})
    config = settings_from_tree({"rig": {
        "area_1": area, "area_2": 0.7 * area, "volume_1": 2e-4, "volume_2": 2e-4, "mass": 20.0,
        "pump_displacement": 1e-6, "position_gain": None}}, "a test")
    course = replace(course_of(recording, config), oil=HIGHER)
    at = np.arange(len(course)) * course.dt
    assert not course.counted("flow")[(at > 5.2) & (at < 6.8)].any()
    assert course.good[(at > 5.2) & (at < 6.8)].any()
    assert course.counted("flow").sum() > 0.5 * course.good.sum()
    none = replace(course, good=np.zeros(len(course), dtype=bool))
    assert not none.counted("flow").any()
