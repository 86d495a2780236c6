"""The alarms of a whole recording: the live board, driven at a reduced rate."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.estimation.model_watch import Trial
from eha_monitor.estimation.results import ParameterEstimate, Taint
from eha_monitor.health.alarms import Alarm, AlarmBoard
from eha_monitor.recordings.columns import blocks, chosen
from eha_monitor.settings.monitor import Settings

# Judgements per second, as live; health changes over seconds, and hold times are tenths of one.
JUDGE_RATE = 10.0
STEPS = 100_000  # from which the rate is taken


@dataclass(frozen=True)
class ParameterSeries:
    """One parameter as it converged over a recording.

    Attributes
    ----------
    final : the estimate at the end, with its status and its reason.
    value, stddev : (n,) SI.
    converged : (n,) bool, where the motion had excited the value: nothing else is judged; or
        what decides that from values and standard deviations.
    """

    final: ParameterEstimate
    value: np.ndarray
    stddev: np.ndarray
    converged: np.ndarray | Callable[[np.ndarray, np.ndarray], np.ndarray]


def judge_series(settings: Settings, time: np.ndarray, parameters: dict[str, ParameterSeries],
                 temperature: np.ndarray | None = None, measured: np.ndarray | None = None,
                 tainted: Mapping[str, Taint] | None = None
                 ) -> tuple[tuple[Alarm, ...], tuple[Alarm, ...]]:
    """Run the alarms over a recording, as they would have come live.

    A value that has just moved is on trial, as it is live; at the end of a recording nothing is,
    because the whole of it has been tested by then.

    Parameters
    ----------
    settings : thresholds, viscosity, ``monitor.stale_after``.
    time : (n,) s, rising.
    parameters : ``B`` and ``beta_e`` as they converged.
    temperature : (n,) °C with NaN where not measured (the last one counts), or None.
    measured : (n,) bool, or numbers that are NaN, False in gaps of the data; None means
        everywhere.
    tainted : see :meth:`AlarmBoard.update`; each counts from its ``since_s`` on.

    Returns
    -------
    alarms : the four alarms at the end.
    history : every change of a level, in order of time.
    """
    board = AlarmBoard(settings)
    if len(time) == 0:
        return tuple(board.stale(0.0, "the recording holds no samples")), tuple(board.history)
    step = np.median(np.diff(time[:STEPS])) if len(time) > 1 else 1.0
    stride = max(1, round(1.0 / (JUDGE_RATE * step)))
    index = np.arange(len(time) - 1, -1, -stride)[::-1]  # the last sample is always judged
    times = chosen(time, index)
    present = (np.ones(len(index), dtype=bool) if measured is None else
               times - time[0] - _last(measured, time, index)
               <= settings.monitor.stale_after)
    warmth = None if temperature is None else _carried(temperature, index).tolist()
    columns = {symbol: _columns(series, index) for symbol, series in parameters.items()}
    trials = {symbol: Trial(series.final.unit) for symbol, series in parameters.items()}
    unjudged = {symbol: _unjudged(series.final) for symbol, series in parameters.items()}
    for k, (at, here) in enumerate(zip(times.tolist(), present.tolist(), strict=True)):
        if not here:
            board.stale(at, f"no data for more than {settings.monitor.stale_after:g} s")
            continue
        row = {}
        for symbol, (judged, value, stddev) in columns.items():
            final = parameters[symbol].final
            if final.status == "no_data":
                row[symbol] = final
            elif k == len(index) - 1:
                row[symbol] = replace(final, value=value[k], stddev=stddev[k])
            elif judged[k]:
                row[symbol] = ParameterEstimate(symbol, value[k], stddev[k], final.unit,
                                                "converged")
            else:
                row[symbol] = unjudged[symbol]
        doubts = {} if k == len(index) - 1 else _trials(trials, at, row)
        doubts |= {name: taint for name, taint in (tainted or {}).items() if at >= taint.since_s}
        board.update(at, row, None if warmth is None else warmth[k], doubts)
    return board.alarms, tuple(board.history)


def _trials(trials: dict[str, Trial], time_s: float, row: dict[str, ParameterEstimate]
            ) -> dict[str, Taint]:
    """Return which values are on trial at one time, and why."""
    found = {}
    for symbol, trial in trials.items():
        estimate = row[symbol]
        known = estimate.status == "converged"
        taint = trial.update(time_s, estimate.value if known else None)
        if taint is not None:
            found[symbol] = taint
    return found


def _columns(series: ParameterSeries, index: np.ndarray) -> tuple[list, list, list]:
    if series.final.status == "no_data" or len(series.value) == 0:
        empty = [False] * len(index), [float("nan")] * len(index), [float("nan")] * len(index)
        return empty
    value, stddev = chosen(series.value, index), chosen(series.stddev, index)
    known = (series.converged(value, stddev) if callable(series.converged)
             else chosen(series.converged, index))
    judged = np.isfinite(value) & np.isfinite(stddev) & known
    return judged.tolist(), value.tolist(), stddev.tolist()


def _unjudged(final: ParameterEstimate) -> ParameterEstimate:
    message = final.message if final.status != "converged" else "not converged yet"
    return replace(final, status="not_excited", message=message)


def _last_rows(present: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return the last row up to each of ``index`` that is True or a number; -1 without one."""
    found, last = [], -1
    for start, stop, (rows,) in blocks(present):
        good = rows if rows.dtype == bool else np.isfinite(rows)
        place = np.maximum.accumulate(np.where(good, np.arange(start, stop), last))
        found.append(place[index[(index >= start) & (index < stop)] - start])
        last = int(place[-1])
    return np.concatenate(found)


def _last(measured: np.ndarray, time: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return when each of ``index`` had its last data, s since the first row; (k,)."""
    rows = _last_rows(measured, index)
    return np.where(rows >= 0, chosen(time, np.maximum(rows, 0)) - time[0], -np.inf)


def _carried(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return the rows ``index`` with NaN filled with the value before it; (k,)."""
    return chosen(values, np.maximum(_last_rows(values, index), 0))
