"""EMPS: a model named on the first part of the record, running free over the rest and the whole.

    python benchmarks/emps_free_run.py [--data ../shared/data] [--last 5] [--record]

The model is named and fitted on the record less its last seconds.  It then gets the measured force
alone, from the measured position and velocity at the start, over the last seconds that no fit has
seen, and over the whole.  Printed beside the errors that others published for the benchmark's own
test record, which is not here (Janot, Gautier, Brunot 2019; nonlinearbenchmark.org): those models
were fitted to this whole record and run over another of the same motion.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import record

from eha_monitor.compiled import load_runtime
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.data.inputs import cut
from eha_monitor.mismatch.likelihood.fit import Fit, free_run
from eha_monitor.mismatch.name.naming import name_effects
from eha_monitor.mismatch.name.select import begun
from eha_monitor.physics.signals import M
from eha_monitor.recordings.importing import read_table
from eha_monitor.settings import load_settings

ROOT = Path(__file__).parents[1]
# Root mean square in mm over the test record.
PUBLISHED = {"neural network": 2.64, "linear": 6.56, "Coulomb friction": 4.69,
             "friction by direction": 8.28}
AIM = 2.0
MEASURES = ("eha_monitor/mismatch", "eha_monitor/physics")


def main() -> None:
    """Fit, run, print, and record if asked."""
    options = record.options(__doc__, data=True)
    options.add_argument("--last", type=float, default=5.0, help="s that no fit sees")
    asked = options.parse_args()
    file = asked.data / "emps" / "DATA_EMPS.mat"
    if not file.exists():
        print(f"{file} is not here: nothing measured")
        return
    load_runtime()
    settings = load_settings(ROOT / "config" / "emps.yaml")
    whole = experiment_of([read_table(file, settings)], settings, hold_out=False)
    (stretch,) = whole.stretches
    split = len(stretch) - round(asked.last / whole.dt)
    seen, unseen = (cut(stretch, *span, whole.dt)
                    for span in ((0, split), (split, len(stretch))))
    naming = name_effects(begun(whole.only((seen,))))
    fit = naming.after
    print(f"named on the first {split * whole.dt:.1f} s: {', '.join(fit.named) or 'nothing'}; "
          + ", ".join(f"{f.name} {fit.value(f.name):.5g}" for f in fit.free)
          + f", mass {fit.theta[M]:.5g} kg")
    figures = {}
    for name, part in (("last", unseen), ("whole", stretch)):
        for model, fitted in (("linear", naming.before), ("named", fit)):
            error = free_error(whole, part, fitted)
            rms, most = (1e3 * value for value in (np.sqrt(np.mean(error**2)),
                                                   np.abs(error).max()))
            figures[f"{name}_{model}"] = record.spread(rms, "mm")
            print(f"{name:6s} {len(part) * whole.dt:5.1f} s  {model:7s} free run: "
                  f"{rms:7.3f} mm rms, {most:7.3f} mm at most")
    print("published, on the test record: " + ", ".join(
        f"{name} {value} mm" for name, value in PUBLISHED.items()) + f"; aim {AIM} mm")
    if asked.record:
        record.write("emps_free_run", figures, MEASURES, held_by="commit")


def free_error(experiment, part, fit: Fit) -> np.ndarray:
    """Return the position's error in a free run over a stretch, (n,) m."""
    error = part.z[:, 0] - free_run(experiment, replace(part, loose=None), fit)[:, 0]
    return error[np.isfinite(error)]


if __name__ == "__main__":
    main()
