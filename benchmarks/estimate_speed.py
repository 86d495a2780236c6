"""Speed of `estimate` on a 60 s, 1 kHz bag with four topics, and of the filters alone.

    python benchmarks/estimate_speed.py [--rounds 7] [--record]

Everything is measured in one run: the whole command as a process of its own (Python's start and
imports included), reading and estimating inside a warm process, the two compiled stages, and what
they are compared with: the same stages on filterpy over the same samples, and a plain reading of
the same bag, in which rosbags hands over each message and numpy takes its last number.  Medians
with the smallest and the largest.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import record
from rich.console import Console
from rich.table import Table
from rosbags.rosbag2 import Reader

from eha_monitor.filters import filterpy_stages, kernel_one, kernel_two
from eha_monitor.filters.inputs import StageInputs
from eha_monitor.filters.known import new_known_memory
from eha_monitor.filters.pipeline import estimate
from eha_monitor.filters.run_two import start_compliance
from eha_monitor.filters.supervision import new_supervision
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import Settings

SECONDS = 60.0
FILTERPY_SAMPLES = 3000


def timed(run: Callable[[], None], rounds: int) -> np.ndarray:
    """Return ``rounds`` wall times in s after one run that is not counted."""
    run()
    times = []
    for _ in range(rounds):
        started = time.perf_counter()
        run()
        times.append(time.perf_counter() - started)
    return np.array(times)


class Stages:
    """Both stages over one recording, compiled and on filterpy."""

    def __init__(self, recording: Recording, settings: Settings):
        self.settings = settings
        self.inputs = StageInputs.of(recording, settings)
        n = len(recording)
        self.b, self.b_variance = np.full(n, 600.0), np.full(n, 0.01)
        self.start = start_compliance(self.inputs, settings, self.b)
        self.out_one, self.out_two = np.empty((6, n)), np.empty((8, n))
        self.events = np.empty((200, 4))

    def compiled(self) -> None:
        """Run stage one, then stage two, over all samples."""
        self.compiled_one()
        self.compiled_two()

    def compiled_one(self) -> None:
        """Run stage one over all samples."""
        self._one(kernel_one.run_one, len(self.inputs.x))

    def compiled_two(self) -> None:
        """Run stage two over all samples."""
        self._two(kernel_two.run_two, len(self.inputs.x))

    def filterpy(self) -> None:
        """Run both stages on filterpy over the first samples."""
        self._one(filterpy_stages.run_one, FILTERPY_SAMPLES)
        self._two(filterpy_stages.run_two, FILTERPY_SAMPLES)

    def _one(self, run, n: int) -> None:
        i, s = self.inputs, self.settings
        model, force = i.model, i.force
        p = np.zeros(6)
        p[5] = s.stage_one.prior_stddev**2
        run(i.x[:n], force.start[:n], force.end[:n], force.variance[:n], i.p1[:n], i.p2[:n], i.dt,
            s.rig.mass, i.position_variance, p[5], False, model.theta, model.plain,
            model.remembering, new_known_memory(), np.array([np.nan, 0.0, s.stage_one.prior]), p,
            new_supervision(), 0, self.out_one, self.events)

    def _two(self, run, n: int) -> None:
        i = self.inputs
        model, drive = i.model, i.drive
        q = np.zeros((4, 4))
        q[3, 3] = self.start[1]
        run(i.x[:n], drive.start[:n], drive.end[:n], drive.variance[:n], drive.instrument[:n],
            self.b[:n], self.b_variance[:n], model.hydraulics, model.leak, i.leak_flow[:n], i.dt,
            i.position_variance, 0.0, 4.0, i.mean[:n], model.theta, model.plain,
            model.remembering, model.flows, new_known_memory(),
            np.array([np.nan, 0.0, 0.0, self.start[0]]), q, np.zeros(4), new_supervision(),
            *kernel_two.new_step(model.hydraulics), 0, self.out_two, self.events)


def read_plainly(bag: Path) -> float:
    """Read each message of a bag raw and the last number in it; returns their sum."""
    total = 0.0
    with Reader(bag) as reader:
        for _, _, data in reader.messages():
            total += np.frombuffer(data[-8:], "<f8")[0]
    return total


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    record.add_option(parser)
    given = parser.parse_args()
    rounds = given.rounds
    settings = Settings()
    recording = Recording(1e-3, Simulator(settings).advance(round(SECONDS * 1e3)))
    program = [sys.executable, "-m", "eha_monitor"]
    with tempfile.TemporaryDirectory() as folder:
        bag, answer = Path(folder) / "bag", Path(folder) / "answer.json"
        write_recording(bag, recording, settings)
        command = [*program, "estimate", str(bag)]
        stages = Stages(recording, settings)
        rows = {
            "help": ("--help, whole process", 0.0, timed(
                lambda: subprocess.run([*program, "--help"], check=True, capture_output=True),
                rounds)),
            "process": ("estimate, whole process", SECONDS, timed(
                lambda: subprocess.run(command, check=True, capture_output=True), rounds)),
            "plain_reading": ("read the bag plainly", SECONDS, timed(
                lambda: read_plainly(bag), rounds)),
            "reading": ("read the bag", SECONDS, timed(
                lambda: read_recording(bag, settings), rounds)),
            "warm": ("read the bag + estimate, in a process", SECONDS, timed(
                lambda: estimate(read_recording(bag, settings), settings), rounds)),
            "one": ("stage one, compiled", SECONDS, timed(stages.compiled_one, 4 * rounds)),
            "two": ("stage two, compiled", SECONDS, timed(stages.compiled_two, 4 * rounds)),
            "both": ("both stages, compiled", SECONDS, timed(stages.compiled, 4 * rounds)),
            "filterpy": ("both stages, filterpy", FILTERPY_SAMPLES * 1e-3,
                         timed(stages.filterpy, 3)),
        }
        subprocess.run([*command, "--json", str(answer)], check=True, capture_output=True)
        reported = json.loads(answer.read_text())["wall_s"]
    table = Table(title="60 s, 1 kHz, joint_states + command + two pressures (240 000 messages)")
    for head in ("what", "median s", "min", "max", "times real time"):
        table.add_column(head, justify="left" if head == "what" else "right")
    for what, seconds, times in rows.values():
        middle = np.median(times)
        table.add_row(what, f"{middle:.4f}", f"{times.min():.4f}", f"{times.max():.4f}",
                      f"{seconds / middle:,.0f}")
    console = Console(width=110)
    console.print(table)
    plain = np.median(rows["filterpy"][2]) / rows["filterpy"][1]
    faster = plain / (rows["both"][2] / SECONDS)
    console.print(f"compiled against filterpy: {np.median(faster):,.0f} times faster; "
                  f"wall_s that the command reports of itself: {reported:.2f} s")
    if given.record:
        figures = {f"{key}_s": record.spread(times, "s") for key, (_, _, times) in rows.items()}
        figures |= {key: record.spread(seconds / times, "times real time")
                    for key, (_, seconds, times) in rows.items() if seconds}
        figures["over_filterpy"] = record.spread(faster, "times as fast")
        figures["over_plain_reading"] = record.spread(
            np.median(rows["plain_reading"][2]) / rows["reading"][2], "times as fast")
        figures["wall_s"] = record.spread(reported, "s")
        record.write("speed", figures, (
            "eha_monitor/filters", "eha_monitor/physics", "eha_monitor/recordings"))


if __name__ == "__main__":
    main()
