"""What an indicator of health says, and what it is made of."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from eha_monitor.quantity import rounded

NAMES = ("leakage", "free_air", "damping", "friction", "friction_share", "pump_efficiency",
         "drive_lag")
WORDS = {"leakage": "internal leakage", "free_air": "free air", "damping": "viscous damping B",
         "friction": "dry friction", "friction_share": "dry friction, of the stall force",
         "pump_efficiency": "volumetric efficiency", "drive_lag": "drive lag"}
# Factor from SI, and the unit that people act on; damping and friction have the rig's own.
UNITS = {"leakage": (6e7, "mL/min"), "free_air": (100.0, "%"), "friction_share": (100.0, "%"),
         "pump_efficiency": (100.0, "%"), "drive_lag": (1e3, "ms")}
AVAILABLE, NONE, UNKNOWN, NEEDS = "available", "none_named", "cannot_be_told", "needs_config"

NOT_LOOKED_FOR = "estimated by `diagnose`, not by `estimate`"


@dataclass(frozen=True)
class Indicator:
    """One number of the health, or why there is none.

    Attributes
    ----------
    name : one of ``NAMES``; ``words`` says it.
    value, stddev : in ``unit``; NaN where nothing could be computed.  A ``value`` may be there
        without being told by itself: a trend over many recordings may tell what one cannot.
    noise : the part of ``stddev`` that differs from one recording to the next; the rest (an
        air-free modulus, an exponent) is the same in all of one rig.
    status : ``available``, ``none_named`` (the recording shows none), ``cannot_be_told``, or
        ``needs_config``, with the missing keys in ``missing``.
    message : the conditions it holds at, or the reason why it is not told.
    law : equation and its limits, in a sentence.
    doubtful : what it is made of is tainted by a model that does not fit; ``message`` says why.
    below : where it is not told, what it is below (above, of the efficiency) with 97.5 %; NaN
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
    def shown(self) -> str:
        """The value as people read it, a dash where it is not told."""
        if self.status != AVAILABLE:
            return "—"
        return f"{' ± '.join(rounded(self.value, self.stddev))} {self.unit}"

    def tree(self) -> dict:
        """Return what stands in a JSON answer; value and stddev only where they are told."""
        told = self.status == AVAILABLE
        return {"name": self.name, "words": self.words, "value": self.value if told else None,
                "stddev": self.stddev if told else None, "noise": self.noise if told else None,
                "unit": self.unit, "status": self.status, "message": self.message,
                "law": self.law, "missing": list(self.missing),
                "below": self.below if math.isfinite(self.below) else None}


@dataclass(frozen=True)
class Evidence:
    """What an estimate or a diagnosis found, as plain numbers.

    Attributes
    ----------
    values : ``B``, ``beta_e``, ``leakage`` (C_T), ``pump_displacement``, and
        ``<effect>.<parameter>`` of each named effect; SI.
    covariance : (k, k) in their order.
    assumed : effects that the config has and that were therefore not measured.
    why : name of a value -> why it is not there; ``doubts``: why it is there and in doubt.
    channels : that were recorded.
    pressures : (m,) absolute pressures of both chambers at times spread over the recording, Pa;
        empty where they were not measured.
    temperature : of the oil, °C, or None; ``measured`` tells whether a channel gave it.
    diagnosed : whether effects were looked for; ``settled``: and what was found explains it.
    """

    values: Mapping[str, float]
    covariance: np.ndarray
    assumed: tuple[str, ...] = ()
    why: Mapping[str, str] = field(default_factory=dict)
    doubts: Mapping[str, str] = field(default_factory=dict)
    channels: tuple[str, ...] = ()
    pressures: np.ndarray = field(default_factory=lambda: np.empty(0))
    temperature: float | None = None
    measured: bool = False
    diagnosed: bool = False
    settled: bool = True

    def part(self, *names: str) -> tuple[dict[str, float], np.ndarray]:
        """Return those of the values that are there, and their covariance."""
        order = list(self.values)
        kept = [name for name in order if name in names]
        places = [order.index(name) for name in kept]
        return ({name: self.values[name] for name in kept},
                np.asarray(self.covariance, dtype=float)[np.ix_(places, places)])

    def named(self, *effects: str) -> list[str]:
        """Return which of the effects were named."""
        there = {name.partition(".")[0] for name in self.values if "." in name}
        return [effect for effect in effects if effect in there]


def propagated(function: Callable[[Mapping[str, float]], float], values: Mapping[str, float],
               covariance: np.ndarray) -> tuple[float, float]:
    """Return a function of uncertain numbers and its standard deviation.

    First order, with the slope taken over one standard deviation on either side, so that it is
    the slope where the number may lie and not only where it was found.

    Parameters
    ----------
    function : of a mapping like ``values``, returns a float.
    covariance : (k, k) in the order of ``values``.
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
