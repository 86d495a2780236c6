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
