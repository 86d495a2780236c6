"""ROS parameters made from the declarations of the config: one table, no second list."""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import BaseModel
from pydantic_core import PydanticCustomError
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
from eha_monitor.settings.load import ROS_OWN
from eha_monitor.settings.monitor import LIMITS
from eha_monitor.units import LARGEST, to_si

# Sections that each node reads; a key of another section is not declared on it.
MONITOR_KEYS = ("rig", "channels", "noise", "stage_one", "stage_two", "discretisation",
                "command_hold", "thresholds", "viscosity", "monitor", "effects")
SIMULATOR_KEYS = ("rig", "channels", "simulation", "effects", "monitor")
# What may change while the node runs.
RUNTIME_SECTION = "thresholds"
_STRETCHES = ("excitation", "test_excitation")
# A ROS parameter knows no null: this number stands for it, and these words for the number.
UNSET, _UNSET_WORDS = math.nan, ("nan", ".nan", "null", "none", "~", "")


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
    number : whether it is one, or may be.
    optional : whether it may be null.
    """

    name: str
    value: Any
    description: str
    unit: str
    lower: float | None
    upper: float | None
    read_only: bool
    number: bool = False
    optional: bool = False

    @property
    def shown(self) -> Any:
        """The value as ROS is shown it: a number that is not set is NaN.

        A parameter without a value would make rclpy answer nothing to whoever asks for all.
        """
        return UNSET if self.value is None and self.number else self.value

    def descriptor(self) -> ParameterDescriptor:
        """Return the ROS descriptor."""
        unit = f" [{self.unit}]" if self.unit not in ("", "1") else ""
        descriptor = ParameterDescriptor(description=f"{self.description}{unit}",
                                         read_only=self.read_only)
        if self.optional and self.number:
            # A range in ROS's own form would refuse the NaN of what is not set.
            descriptor.additional_constraints = self._constraints()
            return descriptor
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


    def _constraints(self) -> str:
        """Return the range in words, and what stands for no number."""
        lower, upper = (f"{limit:g}" for limit in (
            -LARGEST if self.lower is None else self.lower,
            LARGEST if self.upper is None else self.upper))
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        text = f"a number from {lower} to {upper}{unit}; .nan: "
        if self.name.rpartition(".")[2] in LIMITS:
            return f"{text}no limit; expected {' <= '.join(LIMITS)}"
        return f"{text}the rig has none, or it is not known"


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
            _collect(f"{name}.{key}", getattr(value, key), inner, description or context, entries)
    elif isinstance(value, dict):
        words = (field.json_schema_extra or {}).get("entries", {}) if field is not None else {}
        for key, inner in value.items():
            _collect(f"{name}.{key}", inner, None, words.get(key, description or context), entries)
    elif isinstance(value, tuple):
        entries.append(_entry(name, list(value), field, context))
    else:
        entries.append(_entry(name, value, field, context))


def _entry(name: str, value: Any, field, context: str) -> Entry:
    lower = upper = None
    unit = description = ""
    kinds: tuple = ()
    if field is not None:
        description = field.description or ""
        unit = (field.json_schema_extra or {}).get("unit", "")
        kinds = get_args(field.annotation) or (field.annotation,)
        for constraint in field.metadata:
            lower = getattr(constraint, "ge", getattr(constraint, "gt", lower))
            upper = getattr(constraint, "le", getattr(constraint, "lt", upper))
    text = ": ".join(part for part in (context, description) if part)
    return Entry(name, value, text, unit, lower, upper,
                 not name.startswith(f"{RUNTIME_SECTION}."),
                 float in kinds or isinstance(value, float), type(None) in kinds)


def overridden(settings: Settings, changes: dict[str, Any], source: str,
               as_config: bool = False) -> Settings:
    """Return the settings with dotted keys changed; NaN stands for null.

    Parameters
    ----------
    as_config : whether the changes count as what the config itself says: beside a limit that is
        given, a default one that is out of order with it goes, and the numbers of the rig that
        nobody has given stay known as such.

    Raises
    ------
    InputError
        One line that names the key and what was expected.
    """
    tree = settings.model_dump(exclude_unset=as_config)
    tree["simulation"] = settings.simulation.model_dump()
    for stretches in _STRETCHES if as_config else ():
        # A part of a default stretch changes it; whole stretches stand in place of the default.
        whole = any(name.startswith(f"simulation.{stretches}.") and name.endswith(".kind")
                    for name in changes)
        if whole and stretches not in settings.simulation.model_fields_set:
            tree["simulation"][stretches] = {}
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


def number_of(value: Any, unit: str) -> Any:
    """Return what was set as a number in ``unit``; what is none stays as it is.

    >>> number_of(5, "Pa"), number_of("9e8", "Pa"), number_of("900 MPa", "Pa")
    (5.0, 900000000.0, 900000000.0)
    """
    if isinstance(value, str):
        if value.strip().lower() in _UNSET_WORDS:
            return UNSET
        try:
            value = float(value)
        except ValueError:
            try:
                value = to_si(value, unit or "1")
            except PydanticCustomError:
                return value
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


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
             if name.split(".")[0] not in ROS_OWN}
    changed = overridden(settings, given, source, as_config=True)
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
        if entry.shown is None:
            continue  # a text that is not set could never be shown
        node.declare_parameter(entry.name, entry.shown, entry.descriptor(), ignore_override=True)
    units = {entry.name: entry.unit for entry in table if entry.number}
    current = [settings]

    def convert(parameters: list[Parameter]) -> list[Parameter]:
        return [p if p.name not in units else
                Parameter(p.name, value=number_of(p.value, units[p.name])) for p in parameters]

    def validate(parameters: list[Parameter]) -> SetParametersResult:
        changes = {p.name: p.value for p in parameters if not p.name.startswith(ROS_OWN)}
        if not changes:
            return SetParametersResult(successful=True)
        try:
            overridden(current[0], changes, "parameter")
        except InputError as problem:
            return SetParametersResult(successful=False, reason=str(problem))
        return SetParametersResult(successful=True)

    def apply(parameters: list[Parameter]) -> None:
        changes = {p.name: p.value for p in parameters if not p.name.startswith(ROS_OWN)}
        if changes:
            current[0] = overridden(current[0], changes, "parameter")
            if on_change is not None:
                on_change(current[0])

    # Before rclpy compares the types: ``ros2 param set`` makes an integer of 5 and a text of 9e8.
    node.add_pre_set_parameters_callback(convert)
    node.add_on_set_parameters_callback(validate)
    node.add_post_set_parameters_callback(apply)
