"""What would tell structures apart that no allowed motion does: load, temperature, sensor."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from eha_monitor.identify.plan import WORTH, Contest, Structure
from eha_monitor.mismatch.advise.motions import demanded, without_noise
from eha_monitor.mismatch.data.experiment import OUTPUTS, Experiment
from eha_monitor.mismatch.likelihood.fit import Fit, with_unknowns
from eha_monitor.mismatch.likelihood.simulated import simulated
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of
from eha_monitor.quantity import quantity
from eha_monitor.settings.experiment import Experiment as Bounds

LOAD = 0.3  # of the force that the pressure limit allows
CHARGED = 1.5  # times the charge pressure
WARMER = 0.7  # of B: mineral oil some 12 K warmer (Reynolds' law, 0.03 1/K)
SENSORS = {"p1": ("a sensor of the pressure of chamber 1", "pressure"),
           "p2": ("a sensor of the pressure of chamber 2", "pressure"),
           "omega": ("a sensor of the pump speed", "pump_speed"),
           "v": ("a sensor of the velocity", "velocity")}


def otherwise(contest: Contest, x_d: np.ndarray, bounds: Bounds) -> tuple[str, ...]:
    """Return in words what else would tell structures apart, each tried with the same motion.

    Where none of it would, what the catalogue says to look at on the rig.

    Parameters
    ----------
    x_d : (n,) m, the motion.
    """
    now = float(np.sum([one.probability**2 for one in contest.structures]))
    found = []
    for words, experiment, structures in changes(contest, bounds):
        other = Contest(experiment, structures, recorded=False)
        gram = other.told_by(without_noise(demanded(experiment, words, x_d), other.fit))
        if gram is None:
            continue
        expected = other.expected(gram)[0]
        if expected > now + WORTH:
            found.append(f"{words} (expected probability {expected:.2f}, without it {now:.2f})")
    if found:
        return tuple(found)
    names = dict.fromkeys(name for one in contest.structures[:3] for name in sorted(one.names)
                          if name in CATALOGUE)
    return tuple(f"at the rig: {CATALOGUE[name].rig_check.rstrip('.')}" for name in names)


def changes(contest: Contest, bounds: Bounds
            ) -> Iterator[tuple[str, Experiment, Sequence[Structure]]]:
    """Yield what may be changed, in words, with the experiment and the structures under it."""
    experiment, structures = contest.experiment, contest.structures
    rig, noise = experiment.settings.rig, experiment.settings.simulation.noise
    force = float(f"{LOAD * rig.area_1 * (bounds.pressure - rig.charge_pressure):.1g}")
    load, place = NAMES.index("constant_load"), place_of("constant_load.F_0")

    def moved(change) -> list[Structure]:
        found = []
        for one in structures:
            theta, active = one.fit.theta.copy(), one.fit.active.copy()
            change(theta, active)
            found.append(replace(one, fit=replace(one.fit, theta=theta, active=active)))
        return found

    def loaded(theta, active):
        theta[place] += force
        active[load] = True

    def warmer(theta, active):
        theta[s.B] *= WARMER

    def charged(theta, active):
        theta[s.P_CHARGE] *= CHARGED

    higher = rig.model_copy(update={"charge_pressure": CHARGED * rig.charge_pressure})
    yield (f"a charge pressure of {quantity(higher.charge_pressure, 'Pa', 2)}",
           replace(experiment, settings=experiment.settings.model_copy(update={"rig": higher})),
           moved(charged))
    yield f"a constant load of {quantity(force, 'N', 1)} on the rod", experiment, moved(loaded)
    yield "oil that is some 12 °C warmer", experiment, moved(warmer)
    for name, (words, level) in SENSORS.items():
        column = OUTPUTS.index(name)
        if experiment.used[column]:
            continue
        used, levels = experiment.used.copy(), experiment.noise.copy()
        used[column], levels[column] = True, getattr(noise, level)
        there = replace(experiment, used=used, noise=levels)
        yield words, there, [replace(one, fit=seen(there, one.fit)) for one in structures]


def seen(experiment: Experiment, fit: Fit) -> Fit:
    """Return a fit with the gains and innovations of other sensors, the rig at rest."""
    x = float(np.nanmean(experiment.stretches[0].z[:, 0]))
    rest = demanded(experiment, "rest", np.full(len(experiment.stretches[0]), x))
    return with_unknowns(simulated(rest, fit, 0), fit, fit.unknowns)
