"""Known errors of the sensors, undone on the recorded channels before anything else is done."""

import numpy as np

from eha_monitor.filters.results import NoiseEstimate
from eha_monitor.physics import signals as s

MOVED = 6.0  # standard deviations of a difference by which a position behind a play has moved
REACHES = (2, 4, 8)  # samples on each side over which that is looked for


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
    for name, scale, offset, drift in (
            ("p1", s.PRESSURE_SCALE_1, s.PRESSURE_OFFSET_1, s.PRESSURE_DRIFT_1),
            ("p2", s.PRESSURE_SCALE_2, s.PRESSURE_OFFSET_2, s.PRESSURE_DRIFT_2)):
        if name not in channels or not w[[scale, offset, drift, s.PRESSURE_DELAY]].any():
            continue
        values = earlier(channels[name], w[s.PRESSURE_DELAY] / dt)
        channels[name] = (values - w[offset] - w[drift] * time) / (1.0 + w[scale])
        noise[name] = scaled(noise[name], 1.0 + w[scale])
    if "x" in channels:
        if w[s.POSITION_SCALE]:
            channels["x"] = channels["x"] / (1.0 + w[s.POSITION_SCALE])
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
