"""Thresholds to alarms: what is judged, when an alarm is raised and when it clears.

A limit is passed when the value lies beyond it by ``thresholds.confidence`` standard
deviations.  An alarm is raised when its limit was passed for the whole of ``hold_time``, and
clears when the value itself is back inside by the relative ``hysteresis``.  A parameter that
the motion does not excite is not judged: an alarm that was raised before is held.  A model
mismatch that taints a parameter holds back what it can have brought about, and nothing else: an
alarm whose limit lies farther away than the mismatch reaches (:mod:`estimation.reach`) is raised,
one that it may have moved across is not judged (``monitor.on_mismatch``).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from eha_monitor.estimation.results import ParameterEstimate, Taint, units_of
from eha_monitor.health.judge import (
    NO_LIMIT,
    NOT_JUDGED,
    RAISED,
    SEVERITY,
    Alarm,
    Doubt,
    Judge,
    Level,
    Rebase,
    Watched,
    doubt_of,
)
from eha_monitor.indicators.laws import viscosity_ratio
from eha_monitor.quantity import quantity, share, with_uncertainty
from eha_monitor.settings.monitor import Settings, Viscosity

__all__ = [
    "ALARM_NAMES",
    "NOT_JUDGED",
    "NO_LIMIT",
    "SEVERITY",
    "WATCHED",
    "Alarm",
    "AlarmBoard",
    "Level",
    "Watched",
    "viscosity_factor",
]
ADVICE = "run `eha-monitor diagnose` on a recording to identify the cause"

WATCHED = (Watched("B", "viscous_damping", "viscous damping", "N·s/m"),
           Watched("beta_e", "bulk_modulus", "effective bulk modulus", "Pa"))
ALARM_NAMES = tuple(f"{w.section}_{side}" for w in WATCHED for side in ("high", "low"))


@dataclass(frozen=True)
class _Read:
    """A value at the reference temperature, rebased where configured; ``shown`` makes its words.

    ``taint`` is why it deserves doubt and ``doubt`` how far it may be off by that; ``note`` is
    what a reader should know.
    """

    value: float
    stddev: float
    shown: Callable[[], str]
    taint: Taint | None = None
    doubt: Doubt | None = None
    note: str = ""


class AlarmBoard:
    """The four alarms, judged as the estimates come.

    Parameters
    ----------
    settings : thresholds, viscosity and ``monitor.stale_after`` are read.

    Attributes
    ----------
    history : every change of a level so far, the first one of each alarm included.
    """

    def __init__(self, settings: Settings):
        self.history: list[Alarm] = []
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
            self._forget()
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

    def _forget(self) -> None:
        for judge in self._judges:
            judge.forget()

    def _take_stale(self, judge: Judge, time_s: float, reason: str) -> bool:
        if judge.off:
            return judge.take("OK", time_s, ("off",))
        return judge.take("STALE", time_s, ("stale", reason, judge.raised))

    def _see(self, symbol: str, time_s: float, estimate: ParameterEstimate | None,
             temperature: float | None, taint: Taint | None) -> _Read | None:
        """Return a value as the limits should see it, or None where there is none to judge."""
        if (estimate is None or estimate.status != "converged"
                or not (math.isfinite(estimate.value) and math.isfinite(estimate.stddev))):
            return None
        factor = 1.0
        if symbol == "B" and temperature is not None and math.isfinite(temperature):
            factor = viscosity_factor(self._viscosity, temperature)
        else:
            temperature = None
        value, stddev = factor * estimate.value, factor * estimate.stddev
        shown = self._shown(symbol, estimate, value, stddev, temperature)
        if taint is None:
            self._rebase[symbol].fits(value)
            return _Read(value, stddev, shown)
        if self._on_mismatch == "ignore":
            return _Read(value, stddev, shown, note=f"in doubt: {taint.reason}")
        if taint.testing:
            return _Read(value, stddev, shown, taint, Doubt(value, value, trial=True))
        if self._on_mismatch == "rebase":
            rebase = self._rebase[symbol]
            read = rebase.read(time_s, value, stddev, taint.since_s)
            if read is not None:
                settled, before = (quantity(x, self._units[symbol])
                                   for x in (rebase.settled, rebase.before))
                return _Read(*read, shown, note=f"judged by its change from {settled}, where it "
                                                f"settled, relative to {before} before: "
                                                f"{taint.reason}")
        reach = taint.reach * (factor if symbol == "B" else 1.0)
        return _Read(value, stddev, shown, taint, doubt_of(symbol, value, reach))

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
        if now.taint is not None and not now.taint.testing:
            judge.recall(now.taint.since_s, now.value, margin, now.doubt)
        judge.judge(time_s, now.value, margin, now.doubt)
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
            advice = "" if now.taint.testing else f"{self._moved(judge, now)}; {ADVICE}"
            head = f"{RAISED[judge.raised]} held" if judge.raised else NOT_JUDGED
            return f"{head}: {value.rstrip(',')}, but {now.taint.reason}{advice}"
        text = f"{value} {self._against_limit(judge, now.value)}"
        if now.taint is not None and not now.taint.testing:
            text = f"{text}; {now.taint.reason}{self._moved(judge, now)}"
        return f"{text}; {now.note}" if now.note else text

    @staticmethod
    def _moved(judge: Judge, now: _Read) -> str:
        """Return in words how far a value may be off by what the model lacks."""
        off = max(now.doubt.highest - now.value, now.value - now.doubt.lowest)
        if judge.watched.symbol != "B" and off < abs(now.value):
            return f", which may have moved it by {share(off / abs(now.value), 2)}"
        if judge.watched.symbol == "B" and math.isfinite(now.taint.reach):
            return f", which may have moved it by {quantity(off, judge.watched.unit, 2)}"
        return ", which may have moved it by any amount"

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
            return f"has passed {said}, not yet for {judge.hold_time:g} s"
        if judge.sign * (value - limit) > 0:
            return f"is {bad} {said}, within its uncertainty"
        return f"is {good} {said}"


def viscosity_factor(viscosity: Viscosity, temperature: float) -> float:
    """Return B at the reference temperature over B at ``temperature`` (°C)."""
    return viscosity_ratio(temperature, viscosity.reference_temperature, viscosity.coefficient,
                           viscosity.grade, viscosity.at_100)
