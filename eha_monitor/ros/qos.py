"""Qualities of service: those that the nodes use, and those that do not go together."""

from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)


def profile(depth: int, reliable: bool = True, latched: bool = False) -> QoSProfile:
    """Return a quality; ``latched``: a late subscriber gets the last messages."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)


LATCHED = profile(1, latched=True)
QUEUED = profile(10)
# The simulator's: reliable suits subscribers of either kind.
OUTPUT_QOS = profile(1000)
# Best effort takes from every publisher; the depth holds ten seconds of a process that stands.
INPUT_QOS = profile(10_000, reliable=False)
# What is shown may miss samples, and must not be late: the newest of each turn are enough.
SHOWN_QOS = profile(100, reliable=False)


def clashes(node: Node, topic: str) -> list[str]:
    """Return in sentences which others on a topic get nothing from a node, or give it nothing.

    Between qualities that do not go together DDS delivers nothing, and reports nothing.

    Parameters
    ----------
    node : publishes or subscribes there; the graph knows with what quality.
    topic : name, relative to the node's namespace; sentences have its full name, remaps included.
    """
    name = node.resolve_topic_name(topic)
    own = (node.get_name(), node.get_namespace())
    # Both ends as the graph has them: only there are their defaults written in the same way.
    publishers = node.get_publishers_info_by_topic(name)
    subscribers = node.get_subscriptions_info_by_topic(name)
    found = []
    for publisher in publishers:
        for subscriber in subscribers:
            ends = [(end.node_name, end.node_namespace) for end in (publisher, subscriber)]
            if own not in ends:
                continue
            verdict, reason = qos_check_compatible(publisher.qos_profile, subscriber.qos_profile)
            if verdict == QoSCompatibility.ERROR:
                why = " ".join(reason.replace("ERROR:", "").replace(";", " ").split())[:120]
                other = (f"the subscriber {_who(ends[1])} asks for a QoS that is not offered"
                         if own == ends[0] else
                         f"the publisher {_who(ends[0])} offers a QoS that cannot be taken")
                found.append(f"{name}: {other}, nothing is delivered: {why}")
    return found


def _who(end: tuple[str, str]) -> str:
    return f"{end[1].rstrip('/')}/{end[0]}"
