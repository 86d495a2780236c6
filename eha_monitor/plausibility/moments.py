"""Smoothed channels, their derivatives, and the products of all of them.

Every relation that is checked is linear in the channels and their derivatives, and every mistake
that is tried (a sign, a unit, a swap, a clock) only scales or renames them.  So the recording is
gone through once; a hypothesis then costs a small matrix, whatever the recording's length.
"""

from dataclasses import dataclass

import numpy as np

from eha_monitor.recordings.columns import blocks, let_go, spans_of
from eha_monitor.recordings.grid import filled
from eha_monitor.recordings.recording import Recording, sample_of

LONGEST = 32_768  # samples that are looked at: those of the piece with the most motion
SHORTEST = 64
BRIDGED = 5  # samples of a gap that is filled in
PRESENT = 0.5  # share of a stretch that a channel must have
MEAN_OF = 0.1  # s
ORDERS = 3  # the channel and two derivatives
DIRECTION = 3  # place of the smoothed sign of the first derivative, after the derivatives
SLOW = 0.1  # of the rms speed: below, the direction is not known
BAND = 0.2  # of the sampling rate: what lies above is not looked at
# Share of the acceleration's power that the position's noise may be in the band that is used.
NOISE_SHARE = 0.04
LEAST_BAND = 8  # bins
MOVES = 10.0  # standard deviations of the noise: below, nothing moves
MARGIN = 0.02  # of a stretch is left out at each end, where smoothing has one side only
OVERFLOWS = 1e100  # no signal; its square is still a number
AWAY = 0.01  # of the motion: nearer to where it begins or ends, the piston may stand at a stop
STANDS = 0.25  # of the samples at both ends: less of a stand weighs little
SAME = 1e-9  # of its spread: two channels no further apart are one and the same


@dataclass(frozen=True)
class Level:
    """Where a channel lies: 1st, 50th and 99th percentile, and its largest size, SI."""

    low: float
    middle: float
    high: float
    largest: float

    @property
    def span(self) -> float:
        """Difference of the outer percentiles, SI."""
        return self.high - self.low


@dataclass(frozen=True)
class Moments:
    """What the relations need to know of a recording."""

    # (channel, order of derivative or ``DIRECTION``) -> column; only channels that vary
    place: dict[tuple[str, int], int]
    gram: np.ndarray  # (m, m) mean products of the columns, each centred and divided by ``scale``
    scale: np.ndarray  # (m,) standard deviation of each column, SI
    # (m,) mean of each column over its standard deviation; 0 for positions, whose zero is anywhere
    mean: np.ndarray
    noise: np.ndarray  # (m,) share of each column's variance that is the sensor's white noise
    levels: dict[str, Level]  # by channel, of the raw samples
    same: tuple[tuple[str, str], ...]  # pairs of channels that hold the same numbers
    sample_time: float  # s


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # of values that are no signals
def moments_of(recording: Recording) -> Moments:
    """Return the moments of a recording; no columns where it is too short or nothing moves."""
    levels = {name: level_of(values, recording.sample_time)
              for name, values in sample_of(recording).channels.items()
              if np.isfinite(values).any()}
    start, stop = stretch_of(recording)
    piece = {name: values[start:stop] for name, values in recording.channels.items()
             if name in levels and name != "temperature" and levels[name].span > 0
             and np.isfinite(values[start:stop]).mean() > PRESENT} \
        if stop - start >= SHORTEST else {}
    # Live, topics come one after another; held at its first value, a late channel would
    # contradict the others.
    first, stop = common_span(piece)
    piece = {name: filled(values[first:stop].copy()) for name, values in piece.items()
             } if stop - first >= SHORTEST else {}
    same = tuple((one, other) for i, one in enumerate(piece) for other in list(piece)[i + 1:]
                 if same_numbers(one, piece[one], other, piece[other], levels[one].span))
    place: dict[tuple[str, int], int] = {}
    columns: list[np.ndarray] = []
    noise: list[float] = []
    band = cutoff(piece["x"]) if "x" in piece else 0
    if band:  # else nothing moves but noise
        for name, values in piece.items():
            made, white = derivatives(values, band, recording.sample_time)
            noise += [*white, 0.0]
            rms = np.sqrt(np.mean(made[1] ** 2))
            made.append(made[1] / (np.abs(made[1]) + SLOW * rms) if rms > 0 else made[1])
            for order, column in enumerate(made):
                place[name, order] = len(columns)
                columns.append(column - column.mean() if name in ("x", "x_d") and not order
                               else column)
    table = np.array(columns) if columns else np.empty((0, 0))
    if not np.isfinite(table).all() or np.abs(table).max(initial=0.0) > OVERFLOWS:
        place, table, noise = {}, table[:0], []
    mean = table.mean(axis=1) if len(table) else np.empty(0)
    if len(table):
        table = table - mean[:, None]
    scale = np.sqrt(np.mean(table**2, axis=1)) if len(table) else np.empty(0)
    size = np.where(scale > 0, scale, 1.0)
    unit = table / size[:, None]
    return Moments(place, unit @ unit.T / max(table.shape[1], 1), scale, mean / size,
                   np.array(noise) / size**2, levels, same, recording.sample_time)


def common_span(channels: dict[str, np.ndarray]) -> tuple[int, int]:
    """Return the first sample that all channels (n,) with values have, and one past the last."""
    there = [np.flatnonzero(np.isfinite(values)) for name, values in channels.items()
             if name != "temperature"]
    there = [rows for rows in there if len(rows)]
    return (max(rows[0] for rows in there), min(rows[-1] for rows in there) + 1) if there else (
        0, 0)


def same_numbers(one: str, values: np.ndarray, other: str, others: np.ndarray, span: float
                 ) -> bool:
    """Tell whether two channels are one column; of a demand and an answer in other units too.

    No pressure and no force follows what was demanded to the last digit.
    """
    names = {one, other}
    if names & {"x_d", "omega_d"} and names & {"p1", "p2", "force"}:
        level = others - others.mean()
        power = float(level @ level)
        if not 0.0 < power < OVERFLOWS or np.ptp(values) <= SAME * span:
            return False  # what stands still is no other's numbers
        others = values.mean() + float(level @ (values - values.mean())) / power * level
    return bool(np.mean(np.abs(values - others) <= SAME * span) > 0.95)


def level_of(values: np.ndarray, dt: float) -> Level:
    """Return where a channel, (n,), lies: by means over ``MEAN_OF``, as noise is no level."""
    values = values[np.isfinite(values)]
    # Not more than a hundredth of the recording: its clock may be what is wrong.
    length = max(min(round(MEAN_OF / dt), len(values) // 100), 1)
    means = values[:len(values) // length * length].reshape(-1, length).mean(axis=1)
    low, middle, high = np.percentile(means, [1.0, 50.0, 99.0]).tolist()
    return Level(low, middle, high, float(np.abs(means).max()))


def stretch_of(recording: Recording) -> tuple[int, int]:
    """Return the samples to look at: without a gap, and those that move most where many are."""
    if not recording.has("x"):
        return 0, min(len(recording), LONGEST)
    x = recording.channels["x"]
    starts, stops = spans_of((row, np.isfinite(rows)) for row, _, (rows,) in blocks(x))
    if len(starts) > 1:
        joined = np.flatnonzero(starts[1:] - stops[:-1] > BRIDGED)
        starts, stops = starts[np.r_[0, joined + 1]], stops[np.r_[joined, len(stops) - 1]]
    pieces = [(a, min(a + LONGEST, stop)) for start, stop in zip(starts, stops, strict=True)
              for a in range(int(start), int(stop), LONGEST)]
    def motion(piece: tuple[int, int]) -> float:
        values = x[slice(*piece)]
        power = np.nansum((values - np.nanmean(values)) ** 2)
        let_go(x)
        return power

    from scipy.fft import prev_fast_len

    start, stop = moving(x, *max(pieces, key=motion))
    # One sample more than a length whose transform is quick.
    return start, start + (prev_fast_len(stop - start - 1) + 1 if stop - start > 2 else 0)


def moving(x: np.ndarray, start: int, stop: int) -> tuple[int, int]:
    """Return the samples between standing at the beginning and standing at the end.

    A piston that is pressed against a stop answers to no force, and says nothing of a sign.  Where
    it hardly ever stands, all samples are.
    """
    here = x[start:stop]
    finite = np.flatnonzero(np.isfinite(here))
    if not len(finite):
        return start, stop
    away = AWAY * np.ptp(here[finite])
    left = finite[np.abs(here[finite] - here[finite[0]]) > away]
    back = finite[np.abs(here[finite] - here[finite[-1]]) > away]
    if not len(left) or not len(back) or back[-1] - left[0] < SHORTEST:
        return start, stop
    if back[-1] - left[0] > (1.0 - STANDS) * len(here):
        return start, stop
    return start + int(left[0]), start + int(back[-1]) + 1


def spectrum(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the spectrum of the odd continuation about both ends, and the line taken out.

    With the line through its ends taken out, a record continued oddly has no jump and no kink
    where it repeats, so that derivatives can be taken in the spectrum.  Of (n,) without NaN:
    (n,) complex, bin k at k/(2 (n - 1)) of the sampling rate; (n,) the line.
    """
    line = np.linspace(values[0], values[-1], len(values))
    level = values - line
    return np.fft.rfft(np.concatenate([level, -level[-2:0:-1]])), line


def cutoff(x: np.ndarray) -> int:
    """Return the bin of the spectrum up to which the position shows the acceleration, or 0."""
    power = np.abs(spectrum(x)[0]) ** 2
    last, floor = int(2 * BAND * len(power)), floor_of(power)
    fourth = np.arange(last, dtype=float) ** 4
    signal = np.cumsum(fourth * np.maximum(power[:last] - floor, 0.0))
    good = np.flatnonzero(np.cumsum(fourth * floor) <= NOISE_SHARE * signal)
    white = np.sqrt(floor / (2 * (len(x) - 1)))  # of a sample, m
    return max(int(good[-1]), LEAST_BAND) if np.std(x) > MOVES * white else 0


def floor_of(power: np.ndarray) -> float:
    """Return the power of white noise in each bin, estimated from the bins above the band.

    Such a bin's power is exponentially distributed, with a median of ln 2 times its mean.
    """
    return float(np.median(power[int(2 * BAND * len(power)):])) / np.log(2.0)


def derivatives(values: np.ndarray, band: int, dt: float) -> tuple[list[np.ndarray], list[float]]:
    """Return a channel below ``band`` with its derivatives, (m,) SI, and each one's noise."""
    n = len(values)
    bent, line = spectrum(values)
    bins = np.arange(len(bent))
    # A cosine flank over the last third of the band: a sharp edge rings.
    flank = 0.5 + 0.5 * np.cos(np.pi * np.clip(3.0 * bins / band - 2.0, 0.0, 1.0))
    s = 1j * np.pi * bins / ((n - 1) * dt)
    floor = 2.0 * floor_of(np.abs(bent) ** 2) / (2 * (n - 1)) ** 2
    white = [floor * float(np.sum((flank * np.abs(s) ** order) ** 2)) for order in range(ORDERS)]
    bent *= flank
    slope = (line, (line[-1] - line[0]) / ((n - 1) * dt), 0.0)
    cut = slice(int(MARGIN * n), n - int(MARGIN * n))
    return [(np.fft.irfft(bent * s**order, 2 * (n - 1))[:n] + slope[order])[cut]
            for order in range(ORDERS)], white
