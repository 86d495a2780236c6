"""What `diagnose` says of drives whose controller is a computer, by other equations.

    python benchmarks/held_diagnosis.py [--seed S] [--draws N] [--analogue] [--record]

Rigs, motions, rates and sensors of ``hold_parts``; the config knows nothing of what is concealed
nor of the hold.  Each recording is one of

right        all that is concealed is named, or stands as what cannot be told from a name, and
             nothing else; or nothing is there and nothing is named
missed       something is concealed, and nothing is named
unexplained  the answer says so
wrong        a name of what is not there, or one of two

With that: B and beta_e inside two deviations, of all answers that state them.
"""

import time
from collections import Counter

import numpy as np
import record
from hold_parts.draws import Draw, drawn

from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.settings import settings_from_tree

NAMES = {"coulomb": "coulomb_friction", "quadratic": "quadratic_friction",
         "load": "constant_load", "leak": "cross_port_leakage", "dead_zone": "pump_dead_zone",
         "play": "backlash", "swept": "position_dependent_volume"}
KINDS = ("right", "missed", "unexplained", "wrong")
# A controller that reads a late sensor has a late recording and a late feedback.
BESIDE = {"position_delay": {"feedback_delay"}}


def kind_of(draw: Draw, found: Diagnosis) -> str:
    """Return which of ``KINDS`` an answer is."""
    if found.verdict == "unexplained":
        return "unexplained"
    there = {NAMES.get(name, name) for name in draw.extras}
    named = {one.name: {one.name, *one.indistinguishable_from} for one in found.effects}
    if not named and not found.rig_data:
        return "missed" if there else "right"
    allowed = set().union(there, *(BESIDE.get(name, ()) for name in there))
    told = all(any(name in alike for alike in named.values()) for name in there)
    no_other = all(alike & allowed for alike in named.values()) and not found.rig_data
    return "right" if told and no_other else "wrong"


def main() -> None:
    """Print a line for each recording, and the shares."""
    options = record.options(__doc__)
    options.add_argument("--seed", type=int, default=1, help="of the draws")
    options.add_argument("--draws", type=int, default=20, help="recordings")
    options.add_argument("--analogue", action="store_true", help="drives that do not hold")
    given = options.parse_args()
    kinds, inside = Counter(), {"B": [], "beta_e": []}
    for draw in drawn(2 * given.draws, given.seed):
        if draw.digital is given.analogue:
            continue
        settings = settings_from_tree(draw.rig.config(1.0 / draw.rate, draw.noise), draw.name)
        started = time.process_time()
        found = diagnose([draw.recording()], settings)
        kind = kind_of(draw, found)
        kinds[kind] += 1
        for name, true in (("B", draw.rig.damping), ("beta_e", draw.rig.bulk_modulus)):
            if name in found.after and found.verdict != "unexplained":
                one = found.after[name]
                inside[name].append(abs(one.value - true) < 2.0 * one.stddev)
        print(f"{draw.name} {kind:11} {draw.rate:4.0f} Hz {draw.kind:9} "
              f"{', '.join(draw.extras) or '-':28} -> {found.verdict}: "
              f"{', '.join(one.name for one in found.effects) or '-'} "
              f"({time.process_time() - started:.0f} s)", flush=True)
    count = sum(kinds.values())
    figures = {kind: record.spread(100.0 * kinds[kind] / count, "%") for kind in KINDS}
    figures |= {f"{name}_inside": record.spread(100.0 * float(np.mean(values)), "%")
                for name, values in inside.items() if values}
    for name, figure in figures.items():
        print(f"{name:16} {figure['value']:.0f} %")
    if given.record:
        record.write("held_diagnosis", figures, ("eha_monitor/mismatch", "eha_monitor/estimation"))


if __name__ == "__main__":
    main()
