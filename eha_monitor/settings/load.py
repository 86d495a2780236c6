"""Reading a config: ROS parameter file form, one-line errors; writing it as an annotated file."""

import difflib
import json
import math
import reprlib
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from eha_monitor.errors import InputError
from eha_monitor.output import check_regular
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig
from eha_monitor.units import beyond, lost_units, no_such_column, plain

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
    nodes are called; the sections may also stand at the top.  Raises InputError, one line: file,
    key, what was expected.
    """
    if path is None:
        return Settings()
    if not (tree := tree_of(path)):
        raise InputError(f"{path}: expected a config, found none of its sections")
    return settings_from_tree(tree, str(path), True)


def settings_of(text: str, source: str) -> Settings:
    """Return the settings of a config's text; ``source`` names it in errors."""
    return settings_from_tree(text_tree(text, source), source)


def tree_of(path: str | Path, what: str = "a config"):
    """Return the tree of a YAML file; ``what`` it is, in errors.

    Raises InputError, one line: file, what was expected.
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


def settings_from_tree(tree, source: str, by_hand: bool = False) -> Settings:
    """Validate a parsed YAML tree; ``source`` names it in errors.

    ``by_hand``: a person wrote it, who may have lost a unit.
    """
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
    settings = validated(Settings, merged, source)
    if by_hand:
        check_units(merged, source)
        if not_given := no_such_column(settings.rig):
            raise InputError(f"{source}: {not_given}")
    return settings


def check_units(tree: dict, source: str) -> None:
    """Refuse numbers alone that no actuator has, in one line."""
    for line in lost_units(tree, lambda path: _section_at(Settings, path)):
        raise InputError(f"{source}: {line}")


def validated(model: type[Model], tree: dict, source: str | Path) -> Model:
    """Return the model of a tree, or say in one line what is wrong first."""
    try:
        rig = tree.get("rig") if isinstance(tree, dict) else None
        motion = rig.get("motion") if isinstance(rig, dict) else None
        return model.model_validate(tree, context={"motion": motion})
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
        path = str(key).split(".")
        if path[0] in ROS_OWN:
            continue
        if isinstance(value, dict):
            value = _from_ros(value)
        elif isinstance(value, float) and math.isnan(value):
            value = None
        merge(tree, nested(path, value))
    return tree


def nested(path: list[str], value: Any) -> dict:
    """Return a tree in which a value stands at a path of at least one key."""
    for part in reversed(path):
        value = {part: value}
    return value


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
        text = words.format(unit=unit, input=reprlib.repr(error["input"]), **error.get("ctx", {}))
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


_WIDTH = 99
_BOUNDS = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))
_UNSET = "# "
YAML11_BOOLEANS = ("y", "n", "yes", "no", "on", "off", "true", "false")
_HEAD = """\
A config of eha_monitor.  Every key may be left out; its default is the value shown.
A number is in the SI unit named beside it, or a string with a unit: mass: "20 kg".
"""
_OWN = (
    "  <any other name>: a user-defined term, a formula or a table: docs/effects.md",
    "    adds: force (N, against positive motion), flow (m^3/s from chamber 2 into 1), flow_1, "
    "flow_2 (m^3/s into a chamber), speed (rad/s of the pump)",
    '    expression: e.g. "F*exp(-((x - x_0)/w)**2)*tanh(v/1e-3)" with F, x_0, w beside it, SI',
    "    of, first, last, values, times: a table over a signal (x, v, dp, p, omega, p1, p2)",
)


def annotated(settings: Settings, title: str = "") -> str:
    """Return ``settings`` as YAML in ROS parameter file form, with a comment on every key.

    ROS parameter files know neither null nor an empty mapping, so such a value stands in a
    comment where it is the default; so does what a config leaves out of its rig.
    """
    lines = [f"# {line}".rstrip() for line in (title + "\n" + _HEAD).strip().splitlines()]
    lines += ["/**:", "  ros__parameters:", *_section(settings, 4)]
    if not settings.effects:
        lines += _catalogue()
    return "\n".join(lines) + "\n"


def _section(model: BaseModel, indent: int, explain: bool = True,
             usual: BaseModel | None = None) -> Iterator[str]:
    """Yield the lines of a section; ``explain`` puts a comment on each key.

    ``usual`` is what the section is where it is left out: a null that differs from it must stand.
    """
    margin = " " * indent
    for place, (key, field) in enumerate(type(model).model_fields.items()):
        value = getattr(model, key)
        about = _about(field) if explain else ""
        if isinstance(value, (BaseModel, dict)):
            if place:
                yield ""
            yield from _comment(about, margin)
            empty = not isinstance(value, BaseModel) and not value
            yield f"{margin}{_UNSET if _unset(value, field) else ''}{key}:{' {}' * empty}"
            entries = (field.json_schema_extra or {}).get("entries", {})
            yield from _inside(value, indent + 2, explain, entries, field.default)
            if empty and explain:
                yield from _pattern(field.annotation, margin)
        else:
            unset = _unset(value, field) and getattr(usual, key, value) == value
            # A number of the rig that nobody gave binds nobody: written, it would.
            unset |= isinstance(model, Rig) and key not in (model.model_fields_set or {key})
            yield from _entry(f"{key}: {_in_unit(value, field)}", about, margin, unset)


def _inside(value: BaseModel | dict, indent: int, explain: bool, entries: Mapping[str, str],
            usual=None) -> Iterator[str]:
    """Yield the lines of a section or a mapping; ``entries`` says what each entry of one is."""
    if isinstance(value, BaseModel):
        yield from _section(value, indent, explain, usual)
        return
    margin = " " * indent
    for place, (name, item) in enumerate(value.items()):
        if isinstance(item, (BaseModel, dict)):
            yield from _entry(f"{name}:", entries.get(name, ""), margin, False)
            # Entries of a mapping have the same keys: the first one explains them for all.
            yield from _inside(item, indent + 2, explain and place == 0, {})
        else:
            yield f"{margin}{name}: {scalar(item)}"


def _pattern(annotation: Any, margin: str) -> Iterator[str]:
    """Yield, as comments, the keys of one entry of a mapping that has none yet."""
    kind = get_args(annotation)[-1]
    if not (isinstance(kind, type) and issubclass(kind, BaseModel)):
        return
    yield f"{margin}#   <name>:"
    for key, field in kind.model_fields.items():
        value = "..." if field.is_required() else scalar(field.default)
        yield from _comment(f"    {key}: {value}  # {_about(field)}", margin)


def _catalogue() -> Iterator[str]:
    """Yield the effects that a config may name, with their parameters, as comments."""
    margin = " " * 4
    for line in _OWN:
        yield from _comment(line, margin)
    for effect in CATALOGUE.values():
        yield from _comment(f"  {effect.name}: ({effect.balance} balance) {effect.equation}",
                            margin)
        for p in effect.parameters:
            unit = "" if p.unit == "1" else f"{p.unit}, "
            span = f"[{unit}{p.lower:g} to {p.upper:g}]"
            default = "" if p.default is None else f", {p.default:g} if omitted"
            yield from _comment(f"    {p.name}: {span} {p.description}{default}", margin)


def _unset(value: Any, field: FieldInfo) -> bool:
    return value == field.default and value in (None, {})


def _entry(text: str, about: str, margin: str, unset: bool) -> Iterator[str]:
    line = f"{margin}{_UNSET if unset else ''}{text}"
    if not about:
        yield line
    elif len(line) + 4 + len(about) <= _WIDTH:
        yield f"{line}  # {about}"
    else:
        yield from _comment(about, margin)
        yield line


def _comment(text: str, margin: str) -> list[str]:
    prefix = f"{margin}# "
    later = prefix + (" " * (len(text) - len(text.lstrip()) + 2) if text.startswith(" ") else "")
    return textwrap.wrap(text, _WIDTH, initial_indent=prefix, subsequent_indent=later)


def _about(field: FieldInfo) -> str:
    """Return ``[unit, range] description``."""
    unit = (field.json_schema_extra or {}).get("unit", "1")
    parts = [] if unit == "1" else [unit]
    parts += [choices] if (choices := _choices(field.annotation)) else []
    bounds = [f"{sign} {getattr(rule, name):g}" for name, sign in _BOUNDS
              for rule in field.metadata if getattr(rule, name, None) is not None]
    parts += [" and ".join(bounds)] if bounds else []
    return f"[{', '.join(parts)}] {field.description}" if parts else field.description or ""


def _choices(annotation: Any) -> str:
    """Return the words that a Literal, or a list of them, allows."""
    if get_origin(annotation) is Literal:
        return "|".join(get_args(annotation))
    if get_origin(annotation) is tuple:
        return f"list of {_choices(get_args(annotation)[0])}"
    return ""


def _in_unit(value: Any, field: FieldInfo) -> str:
    """Return a scalar; a number that reads as one without its unit has it."""
    extra = field.json_schema_extra
    possible = extra.get("possible") if isinstance(extra, dict) else None
    if possible and isinstance(value, float) and beyond(value, possible):
        return f'"{value!r} {plain(extra["unit"])}"'
    return scalar(value)


def scalar(value: Any) -> str:
    """Return a scalar that YAML 1.1 (ROS) and YAML 1.2 read alike."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(scalar(item) for item in value)}]"
    if isinstance(value, str):
        plain = value.replace("_", "a").replace("/", "a").isalnum()
        # No path, number, date, truth or null.
        plain = plain and value[0].isalpha() and value.lower() not in (*YAML11_BOOLEANS, "null")
        return value if plain else json.dumps(value, ensure_ascii=False)
    return str(value)


def _number(value: float) -> str:
    """Return a float that is exact, and that ROS takes for a double."""
    if value == 0 or 1e-4 <= abs(value) < 1e5:
        return repr(value)
    mantissa, _, power = np.format_float_scientific(value, trim="0").partition("e")
    return f"{mantissa}e{int(power):+d}"
