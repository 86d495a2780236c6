"""What halving and doubling each constant of the naming does to its answers.

    python benchmarks/constants.py [--cases N] [--seed S] [--jobs J]

Concealed draws are searched once; the sets that were refitted are then weighed anew with each
constant of ``name/acceptance.py`` at half and at twice its value.  Counted are the answers that
change, and how many of them become right or wrong: an answer is right if every name in it, or one
of its rivals, was concealed, and if what is outside the catalogue is ``unexplained``.  What is
searched stays as it is.
"""

import argparse
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from rich.console import Console
from rich.progress import track
from rich.table import Table

FACTORS = {"halved": 0.5, "doubled": 2.0}
AS_IT_IS = ("", 1.0)


def constants() -> dict[str, float]:
    """Return the constants that weigh what was searched."""
    from eha_monitor.mismatch.name import acceptance

    return {name: value for name, value in vars(acceptance).items() if name.isupper()}


def set_everywhere(name: str, value: float) -> None:
    """Set a constant in each module that has it."""
    from eha_monitor.mismatch.name import acceptance

    for module in list(sys.modules.values()):
        if getattr(module, "__name__", "").startswith("eha_monitor.mismatch") and (
                module is acceptance or hasattr(module, name)):
            setattr(module, name, value)


def answers_of(job: tuple[int, int]) -> dict[tuple[str, float], tuple[frozenset[str], bool]]:
    """Return (constant, factor) -> what is said of a case, and whether it is right."""
    import eha_monitor.mismatch.diagnose
    from eha_monitor.concealed.cases import truth_of
    from eha_monitor.concealed.generate import write_case
    from eha_monitor.mismatch.data.experiment import experiment_of
    from eha_monitor.mismatch.name.naming import naming_of
    from eha_monitor.mismatch.name.refit import settled
    from eha_monitor.mismatch.name.select import selected
    from eha_monitor.prove.draws import cases_of
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings import load_settings

    assert eha_monitor.mismatch.diagnose  # every room is loaded, and its constants can be set
    place, seed = job
    case = cases_of("mixed", place + 1, seed)[place]
    with tempfile.TemporaryDirectory() as folder:
        bag, config = write_case(case, Path(folder))
        settings = load_settings(config)
        experiment = experiment_of([read_recording(bag, settings)], settings)
    found = selected(experiment)
    before = settled(found.experiment, found.nominal)
    truth, answers = truth_of(case), {}
    for name, factor in (AS_IT_IS, *((name, factor) for name in constants()
                                     for factor in FACTORS.values())):
        value = constants().get(name, 0.0)
        if name:
            set_everywhere(name, factor * value)
        answers[name, factor] = said(naming_of(found.experiment, found, before), truth)
        if name:
            set_everywhere(name, value)
    return answers


def said(naming, truth: dict) -> tuple[frozenset[str], bool]:
    """Return what a naming says, and whether it is right."""
    hidden = {one["name"] for one in truth["effects"]} | {
        one["key"] for one in truth["rig_off"]}
    outside = any(not one["in_catalogue"] for one in truth["effects"])
    if naming.unexplained > 0.5:
        return frozenset({"unexplained"}), outside
    names = {name.removeprefix("rig."): naming.rivals.get(name, ())
             for name, probability in naming.probability.items() if probability > 0.5}
    return frozenset(names), not outside and all(
        {name, *rivals} & hidden for name, rivals in names.items())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        jobs = [(place, options.seed) for place in range(options.cases)]
        found = list(track(pool.map(answers_of, jobs), "searching", len(jobs)))
    table = Table(title=f"{sum(one[AS_IT_IS][1] for one in found)} of {len(found)} answers name "
                        "nothing wrong; with one constant changed")
    for head in ("constant", "value", *(f"{how}: answers that change, become right, wrong"
                                        for how in FACTORS)):
        table.add_column(head)
    for name, value in constants().items():
        cells = []
        for factor in FACTORS.values():
            pairs = [(one[AS_IT_IS], one[name, factor]) for one in found]
            better = sum(now[1] and not was[1] for was, now in pairs)
            worse = sum(was[1] and not now[1] for was, now in pairs)
            cells.append(f"{sum(was[0] != now[0] for was, now in pairs)}, {better}, {worse}")
        table.add_row(name, f"{value:g}", *cells)
    Console().print(table)


if __name__ == "__main__":
    main()
