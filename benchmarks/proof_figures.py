"""The figures of a sealed trial, from the result that `prove --json` wrote.

    eha-monitor prove --cases 200 --seed 4242 --oracle --json trial.json
    python benchmarks/proof_figures.py trial.json --record

The table says at which commit the answers were given; a result of other source is refused, so run
this where the trial was run.
"""

import json
import statistics
import sys
from pathlib import Path

import record

MEASURED = ("eha_monitor/mismatch", "eha_monitor/estimation", "eha_monitor/physics")
STRENGTHS = ("1", "0.3", "0.05")


def main() -> int:
    """Print the rows of a result, and record them if asked; 2 where the result is another's."""
    from eha_monitor.prove.trial import source_digest

    options = record.options(__doc__)
    options.add_argument("result", type=Path, help="what `prove --json` wrote")
    given = options.parse_args()
    found = json.loads(given.result.read_text(encoding="utf-8"))
    outside = {row["kind"] for row in found["rows"]} == {"outside"}
    rows_of, write = ROWS["outside" if outside else "draws"]
    rows = rows_of(found)
    for row in rows:
        print("  ".join(filter(None, row.values())))
    if given.record:
        if set(found["sources"]) != {source_digest()}:
            print(f"{given.result}: expected answers of this very source of the program; run the "
                  "trial again, or this in the checkout that ran it", file=sys.stderr)
            return 2
        write({"rows": rows})
    return 0


def trial_rows(found: dict) -> list[dict]:
    """Return mark, value and aim of a trial with an oracle."""
    score, rows = found["score"], found["rows"]

    def within(chosen: list[dict]) -> str:
        return f"{sum(bool(row['within_class']) for row in chosen)} of {len(chosen)}"

    def percent(name: str) -> str:
        return "–" if score.get(name) is None else f"{100 * score[name]:.1f} %"

    shown = [row for row in rows if row["detectable"] and row["kind"] != "outside"]
    kinds = {kind: [row for row in shown if row["kind"] == kind] for kind in ("pair", "triple")}
    outside = [row for row in rows if row["kind"] == "outside" and row["detectable"]]
    sensor = [row for row in rows if row["sensor_or_timing"]]
    clean = [row for row in rows if row["kind"] == "null"]
    strong = found["by_strength"]
    seconds = [row["seconds"] for row in rows]
    return [
        mark(f"right names, or within their declared class, all {len(rows)} recordings of seed "
             f"{found['seed']}", percent("within_class")),
        mark("the same, where the oracle has 20 log units",
             f"{percent('detectable_within_class')} of {len(shown)}",
             "95 %"),
        mark(f"single effects at strengths about {', '.join(STRENGTHS)}, with that oracle",
             ", ".join(f"{round(one['detectable'] * (one['detectable_within_class'] or 0.0))} of "
                       f"{one['detectable']}" for one in map(strong.get, STRENGTHS) if one),
             "99, 98, 90 %"),
        mark("pairs; triples, with that oracle", "; ".join(map(within, kinds.values())),
             "95, 85 %"),
        mark("what has no name: `unexplained` in the right place; a wrong name",
             f"{within(outside)}; {sum(row['confident_wrong'] for row in outside)} of "
             f"{len(outside)}", "92, 2 %"),
        mark("the right balance", percent("located"), "99 %"),
        mark("a sensor or a delay blamed on the plant",
             f"{sum(row['sensor_blamed'] for row in sensor)} of {len(sensor)}", "none"),
        mark("numbers of the rig beyond tolerance found; one within tolerance named",
             f"{percent('rig_found')}; {percent('rig_false_name')}", "95, 1 %"),
        mark("false alarm on a clean recording",
             f"{sum(row['verdict'] != 'consistent' for row in clean)} of {len(clean)}", "0.5 %"),
        mark("calibration error of the probabilities", percent("calibration_error"), "5 %"),
        mark("held-out error removed, of what can be removed", percent("held_out_error_removed"),
             "90 %"),
        mark("named parameters within 5 %; of these, where ±2σ allows it",
             f"{percent('named_parameters_within_5_percent')}; "
             f"{percent('told_parameters_within_5_percent')}", "95 %"),
        mark("B and βe within 2 %; inside ±2σ", f"{percent('base_parameters_within_2_percent')}; "
             f"{percent('parameters_inside_2_sigma')}", "98; 92–98 %"),
        mark("seconds for an answer on one core: median, mean, longest",
             ", ".join(f"{one:.3g}" for one in (
                 statistics.median(seconds), statistics.mean(seconds), max(seconds))),
             "5 to 10 on two cores"),
    ]


def outside_rows(found: dict) -> list[dict]:
    """Return how each kind without a name fared in a trial of these alone, and all together."""
    kinds: dict[str, list[dict]] = {}
    for row in found["rows"]:
        kinds.setdefault(row["truth"][0], []).append(row)
    groups = [*sorted(kinds.items()), (f"all {len(found['rows'])} of seed {found['seed']}",
                                       found["rows"])]
    return [{"kind": kind.replace("_", " "), "cases": str(len(rows)),
             "placed": str(sum(bool(row["within_class"]) for row in rows)),
             "wrong": str(sum(row["confident_wrong"] for row in rows)),
             "told": str(sum(row["learned"]["told"] for row in rows)),
             "removed": f"{100 * statistics.median(row['learned']['removed'] for row in rows):.0f}"
                        " %",
             "shape": str(sum(bool(row["learned"]["shape"]) for row in rows))}
            for kind, rows in groups]


def mark(words: str, value: str, aim: str = "") -> dict[str, str]:
    """Return a row of a trial's table."""
    return {"mark": words, "value": value, "aim": aim}


HELD = {"measures": MEASURED, "held_by": "commit"}
ROWS = {
    "outside": (outside_rows, lambda made: record.write("outside", made, **HELD)),
    "draws": (trial_rows, lambda made: record.write("proof", made, **HELD)),
}


if __name__ == "__main__":
    sys.exit(main())
