"""Compiled functions: shared by every copy of the package, announced, and complete."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.errors import NumbaError

from eha_monitor.compiled import CACHE, njit

PACKAGE = Path(__file__).parents[1] / "eha_monitor"
COUNT = """
import sys
from numba.core import event

class Counter(event.Listener):
    compiled = []
    def on_start(self, event):
        function = event.data["dispatcher"].py_func
        self.compiled.append(f"{function.__module__}.{function.__qualname__}")
    def on_end(self, event):
        pass

event.register("numba:compile", Counter())
"""
REPORT = "\nprint('compiled', len(Counter.compiled), sorted(set(Counter.compiled)))\n"
ONE_FUNCTION = COUNT + """
import numpy as np
from eha_monitor.physics.contributions import N_EFFECTS, with_term
assert with_term(np.ones(N_EFFECTS, dtype=bool)).any()
""" + REPORT
COMMANDS = COUNT + """
import numpy as np
from pathlib import Path
from eha_monitor.cli import main
from eha_monitor.live.estimator import LiveEstimator
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import Settings

plant, settings = Simulator(Settings(), seed=0), Settings()
rows = plant.advance(4000)
everything, position = Path("everything"), Path("position")
write_recording(everything, Recording(plant.dt, rows), settings, overwrite=True)
write_recording(position, Recording(plant.dt, {name: rows[name] for name in ("x", "x_d")}),
                settings, overwrite=True)
for bag in (everything, position):
    assert main(["estimate", str(bag), "--json", f"{bag}.json"]) == 0
    assert main(["diagnose", str(bag)]) == 0
estimator = LiveEstimator(settings)
for k in range(0, len(next(iter(rows.values()))), 10):
    part = {name: values[k:k + 10] for name, values in rows.items()}
    estimator.push_rows(plant.dt * np.arange(k, k + len(part["x"])), part)
estimator.snapshot()
""" + REPORT


def ran(package_root, script, cache, folder, **environment):
    """Run a script against the package below ``package_root``, with nobody's home.

    Nor with what a set-up has put beside the package: the prefix is another, of children too.
    """
    (folder / "sitecustomize.py").write_text(
        f"import sys\nsys.prefix = {str(folder / 'prefix')!r}\n")
    home = folder / "home"
    home.mkdir(exist_ok=True)
    inherited = {key: value for key, value in os.environ.items()
                 if key not in ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "EHA_MONITOR_CACHE")}
    inherited |= {"HOME": str(home), "PYTHONPATH": f"{folder}{os.pathsep}{package_root}",
                  "PYTHONDONTWRITEBYTECODE": "1"}
    if cache is not None:
        inherited["EHA_MONITOR_CACHE"] = str(cache)
    return subprocess.Popen([sys.executable, "-P", "-c", script], cwd=folder, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                            env=inherited | environment)


def told(process):
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    line = next(line for line in out.splitlines() if line.startswith("compiled "))
    return int(line.split()[1]), line, err


def copy_of(folder):
    """Return a place where the package lies as a fresh installation: other path, other times."""
    shutil.copytree(PACKAGE, folder / "eha_monitor",
                    ignore=shutil.ignore_patterns("__pycache__"), copy_function=shutil.copyfile)
    return folder


@pytest.fixture(scope="module")
def compiled_once(tmp_path_factory):
    """A cache with what one function needs; a test that changes it takes a copy."""
    folder = tmp_path_factory.mktemp("compiled")
    assert told(ran(PACKAGE.parent, ONE_FUNCTION, folder / "cache", folder))[0] > 0
    return folder / "cache"


def test_every_copy_of_the_package_shares_what_was_compiled_once(tmp_path):
    first, line, err = told(ran(PACKAGE.parent, ONE_FUNCTION, None, tmp_path))
    place = next((tmp_path / "home" / ".cache" / "eha_monitor").glob("numba-*"))
    assert first, line
    assert err.count("compiling") == err.count("\n") == 1 and str(place) in err, err
    again = told(ran(copy_of(tmp_path / "a"), ONE_FUNCTION, None, tmp_path))
    assert again[0] == 0 and not again[2], again


def test_processes_that_compile_at_once_leave_nothing_out_and_nothing_broken(tmp_path):
    cache = tmp_path / "cache"
    together = [ran(PACKAGE.parent, ONE_FUNCTION, cache, tmp_path) for _ in range(3)]
    compiled = [told(process)[0] for process in together]
    assert max(compiled) > 0  # one that starts late, on a busy machine, may find it done
    assert told(ran(PACKAGE.parent, ONE_FUNCTION, cache, tmp_path))[0] == 0
    assert not list(cache.rglob("*.tmp"))


def test_a_damaged_file_is_compiled_again(tmp_path, compiled_once):
    cache = shutil.copytree(compiled_once, tmp_path / "cache")
    for place in cache.rglob("*.nbc"):
        raw = bytearray(place.read_bytes())
        raw[len(raw) // 2] ^= 0xff
        place.write_bytes(raw[:-7])
    assert told(ran(PACKAGE.parent, ONE_FUNCTION, cache, tmp_path))[0] > 0
    assert told(ran(PACKAGE.parent, ONE_FUNCTION, cache, tmp_path))[0] == 0


def test_a_cache_that_cannot_be_written_costs_no_answer(tmp_path):
    cache = tmp_path / "cache"
    name = CACHE.name
    cache.mkdir()
    (cache / name).write_text("where the folder should be")
    assert told(ran(PACKAGE.parent, ONE_FUNCTION, cache, tmp_path))[0] > 0


def test_a_user_with_an_empty_home_takes_what_the_set_up_compiled(tmp_path, compiled_once):
    """A prefix of its own stands for the virtual environment."""
    prefix = tmp_path / "venv"
    shutil.copytree(compiled_once, prefix / "share" / "eha_monitor" / "compiled")
    script = f"import sys; sys.prefix = {str(prefix)!r}\n" + ONE_FUNCTION
    count, line, err = told(ran(PACKAGE.parent, script, None, tmp_path))
    assert count == 0 and not err, (line, err)


# Two diagnoses; test_no_compilation.py runs what takes seconds of them.
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_set_up_compiles_all_there_is(tmp_path):
    """Estimate, diagnosis and live, with all channels and with positions alone; elsewhere."""
    cache = tmp_path / "cache"
    script = "from eha_monitor import compile_all; sys.argv[1:] = []; compile_all.main()"
    told(ran(PACKAGE.parent, COUNT + script + REPORT, cache, tmp_path))
    count, line, err = told(ran(copy_of(tmp_path / "copy"), COMMANDS, cache, tmp_path))
    assert count == 0 and "compiling" not in err, (line, err)
    import importlib
    import pkgutil

    import eha_monitor
    from eha_monitor.compiled import SharedCache

    # Written into their callers, or the catalogue's "does nothing".
    never = {"damped_mass_integrals", "no_term", "no_update", "no_circuit"}
    for room in ("physics", "estimation", "recordings", "mismatch"):
        path = [str(PACKAGE / room)]
        for module in pkgutil.walk_packages(path, f"{eha_monitor.__name__}.{room}."):
            for name, made in vars(importlib.import_module(module.name)).items():
                kept = getattr(made, "_cache", None)
                if isinstance(kept, SharedCache) and made.__name__ not in never:
                    folder = cache / CACHE.name / Path(kept.cache_path).name
                    assert list(folder.glob(f"{made.__name__}-*.nbc")) or "<locals>" in (
                        made.py_func.__qualname__), f"{module.name}.{name}"


@njit(allocates=False)
def first_row_of(a):
    return 1.0, a[0]


@njit(allocates=False)
def one_more(a):
    return (a + 1.0)[0, 0]


@pytest.mark.parametrize("function", [first_row_of, one_more])
def test_who_says_that_it_makes_no_array_may_neither_make_nor_return_one(function):
    """It counts no references: its caller would free what it returns once more."""
    with pytest.raises((TypeError, NumbaError)):
        function(np.eye(2))
