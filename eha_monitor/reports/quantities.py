"""Numbers as people write them: MPa and µm instead of 6e8 and 1e-6, with honest digits."""

import math
from dataclasses import dataclass

import numpy as np

_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"),
             (1e-9, "n"))
_PREFIXED = {"m", "m/s", "m/s²", "rad", "rad/s", "rad/s²", "Pa", "N", "N·m", "N·s/m",
             "N·m·s/rad", "s"}
# Units that nobody reads with a prefix: SI unit -> (shown unit, factor to it).
_OTHER = {"m³/(s·Pa)": ("mL/(min·MPa)", 6e13), "m³/s": ("L/min", 6e4)}
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Scale:
    """How an SI quantity is shown: multiply by ``factor``, write ``unit`` behind it."""

    factor: float
    unit: str


def readable(magnitude: float, unit: str) -> Scale:
    """Return the scale in which ``magnitude`` (SI, any sign) has few digits before the point.

    Large prefixes come in from 10 000 on (9000 N·s/m stay, 12 kN·s/m), small ones below 1
    (40 mm).  Unknown units and sizes that no prefix fits stay as they are.
    """
    if unit in _OTHER:
        shown, factor = _OTHER[unit]
        return Scale(factor, shown)
    size = abs(magnitude)
    if unit not in _PREFIXED or not 1e-9 <= size < 1e13:
        return Scale(1.0, unit)
    for factor, prefix in _PREFIXES:
        if size >= factor * (10.0 if factor > 1.0 else 1.0):
            if unit == "s" and factor > 1.0:
                continue
            return Scale(1.0 / factor, prefix + unit)
    return Scale(1.0, unit)


def scale_of(values: np.ndarray, unit: str) -> Scale:
    """Return the scale for an axis that shows ``values`` (SI, NaN allowed)."""
    size = np.abs(values[np.isfinite(values)])
    return axis_scale(float(np.percentile(size, 99)) if size.size else 0.0, unit)


def axis_scale(magnitude: float, unit: str) -> Scale:
    """Return a readable scale whose tick labels stay short: a power of ten where need be."""
    scale = readable(magnitude, unit)
    size = abs(magnitude * scale.factor)
    if size == 0 or not math.isfinite(size) or 1e-3 <= size < 1e6:
        return scale
    power = math.floor(math.log10(size))
    label = f"10{str(power).translate(_SUPERSCRIPT)} {scale.unit}"
    return Scale(scale.factor * 10.0**-power, label)


def time_scale(duration: float) -> Scale:
    """Return the scale of a time axis of ``duration`` seconds: ms, s, min or h."""
    if duration < 0.1:
        return Scale(1e3, "ms")
    if duration >= 6 * 3600:
        return Scale(1 / 3600, "h")
    return Scale(1 / 60, "min") if duration >= 600 else Scale(1.0, "s")


def number(value: float | None, digits: int = 4) -> str:
    """Return a number with ``digits`` significant digits; powers of ten outside 1e-4 to 1e7."""
    if value is None or not math.isfinite(value):
        return "—" if value is None or math.isnan(value) else ("∞" if value > 0 else "−∞")
    if value != 0 and not 1e-4 <= abs(value) < 1e7:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        power = str(int(exponent)).translate(_SUPERSCRIPT)
        return f"{_trimmed(mantissa)}·10{power}".replace("-", "−")
    return f"{value:.{digits}g}".replace("-", "−") if abs(value) < 10**digits \
        else f"{value:.0f}".replace("-", "−")


def quantity(value: float | None, unit: str, digits: int = 4) -> str:
    """Return an SI value in a readable unit, e.g. ``600 MPa``; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return number(value)
    scale = readable(value, unit) if value else Scale(1.0, unit)
    shown = "" if scale.unit == "1" else f" {scale.unit}"
    return f"{number(value * scale.factor, digits)}{shown}"


def with_uncertainty(value: float, stddev: float, unit: str) -> str:
    """Return ``value ± 2 sigma unit``, rounded to two digits of the uncertainty."""
    if not math.isfinite(value):
        return "—"
    if not (math.isfinite(stddev) and stddev >= 0):
        return f"{quantity(value, unit)}, uncertainty unknown"
    scale = readable(value if value else 2 * stddev, unit)
    shown, spread = value * scale.factor, 2 * stddev * scale.factor
    if max(abs(shown), spread) >= 1e7 or 0 < max(abs(shown), spread) < 1e-4:
        return f"({number(shown, 5)} ± {number(spread, 2)}) {scale.unit}"
    if spread == 0 or spread < 1e-6 * abs(shown):
        return f"{number(shown, 7)} ± {number(spread, 2)} {scale.unit}"
    decimals = max(0, 1 - math.floor(math.log10(spread)))
    return f"{shown:.{decimals}f} ± {spread:.{decimals}f} {scale.unit}".replace("-", "−")


def _trimmed(text: str) -> str:
    return text.rstrip("0").rstrip(".") if "." in text else text
