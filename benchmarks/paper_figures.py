"""Fig. 7 and Fig. 16: ten values recovered, against the Cramer-Rao bound of each recording.

    python benchmarks/paper_figures.py [--seeds 200] [--record]

For each value 200 draws of sensor noise (1 um, 500 Pa, 0.1 rad/s) are estimated.  The first draw
goes through a bag on disk.  The bounds come from finite differences of the simulator, not from the
filters:

* B: from x, p1, p2 of the recording, with beta_e unknown;
* beta_e: from x given x_d, which is what Eq. 5 uses, with B as well known as x, p1, p2 tell;
* joint: both from x, p1, p2 given x_d.
"""

import tempfile
from pathlib import Path

import numpy as np
import record
from rich.console import Console
from rich.progress import track
from rich.table import Table

from eha_monitor.estimation.pipeline import estimate
from eha_monitor.physics import signals
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import Settings, settings_from_tree

DAMPINGS = (300.0, 400.0, 600.0, 1200.0, 1800.0)
MODULI = (6e7, 3e8, 4.5e8, 6e8, 8e8)
TRIANGLE = {"kind": "triangle", "amplitude": 0.04, "frequency": 0.25, "duration": 24.0}
SINE = {"kind": "sine", "amplitude": 0.01, "frequency": 4.0, "duration": 8.0}
SIGMA_X, SIGMA_P = 1e-6, 500.0


def settings_of(motion: dict, **rig: float) -> Settings:
    """Return the paper's rig with other constants and one stretch of motion."""
    return settings_from_tree(
        {"rig": rig, "simulation": {"excitation": {"motion": motion}}}, "benchmark")


def truth_of(motion: dict, **rig: float) -> np.ndarray:
    """Return the noise-free signals (n, N_SIGNALS)."""
    return Simulator(settings_of(motion, **rig)).advance_truth(round(motion["duration"] * 1e3))


def sensitivity(motion: dict, rig: dict[str, float], key: str) -> tuple[np.ndarray, np.ndarray]:
    """Return d x/d key and d (p1, p2)/d key, each over its noise, by central differences."""
    h = 1e-3 * rig[key]
    up, down = (truth_of(motion, **{**rig, key: rig[key] + s * h}) for s in (1, -1))
    slope = (up - down) / (2 * h)
    return slope[:, signals.X] / SIGMA_X, slope[:, [signals.P1, signals.P2]].ravel() / SIGMA_P


def bounds(motion: dict, rig: dict[str, float]) -> dict[str, float]:
    """Return the Cramer-Rao bounds: B, beta_e (as Eq. 5 may use the data), beta_e jointly."""
    pairs = [sensitivity(motion, rig, key) for key in ("viscous_damping", "bulk_modulus")]
    position = np.array([[a[0] @ b[0] for a in pairs] for b in pairs])
    pressure = np.array([[a[1] @ b[1] for a in pairs] for b in pairs])
    scale = np.array([rig["viscous_damping"], rig["bulk_modulus"]])  # for the inversion

    def bound(fisher: np.ndarray) -> np.ndarray:
        return scale * np.sqrt(np.diag(np.linalg.inv(fisher * np.outer(scale, scale))))

    damping_only = np.zeros((2, 2))
    damping_only[0, 0] = pressure[0, 0]
    everything = bound(position + pressure)
    return {"B": everything[0], "beta_e": bound(position + damping_only)[1],
            "joint beta_e": everything[1]}


def case(name: str, motion: dict, rig: dict[str, float], seeds: int, console: Console,
         folder: Path) -> list[tuple]:
    """Estimate one value ``seeds`` times; return rows of the table."""
    settings = settings_of(motion, **rig)
    values: dict[str, list] = {}
    for seed in track(range(seeds), f"{name}", console=console, transient=True,
                      disable=not console.is_terminal):
        # Each value has draws of its own, so that the rows of the table are independent.
        draw = np.random.SeedSequence([seed, int(sum(rig.values()))]).generate_state(1)[0]
        recording = Recording(1e-3, Simulator(settings, seed=int(draw)).advance(
            round(motion["duration"] * 1e3)))
        if seed == 0:
            bag = folder / name.replace(" ", "_")
            write_recording(bag, recording, Settings())
            recording = read_recording(bag, Settings())
        found = estimate(recording, Settings())
        parts = {"B": found.parameters["B"], "beta_e": found.parameters["beta_e"],
                 "joint beta_e": found.joint.parameters["beta_e"]}
        for key, parameter in parts.items():
            values.setdefault(key, []).append((parameter.value, parameter.stddev))
        values.setdefault("consistent", []).append(found.model.status == "consistent")
    limit = bounds(motion, rig)
    wanted = ["B"] if motion is TRIANGLE else ["beta_e", "joint beta_e"]
    rows = []
    for key in wanted:
        true = rig["viscous_damping"] if key == "B" else rig["bulk_modulus"]
        v, s = np.array(values[key]).T
        error = v - true
        rows.append((name, key, true, v[0], 100 * (v[0] / true - 1),
                     100 * np.abs(error).max() / true, 100 * limit[key] / true,
                     np.sqrt(np.mean(error**2)) / limit[key],
                     100 * np.mean(np.abs(error) <= 2 * s),
                     100 * np.mean(values["consistent"])))
    return rows


def main() -> None:
    """Print the table."""
    parser = record.options(__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    given = parser.parse_args()
    seeds = given.seeds
    console = Console(width=132)
    table = Table(title=f"Fig. 7 and Fig. 16, {seeds} draws of 1 µm and 500 Pa each")
    for head in ("case", "what", "truth", "first (bag)", "error %", "worst %", "bound %",
                 "RMS/bound", "in ±2σ %", "consistent %"):
        table.add_column(head, justify="left" if head in ("case", "what") else "right")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for b in DAMPINGS:
            rig = {"viscous_damping": b, "bulk_modulus": 6e8}
            rows += case(f"Fig. 7 B={b:g}", TRIANGLE, rig, seeds, console, Path(folder))
        for beta in MODULI:
            rig = {"viscous_damping": 600.0, "bulk_modulus": beta}
            rows += case(f"Fig. 16 βe={beta:g}", SINE, rig, seeds, console, Path(folder))
    for row in rows:
        table.add_row(*_text(row))
    console.print(table)
    if given.record:
        record.write("accuracy", {"draws": record.spread(seeds)} | recorded(rows),
                     ("eha_monitor/estimation", "eha_monitor/physics"), held_by="commit")


def recorded(rows: list[tuple]) -> dict[str, dict]:
    """Return the figures, each over the five values of one parameter."""
    figures = {}
    for key in ("B", "beta_e", "joint beta_e"):
        worst, over_bound, inside, consistent = np.array(
            [[row[5], *row[7:10]] for row in rows if row[1] == key]).T
        name = key.replace(" ", "_")
        figures |= {f"{name}_worst": record.spread(worst, "%"),
                    f"{name}_over_bound": record.spread(over_bound),
                    f"{name}_inside": record.spread(inside, "%"),
                    f"{name}_consistent": record.spread(consistent, "%")}
    return figures


def _text(row: tuple) -> list[str]:
    return [*row[:2], f"{row[2]:.3g}", f"{row[3]:.5g}", f"{row[4]:+.3f}", f"{row[5]:.3f}",
            f"{row[6]:.4f}", f"{row[7]:.2f}", f"{row[8]:.1f}", f"{row[9]:.1f}"]


if __name__ == "__main__":
    main()
