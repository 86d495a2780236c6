"""What ``diagnose`` costs, start included, beside one scipy simulation fit per candidate.

    python benchmarks/diagnosis_speed.py [--runs N] [--candidates K] [--quick] [--lengths S ...]

Wall time, processor time and memory of a process, and how often the filter ran: plain runs, and
passes that carry tangents of many parameters side by side.  The recordings are made of 6 s
stretches of rich motion at 1 kHz (triangles, multisine, steps) with nothing, 40 N of dry friction,
or three effects in them; the longer ones have the dry friction.

The rival search lets the same compiled simulation run free over the whole recording and fits B,
beta_e and the candidate's parameters to all channels by ``scipy.optimize.least_squares``, once for
each entry of the catalogue; it is run on K entries and the rest is extrapolated, which the table
says.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

LENGTHS = (12, 24, 48)  # s
# What is concealed -> effects, and what 24 s of it may take on two cores: s, filter runs.
SETS = {
    "nothing": ((), 5.0, 150),
    "dry friction": ((("coulomb_friction", 1.0),), 5.0, 150),
    "three effects": ((("coulomb_friction", 1.0), ("pump_volumetric_loss", 1.0),
                       ("position_delay", 1.0)), 10.0, 400),
}
ONE = "dry friction"
MOST_RUNS = 60  # simulations with all slopes that a rival fit may take
FIRST = ("coulomb_friction", "quadratic_friction", "added_mass", "cross_port_leakage",
         "pump_dead_zone", "drive_lag", "position_delay", "pressure_offset")


def bag_of(seconds: int, folder: Path, concealed: str = ONE) -> tuple[Path, Path]:
    """Make a recording of some 6 s stretches; returns bag and nominal config."""
    from eha_monitor.concealed.cases import SAMPLE_TIME, Case
    from eha_monitor.concealed.generate import write_case
    from eha_monitor.concealed.motions import LENGTHS as MOTIONS
    from eha_monitor.concealed.motions import demanded_position

    each = MOTIONS["short"]
    t = np.arange(round(each / SAMPLE_TIME)) * SAMPLE_TIME
    demand = np.concatenate([demanded_position("short", t, seed)
                             for seed in range(round(seconds / each))])
    name = f"speed_{seconds}_{concealed.replace(' ', '_')}"
    return write_case(Case(name, SETS[concealed][0], demand=demand, seed=1), folder)


def spent(bag: Path, config: Path) -> tuple[float, float, float]:
    """Return what one ``diagnose`` in a process of its own takes.

    Wall and processor time in s, peak memory in MB.
    """
    started = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "eha_monitor", "diagnose", str(bag), "--config", str(config)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        cwd=Path(__file__).resolve().parent.parent)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{bag}: diagnose ended with status {status}")
    return (time.perf_counter() - started, usage.ru_utime + usage.ru_stime,
            usage.ru_maxrss / 1024.0)


def filter_runs(bag: Path, config: Path) -> tuple[int, int]:
    """Return how often the filter ran, and how many passes carried tangents."""
    from eha_monitor.mismatch.diagnose import diagnose
    from eha_monitor.mismatch.likelihood import fit, tangents
    from eha_monitor.mismatch.name import columns, polish
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings import load_settings

    counts = {"filtered": 0, "along": 0}

    def counting(name, function):
        def counted(*arguments, **options):
            counts[name] += 1
            return function(*arguments, **options)
        return counted

    places = (("filtered", fit.filtered, (fit, columns)),
              ("along", tangents.along, (tangents, columns, polish)))
    for name, function, modules in places:
        for module in modules:
            setattr(module, name, counting(name, function))
    settings = load_settings(config)
    diagnose([read_recording(bag, settings)], settings)
    for name, function, modules in places:
        for module in modules:
            setattr(module, name, function)
    return counts["filtered"], counts["along"]


def measure(runs: int, lengths: tuple[int, ...], folder: Path, table: Table) -> None:
    """Add the rows of what ``diagnose`` costs."""
    for concealed, (_, aim, most) in SETS.items():
        bag, config = bag_of(24, folder, concealed)
        spent(bag, config)  # compiles whatever is not compiled yet
        wall, processor, memory = np.median([spent(bag, config) for _ in range(runs)], axis=0)
        plain, passes = filter_runs(bag, config)
        table.add_row(f"24 s, {concealed} (median of {runs})", f"{wall:.1f}", f"{processor:.1f}",
                      f"{memory:.0f}", f"{plain} + {passes}", f"≤ {aim:g} s, {most} runs")
    table.add_section()
    found: dict[int, float] = {}
    for seconds in lengths:
        bag, config = bag_of(seconds, folder)
        wall, processor, memory = np.median([spent(bag, config) for _ in range(runs)], axis=0)
        found[seconds] = processor
        table.add_row(f"{seconds} s, {ONE} (median of {runs})", f"{wall:.1f}", f"{processor:.1f}",
                      f"{memory:.0f}", "", "")
    if len(found) > 1:
        slope, start = np.polyfit(list(found), list(found.values()), 1)
        bend = max(abs(value - start - slope * seconds) / value
                   for seconds, value in found.items())
        table.add_row(f"start and what does not grow {start:.1f} s of processor, then {slope:.3f} "
                      f"s for each s; off that line by at most {bend:.0%}", "", "", "", "",
                      "linear")


def rival(count: int, folder: Path) -> tuple[list[tuple[str, float, float]], int]:
    """Return (effect, seconds, cost) of simulation fits, and how many the catalogue asks for."""
    from eha_monitor.mismatch.data.experiment import experiment_of
    from eha_monitor.mismatch.name.starts import possible
    from eha_monitor.physics.effects import NAMES
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings import load_settings

    bag, config = bag_of(24, folder)
    settings = load_settings(config)
    experiment = experiment_of([read_recording(bag, settings)], settings)
    every = [name for name in NAMES if possible(name, experiment)]
    order = [*(name for name in FIRST if name in every),
             *(name for name in every if name not in FIRST)]
    simulation_fit(experiment, "constant_load", 2)  # compiles
    found = []
    for name in order[:count]:
        started = time.perf_counter()
        cost = simulation_fit(experiment, name, MOST_RUNS)
        found.append((name, time.perf_counter() - started, cost))
    return found, len(every)


def simulation_fit(experiment, name: str, most: int) -> float:
    """Fit B, beta_e and an effect to the free-running simulation; returns rms error in noises."""
    from scipy.optimize import least_squares

    from eha_monitor.mismatch.likelihood.fit import filtered
    from eha_monitor.mismatch.likelihood.gains import Unknowns, gains_of
    from eha_monitor.mismatch.name.base import base_free, limits_of
    from eha_monitor.mismatch.name.starts import entered, free_of, starts_of

    start = starts_of(name, experiment)[0]
    theta, active = entered(experiment.theta, experiment.active, start)
    free = (*base_free(experiment), *free_of(start))
    gains = gains_of(experiment, theta, active, Unknowns(*limits_of(experiment)[0].as_array()))
    noise = experiment.noise[experiment.columns]

    def residual(point: np.ndarray) -> np.ndarray:
        moved = theta.copy()
        for f, value in zip(free, point, strict=True):
            moved[f.place] = f.outward(value)
        parts = []
        for stretch in experiment.stretches:
            e, _ = filtered(experiment, stretch, moved, active, gains,
                            free=np.ones(len(stretch), dtype=bool))
            parts.append((e[stretch.counted][:, experiment.columns] / noise).ravel())
        return np.clip(np.nan_to_num(np.concatenate(parts), nan=1e6), -1e6, 1e6)

    low = [f.inward(f.lower) if not f.log or f.lower > 0 else -50.0 for f in free]
    high = [f.inward(f.upper) for f in free]
    first = [min(max(f.inward(theta[f.place]), a + 1e-9 * abs(a)), b)
             for f, a, b in zip(free, low, high, strict=True)]
    scale = [1.0 if f.log else max(abs(x), 1e-3 * f.spread)
             for f, x in zip(free, first, strict=True)]
    found = least_squares(residual, first, bounds=(low, high), x_scale=scale, max_nfev=most,
                          diff_step=1e-3)  # scipy's own steps drown in the simulation's rounding
    return float(np.sqrt(2.0 * found.cost / len(found.fun)))


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=3, help="of each length")
    parser.add_argument("--candidates", type=int, default=len(FIRST),
                        help="simulation fits that are run")
    parser.add_argument("--quick", action="store_true", help="24 s only, one run")
    parser.add_argument("--lengths", type=int, nargs="+", default=LENGTHS,
                        help="of the recordings, s; 60 240 960 takes minutes")
    options = parser.parse_args()
    table = Table(title=f"diagnose on {len(os.sched_getaffinity(0))} cores, start included")
    for column in ("", "wall time, s", "processor, s", "memory, MB", "runs + tangent passes",
                   "has to be"):
        table.add_column(column)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        measure(1 if options.quick else options.runs,
                () if options.quick else tuple(options.lengths), folder, table)
        fits, every = rival(options.candidates, folder)
    together = sum(seconds for _, seconds, _ in fits)
    best = min(fits, key=lambda one: one[2])
    table.add_section()
    for name, seconds, cost in fits:
        table.add_row(f"simulation fit of {name}: {cost:.2f} noises left", f"{seconds:.1f}")
    table.add_row(f"simulation fits of the catalogue, one round, {every} of them, on one core; "
                  + ("all run" if len(fits) == every else f"extrapolated from {len(fits)}"),
                  f"{together / len(fits) * every:.0f}")
    Console(width=120).print(table)
    print(f"the simulation fits prefer {best[0]}; concealed is coulomb_friction")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    main()
