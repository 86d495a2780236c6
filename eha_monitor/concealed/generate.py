"""From a case to what the diagnosis is given: channels, nominal config, a bag."""

import math
from io import StringIO
from pathlib import Path

import numpy as np

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
from eha_monitor.concealed.sensors import Sensors, measure


def sensors_of(case: Case) -> Sensors:
    """Return the healthy sensors of a case."""
    plain, factor = Sensors(), case.nuisance
    return Sensors(encoder_step=plain.encoder_step * factor,
                   clock_jitter=plain.clock_jitter * factor,
                   position_lag=plain.position_lag * factor,
                   pressure_lag=plain.pressure_lag * factor,
                   speed_lag=plain.speed_lag * factor)


def recording_of(case: Case) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the measured channels, name -> (n,) SI, and their nominal times (n,) in s."""
    fine, fine_time, faults = fine_run(case, hidden_of(case))
    time = np.arange(samples_of(case)) * SAMPLE_TIME
    shown = measure(fine, fine_time, time, sensors_of(case), faults, case.noise, case.seed)
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
    noise = {
        "position": levels.position_noise * case.noise,
        "pressure": levels.pressure_noise * case.noise,
        "pump_speed": levels.speed_noise * case.noise,
    }
    rig = {
        "name": case.name, "sample_time": SAMPLE_TIME,
        **{key: nominal[symbol] for symbol, keys in CONFIG_KEYS.items() for key in keys},
    }
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
    """Write ``NAME`` (a bag) and ``NAME.yaml`` (the nominal config) into ``folder``.

    Returns
    -------
    bag, config : paths of the two.
    """
    from ruamel.yaml import YAML

    from eha_monitor.output import write_text
    from eha_monitor.recordings.recording import Recording
    from eha_monitor.recordings.write import write_recording
    from eha_monitor.settings.load import load_settings

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    text, yaml = StringIO(), YAML(typ="safe")
    yaml.default_flow_style = False
    yaml.dump(nominal_config(case), text)
    config = folder / f"{case.name}.yaml"
    write_text(config, text.getvalue())
    channels, _ = recording_of(case)
    recording = Recording(SAMPLE_TIME, channels, start_ns=1_700_000_000_000_000_000)
    bag = write_recording(folder / case.name, recording, load_settings(config), overwrite=True)
    return bag, config
