"""The simulated rig: plant, faults over time, sensors; as a stream or all at once."""

import warnings
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from eha_monitor.errors import InputError
from eha_monitor.physics import parameters, plant, signals
from eha_monitor.physics.contributions import circuit_of, new_memory
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Fault, Rig, Segment


def demanded_position(segments: dict[str, Segment], time: np.ndarray) -> np.ndarray:
    """Return x_d(t) in m; the stretches follow one another and then repeat from the start.

    Parameters
    ----------
    segments : stretches by name, in order.
    time : any shape, seconds since the start.
    """
    ends = np.cumsum([segment.duration for segment in segments.values()])
    local = np.mod(time, ends[-1])
    which = np.searchsorted(ends, local, side="right").clip(max=len(ends) - 1)
    out = np.empty_like(local)
    for i, segment in enumerate(segments.values()):
        mask = which == i
        if mask.any():
            start = ends[i] - segment.duration
            out[mask] = segment.offset + shape(segment, local[mask] - start)
    return out


def total_duration(segments: dict[str, Segment]) -> float:
    """Seconds until the excitation repeats."""
    return float(sum(segment.duration for segment in segments.values()))


def shape(segment: Segment, t: np.ndarray) -> np.ndarray:
    """Return one stretch about its offset, m; ``t`` counts from its start."""
    a, f = segment.amplitude, segment.frequency
    if segment.kind == "triangle":  # starts at 0, rising with speed 4 a f
        phase = np.mod(f * t + 0.25, 1.0)
        return a * (1.0 - 4.0 * np.abs(phase - 0.5))
    if segment.kind == "sine":
        return a * np.sin(2 * np.pi * f * t)
    if segment.kind == "chirp":  # frequency rises linearly from f to frequency_end
        rate = (segment.frequency_end - f) / segment.duration
        return a * np.sin(2 * np.pi * (f * t + 0.5 * rate * t**2))
    if segment.kind == "multisine":
        return a * multisine(segment, t)
    if segment.kind == "steps":
        heights = np.random.default_rng(segment.seed).uniform(
            -1.0, 1.0, int(np.ceil(segment.duration * f)) + 1)
        return a * heights[np.floor(t * f).astype(int).clip(0, len(heights) - 1)]
    if segment.kind == "file":
        table = read_motion(segment.file)
        return np.interp(t, table[:, 0], table[:, 1])
    return np.zeros_like(t)


def multisine(segment: Segment, t: np.ndarray) -> np.ndarray:
    """Tones spaced evenly in log frequency, falling as 1/f, random phases, peak near 1."""
    rng = np.random.default_rng(segment.seed)
    tones = np.geomspace(segment.frequency, segment.frequency_end, segment.components)
    phases = rng.uniform(0, 2 * np.pi, segment.components)
    weights = segment.frequency / tones
    waves = [w * (np.sin(2 * np.pi * f * t + p) - np.sin(p))
             for w, f, p in zip(weights, tones, phases, strict=True)]
    return np.sum(waves, axis=0) / weights.sum()


@lru_cache(maxsize=8)
def read_motion(path: str) -> np.ndarray:
    """Return (n, 2) time in s and position in m from a CSV with columns ``t`` and ``x_d``."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of an empty file; the error says it
            table = np.genfromtxt(Path(path), delimiter=",", names=True)
        motion = np.column_stack([table["t"], table["x_d"]])
    except (OSError, ValueError, IndexError, TypeError, KeyError) as problem:
        raise InputError(f"{path}: expected a CSV with columns t (s) and x_d (m)") from problem
    if len(motion) < 2 or not np.isfinite(motion).all() or (np.diff(motion[:, 0]) <= 0).any():
        raise InputError(f"{path}: expected finite rows with rising t")
    return motion


RUN_AWAY = 1e11  # Pa: no oil stands it


class Simulator:
    """The actuator of a config, advanced by whole samples.

    Parameters
    ----------
    settings : config; rig, simulation and effects are read.
    seed : seed of the sensor noise; None takes the config's.
    source : name of the config in errors.
    demand : x_d in m at times in s, any shape, in place of the config's excitation; what it says
        of a time may change until that is simulated.
    """

    def __init__(self, settings: Settings, seed: int | None = None, source: str = "config",
                 demand: Callable[[np.ndarray], np.ndarray] | None = None):
        parameters.require_plant(settings.rig, source)
        self.settings, self._source = settings, source
        self.dt = settings.rig.sample_time
        self.samples = 0
        effects = dict(settings.effects)
        for fault in settings.simulation.faults.values():
            effect, dot, _ = fault.parameter.partition(".")
            if dot and effect not in effects:  # a fault may bring its effect in, from nothing
                effects[effect] = {p.name: p.default if p.default is not None else p.neutral
                                   for p in parameters.CATALOGUE[effect].parameters}
        self.theta, self.active = parameters.theta_of(settings.rig, effects)
        self.rng = np.random.default_rng(settings.simulation.seed if seed is None else seed)
        self._own_demand = demand
        self._tests: list[float] = []  # when each test excitation began, s
        start = self._demanded(np.zeros(1))[0]
        self.y = plant.at_rest(self.theta, self.active, start)
        self._actuator = plant.actuator_of(self.y, new_memory())
        self._shaft = np.nan, 0.0  # speed rad/s and angle rad at the last sample

    @property
    def time(self) -> float:
        """Seconds simulated so far."""
        return self.samples * self.dt

    @property
    def test_left(self) -> float:
        """Seconds until the test excitation that runs now ends; 0 if none runs."""
        whole = total_duration(self.settings.simulation.test_excitation)
        return max(0.0, self._tests[-1] + whole - self.time) if self._tests else 0.0

    def excite(self) -> None:
        """Begin the config's test excitation at the next sample; nothing if one runs."""
        if not self.test_left:
            self._tests.append(self.time)

    def advance(self, n: int) -> dict[str, np.ndarray]:
        """Simulate the next ``n`` samples and return what the sensors show, channel -> (n,)."""
        return self.measure(*self._run(n))

    def batch(self, n: int) -> dict[str, np.ndarray]:
        """Return the same as :meth:`advance`, of a rig that does not run away.

        Raises
        ------
        InputError
            If it does, with what its position loop may be at most.
        """
        truth, shown = self._run(n)
        if not (np.abs(truth[:, [signals.P1, signals.P2]]) < RUN_AWAY).all():
            raise InputError(f"{self._source}: the simulated rig is unstable"
                             + _loop_words(self.settings.rig))
        return self.measure(truth, shown)

    def advance_truth(self, n: int) -> np.ndarray:
        """Simulate ``n`` samples; (n, N_SIGNALS) true signals, and the state moves on."""
        return self._run(n)[0]

    def _run(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Return true signals (n, N_SIGNALS) and what noise-free sensors show (n, N_OUTPUTS)."""
        substeps = self.settings.simulation.substeps
        index = self.samples + np.arange(n)
        theta = self.theta_over(index * self.dt)
        lead = 1 + int(np.ceil(max(circuit_of(row, self.active)[signals.COMMAND_DELAY]
                                   for row in (theta[0], theta[-1])) / self.dt))
        u = self._command(self.samples - lead, n + lead, substeps)
        out, shown = np.empty((n, signals.N_SIGNALS)), np.empty((n, plant.N_OUTPUTS))
        held = self.settings.command_hold == "sampled"
        plant.run(self._actuator, self.time,
                  plant.Given(u, substeps, lead, True, held, plant.NOT_HEARD),
                  plant.Step(self.dt, substeps), theta, self.active, out, shown)
        self.samples += n
        out[:, signals.ANGLE] = self._turned(out[:, signals.OMEGA])
        return out, shown

    def _turned(self, omega: np.ndarray) -> np.ndarray:
        """Return what the shaft has turned since the start, rad (n,), by the trapezoidal rule."""
        before, angle = self._shaft
        steps = 0.5 * self.dt * (omega + np.concatenate([[before], omega[:-1]]))
        found = angle + np.cumsum(np.nan_to_num(steps))
        self._shaft = float(omega[-1]), float(found[-1])
        return found

    def _command(self, first: int, n: int, pieces: int) -> np.ndarray:
        """Return x_d from sample ``first`` on as parabolas, (n*pieces, 4)."""
        half = np.arange(n * pieces * 2 + 1) / (2 * pieces)
        x_d = self._demanded(np.maximum((first + half) * self.dt, 0.0))
        start, middle, end = x_d[:-1:2], x_d[1::2], x_d[2::2]
        return np.column_stack([start, 4 * middle - 3 * start - end,
                                2 * (start + end - 2 * middle), np.zeros_like(start)])

    def _demanded(self, time: np.ndarray) -> np.ndarray:
        """Return x_d at each time, m; the excitation's own time stands still during a test."""
        if self._own_demand is not None:
            return self._own_demand(time)
        simulation = self.settings.simulation
        test, own, added = simulation.test_excitation, time, 0.0
        whole = total_duration(test)
        for began in self._tests:
            local = np.clip(time - began, 0.0, whole)
            own = own - local
            inside = np.where(local < whole, local, 0.0)
            added = added + (demanded_position(test, inside)
                             - demanded_position(test, np.zeros(1)))
        return demanded_position(simulation.excitation, own) + added

    def theta_over(self, time: np.ndarray) -> np.ndarray:
        """Return theta at each time, (n, N_THETA), or one row where nothing changes."""
        faults = self.settings.simulation.faults.values()
        if not faults:
            return self.theta[None, :]
        table = np.repeat(self.theta[None, :], len(time), axis=0)
        for fault in faults:
            place = parameters.place_of(fault.parameter)
            table[:, place] += (fault.value - self.theta[place]) * progress(fault, time)
        return table

    def measure(self, truth: np.ndarray, shown: np.ndarray) -> dict[str, np.ndarray]:
        """Return the published channels: sensors, noise, resolution; channel -> (n,) SI."""
        rig, noise = self.settings.rig, self.settings.simulation.noise
        x, v, p1, p2, omega = shown.T
        clean = {
            "x": (x, noise.position), "v": (v, noise.velocity),
            "x_d": (truth[:, signals.X_D], 0.0), "omega": (omega, noise.pump_speed),
            "p1": (p1, noise.pressure), "p2": (p2, noise.pressure),
            "force": (rig.area_1 * p1 - rig.area_2 * p2, noise.force),
            "temperature": (np.full(len(truth), self.settings.simulation.temperature),
                            noise.temperature),
        }
        measured = {}
        for name, (values, sigma) in clean.items():
            drawn = self.rng.standard_normal(len(truth))  # drawn always: channels do not
            if name in self.settings.simulation.publish:  # change one another's noise
                measured[name] = values + sigma * drawn
        step = noise.position_resolution
        if step > 0 and "x" in measured:
            measured["x"] = step * np.round(measured["x"] / step)
        return measured


def _loop_words(rig: Rig) -> str:
    """Return in words that the position loop is too fast, "" where it is not.

    Of C M s^3 + (C B + L M) s^2 + (L B + A^2) s + A D K, with the chambers' C = V / (2 beta), the
    Hurwitz criterion bounds K D / A (Merritt 1967, Eq. 8-15, with B beside it).
    """
    area, soft = rig.area_1, rig.volume_1 / (2.0 * rig.bulk_modulus)
    most = (soft * rig.viscous_damping + rig.leakage * rig.mass) * (
        rig.leakage * rig.viscous_damping + area**2) / (soft * rig.mass * area**2)
    loop = (rig.position_gain or 0.0) * rig.pump_displacement / area
    return "" if loop < most else (
        f": the position loop's gain rig.position_gain·pump_displacement/area_1 is {loop:.3g} "
        f"1/s, and this oil column allows {most:.3g} 1/s: expected a smaller position_gain, or "
        "a larger viscous_damping or leakage")


def progress(fault: Fault, time: np.ndarray) -> np.ndarray:
    """Return how far a fault has come at each time, 0 to 1."""
    if fault.duration == 0:
        return (time >= fault.start).astype(float)
    return np.clip((time - fault.start) / fault.duration, 0.0, 1.0)
