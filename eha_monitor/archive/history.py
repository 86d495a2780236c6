"""What a table says over time: the values of one parameter, which of them to trust, their line."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from eha_monitor.archive.columns import INDICATORS
from eha_monitor.archive.forecast import Outlook, outlook
from eha_monitor.archive.store import nanoseconds_of
from eha_monitor.archive.trend import LEAST, Trend, trend
from eha_monitor.indicators.indicator import UNITS, limits_of_indicator
from eha_monitor.recordings.recording import CALENDAR_NS
from eha_monitor.settings.monitor import Settings

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
    if name in COLUMN_OF:
        force = "N·m" if settings is not None and settings.rig.motion == "rotary" else "N"
        unit = UNITS[name][1] if name in UNITS else force
        return _of_indicator(rows, name, made_with, unit, limits)
    told = [row for row in rows if _value(row, name, command, False) is not None]
    dated = [row for row in told if _time(row) >= CALENDAR_NS * 1e-9]
    dated.sort(key=_time)
    current = np.array([row["made_with"] == made_with for row in dated], dtype=bool)
    fine = np.array([_converged(row, name, command) for row in dated], dtype=bool) & current
    reliable = fine & np.array([_untainted(row, name, command) for row in dated], dtype=bool)
    usable = reliable if reliable.sum() >= LEAST else fine
    at_reference = name == "B" and command == "estimate" and usable.any() and all(
        row.get("B_reference") is not None
        for row, good in zip(dated, usable, strict=True) if good)
    if at_reference:
        keep = np.array([row.get("B_reference") is not None for row in dated], dtype=bool)
        dated = [row for row, good in zip(dated, keep, strict=True) if good]
        reliable, usable = reliable[keep], usable[keep]
    pairs = np.array([_value(row, name, command, at_reference) for row in dated],
                     dtype=float).reshape(-1, 2)
    time = np.array([_time(row) for row in dated])
    value, stddev = pairs.T
    return _made(name, next((row[f"{name}_unit"] for row in told), ""), time, value, stddev,
                 reliable, usable, sum(_time(row) < CALENDAR_NS * 1e-9 for row in told),
                 bool(at_reference), limits)


def _made(name: str, unit: str, time: np.ndarray, value: np.ndarray, stddev: np.ndarray,
          reliable: np.ndarray, usable: np.ndarray, undated: int, at_reference: bool,
          limits: tuple[float | None, float | None]) -> History:
    """Return a history with its jumps, its forecasts and the line since the last jump."""
    # Values that a mismatch taints tell of change; when a limit is reached they do not.
    tainted = bool((usable & ~reliable).any())
    seen = Outlook() if tainted else outlook(time[usable], value[usable], stddev[usable], limits)
    lately = usable & (time >= max(seen.jumps, default=-np.inf))
    return History(name, unit, time, value, stddev, reliable, usable,
                   trend(time[lately], value[lately], stddev[lately]), undated, at_reference, seen)


def _of_indicator(rows: Sequence[dict], name: str, made_with: str, unit: str,
                  limits: tuple[float | None, float | None]) -> History:
    """Return the history of an indicator, each value with what differs between recordings."""
    column = COLUMN_OF[name]
    told = [row for row in rows if row.get(column) is not None]
    dated = sorted((row for row in told if _time(row) >= CALENDAR_NS * 1e-9), key=_time)
    time = np.array([_time(row) for row in dated])
    value = np.array([row[column] for row in dated], dtype=float)
    stddev = np.array([np.nan if row.get(f"{column}_noise") is None else row[f"{column}_noise"]
                       for row in dated], dtype=float)
    current = np.array([row["made_with"] == made_with for row in dated], dtype=bool)
    doubtful = np.array([row.get(f"{column}_status") == "in_doubt" for row in dated], dtype=bool)
    reliable = current & ~doubtful
    usable = reliable if reliable.sum() >= LEAST else current
    return _made(name, unit, time, value, stddev, reliable, usable,
                 len(told) - len(dated), False, limits)


def _time(row: dict) -> float:
    return nanoseconds_of(row["start"]) * 1e-9 if row.get("start") else 0.0


def _value(row: dict, name: str, command: str, at_reference: bool
           ) -> tuple[float, float] | None:
    key = f"{name}_after" if command == "diagnose" else f"{name}_reference" if (
        at_reference) else name
    value, stddev = row.get(key), row.get(f"{key}_stddev")
    return None if value is None else (value, np.nan if stddev is None else stddev)


def _converged(row: dict, name: str, command: str) -> bool:
    if command == "diagnose":
        return row.get("verdict") in ("consistent", "mismatch", "unexplained")
    return row.get(f"{name}_status") == "converged"


def _untainted(row: dict, name: str, command: str) -> bool:
    """Tell whether the value is that of a model that fits."""
    if command == "diagnose":
        return row.get("verdict") in ("consistent", "mismatch")
    return not row.get(f"{name}_doubt")
