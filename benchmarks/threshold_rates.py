"""Whether the false-alarm rates that `thresholds` states hold.

    python benchmarks/threshold_rates.py [--recordings 240] [--draws 20000] [--record]

First by drawing extremes alone, normal and lognormal, from 2 to 30 healthy recordings.  Then with
everything: recordings of machines whose B and beta_e differ as healthy ones do, simulated with
sensor noise, estimated, limits proposed from some of them, and the alarms' own judge run over the
others.  The stated rates are 5 % and 0.5 % there, so that there is something to count.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import eha_monitor  # noqa: F401, I001  before numpy
import numpy as np
import record
from rich.console import Console
from rich.table import Table

from eha_monitor.api.estimate import series_of
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.health.proposal import Healthy, healthy_of, proposed, thresholds_tree
from eha_monitor.health.alarms import judge_series
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import settings_from_tree

MEASURES = ("eha_monitor/health", "eha_monitor/estimation", "benchmarks/threshold_rates.py")
RATE, LEAST, SECONDS = 0.05, 0.0, 6.0
SPREADS = {"normal, 5 %": (False, 0.05), "normal, 20 %": (False, 0.2),
           "lognormal, 20 %": (True, 0.2)}
COUNTS = (2, 3, 5, 10, 30)


def by_draws(count: int, log: bool, spread: float, draws: int, rng) -> tuple[float, float]:
    """Return the share of new recordings below a low WARN limit, and above a high one."""
    below = above = 0
    for _ in range(draws):
        logs = rng.normal(0.0, spread, count + 1)
        values = np.exp(logs) if log else np.maximum(1.0 + logs, 1e-3)
        healthy = [Healthy("", v, 1e-4 * v, v, v) for v in values[:-1]]
        limits = {one.key: one.value for one in proposed("B", healthy, RATE, LEAST).limits}
        below += values[-1] < limits["low_warn"]
        above += values[-1] > limits["high_warn"]
    return below / draws, above / draws


def made_of(seed: int):
    """Simulate and estimate one healthy machine; return what a threshold is made of."""
    rng = np.random.default_rng([seed, 5])
    settings = settings_from_tree({
        "rig": {"viscous_damping": float(600 * np.exp(rng.normal(0, 0.06))),
                "bulk_modulus": float(6e8 * np.exp(rng.normal(0, 0.04)))},
        "simulation": {"excitation": {"a": {"kind": "multisine", "duration": SECONDS,
                                            "amplitude": 0.01, "frequency": 0.5,
                                            "frequency_end": 10.0, "seed": seed}}}}, "healthy")
    step = settings.rig.sample_time
    seen = Simulator(settings, seed).advance(round(SECONDS / step))
    recording = Recording(step, {name: np.asarray(values) for name, values in seen.items()})
    # The rig's nominal B and beta_e are nobody's knowledge.
    plain = settings_from_tree({}, "plain")
    series = series_of(estimate(recording, plain))
    healthy = {symbol: healthy_of(str(seed), symbol, recording.time, series[symbol], plain)
               for symbol in series}
    # What tells where it converged is no value that another process could be given.
    return healthy, recording.time, {symbol: replace(
        one, converged=one.converged(one.value, one.stddev)) for symbol, one in series.items()}


def everything(seeds: list[int], groups: int, count: int, jobs: int, rng) -> dict[str, float]:
    """Return the share of alarms that other healthy recordings raise, by alarm and level."""
    with ProcessPoolExecutor(jobs) as pool:
        made = list(pool.map(made_of, seeds, chunksize=4))
    raised = dict.fromkeys(("B low", "B high", "βe low"), 0)
    errors = dict(raised)
    asked = 0
    for _ in range(groups):
        order = rng.permutation(len(made))
        chosen, others = order[:count], order[count:count + 20]
        tree = thresholds_tree([proposed(symbol, [made[k][0][symbol] for k in chosen], RATE, LEAST)
                                for symbol in ("B", "beta_e")])
        settings = settings_from_tree({"thresholds": tree}, "proposed")
        for k in others:
            asked += 1
            levels = _levels(*made[k][1:], settings)
            for name, level in levels.items():
                raised[name] += level >= 1
                errors[name] += level >= 2
    return {f"{name} WARN": value / asked for name, value in raised.items()} | {
        f"{name} ERROR": value / asked for name, value in errors.items()}


def _levels(time: np.ndarray, series: dict, settings) -> dict[str, int]:
    """Return 0, 1 or 2 for each alarm: the highest level that the alarms' judge ever gave."""
    _, history = judge_series(settings, time, series)
    found = {"B low": 0, "B high": 0, "βe low": 0}
    names = {"viscous_damping_low": "B low", "viscous_damping_high": "B high",
             "bulk_modulus_low": "βe low"}
    for alarm in history:
        if alarm.name in names and alarm.raised:
            level = 1 + (alarm.level == "ERROR")
            found[names[alarm.name]] = max(found[names[alarm.name]], level)
    return found


def main() -> int:
    """Run it and print its tables."""
    parser = record.options(__doc__)
    parser.add_argument("--recordings", type=int, default=240)
    parser.add_argument("--groups", type=int, default=300)
    parser.add_argument("--draws", type=int, default=20_000)
    parser.add_argument("--jobs", type=int, default=1)
    asked = parser.parse_args()
    rng = np.random.default_rng(1)
    figures, console = {}, Console(width=120)
    table = Table("healthy recordings", *SPREADS, title=f"stated {RATE:.0%} on each side; "
                  "low, high")
    for count in COUNTS:
        row = []
        for place, (log, spread) in enumerate(SPREADS.values()):
            low, high = by_draws(count, log, spread, asked.draws, rng)
            row.append(f"{low:.2%}, {high:.2%}")
            figures[f"draws_{count}_{place}_low"] = record.spread(100 * low, "%")
            figures[f"draws_{count}_{place}_high"] = record.spread(100 * high, "%")
        table.add_row(str(count), *row)
    console.print(table)
    if asked.recordings:
        seeds = list(range(asked.recordings))
        table = Table("from 5 healthy recordings", "stated", "raised in others",
                      title="simulated, estimated, judged")
        for name, share in everything(seeds, asked.groups, 5, asked.jobs, rng).items():
            stated = RATE * (0.1 if "ERROR" in name else 1.0)
            table.add_row(name, f"{stated:.1%}", f"{share:.2%}")
            figures[name.replace(" ", "_").replace("βe", "beta")] = record.spread(
                100 * share, "%")
        console.print(table)
    if asked.record:
        record.write("threshold_rates", figures, MEASURES, held_by="commit")
    return 0


if __name__ == "__main__":
    sys.exit(main())
