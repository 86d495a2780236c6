"""Compiles all that a recording or a live actuator can ask for: what `make setup` does once.

Run as ``python -m eha_monitor.compile_all``.  Nothing is run for it: :mod:`eha_monitor.signatures`
lists what the commands call from Python, and with which types; what these functions call comes
along.  Two processes and more share the list.
"""

import argparse
import importlib
import multiprocessing
import os
import shutil
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from eha_monitor.compiled import ANNOUNCER, CACHE
from eha_monitor.compiled_cache import shipped
from eha_monitor.signatures import SIGNATURES


def compile_one(place: int) -> None:
    """Compile one line of the list, or find that it has been compiled."""
    ANNOUNCER.quiet = True  # the set-up has said so
    module, name, types = SIGNATURES[place]
    getattr(importlib.import_module(f"eha_monitor.{module}"), name).compile(types)


def compile_all(processes: int) -> None:
    """Compile the list, the longest first, in so many processes."""
    if processes == 1:
        for place in range(len(SIGNATURES)):
            compile_one(place)
        return
    # Not forked: a process that compiles has threads of LLVM.
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        list(pool.map(compile_one, range(len(SIGNATURES))))


def ship() -> None:
    """Put what is compiled beside the package of this virtual environment, for every user.

    Whoever runs the installed package with an empty home, as a service does, loads it from there.
    """
    if sys.prefix == sys.base_prefix:  # the system's Python is not ours to write into
        return
    place = shipped()
    place.mkdir(parents=True, exist_ok=True)
    for old in place.iterdir():
        shutil.rmtree(old)
    copy = Path(tempfile.mkdtemp(prefix="copy-", dir=place))
    shutil.copytree(CACHE, copy, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.tmp"))
    copy.chmod(0o755)
    copy.rename(place / CACHE.name)


def main() -> None:
    """Compile; with ``--ship``, for every user of this virtual environment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ship", action="store_true", help="also for the users of this .venv")
    parser.add_argument("--processes", type=int, default=len(os.sched_getaffinity(0)),
                        help="that share the work; as many as there are cores")
    asked = parser.parse_args()
    compile_all(asked.processes)
    if asked.ship:
        ship()


if __name__ == "__main__":
    main()
