"""Simulated recordings and the paper's constants for the tests of plant and filters.

The constants stand here a second time, copied from the paper's page, so that a change of the
config's defaults cannot change what the tests expect.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.importing import read_table
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import Settings, load_settings, settings_from_tree

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT.parent / "shared" / "data"  # the real recordings: not here, as they state no licence

A, B, C_T, D_P, K_POS, M, T_S, V0, BETA = (
    5.05e-4, 600.0, 5e-13, 1.6925e-7, 23000.0, 20.0, 1e-3, 6.85e-5, 6e8)



def write_channels(path, channels, settings, *, start_ns=0, overwrite=False):
    """Write channel -> (n,) SI values on the config's sample time as a bag."""
    return write_recording(path, Recording(settings.rig.sample_time, channels, start_ns),
                           settings, overwrite=overwrite)


def one_by_one(rows):
    """Return (stamp, channel -> value, where it has one) of each of the aligned rows."""
    return [(int(stamp), {name: float(values[k]) for name, values in rows.columns.items()
                          if np.isfinite(values[k])}) for k, stamp in enumerate(rows.stamps)]


TRIANGLE = {"kind": "triangle", "amplitude": 0.04, "frequency": 0.25}
SINE = {"kind": "sine", "amplitude": 0.01, "frequency": 4.0}
MULTISINE = {"kind": "multisine", "amplitude": 0.02, "frequency": 0.3, "frequency_end": 20.0,
             "components": 12, "seed": 3}
CHIRP = {"kind": "chirp", "amplitude": 0.005, "frequency": 0.5, "frequency_end": 12.0}
STEPS = {"kind": "steps", "amplitude": 0.002, "frequency": 2.0, "seed": 1}
REST = {"kind": "rest"}
SENSORS = ("x", "v", "x_d", "omega", "p1", "p2", "force", "temperature")
LOUD = {"position": 1e-5, "pressure": 5e3, "pump_speed": 1.0}
SILENT = dict.fromkeys(("position", "velocity", "pressure", "pump_speed", "force",
                        "temperature"), 0.0)


def closed_loop(b=B, beta=BETA, c_t=C_T):
    """A and the input column of (x, v, dp) from the three lines of the paper's page."""
    stiff = 2 * beta / V0
    a = np.array([[0, 1, 0],
                  [0, -b / M, A / M],
                  [-stiff * D_P * K_POS, -stiff * A, -stiff * c_t / 2]])
    return a, np.array([0, 0, stiff * D_P * K_POS])


def linear_response(x_d, dt, b=B, beta=BETA, c_t=C_T):
    """(n, 3) states for a piecewise linear x_d, by the exponential of the augmented matrix."""
    a, g = closed_loop(b, beta, c_t)
    big = np.zeros((5, 5))  # states, input, slope of the input
    big[:3, :3], big[:3, 3], big[3, 4] = a, g, 1.0
    e = expm(big * dt)
    y = np.zeros((len(x_d), 3))
    for k in range(len(x_d) - 1):
        slope = (x_d[k + 1] - x_d[k]) / dt
        y[k + 1] = (e @ np.array([*y[k], x_d[k], slope]))[:3]
    return y


def settings(**tree) -> Settings:
    """Return settings from sections."""
    return settings_from_tree(tree, "test")


def motion(shape: dict, seconds: float, **simulation) -> dict:
    """Return a ``simulation`` section with one stretch of motion."""
    return {"excitation": {"motion": {**shape, "duration": seconds}}, **simulation}


@dataclass(frozen=True)
class Run:
    """One simulated truth, from which noise is drawn as often as wanted."""

    config: Settings
    truth: np.ndarray

    def recording(self, seed: int = 0, **noise) -> Recording:
        """Return one draw of the sensors; ``noise`` changes the noise section."""
        config = self.config
        if noise:
            tree = config.model_dump()
            tree["simulation"]["noise"].update(noise)
            config = settings_from_tree(tree, "test")
        measured = Simulator(config, seed=seed).advance(len(self.truth))
        return Recording(config.rig.sample_time, measured)


def simulated(shape: dict, seconds: float, rig=None, effects=None, **simulation) -> Run:
    """Simulate once; keyword arguments go into the ``simulation`` section."""
    config = settings(rig=rig or {}, effects=effects or {},
                      simulation=motion(shape, seconds, **simulation))
    truth = Simulator(config).advance_truth(round(seconds / config.rig.sample_time))
    return Run(config, truth)


def real(rig: str, *files: str) -> tuple[list[Recording], Settings]:
    """Return recordings and settings of a real rig; skips where they are not here."""
    if not (DATA / files[0]).exists():
        pytest.skip(f"{DATA / files[0]} is not here")
    config = load_settings(ROOT / "config" / f"{rig}.yaml")
    return [read_table(DATA / file, config) for file in files], config


def copies(recording: Recording) -> dict[str, np.ndarray]:
    """Return the channels to be changed."""
    return {name: values.copy() for name, values in recording.channels.items()}


def without(recording: Recording, *names: str) -> Recording:
    """Return a recording that lacks some channels."""
    return with_channels(recording, **dict.fromkeys(names))


def with_channels(recording: Recording, **channels) -> Recording:
    """Return a recording with other channels; None takes one away."""
    merged = {**recording.channels, **channels}
    return Recording(recording.sample_time,
                     {name: values for name, values in merged.items() if values is not None})


def fed(live, rows, every=10):
    """Give a live estimator rows, (time in s, row) each, some at a time; yield after each."""
    rows = list(rows)
    for start in range(0, len(rows), every):
        batch = rows[start:start + every]
        names = dict.fromkeys(name for _, row in batch for name in row)
        live.push_rows(np.array([time for time, _ in batch]), {
            name: np.array([row.get(name, np.nan) for _, row in batch]) for name in names})
        yield start + len(batch)
