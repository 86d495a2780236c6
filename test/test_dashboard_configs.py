"""The configs for other dashboards name what the monitor really publishes."""

import json
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from ros_tools import Recorder, listen, start
from ruamel.yaml import YAML

from eha_monitor.estimation.results import Consistency, LiveSnapshot
from eha_monitor.ros.topics import LATCHED

CONFIG = Path(__file__).parents[1] / "config"
FILTER = re.compile(r'\{name=="([^"]+)"\}')


@pytest.fixture
def published(graph):
    """Topics of a fed monitor's graph; of health and estimates: name -> keys of the values."""
    _monitor, estimator, sender = start(graph)
    estimator.snapshot = lambda: with_consistency(Recorder.snapshot(estimator))
    heard = listen(graph, DiagnosticArray, "/eha/monitor/health", LATCHED)
    estimates = listen(graph, DiagnosticArray, "/eha/monitor/estimates")
    sender.send(0, 100)
    graph.until(lambda: heard and estimates and any(
        pair.key == "innovation_nis" for status in heard[-1].status for pair in status.values))
    topics = {name for name, _ in graph.nodes[0].get_topic_names_and_types()}
    return topics, _keys(heard[-1]), _keys(estimates[-1])


def _keys(message):
    return {status.name: {pair.key for pair in status.values} for status in message.status}


def with_consistency(snapshot: LiveSnapshot) -> LiveSnapshot:
    fits = Consistency(1000, 1.0, 1.1, 0.1, 5.0, True, "as expected")
    return LiveSnapshot(**{**vars(snapshot), "consistency": {"one": fits, "two": fits}})


def test_plotjuggler_layout(published):
    topics, statuses, estimates = published
    root = ElementTree.parse(CONFIG / "plotjuggler_layout.xml").getroot()
    selected = {topic.get("name") for topic in root.iter("topic")}
    assert selected <= topics
    curves = [curve.get("name") for curve in root.iter("curve")]
    assert len(curves) > 15
    for curve in curves:
        topic = next(name for name in sorted(topics, key=len, reverse=True)
                     if curve.startswith(name + "/"))
        assert topic in selected
        rest = curve.removeprefix(topic + "/").split("/")
        if topic in ("/eha/monitor/health", "/eha/monitor/estimates"):
            hardware, name, key = rest
            known = estimates if topic.endswith("estimates") else statuses
            assert hardware == "eha" and key in known[name], curve
        else:
            assert rest == ["piston", "position"], curve


def test_foxglove_layout(published):
    topics, statuses, _ = published
    layout = json.loads((CONFIG / "foxglove_layout.json").read_text(encoding="utf-8"))
    panels = layout["configById"]
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    assert len(paths) > 10
    for path in paths:
        assert path.split(".")[0] in topics, path
        assert set(FILTER.findall(path)) <= set(statuses), path
    for panel in panels.values():
        assert panel.get("topicToRender", "/diagnostics") in topics
        assert panel.get("selectedName", "eha: data") in statuses

    def leaves(node):
        return {node} if isinstance(node, str) else leaves(node["first"]) | leaves(node["second"])
    assert leaves(layout["layout"]) == set(panels)


def test_diagnostic_aggregator(published):
    """Every status falls into exactly one group, and each group has as many as it expects."""
    _, statuses, _ = published
    text = (CONFIG / "diagnostic_aggregator.yaml").read_text(encoding="utf-8")
    groups = [group for group in YAML(typ="safe").load(text)["/**"]["ros__parameters"].values()
              if isinstance(group, dict)]
    matched = []
    for group in groups:
        found = [name for name in statuses if any(part in name for part in group["contains"])]
        assert len(found) == group["num_items"]
        assert all(any(part in name for name in statuses) for part in group["contains"])
        matched += found
    assert sorted(matched) == sorted(statuses)
