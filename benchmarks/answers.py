"""A fixed set of recordings and their answers: what a change of the house must leave as it is.

    python benchmarks/answers.py --work DIR --out before.json
    python benchmarks/answers.py --work DIR --out after.json --against before.json

Concealed draws, strangers' rigs, the bundled bags, the independent simulator's recordings and real
ones (where ``../shared/data`` is) go through the commands in processes of their own, so that
nothing inside the package is imported by its name.  Names and verdicts have to be equal, numbers
within a tenth of their deviation or a thousandth of their size.  Seconds of processor stand beside
plain filterpy steps in a second, since machines differ.  Recordings are made once in ``--work``.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import record

ROOT = Path(__file__).resolve().parent.parent
SEED, DRAWS = 7001, 24
STRANGERS, RIG_RECORDINGS = (0, 1, 2, 3), 4
DEVIATIONS, RELATIVE = 0.1, 1e-3  # by how much a number may differ
REAL = {  # name -> config, files diagnosed together
    "emps": ("emps", ("emps/DATA_EMPS.mat",)),
    "hsm_1": ("hsm150", ("hsm150/idf_pos_0.06_1.mat",)),
    "hsm_2": ("hsm150", ("hsm150/idf_neg_0.045_3.mat",)),
    "hsm_all": ("hsm150", ("hsm150/idf_pos_0.06_1.mat", "hsm150/idf_pos_0.065_2.mat",
                           "hsm150/idf_neg_0.04_1.mat", "hsm150/idf_neg_0.045_3.mat")),
    "seal_1": ("pneumatic_seals", ("pneumatic_seals/1_O-ring257_1bar.csv",)),
    "seal_all": ("pneumatic_seals", tuple(
        f"pneumatic_seals/1_O-ring257_{bar}bar.csv" for bar in (1, 3, 5, 7))),
    "hanging": ("hanging_load", ("hanging_load/HangingLoad.csv",)),
    "crane_1": ("crane_jib", ("crane_jib/Jib1_090525.csv.gz",)),
    "crane_2": ("crane_jib", ("crane_jib/Jib2_090525.csv.gz",)),
    "eha_1_2": ("ivliev_eha", ("ivliev_eha/exp_data_1_2.csv",)),
    "eha_3_4": ("ivliev_eha", ("ivliev_eha/exp_data_3_4.csv",)),
    "eha_5_4": ("ivliev_eha", ("ivliev_eha/exp_data_5_4.csv",)),
    "eha_days": ("ivliev_eha", tuple(
        f"ivliev_eha_days/day_18_load_{load}_amplitude_{amplitude}.csv.gz"
        for load in (1, 3, 5) for amplitude in (2, 4))),
    "flo_1": ("flo_tork", ("flo_tork/unit_1_run_015.csv.gz",)),
    "flo_5": ("flo_tork", ("flo_tork/unit_5_run_050.csv.gz",)),
}
REFERENCES = {  # name -> config, recording, healthy ones
    "flo_1_against_5": ("flo_tork", "flo_tork/unit_1_run_041.csv.gz", tuple(
        f"flo_tork/unit_5_run_{run:03d}.csv.gz" for run in (0, 15, 30, 45, 60))),
    "flo_5_against_5": ("flo_tork", "flo_tork/unit_5_run_075.csv.gz", tuple(
        f"flo_tork/unit_5_run_{run:03d}.csv.gz" for run in (0, 15, 30, 45, 60))),
}
SIMULATOR = ("h03_rich", "h12_tri", "h14_rich", "h19_rich", "h24_tri", "h40_rich")


def command(*arguments: object) -> tuple[int, str, float]:
    """Run a command of the package; returns its status, what it said, seconds of processor."""
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen([sys.executable, "-m", "eha_monitor", *map(str, arguments)],
                                   stdout=subprocess.DEVNULL, stderr=said, cwd=ROOT)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        return process.returncode, said.read().strip(), usage.ru_utime + usage.ru_stime


def imported(file: str, config: str, work: Path) -> Path:
    """Return the bag of a real recording."""
    name = file.removesuffix(".gz").rpartition(".")[0]
    bag = work / "real" / name.replace("/", "_").replace(".", "_")
    if not bag.exists():
        bag.parent.mkdir(parents=True, exist_ok=True)
        status, said, _ = command("import", record.DATA / file, "--map", ROOT / "config"
                                  / f"{config}.yaml", "--out", bag)
        if status:
            raise SystemExit(said)
    return bag


def questions(work: Path) -> dict[str, list[object]]:
    """Return name -> arguments of the command that answers, recordings made where missing."""
    from strangers.draw import draw_rig
    from strangers.generate import write

    from eha_monitor.concealed.draws import draw_cases
    from eha_monitor.concealed.generate import write_case

    found: dict[str, list[object]] = {}
    for name in ("hidden_friction", "air_ingress"):
        bag = ROOT / "bags" / name
        config = ["--config", ROOT / "config" / "air_ingress.yaml"] if "air" in name else []
        found[f"estimate_{name}"] = ["estimate", bag, *config]
        found[name] = ["diagnose", bag, *config]
    for case in draw_cases(DRAWS, SEED):
        bag, config = work / "draws" / case.name, work / "draws" / f"{case.name}.yaml"
        if not config.exists():
            write_case(case, work / "draws")
        found[case.name] = ["diagnose", bag, "--config", config]
        if int(case.name[1:]) % 4 == 0:
            found[f"estimate_{case.name}"] = ["estimate", bag, "--config", config]
    for i in STRANGERS:
        rig, folder, bags = draw_rig(SEED, i), work / "strangers" / f"r{i}", []
        for k in range(RIG_RECORDINGS):
            setting = rig.settings[k % len(rig.settings)]
            place = folder / str(k)
            if not place.exists():
                write(rig, setting, place, k)
            bags.append(next(path for path in sorted(place.iterdir()) if path.is_dir()))
        config = next((folder / "0").glob("*.yaml"))
        found[f"stranger_{i}"] = ["diagnose", bags[0], "--config", config]
        found[f"stranger_{i}_together"] = ["diagnose", *bags, "--config", config]
        found[f"stranger_{i}_reference"] = ["diagnose", bags[0], "--reference", *bags[1:],
                                            "--config", config]
    if not record.DATA.is_dir():
        print(f"{record.DATA}: not here; without real recordings", file=sys.stderr)
        return found
    for name in SIMULATOR:
        found[name] = ["diagnose", imported(f"fluid_power_sim/{name}.csv.gz",
                                            "fluid_power_sim", work),
                       "--config", ROOT / "config" / "fluid_power_sim.yaml"]
    for name, (config, files) in REAL.items():
        found[name] = ["diagnose", *(imported(file, config, work) for file in files),
                       "--config", ROOT / "config" / f"{config}.yaml"]
    for name, (config, now, healthy) in REFERENCES.items():
        found[name] = ["diagnose", imported(now, config, work), "--reference",
                       *(imported(file, config, work) for file in healthy),
                       "--config", ROOT / "config" / f"{config}.yaml"]
    return found


def answer(arguments: list[object]) -> dict:
    """Return what a command answers: verdict, names, numbers, seconds of processor."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "answer.json"
        status, said, seconds = command(*arguments, "--json", file)
        if status:
            return {"status": status, "said": said.rpartition("/")[2], "cpu_s": seconds}
        found = json.loads(file.read_text())
    if "effects" not in found:  # an estimate
        return {"status": 0, "cpu_s": seconds, "verdict": found["model"]["status"],
                "names": [f"{key}: {one['status']}" for key, one in found["parameters"].items()],
                "numbers": numbers("", found["parameters"])}
    names = sorted([one["name"] for one in found["effects"]]
                   + [f"rig.{one['key']}" for one in found["rig_data"]]
                   + [f"learned: {one['formula']}" for one in found.get("learned", ())]
                   + [f"changed: {one['what']}" for one in found.get("changes", ())])
    known = numbers("", found["parameters"]["after"])
    for one in found["effects"]:
        known |= numbers(one["name"] + ".", one["parameters"])
    return {"status": 0, "cpu_s": seconds, "verdict": found["verdict"], "names": names,
            "numbers": known, "balance": found["location"]["balance"]}


def numbers(prefix: str, values: dict) -> dict[str, tuple[float, float]]:
    """Return name -> value and deviation."""
    return {prefix + key: (one["value"], one.get("stddev")) for key, one in values.items()
            if one and one.get("value") is not None}


def differences(before: dict, after: dict) -> list[str]:
    """Return in what two answers of one recording differ."""
    found = [f"{key}: {before.get(key)} -> {after.get(key)}"
             for key in ("status", "verdict", "names") if before.get(key) != after.get(key)]
    for name, (value, deviation) in before.get("numbers", {}).items():
        now = after.get("numbers", {}).get(name)
        if now is None:
            found.append(f"{name}: {value:.6g} -> gone")
            continue
        allowed = max(RELATIVE * abs(value), DEVIATIONS * (deviation or 0.0))
        if math.isfinite(value) and not abs(now[0] - value) <= allowed:
            found.append(f"{name}: {value:.6g} ± {deviation or math.nan:.2g} -> {now[0]:.6g}")
    found += [f"{name}: new" for name in after.get("numbers", {})
              if name not in before.get("numbers", {})]
    return found


def main() -> int:
    """Answer every question, compare; 1 where an answer differs."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--work", type=Path, required=True, help="folder of the recordings")
    options.add_argument("--out", type=Path, required=True, help="the answers, JSON")
    options.add_argument("--against", type=Path, help="answers of another source")
    options.add_argument("--only", nargs="+", default=[""], help="names that begin so")
    options.add_argument("--jobs", type=int, default=2)
    given = options.parse_args()
    todo = {name: arguments for name, arguments in questions(given.work).items()
            if name.startswith(tuple(given.only))}
    before = json.loads(given.against.read_text())["answers"] if given.against else {}
    answers, differ, rate = {}, 0, 1.0 / record.plain_filterpy_cost(4)
    with ThreadPoolExecutor(given.jobs) as pool:
        futures = {pool.submit(answer, arguments): name for name, arguments in todo.items()}
        for future in as_completed(futures):
            name, one = futures[future], future.result()
            answers[name] = one
            print(f"{name}: {one.get('verdict', one.get('said'))} "
                  f"{', '.join(one.get('names', ()))} ({one['cpu_s']:.1f} s)", flush=True)
            for line in differences(before[name], one) if name in before else ():
                differ += 1
                print(f"    {line}", flush=True)
    given.out.write_text(json.dumps({"filterpy_steps_a_second": rate, "answers": {
        name: answers[name] for name in todo}}, indent=1, ensure_ascii=False))
    spent = sorted(one["cpu_s"] for one in answers.values())
    print(f"{len(answers)} answers, {differ} differences; processor: median "
          f"{spent[len(spent) // 2]:.1f} s, worst {spent[-1]:.1f} s, all {sum(spent):.0f} s; "
          f"{rate:.0f} plain filterpy steps a second")
    return int(differ > 0)


if __name__ == "__main__":
    sys.exit(main())
