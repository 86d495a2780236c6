"""Whose circuit a single rod is on: two pumps that match its areas, or one and an accumulator."""

from dataclasses import replace

import pytest
from strangers.draw import draw_rig
from strangers.generate import record

from eha_monitor.balances.circuit import one_side_is_held
from eha_monitor.balances.measured import course_of
from eha_monitor.mismatch.data.experiment import by_balances
from eha_monitor.mismatch.diagnose import HELD, diagnose

SEED = 450601
TWO_PUMPS, ACCUMULATOR, DOUBLE_ROD = (0, 3, 15, 16), (12, 18, 19), (4,)  # rigs of that draw


def drawn(place, setting=0):
    rig = draw_rig(SEED, place)
    return record(rig, rig.settings[setting], SEED + setting)


@pytest.mark.parametrize("place", TWO_PUMPS + ACCUMULATOR + DOUBLE_ROD)
def test_one_side_is_held_by_an_accumulator_alone(place):
    for setting in (0, 1):
        recording, settings = drawn(place, setting)
        assert one_side_is_held(course_of(recording, settings), settings.rig) == (
            place in ACCUMULATOR)


def test_a_config_of_two_pumps_on_another_circuit_is_judged_by_the_balances():
    recording, settings = drawn(ACCUMULATOR[0])
    rig = settings.rig.model_copy(update={"makeup_conductance": 1e-13, "leakage": 1e-12})
    settings = settings.model_copy(update={"rig": rig})
    assert by_balances([recording], settings)
    assert diagnose([recording], settings).advice[0] == HELD


def test_a_force_that_the_balances_judge_says_nothing_of_the_circuit():
    """Where no pump is recorded, nobody has seen which side it presses."""
    recording, settings = drawn(ACCUMULATOR[0])
    rig = settings.rig.model_copy(update={"makeup_conductance": 1e-13, "leakage": 1e-12})
    moved = replace(recording, channels={
        name: recording.channels[name] for name in ("x", "p1", "p2")})
    one = settings.stage_one.model_copy(update={"prior": 10.0 * rig.mass / rig.sample_time})
    settings = settings.model_copy(update={"rig": rig, "stage_one": one})
    assert by_balances([moved], settings)  # it answers to the force within a sample
    assert HELD not in diagnose([moved], settings).advice


def test_two_pumps_are_left_to_the_filter():
    recording, settings = drawn(TWO_PUMPS[1])
    assert settings.rig.makeup_conductance > 0.0 and not by_balances([recording], settings)


def test_nothing_is_said_without_pressures_or_volumes():
    recording, settings = drawn(ACCUMULATOR[0])
    course = course_of(recording, settings)
    rig = settings.rig.model_copy(update={"volume_1": None})
    assert not one_side_is_held(course, rig)
    assert not one_side_is_held(replace(course, p1=None, p2=None), settings.rig)
