"""How many actuators at 1 kHz one core holds: one monitor process, one node for each.

    python benchmarks/many_actuators.py --counts 1 2 4 6 --duration 8

The monitor is pinned to one core.  A process on another core publishes for each actuator the four
input topics at 1 kHz, as serialised messages with the stamp of the moment, over DDS on loopback.
Latency is from stamp to processed; the CPU share is that of the monitor process while messages
came, "others" what everything else took of its core: on a busy machine only the share tells.
A count is held when no message and no sample is missing and 99 % of the rows are processed within
the time that a row may wait for its last channel (``monitor.latency``).
"""

import argparse
import os
import re
import signal
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

REPOSITORY = Path(__file__).parents[1]
sys.path.insert(0, str(REPOSITORY))
HELD_MS = 20.0  # the default of monitor.latency
BURST = 0.001
STAMP = struct.Struct("<iI")
STAMP_AT = 4  # a header comes first, behind the four bytes of the encapsulation


def main() -> int:
    """Run the benchmark or, as a child of it, the publishers."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--counts", type=int, nargs="+", default=[1, 2, 3, 4, 6], metavar="N")
    options.add_argument("--duration", type=float, default=8.0, metavar="SECONDS")
    options.add_argument("--buffer-minutes", type=float, default=2.0, metavar="MINUTES",
                         help="monitor.buffer_minutes; 0 keeps nothing")
    options.add_argument("--publish", type=int, default=0, help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.publish:
        publish(given.publish, given.duration)
        return 0
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        print("many_actuators: expected two cores, one for the monitor and one for the publishers",
              file=sys.stderr)
        return 2
    print(f"{'actuators':>9} {'rows':>8} {'lost':>6} {'missing':>8} {'p50 ms':>8} {'p99 ms':>8} "
          f"{'max ms':>8} {'CPU %':>7} {'% each':>7} {'others':>7}  held")
    with tempfile.TemporaryDirectory() as folder:
        os.environ.update({
            "ROS_DOMAIN_ID": str(1 + os.getpid() % 100), **os.environ,
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOG_DIR": folder,
            "PYTHONPATH": str(REPOSITORY), "OPENBLAS_NUM_THREADS": "1"})
        config = Path(folder) / "config.yaml"
        config.write_text(f"monitor: {{buffer_minutes: {given.buffer_minutes}}}\n")
        for count in given.counts:
            measure(count, given.duration, config, cores)
    return 0


def names_of(count: int) -> list[str]:
    """Return the names of the actuators."""
    return [f"actuator_{k + 1}" for k in range(count)]


def measure(count: int, duration: float, config: Path, cores: list[int]) -> None:
    """Run one monitor with ``count`` actuators and print its row of the table."""
    actuators = [f"--actuator={name}={config}" for name in names_of(count)]
    monitor = start(cores[0], "-m", "eha_monitor", "monitor", *actuators)
    try:
        sender = start(cores[1], __file__, "--publish", str(count), "--duration", str(duration))
        try:
            used = []
            for line in sender.stdout:  # "begin", "end": while messages come
                used.append((processor_time(monitor.pid), core_time(cores[0]), time.monotonic()))
                said = line
            sender.wait(timeout=60)
        finally:
            end(sender)
        monitor.send_signal(signal.SIGINT)
        summaries = monitor.communicate(timeout=60)[0].strip().splitlines()
    finally:
        end(monitor)
    own, busy, wall = np.subtract(*reversed(used))
    sent, behind = (float(number) for number in re.findall(r"[\d.]+", said))
    print(row(count, summaries, sent, 100.0 * own / wall, 100.0 * (busy - own) / wall), flush=True)
    if behind > HELD_MS / 2:
        print(f"{'':>9} the publishers themselves were up to {behind:.1f} ms late")


def row(count: int, summaries: list[str], sent: float, share: float,
        others: float) -> str:
    """Return a row of the table from the monitor's summaries."""
    def numbers(pattern: str) -> list[float]:
        return [float(re.search(pattern, line)[1]) for line in summaries]

    rows = numbers(r"rows (\d+)")
    lost, missing = sum(numbers(r"lost messages (\d+)")), count * sent - sum(rows)
    p50, p99, most = (max(numbers(rf"{key} ([\d.]+) ms")) for key in ("p50", "p99", "max"))
    if any("latency from receipt" in line for line in summaries):
        p50 = p99 = most = np.inf  # so late that the stamps were taken for those of a bag
    held = "yes" if not lost and not missing and p99 <= HELD_MS else "no"
    return (f"{count:9d} {sum(rows):8.0f} {lost:6.0f} {missing:8.0f} {p50:8.1f} {p99:8.1f} "
            f"{most:8.1f} {share:7.1f} {share / count:7.1f} {others:7.1f}  {held}")


def start(core: int, *arguments: str) -> subprocess.Popen:
    """Start Python on one core."""
    return subprocess.Popen([sys.executable, *arguments], cwd=REPOSITORY, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                            preexec_fn=lambda: os.sched_setaffinity(0, {core}))


def end(process: subprocess.Popen) -> None:
    """Make sure that a process has ended."""
    if process.poll() is None:
        process.kill()
    process.communicate()


def processor_time(pid: int) -> float:
    """Return the processor time that a process has used, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def core_time(core: int) -> float:
    """Return the time that a core has worked, s."""
    line = next(line for line in Path("/proc/stat").read_text().splitlines()
                if line.startswith(f"cpu{core} "))
    user, nice, system, _, _, interrupt, soft, stolen = map(int, line.split()[1:9])
    return (user + nice + system + interrupt + soft + stolen) / os.sysconf("SC_CLK_TCK")


def publish(count: int, duration: float) -> None:
    """Publish the inputs of several actuators in real time."""
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    from eha_monitor.physics.simulator import Simulator
    from eha_monitor.recordings.write import messages_of
    from eha_monitor.ros.topics import message_class
    from eha_monitor.settings import Settings

    samples = round(duration * 1000)
    streams = messages_of(Simulator(Settings(), 1).advance(samples), np.arange(samples), "")
    rclpy.init()
    node = rclpy.create_node("publishers")
    quality = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
    outputs = [[(node.create_publisher(message_class(s.msgtype), f"/{name}{s.topic}", quality),
                 bytearray(s.data.tobytes()), s.data.shape[1]) for s in streams]
               for name in names_of(count)]
    while not all(p.get_subscription_count() for actuator in outputs for p, _, _ in actuator):
        time.sleep(0.05)
    time.sleep(1.0)  # the monitor, too, must have heard of each publisher
    print("begin", flush=True)
    sent, behind, begin = 0, 0.0, time.monotonic()
    begin_ns = time.time_ns()
    while sent < samples:
        due = min(samples, int((time.monotonic() - begin) * 1000) + 1)
        for k in range(sent, due):
            stamp_ns = begin_ns + k * 1_000_000
            behind = max(behind, (time.time_ns() - stamp_ns) * 1e-6)
            for actuator in outputs:
                for publisher, data, length in actuator:
                    at = k * length
                    STAMP.pack_into(data, at + STAMP_AT, *divmod(stamp_ns, 1_000_000_000))
                    publisher.publish(bytes(data[at:at + length]))
        sent = due
        time.sleep(BURST)
    print(f"end {sent} {behind:.2f}", flush=True)
    time.sleep(1.0)  # what is under way arrives before the publishers go
    rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
