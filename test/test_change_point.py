"""A number that changes while a recording runs: when, by how much, and what is no change."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rig_tools import settings, simulated

from eha_monitor import cli
from eha_monitor.balances.answer import answered
from eha_monitor.balances.change_point import change_point, since_change
from eha_monitor.recordings.write import write_recording

SLOW = {"kind": "sine", "amplitude": 0.02, "frequency": 0.7}
RUBS = {"coulomb_friction": {"F_c": 100.0}}


def recorded(parameter=None, value=0.0, effects=None, shape=SLOW, seed=0):
    """Return 30 s of the simulator in which a parameter changes at 12 s."""
    faults = {} if parameter is None else {"fault": {
        "parameter": parameter, "start": 12.0, "value": value}}
    return simulated(shape, 30.0, faults=faults, effects=effects or {}).recording(seed)


@pytest.mark.parametrize("parameter, value, effects, symbol, step", [
    ("viscous_damping", 900.0, {}, "B", 300.0),
    ("coulomb_friction.F_c", 160.0, RUBS, "F_c", 60.0),
    ("leakage", 4e-12, {}, "L", 1.75e-12)])  # half of the coefficient is a leak across
def test_a_step_is_dated_and_measured(parameter, value, effects, symbol, step):
    found = change_point(recorded(parameter, value, effects), settings())
    assert found is not None and found.symbol == symbol
    assert found.before_s <= 12.0 <= found.since_s < 15.0
    assert found.step.value == pytest.approx(step, rel=0.02)
    assert abs(found.step.value - step) < 3.0 * found.step.stddev
    assert found.statement.startswith(f"between {found.before_s:.1f} and {found.since_s:.1f} s")


SWEEP = {"kind": "multisine", "amplitude": 0.02, "frequency": 0.1, "frequency_end": 8.0}


@pytest.mark.parametrize("fastest", [6.0, 8.0])
def test_air_that_enters_is_dated_though_no_balance_owes_two_per_cent_to_it(fastest):
    found = change_point(recorded("bulk_modulus", 2.5e8, shape=SWEEP | {
        "frequency_end": fastest}), settings())
    assert found is not None and found.symbol == "beta_e"
    assert found.before_s <= 12.0 <= found.since_s <= found.before_s + 12.0
    assert abs(found.step.value + 3.5e8) < found.step.stddev < -found.step.value
    assert "the effective bulk modulus fell from" in found.statement


@pytest.mark.parametrize("seed", range(4))
def test_oil_of_one_state_is_not_dated(seed):
    shape = SWEEP | {"seed": seed, "frequency_end": 4.0 + 2.0 * seed}
    assert change_point(recorded(shape=shape, seed=seed), settings()) is None


@pytest.mark.parametrize("effects", [{}, RUBS, {"stribeck_friction": {
    "F_c": 100.0, "F_d": 60.0, "v_s": 0.01}}])
@pytest.mark.parametrize("shape", [SLOW, {
    "kind": "chirp", "amplitude": 0.02, "frequency": 0.2, "frequency_end": 1.5}])
def test_a_machine_of_one_state_has_none(effects, shape):
    """Nor where the motion grows faster, and a law that the config lacks leaves more."""
    assert change_point(recorded(effects=effects, shape=shape), settings()) is None


def test_what_came_before_is_not_in_the_recording_that_is_diagnosed(tmp_path, capfd):
    recording = recorded("viscous_damping", 900.0)
    (kept,), (point,) = since_change([recording], settings())
    gone = recording.time < point.since_s
    assert len(kept) == len(recording) and np.isnan(kept.channels["x"][gone]).all()
    assert np.array_equal(kept.channels["x"][~gone], recording.channels["x"][~gone])

    bag, out = tmp_path / "bag", tmp_path / "d.json"
    write_recording(bag, recording, settings())
    assert cli.main(["diagnose", str(bag), "--json", str(out)]) == 0
    said = " ".join(capfd.readouterr().out.split())
    assert "viscous damping rose by" in said and "in the state since" in said
    found = json.loads(out.read_text())
    (written,) = found["change_points"]
    assert written["symbol"] == "B"
    assert written["step"]["value"] == pytest.approx(300.0, rel=0.01)
    assert written["since_s"] == pytest.approx(point.since_s)
    assert found["message"].startswith(point.statement)
    assert found["parameters"]["after"]["B"]["value"] == pytest.approx(900.0, rel=0.01)
    assert all(start >= point.since_s - 0.1 for start, _ in found["location"]["intervals_s"])


@pytest.mark.parametrize("drift", [1e4, 3e5])
def test_a_pressure_sensor_that_drifts_is_no_change_at_a_time(drift):
    recording = recorded(effects=RUBS, shape=SLOW | {"amplitude": 0.01, "frequency": 0.3})
    p1 = recording.channels["p1"] + np.linspace(0.0, drift, len(recording))
    drifted = replace(recording, channels=recording.channels | {"p1": p1})
    assert change_point(drifted, settings()) is None
    if drift > 1e5:  # a smaller one is no share of the force beside 100 N of friction
        found = {one.name: one for one in answered([drifted], settings()).effects}
        assert set(found) >= {"pressure_drift", "coulomb_friction"}
        rate = found["pressure_drift"].parameters["d_1"]
        assert abs(rate.value - drift / 30.0) < 3.0 * rate.stddev
        assert rate.stddev < 0.1 * rate.value
