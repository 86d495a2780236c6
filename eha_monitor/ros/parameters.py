"""The config as ROS parameters: declared on nodes, and in the files that rcl reads.

They are declared from the declarations of the config: one table, no second list.

rcl reads YAML of a narrower kind than a config may be: everything below a node's name and
``ros__parameters``, no null, no empty mapping, a list of one type.  A file for ``--params-file``
that rcl would refuse is written anew for it; any other is left alone.
"""

import contextlib
import json
import math
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
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
from eha_monitor.settings.load import (
    ROS_OWN,
    ROS_PARAMETERS,
    check_units,
    merge,
    nested,
    ros_sections,
    tree_of,
)
from eha_monitor.settings.monitor import LIMITS
from eha_monitor.units import LARGEST, to_si

# Sections that each node reads; a key of another section is not declared on it.
MONITOR_KEYS = ("rig", "channels", "noise", "stage_one", "stage_two", "discretisation",
                "command_hold", "thresholds", "viscosity", "monitor", "diagnosis", "effects")
SIMULATOR_KEYS = ("rig", "channels", "simulation", "effects", "monitor")
# What may change while the node runs.
RUNTIME_SECTION = "thresholds"
OPTION = "--params-file"
ANY_NODE = "/**"
_LARGEST_INTEGER = 2**63 - 1
_STRETCHES = ("excitation", "test_excitation")
# A ROS parameter knows no null: this number stands for it, and these words for the number.
UNSET, _UNSET_WORDS = math.nan, ("nan", ".nan", "null", "none", "~", "")


@dataclass(frozen=True)
class Declared:
    """One scalar key of the config as a ROS parameter."""

    name: str  # dotted, e.g. ``thresholds.viscous_damping.high_warn``
    value: Any  # number, text or bool; None where the config says null
    # description, unit: from the declaration
    description: str
    unit: str
    # lower, upper: range of a number, None where there is none
    lower: float | None
    upper: float | None
    read_only: bool  # whether it is fixed once the node runs
    number: bool = False  # whether it is one, or may be
    optional: bool = False  # whether it may be null

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


def parameter_table(settings: Settings, keys: tuple[str, ...]) -> list[Declared]:
    """Return every scalar key of the named sections with its declaration and value."""
    return [entry for key in keys for entry in _declared(
        key, getattr(settings, key), type(settings).model_fields[key], "")]


def _declared(name: str, value: Any, field, context: str) -> Iterator[Declared]:
    description = (field.description or "") if field is not None else ""
    if isinstance(value, BaseModel):
        for key, inner in type(value).model_fields.items():
            yield from _declared(f"{name}.{key}", getattr(value, key), inner,
                                 description or context)
    elif isinstance(value, dict):
        words = (field.json_schema_extra or {}).get("entries", {}) if field is not None else {}
        for key, inner in value.items():
            yield from _declared(f"{name}.{key}", inner, None,
                                 words.get(key, description or context))
    else:
        yield _entry(name, list(value) if isinstance(value, tuple) else value, field, context)


def _entry(name: str, value: Any, field, context: str) -> Declared:
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
    return Declared(name, value, text, unit, lower, upper,
                    not name.startswith(f"{RUNTIME_SECTION}."),
                    float in kinds or isinstance(value, float), type(None) in kinds)


def overridden(settings: Settings, changes: dict[str, Any], source: str,
               as_config: bool = False) -> Settings:
    """Return the settings with dotted keys changed; NaN stands for null.

    ``as_config`` : whether the changes count as what the config itself says: beside a limit that
    is given, a default one that is out of order with it goes, and the numbers of the rig that
    nobody has given stay known as such.  Raises InputError, one line that names the key and what
    was expected.
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
        check_units(nested([*path, last], value), source)
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


def settings_of_node(node: Node, settings: Settings) -> Settings:
    """Return the settings with what ``-p`` and ``--params-file`` say on top.

    The node must have been made with ``automatically_declare_parameters_from_overrides``: only so
    does a misspelt key show.  Raises InputError, one line that names the parameter and what was
    expected.
    """
    given = {name: parameter.value
             for name, parameter in node.get_parameters_by_prefix("").items()
             if name.split(".")[0] not in ROS_OWN}
    changed = overridden(settings, given, "ROS parameters", as_config=True)
    if changed.monitor.namespace != settings.monitor.namespace:
        raise InputError("ROS parameters: monitor.namespace: expected it in --config, or as a "
                         f"remap '-r __ns:={changed.monitor.namespace}'")
    for name in given:
        node.undeclare_parameter(name)
    return changed


def declare(node: Node, settings: Settings, keys: tuple[str, ...],
            on_change: Callable[[Settings], None] | None = None) -> None:
    """Declare the table on a node; thresholds may change at run time, validated as a config.

    The node is from :func:`settings_of_node`; ``on_change`` is called with the new settings.
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

    def changed(parameters: list[Parameter]) -> Settings | None:
        """Return the settings with what changes, None where nothing of the config does."""
        changes = {p.name: p.value for p in parameters if not p.name.startswith(ROS_OWN)}
        return overridden(current[0], changes, "parameter") if changes else None

    def validate(parameters: list[Parameter]) -> SetParametersResult:
        try:
            changed(parameters)
        except InputError as problem:
            return SetParametersResult(successful=False, reason=str(problem))
        return SetParametersResult(successful=True)

    def apply(parameters: list[Parameter]) -> None:
        if (settings := changed(parameters)) is not None:
            current[0] = settings
            if on_change is not None:
                on_change(settings)

    # Before rclpy compares the types: ``ros2 param set`` makes an integer of 5 and a text of 9e8.
    node.add_pre_set_parameters_callback(convert)
    node.add_on_set_parameters_callback(validate)
    node.add_post_set_parameters_callback(apply)


@contextlib.contextmanager
def for_rcl(arguments: list[str]) -> Iterator[list[str]]:
    """Give ROS arguments with parameter files that rcl reads; they are there within the block.

    Raises InputError if a file cannot be read, or is neither a config nor a parameter file.
    """
    with tempfile.TemporaryDirectory(prefix="eha_monitor_") as folder:
        found = list(arguments)
        for place, path in _files(arguments):
            tree = _tree(path)
            if tree is None:
                continue
            copy = Path(folder, str(place), path.name)
            copy.parent.mkdir()
            copy.write_text(_yaml(in_ros_form(tree, str(path))), encoding="utf-8")
            found[place] = str(copy)
        yield found


def with_namespace(settings: Settings, arguments: list[str], node: str) -> Settings:
    """Return settings with the ``monitor.namespace`` that parameter files give a node.

    A node is named before it has parameters, so this one is looked up ahead.
    """
    namespace = settings.monitor.namespace
    for _, path in _files(arguments):
        tree = _tree(path)
        for name, parameters in () if tree is None else ros_sections(in_ros_form(tree, str(path))):
            monitor = parameters.get("monitor") if isinstance(parameters, dict) else None
            if name in (ANY_NODE, f"{ANY_NODE}/{node}", f"/{node}") and isinstance(monitor, dict):
                namespace = monitor.get("namespace", namespace)
    if not isinstance(namespace, str) or namespace == settings.monitor.namespace:
        return settings
    return settings.model_copy(update={
        "monitor": settings.monitor.model_copy(update={"namespace": namespace})})


def in_ros_form(tree: dict, source: str) -> dict:
    """Return a config's tree as one that rcl reads; sections at the top are for every node.

    Raises InputError where a list holds nothing, which no parameter file can say.
    """
    found: dict = {}
    for key, content in tree.items():
        if key == ROS_PARAMETERS or ros_sections({key: content}):
            found[key] = content
        else:
            merge(found.setdefault(ANY_NODE, {}), {ROS_PARAMETERS: {key: content}})
    return _plain(found, source, "")


def _files(arguments: list[str]) -> list[tuple[int, Path]]:
    """Return place and path of each parameter file among ROS arguments."""
    return [(place + 1, Path(arguments[place + 1])) for place, word in enumerate(arguments[:-1])
            if word == OPTION]


def _tree(path: Path) -> dict | None:
    """Return the tree of a file, or None where rcl alone is to judge a file that names nodes."""
    try:
        tree = tree_of(path, "a parameter file")
    except InputError:
        with contextlib.suppress(OSError):
            if ROS_PARAMETERS.encode() in path.read_bytes():
                return None
        raise
    if tree is not None and not isinstance(tree, dict):
        raise InputError(f"{path}: expected a mapping of sections, got {type(tree).__name__}")
    return tree or {}


def _plain(value: Any, source: str, key: str) -> Any:
    """Return a value as rcl takes it: NaN for null, no empty mapping, a list of one type."""
    if isinstance(value, dict):
        inner = {str(name): _plain(each, source, f"{key}.{name}" if key else str(name))
                 for name, each in value.items() if each != {}}
        return {name: each for name, each in inner.items() if each != {}}
    if isinstance(value, list | tuple):
        if not value:
            key = key.rpartition(f"{ROS_PARAMETERS}.")[2]
            raise InputError(f"{source}: {key}: expected at least one entry, a ROS parameter file "
                             "holds no empty list; give it with --config")
        numbers = all(isinstance(each, int | float) and not isinstance(each, bool)
                      for each in value)
        one = numbers and any(isinstance(each, float) for each in value)
        return [float(each) if one else _plain(each, source, key) for each in value]
    if value is None:
        return math.nan
    if isinstance(value, str | bool | float):
        return value
    if isinstance(value, int):
        return value if abs(value) <= _LARGEST_INTEGER else float(value)
    return str(value)


def _yaml(value: Any) -> str:
    """Return a value as YAML in flow form, which JSON is but for NaN and infinity."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)}: {_yaml(each)}"
                               for key, each in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_yaml(each) for each in value) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return ".nan" if math.isnan(value) else ".inf" if value > 0 else "-.inf"
    return json.dumps(value)
