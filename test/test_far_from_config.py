"""Rigs whose config is far from them: what least squares on the balances say is the answer."""

from dataclasses import replace

import pytest
from mismatch_tools import recorded
from rig_tools import MULTISINE, settings, simulated
from strangers.draw import draw_rig
from strangers.generate import record, settings_of, truth_of

from eha_monitor.balances.answer import Asked, first_answer
from eha_monitor.concealed.cases import Case
from eha_monitor.mismatch.advise.advice import advise
from eha_monitor.mismatch.beside_balances import differ_in_damping, needs_fewer
from eha_monitor.mismatch.diagnose import FINER, diagnose
from eha_monitor.mismatch.diagnosis import NamedEffect, Value

DRY = {"coulomb_friction", "stribeck_friction", "presliding_friction", "pressure_friction"}


@pytest.mark.parametrize(("place", "kind", "law"), [
    (0, "two_pumps", "karnopp"), (2, "two_pumps", "rational"),
    pytest.param(6, "equal", "lugre", marks=pytest.mark.slow)])
def test_load_and_dry_friction_of_another_law_are_named_with_their_size(place, kind, law):
    rig = draw_rig(3, place, kind, law)
    setting = next(one for one in rig.settings if one.load)
    recording, settings = record(rig, setting, 1)
    truth = truth_of(rig, setting)
    found = diagnose([recording], settings)
    named = {effect.name: effect for effect in found.effects}
    assert found.verdict == "mismatch" and "force" in found.signals, found.message
    assert DRY & set(named) and "constant_load" in named
    load = named["constant_load"].parameters["F_0"]
    assert abs(load.value - setting.load) < 2.0 * load.stddev
    low, high = sorted(truth["B_span"])
    damping = found.after["B"]
    assert low - 3.0 * damping.stddev < damping.value < high + 3.0 * damping.stddev
    assert found.signals["force"].after_rms < 0.2 * found.signals["force"].before_rms


def test_a_healthy_rig_of_other_equations_is_no_mismatch():
    """No filter of the config's laws follows it to its noise, and its balances ask for nothing."""
    rig = draw_rig(500, 14, "equal", "none")
    said = []
    found = diagnose([record(rig, rig.settings[0], 1, 6.0)[0]], settings_of(rig),
                     progress=lambda text, share: said.append(text))
    # The search ends where no law follows, and learns nothing about the form of its own laws.
    assert not [text for text in said if "not in the catalogue" in text], said
    low, high = sorted(truth_of(rig, rig.settings[0])["B_span"])
    damping = found.after["B"]
    assert found.verdict == "consistent" and FINER not in found.advice, found.message
    assert low - 2.0 * damping.stddev < damping.value < high + 2.0 * damping.stddev


def test_dry_friction_of_another_law_is_not_left_to_the_filter_near_its_config_either():
    rig = draw_rig(1301, 9)
    recording, settings = record(rig, rig.settings[1], 1)
    truth = truth_of(rig, rig.settings[1])
    found = diagnose([recording], settings)
    assert {effect.name for effect in found.effects} <= DRY and found.effects, found.message
    low, high = sorted(truth["B_span"])
    damping = found.after["B"]
    assert low - 2.0 * damping.stddev < damping.value < high + 2.0 * damping.stddev


@pytest.mark.slow
def test_advice_rests_on_the_answer_that_a_diagnosis_gives():
    """Of a law that no filter follows its numbers were advice as well: twice the damping."""
    rig = draw_rig(3, 6, "equal", "lugre")
    setting = next(one for one in rig.settings if one.load)
    names, found = advise([record(rig, setting, 1)[0]], settings_of(rig), check=False)
    known = {one.name: one for one in found.known}
    assert DRY & set(names) and "constant_load" in names
    damping, load = known["B"], known["constant_load.F_0"]
    assert abs(damping.value - truth_of(rig, setting)["B_span"][0]) < 2.0 * damping.stddev
    assert abs(load.value - setting.load) < 2.0 * load.stddev
    assert found.tried and found.said  # and a motion is looked for around what was named


@pytest.mark.parametrize("sensor, fewer", [
    ({"position_scale": {"k": 0.03, "in_loop": 0.0}}, True),
    ({"pressure_scale": {"k_1": 0.03, "k_2": 0.03}}, False)])
def test_sensors_that_a_filter_calls_wrong_are_right_where_fewer_names_are_needed(sensor, fewer):
    """A position that is 3 % too large reads as a softer spring, and as a drive that lags."""
    recording, settings = recorded(Case("test", (("position_scale", 1.0), ("spring_load", 1.0)),
                                        motion="triangle", seed=3))
    asked = Asked(None, None, (), ())
    first = first_answer([recording], settings, asked)
    assert len(first.effects) > 2
    (name, values), = sensor.items()
    found = replace(first, config_effects=sensor, effects=(NamedEffect(
        name, "sensor", name, {key: Value(value, 0.0, "1") for key, value in values.items()},
        100.0, (), "", "", ""),))
    assert needs_fewer(found, first, [recording], settings, asked) == fewer
    assert not needs_fewer(replace(found, effects=first.effects), first, [recording], settings,
                           asked)


def test_recordings_of_another_damping_each_are_no_filter_s_to_explain():
    """Five healthy ones of a stranger, B 5 % apart, took 12 minutes; two were "unexplained"."""
    given = settings()
    warm = [replace(simulated(MULTISINE, 8.0, rig={"viscous_damping": 600.0 * share}).recording(k),
                    source=f"day {k}") for k, share in enumerate((1.0, 0.95))]
    assert differ_in_damping(first_answer(warm, given, Asked(None, None, (), (), False)))
    found = diagnose(warm, given)
    assert found.verdict == "consistent" and found.wall_s < 10.0
    alike = [warm[0], replace(simulated(MULTISINE, 8.0).recording(7), source="again")]
    assert not differ_in_damping(first_answer(alike, given, Asked(None, None, (), (), False)))
