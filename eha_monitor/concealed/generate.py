"""From a case to what the diagnosis is given: channels, nominal config, a bag.

What sensors make of the fine trajectory: lag, clock, resolution, noise, faults.  The nuisances
are always there and small: a filter of some 20 us before each converter, a clock that is late by
a few us, an encoder step below its noise.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from eha_monitor.concealed.cases import (
    CONFIG_KEYS,
    RIG,
    SAMPLE_TIME,
    Case,
    demand_of,
    fine_run,
    hidden_of,
    rig_of,
    samples_of,
)
from eha_monitor.concealed.plant import OMEGA, P1, P2, X_SENSED, X

if TYPE_CHECKING:
    from eha_monitor.recordings.recording import Recording

START_NS = 1_700_000_000_000_000_000


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
            faults: dict[str, float], drawn: dict[str, np.ndarray], jumps: bool = False
            ) -> dict[str, np.ndarray]:
    """Return what is measured, channel -> (n,) SI.

    Parameters
    ----------
    fine : (m, N_COLUMNS) trajectory of the plant.
    fine_time : (m,) s, evenly spaced.
    time : (n,) nominal sample times, s.
    sensors : the healthy sensors.
    faults : constants of the concealed sensor effects.
    drawn : of :func:`noise_of`.
    jumps : the shaft's speed jumps at the samples: the drive reports the one that it holds.
    """
    h = fine_time[1] - fine_time[0]
    jitter = sensors.clock_jitter * drawn["clock"]

    def sampled(column: int, lag: float, delay: float = 0.0) -> np.ndarray:
        return np.interp(time + jitter - delay, fine_time, lagged(fine[:, column], h, lag))

    behind = X_SENSED if faults.get("behind_play") else X
    x = sampled(behind, sensors.position_lag, faults.get("position_delay", 0.0))
    x = x * (1.0 + faults.get("position_scale", 0.0)) + drawn["x"]
    step = max(faults.get("resolution", 0.0), sensors.encoder_step)
    speed = (fine[np.searchsorted(fine_time, time - 0.5 * h), OMEGA] if jumps
             else sampled(OMEGA, sensors.speed_lag))
    shown = {"x": step * np.round(x / step) if step > 0.0 else x, "omega": speed + drawn["omega"]}
    for name, column in (("p1", P1), ("p2", P2)):
        p = sampled(column, sensors.pressure_lag, faults.get("pressure_delay", 0.0))
        p = p * (1.0 + faults.get(f"scale_{name}", 0.0)) + faults.get(f"offset_{name}", 0.0)
        p = p + faults.get(f"drift_{name}", 0.0) * time
        shown[name] = p + drawn[name]
    return shown


def noise_of(case: Case) -> dict[str, np.ndarray]:
    """Return the white noise of each channel, (n,) SI, and the clock's in standard deviations."""
    levels, n = sensors_of(case), samples_of(case)
    rng = np.random.default_rng([case.seed, 11])
    clock = np.clip(rng.standard_normal(n), -3.0, 3.0)
    deviations = {"x": levels.position_noise, "p1": levels.pressure_noise,
                  "p2": levels.pressure_noise, "omega": levels.speed_noise}
    return {"clock": clock} | {name: case.noise * level * rng.standard_normal(n)
                               for name, level in deviations.items()}


def sensors_of(case: Case) -> Sensors:
    """Return the healthy sensors of a case."""
    plain = Sensors()
    return replace(plain, **{name: getattr(plain, name) * case.nuisance for name in (
        "encoder_step", "clock_jitter", "position_lag", "pressure_lag", "speed_lag")})


def recording_of(case: Case) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the measured channels, name -> (n,) SI, and their nominal times (n,) in s."""
    drawn, made = noise_of(case), hidden_of(case)
    fine, fine_time, faults = fine_run(case, made, noise=drawn["x"])
    time = np.arange(samples_of(case)) * SAMPLE_TIME
    lag = any(one.plant.get("drive_lag") for one in made)
    shown = measure(fine, fine_time, time, sensors_of(case), faults, drawn,
                    jumps=case.drive != "analogue" and not lag)
    shown["x_d"] = demand_of(case, time)
    return {name: shown[name] for name in case.channels}, time


def nominal_config(case: Case) -> dict:
    """Return the config of the nominal rig as plain YAML data; it says nothing of the effects.

    Design constants are the true ones unless ``case.nominal`` has others.  B and beta_e, which
    the monitor is there to find, are the paper's, whatever the rig has.
    """
    true = rig_of(case)
    nominal = {key: true[place] for key, (place, _) in RIG.items()}
    nominal |= {"B": RIG["B"][1], "beta_e": RIG["beta_e"][1], **case.nominal}
    levels = Sensors()
    noise = {"position": levels.position_noise * case.noise,
             "pressure": levels.pressure_noise * case.noise,
             "pump_speed": levels.speed_noise * case.noise}
    rig = {"name": case.name, "sample_time": SAMPLE_TIME, **{
        key: nominal[symbol] for symbol, keys in CONFIG_KEYS.items() for key in keys}}
    if case.tolerances:  # a leakage's is a factor, the others' are relative
        rig["tolerance"] = {
            key: math.exp(spread) if symbol in ("C_T", "G") else spread
            for symbol, spread in case.tolerances.items() for key in CONFIG_KEYS[symbol]}
    # Whoever states B and the bulk modulus of a rig also expects them there.
    expected = {stage: {"prior": case.nominal[key], "prior_stddev": 2.0 * case.nominal[key]}
                for stage, key in (("stage_one", "B"), ("stage_two", "beta_e"))
                if key in case.nominal}
    return {"/**": {"ros__parameters": {
        "rig": rig, **expected, "simulation": {"noise": dict(noise)}, "noise": dict(noise)}}}


def write_case(case: Case, folder: str | Path) -> tuple[Path, Path]:
    """Write ``NAME`` (a bag) and ``NAME.yaml`` (the nominal config); returns the paths."""
    from eha_monitor.recordings.recording import Recording
    channels, _ = recording_of(case)
    return write_both(Path(folder), case.name, nominal_config(case),
                      Recording(SAMPLE_TIME, channels, start_ns=START_NS))


def write_both(folder: Path, name: str, config: dict, recording: "Recording") -> tuple[Path, Path]:
    """Write a recording as the bag ``name`` and its config as ``name.yaml``; returns the paths."""
    from eha_monitor.output import write_text
    from eha_monitor.recordings.bag_writer import yaml_text
    from eha_monitor.recordings.write import write_recording
    from eha_monitor.settings.load import load_settings
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.yaml"
    write_text(path, yaml_text(config))
    return write_recording(folder / name, recording, load_settings(path), overwrite=True), path
