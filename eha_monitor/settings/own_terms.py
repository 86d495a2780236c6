"""The section ``effects``: entries of the catalogue, and terms that it has not.

    worn_spot:     {adds: force, expression: "F*exp(-((x - x_0)/w)**2)", F: 38.0, x_0: 8e-3,
                    w: 4.1e-3}
    learned_force: {adds: force, of: x, times: direction, scale: 1e-3, first: -0.03, last: 0.03,
                    values: [0.0, 1.2, ...]}

``adds``: force (N, against positive motion), flow (m³/s from chamber 2 into 1), flow_1 and flow_2
(m³/s into one chamber), speed (rad/s of the shaft that makes flow).  All numbers are SI.
"""

import math
import re

import numpy as np
from pydantic_core import PydanticCustomError

from eha_monitor.physics import own_term as o
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.own_term import parsed
from eha_monitor.physics.signals import N_SIGNALS, P1, P2
from eha_monitor.units import to_si

KEY = "adds"  # by which such an entry is known
_TABLE = ("adds", "of", "times", "scale", "first", "last", "values")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,39}")
FEWEST_KNOTS = 3


def is_own(given) -> bool:
    """Tell whether an entry of ``effects`` is a term of its own, not one of the catalogue."""
    return isinstance(given, dict) and KEY in given


def checked(name: str, given: dict) -> dict:
    """Return such an entry with all its keys.

    Raises ValueError, naming the entry, its key and what was expected.
    """
    if name in CATALOGUE:
        raise ValueError(f"{name}.adds: {name} is an effect of the catalogue, expected another "
                         "name for a user-defined term")
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"{str(name)[:40]!r}: expected a name of letters, digits and _")
    if given["adds"] not in o.ADDED:
        raise ValueError(f"{name}.adds: expected one of {', '.join(o.ADDED)}, "
                         f"got {str(given['adds'])[:40]!r}")
    return _expression(name, given) if "expression" in given else _table(name, given)


def _number(name: str, key: str, value) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not (
            math.isfinite(value) and abs(value) < 1e30):
        raise ValueError(f"{name}.{key}: expected a finite number, got {str(value)[:40]!r}")
    return float(value)


def _expression(name: str, given: dict) -> dict:
    text = given["expression"]
    if not isinstance(text, str):
        raise ValueError(f"{name}.expression: expected text, got {str(text)[:40]!r}")
    try:
        found = parsed(text)
    except ValueError as problem:
        raise ValueError(f"{name}.expression: {problem}") from problem
    others = [key for key in given if key not in ("adds", "expression")]
    for key in others:
        if key not in found.parameters:
            raise ValueError(f"{name}.{key}: the expression has no parameter {str(key)[:40]!r}, "
                             f"it has {', '.join(found.parameters) or 'none'}")
    for key in found.parameters:
        if key not in given:
            raise ValueError(f"{name}.{key}: expected the value of this parameter of the "
                             f"expression, or one of the signals {', '.join(o.OF)}")
    values = {key: _number(name, key, given[key]) for key in others}
    entry = {"adds": given["adds"], "expression": found.text, **values}
    if not np.isfinite(_at_rest(slot_for(entry))):
        raise ValueError(f"{name}.expression: is no number at rest (x = v = 0, 20 bar on both "
                         "sides), expected one that the plant can start with")
    return entry


def _at_rest(q: np.ndarray) -> float:
    s = np.zeros(N_SIGNALS)
    s[[P1, P2]] = 2e6
    return float(o.expressed(q, s))


def _table(name: str, given: dict) -> dict:
    for key in given:
        if key not in _TABLE:
            raise ValueError(f"{name}.{key}: unknown key, expected {', '.join(_TABLE)}, or an "
                             "expression")
    for key in ("of", "first", "last", "values"):
        if key not in given:
            raise ValueError(f"{name}.{key}: expected this key of a table, or an expression")
    times = given.get("times", "none")
    for key, value, known in (("of", given["of"], o.OF), ("times", times, o.FACTORS)):
        if value not in known:
            raise ValueError(f"{name}.{key}: expected one of {', '.join(known)}, "
                             f"got {str(value)[:40]!r}")
    first, last, scale = (_number(name, key, given.get(key, 1.0))
                          for key in ("first", "last", "scale"))
    if not last > first:
        raise ValueError(f"{name}.last: expected more than first, {first:g}, got {last:g}")
    if not scale > 0.0:
        raise ValueError(f"{name}.scale: expected more than 0, got {scale:g}")
    values = given["values"]
    if not isinstance(values, (list, tuple)) or not FEWEST_KNOTS <= len(values) <= o.MOST_KNOTS:
        raise ValueError(f"{name}.values: expected a list of {FEWEST_KNOTS} to {o.MOST_KNOTS} "
                         "numbers")
    return {"adds": given["adds"], "of": given["of"], "times": times, "scale": scale,
            "first": first, "last": last,
            "values": [_number(name, "values", value) for value in values]}


def slot_for(entry: dict) -> np.ndarray:
    """Return the slot of theta of a checked entry, (WIDTH,)."""
    if "expression" in entry:
        return parsed(entry["expression"]).slot(entry["adds"], entry)
    q = np.zeros(o.WIDTH)
    values = entry["values"]
    q[[o.ADDS, o.KIND, o.SIGNAL, o.FACTOR, o.SCALE, o.COUNT, o.FIRST, o.LAST]] = (
        o.ADDED.index(entry["adds"]), o.TABLE, o.OF.index(entry["of"]),
        o.FACTORS.index(entry["times"]), entry["scale"], len(values), entry["first"],
        entry["last"])
    q[o.VALUES : o.VALUES + len(values)] = values
    return q


def effects_field(value):
    """Check the ``effects`` section against the catalogue and return {effect: {name: value}}.

    What has the key ``adds`` is a term of the rig's own.

    A shape that is not given takes its default; a size that is not given is absent, as long as the
    effect has another size that is.  Raises ValueError, naming the effect, its parameter, the unit
    and the range that was expected.
    """
    if not isinstance(value, dict):
        raise ValueError("expected a mapping from effect to its parameters")
    found = {}
    own = [name for name, given in value.items() if is_own(given)]
    if len(own) > o.SLOTS:
        raise ValueError(f"{own[o.SLOTS]}: expected at most {o.SLOTS} terms beyond the catalogue")
    for name, given in value.items():
        if name in own:
            found[name] = checked(name, given)
            continue
        if name not in CATALOGUE:
            raise ValueError(f"unknown effect {name!r}, expected a user-defined term with the "
                             f"key adds, or one of {', '.join(CATALOGUE)}")
        effect = CATALOGUE[name]
        known = {p.name: p for p in effect.parameters}
        if not isinstance(given, dict):
            raise ValueError(f"{name}: expected its parameters {', '.join(known)}")
        if extra := set(given) - set(known):
            raise ValueError(f"{name}.{min(extra, key=str)}: unknown key, "
                             f"expected {', '.join(known)}")
        some_size = any(given.get(p.name) is not None for p in effect.sizes)
        found[name] = {}
        for p in effect.parameters:
            raw = given.get(p.name, p.default)
            if (raw is None and p.default is None and some_size) or raw == math.inf == p.neutral:
                raw = min(p.neutral, p.upper)  # a limit that is not there: its upper bound
            try:
                number = to_si(raw, p.unit.replace("^2", "²").replace("^3", "³").replace("*", "·"))
            except PydanticCustomError as problem:
                raise ValueError(f"{name}.{p.name}: {problem}") from problem
            if not isinstance(number, (int, float)) or not p.lower <= number <= p.upper:
                raise ValueError(f"{name}.{p.name}: expected a number in {p.unit} from "
                                 f"{p.lower:g} to {p.upper:g}, got {number!r}")
            found[name][p.name] = float(number)
    return found
