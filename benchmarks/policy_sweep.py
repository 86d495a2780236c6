"""Which names move when a number of the search's policy does, or one of its numerics.

    python benchmarks/policy_sweep.py --work DIR [--weighed C001 ...] [--searched C003 ...]
        [--numerics] [--record]

Concealed draws (seed 7001, as in ``answers.py``).  Those ``weighed`` are searched once, and the
sets that were refitted are weighed anew with each number of ``SearchPolicy`` at 2/3 and at 3/2 of
its value.  Those ``searched`` are diagnosed from the first fit on with each number, and with
``--numerics`` also with each of the constants that bound the search.  Verdict and names are
compared; a change counts as better or worse by what was concealed.  What was found of a draw is
kept in ``--work``, so that a sweep can be stopped and goes on.
"""

import importlib
import json
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path

import record

SEED, DRAWS = 7001, 24
FACTORS = (2.0 / 3.0, 1.5)
WEIGHED = tuple(f"c{number:03d}" for number in (1, 2, 4, 5, 9, 13, 15, 16, 17, 21))
SEARCHED = ("c008", "c003")
WEIGHS = ("effect", "rare", "temper", "form", "law", "rival", "likely", "few", "share")
PACKAGE = "eha_monitor.mismatch"
NUMERICS = (  # room, constants: how much is searched, and how finely
    ("name.proposals", "HANDFUL"), ("name.proposals", "MOST_OF"), ("name.proposals", "PROMISING"),
    ("name.posterior", "PURSUED"), ("name.rank", "BEAM"), ("name.columns", "TANGENT"),
    ("name.columns", "FAR_OFF"), ("name.refit", "COARSER"), ("name.select", "CATCHING_UP"),
    ("name.finalists", "WITHIN_REACH"), ("name.neighbours", "CLOSE"), ("name.nominal", "LEANING"),
    ("name.select", "SKETCH"), ("name.unnamed", "HATS"))


Answers = dict[tuple[str, float], tuple[tuple[str, ...], bool]]


def answers_of(job: tuple[str, int, Path]) -> Answers:
    """Return (number, factor) -> names of a draw, and whether none is wrong."""
    name, anew, work = job
    kept = work / f"{name}_{anew}.json"
    if not kept.exists():
        found = answered(name, anew)
        kept.write_text(json.dumps([[*key, *value] for key, value in found.items()]))
    return {(number, factor): (tuple(names), good)
            for number, factor, names, good in json.loads(kept.read_text())}


def answered(name: str, anew: int) -> Answers:
    """Return the answers of a draw that is ``anew`` 0 weighed, 1 searched, 2 with numerics."""
    from eha_monitor.concealed.cases import truth_of
    from eha_monitor.concealed.draws import draw_cases
    from eha_monitor.concealed.generate import write_case
    from eha_monitor.mismatch.data.experiment import experiment_of
    from eha_monitor.mismatch.policy import POLICY
    from eha_monitor.recordings.read import read_recording
    from eha_monitor.settings import load_settings

    case = next(case for case in draw_cases(DRAWS, SEED) if case.name == name)
    with tempfile.TemporaryDirectory() as folder:
        bag, config = write_case(case, Path(folder))
        settings = load_settings(config)
        recording = read_recording(bag, settings)
    experiment = experiment_of([recording], settings)
    said = diagnosed_with(recording, experiment) if anew else weighed_with(experiment)
    truth = truth_of(case)
    cases = {("", 1.0): POLICY} | {
        (number, factor): replace(POLICY, **{number: factor * value})
        for number, value in asdict(POLICY).items() for factor in FACTORS}
    found = {key: said(policy) for key, policy in cases.items()}
    for room, constant in NUMERICS if anew == 2 else ():
        module = importlib.import_module(f"{PACKAGE}.{room}")
        value = getattr(module, constant)
        for factor in FACTORS:
            setattr(module, constant, type(value)(min(factor * value, most(constant))))
            found[f"{room.partition('.')[2]}.{constant}", factor] = said(POLICY)
        setattr(module, constant, value)
    return {key: (names, right(names, rivals, truth)) for key, (names, rivals) in found.items()}


def most(constant: str) -> float:
    """Return how large a constant may be: shares stay below one."""
    return 0.99 if constant in ("MOST_OF", "PROMISING", "CATCHING_UP") else float("inf")


def weighed_with(experiment):
    """Return policy -> names and their rivals, of one search."""
    from eha_monitor.mismatch.name.naming import naming_of
    from eha_monitor.mismatch.name.refit import settled
    from eha_monitor.mismatch.name.select import begun, finished

    search = begun(experiment)
    views = finished(search)
    before = settled(search.experiment, search.bare)

    def said(policy):
        naming = naming_of(replace(search.experiment, policy=policy),
                           replace(search.refits, policy=policy), views, before)
        if naming.unexplained > policy.likely:
            return ("unexplained",), {}
        names = {name.removeprefix("rig."): naming.rivals.get(name, ())
                 for name, one in naming.probability.items() if one > policy.likely}
        return tuple(sorted(names)), names

    return said


def diagnosed_with(recording, experiment):
    """Return policy -> names and their rivals, of a whole diagnosis."""
    from eha_monitor.mismatch.diagnose import begun_in, diagnosed
    from eha_monitor.mismatch.name.naming import name_effects

    def said(policy):
        one, say = replace(experiment, policy=policy), lambda text, share: None
        windows, search = begun_in(one, say)
        answer = diagnosed([recording], one, (windows, name_effects(search, say)), None,
                           time.perf_counter(), say)
        if answer.verdict not in ("mismatch", "consistent"):
            return (answer.verdict,), {}
        names = {effect.name: effect.indistinguishable_from for effect in answer.effects} | {
            finding.key: finding.indistinguishable_from for finding in answer.rig_data}
        return tuple(sorted(names)), names

    return said


def right(names: tuple[str, ...], rivals: dict, truth: dict) -> bool:
    """Tell whether nothing wrong is named, and nothing at all of what no catalogue has."""
    if not all(one["in_catalogue"] for one in truth["effects"]):
        return names == ("unexplained",)
    hidden = {one["name"] for one in truth["effects"]} | {one["key"] for one in truth["rig_off"]}
    return all({name, *rivals.get(name, ())} & hidden for name in names)


def main() -> None:
    """Print and record what moved."""
    parser = record.options(__doc__)
    parser.add_argument("--work", type=Path, required=True, help="folder of what was found")
    parser.add_argument("--weighed", nargs="*", default=WEIGHED)
    parser.add_argument("--searched", nargs="*", default=SEARCHED)
    parser.add_argument("--numerics", action="store_true", help="vary what bounds the search too")
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    from eha_monitor.mismatch.policy import POLICY

    given.work.mkdir(parents=True, exist_ok=True)
    jobs = [(name, anew, given.work) for anew, names in (
        (1 + given.numerics, given.searched), (0, given.weighed)) for name in names]
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        found = []
        for job, one in zip(jobs, pool.map(answers_of, jobs), strict=True):
            found.append(one)
            base = one["", 1.0]
            moved = [f"{number} x {factor:.2g}: {', '.join(names) or 'nothing'}"
                     for (number, factor), (names, _) in one.items() if names != base[0]]
            print(f"{job[0]} {'searched' if job[1] else 'weighed'}: "
                  f"{', '.join(base[0]) or 'nothing'} ({'right' if base[1] else 'wrong'})",
                  *moved, sep="\n    ", flush=True)
    rows = []
    for number in dict.fromkeys(number for one in found for number, _ in one if number):
        row = {"number": number, "value": asdict(POLICY).get(number)}
        for (_, anew, _), one in zip(jobs, found, strict=True):
            for factor in FACTORS:
                if (number, factor) not in one or not (anew or number in WEIGHS):
                    continue  # it enters before anything is weighed
                key = ("searched" if anew else "weighed") + ("_less" if factor < 1 else "_more")
                was, now = one["", 1.0], one[number, factor]
                cell = row.setdefault(key, [0, 0, 0])
                for i, counts in enumerate((was[0] != now[0], now[1] and not was[1],
                                            was[1] and not now[1])):
                    cell[i] += int(counts)
        rows.append(row)
    for row in rows:
        print(row)
    if given.record:
        record.write("policy_sweep", {
            "weighed": {"value": len(given.weighed)}, "searched": {"value": len(given.searched)},
            "rows": {"value": rows}},
            ("eha_monitor/mismatch/name", "eha_monitor/mismatch/policy.py"), held_by="commit")


if __name__ == "__main__":
    sys.exit(main())
