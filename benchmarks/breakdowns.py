"""Valid recordings of strangers' rigs that end in exit 2 or 70: there must be none.

    python benchmarks/breakdowns.py [--rigs 100] [--seed 1] [--seconds 6] [--tasks estimate ...]

Each rig (single rods, gravity, 500 Hz, digital hold, 12 bits, gauge pressures, play) is recorded
once more than healthy recordings are needed, and each task is run on it: `estimate`, `diagnose`,
`together` (all recordings explained as one machine) and `reference` (`diagnose --reference`).
One line for each that broke down, and the counts.  The exit status is 1 if any did.
"""

import argparse
import json
import sys
import time
import traceback
from collections import Counter

from eha_monitor.api.read import checked
from eha_monitor.concealed.strangers.draw import KINDS, StrangerRig, draw_rig
from eha_monitor.concealed.strangers.generate import recorded, settings_of
from eha_monitor.errors import InputError
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.mismatch.compare.compared import compared
from eha_monitor.mismatch.diagnose import diagnose

TASKS = ("estimate", "diagnose", "together", "reference")
REFERENCES = 5


def run(task: str, rig: StrangerRig, seconds: float) -> str:
    """Run a task on short recordings of a rig; returns its verdict or the status of B.

    Raises
    ------
    Exception
        Whatever breaks down.
    """
    settings = settings_of(rig)
    count = {"together": 3, "reference": REFERENCES + 1}.get(task, 1)
    recordings = [recorded(rig, rig.settings[k % len(rig.settings)], k, seconds)
                  for k in range(count)]
    checked(recordings, settings)
    if task == "estimate":
        return estimate(recordings[0], settings).parameters["B"].status
    if task == "reference":
        return compared(recordings[:1], recordings[1:], settings).verdict
    return diagnose(recordings, settings).verdict


def ended(task: str, rig: StrangerRig, seconds: float) -> dict:
    """Return how a task ended: ``status`` as the command's, ``said``, ``where`` it broke down."""
    begun = time.process_time()
    try:
        found = {"status": 0, "said": run(task, rig, seconds)}
    except InputError as problem:
        found = {"status": 2, "said": str(problem), "where": _where(problem.__cause__ or problem)}
    except Exception as problem:  # noqa: BLE001 - whatever it is, it is counted
        found = {"status": 70, "said": repr(problem), "where": _where(problem)}
    return {"task": task, "rig": rig.name, "kind": rig.kind, "law": rig.law, **found,
            "cpu_s": round(time.process_time() - begun, 1)}


def _where(problem: BaseException) -> list[str]:
    return [f"{frame.filename.rpartition('eha_monitor/')[2]}:{frame.lineno}"
            for frame in traceback.extract_tb(problem.__traceback__)][-6:]


def main() -> int:
    """Sweep and count; 1 if anything broke down."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--rigs", type=int, default=100)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--seconds", type=float, default=6.0)
    options.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    options.add_argument("--kind", choices=KINDS)
    options.add_argument("--json", help="a line for each is added to this file")
    given = options.parse_args()
    rows = []
    for i in range(given.rigs):
        rig = draw_rig(given.seed, i, given.kind)
        for task in given.tasks:
            row = ended(task, rig, given.seconds)
            rows.append(row)
            if row["status"]:
                print(json.dumps(row), flush=True)
            if given.json:
                with open(given.json, "a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
    for task in given.tasks:
        mine = [row for row in rows if row["task"] == task]
        cost = sorted(row["cpu_s"] for row in mine)
        print(f"{task}: {sum(row['status'] != 0 for row in mine)} of {len(mine)} broke down; "
              f"{cost[len(cost) // 2]:.1f} s of processor in the median, {cost[-1]:.1f} at most; "
              f"{dict(Counter(row['said'] for row in mine if not row['status']))}")
    return int(any(row["status"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
