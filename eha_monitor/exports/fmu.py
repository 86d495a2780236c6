"""The identified actuator as an FMU 2.0 for co-simulation that needs nothing but itself."""

import io
import tempfile
import uuid
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from eha_monitor.errors import InputError
from eha_monitor.exports import fmu_kernel
from eha_monitor.exports.fmu_build import SOURCES, identifier, platforms_for, shared_library
from eha_monitor.exports.fmu_description import (
    VR_CLOSED,
    VR_OUTPUT,
    VR_PARAMETER,
    VR_X_START,
    Variable,
    description,
    parameters_of,
)
from eha_monitor.exports.model import Exported, Model, lost_of_simulation
from eha_monitor.physics import plant, signals
from eha_monitor.physics.contributions import (
    N_EFFECTS,
    N_THETA,
    circuit_of,
    with_term,
    with_update,
)
from eha_monitor.physics.excitation import demanded_position
from eha_monitor.physics.parameters import theta_of

_NEEDED = ("area_1", "area_2", "volume_1", "volume_2", "pump_displacement")


def fmu_of(model: Model, units: Mapping[str, str], wanted: tuple[str, ...] = ()) -> Exported:
    """Return the FMU of a config.

    Parameters
    ----------
    units : unit of a linear rig -> that of this one.
    wanted : platforms (``linux64``, ``win64``); without any all that can be built for here.

    Raises
    ------
    InputError
        If a number of the rig is null, a delay is longer than the FMU remembers, or there is no
        compiler.
    """
    model.require("an FMU", *_NEEDED)
    platforms = platforms_for(wanted)
    settings = model.settings
    theta, active = theta_of(settings.rig, settings.effects)
    theta = np.nan_to_num(theta, nan=0.0)
    h = settings.rig.sample_time / settings.simulation.substeps
    _refuse_long_delays(model, theta, active, h)
    start = float(demanded_position(settings.simulation.excitation, np.zeros(1))[0])
    parameters = parameters_of(model, theta)
    lost = _lost(model)
    name = identifier(settings.rig.name)
    # The same model has the same identity, whoever exports it.
    guid = "{" + str(uuid.uuid5(uuid.NAMESPACE_URL, repr((
        name, theta.tolist(), active.tolist(), h, start)))) + "}"
    content = io.BytesIO()
    with tempfile.TemporaryDirectory(prefix="eha-fmu-") as folder, zipfile.ZipFile(
            content, "w", zipfile.ZIP_DEFLATED) as archive:
        here = Path(folder)
        (here / "model.h").write_text(header(settings.rig.position_gain is not None, guid, h,
                                             start, theta, active, parameters), encoding="ascii")
        source = here / "fmi2.c"
        source.write_bytes((SOURCES / "fmi2.c").read_bytes())  # beside its model.h
        for platform in platforms:
            archive.writestr(f"binaries/{platform.folder}/{name}{platform.suffix}",
                             shared_library(platform, here, [source]))
        archive.writestr("modelDescription.xml", description(
            model, guid, name, start, parameters, lost, units))
    return Exported(content.getvalue(), lost)


def _refuse_long_delays(model: Model, theta: np.ndarray, active: np.ndarray, h: float) -> None:
    w = circuit_of(theta, active)
    longest = {signals.COMMAND_DELAY: fmu_kernel.KEPT - 2, signals.FEEDBACK_DELAY: plant.RING - 2,
               signals.POSITION_DELAY: plant.RING - 2, signals.PRESSURE_DELAY: plant.RING - 2}
    for place, steps in longest.items():
        if w[place] > steps * h:
            raise InputError(f"{model.source}: simulation.substeps: a delay of {w[place]:g} s is "
                             f"longer than the {steps * h:g} s that an FMU remembers, expected "
                             "fewer steps in a sample")


def _lost(model: Model) -> tuple[str, ...]:
    lost = list(lost_of_simulation(model))
    for name in model.own_terms:
        lost.append(f"{name}: acts as in the config; its values are not FMU parameters")
    if model.settings.rig.position_gain is None:
        drive = model.of_balance("drive")
        lost.append("rig.position_gain is null: x_d has no effect, pump_speed turns the pump"
                    + (f"; {', '.join(drive)} do not act on it" if drive else ""))
    return tuple(lost)


def header(closed: bool, guid: str, h: float, start: float, theta: np.ndarray, active: np.ndarray,
           parameters: list[Variable]) -> str:
    """Return ``model.h``: what fmi2.c needs to know of the physics and of this config."""
    sizes = {
        "N_STATE": plant.N_STATE, "N_THETA": N_THETA, "N_CIRCUIT": signals.N_CIRCUIT,
        "N_MEMORY": N_EFFECTS * signals.MAX_MEMORY, "RING": plant.RING, "ROWS": fmu_kernel.ROWS,
        "N_SCRATCH": signals.N_CONTRIBUTIONS + signals.N_SIGNALS, "N_OUT": fmu_kernel.N_OUT,
        "P_CHARGE": signals.P_CHARGE, "AREA_1": signals.AREA_1, "AREA_2": signals.AREA_2,
        "VR_X_START": VR_X_START, "VR_CLOSED": VR_CLOSED, "VR_OUTPUT": VR_OUTPUT,
        "VR_PARAMETER": VR_PARAMETER, "CLOSED": int(closed), "N_PARAMETERS": len(parameters)}
    lines = ["#include <stdint.h>", f'#define GUID "{guid}"', f"#define STEP {h!r}",
             f"#define X_START {start!r}",
             *(f"#define {name} {value}" for name, value in sizes.items())]
    terms, updates = with_term(active), with_update(active, theta)
    for name, places in (("TERMS", terms), ("UPDATES", updates)):
        lines += [f"#define N_{name} {len(places)}",
                  _table("int64_t", name, [int(place) for place in places] or [0])]
    lines += [_table("uint8_t", "ACTIVE", [int(one) for one in active]),
              _table("double", "THETA", [float(one) for one in theta]),
              _table("int", "PLACES", [one.place for one in parameters]),
              _table("uint8_t", "TUNABLE", [int(one.tunable) for one in parameters])]
    return "\n".join(lines) + "\n"


def _table(kind: str, name: str, values: list) -> str:
    return f"static const {kind} {name}[] = {{{', '.join(map(repr, values))}}};"
