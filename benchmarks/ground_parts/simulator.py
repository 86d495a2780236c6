"""A ground of the proof: recordings of an independent fluid-power simulator with their own key.

The tables are read through the project's import path, sensor noise and resolution are added, and
the bags are diagnosed blindly: each motion by itself, and both of a rig together.  The key is a
file of the recordings' folder; its digest is in the sealed key, and it is opened last.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import record

from eha_monitor.errors import InputError
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.prove.trial import Question, digest_of, prove, read_json
from ground_parts import (
    Ground,
    after_of,
    answer_of,
    compared_row,
    said_of,
)

FOLDER = "fluid_power_sim"  # RIG_MOTION.csv.gz and the key
KEY = "key.json"
SUFFIX = ".csv.gz"
# Channel -> (white noise, resolution), SI; the pressure and position noise of the draws.
SENSORS = {"x": (2e-6, 0.5e-6), "p1": (2e3, 500.0), "p2": (2e3, 500.0), "omega": (0.1, 0.02)}
CLOSE = 0.05
LEAKAGE = "cross_port_leakage"
# Parameter of the simulator's key -> (parameter of the catalogue, factor, offset); a pair of
# parameters where the catalogue has a difference stands in ``translated``.
SYMBOLS = {
    "kinetic_friction_N": "F_c", "coulomb_N": "F_c", "stribeck_velocity_m_s": "v_s",
    "stiffness_N_m": "k", "neutral_position_m": "x_0", "force_N": "F_0",
    "extra_conductance_m3_s_Pa": "L", "half_width_rad_s": "omega_0", "time_constant_s": "tau",
    "limit_rad_s": "omega_max", "delay_s": "T", "mass_kg": "dM",
}


@dataclass(frozen=True)
class Table:
    """One recording of the simulator: ``name`` is RIG_MOTION, ``file`` and ``config`` paths."""

    name: str
    file: Path
    config: Path
    seed: int

    @property
    def rig(self) -> str:
        """Name of the rig."""
        return self.name.rpartition("_")[0]

    @property
    def motion(self) -> str:
        """Name of the motion."""
        return self.name.rpartition("_")[2]


def prove_simulator(ground: Ground, announce: Callable[[str], None],
                    say: Callable[[str, float], None]) -> dict:
    """Run the trial on the simulator's recordings; ``ground.cases`` counts rigs."""
    data, config = record.DATA / FOLDER, record.ROOT / "config" / f"{FOLDER}.yaml"
    tables = tables_of(data, config, ground)
    questions = questions_of(tables)
    trial = ground.trial(tables, questions, conceal=conceal,
                         complete=partial(completed, data=data, config=config))
    found = prove(trial, announce, say)
    key = completed({"cases": [{"case": table.name} for table in tables]}, data, config,
                    sealed=False)
    truths = {one["case"]: one for one in key["cases"]}
    ratios = [row for question in questions
              for row in parameters(question, truths[question.bags[0]], ground.work)]
    own = [row for row in ratios if row["aim"]]
    facts = [f"{sum(row['exact'] for row in found['rows'])} of {len(found['rows'])} answers name "
             "exactly what the key says, "
             f"{sum(row['within_class'] for row in found['rows'])} within a declared class",
             f"{sum(row['within'] for row in own)} of {len(own)} parameters within {CLOSE:.0%}"]
    return {**found, "facts": facts, "parameters": ratios}


def tables_of(data: Path, config: Path, ground: Ground) -> tuple[Table, ...]:
    """Return the recordings of a folder, of the first rigs that are requested."""
    files = sorted(data.glob(f"*_*{SUFFIX}")) if data.is_dir() else []
    if not files or not (data / KEY).is_file():
        raise InputError(f"{data}: expected RIG_MOTION{SUFFIX} files and {KEY}")
    found = [Table(file.name.removesuffix(SUFFIX), file.resolve(), config.resolve(), ground.seed)
             for file in files]
    rigs = list(dict.fromkeys(table.rig for table in found))[: ground.cases or None]
    return tuple(table for table in found if table.rig in rigs)


def questions_of(tables: tuple[Table, ...]) -> tuple[Question, ...]:
    """Return the questions: each recording by itself, and those of a rig together."""
    groups: dict[str, list[str]] = {}
    for table in tables:
        groups.setdefault(table.rig, []).append(table.name)
    found = [Question(table.name, (table.name,)) for table in tables]
    found += [Question(f"{rig}_both", tuple(names)) for rig, names in groups.items()
              if len(names) > 1]
    return tuple(found)


def conceal(table: Table, folder: Path) -> dict:
    """Import a recording, add what its sensors would, write bag and config; returns its entry."""
    from eha_monitor.output import write_text
    from eha_monitor.recordings.importing import read_table
    from eha_monitor.recordings.write import write_recording
    from eha_monitor.settings import load_settings

    folder.mkdir(parents=True, exist_ok=True)
    settings = load_settings(table.config)
    recording = read_table(table.file, settings, map_source=str(table.config))
    rng = np.random.default_rng([table.seed, zlib.crc32(table.name.encode())])
    channels = {"x_d": recording.channels["x_d"]}  # a commanded value has no noise
    for name, (noise, step) in SENSORS.items():
        noisy = recording.channels[name] + noise * rng.standard_normal(len(recording))
        channels[name] = step * np.round(noisy / step)
    write_recording(folder / table.name, replace(recording, channels=channels), settings,
                    overwrite=True)
    write_text(folder / f"{table.name}.yaml", table.config.read_text(encoding="utf-8"))
    return {"motion": table.motion, "noise": 1.0, "channels": list(channels), "seed": table.seed,
            "table_sha256": digest_of(table.file.read_bytes()),
            "key_sha256": digest_of((table.file.parent / KEY).read_bytes())}


def completed(key: dict, data: Path, config: Path, sealed: bool = True) -> dict:
    """Return a key whose entries have the truth of the simulator's own key.

    Raises
    ------
    InputError
        If that file is not the one whose digest was sealed, or lacks a rig.
    """
    from eha_monitor.settings import load_settings

    path = data / KEY
    digest, truth = digest_of(path.read_bytes()), read_json(path) or {}
    leakage = load_settings(config).rig.leakage
    entries = []
    for entry in key["cases"]:
        rig = entry["case"].rpartition("_")[0]
        if sealed and entry["key_sha256"] != digest:
            raise InputError(f"{path}: is not the key that was sealed: expected SHA-256 "
                             f"{entry['key_sha256']}, got {digest}")
        if rig not in truth:
            raise InputError(f"{path}: expected an entry {rig}, found {', '.join(truth)}")
        entries.append({**entry, **truth_of(truth[rig], leakage)})
    return {**key, "cases": entries}


def truth_of(entry: dict, leakage: float) -> dict:
    """Return a rig's entry in the catalogue's terms.

    A leakage that is not the config's is an effect, as the contract has it.

    Parameters
    ----------
    entry : of the simulator's key: ``effects``, ``B``, ``beta_e``, ``C_T``.
    leakage : C_T of the nominal config, m^3/(s*Pa).
    """
    found = {one["name"]: translated(one["parameters"]) for one in entry["effects"]}
    other = 0.5 * (entry.get("C_T", leakage) - leakage)
    if abs(other) > 1e-3 * leakage:
        found[LEAKAGE] = {"L": found.get(LEAKAGE, {}).get("L", 0.0) + other}
    return {"B": entry["B"], "beta_e": entry["beta_e"], "effects": [
        {"name": name, "strength": 1.0, "in_catalogue": name in CATALOGUE,
         "balance": CATALOGUE[name].balance if name in CATALOGUE else "",
         "parameters": parameters} for name, parameters in found.items()]}


def translated(parameters: dict) -> dict[str, float]:
    """Return parameters of the simulator's key under the catalogue's names, SI."""
    found = {SYMBOLS[name]: float(value) for name, value in parameters.items()
             if name in SYMBOLS}
    if "static_N" in parameters and "coulomb_N" in parameters:
        found["F_d"] = parameters["static_N"] - parameters["coulomb_N"]
    if "flow_factor" in parameters:
        found["k"] = parameters["flow_factor"] - 1.0
    if "bias_Pa" in parameters:
        sensor = str(parameters.get("sensor", "p1"))[-1]
        found |= {"b_1": 0.0, "b_2": 0.0, f"b_{sensor}": float(parameters["bias_Pa"])}
    return found


def parameters(question: Question, truth: dict, work: Path) -> list[dict]:
    """Return the true parameters of a rig beside what one answer says."""
    answer = answer_of(work, question.name)
    rows = [compared_row(question.name, f"{one['name']}.{symbol}", true,
                         said_of(answer, one["name"], symbol), CLOSE)
            for one in truth["effects"] for symbol, true in one["parameters"].items() if true]
    rows += [compared_row(question.name, name, truth[name], after_of(answer, name), CLOSE)
             for name in ("B", "beta_e")]
    return rows
