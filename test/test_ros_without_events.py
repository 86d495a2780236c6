"""No endpoint of this package's nodes asks for the events that can stop every message."""

import pytest
from std_msgs.msg import Float64

from eha_monitor.ros import running
from eha_monitor.ros.managed_node import ManagedMonitor
from eha_monitor.settings import load_settings


def made_by_running(config):
    with running.node("quiet", "/eha") as node:
        node.create_publisher(Float64, "one", 1)
        node.create_subscription(Float64, "two", print, 1)
        yield node


def managed(config):
    node = ManagedMonitor(config)
    node.start(active=True)
    yield node
    node.destroy_node()


@pytest.mark.parametrize("make", [made_by_running, managed])
def test_no_endpoint_asks_for_events(graph, make):
    for node in make(load_settings(None)):
        endpoints = [*node.publishers, *node.subscriptions]
        assert any(each.topic_name == "/parameter_events" for each in node.publishers)
        assert not [each.topic_name for each in endpoints if each.event_handlers]
