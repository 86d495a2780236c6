"""What the tests of the nodes share: a recording estimator, a sender, service calls, processes."""

import math
import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import FluidPressure, JointState
from std_srvs.srv import Trigger

from eha_monitor.estimation.results import Event, ModelStatus, ParameterEstimate
from eha_monitor.ros import messages
from eha_monitor.ros.monitor_node import Monitor
from eha_monitor.settings import settings_from_tree

REPOSITORY = Path(__file__).parents[1]
# The first run after a change of the sources compiles the model.
PATIENCE = 90.0
MS = 1_000_000
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
START_NS = 1_700_000_000 * 1_000_000_000

TRANSITIONS = {"configure": Transition.TRANSITION_CONFIGURE,
               "activate": Transition.TRANSITION_ACTIVATE,
               "deactivate": Transition.TRANSITION_DEACTIVATE,
               "cleanup": Transition.TRANSITION_CLEANUP,
               "shutdown": Transition.TRANSITION_INACTIVE_SHUTDOWN}


class Caller:
    """Calls services from a node of its own."""

    def __init__(self, graph, timeout=20.0):
        self.graph, self.timeout = graph, timeout
        self.node = graph.node(f"caller_{len(graph.nodes)}")
        self._clients = {}

    def begin(self, kind, name, request):
        """Send a request and return its future."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        self.graph.until(self._clients[name].service_is_ready, self.timeout)
        return self._clients[name].call_async(request)

    def call(self, kind, name, request):
        """Return the answer to a request."""
        future = self.begin(kind, name, request)
        self.graph.until(future.done, self.timeout)
        return future.result()

    def trigger(self, name):
        return self.call(Trigger, name, Trigger.Request())

    def trigger_until_answered(self, name, each=10.0):
        """Ask again where no answer comes: for a request that may be made twice.

        A server in another process may answer before its writer has found this node's reader, and
        that answer is lost (``service_is_ready`` knows of this side only).
        """
        for _ in range(max(1, round(self.timeout / each))):
            future = self.begin(Trigger, name, Trigger.Request())
            try:
                self.graph.until(future.done, each)
            except AssertionError:
                continue
            return future.result()
        raise AssertionError(f"{name}: no answer within {self.timeout:g} s")

    def change(self, monitor, transition):
        """Ask a managed node for a transition; returns whether it was made."""
        request = ChangeState.Request()
        request.transition.id = TRANSITIONS[transition]
        return self.call(ChangeState, f"{monitor}/change_state", request).success

    def state(self, monitor):
        return self.call(GetState, f"{monitor}/get_state", GetState.Request()).current_state.label


class Recorder:
    """Stands where the estimator stands and keeps what the node gave it."""

    def __init__(self, settings):
        self.rows, self.resets, self.damping = [], [], 600.0

    def push_rows(self, times, columns):
        for k, time_s in enumerate(times):
            self.push(float(time_s), {name: float(values[k]) for name, values in columns.items()
                                      if math.isfinite(values[k])})

    def push(self, time_s, row):
        self.rows.append((time_s, row))

    def reset(self, reason):
        self.resets.append(reason)

    def withdraw(self, channel, since_s):
        pass

    def snapshot(self):
        from eha_monitor.live.estimator import LiveSnapshot
        make = ParameterEstimate
        return LiveSnapshot(
            time_s=self.rows[-1][0], position=0.01, velocity=0.02, temperature=None,
            parameters={"B": make("B", self.damping, 2.0, "N·s/m", "converged"),
                        "beta_e": make("beta_e", 6e8, 5e6, "Pa", "converged")},
            model=ModelStatus("consistent", "the model explains the data"),
            events=(Event(0.0, "one", "converged"),), consistency={"one": None, "two": None})


class Feeder:
    """Publishes the contract's inputs, sample by sample."""

    def __init__(self, graph, namespace="/eha", names=("piston", "pump"), demand="piston"):
        node = graph.node("feeder", namespace)
        self.graph, self.names, self.demand = graph, names, demand
        self.joints = node.create_publisher(JointState, "joint_states", BEST_EFFORT)
        self.command = node.create_publisher(JointState, "command", BEST_EFFORT)
        self.pressures = [node.create_publisher(FluidPressure, f"pressure/chamber_{i}",
                                                BEST_EFFORT) for i in (1, 2)]

    def matched(self):
        return all(p.get_subscription_count()
                   for p in (self.joints, self.command, *self.pressures))

    def send(self, first, count, start_ns=START_NS):
        """Send samples 1 ms apart, and spin between bursts as a real sender would."""
        for k in range(first, first + count):
            stamp = messages.stamp(start_ns + k * MS)
            values = {"piston": (0.001 * k, 0.5), "pump": (math.nan, 100.0 + k)}
            joints = JointState(name=list(self.names),
                                position=[values[n][0] for n in self.names],
                                velocity=[values[n][1] for n in self.names])
            command = JointState(name=[self.demand], position=[0.002 * k], velocity=[0.5])
            for publisher, message in ((self.joints, joints), (self.command, command)):
                message.header.stamp = stamp
                publisher.publish(message)
            for publisher, pressure in zip(self.pressures, (2e6, 1e6), strict=False):
                message = FluidPressure(fluid_pressure=pressure + k)
                message.header.stamp = stamp
                publisher.publish(message)
            self.graph.executor.spin_once(timeout_sec=0)


def start(graph, tree=None, **feeder):
    settings = settings_from_tree(tree or {}, "test")
    monitor = Monitor(graph.node("monitor", settings.monitor.namespace), settings, Recorder)
    sender = Feeder(graph, **feeder)
    graph.until(sender.matched)
    return monitor, monitor._estimator, sender


def listen(graph, kind, topic, qos=10):
    heard = []
    graph.node(f"listener_{len(graph.nodes)}").create_subscription(kind, topic, heard.append, qos)
    return heard


def levels(array):
    return {status.name: status.level for status in array.status}


@contextmanager
def command(*arguments):
    """Run a command of the package; it is ended with SIGTERM if the test has not done so."""
    process = subprocess.Popen(
        [sys.executable, "-m", "eha_monitor", *map(str, arguments)], cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def end(process, how=signal.SIGTERM, status=0):
    """End a command with a signal; returns its stdout.  It must end cleanly."""
    process.send_signal(how)
    out, err = process.communicate(timeout=30)
    assert process.returncode == status, err
    assert "Traceback" not in err, err
    return out
