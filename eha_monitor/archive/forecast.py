"""The time to the limit, as a distribution, from the values of a series so far."""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from eha_monitor.archive.wear import FIRST, Tracker, z_of

SAMPLES = 4000
SHORT = 0.02  # of the limit: a shorter way to it is none
MOST = 400  # values, the last ones: a filter bank takes about a millisecond for each
TAILS = (0.05, 0.5, 0.95)
TOLD, BEYOND, NOT_YET, STEADY, NO_LIMIT = (
    "told", "beyond", "cannot_be_told_yet", "no_growth", "no_limit")


@dataclass(frozen=True)
class Forecast:
    """When a value reaches its limit.

    Attributes
    ----------
    status : ``told``, ``beyond`` (it is there), ``cannot_be_told_yet``, ``no_growth``,
        ``no_limit``.
    limit : in the unit of the values; NaN without one.
    early, middle, late : 5, 50 and 95 % of the time of the first passage, s since the epoch;
        inf where that share of the possibilities never reaches it.
    odds : of growth against none.
    jumps : times of the first values after a jump, s since the epoch.
    """

    status: str
    limit: float = np.nan
    early: float = np.nan
    middle: float = np.nan
    late: float = np.nan
    odds: float = np.nan
    jumps: tuple[float, ...] = field(default=())


class Series:
    """Values one by one against one limit.

    Parameters
    ----------
    limit : in the unit of the values.
    above : values above the limit are too large; otherwise those below are too small.
    """

    def __init__(self, limit: float, above: bool = True):
        self.limit = limit
        self._side = 1.0 if above else -1.0
        self._early: list[tuple[float, float, float]] = []
        self._tracker: Tracker | None = None
        self._start = self._way = np.nan

    def add(self, time: float, value: float, stddev: float) -> None:
        """Take a value in; ``stddev`` is that of the recording's own noise."""
        if self._tracker is not None:
            self._tracker.add(time, (value - self._start) / self._way, stddev / abs(self._way))
            return
        self._early.append((time, value, stddev))
        if len(self._early) < FIRST:
            return
        self._begin()

    def _begin(self) -> None:
        times, values, stddevs = np.array(self._early).T
        rough = float(np.median(np.abs(np.diff(values)))) / 0.954  # of a normal deviate, times √2
        self._start = float(np.median(values))
        least = max(4.0 * rough, SHORT * abs(self.limit)) or 1.0
        if self._side * (self.limit - self._start) < least:  # it began at its limit or beyond
            self._start = self.limit - self._side * least
        self._way = self.limit - self._start
        size = abs(self._way)
        scale = max(rough, 0.2 * float(np.median(stddevs)), 1e-4 * size) / size
        unit = float(np.median(np.diff(times))) or 1.0
        self._tracker = Tracker(unit, scale)
        for time, value, stddev in self._early:
            self.add(time, value, stddev)

    @property
    def certain(self) -> bool:
        """Whether growth is told, for the last or for an earlier value since the last jump."""
        return self._tracker is not None and self._tracker.certain

    def forecast(self, seed: int = 0) -> Forecast:
        """Return what is known now."""
        tracker = self._tracker
        if tracker is None:
            return Forecast(NOT_YET, self.limit)
        bank, odds, jumps = tracker.bank, tracker.odds, tracker.jumps
        share = np.exp(bank.weight - bank.weight.max())
        share /= share.sum()
        if share @ bank.level >= 1.0:
            return Forecast(BEYOND, self.limit, tracker.time, tracker.time, tracker.time, odds,
                            jumps)
        if not tracker.certain or tracker.active < 0.5:
            status = STEADY if odds < 1.0 or tracker.certain else NOT_YET
            return Forecast(status, self.limit, odds=odds, jumps=jumps)
        passage = first_passage(tracker, share, np.random.default_rng(seed))
        early, middle, late = np.quantile(passage, TAILS, method="inverted_cdf")
        return Forecast(TOLD, self.limit, float(early), float(middle), float(late), odds, jumps)


@dataclass(frozen=True)
class Outlook:
    """What a series says of its past and future.

    Attributes
    ----------
    jumps : times of the first values after a jump, s since the epoch.
    forecasts : one for each limit.
    """

    jumps: tuple[float, ...] = ()
    forecasts: tuple[Forecast, ...] = ()


@lru_cache(maxsize=64)
def _looked_at(table: bytes, limit: float, above: bool) -> Forecast:
    series = Series(limit, above)
    for time, value, stddev in np.frombuffer(table).reshape(-1, 3)[-MOST:]:
        series.add(float(time), float(value), float(stddev))
    return series.forecast()


def outlook(time: np.ndarray, value: np.ndarray, stddev: np.ndarray,
            limits: tuple[float | None, float | None]) -> Outlook:
    """Return jumps and the time to each limit of a series.

    Parameters
    ----------
    time : (n,) s since the epoch, in order; ``value``, ``stddev`` : (n,) in one unit.
    limits : that it must stay above, and below; None for none.  Without any, jumps alone are
        looked for.
    """
    good = np.isfinite(time) & np.isfinite(value)
    table = np.column_stack([time, value, np.nan_to_num(stddev, nan=0.0, posinf=0.0)])[good]
    packed = np.ascontiguousarray(table, dtype=float).tobytes()
    found = [_looked_at(packed, float(limit), above)
             for limit, above in zip(limits, (False, True), strict=True) if limit is not None]
    if found:
        # The nearer limit is the finer measure of a jump.
        latest = float(np.median(table[-3:, 1])) if len(table) else 0.0
        return Outlook(min(found, key=lambda one: abs(one.limit - latest)).jumps, tuple(found))
    if not len(table):
        return Outlook()
    far = float(np.max(table[:, 1]) + 3.0 * np.ptp(table[:, 1]))  # no limit: a way to measure by
    return Outlook(_looked_at(packed, far, True).jumps, (Forecast(NO_LIMIT),))


def first_passage(tracker: Tracker, share: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw times of the first passage through 1, s; inf where there is none.

    In the transformed time of each hypothesis it is inverse Gaussian (Schrödinger 1915; Folks,
    Chhikara 1978): mean d/(g A), shape (d/(s A))² over the way d that is left.
    """
    bank = tracker.bank
    chosen = bank.part(rng.choice(len(bank), SAMPLES, p=share))
    root = np.sqrt(np.maximum(chosen.var_l, 0.0))
    level = chosen.level + root * rng.standard_normal(SAMPLES)
    slope = np.where(root > 0.0, chosen.cov / np.maximum(chosen.var_l, 1e-300), 0.0)
    left = np.sqrt(np.maximum(chosen.var_g - slope * chosen.cov, 0.0))
    gain = chosen.gain + slope * (level - chosen.level) + left * rng.standard_normal(SAMPLES)
    way = 1.0 - level
    found = np.full(SAMPLES, np.inf)
    found[way <= 0.0] = tracker.time
    grows = chosen.grows & (gain > 1e-6) & (way > 0.0)
    g = chosen.part(grows)
    clock = rng.wald(way[grows] / (gain[grows] * g.way),
                     np.square(way[grows] / (g.diffusion * g.way)))
    found[grows] = g.onset + g.tau * z_of(g.clock + clock, g.shape)
    return found
