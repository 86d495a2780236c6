"""Parameter files for rcl: a config in either form is one, as ``--params-file`` takes it.

rcl reads YAML of a narrower kind than a config may be: everything below a node's name and
``ros__parameters``, no null, no empty mapping, a list of one type.  A file that rcl would refuse
is written anew for it; any other is left alone.
"""

import contextlib
import json
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from eha_monitor.errors import InputError
from eha_monitor.settings import Settings
from eha_monitor.settings.load import ROS_PARAMETERS, merge, ros_sections, tree_of

OPTION = "--params-file"
ANY_NODE = "/**"
_LARGEST_INTEGER = 2**63 - 1


@contextlib.contextmanager
def for_rcl(arguments: list[str]) -> Iterator[list[str]]:
    """Give ROS arguments with parameter files that rcl reads; they are there within the block.

    Raises
    ------
    InputError
        If a file cannot be read, or is neither a config nor a parameter file.
    """
    with tempfile.TemporaryDirectory(prefix="eha_monitor_") as folder:
        found = list(arguments)
        for place, path in _files(arguments):
            tree = _tree(path)
            if tree is None or (_sections_only(tree) and _fits(tree)):
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
        for name, parameters in () if tree is None else ros_sections(
                in_ros_form(tree, str(path))):
            monitor = parameters.get("monitor") if isinstance(parameters, dict) else None
            if name in (ANY_NODE, f"{ANY_NODE}/{node}", f"/{node}") and isinstance(monitor, dict):
                namespace = monitor.get("namespace", namespace)
    if not isinstance(namespace, str) or namespace == settings.monitor.namespace:
        return settings
    return settings.model_copy(update={
        "monitor": settings.monitor.model_copy(update={"namespace": namespace})})


def in_ros_form(tree: dict, source: str) -> dict:
    """Return a config's tree as one that rcl reads; sections at the top are for every node.

    Raises
    ------
    InputError
        Where a list holds nothing, which no parameter file can say.
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


def _sections_only(tree: dict) -> bool:
    """Tell whether everything stands below a node's name."""
    return bool(tree) and all(ros_sections({key: content}) for key, content in tree.items())


def _fits(value: Any) -> bool:
    """Tell whether rcl reads a value as it is."""
    if isinstance(value, dict):
        return bool(value) and all(_fits(each) for each in value.values())
    if isinstance(value, list):
        return bool(value) and len({type(each) for each in value}) == 1 and all(
            isinstance(each, str | int | float) for each in value)
    return isinstance(value, str | int | float)


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
