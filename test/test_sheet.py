"""Numbers of the config against least squares: what is said, and what is not."""

import numpy as np
import pytest
from mismatch_tools import recorded
from rig_tools import settings
from test_plausibility import MULTISINE, OTHER, changed, made, with_rig

from eha_monitor.balances.baseline import baseline
from eha_monitor.concealed.cases import Case
from eha_monitor.plausibility.sheet import against_sheet

RECORDING, CONFIG = made(MULTISINE, 12.0, **(OTHER | {"sample_time": 1e-3}))


def said(recording=RECORDING, config=CONFIG):
    return against_sheet(baseline(recording, config), config)


def late(seconds, *channels):
    """Return the recording with channels that pass a filter with that time constant."""
    step = RECORDING.sample_time
    keep = np.exp(-step / seconds)
    out = {}
    for name in channels:
        values = RECORDING.get(name).copy()
        for i in range(1, len(values)):
            values[i] = keep * values[i - 1] + (1 - keep) * values[i]
        out[name] = values
    return out


def replaced(**values):
    recording = changed(RECORDING)
    recording.channels.update(values)
    return recording


def test_a_right_config_is_not_spoken_against():
    assert said() == []


@pytest.mark.parametrize("factor", [0.5, 1.5, 2.0])
def test_areas_that_are_off_move_mass_and_pump_alike(factor):
    (sentence,) = said(config=with_rig(CONFIG, area_1=factor, area_2=factor))
    size = f"{max(factor, 1 / factor):.3g} times too {'large' if factor > 1 else 'small'}"
    assert f"piston areas that are {size}" in sentence


@pytest.mark.parametrize(("key", "words"), [("pump_displacement", "pump displacement"),
                                            ("mass", "moving mass")])
def test_one_wrong_number_is_the_one_that_is_named(key, words):
    (sentence,) = said(config=with_rig(CONFIG, **{key: 1.4}))
    assert sentence.startswith(words)


def test_a_filter_of_the_pressures_takes_damping_times_its_delay_from_the_mass():
    (sentence,) = said(replaced(**late(10e-3, "p1", "p2")))
    delay = float(sentence.split("that are ")[1].split(" ms late")[0])
    assert sentence.startswith("moving mass") and "p1.delay and p2.delay" in sentence
    assert delay == pytest.approx(10.0, rel=0.2)


def test_without_a_number_in_the_config_nothing_is_said():
    tree = CONFIG.model_dump()
    tree["rig"]["pump_displacement"] = None
    assert said(config=settings(**tree)) == []


@pytest.mark.parametrize(("load", "zero"), [(600.0, 0.0), (-500.0, 0.0), (0.0, 5e5)])
def test_a_constant_load_that_the_config_lacks_is_a_line_to_write(load, zero):
    rig = OTHER | {"sample_time": 1e-3}
    effects = {"constant_load": {"F_0": load}} if load else {}
    recording, config = made(MULTISINE, 12.0, effects, **rig)
    shown = changed(recording)
    shown.channels["p1"] = shown.get("p1") + zero
    (sentence,) = said(shown, config)
    true = load + rig["area_1"] * zero
    written = float(sentence.split("F_0: ")[1].split("}")[0])
    assert written == pytest.approx(true, rel=0.03)
    high = float(sentence.split("p1 that reads ")[1].split(" bar")[0])
    assert high == pytest.approx(abs(true) / rig["area_1"] / 1e5, rel=0.05)
    assert f"bar too {'high' if true > 0 else 'low'}" in sentence
    right = settings(**config.model_dump(exclude_unset=True) | {
        "effects": {"constant_load": {"F_0": written}}})
    assert said(shown, right) == []


@pytest.mark.parametrize(("unit", "hint"), [("", True), ("kPa", True), ("bar", False),
                                            ("Pa", False)])
def test_a_unit_that_the_config_writes_was_not_taken_for_another(unit, hint):
    tree = with_rig(CONFIG, mass=6.894757).model_dump(exclude_unset=True)
    columns = {name: {"column": name, "unit": unit} for name in ("p1", "p2")}
    (sentence,) = said(config=settings(**tree | {"table": {"columns": columns}}))
    assert ("pressures in psi that are taken for kPa" in sentence) == hint


@pytest.mark.parametrize("effects, factor, told", [
    ((), 1.4, True), ((("coulomb_friction", 1.0),), 0.85, False),
    ((("coulomb_friction", 1.0),), 1.0, False), ((("coulomb_friction", 1.0),), 1.4, True),
    ((("coulomb_friction", 1.0),), 4.0, True)])
def test_seals_that_turn_with_the_piston_make_no_mass_wrong(effects, factor, told):
    """Least squares have 30.9 +- 0.5 kg of 34.3 beside bristles, and no channel is late.

    Of 48 kg in the config, the difference makes more of the force than the balance leaves.
    """
    recording, config = recorded(Case("test", effects, motion="rich", seed=3))
    rig = config.rig.model_copy(update={"mass": factor * config.rig.mass})
    lines = said(recording, config.model_copy(update={"rig": rig}))
    assert any("moving mass" in line for line in lines) == told


def test_a_chamber_that_would_hold_less_than_no_oil_is_told_and_what_would_do():
    taken = -float(np.min(RECORDING.get("x"))) * CONFIG.rig.area_1 / CONFIG.rig.volume_1
    (sentence,) = said(config=with_rig(CONFIG, volume_1=0.8 * taken))
    assert sentence.startswith("chamber 1 would hold") and "exchanged they would do" in sentence
    assert said(config=with_rig(CONFIG, volume_1=1.2 * taken)) == []


@pytest.mark.parametrize("inverse", [1.0, -1.0])
def test_a_pump_that_reads_the_ratio_of_the_areas_of_a_single_rod_says_they_are_exchanged(inverse):
    ratio = (CONFIG.rig.area_2 / CONFIG.rig.area_1) ** inverse
    exchanged = "area_1 and area_2 that are exchanged"
    assert exchanged in said(config=with_rig(CONFIG, pump_displacement=ratio))[0]
    assert exchanged not in said(config=with_rig(CONFIG, pump_displacement=0.8 * ratio))[0]
