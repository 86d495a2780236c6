"""Indicators of health as rows of a report's table."""

from collections.abc import Sequence
from typing import Any

from eha_monitor.indicators.indicator import AVAILABLE, Indicator, limits_of_indicator, passed
from eha_monitor.quantity import number
from eha_monitor.settings.monitor import Settings


def indicator_rows(indicators: Sequence[Indicator], settings: Settings) -> list[dict[str, Any]]:
    """Return one row for each indicator, with its limits in words."""
    return [{"words": one.words, "shown": one.shown, "unit": one.unit, "message": one.message,
             "law": one.law, "passed": passed(one, settings),
             "limit": limit_words(one, settings),
             "value": one.value if one.status == AVAILABLE else None,
             "stddev": one.stddev if one.status == AVAILABLE else None} for one in indicators]


def limit_words(one: Indicator, settings: Settings) -> str:
    """Return the limits of an indicator, ``below 50 mL/min``, or ``not set``."""
    low, high = limits_of_indicator(one.name, settings)
    parts = [f"{words} {number(limit, 3)} {one.unit}"
             for words, limit in (("above", low), ("below", high)) if limit is not None]
    return ", ".join(parts) or "not set"
