"""The processes of a trial: for each question a fork of a loaded process, on cores of its own."""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from eha_monitor.compiled import FIRST_RUN
from eha_monitor.prove.files import read_json, write_json

PACKAGE = Path(__file__).parents[1]
LONGEST = 1800.0  # s that a diagnosis may take
DIED = "the process that answers died"


class Place:
    """Some cores, and the process that waits there for questions.

    Parameters
    ----------
    module : whose ``main`` answers.
    cores : that it may use.
    """

    def __init__(self, module: str, cores: Sequence[int]):
        self.cores = tuple(cores)
        self._module = module
        self._process: subprocess.Popen | None = None

    def ask(self, arguments: Sequence[str]) -> tuple[int, str]:
        """Return the exit status of an answer and what it complained of."""
        if self._process is not None and self._process.poll() is not None:
            self.leave()
        process = self._process = self._process or self._start()
        try:
            process.stdin.write(json.dumps({"arguments": list(arguments), "seconds": LONGEST})
                                + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except OSError:
            line = ""
        if not line:
            return process.wait(), DIED
        said = json.loads(line)
        return said["status"], said["error"]

    def _start(self) -> subprocess.Popen:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(
            [str(PACKAGE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])}
        os.sched_setaffinity(0, self.cores)  # of this thread; its child inherits it
        return subprocess.Popen(
            [sys.executable, "-m", "eha_monitor.prove.warm", self._module], env=environment,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)

    def leave(self, at_once: bool = False) -> None:
        """End the waiting process, ``at_once`` with the answer that it is at."""
        process, self._process = self._process, None
        if process is None:
            return
        if at_once:
            process.terminate()
        with suppress(OSError):  # it died with a question in its pipe
            process.stdin.close()
        process.wait()
        process.stdout.close()


@dataclass(frozen=True)
class Questions:
    """Questions of one kind.

    Attributes
    ----------
    module : whose ``main`` answers.
    folder : of the answers, ``NAME.json``, and of how they ran, ``NAME.run.json``.
    source : digest of what has a part in the answers.
    arguments : name of a question -> arguments of ``main``.
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
    places = [Place(questions.module, cores[i::jobs]) for i in range(jobs)]
    free, stop = list(places), threading.Event()

    def one(name: str) -> None:
        if stop.is_set():
            return
        place = free.pop()
        target = questions.folder / f"{name}.json"
        target.unlink(missing_ok=True)
        started = time.perf_counter()
        try:
            status, complaint = place.ask(questions.arguments(name))
        finally:
            free.append(place)
        if stop.is_set():
            return
        fine = status == 0 and read_json(target) is not None
        write_json(questions.folder / f"{name}.run.json", {
            "status": status, "seconds": time.perf_counter() - started, "source": questions.source,
            "cores": len(place.cores),
            "error": "" if fine else (complaint.splitlines() or ["no answer"])[-1]})

    head = 1 if FIRST_RUN else 0  # it compiles; the others would all do so at the same time
    with ThreadPoolExecutor(jobs) as pool:
        try:
            ended = 0
            for batch in (names[:head], names[head:]):
                for future in as_completed([pool.submit(one, name) for name in batch]):
                    future.result()
                    ended += 1
                    say(f"{questions.what}, {ended} of {len(names)}", ended / len(names))
        except BaseException:
            stop.set()
            for place in places:
                place.leave(at_once=True)
            raise
    for place in places:
        place.leave()


def kept(questions: Questions, name: str, keep: str) -> bool:
    """Tell whether an answer is there that may stay: of the ``same`` source, ``all``, ``none``."""
    run = read_json(questions.folder / f"{name}.run.json") or {}
    if keep == "none" or run.get("status") != 0 or (
            keep == "same" and run.get("source") != questions.source):
        return False
    return read_json(questions.folder / f"{name}.json") is not None
