"""Curves made fit for a picture: envelopes, derivatives, windows, limits, correlations."""

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np

LARGEST = 1e60  # SI; beyond it squares and the sums of a drawing library overflow
Record = TypeVar("Record")


def tamed(values: np.ndarray) -> np.ndarray:
    """Return (n,) values with NaN for infinities and for sizes that no picture can show."""
    with np.errstate(invalid="ignore"):
        wild = ~(np.abs(values) < LARGEST)
    return np.where(wild, np.nan, values) if wild.any() else values


def with_tamed(record: Record) -> Record:
    """Return a record whose arrays are :func:`tamed`."""
    return replace(record, **{one.name: tamed(values) for one in fields(record)
                              if isinstance(values := getattr(record, one.name), np.ndarray)})


def envelope(time: np.ndarray, values: np.ndarray, bins: int = 1500
             ) -> tuple[np.ndarray, np.ndarray]:
    """Return at most four samples per bin that draw the same line: peaks and gaps survive.

    Each bin keeps its first, lowest, highest and last sample where they are, which is what a line
    drawn through all of them would show at that width.  A gap longer than three times the usual
    spacing of the finite samples becomes a NaN; shorter ones are joined, so that a channel
    slower than the grid is still a line.  ``time`` is (n,) rising; ``values`` (n,) are NaN or
    infinite where there is nothing.
    """
    index = np.flatnonzero(np.isfinite(values))
    if not index.size:
        return np.empty(0), np.empty(0)
    gap_after, starts, ends = _in_bins(index, len(values), bins)
    t, v = time[index], values[index]
    kept = slice(None)
    if len(index) > 4 * bins:
        kept = np.unique(np.concatenate([starts, ends, _first_of(v, starts, np.minimum),
                                         _first_of(v, starts, np.maximum)]))
    breaks = np.flatnonzero(np.r_[gap_after, False][kept]) + 1
    t, v = t[kept], v[kept]
    return np.insert(t, breaks, t[breaks - 1]), np.insert(v, breaks, np.nan)


def band_envelope(time: np.ndarray, lower: np.ndarray, upper: np.ndarray, bins: int = 400
                  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return two points per bin between which a band is as wide as it is anywhere in the bin.

    ``lower`` and ``upper`` (n,) are NaN where there is no band; gaps are as in :func:`envelope`.
    """
    index = np.flatnonzero(np.isfinite(lower) & np.isfinite(upper))
    if not index.size:
        return np.empty(0), np.empty(0), np.empty(0)
    gap_after, starts, ends = _in_bins(index, len(lower), bins)
    t = np.column_stack([time[index[starts]], time[index[ends]]]).ravel()
    low = np.repeat(np.minimum.reduceat(lower[index], starts), 2)
    high = np.repeat(np.maximum.reduceat(upper[index], starts), 2)
    breaks = 2 * (np.flatnonzero(gap_after[ends[:-1]]) + 1)
    return tuple(np.insert(values, breaks, fill) for values, fill in (
        (t, t[breaks - 1]), (low, np.nan), (high, np.nan)))


def _in_bins(index: np.ndarray, samples: int, bins: int
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return of (n,) places which end in a gap, (n - 1,), and the first and last of each bin."""
    steps, column = np.diff(index), (index * bins) // samples
    gap_after = steps > 3 * np.median(steps) if steps.size else np.zeros(0, dtype=bool)
    starts = np.flatnonzero(np.r_[True, (np.diff(column) > 0) | gap_after])
    return gap_after, starts, np.r_[starts[1:], len(index)] - 1


def _first_of(values: np.ndarray, starts: np.ndarray, extreme: np.ufunc) -> np.ndarray:
    """Return of each part of (n,) values the place of its extreme, the first if there are more."""
    counts = np.diff(np.r_[starts, len(values)])
    places = np.flatnonzero(values == np.repeat(extreme.reduceat(values, starts), counts))
    return places[np.searchsorted(places, starts)]


@dataclass(frozen=True)
class Smoother:
    """A cubic fitted over a sliding window (Savitzky-Golay), read off as a derivative.

    ``window`` samples of ``dt`` seconds; ``order`` 1 or 2.
    """

    window: int
    dt: float
    order: int

    def of(self, values: np.ndarray) -> np.ndarray:
        """Return the derivative of (n,) values; NaN at the ends and beside long gaps."""
        return _fitted(_bridged(values), self.window, self.order, self.dt)

    def alike(self, derivative: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """Return a known derivative, (n,), treated exactly as :meth:`of` treats ``measured``.

        It is summed up ``order`` times first (the constants of summation drop out again) and
        kept only where the measured values are.
        """
        finite = np.isfinite(derivative)
        total = np.where(finite, derivative, 0.0)
        for _ in range(self.order):
            total = np.concatenate([[0.0], np.cumsum(0.5 * (total[1:] + total[:-1]))]) * self.dt
        kept = np.where(finite & np.isfinite(measured), total, np.nan)
        return _fitted(_bridged(kept), self.window, self.order, self.dt)


def choose_smoother(values: np.ndarray, dt: float, order: int) -> Smoother | None:
    """Return the shortest of a few windows that keeps the noise below 3 % of the derivative.

    ``values`` are (n,) measured, SI, ``dt`` s apart; ``order`` is 1 or 2.  None where no window
    fits into the data.
    """
    from scipy.signal import savgol_coeffs

    filled = _bridged(values)
    best = None
    spacing = usual_spacing(values)
    for samples in (7, 11, 17, 25, 41, 65, 101):
        window = samples * spacing | 1  # odd
        if window > len(values):
            break
        slope = _fitted(filled, window, order, dt)
        finite = np.isfinite(slope)
        if not finite.any():
            break
        best = Smoother(window, dt, order)
        # The mean is little moved by the reversals, where a cubic does not fit, and unlike the
        # median it hears the steps of a coarse encoder that stands still most of the time.
        rest = np.abs(filled - _fitted(filled, window, 0, dt))[finite]
        noise = 1.25 * np.mean(rest) * np.linalg.norm(savgol_coeffs(window, 3, order, dt))
        if noise < 0.03 * np.percentile(np.abs(slope[finite]), 95):
            break
    return best


def _fitted(values: np.ndarray, window: int, order: int, dt: float) -> np.ndarray:
    """Return the ``order``-th derivative of the sliding cubic; (n,), NaN where it has no data."""
    from scipy.signal import savgol_filter  # takes as long to import as a page to draw

    fitted = np.full(len(values), np.nan)
    if window <= len(values):
        inside = slice(window // 2, len(values) - window // 2)
        fitted[inside] = savgol_filter(values, window, 3, order, dt, mode="constant")[inside]
    return fitted


def usual_spacing(values: np.ndarray) -> int:
    """Return the usual distance of finite samples; more than 1 if slower than the grid."""
    steps = np.diff(np.flatnonzero(np.isfinite(values)))
    return int(np.median(steps)) if steps.size else 1


def in_gap(values: np.ndarray) -> np.ndarray:
    """Return where (n,) values are missing for longer than three usual spacings; (n,) bool."""
    index = np.flatnonzero(np.isfinite(values))
    if not index.size:
        return np.ones(len(values), dtype=bool)
    every = np.arange(len(values))
    place = np.searchsorted(index, every)
    after = index[place.clip(max=len(index) - 1)]
    before = index[(place - 1).clip(min=0)]
    distance = np.where(place == 0, after - every, np.where(
        place == len(index), every - before, after - before))
    return (distance > 3 * usual_spacing(values)) & ~np.isfinite(values)


def _bridged(values: np.ndarray) -> np.ndarray:
    """Fill gaps of at most fifteen samples, or three usual spacings, linearly; (n,)."""
    longest = max(15, 3 * usual_spacing(values))
    finite = np.isfinite(values)
    index = np.flatnonzero(finite)
    if index.size < 2 or finite.all():
        return np.where(finite, values, np.nan)
    every = np.arange(len(values))
    filled = np.interp(every, index, values[index], left=np.nan, right=np.nan)
    after = np.searchsorted(index, every).clip(1, len(index) - 1)
    too_long = (index[after] - index[after - 1] > longest + 1) & ~finite
    filled[too_long] = np.nan
    return filled


def reversals(values: np.ndarray) -> np.ndarray:
    """Return the indices where a motion turns by more than a tenth of its range."""
    index = np.flatnonzero(np.isfinite(values))
    if index.size < 5:
        return np.empty(0, dtype=int)
    thin = index[:: max(1, index.size // 200_000)]
    v = values[thin]
    threshold = 0.1 * (np.percentile(v, 99) - np.percentile(v, 1))
    if not threshold > 0:
        return np.empty(0, dtype=int)
    found, extreme, direction = [], 0, 0
    for i, value in enumerate(v.tolist()):
        ahead = value - v[extreme]
        if direction == 0:
            if abs(ahead) > threshold:
                direction, extreme = (1 if ahead > 0 else -1), i
        elif ahead * direction >= 0:
            extreme = i
        elif -ahead * direction > threshold:
            found.append(extreme)
            direction, extreme = -direction, i
    return thin[np.array(found, dtype=int)]


def informative_window(motion: np.ndarray, dt: float, near: float | None = None
                   ) -> tuple[int, int, str]:
    """Return a window worth a closer look: (start, stop, what it shows).

    Fast motions show three periods, slow ones the surroundings of a reversal.  ``motion`` is a
    position, (n,), NaN in gaps.  The window is close to the time ``near``, s; by default three
    fifths into the record, where filters have converged.
    """
    n = len(motion)
    if n == 0:
        return 0, 0, "nothing"
    if near is None or not np.isfinite(near):
        near = 0.6 * n * dt
    turns = reversals(motion)
    if len(turns) >= 2:
        half_period = float(np.median(np.diff(turns))) * dt
        if half_period <= 0.5:
            length, words = 6 * half_period, "three periods"
        else:
            length, words = max(1.0, 0.5 * half_period), "a reversal"
    else:
        length, words = max(0.05 * n * dt, 20 * dt), "a reversal" if len(turns) else "a part"
    width = int(min(n, max(round(length / dt), 20)))
    centres = turns if len(turns) else np.array([int(near / dt)])

    def around(centre: int) -> int:
        return int(np.clip(centre - width // 2, 0, n - width))

    for start in map(around, centres[np.argsort(np.abs(centres * dt - near))][:50]):
        if np.isfinite(motion[start:start + width]).mean() > 0.98:
            return start, start + width, words
    start = around(centres[np.argmin(np.abs(centres * dt - near))])
    return start, start + width, words


def robust_range(curves: list[np.ndarray], followed: list[np.ndarray] = ()
                 ) -> tuple[float, float, float]:
    """Return limits for a plot, and the size of the largest sample that they cut off (or 0).

    The limits hold everything unless a few samples tower over the rest.

    Parameters
    ----------
    curves : (n,) each; they set the limits.
    followed : such as estimates of what is measured; they widen the limits by the whole span at
        each end and no more, so that one that diverges does not flatten what it should follow.
    """
    if not any(np.isfinite(curve).any() for curve in curves):
        curves, followed = followed, ()
    low, high, inner_low, inner_high = _extremes(curves)
    span = inner_high - inner_low
    if span > 0 and high - low > 4 * span:
        inner_low = max(low, inner_low - 0.5 * span)
        inner_high = min(high, inner_high + 0.5 * span)
    else:
        inner_low, inner_high = low, high
    if any(np.isfinite(curve).any() for curve in followed):
        least, most, *_ = _extremes(followed)
        low, high = min(low, least), max(high, most)
        span = inner_high - inner_low or max(abs(inner_low), abs(inner_high))
        inner_low, inner_high = (max(min(inner_low, least), inner_low - span),
                                 min(max(inner_high, most), inner_high + span))
    if inner_low <= low and high <= inner_high:
        return inner_low, inner_high, 0.0
    return inner_low, inner_high, abs(low if inner_low - low > high - inner_high else high)


def _extremes(curves: list[np.ndarray]) -> tuple[float, float, float, float]:
    """Return the least and the largest value, and those without the outer 0.2 %; 0 of nothing."""
    finite = [curve[np.isfinite(curve)] for curve in curves]
    finite = [curve for curve in finite if curve.size] or [np.zeros(1)]
    inner = [np.percentile(curve, (0.2, 99.8)) for curve in finite]
    return (float(min(map(np.min, finite))), float(max(map(np.max, finite))),
            float(min(low for low, _ in inner)), float(max(high for _, high in inner)))


def robust_peak(values: np.ndarray) -> tuple[float, float]:
    """Return a half-height for a plot about zero and the true peak; both positive or zero.

    The half-height is the peak itself unless a few samples tower over the rest.
    """
    size = np.abs(values[np.isfinite(values)])
    if not size.size:
        return 0.0, 0.0
    peak, usual = float(size.max()), float(np.percentile(size, 99))
    return (3 * usual if usual > 0 and peak > 8 * usual else peak), peak


def autocorrelation(values: np.ndarray, lags: int) -> tuple[np.ndarray, int]:
    """Return the autocorrelation at lags 1 to ``lags`` and the number of samples used.

    The mean is not taken off, since innovations are expected to have none.  NaN are left out.
    """
    z = values[-500_000:]  # enough of a long record
    finite = np.isfinite(z)
    z = np.where(finite, z, 0.0)
    power = float(z @ z) / max(finite.sum(), 1)
    if not power > 0:
        return np.empty(0), int(finite.sum())
    lags = min(lags, len(z) - 1)
    size = 1 << int(np.ceil(np.log2(len(z) + lags + 1)))
    spectrum, present = np.fft.rfft(z, size), np.fft.rfft(finite.astype(float), size)
    products = np.fft.irfft(np.abs(spectrum) ** 2, size)[1:lags + 1]
    pairs = np.fft.irfft(np.abs(present) ** 2, size)[1:lags + 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(pairs > 0.5, products / pairs / power, np.nan), int(finite.sum())


def running_rms(values: np.ndarray, windows: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle index of up to ``windows`` windows and the RMS in each; NaN in gaps."""
    n = len(values)
    windows = max(1, min(windows, n // 10))
    edges = np.linspace(0, n, windows + 1).astype(int)
    finite = np.isfinite(values)
    squares = np.where(finite, values, 0.0) ** 2
    count = np.add.reduceat(finite.astype(float), edges[:-1])
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.sqrt(np.add.reduceat(squares, edges[:-1]) / count)
    return 0.5 * (edges[:-1] + edges[1:]), np.where(count >= 3, rms, np.nan)
