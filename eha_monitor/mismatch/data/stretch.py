"""A gapless stretch of a recording, and pieces of one."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

BURN_IN = 0.15  # s at the start of each stretch in which the filter finds the state


@dataclass(frozen=True)
class Stretch:
    """One gapless stretch of a recording.

    Attributes
    ----------
    start : time of its first sample in its recording, s; ``source`` names the recording.
    z : (n, N_OUTPUTS) measured x, v, p1, p2, omega (SI), NaN where missing.
    u : (n, 4) input as cubics: x_d (m), pump speed (rad/s) or force (N).
    p1, p2 : (n,) pressures for a forced model, Pa.
    counted : (n,) bool, samples whose innovations are fitted.
    held_out : (n,) bool, samples kept aside for the proof.
    loose : (n,) share of the pressure difference that is taken from the sensors because the
        input's course before the sample is not known, or None.
    angle : (n,) what the shaft has turned since the recording began, rad; None if nothing says it.
    """

    source: str
    start: float
    z: np.ndarray
    u: np.ndarray
    p1: np.ndarray
    p2: np.ndarray
    counted: np.ndarray
    held_out: np.ndarray
    loose: np.ndarray | None = None
    angle: np.ndarray | None = None

    @property
    def begins_at(self) -> float:
        """Angle of the shaft at the first sample, rad; 0 where nothing says it."""
        return 0.0 if self.angle is None else float(self.angle[0])

    def __len__(self) -> int:
        return len(self.z)

    @cached_property
    def middle(self) -> np.ndarray:
        """Medians of the measured signals, (N_OUTPUTS,) SI; NaN where one was not measured."""
        measured = np.isfinite(self.z)
        return np.array([np.median(column[here]) if here.any() else np.nan
                         for column, here in zip(self.z.T, measured.T, strict=True)])


def cut(stretch: Stretch, first: int, last: int, dt: float) -> Stretch:
    """Return samples ``first`` to ``last`` of a stretch; the filter finds its state anew."""
    here = slice(first, last)
    counted = stretch.counted[here].copy()
    counted[: round(BURN_IN / dt) if first else 0] = False
    return replace(stretch, start=stretch.start + first * dt, z=stretch.z[here],
                   u=stretch.u[here], p1=stretch.p1[here], p2=stretch.p2[here], counted=counted,
                   held_out=stretch.held_out[here],
                   loose=None if stretch.loose is None else stretch.loose[here],
                   angle=None if stretch.angle is None else stretch.angle[here])
