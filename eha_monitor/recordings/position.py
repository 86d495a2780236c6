"""The step of a position, and what no piston does: dropping out, jumping, breaking into noise.

A mass needs several samples to gain speed, so one step of a position among steps a tenth of it is
no motion.  Away and soon back again the sensor has dropped out; away for good it has lost counts,
or rows are missing.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import median_filter

from eha_monitor.recordings.columns import IN_MEMORY, stretches
from eha_monitor.recordings.recording import Recording

SLOWEST = 0.02  # s: between samples farther apart a piston may start and stop
REACH = 4  # steps on either side that a step is seen among
LONE, SIGMAS = 10.0, 30.0  # times the others, and the noise
FAR = 0.05  # of the motion: stick and slip jumps by less
# How long a drop-out lasts, s, and how many of the steps about it may be of others: one beside
# another is seen when that one is out, and what lies between two is longer.
PASSES = ((0.0, 3), (0.0, 3), (0.1, 3), (2.0, 2))
BLOCK_S, FEWEST = 0.1, 16  # s and least samples over which noise is taken
NOISIER, LOUD = 30.0, 0.02  # times what is usual, and of the motion
SELDOM = 0.4  # of the blocks: what is usual is no fault of a moment
ORDER = 3  # of the differences: they leave little of a motion


def quantum(values: np.ndarray) -> float:
    """Return the step of a quantised channel, or 0 where it is continuous.

    ``values`` : (n,) finite samples.
    """
    steps = np.abs(np.diff(values[:20000]))
    scale = np.abs(values).max(initial=0.0)
    steps = steps[steps > 1e-12 * scale]
    if len(steps) < 8:
        return 0.0
    smallest = steps.min()
    if steps.max() > 1e6 * smallest:
        return 0.0
    off = np.abs(steps / smallest - np.round(steps / smallest))
    return float(smallest) if (off < 0.02).all() and (steps < 1.5 * smallest).any() else 0.0


class Astray(NamedTuple):
    """Where a position is not the piston's.

    Attributes
    ----------
    out, noisy : (m, 2) first sample and one behind the last of each stretch.
    jumps : (j,) sample before each jump that is not undone.
    size : m, the largest jump; ``noise`` : rms of the loudest stretch over what is usual.
    """

    out: np.ndarray
    noisy: np.ndarray
    jumps: np.ndarray
    size: float
    noise: float

    def mask(self, n: int) -> np.ndarray:
        """Return which of ``n`` samples are no position, (n,) bool."""
        found = np.zeros(n, dtype=bool)
        for first, last in (*self.out, *self.noisy):
            found[first:last] = True
        return found


NONE = Astray(np.zeros((0, 2), dtype=int), np.zeros((0, 2), dtype=int), np.zeros(0, dtype=int),
              0.0, 1.0)


def noise_of(values: np.ndarray) -> float:
    """Return the standard deviation of the white part of a channel, by its second differences."""
    bends = np.abs(np.diff(values, 2))
    bends = bends[np.isfinite(bends)]
    return float(np.median(bends)) / (0.6745 * 6.0**0.5) if len(bends) else 0.0


def astray(x: np.ndarray, dt: float) -> Astray:
    """Return where a position is not that of a piston.

    Parameters
    ----------
    x : (n,) m or rad, NaN where missing.
    dt : sample time, s; none is found where it is more than ``SLOWEST``.
    """
    there = np.flatnonzero(np.isfinite(x))
    if dt > SLOWEST or len(there) < 4 * FEWEST:
        return NONE
    values, beside = x[there].copy(), np.diff(there) == 1  # in a gap it may have moved
    travel = float(np.ptp(median_filter(values, 2 * REACH + 1)))
    least = max(SIGMAS * noise_of(values), FAR * travel)
    gone, sizes, stays = np.zeros(len(values), dtype=bool), [0.0], []
    for away, aside in PASSES:
        at = _jumps(values, least, aside)
        out, stays = _drop_outs(values, at[beside[at]], max(round(away / dt), REACH))
        for first, last in out:
            sizes.append(abs(values[first] - values[first - 1]))
            values[first - 1:last + 1] = np.linspace(values[first - 1], values[last],
                                                     last - first + 2)
            gone[first:last] = True
    noisy, louder = _bursts(values, dt, travel)
    stays = [k for k in stays if not any(first <= k + 1 <= last for first, last in noisy)]
    sizes += [abs(values[k + 1] - values[k]) for k in stays]
    ends = np.append(there, len(x))
    return Astray(ends[stretches(gone)], ends[noisy], there[np.array(stays, dtype=int)],
                  float(max(sizes)), louder)


def _drop_outs(values: np.ndarray, at: np.ndarray, longest: int
               ) -> tuple[list[tuple[int, int]], list[int]]:
    """Return the stretches between a jump and the one that undoes it, and the other jumps."""
    out, stays = [], []
    while len(at):
        first, at = int(at[0]), at[1:]
        away = np.abs(values[first + 1:first + 2 + longest] - values[first])
        back = int(np.argmax(away < 0.5 * away[0]))  # 0: it does not come back
        if back and first + back in at:
            out.append((first + 1, first + 1 + back))
            at = at[at > first + back]
        else:
            stays.append(first)
    return out, stays


def trusted(recording: Recording) -> Recording:
    """Return a recording whose position has no value where it is not the piston's.

    The samples of a long one (``sample_of``) are looked at where they are taken.
    """
    x, dt = recording.channels.get("x"), recording.sample_time
    if x is None or len(x) > IN_MEMORY:
        return recording
    away = astray(x, dt).mask(len(x))
    return recording if not away.any() else replace(
        recording, channels={**recording.channels, "x": np.where(away, np.nan, x)})


def _jumps(values: np.ndarray, least: float, aside: int) -> np.ndarray:
    """Return the samples before steps that stand alone, but for some others ``aside``, (j,)."""
    steps = np.abs(np.diff(values))
    at = np.flatnonzero(steps > least)
    if not len(at):
        return at
    windows = sliding_window_view(np.pad(steps, REACH), 2 * REACH + 1)[at].copy()
    windows[:, REACH] = 0.0
    others = np.partition(windows, -1 - aside, axis=1)[:, -1 - aside]
    return at[steps[at] > LONE * others]


def _bursts(values: np.ndarray, dt: float, travel: float) -> tuple[np.ndarray, float]:
    """Return the stretches in which a position is far noisier than usual, (m, 2), and how much."""
    size = max(round(BLOCK_S / dt), FEWEST)
    rough = np.diff(values, ORDER)
    count = len(rough) // size
    if count < 4:
        return NONE.noisy, 1.0
    level = np.sqrt(np.median(rough[: count * size].reshape(count, size) ** 2, axis=1))
    usual = max(float(np.median(level)), 1e-300)
    loud = (level > NOISIER * usual) & (level > LOUD * travel)
    if not loud.any() or loud.mean() > SELDOM:
        return NONE.noisy, 1.0
    # A burst may begin and end within the blocks beside those that it fills.
    wide = np.clip((stretches(loud) + np.array([-1, 1])) * size, 0, len(values))
    return wide, float(level.max() / usual)
