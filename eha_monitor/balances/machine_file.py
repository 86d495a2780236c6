"""The file of a machine: as one is written, and read again."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from eha_monitor.balances.machine import OTHER, SCHEMA, Machine
from eha_monitor.balances.parameters import UNKNOWN
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
    for words, unit, there, here in (
            ("mass", "kg", machine.mass, rig.mass),
            ("pump displacement", "m³/rad", machine.displacement, rig.pump_displacement)):
        if there and here and abs(np.log(here / there)) >= np.log(OTHER):
            raise InputError(f"{path}: a machine made with a {words} of {quantity(there, unit, 3)}"
                             f", expected that of the config, {quantity(here, unit, 3)}")
    return machine


def _read(path: Path) -> Machine:
    wanted = "expected a machine, as `diagnose A B C --machine FILE` writes it"
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as problem:
        raise InputError(f"{path}: {wanted}: {problem.strerror}") from problem
    except ValueError as problem:
        raise InputError(f"{path}: {wanted}, found a file that is not JSON, or only a part of "
                         "one") from problem
    schema = data.get("schema") if isinstance(data, dict) else None
    if schema != SCHEMA:
        raise InputError(f"{path}: {wanted}, with schema {SCHEMA}; found "
                         f"{f'schema {schema}' if schema else 'JSON of another kind'}")
    try:
        data["sources"] = [row["recording"] for row in data["settings"]]
        # Files of older versions did not tell oils apart, nor hold the machine's own.
        data["balances"] = [_with_infinities({
            "held": one["error"], "beside": one["scatter"]} | one) for one in data["balances"]]
        data["stiffness"] = _with_infinities(data.get("stiffness") or asdict(UNKNOWN))
        return TypeAdapter(Machine).validate_python(data)
    except (ValueError, KeyError, TypeError, AttributeError) as problem:
        raise InputError(f"{path}: {wanted}: {' '.join(str(problem).split())[:300]}") from problem


def _with_infinities(tree):
    """Return a tree with infinities for its nulls, as which they are written."""
    if isinstance(tree, dict):
        return {key: _with_infinities(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_with_infinities(value) for value in tree]
    return np.inf if tree is None else tree
