"""Processor time of the first and of later runs, from two copies of the package, no home.

Run as ``python benchmarks/first_run.py``; a minute or two.  The second copy stands for the
installed package beside a checkout, or for another clone: it has to compile nothing.
"""

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
RUNS = (("a", "estimate"), ("a", "estimate"), ("b", "estimate"),
        ("a", "diagnose"), ("a", "diagnose"), ("b", "diagnose"))
ARGUMENTS = {"estimate": ["bags/air_ingress"],
             "diagnose": ["bags/hidden_friction"]}


def timed(package: Path, command: str, home: Path) -> tuple[float, float, str]:
    """Run one command; returns seconds of processor and of wall time, and what it told."""
    kept = {key: value for key, value in os.environ.items()
            if key not in ("XDG_CACHE_HOME", "EHA_MONITOR_CACHE", "NUMBA_CACHE_DIR")}
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-P", "-m", "eha_monitor", command, *ARGUMENTS[command]], cwd=ROOT,
        env=kept | {"HOME": str(home), "PYTHONPATH": str(package),
                    "PYTHONDONTWRITEBYTECODE": "1"},
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
            time.perf_counter() - started, done.stderr.strip())


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as scratch:
        home = Path(scratch) / "home"
        home.mkdir()
        for name in ("a", "b"):
            shutil.copytree(ROOT / "eha_monitor", Path(scratch) / name / "eha_monitor",
                            ignore=shutil.ignore_patterns("__pycache__"),
                            copy_function=shutil.copyfile)
        print(f"{'copy':5} {'command':9} {'processor':>10} {'wall':>8}  told")
        for name, command in RUNS:
            processor, wall, told = timed(Path(scratch) / name, command, home)
            lines = told.replace(scratch, "").splitlines() or ["nothing"]
            print(f"{name:5} {command:9} {processor:8.1f} s {wall:6.1f} s  {lines[0]}")
            for line in lines[1:]:
                print(f"{'':36}{line}")


if __name__ == "__main__":
    main()
