"""Answers for a rig that turns: radians, newton metres and kg·m² where a linear one has m, N, kg.

The equations are the same, and so the diagnosis knows one set of units; here, where an answer
leaves the program, they become those of the rig.
"""

import re
from dataclasses import fields, is_dataclass, replace
from typing import TypeVar

from eha_monitor.quantity import spelt

UNITS = {"N": "N·m", "N·s/m": "N·m·s/rad", "N·s²/m²": "N·m·s²/rad²", "N/m": "N·m/rad",
         "kg": "kg·m²", "m": "rad", "m/s": "rad/s", "m/s²": "rad/s²", "m²": "m²·m/rad"}
_PREFIXES = {"N": "[Mkmµ]?", "k": "", "m": "[cmµn]?"}
_NAMES = ("bag", "bags", "source", "name", "balance", "equation", "verdict", "regime", "key")
# A number, a space, and one of these units as a whole; the longest one first.
_IN_TEXT = re.compile("(?<=[0-9⁰¹²³⁴⁵⁶⁷⁸⁹] )(?:" + "|".join(
    f"({_PREFIXES[unit[0]]})({re.escape(unit)})"
    for unit in sorted(UNITS, key=len, reverse=True)) + r")(?![\w·/²³])")
Answer = TypeVar("Answer")


def of_rig(answer: Answer, motion: str) -> Answer:
    """Return an answer (a record, a tree, a sentence) in the units of a rig with this motion."""
    return _turned(answer, "") if motion == "rotary" else answer


def _turned(part, name: str):
    if isinstance(part, str):
        if name in ("unit", "against_unit"):
            return UNITS.get(spelt(part), part)
        return part if name in _NAMES else _IN_TEXT.sub(_unit, part)
    if is_dataclass(part) and not isinstance(part, type):
        return replace(part, **{f.name: _turned(getattr(part, f.name), f.name)
                                for f in fields(part)})
    if isinstance(part, dict):
        return {key: _turned(value, key) for key, value in part.items()}
    if isinstance(part, (tuple, list)):
        return type(part)(_turned(one, name) for one in part)
    return part


def _unit(found: re.Match) -> str:
    prefix, unit = (group for group in found.groups() if group is not None)
    return prefix + UNITS[unit]
