"""Faults that only a graph has, and what the diagnostics make of a fault."""

import time

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_tools import Recorder, levels, listen, start
from std_msgs.msg import Float64

from eha_monitor.estimation.results import ParameterEstimate
from eha_monitor.ros.topics import INPUT_QOS, LATCHED, clashes

LATCHING = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                      durability=DurabilityPolicy.TRANSIENT_LOCAL)


def test_a_subscriber_that_asks_for_more_than_is_offered_is_named(graph):
    monitor, _, sender = start(graph)
    other = graph.node("page", "/other")
    asked = other.create_subscription(Float64, "/eha/monitor/viscous_damping", print, LATCHING)
    sender.send(0, 20)
    told = graph.until(lambda: [p for p in monitor.data.problems if "QoS" in p])
    assert "monitor/viscous_damping: the subscriber /other/page asks for a QoS" in told[0]
    other.destroy_subscription(asked)
    graph.until(lambda: not any("QoS" in p for p in monitor.data.problems))


def test_a_publisher_that_offers_too_little_is_named(graph):
    node, other = graph.node("taker", "/eha"), graph.node("giver", "/eha")
    node.create_subscription(Float64, "number", print, LATCHING)
    other.create_publisher(Float64, "number", INPUT_QOS)
    told = graph.until(lambda: clashes(node, "number"))
    assert told[0].startswith(
        "/eha/number: the publisher /eha/giver offers a QoS that cannot be taken")


class Lost(Recorder):
    """An estimator whose B has diverged."""

    def snapshot(self):
        from dataclasses import replace
        found = super().snapshot()
        lost = ParameterEstimate("B", float("nan"), float("nan"), "N·s/m", "diverged", "B went")
        return replace(found, parameters={**found.parameters, "B": lost})


@pytest.mark.parametrize("samples, level", [(1500, DiagnosticStatus.WARN),
                                            (3000, DiagnosticStatus.ERROR)])
def test_a_parameter_is_lost_only_when_it_stays_so(graph, monkeypatch, samples, level):
    monitor, estimator, sender = start(graph)
    # What a busy machine loses or delays is a fault of the data, and begins the two seconds anew.
    monkeypatch.setattr(monitor.watch, "sentences", lambda now, without=(): [])
    estimator.__class__ = Lost
    health = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    sender.send(0, samples)
    graph.until(lambda: len(estimator.rows) == samples and health)
    monitor._judge()
    monitor._publish_health()
    heard = len(health)
    graph.until(lambda: len(health) > heard)
    assert levels(health[-1])["eha: stage_one"] == level


def test_a_parameter_that_goes_astray_on_faulty_data_is_no_error(graph, monkeypatch):
    monitor, estimator, sender = start(graph)
    estimator.__class__ = Lost
    with monkeypatch.context() as clean:
        clean.setattr(monitor.watch, "sentences", lambda now, without=(): [])
        sender.send(0, 3000)
        graph.until(lambda: len(estimator.rows) == 3000)
    assert monitor.data.unsettled == set()
    monitor.watch.note("gauge", time.monotonic(), "gauge: messages are dropped")
    monitor._judge()
    assert monitor.data.unsettled == {"B"}


def test_a_frozen_channel_reaches_neither_rows_nor_estimates(graph):
    monitor, estimator, _ = start(graph)
    taken_back = []
    estimator.withdraw = lambda channel, since_s: taken_back.append((channel, since_s))
    source = {channel: s for s in monitor.aligner.sources for channel in s.channels}

    def feed(first, count, still):
        for k in range(first, first + count):
            now = k * 1e-3
            x = 3e-4 * abs((k * 7) % 2000 - 1000)
            for name, values in (("p1", (1e6 if still else 1e6 + k,)), ("p2", (2e6 + k,)),
                                 ("x_d", (x,)), ("x", (x, 0.1 * k, float("nan")))):
                monitor.aligner.push(source[name], (5000 + k) * 1_000_000, values, now)
            monitor.process(now)
            if k % 250 == 249:
                monitor._look(now)
    feed(0, 4000, False)
    assert not taken_back and "p1" in estimator.rows[-1][1]
    feed(4000, 1000, True)
    assert [channel for channel, _ in taken_back] == ["p1"]
    assert taken_back[0][1] == pytest.approx(4.0, abs=0.002)
    assert "p1" not in estimator.rows[-1][1] and "p2" in estimator.rows[-1][1]
    assert any("p1 has not changed for" in problem for problem in monitor.data.problems)
    feed(5000, 20, False)
    assert "p1" in estimator.rows[-1][1]
