"""The trial of the hold: does the recording tell it, and does nothing pay for it.

    python benchmarks/command_hold.py [draws] [seed]

Rigs with areas, volumes, masses and gains of their own, 250 Hz to 2 kHz, triangles, sines and
multisines, with all channels or few; a controller that is analogue, or a computer that reads the
noisy sensor once in a sample; nothing beyond the linear model, or one or two of dry and quadratic
friction, load, leakage, dead zone, play, lag, late command, feedback or sensor, moving volumes.
"""

import sys
import time
from collections import Counter

import numpy as np
from hold_parts.draws import Draw, drawn
from rich.console import Console
from rich.table import Table

from eha_monitor.estimation.hold_choice import resolved
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.settings import settings_from_tree

DRAWS, SEED = 100, 7
FAR = 3.0  # standard deviations


def asked(draw: Draw) -> dict:
    """Return what becomes of one draw; None where the plant itself ran away."""
    recording = draw.recording()
    x = recording.channels["x"]
    if not np.isfinite(x).all() or np.abs(x).max() > 0.2:
        return {}
    settings = settings_from_tree(draw.rig.config(1.0 / draw.rate, draw.noise), draw.name)
    started = time.process_time()
    _, decision = resolved([recording], settings)
    spent = time.process_time() - started
    found = estimate(recording, settings)
    beta = found.parameters["beta_e"]
    far = (beta.status == "converged"
           and abs(beta.value - draw.rig.bulk_modulus) > FAR * beta.stddev)
    # Behind a lag the shaft turns between the samples: its measured speed is not held.
    held = draw.digital and not (decision.channel == "omega" and "drive_lag" in draw.extras)
    told = ("cannot tell" if not decision.decided else
            "right" if (decision.hold == "sampled") == held else "wrong")
    return {"draw": draw, "told": told, "evidence": decision.evidence, "spent": spent,
            "far": far, "silent": far and found.model.status != "mismatch",
            "converged": beta.status == "converged"}


def main() -> None:
    """Print how many holds are told rightly, and every answer that is confidently wrong."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else DRAWS
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else SEED
    rows = [row for draw in drawn(count, seed) if (row := asked(draw))]
    console = Console()
    table = Table("recordings", "right", "cannot tell", "wrong",
                  "converged", "beyond 3 sigma", "and no mismatch", box=None)
    groups = {"nothing beyond the model": lambda d: not d.extras,
              "fast enough": lambda d: not d.extras and d.kind != "slow",
              "other physics": lambda d: bool(d.extras), "all": lambda d: True}
    for name, belongs in groups.items():
        mine = [row for row in rows if belongs(row["draw"])]
        told = Counter(row["told"] for row in mine)
        table.add_row(f"{name} ({len(mine)})", *(str(told[one]) for one in (
            "right", "cannot tell", "wrong")), *(str(sum(row[key] for row in mine)) for key in (
                "converged", "far", "silent")))
    console.print(table)
    for row in rows:
        if row["told"] == "wrong" or row["silent"]:
            draw = row["draw"]
            console.print(f"{draw.name}: {draw.kind} at {draw.rate:.0f} Hz, "
                          f"{'digital' if draw.digital else 'analogue'}, "
                          f"{', '.join(draw.extras) or 'nothing else'}, "
                          f"{' '.join(draw.channels)}: {row['told']} by {row['evidence']:.0f} "
                          f"log units{'; converged off, no mismatch' if row['silent'] else ''}")
    spent = sorted(row["spent"] for row in rows)
    console.print(f"processor for the question: median {1e3 * spent[len(spent) // 2]:.0f} ms, "
                  f"90 % {1e3 * spent[int(0.9 * len(spent))]:.0f} ms")


if __name__ == "__main__":
    main()
