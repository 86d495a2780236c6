"""The trial on other grounds: a published plant, another simulator, strangers' rigs, the triangle.

    python benchmarks/grounds.py mcmaster|simulator|strangers|triangle [--cases N] [--seed S]
        [--work DIR] [--record]

Each is the trial of ``eha-monitor prove`` (sealed key, blind processes, the same marks) on
recordings from elsewhere; what each conceals stands at the head of its file in ``ground_parts``.
The recordings of the simulator are those of ``../shared/data/fluid_power_sim``.
"""

import sys
from pathlib import Path

import record
from ground_parts import Ground
from ground_parts.mcmaster import prove_mcmaster
from ground_parts.simulator import prove_simulator
from ground_parts.strangers import prove_strangers
from ground_parts.triangle import prove_triangle

MEASURED = ("eha_monitor/mismatch", "eha_monitor/estimation", "eha_monitor/physics")
HELD = {"measures": MEASURED, "held_by": "commit"}
# How each is run, what its row says, and how it is recorded.
GROUNDS = {
    "mcmaster": (prove_mcmaster, "the McMaster actuator in its three states",
                 lambda made: record.write("mcmaster_ground", made, **HELD)),
    "simulator": (prove_simulator, "Hopsan: 14 rigs, rich motion, triangle and both together",
                  lambda made: record.write("simulator_ground", made, **HELD)),
    "strangers": (prove_strangers, "strangers' rigs, each recording alone and all together",
                  lambda made: record.write("strangers_ground", made, **HELD)),
    "triangle": (prove_triangle, "the paper's triangle with Coulomb friction, and a second "
                 "recording as advised",
                 lambda made: record.write("triangle_ground", made, **HELD)),
}


def main() -> int:
    """Run the trial on a ground and print what was found."""
    from eha_monitor.commands.common import progress_bar
    from eha_monitor.commands.experiments import summary

    options = record.options(__doc__)
    options.add_argument("ground", choices=sorted(GROUNDS))
    options.add_argument("--cases", type=int, default=0,
                         help="recordings of mcmaster, rigs of the others; 0: the ground's own")
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--work", type=Path, help="by default out/proof/GROUND-seedS")
    options.add_argument("--jobs", type=int, default=0)
    given = options.parse_args()
    run, words, write = GROUNDS[given.ground]
    work = given.work or Path("out", "proof", f"{given.ground}-seed{given.seed}")
    with progress_bar() as told:
        found = run(Ground(work.resolve(), given.seed, given.cases, given.jobs), print, told)
    for row in found["parameters"]:
        print("  ".join(parameter_words(row)))
    for fact in found["facts"]:
        print(fact)
    print(summary(found))
    made = row_of(found, words)
    print(f"{made['what']}: {made['found']}")
    if given.record:
        write({"rows": [made]})
    return 0


def parameter_words(row: dict) -> tuple[str, ...]:
    """Return a parameter as its row shows it: true, found, error, whether that is close enough."""
    from eha_monitor.quantity import quantity, with_uncertainty

    unit = row["unit"]
    said = ("not named" if row["said"] is None else
            with_uncertainty(row["said"], row["stddev"], unit))
    error = "" if row["relative"] is None else f"{row['relative']:.1%} off"
    mark = "" if not row["aim"] or row["within"] else "!"
    return row["group"], row["name"], quantity(row["true"], unit), said, error, mark


def row_of(found: dict, words: str) -> dict[str, str]:
    """Return what was asked of a ground, and what it found."""
    rows, parameters = found["rows"], [one for one in found["parameters"] if one["aim"]]
    right = sum(bool(row["within_class"]) for row in rows)
    close = sum(bool(one["within"]) for one in parameters)
    aim = 100 * max((one["aim"] for one in parameters), default=0.0)
    missed = [row["case"] for row in rows if not row["within_class"]]
    return {"what": words,
            "found": f"{right} of {len(rows)} within class"
                     + (f" (not {', '.join(missed)})" if missed else "")
                     + (f"; {close} of {len(parameters)} parameters within {aim:.0f} %"
                        if parameters else ""),
            "published": ""}


if __name__ == "__main__":
    sys.exit(main())
