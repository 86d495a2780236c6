"""A recording and a rig as one hypothesis reads them, and regressions between their signals."""

from dataclasses import dataclass
from math import copysign, inf, sqrt

import numpy as np

from eha_monitor.plausibility.moments import DIRECTION, Moments

# Of the share of a side that the others cannot explain: below, they are the same thing.
DISTINCT = 1e-3
NOISY = 0.3  # of a side's variance must be signal
COLLINEAR = 1e-9  # share of a side that others leave of it, below which it is one of them


@dataclass(frozen=True)
class Source:
    """A channel as a hypothesis reads it: SI value = factor * recorded + offset."""

    channel: str
    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Reading:
    """A recording and a rig as one hypothesis reads them.

    Attributes
    ----------
    roles : role (``x``, ``p1``, ...) -> where it is read; a role that is absent is not recorded.
    rig : numbers of the rig by key, SI; None where it has none.
    said : keys of the rig that somebody wrote; the others are defaults and bind nobody.
    clock : true seconds for one recorded second.
    rotary : x is an angle.
    """

    moments: Moments
    roles: dict[str, Source]
    rig: dict[str, float | None]
    said: frozenset[str] = frozenset()
    clock: float = 1.0
    rotary: bool = False

    def has(self, *roles: str) -> bool:
        """Tell whether each role is recorded and varies."""
        return all(role in self.roles and (self.roles[role].channel, 0) in self.moments.place
                   for role in roles)

    def column(self, role: str, order: int = 0, scale: float = 1.0) -> np.ndarray:
        """Return ``scale`` times a derivative of a role as (m,) weights of the columns."""
        source, out = self.roles[role], np.zeros(len(self.moments.scale))
        place = self.moments.place[source.channel, order]
        by = np.sign(source.factor) if order == DIRECTION else source.factor / self.clock**order
        out[place] = scale * by * self.moments.scale[place]
        return out


@dataclass(frozen=True)
class Ratio:
    """Slope of one side on the other beside the rest, and their partial correlation.

    ``share`` is the part of the left side's variance that all of the right side explains.
    """

    slope: float
    rho: float
    share: float


def ratio(reading: Reading, left: np.ndarray, right: np.ndarray, *beside: np.ndarray
          ) -> Ratio | None:
    """Regress ``left`` on ``right`` and ``beside``; None where they do not vary on their own.

    Parameters
    ----------
    left, right, beside : (m,) weights of the columns.
    """
    sides = np.array([left, right, *beside])
    c = (sides @ reading.moments.gram @ sides.T).tolist()
    if not (0.0 < c[0][0] < inf and 0.0 < c[1][1] < inf):
        return None
    left_blur, right_blur = (sides[:2] ** 2 @ reading.moments.noise).tolist()
    whole, other = c[0][0], c[1][1]
    swept(c)
    if c[1][1] < DISTINCT * other or c[0][0] < 1e-12 * whole:
        return None
    # White noise of the sensors is no physics that is missing, and draws no slope to zero.
    signal = c[1][1] - right_blur
    if signal < NOISY * c[1][1]:
        return None
    explains = c[0][1] ** 2 / signal
    rest = max(c[0][0] - explains - left_blur, 1e-9 * c[0][0])
    rho = copysign(sqrt(explains / (explains + rest)), c[0][1])
    return Ratio(c[0][1] / signal, rho, min(max(1.0 - rest / whole, 0.0), 1.0))


def swept(c: list[list[float]]) -> None:
    """Take what the sides from the third on explain out of the products of the first two.

    ``c`` (k, k) products, changed in place: Gauss's elimination without a pivot that is nothing
    but rounding.  Plain floats: numpy takes ten times as long for so few.
    """
    own = [c[p][p] for p in range(len(c))]
    for p in range(len(c) - 1, 1, -1):
        pivot = c[p][p]
        if pivot <= COLLINEAR * own[p]:  # the other sides have explained it: rounding is left
            continue
        row = c[p]
        for i in range(p):
            f = c[i][p] / pivot
            if f:
                line = c[i]
                for j in range(p):
                    line[j] -= f * row[j]
