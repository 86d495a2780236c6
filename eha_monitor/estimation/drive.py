"""Stage two's input: the demanded position, or the pump speed that effects have made of it."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.hold import Hold, both_ends, hold_of, instrument_of
from eha_monitor.estimation.modelled import contributions
from eha_monitor.physics import signals as s
from eha_monitor.physics.balances import drive_speed
from eha_monitor.physics.contributions import N_EFFECTS
from eha_monitor.physics.plant import shaft_speed
from eha_monitor.physics.signals import (
    DRIVE_LAG,
    MAX_MEMORY,
    N_CONTRIBUTIONS,
    N_SIGNALS,
    OMEGA,
    SLEW_LIMIT,
    SPEED,
)

PARTS = 8  # of a sample, in which drive and pump are followed
EDGE = 1e-9  # samples: just before a jump
DEMAND, LOOP_OPEN, SHAFT = range(3)  # kinds of a course
# Effects of the drive that x_d as the input of a closed loop does not show.
OPENING = (s.DRIVE_LAG, s.FEEDBACK_DELAY)


def opens_loop(w: np.ndarray, pump: np.ndarray) -> bool:
    """Tell whether modelled effects stand between the position error and the pump's flow.

    A gain, a late command and a scale error of the position that the drive reads too leave the
    loop linear; x_d stays the input then.
    """
    return bool(len(pump) or w[list(OPENING)].any() or np.isfinite(w[list(s.LIMITS)]).any()
                or (w[s.PLAY] and w[s.IN_LOOP]))


def loop_gain(theta: np.ndarray, w: np.ndarray) -> float:
    """Return pump speed over true position in the closed loop, rad/(s*m)."""
    shared = w[s.POSITION_SCALE] if w[s.IN_LOOP] else 0.0
    return theta[s.K_POS] * (1.0 + w[s.DRIVE_GAIN]) * (1.0 + shared)


class Course(NamedTuple):
    """What drive and pump make the input of.

    Attributes
    ----------
    kind : ``DEMAND`` x_d to x_d, late; ``LOOP_OPEN`` x_d and the position to the pump speed;
        ``SHAFT`` the shaft's speed.
    start, end : (n,) hold of x_d in m or of the shaft's speed in rad/s.
    seen : (n,) position as the drive reads it, m; ``lead`` samples later it is the present one.
    sampled : the drive reads once in a sample and holds.
    """

    kind: int
    start: np.ndarray
    end: np.ndarray
    seen: np.ndarray
    lead: float
    sampled: bool


@njit
def place_in(values, place):
    """Return a sampled channel at ``place`` samples, by a cubic through its neighbours."""
    n = values.shape[0]
    i = math.floor(place)
    f = place - i
    if i < 0 or i >= n or (f > 1e-9 and i + 1 >= n):
        return math.nan
    if f <= 1e-9:
        return values[i]
    here, after = values[i], values[i + 1]
    before = values[i - 1] if i > 0 else 2.0 * here - after
    later = values[i + 2] if i + 2 < n else 2.0 * after - here
    if math.isnan(before) or math.isnan(later):
        return here + f * (after - here)
    return (-f * (f - 1.0) * (f - 2.0) / 6.0 * before
            + (f + 1.0) * (f - 1.0) * (f - 2.0) / 2.0 * here
            - (f + 1.0) * f * (f - 2.0) / 2.0 * after + (f + 1.0) * f * (f - 1.0) / 6.0 * later)


@njit
def held(start, end, place):
    """Return an input that runs from ``start[i]`` to ``end[i + 1]``, at ``place`` samples."""
    n = start.shape[0]
    i = max(math.floor(place), 0)
    if i + 1 >= n:
        return math.nan
    f = max(place - i, 0.0)
    return start[i] + f * (end[i + 1] - start[i])


@njit
def wanted_at(course, place, late, theta, w):
    """Return the shaft speed that the drive wants at ``place`` samples, rad/s."""
    x = place_in(course.seen, place + course.lead)
    return shaft_speed(drive_speed(held(course.start, course.end, place - late), x, theta, w), w)


@njit
def lagging(omega, first, last, h, lag, keep, slew):
    """Return the speed after ``h`` s and its mean; the command runs from ``first`` to ``last``.

    The exact answer of the first-order lag to a ramp; ``keep`` is exp(-h / lag).
    """
    along = (last - first) / h * lag
    after = last - along + (omega - first + along) * keep
    if abs(after - omega) > slew * h:
        after = omega + math.copysign(slew * h, after - omega)
        return after, 0.5 * (omega + after)
    return after, 0.5 * (first + last) - along + (omega - first + along) * (1.0 - keep) * lag / h


@njit
def follow(course, dt, theta, pump, w, kept):
    """Follow drive and pump through all samples; return the input's line in each.

    Parameters
    ----------
    course : :class:`Course`.
    pump : places of the effects that add to the speed, whatever the pressure; none remembers.
    kept : (n, 1) written after each sample: the lagging speed; row 0 is where it starts, NaN for
        a fresh start.

    Returns
    -------
    start, end : (n,) the line of least squares, as those of the course; NaN where not known.
    """
    start, end, sampled = course.start, course.end, course.sampled
    n = start.shape[0]
    line_start, line_end = np.full(n, np.nan), np.full(n, np.nan)
    h = dt / PARTS
    row, c = np.zeros(N_SIGNALS), np.zeros(N_CONTRIBUTIONS)
    memory = np.zeros((N_EFFECTS + 1, MAX_MEMORY))
    lag, slew = w[DRIVE_LAG], w[SLEW_LIMIT]
    slow = lag > 0.0 or slew < np.inf
    keep = math.exp(-h / lag) if lag > 0.0 else 0.0
    omega = kept[0, 0]
    late = w[s.COMMAND_DELAY] / dt if course.kind != SHAFT else 0.0
    spread = (PARTS * PARTS - 1.0) / (12.0 * PARTS * PARTS)  # mean square of the parts' places
    for k in range(1, n):
        mean = tilt = 0.0
        for j in range(PARTS):
            along = (j + 0.5) / PARTS
            place = k - 1 + (0.0 if sampled else along)
            value = held(start, end, place - late)
            if course.kind == LOOP_OPEN:
                half = 0.0 if sampled else 0.5 / PARTS
                first = wanted_at(course, place - half, late, theta, w)
                last = wanted_at(course, place + half - EDGE, late, theta, w)
                value = 0.5 * (first + last)
                if slow:
                    if math.isnan(omega):
                        omega = first
                    omega, value = lagging(omega, first, last, h, lag, keep, slew)
            if len(pump) > 0:
                row[OMEGA] = value
                contributions(row, theta, pump, memory, c)
                value += c[SPEED]
            mean += value / PARTS
            tilt += ((j + 0.5) / PARTS - 0.5) * value / PARTS
        tilt /= spread
        line_start[k - 1], line_end[k] = mean - 0.5 * tilt, mean + 0.5 * tilt
        if math.isnan(mean):
            omega = math.nan
        kept[k, 0] = omega
    return line_start, line_end


@dataclass(frozen=True)
class DriveInput:
    """Stage two's input, and what the drive remembers after each sample, (n, 1)."""

    hold: Hold
    kept: np.ndarray


def drive_input(model, recorded: dict, channels: dict, noise: dict, dt: float,
                started: np.ndarray | None = None) -> DriveInput:
    """Return stage two's input.

    x_d in m where the loop is part of the model; the pump speed in rad/s where it is not: the
    measured one, or the one that the drive makes of x_d - x.  Whether the drive reads the
    recorded x or a cleaner one is not known, so the noise of x counts as the input's own.

    Parameters
    ----------
    model : :class:`rig_model.RigModel`.
    recorded, channels : as the sensors showed them, and with their known errors undone.
    noise : of ``channels``.
    started : what the drive remembers at the first sample, a row of ``kept``.
    """
    rig, w = model.settings.rig, model.circuit
    n = len(channels["x"])
    kept = np.full((n, 1), np.nan)
    if started is not None:
        kept[0] = started
    commanded = rig.position_gain is not None and "x_d" in channels
    sampled = model.settings.command_hold == "sampled"
    plain = not (len(model.pump) or model.opened or w[s.COMMAND_DELAY])
    seen, lead = channels["x"], 0.0
    if commanded and model.loop:
        shared = w[s.POSITION_SCALE] if w[s.IN_LOOP] else 0.0
        hold, kind = hold_of(channels["x_d"] / (1.0 + shared), 0.0), DEMAND
        done = plain
    elif "omega" in channels and (model.opened or not commanded):
        sigma = noise["omega"].value
        sampled = sampled and not w[s.DRIVE_LAG]  # a slow shaft turns in between
        hold = hold_of(channels["omega"], sigma, sampled=sampled).with_noise(sigma**2)
        kind, done = SHAFT, plain or not len(model.pump)
    else:
        gain = loop_gain(model.theta, w)
        noise_variance = (abs(gain) * noise["x"].value) ** 2
        if plain and sampled:
            hold = hold_of(gain * (channels["x_d"] - channels["x"]), 0.0, sampled=True)
            return DriveInput(hold.with_noise(noise_variance), kept)
        hold = hold_of(channels["x_d"], 0.0)
        hold = hold._replace(variance=gain**2 * hold.variance + noise_variance)
        in_loop, kind, done = bool(w[s.IN_LOOP]), LOOP_OPEN, False
        seen = recorded["x"] if in_loop else channels["x"]
        lead = ((w[s.POSITION_DELAY] if in_loop else 0.0) - w[s.FEEDBACK_DELAY]) / dt
    if done:
        return DriveInput(hold, kept)
    start, end = follow(Course(kind, hold.start, hold.end, seen, lead, sampled), dt, model.theta,
                        model.pump, w, kept)
    variance = hold.variance
    if kind != SHAFT:  # what is uncertain about x_d comes late as well
        whole = int(np.ceil(w[s.COMMAND_DELAY] / dt))
        for shift in {whole, max(whole - 1, 0)} - {0}:
            moved = np.concatenate([np.full(shift, variance[0]), variance[:-shift]])[:n]
            variance = np.maximum(variance, moved)
    ends = [np.where(np.isfinite(one), one, other) for one, other in ((start, end), (end, start))]
    clean = ends if kind == DEMAND else map(instrument_of, ends)
    return DriveInput(Hold(start, end, variance, both_ends(*clean)), kept)
