"""A sampled input as a curve: what it did between its samples."""

import numpy as np

from eha_monitor.estimation.drive import JUMP, VISIBLE, largest_neighbour
from eha_monitor.recordings.grid import filled
from eha_monitor.settings.rig import Rig

CLOSED, OPEN, FORCED = 0, 1, 2  # input: x_d with the loop, pump speed, force
REACH = 25  # samples over which an input's own change is separated from its noise
GOVERNS = 10.0  # times the steps' variance
KEPT = 0.95  # share of the smallest squares that count: jumps and spikes aside
# A corner's bend is a change of slope, of first order in the sample time; a curve's is of second
# order, also where the curve begins.
CORNER = 20.0  # times the bends outside: a corner lies between two samples

JUMPED = 3.0**-0.5  # rms of what a jump at any time between two stamps adds to the mean
BEND = 1.0 / 24.0  # of the fourth difference: how far a cubic's mean may be off where it bends


def cubics(u: np.ndarray, sigma: float, sampled: bool = False) -> np.ndarray:
    """Return the input on each sample as a cubic of f = 0..1, (n, 4), constant term first.

    Lagrange's cubic through four samples where the signal is smooth; across a corner the
    parabola with the right mean (both branches extrapolated); a jump is held until its stamp.

    Parameters
    ----------
    u : (n,) finite samples.
    sigma : standard deviation of the noise on them, in their unit.
    sampled : the input is held over each sample, a digital drive.
    """
    return course_of(u, sigma, sampled)[0]


def course_of(u: np.ndarray, sigma: float, sampled: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return the cubics, and by how much the mean of each may be off, (n,) in the input's unit.

    Where a demand begins to move smoothly within a few samples, its course between two of them is
    not known, nor is the time between two stamps at which it jumps; a straight piece or a corner
    is taken as it is.
    """
    n = len(u)
    c = np.zeros((n, 4))
    c[:, 0] = u
    if sampled or n < 4:
        return c, np.zeros(n)
    p = np.concatenate([[2 * u[0] - u[1]], u, [2 * u[-1] - u[-2], 3 * u[-1] - 2 * u[-2]]])
    p_, p0, p1, p2 = p[:n], p[1 : n + 1], p[2 : n + 2], p[3 : n + 3]
    c[:, 1] = -p_ / 3 - p0 / 2 + p1 - p2 / 6
    c[:, 2] = (p_ - 2 * p0 + p1) / 2
    c[:, 3] = (-p_ + 3 * p0 - 3 * p1 + p2) / 6

    step = np.abs(p1 - p0)
    beside = largest_neighbour(step, 2)
    jump = step > JUMP * beside + VISIBLE * 2.0 * sigma
    near_jump = (np.roll(jump, 1) | np.roll(jump, -1)) & ~jump

    b0, b1 = p_ - 2 * p0 + p1, p0 - 2 * p1 + p2
    outside = np.abs(np.roll(b0, 1)) + np.abs(np.roll(b1, -1))
    corner = (np.abs(b0) + np.abs(b1) > CORNER * outside + VISIBLE * np.sqrt(12.0) * sigma) & (
        b0 * b1 >= -1e-3 * (b0**2 + b1**2)) & ~jump & ~near_jump
    corner &= np.abs(b0) + np.abs(b1) > 1e-9 * (np.abs(p0) + step)
    left, right = p0 - p_, p2 - p1
    with np.errstate(divide="ignore", invalid="ignore"):
        f = np.clip((p1 - right - p0) / (left - right), 0.0, 1.0)
    mean = p0 * f + left * f**2 / 2 + p1 * (1 - f) - right * (1 - f) ** 2 / 2
    bow = 6.0 * ((p0 + p1) / 2 - mean)
    near_corner = (np.roll(corner, 1) | np.roll(corner, -1)) & ~corner
    straight = near_jump | near_corner
    c[straight, 1], c[straight, 2], c[straight, 3] = (p1 - p0)[straight], 0.0, 0.0
    c[corner, 1] = (p1 - p0 - bow)[corner]
    c[corner, 2], c[corner, 3] = bow[corner], 0.0
    c[jump, 1:] = 0.0
    fourth = np.zeros(n)
    fourth[2:-2] = np.abs(np.diff(u, 4))
    off = BEND * np.maximum(fourth, np.append(fourth[1:], 0.0))
    off[np.convolve(corner | jump, np.ones(7), "same") > 0.5] = 0.0  # as far as five samples reach
    off[jump] = JUMPED * step[jump]
    return c, off


def present(u: np.ndarray, x: np.ndarray, longest: int) -> list[tuple[int, int]]:
    """Return (start, stop) of stretches in which input and position are there, gaps bridged."""
    good = np.flatnonzero(np.isfinite(u) & np.isfinite(x))
    if not len(good):
        return []
    cuts = np.flatnonzero(np.diff(good) > max(longest, 1) + 1)
    starts = [good[0], *good[cuts + 1]]
    stops = [*(good[cuts] + 1), good[-1] + 1]
    return list(zip(map(int, starts), map(int, stops), strict=True))


def noise_governs(parts: list[np.ndarray]) -> bool:
    """Tell whether a measured input's own noise outweighs its change from sample to sample.

    The change over one sample and over ``REACH`` gives the variances q of a wandering level's
    steps and r of the noise beside it.
    """
    def change(reach):
        squares = np.concatenate([(part[reach:] - part[:-reach]) ** 2 for part in parts
                                  if len(part) > reach] or [np.zeros(0)])
        squares = squares[np.isfinite(squares)]
        kept = int(KEPT * len(squares))
        return float(np.partition(squares, kept - 1)[:kept].mean()) if kept else 0.0

    near, far = change(1), change(REACH)
    q = max((far - near) / (REACH - 1), 0.0)
    r = 0.5 * (near - q)
    return bool(r > GOVERNS * q)


def speed_of(channels: dict[str, np.ndarray], rig: Rig) -> np.ndarray | None:
    """Return the pump's speed as it was measured, or as it was commanded, rad/s."""
    if "omega" in channels:
        return channels["omega"]
    if rig.position_gain is not None and "x_d" in channels:
        return rig.position_gain * (channels["x_d"] - channels["x"])
    return None


def angle_of(channels: dict, rig: Rig, dt: float) -> np.ndarray | None:
    """Return what the shaft has turned since the recording began, rad (n,); None if nothing says.

    The integral of the pump's speed, measured or that of the position loop.
    """
    speed = speed_of(channels, rig)
    if speed is None:
        return None
    speed = filled(speed) if np.isfinite(speed).any() else np.zeros(len(speed))
    return dt * np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))])
