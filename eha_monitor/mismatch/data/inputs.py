"""What models run on: sampled inputs as curves, gapless stretches, windows of long recordings.

A model run over an hour costs minutes and gigabytes, and says no more than the informative parts
of it.  Before any model is run one pass over the recording finds how each window's motion excites
what the balances are made of, and by how much they are off there.  Of the windows chosen by that
the models themselves choose again (:mod:`name.before`).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from eha_monitor import ties
from eha_monitor.estimation.drive import JUMP, VISIBLE, largest_neighbour
from eha_monitor.estimation.rig_model import force_of
from eha_monitor.recordings.grid import filled
from eha_monitor.recordings.recording import Recording, rows_of
from eha_monitor.settings.monitor import Settings
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


BEGINNING, HEAD = 20, 8  # samples in which a first value is sought; of a line through x
BURN_IN = 0.15  # s at the start of each stretch in which the filter finds the state


@dataclass(frozen=True)
class Stretch:
    """One gapless stretch of a recording."""

    source: str  # names the recording
    start: float  # time of its first sample in its recording, s
    z: np.ndarray  # (n, N_OUTPUTS) measured x, v, p1, p2, omega (SI), NaN where missing
    u: np.ndarray  # (n, 4) input as cubics: x_d (m), pump speed (rad/s) or force (N)
    p1: np.ndarray  # (n,) pressures for a forced model, Pa
    p2: np.ndarray
    counted: np.ndarray  # (n,) bool, samples whose innovations are fitted
    held_out: np.ndarray  # (n,) bool, samples kept aside for the proof
    # (n,) share of the pressure difference that is taken from the sensors because the
    # input's course before the sample is not known, or None
    loose: np.ndarray | None = None
    # (n,) what the shaft has turned since the recording began, rad; None if nothing says it
    angle: np.ndarray | None = None

    @property
    def begins_at(self) -> float:
        """Angle of the shaft at the first sample, rad; 0 where nothing says it."""
        return 0.0 if self.angle is None else float(self.angle[0])

    def __len__(self) -> int:
        return len(self.z)

    @cached_property
    def first(self) -> np.ndarray:
        """Means of the first three values of each signal, (N_OUTPUTS,) SI; NaN without any."""
        heads = [column[np.isfinite(column)][:3] for column in self.z[:BEGINNING].T]
        return np.array([np.mean(head) if len(head) else np.nan for head in heads])

    @cached_property
    def rise(self) -> float:
        """Slope of a line through the first positions, m a sample; 0 where some are missing."""
        head, at = self.z[:HEAD, 0], np.arange(HEAD) - 0.5 * (HEAD - 1)
        return float(at @ head / (at @ at)) if len(head) == HEAD and np.isfinite(
            head).all() else 0.0

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


WINDOW = 8_000  # samples
LOOKED = 64_000  # samples that are looked at; a recording that is no longer is looked at whole
REACH_S = 0.01  # over which means, and from mean to mean slopes, are taken
TURNING = 0.05  # of the rms speed: below, a direction is half known


@dataclass(frozen=True)
class Rows:
    """Samples ``first`` to ``last`` of a recording, by its number."""

    recording: int
    first: int
    last: int


def windows_of(recordings: list[Recording], settings: Settings, most: int = LOOKED
               ) -> list[Rows] | None:
    """Return the most informative windows of a rig's recordings, in order.

    They have ``most`` samples together; None where all of the recordings have no more.
    """
    if sum(map(len, recordings)) <= most:
        return None
    windows, columns = [], []
    for number, recording in enumerate(recordings):
        for first in range(0, len(recording), WINDOW):
            last = min(first + WINDOW, len(recording))
            if last - first >= min(WINDOW // 2, len(recording)):
                windows.append(Rows(number, first, last))
                columns.append(columns_of(rows_of(recording, first, last), settings))
    names = sorted(set().union(*columns))
    tables = [np.column_stack([one.get(name, np.zeros(len(one["x"]))) for name in names])
              if one else np.zeros((0, len(names))) for one in columns]
    # In units of what a column comes to over the whole.
    scale = np.sqrt(sum((part**2).sum(axis=0) for part in tables) / max(sum(map(len, tables)), 1))
    grams = [(part / np.where(scale > 0, scale, 1.0)).T @ (part / np.where(scale > 0, scale, 1.0))
             for part in tables]
    return [windows[i] for i in most_informative(
        grams, [one.last - one.first for one in windows], most, WINDOW)]


def most_informative(grams: list[np.ndarray], lengths: list[int], most: int, size: int
                     ) -> list[int]:
    """Return the windows whose log det together is the largest, in order: D-optimal, greedy.

    ``grams`` : (k, k) products of a window's columns, of length 0 where it says nothing.
    ``lengths`` : samples of each, about ``size``; ``most`` of all that are chosen.
    """
    whole, chosen, samples = np.eye(max(map(len, grams))), [], 0
    left = [i for i, gram in enumerate(grams) if len(gram)]
    while left and samples + size // 2 <= most:
        known = [np.linalg.slogdet(whole + grams[i])[1] for i in left]
        best = left.pop(ties.largest(known, ties.GUESS))
        chosen.append(best)
        whole = whole + grams[best]
        samples += lengths[best]
    return sorted(chosen)


def columns_of(window: Recording, settings: Settings) -> dict[str, np.ndarray]:
    """Return what the balances are made of in a window, and what they leave; name -> (n,).

    Means over ``REACH_S``, in which a sensor's noise is small; nil where one is not there.
    """
    rig, channels = settings.rig, window.channels
    reach = max(1, round(REACH_S / window.sample_time))
    count = len(window) // reach
    step = reach * window.sample_time

    def coarse(values: np.ndarray) -> np.ndarray:
        return values[: count * reach].reshape(count, reach).mean(axis=1)

    if count < 4 or "x" not in channels:
        return {}
    x = coarse(channels["x"])
    v = np.gradient(x, step)
    a = np.gradient(v, step)
    found = {"x": x, "v": v, "a": a, "v|v|": v * np.abs(v),
             "turning": np.tanh(v / max(TURNING * _rms(v), 1e-12))}
    force = force_of(rig, channels)
    if force is not None:
        force = coarse(force)
        found |= {"force": force, "force_left": force - rig.mass * a - rig.viscous_damping * v}
    for name in ("p1", "p2"):
        if name in channels:
            found |= {name: coarse(channels[name]),
                      f"{name}'": np.gradient(coarse(channels[name]), step)}
    speed = speed_of(channels, rig)
    if speed is not None:
        speed = coarse(speed)
        found |= {"omega": speed, "omega'": np.gradient(speed, step)}
        if rig.pump_displacement and rig.area_1:
            found["flow_left"] = rig.pump_displacement * speed - rig.area_1 * v
        if "omega" in channels and rig.position_gain is not None and "x_d" in channels:
            wanted = rig.position_gain * (channels["x_d"] - channels["x"])
            found["drive_left"] = coarse(channels["omega"] - wanted)
    return {name: np.nan_to_num(values) for name, values in found.items()}


def _rms(values: np.ndarray) -> float:
    good = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(good**2))) if len(good) else 0.0
