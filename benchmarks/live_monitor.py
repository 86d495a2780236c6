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
import sys
import tempfile
import time
from pathlib import Path

import many_actuators as many
import numpy as np
import record

TARGET = 0.15  # of the reference
MARGIN_MS = 10.0  # beyond one publishing period, 99 % of the rows
MEASURED = tuple(f"eha_monitor/{room}" for room in (
    "estimation", "live", "health", "recordings", "ros"))
UNITS = {"p50": "ms", "p99": "ms", "most": "ms", "share": "% of a core"}


def main() -> int:
    """Run the benchmark or, as a child of it, the reference; 1 if anything was lost."""
    options = record.options(__doc__)
    options.add_argument("--counts", type=int, nargs="+", default=[1, 10], metavar="N")
    options.add_argument("--duration", type=float, default=20.0, metavar="SECONDS")
    options.add_argument("--rate", type=float, default=10.0, metavar="HZ",
                         help="monitor.publish_rate")
    options.add_argument("--reference", choices=("callbacks", "middleware"),
                         help=argparse.SUPPRESS)
    given = options.parse_args()
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
        os.environ.update({
            "ROS_DOMAIN_ID": str(1 + os.getpid() % 100), **os.environ,
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOG_DIR": folder,
            "PYTHONPATH": str(many.REPOSITORY), "OPENBLAS_NUM_THREADS": "1"})
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
    sender = many.start(core, many.__file__, "--publish", str(count), "--duration", str(duration))
    try:
        used, said = [], ""
        for line in sender.stdout:  # "begin", "end": while messages come
            used.append((many.processor_time(process.pid), time.monotonic()))
            said = line
        sender.wait(timeout=60)
    finally:
        many.end(sender)
    own, wall = np.subtract(*reversed(used))
    sent, behind = (float(number) for number in re.findall(r"[\d.]+", said))
    return own / wall, sent, (
        f"the publishers themselves were up to {behind:.1f} ms late" if behind > MARGIN_MS else "")


def measure(count: int, duration: float, config: Path, cores: list[int],
            reference: float) -> dict[str, float]:
    """Run one monitor with ``count`` actuators; print its row of the table and return it."""
    actuators = [f"--actuator={name}={config}" for name in many.names_of(count)]
    monitor = many.start(cores[0], "-m", "eha_monitor", "monitor", *actuators)
    try:
        share, sent, note = fed(monitor, count, duration, cores[1])
        monitor.send_signal(signal.SIGINT)
        summaries = monitor.communicate(timeout=60)[0].strip().splitlines()
    finally:
        many.end(monitor)

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
    node = many.start(cores[0], __file__, "--reference", what)
    try:
        return fed(node, 1, duration, cores[1])[0]
    finally:
        many.end(node)


def reference_node(takes: bool) -> None:
    """Hold one actuator's subscriptions until killed, and spin them if ``takes``."""
    import rclpy
    from rclpy.experimental import EventsExecutor
    from sensor_msgs.msg import FluidPressure, JointState

    from eha_monitor.ros.topics import INPUT_QOS

    rclpy.init()
    node = rclpy.create_node("reference", namespace=f"/{many.names_of(1)[0]}")
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


if __name__ == "__main__":
    sys.exit(main())
