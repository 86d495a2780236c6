"""Nodes that never take the middleware's events, because those can stop every message for good.

rmw_fastrtps 8.4 holds the lock of an endpoint's events while it asks the endpoint for its status,
and Fast DDS holds the endpoint's lock while it tells of an event (pull request 890 of
rmw_fastrtps).  Where an EventsExecutor takes up an endpoint in the moment in which it is matched,
the two wait for each other forever, and the process receives nothing more.  rclpy asks for two
events of every endpoint, to warn of an incompatible QoS or type.
"""

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node


class WithoutEvents:
    """Mixed in before a kind of node: its endpoints ask for no event unless the caller does."""

    def create_publisher(self, *arguments, event_callbacks=None, **options):
        """Make a publisher as :meth:`rclpy.node.Node.create_publisher` does."""
        return super().create_publisher(
            *arguments, **options, event_callbacks=event_callbacks
            or PublisherEventCallbacks(use_default_callbacks=False))

    def create_subscription(self, *arguments, event_callbacks=None, **options):
        """Make a subscription as :meth:`rclpy.node.Node.create_subscription` does."""
        return super().create_subscription(
            *arguments, **options, event_callbacks=event_callbacks
            or SubscriptionEventCallbacks(use_default_callbacks=False))


class QuietNode(WithoutEvents, Node):
    """A node whose own endpoints, that of parameter events too, ask for no event."""
