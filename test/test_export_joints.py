"""URDF, MuJoCo and the ROS parameter file, each read by its own program's parser."""

import subprocess
import sys

import mujoco
import numpy as np
import pytest
from export_tools import model_of
from rig_tools import TRIANGLE, settings
from urdf_parser_py.urdf import URDF

from eha_monitor.exports.joints import feedforward_of, mujoco_of, urdf_of, velocity_of
from eha_monitor.exports.model import Model
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.recording import Recording

DRY = {"coulomb_friction": {"F_c": 40.0}}
CREEPING = {"stribeck_friction": {"F_c": 30.0, "F_d": 20.0, "v_s": 5e-3, "v_e": 2e-4}}


def rig(effects, **more) -> Model:
    return model_of(effects, TRIANGLE, 8.0, **more)


def test_urdf_holds_damping_and_friction():
    exported = urdf_of(rig(DRY | {"added_mass": {"dM": 3.0}}), "piston")
    robot = URDF.from_xml_string(exported.content.encode())
    joint = robot.joint_map["piston"]
    assert joint.type == "prismatic"
    assert joint.dynamics.damping == pytest.approx(600.0)
    assert joint.dynamics.friction == pytest.approx(40.0)
    assert robot.link_map["piston_link"].inertial.mass == pytest.approx(23.0)
    assert (joint.limit.lower, joint.limit.upper) == (-0.04, 0.04)
    assert joint.limit.velocity == pytest.approx(0.04)
    assert not [line for line in exported.lost if line.startswith("coulomb")]


def test_a_rig_that_turns_gets_a_revolute_joint():
    robot = URDF.from_xml_string(urdf_of(rig(DRY, motion="rotary"), "valve").content.encode())
    joint = robot.joint_map["valve"]
    assert joint.type == "revolute"
    assert (joint.dynamics.damping, joint.dynamics.friction) == (600.0, 40.0)
    assert robot.link_map["valve_link"].inertial.inertia.ixx == pytest.approx(20.0)
    hinge = mujoco.MjModel.from_xml_string(mujoco_of(rig(DRY, motion="rotary"), "valve").content)
    assert hinge.jnt_type[0] == mujoco.mjtJoint.mjJNT_HINGE
    data = mujoco.MjData(hinge)
    data.qvel[0] = 1.0
    mujoco.mj_forward(hinge, data)
    assert data.qacc[0] == pytest.approx(-(600.0 + 40.0) / 20.0, rel=1e-2)


def test_friction_that_is_no_line_is_told_with_its_error():
    """By hand: at 10 times v_e, 2 mm/s, it is 30 + 20 exp(-0.16) + 1.2 N."""
    exported = urdf_of(rig(CREEPING), "piston")
    joint = URDF.from_xml_string(exported.content.encode()).joint_map["piston"]
    line = next(one for one in exported.lost if one.startswith("stribeck_friction"))
    truth = 30.0 + 20.0 * np.exp(-0.16) + 600.0 * 2e-3
    off = abs(truth - joint.dynamics.damping * 2e-3 - joint.dynamics.friction)
    assert f"{off:.0f} N at 2 mm/s" in line
    assert f"<!-- not in this file: {line} -->" in exported.content


def test_what_a_joint_does_not_hold_is_told():
    lost = "\n".join(urdf_of(rig({
        "constant_load": {"F_0": 12.0}, "spring_load": {"k": 900.0},
        "pressure_friction": {"mu": 3e-6}, "command_delay": {"T": 1e-3},
        "spot": {"adds": "flow", "expression": "k*dp", "k": 1e-12}}), "piston").lost)
    assert "a load of 12" in lost
    assert "spring_load: the force depends on the position" in lost
    assert "pressure_friction: taken at the charge pressure, 2 MPa" in lost
    assert "command_delay, spot: a joint has none" in lost


def test_a_mujoco_joint_decays_as_the_closed_form_says():
    """M v' = -B v - F until it stands: v(t) = (v_0 + F/B) exp(-B t/M) - F/B."""
    loaded = mujoco.MjModel.from_xml_string(mujoco_of(rig(DRY), "piston").content)
    data = mujoco.MjData(loaded)
    loaded.opt.timestep = 1e-5
    v_0, b, f, m = 0.5, 600.0, 40.0, 20.0
    data.qvel[0] = v_0
    stop = m / b * np.log(1.0 + v_0 * b / f)
    for share in (0.25, 0.5, 0.75):
        while data.time < share * stop - 1e-9:
            mujoco.mj_step(loaded, data)
        wanted = (v_0 + f / b) * np.exp(-b * data.time / m) - f / b
        assert data.qvel[0] == pytest.approx(wanted, rel=0.01)
    while data.time < stop + 0.05:  # its friction is a soft constraint: it takes a while to stand
        mujoco.mj_step(loaded, data)
    assert abs(data.qvel[0]) < 1e-3 * v_0
    rest = m / b * (v_0 - f / b * np.log(1.0 + v_0 * b / f))
    assert data.qpos[0] == pytest.approx(rest, rel=0.01)


def test_a_spring_load_is_the_stiffness_of_a_mujoco_joint():
    loaded = mujoco.MjModel.from_xml_string(mujoco_of(
        rig({"spring_load": {"k": 900.0, "x_0": 0.01}}), "piston").content)
    data = mujoco.MjData(loaded)
    data.qpos[0] = 0.03
    mujoco.mj_forward(loaded, data)
    assert data.qacc[0] == pytest.approx(-900.0 * 0.02 / 20.0, rel=1e-6)


def parameters(path, node):
    """Return what rclpy's own parser reads for a node."""
    script = f"""
import json, sys, rclpy
rclpy.init(args=["--ros-args", "--params-file", sys.argv[1]])
node = rclpy.create_node({node!r}, automatically_declare_parameters_from_overrides=True)
print(json.dumps({{name: list(value) if not isinstance(value, (str, float, int)) else value
                  for name, value in ((name, one.value) for name, one in
                                      node.get_parameters_by_prefix("").items())}}))
"""
    import json
    import os

    run = subprocess.run([sys.executable, "-c", script, str(path)], check=True, text=True,
                         capture_output=True,
                         env={**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"})
    return json.loads(run.stdout.splitlines()[-1])


def test_rclpy_reads_the_table(tmp_path):
    pytest.importorskip("rclpy")
    model = rig(CREEPING | {"constant_load": {"F_0": 12.0}})
    recording = Recording(1e-3, Simulator(settings(
        simulation={"excitation": {"one": {**TRIANGLE, "duration": 4.0}}})).advance(4000))
    file = tmp_path / "ff.yaml"
    file.write_text(feedforward_of(model, "rod", [recording]).content, encoding="utf-8")
    table = parameters(file, "friction_feedforward")
    v, force = np.array(table["velocity"]), np.array(table["force"])
    assert table["joint"] == "rod" and (np.diff(v) > 0).all()
    law = 600.0 * v + (30.0 + 20.0 * np.exp(-(v / 5e-3) ** 2)) * np.tanh(v / 2e-4) + 12.0
    np.testing.assert_allclose(force, law, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(table["friction"], law - 600.0 * v - 12.0, atol=1e-4)
    assert table["load"] == 12.0 and table["moving_mass"] == 20.0
    # The triangle goes at 0.04 m/s one way and the other, and at nothing in between for long.
    covered, seconds = np.array(table["covered"]), np.array(table["covered_seconds"])
    assert covered[np.argmin(abs(v - 0.0375))] or covered[-1]
    assert not covered[np.argmin(abs(v - 0.01))]
    assert seconds.sum() == pytest.approx(4.0, abs=0.01)
    other = parameters(file, "joint_trajectory_controller")
    assert other["gains.rod.ff_velocity_scale"] == 600.0


def test_the_velocity_of_a_recording_is_its_position_s_rate():
    time = np.arange(2000) * 1e-3
    x = 0.01 * np.sin(2 * np.pi * time)
    x[500:520] = np.nan
    found = velocity_of(Recording(1e-3, {"x": x, "x_d": x}))
    good = np.isfinite(found)
    assert good.sum() == 1980
    wanted = 0.01 * 2 * np.pi * np.cos(2 * np.pi * time)
    np.testing.assert_allclose(found[good], wanted[good], atol=3e-4)
