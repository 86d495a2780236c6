"""A line through values of many days, each with its own standard deviation."""

from dataclasses import dataclass

import numpy as np

MONTH = 30.0 * 86400.0  # s; slopes are told for 30 days
LEAST = 3  # values through which a line is laid


@dataclass(frozen=True)
class Trend:
    """A straight line: ``value`` = ``level`` + ``slope`` (t - ``middle``).

    Attributes
    ----------
    slope, slope_stddev : SI unit per s.
    level, level_stddev : at ``middle``, s since the epoch, where both are uncorrelated.
    scatter : standard deviation from one recording to the next beyond what theirs explain.
    count : values.
    """

    slope: float
    slope_stddev: float
    level: float
    level_stddev: float
    middle: float
    scatter: float
    count: int

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the line and its standard deviation at times (n,), s since the epoch."""
        away = time - self.middle
        return (self.level + self.slope * away,
                np.hypot(self.level_stddev, self.slope_stddev * away))


def trend(time: np.ndarray, value: np.ndarray, stddev: np.ndarray) -> Trend | None:
    """Lay a line through values by weighted least squares; None through fewer than three.

    A rig differs from night to night (temperature, load) by more than one recording's standard
    deviation says.  With weights 1/stddev² alone the slope would look far too certain, and the
    quietest recording would hold the line by itself.  So each variance gets a common part more,
    chosen such that the weighted squares of the residuals add up to their degrees of freedom
    (Paule and Mandel 1982); it is 0 where the standard deviations explain the scatter.

    Parameters
    ----------
    time : (n,) s since the epoch.
    value, stddev : (n,) SI.
    """
    good = np.isfinite(time) & np.isfinite(value) & np.isfinite(stddev) & (stddev >= 0)
    time, value, stddev = time[good], value[good], stddev[good]
    if len(time) < LEAST or np.ptp(time) == 0:
        return None
    # A stddev of 0 would weigh infinitely; no value is known better than its last digit.
    size = float(np.max(np.abs(value))) or 1.0
    variance = np.maximum(stddev, 1e-9 * size)**2
    freedom = len(time) - 2

    def excess(more: float) -> float:
        return _line(time, value, variance + more)[-1] - freedom

    more = 0.0
    if excess(0.0) > 0:
        from scipy.optimize import brentq

        most = float(np.var(value)) or 1.0
        while excess(most) > 0:
            most *= 4.0
        more = float(brentq(excess, 0.0, most, rtol=1e-6, xtol=1e-12 * most))
    level, slope, middle, level_variance, slope_variance, _ = _line(time, value, variance + more)
    return Trend(slope, slope_variance**0.5, level, level_variance**0.5, middle, more**0.5,
                 len(time))


def _line(time: np.ndarray, value: np.ndarray, variance: np.ndarray) -> tuple[float, ...]:
    """Return level, slope, weighted middle, their variances, and the weighted squares left."""
    weight = 1.0 / variance
    total = weight.sum()
    middle = float((weight * time).sum() / total)
    away = time - middle
    level = float((weight * value).sum() / total)
    spread = float((weight * away**2).sum())
    slope = float((weight * away * value).sum() / spread)
    left = float((weight * (value - level - slope * away)**2).sum())
    return level, slope, middle, float(1.0 / total), 1.0 / spread, left
