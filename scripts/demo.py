"""``make demo``: live, replayed, recorded, diagnosed; each step checked for what it shows."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import click
from watch import Seen, watch

from eha_monitor.errors import InputError
from eha_monitor.health.alarms import NOT_JUDGED

ROOT = Path(__file__).resolve().parents[1]
NAMESPACE = "/eha"
BOTH_ALARMS = frozenset({"viscous_damping_high", "bulk_modulus_low"})
START_SECONDS = 180.0  # at most, until the first estimate: a busy machine starts ROS slowly
LIVE_SECONDS, REPLAY_SECONDS = 40.0, 40.0  # at most after it; over when the alarms have come
_COLOURS = {"WARN": "yellow", "ERROR": "red", "OK": "green", NOT_JUDGED: "cyan"}
_GRACE = 5.0  # s that a child has to end by itself


class DemoFailed(Exception):
    """A step did not show what it should; the message is one line."""


class Children:
    """Child processes of one step; all of them are ended with it, by their ids."""

    def __init__(self, logs: Path):
        self._logs = logs
        self._running: dict[str, subprocess.Popen] = {}

    def __enter__(self) -> "Children":
        return self

    def __exit__(self, *_) -> None:
        for ask in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            for child in self._running.values():
                if child.poll() is None:
                    child.send_signal(ask)
            end = time.monotonic() + _GRACE
            for child in self._running.values():
                try:
                    child.wait(max(0.0, end - time.monotonic()))
                except subprocess.TimeoutExpired:
                    continue  # the next signal is stronger
            if all(child.poll() is not None for child in self._running.values()):
                return

    def start(self, *arguments: str) -> None:
        """Start ``eha_monitor <arguments>`` with this very Python; it writes to a log."""
        self._start(arguments[0], "-m", "eha_monitor", *arguments)

    def compile(self) -> None:
        """Start to compile what is missing, behind the others.

        Not far behind: with nice 19 it waited for half an hour where other programs were at work.
        """
        self._start("compile", "-c", "import os, sys; from eha_monitor.compile_all import main; "
                    "os.nice(5); sys.exit(main())", "--ship")

    def _start(self, name: str, *words: str) -> None:
        with (self._logs / f"{name}.log").open("w") as log:
            self._running[name] = subprocess.Popen([sys.executable, *words], stdout=log,
                                                   stderr=log, stdin=subprocess.DEVNULL)

    def ended(self, name: str) -> bool:
        """Tell whether a child has ended."""
        return self._running[name].poll() is not None

    def finish(self) -> None:
        """Wait until all have ended by themselves; raise DemoFailed if one did so badly."""
        if any(child.poll() is None for child in self._running.values()):
            print("   The rest of the model is still being compiled, once (half a minute to some "
                  "minutes) ...", flush=True)
        for child in self._running.values():
            child.wait()
        self.check()

    def check(self) -> None:
        """Raise DemoFailed if a child has ended badly."""
        for name, child in self._running.items():
            if child.poll():
                raise DemoFailed(f"{name} ended with status {child.returncode}: "
                                 f"{_last_line(self._logs / f'{name}.log')}")


def _last_line(path: Path) -> str:
    lines = path.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "it printed nothing"


def watched(children: Children, seconds: float, alarms: frozenset[str]) -> None:
    """Show what the monitor publishes until ``alarms`` are raised; else raise DemoFailed.

    The ``seconds`` that the alarms have begin with the first estimate, however long the
    processes take to start.
    """
    ends = math.inf

    def say(line: str, level: str | None) -> None:
        click.secho(f"  {line}", fg=_COLOURS.get(level), bold=level is not None)

    def finished(seen: Seen) -> bool:
        nonlocal ends
        children.check()
        if seen.estimates and ends == math.inf:
            ends = time.monotonic() + seconds
        return alarms <= seen.raised or time.monotonic() > ends

    seen = watch(NAMESPACE, START_SECONDS + seconds, say, finished)
    children.check()
    if seen.losses:
        click.secho(f"  {seen.losses}", fg="yellow")
    for symbol in ("B", "beta_e"):
        if not seen.estimates.get(symbol):
            raise DemoFailed(f"the monitor published no estimate of {symbol}")
    if missing := sorted(alarms - seen.raised):
        raise DemoFailed(f"expected the alarm {missing[0]} within {seconds:g} s, it did not come")


def awaited(children: Children) -> None:
    """Wait until the monitor is there."""
    def finished(seen: Seen) -> bool:
        children.check()
        return seen.heard

    if not watch(NAMESPACE, START_SECONDS, lambda line, level: None, finished).heard:
        raise DemoFailed(f"the monitor was not there after {START_SECONDS:g} s")


def run(*arguments: str) -> None:
    """Run one command to its end."""
    done = subprocess.run([sys.executable, "-m", "eha_monitor", *arguments], text=True,
                          check=False)
    if done.returncode:
        raise DemoFailed(f"{arguments[0]} ended with status {done.returncode}")


def compiled(beside: Children) -> None:
    """Compile what the live steps need, and start to compile the rest; nothing on a later run."""
    from eha_monitor.compiled import FIRST_RUN, PLACES

    if FIRST_RUN and subprocess.run([sys.executable, "-m", "eha_monitor.compile_all", "--live"],
                                    check=False).returncode:
        raise DemoFailed("the model could not be compiled")
    if not PLACES[-1].exists():  # made when all is compiled
        beside.compile()


def live(logs: Path) -> None:
    """Run the real simulator and the real monitor; B rises, then air enters."""
    print("1. Simulator and monitor, live.  10 s after the simulator's start B rises\n"
          "   from 600 to 1300 N·s/m, after 18 s air enters the oil.  The times are since the\n"
          "   monitor's first sample, which comes a few seconds later.", flush=True)
    with Children(logs) as children:
        config = str(ROOT / "config/demo.yaml")
        children.start("monitor", "--config", config)
        children.start("simulator", "--config", config)
        watched(children, LIVE_SECONDS, BOTH_ALARMS)


def replayed(logs: Path) -> None:
    """Replay the bundled bag through another monitor, as fast as it was recorded."""
    print("2. The bundled bag air_ingress through a monitor, at its own rate; the times are the\n"
          "   bag's.  Air enters the oil from 8 s on.", flush=True)
    with Children(logs) as children:
        children.start("monitor")
        awaited(children)  # else the bag begins without it
        children.start("replay", str(ROOT / "bags/air_ingress"))
        watched(children, REPLAY_SECONDS, frozenset({"bulk_modulus_low"}))


def reported(out: Path) -> Path:
    """Estimate from the bundled bag at once, and write the report."""
    print("3. The same bag at once, with a report.", flush=True)
    report, answer = out / "report.html", out / "report.json"
    run("estimate", str(ROOT / "bags/air_ingress"), "--report", str(report), "--json", str(answer))
    found = json.loads(answer.read_text())["parameters"]
    if any(found[name]["status"] != "converged" for name in ("B", "beta_e")):
        raise DemoFailed(f"estimate did not converge: {found}")
    return report.resolve()


def diagnosed(out: Path) -> Path:
    """Ask of a bag that hides dry friction what the model leaves out, and write the report."""
    print("4. Another bag, hidden_friction: B alone would look like wear.", flush=True)
    report, answer = out / "diagnosis.html", out / "diagnosis.json"
    run("diagnose", str(ROOT / "bags/hidden_friction"), "--report", str(report), "--json",
        str(answer))
    found = json.loads(answer.read_text())
    names = {name for effect in found["effects"]
             for name in (effect["name"], *effect["indistinguishable_from"])}
    if found["verdict"] != "mismatch" or "coulomb_friction" not in names:
        raise DemoFailed(f"expected coulomb_friction, got {found['verdict']}: "
                         f"{', '.join(sorted(names)) or 'nothing'}")
    return report.resolve()


def play(name: str, logs: Path, steps: Callable[[], str]) -> int:
    """Play steps, which return their last words; returns the exit status.

    They have a graph of their own on this machine: nobody else's topics, and ours in nobody's
    way.
    """
    started = time.monotonic()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(10 + os.getpid() % 90)
    for number in (signal.SIGINT, signal.SIGTERM):
        # SystemExit runs every `finally` and, unlike KeyboardInterrupt, no spin() keeps it.
        signal.signal(number, lambda number, _: sys.exit(128 + number))
    try:
        logs.mkdir(parents=True, exist_ok=True)
        os.environ.setdefault("ROS_LOG_DIR", str(logs.resolve()))
        said = steps()
    except (DemoFailed, InputError, OSError) as problem:
        print(f"{name} failed: {problem} (logs in {logs})", file=sys.stderr)
        return 1
    print(f"Done in {time.monotonic() - started:.0f} s.{said}")
    return 0


def main() -> int:
    """Run the four steps; returns the exit status."""
    out = Path("out")
    logs = out / "demo"

    def steps() -> str:
        with Children(logs) as beside:
            compiled(beside)
            live(logs)
            replayed(logs)
            beside.finish()
        report = reported(out)
        return f"  Reports: {report}\n{'':24}{diagnosed(out)}"

    return play("demo", logs, steps)


if __name__ == "__main__":
    sys.exit(main())
