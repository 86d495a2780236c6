"""Starting and ending a node: config, arguments, signals, the executor."""

import contextlib
import re
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import rclpy
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidNamespaceException, InvalidParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.experimental import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from eha_monitor.errors import InputError
from eha_monitor.ros.parameters import for_rcl, with_namespace
from eha_monitor.settings import Settings, load_settings

# So often the loop looks up whether it is to end: while nothing comes, signals wait.
_LOOK_UP = 1.0
# So long a node that ends waits for subscribers to confirm its last messages, in seconds; one
# that was killed never does.
_DELIVERY = 2.0
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


class WithoutEvents:
    """Mixed in before a kind of node: its endpoints ask for no event of the middleware.

    Those can stop every message for good.  rmw_fastrtps 8.4 holds the lock of an endpoint's
    events while it asks the endpoint for its status, and Fast DDS holds the endpoint's lock while
    it tells of an event (pull request 890 of rmw_fastrtps).  Where an EventsExecutor takes up an
    endpoint in the moment in which it is matched, the two wait for each other forever, and the
    process receives nothing more.  rclpy asks for two events of every endpoint, to warn of an
    incompatible QoS or type.
    """

    def create_publisher(self, *arguments, **options):
        """Make a publisher as :meth:`rclpy.node.Node.create_publisher` does."""
        none = PublisherEventCallbacks(use_default_callbacks=False)
        return super().create_publisher(*arguments, event_callbacks=none, **options)

    def create_subscription(self, *arguments, **options):
        """Make a subscription as :meth:`rclpy.node.Node.create_subscription` does."""
        none = SubscriptionEventCallbacks(use_default_callbacks=False)
        return super().create_subscription(*arguments, event_callbacks=none, **options)


class QuietNode(WithoutEvents, Node):
    """A node whose own endpoints, that of parameter events too, ask for no event."""


@contextlib.contextmanager
def ros_session(arguments: list[str]) -> Iterator[None]:
    """Keep ROS running for a block; SIGINT and SIGTERM end the block quietly.

    ``arguments`` : ROS arguments, with or without a leading ``--ros-args``; a parameter file may
    be a config of either form.  Raises InputError if ROS does not understand the arguments.
    """
    arguments = list(arguments)
    if arguments and "--ros-args" not in arguments:
        arguments.insert(0, "--ros-args")
    # rcl reads the parameter files within this block, and never again.
    with _ros_problem("ROS arguments"), for_rcl(arguments) as readable:
        unknown = remove_ros_args(["eha_monitor", *readable])[1:]
        if unknown:
            raise InputError(f"{unknown[0]}: unknown argument, expected options or --ros-args")
        rclpy.init(args=readable, signal_handler_options=SignalHandlerOptions.NO)
    with _Signals() as noted:
        try:
            with until_shutdown():
                yield
        finally:
            rclpy.try_shutdown()
    noted.hand_on()


def ok() -> bool:
    """Tell whether to go on: ROS runs, and no signal has come."""
    return rclpy.ok() and _Signals.came is None


class _Signals:
    """SIGINT and SIGTERM as a note.

    rclpy's own handler ends the context from a thread: the callback that runs then can publish
    no more, and the executor logs that as FATAL.  A note waits until the callback is through.
    """

    came: int | None = None

    def __enter__(self) -> "_Signals":
        _Signals.came = None
        self._before = {number: signal.signal(number, self._note)
                        for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @staticmethod
    def _note(number: int, frame) -> None:
        _Signals.came = number

    def hand_on(self) -> None:
        """Give a signal that came to the handler of whoever called us, if there is one."""
        number = _Signals.came
        handler = self._before.get(number)
        if callable(handler) and handler is not signal.default_int_handler:
            handler(number, None)


@contextlib.contextmanager
def until_shutdown() -> Iterator[None]:
    """Run a block that a signal may end anywhere; what follows the block is still done."""
    try:
        yield
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (rclpy_implementation.RCLError, rclpy_implementation.InvalidHandle):
        if rclpy.ok():  # else a signal came between two lines, and publishing has ended
            raise


@contextlib.contextmanager
def _ros_problem(what: str) -> Iterator[None]:
    """Turn what rcl says about arguments, names and parameter files into one line."""
    try:
        yield
    except (rclpy_implementation.RCLError, rclpy_implementation.UnknownROSArgsError,
            InvalidNamespaceException, InvalidParameterException) as problem:
        text = " ".join(str(problem).split())
        text = text.split(", at ./src")[0].split(", at /")[0]
        raise InputError(f"{what}: {text[:300]}") from problem


@contextlib.contextmanager
def made(name: str, make: Callable[..., Node], *arguments, **options) -> Iterator[Node]:
    """Make a node; at the end deliver what it published last, and destroy it.

    ``make`` : called with what follows.  Raises InputError if a parameter file or the namespace is
    wrong.
    """
    with _ros_problem(f"node {name}"):
        found = make(*arguments, **options)
    try:
        yield found
        if ok():  # a signal ends at once
            deliver(found)
    finally:
        found.destroy_node()


def deliver(node: Node) -> None:
    """Wait until reliable subscribers have what was published: it would go with the publisher."""
    end = time.monotonic() + _DELIVERY  # of all topics together
    for publisher in node.publishers:
        publisher.wait_for_all_acked(Duration(seconds=max(0.0, end - time.monotonic())))


def node(name: str, namespace: str = "", **options) -> contextlib.AbstractContextManager[Node]:
    """Make a node whose parameter overrides are all declared; see :func:`made`."""
    return made(name, QuietNode, name, namespace=namespace,
                automatically_declare_parameters_from_overrides=True, **options)


def spin(nodes: Node | Sequence[Node], duration: float | None = None,
         finished: Callable[[], bool] = lambda: False, goes_on: Callable[[], bool] = ok) -> None:
    """Run the callbacks of nodes until a signal, ``duration`` s, or ``finished()``.

    ``goes_on`` : :func:`rclpy.ok` also after a signal.
    """
    nodes = [nodes] if isinstance(nodes, Node) else nodes
    executor = EventsExecutor()
    for each in nodes:
        executor.add_node(each)
    end = None if duration is None else time.monotonic() + duration
    try:
        with until_shutdown():
            while goes_on() and not finished():
                left = _LOOK_UP if end is None else min(_LOOK_UP, end - time.monotonic())
                if left <= 0:
                    break
                executor.spin_once(timeout_sec=left)
    finally:
        for each in nodes:
            executor.remove_node(each)
        executor.shutdown()


def configured(config: Path | None, ros_args: list[str], name: str) -> tuple[Settings, str]:
    """Return the settings of a node of this name, and what its config is called in errors.

    Raises InputError if the config or a parameter file is wrong.
    """
    return (with_namespace(load_settings(config), ros_args, name), str(config or "default config"))


def actuators(config: Path | None, given: tuple[str, ...], ros_args: list[str], node: str
              ) -> list[tuple[Settings, str]]:
    """Return settings and config's name of each ``NAME=CONFIG``, or else of the one actuator.

    The name becomes the namespace of the topics and the ``hardware_id`` of the diagnostics; an
    empty CONFIG is the paper's EHA.  Raises InputError if there is a ``config`` as well, one has
    no name, or a name comes twice, or a config is wrong.
    """
    if not given:
        return [configured(config, ros_args, node)]
    if config is not None:
        raise InputError("--config: expected either it or --actuator NAME=CONFIG")
    found: dict[str, tuple[Settings, str]] = {}
    for text in given:
        name, equals, config = text.partition("=")
        if not equals or not _NAME.fullmatch(name):
            raise InputError(f"--actuator {text}: expected NAME=CONFIG, the name in letters, "
                             "digits and underscores")
        if name in found:
            raise InputError(f"--actuator {text}: {name} exists already, expected another name")
        settings = load_settings(Path(config) if config else None)
        if node == "monitor":  # a dashboard compares with no machine, and may be far from its file
            refuse_another_rig(settings)
        found[name] = (settings.model_copy(update={
            "rig": settings.rig.model_copy(update={"name": name}),
            "monitor": settings.monitor.model_copy(update={"namespace": f"/{name}"})}),
            config or "default config")
    return list(found.values())


def refuse_another_rig(settings: Settings) -> None:
    """Raise InputError where the machine file was made of another rig than the config's.

    By the name in the config: that of ``--actuator`` is no rig's, but a place's.
    """
    if not settings.diagnosis.machine:
        return
    from eha_monitor.balances.machine import load

    file, name = Path(settings.diagnosis.machine), settings.rig.name
    known = load(file, settings.rig)
    if known.rig != name:
        raise InputError(f"{file}: the machine of the rig {known.rig}, expected that of {name} "
                         "(rig.name)")


def check_apart(nodes: Sequence[Node]) -> None:
    """Raise InputError where two of the nodes have the same name."""
    names = [each.get_fully_qualified_name() for each in nodes]
    if len(set(names)) < len(names):
        raise InputError(f"ROS arguments: two actuators would both be {names[0]}, expected no "
                         "remap of the namespace or the node's name")
