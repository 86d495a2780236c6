"""Speed of `estimate` on a 60 s, 1 kHz bag with four topics, and of the filters alone.

    python benchmarks/estimate_speed.py [--rounds 7] [--record]

Everything is measured in one run: the whole command as a process of its own (Python's start and
imports included), reading and estimating inside a warm process, the two compiled stages, and what
they are compared with: the same stages on filterpy over the same samples, and a plain reading of
the same bag, in which rosbags hands over each message and numpy takes its last number.  Medians
with the smallest and the largest.
"""

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

from eha_monitor.estimation import reference_stages, stage_one, stage_two
from eha_monitor.estimation.inputs import StageInputs
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.estimation.stage_one import new_state_one
from eha_monitor.estimation.stage_two import new_state_two
from eha_monitor.estimation.stages import constants_one, constants_two, start_compliance
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
        self.start = start_compliance(self.inputs, settings, np.full(n, 600.0))
        self.out_one, self.out_two = np.empty((6, n)), np.empty((8, n))
        self.events = np.empty((200, 4))

    def compiled(self) -> None:
        """Run stage one, then stage two, over all samples."""
        self.compiled_one()
        self.compiled_two()

    def compiled_one(self) -> None:
        """Run stage one over all samples."""
        self._one(stage_one.run_one, len(self.inputs.x))

    def compiled_two(self) -> None:
        """Run stage two over all samples."""
        self._two(stage_two.run_two, len(self.inputs.x))

    def filterpy(self) -> None:
        """Run both stages on filterpy over the first samples."""
        self._one(reference_stages.run_one, FILTERPY_SAMPLES)
        self._two(reference_stages.run_two, FILTERPY_SAMPLES)

    def _one(self, run, n: int) -> None:
        constants = constants_one(self.inputs, self.settings)
        state = new_state_one(self.settings.stage_one.prior, constants.prior_variance)
        run(self.inputs.rows_one(n), constants, self.inputs.model.effects, state, 0, self.out_one,
            self.events)

    def _two(self, run, n: int) -> None:
        model, constants = self.inputs.model, constants_two(self.inputs, self.settings)
        run(self.inputs.rows_two(600.0, 0.01, n), constants, model.effects,
            new_state_two(model.hydraulics, *self.start), 0, self.out_two, self.events)


def read_plainly(bag: Path) -> float:
    """Read each message of a bag raw and the last number in it; returns their sum."""
    total = 0.0
    with Reader(bag) as reader:
        for _, _, data in reader.messages():
            total += np.frombuffer(data[-8:], "<f8")[0]
    return total


def main() -> None:
    """Print the table."""
    parser = record.options(__doc__)
    parser.add_argument("--rounds", type=int, default=7)
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
            "eha_monitor/estimation", "eha_monitor/physics", "eha_monitor/recordings"))


if __name__ == "__main__":
    main()
