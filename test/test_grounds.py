"""The trial on other grounds (benchmarks/grounds.py): what is true there, what was answered."""

from pathlib import Path

import numpy as np
import pytest
from ground_parts import (
    mcmaster,
    said_of,
    simulator,
    strangers,
    triangle,
)

from eha_monitor.concealed.cases import truth_of
from eha_monitor.concealed.draws import MCMASTER, MCMASTER_RIG, mcmaster_case
from eha_monitor.errors import InputError
from eha_monitor.prove.files import write_json
from eha_monitor.prove.score import row_of
from eha_monitor.prove.trial import Question
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


# McMaster.

def test_a_wrong_leakage_of_the_config_is_the_same_equation_as_more_leakage():
    answer = said() | {"rig_data": [{"key": "leakage", "found": {"value": 9.6e-12,
                                                                 "stddev": 2e-14}}]}
    assert mcmaster.leakage(answer, 2.5e-13) == {"value": 4.8e-12, "stddev": 1e-14}
    named = said(("cross_port_leakage", (), {"L": 4.5e-12}))
    assert mcmaster.leakage(named, 2.5e-13)["value"] == 4.5e-12 + 2.5e-13
    assert mcmaster.leakage(said(), 2.5e-13) is None


def test_published_leakage_is_the_configs_and_the_concealed_one_together():
    for state, (leak, offset, _, a_2, _) in MCMASTER.items():
        case = mcmaster_case(state)
        truth = {one["name"]: one["parameters"] for one in truth_of(case)["effects"]}
        total = truth["cross_port_leakage"]["L"] + 0.5 * MCMASTER_RIG["C_T"]
        assert total == pytest.approx(leak, rel=1e-12)
        assert truth["leakage_offset"]["Q_0"] == offset and case.rig["B"] == a_2


@pytest.mark.parametrize("shape", ["triangle", "sine"])
def test_a_linear_fit_reads_the_friction_it_lacks_as_viscous(shape):
    fit = mcmaster.linear_fit(shape)
    assert fit["B"] == pytest.approx(mcmaster.PUBLISHED[shape], rel=0.1)


def test_parameters_are_compared_with_the_published_ones(tmp_path):
    case = mcmaster.case_of(0, 1)
    leak, offset, a_1, a_2, a_3 = MCMASTER["normal"]
    (tmp_path / "answers").mkdir()
    write_json(tmp_path / "answers" / f"{case.name}.json", said(
        ("quadratic_friction", (), {"a_1": 1.05 * a_1}),
        ("presliding_friction", ("coulomb_friction",), {"F_c": a_3}),
        ("cross_port_leakage", (), {"L": leak - 2.5e-13}),
        after={"B": {"value": 1.2 * a_2, "stddev": 1.0}}))
    rows = {row["name"]: row for row in mcmaster.parameters(case, tmp_path)}
    assert [name for name, row in rows.items() if row["within"]] == ["a1", "a3", "L"]
    assert rows["L"]["relative"] == pytest.approx(0.0, abs=1e-9)
    assert rows["a2"]["relative"] == pytest.approx(0.2)
    assert rows["Q_L0"]["said"] is None and rows["Q_L0"]["true"] == offset


def test_dry_friction_may_be_said_as_pressure_friction():
    mu = 436.0 / 16e6
    answer = said(("pressure_friction", ("coulomb_friction",), {"mu": mu}))
    assert mcmaster.dry_friction(answer)["value"] == pytest.approx(436.0)
    assert mcmaster.dry_friction(said(("pressure_friction", (), {"mu": mu}))) is None


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


# The triangle.

def test_what_the_advice_must_say(tmp_path, monkeypatch):
    monkeypatch.setattr(triangle, "linear_fit", lambda case, work: 900.0)
    case = triangle.triangle_case(0, 1)
    force, true = case.options["coulomb_friction"]["F_c"], case.rig["B"]
    (tmp_path / "answers").mkdir()
    write_json(tmp_path / "answers" / f"{case.name}_both.json", {**said(
        ("coulomb_friction", (), {"F_c": 1.01 * force}),
        after={"B": {"value": 0.99 * true, "stddev": 2.0}}),
        "fit": {"data": "held_out_bag"}, "verdict": "mismatch"})
    advice = {"confusions": [{"parameter": "B", "effect": "coulomb_friction", "amount": 20.0,
                              "plateau_correlation": -0.99999, "plateau_shift": -500.0}],
              "doubts": [{"parameter": "B", "effect": "coulomb_friction", "then": 800.0}],
              "motion": {"words": "a sine", "excitation": {}}}
    row = triangle.judged(case, advice, tmp_path)
    assert row["shift_right"] and row["decides"] and row["named"] == ["coulomb_friction"]
    facts = triangle.facts_of([row])
    assert [fact.split(":")[0] for fact in facts[:3]] == ["1 of 1"] * 3
    rows = triangle.parameters(case, tmp_path)
    assert [row["within"] for row in rows] == [False, False, True, True]
    wrong = triangle.judged(case, {**advice, "motion": None, "doubts": []}, tmp_path)
    assert not wrong["decides"]


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


