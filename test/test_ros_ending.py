"""An orderly end: a signal waits for the callback that it falls into, and the log says nothing."""

import signal
import subprocess
import sys
import textwrap

import pytest

# A callback that a signal falls into, and that goes on publishing until long after it.
PROGRAM = """
    import os, signal, sys, time
    from std_msgs.msg import Float64
    from eha_monitor.ros import running

    number = int(sys.argv[1])
    with running.ros_session([]), running.node("talker") as node:
        publisher = node.create_publisher(Float64, "number", 10)
        count = [0]

        def talk():
            count[0] += 1
            if count[0] == 1:
                os.kill(os.getpid(), number)
                end = time.monotonic() + 0.3  # a shutdown by a thread has its time
                while time.monotonic() < end:
                    publisher.publish(Float64(data=1.0))

        node.create_timer(0.01, talk)
        running.spin(node, 20.0)
        print("spun", running.ok(), flush=True)
    print("ended", flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_a_callback_ends_without_a_fatal_line(number):
    pytest.importorskip("rclpy")
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(PROGRAM), str(int(number))],
                          capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["spun", "False", "ended"]
    assert "FATAL" not in done.stderr and "Traceback" not in done.stderr, done.stderr
