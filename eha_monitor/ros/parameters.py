"""ROS parameters made from the declarations of the config: one table, no second list."""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from eha_monitor.errors import InputError
from eha_monitor.settings import Settings, settings_from_tree

# Sections that each node reads; a key of another section is not declared on it.
MONITOR_KEYS = ("rig", "channels", "noise", "stage_one", "stage_two", "discretisation",
                "command_hold", "thresholds", "viscosity", "monitor", "effects")
SIMULATOR_KEYS = ("rig", "channels", "simulation", "effects", "monitor")
# What may change while the node runs.
RUNTIME_SECTION = "thresholds"
# Parameters that rclpy itself declares.
_ROS_OWN = ("use_sim_time", "qos_overrides", "start_type_description_service")


@dataclass(frozen=True)
class Entry:
    """One scalar key of the config as a ROS parameter.

    Attributes
    ----------
    name : dotted, e.g. ``thresholds.viscous_damping.high_warn``.
    value : number, text or bool; None where the config says null.
    description, unit : from the declaration.
    lower, upper : range of a number, None where there is none.
    read_only : whether it is fixed once the node runs.
    """

    name: str
    value: Any
    description: str
    unit: str
    lower: float | None
    upper: float | None
    read_only: bool

    def descriptor(self) -> ParameterDescriptor:
        """Return the ROS descriptor."""
        unit = f" [{self.unit}]" if self.unit not in ("", "1") else ""
        descriptor = ParameterDescriptor(description=f"{self.description}{unit}",
                                         read_only=self.read_only)
        if self.lower is None and self.upper is None:
            return descriptor
        if isinstance(self.value, int):
            descriptor.integer_range = [IntegerRange(
                from_value=int(self.lower if self.lower is not None else -2**63),
                to_value=int(self.upper if self.upper is not None else 2**63 - 1))]
        else:
            largest = sys.float_info.max
            descriptor.floating_point_range = [FloatingPointRange(
                from_value=float(-largest if self.lower is None else self.lower),
                to_value=float(largest if self.upper is None else self.upper))]
        return descriptor


def parameter_table(settings: Settings, keys: tuple[str, ...]) -> list[Entry]:
    """Return every scalar key of the named sections with its declaration and value."""
    entries: list[Entry] = []
    for key in keys:
        field = type(settings).model_fields[key]
        _collect(key, getattr(settings, key), field, "", entries)
    return entries


def _collect(name: str, value: Any, field, context: str, entries: list[Entry]) -> None:
    description = (field.description or "") if field is not None else ""
    if isinstance(value, BaseModel):
        for key, inner in type(value).model_fields.items():
            _collect(f"{name}.{key}", getattr(value, key), inner, description, entries)
    elif isinstance(value, dict):
        for key, inner in value.items():
            _collect(f"{name}.{key}", inner, None, description, entries)
    elif isinstance(value, tuple):
        entries.append(_entry(name, list(value), field, context))
    else:
        entries.append(_entry(name, value, field, context))


def _entry(name: str, value: Any, field, context: str) -> Entry:
    lower = upper = None
    unit = description = ""
    if field is not None:
        description = field.description or ""
        unit = (field.json_schema_extra or {}).get("unit", "")
        for constraint in field.metadata:
            lower = getattr(constraint, "ge", getattr(constraint, "gt", lower))
            upper = getattr(constraint, "le", getattr(constraint, "lt", upper))
    text = ": ".join(part for part in (context, description) if part)
    return Entry(name, value, text, unit, lower, upper,
                 not name.startswith(f"{RUNTIME_SECTION}."))


def overridden(settings: Settings, changes: dict[str, Any], source: str) -> Settings:
    """Return the settings with dotted keys changed; NaN stands for null.

    Raises
    ------
    InputError
        One line that names the key and what was expected.
    """
    tree = settings.model_dump()
    for name, value in changes.items():
        if isinstance(value, float) and math.isnan(value):
            value = None
        if not isinstance(value, str | int | float | bool | None):
            value = list(value)
        *path, last = name.split(".")
        place = tree
        for part in path:
            inner = place.setdefault(part, {})
            if not isinstance(inner, dict):
                raise InputError(f"{source}: {name}: {part} has no keys of its own")
            place = inner
        place[last] = value
    return settings_from_tree(tree, source)


def settings_of_node(node: Node, settings: Settings, source: str = "ROS parameters") -> Settings:
    """Return the settings with what ``-p`` and ``--params-file`` say on top.

    The node must have been made with ``automatically_declare_parameters_from_overrides``: only
    so does a misspelt key show.

    Raises
    ------
    InputError
        One line that names the parameter and what was expected.
    """
    given = {name: parameter.value
             for name, parameter in node.get_parameters_by_prefix("").items()
             if name.split(".")[0] not in _ROS_OWN}
    changed = overridden(settings, given, source)
    if changed.monitor.namespace != settings.monitor.namespace:
        raise InputError(f"{source}: monitor.namespace: expected it in --config, or as a remap "
                         f"'-r __ns:={changed.monitor.namespace}'")
    for name in given:
        node.undeclare_parameter(name)
    return changed


def declare(node: Node, settings: Settings, keys: tuple[str, ...],
            on_change: Callable[[Settings], None] | None = None) -> None:
    """Declare the table on a node; thresholds may change at run time, validated as a config.

    Parameters
    ----------
    node : from :func:`settings_of_node`.
    settings : values to show.
    keys : sections to declare.
    on_change : called with the new settings after a change of the thresholds.
    """
    table = parameter_table(settings, keys)
    for entry in table:
        value = Parameter.Type.DOUBLE if entry.value is None else entry.value
        if entry.value is None and entry.read_only:
            continue  # a read-only value that is not set could never be shown
        node.declare_parameter(entry.name, value, entry.descriptor(), ignore_override=True)
    current = [settings]

    def validate(parameters: list[Parameter]) -> SetParametersResult:
        changes = {p.name: p.value for p in parameters if not p.name.startswith(_ROS_OWN)}
        if not changes:
            return SetParametersResult(successful=True)
        try:
            overridden(current[0], changes, "parameter")
        except InputError as problem:
            return SetParametersResult(successful=False, reason=str(problem))
        return SetParametersResult(successful=True)

    def apply(parameters: list[Parameter]) -> None:
        changes = {p.name: p.value for p in parameters if not p.name.startswith(_ROS_OWN)}
        if changes:
            current[0] = overridden(current[0], changes, "parameter")
            if on_change is not None:
                on_change(current[0])

    node.add_on_set_parameters_callback(validate)
    node.add_post_set_parameters_callback(apply)
