"""An indicator of health: what it says, its uncertainty, its limits."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from eha_monitor.quantity import with_uncertainty
from eha_monitor.settings.monitor import Settings

NAMES = ("leakage", "free_air", "damping", "friction", "friction_share", "pump_efficiency",
         "drive_lag")
WORDS = {"leakage": "internal leakage", "free_air": "free air", "damping": "viscous damping B",
         "friction": "dry friction", "friction_share": "dry friction, of the stall force",
         "pump_efficiency": "volumetric efficiency", "drive_lag": "drive lag"}
# Factor from SI, and the unit that people act on; damping and friction have the rig's own.
UNITS = {"leakage": (6e7, "mL/min"), "free_air": (100.0, "%"), "friction_share": (100.0, "%"),
         "pump_efficiency": (100.0, "%"), "drive_lag": (1e3, "ms")}
# Parameter -> its thresholds, where it is shown beside the indicators.
WORST = {"B": "viscous_damping", "beta_e": "bulk_modulus"}
AVAILABLE, NONE, UNKNOWN, NEEDS = "available", "none_named", "cannot_be_told", "needs_config"
NOT_LOOKED_FOR = "estimated by `diagnose`, not by `estimate`"


@dataclass(frozen=True)
class Indicator:
    """One number of the health, or why there is none.

    Attributes
    ----------
    name : one of ``NAMES``; ``words`` says it.
    value, stddev : in ``unit``; NaN where nothing could be computed.  A ``value`` may be there
        without being reported: a trend over many recordings may show what one cannot.
    noise : the part of ``stddev`` that differs from one recording to the next; the rest (an
        air-free modulus, an exponent) is the same in all of one rig.
    status : ``available``, ``none_named`` (the recording shows none), ``cannot_be_told``, or
        ``needs_config``, with the missing keys in ``missing``.
    message : the conditions it holds at, or the reason why it is not reported.
    law : equation and its limits, in a sentence.
    doubtful : what it is made of is tainted by a model that does not fit; ``message`` says why.
    below : where it is not reported, what it is below (above, of the efficiency) with 97.5 %; NaN
        where that is not known.
    """

    name: str
    value: float
    stddev: float
    noise: float
    unit: str
    status: str
    message: str
    law: str
    missing: tuple[str, ...] = ()
    below: float = math.nan
    doubtful: bool = False

    @property
    def words(self) -> str:
        """The name as people say it."""
        return WORDS[self.name]

    @property
    def silent(self) -> bool:
        """Whether it tells nothing: keys are missing, none was named, or nobody looked."""
        return self.status in (NEEDS, NONE) or self.message == NOT_LOOKED_FOR

    @property
    def shown(self) -> str:
        """The value as people read it, in brackets in doubt, a dash where it is not reported."""
        if self.status != AVAILABLE:
            return "—"
        known = with_uncertainty(self.value, self.stddev, self.unit)
        return f"({known})" if self.doubtful else known

    def tree(self, settings: Settings) -> dict:
        """Return what stands in a JSON answer; value and stddev only where they are known.

        ``limit`` : of the config, in ``unit``, None for none; ``beyond_limit`` see :func:`passed`.
        """
        known = self.status == AVAILABLE
        limit = next((one for one in limits_of_indicator(self.name, settings)
                      if one is not None), None)
        return {"name": self.name, "words": self.words, "value": self.value if known else None,
                "stddev": self.stddev if known else None, "noise": self.noise if known else None,
                "unit": self.unit, "status": self.status, "message": self.message,
                "law": self.law, "missing": list(self.missing),
                "below": self.below if math.isfinite(self.below) else None,
                "limit": limit, "beyond_limit": passed(self, settings)}


def propagated(function: Callable[[Mapping[str, float]], float], values: Mapping[str, float],
               covariance: np.ndarray) -> tuple[float, float]:
    """Return a function of uncertain numbers and its standard deviation.

    First order, with the slope taken over one standard deviation on either side, so that it is
    the slope where the number may lie and not only where it was found.  ``covariance`` is (k, k)
    in the order of ``values``.
    """
    middle = function(values)
    slopes = np.zeros(len(values))
    for i, name in enumerate(values):
        step = math.sqrt(max(float(covariance[i, i]), 0.0))
        if step > 0.0:
            high = function({**values, name: values[name] + step})
            low = function({**values, name: values[name] - step})
            slopes[i] = (high - low) / (2.0 * step)
    return float(middle), float(math.sqrt(max(float(slopes @ covariance @ slopes), 0.0)))


def limits_of_indicator(name: str, settings: Settings) -> tuple[float | None, float | None]:
    """Return what an indicator, B or beta_e must stay above and below; None for no limit.

    They are in the unit in which the indicator is shown; of B and beta_e they are the ERROR
    thresholds, or those of WARN where there is no other.
    """
    if name in WORST or name == "damping":
        limits = getattr(settings.thresholds, WORST.get(name, "viscous_damping"))
        low = limits.low_warn if limits.low_error is None else limits.low_error
        high = limits.high_warn if limits.high_error is None else limits.high_error
        return low, high
    key = "friction" if name == "friction_share" else name
    limit = getattr(settings.health, f"{key}_limit")
    if limit is None:
        return None, None
    if name == "friction":
        areas = settings.rig.area_1, settings.rig.area_2
        if settings.health.rated_pressure is None or None in areas:
            return None, None
        return None, limit * settings.health.rated_pressure * min(areas)
    shown = limit * UNITS[name][0]
    return (shown, None) if name == "pump_efficiency" else (None, shown)


def passed(one: Indicator, settings: Settings) -> bool:
    """Tell whether a value lies beyond its limit by ``thresholds.confidence`` of its stddev.

    One in doubt does not.
    """
    low, high = limits_of_indicator(one.name, settings)
    margin = settings.thresholds.confidence * one.stddev
    return one.status == AVAILABLE and not one.doubtful and (
        (low is not None and one.value < low - margin)
        or (high is not None and one.value > high + margin))
