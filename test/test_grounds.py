"""The trial on other grounds (benchmarks/grounds.py): what is true there, what was answered."""

from pathlib import Path

import numpy as np
import pytest
from ground_parts import (
    said_of,
    simulator,
    strangers,
)

from eha_monitor.errors import InputError
from eha_monitor.prove.score import row_of
from eha_monitor.prove.trial import Question, write_json
from eha_monitor.recordings.read import read_recording
from eha_monitor.settings import load_settings

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data" / "fluid_power_sim"
CONFIG = ROOT / "config" / "fluid_power_sim.yaml"
pytestmark = pytest.mark.timeout(600)  # 10 s; minutes where all has to be compiled first
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"{DATA} is absent")


def said(*effects, after=None) -> dict:
    """Return an answer: (name, rivals, parameters) each."""
    return {"effects": [{"name": name, "indistinguishable_from": list(rivals), "parameters": {
        key: {"value": value, "stddev": 0.01 * abs(value)} for key, value in parameters.items()}}
        for name, rivals, parameters in effects], "parameters": {"after": after or {}}}


# The simulator.

def test_the_simulators_key_in_the_catalogues_terms():
    entry = {"B": 900.0, "beta_e": 8e8, "C_T": 1e-12, "effects": [
        {"name": "stribeck_friction", "parameters": {
            "coulomb_N": 7.0, "static_N": 18.0, "stribeck_velocity_m_s": 0.004, "law": "f"}},
        {"name": "pump_flow_gain", "parameters": {"flow_factor": 0.97}},
        {"name": "pressure_offset", "parameters": {"sensor": "p2", "bias_Pa": 2.5e4}},
        {"name": "sticking_vane", "parameters": {"force_N": 3.0}}]}
    found = {one["name"]: one for one in simulator.truth_of(entry, 5e-13)["effects"]}
    assert found["stribeck_friction"]["parameters"] == pytest.approx(
        {"F_c": 7.0, "F_d": 11.0, "v_s": 0.004})
    assert found["pump_flow_gain"]["parameters"] == pytest.approx({"k": -0.03})
    assert found["pressure_offset"]["parameters"] == {"b_1": 0.0, "b_2": 2.5e4}
    assert not found["sticking_vane"]["in_catalogue"]
    # What the config does not have is other than configured.
    assert found["cross_port_leakage"]["parameters"]["L"] == pytest.approx(2.5e-13)
    assert "cross_port_leakage" not in {one["name"] for one in simulator.truth_of(
        {**entry, "C_T": 5e-13}, 5e-13)["effects"]}


@needs_data
def test_simulators_recordings_come_through_the_import_with_noise(tmp_path):
    from eha_monitor.recordings.read import read_recording

    table = simulator.Table("h32_tri", DATA / "h32_tri.csv.gz", CONFIG, 1)
    entry = simulator.conceal(table, tmp_path)
    assert "effects" not in entry and len(entry["key_sha256"]) == 64
    recording = read_recording(tmp_path / "h32_tri", load_settings(tmp_path / "h32_tri.yaml"))
    plain = np.genfromtxt(DATA / "h32_tri.csv.gz", delimiter=",", names=True)
    n = len(recording)
    for name, column in (("x", "x"), ("p1", "p1"), ("omega", "w")):
        noise, step = simulator.SENSORS[name]
        left = recording.channels[name] - plain[column][:n]
        assert np.std(left) == pytest.approx(np.hypot(noise, step / np.sqrt(12)), rel=0.05)
    assert recording.channels["x_d"] == pytest.approx(plain["xd"][:n], abs=1e-12)


@needs_data
def test_simulators_key_must_be_the_sealed_one():
    entry = {"case": "h32_tri", "key_sha256": "0" * 64}
    with pytest.raises(InputError, match="is not the key that was sealed"):
        simulator.completed({"cases": [entry]}, DATA, CONFIG)


# Strangers' rigs.

def test_a_stranger_s_recording_is_written_with_the_config_of_its_sheet(tmp_path):
    case = strangers.Strange("s1_000_r2", 1, 0, 1)
    truth = strangers.conceal(case, tmp_path)
    settings = load_settings(tmp_path / "s1_000_r2.yaml")
    recording = read_recording(tmp_path / "s1_000_r2", settings)
    assert recording.has("x", "x_d", "omega", "p1", "p2", "temperature")
    assert settings.rig.area_1 > settings.rig.area_2 and settings.effects == {}
    assert truth["effects"][0]["class"][0] == "coulomb_friction"
    assert truth["load"] != 0.0 and truth["motion"] and truth["rig_off"]


def test_dry_friction_of_another_law_is_right_within_its_class_and_b_within_its_drift(tmp_path):
    truth = {"case": "s", "B": 1400.0, "B_span": [1500.0, 1275.0], "beta_e": 8e8, "rig_off": [],
             "effects": [{"name": "stribeck_friction", "balance": "force", "strength": 1.0,
                          "in_catalogue": True, "parameters": {"F_c": 180.0, "F_d": 80.0},
                          "class": ["coulomb_friction", "stribeck_friction"]}]}
    answer = said(("coulomb_friction", (), {"F_c": 183.0}), after={
        "B": {"value": 1270.0, "stddev": 10.0, "unit": "N·s/m"}})
    answer |= {"verdict": "mismatch", "location": {"balance": {"force": 1.0}},
               "fit": {"signals": {}}}
    answer["effects"][0] |= {"balance": "force", "log_evidence": 50.0, "probability": 0.9}
    row = row_of(truth, answer)
    assert row["within_class"] and not row["exact"]
    (tmp_path / "answers").mkdir()
    write_json(tmp_path / "answers" / "s.json", answer)
    (b,) = strangers.parameters(Question("s", ("s",)), {"s": truth}, tmp_path)
    assert b["inside"] and b["true"] == 1400.0


def test_a_parameter_may_be_said_under_a_declared_class():
    answer = said(("turbulent_leakage", ("cross_port_leakage",), {"c": 1e-9}),
                  ("presliding_friction", ("coulomb_friction",), {"F_c": 40.0}))
    assert said_of(answer, "cross_port_leakage", "L") is None
    assert said_of(answer, "coulomb_friction", "F_c", 2.0)["value"] == 42.0
