"""Thresholds from healthy recordings, and the false alarms that they imply.

A low limit L raises an alarm in a recording where value + c·stddev stays below L for the hold
time; so each recording has a limit that just raises none, its *extreme*, and a high one likewise.
The logarithms of the extremes of n healthy recordings are taken as normal; the extreme of another
healthy recording then lies below mean - t·s·√(1 + 1/n) with the probability of Student's t with
n - 1 degrees of freedom (a prediction interval for one further observation: Hahn and Meeker,
Statistical Intervals, 2nd ed., ch. 4).  It holds both spreads: within a recording (noise, wander)
and between recordings.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr, stdtrit

from eha_monitor.health.alarms import JUDGE_RATE, SECTIONS, ParameterSeries, carried
from eha_monitor.indicators.laws import at_reference
from eha_monitor.settings.monitor import LIMITS, Settings, Thresholds

UNLIKE = 0.01  # chance, over all recordings, at which one counts as unlike the others
ERROR_SHARE = 0.1  # of the WARN rate, the rate of an ERROR
SIDES = {"B": ("low", "high"), "beta_e": ("low",)}
NOMINAL = {"B": 600.0, "beta_e": 6e8}  # of the paper, which its limits are set around
FARTHEST = math.log(1e3)  # a limit that lies farther off is none
WIDE = 3.0  # times the mean: a limit farther off watches nothing and needs more recordings


@dataclass(frozen=True)
class Healthy:
    """One parameter in one healthy recording, SI, B at the reference temperature."""

    source: str  # the recording
    # value, stddev: the estimate at its end
    value: float
    stddev: float
    # low, high: lowest and highest limit that would have raised no alarm
    low: float
    high: float


@dataclass(frozen=True)
class Limit:
    """A proposed limit.

    ``rate`` is the share of healthy recordings that would raise it, NaN where it is not known;
    ``factor`` is the limit over the mean.
    """

    key: str
    value: float
    rate: float
    factor: float

    @property
    def wide(self) -> bool:
        """Tell whether it lies so far off that it watches nothing; then none is written."""
        return math.isfinite(self.rate) and not 1 / WIDE < self.factor < WIDE


@dataclass(frozen=True)
class Proposal:
    """Limits of one parameter."""

    symbol: str
    healthy: tuple[Healthy, ...]
    mean: float  # of the healthy recordings, geometric
    # within, between: relative standard deviations within and between recordings; ``between`` is
    # NaN from one recording
    within: float
    between: float
    limits: tuple[Limit, ...]
    # recordings that are unlike the others, with the chance of it
    unlike: tuple[tuple[str, float], ...]
    # how many recordings of this spread would bring each limit within ``WIDE``; 0 where all are
    more: int = 0


def healthy_of(source: str, symbol: str, time: np.ndarray, series: ParameterSeries,
               settings: Settings, temperature: np.ndarray | None = None) -> Healthy | None:
    """Return a parameter of a recording with its extremes, or None where nothing was judged.

    ``time`` (n,) in s; ``temperature`` (n,) in °C, or None.
    """
    if len(time) < 2 or len(series.value) == 0 or series.final.status != "converged":
        return None
    stride = max(1, round(1.0 / (JUDGE_RATE * float(np.median(np.diff(time))))))
    index = np.arange(len(time) - 1, -1, -stride)[::-1]
    known, value, stddev = series.at(index)
    if symbol == "B" and temperature is not None:
        value, stddev = np.array([
            at_reference(settings.viscosity, degrees, one, spread) if math.isfinite(degrees)
            else (one, spread) for degrees, one, spread in zip(
                carried(temperature, index), value, stddev, strict=True)]).T
    limits = getattr(settings.thresholds, SECTIONS[symbol])
    margin = settings.thresholds.confidence * stddev
    window = min(math.ceil(limits.hold_time * JUDGE_RATE - 1e-6) + 1, len(index))
    upper = np.where(known, value + margin, np.inf)
    lower = np.where(known, value - margin, -np.inf)
    view = np.lib.stride_tricks.sliding_window_view
    low = float(view(upper, window).max(axis=1).min())
    high = float(view(lower, window).min(axis=1).max())
    if not (0 < low < math.inf and 0 < high < math.inf):
        return None
    return Healthy(source, float(value[-1]), float(stddev[-1]), low, high)


def proposed(symbol: str, healthy: list[Healthy], rate: float, least: float) -> Proposal:
    """Return limits with the false alarms that they imply.

    Parameters
    ----------
    rate : share of healthy recordings that may raise a WARN; an ERROR a tenth of it.
    least : no limit lies nearer to the mean than by this share of it.
    """
    logs = np.log([one.value for one in healthy])
    mean = float(np.exp(logs.mean()))
    within = math.sqrt(float(np.mean([(one.stddev / one.value) ** 2 for one in healthy])))
    n = len(healthy)
    between = math.nan
    if n > 1:
        between = math.sqrt(max(0.0, float(logs.var(ddof=1)) - within**2))
    limits = tuple(_limit(symbol, side, level, healthy, rate, least, mean)
                   for side in SIDES[symbol] for level in ("error", "warn"))
    return Proposal(symbol, tuple(healthy), mean, within, between,
                    tuple(sorted(limits, key=lambda one: LIMITS.index(one.key))),
                    _unlike(healthy), _more(limits, healthy, rate))


def _limit(symbol: str, side: str, level: str, healthy: list[Healthy], rate: float, least: float,
           mean: float) -> Limit:
    key, n = f"{side}_{level}", len(healthy)
    sign = -1.0 if side == "low" else 1.0
    if n == 1:
        # The spread between recordings is not known: the paper's limits, about this mean.
        paper = getattr(getattr(Thresholds(), SECTIONS[symbol]), key)
        return Limit(key, mean * paper / NOMINAL[symbol], math.nan, paper / NOMINAL[symbol])
    middle, spread = _extremes(side, healthy)
    wanted = rate * (ERROR_SHARE if level == "error" else 1.0)
    reach = min(max(sign * _t(wanted, n) * spread, -FARTHEST), FARTHEST)
    value = math.exp(middle + reach)
    # An ERROR lies farther out than a WARN in any case.
    nearest = mean * (1.0 + sign * least * (1.5 if level == "error" else 1.0))
    value = min(value, nearest) if sign < 0 else max(value, nearest)
    return Limit(key, value, implied(side, healthy, value), value / mean)


def _extremes(side: str, healthy: list[Healthy]) -> tuple[float, float]:
    """Return mean and standard error of prediction of the extremes' logarithms."""
    logs = np.log([getattr(one, side) for one in healthy])
    n = len(logs)
    # Never less than what the noise of one recording does by itself.
    floor = float(np.mean([(one.stddev / one.value) ** 2 for one in healthy]))
    return float(logs.mean()), math.sqrt(max(float(logs.var(ddof=1)), floor) * (1.0 + 1.0 / n))


def implied(side: str, healthy: list[Healthy], limit: float) -> float:
    """Return the share of healthy recordings that would raise an alarm at a limit."""
    middle, spread = _extremes(side, healthy)
    away = (middle - math.log(limit)) * (1.0 if side == "low" else -1.0) / spread
    return float(stdtr(len(healthy) - 1, -away))


def _t(rate: float, n: int) -> float:
    """Return the distance in Student's distribution beyond which lies a share ``rate``."""
    return -float(stdtrit(n - 1, rate))


def _unlike(healthy: list[Healthy]) -> tuple[tuple[str, float], ...]:
    """Return the recordings that are no likely draw of what the others are drawn from."""
    logs, n = np.log([one.value for one in healthy]), len(healthy)
    if n < 3:
        return ()
    found = []
    for place, one in enumerate(healthy):
        rest = np.delete(logs, place)
        spread = math.sqrt(max(float(rest.var(ddof=1)), (one.stddev / one.value) ** 2)
                           * (1.0 + 1.0 / (n - 1)))
        chance = n * 2.0 * float(stdtr(n - 2, -abs(logs[place] - rest.mean()) / spread))
        if chance < UNLIKE:
            found.append((one.source, chance))
    return tuple(found)


def _more(limits: tuple[Limit, ...], healthy: list[Healthy], rate: float) -> int:
    """Return how many recordings of the same spread would bring the limits within ``WIDE``."""
    n = len(healthy)
    if n == 1:
        return 5
    if not any(one.wide for one in limits):
        return 0
    spread = max(_extremes(side, healthy)[1] for side in ("low", "high")) / math.sqrt(1 + 1 / n)
    for count in range(n + 1, 31):
        if _t(rate * ERROR_SHARE, count) * spread * math.sqrt(1 + 1 / count) < math.log(WIDE):
            return count
    return 30


def thresholds_tree(proposals: list[Proposal]) -> dict[str, dict[str, float | None]]:
    """Return the ``thresholds`` section; a side that is not proposed, or is wide, has none."""
    return {SECTIONS[one.symbol]: dict.fromkeys(LIMITS) | {
        limit.key: float(f"{limit.value:.4g}") for limit in one.limits if not limit.wide}
        for one in proposals}
