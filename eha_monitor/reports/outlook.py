"""Steps of a trend and the time to its limit, in words and in the picture."""

import math
from datetime import UTC, datetime

from matplotlib.axes import Axes

from eha_monitor.archive.forecast import BEYOND, NO_LIMIT, NOT_YET, TOLD, Forecast
from eha_monitor.archive.history import History
from eha_monitor.indicators.indicator import WORDS
from eha_monitor.quantity import SYMBOLS, number, quantity
from eha_monitor.reports.drawing import ERROR_LINE, INK

DAY = 86400.0  # s
FAR = 1.0  # times what has been recorded: so far ahead a picture shows
NEVER = 50.0  # years: beyond that a date is no date


def outlook_words(found: History) -> str:
    """Return steps and the time to each limit, in sentences; empty where nothing is to say."""
    words = []
    if jumps := found.outlook.jumps:
        words.append(f"Step{'s' if len(jumps) > 1 else ''} at {', '.join(map(day, jumps))} (a "
                     "repair, other oil): the trend restarts there.")
    words += [forecast_words(one, found) for one in found.outlook.forecasts
              if one.status != NO_LIMIT]
    return " ".join(filter(None, words))


def forecast_words(one: Forecast, found: History) -> str:
    """Return when a limit is reached, or why that cannot be told."""
    name = SYMBOLS.get(found.name) or WORDS[found.name].capitalize()
    limit = quantity(one.limit, found.unit)
    if one.status == TOLD:
        now = float(found.time[found.usable][-1])
        if not math.isfinite(one.early):
            return f"{name} grows, but does not reach {limit} within the forecast horizon."
        late = f"{day(one.late)}" if _near(one.late, now) else "no upper bound"
        middle = (f", median {day(one.middle)} ({span(one.middle - now)})"
                  if _near(one.middle, now) else "")
        return (f"{name} reaches {limit} between {day(one.early)} and {late} "
                f"(90 % interval){middle}.")
    if one.status == BEYOND:
        return f"{name} is at its limit of {limit} or beyond it."
    if one.status == NOT_YET:
        return (f"Time to {limit}: cannot be told yet"
                + (f" (odds of growth {number(one.odds, 2)} to 1; predicted from 200 on)."
                   if math.isfinite(one.odds) else " (fewer than eight values)."))
    return f"Time to {limit}: no growth towards it."


def draw_outlook(axis: Axes, found: History, factor: float) -> None:
    """Draw steps as vertical lines and the interval of the passage as a bar on the limit."""
    for place, jump in enumerate(found.outlook.jumps):
        axis.axvline(jump / DAY, color=INK, linewidth=1.2, linestyle=(0, (1, 2)),
                     label="step" if not place else None)
    bottom, top = axis.get_ylim()
    _, right = axis.get_xlim()
    for one in told_of(found):
        height = one.limit * factor
        if not bottom <= height <= top:
            continue
        early, late = one.early / DAY, min(one.late / DAY, right)
        if early >= right:
            continue
        axis.plot([early, late], [height, height], color=ERROR_LINE, linewidth=9, alpha=0.35,
                  solid_capstyle="butt", label="limit reached, 90 % interval")
        if one.middle / DAY < right:
            axis.plot([one.middle / DAY], [height], marker="D", markersize=6, color=ERROR_LINE,
                      linestyle="", label="median")


def told_of(found: History) -> list[Forecast]:
    """Return the forecasts that are told."""
    return [one for one in found.outlook.forecasts
            if one.status == TOLD and math.isfinite(one.early)]


def horizon(found: History) -> float:
    """Return the end of a picture, s since the epoch: that of the interval, within reason."""
    last = float(found.time[-1])
    ahead = FAR * max(last - float(found.time[0]), DAY)
    ends = [min(one.late, last + ahead) for one in told_of(found) if one.early < last + ahead]
    return max([last, *ends])


def day(time: float) -> str:
    """Return a time as a date, UTC."""
    return datetime.fromtimestamp(time, tz=UTC).strftime("%Y-%m-%d")


def span(seconds: float) -> str:
    """Return a time from now in words."""
    days = seconds / DAY
    if days < 1.0:
        return "now"
    return f"in {days:.0f} days" if days < 100 else f"in {days / 30.4:.0f} months"


def _near(time: float, now: float) -> bool:
    return math.isfinite(time) and time - now < NEVER * 365.25 * DAY
