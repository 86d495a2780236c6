"""What a table says over time: the values of one parameter, which of them to trust, their line."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from eha_monitor.archive.forecast import Outlook, outlook
from eha_monitor.archive.store import INDICATORS, nanoseconds_of
from eha_monitor.indicators.indicator import UNITS, limits_of_indicator
from eha_monitor.recordings.recording import CALENDAR_NS
from eha_monitor.settings.monitor import Settings

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


COLUMN_OF = {indicator: column for column, indicator in INDICATORS.items()}


@dataclass(frozen=True)
class History:
    """One parameter over the recordings, in order of time; arrays are (n,).

    Attributes
    ----------
    name : ``B``, ``beta_e`` or an indicator of health; ``unit`` is that of the values.
    time : s since the epoch.
    value, stddev : SI.
    reliable : converged, untainted, and made with this config and source.
    usable : what the line goes through: the reliable ones; where they are fewer than three, those
        that only the model's mismatch speaks against.
    line : through the usable ones since the last jump, or None.
    outlook : jumps, and the time to each limit.
    undated : recordings with a value whose stamps are no calendar time.
    at_reference : the values are B at the reference temperature.
    """

    name: str
    unit: str
    time: np.ndarray
    value: np.ndarray
    stddev: np.ndarray
    reliable: np.ndarray
    usable: np.ndarray
    line: Trend | None
    undated: int
    at_reference: bool
    outlook: Outlook = field(default_factory=Outlook)

    @property
    def since(self) -> float:
        """Time of the first value after the last jump, s since the epoch; -inf without one."""
        return max(self.outlook.jumps, default=-np.inf)

    @property
    def doubtful(self) -> bool:
        """Whether the line goes through values that a mismatch taints."""
        return self.line is not None and bool((self.usable & ~self.reliable).any())


def history(rows: Sequence[dict], name: str, command: str, made_with: str,
            settings: Settings | None = None) -> History:
    """Return the history of a parameter or an indicator.

    Parameters
    ----------
    rows : of the table.
    command : ``estimate`` takes its own value, ``diagnose`` the one with the named effects.
    made_with : rows with another digest are shown, and do not count.
    settings : its limits are those of the forecast.
    """
    limits = (None, None) if settings is None else limits_of_indicator(name, settings)
    told = [row for row in rows if _value(row, name, command, False) is not None]
    dated = sorted((row for row in told if _time(row) >= CALENDAR_NS * 1e-9), key=_time)
    current = np.array([row["made_with"] == made_with for row in dated], dtype=bool)
    fine = np.array([_converged(row, name, command) for row in dated], dtype=bool) & current
    reliable = fine & np.array([_untainted(row, name, command) for row in dated], dtype=bool)
    usable = reliable if reliable.sum() >= LEAST else fine
    at_reference = bool(name == "B" and command == "estimate" and usable.any() and all(
        row.get("B_reference") is not None
        for row, good in zip(dated, usable, strict=True) if good))
    if at_reference:
        keep = np.array([row.get("B_reference") is not None for row in dated], dtype=bool)
        dated = [row for row, good in zip(dated, keep, strict=True) if good]
        reliable, usable = reliable[keep], usable[keep]
    time = np.array([_time(row) for row in dated])
    value, stddev = np.array([_value(row, name, command, at_reference) for row in dated],
                             dtype=float).reshape(-1, 2).T
    # Values that a mismatch taints tell of change; when a limit is reached they do not.
    tainted = bool((usable & ~reliable).any())
    seen = Outlook() if tainted else outlook(time[usable], value[usable], stddev[usable], limits)
    lately = usable & (time >= max(seen.jumps, default=-np.inf))
    return History(name, _unit(name, told, settings), time, value, stddev, reliable, usable,
                   trend(time[lately], value[lately], stddev[lately]),
                   sum(_time(row) < CALENDAR_NS * 1e-9 for row in told), at_reference, seen)


def _unit(name: str, told: Sequence[dict], settings: Settings | None) -> str:
    if name not in COLUMN_OF:
        return next((row[f"{name}_unit"] for row in told), "")
    force = "N·m" if settings is not None and settings.rig.motion == "rotary" else "N"
    return UNITS[name][1] if name in UNITS else force


def _time(row: dict) -> float:
    return nanoseconds_of(row["start"]) * 1e-9 if row.get("start") else 0.0


def _value(row: dict, name: str, command: str, at_reference: bool
           ) -> tuple[float, float] | None:
    """Return a value and its stddev; of an indicator, of what differs between recordings."""
    key = COLUMN_OF.get(name, f"{name}_after" if command == "diagnose" else name)
    key += "_reference" * at_reference
    value = row.get(key)
    stddev = row.get(f"{key}_noise" if name in COLUMN_OF else f"{key}_stddev")
    return None if value is None else (value, np.nan if stddev is None else stddev)


def _converged(row: dict, name: str, command: str) -> bool:
    if name in COLUMN_OF:
        return True
    if command == "diagnose":
        return row.get("verdict") in ("consistent", "mismatch", "unexplained")
    return row.get(f"{name}_status") == "converged"


def _untainted(row: dict, name: str, command: str) -> bool:
    """Tell whether the value is that of a model that fits."""
    if name in COLUMN_OF:
        return row.get(f"{COLUMN_OF[name]}_status") != "in_doubt"
    if command == "diagnose":
        return row.get("verdict") in ("consistent", "mismatch")
    return not row.get(f"{name}_doubt")
