"""`import` and `estimate` on the real recordings in ../shared/data, with the configs of config/.

    python benchmarks/real_recordings.py [--data ../shared/data] [--record]

The recordings state no licence, so they stay where they are; without them this says so and ends.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import record
from rich.console import Console
from rich.table import Table

from eha_monitor.quantity import with_uncertainty

ROOT = Path(__file__).resolve().parent.parent
RECORDINGS = (
    ("emps", "emps/DATA_EMPS.mat"),
    ("hsm150", "hsm150/idf_pos_0.06_1.mat"),
    ("hsm150", "hsm150/idf_pos_0.065_2.mat"),
    ("hsm150", "hsm150/idf_neg_0.04_1.mat"),
    ("hsm150", "hsm150/idf_neg_0.045_3.mat"),
    ("ivliev_eha", "ivliev_eha/exp_data_1_2.csv"),
    ("ivliev_eha", "ivliev_eha/exp_data_1_4.csv"),
    ("ivliev_eha", "ivliev_eha/exp_data_2_3.csv"),
    ("ivliev_eha", "ivliev_eha/exp_data_3_4.csv"),
    ("ivliev_eha", "ivliev_eha/exp_data_4_2.csv"),
    ("ivliev_eha", "ivliev_eha/exp_data_5_4.csv"),
    ("ivliev_eha", "ivliev_eha/extra_2024_10_14_5.csv"),
    ("pneumatic_seals", "pneumatic_seals/1_O-ring257_1bar.csv"),
    ("pneumatic_seals", "pneumatic_seals/1_O-ring257_7bar.csv"),
    ("fluid_power_sim", "fluid_power_sim/h32_rich.csv.gz"),
    ("fluid_power_sim", "fluid_power_sim/h21_tri.csv.gz"),
)

PLAIN = str.maketrans(".-", "__")  # a file's name as the name of a figure


def run(*arguments: str) -> None:
    """Run one command of the package; its own words on failure."""
    done = subprocess.run([sys.executable, "-m", "eha_monitor", *arguments], text=True,
                          capture_output=True)
    if done.returncode:
        sys.exit(done.stderr)


def shown(parameter: dict, expected: str = "") -> str:
    """Return a parameter as a table shows it, with its status where that is not the expected."""
    status = parameter["status"]
    if parameter["value"] is None or (expected and status == "not_excited"):
        return status.replace("_", " ") if expected else status
    value = with_uncertainty(parameter["value"], parameter["stddev"], parameter["unit"])
    return value if status == expected else f"{value} {status}"


def main() -> None:
    """Print the table."""
    given = record.options(__doc__, data=True).parse_args()
    data, figures = given.data, {}
    if not data.is_dir():
        print(f"{data}: not here; the real recordings are not part of this repository")
        return
    table = Table(title="import + estimate on recordings that this project did not make")
    for head in ("recording", "B", "βe", "model", "s"):
        table.add_column(head)
    with tempfile.TemporaryDirectory() as folder:
        for rig, file in RECORDINGS:
            config, bag = str(ROOT / "config" / f"{rig}.yaml"), str(Path(folder) / Path(file).stem)
            answer = Path(folder) / "answer.json"
            run("import", str(data / file), "--map", config, "--out", bag)
            run("estimate", bag, "--config", config, "--json", str(answer))
            found = json.loads(answer.read_text())
            parameters = found["parameters"]
            table.add_row(file, shown(parameters["B"]), shown(parameters["beta_e"]),
                          found["model"]["status"], f"{found['wall_s']:.2f}")
            figures[Path(file).name.partition(".csv")[0].partition(".mat")[0].translate(PLAIN)] = {
                "B": shown(parameters["B"], "converged"), "model": found["model"]["status"],
                "beta_e": shown(parameters["beta_e"], "converged")}
    Console(width=150).print(table)
    if given.record:
        record.write("real_recordings", figures, (
            "eha_monitor/estimation", "eha_monitor/physics", "eha_monitor/recordings"),
            held_by="commit")


if __name__ == "__main__":
    main()
