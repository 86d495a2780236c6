"""What is compiled, how often and how long: by the set-up, and after it by each command.

Run as ``python benchmarks/compilations.py``: compiles all into an empty cache, then runs the
commands and prints what they still compile, which is nothing; some minutes.  ``--record`` writes
the time of the set-up to benchmarks/figures.  ``--write`` runs the commands first, with a cache
that is empty, and writes ``eha_monitor/signatures.json`` from what they called: after a change of
what is compiled.
"""

import collections
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import record
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).parents[1]
SIGNATURES = ROOT / "eha_monitor" / "signatures.json"
LIVE = ("simulator", "monitor", "replay")
# Commands on what `grounds` makes.  {k} is a bag there; a config stands beside its bag.
ESTIMATES = {"plain": {"effects": {}}, "euler": {"discretisation": "euler"},
             "sampled": {"command_hold": "sampled"},
             "delayed": {"effects": {"command_delay": {"T": 1e-3}}},
             "rubbing": {"effects": {"coulomb_friction": {"F_c": 10.0}}},
             "lines": {"effects": {"line_dynamics": {"T_l": 1e-3, "zeta": 0.1, "Z": 1e5}}}}
SECONDS = "4"  # of motion: enough for the estimators to converge
# What a diagnosis asks for only where there is something to locate or to show.
SELDOM = """
import sys
from dataclasses import replace
import numpy as np
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.likelihood.along import drive_along, played, smoothed
from eha_monitor.mismatch.locate.location import latent_gains
from eha_monitor.mismatch.name.nominal import nominal
from eha_monitor.physics.contributions import circuit_of
from eha_monitor.recordings.read import read_recording
from eha_monitor.settings import Settings

recording = read_recording(sys.argv[1], Settings())
for names in (("x", "x_d", "omega", "p1", "p2"), ("x", "omega"), ("x", "p1", "p2")):
    part = replace(recording, channels={name: recording.channels[name] for name in names})
    experiment, fit = nominal(experiment_of([part], Settings(), hold_out=True))
    latent_gains(experiment, fit)
    smoothed(experiment, fit)
    stretch = experiment.stretches[0]
    position = np.ascontiguousarray(stretch.z[:, 0])
    drive_along(position, stretch.u, experiment.dt, 1, fit.theta,
                circuit_of(fit.theta, fit.active), np.zeros(len(position)))
    played(position, 1e-6)
"""
# Each kind of config, live: as a monitor that is asked for nothing but its state.
PUSHED = """
import sys
from eha_monitor.live.estimator import LiveEstimator
from eha_monitor.recordings.read import read_recording
from eha_monitor.settings import load_settings

settings = load_settings(sys.argv[2])
recording = read_recording(sys.argv[1], settings)
live = LiveEstimator(settings)
for k in range(0, len(recording), 10):
    live.push_rows(recording.time[k:k + 10], recording.part(k, k + 10).channels)
live.snapshot()
live.rehearse()
"""
# A recording of one sample, which is refused, of the fewest, of positions alone, and a table.
OTHERS = """
import json
import sys
from pathlib import Path
import numpy as np
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import Settings

folder, settings = Path(sys.argv[2]), Settings()
whole = read_recording(sys.argv[1], settings)
for name, samples, channels in (("one", 1, whole.channels), ("short", 600, whole.channels),
                                ("positions", 4000, ("x", "x_d")),
                                ("speeds", 4000, ("x", "omega"))):
    write_recording(folder / name, Recording(
        whole.sample_time, {c: whole.channels[c][:samples] for c in channels}), settings)
n = 3000
rows = np.column_stack([np.arange(n) * whole.sample_time,
                        *(whole.channels[c][:n] for c in ("x", "x_d", "p1", "p2"))])
np.savetxt(folder / "table.csv", rows, delimiter=",", header="t,x,xd,pa,pb", comments="")
(folder / "map.yaml").write_text(json.dumps({"table": {"time": "t", "columns": {
    "x": {"column": "x"}, "x_d": {"column": "xd"}, "p1": {"column": "pa"},
    "p2": {"column": "pb"}}}}))
"""


def commands(folder: Path) -> list[tuple[str, list[list[str]]]]:
    """Return what is run one after the other: a name, and what runs at once; bags come first."""
    eha = [sys.executable, "-m", "eha_monitor"]
    plain, rubbing = str(folder / "plain"), str(folder / "rubbing")
    steps = []
    for name, tree in ESTIMATES.items():
        config = folder / f"{name}.yaml"
        config.write_text(json.dumps(tree))
        steps += [("simulate", [[*eha, "simulate", "--config", str(config), "--duration", SECONDS,
                                 "--out", str(folder / name)]]),
                  ("estimate", [[*eha, "estimate", plain, "--config", str(config), "--json",
                                 str(folder / "answer.json")]]),
                  ("pushed", [[sys.executable, "-c", PUSHED, plain, str(config)]])]
    steps.append(("other recordings", [[sys.executable, "-c", OTHERS, plain, str(folder)]]))
    steps.append(("import", [[*eha, "import", str(folder / "table.csv"), "--map",
                              str(folder / "map.yaml"), "--out", str(folder / "imported")]]))
    steps += [("estimate", [[*eha, "estimate", str(folder / name)]])
              for name in ("one", "short", "positions", "speeds", "imported")]
    many = folder / "many"
    many.mkdir()
    demo, bag = str(ROOT / "config" / "demo.yaml"), str(ROOT / "bags" / "air_ingress")
    for k in range(2):
        steps.append(("simulate", [[*eha, "simulate", "--duration", "3", "--seed", str(k),
                                    "--out", str(many / f"{k}")]]))
    live = ["--duration", "8"]
    # What is live comes first: only what nobody has compiled yet is listed with who called it.
    return [("live", [[*eha, "monitor", "--config", demo, *live],
                      [*eha, "simulator", "--config", demo, *live],
                      [*eha, "record", "--out", str(folder / "recorded"), *live]]),
            ("replay", [[*eha, "replay", bag], [*eha, "monitor", *live]]),
            *steps, ("archive", [[*eha, "estimate", str(many), "--out", str(folder / "table")]]),
            ("diagnose", [[*eha, "diagnose", rubbing, "--report", str(folder / "d.html")]]),
            ("diagnose", [[*eha, "diagnose", str(folder / "positions")]]),
            ("seldom", [[sys.executable, "-c", SELDOM, plain]]),
            ("advise", [[*eha, "advise", plain]]),
            ("prove", [[*eha, "prove", "--cases", "1", "--jobs", "1", "--work",
                        str(folder / "proof")]])]


def run(name: str, together: list[list[str]], environment: dict[str, str]) -> float:
    """Run what belongs to one step; returns its wall time, s."""
    started = time.perf_counter()
    processes = [subprocess.Popen(one, env=environment, stdout=subprocess.DEVNULL,
                                  stderr=subprocess.PIPE, text=True) for one in together]
    for one, process in zip(together, processes, strict=True):
        _, told = process.communicate()
        # Refused in one line is an answer too.
        if process.returncode not in (0, 1, 2) or "Traceback (most recent" in told:
            raise RuntimeError(f"{name}: {' '.join(one[2:])[:200]}\n{told}")
        if process.returncode == 2:
            print(f"{name}: {told.strip().splitlines()[-1]}", flush=True)
    return time.perf_counter() - started


def lines_of(file: Path) -> list[list]:
    """Return what was compiled: depth, module, function, seconds, types, command."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def write_signatures(lines: list[list]) -> None:
    """Write the list of what is compiled for a call from Python, the longest first."""
    seconds: dict[tuple[str, str, str], float] = {}
    live = set()
    for depth, module, name, took, types, command in lines:
        if depth == 0 and (module or "").startswith("eha_monitor."):
            one = (module.removeprefix("eha_monitor."), name, types)
            seconds[one] = max(took, seconds.get(one, 0.0))
            if command[1:2] and command[1] in LIVE:
                live.add(one[:2])
    ordered = [one for one, _ in sorted(seconds.items(), key=lambda item: (-item[1], item[0]))]
    made = {"live": sorted(live), "signatures": ordered}
    SIGNATURES.write_text("{\n" + ",\n".join(f' "{key}": [\n' + ",\n".join(
        f"  {json.dumps(one)}" for one in rows) + "\n ]" for key, rows in made.items()) + "\n}\n")


def show(title: str, lines: list[list], most: int) -> None:
    """Print how often and how long each function was compiled."""
    table = Table(title=title)
    for column in ("function", "signatures", "seconds with what it calls"):
        table.add_column(column, justify="left" if column == "function" else "right")
    kept = collections.defaultdict(list)
    for _, module, name, took, *_ in lines:
        kept[f"{module}.{name}"].append(took)
    for name, took in sorted(kept.items(), key=lambda item: -sum(item[1]))[:most]:
        table.add_row(name, str(len(took)), f"{sum(took):.1f}")
    ours = [line for line in lines if (line[1] or "").startswith("eha_monitor.")]
    table.caption = (f"{len(lines)} compilations, {len(ours)} of functions of ours; "
                     f"{sum(line[3] for line in lines if line[0] == 0):.0f} s of processor")
    Console().print(table)


def main() -> None:
    """Compile, run, print."""
    parser = record.options(__doc__)
    parser.add_argument("--write", action="store_true", help="eha_monitor/signatures.json")
    parser.add_argument("--most", type=int, default=25, help="functions in the table")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder, file = Path(scratch), Path(scratch) / "compiled.jsonl"
        environment = os.environ | {
            "EHA_MONITOR_CACHE": str(folder / "cache"), "EHA_MONITOR_COMPILED": str(file),
            "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        if not asked.write:
            took = run("set-up", [[sys.executable, "-m", "eha_monitor.compile_all"]], environment)
            spent = resource.getrusage(resource.RUSAGE_CHILDREN)
            show(f"the set-up, {took:.0f} s", lines_of(file), asked.most)
        before = at_set_up = len(lines_of(file))
        table = Table("command", "s", "compiled", title="after the set-up")
        for name, together in commands(folder):
            ran = run(name, together, environment)
            lines = lines_of(file)
            table.add_row(name, f"{ran:.1f}", str(len(lines) - before))
            for line in lines[before:] if not asked.write else ():
                print(name, line[:3], line[4])
            before = len(lines)
        Console().print(table)
        if asked.record and not asked.write:
            record.write("set_up", {
                "wall": record.spread(took, "s"), "late": record.spread(before - at_set_up),
                "processor": record.spread(spent.ru_utime + spent.ru_stime, "s")},
                ("eha_monitor",), held_by="commit")
        if asked.write:
            write_signatures(lines_of(file))
            print(f"{SIGNATURES.relative_to(ROOT)} is written")
        elif late := before - at_set_up:
            sys.exit(f"{late} functions are compiled after the set-up: {SIGNATURES.name} lacks "
                     "them; --write makes it")


if __name__ == "__main__":
    main()
