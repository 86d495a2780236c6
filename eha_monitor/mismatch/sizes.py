"""How large a named effect is, in newtons, litres per minute, milliseconds or per cent."""

import numpy as np

from eha_monitor.mismatch.experiment import Experiment
from eha_monitor.mismatch.fit import Fit, filtered
from eha_monitor.mismatch.missing import contributed, signals_along
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import circuit_of
from eha_monitor.physics.effects import NAMES

SHARE = 0.98  # quantile of the size over the record that counts as its largest
LITRES_PER_MINUTE = 6e4  # in a m^3/s

# Circuit place -> factor and words.
_CIRCUIT_WORDS = {
    s.DRIVE_GAIN: (100.0, "% of the pump speed"), s.DRIVE_LAG: (1e3, "ms"),
    s.SPEED_LIMIT: (1.0, "rad/s"), s.SLEW_LIMIT: (1.0, "rad/s²"),
    s.COMMAND_DELAY: (1e3, "ms"), s.FEEDBACK_DELAY: (1e3, "ms"), s.POSITION_DELAY: (1e3, "ms"),
    s.PRESSURE_DELAY: (1e3, "ms"), s.POSITION_SCALE: (100.0, "% of the position"),
    s.PLAY: (1e3, "mm"), s.PRESSURE_SCALE_1: (100.0, "% of p1"),
    s.PRESSURE_SCALE_2: (100.0, "% of p2"), s.PRESSURE_OFFSET_1: (1e-5, "bar on p1"),
    s.PRESSURE_OFFSET_2: (1e-5, "bar on p2"), s.PRESSURE_DRIFT_1: (60e-5, "bar/min on p1"),
    s.PRESSURE_DRIFT_2: (60e-5, "bar/min on p2"),
}


def filtered_tracks(experiment: Experiment, fit: Fit) -> list[np.ndarray]:
    """Return the signals along each stretch as the filter has them, (n, N_SIGNALS) each."""
    return [signals_along(experiment, stretch, filtered(
        experiment, stretch, fit.theta, fit.active, fit.gains, states=True)[1])
        for stretch in experiment.stretches]


def size_of(experiment: Experiment, fit: Fit, name: str, tracks: list[np.ndarray]) -> str:
    """Return how much a named effect does at its largest in this record, in words.

    tracks : :func:`filtered_tracks` of the fit.
    """
    alone = np.zeros(len(NAMES), dtype=bool)
    alone[NAMES.index(name)] = True
    found = []
    w = circuit_of(fit.theta, alone)
    for place, (factor, words) in _CIRCUIT_WORDS.items():
        value = w[place] * factor
        if value != 0 and np.isfinite(value) and abs(value) < 1e6:
            found.append(f"{abs(value):.3g} {words}")
    rows = [contributed(experiment, fit, track, (name,)) for track in tracks]
    most = np.quantile(np.abs(np.concatenate(rows)), SHARE, axis=0)
    flow = max(most[s.FLOW_1], most[s.FLOW_2], fit.theta[s.D_P] * most[s.SPEED]
               if np.isfinite(fit.theta[s.D_P]) else 0.0) * LITRES_PER_MINUTE
    unit = "N" if experiment.settings.rig.motion == "linear" else "N·m"
    if most[s.FORCE] > 0:
        found.append(f"{most[s.FORCE]:.3g} {unit}")
    if flow > 0:
        found.append(f"{flow:.3g} l/min")
    if most[s.MASS] > 0:
        found.append(f"{most[s.MASS]:.3g} {'kg' if unit == 'N' else 'kg·m²'}")
    compliance = max(most[s.COMPLIANCE_1], most[s.COMPLIANCE_2]) * fit.theta[s.BETA_E]
    if compliance > 0:
        found.append(f"{100 * compliance:.3g} % more compliance")
    volume = max(most[s.VOLUME_1], most[s.VOLUME_2])
    if volume > 0:
        found.append(f"{volume * 1e6:.3g} ml of chamber volume")
    return ", ".join(found)


