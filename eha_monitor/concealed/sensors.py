"""What the sensors make of the fine trajectory: lag, clock, resolution, noise, faults.

The nuisances are always there and small: a filter of some 20 us before each converter, a clock
that is late by a few us, an encoder step below its noise.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from eha_monitor.concealed.places import OMEGA, P1, P2, X_SENSED, X


@dataclass(frozen=True)
class Sensors:
    """Noise and small imperfections of healthy sensors, SI."""

    position_noise: float = 2e-6
    pressure_noise: float = 2e3
    speed_noise: float = 0.1
    encoder_step: float = 0.5e-6
    clock_jitter: float = 2e-6
    position_lag: float = 15e-6
    pressure_lag: float = 25e-6
    speed_lag: float = 20e-6


def lagged(values: np.ndarray, h: float, lag: float) -> np.ndarray:
    """Return (n,) behind a first-order lag, exact for straight lines between the steps."""
    if lag <= 0.0:
        return values
    decay = np.exp(-h / lag)
    after = 1.0 - lag / h * (1.0 - decay)  # weight of the new value; the old one has the rest
    start = values[0] * np.array([decay + (1.0 - decay - after)])
    return lfilter([after, 1.0 - decay - after], [1.0, -decay], values, zi=start)[0]


def measure(fine: np.ndarray, fine_time: np.ndarray, time: np.ndarray, sensors: Sensors,
            faults: dict[str, float], noise: float, seed: int) -> dict[str, np.ndarray]:
    """Return what is measured, channel -> (n,) SI.

    Parameters
    ----------
    fine : (m, N_COLUMNS) trajectory of the plant.
    fine_time : (m,) s, evenly spaced.
    time : (n,) nominal sample times, s.
    sensors : the healthy sensors.
    faults : constants of the concealed sensor effects.
    noise : factor on the white noise.
    seed : of noise and clock.
    """
    h = fine_time[1] - fine_time[0]
    rng = np.random.default_rng([seed, 11])
    jitter = sensors.clock_jitter * np.clip(rng.standard_normal(len(time)), -3.0, 3.0)
    drawn = {name: rng.standard_normal(len(time)) for name in ("x", "p1", "p2", "omega")}

    def seen(column: int, lag: float, delay: float = 0.0) -> np.ndarray:
        return np.interp(time + jitter - delay, fine_time, lagged(fine[:, column], h, lag))

    behind = X_SENSED if faults.get("behind_play") else X
    x = seen(behind, sensors.position_lag, faults.get("position_delay", 0.0))
    x = x * (1.0 + faults.get("position_scale", 0.0))
    x = x + noise * sensors.position_noise * drawn["x"]
    step = max(faults.get("resolution", 0.0), sensors.encoder_step)
    shown = {"x": step * np.round(x / step) if step > 0.0 else x,
             "omega": (seen(OMEGA, sensors.speed_lag)
                       + noise * sensors.speed_noise * drawn["omega"])}
    for name, column in (("p1", P1), ("p2", P2)):
        p = seen(column, sensors.pressure_lag, faults.get("pressure_delay", 0.0))
        p = p * (1.0 + faults.get(f"scale_{name}", 0.0)) + faults.get(f"offset_{name}", 0.0)
        p = p + faults.get(f"drift_{name}", 0.0) * time
        shown[name] = p + noise * sensors.pressure_noise * drawn[name]
    return shown
