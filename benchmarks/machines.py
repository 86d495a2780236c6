"""What is told of machines that are no pump-controlled actuator: valve, servo motor, pneumatics.

    python benchmarks/machines.py [--machines NAME ...] [--no-diagnose] [--record]

Each is simulated with the equations of a textbook (orifices of a servo valve and ISO 6358 of air,
polytropic chambers, a torque-controlled shaft), without and with dry friction, written as a CSV,
imported with its config in `config/`, estimated and diagnosed.  The truth is printed beside it.
"""

import sys
import tempfile
from dataclasses import dataclass
from math import pi
from pathlib import Path

import numpy as np
import record
from numba import njit
from rich.console import Console
from rich.table import Table
from stranger_parts.commands import ROOT, answer_of, shell, shown

MEASURES = ("eha_monitor/estimation", "eha_monitor/mismatch", "benchmarks/machines.py")
SECONDS, SUBSTEPS = 12.0, 40
ATMOSPHERE = 101_325.0
SMOOTH = 1e-3  # of the tanh of dry friction, m/s or rad/s


@dataclass(frozen=True)
class Machine:
    """One machine: config, truth, dry friction of its second recording."""

    words: str
    config: str
    damping: float
    dry: float
    unit: str
    simulate: object


@njit
def demand(t, tones):
    """Return a sum of sines (amplitude, Hz) and its rate."""
    x = v = 0.0
    ramp = min(t, 1.0)
    for k in range(tones.shape[0]):
        w = 2.0 * pi * tones[k, 1]
        x += tones[k, 0] * np.sin(w * t + k)
        v += tones[k, 0] * w * np.cos(w * t + k)
    return ramp * (x - 0.0), ramp * v


@njit
def orifice(drop, gain):
    """Return the flow of a sharp edge, m³/s, turbulent but near zero."""
    return gain * drop / (drop * drop + 1e8) ** 0.25


@njit
def valve_cylinder(rows, h, b, dry, tones):
    """Return (rows, 4) x, x_d, p1, p2 of a cylinder behind a critically lapped servo valve."""
    area, volume, mass, beta, supply, tank = 8.04e-4, 9e-5, 60.0, 8e8, 140e5, 1e5
    gain, lag, loop = 1.2e-4 / np.sqrt(35e5), 4e-3, 9.0
    x, v, p1, p2, u = 0.0, 0.0, 70e5, 70e5, 0.0
    out = np.empty((rows, 4))
    for row in range(rows):
        for k in range(SUBSTEPS):
            t = (row * SUBSTEPS + k) * h
            x_d, rate = demand(t, tones)
            wanted = (loop * (x_d - x) + rate) * area / (gain * np.sqrt(70e5))
            u += h / lag * (min(max(wanted, -1.0), 1.0) - u)
            q1 = u * orifice(supply - p1, gain) if u > 0 else u * orifice(p1 - tank, gain)
            q2 = u * orifice(p2 - tank, gain) if u > 0 else u * orifice(supply - p2, gain)
            leak = 2e-13 * (p1 - p2)
            p1 += h * beta / (volume + area * x) * (q1 - area * v - leak)
            p2 += h * beta / (volume - area * x) * (area * v - q2 + leak)
            v += h / mass * (area * (p1 - p2) - b * v - dry * np.tanh(v / SMOOTH))
            x += h * v
        out[row] = x, x_d, p1, p2
    return out


@njit
def air(up, down, conductance):
    """Return the mass flow of ISO 6358 from up to down (Pa), kg/s; b = 0.3, 293 K."""
    if up < down:
        return -air(down, up, conductance)
    ratio, critical = down / up, 0.3
    choked = conductance * 1.185 * up
    if ratio <= critical:
        return choked
    return choked * np.sqrt(max(0.0, 1.0 - ((ratio - critical) / (1.0 - critical)) ** 2))


@njit
def pneumatic_cylinder(rows, h, b, dry, tones):
    """Return (rows, 4) x, x_d and absolute p1, p2 of a pneumatic cylinder, 5/3 proportional."""
    a1, a2, half, dead, mass = 8.04e-4, 6.91e-4, 0.1, 2e-5, 4.0
    supply, gas, n, conductance, lag = 7e5, 287.0 * 293.0, 1.2, 1.5e-8, 5e-3
    x, v, u = 0.0, 0.0, 0.0
    p1 = 4e5
    p2 = (a1 * p1 - (a1 - a2) * ATMOSPHERE) / a2
    out = np.empty((rows, 4))
    for row in range(rows):
        for k in range(SUBSTEPS):
            t = (row * SUBSTEPS + k) * h
            x_d, rate = demand(t, tones)
            wanted = 12.0 * (x_d - x) + 1.2 * rate - 0.25 * v
            u += h / lag * (min(max(wanted, -1.0), 1.0) - u)
            size = conductance * abs(u)
            m1 = air(supply, p1, size) if u > 0 else -air(p1, ATMOSPHERE, size)
            m2 = -air(p2, ATMOSPHERE, size) if u > 0 else air(supply, p2, size)
            p1 += h * n / (dead + a1 * (half + x)) * (gas * m1 - p1 * a1 * v)
            p2 += h * n / (dead + a2 * (half - x)) * (gas * m2 + p2 * a2 * v)
            force = a1 * p1 - a2 * p2 - (a1 - a2) * ATMOSPHERE
            v += h / mass * (force - b * v - dry * np.tanh(v / SMOOTH))
            x += h * v
        out[row] = x, x_d, p1 - ATMOSPHERE, p2 - ATMOSPHERE
    return out


@njit
def servo_motor(rows, h, b, dry, tones):
    """Return (rows, 4) angle, its demand, torque, speed; rad, N·m; a PD drive."""
    inertia, lag = 2e-3, 1e-3
    x, v, torque = 0.0, 0.0, 0.0
    out = np.empty((rows, 4))
    for row in range(rows):
        for k in range(SUBSTEPS):
            t = (row * SUBSTEPS + k) * h
            x_d, rate = demand(t, tones)
            wanted = 40.0 * (x_d - x) + 0.5 * (rate - v)
            torque += h / lag * (min(max(wanted, -20.0), 20.0) - torque)
            v += h / inertia * (torque - b * v - dry * np.tanh(v / (20.0 * SMOOTH)))
            x += h * v
        out[row] = x, x_d, torque, v
    return out


SLOW = np.array([(0.02, 0.4), (5e-3, 1.7), (1.5e-3, 4.1)])
TURN = np.array([(3.0, 0.5), (0.8, 1.9), (0.2, 5.3)])
MACHINES = {
    "valve_cylinder": Machine("cylinder behind a servo valve, 140 bar", "valve_cylinder", 1200.0,
                              90.0, "N·s/m", valve_cylinder),
    "servo_motor": Machine("servo motor, measured torque", "servo_motor", 8e-3, 0.05,
                           "N·m·s/rad", servo_motor),
    "pneumatic_cylinder": Machine("pneumatic cylinder, 7 bar, gauge pressures",
                                  "pneumatic_cylinder", 80.0, 12.0, "N·s/m",
                                  pneumatic_cylinder),
}


def write(name: str, machine: Machine, dry: float, file: Path, seed: int) -> None:
    """Simulate a machine and write what its logger shows."""
    rng = np.random.default_rng([seed, len(name)])
    period = 2e-3 if name == "pneumatic_cylinder" else 1e-3
    rows = round(SECONDS / period)
    seen = machine.simulate(rows, period / SUBSTEPS, machine.damping, dry,
                            TURN if name == "servo_motor" else SLOW)
    t = np.arange(1, rows + 1) * period

    def noisy(values, noise, step):
        return step * np.round((values + noise * rng.standard_normal(rows)) / step)

    if name == "servo_motor":
        heads = "time_s,angle_deg,setpoint_deg,torque_Nm"
        columns = [t, np.degrees(noisy(seen[:, 0], 2e-5, 2 * pi / 2**18)), np.degrees(seen[:, 1]),
                   noisy(seen[:, 2], 5e-3, 1e-3)]
    else:
        noise = 200.0 if name == "pneumatic_cylinder" else 2e3
        heads = "time_s,position_mm,setpoint_mm,p_a_bar,p_b_bar"
        columns = [t, noisy(seen[:, 0], 1e-6, 1e-6) * 1e3, seen[:, 1] * 1e3,
                   noisy(seen[:, 2], noise, 50.0) * 1e-5, noisy(seen[:, 3], noise, 50.0) * 1e-5]
    np.savetxt(file, np.column_stack(columns), delimiter=",", header=heads, comments="",
               fmt="%.9g")


def tried(name: str, dry: float, folder: Path, seed: int, diagnose: bool) -> dict:
    """Import, estimate and diagnose one recording."""
    machine = MACHINES[name]
    stem = f"{name}_{'dry' if dry else 'viscous'}"
    file, bag = folder / f"{stem}.csv", folder / stem
    config = str(ROOT / "config" / f"{machine.config}.yaml")
    write(name, machine, dry, file, seed)
    imported = shell("import", str(file), "--map", config, "--out", str(bag))
    first, second = folder / f"{stem}.json", folder / f"{stem}_why.json"
    estimated = answer_of(shell("estimate", str(bag), "--config", config, "--json", str(first)),
                          first)
    found = {"machine": name, "dry": dry, "said": imported.out + imported.err,
             "B": estimated.parameters.get("B"), "beta": estimated.parameters.get("beta_e"),
             "model": estimated.model, "lines": estimated.lines}
    if diagnose:
        why = answer_of(shell("diagnose", str(bag), "--config", config, "--json", str(second)),
                        second)
        found |= {"verdict": why.verdict, "after": why.parameters.get("B"), "named": [
            f"{one['name']} " + ", ".join(f"{key} {value['value']:.4g}" for key, value
                                          in one["parameters"].items())
            for one in why.tree.get("effects", ())]}
    return found


def off(parameter: dict | None, truth: float) -> float:
    """Return the error in %."""
    value = (parameter or {}).get("value")
    return 100.0 * (value / truth - 1.0) if value else float("nan")


def main() -> int:
    """Run it and print its table."""
    parser = record.options(__doc__)
    parser.add_argument("--machines", nargs="+", choices=list(MACHINES), default=list(MACHINES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--no-diagnose", action="store_true")
    asked = parser.parse_args()
    table, figures = Table(title="machines that are no pump-controlled actuator"), {}
    for head in ("machine", "truth", "estimate B", "off", "model", "diagnose", "B then", "off"):
        table.add_column(head, overflow="fold")
    with tempfile.TemporaryDirectory(prefix="machines_") as folder:
        for name in asked.machines:
            machine = MACHINES[name]
            for dry in (0.0, machine.dry):
                one = tried(name, dry, Path(folder), asked.seed, not asked.no_diagnose)
                wrong, then = off(one["B"], machine.damping), off(one.get("after"),
                                                                 machine.damping)
                table.add_row(machine.words, f"B {machine.damping:g}, dry {dry:g}",
                              shown(one["B"]), f"{wrong:+.2f} %", one["model"],
                              f"{one.get('verdict', '–')}: {'; '.join(one.get('named', ()))}",
                              shown(one.get("after")), f"{then:+.2f} %")
                stem = f"{name}_{'dry' if dry else 'viscous'}"
                figures |= {f"{stem}_b": record.spread(wrong, "%"),
                            f"{stem}_then": record.spread(then, "%")}
                print(stem, one["said"].strip(), *one["lines"], sep="\n  ", file=sys.stderr)
    Console(width=170).print(table)
    if asked.record:
        record.write("machines", figures, MEASURES, held_by="commit")
    return 0


if __name__ == "__main__":
    sys.exit(main())
