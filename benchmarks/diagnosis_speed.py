"""What ``diagnose`` costs, start included.

    python benchmarks/diagnosis_speed.py [--draws N] [--seed S]

N concealed draws of each kind in :data:`KINDS`, 24 s each on drawn rigs whose configs are exact,
within their tolerances or off in one number: seconds of processor of a process that reads and
diagnoses, median and worst of each kind, with the filter's runs and what was named, beside how
many plain filterpy steps the same processor takes in a second before, between and after.  Longer
recordings: ``long_recordings.py``.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import record
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from eha_monitor.mismatch.diagnosis import Diagnosis

# Kind of draw -> (concealed effects: of which ``dry`` is a law of dry friction; recordings).
KINDS = {
    "clean": ((), 1),
    "one effect": (("any",), 1),
    "dry friction": (("dry",), 1),
    "dry friction beside another": (("dry", "any"), 1),
    "outside the catalogue": (("outside",), 1),
    "two recordings": (("dry", "any"), 2),
}
MEDIAN, WORST = 10.0, 30.0  # s of processor that a draw may take


def filter_runs(bags: list[Path], config: Path) -> tuple[int, "Diagnosis"]:
    """Return how often the filter ran, and the answer."""
    from eha_monitor.mismatch.diagnose import diagnose
    from eha_monitor.mismatch.likelihood import fit
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings import load_settings

    runs, innovate = 0, fit.innovate

    def counted(*arguments):
        nonlocal runs
        runs += 1
        innovate(*arguments)

    fit.innovate = counted
    settings = load_settings(config)
    found = diagnose([read_recording(bag, settings) for bag in bags], settings)
    fit.innovate = innovate
    return runs, found


def draw(kind: str, i: int, seed: int, folder: Path) -> tuple[list[Path], Path, str]:
    """Make the i-th draw of a kind; returns bags, nominal config and what is concealed."""
    from dataclasses import replace

    from eha_monitor.concealed.cases import Case, effect_names, outside_names
    from eha_monitor.concealed.draws import FAMILIES, draw_rig, misconfigured
    from eha_monitor.concealed.generate import write_case

    rng = np.random.default_rng([seed, list(KINDS).index(kind), i])
    dry = FAMILIES[0]
    pools = {"dry": dry, "any": [name for name in effect_names() if name not in dry],
             "outside": outside_names()}
    wanted, recordings = KINDS[kind]
    effects = tuple((str(rng.choice(pools[pool])), round(float(np.exp(rng.uniform(
        np.log(0.2), np.log(1.2)))), 3)) for pool in wanted)
    case = Case(f"{kind}_{i}".replace(" ", "_"), effects, seed=int(rng.integers(2**31)),
                rig={} if rng.random() < 0.3 else draw_rig(rng))
    (case,) = misconfigured([case], seed + i)
    bags, config = [], folder
    for k in range(recordings):
        bag, config = write_case(replace(case, name=f"{case.name}_{k}", seed=case.seed + k,
                                         motion="rich" if k == 0 else "triangle"), folder)
        bags.append(bag)
    return bags, config, ", ".join(f"{name} {size:g}" for name, size in effects) or "nothing"


def draws_table(count: int, seed: int) -> Table:
    """Diagnose draws of every kind, each in a process of its own."""
    table = Table(title=f"diagnose on concealed draws, seed {seed}")
    for column in ("concealed", "answer", "processor, s", "runs of the filter", "has to be"):
        table.add_column(column)
    rates, every = [1.0 / record.plain_filterpy_cost(4)], []
    with tempfile.TemporaryDirectory() as name:
        for kind in KINDS:
            spans = []
            for i in range(count):
                bags, config, concealed = draw(kind, i, seed, Path(name))
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                made = subprocess.run(
                    [sys.executable, __file__, "--one", str(config), *map(str, bags)],
                    capture_output=True, text=True, check=True).stdout
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
                spans.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
                one = json.loads(made.splitlines()[-1])
                table.add_row(concealed, one["answer"], f"{spans[-1]:.1f}",
                              str(one["runs"]), "")
            rates.append(1.0 / record.plain_filterpy_cost(4))
            every += spans
            table.add_row(f"[bold]{kind}", "median, worst",
                          f"{np.median(spans):.1f}, {max(spans):.1f}", "", "", end_section=True)
    table.add_row("[bold]all", "median, worst", f"{np.median(every):.1f}, {max(every):.1f}", "",
                  f"≤ {MEDIAN:g}, ≤ {WORST:g}", end_section=True)
    table.add_row("plain filterpy steps in a second of processor", "median, slowest",
                  f"{np.median(rates):.0f}, {min(rates):.0f}", "", "")
    return table


def one_draw(config: Path, bags: list[Path]) -> None:
    """Diagnose recordings and print what was named and what it took."""
    runs, found = filter_runs(bags, config)
    names = [effect.name for effect in found.effects] + [one.key for one in found.rig_data]
    print(json.dumps({"runs": runs,
                      "answer": ": ".join(filter(None, (found.verdict, ", ".join(names))))}))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=1, help="of each kind")
    parser.add_argument("--seed", type=int, default=1, help="of the draws")
    parser.add_argument("--one", nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        one_draw(Path(options.one[0]), [Path(bag) for bag in options.one[1:]])
        return
    Console(width=120).print(draws_table(options.draws, options.seed))


if __name__ == "__main__":
    main()
