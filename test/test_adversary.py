"""What an adversary found once, and must not find again."""

import json

import pytest

from eha_monitor.cli import main
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.output import write_text
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import Settings, settings_from_tree

SINE = {"kind": "sine", "frequency": 4.0, "amplitude": 0.01, "duration": 100.0}
TRIANGLE = {"kind": "triangle", "duration": 100.0}
MULTISINE = {"kind": "multisine", "frequency": 0.25, "amplitude": 0.03, "duration": 100.0}
TWO_AREAS = {"area_1": 2e-3, "area_2": 1.65e-3, "volume_1": 2e-4, "volume_2": 1.5e-4,
             "mass": 150.0, "pump_displacement": 6.7e-7, "position_gain": 11000.0}


def record(motion, seconds, rig=None, seed=0, **simulation):
    settings = settings_from_tree(
        {"rig": rig or {}, "simulation": {"excitation": {"m": motion}, **simulation}}, "test")
    return Recording(1e-3, Simulator(settings, seed=seed).advance(round(seconds * 1e3)))


@pytest.mark.parametrize("motion", [SINE, TRIANGLE, MULTISINE], ids=["sine", "triangle", "multi"])
@pytest.mark.parametrize(("before", "after"), [(3e8, 8e8), (6e8, 3e8)])
def test_a_step_of_the_modulus_is_followed(motion, before, after):
    found = estimate(record(
        motion, 24, {"bulk_modulus": before}, noise={"position": 2e-6, "pressure": 1000.0},
        faults={"air": {"parameter": "bulk_modulus", "start": 11.0, "value": after}}), Settings())
    assert found.parameters["beta_e"].value == pytest.approx(after, rel=0.03)
    assert found.joint.parameters["beta_e"].value == pytest.approx(after, rel=0.03)
    assert found.stage_two.value[10_000] == pytest.approx(before, rel=0.05)
    assert found.model.status == "consistent", found.model.message


@pytest.mark.parametrize("motion", [SINE, TRIANGLE, MULTISINE], ids=["sine", "triangle", "multi"])
def test_a_rig_with_two_areas_fits_its_own_simulation(motion):
    found = estimate(record(motion, 16, TWO_AREAS), settings_from_tree({"rig": TWO_AREAS}, "t"))
    assert found.model.status == "consistent", found.model.message
    assert found.parameters["B"].value == pytest.approx(600.0, rel=0.01)
    assert found.parameters["beta_e"].value == pytest.approx(6e8, rel=0.01)


def test_a_pump_speed_in_the_wrong_unit_is_a_mismatch():
    recording = record(TRIANGLE, 12)
    recording.channels["omega"][:] *= 9.55
    assert estimate(recording, Settings()).model.status == "mismatch"


def test_lone_wild_samples_are_left_out_and_told():
    recording = record(TRIANGLE, 12)
    recording.channels["p1"][5000], recording.channels["x"][9000] = 1e12, 5.0
    found = estimate(recording, Settings())
    assert found.parameters["B"].value == pytest.approx(600.0, rel=0.01)
    assert found.model.status == "consistent", found.model.message
    assert sum("outlier" in note for note in found.warnings) == 2


def test_a_config_keeps_what_it_leaves_out():
    limits = settings_from_tree({"thresholds": {"viscous_damping": {"low_warn": 300.0}}}, "t"
                                ).thresholds.viscous_damping
    assert (limits.low_error, limits.high_warn, limits.high_error) == (150.0, 1000.0, 1500.0)
    channels = settings_from_tree({"channels": {"x": {"delay": 0.001}}}, "t").channels
    assert channels["x"].topic == "joint_states" and channels["p2"].topic == "pressure/chamber_2"


def test_outputs_never_replace_what_is_no_file_or_the_bag(tmp_path, capfd):
    link = tmp_path / "null"
    link.symlink_to("/dev/null")
    write_text(link, "nothing")  # written into, not replaced
    assert link.is_symlink()
    bag = tmp_path / "bag"
    write_recording(bag, record(TRIANGLE, 2), Settings())
    inside = next(bag.glob("*.mcap"))
    content = inside.read_bytes()
    assert main(["estimate", str(bag), "--json", str(inside)]) == 2
    assert inside.read_bytes() == content
    same = str(tmp_path / "answer")
    assert main(["estimate", str(bag), "--json", same, "--report", same]) == 2
    assert capfd.readouterr().err.count("\n") == 2
    assert main(["estimate", str(bag), "--json", same]) == 0
    assert json.loads((tmp_path / "answer").read_text())["samples"] == 2000
