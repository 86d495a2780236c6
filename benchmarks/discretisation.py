"""What the printed forward Euler of Eq. 4 and 5 costs against an exact step.

    python benchmarks/discretisation.py [--figure docs/images/discretisation.png] [--record]

The paper's sine (4 Hz, 10 mm, 8 s) at several true bulk moduli and position noises, estimated
with `discretisation: exact` and with `discretisation: euler`; also the largest pole of Eq. 5.
"""

from pathlib import Path

import numpy as np
import record
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from eha_monitor.estimation.pipeline import Estimate, estimate
from eha_monitor.estimation.reference_stages import Printed, printed_step
from eha_monitor.physics.parameters import theta_of
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import Settings, settings_from_tree

MODULI = (6e7, 3e8, 4.5e8, 6e8, 8e8)
NOISES = (1e-6, 1e-5)


def largest_pole(beta: float) -> float:
    """Return the largest modulus of the poles of Eq. 5 at 1 ms, beta_e held."""
    theta, _ = theta_of(Settings().rig, {})
    f = np.empty((4, 4))
    printed_step(np.array([0.0, 0.0, 0.0, beta]), 600.0, 0.0, Printed.of(theta, 20.0, 1e-3), f)
    return float(np.abs(np.linalg.eigvals(f[:3, :3])).max())


def recording_of(beta: float, noise: float) -> Recording:
    """Return the paper's sine at a bulk modulus and a position noise."""
    settings = settings_from_tree(
        {"rig": {"bulk_modulus": beta},
         "simulation": {"noise": {"position": noise}, "excitation": {
             "sine": {"kind": "sine", "frequency": 4.0, "amplitude": 0.01}}}}, "benchmark")
    return Recording(1e-3, Simulator(settings).advance(8000))


def main() -> None:
    """Print the table and draw the figure."""
    parser = record.options(__doc__)
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args()
    figures = {}
    table = Table(title="βe found, in MPa, on the paper's sine; B true is 600 N·s/m")
    for head in ("true", "largest pole (Euler)", "noise µm", "exact", "Euler", "Euler error %",
                 "B exact", "B Euler"):
        table.add_column(head, justify="right")
    figure = Figure(figsize=(9, 4), dpi=160, layout="tight")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2, sharey=True)
    for beta in MODULI:
        for noise, axis in zip(NOISES, axes, strict=True):
            recording = recording_of(beta, noise)
            exact = estimate(recording, Settings())
            euler = estimate(recording, settings_from_tree({"discretisation": "euler"}, "b"))
            values = [e.parameters["beta_e"].value for e in (exact, euler)]
            table.add_row(
                f"{beta / 1e6:.0f}", f"{largest_pole(beta):.4f}", f"{noise * 1e6:.0f}",
                f"{values[0] / 1e6:.1f}", f"{values[1] / 1e6:.1f}",
                f"{100 * (values[1] / beta - 1):+.0f}",
                f"{exact.parameters['B'].value:.1f}", f"{euler.parameters['B'].value:.1f}")
            figures |= recorded(f"{beta / 1e6:.0f}_{noise * 1e6:.0f}", exact, euler)
            figures[f"pole_{beta / 1e6:.0f}"] = record.spread(largest_pole(beta))
            line = {"color": f"C{MODULI.index(beta)}"}
            axis.axhline(beta / 1e6, ls=":", lw=1, **line)
            for stage, style in ((exact.stage_two, "-"), (euler.stage_two, "--")):
                axis.plot(stage.time[::20], stage.value[::20] / 1e6, style, lw=1.3, **line)
            axis.set_title(f"position noise {noise * 1e6:.0f} µm")
            axis.set_xlabel("time, s")
    axes[0].set_ylim(0, 1200)
    axes[0].set_ylabel("effective bulk modulus, MPa")
    axes[1].plot([], [], "k-", label="exact step")
    axes[1].plot([], [], "k--", label="Eq. 5 as printed (Euler)")
    axes[1].plot([], [], "k:", label="true")
    axes[1].legend(loc="upper right", framealpha=1)
    Console(width=110).print(table)
    if given.figure is not None:
        figure.savefig(given.figure)
        print(given.figure)
    if given.record:
        record.write("discretisation", figures, ("eha_monitor/estimation", "eha_monitor/physics"))


def recorded(case: str, exact: Estimate, euler: Estimate) -> dict[str, dict]:
    """Return the figures of one recording: beta_e in MPa, B of the printed equations."""
    mega = [found.parameters["beta_e"].value / 1e6 for found in (exact, euler)]
    return {f"exact_{case}": record.spread(mega[0], "MPa"),
            f"euler_{case}": record.spread(mega[1], "MPa"),
            f"euler_B_{case}": record.spread(euler.parameters["B"].value, "N·s/m")}


if __name__ == "__main__":
    main()
