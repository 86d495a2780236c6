"""The right recordings that mistakes are made on: two own rigs, and the real ones."""

import copy
from dataclasses import dataclass
from pathlib import Path

from strangers.plant import recording
from strangers.record import config_of, write_csv
from strangers.rigs import MICRO, SINGLE_ROD

from stranger_parts.commands import ROOT

# base -> config of the project, file below the data folder
REAL = {
    "ivliev": ("ivliev_eha", "ivliev_eha/exp_data_1_4.csv"),
    "emps": ("emps", "emps/DATA_EMPS.mat"),
    "hsm150": ("hsm150", "hsm150/idf_pos_0.065_2.mat"),
    "seals": ("pneumatic_seals", "pneumatic_seals/1_O-ring257_7bar.csv"),
    "sim": ("fluid_power_sim", "fluid_power_sim/h32_rich.csv.gz"),
}
OWN = {"equal": MICRO, "single_rod": SINGLE_ROD}


@dataclass(frozen=True)
class Base:
    """A file, the config that is right for it, and what is true of it.

    Attributes
    ----------
    truth : B and beta_e; None where nobody knows: the right config's own answer stands for it.
    """

    file: Path
    tree: dict
    truth: dict[str, float | None]


def data_folder(asked: Path | None) -> Path | None:
    """Return where the real recordings lie, or None."""
    for folder in (asked, *(parent / "shared" / "data" for parent in ROOT.parents)):
        if folder is not None and folder.is_dir():
            return folder
    return None


def config_tree(name: str) -> dict:
    """Return a config of the project as plain data, without the ROS form's two levels."""
    from ruamel.yaml import YAML

    tree = YAML(typ="safe").load((ROOT / "config" / f"{name}.yaml").read_text(encoding="utf-8"))
    return tree["/**"]["ros__parameters"]


def base_of(name: str, folder: Path, data: Path | None, seed: int = 0) -> Base | None:
    """Return a base, its file written into ``folder``; None where its data are not here."""
    if name in OWN:
        rig = OWN[name]
        file = folder / f"{rig.name}.csv"
        if not file.is_file():
            write_csv(rig, recording(rig, seed), file)
        truth = {"B": rig.plant.damping, "beta_e": rig.plant.bulk_modulus}
        return Base(file, config_of(rig, well_known=True), truth)
    config, path = REAL[name]
    if data is None or not (data / path).is_file():
        return None
    return Base(data / path, config_tree(config), {"B": None, "beta_e": None})


def edited(base: Base, edit) -> dict:
    """Return the base's config with a mistake in it."""
    tree = copy.deepcopy(base.tree)
    edit(tree)
    return tree
