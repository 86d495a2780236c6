"""The live monitor at 1 kHz on four topics for each actuator: losses, latency, share of a core.

    python benchmarks/live_monitor.py --counts 1 10 --duration 20 [--record]

Each count is one monitor process on one core, with a node for each actuator; a process on
another core publishes the inputs as serialised messages with the stamp of the moment, over DDS on
loopback.  First, in the same run and on the same core, the reference: a node with the same four
subscriptions and empty callbacks on an EventsExecutor, fed in the same way, and two plain filterpy
filters (of three and of four states), predicted and updated once a row.  The monitor's share of
the core is given as a ratio to the reference's, each for one actuator.  So is what the middleware
alone takes: the same subscriptions in a process that sleeps and takes nothing, below which no
subscriber can be.  Shares are those of the whole process while messages come.

Latency is from a row's stamp to the publication of the first estimates that know of it, over the
last minute: a run of 70 s leaves out the beginning, when a row waits for the 256 from which the
noise is first measured.
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
import record

TARGET = 0.35  # of the reference
MARGIN_MS = 10.0  # beyond one publishing period, 99 % of the rows
MEASURED = tuple(f"eha_monitor/{room}" for room in (
    "estimation", "live", "health", "recordings", "ros"))
BURST = 0.001  # s between two bursts of what is due
STAMP = struct.Struct("<iI")
STAMP_AT = 4  # a header comes first, behind the four bytes of the encapsulation
UNITS = {"p50": "ms", "p99": "ms", "most": "ms", "share": "% of a core"}


def main() -> int:
    """Run the benchmark or, as a child of it, reference or publishers; 1 if anything was lost."""
    options = record.options(__doc__)
    options.add_argument("--counts", type=int, nargs="+", default=[1, 10], metavar="N")
    options.add_argument("--duration", type=float, default=20.0, metavar="SECONDS")
    options.add_argument("--rate", type=float, default=10.0, metavar="HZ",
                         help="monitor.publish_rate")
    options.add_argument("--reference", choices=("callbacks", "middleware"),
                         help=argparse.SUPPRESS)
    options.add_argument("--publish", type=int, default=0, help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.publish:
        publish(given.publish, given.duration)
        return 0
    if given.reference:
        reference_node(takes=given.reference == "callbacks")
        return 0
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        print("live_monitor: expected two cores, one for the monitor and one for the publishers",
              file=sys.stderr)
        return 2
    lost, figures = 0, {}
    with tempfile.TemporaryDirectory() as folder:
        record.own_graph(folder)
        config = Path(folder) / "config.yaml"
        config.write_text(f"monitor: {{publish_rate: {given.rate}}}\n")
        callbacks = measure_reference("callbacks", given.duration, cores)
        middleware = measure_reference("middleware", given.duration, cores)
        os.sched_setaffinity(0, {cores[0]})
        costs = [record.plain_filterpy_cost(states) for states in (3, 4)]
        filters = 1000 * sum(costs)
        os.sched_setaffinity(0, set(cores))
        reference = callbacks + filters
        print(f"reference, one actuator: {100 * reference:.1f} % of a core: empty callbacks "
              f"{100 * callbacks:.1f} %, two plain filterpy filters {100 * filters:.1f} % "
              f"({1 / costs[0]:.0f} steps of three states a second)", flush=True)
        print(f"the middleware alone, nothing taken: {100 * middleware:.1f} % of a core, a ratio "
              f"of {middleware / reference:.3f}")
        bound = 1e3 / given.rate + MARGIN_MS
        print(f"asked: a ratio of {TARGET} at most, p99 of {bound:.0f} ms at most, nothing lost")
        print(f"{'actuators':>9} {'rows':>8} {'lost':>6} {'missing':>8} {'p50 ms':>8} "
              f"{'p99 ms':>8} {'max ms':>8} {'CPU %':>7} {'% each':>7} {'ratio':>7}", flush=True)
        for count in given.counts:
            row = measure(count, given.duration, config, cores, reference)
            lost += row["lost"] + row["missing"]
            figures |= {f"{key}_{count}": record.spread(one, UNITS.get(key, ""))
                        for key, one in row.items()}
    if given.record:
        record.write("live", figures | {
            "callbacks": record.spread(100 * callbacks, "% of a core"),
            "middleware": record.spread(100 * middleware, "% of a core"),
            "floor": record.spread(middleware / reference),
            "filters": record.spread(100 * filters, "% of a core"),
            "bound": record.spread(bound, "ms"), "asked": record.spread(TARGET)},
            MEASURED, held_by="commit")
    return 1 if lost else 0


def fed(process, count: int, duration: float, core: int) -> tuple[float, float, str]:
    """Publish to a process; return its share of a core, the samples sent, and what was late."""
    sender = start(core, __file__, "--publish", str(count), "--duration", str(duration))
    try:
        used, said = [], ""
        for line in sender.stdout:  # "begin", "end": while messages come
            used.append((processor_time(process.pid), time.monotonic()))
            said = line
        sender.wait(timeout=60)
    finally:
        end(sender)
    own, wall = np.subtract(*reversed(used))
    sent, behind = (float(number) for number in re.findall(r"[\d.]+", said))
    return own / wall, sent, (
        f"the publishers themselves were up to {behind:.1f} ms late" if behind > MARGIN_MS else "")


def measure(count: int, duration: float, config: Path, cores: list[int],
            reference: float) -> dict[str, float]:
    """Run one monitor with ``count`` actuators; print its row of the table and return it."""
    actuators = [f"--actuator={name}={config}" for name in names_of(count)]
    monitor = start(cores[0], "-m", "eha_monitor", "monitor", *actuators)
    try:
        share, sent, note = fed(monitor, count, duration, cores[1])
        monitor.send_signal(signal.SIGINT)
        summaries = monitor.communicate(timeout=60)[0].strip().splitlines()
    finally:
        end(monitor)

    def numbers(pattern: str) -> list[float]:
        return [float(found[1]) for line in summaries if (found := re.search(pattern, line))]

    rows, lost = numbers(r"rows (\d+)"), sum(numbers(r"lost messages (\d+)"))
    missing = count * sent - sum(rows)
    late = [max(numbers(rf"{key} ([\d.]+) ms"), default=np.inf) for key in ("p50", "p99", "max")]
    if any("latency from receipt" in line for line in summaries):
        late = [np.inf] * 3  # so late that the stamps were taken for those of a bag
    print(f"{count:9d} {sum(rows):8.0f} {lost:6.0f} {missing:8.0f} " + " ".join(
        f"{one:8.1f}" for one in late) + f" {100 * share:7.1f} {100 * share / count:7.1f} "
        f"{share / count / reference:7.3f}", flush=True)
    if note:
        print(f"{'':>9} {note}")
    return {"rows": sum(rows), "lost": lost, "missing": missing, "p50": late[0], "p99": late[1],
            "most": late[2], "share": 100 * share, "ratio": share / count / reference}


def measure_reference(what: str, duration: float, cores: list[int]) -> float:
    """Return the share of a core of one actuator's topics, with empty callbacks or alone."""
    node = start(cores[0], __file__, "--reference", what)
    try:
        return fed(node, 1, duration, cores[1])[0]
    finally:
        end(node)


def reference_node(takes: bool) -> None:
    """Hold one actuator's subscriptions until killed, and spin them if ``takes``."""
    import rclpy
    from rclpy.experimental import EventsExecutor
    from sensor_msgs.msg import FluidPressure, JointState

    from eha_monitor.ros.topics import INPUT_QOS

    rclpy.init()
    node = rclpy.create_node("reference", namespace=f"/{names_of(1)[0]}")
    for kind, topic in ((JointState, "joint_states"), (JointState, "command"),
                        (FluidPressure, "pressure/chamber_1"),
                        (FluidPressure, "pressure/chamber_2")):
        node.create_subscription(kind, topic, lambda message: None, INPUT_QOS)
    executor = EventsExecutor()
    if takes:
        executor.add_node(node)
    while rclpy.ok():
        if takes:
            executor.spin_once(timeout_sec=1.0)
        else:
            time.sleep(1.0)


def names_of(count: int) -> list[str]:
    """Return the names of the actuators."""
    return [f"actuator_{k + 1}" for k in range(count)]


def start(core: int, *arguments: str) -> subprocess.Popen:
    """Start Python on one core."""
    return subprocess.Popen([sys.executable, *arguments], cwd=record.ROOT, text=True,
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
