"""Reading a config: ROS parameter file form, one-line errors."""

import difflib
import math
import reprlib
from pathlib import Path
from typing import TypeVar, get_args

from pydantic import BaseModel, ValidationError

from eha_monitor.errors import InputError
from eha_monitor.output import check_regular
from eha_monitor.settings.monitor import Settings

LARGEST = 1024 * 1024  # bytes of a config
Model = TypeVar("Model", bound=BaseModel)
ROS_PARAMETERS = "ros__parameters"
# Parameters that rclpy itself declares.
ROS_OWN = ("use_sim_time", "qos_overrides", "start_type_description_service")
DEEPEST = 32  # of a node's name
_WORDS = {
    "greater_than": "expected more than {gt:g}{unit}, got {input}",
    "greater_than_equal": "expected at least {ge:g}{unit}, got {input}",
    "less_than": "expected less than {lt:g}{unit}, got {input}",
    "less_than_equal": "expected at most {le:g}{unit}, got {input}",
    "finite_number": "expected a finite number{unit}, got {input}",
    "dict_type": "expected a mapping, got {input}",
    "model_type": "expected a mapping, got {input}",
    "float_type": "expected a number{unit}, got {input}",
    "float_parsing": "expected a number{unit}, got {input}",
}


def load_settings(path: str | Path | None) -> Settings:
    """Return the settings of a YAML file, or the paper's EHA for None.

    The file has the form of a ROS parameter file (``/**: ros__parameters: ...``), whatever the
    nodes are called; the sections may also stand at the top.

    Raises
    ------
    InputError
        One line: file, key, what was expected.
    """
    return Settings() if path is None else settings_from_tree(tree_of(path), str(path))


def settings_of(text: str, source: str) -> Settings:
    """Return the settings of a config's text; ``source`` names it in errors."""
    return settings_from_tree(text_tree(text, source), source)


def tree_of(path: str | Path, what: str = "a config"):
    """Return the tree of a YAML file; ``what`` it is, in errors.

    Raises
    ------
    InputError
        One line: file, what was expected.
    """
    path = Path(path)
    check_regular(path, what, streams=True)
    try:
        with path.open("rb") as file:  # what is given by mistake may be large
            content = file.read(LARGEST + 1)
        if len(content) > LARGEST:
            raise InputError(f"{path}: expected {what} of at most {LARGEST // 1024} KiB")
        text = content.decode("utf-8")
    except OSError as problem:
        raise InputError(f"{path}: cannot read {what.removeprefix('a ')}: "
                         f"{problem.strerror}") from problem
    except UnicodeDecodeError as problem:
        raise InputError(f"{path}: expected UTF-8 text") from problem
    return text_tree(text, path)


def text_tree(text: str, path: Path | str):
    """Return the tree of a YAML text; whatever the parser raises is one line with the file."""
    from ruamel.yaml import YAML  # YAML 1.2, where 6e8 is a number
    from ruamel.yaml.error import YAMLError

    try:
        return YAML(typ="safe").load(text)
    except Exception as problem:  # beside its own errors there were KeyError and AssertionError
        where = getattr(problem, "problem_mark", None)
        line = f" at line {where.line + 1}" if where else ""
        what = " ".join(str(getattr(problem, "problem", None) or problem).split())[:120]
        what = what if isinstance(problem, (YAMLError, ValueError)) else (
            f"the parser failed ({type(problem).__name__}: {what})")
        raise InputError(f"{path}: expected YAML, cannot parse{line}: {what}") from problem


def settings_from_tree(tree, source: str) -> Settings:
    """Validate a parsed YAML tree; ``source`` names it in errors."""
    if tree is None:
        tree = {}
    if not isinstance(tree, dict):
        raise InputError(f"{source}: expected a mapping of sections, got {type(tree).__name__}")
    merged: dict = {}
    for node, content in tree.items():
        sections = ros_sections({node: content})
        if not sections:
            merge(merged, {node: content})
        for name, parameters in sections:
            parameters = {} if parameters is None else parameters
            if not isinstance(parameters, dict):
                name = " ".join(name.split())[:100]
                raise InputError(f"{source}: {name}.{ROS_PARAMETERS}: expected a mapping")
            merge(merged, _from_ros(parameters))
    return validated(Settings, merged, source)


def validated(model: type[Model], tree: dict, source: str | Path) -> Model:
    """Return the model of a tree, or say in one line what is wrong first."""
    try:
        return model.model_validate(tree)
    except ValidationError as problem:
        line = " ".join(_one_line(model, problem).split())[:400]  # keys may hold line breaks
        raise InputError(f"{source}: {line}") from None


def ros_sections(tree, path: str = "") -> list[tuple[str, object]]:
    """Return node and parameters of each section of a ROS parameter file; none of another file.

    A section is what stands below ``ros__parameters``; the keys above it are the node's name.
    """
    if not isinstance(tree, dict):
        return []
    found = []
    for key, content in tree.items():
        if key == ROS_PARAMETERS:
            found.append((path, content))
        elif path.count("/") < DEEPEST:
            found += ros_sections(content, f"{path}/{key}".replace("//", "/"))
    return found


def merge(tree: dict, more: dict) -> None:
    """Put ``more`` into a tree, key by key of each mapping that both have."""
    for key, value in more.items():
        if isinstance(value, dict) and isinstance(tree.get(key), dict):
            merge(tree[key], value)
        else:
            tree[key] = value


def _from_ros(parameters: dict) -> dict:
    """Return parameters as a tree: ``rig.mass`` is a key in a section, and NaN stands for null.

    That is what ``ros2 param dump`` writes; the parameters of rclpy itself are left out.
    """
    tree: dict = {}
    for key, value in parameters.items():
        *path, last = str(key).split(".")
        if (*path, last)[0] in ROS_OWN:
            continue
        if isinstance(value, dict):
            value = _from_ros(value)
        elif isinstance(value, float) and math.isnan(value):
            value = None
        for part in reversed((*path, last)):
            value = {part: value}
        merge(tree, value)
    return tree


def _one_line(model: type[BaseModel], problem: ValidationError) -> str:
    error = problem.errors()[0]
    location = tuple(part for part in error["loc"] if part != "[key]")
    key = ".".join(str(part) for part in location)
    parent = _section_at(model, location[:-1]) if location else None
    if error["type"] == "extra_forbidden":
        known = list(parent.model_fields) if parent else []
        close = difflib.get_close_matches(str(location[-1]), known, 1)
        hint = f"did you mean '{close[0]}'?" if close else f"expected one of {', '.join(known)}"
        return f"{key}: unknown key, {hint}"
    field = parent.model_fields.get(str(location[-1])) if parent else None
    unit = (field.json_schema_extra or {}).get("unit", "") if field is not None else ""
    unit = f" in {unit}" if unit and unit != "1" else ""
    words = _WORDS.get(error["type"])
    if words:
        text = words.format(unit=unit, input=reprlib.repr(error["input"]),
                            **error.get("ctx", {}))
    else:
        text = error["msg"].removeprefix("Value error, ")
        text = text[0].lower() + text[1:]
        if error["type"] not in ("value_error", "number", "unit") and not isinstance(
                error["input"], dict):
            text += f", got {reprlib.repr(error['input'])}"
    return f"{key}: {text}" if key else text


def _section_at(model, location: tuple):
    """Return the section at a location: a part is a key of a section or a name in a mapping."""
    for part in location:
        if isinstance(model, type) and issubclass(model, BaseModel):
            field = model.model_fields.get(str(part))
            model = field.annotation if field else None
        else:  # dict[str, Section]: whatever the name, its value is the section
            model = get_args(model)[1] if len(get_args(model)) == 2 else None
    return model if isinstance(model, type) and issubclass(model, BaseModel) else None
