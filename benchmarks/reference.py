"""What has changed against healthy recordings, on real actuators: Flo-Tork, two units.

    python benchmarks/reference.py [--data ../shared/data] [--splits 100] [--record]

Unit 5 runs free, unit 1 turns a butterfly valve: dry friction that the free one does not have.
Three quarters of unit 5's strokes, drawn at random for each split, are the healthy recordings; its
other strokes must not be called changed, and each stroke of unit 1 must be, with dry friction
named.  The last lines take the first three quarters in order of time: the unit drifts.
"""

from pathlib import Path

import numpy as np
import record
from rich.progress import track

from eha_monitor.balances.changed import against
from eha_monitor.balances.machine import healthy_machine_of
from eha_monitor.balances.measured import courses_of
from eha_monitor.compiled import load_runtime
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.recordings.importing import read_table
from eha_monitor.settings import load_settings

ROOT = Path(__file__).parents[1]
SHARE = 0.75  # of unit 5's strokes
MEASURES = ("eha_monitor/balances", "eha_monitor/physics")


def main() -> None:
    """Compare, print, and record if asked."""
    options = record.options(__doc__, data=True)
    options.add_argument("--splits", type=int, default=100)
    options.add_argument("--seed", type=int, default=5)
    asked = options.parse_args()
    files = sorted((asked.data / "flo_tork").glob("*.csv.gz"))
    if not files:
        print(f"{asked.data / 'flo_tork'} is not here: nothing measured")
        return
    load_runtime()
    settings = load_settings(ROOT / "config" / "flo_tork.yaml")
    strokes = {file.name: read_table(file, settings) for file in files}
    healthy = [name for name in strokes if name.startswith("unit_5")]
    loaded = [name for name in strokes if name.startswith("unit_1")]
    rng, count = np.random.default_rng(asked.seed), round(SHARE * len(healthy))
    rows = []
    for _ in track(range(asked.splits), "splits", transient=True):
        references = sorted(rng.permutation(healthy)[:count])
        rows.append(tried(strokes, references, [
            name for name in strokes if name not in references], settings))
    false = sum(called for row in rows for name, (called, _) in row.items() if name in healthy)
    free = sum(name in healthy for row in rows for name in row)
    dry = [any(is_dry(name) for name in named) for row in rows for stroke, (_, named)
           in row.items() if stroke in loaded]
    print(f"{asked.splits} splits: {false} of {free} free strokes called changed; dry friction "
          f"named in {sum(dry)} of {len(dry)} strokes with the valve")
    by_time = tried(strokes, healthy[:count], [*healthy[count:], *loaded], settings)
    late = [by_time[name][0] for name in healthy[count:]]
    dry_by_time = [any(map(is_dry, by_time[name][1])) for name in loaded]
    print(f"in order of time: {sum(late)} of {len(late)} later strokes called changed, dry "
          f"friction named in {sum(dry_by_time)} of {len(loaded)}")
    for name in loaded:
        print(f"  {name}: {', '.join(by_time[name][1]) or 'nothing named'}")
    if asked.record:
        record.write("reference", {
            "false": record.spread(false), "free": record.spread(free),
            "dry": record.spread(sum(dry)), "loaded": record.spread(len(dry)),
            "late": record.spread(sum(late)), "of_late": record.spread(len(late)),
            "dry_by_time": record.spread(sum(dry_by_time)),
            "of_time": record.spread(len(loaded))}, MEASURES, held_by="commit")


def tried(strokes: dict, references: list[str], others: list[str], settings
          ) -> dict[str, tuple[bool, list[str]]]:
    """Return of each other stroke whether it is called changed, and what is named."""
    courses = courses_of([strokes[name] for name in references], settings)[1]
    machine, found = healthy_machine_of(courses, settings), {}
    for name in others:
        answer = against(machine, [strokes[name]], settings, tuple(references))
        found[name] = answer.verdict != "consistent", [one.what for one in answer.changes]
    return found


def is_dry(name: str) -> bool:
    """Tell whether an effect is a law of dry friction."""
    return name in CATALOGUE and CATALOGUE[name].family == "dry"


if __name__ == "__main__":
    main()
