"""Shared libraries of an FMU: numba's code for the physics, a C compiler for the FMI functions.

The physics is compiled once for each source of the package (about ten seconds) and kept beside
numba's own cache.  For each FMU only the C files with its start values are compiled.
"""

import importlib.util
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from eha_monitor.compiled import CACHE
from eha_monitor.errors import InputError, installs
from eha_monitor.exports.fmu_kernel import NAME
from eha_monitor.output import write_text
from eha_monitor.source import source_digest

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

    All can with zig, Linux with a compiler of its own.

    Raises
    ------
    InputError
        If one that is wanted, or all, cannot be built for.
    """
    known = {platform.folder: platform for platform in PLATFORMS}
    if importlib.util.find_spec("ziglang") is None:
        if _compiler() is None or sys.platform != "linux" or os.uname().machine != "x86_64":
            raise InputError(MISSING)
        other = [folder for folder in wanted if folder != PLATFORMS[0].folder]
        if other:
            raise InputError(f"--fmu-platform {other[0]}: needs ziglang; "
                             + installs("export"))
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
    for function in module.functions:
        if not function.is_declaration and function.name != NAME:
            function.linkage = "internal"
    for variable in module.global_variables:
        if not variable.is_declaration:
            variable.linkage = "internal"
    module.triple = platform.triple
    machine = llvm.Target.from_triple(platform.triple).create_target_machine(
        opt=2, reloc="pic", codemodel="default")
    module.data_layout = str(machine.target_data)
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(
        machine, llvm.create_pipeline_tuning_options(speed_level=0)))
    content = machine.emit_object(module)
    fresh = kept.with_name(f".{kept.name}.{os.getpid()}.tmp")
    fresh.write_bytes(content)
    fresh.replace(kept)
    return content


def shared_library(platform: Platform, folder: Path, sources: list[Path]) -> bytes:
    """Return the shared library of C files and the physics for a platform.

    Parameters
    ----------
    folder : an empty one to work in.

    Raises
    ------
    InputError
        If the compiler fails: a full disk, a broken installation.
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
