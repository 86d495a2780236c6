"""The monitor as managed nodes: one process, one node for each actuator."""

import gc
import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial, wraps
from pathlib import Path

import numpy as np
from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from eha_monitor.errors import InputError
from eha_monitor.live.checks import Turns
from eha_monitor.live.estimator import LiveEstimator
from eha_monitor.live.ingest import BATCH
from eha_monitor.physics.simulator import Simulator
from eha_monitor.ros import running
from eha_monitor.ros.monitor_node import Monitor
from eha_monitor.ros.parameters import MONITOR_KEYS, declare, settings_of_node
from eha_monitor.settings import Settings

WARM_UP_ROWS = 3000  # past the first second, when stage two is run and the model is tested
# How long one thread of Python runs while another waits: a bag is written beside the filter.
SWITCH_S = 0.0005


def _transition(work: Callable) -> Callable:
    """Make a transition that says why its work failed: rclpy itself would be silent."""
    @wraps(work)
    def done(self: "ManagedMonitor", state: LifecycleState) -> TransitionCallbackReturn:
        self.failure = None
        try:
            work(self)
        except InputError as problem:
            self.failure = problem
            self.get_logger().error(str(problem))
            return TransitionCallbackReturn.FAILURE
        except Exception as problem:  # noqa: BLE001  told, and rclpy makes it an error
            self.failure = problem
            self.get_logger().error(f"defect: {problem!r}")
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS
    return done


class ManagedMonitor(running.WithoutEvents, LifecycleNode):
    """A monitor in the states of a managed node.

    Unconfigured there is nothing but the parameters.  Configured, so inactive, there are
    publishers and services, but no data are taken and nothing is published.  Active it works.
    Each activation begins with estimators that know nothing; thresholds stay as they were set.
    Shutting down ends it for good.
    """

    def __init__(self, settings: Settings, source: str = "config", name: str = "monitor",
                 estimator_factory: Callable[[Settings], object] = LiveEstimator):
        super().__init__(name, namespace=settings.monitor.namespace,
                         automatically_declare_parameters_from_overrides=True)
        self.monitor: Monitor | None = None  # while configured, else None
        self.failure: Exception | None = None  # what the last transition failed of, or None
        self.ended = False  # whether it has been shut down
        self._source, self._factory = source, estimator_factory
        self._summary = "was not active"
        self.settings = settings_of_node(self, settings)
        declare(self, self.settings, MONITOR_KEYS, self._take_settings)
        for service in self.services:
            if service.srv_type is ChangeState:
                service.callback = self._guarded(service.callback)

    def start(self, active: bool = True) -> None:
        """Configure, and activate unless it is to wait; raises InputError if it cannot work so."""
        self.trigger_configure()
        if active and self.monitor is not None:
            self.trigger_activate()
        if self.failure is not None:
            raise self.failure

    @_transition
    def on_configure(self) -> None:
        """Make estimator, publishers and services."""
        self.monitor = Monitor(self, self.settings, self._factory, self._source, active=False)

    @_transition
    def on_activate(self) -> None:
        """Take data and publish."""
        self.monitor.activate()

    @_transition
    def on_deactivate(self) -> None:
        """Say that the health is unknown from now on, and stop."""
        self._summarise(self.monitor)
        self.monitor.deactivate()

    @_transition
    def on_cleanup(self) -> None:
        """Give up what was made, the minutes in the buffer included; so too after a defect."""
        self.close()

    on_error = on_cleanup

    @_transition
    def on_shutdown(self) -> None:
        """End for good."""
        self.ended = True
        self.close()

    def close(self) -> None:
        """End the monitor, if there is one; a bag that is due is written first."""
        monitor, self.monitor = self.monitor, None
        if monitor is not None:
            self._summarise(monitor)
            monitor.close()

    def destroy_node(self) -> None:
        """End the node; rclpy alone would leave the services of the states until collected."""
        self.close()
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    def summary(self) -> str:
        """Return what was processed, lost and how late, in one line."""
        if self.monitor is not None and self.monitor.active:
            self._summarise(self.monitor)
        return self._summary

    def _summarise(self, monitor: Monitor) -> None:
        if monitor.active:
            self._summary = monitor.summary()

    def _take_settings(self, settings: Settings) -> None:
        self.settings = settings
        if self.monitor is not None:
            self.monitor.reconfigure(settings)

    def _guarded(self, change_state: Callable) -> Callable:
        """Refuse a transition that the state does not have; rclpy would end the process."""
        def answer(request, response):
            try:
                return change_state(request, response)
            except running.rclpy_implementation.RCLError:
                wanted = request.transition.label or request.transition.id
                self.get_logger().warning(f"transition {wanted} is not possible in this state")
                response.success = False
                return response
        return answer


def warm_up() -> None:
    """Run the estimator once through all it does, so that compiled code is loaded.

    Otherwise the first hand-over stops the node for a second while messages come.
    """
    settings = Settings()
    estimator, simulator = LiveEstimator(settings), Simulator(settings)
    for start in range(0, WARM_UP_ROWS, BATCH):
        shown = simulator.advance(BATCH)
        estimator.push_rows(simulator.dt * np.arange(start, start + BATCH), shown)
    estimator.snapshot()
    estimator.rehearse()


def run_monitor(config: Path | None, ros_args: list[str], duration: float | None = None,
                actuators: tuple[str, ...] = (), inactive: bool = False,
                machine: Path | None = None) -> int:
    """Run the monitor until a signal or for ``duration`` s; returns the exit status.

    Raises InputError if a config, a parameter or a ROS argument is wrong.

    Parameters
    ----------
    actuators : ``NAME=CONFIG`` for each of several actuators; else ``config`` is the only one.
    inactive : whether to wait for the transition ``activate``.
    machine : file of the healthy machine; None leaves it to the config.
    """
    wanted = running.actuators(config, actuators, ros_args, "monitor")
    if machine is not None:
        if actuators:
            raise InputError("--machine: expected one actuator; for several it is the key "
                             "diagnosis.machine of each config")
        wanted = [(settings.model_copy(update={"diagnosis": settings.diagnosis.model_copy(
            update={"machine": str(machine)})}), source) for settings, source in wanted]
    if not actuators:
        running.refuse_another_rig(wanted[0][0])
    factory = partial(LiveEstimator, turns=Turns())
    with running.ros_session(ros_args), ExitStack() as stack:
        nodes = [stack.enter_context(running.made("monitor", ManagedMonitor, *which,
                                                  estimator_factory=factory))
                 for which in wanted]
        running.check_apart(nodes)
        warm_up()
        sys.setswitchinterval(SWITCH_S)
        for node in nodes:
            node.start(not inactive)
        gc.collect()
        gc.freeze()  # what is loaded stays: collections then cost microseconds, not 50 ms
        running.spin(nodes, duration, lambda: all(node.ended for node in nodes))
        for node in nodes:
            head = f"{node.settings.rig.name}: " if actuators else ""
            print(f"{head}{node.summary()}", flush=True)
    return 0
