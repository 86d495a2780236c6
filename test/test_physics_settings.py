"""What a config may say: units, effects and their defaults, and what is told of the rest."""

from pathlib import Path

import numpy as np
import pytest

from eha_monitor.errors import InputError
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.settings import Settings, load_settings, settings_from_tree
from eha_monitor.settings.load import annotated


def test_settings_survive_being_written_and_read():
    assert settings_from_tree(Settings().model_dump(), "x") == Settings()
    other = settings_from_tree({
        "rig": {"mass": "33 kg", "position_gain": None, "volume_1": "70 cm^3"},
        "effects": {"coulomb_friction": {"F_c": "12 N"}, "entrained_air": {"alpha": 0.01}},
        "simulation": {"faults": {"f": {"parameter": "leakage", "value": 1e-12}},
                       "excitation": {"a": {"kind": "sine"}, "b": {"kind": "rest"}}},
    }, "x")
    assert settings_from_tree(other.model_dump(), "x") == other
    wrapped = {"/eha/monitor": {"ros__parameters": {**other.model_dump(), "use_sim_time": True}}}
    assert settings_from_tree(wrapped, "x") == other


@pytest.mark.parametrize("key, text, value", [
    ("mass", "20 kg", 20.0), ("mass", "20000 g", 20.0), ("area_1", "5.05 cm^2", 5.05e-4),
    ("volume_1", "68.5 cm^3", 6.85e-5), ("volume_2", "0.0685 liter", 6.85e-5),
    ("bulk_modulus", "600 MPa", 6e8), ("bulk_modulus", "6000 bar", 6e8),
    ("charge_pressure", "20 bar", 2e6), ("sample_time", "1 ms", 1e-3),
    ("viscous_damping", "0.6 kN*s/m", 600.0), ("leakage", "0.5 mm^3/(s*kPa)", 5e-13),
    ("pump_displacement", "1.6925e-7 m^3/rad", 1.6925e-7),
    ("position_gain", "23 rad/s/mm", 23000.0)])
def test_units(key, text, value):
    found = settings_from_tree({"rig": {key: text}}, "x")
    assert getattr(found.rig, key) == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize("key, value, words", [
    ("mass", "20 m", "expected a number in kg, got '20 m'"),
    ("mass", -1, "expected more than 0 in kg, got -1"),
    ("mass", "-20 kg", "expected more than 0 in kg"),
    ("mass", None, "expected a number in kg"),
    ("mass", True, "expected a number in kg, got True"),
    ("mass", float("nan"), "expected a finite number in kg"),
    ("sample_time", "2 s", "expected at most 1 in s"),
    ("weight", 3, "unknown key"), ("mas", 3, "did you mean 'mass'?"),
    ("makeup_conductance", 1e-9, "must not exceed")])
def test_what_is_wrong_is_said(key, value, words):
    with pytest.raises(InputError) as caught:
        settings_from_tree({"rig": {key: value}}, "my.yaml")
    assert str(caught.value).startswith("my.yaml: rig") and words in str(caught.value)


@pytest.mark.parametrize("effects, words", [
    ({"friction": {}}, "unknown effect 'friction'"),
    ({"coulomb_friction": {}}, "coulomb_friction.F_c: expected a number in N"),
    ({"coulomb_friction": {"F_c": -1}}, "from 0 to"),
    ({"coulomb_friction": {"F_c": "3 Pa"}}, "coulomb_friction.F_c: expected a number in N"),
    ({"coulomb_friction": {"F_c": None}}, "coulomb_friction.F_c: expected a number in N"),
    ({"coulomb_friction": {"F_c": float("inf")}}, "coulomb_friction.F_c: expected at most"),
    ({"drive_saturation": {}}, "drive_saturation.omega_max: expected a number in rad/s"),
    ({"added_mass": {"dM": -1}}, "added_mass.dM: expected a number in kg from 0 to"),
    ({"spring_load": {"k": "900 N/s"}}, "spring_load.k: expected a number in N/m"),
    ({"coulomb_friction": {"F_c": 1, "g": 2}}, "coulomb_friction.g: unknown key"),
    ({"coulomb_friction": 3}, "expected its parameters F_c, v_e"),
    (["coulomb_friction"], "expected a mapping")])
def test_effects_are_checked_against_the_catalogue(effects, words):
    with pytest.raises(InputError) as caught:
        settings_from_tree({"effects": effects}, "my.yaml")
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_effects_take_their_defaults():
    found = settings_from_tree({"effects": {"entrained_air": {"alpha": "2 %"}}}, "x")
    assert found.effects == {"entrained_air": {"alpha": 0.02, "n": 1.4}}


@pytest.mark.parametrize("given, meant", [
    ({"omega_max": 200}, {"omega_max": 200.0, "slew": 1e9}),
    ({"omega_max": float("inf"), "slew": "3000 rad/s^2"}, {"omega_max": 1e6, "slew": 3e3})])
def test_a_limit_that_is_left_out_is_out_of_reach(given, meant):
    found = settings_from_tree({"effects": {"drive_saturation": given}}, "x").effects
    assert found == {"drive_saturation": meant}
    assert settings_from_tree({"effects": found}, "x").effects == found


def test_a_size_beside_another_is_zero_where_it_is_left_out():
    found = settings_from_tree({"effects": {"pressure_offset": {"b_2": "0.4 bar"}}}, "x").effects
    assert found == {"pressure_offset": {"b_1": 0.0, "b_2": pytest.approx(4e4)}}


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=lambda effect: effect.name)
def test_every_parameter_can_be_written_with_its_unit(effect):
    values = {p.name: min(max(p.scale, p.lower), p.upper) for p in effect.parameters}
    written = {p.name: f"{values[p.name]!r} {'' if p.unit == '1' else p.unit}"
               for p in effect.parameters}
    found = settings_from_tree({"effects": {effect.name: written}}, "x").effects
    assert found == {effect.name: pytest.approx(values)}


@pytest.mark.parametrize("written, key, words", [
    ("rig: {charge_pressure: 15}", "rig.charge_pressure", "15 is read as 15 Pa, expected 1 kPa to "
     "100 MPa: write '15 bar' (1.5 MPa)"),
    ("/**: {ros__parameters: {rig.charge_pressure: 15}}", "rig.charge_pressure", "'15 bar'"),
    ("rig: {area_1: 505}", "rig.area_1", "'505 mm^2' (5.05 cm²)"),
    ("rig: {volume_1: 45}", "rig.volume_1", "a number alone is in m³, expected such as"),
    ("rig: {volume_1: 6850}", "rig.volume_1", "'6850 cm^3' (6850 cm³)"),
    ("rig: {pump_displacement: 1.6}", "rig.pump_displacement", "'1.6 cm^3/rev' (0.2546 cm³/rad)"),
    ("rig: {motion: rotary, area_1: 120}", "rig.area_1", "120 m³/rad"),
    ("rig: {sample_time: 1}", "rig.sample_time", "'1 ms'"),
    ("rig: {leakage: 0.05}", "rig.leakage", "'0.05 l/min/bar'"),
    ("thresholds: {bulk_modulus: {low_warn: 450}}", "thresholds.bulk_modulus.low_warn",
     "'450 MPa'"),
    ("experiment: {lower: -40, upper: 40}", "experiment.lower", "'-40 mm'"),
    ("experiment: {pressure: 210}", "experiment.pressure", "'210 bar' (21 MPa)"),
    ("channels: {p1: {delay: 5}}", "channels.p1.delay", "'5 ms'"),
    ("simulation: {excitation: {a: {kind: sine, amplitude: 40}}}",
     "simulation.excitation.a.amplitude", "'40 mm'")])
def test_a_number_that_has_lost_its_unit_is_refused(tmp_path, written, key, words):
    """Bar typed for Pa was taken without a word; the line says what was read and what to write."""
    (tmp_path / "my.yaml").write_text(written)
    with pytest.raises(InputError) as caught:
        load_settings(tmp_path / "my.yaml")
    line = str(caught.value)
    assert f"my.yaml: {key}: " in line and words in line and "\n" not in line


def test_every_section_of_a_rig_that_turns_takes_its_units():
    found = settings_from_tree({
        "rig": {"motion": "rotary", "viscous_damping": "24 N*m*s/rad"},
        "experiment": {"lower": "-50 deg", "upper": "0.9 rad", "speed": "90 deg/s",
                       "acceleration": "20 rad/s^2"},
        "thresholds": {"viscous_damping": {"high_warn": "40 N*m*s/rad"}}}, "x")
    assert found.experiment.lower == pytest.approx(-np.deg2rad(50.0))
    assert found.experiment.speed == pytest.approx(0.5 * np.pi)
    assert found.thresholds.viscous_damping.high_warn == 40.0
    with pytest.raises(InputError, match="in rad, got '5 mm'"):
        settings_from_tree({"rig": {"motion": "rotary"}, "experiment": {"lower": "5 mm"}}, "x")


@pytest.mark.parametrize("written, value", [
    ("15 Pa", 15.0), ("15 bar", 1.5e6), ("15 bar gauge", 1_601_325.0), ("14 barg", 1_501_325.0),
    ("200 psi absolute", 200 * 6894.757), ("0", 0.0), ("2e6", 2e6)])
def test_what_is_written_with_its_unit_is_taken(tmp_path, written, value):
    """Also when such a config is written again."""
    place = tmp_path / "my.yaml"
    place.write_text(f"rig: {{charge_pressure: {written}}}")
    found = load_settings(place)
    assert found.rig.charge_pressure == pytest.approx(value, rel=1e-6)
    place.write_text(annotated(found))
    assert load_settings(place).rig.charge_pressure == pytest.approx(value, rel=1e-6)


def test_no_config_that_comes_with_it_is_refused():
    root = Path(__file__).parents[1]
    places = [place for place in root.glob("config/*.yaml") if "aggregator" not in place.name]
    assert places
    for place in places:
        load_settings(place)


def test_what_a_config_leaves_out_of_its_rig_is_not_written_as_told(tmp_path):
    """A damping that nobody gave was checked as one that somebody knows."""
    given = settings_from_tree({"rig": {"mass": 12.0}}, "test")
    place = tmp_path / "config.yaml"
    place.write_text(annotated(given))
    found = load_settings(place)
    assert found == given and "viscous_damping" not in found.rig.model_fields_set
    assert "# viscous_damping: 600.0" in place.read_text()
