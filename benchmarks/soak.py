"""The live monitor under faults of its inputs: each must be named, and pass without harm.

    python benchmarks/soak.py --minutes 10 --seed 0 [--record]

A publisher process sends the simulated actuator at 1 kHz on the four input topics; now and then
one of the faults below lasts some seconds, with at least 12 s of calm after it.  The monitor is
a real process; this one looks on.  Demanded of each fault: a diagnostic that is not OK names it
within 2 s; B and the bulk modulus are published again, within 5 % of the truth, within 10 s of its
end; no status is ever ERROR, as the plant is well (that the monitor cannot keep up, at ten times
the rate, is no word on the plant).  The monitor must live, and its memory must not grow.  The exit
status is 1 if one of these is missed.
"""

import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import numpy as np
import record

from eha_monitor.health.overload import OVERLOADED

NAMESPACE = "/eha"
TRUTH = {"viscous_damping": 600.0, "bulk_modulus": 6e8}
WITHIN = 0.05
NAMED_S, RECOVERED_S = 2.0, 10.0
FRESH_S = 1.0  # estimates come ten times a second
SLOPE = 2.0  # MB/min over the second half that is still no growth
# What a diagnostic must say of each.
WORDS = {
    "killed": "nothing (new|on|received)|no publisher",
    "dropped": "missing", "duplicated": "repeat", "late": "after their stamp|wait no longer",
    "out_of_order": "out of order", "clock_back": "jumped back", "nan": "NaN|no number",
    "frozen": "not changed", "joint_names": "no entry named", "qos": "QoS",
    "rate_10": "times as (fast|often)"}


@dataclass
class Fault:
    """One fault as it was; times in s, monotonic."""

    kind: str
    begin: float
    end: float = np.inf
    detail: str = ""


@dataclass
class Seen:
    """What the monitor published; times in s, monotonic."""

    health: list = field(default_factory=list)
    estimates: dict = field(default_factory=lambda: {name: [] for name in TRUTH})
    memory: list = field(default_factory=list)


class Child:
    """The publisher process and what it says."""

    def __init__(self, seed: int):
        self.process = subprocess.Popen(
            [sys.executable, "benchmarks/soak_parts/faulty_publisher.py", str(seed)],
            cwd=record.ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.said: list[tuple[float, str]] = []
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        for line in self.process.stdout:
            self.said.append((time.monotonic(), line.strip()))

    def tell(self, line: str) -> None:
        """Send a command."""
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def kill(self) -> None:
        """End it as a crash would."""
        self.process.kill()
        self.process.wait()


def main() -> int:
    """Run the soak; the exit status is 1 if a demand is missed."""
    options = record.options(__doc__)
    options.add_argument("--minutes", type=float, default=10.0)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--kinds", nargs="+", choices=list(WORDS), default=list(WORDS))
    options.add_argument("--log", type=Path, help="write what was seen to a JSON file")
    given = options.parse_args()
    # No pipe for its log: an hour fills one, and whoever writes on waits for a reader.
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile(mode="w+") as log:
        record.own_graph(folder)
        faults, seen, status, said = soak(given.minutes * 60.0, given.seed, given.kinds, log)
    if given.log:
        given.log.write_text(json.dumps({"faults": [vars(f) for f in faults], **vars(seen)}))
    print(f"{given.minutes:g} min, seed {given.seed}, load {os.getloadavg()[1]:.1f} on "
          f"{os.cpu_count()} cores")
    missed, figures = report(faults, seen, status, said)
    if given.record:
        record.write("soak", figures, tuple(f"eha_monitor/{room}" for room in (
            "estimation", "live", "health", "ros")), held_by="commit")
    return int(missed)


def soak(duration: float, seed: int, kinds: list[str], log: TextIO
         ) -> tuple[list[Fault], Seen, int | None, str]:
    """Run monitor and publisher; return faults, what was seen, exit status, last words."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from std_msgs.msg import Float64

    from eha_monitor.ros.messages import findings_of
    from eha_monitor.ros.topics import LATCHED

    seen, faults = Seen(), []
    monitor = subprocess.Popen([sys.executable, "-X", "faulthandler", "-m", "eha_monitor",
                                "monitor"], cwd=record.ROOT, text=True, stdout=subprocess.PIPE,
                               stderr=log)
    rclpy.init()
    node = rclpy.create_node("soak", namespace=NAMESPACE)
    node.create_subscription(
        DiagnosticArray, "monitor/health", lambda m: seen.health.append(
            (time.monotonic(), [(f.name, f.level, f.message) for f in findings_of(m)])), LATCHED)
    for name in TRUTH:
        node.create_subscription(Float64, f"monitor/{name}", lambda m, name=name: (
            seen.estimates[name].append((time.monotonic(), m.data))), 10)

    def look_on(until: float, done=lambda: False) -> None:
        while time.monotonic() < until and not done() and monitor.poll() is None:
            rclpy.spin_once(node, timeout_sec=0.05)
            if not seen.memory or time.monotonic() - seen.memory[-1][0] > 1.0:
                seen.memory.append((time.monotonic(), resident(monitor.pid)))

    child = Child(seed)
    try:
        look_on(time.monotonic() + 180.0, lambda said=child.said: said)
        begin = time.monotonic()
        look_on(begin + 15.0)
        draw, round_ = random.Random(seed), []
        while monitor.poll() is None and time.monotonic() - begin < duration - 18.0:
            if not round_:
                round_ = draw.sample(kinds, len(kinds))
            fault = Fault(round_.pop(), time.monotonic())
            faults.append(fault)
            heard = len(child.said)
            length = draw.uniform(2.5, 5.0)
            if fault.kind == "killed":
                child.kill()
                look_on(fault.begin + length)
                child = Child(draw.randrange(1000))
                look_on(time.monotonic() + 60.0, lambda said=child.said: said)
            else:
                child.tell(f"{fault.kind} {draw.randrange(10**6)}")
                # A starved publisher answers late: the fault begins when it says so.
                look_on(fault.begin + 20.0, lambda: len(child.said) > heard)  # noqa: B023
                if len(child.said) > heard:
                    fault.begin, fault.detail = child.said[heard]
                look_on(fault.begin + length)
                child.tell("calm")
            fault.end = fault.begin if fault.kind == "clock_back" else time.monotonic()
            look_on(time.monotonic() + draw.uniform(12.0, 14.0))
        status = monitor.poll()
        if status is None:
            monitor.send_signal(signal.SIGINT)
        try:
            said, _ = monitor.communicate(timeout=60)
        except subprocess.TimeoutExpired:  # it hangs: where, says faulthandler
            monitor.send_signal(signal.SIGABRT)
            said, _ = monitor.communicate()
        log.seek(0)
        wrong = log.read()
        status = monitor.returncode if status is None else status
        if "Traceback" in wrong or "most recent call first" in wrong:
            print(wrong.partition("Extension modules")[0][-4000:], file=sys.stderr)
            status = status or 1
    finally:
        child.kill()
        if monitor.poll() is None:
            monitor.kill()
        node.destroy_node()
        rclpy.try_shutdown()
    return faults, seen, status, said.strip()


def resident(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    try:
        text = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return np.nan
    found = re.search(r"VmRSS:\s+(\d+)", text)
    return int(found[1]) / 1024 if found else np.nan


def report(faults: list[Fault], seen: Seen, status: int | None, said: str
           ) -> tuple[bool, dict[str, dict]]:
    """Print the table; return whether a demand is missed, and the figures to record."""
    print(f"{'fault':<13} {'times':>5} {'named s':>8} {'recovered s':>12} {'cleared s':>10} "
          f"{'ERRORs':>7}")
    missed, rows = [], {}
    ends = [*[fault.begin for fault in faults[1:]], np.inf]
    for fault, until in zip(faults, ends, strict=True):
        named, cleared = named_after(fault, seen, until)
        back = recovered_after(fault, seen, until)
        errors = sorted({f"{name}: {message}" for at, found in seen.health
                         for name, level, message in found
                         if level == "ERROR" and OVERLOADED not in message
                         and fault.begin <= at < until})
        rows.setdefault(fault.kind, []).append((named, back, cleared, len(errors)))
        for what, bad in (("not named", named > NAMED_S), ("not recovered", back > RECOVERED_S),
                          ("ERROR", bool(errors))):
            if bad:
                missed.append(f"{fault.kind} {fault.detail}: {what} (named {named:.1f}, recovered "
                              f"{back:.1f} s) {'; '.join(errors)[:300]}")
    for kind, found in rows.items():
        named, back, cleared, errors = (np.array(column, float)
                                        for column in zip(*found, strict=True))
        print(f"{kind:<13} {len(found):5d} {named.max():8.1f} {back.max():12.1f} "
              f"{cleared.max():10.1f} {errors.sum():7.0f}")
    time_s, memory = np.array(seen.memory).T
    later = time_s > (time_s[0] + time_s[-1]) / 2
    later &= np.isfinite(memory)
    slope = 60.0 * np.polyfit(time_s[later], memory[later], 1)[0]
    print(f"memory        {memory[later].mean():.0f} MB over the second half, at most "
          f"{np.nanmax(memory):.0f} MB, slope {slope:+.2f} MB/min")
    print(f"monitor       exit status {status}; {said}")
    long_enough = time_s[-1] - time_s[0] > 300.0  # before, its buffer of two minutes fills
    if slope > SLOPE and long_enough:
        missed.append(f"memory grows by {slope:.1f} MB/min")
    if status != 0:
        missed.append(f"the monitor ended with {status}")
    for line in missed:
        print("MISSED", line)
    every = np.array([one for found in rows.values() for one in found], float).reshape(-1, 4)
    share = re.search(r"CPU share ([\d.]+) %", said)
    figures = {
        "faults": (len(every),), "named": (np.sum(every[:, 0] <= NAMED_S),),
        "longest_to_name": (every[:, 0].max(), "s"),
        "longest_to_recover": (every[:, 1].max(), "s"),
        "errors": (every[:, 3].sum(),),
        "share": (float(share[1]) if share else np.nan, "% of a core"),
        "memory": (memory[later].mean(), "MB"), "memory_slope": (slope, "MB/min"),
        "memory_slope_asked": (SLOPE, "MB/min"), "load": (os.getloadavg()[1],)}
    return bool(missed), {name: record.spread(*one) for name, one in figures.items()}


def named_after(fault: Fault, seen: Seen, until: float) -> tuple[float, float]:
    """Return when a diagnostic named a fault, and when none did after its end; s."""
    words, named, last = re.compile(WORDS[fault.kind]), np.inf, fault.end
    for at, found in seen.health:
        if fault.begin <= at < until and any(
                level != "OK" and words.search(message) for _, level, message in found):
            named, last = min(named, at - fault.begin), max(last, at)
    return named, last - fault.end


def recovered_after(fault: Fault, seen: Seen, until: float) -> float:
    """Return from when on after a fault both estimates come and are right; s."""
    until = min(until, min((points[-1][0] for points in seen.estimates.values() if points),
                           default=fault.end))
    last = fault.end
    for name, points in seen.estimates.items():
        before = fault.end
        for at, value in [*points, (until, TRUTH[name])]:
            if not fault.end <= at <= until:
                continue
            if abs(value / TRUTH[name] - 1.0) > WITHIN or at - before > FRESH_S:
                last = max(last, at)
            before = at
    return last - fault.end if until - last > 1.0 else np.inf


if __name__ == "__main__":
    sys.exit(main())
