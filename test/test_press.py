"""Oil and pump of a press that meets its work: by arithmetic, check valves hold the low side."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from eha_monitor.balances.machine import healthy_machine_of
from eha_monitor.balances.measured import courses_of
from eha_monitor.balances.oil import compressibility
from eha_monitor.balances.together import of_one_machine
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import settings_from_tree

AREA, VOLUME, DISPLACEMENT, SOURCE = 3.06e-3, 4.8e-4, 3.23e-6, 1.1e6
B, DRY, WEIGHT, MASS = 5000.0, 260.0, 1530.0, 156.0
STIFF, CONTACT = 1.6e7, 0.055  # of the work, N/m, and where it stands, m
ACROSS, CASE = 4.8e-13, 4.5e-14  # leakages, m³/(s·Pa)
AMBIENT, DT = 101_325.0, 2e-3
SETTINGS = settings_from_tree({"rig": {
    "area_1": AREA, "area_2": AREA, "volume_1": VOLUME, "volume_2": VOLUME, "mass": MASS,
    "pump_displacement": DISPLACEMENT, "leakage": 1e-12, "charge_pressure": SOURCE,
    "position_gain": None, "sample_time": DT}}, "press.yaml")


def press(seed: int, modulus: float, case: float = CASE) -> Recording:
    """Return 40 s of a press: fast to its work, slowly into it, a rest, and back."""
    rng, when, places, yields = np.random.default_rng(seed), [0.0, 1.0], [-0.1, -0.1], []
    while when[-1] < 40.0:
        yields.append(rng.uniform(8e3, 2.2e4))
        for place, speed, rest in ((0.052, rng.uniform(0.13, 0.18), 0.0), (
                CONTACT + rng.uniform(2e-3, 4e-3), rng.uniform(0.012, 0.025),
                rng.uniform(0.5, 1.5)), (-0.1, 0.17, rng.uniform(0.8, 1.5))):
            when += [when[-1] + abs(place - places[-1]) / speed]
            places += [place]
            when, places = [*when, when[-1] + rest + 1e-3], [*places, place]
    t = DT * np.arange(int(when[-1] / DT))
    x = gaussian_filter1d(np.interp(t, when, places), 12)
    v = np.gradient(x, DT)
    work, deepest, part = np.zeros(len(t)), CONTACT, 0
    for k in range(len(t)):  # elastic up to what it yields at, and so on the way back
        if x[k] < 0.0:
            deepest, part = CONTACT, int(np.sum(np.array(when[3::6]) < t[k])) % len(yields)
        deepest = max(deepest, x[k])
        most = min(STIFF * (deepest - CONTACT), yields[part])
        work[k] = max(most - STIFF * (deepest - x[k]), 0.0)
    force = gaussian_filter1d(MASS * np.gradient(v, DT) + B * v + DRY * np.tanh(v / 2e-3)
                              + work - WEIGHT, 3)
    side = np.where(force > 0.0, 1.0, -1.0)
    high = SOURCE + np.abs(force) / AREA
    p1, p2 = np.where(side > 0.0, high, SOURCE), np.where(side > 0.0, SOURCE, high)
    flow = AREA * v + ACROSS * (p1 - p2) + side * (
        case * (high - AMBIENT) + (VOLUME + side * AREA * x) / modulus * np.gradient(high, DT))
    noise = rng.standard_normal((4, len(t)))
    return Recording(DT, {"x": x + 3e-6 * noise[0], "omega": flow / DISPLACEMENT + 0.03 * noise[1],
                          "p1": p1 + 4e3 * noise[2], "p2": p2 + 4e3 * noise[3]}, source=str(seed))


@pytest.mark.parametrize(("modulus", "case"), [
    (1.05e9, CASE), (1.05e9, 0.0), (0.63e9, CASE), (1.05e9, 8.0 * CASE)])
def test_what_leaks_to_the_case_is_no_oil(modulus, case):
    """Where pressure and its rate come and go together it read too soft, and was sure of it."""
    for seed in range(3):
        _, courses, _ = courses_of([press(seed, modulus, case)], SETTINGS)
        (course,) = of_one_machine(courses, SETTINGS.rig)
        found = compressibility(course, SETTINGS.rig)
        assert abs(found.value * modulus - 1.0) < 0.1, (seed, 1.0 / found.value)
        assert abs(found.value - 1.0 / modulus) < 4.0 * found.stddev < 0.4 * found.value


def test_a_pump_beside_check_valves_is_as_large_as_it_is():
    """A stranger's areas were called 2.6 % apart, and his pump 2.5 % small, at 0.03 %."""
    _, courses, _ = courses_of([press(seed, 1.05e9) for seed in range(4)], SETTINGS)
    machine = healthy_machine_of(courses, SETTINGS)
    (pump,) = (p for p in machine["flow"].parameters if p.name == "D_p")
    assert pump.value == pytest.approx(DISPLACEMENT, rel=0.005)
    assert abs(machine.apart) < 0.003
