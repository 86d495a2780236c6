"""Thresholds to alarms, live or over a whole recording: what is judged, raised, cleared.

A limit is passed when the value lies beyond it by ``thresholds.confidence`` standard
deviations.  An alarm is raised when its limit was passed for the whole of ``hold_time``, and
clears when the value itself is back inside by the relative ``hysteresis``.  A parameter that
the motion does not excite is not judged: an alarm that was raised before is held.  A parameter
that a model mismatch taints is judged by least squares on its balance
(:mod:`balances.parameters`), at two looks in turn, and is not judged where these do not determine
it (``monitor.on_mismatch``).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.estimation.model_watch import LONGEST_TRIAL_S, Trial
from eha_monitor.estimation.results import (
    EVERY_S,
    Beside,
    ParameterEstimate,
    Taint,
    stands,
    units_of,
)
from eha_monitor.health.judge import (
    NO_LIMIT,
    NOT_JUDGED,
    RAISED,
    UNKNOWN,
    Alarm,
    Doubt,
    Judge,
    Rebase,
    Watched,
)
from eha_monitor.indicators.laws import at_reference
from eha_monitor.quantity import quantity, share, with_uncertainty
from eha_monitor.recordings.columns import blocks, chosen
from eha_monitor.settings.monitor import Settings

ADVICE = "run `eha-monitor diagnose` on a recording to identify the cause"

BALANCES = {"B": "force", "beta_e": "flow"}  # of the least squares that determine each

WATCHED = (Watched("B", "viscous_damping", "viscous damping", "N·s/m"),
           Watched("beta_e", "bulk_modulus", "effective bulk modulus", "Pa"))
ALARM_NAMES = tuple(f"{w.section}_{side}" for w in WATCHED for side in ("high", "low"))
SECTIONS = {w.symbol: w.section for w in WATCHED}


@dataclass(frozen=True)
class _Read:
    """A value at the reference temperature, rebased where configured; ``shown`` makes its words.

    ``taint`` is why it deserves doubt and ``doubt`` how far it may be off by that; ``note`` is
    what a reader should know.  ``look`` tells apart the looks that gave it.
    """

    value: float
    stddev: float
    shown: Callable[[], str]
    taint: Taint | None = None
    doubt: Doubt | None = None
    note: str = ""
    look: object = None


class AlarmBoard:
    """The four alarms, judged as the estimates come."""

    def __init__(self, settings: Settings):
        # every change of a level so far, the first one of each alarm included
        self.history: list[Alarm] = []
        # of each parameter what was judged last over what was measured: B at another temperature
        self.carried: dict[str, float] = {}
        self._units = units_of(settings.rig.motion)
        watched = [replace(w, unit=self._units[w.symbol]) for w in WATCHED]
        self._judges = [Judge(w, sign) for w in watched for sign in (1.0, -1.0)]
        self._last: float | None = None
        self._rebase = {"B": Rebase(settings.rig.viscous_damping, by_ratio=False),
                        "beta_e": Rebase(settings.rig.bulk_modulus, by_ratio=True)}
        self.configure(settings)

    def configure(self, settings: Settings) -> None:
        """Take other thresholds; what is raised stays raised until the next judgement."""
        self._viscosity = settings.viscosity
        self._confidence = settings.thresholds.confidence
        self._longest_step = settings.monitor.stale_after
        self._on_mismatch = settings.monitor.on_mismatch
        for judge in self._judges:
            judge.configure(getattr(settings.thresholds, judge.watched.section))

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """State of all four alarms now."""
        return tuple(self._alarm(judge) for judge in self._judges)

    @property
    def levels(self) -> tuple[tuple[str | None, bool], ...]:
        """Level of each alarm, and whether it is not judged; without the words."""
        return tuple((judge.level, judge.not_judged) for judge in self._judges)

    def update(self, time_s: float, parameters: dict[str, ParameterEstimate],
               temperature: float | None = None,
               tainted: Mapping[str, Taint] | None = None) -> list[Alarm]:
        """Judge the estimates at one time and return the alarms whose level changed.

        Parameters
        ----------
        time_s : s, on the clock of the recording.
        parameters : ``B`` and ``beta_e``; an absent one counts as ``no_data``.
        temperature : oil temperature in °C, or None where it is not measured.
        tainted : by symbol, why a value deserves doubt, e.g. a model mismatch; what that does to
            its alarms is ``monitor.on_mismatch``.
        """
        # Nothing is known about a limit while no data came: the hold time starts anew.
        if self._last is not None and not 0 <= time_s - self._last <= self._longest_step:
            for judge in self._judges:
                judge.forget()
        self._last = time_s
        changed, now = [], {}
        for symbol in self._rebase:
            now[symbol] = self._see(symbol, time_s, parameters.get(symbol), temperature,
                                     (tainted or {}).get(symbol))
        for judge in self._judges:
            symbol = judge.watched.symbol
            if self._judge_one(judge, time_s, parameters.get(symbol), now[symbol]):
                changed.append(self._alarm(judge))
        self.history += changed
        return changed

    def stale(self, time_s: float, reason: str) -> list[Alarm]:
        """Data have stopped: make all alarms STALE; returns those whose level changed."""
        changed = []
        for judge in self._judges:
            judge.forget()
            if self._take_stale(judge, time_s, reason):
                changed.append(self._alarm(judge))
        self.history += changed
        return changed

    def _take_stale(self, judge: Judge, time_s: float, reason: str) -> bool:
        if judge.off:
            return judge.take("OK", time_s, ("off",))
        return judge.take("STALE", time_s, ("stale", reason, judge.raised))

    def _see(self, symbol: str, time_s: float, estimate: ParameterEstimate | None,
             temperature: float | None, taint: Taint | None) -> _Read | None:
        """Return a value as the limits should see it, or None where there is none to judge."""
        other = None
        if taint is not None and not taint.testing and self._on_mismatch == "hold":
            other = taint.instead
            estimate = other or estimate
        if (estimate is None or estimate.status != "converged"
                or not (math.isfinite(estimate.value) and math.isfinite(estimate.stddev))):
            return None
        value, stddev = estimate.value, estimate.stddev
        if symbol == "B" and temperature is not None and math.isfinite(temperature):
            value, stddev = at_reference(self._viscosity, temperature, value, stddev)
            self.carried[symbol] = value / estimate.value if estimate.value else 1.0
        else:
            temperature = None
            self.carried.pop(symbol, None)
        shown = self._shown(symbol, estimate, value, stddev, temperature)
        if taint is None:
            self._rebase[symbol].fits(value)
            return _Read(value, stddev, shown)
        if self._on_mismatch == "ignore":
            return _Read(value, stddev, shown, note=f"in doubt: {taint.reason}")
        if taint.testing:
            return _Read(value, stddev, shown, taint, Doubt(
                value, value, trial=True, never=taint.never,
                wait=math.inf if taint.untested else LONGEST_TRIAL_S))
        if self._on_mismatch == "rebase":
            rebase = self._rebase[symbol]
            read = rebase.read(time_s, value, stddev, taint.since_s)
            if read is not None:
                settled, before = (quantity(x, self._units[symbol])
                                   for x in (rebase.settled, rebase.before))
                return _Read(*read, shown, note=f"judged by its change from {settled}, where it "
                                                f"settled, relative to {before} before: "
                                                f"{taint.reason}")
        if other is None:
            return _Read(value, stddev, shown, taint, UNKNOWN)
        age = f", {other.age_s:.0f} s ago" if other.age_s > 2.0 * EVERY_S else ""
        return _Read(value, stddev, shown, taint, note=f"by least squares on the "
                     f"{BALANCES[symbol]} balance{age}: {taint.reason}",
                     look=(other.value, other.stddev))

    def _judge_one(self, judge: Judge, time_s: float, estimate: ParameterEstimate | None,
                   now: _Read | None) -> bool:
        if judge.off:
            return judge.take("OK", time_s, ("off",))
        if estimate is None or estimate.status == "no_data":
            judge.forget()
            reason = estimate.message if estimate else ""
            return self._take_stale(judge, time_s, reason or "no data for this parameter")
        if now is None:
            judge.forget()
            known = math.isfinite(estimate.value) and math.isfinite(estimate.stddev)
            reason = estimate.message or (
                estimate.status.replace("_", " ") if known else "the estimate is not finite")
            if judge.raised:
                return judge.take(RAISED[judge.raised], time_s, ("held", reason))
            return judge.take("STALE", time_s, ("unjudged", reason), not_judged=True)
        margin = self._confidence * now.stddev
        if now.doubt is UNKNOWN:
            judge.recall(now.taint.since_s, now.value, margin, now.doubt)
        judge.judge(time_s, now.value, margin, now.doubt, now.look)
        level, not_judged = judge.verdict(time_s, now.doubt)
        held = not_judged or (judge.raised > 0 and now.doubt is not None and (
            now.doubt.trial or not judge.evident(0.0, now.doubt, now.value)))
        return judge.take(level, time_s, ("held back" if held else "judged", now), not_judged)

    def _shown(self, symbol: str, estimate: ParameterEstimate, value: float, stddev: float,
               temperature: float | None) -> Callable[[], str]:
        """Return what makes the value's words; most are never read."""
        def words() -> str:
            unit = self._units[symbol]
            shown = with_uncertainty(estimate.value, estimate.stddev, unit)
            if temperature is None:
                return shown
            return (f"{shown} at {temperature:.1f} °C, which is "
                    f"{with_uncertainty(value, stddev, unit)} at the reference temperature of "
                    f"{self._viscosity.reference_temperature:g} °C,")
        return words

    def _alarm(self, judge: Judge) -> Alarm:
        return Alarm(judge.name, judge.level or "STALE", self._sentence(judge), judge.time_s,
                     judge.not_judged)

    def _sentence(self, judge: Judge) -> str:
        """Return the situation of an alarm in words; made only when somebody reads it."""
        kind, *rest = judge.situation
        if kind == "off":
            return NO_LIMIT
        if kind == "unjudged":
            return f"not judged: {rest[0]}"
        if kind == "held":
            return f"{RAISED[judge.raised]} held, not judged now: {rest[0]}"
        if kind == "stale":
            before = f" (was {RAISED[rest[1]]} before)" if rest[1] else ""
            return f"no judgement: {rest[0]}{before}"
        now = rest[0]
        value = f"{judge.watched.words} {now.shown()}"
        if kind == "held back":
            advice = "" if now.taint.testing else f"; {ADVICE}"
            head = f"{RAISED[judge.raised]} held" if judge.raised else NOT_JUDGED
            return f"{head}: {value.rstrip(',')}, but {now.taint.reason}{advice}"
        text = f"{value} {self._against_limit(judge, now.value)}"
        return f"{text}; {now.note}" if now.note else text

    @staticmethod
    def _against_limit(judge: Judge, value: float) -> str:
        bad, good = ("above", "below") if judge.sign > 0 else ("below", "above")
        place = judge.raised - 1 if judge.raised else 0 if judge.limits[0] is not None else 1
        limit, level = judge.limits[place], RAISED[place + 1]
        said = f"the {level} limit of {quantity(limit, judge.watched.unit, 6)}"
        if judge.raised:
            if judge.sign * (value - limit) > 0:
                return f"is {bad} {said}"
            return f"is {good} {said} again, but not yet by {share(judge.hysteresis)} of it"
        if judge.since[place] is not None:
            again = " and at a second look" if judge.look[place] is not None else ""
            return f"has passed {said}, not yet for {judge.hold_time:g} s{again}"
        if judge.sign * (value - limit) > 0:
            return f"is {bad} {said}, within its uncertainty"
        return f"is {good} {said}"


# Judgements per second, as live; health changes over seconds, and hold times are tenths of one.
JUDGE_RATE = 10.0
STEPS = 100_000  # from which the rate is taken


@dataclass(frozen=True)
class ParameterSeries:
    """One parameter as it converged over a recording."""

    final: ParameterEstimate  # the estimate at the end, with its status and its reason
    # value, stddev: (n,) SI
    value: np.ndarray
    stddev: np.ndarray
    # (n,) bool, where the motion had excited the value: nothing else is judged; or what decides
    # that from values and standard deviations
    converged: np.ndarray | Callable[[np.ndarray, np.ndarray], np.ndarray]

    def at(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return of rows ``index`` (k,) whether they are judged, the values and deviations."""
        value, stddev = chosen(self.value, index), chosen(self.stddev, index)
        known = (self.converged(value, stddev) if callable(self.converged)
                 else chosen(self.converged, index))
        return np.isfinite(value) & np.isfinite(stddev) & known, value, stddev


def judge_series(settings: Settings, time: np.ndarray, parameters: dict[str, ParameterSeries],
                 temperature: np.ndarray | None = None, measured: np.ndarray | None = None,
                 tainted: Mapping[str, Taint] | None = None, beside: Sequence[Beside] = ()
                 ) -> tuple[tuple[Alarm, ...], tuple[Alarm, ...]]:
    """Run the alarms over a recording, as they would have come live.

    A value that has just moved is on trial, as it is live; at the end of a recording nothing is,
    because the whole of it has been tested by then.

    Parameters
    ----------
    time : (n,) s, rising.
    parameters : ``B`` and ``beta_e`` as they converged.
    temperature : (n,) °C with NaN where not measured (the last one counts), or None.
    measured : (n,) bool, or numbers that are NaN, False in gaps of the data; None means
        everywhere.
    tainted : see :meth:`AlarmBoard.update`; each counts from its ``since_s`` on.
    beside : least squares along the recording, by which what is tainted is judged.

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
    warmth = None if temperature is None else carried(temperature, index).tolist()
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
        doubts |= {name: replace(taint, instead=stands(beside, at - float(time[0]), name))
                   for name, taint in (tainted or {}).items() if at >= taint.since_s}
        board.update(at, row, None if warmth is None else warmth[k], doubts)
    return board.alarms, tuple(board.history)


def _trials(trials: dict[str, Trial], time_s: float, row: dict[str, ParameterEstimate]
            ) -> dict[str, Taint]:
    """Return which values are on trial at one time, and why."""
    found = {}
    for symbol, trial in trials.items():
        estimate = row[symbol]
        known = estimate.status == "converged"
        taint = trial.update(time_s, estimate.value if known else None, estimate.stddev)
        if taint is not None:
            found[symbol] = taint
    return found


def _columns(series: ParameterSeries, index: np.ndarray) -> tuple[list, list, list]:
    if series.final.status == "no_data" or len(series.value) == 0:
        return [False] * len(index), [math.nan] * len(index), [math.nan] * len(index)
    judged, value, stddev = series.at(index)
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


def carried(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return the rows ``index`` of a slow channel, NaN filled with the value before it; (k,)."""
    return chosen(values, np.maximum(_last_rows(values, index), 0))
