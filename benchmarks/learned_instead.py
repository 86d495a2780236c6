"""Real recordings with dry friction taken out of the catalogue, and what is learned in its place.

    python benchmarks/learned_instead.py [--data ../shared/data] [--record]

Each recording is diagnosed with the whole catalogue and without the laws of dry friction (HSM150
turns one way, where a constant load does the same: without that, too).  Printed: how much of the
squared error of the force balance on unseen data each takes away, their ratio (asked: 0.9), and
the formula that was learned.
"""

from pathlib import Path

import numpy as np
import record
from real_diagnosis import HSM, SEALS
from rich.console import Console
from rich.table import Table

from eha_monitor.compiled import load_runtime
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.recordings.importing import read_table
from eha_monitor.settings import load_settings

ROOT = Path(__file__).parents[1]
DRY = tuple(name for name, entry in CATALOGUE.items() if entry.family == "dry")
ALSO = {"hsm150": ("constant_load",)}
RECORDS = {"emps": ("emps/DATA_EMPS.mat",), "hsm150": HSM,
           "pneumatic_seals": (SEALS[0], SEALS[-1]),
           "ivliev_eha": ("ivliev_eha/exp_data_1_2.csv", "ivliev_eha/extra_2024_10_14_5.csv")}
ASKED = 0.9
MEASURES = ("eha_monitor/mismatch", "eha_monitor/physics")


def main() -> None:
    """Diagnose, print, and record if asked."""
    asked = record.options(__doc__, data=True).parse_args()
    load_runtime()
    table, figures, ratios = Table("recording", "named", "learned", "ratio", "as"), {}, []
    for rig, files in RECORDS.items():
        settings = load_settings(ROOT / "config" / f"{rig}.yaml")
        for file in files:
            if not (asked.data / file).exists():
                print(f"{asked.data / file} is not here")
                continue
            recording = read_table(asked.data / file, settings)
            named = diagnose([recording], settings)
            learned = diagnose([recording], settings, without=DRY + ALSO.get(rig, ()))
            one, other = removed(named), removed(learned)
            ratio = other / one if one > 0.0 else float("nan")
            ratios.append(ratio)
            shown = "; ".join(term.formula or f"a curve of {', '.join(term.of)}"
                              for term in learned.learned) or ", ".join(
                effect.name for effect in learned.effects) or learned.verdict
            table.add_row(Path(file).stem, f"{one:.3f}", f"{other:.3f}", f"{ratio:.2f}", shown)
            figures[Path(file).stem] = record.spread(ratio) | {"as": shown}
    Console(width=160).print(table)
    good = sum(ratio >= ASKED for ratio in ratios)
    print(f"{good} of {len(ratios)} reach {ASKED}; median {np.median(ratios):.2f}")
    if asked.record:
        record.write("learned_instead", figures | {
            "good": record.spread(good), "of": record.spread(len(ratios)),
            "median": record.spread(float(np.median(ratios)))}, MEASURES, held_by="commit")


def removed(found: Diagnosis) -> float:
    """Return the share of the force's squared error beyond the noise that is gone, <= 1."""
    fit = found.signals["force"]
    noise = np.nan_to_num(fit.noise_rms) ** 2
    before, after = (max(rms**2 - noise, 0.0) for rms in (fit.before_rms, fit.after_rms))
    return 1.0 - after / before


if __name__ == "__main__":
    main()
