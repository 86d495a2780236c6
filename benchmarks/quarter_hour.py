"""A person's first quarter of an hour: five unknown CSVs, and what a data sheet says.

    python benchmarks/quarter_hour.py [--cases NAME ...] [--seed 0] [--keep DIR] [--record]

The files are of `benchmarks/strangers`' plant, whose equations are not this project's, in five
dialects.  For each: `init` with the answers that a person has (bore, rod, stroke, mass, pump,
charge pressure), `import`, `estimate`, each as a process of its own.  Printed: time taken, what
was guessed rightly and wrongly, the errors of B and beta_e.
"""

import datetime
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi
from pathlib import Path

import numpy as np
import record
from rich.console import Console
from rich.table import Table
from stranger_parts.commands import answer_of, shell, shown
from strangers.plant import Constants, Drive, Motion, Sensors, recording
from strangers.rigs import Dialect, Rig

from eha_monitor.settings import load_settings

MEASURES = ("eha_monitor/draft", "eha_monitor/plausibility", "eha_monitor/recordings",
            "eha_monitor/estimation", "benchmarks/strangers", "benchmarks/quarter_hour.py")
ATMOSPHERE, RPM = 101_325.0, pi / 30
GOOD = 1e-4  # relative: a factor of a guess is right
Shown = dict[str, np.ndarray]


@dataclass(frozen=True)
class Sheet:
    """What the data sheet of a rig says; mm, cm³, cm³ a revolution, bar, kg."""

    bore: float
    rod: float
    rods: int
    stroke: float
    line: float
    mass: float
    pump: float
    charge: float

    def answers(self) -> list[str]:
        """Return the answers of a person, as ``--set`` takes them."""
        return [f"bore={self.bore} mm", f"rod={self.rod} mm", f"rods={self.rods}",
                f"stroke={self.stroke} mm", f"line_volume={self.line} cm^3",
                f"mass={self.mass} kg",
                f"pump_displacement={self.pump} cm^3/rev", f"charge_pressure={self.charge} bar"]

    def plant(self, damping: float, beta: float, gain: float, **more: float) -> Constants:
        """Return the truth behind it."""
        ring = pi / 4 * (self.bore**2 - self.rod**2) * 1e-6
        areas = (ring if self.rods == 2 else pi / 4 * self.bore**2 * 1e-6, ring)
        volumes = [area * self.stroke * 0.5e-3 + self.line * 1e-6 for area in areas]
        pump = self.pump * 1e-6 / (2 * pi)
        more["load"] = more.get("load", 0.0) + ATMOSPHERE * (areas[0] - areas[1])  # on the rod
        return Constants(*areas, *volumes, self.mass, damping, beta, pump,
                         pump * areas[1] / areas[0], gain, reservoir=self.charge * 1e5, **more)


@dataclass(frozen=True)
class Case:
    """One file: rig, how it is written, what a person answers, what ought to be guessed.

    ``truth`` : channel -> (column, SI units in one of the file, SI value at zero).
    """

    words: str
    sheet: Sheet
    rig: Rig
    write: Callable[[Path, Shown], None]
    truth: dict[str, tuple[str, float, float]]
    more: tuple[str, ...] = ()


def rig(name: str, plant: Constants, rate: float, motion: Motion, **more) -> Rig:
    """Return a rig of 12 s."""
    return Rig(name, "", plant, rate, 12.0, motion, Dialect({}), **more)


def cells(shown: Shown, columns: dict[str, tuple[str, float, float]], digits: int = 5
          ) -> list[list[str]]:
    """Return the rows of a file in the units of its columns."""
    numbers = [(shown[channel] - zero) / factor for channel, (_, factor, zero) in columns.items()]
    return [[f"{value:.{digits}f}" for value in row] for row in zip(*numbers, strict=True)]


# --- five dialects
EXCEL = {"x": ("Kolbenweg [mm]", 1e-3, 0), "x_d": ("Sollweg [mm]", 1e-3, 0),
         "p1": ("Druck A [bar]", 1e5, 0), "p2": ("Druck B [bar]", 1e5, 0),
         "omega": ("Pumpendrehzahl [1/min]", RPM, 0), "temperature": ("Öltemperatur [°C]", 1, 0)}
LABVIEW = {"x": ("Piston Position", 1e-3, 0), "x_d": ("Position Cmd", 1e-3, 0),
           "omega": ("Motor Speed", RPM, 0), "p1": ("P_cap", 1e6, 0), "p2": ("P_rod", 1e6, 0)}
LOGGER = {"x_d": ("ref_pos", 1e-3, 0), "x": ("act_pos", 1e-3, 0), "omega": ("pump_speed", RPM, 0),
          "p1": ("pressure_1", 1e5, ATMOSPHERE), "p2": ("pressure_2", 1e5, ATMOSPHERE)}
FRENCH = {"x": ("Course (mm)", 1e-3, 0), "x_d": ("Consigne (mm)", 1e-3, 0),
          "omega": ("Vitesse pompe (tr/min)", RPM, 0),
          "p1": ("Pression B (bar)", 1e5, 0), "p2": ("Pression A (bar)", 1e5, 0)}
PLC = {"x": ("Pos_Ist_%", 1e-3, -0.05), "x_d": ("Pos_Soll_%", 1e-3, -0.05),
       "omega": ("n_Pumpe_%", 3000 * RPM / 100, 0), "p1": ("pA_raw", 250e5 / 27648, 0),
       "p2": ("pB_raw", 250e5 / 27648, 0)}


def excel(path: Path, shown: Shown) -> None:
    """Write what Excel saves in Germany."""
    rows = [["Zeit [ms]", *(head for head, *_ in EXCEL.values())]]
    rows += [[f"{1e3 * t:.1f}", *row] for t, row in zip(shown["time"], cells(shown, EXCEL),
                                                       strict=True)]
    text = "\r\n".join(";".join(row).replace(".", ",") for row in rows)
    path.write_text(text, encoding="cp1252")


def labview(path: Path, shown: Shown) -> None:
    """Write a LabVIEW measurement file."""
    heads = [head for head, *_ in LABVIEW.values()]
    rows = ["LabVIEW Measurement", "Writer_Version\t2", "Separator\tTab", "Decimal_Separator\t.",
            "Date\t2026/11/23", "Operator\tmk", "***End_of_Header***", "", "Channels\t5",
            "\t".join(["X_Value", *heads, "Comment"]),
            "\t".join(["s", "mm", "mm", "rpm", "MPa", "MPa", ""])]
    rows += ["\t".join([f"{t:.4f}", *row, ""]) for t, row in zip(
        shown["time"], cells(shown, LABVIEW, 6), strict=True)]
    path.write_text("\n".join(rows), encoding="utf-8")


def logger(path: Path, shown: Shown) -> None:
    """Write the file of a logger with ISO stamps."""
    start = datetime.datetime(2026, 11, 23, 8, 30, tzinfo=datetime.UTC)
    rows = [",".join(["timestamp", *(head for head, *_ in LOGGER.values()), "status"])]
    # Pressures as gauges show them, which the header does not say.
    for t, row in zip(shown["time"], cells(shown, LOGGER), strict=True):
        stamp = start + datetime.timedelta(seconds=float(t))
        rows.append(",".join([stamp.isoformat(timespec="microseconds"), *row, "OK"]))
    path.write_text("\n".join(rows), encoding="utf-8-sig")


def french(path: Path, shown: Shown) -> None:
    """Write a French file, the transducers on each other's port."""
    # The hoses of the two transducers are on each other's port.
    order = {"x": "x", "x_d": "x_d", "omega": "omega", "p2": "p2", "p1": "p1"}
    rows = [";".join(["Temps (s)", *(FRENCH[name][0] for name in order)])]
    rows += [";".join([f"{t:.4f}", *row]).replace(".", ",") for t, row in zip(
        shown["time"], cells(shown, {name: FRENCH[name] for name in order}), strict=True)]
    path.write_text("\n".join(rows), encoding="utf-8")


def plc(path: Path, shown: Shown) -> None:
    """Write the trace of a PLC."""
    rows = [";".join(["Zeit_ms", *(head for head, *_ in PLC.values())])]
    for t, row in zip(shown["time"], cells(shown, PLC, 3), strict=True):
        rows.append(";".join([f"{1e3 * t:.0f}", *row[:3], *(f"{float(cell):.0f}"
                                                            for cell in row[3:])]))
    path.write_text("\n".join(rows), encoding="utf-8")


SINES = Motion("sines", (0.02, 4e-3, 1e-3, 4e-4), (0.4, 1.7, 5.3, 11.0))
E_SHEET = Sheet(40, 22, 2, 120, 20, 35, 1.45, 16)
L_SHEET = Sheet(40, 25, 1, 160, 40, 60, 3.1, 15)
I_SHEET = Sheet(32, 16, 2, 100, 15, 20, 1.1, 20)
F_SHEET = Sheet(50, 28, 2, 200, 30, 80, 3.5, 12)
P_SHEET = Sheet(32, 18, 2, 100, 15, 25, 1.0, 25)
LEAK = {"cross_leakage": 1.5e-13, "makeup": 1.5e-13}
CASES = {
    "excel": Case("German Excel: ';', decimal comma, mm, bar, 1/min, Windows-1252", E_SHEET,
                  rig("excel", E_SHEET.plant(1500, 7e8, 22000, **LEAK), 1000, SINES), excel,
                  EXCEL),
    "labview": Case("LabVIEW: header block, tabs, row of units, single rod", L_SHEET, replace(
        rig("labview", L_SHEET.plant(2400, 8e8, 20000, gas_volume=1e-3, **LEAK), 1000, SINES),
        sensors=Sensors(encoder=0.5e-6, pressure_noise=1e3)), labview, LABVIEW),
    "logger": Case("ISO stamps, no units, gauge pressures that nobody calls so", I_SHEET, rig(
        "logger", I_SHEET.plant(800, 6e8, 23000, **LEAK), 1000, SINES), logger, LOGGER),
    "swapped": Case("French; the pressure transducers on each other's port", F_SHEET, rig(
        "swapped", F_SHEET.plant(5000, 6.5e8, 15000, **LEAK), 500, SINES), french, FRENCH),
    "plc": Case("PLC at 4 ms, holding its command; per cent and counts", P_SHEET, replace(
        rig("plc", P_SHEET.plant(1000, 7.5e8, 15000, **LEAK), 250, Motion(
            "sines", (0.02, 4e-3, 1e-3), (0.4, 1.7, 5.3))), drive=Drive(1),
        sensors=Sensors(pressure_noise=1e3, pressure_step=0.0)), plc, PLC,
        ("x.full=100 mm", "x_d.full=100 mm", "omega.full=3000 rpm", "p1.full=27648 = 250 bar",
         "p2.full=27648 = 250 bar")),
}


@dataclass(frozen=True)
class Played:
    """What became of one file: seconds, guesses, errors in %."""

    name: str
    seconds: tuple[float, ...]
    right: tuple[str, ...]
    wrong: tuple[str, ...]
    b: str = "–"
    beta: str = "–"
    error_b: float = np.nan
    error_beta: float = np.nan
    model: str = ""
    said: str = ""


def play(name: str, case: Case, folder: Path, seed: int) -> Played:
    """Go through init, import, estimate with one file."""
    file, config, bag = folder / f"{name}.csv", folder / f"{name}.yaml", folder / name
    case.write(file, recording(case.rig, seed))
    told = [word for answer in (*case.sheet.answers(), *case.more) for word in ("--set", answer)]
    drafted = shell("init", str(file), "--out", str(config), "--yes", *told)
    if drafted.status:
        return Played(name, (drafted.wall,), (), ("init",), said=drafted.err[-300:])
    right, wrong = guesses(case, config)
    imported = shell("import", str(file), "--map", str(config), "--out", str(bag))
    answered = folder / f"{name}.json"
    estimated = shell("estimate", str(bag), "--config", str(config), "--json", str(answered))
    seconds = (drafted.wall, imported.wall, estimated.wall)
    answer = answer_of(estimated, answered)
    truth = {"B": case.rig.plant.damping, "beta_e": case.rig.plant.bulk_modulus}
    off = {key: 100 * (answer.parameters[key]["value"] / value - 1)
           if answer.parameters.get(key, {}).get("value") else np.nan
           for key, value in truth.items()}
    return Played(name, seconds, right, wrong, shown(answer.parameters.get("B")),
                  shown(answer.parameters.get("beta_e")), off["B"], off["beta_e"], answer.model,
                  (imported.err + estimated.err)[-300:])


def guesses(case: Case, config: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what the draft has right, and what wrong."""
    settings = load_settings(config)
    right, wrong = [], []
    for channel, (column, factor, zero) in case.truth.items():
        found = settings.table.columns.get(channel)
        # Where x = 0 lies is nobody's business but the owner's.
        good = found is not None and found.column == column and abs(
            found.gain / factor - 1) < GOOD and (channel[0] == "x" or abs(found.zero - zero) < 1.0)
        (right if good else wrong).append(
            channel if good else f"{channel}: {'missing' if found is None else found}")
    gain = settings.rig.position_gain
    true = case.rig.plant.gain
    good = gain is not None and abs(gain / true - 1) < 0.02
    (right if good else wrong).append("position_gain" if good else f"position_gain: {gain}")
    return tuple(right), tuple(wrong)


def show(played: list[Played]) -> None:
    """Print the table."""
    table = Table(title="a quarter of an hour with an unknown CSV")
    for head in ("file", "s: init, import, estimate", "guessed rightly", "wrongly", "B", "off",
                 "βe", "off", "model"):
        table.add_column(head, overflow="fold")
    for one in played:
        table.add_row(f"{one.name}: {CASES[one.name].words}",
                      " ".join(f"{s:.1f}" for s in one.seconds), str(len(one.right)),
                      "; ".join(one.wrong) or "none", one.b, f"{one.error_b:+.2f} %", one.beta,
                      f"{one.error_beta:+.2f} %", one.model + (f" {one.said}" if one.said else ""))
    Console(width=180).print(table)


def main() -> int:
    """Run it and print its table."""
    parser = record.options(__doc__)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep files and configs here")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="quarter_hour_") as folder:
        place = asked.keep or Path(folder)
        place.mkdir(exist_ok=True)
        played = [play(name, CASES[name], place, asked.seed) for name in asked.cases]
    show(played)
    if asked.record:
        record.write("quarter_hour", figures(played), MEASURES, held_by="commit")
    return int(any(one.wrong for one in played))


def figures(played: list[Played]) -> dict[str, dict]:
    """Return what the table of the docs is made of."""
    found = {}
    for one in played:
        found |= {f"{one.name}_seconds": record.spread(sum(one.seconds), "s"),
                  f"{one.name}_right": record.spread(len(one.right)),
                  f"{one.name}_wrong": record.spread(len(one.wrong)),
                  f"{one.name}_b": record.spread(one.error_b, "%"),
                  f"{one.name}_beta": record.spread(one.error_beta, "%")}
    return found


if __name__ == "__main__":
    sys.exit(main())
