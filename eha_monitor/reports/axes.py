"""Scales of axes: readable units whose tick labels stay short."""

import math

import numpy as np

from eha_monitor.quantity import FLOOR, Scale, power_of_ten, readable


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
    return Scale(scale.factor * 10.0**-power, f"{power_of_ten(power)} {scale.unit}")


def stated(value: np.ndarray, stddev: np.ndarray) -> np.ndarray:
    """Return the standard deviations as they are written beside the values: no finer than that."""
    return np.maximum(stddev, FLOOR * np.abs(value))


def time_scale(duration: float) -> Scale:
    """Return the scale of a time axis of ``duration`` seconds: ms, s, min or h."""
    if duration < 0.1:
        return Scale(1e3, "ms")
    if duration >= 6 * 3600:
        return Scale(1 / 3600, "h")
    return Scale(1 / 60, "min") if duration >= 600 else Scale(1.0, "s")
