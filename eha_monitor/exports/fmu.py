"""The identified actuator as an FMU 2.0 for co-simulation that needs nothing but itself.

Its shared libraries are numba's code for the physics, and a C compiler's for the FMI functions.
The physics is compiled once for each source of the package (about ten seconds) and kept beside
numba's own cache; for each FMU only the C files with its start values are compiled.
"""

import importlib.util
import io
import os
import shutil
import subprocess
import sys
import tempfile
import uuid
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eha_monitor import __version__
from eha_monitor.compiled import CACHE
from eha_monitor.errors import InputError, installs
from eha_monitor.exports import fmu_kernel
from eha_monitor.exports.fmu_kernel import NAME
from eha_monitor.exports.model import (
    INPUTS,
    OUTPUTS,
    Exported,
    Model,
    exponents,
    lost_of_simulation,
    plain,
    rendered,
)
from eha_monitor.output import source_digest, write_bytes, write_text
from eha_monitor.physics import contributions, plant, signals
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import BASE_KEYS, place_of, theta_of
from eha_monitor.physics.signals import K_POS
from eha_monitor.settings.rig import Rig

SOURCES = Path(__file__).parent / "fmu"
MISSING = ("--fmu: needs a C compiler to link with, and there is neither ziglang nor cc; "
           + installs("export"))


@dataclass(frozen=True)
class Platform:
    """Where an FMU runs: its folder in the FMU, LLVM's and zig's names, and the library's end."""

    folder: str
    triple: str
    zig: str
    suffix: str


# glibc of 2014 and later; the 64-bit platforms that FMI 2.0 names.
PLATFORMS = (Platform("linux64", "x86_64-unknown-linux-gnu", "x86_64-linux-gnu.2.17", ".so"),
             Platform("win64", "x86_64-pc-windows-gnu", "x86_64-windows-gnu", ".dll"))


def platforms_for(wanted: tuple[str, ...]) -> tuple[Platform, ...]:
    """Return the platforms by their folders; without any all that can be built for here.

    All can with zig, Linux with a compiler of its own.  Raises InputError if one that is wanted,
    or all, cannot be built for.
    """
    known = {platform.folder: platform for platform in PLATFORMS}
    if importlib.util.find_spec("ziglang") is None:
        if _compiler() is None or sys.platform != "linux" or os.uname().machine != "x86_64":
            raise InputError(MISSING)
        other = [folder for folder in wanted if folder != PLATFORMS[0].folder]
        if other:
            raise InputError(f"--fmu-platform {other[0]}: needs ziglang; " + installs("export"))
        return PLATFORMS[:1]
    return tuple(known[folder] for folder in dict.fromkeys(wanted)) or PLATFORMS


def _compiler() -> str | None:
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def _kept(end: str) -> Path:
    """Return where something compiled of exactly this source is kept."""
    return CACHE / "exports" / f"fmu_kernel-{source_digest(('exports/fmu_kernel.py',))}.{end}"


def physics_assembly() -> str:
    """Return the LLVM assembly of the physics, compiled for any processor of this architecture.

    In a process of its own: numba takes its processor from the environment, once.
    """
    kept = _kept("ll")
    if kept.exists():
        return kept.read_text(encoding="utf-8")
    kept.parent.mkdir(parents=True, exist_ok=True)
    fresh = kept.with_name(f".{kept.name}.{os.getpid()}.tmp")
    run = subprocess.run(
        [sys.executable, "-m", "eha_monitor.exports.fmu_kernel", str(fresh)], check=False,
        env={**os.environ, "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "",
             "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        capture_output=True, text=True)
    try:
        if run.returncode:
            last = run.stderr.strip().rsplit("\n", 1)[-1]
            raise InputError(f"--fmu: the physics could not be compiled: {last[:300]}")
        text = fresh.read_text(encoding="utf-8")
    finally:
        fresh.unlink(missing_ok=True)
    write_text(kept, text)
    return text


def physics_object(platform: Platform) -> bytes:
    """Return an object file with the function ``NAME`` for a platform.

    What numba makes for Python's sake is left out: nothing of Python is needed to link or run it.
    """
    kept = _kept(f"{platform.folder}.o")
    if kept.exists():
        return kept.read_bytes()
    import llvmlite.binding as llvm

    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    head, text = physics_assembly().split("\n", 1)
    mangled = head.removeprefix("; ")
    module = llvm.parse_assembly(text.replace(f'@"{mangled}"', f"@{NAME}").replace(
        f"@{mangled}(", f"@{NAME}("))
    for one in (*module.functions, *module.global_variables):
        if not one.is_declaration and one.name != NAME:
            one.linkage = "internal"
    module.triple = platform.triple
    machine = llvm.Target.from_triple(platform.triple).create_target_machine(
        opt=2, reloc="pic", codemodel="default")
    module.data_layout = str(machine.target_data)
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(
        machine, llvm.create_pipeline_tuning_options(speed_level=0)))
    content = machine.emit_object(module)
    write_bytes(kept, content)
    return content


def shared_library(platform: Platform, folder: Path, sources: list[Path]) -> bytes:
    """Return the shared library of C files and the physics for a platform.

    ``folder`` : an empty one to work in.

    Raises InputError if the compiler fails: a full disk, a broken installation.
    """
    here = folder / platform.folder
    here.mkdir()
    compiled, library = here / "physics.o", here / f"model{platform.suffix}"
    compiled.write_bytes(physics_object(platform))
    if importlib.util.find_spec("ziglang") is not None:
        compiler = [sys.executable, "-m", "ziglang", "cc", "-target", platform.zig]
        kept = str(CACHE.parent / "zig")  # its C libraries: minutes once, and not once per source
        environment = {**os.environ, "ZIG_GLOBAL_CACHE_DIR": kept, "ZIG_LOCAL_CACHE_DIR": kept}
    else:
        compiler, environment = [str(_compiler()), "-fPIC"], dict(os.environ)
    run = subprocess.run(
        [*compiler, "-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-shared",
         "-fvisibility=hidden", "-o", str(library), *map(str, sources), str(compiled), "-lm"],
        check=False, env=environment, capture_output=True, text=True, cwd=here)
    if run.returncode:
        last = (run.stderr or run.stdout).strip().rsplit("\n", 1)[-1]
        raise InputError(f"--fmu: the compiler failed for {platform.folder}: {last[:300]}")
    return library.read_bytes()


# Numbers of the rig that age and heat change; the others are its geometry.
DRIFTING = ("viscous_damping", "bulk_modulus", "leakage", "makeup_conductance")
VR_X_START, VR_CLOSED, VR_OUTPUT, VR_PARAMETER = 10, 11, 100, 1000


@dataclass(frozen=True)
class Variable:
    """A parameter of the FMU."""

    name: str
    place: int  # in theta
    unit: str
    description: str
    start: float
    lower: float | None
    upper: float | None
    tunable: bool  # may be set while the simulation runs; another only before it


def parameters_of(model: Model, theta: np.ndarray) -> list[Variable]:
    """Return the rig's numbers and the parameters of the active effects of the catalogue."""
    found = []
    for place, key in BASE_KEYS.items():
        if place == K_POS and model.settings.rig.position_gain is None:
            continue
        field = Rig.model_fields[key]
        bounds = {name: getattr(one, name) for one in field.metadata
                  for name in ("gt", "ge") if hasattr(one, name)}
        found.append(Variable(key, place, field.json_schema_extra["unit"], field.description,
                              float(theta[place]), bounds.get("ge", bounds.get("gt")), None,
                              key in DRIFTING))
    for name in model.effects:
        for p in CATALOGUE[name].parameters:
            place = place_of(f"{name}.{p.name}")
            found.append(Variable(f"{name}.{p.name}", place, p.unit, p.description,
                                  float(theta[place]), p.lower, p.upper,
                                  p.fitted or p.default is None))
    return found


def description(model: Model, guid: str, identifier: str, start: float, parameters: list[Variable],
                lost: tuple[str, ...], units: Mapping[str, str]) -> bytes:
    """Return the XML file.

    Parameters
    ----------
    start : position at the start, m.
    units : unit of a linear rig -> that of this one.
    """
    def unit_of(unit: str) -> str:
        return plain(units.get(unit, unit))

    def real(name: str, vr: int, text: str, unit: str, start: float | None = None,
             bounds: tuple[float | None, float | None] = (None, None), **attributes: str) -> tuple:
        value = {"unit": unit_of(unit)} if unit_of(unit) else {}
        value |= {key: repr(float(bound)) for key, bound in zip(("min", "max"), bounds,
                                                                strict=True)
                  if bound is not None and np.isfinite(bound)}
        if start is not None:
            value["start"] = repr(float(start))
        return ({"name": name, "valueReference": vr, "description": text} | attributes, "Real",
                value)

    before = {"causality": "parameter", "variability": "fixed", "initial": "exact"}
    variables = [real(name, vr, text, unit, start if name == "x_d" else 0.0, causality="input",
                      variability="continuous") for vr, (name, unit, text) in enumerate(INPUTS)]
    variables += [
        real("x_start", VR_X_START, "position at the start, at rest", "m", start, **before),
        ({"name": "closed_loop", "valueReference": VR_CLOSED} | before | {
            "description": "true: the drive follows x_d; false: pump_speed turns the pump"},
         "Boolean", {"start": str(model.settings.rig.position_gain is not None).lower()})]
    variables += [real(one.name, VR_PARAMETER + i, one.description, one.unit, one.start,
                       (one.lower, one.upper), **before | (
                           {"variability": "tunable"} if one.tunable else {}))
                  for i, one in enumerate(parameters)]
    first = len(variables) + 1
    variables += [real(name, VR_OUTPUT + i, text, unit, causality="output",
                       variability="continuous", initial="calculated")
                  for i, (name, unit, text) in enumerate(OUTPUTS)]
    used = {unit_of(one[1]) for one in (*INPUTS, *OUTPUTS)} | {
        unit_of(one.unit) for one in parameters}
    return rendered(
        "fmu.xml.j2", model=model, rig=model.settings.rig, guid=guid, identifier=identifier,
        version=__version__, lost=lost, variables=variables,
        definitions=[(unit, exponents(unit)) for unit in sorted(used - {""})],
        outputs=range(first, first + len(OUTPUTS))).encode()


def fmu_of(model: Model, units: Mapping[str, str], wanted: tuple[str, ...] = ()) -> Exported:
    """Return the FMU of a config.

    Raises InputError if a number of the rig is null, a delay is longer than the FMU remembers, or
    there is no compiler.

    Parameters
    ----------
    units : unit of a linear rig -> that of this one.
    wanted : platforms (``linux64``, ``win64``); without any all that can be built for here.
    """
    model.require("an FMU")
    platforms = platforms_for(wanted)
    settings = model.settings
    theta, active = theta_of(settings.rig, settings.effects)
    theta = np.nan_to_num(theta, nan=0.0)
    h = settings.rig.sample_time / settings.simulation.substeps
    _refuse_long_delays(model, theta, active, h)
    start = model.start
    parameters = parameters_of(model, theta)
    lost = _lost(model)
    name = model.identifier
    # The same model has the same identity, whoever exports it.
    guid = "{" + str(uuid.uuid5(uuid.NAMESPACE_URL, repr((
        name, theta.tolist(), active.tolist(), h, start)))) + "}"
    content = io.BytesIO()
    with tempfile.TemporaryDirectory(prefix="eha-fmu-") as folder, zipfile.ZipFile(
            content, "w", zipfile.ZIP_DEFLATED) as archive:
        here = Path(folder)
        (here / "model.h").write_text(header(settings.rig.position_gain is not None, guid, h,
                                             start, theta, active, parameters), encoding="ascii")
        source = Path(shutil.copy(SOURCES / "fmi2.c", here))  # beside its model.h
        for platform in platforms:
            archive.writestr(f"binaries/{platform.folder}/{name}{platform.suffix}",
                             shared_library(platform, here, [source]))
        archive.writestr("modelDescription.xml", description(
            model, guid, name, start, parameters, lost, units))
    return Exported(content.getvalue(), lost)


def _refuse_long_delays(model: Model, theta: np.ndarray, active: np.ndarray, h: float) -> None:
    w = contributions.circuit_of(theta, active)
    longest = {signals.COMMAND_DELAY: fmu_kernel.KEPT - 2, signals.FEEDBACK_DELAY: plant.RING - 2,
               signals.POSITION_DELAY: plant.RING - 2, signals.PRESSURE_DELAY: plant.RING - 2}
    for place, steps in longest.items():
        if w[place] > steps * h:
            raise InputError(f"{model.source}: simulation.substeps: a delay of {w[place]:g} s is "
                             f"longer than the {steps * h:g} s that an FMU remembers, expected "
                             "fewer steps in a sample")


def _lost(model: Model) -> tuple[str, ...]:
    lost = [*lost_of_simulation(model), *(
        f"{name}: acts as in the config; its values are not FMU parameters"
        for name in model.own_terms)]
    if model.settings.rig.position_gain is None:
        drive = model.of_balance("drive")
        lost.append("rig.position_gain is null: x_d has no effect, pump_speed turns the pump"
                    + (f"; {', '.join(drive)} do not act on it" if drive else ""))
    return tuple(lost)


def header(closed: bool, guid: str, h: float, start: float, theta: np.ndarray, active: np.ndarray,
           parameters: list[Variable]) -> str:
    """Return ``model.h``: what fmi2.c needs to know of the physics and of this config."""
    terms, updates = contributions.with_term(active), contributions.with_update(active, theta)
    defines = {
        "GUID": f'"{guid}"', "STEP": h, "X_START": start,
        "N_STATE": plant.N_STATE, "N_THETA": contributions.N_THETA, "N_CIRCUIT": signals.N_CIRCUIT,
        "N_MEMORY": contributions.N_EFFECTS * signals.MAX_MEMORY,
        "RING": plant.RING, "ROWS": fmu_kernel.ROWS,
        "N_SCRATCH": signals.N_CONTRIBUTIONS + signals.N_SIGNALS, "N_OUT": fmu_kernel.N_OUT,
        "AREA_1": signals.AREA_1, "AREA_2": signals.AREA_2,
        "VR_X_START": VR_X_START, "VR_CLOSED": VR_CLOSED, "VR_OUTPUT": VR_OUTPUT,
        "VR_PARAMETER": VR_PARAMETER, "CLOSED": int(closed), "N_PARAMETERS": len(parameters),
        "N_TERMS": len(terms), "N_UPDATES": len(updates)}
    return rendered("model.h.j2", defines=defines, tables=(
        ("int64_t", "TERMS", terms.tolist() or [0]),
        ("int64_t", "UPDATES", updates.tolist() or [0]),
        ("uint8_t", "ACTIVE", [int(one) for one in active]), ("double", "THETA", theta.tolist()),
        ("int", "PLACES", [one.place for one in parameters]),
        ("uint8_t", "TUNABLE", [int(one.tunable) for one in parameters])))
