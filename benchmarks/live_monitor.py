"""The live monitor at 1 kHz on all four input topics: losses, latency, CPU share.

Runs the real simulator node and the real monitor node as processes over DDS on loopback:

    python benchmarks/live_monitor.py --duration 60

The monitor starts first and ends last.  What the simulator sends before DDS has matched the two
(up to 3 s, when an announcement is lost) is counted apart from what is lost after.  The plain
filterpy loop is run in this process for comparison: one ExtendedKalmanFilter of three states,
predicted and updated sample by sample.
"""

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

REPOSITORY = Path(__file__).parents[1]


def main() -> int:
    """Run the benchmark; the exit status is 1 if a message was lost."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--duration", type=float, default=60.0, metavar="SECONDS")
    duration = options.parse_args().duration
    with tempfile.TemporaryDirectory() as logs:
        environment = {
            "ROS_DOMAIN_ID": str(1 + os.getpid() % 100), **os.environ,
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOG_DIR": logs,
            "PYTHONPATH": str(REPOSITORY)}
        os.environ.update(environment)
        sent, summary = run_nodes(duration)
    received = int(re.search(r"rows (\d+)", summary)[1])
    lost = int(re.search(r"lost messages (\d+)", summary)[1])
    missing = int(re.search(r"missing samples (\d+)", summary)[1])
    early = sent - received - missing
    print(f"samples sent        {sent}  (four topics, so {4 * sent} messages)")
    print(f"rows processed      {received}  ({missing} missing between the first and the last; "
          f"{early} were sent before DDS had matched the nodes)")
    print(f"messages lost       {lost}  (missing between the stamps of each topic)")
    print(f"monitor             {summary}")
    live = float(re.search(r"CPU share ([\d.]+)", summary)[1])
    plain = plain_filterpy_cost()
    print(f"plain filterpy loop {1e6 * plain:.0f} µs a sample, so {100 * plain * 1000:.1f} % of a "
          f"core at 1 kHz for one filter of three states; the whole monitor takes {live:.1f} %")
    return 1 if missing or lost else 0


def run_nodes(duration: float) -> tuple[int, str]:
    """Return the samples that the simulator sent, and the monitor's summary."""
    monitor = start("monitor")
    try:
        wait_for_health()
        simulator = start("simulator", "--duration", str(duration))
        try:
            said = simulator.communicate(timeout=duration + 120)[0]
        finally:
            end(simulator)
        time.sleep(0.5)  # the last rows are at most monitor.latency behind
        monitor.send_signal(signal.SIGINT)
        summary = monitor.communicate(timeout=30)[0]
    finally:
        end(monitor)
    return int(re.search(r"published (\d+) samples", said)[1]), summary.strip()


def start(*arguments: str) -> subprocess.Popen:
    """Start a command of the package."""
    return subprocess.Popen([sys.executable, "-m", "eha_monitor", *arguments], cwd=REPOSITORY,
                            text=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)


def end(process: subprocess.Popen) -> None:
    """Make sure that a command has ended."""
    if process.poll() is None:
        process.kill()
    process.communicate()


def wait_for_health() -> None:
    """Wait until the monitor listens: it then publishes its health."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.wait_for_message import wait_for_message

    sys.path.insert(0, str(REPOSITORY))
    from eha_monitor.ros.outputs import LATCHED

    rclpy.init()
    node = rclpy.create_node("benchmark")
    try:
        found, _ = wait_for_message(DiagnosticArray, node, "/eha/monitor/health",
                                    qos_profile=LATCHED, time_to_wait=180)
        if not found:
            raise SystemExit("the monitor did not start")
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def plain_filterpy_cost(samples: int = 5000) -> float:
    """Return seconds a sample of the plain loop, median of five."""
    ekf = ExtendedKalmanFilter(dim_x=3, dim_z=1)
    ekf.F = np.array([[1.0, 1e-3, 0.0], [0.0, 0.97, -1e-5], [0.0, 0.0, 1.0]])
    ekf.Q = np.diag([1e-14, 1e-8, 1e-4])
    ekf.R = np.array([[1e-12]])
    h = np.array([[1.0, 0.0, 0.0]])
    measured = np.array([[1e-3]])
    costs = []
    for _ in range(5):
        begin = time.perf_counter()
        for _ in range(samples // 5):
            ekf.predict()
            ekf.update(measured, lambda x: h, lambda x: h @ x)
        costs.append((time.perf_counter() - begin) / (samples // 5))
    return float(np.median(costs))


if __name__ == "__main__":
    sys.exit(main())
