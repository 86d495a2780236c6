"""Condition monitor for electrohydraulic actuators (ROS 2 Jazzy)."""

__version__ = "0.1.0"
