"""How large a named effect is, in newtons, litres per minute, milliseconds or per cent."""

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.mismatch.experiment import Experiment
from eha_monitor.mismatch.fit import Fit, filtered
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import (
    add_contributions,
    circuit_of,
    update_memory,
    with_term,
    with_update,
)
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


@njit
def contributions_along(time, states, speed, demanded, dt, theta, active, out):
    """Write what active effects add along a trajectory.

    Parameters
    ----------
    time : (n,) s; states : (n, >= 4) x, v, p1, p2; speed, demanded : (n,) rad/s and m.
    out : (n, N_CONTRIBUTIONS) written.
    """
    terms, updates = with_term(active), with_update(active)
    memory = np.zeros((len(active), s.MAX_MEMORY))
    signals = np.zeros(s.N_SIGNALS)
    for k in range(len(time)):
        signals[s.T], signals[s.X], signals[s.V] = time[k], states[k, 0], states[k, 1]
        signals[s.P1], signals[s.P2] = states[k, 2], states[k, 3]
        signals[s.OMEGA], signals[s.X_D] = speed[k], demanded[k]
        add_contributions(signals, theta, terms, memory, out[k])
        update_memory(signals, theta, updates, dt, memory)


def trajectory(experiment: Experiment, fit: Fit, stretch) -> tuple[np.ndarray, np.ndarray]:
    """Return the filtered states (n, 8) of a stretch and the pump speed (n,), rad/s."""
    states = filtered(experiment, stretch, fit.theta, fit.active, fit.gains, states=True)[1]
    speed = stretch.z[:, 4]
    if not np.isfinite(speed).any():
        gain = fit.theta[s.K_POS]
        speed = (gain * (stretch.u[:, 0] - states[:, 0]) if experiment.mode == 0
                 else stretch.u[:, 0])
    states = states.copy()
    if experiment.mode == 2:
        states[:, 2], states[:, 3] = stretch.p1, stretch.p2
    return states, np.nan_to_num(speed)


def size_of(experiment: Experiment, fit: Fit, name: str) -> str:
    """Return how much a named effect does at its largest in this record, in words."""
    alone = np.zeros(len(NAMES), dtype=bool)
    alone[NAMES.index(name)] = True
    found = []
    w = circuit_of(fit.theta, alone)
    for place, (factor, words) in _CIRCUIT_WORDS.items():
        value = w[place] * factor
        if value != 0 and np.isfinite(value) and abs(value) < 1e6:
            found.append(f"{abs(value):.3g} {words}")
    rows = []
    for stretch in experiment.stretches:
        states, speed = trajectory(experiment, fit, stretch)
        out = np.zeros((len(stretch), s.N_CONTRIBUTIONS))
        contributions_along(np.arange(len(stretch)) * experiment.dt, states, speed,
                            stretch.u[:, 0], experiment.dt, fit.theta, alone, out)
        rows.append(out)
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


