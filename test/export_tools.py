"""Configs with several effects, exported, and the simulator's own run of them."""

import numpy as np
from rig_tools import motion, settings

from eha_monitor.exports.model import Model
from eha_monitor.physics.simulator import Simulator, demanded_position

FAST = {"kind": "multisine", "amplitude": 0.02, "frequency": 0.5, "frequency_end": 6.0, "seed": 3}
SECONDS = 1.5
# What a diagnosis writes, and worse: each balance has something, and two terms have no name.
CASES = {
    "default": {},
    "identified": {"coulomb_friction": {"F_c": 40.04, "v_e": 1.1e-4, "z_0": 4.01e-6, "t_1": 8.5e-4,
                                        "v_d": 4.95e-3}},
    "friction, delay, air": {
        "stribeck_friction": {"F_c": 30.0, "F_d": 20.0, "v_s": 5e-3, "v_e": 2e-4, "z_0": 4e-6,
                              "t_1": 1e-4},
        "command_delay": {"T": 3.7e-3}, "entrained_air": {"alpha": 0.01}},
    "drive and sensors": {
        "drive_lag": {"tau": 4e-3}, "drive_saturation": {"omega_max": 300.0, "slew": 20000.0},
        "feedback_delay": {"T": 2e-3}, "position_delay": {"T": 2.3e-3},
        "pressure_delay": {"T": 1.3e-3}, "pressure_offset": {"b_1": 1e4, "b_2": -2e4},
        "pressure_drift": {"d_1": 1e3, "d_2": 0.0}},
    "line, own terms": {
        "line_dynamics": {"T_l": 1e-3, "zeta": 0.2, "Z": 1e4},
        "spot": {"adds": "force", "expression": "F*exp(-((x - x_0)/w)**2)", "F": 38.0,
                 "x_0": 8e-3, "w": 4e-3},
        "learned": {"adds": "flow", "of": "dp", "first": -1e6, "last": 1e6,
                    "values": [-1e-7, -2e-8, 0.0, 3e-8, 1e-7], "times": "direction",
                    "scale": 1e-3}},
    "pump ripple": {
        "ripple": {"adds": "flow", "expression": "F*cos(7*angle)*omega", "F": 8e-9},
        "wobble": {"adds": "flow", "of": "angle", "first": 0.0, "last": 6.283185307179586,
                   "values": [1e-7, -2e-7, 3e-7], "times": "omega", "scale": 100.0}},
    "play and valves": {
        "backlash": {"b": 2e-4}, "position_scale": {"k": 0.01, "in_loop": 1.0},
        "pressure_friction": {"mu": 3e-6}, "asymmetric_friction": {
            "F_c": 20.0, "dF": 5.0, "dB": 40.0, "z_0": 1e-5},
        "relief_valve": {"k": 1e-11, "p_c": 2e5}, "pump_dead_zone": {"omega_0": 2.0}},
}


def model_of(effects, shape=FAST, seconds=SECONDS, **rig) -> Model:
    return Model(settings(rig={"name": "my_rig", **rig}, effects=effects,
                          simulation=motion(shape, seconds)), "my_rig.yaml")


def demand(model: Model, time: np.ndarray) -> np.ndarray:
    return demanded_position(model.settings.simulation.excitation, time)


def own_run(model: Model, samples: int) -> dict[str, np.ndarray]:
    """Return the simulator's free run: true signals, and sensors without noise."""
    tree = model.settings.model_dump()
    silent = dict.fromkeys(tree["simulation"]["noise"], 0.0)
    tree["simulation"] |= {"noise": silent, "publish": ["x", "v", "p1", "p2", "omega"]}
    truth = Simulator(settings(**tree)).advance_truth(samples)
    seen = Simulator(settings(**tree)).advance(samples)
    names = ("time", "x", "v", "p1", "p2", "omega", "x_d", "angle")
    return dict(zip(names, truth.T, strict=True)) | {
        f"{name}_measured": seen[name] for name in ("x", "p1", "p2")}
