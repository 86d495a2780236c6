"""A rig over ROS for an experiment: commands out, recordings in, limits watched."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from eha_monitor.errors import InputError
from eha_monitor.identify.experiment import CHANNELS, FOLLOWS, HELD, Ran, Rig, Watch, held
from eha_monitor.quantity import quantity
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import BagWriter
from eha_monitor.ros import running
from eha_monitor.ros.messages import joint_state
from eha_monitor.ros.parameters import with_namespace
from eha_monitor.ros.subscriptions import TopicInput
from eha_monitor.ros.topics import OUTPUT_QOS, answered, every, topics_of
from eha_monitor.settings.monitor import Experiment as Bounds
from eha_monitor.settings.monitor import Settings

TURN = 0.01  # s between two turns: what comes is looked at, what is due is sent
GRAPH = 0.2  # s between two looks at who publishes
HOLDING = 0.1  # s between two commands while a position is held
PATIENCE = 30.0  # s that a rig has to appear
STALLED = 0.1  # s that a command may be overdue: what the rig missed would come as a jump
ENDING = 5.0  # s in which what has come of an interrupted motion is written
TAIL = 0.2  # s for which what comes is still recorded after a motion
LATE = 0.3  # s after which a piston must have begun to follow
OFF = 0.02  # of the travel by which a piston at rest may be off where it is held
COMMAND = "command"


@dataclass
class Job:
    """A motion that is run."""

    x_d: np.ndarray  # (n,) m; ``start_ns`` stamp of the first, ``sent`` how many are
    start_ns: int
    end_ns: int  # stamp up to which what comes is recorded
    watch: Watch
    sent: int = 0
    low: float = np.inf  # of the positions that came, m; ``high`` likewise
    high: float = -np.inf
    # topic and type -> (received ns, message)
    kept: dict[tuple[str, str], list[tuple[int, bytes]]] = field(default_factory=dict)
    # aborted, asked: why it ends early, and whether somebody asked for it
    aborted: str = ""
    asked: bool = False
    done: threading.Event = field(default_factory=threading.Event)


    def lags(self, now_ns: int, dt_ns: int, least: float) -> str:
        """Return that the piston does not follow what was demanded ``LATE`` s ago, or "".

        Not before ``least`` m are demanded.
        """
        due = self.x_d[:max((now_ns - self.start_ns) // dt_ns - round(1e9 * LATE) // dt_ns, 0)]
        asked = float(np.ptp(due)) if len(due) else 0.0
        came = self.high - self.low
        if not asked > least or not came < FOLLOWS * asked:
            return ""
        return (f"the piston moves by {quantity(came, 'm', 2)} where {quantity(asked, 'm', 2)} "
                "are demanded, expected one that follows the command")


class RosRig:
    """A rig on the topics of the channel map: its node turns in one thread, others ask it.

    Parameters
    ----------
    node : in the namespace of the topics.
    settings : validated config; ``source`` names it in errors.
    bounds : complete limits.
    folder : where each motion becomes a bag; ``overwrite`` those that are there.
    """

    def __init__(self, node: Node, settings: Settings, bounds: Bounds, folder: Path,
                 overwrite: bool = False, source: str = "config"):
        self._node, self._settings, self._bounds = node, settings, bounds
        self._folder, self._overwrite = folder, overwrite
        self._dt_ns = round(settings.rig.sample_time * 1e9)
        self._lead_ns = round(bounds.command_lead * 1e9)
        self._name = settings.channels["x"].name or "piston"
        self._inputs = [TopicInput(node, topic) for topic in topics_of(
            settings, source, node.resolve_topic_name)]
        self._publisher = node.create_publisher(JointState, COMMAND, OUTPUT_QOS)
        self._job: Job | None = None
        self._demanded = self._measured = np.nan
        self._heard: dict[str, float] = {}
        self._told, self._stop = 0.0, ""
        self._last_ns = 0  # stamp of the command sent last
        self.started, self.seen = threading.Event(), threading.Event()
        every(node, TURN, self._turn)
        every(node, GRAPH, self._look)
        node.create_service(Trigger, "identify/start", self._on_start)
        node.create_service(Trigger, "identify/stop", self._on_stop)

    def position(self) -> float:
        """Return where the piston is held, m; raises InputError if no position comes."""
        if not self.seen.wait(PATIENCE):
            channel = self._settings.channels["x"]
            raise InputError(f"{self._node.resolve_topic_name(channel.topic)}: no position came "
                             f"within {PATIENCE:g} s, expected {channel.field} of {self._name}")
        return float(self._demanded if np.isfinite(self._demanded) else self._measured)

    def ready(self) -> None:
        """Wait until somebody follows the command; InputError if none does or another commands."""
        topic, own = self._node.resolve_topic_name(COMMAND), self._node.get_name()
        end = time.monotonic() + PATIENCE
        while not any(info.node_name != own
                      for info in self._node.get_subscriptions_info_by_topic(topic)):
            if time.monotonic() > end:
                raise InputError(f"{topic}: nobody subscribes to it within {PATIENCE:g} s, "
                                 "expected a rig that follows it")
            time.sleep(GRAPH)
        others = {info.node_name for info in self._node.get_publishers_info_by_topic(topic)} - {
            own}
        if others:
            raise InputError(f"{topic}: {min(others)} commands the rig already, expected nobody "
                             "else")

    def run(self, x_d: np.ndarray, name: str) -> Ran:
        """Run a demand; see :meth:`Rig.run`."""
        noise = self._settings.noise
        now = self._node.get_clock().now().nanoseconds
        job = Job(x_d, now + self._lead_ns, now + self._lead_ns + len(x_d) * self._dt_ns
                  + round(TAIL * 1e9),
                  Watch(self._bounds, self._settings.rig.sample_time,
                        max(noise.position, noise.position_resolution)))
        self._heard = dict.fromkeys(self._heard, time.monotonic())
        self._job = job
        while not job.done.wait(1.0):
            pass
        bag = self._folder / name
        if not any(job.kept.values()):
            return Ran(Recording(self._settings.rig.sample_time, {}, source=name), job.aborted,
                       job.asked)
        self._folder.mkdir(parents=True, exist_ok=True)
        with BagWriter(bag, dict(job.kept.keys()), overwrite=self._overwrite) as writer:
            for received, topic, data in sorted(
                    (received, topic, data) for (topic, _), messages in job.kept.items()
                    for received, data in messages):
                writer.write_raw(topic, received, data)
        try:
            recording = read_recording(bag, self._settings)
        except InputError:
            if not job.aborted:
                raise
            recording = Recording(self._settings.rig.sample_time, {}, source=str(bag))
        return Ran(recording, job.aborted, job.asked, bag)

    def abort(self, why: str, asked: bool = False) -> bool:
        """Hold the position sent last; returns whether a motion was under way.

        What was sent is on its way, up to ``command_lead`` s of it: a rig that queues commands by
        their stamps does it yet, and would jump back to any earlier position.  But a piston that
        does not come there, as it is blocked or off, is held where it is: else its pump would go
        on against it (:meth:`_turn`).
        """
        job, now = self._job, self._node.get_clock().now().nanoseconds
        if job is None or job.aborted:
            return False
        job.aborted, job.asked = why, asked
        if job.sent:
            self._hold(held(self._bounds, job.x_d[job.sent - 1]), now)
        job.sent = len(job.x_d)
        job.end_ns = now + round(HELD * 1e9)
        return True

    def _hold(self, position: float, now: int) -> None:
        """Command a position behind all that was sent."""
        self._demanded, self._told = position, time.monotonic()
        self._send(position, max(now, self._last_ns + self._dt_ns))

    def _send(self, position: float, stamp_ns: int) -> None:
        self._last_ns = stamp_ns
        self._publisher.publish(joint_state(stamp_ns, self._name, position, np.nan,
                                            self._settings.frame_id))

    def _turn(self) -> None:
        """Look at what came, send what is due."""
        job, now = self._job, self._node.get_clock().now().nanoseconds
        self._take(job)
        if (job is None or job.aborted) and np.isfinite(self._demanded) and (
                time.monotonic() - self._told >= HOLDING):
            off = OFF * (self._bounds.upper - self._bounds.lower)
            if job is not None and abs(self._measured - self._demanded) > off:
                self._demanded = held(self._bounds, self._measured)
            self._hold(self._demanded, now)
        if job is None:
            return
        if self._stop and not job.aborted:
            self.abort(self._stop, asked=True)
        overdue = now - job.start_ns - job.sent * self._dt_ns
        if 0 < job.sent < len(job.x_d) and overdue > STALLED * 1e9:
            self.abort(f"this program stood still: a command is {1e-9 * overdue:.2f} s late")
        if not job.aborted and (why := job.lags(now, self._dt_ns, OFF * (
                self._bounds.upper - self._bounds.lower))):
            self.abort(why)
        silent = [name for name, at in self._heard.items()
                  if time.monotonic() - at > self._bounds.silence]
        if silent and not job.aborted:
            self.abort(f"nothing came of {', '.join(silent)} for {self._bounds.silence:g} s")
        due = min((now + self._lead_ns - job.start_ns) // self._dt_ns + 1, len(job.x_d))
        for k in range(job.sent, due):
            self._send(float(job.x_d[k]), job.start_ns + k * self._dt_ns)
        if due > job.sent:
            job.sent, self._demanded = due, float(job.x_d[due - 1])
            self._told = time.monotonic()
        if now >= job.end_ns:
            self._job = None
            job.done.set()

    def _take(self, job: Job | None) -> None:
        clock_ns, now = self._node.get_clock().now().nanoseconds, time.monotonic()
        for each in self._inputs:
            messages, received, _ = each.take()
            if not messages:
                continue
            if job is not None:
                job.kept.setdefault((each.topic.full_name, each.type), []).extend(
                    zip(received, messages, strict=True))
            for batch in each.reader.read(messages, np.full(len(messages), now),
                                          np.full(len(messages), clock_ns)):
                shown = {name: values for name, values in zip(
                    batch.source.channels, batch.values.T, strict=True)
                    if name in CHANNELS and np.isfinite(values).any()}
                self._heard |= dict.fromkeys(shown, now)
                if "x" in shown:
                    there = shown["x"][np.isfinite(shown["x"])]
                    self._measured = float(there[-1])
                    self.seen.set()
                    if job is not None:
                        job.low = min(job.low, float(there.min()))
                        job.high = max(job.high, float(there.max()))
                if job is not None and not job.aborted and (why := job.watch.exceeded(
                        shown, 1e-9 * batch.stamps if each.reader.stamped else None)):
                    self.abort(why)

    def _look(self) -> None:
        for each in self._inputs:
            each.follow_graph()

    def _on_start(self, request, response):
        waits = not self.started.is_set()
        self.started.set()
        return answered(response, waits, "the experiment begins" if waits else
                        "the experiment runs already, expected one that waits")

    def _on_stop(self, request, response):
        """Abort the motion, and run no further one."""
        self._stop = "the service identify/stop was called"
        moving = self.abort(self._stop, asked=True)
        self.started.set()
        return answered(response, True, "the motion is aborted, and its last position held"
                        if moving else "no motion is under way, and none will follow")


def run_identify(settings: Settings, bounds: Bounds, ros_args: list[str], wait: bool,
                 folder: tuple[Path, bool], experiment: Callable[[Rig], str]) -> str:
    """Run an experiment over ROS; returns why it was aborted, or "".

    Raises InputError if the rig does not answer, or the experiment raises it.

    Parameters
    ----------
    wait : for the service ``identify/start``.
    folder : of the bags, and whether to replace those that are there.
    experiment : runs on the rig, in a thread of its own.
    """
    settings = with_namespace(settings, ros_args, "identify")
    result: list[str] = []
    failed: list[BaseException] = []
    with (running.ros_session(ros_args),
          running.node("identify", settings.monitor.namespace) as node):
        rig = RosRig(node, settings, bounds, *folder)

        def work() -> None:
            try:
                if wait:
                    print("waiting for the service identify/start", flush=True)
                    rig.started.wait()
                rig.started.set()
                rig.position()
                rig.ready()
                result.append(experiment(rig))
            except BaseException as problem:  # noqa: BLE001  raised again where it is told
                failed.append(problem)

        worker = threading.Thread(target=work, name="identify", daemon=True)
        worker.start()
        running.spin(node, finished=lambda: not worker.is_alive())
        interrupted = worker.is_alive()
        # A motion ends as at the service identify/stop: the rig is held, and its bag written.
        if rig.abort("interrupted", asked=True):
            running.spin(node, ENDING, lambda: not worker.is_alive(), rclpy.ok)
    if failed:
        raise failed[0]
    if interrupted:
        raise KeyboardInterrupt
    return result[0] if result else ""
