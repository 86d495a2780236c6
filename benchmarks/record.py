"""What a benchmark measured, in a file, with all that tells whether the figure is still true.

A benchmark that is started with ``--record`` calls :func:`write`, which makes
``benchmarks/figures/<name>.json``: each figure with its spread and unit, the command, the commit,
the day, the machine with its speed in plain filterpy steps per second, and a digest of each folder
of source that the figure measures.  ``make figures`` makes the tables of README and docs of these
files; docs/figures.md says when a figure counts as too old.
"""

import argparse
import ast
import datetime
import hashlib
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "benchmarks" / "figures"
DATA = ROOT.parent / "shared" / "data"  # real recordings, which are not in the repository
sys.path.insert(0, str(ROOT))  # what is measured is this source, whatever is installed
DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def options(words: str, data: bool = False) -> argparse.ArgumentParser:
    """Return the options of a benchmark: ``--record``, and ``--data`` of one on real recordings.

    Parameters
    ----------
    words : its docstring, whose first line the help shows.
    """
    made = argparse.ArgumentParser(description=words.splitlines()[0])
    made.add_argument("--record", action="store_true",
                      help="write what is measured to benchmarks/figures")
    if data:
        made.add_argument("--data", type=Path, default=DATA)
    return made


def own_graph(logs: str) -> None:
    """Give this process and its children a ROS graph of their own, and this source."""
    os.environ.update({
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100), **os.environ,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOG_DIR": logs,
        "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"})


def spread(values: object, unit: str = "") -> dict:
    """Return a figure: the median of what was measured, the smallest and the largest, how many.

    Parameters
    ----------
    values : array_like or float
        What was measured, once or several times.
    unit : str
        As the table shows it.
    """
    measured = np.atleast_1d(np.asarray(values, float))
    return {"value": rounded(np.median(measured)), "min": rounded(measured.min()),
            "max": rounded(measured.max()), "n": len(measured), "unit": unit}


def rounded(value: float) -> float | None:
    """Return a number to eight digits, so that a file can be read; None where it is none."""
    return float(f"{value:.8g}") if np.isfinite(value) else None


def write(name: str, figures: dict[str, dict], measures: tuple[str, ...],
          held_by: str = "source") -> None:
    """Write the figures of a benchmark that runs now.

    Parameters
    ----------
    name : str
        Name of the file, without its ending.
    figures : dict
        Key -> what :func:`spread` returns.
    measures : tuple of str
        Folders or files of source, from the root of the repository, that the figures measure.
    held_by : {"source", "commit"}
        ``source``: ``tables.py --again`` measures it again where the code has changed, for
        benchmarks of a minute.  ``commit``: the table says at which commit it was, for longer
        ones, and for those that need a quiet machine.
    """
    words = [str(Path(sys.argv[0]).resolve().relative_to(ROOT)), *sys.argv[1:]]
    commit, dirty = commit_now()
    made = {"command": f"python {shlex.join(words)}", "commit": commit, "dirty": dirty,
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
            "machine": machine(), "held_by": held_by,
            "measures": {part: digest(part) for part in measures}, "figures": figures}
    FIGURES.mkdir(exist_ok=True)
    file = FIGURES / f"{name}.json"
    text = json.dumps(made, indent=1, ensure_ascii=False, allow_nan=False)
    file.write_text(f"{text}\n", encoding="utf-8")
    print(f"{file.relative_to(ROOT)} is written; `make figures` puts it into the tables")


def commit_now() -> tuple[str, bool]:
    """Return the commit that is checked out, and whether the package differs from it."""
    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True,
                              check=True).stdout.strip()

    return git("rev-parse", "--short=7", "HEAD"), bool(git("status", "--porcelain", "eha_monitor"))


def machine() -> dict:
    """Return what a timing depends on, measured now."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")),
                 platform.machine())
    load = os.getloadavg()[0]  # before the steps below add to it
    steps = 1.0 / plain_filterpy_cost(3)
    return {"cores": len(os.sched_getaffinity(0)), "model": model, "load": round(load, 1),
            "filterpy_steps_per_s": round(steps, -2)}


def plain_filterpy_cost(size: int, samples: int = 5000) -> float:
    """Return seconds a sample of a plain loop with so many states, median of five."""
    ekf = ExtendedKalmanFilter(dim_x=size, dim_z=1)
    ekf.F = np.eye(size) + np.diag(np.full(size - 1, 1e-3), 1)
    ekf.Q, ekf.R = np.diag(np.full(size, 1e-8)), np.array([[1e-12]])
    h = np.eye(1, size)
    measured = np.array([1e-3])
    costs = []
    for _ in range(5):
        begin = time.perf_counter()
        for _ in range(samples // 5):
            ekf.predict()
            ekf.update(measured, lambda x: h, lambda x: h @ x)
        costs.append((time.perf_counter() - begin) / (samples // 5))
    return float(np.median(costs))


def digest(part: str) -> str:
    """Return the digest of a folder's or a file's code; comments and docstrings do not count."""
    place = ROOT / part
    files = sorted(place.rglob("*.py")) if place.is_dir() else [place]
    if not files or not all(file.is_file() for file in files):
        raise FileNotFoundError(f"{part}: expected source that a figure measures")
    every = hashlib.sha256()
    for file in files:
        every.update(f"{file.relative_to(ROOT).as_posix()}\n".encode())
        every.update(code_of(file.read_text(encoding="utf-8")).encode())
    return every.hexdigest()


def code_of(source: str) -> str:
    """Return what of a source is run, in a form that all Pythons from 3.11 on share."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return ast.dump(tree).replace(", type_params=[]", "")  # since 3.12
