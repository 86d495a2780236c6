"""Noise of each channel, measured from the recording; wild samples and known errors undone."""

from math import comb

import numpy as np

from eha_monitor.estimation.results import NoiseEstimate
from eha_monitor.physics import signals as s
from eha_monitor.recordings.position import quantum
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import NoiseLevels

ORDERS = (1, 2, 3, 5, 7)
NEAR = 1.03  # an order whose answer is this close to the smallest is as good, and steadier
KEPT = 0.9  # share of the smallest squares that is averaged: reversals and spikes fall out
# Mean of the smallest 90 % of squared normal deviates.
KEPT_MEAN = 0.6230155
SMALLEST_SAMPLES = 64
FLOOR = 5e-6
SMALLEST = 1e-12  # in the channel's unit: what stands still has a variance that can be divided by
MOVED = 6.0  # standard deviations of a difference by which a position behind a play has moved
REACHES = (2, 4, 8)  # samples on each side over which that is looked for
SPIKE_SPAN, SPIKE_SIGMAS = 10.0, 30.0

_LEVEL_OF = {"x": "position", "v": "velocity", "p1": "pressure", "p2": "pressure",
             "omega": "pump_speed", "force": "force", "temperature": "temperature"}


def white_noise(values: np.ndarray) -> float:
    """Return the standard deviation of the white part of a channel, in its unit.

    Differences of rising order suppress the motion (a wave of omega T rad a sample falls by
    (omega T)^d) and add the noise up to sqrt(binomial(2d, d)); the first order that comes near
    the smallest answer is taken.  A trimmed mean keeps reversals and spikes out.

    ``values`` : (n,) samples, NaN where missing.
    """
    answers = []
    finite = np.isfinite(values)
    # A slower channel among faster ones: its own samples are evenly spaced.
    if finite.any() and finite.mean() < 0.7:
        values = values[finite]
    for order in ORDERS:
        d = np.diff(values, order)
        d = d[np.isfinite(d)]
        if len(d) < SMALLEST_SAMPLES - order:
            continue
        squares = d * d
        kept = max(1, int(KEPT * len(squares)))
        mean = np.partition(squares, kept - 1)[:kept].mean()
        answers.append(np.sqrt(mean / KEPT_MEAN / comb(2 * order, order)))
    if not answers:
        return np.nan
    best = next(answer for answer in answers if answer <= NEAR * min(answers))
    step = quantum(values[np.isfinite(values)])
    return float(max(best, step / np.sqrt(12.0)))


def noise_levels(recording: Recording, levels: NoiseLevels) -> dict[str, NoiseEstimate]:
    """Return the noise of each recorded channel, measured unless the config says ``fixed``.

    No channel is taken to be better than ``FLOOR`` of its range (17.6 bits): a noise-free
    recording of a simulator would make every nanometre of difference a mismatch.
    """
    found = {}
    for name, values in recording.channels.items():
        if name not in _LEVEL_OF:
            continue
        level = getattr(levels, _LEVEL_OF[name])
        measured = np.nan if levels.fixed else white_noise(values)
        if np.isfinite(measured):
            span = np.subtract(*np.nanpercentile(values, [99.5, 0.5]))  # wild samples aside
            floor = FLOOR * span if span > 0 else level
            found[name] = NoiseEstimate(max(measured, floor, SMALLEST), True)
        else:
            found[name] = NoiseEstimate(level if level > 0 else SMALLEST, False)
    return found


def without_spikes(channels: dict[str, np.ndarray], noise: dict[str, NoiseEstimate],
                   counted: slice | None = None
                   ) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Return the channels with lone wild samples set to NaN, and how many ``counted`` ones were.

    A sample is wild when it lies far outside what its two neighbours on each side span: ten
    times that span and thirty sigmas.  A step is none: its neighbours span it.
    """
    cleaned, counts = {}, {}
    for name, values in channels.items():
        cleaned[name] = values
        if name not in noise or name == "temperature" or len(values) < 5:
            continue
        before, inner = (values[:-4], values[1:-3]), values[2:-2]
        after = values[3:-1], values[4:]
        high = np.maximum(np.maximum(*before), np.maximum(*after))
        low = np.minimum(np.minimum(*before), np.minimum(*after))
        wild = np.zeros(len(values), dtype=bool)
        with np.errstate(invalid="ignore"):
            wild[2:-2] = np.abs(inner - 0.5 * (high + low)) > (
                SPIKE_SPAN * (high - low) + SPIKE_SIGMAS * noise[name].value)
        if wild.any():
            cleaned[name] = np.where(wild, np.nan, values)
            count = int(wild[counted or slice(None)].sum())
            if count:
                counts[name] = count
    return cleaned, counts


PRESSURE_ERRORS = {"p1": (s.PRESSURE_SCALE_1, s.PRESSURE_OFFSET_1, s.PRESSURE_DRIFT_1),
                   "p2": (s.PRESSURE_SCALE_2, s.PRESSURE_OFFSET_2, s.PRESSURE_DRIFT_2)}


def true_pressure(shown, name: str, w: np.ndarray, time):
    """Return what a pressure is where its sensor shows ``shown``, Pa: no scale, offset, drift.

    Parameters
    ----------
    shown, time : Pa, and s since the recording began; numbers or (n,).
    name : ``p1`` or ``p2``; w : circuit of the model.
    """
    scale, offset, drift = PRESSURE_ERRORS[name]
    return (shown - w[offset] - w[drift] * time) / (1.0 + w[scale])


def true_position(shown, w: np.ndarray):
    """Return the position at which the sensor shows ``shown`` behind its delay and its play, m.

    The inverse of :func:`physics.plant.shown_position`.
    """
    return shown / (1.0 + w[s.POSITION_SCALE])


def undo_sensors(channels: dict[str, np.ndarray], noise: dict[str, NoiseEstimate], w: np.ndarray,
                 time: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, NoiseEstimate]]:
    """Return the channels and their noise as right sensors would have shown them.

    Scale, offset and drift are taken out; a late channel is read from the samples that came
    later, between samples by a cubic, so that the last ones are missing.  A position behind a
    play is known only while the sensor moves; elsewhere it is missing.

    Parameters
    ----------
    channels : channel -> (n,) SI.
    w : circuit of the modelled effects.
    time : (n,) s since the start of the record.
    """
    channels, noise = dict(channels), dict(noise)
    dt = time[1] - time[0] if len(time) > 1 else 1.0
    for name, errors in PRESSURE_ERRORS.items():
        if name not in channels or not w[[*errors, s.PRESSURE_DELAY]].any():
            continue
        values = earlier(channels[name], w[s.PRESSURE_DELAY] / dt)
        channels[name] = true_pressure(values, name, w, time)
        noise[name] = scaled(noise[name], 1.0 + w[errors[0]])
    if "x" in channels:
        if w[s.POSITION_SCALE]:
            channels["x"] = true_position(channels["x"], w)
            noise["x"] = scaled(noise["x"], 1.0 + w[s.POSITION_SCALE])
        if w[s.PLAY]:
            channels["x"] = before_play(channels["x"], w[s.PLAY], noise["x"].value)
        channels["x"] = earlier(channels["x"], w[s.POSITION_DELAY] / dt)
    return channels, noise


def scaled(noise: NoiseEstimate, factor: float) -> NoiseEstimate:
    """Return the noise of a channel that is divided by ``factor``."""
    return NoiseEstimate(noise.value / factor, noise.measured)


def earlier(values: np.ndarray, samples: float) -> np.ndarray:
    """Return the values that the channel shows so many samples later; NaN where it has ended."""
    if samples == 0.0:
        return values
    whole = int(np.floor(samples + 1e-9))
    f = max(samples - whole, 0.0)
    padded = np.concatenate([values[:1], values, np.full(whole + 3, np.nan)])
    n = len(values)
    rows = [padded[whole + d : whole + d + n] for d in range(4)]  # samples -1, 0, 1, 2 of it
    if f < 1e-9:
        return rows[1]
    weights = (-f * (f - 1) * (f - 2) / 6, (f + 1) * (f - 1) * (f - 2) / 2,
               -(f + 1) * f * (f - 2) / 2, (f + 1) * f * (f - 1) / 6)
    return sum(w * row for w, row in zip(weights, rows, strict=True))


def before_play(values: np.ndarray, play: float, sigma: float) -> np.ndarray:
    """Return the position before a play of width ``play``, NaN while the sensor stands still."""
    n = len(values)
    least = MOVED * np.sqrt(2.0) * sigma
    up, down = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    for reach in REACHES:
        padded = np.pad(values, reach, constant_values=np.nan)
        back, ahead = values - padded[:n], padded[2 * reach :] - values
        with np.errstate(invalid="ignore"):
            up |= (back > least) & (ahead > least)
            down |= (back < -least) & (ahead < -least)
    return np.where(up, values + 0.5 * play, np.where(down, values - 0.5 * play, np.nan))
