"""Where a learned table says nothing: beyond the range of the recording that it was learned from.

A table keeps its last value there, which is no law.  A model that is used beyond it is neither
right nor wrong, and what is estimated beside it deserves doubt.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.estimation.results import ModelStatus, Taint
from eha_monitor.physics.own_term import BY_ANGLE, OF, OF_UNITS
from eha_monitor.quantity import quantity, share
from eha_monitor.settings.monitor import Settings

BEYOND = 0.02  # of its range: so far past an end a table still holds
OFTEN = 0.01  # of the samples; a table leaves out 0.1 % of its own recording at either end
OVER_S = 0.01  # a velocity is read over so long


@dataclass(frozen=True)
class Range:
    """What a learned table covers: name of its entry, signal, both ends, SI."""

    name: str
    of: str
    first: float
    last: float


def ranges_of(settings: Settings) -> tuple[Range, ...]:
    """Return what the tables among a config's effects cover; the shaft's angle goes round."""
    return tuple(Range(name, entry["of"], entry["first"], entry["last"])
                 for name, entry in settings.effects.items()
                 if "values" in entry and entry.get("of") not in (None, OF[BY_ANGLE]))


def beyond(ranges: tuple[Range, ...], channels: Mapping[str, np.ndarray], dt: float,
           gain: float | None) -> str:
    """Return in words which table the motion leaves, "" where it leaves none.

    Parameters
    ----------
    channels : recorded ones by name, (n,) SI, NaN where missing;  ``dt`` between samples, s.
    gain : of the position loop, rad/s/m, where the shaft's speed is not recorded.
    """
    for one in ranges:
        values = _signal(one.of, channels, dt, gain)
        values = values[np.isfinite(values)]
        margin = BEYOND * (one.last - one.first)
        outside = (values < one.first - margin) | (values > one.last + margin)
        if len(values) and np.mean(outside) > OFTEN:
            unit = OF_UNITS[one.of]
            return (f"{one.name} was learned from {one.of} = {quantity(one.first, unit, 3)} to "
                    f"{quantity(one.last, unit, 3)}, and {share(float(np.mean(outside)))} of the "
                    "samples are outside")
    return ""


def _signal(of: str, channels: Mapping[str, np.ndarray], dt: float, gain: float | None
            ) -> np.ndarray:
    """Return a signal of a table along a recording, empty where it was not measured."""
    if of in ("x", "p1", "p2", "omega") and of in channels:
        return channels[of]
    if of == "v" and "x" in channels:
        step = max(round(OVER_S / dt), 1)
        x = channels["x"]
        return (x[step:] - x[:-step]) / (step * dt)
    if of in ("dp", "p") and "p1" in channels and "p2" in channels:
        return (channels["p1"] - channels["p2"] if of == "dp"
                else 0.5 * (channels["p1"] + channels["p2"]))
    if of == "omega" and gain is not None and "x_d" in channels and "x" in channels:
        return gain * (channels["x_d"] - channels["x"])
    return np.zeros(0)


def within(status: ModelStatus, words: str, since_s: float) -> ModelStatus:
    """Return the verdict on a model: none where the motion leaves what was learned (``words``)."""
    if not words:
        return status
    doubt = Taint(words, since_s)
    return replace(status, status="not_judged", message=words,
                   tainted={"B": doubt, "beta_e": doubt} | status.tainted)
