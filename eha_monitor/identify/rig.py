"""What an experiment moves: a rig, and the simulated one."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from eha_monitor.identify.bounds import Watch, held
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.experiment import Experiment as Bounds
from eha_monitor.settings.monitor import Settings

TURN = 0.02  # s that are simulated between two looks at the limits
HELD = 0.5  # s that are still recorded after an abort
START_NS = 1_000_000_000


@dataclass(frozen=True)
class Ran:
    """A motion that was run.

    Attributes
    ----------
    recording : what came.
    aborted : why it ended early, or ""; ``asked`` : whether somebody asked for it.
    bag : where it was recorded as it came, or None.
    """

    recording: Recording
    aborted: str = ""
    asked: bool = False
    bag: Path | None = None


class Rig(Protocol):
    """What runs motions."""

    def position(self) -> float:
        """Return where the piston is held, m."""

    def run(self, x_d: np.ndarray, name: str) -> Ran:
        """Run a demand (n,) m, one value to a sample, from where the piston is held.

        Where a limit is exceeded, data stop, or somebody asks for it, the position demanded last
        is held, or the limit next to it: the piston comes to rest there without a jolt.
        """


class SimulatedRig:
    """The simulated actuator of a config, in place of a rig: it goes on from motion to motion.

    Parameters
    ----------
    settings : of the simulated actuator, effects and sensor noise included.
    bounds : complete limits.
    """

    def __init__(self, settings: Settings, bounds: Bounds, seed: int | None = None,
                 source: str = "config"):
        self._demand = np.full(1, 0.5 * (bounds.lower + bounds.upper))
        self._began, self._dt = 0, settings.rig.sample_time
        self._simulator = Simulator(settings, seed, source, self._demanded)
        self._bounds = bounds
        self._noise = max(settings.simulation.noise.position,
                          settings.simulation.noise.position_resolution)

    def _demanded(self, time: np.ndarray) -> np.ndarray:
        """Return x_d at each time, m; behind its end the demand is held."""
        return np.interp(time / self._dt - self._began, np.arange(len(self._demand)),
                         self._demand)

    def position(self) -> float:
        """Return where the piston is held, m."""
        return float(self._demand[-1])

    def run(self, x_d: np.ndarray, name: str) -> Ran:
        """Run a demand; see :meth:`Rig.run`."""
        simulator, parts = self._simulator, []
        watch = Watch(self._bounds, simulator.dt, self._noise)
        self._demand, self._began = x_d, simulator.samples
        start, end, aborted = simulator.samples, simulator.samples + len(x_d), ""
        turn = max(1, round(TURN / simulator.dt))
        while simulator.samples < end:
            shown = simulator.advance(min(turn, end - simulator.samples))
            parts.append(shown)
            aborted = aborted or watch.exceeded(shown)
            if aborted and end > simulator.samples and self._demand is x_d:
                self._demand = np.array([held(self._bounds, x_d[simulator.samples - start - 1])])
                end = min(end, simulator.samples + round(HELD / simulator.dt))
        return Ran(Recording(simulator.dt, {key: np.concatenate([part[key] for part in parts])
                                            for key in parts[0]},
                             START_NS + round(start * simulator.dt * 1e9), name), aborted)
