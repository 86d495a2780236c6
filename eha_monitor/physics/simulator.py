"""The simulated rig: plant, faults over time, sensors; as a stream or all at once."""

import numpy as np

from eha_monitor.physics import excitation, parameters, signals
from eha_monitor.physics.plant import run
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Fault


class Simulator:
    """The actuator of a config, advanced by whole samples.

    Parameters
    ----------
    settings : config; rig, simulation and effects are read.
    seed : seed of the sensor noise; None takes the config's.
    source : name of the config in errors.
    """

    def __init__(self, settings: Settings, seed: int | None = None, source: str = "config"):
        parameters.require_plant(settings.rig, source)
        self.settings = settings
        self.dt = settings.rig.sample_time
        self.samples = 0
        effects = dict(settings.effects)
        for fault in settings.simulation.faults.values():
            effect, dot, _ = fault.parameter.partition(".")
            if dot and effect not in effects:  # a fault may bring its effect in, from nothing
                effects[effect] = {p.name: p.default if p.default is not None else 0.0
                                   for p in parameters.CATALOGUE[effect].parameters}
        self.theta, self.active = parameters.theta_of(settings.rig, effects)
        self.rng = np.random.default_rng(
            settings.simulation.seed if seed is None else seed)
        start = excitation.demanded_position(settings.simulation.excitation, np.zeros(1))[0]
        charge = settings.rig.charge_pressure
        self.y = np.array([start, 0.0, charge, charge * settings.rig.area_1
                           / settings.rig.area_2])  # at rest: the forces balance

    @property
    def time(self) -> float:
        """Seconds simulated so far."""
        return self.samples * self.dt

    def advance(self, n: int) -> dict[str, np.ndarray]:
        """Simulate the next ``n`` samples and return what the sensors show, channel -> (n,)."""
        truth = self.advance_truth(n)
        return self.measure(truth)

    def advance_truth(self, n: int) -> np.ndarray:
        """Simulate ``n`` samples; (n, N_SIGNALS) true signals, and the state moves on."""
        substeps = self.settings.simulation.substeps
        index = self.samples + np.arange(n)
        fine = (index[:, None] + np.arange(2 * substeps + 1)[None, :] / (2 * substeps)) * self.dt
        x_d = excitation.demanded_position(self.settings.simulation.excitation, fine)
        out = np.empty((n, signals.N_SIGNALS))
        run(self.y, self.time, self.dt, substeps, x_d, self.theta_over(index * self.dt),
            self.active, out)
        self.samples += n
        return out

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

    def measure(self, truth: np.ndarray) -> dict[str, np.ndarray]:
        """Return the published channels: truth, noise, resolution; channel -> (n,) SI."""
        rig, noise = self.settings.rig, self.settings.simulation.noise
        p1, p2 = truth[:, signals.P1], truth[:, signals.P2]
        clean = {
            "x": (truth[:, signals.X], noise.position),
            "v": (truth[:, signals.V], noise.velocity),
            "x_d": (truth[:, signals.X_D], 0.0),
            "omega": (truth[:, signals.OMEGA], noise.pump_speed),
            "p1": (p1, noise.pressure),
            "p2": (p2, noise.pressure),
            "force": (rig.area_1 * p1 - rig.area_2 * p2, noise.force),
            "temperature": (np.full(len(truth), self.settings.simulation.temperature),
                            noise.temperature),
        }
        shown = {}
        for name, (values, sigma) in clean.items():
            drawn = self.rng.standard_normal(len(truth))  # drawn always: channels do not
            if name in self.settings.simulation.publish:  # change one another's noise
                shown[name] = values + sigma * drawn
        step = noise.position_resolution
        if step > 0 and "x" in shown:
            shown["x"] = step * np.round(shown["x"] / step)
        return shown


def progress(fault: Fault, time: np.ndarray) -> np.ndarray:
    """Return how far a fault has come at each time, 0 to 1."""
    if fault.duration == 0:
        return (time >= fault.start).astype(float)
    return np.clip((time - fault.start) / fault.duration, 0.0, 1.0)
