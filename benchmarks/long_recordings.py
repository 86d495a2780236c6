"""Processor time and peak memory of the commands on recordings of a minute to an hour.

Every command is a process of its own; its peak is the largest resident set that the system saw,
start of Python and libraries included.  ``record`` is the recorder's writer with four topics at
1 kHz, one message at a time, as fast as it goes: what a live one adds is ROS.

    python benchmarks/long_recordings.py --minutes 1 4 16 60 --record
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import record

COMMANDS = ("simulate", "estimate", "diagnose", "record")
MEASURES = ("eha_monitor/recordings", "eha_monitor/estimation", "eha_monitor/mismatch",
            "eha_monitor/commands")
# s of processor for an hour (diagnose: of 1 and 4 minutes), and MB, as asked.
ASKED = {"simulate": 60.0, "estimate": 15.0, "diagnose": 30.0}
ASKED_MB = 500.0


def main() -> None:
    """Measure, print, and record if asked."""
    options = record.options(__doc__)
    options.add_argument("--minutes", type=int, nargs="+", default=[1, 4, 16, 60])
    options.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    options.add_argument("--folder", type=Path, help="of the bags; 0.5 GB for an hour")
    options.add_argument("--write", nargs=2, metavar=("MINUTES", "BAG"), help=argparse.SUPPRESS)
    asked = options.parse_args()
    if asked.write:
        write_messages(int(asked.write[0]), Path(asked.write[1]))
        return
    figures = {}
    with tempfile.TemporaryDirectory(dir=asked.folder, prefix="long_") as place:
        warm(Path(place))
        for minutes in asked.minutes:
            figures |= measured(minutes, asked.commands, Path(place))
    if asked.record:
        figures["asked_mb"] = record.spread(ASKED_MB, "MB")
        figures |= {f"asked_{name}": record.spread(value, "s") for name, value in ASKED.items()}
        record.write("long", figures, MEASURES, held_by="commit")


def measured(minutes: int, commands: list[str], place: Path) -> dict[str, dict]:
    """Return the figures of one length."""
    bag, figures = place / "bag", {}
    for name in ("simulate", *(one for one in commands if one != "simulate")):
        words = {
            "simulate": ["simulate", "--out", bag, "--duration", str(60 * minutes), "--seed", "1",
                         "--overwrite"],
            "estimate": ["estimate", bag, "--json", place / "answer.json"],
            "diagnose": ["diagnose", bag, "--json", place / "answer.json"]}.get(name)
        if words is None:
            processor, peak = cost([sys.executable, __file__, "--write", str(minutes),
                                    place / "recorded"])
            shutil.rmtree(place / "recorded")
        else:
            processor, peak = cost([sys.executable, "-m", "eha_monitor", *words])
        if name in commands:
            print(f"{name:9s} {minutes:3d} min  {processor:6.1f} s of processor  {peak:5.0f} MB",
                  flush=True)
            figures[f"{name}_s_{minutes}"] = record.spread(processor, "s")
            figures[f"{name}_mb_{minutes}"] = record.spread(peak, "MB")
    return figures


def cost(words: list) -> tuple[float, float]:
    """Run a process; return its processor time, s, and its peak resident set, MB."""
    child = subprocess.Popen([str(word) for word in words], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"{' '.join(map(str, words))}: exit status {child.returncode}")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def warm(place: Path) -> None:
    """Have compiled what is compiled once, as `make setup` does."""
    run = [sys.executable, "-m", "eha_monitor"]
    cost([*run, "simulate", "--out", place / "warm", "--duration", "10", "--seed", "1"])
    for command in ("estimate", "diagnose"):
        cost([*run, command, place / "warm", "--json", place / "warm.json"])


def write_messages(minutes: int, bag: Path) -> None:
    """Write what a recorder would, message by message."""
    from eha_monitor.recordings.write import BagWriter, messages_of

    noise = np.random.default_rng(0).normal(size=(5, 1000))
    stamps = 10**6 * np.arange(1000)
    streams = messages_of(dict(zip(("x", "x_d", "omega", "p1", "p2"), noise, strict=True)),
                          stamps, "/eha")
    messages = [[row.tobytes() for row in one.data] for one in streams]
    with BagWriter(bag, {one.topic: one.msgtype for one in streams}) as writer:
        for second in range(60 * minutes):
            for k in range(1000):
                for one, rows in zip(streams, messages, strict=True):
                    writer.write_raw(one.topic, 10**18 + 10**9 * second + 10**6 * k, rows[k])


if __name__ == "__main__":
    main()
