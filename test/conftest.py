"""ROS for the tests: loopback only, a domain of their own, strict field checks, logs aside.

The environment is set before anything imports rclpy or numpy, and child processes inherit it.
"""

import fcntl
import gc
import os
import shutil
import tempfile
import time

import hypothesis
import pytest

# A busy machine is no error of a test; a folder may hold what the example before has left there.
# The same draws on every machine, so that a run says something of the sources it is of; ``make
# proof`` draws afresh.
for profile, same in (("same", True), ("fresh", False)):
    hypothesis.settings.register_profile(
        profile, deadline=None, derandomize=same, suppress_health_check=[
            hypothesis.HealthCheck.function_scoped_fixture])
hypothesis.settings.load_profile("same")


def _domain() -> tuple[int, object]:
    """Return a ROS domain that no other session on this machine has, and the lock that says so."""
    for domain in range(1, 101):
        lock = open(  # noqa: SIM115 - held as long as the session lasts
            os.path.join(tempfile.gettempdir(), f"eha_monitor_domain_{domain}"), "w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return domain, lock
        except OSError:
            lock.close()
    raise RuntimeError("all ROS domains from 1 to 100 are taken by test sessions")


_DOMAIN, _LOCK = _domain()
_LOGS = tempfile.TemporaryDirectory(prefix="eha_monitor_ros_")
os.environ.update({
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "ROS_DOMAIN_ID": str(_DOMAIN),
    "ROS_PYTHON_CHECK_FIELDS": "1",  # a wrong Python type is an error, not garbage bytes
    "ROS_LOG_DIR": _LOGS.name,
    # As eha_monitor sets it; a test imports numpy before, and then BLAS spins on every core.
    "OPENBLAS_NUM_THREADS": "1",
})


# Of 2 400 processes started eight at once on two busy cores, five heard of none of 40 publishers
# that they had discovered, with every thread idle; probably Fast DDS replaces a port in shared
# memory whose listener does not answer its check in time.  With the discovery range on loopback
# rmw_fastrtps takes shared memory whatever FASTDDS_BUILTIN_TRANSPORTS says.  So where a
# message never comes, and only there, a test over DDS runs once more; pytest counts it.
NEVER_CAME = [r"Timeout \(>", r"within [0-9.]+ s"]


def pytest_collection_modifyitems(items):
    """Let a test over DDS run again where a message never came."""
    for item in items:
        if "graph" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.flaky(reruns=1, only_rerun=NEVER_CAME))


def pytest_unconfigure():
    """Remove the logs of the session, and let its domain go."""
    _LOCK.close()
    _LOGS.cleanup()


class Graph:
    """Nodes of one test on one executor; everything waits for messages, never for time."""

    def __init__(self):
        import rclpy
        from rclpy.experimental import EventsExecutor

        rclpy.init()
        self._rclpy = rclpy
        self.executor = EventsExecutor()
        self.nodes = []

    def node(self, name, namespace="", parameters=(), **options):
        """Make a node as the commands make theirs."""
        from eha_monitor.ros.running import QuietNode

        made = QuietNode(
            name, namespace=namespace, parameter_overrides=list(parameters), **options,
            automatically_declare_parameters_from_overrides=True)
        self.executor.add_node(made)
        self.nodes.append(made)
        return made

    def until(self, condition, timeout=60.0):  # only a failing test, or a busy machine, waits
        """Spin until ``condition()`` holds; fail after ``timeout`` s."""
        end = time.monotonic() + timeout
        while not (found := condition()):
            assert time.monotonic() < end, f"not within {timeout:g} s: {condition}"
            self.executor.spin_once(timeout_sec=0.05)
        return found

    def close(self):
        """Destroy the nodes and end ROS."""
        while self.nodes:
            made = self.nodes.pop()
            self.executor.remove_node(made)
            made.destroy_node()
        made = None
        gc.collect()  # a monitor's subscriptions go with it, and a test does not close it
        self.executor.shutdown()
        self._rclpy.try_shutdown()


# Headless, and without looking for anything outside this machine.
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
         "--disable-background-networking", "--disable-component-update", "--disable-sync"]


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium of the system, for all tests of a module."""
    driver = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))),
                None)
    if path is None:
        pytest.skip("no chromium on this machine (apt-get install chromium)")
    with driver.sync_playwright() as playwright:
        made = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield made
        made.close()


@pytest.fixture
def graph():
    """Nodes over DDS on loopback, within this process."""
    made = Graph()
    yield made
    made.close()


@pytest.fixture(scope="session")
def rubbing():
    """The diagnosis of a recording with 40 N of dry friction in it; seconds of work, shared."""
    from mismatch_tools import diagnosed

    return diagnosed("coulomb_friction", samples=4000)


@pytest.fixture(scope="session")
def sticking():
    """The diagnosis of a piston that sticks at one place, which no entry describes."""
    from mismatch_tools import diagnosed

    return diagnosed("sticking_place")
