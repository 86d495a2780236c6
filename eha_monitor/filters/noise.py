"""How noisy each channel is, measured from the recording itself."""

from math import comb

import numpy as np

from eha_monitor.filters.results import NoiseEstimate
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
SPIKE_SPAN, SPIKE_SIGMAS = 10.0, 30.0

_LEVEL_OF = {"x": "position", "v": "velocity", "p1": "pressure", "p2": "pressure",
             "omega": "pump_speed", "force": "force", "temperature": "temperature"}


def quantum(values: np.ndarray) -> float:
    """Return the step of a quantised channel, or 0 where it is continuous.

    Parameters
    ----------
    values : (n,) finite samples.
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


def white_noise(values: np.ndarray) -> float:
    """Return the standard deviation of the white part of a channel, in its unit.

    Differences of rising order suppress the motion (a wave of omega T rad a sample falls by
    (omega T)^d) and add the noise up to sqrt(binomial(2d, d)); the first order that comes near
    the smallest answer is taken.  A trimmed mean keeps reversals and spikes out.

    Parameters
    ----------
    values : (n,) samples, NaN where missing.
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
