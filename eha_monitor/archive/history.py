"""What a table says over time: the values of one parameter, which of them to trust, their line."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eha_monitor.archive.store import nanoseconds_of
from eha_monitor.archive.trend import LEAST, Trend, trend
from eha_monitor.recordings.recording import CALENDAR_NS


@dataclass(frozen=True)
class History:
    """One parameter over the recordings, in order of time; arrays are (n,).

    Attributes
    ----------
    name : ``B`` or ``beta_e``; ``unit`` is that of the values.
    time : s since the epoch.
    value, stddev : SI.
    reliable : converged, untainted, and made with this config and source.
    usable : what the line goes through: the reliable ones; where they are fewer than three, those
        that only the model's mismatch speaks against.
    line : through the usable ones, or None.
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

    @property
    def doubtful(self) -> bool:
        """Whether the line goes through values that a mismatch taints."""
        return self.line is not None and bool((self.usable & ~self.reliable).any())


def history(rows: Sequence[dict], name: str, command: str, made_with: str) -> History:
    """Return the history of a parameter.

    Parameters
    ----------
    rows : of the table.
    command : ``estimate`` takes its own value, ``diagnose`` the one with the named effects.
    made_with : rows with another digest are shown, and do not count.
    """
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
    return History(name, next((row[f"{name}_unit"] for row in told), ""), time, value, stddev,
                   reliable, usable, trend(time[usable], value[usable], stddev[usable]),
                   sum(_time(row) < CALENDAR_NS * 1e-9 for row in told), bool(at_reference))


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
