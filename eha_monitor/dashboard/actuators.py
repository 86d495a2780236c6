"""One actuator as the page knows it."""

from dataclasses import dataclass

from eha_monitor.dashboard.state import State


@dataclass(frozen=True)
class Actuator:
    """One of the actuators on the page.

    Attributes
    ----------
    name : by which it is chosen; the name of its rig where it is the only one.
    namespace : of its topics.
    domain : ROS domain id that is listened to.
    state : what was heard of it.
    topics : full names of the topics, by those keys of ``View.silence`` that are looked at.
    """

    name: str
    namespace: str
    domain: int
    state: State
    topics: dict[str, str]
