"""What the numbers of a column tell: the unit that they are likely in, and who follows whom."""

import numpy as np

# Quantity -> (largest absolute value below which, unit): what a rig shows, coarsest guess.
_LEVELS = {
    "position": ((2.0, "m"), (5e3, "mm"), (np.inf, "um")),
    "angle": ((7.0, "rad"), (np.inf, "deg")),
    "velocity": ((5.0, "m/s"), (np.inf, "mm/s")),
    "pressure": ((600.0, "bar"), (2e4, "kPa"), (np.inf, "Pa")),
    "turning": ((np.inf, "rpm"),),
    "force": ((np.inf, "N"),), "torque": ((np.inf, "N*m"),),
    "temperature": ((200.0, "degC"), (np.inf, "K")),
}
_EPOCHS = ((1e17, "1 ns"), (1e14, "1 us"), (1e11, "1 ms"))
REGULAR = 0.95  # of the steps of a time go forward
LAGS = 400  # samples looked ahead and behind


def likely_unit(quantity: str, values: np.ndarray) -> tuple[str, str]:
    """Return the unit that numbers of a quantity are likely in, and why, in words."""
    finite = values[np.isfinite(values)]
    largest = float(np.abs(finite).max()) if len(finite) else 0.0
    unit = next(unit for limit, unit in _LEVELS[quantity] if largest < limit)
    return unit, f"values up to {largest:.4g}"


def is_time(values: np.ndarray) -> bool:
    """Tell whether numbers or dates go forward as a time does."""
    steps = steps_of(values)
    return len(steps) > 1 and float(np.mean(steps >= 0)) > REGULAR and np.median(steps) >= 0 and (
        float(steps.sum()) > 0)


def steps_of(values: np.ndarray) -> np.ndarray:
    """Return the steps of a column; of dates in seconds."""
    if values.dtype.kind == "M":
        return np.diff(values[~np.isnat(values)].astype(np.int64)) * 1e-9
    return np.diff(values[np.isfinite(values)])


def time_unit(values: np.ndarray) -> tuple[str, str]:
    """Return what a unit of a time column without a name of its unit is, and why."""
    largest = float(np.nanmax(np.abs(values)))
    for limit, unit in _EPOCHS:
        if largest > limit:
            return unit, f"values from {largest:.3g} on count from 1970"
    steps = steps_of(values)
    step = float(np.median(steps[steps > 0]))
    if largest < 1e9 and step >= 0.5 and largest > 200:
        return "1 ms", f"steps of {step:.4g} up to {largest:.4g}"
    return "1 s", f"steps of {step:.4g} up to {largest:.4g}"


def leads(one: np.ndarray, other: np.ndarray) -> bool:
    """Tell whether one column is ahead of another, as a demand is of what follows it."""
    a, b = (np.nan_to_num(np.diff(values)) for values in (one, other))
    a, b = a - a.mean(), b - b.mean()
    lags = range(-min(LAGS, len(a) // 4), min(LAGS, len(a) // 4) + 1)
    match = [float(np.dot(a[max(0, -k):len(a) - max(0, k)], b[max(0, k):len(b) - max(0, -k)]))
             for k in lags]
    return bool(list(lags)[int(np.argmax(match))] > 0)


def is_rate_of(speed: np.ndarray, position: np.ndarray, step: float) -> bool:
    """Tell whether one column is the rate of another in the same unit of length."""
    rate = np.gradient(position, step)
    good = np.isfinite(rate) & np.isfinite(speed)
    if good.sum() < 100 or not np.std(speed[good]) or not np.std(rate[good]):
        return False
    # Over blocks, so that the noise of a difference does not hide it.
    width = max(1, good.sum() // 300)
    a, b = (values[good][:good.sum() // width * width].reshape(-1, width).mean(axis=1)
            for values in (speed, rate))
    slope = float(np.dot(a, b) / np.dot(b, b))
    return bool(np.corrcoef(a, b)[0, 1] > 0.95 and 0.9 < slope < 1.1)
