"""From a rig to what its owner has: a CSV, and the config of the README."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from strangers.plant import ATMOSPHERE, Motion
from strangers.rigs import Rig

# SI per unit.
UNITS = {"s": 1.0, "ms": 1e-3, "m": 1.0, "mm": 1e-3, "um": 1e-6, "Pa": 1.0, "kPa": 1e3,
         "bar": 1e5, "MPa": 1e6, "rad/s": 1.0, "rpm": 2 * np.pi / 60, "degC": 1.0}


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
