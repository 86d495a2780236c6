"""Stage two's input: demanded position, or pump speed that effects have made of it, and its hold.

The hold is what a sampled input did between its samples, and how uncertain that is.
"""

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.modelled import contributions
from eha_monitor.physics import signals as s
from eha_monitor.physics.balances import drive_speed
from eha_monitor.physics.contributions import N_EFFECTS
from eha_monitor.physics.plant import shaft_speed

JUMP = 20.0  # times the neighbouring steps: a jump, held until its stamp
KINK = 4.0  # times the neighbouring bends: a corner, which linear interpolation already meets
REMAINDER = 1.0 / 20.0  # of the fourth difference: interpolation error at corners (1/24) and
# on waves (11/720), so that the filters know where their input is uncertain
VISIBLE = 6.0  # standard deviations by which a fourth difference must rise above the noise
ROOT_70 = np.sqrt(70.0)
REACHES = (2, 4, 8, 16, 24)  # samples on both sides over which a noisy speed is smoothed
LONGEST = REACHES[-1]
SILENT = 12.0  # rad of the resonance in a reach: a longer one takes of the signal, not of noise
CONFIDENT = 1.5  # standard deviations within which a longer mean must agree with all shorter ones


class Hold(NamedTuple):
    """An input that runs linearly from ``start[k-1]`` to ``end[k]`` in the sample before k.

    ``variance`` (n,) is that of the input over this sample beyond the sensor's noise; ``slow``
    (n,) is the variance that remains, each sample its own, where an input was smoothed: it moves
    the position and does not make the oil column ring.
    """

    start: np.ndarray
    end: np.ndarray
    variance: np.ndarray
    slow: np.ndarray

    def part(self, rows: slice) -> "Hold":
        """Return the hold of these samples."""
        return Hold(*(values[rows] for values in self))

    def with_noise(self, variance: float) -> "Hold":
        """Add a sensor's variance to that of the course between the samples."""
        return self._replace(variance=self.variance + variance)


def smoothing_weights(reach: int) -> np.ndarray:
    """Return the weights of a local quartic's middle over +-``reach`` samples, (2 reach + 1,).

    Biweight, so that the response falls without side lobes (Cleveland 1979); a quintic passes
    unchanged.  With a parabola the bends of a chirp were lost, and beta_e with them.
    """
    place = np.arange(-reach, reach + 1)
    weight = (1.0 - (place / (reach + 1.0)) ** 2) ** 2
    powers = np.vander(place / reach, 5, increasing=True)
    return np.linalg.solve(powers.T @ (powers * weight[:, None]), powers.T * weight)[0]


WEIGHTS = {reach: smoothing_weights(reach) for reach in REACHES}


def smoothed(u: np.ndarray, sigma: float, longest: float = LONGEST
             ) -> tuple[np.ndarray, np.ndarray]:
    """Return a noisy input without the noise that its neighbours know of, and the reach; (n,).

    The measured speed drives the model, so its noise is in the prediction and in what multiplies
    the parameter alike, and the parameter is drawn aside: at 1 rad/s of noise beta_e by 27 %
    (errors in variables, Soderstrom 2018).  A shaft's speed is smooth and its noise is not.  Each
    sample takes the longest window whose mean still agrees with all shorter ones
    (intersection of confidence intervals, Goldenshluger & Nemirovski 1997), so a jump stays.

    Parameters
    ----------
    u : (n,) samples, NaN where missing.
    sigma : standard deviation of the noise on u.
    longest : reach, samples.
    """
    reach, there = np.zeros(len(u), dtype=int), np.isfinite(u)
    if not sigma > 0.0 or not there.any():
        return u, reach
    from scipy.ndimage import correlate1d  # a fifth of the start of a command

    number = np.arange(len(u))
    whole = np.interp(number, number[there], u[there])
    found, low, high = u.copy(), whole - CONFIDENT * sigma, whole + CONFIDENT * sigma
    agrees, to_end = there.copy(), np.minimum(number, number[::-1])
    for longer, weights in WEIGHTS.items():
        if longer > longest:
            break
        mean = correlate1d(whole, weights)
        spread = CONFIDENT * sigma * math.sqrt(weights @ weights)
        low, high = np.maximum(low, mean - spread), np.minimum(high, mean + spread)
        agrees &= (low <= high) & (to_end >= longer)
        found[agrees], reach[agrees] = mean[agrees], longer
    return found, reach


def speed_hold(omega: np.ndarray, sigma: float, ringing: float, sampled: bool) -> Hold:
    """Return the hold of a measured pump speed.

    Parameters
    ----------
    omega, sigma : (n,) samples and standard deviation of their noise, rad/s.
    ringing : resonance of the oil column, rad a sample: the share of the noise that passes the
        smoothing there makes the model ring, the other moves its position alone.
    sampled : see :func:`hold_of`.
    """
    clean, reach = smoothed(omega, sigma, max(SILENT / max(ringing, 1e-9), REACHES[0]))
    passes = np.ones(len(omega))
    for longer, weights in WEIGHTS.items():
        angle = min(ringing, math.pi) * np.arange(-longer, longer + 1)
        passes[reach == longer] = min((weights @ np.cos(angle)) ** 2, 1.0)
    hold = hold_of(clean, sigma, sampled=sampled)
    return hold._replace(variance=hold.variance + passes * sigma**2,
                         slow=(1.0 - passes) * sigma**2)


def largest_neighbour(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the largest value within ``reach`` samples, itself left out; (n,), none negative."""
    n = len(values)
    padded = np.zeros(n + 2 * reach)
    padded[reach : reach + n] = values
    largest = padded[:n]
    for d in range(1 - reach, reach + 1):
        if d:
            largest = np.maximum(largest, padded[reach + d : reach + d + n])
    return largest


def hold_of(u: np.ndarray, sigma: float, sampled: bool = False, kinked: bool = False) -> Hold:
    """Return the hold of a sampled input.

    Linear interpolation of a sampled wave loses (omega T)^2/12 of it; adding minus a twelfth of
    the second difference makes the hold fourth order: at 472 rad/s and 1 ms 0.07 % is lost
    instead of 1.9 %.  Corners stay as they are.  A jump is held until its stamp.

    Parameters
    ----------
    u : (n,) samples, NaN where missing.
    sigma : standard deviation of the sensor's noise on u.
    sampled : the input is held over each sample (a digital drive).
    kinked : the signal has a corner at each sample (a pressure behind a digital drive): nothing
        is corrected, and a twelfth of the second difference counts as uncertain.
    """
    n = len(u)
    if sampled or n < 5:
        end = np.concatenate([u[:1], u[:-1]]) if sampled else u
        return Hold(u, end, np.zeros(n), np.zeros(n))
    step = np.zeros(n)
    step[1:] = u[1:] - u[:-1]
    size = np.abs(step)
    jump = size > JUMP * largest_neighbour(np.fmax(size, 0.0), 2) + VISIBLE * 2.0 * sigma
    bend = np.zeros(n)
    bend[1:-1] = u[2:] - 2 * u[1:-1] + u[:-2]
    fourth = np.zeros(n)
    fourth[2:-2] = u[4:] - 4 * u[3:-1] + 6 * u[2:-2] - 4 * u[1:-3] + u[:-4]
    fourth, bent = np.fmax(np.abs(fourth), 0.0), np.fmax(np.abs(bend), 0.0)  # NaN to 0
    rough = fourth > VISIBLE * ROOT_70 * sigma
    corner = (bent > KINK * largest_neighbour(bent, 2)) & rough
    beside = jump.copy()
    if jump.any():
        beside |= np.roll(jump, -1) | np.roll(jump, 1)
    correction = np.where(corner | beside | ~np.isfinite(bend), 0.0, bend / 12.0)
    start = u - correction
    end = np.where(jump, np.concatenate([start[:1], start[:-1]]), start)
    unsure = np.where(rough, REMAINDER * fourth, 0.0)
    if kinked:
        start, end = u, np.where(jump, np.concatenate([u[:1], u[:-1]]), u)
        visible = bent > VISIBLE * np.sqrt(6.0) * sigma
        unsure = np.maximum(unsure, np.where(visible, bent / 12.0, 0.0))
    unsure[1:] = np.maximum(unsure[1:], unsure[:-1])
    unsure[beside] = 0.0
    unsure[jump] = 0.3 * np.abs(step[jump])
    return Hold(start, end, unsure**2, np.zeros(n))


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
    row, c = np.zeros(s.N_SIGNALS), np.zeros(s.N_CONTRIBUTIONS)
    memory = np.zeros((N_EFFECTS + 1, s.MAX_MEMORY))
    lag, slew = w[s.DRIVE_LAG], w[s.SLEW_LIMIT]
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
                row[s.OMEGA] = value
                contributions(row, theta, pump, memory, c)
                value += c[s.SPEED]
            mean += value / PARTS
            tilt += ((j + 0.5) / PARTS - 0.5) * value / PARTS
        tilt /= spread
        line_start[k - 1], line_end[k] = mean - 0.5 * tilt, mean + 0.5 * tilt
        if math.isnan(mean):
            omega = math.nan
        kept[k, 0] = omega
    return line_start, line_end


def takes_speed(model, channels: Collection[str]) -> bool:
    """Tell whether stage two's input is the measured speed: no loop, or the drive's effects."""
    commanded = model.settings.rig.position_gain is not None and "x_d" in channels
    return "omega" in channels and (model.opened or not commanded)


def drive_input(model, recorded: dict, channels: dict, noise: dict, dt: float,
                started: np.ndarray | None = None) -> tuple[Hold, np.ndarray]:
    """Return stage two's input, and what the drive remembers after each sample, (n, 1).

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
    elif takes_speed(model, channels):
        sigma = noise["omega"].value
        hold = speed_hold(channels["omega"], sigma, model.ringing * dt, model.held)
        kind, done = SHAFT, plain or not len(model.pump)
    else:
        gain = loop_gain(model.theta, w)
        noise_variance = (abs(gain) * noise["x"].value) ** 2
        if plain and sampled:
            hold = hold_of(gain * (channels["x_d"] - channels["x"]), 0.0, sampled=True)
            return hold.with_noise(noise_variance), kept
        hold = hold_of(channels["x_d"], 0.0)
        hold = hold._replace(variance=gain**2 * hold.variance + noise_variance)
        in_loop, kind, done = bool(w[s.IN_LOOP]), LOOP_OPEN, False
        seen = recorded["x"] if in_loop else channels["x"]
        lead = ((w[s.POSITION_DELAY] if in_loop else 0.0) - w[s.FEEDBACK_DELAY]) / dt
    if done:
        return hold, kept
    start, end = follow(Course(kind, hold.start, hold.end, seen, lead, sampled), dt, model.theta,
                        model.pump, w, kept)
    variance = hold.variance
    if kind != SHAFT:  # what is uncertain about x_d comes late as well
        whole = int(np.ceil(w[s.COMMAND_DELAY] / dt))
        for shift in {whole, max(whole - 1, 0)} - {0}:
            moved = np.concatenate([np.full(shift, variance[0]), variance[:-shift]])[:n]
            variance = np.maximum(variance, moved)
    return Hold(start, end, variance, hold.slow), kept
