"""Compiles all that a recording or a live actuator can ask for: what `make setup` does once.

Run as ``python -m eha_monitor.compile_all``.  Nothing is run for it: ``signatures.json`` lists
what the commands call from Python, and with which types, the longest first; what these functions
call comes along.  Two processes and more share the list, which ``python benchmarks/compilations.py
--write`` makes.
"""

import argparse
import importlib
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Collection, Sequence
from pathlib import Path

from numba.core import types

from eha_monitor.archive.run import on_this_machine
from eha_monitor.compiled import ANNOUNCER, CACHE, shipped

LIST = json.loads((Path(__file__).parent / "signatures.json").read_text(encoding="utf-8"))
# What a simulator, a monitor and a replay call: `make demo` begins once these are compiled.
LIVE = {tuple(one) for one in LIST["live"]}
SIGNATURES = LIST["signatures"]  # module, function, types as numba writes them


def types_of(words: str) -> tuple:
    """Return the types of a signature; a named tuple of the package is ``named(...)``."""
    def named(module: str, name: str, *fields: types.Type) -> types.Type:
        return types.BaseTuple.from_types(fields, getattr(importlib.import_module(module), name))

    return eval(words, {**vars(types), "named": named})


def compile_lines(places: Sequence[int]) -> None:
    """Compile lines of the list, or find that they have been compiled."""
    ANNOUNCER.quiet = True  # the set-up has said so
    for place in places:
        module, name, words = SIGNATURES[place]
        getattr(importlib.import_module(f"eha_monitor.{module}"), name).compile(types_of(words))


def compile_all(processes: int, only: Collection[tuple[str, str]] = ()) -> None:
    """Compile the list, or ``only`` these (module, function), in so many processes.

    Raises
    ------
    RuntimeError
        If a process died.
    """
    # A module's functions call the same ones: two processes would compile these twice.
    tasks: dict[str, list[int]] = {}
    for place, one in enumerate(SIGNATURES):
        if not only or tuple(one[:2]) in only:
            tasks.setdefault(one[0], []).append(place)
    if processes == 1:
        for places in tasks.values():
            compile_lines(places)
        return
    # Not apart: a busy core would hold up what was pinned to it.
    for places, _, error in on_this_machine(compile_lines, list(tasks.values()), processes,
                                            apart=False):
        if error:
            raise RuntimeError(f"{SIGNATURES[places[0]][0]}: {error}")


def ship() -> None:
    """Put what is compiled beside the package of this virtual environment, for every user.

    Whoever runs the installed package with an empty home, as a service does, loads it from there.
    """
    if sys.prefix == sys.base_prefix or not os.access(sys.prefix, os.W_OK):
        return  # the system's Python, or somebody else's, is not ours to write into
    place = shipped()
    place.mkdir(parents=True, exist_ok=True)
    for old in place.iterdir():
        shutil.rmtree(old)
    copy = Path(tempfile.mkdtemp(prefix="copy-", dir=place))
    shutil.copytree(CACHE, copy, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.tmp"))
    copy.chmod(0o755)
    copy.rename(place / CACHE.name)


def main() -> int:
    """Compile; with ``--ship``, for every user of this virtual environment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--live", action="store_true",
                        help="only what a simulator, a monitor and a replay need")
    parser.add_argument("--ship", action="store_true", help="also for the users of this .venv")
    parser.add_argument("--processes", type=int, default=len(os.sched_getaffinity(0)),
                        help="that share the work; as many as there are cores")
    asked = parser.parse_args()
    try:
        compile_all(asked.processes, LIVE if asked.live else ())
        if asked.ship:
            ship()
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
