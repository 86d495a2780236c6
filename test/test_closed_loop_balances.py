"""A position loop around a pump: its drive's limit, and the pressure of what feeds the chambers.

The rig is written here with a few lines: the piston takes what the pump gives, the pressures what
the force asks for.  Nothing of the simulator or of the catalogue takes part.
"""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from machine_tools import healthy_machine
from scipy.ndimage import gaussian_filter1d

from eha_monitor.balances.answer import Asked, answered
from eha_monitor.balances.changed import _fed, against
from eha_monitor.balances.judge import judge
from eha_monitor.balances.measured import course_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import settings_from_tree

AREA, PUMP, GAIN, MASS, DAMPING = 1.4e-3, 1.9e-7, 1.5e5, 180.0, 4000.0
DT, SECONDS, LAG, HELD = 4e-3, 24.0, 6e-3, ("h",) * 5


def loop(seed, limit=np.inf, source=5e5, gust=0.0, dry=300.0, load=0.0, pump=PUMP, wider=1.0):
    """Return a recording; ``limit`` of the drive in rad/s, ``source`` pressure in Pa, a random
    ``gust``, ``dry`` friction and ``load`` in N.

    ``wider`` : areas over the config's.
    """
    area = wider * AREA
    rng = np.random.default_rng(seed)
    fine = 8
    h = DT / fine
    t = np.arange(0.0, SECONDS, h)
    x_d = sum(0.02 / k * np.sin(2 * np.pi * 0.37 * k * t + phase)
              for k, phase in zip((1, 2.3, 4.1), rng.uniform(0, 6, 3), strict=True))
    x, omega = np.empty_like(t), np.empty_like(t)
    now, speed = x_d[0], 0.0
    for i, wanted in enumerate(x_d):
        x[i], omega[i] = now, speed
        speed += (np.clip(GAIN * (wanted - now), -limit, limit) - speed) * h / LAG
        now += pump / area * speed * h
    v = pump / area * omega
    force = MASS * np.gradient(v, h) + DAMPING * v + dry * np.tanh(v / 1e-3) + load
    force += gust * gaussian_filter1d(rng.standard_normal(len(t)), 0.1 / h) * np.sqrt(0.35 / h)
    channels = {
        "x": x + 2e-6 * rng.standard_normal(len(t)), "x_d": x_d,
        "omega": omega + 0.1 * rng.standard_normal(len(t)),
        "p1": source + np.maximum(force, 0.0) / area + 2e3 * rng.standard_normal(len(t)),
        "p2": source + np.maximum(-force, 0.0) / area + 2e3 * rng.standard_normal(len(t))}
    return Recording(DT, {name: values[::fine] for name, values in channels.items()},
                     source=f"loop {seed}")


@pytest.fixture(scope="module")
def settings():
    return settings_from_tree({"rig": {
        "name": "loop", "area_1": AREA, "area_2": AREA, "volume_1": 1.2e-4, "volume_2": 1.2e-4,
        "mass": MASS, "viscous_damping": DAMPING, "pump_displacement": PUMP,
        "position_gain": GAIN, "charge_pressure": 5e5, "sample_time": DT}}, "loop")


@pytest.fixture(scope="module")
def healthy(settings):
    return healthy_machine([loop(seed) for seed in range(5)], settings)


def test_a_healthy_one_is_left_alone(healthy, settings):
    for seed in (10, 11, 12):
        assert against(healthy, [loop(seed)], settings, HELD).verdict == "consistent"


def test_a_pump_of_another_machine_among_the_references_is_found(settings):
    """A spread of 5 % for every number had hidden one of a fifth less."""
    machine = healthy_machine([*(loop(seed) for seed in range(4)), loop(4, pump=0.8 * PUMP)],
                              settings)
    (odd,) = machine.odd
    assert odd.source == "loop 4" and "pump displacement" in odd.why
    found = against(machine, [loop(10, pump=0.96 * PUMP)], settings, HELD)
    assert [one.what for one in found.changes] == ["pump_displacement"]


def test_pump_and_mass_off_by_one_share_are_wider_areas(healthy, settings):
    wider, worn = (" ".join(against(healthy, [one], settings, HELD).health) for one in (
        loop(10, wider=1.1), loop(10, pump=0.9 * PUMP)))
    assert "with piston areas that are larger" in wider and "areas" not in worn


def test_a_load_that_differs_is_written_as_the_mean(settings):
    recordings = [loop(seed, load=load) for seed, load in enumerate((400.0, 520.0, 640.0))]
    mean, first = (answered(recordings, settings, Asked(newest=newest)).config_effects[
        "constant_load"]["F_0"] for newest in (False, True))
    assert mean == pytest.approx(520.0, abs=15.0) and first == pytest.approx(400.0, abs=15.0)


def test_a_load_of_the_config_is_written_as_the_recordings_know_it(settings):
    """Within its tolerance it is no finding, and hundreds of times a filter's noise."""
    known = settings.model_copy(update={"effects": {"constant_load": {"F_0": 400.0}}})
    found = answered([loop(seed, load=440.0) for seed in range(3)], known)
    assert "constant_load" not in [effect.name for effect in found.effects]
    assert found.config_effects["constant_load"]["F_0"] == pytest.approx(440.0, abs=10.0)


@pytest.mark.parametrize(("source", "seed"), [(1.5e5, 20), (9e5, 21), (4e5, 22)])
def test_another_pressure_of_the_source_is_a_change(healthy, settings, source, seed):
    found = against(healthy, [loop(seed, source=source)], settings, HELD)
    (change,) = found.changes
    assert found.verdict == "mismatch" and change.what == "charge_pressure"
    assert change.now.value - change.reference.value == pytest.approx(source - 5e5, abs=2e3)
    assert change.reference.value == pytest.approx(5e5, rel=0.03)  # its band rings a little
    assert "pressure_offset" in change.indistinguishable_from


def test_one_chamber_that_runs_emptier_has_its_own_make_up_valve(healthy, settings):
    """A check valve that sticks was told as the pressure of the source, which both share."""
    one = loop(23)
    p1, p2 = one.channels["p1"], one.channels["p2"]
    starved = replace(one, channels={**one.channels, "p1": np.where(p1 < p2, p1 - 2e5, p1)})
    found = against(healthy, [starved], settings, HELD)
    change = next(c for c in found.changes if c.what == "makeup_valve")
    assert change.now.value - change.reference.value == pytest.approx(-2e5, rel=0.1)
    assert "chamber 1" in change.statement and "chamber 2 as before" in change.statement


def test_a_worn_pump_is_named_beside_a_drive_that_nobody_knows(healthy, settings):
    """A feed-forward of the loop left the drive open, and hid what the flow said had changed."""
    one = loop(24)
    worn = replace(one, channels={**one.channels, "omega": one.channels["omega"] / 0.94})
    judged = judge(healthy, [course_of(worn, settings)], settings)
    assert {moved.candidate.balance for moved in judged.changed} == {"flow", "drive"}
    left_open = replace(judged, balances=tuple(
        replace(each, complete=False, error=0.5, after=0.4, usual=0.1)
        if each.balance == "drive" else each for each in judged.balances))
    assert not left_open.explained and left_open.apart().explained
    assert [moved.candidate.name for moved in left_open.apart().changed] == ["D_p"]
    nothing = replace(left_open, balances=tuple(
        replace(each, complete=False, error=0.5, after=0.4, usual=0.1)
        for each in left_open.balances))
    assert nothing.apart() is nothing and not nothing.explained


def test_a_drive_at_its_limit_is_no_change_of_its_gain(healthy, settings):
    top = np.abs(loop(30).channels["omega"]).max()
    found = against(healthy, [loop(30, limit=0.4 * top)], settings, HELD)
    assert found.verdict == "unexplained" and not found.changes
    assert "drive: the machine's terms fitted anew leave" in found.message
    assert "the nearest, which does not explain it" in found.message


def test_a_limit_far_below_what_is_asked_for_is_named(settings):
    """What the limit takes away is several times what the drive gives."""
    top = np.abs(loop(30).channels["omega"]).max()
    found = answered([loop(30, limit=0.3 * top)], settings)
    named = {effect.name: effect for effect in found.effects}
    assert "drive_saturation" in named and not found.rig_data
    assert named["drive_saturation"].parameters["omega_max"].value == pytest.approx(
        0.3 * top, rel=0.03)


def test_what_the_config_leaves_is_told_where_nothing_explains_it(settings):
    quiet, gusty = (answered([loop(40, gust=gust, dry=0.0)], settings) for gust in (0.0, 40.0))
    assert quiet.verdict == gusty.verdict == "consistent"
    assert "of the force" not in quiet.message
    assert re.search(r"but for \d+ % of the force, of which no effect", gusty.message)


@pytest.mark.parametrize("zero", [0.0, 3e-4])
def test_the_recorders_zero_is_no_law_of_the_drive(settings, zero):
    # K times 0.3 mm is a speed that had made a feed-forward in the place of the whole gain.
    recordings = [replace(one, channels=one.channels | {"x": one.channels["x"] + zero})
                  for one in (loop(seed) for seed in range(5))]
    drive = {p.name: p.value for p in healthy_machine(recordings, settings)["drive"].parameters}
    lag = drive.pop("tau", None) or drive.pop("tau_d")
    assert lag == pytest.approx(LAG, rel=0.05)
    assert set(drive) == {"k_d"} and abs(drive["k_d"]) < 0.01


def test_what_the_make_up_path_lacks_from_a_lower_source_is_no_leak(settings):
    column = np.linspace(1e6, 3e6, 50)
    table = SimpleNamespace(rows=np.column_stack([column, column]), good=np.ones(50, bool),
                            places={"L_1": 1})
    judged = SimpleNamespace(balances=(SimpleNamespace(balance="flow", table=table),))
    source = SimpleNamespace(now=SimpleNamespace(value=7e5), reference=SimpleNamespace(value=13e5))
    most = settings.rig.makeup_conductance * np.exp(
        2.0 * settings.rig.tolerance.log_spread("makeup_conductance")) * 6e5
    for share, fed in ((0.9, True), (1.1, False)):
        grown = share * most / np.sqrt(np.mean(column**2))
        moved = SimpleNamespace(candidate=SimpleNamespace(name="L_1", effect="external_leakage"),
                                here=2e-13 + grown, machine=2e-13)
        assert _fed(moved, judged, source, settings.rig) is fed
