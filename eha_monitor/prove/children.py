"""The processes of a trial: each question is answered by one, on cores of its own; its files."""

import hashlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from eha_monitor.compiled import FIRST_RUN
from eha_monitor.output import write_text

PACKAGE = Path(__file__).parents[1]
LONGEST = 1800.0  # s that a diagnosis may take


@dataclass(frozen=True)
class Questions:
    """Questions of one kind.

    Attributes
    ----------
    module : what is run, as by ``python -m``.
    folder : of the answers, ``NAME.json``, and of how they ran, ``NAME.run.json``.
    source : digest of what has a part in the answers.
    arguments : name of a question -> arguments of the module.
    what : the work in words.
    """

    module: str
    folder: Path
    source: str
    arguments: Callable[[str], list[str]]
    what: str


def children(questions: Questions, names: Sequence[str], jobs: int,
             say: Callable[[str, float], None]) -> None:
    """Have each name answered by a process of its own, ``jobs`` at a time, each on its cores."""
    jobs = max(1, min(jobs, len(names)))
    cores = sorted(os.sched_getaffinity(0))
    shares = [cores[i::jobs] for i in range(jobs)]
    running: set[subprocess.Popen] = set()
    stop = threading.Event()

    def one(name: str) -> None:
        if stop.is_set():
            return
        share = shares.pop()
        target = questions.folder / f"{name}.json"
        target.unlink(missing_ok=True)
        started = time.perf_counter()
        os.sched_setaffinity(0, share)  # of this thread; its child inherits it
        process = begun(questions.module, questions.arguments(name))
        running.add(process)
        status, complaint = ended(process)
        running.discard(process)
        shares.append(share)
        if stop.is_set():
            return
        fine = status == 0 and read_json(target) is not None
        write_json(questions.folder / f"{name}.run.json", {
            "status": status, "seconds": time.perf_counter() - started, "source": questions.source,
            "cores": len(share),
            "error": "" if fine else (complaint.splitlines() or ["no answer"])[-1]})

    head = 1 if FIRST_RUN else 0  # it compiles; the others would all do so at the same time
    with ThreadPoolExecutor(jobs) as pool:
        try:
            done = 0
            for batch in (names[:head], names[head:]):
                for future in as_completed([pool.submit(one, name) for name in batch]):
                    future.result()
                    done += 1
                    say(f"{questions.what}, {done} of {len(names)}", done / len(names))
        except BaseException:
            stop.set()
            for process in list(running):
                process.terminate()
            raise


def begun(module: str, arguments: Sequence[str]) -> subprocess.Popen:
    """Start a module of this very source with arguments; what it complains of is kept."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(
        [str(PACKAGE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])}
    return subprocess.Popen([sys.executable, "-m", module, *arguments], env=environment,
                            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                            stderr=subprocess.PIPE, text=True, errors="replace")


def ended(process: subprocess.Popen, seconds: float = LONGEST) -> tuple[int, str]:
    """Return a process' exit status, and what it complained of, once it has ended."""
    try:
        _, complaint = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return process.returncode, f"took more than {seconds:.0f} s"
    return process.returncode, complaint.strip()


def kept(questions: Questions, name: str, keep: str) -> bool:
    """Tell whether an answer is there that may stay: of the ``same`` source, ``all``, ``none``."""
    run = read_json(questions.folder / f"{name}.run.json") or {}
    if keep == "none" or run.get("status") != 0 or (
            keep == "same" and run.get("source") != questions.source):
        return False
    return read_json(questions.folder / f"{name}.json") is not None


def digest_of(content: bytes) -> str:
    """Return the SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def read_json(path: Path) -> dict | None:
    """Return what a JSON file holds; None where there is none that can be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def write_json(path: Path, content: dict) -> None:
    """Write a JSON file whole."""
    write_text(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")
