"""Simulated recordings and the paper's constants for the tests of plant and filters.

The constants stand here a second time, copied from the paper's page, so that a change of the
config's defaults cannot change what the tests expect.
"""

from dataclasses import dataclass

import numpy as np

from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import Settings, settings_from_tree

A, B, C_T, D_P, K_POS, M, T_S, V0, BETA = (
    5.05e-4, 600.0, 5e-13, 1.6925e-7, 23000.0, 20.0, 1e-3, 6.85e-5, 6e8)

TRIANGLE = {"kind": "triangle", "amplitude": 0.04, "frequency": 0.25}
SINE = {"kind": "sine", "amplitude": 0.01, "frequency": 4.0}
MULTISINE = {"kind": "multisine", "amplitude": 0.02, "frequency": 0.3, "frequency_end": 20.0,
             "components": 12, "seed": 3}
CHIRP = {"kind": "chirp", "amplitude": 0.005, "frequency": 0.5, "frequency_end": 12.0}
STEPS = {"kind": "steps", "amplitude": 0.002, "frequency": 2.0, "seed": 1}
REST = {"kind": "rest"}
SILENT = dict.fromkeys(("position", "velocity", "pressure", "pump_speed", "force",
                        "temperature"), 0.0)


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
        measured = Simulator(config, seed=seed).measure(self.truth)
        return Recording(config.rig.sample_time, measured)


def simulated(shape: dict, seconds: float, rig=None, effects=None, **simulation) -> Run:
    """Simulate once; keyword arguments go into the ``simulation`` section."""
    config = settings(rig=rig or {}, effects=effects or {},
                      simulation=motion(shape, seconds, **simulation))
    truth = Simulator(config).advance_truth(round(seconds / config.rig.sample_time))
    return Run(config, truth)


def without(recording: Recording, *names: str) -> Recording:
    """Return a recording that lacks some channels."""
    return with_channels(recording, **dict.fromkeys(names))


def with_channels(recording: Recording, **channels) -> Recording:
    """Return a recording with other channels; None takes one away."""
    merged = {**recording.channels, **channels}
    return Recording(recording.sample_time,
                     {name: values for name, values in merged.items() if values is not None})
