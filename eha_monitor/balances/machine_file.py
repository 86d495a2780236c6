"""The file of a machine: as one is written, and read again."""

import json
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from eha_monitor.balances.alone import Refused
from eha_monitor.balances.candidates import Scale
from eha_monitor.balances.discrepancy import Regime
from eha_monitor.balances.machine import (
    SCHEMA,
    Machine,
    MachineBalance,
    Odd,
    Parameter,
    Setting,
)
from eha_monitor.balances.parameters import UNKNOWN, Stiffness
from eha_monitor.balances.policy import Policy
from eha_monitor.balances.scatter import Scatter
from eha_monitor.balances.together import Named
from eha_monitor.errors import InputError
from eha_monitor.output import write_json
from eha_monitor.quantity import quantity
from eha_monitor.settings.rig import Rig


def save(machine: Machine, path: Path) -> None:
    """Write a machine as a small JSON file."""
    write_json(path, machine.to_dict())


def load(path: Path, rig: Rig) -> Machine:
    """Read a machine that :func:`save` wrote, to be compared on a rig.

    Raises
    ------
    InputError
        Naming the file, if it holds none, or one with other areas than the rig's, or that does not
        say with which it was made: every force and flow of its balances would be another.
    """
    machine = _read(path)
    own, within = (rig.area_1, rig.area_2), machine.policy.varied * rig.tolerance.log_spread(
        "area_1")
    theirs = machine.areas
    if theirs is None and any(own):
        raise InputError(f"{path}: a machine of an older version, which does not say for which "
                         "areas it was made; make it again from its recordings: eha-monitor "
                         f"diagnose {' '.join(machine.sources)} --config CONFIG --machine "
                         f"{path}")
    if theirs is not None and any(bool(here) != bool(there) or (
            here and abs(np.log(here / there)) > within)
            for here, there in zip(own, theirs, strict=True)):
        others, mine = (" and ".join(quantity(one, "m²", 3) if one else "none" for one in areas)
                        for areas in (theirs, own))
        raise InputError(f"{path}: a machine with areas of {others}, expected those of the "
                         f"config, {mine}")
    return machine


def _read(path: Path) -> Machine:
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
        if data.get("schema") != SCHEMA:
            raise ValueError(f"expected schema {SCHEMA}")
        balances = tuple(_read_balance(one) for one in data["balances"])
        known = {f.name for f in fields(Policy)}
        return Machine(
            data["rig"], tuple(row["recording"] for row in data["settings"]),
            Scale(**data["scale"] | {"tops": tuple(data["scale"]["tops"])}),
            data["load_varied"], data["pieces"], balances,
            tuple(Odd(**one) for one in data["odd"]),
            Policy(**{k: v for k, v in data["policy"].items() if k in known}),
            _read_stiffness(data.get("stiffness")),
            tuple(data["areas"]) if data.get("areas") else None)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as problem:
        raise InputError(f"{path}: expected a machine, as `diagnose A B C --machine FILE` writes "
                         f"it: {problem}") from problem


def _read_stiffness(data: dict | None) -> Stiffness:
    """Return what the file says of the oil; files before it was kept say nothing."""
    if data is None:
        return UNKNOWN
    return Stiffness(*_numbers([data[key] for key in ("value", "between", "stddev")]),
                     data["count"])


def _read_balance(data: dict) -> MachineBalance:
    made = dict(data)
    made["parameters"] = tuple(
        Parameter(**one | {"stddev": _numbers([one["stddev"]])[0]}) for one in data["parameters"])
    made["settings"] = tuple(
        Setting(**one | {"value": tuple(one["value"]), "stddev": _numbers(one["stddev"])})
        for one in data["settings"])
    made["regimes"] = tuple(Regime(**one) for one in data["regimes"])
    made["named"] = tuple(Named(**one | {"terms": tuple(one["terms"]), "rivals": tuple(
        one["rivals"])}) for one in data["named"])
    made["refused"] = tuple(Refused(**one) for one in data["refused"])
    for name in ("scatter", "beside"):
        made[name] = Scatter(**{key: tuple(value) if isinstance(value, list) else value
                                for key, value in data.get(name, data["scatter"]).items()})
    made["steps"] = tuple(map(tuple, data["steps"]))
    for name in ("each", "each_stddev"):
        made[name] = tuple(map(_numbers, data[name]))
    made.setdefault("held", data["error"])  # of a file before oils were told apart
    for name in ("nominal", "error", "learned", "reference", "held", "forms", "levers"):
        made[name] = _numbers(made.get(name, ()))
    return MachineBalance(**made)


def _numbers(row: Sequence) -> tuple:
    return tuple(np.inf if value is None else value for value in row)
