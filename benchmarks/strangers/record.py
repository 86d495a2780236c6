"""From a rig to what its owner has: a table of channels, a CSV, and the config of the README."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.signal import butter, lfilter, lfilter_zi

from strangers.motions import Motion
from strangers.plant import N_STATE, P1, P2, Constants, W, X, rest, run
from strangers.rigs import Rig

ATMOSPHERE = 101325.0  # Pa
PREROLL = 1.0  # s: the rig runs before the logger does
LONGEST_STEP = 5e-5  # s
SUBSTEPS = 20  # in a sample, at least
# SI per unit.
UNITS = {"s": 1.0, "ms": 1e-3, "m": 1.0, "mm": 1e-3, "um": 1e-6, "Pa": 1.0, "kPa": 1e3,
         "bar": 1e5, "MPa": 1e6, "rad/s": 1.0, "rpm": 2 * np.pi / 60, "degC": 1.0}


def fine_run(rig: Rig, seed: int = 0, substeps: int | None = None
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the trajectory (m, N_STATE), its times (m,) s, the sample of each log, its noise.

    Returns
    -------
    out, time, at, noise : trajectory; its times, 0 at the first logged sample; (n,) rows of
        ``out`` at the logged samples; (n,) noise of the position in m at them.
    """
    period = 1.0 / rig.rate
    if substeps is None:
        substeps = max(SUBSTEPS, int(np.ceil(period / LONGEST_STEP)))
    h = period / substeps
    ahead = round((PREROLL - min(rig.motion.before, 0.0)) * rig.rate)
    ahead += ahead % 2  # whole periods of any drive
    samples = round(rig.length * rig.rate)
    steps = (ahead + samples) * substeps
    halves = np.arange(2 * steps + 1) * 0.5 * h - ahead * period
    demand = rig.motion(halves, rig.length)
    slope = np.gradient(demand, 0.5 * h)
    rng = np.random.default_rng([seed, 1])
    noise = rig.sensors.position_noise * rng.standard_normal(ahead + samples)
    drive = rig.drive
    if drive.hold and drive.phase == 0.0:
        read = noise[::drive.hold]
    else:
        read = rig.sensors.position_noise * rng.standard_normal(ahead + samples)
    out = np.empty((steps + 1, N_STATE))
    c = Constants(*map(float, rig.plant))
    y = rest(c, float(demand[0]))
    run(y, c, demand, slope, h, steps, drive.hold * substeps,
        round(drive.phase * substeps), rig.sensors.encoder, read, out)
    at = (ahead + np.arange(samples)) * substeps
    return out, halves[::2], at, noise[ahead:]


def recording(rig: Rig, seed: int = 0) -> dict[str, np.ndarray]:
    """Return time and channels as the sensors show them, name -> (n,) SI."""
    out, time, at, noise = fine_run(rig, seed)
    sensors, rng = rig.sensors, np.random.default_rng([seed, 2])
    h = time[1] - time[0]

    def filtered(values):
        if not sensors.filter_hz:
            return values
        b, a = butter(2, sensors.filter_hz, fs=1.0 / h)
        return lfilter(b, a, values, zi=lfilter_zi(b, a) * values[0])[0]

    def stepped(values, step):
        return step * np.round(values / step) if step else values

    n = len(at)
    shown = {"time": np.arange(n) / rig.rate,
             "x": stepped(out[at, X] + noise, sensors.encoder),
             "x_d": rig.motion(time[at], rig.length),
             "omega": filtered(out[:, W])[at] + sensors.speed_noise * rng.standard_normal(n),
             "temperature": 41.0 + 1.5 * (1 - np.exp(-np.arange(n) / (5 * rig.rate)))}
    for name, column in (("p1", P1), ("p2", P2)):
        p = filtered(out[:, column])[at] + sensors.pressure_noise * rng.standard_normal(n)
        shown[name] = stepped(p - ATMOSPHERE * sensors.gauge, sensors.pressure_step)
    return shown


def varied(rig: Rig, seed: int) -> Rig:
    """Return the rig in other hands: another motion of the same size, half as long, other B."""
    rng = np.random.default_rng([seed, 17])
    m, length = rig.motion, min(rig.length, 10.0)
    kinds = ("triangle", "sines", "ramps")
    kind = str(rng.choice(kinds))
    # The largest speed that the owner's own motion asks for bounds the others.
    t = np.arange(0.0, rig.length, 1e-3)
    speed = float(np.quantile(np.abs(np.diff(m(t, rig.length))) / 1e-3, 0.98))
    reach = float(np.abs(m(t, rig.length)).max()) * rng.uniform(0.6, 1.0)
    if kind == "triangle":
        f = speed * rng.uniform(0.5, 0.9) / (4.0 * reach)
        motion = Motion(kind, (reach, 0.3 * reach), (f, f), before=m.before)
    elif kind == "sines":
        tones = np.array([0.5, 1.9, 5.3]) * rng.uniform(0.8, 1.2, 3)
        share = np.array([0.5, 0.3, 0.2]) * 0.7 * speed / (2 * np.pi * tones)
        share *= min(1.0, reach / share.sum())
        motion = Motion(kind, tuple(share), tuple(tones), seed=seed, before=m.before)
    else:
        motion = Motion(kind, (reach,), seed=seed, speed=0.7 * speed, before=m.before)
    return replace(rig, motion=motion, length=length, plant=rig.plant._replace(
        damping=rig.plant.damping * rng.uniform(0.9, 1.4),
        bulk_modulus=rig.plant.bulk_modulus * rng.uniform(0.7, 1.2)))


def config_of(rig: Rig, *, well_known: bool = False) -> dict:
    """Return the config that the README's second step asks of the owner, plain data.

    Parameters
    ----------
    well_known : the owner has also measured leakage, make-up and charge pressure.
    """
    c, file = rig.plant, rig.dialect
    known = {
        "name": rig.name,
        "area_1": f"{c.area_1 * 1e4:.6g} cm^2", "area_2": f"{c.area_2 * 1e4:.6g} cm^2",
        "volume_1": f"{c.volume_1 * 1e6:.6g} cm^3", "volume_2": f"{c.volume_2 * 1e6:.6g} cm^3",
        "mass": f"{c.mass:.6g} kg", "pump_displacement": c.displacement_1,
        "position_gain": c.gain if rig.gain_known else None,
        "sample_time": f"{1e3 / rig.rate:.6g} ms"}
    if well_known:
        known |= {"leakage": 2.0 * c.cross_leakage + c.makeup, "makeup_conductance": c.makeup,
                  "charge_pressure": f"{c.reservoir * 1e-5:.6g} bar"}
    columns = {}
    for channel, (header, unit, _) in file.columns.items():
        if channel == "time":
            continue
        columns[channel] = {"column": header, "scale": float(f"{UNITS[unit]:.11g}")}
        if rig.sensors.gauge and channel in ("p1", "p2"):
            columns[channel]["offset"] = ATMOSPHERE
    header, unit, _ = file.columns["time"]
    return {"rig": known, "table": {"time": header, "time_scale": UNITS[unit],
                                    "columns": columns}}


def write_csv(rig: Rig, shown: dict[str, np.ndarray], path: Path) -> Path:
    """Write channels (SI) in the dialect of the rig's logger."""
    file = rig.dialect
    cells, heads, units = [], [], []
    for channel, (header, unit, digits) in file.columns.items():
        heads.append(header)
        units.append(unit)
        cells.append([f"{value:.{digits}f}" for value in shown[channel] / UNITS[unit]])
    for k, header in enumerate(file.extra):
        heads.append(header)
        units.append("-")
        cells.append([str((i // 100 + k) % 3) for i in range(len(cells[0]))])
    rows = [file.separator.join(heads)]
    if file.units_row:
        rows.append(file.separator.join(units))
    body = [file.separator.join(row) for row in zip(*cells, strict=True)]
    if file.decimal == ",":
        body = [row.replace(".", ",") for row in body]
    text = "\n".join(rows + body) + "\n"
    path.write_text(text, encoding="utf-8-sig" if file.bom else "utf-8")
    return path


def write_config(tree: dict, path: Path) -> Path:
    """Write a config as YAML."""
    from ruamel.yaml import YAML

    yaml = YAML(typ="safe")
    yaml.default_flow_style = False
    yaml.allow_unicode = True
    with path.open("w", encoding="utf-8") as file:
        yaml.dump(tree, file)
    return path
