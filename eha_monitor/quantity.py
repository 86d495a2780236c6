"""Quantities as people write them: one unit, one ±, and no digit that nobody can stand behind.

± is one standard deviation everywhere, the ``stddev`` of the JSON answers.  It is written with the
digits of the Particle Data Group's rule (two where they begin with 100 to 354, else one), and
never below ``FLOOR`` of the value: rig numbers come with three digits, and a number that was
rounded to three digits is off by at least 1/(1000 √12) = 0.03 % of itself (one standard
deviation), which B and beta_e carry in full (``benchmarks/rig_numbers.py``).  Larger errors of the
rig numbers are not in the ± of an estimate, and ``NOTE`` says so; a diagnosis has their tolerances
in it (``DIAGNOSED``), a comparison has not (``COMPARED``).
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, fields, is_dataclass, replace
from decimal import Decimal
from typing import TypeVar

FLOOR = 3e-4  # of the value; no ± is written smaller
NOTE = ("± is one standard deviation due to noise, shown as at least "
        f"{100 * FLOOR:g} % of the value. Errors of the configured rig data add "
        "to it: areas that are 10 % off bias B by 10 %, and by 10 % of a load over the speed; "
        "volumes or a mass 10 % off bias βe by 10 %.")
DIAGNOSED = ("± is one standard deviation due to noise and the tolerances of the configured rig "
             "data (rig.tolerance), shown as at least "
             f"{100 * FLOOR:g} % of the value.")
COMPARED = ("± is one standard deviation due to noise and from one healthy recording to another. "
            "Errors of the configured rig data move healthy and now alike, and are not in the ± "
            "of a change.")
SYMBOLS = {"B": "B", "beta_e": "βe", "L": "C_T"}  # of the estimated parameters

# Prefix and the size from which it is written.  Large ones come late: 9000 N·s/m, 12 kN·s/m.
_LARGE = (("M", 1e7), ("k", 1e4), ("", 0.0))
_SMALL = (("", 1.0), ("m", 1e-3), ("µ", 1e-7), ("n", 0.0))
_BOTH = (("M", 1e7), ("k", 1e4), ("", 1.0), ("m", 1e-3), ("µ", 0.0))
_PRESSURE = (("G", 1e10), ("M", 1e6), ("k", 1e3), ("", 0.0))  # bulk moduli stay in MPa
_PREFIXED = {"m": _SMALL, "m/s": _SMALL, "m/s²": _SMALL, "rad": _SMALL, "s": _SMALL, "N": _LARGE,
             "N·s/m": _LARGE, "N/m": _LARGE, "N·m": _BOTH, "N·m·s/rad": _BOTH, "Pa": _PRESSURE,
             "Pa·s/rad": _PRESSURE}
_POWER = {"G": 1e9, "M": 1e6, "k": 1e3, "": 1.0, "m": 1e-3, "µ": 1e-6, "n": 1e-9}
# Units that nobody reads with a prefix: (shown unit, factor to it, SI size from which it is used).
_OTHER = {
    "m²": (("m²", 1.0, 1.0), ("cm²", 1e4, 1e-5), ("mm²", 1e6, 0.0)),
    "m³": (("m³", 1.0, 1.0), ("l", 1e3, 1e-2), ("cm³", 1e6, 1e-7), ("mm³", 1e9, 0.0)),
    "m³/rad": (("cm³/rad", 1e6, 0.0),),
    "m³/s": (("l/min", 6e4, 1e-7), ("ml/min", 6e7, 0.0)),
    "m³/(s·Pa)": (("l/(min·MPa)", 6e10, 1e-9), ("ml/(min·MPa)", 6e13, 0.0)),
    "m³/(s·Pa^½)": (("l/(min·√MPa)", 6e7, 1e-9), ("ml/(min·√MPa)", 6e10, 0.0)),
    "Pa/s": (("MPa/s", 1e-6, 1e5), ("kPa/min", 0.06, 0.0)),
    "1/Pa": (("%/MPa", 1e8, 0.0),),
    "1/K": (("%/K", 100.0, 0.0),),
}
# The catalogue has plain text.
_SPELT = (("^0.5", "^½"), ("√Pa", "Pa^½"), ("^2", "²"), ("^3", "³"), ("*", "·"))
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_LEAST, _MOST = 1e-4, 1e7  # numbers beyond are written with a power of ten
# Of a rig that turns, in place of those of a linear one: its equations are the same.
ROTARY = {"N": "N·m", "N·s/m": "N·m·s/rad", "N·s²/m²": "N·m·s²/rad²", "N/m": "N·m/rad",
          "kg": "kg·m²", "m": "rad", "m/s": "rad/s", "m/s²": "rad/s²", "m²": "m²·m/rad"}
_motion: ContextVar[str] = ContextVar("motion", default="linear")  # of the rig in question
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Scale:
    """How an SI quantity is shown: multiply by ``factor``, write ``unit`` behind it."""

    factor: float
    unit: str


@contextmanager
def rig_motion(motion: str) -> Iterator[None]:
    """Write quantities in the units of a rig, ``linear`` or ``rotary``, within the block.

    The diagnosis computes with the units of a linear rig, whose equations are the same.
    """
    before = _motion.set(motion)
    try:
        yield
    finally:
        _motion.reset(before)


def in_units(answer: Answer, name: str = "") -> Answer:
    """Return a record whose units, at any depth, are those of the rig of :func:`rig_motion`.

    What stands in the fields and keys ``unit`` and ``against_unit`` is changed; ``name`` is that
    of the part itself.
    """
    if _motion.get() != "rotary":
        return answer
    if isinstance(answer, str):
        return ROTARY.get(spelt(answer), answer) if name in ("unit", "against_unit") else answer
    if is_dataclass(answer) and not isinstance(answer, type):
        return replace(answer, **{one.name: in_units(getattr(answer, one.name), one.name)
                                  for one in fields(answer)})
    if isinstance(answer, dict):
        return {key: in_units(part, key) for key, part in answer.items()}
    if isinstance(answer, (tuple, list)):
        return type(answer)(in_units(one, name) for one in answer)
    return answer


def spelt(unit: str) -> str:
    """Return a unit as people write it: ``m^3/(s*Pa)`` becomes m³/(s·Pa), ``1`` nothing."""
    for plain, shown in _SPELT:
        unit = unit.replace(plain, shown)
    return "" if unit == "1" else unit


def readable(magnitude: float, unit: str) -> Scale:
    """Return the scale in which ``magnitude`` (SI, any sign) has few digits before the point.

    Unknown units and sizes that no prefix fits stay as they are.  The unit is that of the rig of
    :func:`rig_motion`, with the prefix that a linear one has.
    """
    unit = spelt(unit)
    scale = _linear(abs(magnitude), unit)
    if _motion.get() != "rotary" or unit not in ROTARY:
        return scale
    return Scale(scale.factor, scale.unit.removesuffix(unit) + ROTARY[unit])


def _linear(size: float, unit: str) -> Scale:
    if not 1e-18 <= size < 1e13:
        return Scale(1.0, unit)
    if unit in _OTHER:
        return next(Scale(factor, shown) for shown, factor, start in _OTHER[unit] if size >= start)
    if unit in _PREFIXED and size >= 1e-12:
        prefix = next(prefix for prefix, start in _PREFIXED[unit] if size >= start)
        return Scale(1.0 / _POWER[prefix], prefix + unit)
    return Scale(1.0, unit)


def power_of_ten(power: int) -> str:
    """Return ``10³`` for 3."""
    return f"10{str(power).translate(_SUPERSCRIPT)}"


def number(value: float | None, digits: int = 4) -> str:
    """Return a number with ``digits`` significant digits; powers of ten outside 1e-4 to 1e7."""
    if value is None or not math.isfinite(value):
        return "—" if value is None or math.isnan(value) else ("∞" if value > 0 else "−∞")
    if value != 0 and not _LEAST <= abs(value) < _MOST:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{_trimmed(mantissa)}·{power_of_ten(int(exponent))}".replace("-", "−")
    short = float(f"{value:.{digits}g}")  # 999.9 with three digits is 1000, not 1e+03
    return (f"{short:.{digits}g}" if abs(short) < 10**digits else f"{value:.0f}").replace("-", "−")


def quantity(value: float | None, unit: str, digits: int = 4) -> str:
    """Return an SI value in a readable unit, e.g. ``600 MPa``; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return number(value)
    scale = readable(value, unit)
    return f"{number(value * scale.factor, digits)} {scale.unit}".rstrip()


def signed(value: float, unit: str, digits: int = 4) -> str:
    """Return an SI value with its sign, e.g. ``+20 kPa``."""
    return ("+" if value > 0 else "") + quantity(value, unit, digits)


def share(value: float, digits: int = 3) -> str:
    """Return a share of one in per cent, e.g. ``2.5 %``."""
    return f"{number(100.0 * value, digits)} %" if math.isfinite(value) else number(value)


def rounded(value: float, stddev: float) -> tuple[str, str]:
    """Return value and standard deviation (finite) with the digits that can be stood behind.

    >>> rounded(600.123, 2.34), rounded(599.998, 0.030)
    (('600.1', '2.3'), ('600.0', '0.2'))
    """
    least = FLOOR * abs(value)
    stddev = max(abs(stddev), least)
    decimals = _decimals(stddev)
    if least > 0.0:  # the floor's own second digit means nothing
        decimals = min(decimals, -_exponent(float(f"{least:.0e}")))
    return _fixed(value, decimals), _fixed(stddev, decimals)


def to_digits(value: float, stddev: float) -> float:
    """Return a value with the digits that can be stood behind, as a number.

    >>> to_digits(-1119.3, 330.0)
    -1120.0
    """
    return float(rounded(value, stddev)[0].replace("\N{MINUS SIGN}", "-"))


def with_uncertainty(value: float, stddev: float, unit: str, scale: Scale | None = None) -> str:
    """Return ``value ± stddev unit``, SI in, in a readable unit or in that of ``scale``.

    >>> with_uncertainty(5.99998e8, 3.0e4, "Pa")
    '600.0 ± 0.2 MPa'
    """
    if not math.isfinite(value):
        return "—"
    if not (math.isfinite(stddev) and stddev >= 0):
        return f"{quantity(value, unit)}, ± not known"
    scale = scale or readable(max(abs(value), stddev), unit)
    shown, spread = value * scale.factor, stddev * scale.factor
    size, power = max(abs(shown), spread), ""
    if size and not _LEAST <= size < _MOST:
        exponent = _exponent(size)
        power = f"·{power_of_ten(exponent)}"
        shown, spread = (float(Decimal(x).scaleb(-exponent)) for x in (shown, spread))
    text = " ± ".join(rounded(shown, spread))
    return f"({text}){power} {scale.unit}".rstrip() if power else f"{text} {scale.unit}".rstrip()


def side_by_side(given: float, value: float, stddev: float, unit: str) -> tuple[str, str]:
    """Return a number without and one with ±, in one unit, so that they can be compared.

    >>> side_by_side(2e6, 3e5, 2e3, "Pa")
    ('2000 kPa', '300.0 ± 2.0 kPa')
    """
    smaller = min((abs(one) for one in (given, value) if one and math.isfinite(one)), default=0.0)
    scale = readable(smaller, unit)
    return (f"{number(given * scale.factor)} {scale.unit}".rstrip(),
            with_uncertainty(value, stddev, unit, scale))


def _decimals(stddev: float) -> int:
    """Return the decimals of the Particle Data Group's rule; negative ones are tens."""
    if stddev == 0.0:
        return 0
    power = _exponent(stddev)
    return 1 - power if round(stddev / 10.0**power, 2) < 3.55 else -power


def _exponent(size: float) -> int:
    """Return the power of ten of the first digit of a positive number."""
    return int(f"{size:e}".partition("e")[2])


def _fixed(value: float, decimals: int) -> str:
    text = f"{round(value, decimals) + 0.0:.{max(decimals, 0)}f}"  # + 0.0: no "-0.0"
    return text.replace("-", "−")


def _trimmed(text: str) -> str:
    return text.rstrip("0").rstrip(".") if "." in text else text
