"""`import` and `diagnose` on the real recordings in ../shared/data, with the configs of config/.

    python benchmarks/real_diagnosis.py [--data ../shared/data] [--only emps] [--record]

The recordings state no licence, so they stay where they are; without them this says so and ends.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import record
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parent.parent
HSM = ("hsm150/idf_pos_0.06_1.mat", "hsm150/idf_pos_0.065_2.mat", "hsm150/idf_neg_0.04_1.mat",
       "hsm150/idf_neg_0.045_3.mat")
SEALS = tuple(f"pneumatic_seals/1_O-ring257_{bar}bar.csv" for bar in (1, 3, 5, 7))
EHA = tuple(f"ivliev_eha/exp_data_{name}.csv" for name in ("1_2", "1_4", "2_3", "3_4", "4_2",
                                                          "5_4"))
LOSSES = {"cross_port_leakage", "external_leakage", "turbulent_leakage", "leakage_offset",
          "pump_volumetric_loss", "pump_flow_gain", "pump_dead_zone"}
# config, files that are diagnosed together, what has to come out
CASES = (
    ("emps", ("emps/DATA_EMPS.mat",), "B 203.5, F_c 20.39, by direction"),
    *(("hsm150", (file,), "B 7.03e-5, load or Coulomb") for file in HSM),
    ("hsm150", HSM, "B 7.03e-5, Coulomb"),
    *(("ivliev_eha", (file,), "friction, leakage") for file in EHA[:-1]),
    ("ivliev_eha", EHA[-1:], "friction, leakage, saturation"),
    ("ivliev_eha", (EHA[1], EHA[3], EHA[5]), "friction, leakage, saturation"),
    ("ivliev_eha", ("ivliev_eha/extra_2024_10_14_5.csv",), "friction, leakage"),
    *(("pneumatic_seals", (file,), "friction 5.4 to 10.2 N") for file in SEALS[::3]),
    ("pneumatic_seals", SEALS, "pressure friction"),
    ("hanging_load", ("hanging_load/HangingLoad.csv",), "refusal"),
    *(("crane_jib", (f"crane_jib/Jib{run}_090525.csv.gz",), "a load that depends on the stroke")
      for run in (1, 2)),
)


def run(*arguments: str) -> str:
    """Run one command of the package; returns its own words on failure."""
    done = subprocess.run([sys.executable, "-m", "eha_monitor", *arguments], text=True,
                          capture_output=True)
    return done.stderr.strip() if done.returncode else ""


def number(text: str, name: str, symbol: str, effects: list[dict]) -> str:
    """Return what a recording reached beside what is published, as text."""
    for effect in effects:
        if effect["name"] in name.split("|") and symbol in effect["parameters"]:
            return f"{text} {effect['parameters'][symbol]['value']:.4g}"
    return f"{text} not named"


def reached(config: str, found: dict) -> str:
    """Return the figures that are to be compared with what has to be."""
    effects = found["effects"]
    b = found["parameters"]["after"].get("B")
    words = [f"B {b['value']:.4g}"] if b else []
    if config in ("emps", "hsm150"):
        words.append(number("F_c", "asymmetric_friction|coulomb_friction", "F_c", effects))
    if config == "pneumatic_seals":
        words.append(number("mu", "pressure_friction", "mu", effects))
    if config == "ivliev_eha":
        named = {effect["name"] for effect in effects}
        words = [word for word, names in (
            ("friction", [name for name in named if name.endswith("friction")]),
            ("flow loss", named & LOSSES), ("saturation", named & {"drive_saturation"})) if names]
    return ", ".join(words)


def row_of(config: str, files: tuple[str, ...], data: Path, folder: Path) -> tuple[str, ...]:
    """Return verdict, names, what was reached, force residual, its share, seconds, as text."""
    settings = str(ROOT / "config" / f"{config}.yaml")
    bags = []
    for file in files:
        bags.append(str(folder / Path(file).stem))
        if not Path(bags[-1]).exists():
            failed = run("import", str(data / file), "--map", settings, "--out", bags[-1])
            if failed:
                return "not imported", failed, "", "", "", ""
    answer, began = folder / "answer.json", time.perf_counter()
    failed = run("diagnose", *bags, "--config", settings, "--json", str(answer))
    seconds = f"{time.perf_counter() - began:.0f}"
    if failed:
        return "refused", failed.replace(str(folder), ""), "", "", "", seconds
    found = json.loads(answer.read_text())
    names = "; ".join(
        effect["name"] + "".join(f" {key} {effect['parameters'][key]['value']:.4g}"
                                 for key in list(effect["parameters"])[:2])
        + "".join(f" / {rival}" for rival in effect["indistinguishable_from"])
        for effect in found["effects"])
    force = found["fit"]["signals"].get("force")
    left = f"{force['before_rms']:.3g} → {force['after_rms']:.3g}" if force else ""
    share = ""
    if force and force.get("signal_rms"):
        share = " → ".join(f"{100 * force[key] / force['signal_rms']:.3g}"
                           for key in ("before_rms", "after_rms"))
    return found["verdict"], names, reached(config, found), left, share, seconds


def main() -> None:
    """Print the table."""
    parser = record.options(__doc__, data=True)
    parser.add_argument("--only", default="", help="config whose recordings are run")
    options = parser.parse_args()
    if not options.data.is_dir():
        print(f"{options.data}: not here; the real recordings are not part of this repository")
        return
    table = Table(title="diagnose on recordings that this project did not make", show_lines=True)
    for head in ("recording", "has to be", "verdict", "named", "reached", "force left, N",
                 "% of the force", "s"):
        table.add_column(head)
    chosen = [case for case in CASES if options.only in ("", case[0])]
    kept = []
    with tempfile.TemporaryDirectory() as folder:
        for i, (config, files, expected) in enumerate(chosen, 1):
            name = " + ".join(Path(file).stem for file in files)
            row = row_of(config, files, options.data, Path(folder))
            print(f"{i}/{len(chosen)} {name}: {row[0]}, {row[-1]} s", file=sys.stderr, flush=True)
            table.add_row(name, expected, *row)
            verdict, names, reached_, left, *_ = row
            kept.append({"what": f"{config}: {name}", "published": expected, "found": "; ".join(
                filter(None, (f"{verdict}: {names}" if names else verdict, reached_,
                              f"force left {left} N" if left else "")))})
    Console(width=190).print(table)
    if options.record:
        record.write("real_diagnosis", {"rows": kept}, (
            "eha_monitor/mismatch", "eha_monitor/estimation", "eha_monitor/physics"),
            held_by="commit")


if __name__ == "__main__":
    main()
