"""The config as an annotated file: every key with its value, unit, range and description."""

import textwrap
from collections.abc import Iterator, Mapping
from typing import Any, Literal, get_args, get_origin

import numpy as np
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.settings.monitor import Settings

_WIDTH = 99
_BOUNDS = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))
_UNSET = "# "
_YAML11_BOOLEANS = ("y", "n", "yes", "no", "on", "off", "true", "false")
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
    comment where it is the default.
    """
    lines = [f"# {line}".rstrip() for line in (title + "\n" + _HEAD).strip().splitlines()]
    lines += ["/**:", "  ros__parameters:", *_section(settings, 4)]
    if not settings.effects:
        lines += _catalogue(4)
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
            yield from _entry(f"{key}: {_scalar(value)}", about, margin, unset)


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
            yield f"{margin}{name}: {_scalar(item)}"


def _pattern(annotation: Any, margin: str) -> Iterator[str]:
    """Yield, as comments, the keys of one entry of a mapping that has none yet."""
    kind = get_args(annotation)[-1]
    if not (isinstance(kind, type) and issubclass(kind, BaseModel)):
        return
    yield f"{margin}#   <name>:"
    for key, field in kind.model_fields.items():
        value = "..." if field.is_required() else _scalar(field.default)
        yield from _comment(f"    {key}: {value}  # {_about(field)}", margin)


def _catalogue(indent: int) -> Iterator[str]:
    """Yield the effects that a config may name, with their parameters, as comments."""
    margin = " " * indent
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


def _scalar(value: Any) -> str:
    """Return a scalar that YAML 1.1 (ROS) and YAML 1.2 read alike."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(_scalar(item) for item in value)}]"
    if isinstance(value, str):
        plain = value.replace("_", "a").replace("/", "a").isalnum()
        plain = plain and not value.startswith("/") and value.lower() not in _YAML11_BOOLEANS
        return value if plain else f'"{value}"'
    return str(value)


def _number(value: float) -> str:
    """Return a float that is exact, and that ROS takes for a double."""
    if value == 0 or 1e-4 <= abs(value) < 1e5:
        return repr(value)
    mantissa, _, power = np.format_float_scientific(value, trim="0").partition("e")
    return f"{mantissa}e{int(power):+d}"
