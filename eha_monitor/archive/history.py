"""What a table says over time: which values to trust, their line, wear, the time to the limit.

Wear in a series of values (none, growing, set back by a repair) and the time to the limit.

A health number does one of two things between recordings: it stays (``rest``), or it grows
towards its limit (``growth``).  In units in which it is 0 at first and 1 at the limit,

    growth:  x(t) = x(o) + g A Lambda(t) + s A W(Lambda(t)),
    Lambda(t) = z^b  or  (exp(k z) - 1)/(exp(k) - 1),  z = (t - o)/tau

is a Wiener process with drift in transformed time (Whitmore, Schenkelberg 1997): o is its onset, A
the way from there to the limit, tau the time that it needs on average, b or k its shape (b = 1
steady, above accelerating, below slowing down; k for wear that feeds on itself), s the diffusion.
At every recording it may begin, begin anew with other numbers, or end; and the level may jump (a
repair, new oil), after which everything begins anew.  What is measured is x plus white noise of a
size that is found as well; now and then a value is an outlier.

Each hypothesis (onset, tau, b, s, size of the noise) is a Kalman filter with the level and g as
its state, all of them in one bank, weighted by their evidence (as Adams, MacKay 2007 do it for
change points).  ``odds`` is the evidence of all that have grown since the last jump over all that
have not.  Where nothing grows it exceeds 1/q with probability q at most, however often one looks
(Ville 1939), so a trend is told from odds of ``CERTAIN`` on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np

from eha_monitor.archive.store import INDICATORS, nanoseconds_of
from eha_monitor.indicators.indicator import UNITS, limits_of_indicator
from eha_monitor.recordings.recording import CALENDAR_NS
from eha_monitor.settings.monitor import Settings

CERTAIN = 200.0  # odds from which growth is told: at most 0.5 % of healthy machines ever see it
BEGINS, ANEW, ENDS, JUMPS = 1 / 100, 1 / 100, 1 / 200, 1 / 500  # a recording
OUTLIER = 0.02  # share of values that are none
LEVEL = 0.7  # standard deviation of the level at first and after a jump, of the way to the limit
TAUS = np.geomspace(10.0, 3000.0, 24)  # times the usual time between two recordings
# b of each power law, and -k of each exponential.
SHAPES = np.array([0.5, 1.0, 1.5, 2.0, 3.0, 5.0, -2.0, -3.5, -5.0])
# Standard deviation of g: it fills the gaps of the grid.
GAIN = np.array([0.2, 0.2, 0.25, 0.3, 0.35, 0.4, 0.25, 0.3, 0.35])
DIFFUSIONS = np.array([0.02, 0.1, 0.3])
NOISES = np.geomspace(0.25, 8.0, 6)  # times what the first differences show
FIRST = 8  # values whose differences tell roughly how large the noise is
HYPOTHESES = 1500  # kept
SAMPLES = 4000
CLEAR = 2.0  # standard deviations by which the last value is beyond a limit, whatever came before
SHORT = 0.02  # of the limit: a shorter way to it is none
LAST = 400  # values: a filter bank takes about a millisecond for each
TAILS = (0.05, 0.5, 0.95)
TOLD, BEYOND, NOT_YET, STEADY, NO_LIMIT = (
    "told", "beyond", "cannot_be_told_yet", "no_growth", "no_limit")
NEAR = 0.05  # of the first way to the limit: growth that begins closer has no way left to go


NEW = {"weight": 0.0, "grows": False, "grown": False, "level": 0.0, "gain": 0.0, "var_l": 0.0,
       "cov": 0.0, "var_g": 0.0, "onset": 0.0, "tau": 1.0, "shape": 1.0, "diffusion": 0.0,
       "way": 1.0, "clock": 0.0, "noise": 0, "path": 0}


class Bank(SimpleNamespace):
    """Hypotheses: columns (k,) as in ``NEW``.

    ``weight`` is a logarithm; ``grows`` tells which kind it is now, ``grown`` whether it has grown
    since the last jump; ``level`` to ``var_g`` are the filter's state and covariance; ``clock`` is
    Lambda now, ``noise`` a class, ``path`` the place of the times of its jumps in the tracker's
    list.
    """

    @classmethod
    def of(cls, size: int, **columns: np.ndarray | float) -> "Bank":
        """Return so many hypotheses that differ from new ones in these columns."""
        return cls(**{name: np.full(size, values) for name, values in (NEW | columns).items()})

    def __len__(self) -> int:
        return len(self.weight)

    def part(self, which: np.ndarray) -> "Bank":
        """Return some of the hypotheses."""
        return Bank(**{name: values[which] for name, values in vars(self).items()})


_TAU, _SHAPE, _DIFFUSION = (one.ravel() for one in np.meshgrid(TAUS, SHAPES, DIFFUSIONS,
                                                                indexing="ij"))
_GAIN = np.meshgrid(TAUS, GAIN, DIFFUSIONS, indexing="ij")[1].ravel()
_EACH = -np.log(len(_TAU))


def clock_of(z: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return Lambda at z = (t - o)/tau >= 0; a negative ``shape`` is -k."""
    k = np.where(shape < 0.0, -shape, 1.0)
    power = z ** np.where(shape < 0.0, 1.0, shape)
    return np.where(shape < 0.0, np.expm1(np.minimum(k * z, 300.0)) / np.expm1(k), power)


def z_of(clock: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return z = (t - o)/tau at which Lambda is ``clock``; the inverse of :func:`clock_of`."""
    k = np.where(shape < 0.0, -shape, 1.0)
    power = clock ** (1.0 / np.where(shape < 0.0, 1.0, shape))
    return np.where(shape < 0.0, np.log1p(clock * np.expm1(k)) / k, power)


def logsum(values: np.ndarray) -> float:
    """Return log sum exp, -inf of nothing."""
    if not len(values):
        return -np.inf
    top = values.max()
    return float(top + np.log(np.exp(values - top).sum())) if np.isfinite(top) else -np.inf


@dataclass
class Tracker:
    """Takes the values of a series one by one."""

    unit: float  # usual time between two recordings, s
    scale: float  # noise that the first differences show, in units of the way to the limit
    bank: Bank = None
    time: float = np.nan
    count: int = 0
    # the odds have reached ``CERTAIN``, and have not fallen below one since: the bound on false
    # alarms holds for their largest value, so what was certain once stays so until a jump (a
    # repair) is more likely than not
    certain: bool = False
    paths: list = field(default_factory=lambda: [()])

    def add(self, time: float, value: float, stddev: float) -> None:
        """Take a value in.

        Parameters
        ----------
        time : s, not before the last one.
        value : 0 at the healthy level, 1 at the limit.
        stddev : of the recording's own noise, in the same units.
        """
        if self.bank is None:
            size = len(NOISES)
            self.bank = Bank.of(size, weight=-np.log(size), var_l=LEVEL**2, noise=np.arange(size))
        else:
            self._branch(time)
        self._advance(time)
        self._correct(value, stddev)
        self._prune()
        self.time, self.count = time, self.count + 1
        odds = self.odds
        self.certain = odds >= CERTAIN or (self.certain and odds >= 1.0)

    @property
    def odds(self) -> float:
        """Evidence of growth since the last jump over that of none."""
        grown = self.bank.grown
        return float(np.exp(min(logsum(self.bank.weight[grown])
                                - logsum(self.bank.weight[~grown]), 700.0)))

    @property
    def active(self) -> float:
        """Share of the hypotheses that grow now, 0 to 1."""
        weight = self.bank.weight
        return float(np.exp(logsum(weight[self.bank.grows]) - logsum(weight)))

    @property
    def jumps(self) -> tuple[float, ...]:
        """Times before which and after which lies a jump: of the first value after each."""
        best: dict[int, float] = {}
        for path in np.unique(self.bank.path):
            best[path] = logsum(self.bank.weight[self.bank.path == path])
        return self.paths[max(best, key=best.get)]

    def _branch(self, time: float) -> None:
        """Let growth begin, begin anew or end, and the level jump, before the next value."""
        bank, new = self.bank, []
        top = bank.weight.max()
        fade = self.count * np.log1p(-BEGINS)  # an onset is somewhere: its chances add up to one
        for noise in np.unique(bank.noise):
            mine = bank.noise == noise
            total = logsum(bank.weight[mine])
            if total < top - 12.0:
                continue
            for grows, grown in ((False, False), (False, True), (True, True)):
                chance = np.log(ANEW) if grown else np.log(BEGINS) + fade
                which = mine & (bank.grows == grows) & (bank.grown == grown)
                if not which.any() or logsum(bank.weight[which]) < top - 16.0:
                    continue
                weight, level, spread, path = collapsed(bank, which)
                if level < 1.0 - NEAR:
                    new.append(self._growing(weight + chance, level, spread, noise, path))
                if grows:
                    new.append(Bank.of(1, weight=weight + np.log(ENDS), level=level, var_l=spread,
                                       noise=noise, path=path, grown=True))
            weight, _, _, path = collapsed(bank, mine)
            self.paths.append((*self.paths[path], time))
            new.append(Bank.of(1, weight=weight + np.log(JUMPS), var_l=LEVEL**2, noise=noise,
                               path=len(self.paths) - 1))
        self.bank = Bank(**{name: np.concatenate([vars(one)[name] for one in (bank, *new)])
                            for name in NEW})

    def _growing(self, weight: float, level: float, spread: float, noise: int, path: int) -> Bank:
        return Bank.of(len(_TAU), weight=weight + _EACH, grows=True, grown=True, level=level,
                       gain=1.0, var_l=spread, var_g=_GAIN**2, onset=self.time,
                       tau=_TAU * self.unit, shape=_SHAPE, diffusion=_DIFFUSION, way=1.0 - level,
                       noise=noise, path=path)

    def _advance(self, time: float) -> None:
        bank = self.bank
        g = bank.grows
        clock = clock_of((time - bank.onset[g]) / bank.tau[g], bank.shape[g])
        step = bank.way[g] * (clock - bank.clock[g])
        bank.level[g] += step * bank.gain[g]
        bank.var_l[g] += (2.0 * step * bank.cov[g] + step**2 * bank.var_g[g]
                          + (bank.diffusion[g] * bank.way[g]) ** 2 * (clock - bank.clock[g]))
        bank.cov[g] += step * bank.var_g[g]
        bank.clock[g] = clock

    def _correct(self, value: float, stddev: float) -> None:
        """Weigh each hypothesis by the value, as a true one or as an outlier."""
        bank = self.bank
        noise = (self.scale * NOISES[bank.noise]) ** 2 + stddev**2
        off = value - bank.level
        spread = bank.var_l + noise
        good = np.log1p(-OUTLIER) - 0.5 * (off**2 / spread + np.log(spread))
        wide = spread + (0.5 + 10.0 * np.sqrt(noise)) ** 2
        bad = np.log(OUTLIER) - 0.5 * (off**2 / wide + np.log(wide))
        both = np.logaddexp(good, bad)
        share = np.exp(good - both)  # of a true value
        bank.weight += both
        k_l, k_g = bank.var_l / spread, bank.cov / spread
        # The two cases in one normal distribution with their mean and variance.
        between = share * (1.0 - share) * off**2
        bank.level += share * k_l * off
        bank.gain += share * k_g * off
        bank.var_g += between * k_g**2 - share * k_g * bank.cov
        bank.cov += between * k_l * k_g - share * k_l * bank.cov
        bank.var_l += between * k_l**2 - share * k_l * bank.var_l

    def _prune(self) -> None:
        bank = self.bank
        top = bank.weight.max()
        if len(bank) > HYPOTHESES:
            least = np.partition(bank.weight, -HYPOTHESES)[-HYPOTHESES]
            kept = bank.weight >= max(least, top - 30.0)
            rest = np.flatnonzero(~bank.grown)
            kept[rest[np.argsort(bank.weight[rest])[-12:]]] = True  # odds need both kinds
            bank = bank.part(kept)
        bank.weight -= top
        self.bank = bank


def collapsed(bank: Bank, which: np.ndarray) -> tuple[float, float, float, int]:
    """Return log weight, mean and variance of the level, and the path of the best, of some."""
    weight = bank.weight[which]
    total = logsum(weight)
    share = np.exp(weight - total)
    level = bank.level[which]
    mean = float(share @ level)
    spread = float(share @ (bank.var_l[which] + (level - mean) ** 2))
    return total, mean, max(spread, 1e-12), int(bank.path[which][np.argmax(weight)])


@dataclass(frozen=True)
class Forecast:
    """When a value reaches its limit."""

    # ``told``, ``beyond`` (it is there), ``cannot_be_told_yet``, ``no_growth``, ``no_limit``
    status: str
    limit: float = np.nan  # in the unit of the values; NaN without one
    # early, middle, late: 5, 50 and 95 % of the time of the first passage, s since the epoch; inf
    # where that share of the possibilities never reaches it
    early: float = np.nan
    middle: float = np.nan
    late: float = np.nan
    odds: float = np.nan  # of growth against none
    # times of the first values after a jump, s since the epoch
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

    def forecast(self) -> Forecast:
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
        passage = first_passage(tracker, share, np.random.default_rng(0))
        early, middle, late = np.quantile(passage, TAILS, method="inverted_cdf")
        return Forecast(TOLD, self.limit, float(early), float(middle), float(late), odds, jumps)


@dataclass(frozen=True)
class Outlook:
    """What a series says of its past and future."""

    jumps: tuple[float, ...] = ()  # times of the first values after a jump, s since the epoch
    forecasts: tuple[Forecast, ...] = ()  # one for each limit


@lru_cache(maxsize=64)
def _looked_at(table: bytes, limit: float, above: bool) -> Forecast:
    series, rows = Series(limit, above), np.frombuffer(table).reshape(-1, 3)[-LAST:]
    for time, value, stddev in rows:
        series.add(float(time), float(value), float(stddev))
    found = series.forecast()
    if found.status in (NOT_YET, STEADY) and len(rows):
        time, value, stddev = map(float, rows[-1])
        if (1.0 if above else -1.0) * (value - limit) > CLEAR * stddev:
            return replace(found, status=BEYOND, early=time, middle=time, late=time)
    return found


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


MONTH = 30.0 * 86400.0  # s; slopes are told for 30 days
LEAST = 3  # values through which a line is laid


@dataclass(frozen=True)
class Trend:
    """A straight line: ``value`` = ``level`` + ``slope`` (t - ``middle``)."""

    # slope, slope_stddev: SI unit per s
    slope: float
    slope_stddev: float
    # level, level_stddev: at ``middle``, s since the epoch, where both are uncorrelated
    level: float
    level_stddev: float
    middle: float
    scatter: float  # standard deviation from one recording to the next beyond what theirs explain
    count: int  # values

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

    ``time`` (n,) in s since the epoch; ``value`` and ``stddev`` (n,) SI.
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
    """One parameter over the recordings, in order of time; arrays are (n,)."""

    name: str  # ``B``, ``beta_e`` or an indicator of health; ``unit`` is that of the values
    unit: str
    time: np.ndarray  # s since the epoch
    # value, stddev: SI
    value: np.ndarray
    stddev: np.ndarray
    # converged, untainted, and made with this config and source: what a line may go through
    reliable: np.ndarray
    line: Trend | None  # through these since the last jump, or None
    undated: int  # recordings with a value whose stamps are no calendar time
    at_reference: bool  # the values are B at the reference temperature
    outlook: Outlook = field(default_factory=Outlook)  # jumps, and the time to each limit

    @property
    def since(self) -> float:
        """Time of the first value after the last jump, s since the epoch; -inf without one."""
        return max(self.outlook.jumps, default=-np.inf)


def history(rows: Sequence[dict], name: str, command: str, made_with: str,
            settings: Settings | None = None) -> History:
    """Return the history of a parameter or an indicator.

    Parameters
    ----------
    command : ``estimate`` takes its own value, ``diagnose`` the one with the named effects.
    made_with : rows with another digest are shown, and do not count.
    settings : its limits are those of the forecast.
    """
    limits = (None, None) if settings is None else limits_of_indicator(name, settings)
    told = [row for row in rows if _value(row, name, command, False) is not None]
    dated = sorted((row for row in first_of_copies(told) if _time(row) >= CALENDAR_NS * 1e-9),
                   key=_time)
    current = np.array([row["made_with"] == made_with for row in dated], dtype=bool)
    fine = np.array([_converged(row, name, command) for row in dated], dtype=bool) & current
    reliable = fine & np.array([_untainted(row, name, command) for row in dated], dtype=bool)
    at_reference = bool(name == "B" and command == "estimate" and reliable.any() and all(
        row.get("B_reference") is not None
        for row, good in zip(dated, reliable, strict=True) if good))
    if at_reference:
        keep = np.array([row.get("B_reference") is not None for row in dated], dtype=bool)
        dated = [row for row, good in zip(dated, keep, strict=True) if good]
        reliable = reliable[keep]
    time = np.array([_time(row) for row in dated])
    value, stddev = np.array([_value(row, name, command, at_reference) for row in dated],
                             dtype=float).reshape(-1, 2).T
    seen = outlook(time[reliable], value[reliable], stddev[reliable], limits)
    lately = reliable & (time >= max(seen.jumps, default=-np.inf))
    return History(name, _unit(name, told, settings), time, value, stddev, reliable,
                   trend(time[lately], value[lately], stddev[lately]),
                   sum(_time(row) < CALENDAR_NS * 1e-9 for row in told), at_reference, seen)


def first_of_copies(rows: Sequence[dict]) -> list[dict]:
    """Return the rows without copies: a machine is not recorded twice from the same moment on."""
    seen, found = set(), []
    for row in rows:
        moment = row.get("start"), row.get("samples")
        if None in moment or moment not in seen:
            found.append(row)
        seen.add(moment)
    return found


def _unit(name: str, told: Sequence[dict], settings: Settings | None) -> str:
    if name not in COLUMN_OF:
        return next((row[f"{name}_unit"] for row in told), "")
    force = "N·m" if settings is not None and settings.rig.motion == "rotary" else "N"
    return UNITS[name][1] if name in UNITS else force


def _time(row: dict) -> float:
    return nanoseconds_of(row["start"]) * 1e-9 if row.get("start") else 0.0


def _value(row: dict, name: str, command: str, at_reference: bool) -> tuple[float, float] | None:
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
