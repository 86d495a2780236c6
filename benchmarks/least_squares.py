"""B, beta_e and C_T on strangers' rigs: by the two stages, and as the alarms judge them.

    python benchmarks/least_squares.py [--rigs 24] [--seed 16001] [--record]

Rigs by equations that are not the package's (``benchmarks/strangers``: friction of six laws, drive
lags, digital holds, wrong data sheets), each recorded under several settings and estimated with
the config that ``init`` would draft of its data sheet.  Counted is how far the value of the stages
is from the truth wherever it is ``converged``, and how far what is judged (least squares where the
model does not fit) wherever it is determined; of the leakage where least squares know it and no
joint filter does.  They are compared in what the config's areas and volumes make of them: a volume
that is 10 % off moves beta_e by 10 %.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import eha_monitor  # noqa: F401, I001  before numpy
import numpy as np
import record
from rich.console import Console
from rich.table import Table

from strangers.draw import draw_rig
from strangers.generate import leakage_of_both, record as recorded, truth_of
from eha_monitor.errors import InputError
from eha_monitor.estimation.pipeline import estimate

MEASURES = ("eha_monitor/balances", "eha_monitor/estimation", "benchmarks/least_squares.py")
SETTINGS = 3
NEAR = {"B": 0.05, "beta_e": 0.15, "leakage": 0.15}


def rig_errors(seed: int, place: int) -> list[tuple[str, str, float, float]]:
    """Return (parameter, by whom, relative error, error in deviations) of a rig's recordings."""
    rig, found = draw_rig(seed, place), []
    for setting in rig.settings[:SETTINGS]:
        recording, settings = recorded(rig, setting, 1)
        try:
            answer = estimate(recording, settings)
        except InputError:
            continue
        truth = truth_of(rig, setting)
        off = {one["key"]: one["configured"] / one["true"] for one in truth["rig_off"]}
        true = {"B": truth["B"] * off["area_1"], "beta_e": truth["beta_e"] * off["volume_1"]}
        judged = {name: one for name, one in answer.parameters.items()
                  if name not in answer.doubted}
        if answer.leakage is not None:
            judged["leakage"], true["leakage"] = answer.leakage, leakage_of_both(rig)
        for who, values in (("stages", answer.by_stages), ("judged", judged)):
            found += [(name, who, one.value / true[name] - 1.0,
                       (one.value - true[name]) / one.stddev)
                      for name, one in values.items() if one.status == "converged"]
    return found


def main() -> int:
    """Print, and record, what both get right."""
    options = record.options(__doc__)
    options.add_argument("--rigs", type=int, default=24)
    options.add_argument("--seed", type=int, default=16001)
    options.add_argument("--jobs", type=int, default=2)
    asked = options.parse_args()
    with ProcessPoolExecutor(asked.jobs) as pool:
        rows = [row for rows in pool.map(rig_errors, [asked.seed] * asked.rigs,
                                         range(asked.rigs)) for row in rows]
    figures = {"recordings": record.spread(asked.rigs * SETTINGS)}
    table = Table("", "determined", "near", "median error", "largest error", "inside ± 2")
    for name, near in NEAR.items():
        for who in ("stages", "judged"):
            errors = np.array([row[2:] for row in rows if row[:2] == (name, who)]).reshape(-1, 2)
            if not len(errors):  # no stage has a leakage
                continue
            size = np.abs(errors[:, 0])
            shares = {"near": 100 * np.mean(size < near), "median": 100 * np.median(size),
                      "worst": 100 * size.max(), "inside": 100 * np.mean(
                          np.abs(errors[:, 1]) < 2.0)}
            figures[f"{name}_{who}_n"] = record.spread(len(size))
            figures |= {f"{name}_{who}_{key}": record.spread(value, "%")
                        for key, value in shares.items()}
            table.add_row(f"{name}, {who}", f"{len(size)} of {asked.rigs * SETTINGS}",
                          f"{shares['near']:.0f} % within {100 * near:.0f} %",
                          f"{shares['median']:.1f} %", f"{shares['worst']:.0f} %",
                          f"{shares['inside']:.0f} %")
    Console(width=120).print(table)
    if asked.record:
        record.write("least_squares", figures, MEASURES, held_by="commit")
    return 0


if __name__ == "__main__":
    sys.exit(main())
