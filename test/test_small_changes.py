"""What is said beside healthy recordings: changed, surely different but small, or nothing.

The rig is written down here with a few lines of numpy: a motion, the pressures that it takes, the
speed at which a pump delivers its flow to chamber 1, and a drive that lags its command.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from machine_tools import healthy_machine

from eha_monitor.balances.candidates import Scale, candidates_of
from eha_monitor.balances.changed import against
from eha_monitor.balances.course import IN_TURN
from eha_monitor.balances.judge import judge, steadier
from eha_monitor.balances.measured import course_of
from eha_monitor.balances.together import of_one_machine
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import settings_from_tree

A_1, A_2, VOLUME, BETA, PUMP = 3.1e-3, 2.1e-3, 6e-4, 0.9e9, 1.6e-6


def pumped(seed, leak=2.4e-12, pump=PUMP, lag=0.014, dry=280.0, seconds=24.0,
           delay=0.0, valves=False, damping=1.0, oil=None, load=5800.0, rough=0.0):
    """Return a recording; ``pump`` m³/rad, ``lag`` and ``delay`` s of the drive, ``dry`` N.

    Behind ``valves`` the pump fills chamber 2 on the way back.  With an ``oil`` so many times as
    viscous the damping is 6200 N s/m times that and ``damping``, and the leak is divided by it.
    The guides are ``rough``: so many N every 3 mm.
    """
    rng, dt = np.random.default_rng(seed), 2e-3
    t = np.arange(0.0, seconds, dt)
    w = 2.0 * np.pi * np.array([0.13, 0.37, 0.9, 2.1])
    size = np.array([0.03, 0.012, 0.004, 5e-4]) * rng.uniform(0.8, 1.2, 4)
    v = sum(a * b * np.cos(b * t + c) for a, b, c in zip(
        size, w, rng.uniform(0.0, 2.0 * np.pi, 4), strict=True))
    x = np.cumsum(v) * dt
    b, own = rng.uniform(5500.0, 7000.0), rng.uniform(0.85, 1.15)
    b, own = (b, own) if oil is None else (6200.0 * oil, 1.0 / oil)
    force = (500.0 * np.gradient(v, dt) + damping * b * v + load
             + dry * np.tanh(v / 5e-4) + 4e4 * x + rough * np.sin(2.0 * np.pi * x / 3e-3))
    p2 = 22e5 + 4e5 * np.sin(0.5 * t)
    p1 = (force + A_2 * p2) / A_1
    leak *= own
    omega = (A_1 * v + leak * (p1 - p2) + VOLUME / BETA * np.gradient(p1, dt)) / pump
    if valves:
        back = (A_2 * v + leak * (p1 - p2) - 5e-4 / BETA * np.gradient(p2, dt)) / pump
        omega = np.where(v > 0.0, omega, back)
    wanted = np.interp(t + delay, t, omega + lag * np.gradient(omega, dt))
    noise = {"x": 2e-6, "omega": 0.05, "omega_d": 0.01, "p1": 2e3, "p2": 2e3}
    return Recording(dt, {name: values + noise[name] * rng.standard_normal(len(t))
                          for name, values in (("x", x), ("omega", omega), ("omega_d", wanted),
                                               ("p1", p1), ("p2", p2))}, source=f"pumped {seed}")


@pytest.fixture(scope="module")
def settings():
    return settings_from_tree({"rig": {
        "area_1": A_1, "area_2": A_2, "volume_1": VOLUME, "volume_2": 5e-4, "mass": 500.0,
        "pump_displacement": 1.65e-6, "position_gain": None, "leakage": 5e-13,
        "makeup_conductance": 1e-13, "charge_pressure": 22e5}}, "a test")


@pytest.fixture(scope="module")
def machine(settings):
    return healthy_machine([pumped(seed) for seed in range(6)], settings)


def said(machine, recording, settings):
    return against(machine, [recording], settings, machine.sources)


def test_what_no_numbers_of_the_machine_describe_is_told_however_small(machine, settings):
    for seed in range(20, 26):
        judged = judge(machine, [course_of(pumped(seed), settings)], settings)
        assert not any(one.foreign for one in judged.balances)
    found = said(machine, pumped(20, rough=20.0), settings)  # 0.7 % of the force's signal
    assert found.verdict == "unexplained"
    assert re.search(r"force: the machine's terms fitted anew leave [45]\.?\d? times what they "
                     "leave of any healthy recording", found.message)


def test_a_damping_that_grew_a_little_at_its_temperature_is_told(settings):
    oils = np.exp(np.linspace(-0.4, 0.4, 6))
    healthy = [pumped(seed, oil=oil) for seed, oil in enumerate(oils)]
    warm = [replace(one, channels=one.channels | {"temperature": np.full(
        len(one), 40.0 - np.log(oil) / 0.03)}) for one, oil in zip(healthy, oils, strict=True)]
    machine = healthy_machine(warm, settings)
    worn = pumped(30, oil=1.1, damping=1.15)
    worn = replace(worn, channels=worn.channels | {"temperature": np.full(
        len(worn), 40.0 - np.log(1.1) / 0.03)})
    found = said(machine, worn, settings)
    assert found.verdict == "consistent"
    assert "viscous damping B is" in found.message
    assert "at the temperature of its oil" in found.message and "+1" in found.message


def test_healthy_is_nothing(machine, settings):
    for seed in (20, 21, 22):
        found = said(machine, pumped(seed), settings)
        assert found.verdict == "consistent"
        assert found.message.startswith("nothing has changed from 6 healthy recordings")


def test_a_small_sure_difference_has_its_name_and_its_value(machine, settings):
    """It was "the largest difference is pump loss by direction" for a pump of another size."""
    found = said(machine, pumped(23, pump=1.013 * PUMP), settings)
    assert found.verdict == "consistent" and not found.changes
    assert found.message.startswith(
        "what differs is too small to be called a change: the pump's displacement")
    more, doubt = map(float, re.search(r"\+([\d.]+) ± ([\d.]+) %", found.message).groups())
    # Oils that differ by 15 % leave 0.01 % of the pump's size in what healthy recordings have.
    assert more == pytest.approx(1.3, abs=0.4) and abs(more - 1.3) < 3.0 * np.hypot(doubt, 0.01)


@pytest.mark.parametrize("valves", [False, True])
def test_the_pumped_chamber_is_the_machines(settings, valves):
    """A leak had 0.8 of its size where chamber 2 was taken for filled on the way back."""
    healthy = [pumped(seed, valves=valves) for seed in range(6)]
    for made in (healthy, healthy[:1]):
        courses = of_one_machine([course_of(one, settings) for one in made], settings.rig)
        assert all((course.oil == IN_TURN) == valves for course in courses)
    found = said(healthy_machine(healthy, settings), pumped(28, leak=2.4e-11, valves=valves),
                 settings)
    (change,) = found.changes
    more = change.now.value - change.reference.value
    assert change.what == "cross_port_leakage"
    assert more == pytest.approx(2.16e-11, rel=0.18)  # each recording's oil is 15 % off at most


@pytest.mark.parametrize("more", [{"lag": 0.023}, {"delay": 0.009}])
def test_a_lag_is_the_drives_whichever_columns_hold_it(machine, settings, more):
    """It was "9 ms, where healthy have 0" where the change fell on the other column."""
    found = said(machine, pumped(24, **more), settings)
    (change,) = found.changes
    assert change.what == "drive_lag"
    assert change.reference.value == pytest.approx(0.014, rel=0.02)
    assert change.now.value == pytest.approx(0.023, rel=0.02)


def test_columns_of_one_number_add(settings):
    courses = [course_of(pumped(0, seconds=8.0), settings)]
    of = {kind: {c.name: c for c in candidates_of(kind, Scale.of(courses), settings.rig)}
          for kind in ("force", "flow", "drive")}
    drive, force, flow = of["drive"], of["force"], of["flow"]
    assert drive["tau"].adds_to(drive["tau_d"])
    assert force["F_z2"].adds_to(force["F_c"])
    assert force["F_s1"].adds_to(force["F_c"])
    assert not force["F_c"].adds_to(force["F_s1"])
    assert not flow["L"].adds_to(flow["L_1"]) and flow["L"].adds_to(flow["L"])


def test_a_leak_has_one_name(machine, settings):
    """What the first change leaves beside the healthy machine's other terms is no second one."""
    found = said(machine, pumped(25, leak=2.4e-11), settings)
    assert [one.what for one in found.changes] == ["cross_port_leakage"]


def test_what_is_small_is_beyond_its_limit(machine, settings):
    for recording in (pumped(26, dry=320.0), pumped(27, pump=0.985 * PUMP)):
        judged = judge(machine, [course_of(recording, settings)], settings)
        for one in judged.small:
            assert abs(one.deviations) > one.limit
            assert one.apart == pytest.approx(abs(one.here - one.machine) / abs(one.deviations))
        assert judged.belongs and judged.small, recording.source


@pytest.fixture(scope="module")
def in_oils(settings):
    return healthy_machine([pumped(seed, oil=oil) for seed, oil in enumerate(
        (0.75, 0.86, 0.97, 1.08, 1.19, 1.30))], settings)


def test_damping_is_compared_beside_the_oil_that_the_leakage_shows(in_oils, settings):
    """60 % more than warm oil has is what cold oil has, but then it leaks less."""
    found = said(in_oils, pumped(31, oil=0.85, damping=1.6), settings)
    (change,) = found.changes
    assert change.what == "B" and "that the leakage shows" in change.statement
    assert change.reference.value == pytest.approx(0.85 * 6200.0, rel=0.1)
    assert change.now.value == pytest.approx(1.6 * 0.85 * 6200.0, rel=0.1)


def test_a_leak_is_compared_beside_the_oil_that_the_damping_shows(in_oils, settings):
    found = said(in_oils, pumped(32, oil=1.2, leak=1.6 * 2.4e-12), settings)
    (change,) = found.changes
    assert change.what == "cross_port_leakage"
    assert "pressure_offset" in change.indistinguishable_from


def test_oil_as_warm_or_cold_as_ever_is_healthy(in_oils, settings):
    for seed, oil in ((33, 0.8), (34, 1.0), (35, 1.25)):
        assert said(in_oils, pumped(seed, oil=oil), settings).verdict == "consistent"


def test_a_sum_that_is_no_steadier_says_nothing():
    rng = np.random.default_rng(5)
    b, oil = rng.normal(0.0, 0.1, 6), rng.normal(0.0, 0.2, 6)
    assert steadier(b, b + rng.normal(0.0, 0.1, 6)) < 2.0
    assert steadier(oil, 0.02 * rng.normal(0.0, 1.0, 6)) > 2.0


def test_no_leak_is_less_than_none(settings):
    """Pressures of the wrong zero made "-1.6 l/(min MPa)" the healthy leakage of a machine."""
    healthy = healthy_machine([pumped(seed, leak=-2.4e-11) for seed in range(6)], settings)
    (leakage,) = [p.value for p in healthy["flow"].parameters if p.name == "L"]
    assert leakage + 0.5 * settings.rig.leakage == pytest.approx(0.0, abs=1e-15)
    assert all(p.value >= 0.0 for p in healthy["flow"].parameters if p.name in (
        "c", "L_1", "L_1a", "L_2a", "k_l"))


def test_a_load_matters_as_all_else_does(settings):
    """It was a change from 2 % of the signal, however much the balance leaves beside it."""
    rough = [pumped(seed, rough=220.0) for seed in range(6)]
    healthy = healthy_machine(rough, settings)
    (size,) = [one.size for one in healthy.balances if one.balance == "force"]
    slight = said(healthy, pumped(23, rough=220.0, load=5800.0 + 0.03 * size), settings)
    assert slight.verdict == "consistent"
    found = said(healthy, pumped(23, rough=220.0, load=5800.0 + 0.3 * size), settings)
    assert [one.what for one in found.changes] == ["constant_load"]


def test_signals_that_only_one_side_has_are_told(machine, settings):
    """The flow was left out without a word where the recording has no pump speed."""
    blind = pumped(24)
    blind = replace(blind, channels={name: blind.channels[name] for name in ("x", "p1", "p2")})
    lines = said(machine, blind, settings).health
    assert [line for line in lines if line.startswith("the flow is not compared: the recording")]


def test_references_of_another_size_are_told(settings):
    other = settings.model_copy(update={"rig": settings.rig.model_copy(update={
        "pump_displacement": 2.5 * PUMP})})
    healthy = healthy_machine([pumped(seed) for seed in range(3)], other)
    (line,) = said(healthy, pumped(24), other).health
    assert re.search(r"a pump displacement of 1\.6 cm³/rad where the config has 4", line)
