"""A fleet: many bags of a minute through `estimate` and `diagnose` on a local Dask cluster.

    python benchmarks/fleet.py --bags 1000 --diagnosed 60 [--record] [--folder DIR]

A scheduler and one worker of one thread for each core are processes of this machine; the commands
are those that a user gives, ``estimate FOLDER --scheduler ADDRESS``.  Bags are copies of a few
simulated ones, each with times of its own, so that none is taken for one that was answered.  Given
are bags an hour and core, and the hours that 1 000 bags take on this machine and, on paper, on a
hundred such cores; the share of a second worker shows what handing over costs.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import record

DIFFERENT = 8  # bags that are simulated
FLEET, CLUSTER = 1000, 100  # bags, and cores on paper
MEASURES = ("eha_monitor/archive", "eha_monitor/recordings", "eha_monitor/estimation",
            "eha_monitor/mismatch")
COMMANDS = ("estimate", "diagnose")


def main() -> None:
    """Measure, print, and record if asked."""
    options = record.options(__doc__)
    options.add_argument("--bags", type=int, default=FLEET, help="through estimate")
    options.add_argument("--diagnosed", type=int, default=60, help="of these through diagnose")
    options.add_argument("--folder", type=Path, help="of the bags; 8 MB each")
    given = options.parse_args()
    figures, cores = {}, len(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory(dir=given.folder, prefix="fleet_") as place:
        bags = Path(place) / "bags"
        models = simulated(Path(place))
        for name, count in zip(COMMANDS, (given.bags, given.diagnosed), strict=True):
            folder = bags / name
            copies(models, count, folder)
            for workers in dict.fromkeys((1, cores)):
                asked = count if workers == cores else max(count // (5 * cores), cores)
                few = folder if asked == count else copies(models, asked, bags / f"few_{name}")
                seconds = with_cluster(workers, name, few, Path(place) / f"out_{name}_{workers}")
                rate = 3600.0 * asked / seconds / workers
                print(f"{name:9s} {asked:5d} bags of a minute on {workers} worker"
                      f"{'s' if workers > 1 else ''}: {seconds:7.1f} s, {rate:6.0f} bags an hour "
                      "and core", flush=True)
                key = "alone" if workers == 1 else "each"
                figures[f"{name}_{key}"] = record.spread(rate, "bags an hour and core")
            hours = FLEET / figures[f"{name}_each"]["value"]
            print(f"{name:9s} {FLEET} bags: {hours / cores:.2f} h here, "
                  f"{60 * hours / CLUSTER:.1f} min on {CLUSTER} such cores", flush=True)
            figures[f"{name}_bags"] = record.spread(count)
            figures[f"{name}_here"] = record.spread(hours / cores, "h")
            figures[f"{name}_cluster"] = record.spread(60.0 * hours / CLUSTER, "min")
            shutil.rmtree(folder)
    if given.record:
        record.write("fleet", figures, MEASURES, held_by="commit")


def simulated(place: Path) -> list[Path]:
    """Return a few bags of a minute."""
    bags = [place / f"model_{seed}" for seed in range(DIFFERENT)]
    for seed, bag in enumerate(bags):
        run("simulate", "--out", bag, "--duration", "60", "--seed", str(seed))
    return bags


def copies(models: list[Path], count: int, folder: Path) -> Path:
    """Return a new folder with so many bags, copies of these in turn."""
    for k in range(count):
        shutil.copytree(models[k % len(models)], folder / f"unit_{k:04d}",
                        copy_function=shutil.copyfile)
    return folder


def with_cluster(workers: int, command: str, folder: Path, out: Path) -> float:
    """Return the seconds that a command takes for a folder on a cluster of its own."""
    port = free_port()
    address = f"tcp://127.0.0.1:{port}"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    env = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(record.ROOT)}
    cores = sorted(os.sched_getaffinity(0))
    started = [subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_scheduler", "--host",
                                 "127.0.0.1", "--port", str(port), "--no-dashboard"],
                                env=env, **quiet)]
    try:
        for k in range(workers):
            started.append(subprocess.Popen(
                [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1",
                 "--no-dashboard", "--local-directory", str(out.parent / f"worker_{k}")],
                env=env, **quiet, preexec_fn=lambda k=k: os.sched_setaffinity(
                    0, {cores[k % len(cores)]})))
        ready(address, workers)
        began = time.monotonic()
        run(command, folder, "--scheduler", address, "--out", out)
        return time.monotonic() - began
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait()


def ready(address: str, workers: int) -> None:
    """Wait until a cluster has its workers, and each has what it computes with."""
    from distributed import Client

    for _ in range(60):
        try:
            with Client(address, timeout=2) as client:
                client.wait_for_workers(workers, timeout=60)
                client.run(loaded)
            return
        except OSError:
            continue
    raise SystemExit(f"{address}: no scheduler answers")


def loaded() -> str:
    """Import what the commands need, on a worker."""
    import eha_monitor.archive.run  # noqa: F401

    return "loaded"


def free_port() -> int:
    """Return a port of this machine that nobody listens on."""
    import socket

    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def run(*words: object) -> None:
    """Run a command of the package; ends this benchmark where it fails."""
    done = subprocess.run([sys.executable, "-m", "eha_monitor", *map(str, words)], text=True,
                          capture_output=True)
    if done.returncode or "could not be answered" in done.stdout:
        raise SystemExit(f"{' '.join(map(str, words))}: {done.stdout[-500:]}{done.stderr[-500:]}")


if __name__ == "__main__":
    main()
