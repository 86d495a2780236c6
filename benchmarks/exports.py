"""How far the exported FMU runs from the simulator, for several configs and communication steps.

    python benchmarks/exports.py [--record]

fmpy runs each FMU over 1.5 s of a multisine up to 6 Hz.  ``line``: the master gives x_d and its
rate at each communication point of 1 ms (fmi2SetRealInputDerivatives); ``held``: x_d alone, as
Simulink and ``fmpy.simulate_fmu`` do, which makes it half a communication step late.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import record

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "test"))

from export_tools import CASES, SECONDS, demand, model_of, own_run  # noqa: E402
from test_export_fmu import OUTPUTS, Slave, apart  # noqa: E402

from eha_monitor.exports.fmu import fmu_of  # noqa: E402

MEASURES = ("eha_monitor/exports", "eha_monitor/physics")
DT = 1e-3


def main() -> None:
    """Export, run, compare, print, and record if asked."""
    asked = record.options(__doc__).parse_args()
    samples, line, cost = round(SECONDS / DT), [], []
    with tempfile.TemporaryDirectory() as folder:
        for name, effects in CASES.items():
            model, path = model_of(effects), Path(folder) / "one.fmu"
            path.write_bytes(fmu_of(model, {}, ("linux64",)).content)
            wanted = own_run(model, samples)
            begin = time.perf_counter()
            found = driven(path, model, samples, 1)
            cost.append((time.perf_counter() - begin) / SECONDS)
            errors = {output: 100.0 * apart(found[:, j], wanted[output])
                      for j, output in enumerate(OUTPUTS)}
            line.append(max(errors.values()))
            print(f"{name:22s} line 1 ms: " + ", ".join(
                f"{output} {error:.4f} %" for output, error in errors.items()))
        model = model_of(CASES["identified"])
        path.write_bytes(fmu_of(model, {}, ("linux64",)).content)
        wanted, held = own_run(model, samples), {}
        for key, every in (("held_1ms", 1), ("held_0_1ms", 10)):
            found = driven(path, model, samples, every, held=True)
            held[key] = {output: 100.0 * apart(found[:, j], wanted[output])
                         for j, output in enumerate(OUTPUTS[:5])}
            print(f"identified, {key}: " + ", ".join(
                f"{output} {error:.3f} %" for output, error in held[key].items()))
    if asked.record:
        record.write("exports", {
            "line": record.spread(line, "%"), "cost": record.spread(np.array(cost) * 100, "%"),
            **{f"{key}_{output}": record.spread(held[key][output], "%")
               for key in held for output in ("x", "p1", "omega")}}, MEASURES, held_by="commit")


def driven(path: Path, model, samples: int, every: int, held: bool = False) -> np.ndarray:
    """Return the outputs at each sample, with ``every`` communication steps in it."""
    step = DT / every
    u = demand(model, np.arange(samples * every + 1) * step)
    with Slave(path) as slave:
        slave.start(x_d=float(u[0]))
        if not held:
            return slave.run("x_d", u, step)[::every]
        rows = []
        for k in range(samples * every):
            if k % every == 0:
                rows.append(slave.get(*OUTPUTS))
            slave.set(x_d=u[k])
            slave.fmu.doStep(k * step, step)
        return np.array(rows)


if __name__ == "__main__":
    main()
