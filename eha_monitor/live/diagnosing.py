"""A diagnosis in another process, and what comes of it."""

import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from eha_monitor.errors import InputError
from eha_monitor.settings.document import annotated
from eha_monitor.settings.load import load_settings
from eha_monitor.settings.monitor import Settings

PACKAGE = Path(__file__).parents[1]
WALL = 10.0  # times its processor time: then it hangs
_NO_MEMORY = ("MemoryError", "Memory allocation", "Cannot allocate memory")


class Turn:
    """Whose diagnosis is under way: one at a time in a process, for all its actuators.

    Whoever is collected without giving it back holds it no longer.
    """

    def __init__(self):
        self._holder: weakref.ref | None = None

    @property
    def holder(self) -> object | None:
        """Who has it, None where it is free."""
        return None if self._holder is None else self._holder()

    def take(self, whose: object) -> None:
        """Take it; to be asked for first."""
        self._holder = weakref.ref(whose)

    def give_back(self, whose: object) -> None:
        """Give it back, if it was taken."""
        if self.holder is whose:
            self._holder = None


TURN = Turn()


@dataclass(frozen=True)
class Answer:
    """What came of a diagnosis.

    Attributes
    ----------
    problem : why there is no answer, as a sentence; "" where there is one.
    tree : the JSON of ``diagnose``; empty without an answer.
    completed : the config with what was found, None where nothing was.
    folder : of the report, the JSON and the config; ``bags`` that were diagnosed.
    wall_s : duration, s.
    """

    problem: str
    folder: Path
    bags: tuple[Path, ...]
    tree: dict = field(default_factory=dict)
    completed: Settings | None = None
    wall_s: float = math.nan

    @property
    def verdict(self) -> str:
        """The verdict, or ``failed``."""
        return self.tree.get("verdict", "failed")

    @property
    def probability(self) -> float:
        """Least probability of an effect, one less that of an unnamed one; NaN without effects.

        A learned term has no name, so no probability either.
        """
        found = [one.get("probability") for one in self.tree.get("effects", [])]
        if not found or None in found or self.tree.get("learned"):
            return math.nan
        unnamed = (self.tree.get("probability") or {}).get("unexplained") or 0.0
        return min(*found, 1.0 - unnamed)


class Diagnosing:
    """One run of ``diagnose`` within its budget.

    Parameters
    ----------
    bags : of one machine in one state, the newest first.
    settings : the config that they are diagnosed with; ``diagnosis`` is the budget.
    folder : for what is written, made here.
    further : arguments beside those.

    Raises
    ------
    InputError
        If the folder cannot be written.
    OSError
        If no process can be started.
    """

    def __init__(self, bags: Sequence[Path], settings: Settings, folder: Path,
                 further: Sequence[str] = ()):
        self._budget, self._folder = settings.diagnosis, folder.absolute()
        self._bags = tuple(bag.absolute() for bag in bags)
        config, self._log = self._folder / "config.yaml", self._folder / "diagnose.log"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            config.write_text(annotated(settings, "The config of the monitor."), encoding="utf-8")
            log = self._log.open("wb")
        except OSError as problem:
            raise InputError(f"{folder}: cannot write: {problem.strerror}") from problem
        budget = (os.getpid(), self._budget.niceness, math.ceil(self._budget.processor_time),
                  round(1e9 * self._budget.memory_gigabytes))
        self._started = time.monotonic()
        with log:
            # By this thread: the process ends with the thread that began it.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "eha_monitor.limited", *map(str, budget), "diagnose",
                 *map(str, self._bags), "--config", str(config),
                 "--json", str(self._folder / "diagnosis.json"),
                 "--report", str(self._folder / "report.html"),
                 "--write-config", str(self._folder / "completed.yaml"), *further],
                env=os.environ | {"PYTHONPATH": os.pathsep.join(
                    [str(PACKAGE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])},
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log)
        self._answer: Answer | None = None
        # To read the answer takes a tenth of a second: rows must not wait for it.
        self._reader = threading.Thread(target=self._read, daemon=True, name="diagnosis")
        self._reader.start()

    def take(self) -> Answer | None:
        """Return the answer once there is one."""
        return self._answer

    def end(self) -> None:
        """End the process, if it still runs."""
        self._process.kill()
        self._reader.join()

    def _read(self) -> None:
        """Wait for the process and read what it wrote."""
        longest = WALL * self._budget.processor_time
        try:
            status = self._process.wait(longest)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            self._answer = self._failed(f"had not ended after {longest:.0f} s")
            return
        if status:
            self._answer = self._failed(self._why(status))
            return
        try:
            tree = json.loads((self._folder / "diagnosis.json").read_text(encoding="utf-8"))
            completed = load_settings(self._folder / "completed.yaml") if tree["verdict"] in (
                "mismatch", "unexplained") else None
        except (OSError, ValueError, KeyError, InputError) as problem:
            self._answer = self._failed(f"left no answer: {problem}")
            return
        self._answer = Answer("", self._folder, self._bags, tree, completed,
                              time.monotonic() - self._started)

    def _failed(self, why: str) -> Answer:
        return Answer(f"the diagnosis of {self._bags[0]} {why}", self._folder, self._bags,
                      wall_s=time.monotonic() - self._started)

    def _why(self, status: int) -> str:
        """Return why it ended without an answer, as the end of a sentence."""
        said = self._log.read_text(encoding="utf-8", errors="replace").strip()
        if status in (-signal.SIGXCPU, -signal.SIGKILL):
            return (f"used up its {self._budget.processor_time:g} s of processor time "
                    "(diagnosis.processor_time)" if status == -signal.SIGXCPU else "was killed")
        if any(word in said for word in _NO_MEMORY):
            return (f"ran out of its {self._budget.memory_gigabytes:g} GB of memory "
                    "(diagnosis.memory_gigabytes)")
        last = said.splitlines()[-1] if said else f"exit status {status}"
        return f"failed: {last.removeprefix('eha_monitor: ')}"
