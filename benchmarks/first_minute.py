"""The first minute and the first hour in an empty home: seconds and megabytes of each step.

    python3 benchmarks/first_minute.py [--keep DIR] [--no-demo] [--record]

Clone, `make demo` with a `.venv` of its own, then what the README tells: `init`, `import`,
`estimate`, `diagnose`, `diagnose --reference`, `thresholds`, a report.  The stranger's file has
decimal commas, semicolons, rpm and pressures as gauges show them, at 500 Hz, of a single rod on a
slope.  Needs Python and make, as the README does.  The packages come from where pip is told to
look: with PIP_NO_INDEX=1 and PIP_FIND_LINKS=FOLDER from a folder of wheels.  `--record` needs
the packages of `make bench`.
"""

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HEALTHY = 5
DEMO_BEGINS = "1. "


@dataclass(frozen=True)
class Step:
    """What became of one step.

    Attributes
    ----------
    wall, cpu : s, of it and its children.
    added : MB that it left on the disk.
    peak : MB of memory, of its largest process.
    """

    name: str
    status: int
    wall: float
    cpu: float
    added: float
    peak: float
    said: str = ""


class Newcomer:
    """Somebody with an empty home, who types one command after the other."""

    def __init__(self, place: Path):
        self.place, self.home = place, place / "home"
        self.home.mkdir()
        self.clone = self.home / "eha_monitor"
        self.steps: list[Step] = []
        kept = ("PATH", "LANG", "SSL_CERT_FILE", "REQUESTS_CA_BUNDLE")
        self.environment = {
            "HOME": str(self.home), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            **{key: value for key, value in os.environ.items()
               if key in kept or key.startswith("PIP_")}}

    def do(self, name: str, *words: str, cwd: Path | None = None) -> Step:
        """Run one command; its lines are kept in a file."""
        log = self.place / f"{len(self.steps):02}_{name.split()[0]}.log"
        before, started = megabytes(self.home), time.perf_counter()
        with log.open("w") as file:
            process = subprocess.Popen(words, cwd=cwd or self.home, env=self.environment,
                                       stdin=subprocess.DEVNULL, stdout=file, stderr=file)
            _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        lines = log.read_text(errors="replace").strip().splitlines()
        return self._add(Step(
            name, process.returncode, time.perf_counter() - started,
            used.ru_utime + used.ru_stime, megabytes(self.home) - before, used.ru_maxrss / 1e3,
            lines[-1] if process.returncode and lines else ""))

    def demo(self) -> None:
        """Run `make demo`; its set-up ends where its first step begins."""
        before, started = megabytes(self.home), time.perf_counter()
        process = subprocess.Popen(["make", "demo"], cwd=self.clone, env=self.environment,
                                   text=True, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                   stderr=subprocess.STDOUT)
        last, begun = "", None
        with (self.place / "demo.log").open("w") as log:
            for line in process.stdout:
                log.write(line)
                last = line.strip() or last
                if begun is None and line.startswith(DEMO_BEGINS):
                    begun = (time.perf_counter(), megabytes(self.home), waited_for(process.pid))
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        ended, size = time.perf_counter(), megabytes(self.home)
        if begun is None:
            begun = ended, size, used.ru_utime + used.ru_stime
        self._add(Step("make demo: set-up", 0, begun[0] - started, begun[2], begun[1] - before,
                       0.0))
        self._add(Step("make demo: its four steps", process.returncode, ended - begun[0],
                       used.ru_utime + used.ru_stime - begun[2], size - begun[1],
                       used.ru_maxrss / 1e3, last if process.returncode else ""))

    def _add(self, step: Step) -> Step:
        self.steps.append(step)
        print(f"{step.name:32} {step.wall:7.1f} s {step.cpu:7.1f} s cpu {step.added:7.1f} MB "
              f"{step.peak:6.0f} MB{f'  exit {step.status}: {step.said}' if step.status else ''}",
              flush=True)
        return step

    def play(self, demo: bool) -> None:
        """Go through it all."""
        print(f"{'step':32} {'wall':>9} {'processor':>13} {'on disk':>10} {'memory':>9}")
        self.do("git clone", "git", "clone", "--quiet", str(ROOT), str(self.clone))
        if demo:
            self.demo()
        else:
            self.do("make setup", "make", "setup", cwd=self.clone)
        python, eha = (str(self.clone / ".venv" / "bin" / name)
                       for name in ("python", "eha-monitor"))
        files, compiled = self.place / "files", self.place / "compiled.jsonl"
        subprocess.run([python, __file__, "--write", str(files)], check=True,
                       env=self.environment | {"EHA_MONITOR_CACHE": str(self.place / "cache")})
        self.environment["EHA_MONITOR_COMPILED"] = str(compiled)
        answers = (files / "answers.txt").read_text().splitlines()
        told = [word for answer in answers for word in ("--set", answer)]
        self.do("init", eha, "init", str(files / "healthy_0.csv"), "--out", "rig.yaml", "--yes",
                *told)
        healthy = [f"healthy_{k}" for k in range(HEALTHY)]
        for name in (*healthy, "now"):
            self.do(f"import {name}", eha, "import", str(files / f"{name}.csv"), "--map",
                    "rig.yaml", "--out", name)
        self.do("estimate", eha, "estimate", healthy[0], "--config", "rig.yaml", "--report",
                "estimate.html")
        self.do("diagnose", eha, "diagnose", healthy[0], "--config", "rig.yaml",
                "--write-config", "diagnosed.yaml", "--report", "diagnosis.html")
        config = "diagnosed.yaml" if (self.home / "diagnosed.yaml").is_file() else "rig.yaml"
        self.do("diagnose --reference", eha, "diagnose", "now", "--reference", *healthy,
                "--config", config, "--report", "change.html")
        self.do("thresholds", eha, "thresholds", "--from", *healthy, "--config", config,
                "--write-config", "judged.yaml")
        judged = "judged.yaml" if (self.home / "judged.yaml").is_file() else config
        self.do("report of now, judged", eha, "estimate", "now", "--config", judged, "--report",
                "now.html")
        lines = len(compiled.read_text().splitlines()) if compiled.exists() else 0
        print(f"{lines} functions compiled after the set-up")


def megabytes(folder: Path) -> float:
    """Return what a folder takes of the disk."""
    seen, total = set(), 0
    for path in folder.rglob("*"):
        try:
            found = path.lstat()
        except OSError:
            continue  # gone meanwhile
        if (found.st_dev, found.st_ino) not in seen:
            seen.add((found.st_dev, found.st_ino))
            total += found.st_blocks * 512
    return total / 1e6


def waited_for(number: int) -> float:
    """Return the processor time, s, of the children of a process that have ended."""
    fields = Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[13]) + int(fields[14])) / os.sysconf("SC_CLK_TCK")


def write(folder: Path) -> None:
    """Write the stranger's files, and what he answers: run with the clone's packages."""
    from dataclasses import replace
    from math import radians, sin

    from quarter_hour import ATMOSPHERE, EXCEL, SINES, Sheet, excel, rig
    from strangers.plant import recording

    sheet = Sheet(40, 25, 1, 160, 40, 60, 3.1, 15)
    weight = 60 * 9.81 * sin(radians(20))
    folder.mkdir()
    gauge = {"p1": ATMOSPHERE, "p2": ATMOSPHERE}
    for name, seed, damping in (*((f"healthy_{k}", k, 2400) for k in range(HEALTHY)),
                                ("now", 99, 3600)):
        plant = sheet.plant(damping, 8e8, 20000, gas_volume=1e-3, cross_leakage=1.5e-13,
                            makeup=1.5e-13, load=weight)
        made = rig(name, plant, 500, SINES)
        shown = recording(replace(made, sensors=replace(made.sensors, pressure_noise=1e3)), seed)
        excel(folder / f"{name}.csv", {key: shown[key] - gauge.get(key, 0.0)
                                       for key in ("time", *EXCEL)})
    answers = [*sheet.answers(), "machine=two_pumps", "load=gravity", "inclination=20 deg",
               "zero=middle", "pressures=gauge"]
    (folder / "answers.txt").write_text("\n".join(answers) + "\n")


def figures(steps: list[Step]) -> dict[str, dict]:
    """Return what the table of docs/installation.md is made of."""
    import record

    def total(which: str, names: tuple[str, ...]) -> float:
        return sum(getattr(step, which) for step in steps if step.name.startswith(names))

    return {"set_up": record.spread(total("wall", ("make demo: set-up",)), "s"),
            "set_up_cpu": record.spread(total("cpu", ("make demo: set-up",)), "s"),
            "demo": record.spread(total("wall", ("make demo: its",)), "s"),
            "disk": record.spread(total("added", ("git", "make")), "MB"),
            **{name.replace(" --", "_"): record.spread(total("wall", (name,)), "s")
               for name in ("init", "import", "estimate", "diagnose", "thresholds", "report")}}


def main() -> int:
    """Play and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", type=Path, metavar="DIR", help="a new folder, kept")
    parser.add_argument("--no-demo", action="store_true", help="`make setup` in its place")
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--record", action="store_true",
                        help="write what is measured to benchmarks/figures")
    asked = parser.parse_args()
    if asked.write:
        write(asked.write)
        return 0
    if asked.keep:
        asked.keep.mkdir(parents=True)
    place = asked.keep or Path(tempfile.mkdtemp(prefix="first_minute_"))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        newcomer = Newcomer(place.resolve())
        newcomer.play(demo=not asked.no_demo)
    finally:
        if not asked.keep:
            shutil.rmtree(place)
    total = sum(step.added for step in newcomer.steps)
    print(f"{sum(step.wall for step in newcomer.steps):.0f} s, {total:.0f} MB in the home; load "
          f"{os.getloadavg()[0]:.1f} on {len(os.sched_getaffinity(0))} cores")
    if asked.record:
        import record
        record.write("first_minute", figures(newcomer.steps), ("Makefile", "eha_monitor"),
                     held_by="commit")
    return int(any(step.status for step in newcomer.steps))


if __name__ == "__main__":
    sys.exit(main())
