"""A process that has the program loaded and waits for questions: each is answered by a fork of it.

    python -m eha_monitor.prove.warm eha_monitor.prove.blind

Starting Python and loading numba, scipy and the program takes two seconds of processor; a fork
takes none of it.  A fork sees no more than a fresh process would: this one opens no recording and
no key, never loads the generator, and is handed one question at a time.

A line of the standard input is a question, ``{"arguments": [...], "seconds": 1800}`` for the
module's ``main``; a line of the output is how it ended, ``{"status": 0, "error": ""}``.
"""

import importlib
import json
import os
import pkgutil
import select
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable

# Rooms that are loaded whole: what the commands load only when they are run.
ROOMS = ("commands", "api", "mismatch", "plausibility", "estimation", "live", "physics",
         "recordings", "settings")
MOST_WORDS = 100_000  # bytes of a complaint that are kept


def answered(main: Callable[[list[str]], None], arguments: list[str], seconds: float,
             started: Callable[[int], None]) -> dict:
    """Run ``main`` in a fork and return its exit status and what it complained of.

    Parameters
    ----------
    seconds : that it may take.
    started : called with the number of the fork's process, and 0 when it has ended.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        become(main, arguments, writing)
    started(child)
    os.close(writing)
    words, late, end = b"", False, time.monotonic() + seconds
    while True:
        left = end - time.monotonic()
        if not late and not select.select([reading], [], [], max(left, 0.0))[0]:
            os.kill(child, signal.SIGKILL)
            late = True
        part = os.read(reading, 65536)
        if not part:
            break
        words = (words + part)[-MOST_WORDS:]
    os.close(reading)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    started(0)
    error = f"took more than {seconds:.0f} s" if late else words.decode(errors="replace").strip()
    return {"status": status, "error": error}


def become(main: Callable[[list[str]], None], arguments: list[str], writing: int) -> None:
    """Run ``main`` and end; neither questions nor answers of the waiting process can be read."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    nothing = os.open(os.devnull, os.O_RDWR)
    for taken, place in ((nothing, 0), (nothing, 1), (writing, 2)):
        os.dup2(taken, place)
    os.close(nothing)
    os.close(writing)
    # New ones: those of the waiting process remember what they were opened on.
    sys.stdin = os.fdopen(0)
    sys.stdout, sys.stderr = (os.fdopen(place, "w", buffering=1) for place in (1, 2))
    status = 1
    try:
        main(arguments)
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        if sys.exc_info()[0] is not None:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def load() -> None:
    """Load every module of the rooms that have a part in an answer."""
    for room in ROOMS:
        package = importlib.import_module(f"eha_monitor.{room}")
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(found.name)


def serve(module: str) -> None:
    """Answer questions until the input ends."""
    from eha_monitor.compiled import load_runtime

    load()
    main = importlib.import_module(module).main
    load_runtime()
    running = 0

    def started(child: int) -> None:
        nonlocal running
        running = child

    def ended(*_) -> None:
        if running:
            os.kill(running, signal.SIGKILL)
        os._exit(1)

    signal.signal(signal.SIGTERM, ended)
    # Only the threads of the linear algebra are there, which know how to be forked.
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    for line in iter(sys.stdin.readline, ""):
        question = json.loads(line)
        print(json.dumps(answered(main, question["arguments"], question["seconds"], started)),
              flush=True)


if __name__ == "__main__":
    serve(sys.argv[1])
