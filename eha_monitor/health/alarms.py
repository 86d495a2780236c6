"""Thresholds to alarms (written by the health helper; interface fixed here)."""

from dataclasses import dataclass
from typing import Literal

Level = Literal["OK", "WARN", "ERROR", "STALE"]


@dataclass(frozen=True)
class Alarm:
    """State of one alarm at one time.

    ``name`` is ``viscous_damping_high``, ``viscous_damping_low``, ``bulk_modulus_high`` or
    ``bulk_modulus_low``; ``time_s`` is when it took this level.
    """

    name: str
    level: Level
    message: str
    time_s: float
