"""How large a named effect is, in newtons, litres per minute, milliseconds or per cent."""

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.along import contributed
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import N_EFFECTS, circuit_of
from eha_monitor.physics.effects import NAMES
from eha_monitor.quantity import quantity, share

SHARE = 0.98  # quantile of the size over the record that counts as its largest

# Circuit place -> SI unit, 1 for a share, and words.
_CIRCUIT_WORDS = {
    s.DRIVE_GAIN: ("1", " of the pump speed"), s.DRIVE_LAG: ("s", ""),
    s.SPEED_LIMIT: ("rad/s", ""), s.SLEW_LIMIT: ("rad/s²", ""),
    s.COMMAND_DELAY: ("s", ""), s.FEEDBACK_DELAY: ("s", ""), s.POSITION_DELAY: ("s", ""),
    s.PRESSURE_DELAY: ("s", ""), s.POSITION_SCALE: ("1", " of the position"),
    s.PLAY: ("m", ""), s.PRESSURE_SCALE_1: ("1", " of p1"),
    s.PRESSURE_SCALE_2: ("1", " of p2"), s.PRESSURE_OFFSET_1: ("Pa", " on p1"),
    s.PRESSURE_OFFSET_2: ("Pa", " on p2"), s.PRESSURE_DRIFT_1: ("Pa/s", " on p1"),
    s.PRESSURE_DRIFT_2: ("Pa/s", " on p2"),
}


def size_of(experiment: Experiment, fit: Fit, name: str, tracks: list[np.ndarray]) -> str:
    """Return how much a named effect does at its largest in this record, in words.

    tracks : :func:`along.filtered_tracks` of the fit.
    """
    alone = np.zeros(N_EFFECTS, dtype=bool)
    alone[NAMES.index(name)] = True
    found = []
    w = circuit_of(fit.theta, alone)
    for place, (unit, words) in _CIRCUIT_WORDS.items():
        value = abs(float(w[place]))
        if value != 0 and np.isfinite(value):
            found.append((share(value) if unit == "1" else quantity(value, unit, 3)) + words)
    rows = [contributed(experiment, fit.theta, track, (name,)) for track in tracks]
    most = np.quantile(np.abs(np.concatenate(rows)), SHARE, axis=0)
    flow = max(most[s.FLOW_1], most[s.FLOW_2], fit.theta[s.D_P] * most[s.SPEED]
               if np.isfinite(fit.theta[s.D_P]) else 0.0)
    unit = "N" if experiment.settings.rig.motion == "linear" else "N·m"
    if most[s.FORCE] > 0:
        found.append(quantity(most[s.FORCE], unit, 3))
    if flow > 0:
        found.append(quantity(flow, "m³/s", 3))
    if most[s.MASS] > 0:
        found.append(quantity(most[s.MASS], "kg" if unit == "N" else "kg·m²", 3))
    compliance = max(most[s.COMPLIANCE_1], most[s.COMPLIANCE_2]) * fit.theta[s.BETA_E]
    if compliance > 0:
        found.append(f"{share(compliance)} more compliance")
    volume = max(most[s.VOLUME_1], most[s.VOLUME_2])
    if volume > 0:
        found.append(f"{quantity(volume, 'm³', 3)} of chamber volume")
    return ", ".join(found)


