"""B and beta_e under each effect of the catalogue: with a bare config, and with the effect in it.

    python benchmarks/known_effects.py [effect ...]

The simulator makes 24 s at 1 kHz of rich motion (two triangle speeds, a multisine to 20 Hz, steps)
with 2 um and 2 kPa of noise; truth is B = 600 N·s/m and beta_e = 600 MPa.
"""

import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from eha_monitor.estimation.pipeline import estimate
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import settings_from_tree

MOTION = {
    "slow": {"kind": "triangle", "amplitude": 0.04, "frequency": 0.25, "duration": 8.0},
    "fast": {"kind": "triangle", "amplitude": 0.03, "frequency": 0.75, "duration": 4.0},
    "rich": {"kind": "multisine", "amplitude": 0.02, "frequency": 0.3, "frequency_end": 20.0,
             "components": 12, "seed": 3, "duration": 8.0},
    "steps": {"kind": "steps", "amplitude": 0.002, "frequency": 2.0, "seed": 1, "duration": 4.0},
}
NOISE = {"position": 2e-6, "pressure": 2e3}
TOLERANCE = 0.03
TRUTH = {"B": 600.0, "beta_e": 6e8}
SEAL = {"z_0": 3e-6}
# Effect -> its parameters; several cases where an effect has forms.
CASES = {
    "none": {},
    "added_mass": {"dM": 6.0},
    "anti_cavitation": {"k": 2e-11, "p_min": 1.95e6},
    "asymmetric_friction": {"dB": 150.0, "dF": 10.0, **SEAL},
    "backlash": {"b": 2e-4},
    "backlash, recording only": {"b": 2e-4, "in_loop": 0.0},
    "command_delay": {"T": 2e-3},
    "command_delay, 1.6 ms": {"T": 1.6e-3},
    "constant_load": {"F_0": 100.0},
    "coulomb_friction": {"F_c": 40.0, **SEAL},
    "coulomb_friction, no z_0": {"F_c": 40.0},
    "cross_port_leakage": {"L": 3e-12},
    "drive_gain": {"k": 0.08},
    "drive_lag": {"tau": 4e-3},
    "drive_saturation": {"omega_max": 150.0},
    "drive_saturation, slew": {"slew": 3000.0},
    "entrained_air": {"alpha": 0.01},
    "external_leakage": {"L_1": 2e-14, "L_2": 1e-14},
    "feedback_delay": {"T": 2e-3},
    "leakage_offset": {"Q_0": 3e-7},
    "line_dynamics": {"T_l": 2e-3},
    "position_delay": {"T": 2e-3},
    "position_delay, 1.6 ms": {"T": 1.6e-3},
    "position_dependent_volume": {"A_v": 5.05e-4},
    "position_quantisation": {"q": 1e-5},
    "position_scale": {"k": 0.08},
    "position_scale, in loop": {"k": 0.08, "in_loop": 1.0},
    "presliding_friction": {"F_c": 40.0, "z_0": 4e-5},
    "pressure_delay": {"T": 2e-3},
    "pressure_delay, 1.6 ms": {"T": 1.6e-3},
    "pressure_drift": {"d_1": 3e3, "d_2": 0.0},
    "pressure_friction": {"mu": 1e-5, **SEAL},
    "pressure_offset": {"b_1": 4e4, "b_2": 0.0},
    "pressure_scale": {"k_1": 0.08, "k_2": 0.0},
    "pump_dead_zone": {"omega_0": 8.0},
    "pump_flow_gain": {"k": 0.08},
    "pump_volumetric_loss": {"k": 4e-7},
    "pump_volumetric_loss, by speed": {"k": 4e-7, "motoring": -1.0},
    "quadratic_friction": {"a_1": 8000.0},
    "relief_valve": {"k": 2e-11, "p_c": 1.5e5},
    "spring_load": {"k": 8000.0},
    "stribeck_friction": {"F_c": 20.0, "F_d": 20.0, **SEAL},
    "turbulent_leakage": {"c": 2e-9},
}


def recording_of(case: str, channels: tuple[str, ...], seed: int = 0, noise: float = 1.0,
                 seconds: float = 24.0, effects: dict | None = None) -> tuple[Recording, dict]:
    """Return a simulated recording with the effect of ``case``, and its ``effects`` section.

    Other ``effects`` stand in for those of the case.
    """
    effect = case.split(",")[0]
    if effects is None:
        effects = {effect: CASES[case]} if effect in CATALOGUE else {}
    levels = {name: noise * value for name, value in NOISE.items()}
    if effect == "position_quantisation":
        levels["position_resolution"] = CASES[case]["q"]
    share = seconds / 24.0
    motion = {name: {**one, "duration": one["duration"] * share} for name, one in MOTION.items()}
    config = settings_from_tree({"effects": effects, "simulation": {
        "excitation": motion, "noise": levels, "publish": list(channels)}}, "benchmark")
    measured = Simulator(config, seed).advance(round(seconds / config.rig.sample_time))
    return Recording(config.rig.sample_time, measured), effects


def answer(recording: Recording, effects: dict):
    """Return the estimate with the config's defaults and these effects."""
    return estimate(recording, settings_from_tree({"effects": effects}, "benchmark"))


def reached(found) -> bool:
    """Tell whether the model fits and what the channels tell of B and beta_e is within 3 %."""
    told = {name: one for name, one in found.parameters.items() if one.status != "no_data"}
    return bool(told) and found.model.status == "consistent" and all(
        abs(one.value / TRUTH[name] - 1.0) < TOLERANCE for name, one in told.items())


def main() -> None:
    """Print the table; exit with 1 where an effect is not reached."""
    channels = ("x", "x_d", "omega", "p1", "p2")
    wanted = [one for one in sys.argv[1:] if not one.startswith("--")]
    for option in sys.argv[1:]:
        if option.startswith("--channels="):
            channels = tuple(option.split("=")[1].split(","))
    table = Table(title="within 3 % and consistent, channels " + ", ".join(channels))
    for column in ("effect", "bare B", "bare beta_e", "bare", "B", "beta_e / MPa", "model",
                   "reached", "s"):
        table.add_column(column)
    missed = []
    for case in CASES:
        if wanted and case.split(",")[0] not in wanted:
            continue
        recording, effects = recording_of(case, channels)
        bare = answer(recording, {})
        started = time.perf_counter()
        known = answer(recording, effects)
        seconds = time.perf_counter() - started
        row = [case]
        for found in (bare, known):
            b, beta = found.parameters["B"], found.parameters["beta_e"]
            row += [f"{b.value:.1f} ± {b.stddev:.1f}",
                    f"{beta.value / 1e6:.1f} ± {beta.stddev / 1e6:.1f}", found.model.status]
        if not reached(known):
            missed.append(case)
        table.add_row(*row, "yes" if reached(known) else "NO", f"{seconds:.2f}")
        if "--why" in sys.argv:
            print(case, known.model.message, np.round(known.wall_s, 2))
    Console(width=150).print(table)
    print(f"{len(missed)} not reached: {', '.join(missed)}" if missed else "all reached")
    sys.exit(bool(missed))


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    main()
