"""People who have never seen this project: one rig, three mistakes, and how they are scored."""

import pytest
from stranger_parts.commands import Answer, here
from stranger_parts.mistakes import MISTAKES
from stranger_parts.scoring import named
from strangers.check import check
from strangers.draw import draw_rig
from strangers.generate import record, truth_of
from strangers.rigs import CHIRP
from wrong_inputs import Trial

from eha_monitor.balances.answer import answered

BY_NAME = {mistake.name: mistake for mistake in MISTAKES}


def test_the_strangers_plant_keeps_its_balances():
    assert check(CHIRP).faults() == []


@pytest.mark.parametrize(("kind", "law"), [
    ("equal", "lugre"), ("two_pumps", "karnopp"), ("rod_accumulator", "rational")])
def test_a_drawn_rig_keeps_its_balances(kind, law):
    rig = draw_rig(3, 0, kind, law)
    found = check(rig.run(rig.settings[0], 4.0))
    assert found.flow < 1e-3 and found.energy < 2e-3, found
    assert found.damping < -0.5, found


def test_a_drawn_rig_is_the_same_each_time_and_its_sheet_is_within_the_tolerances():
    rig = draw_rig(3, 1)
    assert rig == draw_rig(3, 1)
    first, settings = record(rig, rig.settings[1], 2, 6.0)
    again, _ = record(rig, rig.settings[1], 2, 6.0)
    assert first.get("p1").tolist() == again.get("p1").tolist()
    truth = truth_of(rig, rig.settings[1])
    assert all(abs(one["tolerances"]) < 3.5 for one in truth["rig_off"])
    assert truth["B_span"][1] <= truth["B"] <= truth["B_span"][0]
    true = {getattr(rig.plant, name) for name in ("area_1", "mass", "gain", "reservoir")}
    assert not true & {settings.rig.area_1, settings.rig.mass, settings.rig.position_gain,
                       settings.rig.charge_pressure}


@pytest.mark.parametrize("name", ["e_swapped", "e_rpm", "u_pump_reversed"])
def test_a_mistake_is_named(name, tmp_path):
    score, = Trial(tmp_path, None, 0, here).scores(BY_NAME[name], ("estimate",))
    assert score.full, score
    assert not score.wrong, score


def finding(kind, channels, text, correction=None):
    return Answer(2, findings=({"kind": kind, "channels": channels, "finding": text,
                                "correction": correction or {}},))


@pytest.mark.parametrize(("name", "answer", "full", "place"), [
    ("e_swapped", finding("swapped", ["p1", "p2"], "p1 and p2 look swapped"), True, True),
    ("e_swapped", finding("sign", ["omega"], "the pump speed looks reversed"), False, False),
    ("e_rpm", finding("unit", ["omega"], "omega looks like rpm taken as rad/s"), True, True),
    ("e_rpm", finding("unit", ["omega"], "omega is 9.55 times too large"), True, True),
    ("e_rpm", finding("unit", ["omega"], "omega is 3 times too large"), False, True),
    ("e_rpm", finding("unit", ["pump_displacement"], "pump_displacement is 9.5 times too small, "
                      "or the pump speed is in rpm"), True, True),
    ("e_rpm", finding("unit", ["pump_displacement"], "displacement 9.5 times off"), False, False),
    ("e_x_mm", finding("unit", ["x", "x_d"], "x is not x_d", {"x": {"scale": 0.001}}),
     True, True),
    ("e_x_mm", finding("unit", ["x", "x_d"], "x is not x_d", {"x_d": {"scale": 1000.0}}),
     False, False),
    ("e_mass", finding("unit", ["rig.mass"], "the mass looks 10.2 times too large"), True, True),
    ("e_p1_twice", finding("swapped", ["p1", "p2"], "p1 and p2 are the same column"),
     True, True),
    ("e_gauge", finding("hold", ["x_d"], "the drive holds x_d over a sample"), False, False),
    ("e_swapped", Answer(2, lines=("bag: p1 and p2 look swapped: correlation -0.98",)),
     True, True),
    ("e_swapped", Answer(70, lines=("p1 and p2 look swapped",)), False, False),
    ("e_swapped", Answer(0), False, False),
])
def test_the_score_of_what_is_said(name, answer, full, place):
    assert named(answer, BY_NAME[name].truths) == (full, place)


@pytest.mark.parametrize("k", [0, 1])
def test_a_load_within_the_areas_tolerance_leaves_nothing_open(k):
    """A healthy rig whose bore is a little off: at 30 bar that is more force than its motion."""
    rig = draw_rig(290201, 2)
    recording, settings = record(rig, rig.settings[k], 290201 + k)
    assert not truth_of(rig, rig.settings[k])["effects"]
    found = answered([recording], settings)
    assert found.verdict == "consistent" and not found.effects
    assert found.signals["force"].before_rms > 0.3 * found.signals["force"].signal_rms
