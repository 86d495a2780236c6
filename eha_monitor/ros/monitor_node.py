"""The monitor node: live topics in, estimates and health out."""

import math
import re
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from rclpy.node import Node
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from eha_monitor.errors import InputError
from eha_monitor.estimation.results import Event, ModelStatus, ParameterEstimate
from eha_monitor.health.alarms import Alarm, AlarmBoard
from eha_monitor.health.overload import BEHIND_S, LatencyMeter, ProcessorMeter
from eha_monitor.live.diagnosing import Candidate
from eha_monitor.live.estimator import LiveEstimator
from eha_monitor.live.faults import CONSEQUENCES, FaultWatch
from eha_monitor.live.rows import RowAligner, Rows
from eha_monitor.ros.diagnosis import SelfDiagnosis
from eha_monitor.ros.findings import DataState, all_findings, levels, unfed, with_bags
from eha_monitor.ros.keeper import Keeper
from eha_monitor.ros.messages import Outputs
from eha_monitor.ros.subscriptions import DEMANDED, OPTIONAL, Drain, Load, TopicInput
from eha_monitor.ros.topics import answered, clashes, every, topics_of
from eha_monitor.settings import Settings

# Health is judged at this spacing of the data's own time, so that a replay at ten times the
# rate is judged as densely as the original.
JUDGE_EVERY_NS = 100_000_000
WATCH_PERIOD = 0.1
# A filter that has just been thrown off comes back or does not: an ERROR says that it did not.
DIVERGED_S = 2.0
LOOK_S = 0.19  # between two looks for faults of the data
QUIET_S = 30.0  # a problem of the data that was gone for so long is logged again
NUMBER = re.compile(r"\d")
DIAGNOSTICS_PERIOD = 1.0
FEW = 7  # of so many rows one counts in the latencies of each second; no divisor of a batch
CLASHES_PERIOD = 1.5  # to ask the graph for all ends of all topics costs 1.6 ms


class Monitor:
    """Estimator, alarms and topics on a node; unless ``active``, :meth:`activate` begins."""

    def __init__(self, node: Node, settings: Settings,
                 estimator_factory: Callable[[Settings], object] = LiveEstimator,
                 source: str = "config", active: bool = True):
        self.node, self.settings = node, settings
        self._factory = estimator_factory
        self.board = AlarmBoard(settings)
        self._topics = topics_of(settings, source, node.resolve_topic_name)
        self._topic_of = {channel: t.full_name for t in self._topics for e in t.entries
                          for channel, _ in e.channels}
        self.keeper = Keeper(node, settings, self._tell_of_bag)
        self._outputs = Outputs(node, self.keeper, settings)
        try:
            self.diagnosis = SelfDiagnosis(node, settings, self.keeper, self._outputs.diagnosis,
                                           self._candidate, self._exchange)
        except InputError:
            self.keeper.close()
            self._outputs.close()
            raise
        self.settings = self.diagnosis.in_force
        self._estimator = estimator_factory(self.settings)
        self._reset_service = node.create_service(Trigger, "monitor/reset", self._on_reset)
        self.inputs: list[TopicInput] = []
        self._timers: list[Timer] = []
        self._begin_anew()
        if active:
            self.activate()

    def _begin_anew(self) -> None:
        """Forget the data that came so far; estimates are the estimator's own."""
        self.latency, self.processor = LatencyMeter(), ProcessorMeter()
        self.data = DataState()
        self.missing_samples = 0
        self.aligner = RowAligner([e.source for t in self._topics for e in t.entries],
                                  self.settings.monitor.latency)
        self.watch = FaultWatch(self.aligner.sources, self.settings.rig.sample_time,
                                self.settings.monitor.latency,
                                self.settings.rig.motion == "rotary")
        self._clashes: list[str] = []
        self._warned: dict[str, float] = {}  # kind of problem -> when it last stood, s
        self._diverged: dict[str, int] = {}  # since when by the rows' stamps, ns
        self._looked = -math.inf
        self._snapshot = None
        self._model = ModelStatus("unknown", "no data yet")
        self._events: dict[str, Event] = {}
        self._origin_ns: int | None = None
        self._row_ns = self._judged_ns = 0
        self._row_came: float | None = None
        self._seen: dict[str, int] = {}
        self._levels: tuple | None = None
        self._fresh = False

    @property
    def active(self) -> bool:
        """Whether data are taken and estimates published."""
        return bool(self._timers)

    def activate(self) -> None:
        """Take data and publish, with an estimator that knows nothing yet."""
        self._note_stop(time.monotonic())
        self.inputs = [TopicInput(self.node, topic) for topic in self._topics]
        self.drain = Drain(self.node, self.inputs, self.aligner, self.keeper)
        self.load = Load(((1.0 / self.settings.monitor.publish_rate, self._publish_estimates),
                          (WATCH_PERIOD, self._watch),
                          (CLASHES_PERIOD, self._note_clashes),
                          (DIAGNOSTICS_PERIOD, self._every_second)),
                         self.settings.monitor.stale_after)
        self._timers = [every(self.node, self.load.period, self._work)]
        self._publish_health()

    def deactivate(self) -> None:
        """Take no more data and publish nothing, after a last health that says so.

        What the estimator knew is forgotten: the plant moves on unseen.  Thresholds, and the
        minutes in the buffer, stay.
        """
        self._stop("the monitor is not active")
        self._topics = topics_of(self.settings, resolve=self.node.resolve_topic_name)  # no past
        self._estimator.reset("deactivated")
        self.diagnosis.stop()
        self.diagnosis.reset("deactivated")
        self._begin_anew()

    def close(self) -> None:
        """End everything on the node, after a last health, and write the bag that is due."""
        if self.active:
            self._stop("the monitor has ended")
        self.diagnosis.close()
        self.keeper.close()
        self._outputs.close()
        self.node.destroy_service(self._reset_service)

    def _stop(self, reason: str) -> None:
        """Take no more data, and say so in a last health."""
        for timer in self._timers:
            self.node.destroy_timer(timer)
        for topic_input in self.inputs:
            topic_input.close()
        self._timers, self.inputs = [], []
        self.data.stopped = reason
        self.board.stale(self._seconds(), reason)
        self._publish_health()

    def reconfigure(self, settings: Settings) -> None:
        """Take other thresholds while running."""
        self.settings = self.diagnosis.configure(settings)
        self.board.configure(settings)
        self._judge()
        if self.active:
            self._publish_health()

    def _work(self) -> None:
        """Take what waits, and do what is due; then others have their turn."""
        now = time.monotonic()
        until = now + self.load.period
        self._note_away(now)
        more = True
        while more and now < until and self.active:
            more = self.drain.take()
            self.process(time.monotonic())
            now = time.monotonic()
            self._tick(now)
        if self.active:
            self.diagnosis.advance()
            self._publish_health(only_changes=True)

    def _tick(self, now: float) -> None:
        self._note_away(now)
        self.load.tick(now)

    def _note_away(self, now: float) -> None:
        """A silence while the monitor itself did not run is none of the data."""
        away = self.load.run(now) - self.load.period
        if away > BEHIND_S:
            if self._row_came is not None:
                self._row_came += away
            for source in self.aligner.sources:
                source.heard_s += away

    def process(self, now: float) -> None:
        """Give the rows that are complete at ``now`` (s, monotonic) to the estimator."""
        while True:
            self._take(self.watch.take(self.aligner.pop(now)))
            if self.aligner.reset_reason is None:
                return
            reason = self.aligner.take_reset()
            self.watch.restart(reason, now)
            self._reset(reason)

    def _take(self, rows: Rows) -> None:
        """Give rows to the estimator, and judge now and then."""
        while len(rows):
            if self._origin_ns is None:
                self._origin_ns = self._row_ns = int(rows.stamps[0])
            since = rows.stamps - self._judged_ns
            due = (since < 0) | (since >= JUDGE_EVERY_NS)
            stop = int(np.argmax(due)) + 1 if due.any() else len(rows)
            # What a turn brings is one piece, so that what is published at its end knows of all.
            if rows.stamps[-1] - rows.stamps[stop - 1] < JUDGE_EVERY_NS:
                stop = len(rows)
            self._give(rows.part(0, stop))
            if due.any():
                self._judge()
            rows = rows.part(stop, len(rows))
            if len(rows):
                self._tick(time.monotonic())  # much has come at once

    def _give(self, rows: Rows) -> None:
        steps = np.diff(rows.stamps, prepend=self._row_ns) * (1e-9 / self.settings.rig.sample_time)
        # A long gap is an interruption, or a clock that was set: it is told as such, and nothing
        # is lost within it.
        longest = self.settings.monitor.stale_after / self.settings.rig.sample_time
        lost_here = steps[(steps > 1.5) & (steps <= max(longest, 1.5))]
        self.missing_samples += int((np.rint(lost_here) - 1).sum())
        self._row_ns = int(rows.stamps[-1])
        # Since the first row: seconds since 1970 leave a double 0.2 µs of resolution.
        times = (rows.stamps - self._origin_ns) * 1e-9
        self._estimator.push_rows(times, rows.columns)
        self.diagnosis.push(times, rows.columns)
        for name, values in rows.columns.items():
            there = np.isfinite(values)
            if there.any():
                self._seen[name] = int(rows.stamps[there][-1])
        self._fresh = True
        self._row_came = time.monotonic()
        self.drain.worked_on(float(rows.came[-1]))
        self.latency.came(rows.stamps, rows.came)

    def _reset(self, reason: str) -> None:
        self.node.get_logger().warning(f"estimator reset: {reason}")
        self._estimator.reset(reason)
        self.diagnosis.reset(reason)
        self._origin_ns = None
        self._seen.clear()
        self.latency.restart()

    def _candidate(self, settings: Settings, since_s: float) -> Candidate:
        """Return an estimator that begins with the buffered rows from ``since_s`` on."""
        return Candidate(self._factory(settings), self._estimator.past(since_s))

    def _exchange(self, estimator: object, settings: Settings) -> None:
        """Go on with another estimator, which has taken the same rows with another model."""
        self._estimator, self.settings = estimator, settings
        estimator.snapshot()  # events of rows that were told of already
        self._judge()
        self._publish_health()

    def _on_reset(self, request, response):
        self._reset("requested by the service monitor/reset")
        return answered(response, True, "both estimators reset; alarms keep their state until "
                        "there is a new estimate")

    def _judge(self) -> None:
        """Bring snapshot and alarms up to the last row; an alarm that changed is published."""
        if self._origin_ns is None:
            return
        self._judged_ns = self._row_ns
        self.data.stopped = None
        snapshot = self._snapshot = self.diagnosis.known(self._estimator.snapshot())
        self._model = snapshot.model
        self.data.implausible = snapshot.implausible
        self.data.refused = bool(snapshot.implausible) and (
            snapshot.model.message == snapshot.implausible)
        if self.data.refused:
            self.diagnosis.leave_out()
        for event in snapshot.events:
            self._events[event.stage] = event
            self.node.get_logger().info(f"stage {event.stage}: {event.message}")
        self.diagnosis.note(self._model, snapshot.parameters, self._seconds())
        self._note_diverged(snapshot.parameters)
        parameters = {}
        for symbol, estimate in snapshot.parameters.items():
            reason = unfed(symbol, self._seen, self._row_ns, self.inputs, self.settings,
                           self.watch.stillness.frozen)
            parameters[symbol] = estimate if reason is None else replace(
                estimate, status="no_data", message=reason)
        changes = self.board.update(self._seconds(), parameters, snapshot.temperature,
                                    self._model.tainted)
        self._announce(changes)
        if changes:  # what else there is to tell is told at the end of the turn
            self._publish_health(only_changes=True)

    def _note_diverged(self, parameters: dict[str, ParameterEstimate]) -> None:
        """Note since when a parameter has been diverged on data without a fault."""
        faulty = bool(self.watch.stillness.frozen) or bool(self.watch.sentences(time.monotonic()))
        now = {symbol for symbol, estimate in parameters.items() if estimate.status == "diverged"}
        self._diverged = {symbol: self._row_ns if faulty else min(
            self._diverged.get(symbol, self._row_ns), self._row_ns) for symbol in now}
        self.data.unsettled = {symbol for symbol, since_ns in self._diverged.items()
                               if self._row_ns - since_ns < DIVERGED_S * 1e9}

    def _seconds(self) -> float:
        return (self._row_ns - (self._origin_ns or self._row_ns)) * 1e-9

    def _announce(self, changes: list[Alarm]) -> None:
        self.keeper.note(changes)
        log = self.node.get_logger()
        for alarm in changes:
            text = f"{alarm.name} {alarm.level}: {alarm.message}"
            if alarm.level == "ERROR":  # rclpy wants a line of code of its own for each severity
                log.error(text)
            elif alarm.level == "WARN":
                log.warning(text)
            else:
                log.info(text)

    def _watch(self) -> None:
        now = time.monotonic()
        self._note_stop(now)
        if now - self._looked >= LOOK_S:
            self._looked = now
            self._look(now)

    def _look(self, now: float) -> None:
        """Look for faults of the data, and take back what a frozen channel gave."""
        self.load.look(self.drain.look(), self.aligner.rows, self.missing_samples)
        self.data.overload = overload = self.load.watch.found(time.monotonic())
        for channel, since_ns in self.watch.look(now).items():
            if self._origin_ns is not None:
                since_s = (since_ns - self._origin_ns) * 1e-9
                self._estimator.withdraw(channel, since_s)
                self.diagnosis.withdraw(channel, since_s)
        limit = self.settings.monitor.stale_after
        heard = {channel for each in self.inputs if each.messages for channel in each.channels}
        optional = OPTIONAL | (DEMANDED if "omega" in heard else set())
        for problem in (p for each in self.inputs for p in each.problems(now, limit, optional)):
            self.watch.note(problem, now, problem)
        without = CONSEQUENCES if overload else ()
        told = self.watch.sentences(now, without)
        crowds = filter(None, (each.crowd(told) for each in self.inputs))
        self.data.problems = [*self._clashes, *crowds, *told]
        for problem in self.data.problems:  # its numbers go on changing while it stands
            kind = NUMBER.split(problem)[0]
            if now - self._warned.get(kind, -math.inf) > QUIET_S:
                self.node.get_logger().warning(f"data: {problem}")
            self._warned[kind] = now

    def _note_stop(self, now: float) -> None:
        """Make the health STALE when rows have stopped; wall time, as /clock may stop too."""
        limit = self.settings.monitor.stale_after
        topic = self._topic_of["x"]
        if self._row_came is None:
            reason = f"no data yet: nothing received on {topic}"
        elif now - self._row_came > limit:
            reason = f"data stopped: nothing on {topic} for more than {limit:g} s"
        else:
            return
        self.data.stopped = reason
        silence = 0.0 if self._row_came is None else now - self._row_came
        self._announce(self.board.stale(self._seconds() + silence, reason))

    def _publish_estimates(self) -> None:
        if not self._fresh:
            return  # nothing new: an old number is not published again
        self._fresh = False
        if self._judged_ns != self._row_ns:
            self._judge()
        snapshot = self._snapshot
        self._outputs.parameters(self._state_ns(snapshot.state_time_s), snapshot.parameters,
                                 snapshot.model)
        if snapshot.position == snapshot.position:  # not NaN
            name = self.settings.channels["x"].name or "piston"
            self._outputs.state(self._state_ns(snapshot.state_time_s), name, snapshot.position,
                                snapshot.velocity)
        self.latency.published(self._state_ns(snapshot.state_time_s))

    def _state_ns(self, state_time_s: float) -> int:
        """Return the stamp of the estimated state, which is some rows old; ns."""
        if not math.isfinite(state_time_s):
            return self._row_ns
        return (self._origin_ns or 0) + round(state_time_s * 1e9)

    def _note_clashes(self) -> None:
        names = (*(topic.name for topic in self._topics), *self._outputs.topics)
        self._clashes = [clash for name in names for clash in clashes(self.node, name)]

    def _every_second(self) -> None:
        for topic_input in self.inputs:
            topic_input.follow_graph()
        self._look(time.monotonic())
        self._update_data()
        self._publish_health()

    def _update_data(self) -> None:
        now = time.monotonic()
        values = {"rows": self.aligner.rows} | {
            f"rate_{each.key}_Hz": each.rate(now) for each in self.inputs}
        if self._origin_ns is not None:
            values["first_stamp_ns"] = str(self._origin_ns)
        if {"p1", "p2"} & set(self.settings.channels):
            values["pressures"] = "absolute, Pa"
        self.data.values = values | self.counts() | {
            "missing_share_percent": 100.0 * self.load.watch.share,
            "behind_s": self.load.watch.behind,
            **{f"latency_{key}_ms": value for key, value in self.latency.percentiles(FEW).items()},
            "latency_counts_from": self.latency.counts_from,
            "cpu_share_percent": 100.0 * self.processor.share()} | self._kept()

    def _kept(self) -> dict[str, float | int | str]:
        self.data.unsaved = self.keeper.unsaved
        return self.keeper.values()

    def _tell_of_bag(self) -> None:
        """Name a bag that has been written, or why it could not be, without delay."""
        self.data.values |= self._kept()
        if self.active:
            self._publish_health()

    def counts(self) -> dict[str, int]:
        """Return how much was lost or dropped since the start."""
        sources = self.aligner.sources
        return {"lost_messages": self.watch.missing,
                "missing_samples": self.missing_samples,
                "incomplete_rows": self.aligner.incomplete,
                "late_or_repeated_stamps": sum(s.late + s.repeated for s in sources),
                "jumped_stamps": sum(s.jumped for s in sources)}

    def _publish_health(self, only_changes: bool = False) -> None:
        snapshot = self._snapshot
        parameters = snapshot.parameters if snapshot else {}
        now = levels(self.board, parameters, self._model, self.data)
        if only_changes and now == self._levels:
            return
        self._levels = now
        found = all_findings(self.settings, self.board, parameters,
                             snapshot.consistency if snapshot else {},
                             self._model, self._events, self.data,
                             self.diagnosis.cause)
        self._outputs.health([*with_bags(found, self.keeper.bags), *self.diagnosis.of_machine])

    def summary(self) -> str:
        """Return what was processed, lost and how late, in one line."""
        lost = ", ".join(f"{key.replace('_', ' ')} {value}"
                         for key, value in self.counts().items())
        late = ", ".join(f"{key} {value:.2f} ms"
                         for key, value in self.latency.percentiles().items())
        return (f"rows {self.aligner.rows}; {lost}; latency from {self.latency.counts_from} to "
                f"published {late or 'not measured'}; "
                f"CPU share {100 * self.processor.total():.1f} %")
