"""What the pages are about: recordings made here, and the answers to them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from eha_monitor.api.estimate import judged
from eha_monitor.estimation.joint import observability
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.mismatch.compared import compared
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.physics.simulator import Simulator
from eha_monitor.prove.trial import Trial, cases_of, prove
from eha_monitor.quantity import in_units, rig_motion
from eha_monitor.recordings.importing import read_table
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.reports.archive_report import archive_page
from eha_monitor.reports.diagnosis_report import diagnosis_page
from eha_monitor.reports.estimate_report import estimate_page
from eha_monitor.reports.proof_report import proof_page
from eha_monitor.settings import load_settings, settings_from_tree
from eha_monitor.settings.hypothesis import hypothesis_of

ROOT = Path(__file__).parents[2]
START, DAY = 1_790_000_000_000_000_000, 86_400 * 10**9  # ns
SWEEP = {"kind": "multisine", "amplitude": 0.02, "frequency": 0.3, "frequency_end": 20.0,
         "duration": 8.0}
# The worn spot of docs/effects.md.
SPOT = {"adds": "force", "expression": "F*exp(-((x - x_0)/w)**2)*tanh(v/1e-3)"}
SPOT_IS = {"F": 60.0, "x_0": 4e-3, "w": 5e-3}
SUSPECTED = SPOT | {"name": "worn_spot", "parameters": {
    "F": {"start": 20.0, "lower": 0.0, "upper": 500.0, "unit": "N"},
    "x_0": {"start": 0.0, "lower": -0.03, "upper": 0.03, "unit": "m"},
    "w": {"start": 3e-3, "lower": 1e-4, "upper": 0.05, "unit": "m"}},
    "sentence": "the cylinder is worn at {x_0}: the seal grips with up to {F}"}
HEALTHY, REAL = 5, 16  # references of a comparison, simulated and real


@dataclass(frozen=True)
class Folder:
    """Where answers are kept, and where recordings of others lie."""

    path: Path
    data: Path


def plant(effects: dict | None = None, rig: dict | None = None) -> dict:
    """Return the config of a simulated rig on the multisine."""
    return {"rig": {"viscous_damping": 600.0} | (rig or {}), "effects": effects or {},
            "simulation": {"excitation": {"sweep": SWEEP}}}


def recorded(tree: dict, seconds: float, seed: int = 1, name: str = "recording", day: int = 0
             ) -> Recording:
    """Simulate a recording."""
    rig = Simulator(settings_from_tree(tree, "pages"), seed=seed)
    return Recording(rig.dt, rig.advance(round(seconds / rig.dt)), START + day * DAY, name)


def estimated(recording: Recording, settings) -> tuple:
    """Return what the page of an estimate takes."""
    found = estimate(recording, settings)
    return (found, *judged(found), observability(found))


def bundled(name: str) -> Callable:
    """Return the maker of the estimate of a bundled bag."""
    return lambda folder: estimated(from_bags(name), PAPER)


def from_bags(name: str) -> Recording:
    """Return a bundled recording, under the name that everybody knows it by."""
    return replace(read_recording(ROOT / "bags" / name, PAPER), source=f"bags/{name}")


def long_one(_: Folder) -> tuple:
    """Estimate ten minutes at 1 kHz."""
    return estimated(recorded({}, 600.0, name="ten_minutes"), PAPER)


def few_channels(_: Folder) -> tuple:
    """Estimate where only the position was recorded, with a gap."""
    whole = recorded({}, 6.0, name="position_only")
    x = whole.get("x").copy()
    x[2000:2800] = float("nan")
    return estimated(Recording(whole.sample_time, {"x": x}, START, whole.source), PAPER)


def missing(tree: dict, name: str, hypothesis: bool = False) -> Callable:
    """Return the maker of a diagnosis of a simulated rig with the paper's config."""
    def made(_: Folder) -> tuple:
        suspected = hypothesis_of(SUSPECTED, "spot.yaml") if hypothesis else None
        return diagnose([recorded(tree, 8.0, name=name)], PAPER, hypothesis=suspected), PAPER

    return made


def bent(_: Folder) -> tuple:
    """Diagnose pressures whose amplifiers bend from the middle on, which nothing names."""
    whole = recorded(plant(), 8.0, name="bent")
    late = np.arange(len(whole)) * whole.sample_time > 4.0
    push = 4e5 * np.maximum(whole.get("x") - 5e-3, 0.0) ** 0.5 * late  # Pa
    return diagnose([replace(whole, channels=whole.channels | {
        "p1": whole.get("p1") + push, "p2": whole.get("p2") - 3.0 * push**0.9})], PAPER), PAPER


def hidden(_: Folder) -> tuple:
    """Diagnose the bundled recording of the README."""
    return diagnose([from_bags("hidden_friction")], PAPER), PAPER


def against_healthy(tree: dict, name: str) -> Callable:
    """Return the maker of a comparison of one simulated recording with healthy ones."""
    def made(_: Folder) -> tuple:
        settings = settings_from_tree(plant(), "pages")
        healthy = [recorded(plant(rig={"viscous_damping": 600.0 + 4.0 * i}), 8.0, 10 + i,
                            f"healthy_{i}", i) for i in range(HEALTHY)]
        return compared([recorded(tree, 8.0, 3, name, 30)], healthy, settings), settings

    return made


def valve(folder: Folder) -> tuple | None:
    """Compare a real actuator that turns a valve with one that runs free."""
    files = sorted((folder.data / "flo_tork").glob("*.csv.gz"))
    if not files:
        return None
    settings = load_settings(ROOT / "config" / "flo_tork.yaml")
    free = [read_table(file, settings) for file in files
            if file.name.startswith("unit_5")][:REAL]
    loaded = next(file for file in files if file.name.startswith("unit_1"))
    with rig_motion(settings.rig.motion):
        return in_units(compared([read_table(loaded, settings)], free, settings)), settings


def nights(command: str, count: int, seconds: float) -> Callable:
    """Return the maker of the table of a folder whose B rises and whose oil takes up air."""
    def made(folder: Folder) -> tuple:
        from eha_monitor.commands.archive_rows import Task, error_row, row_of

        rows = []
        for k in range(count):
            worn = plant({"coulomb_friction": {"F_c": 40.0}} if k == count - 1 else {},
                         {"viscous_damping": 600.0 + 45.0 * k,
                          "bulk_modulus": 6e8 if k < count // 2 else 4.5e8})
            bag = folder.path / command / f"october/night_{k:02d}"
            if not bag.exists():
                bag.parent.mkdir(parents=True, exist_ok=True)
                write_recording(bag, recorded(worn, seconds, k, bag.name, k), PAPER)
            rows.append(row_of(Task(f"october/night_{k:02d}", bag, command, PAPER, str(k), "now")))
        broken = Task("october/cut.mcap", folder.path / "cut.mcap", command, PAPER, "x", "now")
        return [*rows, error_row(broken, "october/cut.mcap: the file is empty")], command

    return made


def trial(folder: Folder) -> tuple:
    """Run a small trial on concealed effects."""
    cases = cases_of("mixed", 6, 3)
    work = folder.path / "trial"
    return prove(Trial(cases, 3, work, True, 1, "all"), lambda _: None, lambda *_: None), work


def diagnosis(found: tuple, _: Folder) -> str:
    """Draw the page of a diagnosis."""
    answer, settings = found
    return diagnosis_page(answer, settings, command="eha-monitor diagnose recording")


def table(found: tuple, folder: Folder) -> str:
    """Draw the page of an archive."""
    rows, command = found
    return archive_page(rows, command, PAPER, folder.path / command, "now")


PAPER = load_settings(None)
LEAK = plant({"cross_port_leakage": {"L": 3e-13}})
# Page -> what makes its answer, and what draws it.
CASES: dict[str, tuple[Callable, Callable]] = {
    "estimate_air": (bundled("air_ingress"), lambda found, _: estimate_page(*found)),
    "estimate_mismatch": (bundled("hidden_friction"), lambda found, _: estimate_page(*found)),
    "estimate_long": (long_one, lambda found, _: estimate_page(*found)),
    "estimate_few_channels": (few_channels, lambda found, _: estimate_page(*found)),
    "diagnosis_mismatch": (hidden, diagnosis),
    "diagnosis_consistent": (missing(plant(), "nothing_missing"), diagnosis),
    "diagnosis_unexplained": (bent, diagnosis),
    "diagnosis_learned": (missing(plant({"worn_spot": SPOT | SPOT_IS}), "worn"), diagnosis),
    "diagnosis_hypothesis": (missing(plant({"worn_spot": SPOT | SPOT_IS}), "worn", True),
                             diagnosis),
    "reference_consistent": (against_healthy(plant(), "as_before"), diagnosis),
    "reference_mismatch": (against_healthy(LEAK, "leaking"), diagnosis),
    "reference_learned": (against_healthy(plant({"worn_spot": SPOT | SPOT_IS}), "worn"),
                          diagnosis),
    "reference_valve": (valve, diagnosis),
    "archive_estimate": (nights("estimate", 12, 4.0), table),
    "archive_diagnose": (nights("diagnose", 4, 6.0), table),
    "proof": (trial, lambda found, _: proof_page(*found)),
}
