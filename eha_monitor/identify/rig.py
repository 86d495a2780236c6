"""What an experiment moves, a rig or the simulated one, and the limits that it keeps."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.signal import savgol_coeffs

from eha_monitor.errors import InputError
from eha_monitor.physics.simulator import Simulator
from eha_monitor.quantity import quantity
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Experiment, Settings
from eha_monitor.settings.monitor import Experiment as Bounds

NEEDED = ("lower", "upper", "speed", "acceleration", "pressure")
LOOP = ("area_1", "area_2", "volume_1", "volume_2", "pump_displacement", "position_gain")
CHANNELS = ("x", "p1", "p2")  # that are watched, where they come
WINDOW = 0.02  # s over which speed and acceleration are taken from the position
STANDING = 3  # samples beyond a limit before it counts: one may be a spike
INSIDE = 0.02  # of the travel, from its ends, where a position is held
NOISE = 5.0  # standard deviations that noise may add


def bounds_of(settings: Settings, source: str) -> Experiment:
    """Return the limits of a config, complete and possible on its rig.

    Parameters
    ----------
    source : what the config is called in errors.

    Raises
    ------
    InputError
        One line: the key and what was expected.
    """
    given, rig = settings.experiment, settings.rig
    for key in NEEDED:
        if getattr(given, key) is None:
            raise InputError(f"{source}: experiment.{key}: expected a number, as nothing is moved "
                             f"without limits of {', '.join(NEEDED)}")
    for key in LOOP:
        if getattr(rig, key) is None:
            raise InputError(f"{source}: rig.{key}: expected a number, as motions are planned "
                             "with a model of the position loop")
    if given.pressure <= rig.charge_pressure:
        raise InputError(f"{source}: experiment.pressure: expected more than the charge pressure "
                         f"of {quantity(rig.charge_pressure, 'Pa', 3)}, got "
                         f"{quantity(given.pressure, 'Pa', 3)}")
    return given


def held(bounds: Experiment, position: float) -> float:
    """Return where to hold a piston, m: as demanded, but a little within the travel."""
    inside = INSIDE * (bounds.upper - bounds.lower)
    return float(np.clip(position, bounds.lower + inside, bounds.upper - inside))


class Watch:
    """Tells from what the sensors show whether a limit is exceeded.

    Speed and acceleration are those of a parabola fitted to ``WINDOW`` s of positions
    (Savitzky and Golay 1964); what their noise may add is not counted.

    Parameters
    ----------
    bounds : complete limits.
    dt : sample time, s.
    noise : standard deviation of the position, m.
    """

    def __init__(self, bounds: Experiment, dt: float, noise: float):
        self._bounds, self._dt = bounds, dt
        count = max(5, 2 * round(0.5 * WINDOW / dt) + 1)
        self._rates = [(name, unit, limit, kernel, NOISE * noise * float(np.linalg.norm(kernel)))
                       for name, unit, limit, kernel in (
            ("speed", "m/s", bounds.speed, savgol_coeffs(count, 2, 1, dt)),
            ("acceleration", "m/s²", bounds.acceleration, savgol_coeffs(count, 2, 2, dt)))]
        self._kept: dict[str, np.ndarray] = {}
        self._count = count

    def exceeded(self, channels: dict[str, np.ndarray]) -> str:
        """Take further samples, channel -> (n,) SI; return which limit they exceed, or "".

        Missing samples (NaN) are left out, those of a channel that does not come are not asked.
        """
        for name in CHANNELS:
            values = channels.get(name)
            if values is None:
                continue
            values = values[np.isfinite(values)]
            before = self._kept.get(name, values[:0])
            rows = np.concatenate([before, values])
            self._kept[name] = rows[-(self._count + STANDING):]
            if found := self._beyond(name, rows):
                return found
        return ""

    def _beyond(self, name: str, rows: np.ndarray) -> str:
        b = self._bounds
        if name != "x":
            return lasting(rows, lambda v: v > b.pressure, f"{name} of", "Pa", b.pressure)
        found = (lasting(rows, lambda v: v > b.upper, "position of", "m", b.upper)
                 or lasting(-rows, lambda v: v > -b.lower, "position of", "m", -b.lower, -1.0))
        for what, unit, limit, kernel, extra in self._rates:
            if found or len(rows) < len(kernel):
                break
            rates = np.abs(np.convolve(rows, kernel, "valid"))
            found = lasting(rates, lambda v, most=limit + extra: v > most, f"{what} of", unit,
                            limit)
        return found


def lasting(values: np.ndarray, beyond: Callable[[np.ndarray], np.ndarray], what: str, unit: str,
            limit: float, sign: float = 1.0) -> str:
    """Return in words by how much values are beyond a limit for ``STANDING`` samples, or ""."""
    if len(values) < STANDING:
        return ""
    least = np.lib.stride_tricks.sliding_window_view(values, STANDING).min(axis=1)
    if not beyond(least).any():
        return ""
    return (f"{what} {quantity(sign * float(least.max()), unit, 3)}, the limit is "
            f"{quantity(sign * limit, unit, 3)}")


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
