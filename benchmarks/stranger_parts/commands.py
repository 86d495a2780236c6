"""The project's commands as a stranger runs them, with their time; and their answers."""

import contextlib
import io
import json
import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Ran:
    """One command that has ended, or was ended.

    Attributes
    ----------
    status : exit status; None if the time was over.
    cpu : s of processor, of it and its children.
    """

    status: int | None
    out: str
    err: str
    wall: float
    cpu: float


def shell(*arguments: str, timeout: float = 600.0) -> Ran:
    """Run ``eha-monitor`` in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(
        [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])}
    before, started = _children(), time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "eha_monitor", *arguments], text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, env=environment, start_new_session=True)
    try:
        out, err = process.communicate(timeout=timeout)
        status = process.returncode
    except subprocess.TimeoutExpired:
        # Its own session: its workers end with it.
        for sign in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, sign)
            try:
                out, err = process.communicate(timeout=10)
                break
            except subprocess.TimeoutExpired:
                continue
        status = None
    return Ran(status, out, err, time.perf_counter() - started, _children() - before)


def here(*arguments: str) -> Ran:
    """Run the same command within this process: the same entry, without the start of Python."""
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    from eha_monitor.cli import main

    out, err = io.StringIO(), io.StringIO()
    started, cpu = time.perf_counter(), time.process_time()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(list(arguments))
    return Ran(status, out.getvalue(), err.getvalue(), time.perf_counter() - started,
               time.process_time() - cpu)


def _children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@dataclass(frozen=True)
class Answer:
    """What a command answered: the JSON's parts that a score needs, and what it said.

    Attributes
    ----------
    parameters : B and beta_e -> {value, stddev, status}, or empty.
    findings : entries of the JSON's ``channels``, as in the contract.
    lines : of the terminal's error stream.
    """

    status: int | None
    parameters: dict = field(default_factory=dict)
    model: str = ""
    verdict: str = ""
    findings: tuple[dict, ...] = ()
    lines: tuple[str, ...] = ()
    tree: dict = field(default_factory=dict, repr=False)

    def said(self) -> str:
        """Return the first finding, or the first line of the error stream."""
        for text in (*(str(f.get("finding", f)) for f in self.findings), *self.lines):
            return text
        return ""


def answer_of(ran: Ran, file: Path) -> Answer:
    """Return the answer of ``estimate`` or ``diagnose``; ``file`` may be missing."""
    tree = {}
    if file.is_file():
        tree = json.loads(file.read_text(encoding="utf-8"))
    channels = tree.get("channels")
    findings = tuple(f for f in channels if isinstance(f, dict)) if isinstance(
        channels, list) else ()
    parameters = tree.get("parameters", {})
    parameters = parameters.get("after") or parameters.get("before") or parameters
    return Answer(ran.status, parameters, tree.get("model", {}).get("status", ""),
                  tree.get("verdict", ""), findings,
                  tuple(line.strip() for line in ran.err.splitlines() if line.strip()), tree)


def off(parameter: dict | None, truth: float | None) -> bool:
    """Tell whether a stated number lies beyond three of its deviations, and 2 %, of the truth."""
    if not parameter or truth is None or parameter.get("value") is None:
        return False
    error = abs(parameter["value"] - truth)
    return error > 3.0 * (parameter.get("stddev") or 0.0) and error > 0.02 * abs(truth)


def converged_off(answer: Answer, truth: dict[str, float | None]) -> list[str]:
    """Return the parameters that are ``converged`` and wrong."""
    return [name for name in ("B", "beta_e")
            if answer.parameters.get(name, {}).get("status") == "converged"
            and off(answer.parameters[name], truth.get(name))]


def shown(parameter: dict | None) -> str:
    """Return a parameter as the tables print it."""
    if not parameter or parameter.get("value") is None:
        return (parameter or {}).get("status", "–")
    value, spread, factor = parameter["value"], parameter.get("stddev") or 0.0, 1.0
    if abs(value) >= 1e6:
        factor = 1e-6
    text = f"{value * factor:.5g} ± {spread * factor:.2g}" + (" M" if factor < 1 else "")
    status = parameter.get("status")
    return text if status in (None, "converged") else f"{text} ({status})"
