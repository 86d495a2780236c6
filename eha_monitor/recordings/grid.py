"""The uniform grid under stamps that jitter, drift, or have holes."""

from dataclasses import dataclass

import numpy as np

from eha_monitor.recordings.stamps import deviation, lower_median, running_median, window_for

JITTER = 0.02  # of the sample time; below it stamps count as exact
SNAP = 0.05  # the config's sample time is taken when the stamps agree this well
GAP = 2.5  # periods across which nothing is interpolated
ROUGH = 0.2  # spread of the steps, in steps, above which a missing sample hides in it


@dataclass(frozen=True)
class Grid:
    """How stamps lie on a uniform grid.

    Attributes
    ----------
    start, step : first grid point and spacing, s.
    index : (n,) int64 place of each sample on the grid; of no use when ``mode`` is
        ``instants``.
    mode : ``exact`` (stamps on the grid), ``snapped`` (stamps jitter about it), ``instants``
        (samples were taken at their uneven stamps).
    jitter : root mean square of the stamps' distance from the grid, or of the steps' distance
        from whole samples where the mode is ``instants``, s.
    """

    start: float
    step: float
    index: np.ndarray
    mode: str
    jitter: float = 0.0

    def times(self, t: np.ndarray) -> np.ndarray:
        """Return the repaired times of the samples, s."""
        return t if self.mode == "instants" else self.start + self.index * self.step


def fit_grid(t: np.ndarray, values: np.ndarray, nominal: float) -> Grid:
    """Find the uniform grid of stamps and decide what their jitter means.

    Stamps off the grid are either jitter of the clock about an even sampling, or true instants
    of an uneven one.  The wrong choice puts false accelerations into a moving quantity; the
    motion itself tells which it is.  Stamps that run backwards are jitter in any case.

    Parameters
    ----------
    t : (n,) stamps in the order of the samples, s.  values : (n,) the quantity.
    nominal : sample time of the config, s; it, a multiple or a whole part of it is taken where
        the stamps agree.
    """
    if len(t) < 2:
        return Grid(float(t[0]) if len(t) else 0.0, nominal, np.zeros(len(t), np.int64), "exact")
    steps = np.diff(t)
    usual = float(lower_median(steps))
    rising = bool((steps > 0).all())
    spread = deviation(steps) / usual
    step = usual if spread > ROUGH else float(
        np.mean(steps[np.abs(steps - usual) < 0.5 * usual]))
    target = _simple(usual, nominal)
    near = abs(step / target - 1) <= SNAP
    for candidate in (([target] if near else []) + [usual, step]) * rising:
        grid = _exact(t, candidate, refine=candidate != target)
        if grid is not None:
            return grid
    width = window_for(spread)
    index = _unbroken(t, target if near else step, width)
    if index is None:
        index = _step_by_step(steps, step)
    broken = index is None
    if broken:  # steps between lost samples sum up to less than the config's sample time knows
        sure = 0.002 + spread * (0.03 + 3 / np.sqrt(len(t)))  # of the steps' own mean
        trusted = near and abs(step / target - 1) <= sure
        index = _count(t, target if trusted else step, width)
    slope = _slope(t, index)
    if broken and trusted and abs(slope - target) * index[-1] >= 0.5 * target:
        index = _count(t, step, width)
        slope = _slope(t, index)
    slope = slope if slope > 0 else step
    if near and abs(slope - target) * index[-1] < 0.5 * target:
        slope = target
    start = float(np.median(t - index * slope))
    jitter = float(np.sqrt(np.mean((t - start - index * slope) ** 2)))
    if not rising or _share_of_jitter(t, index, values, slope) < 0.5:
        return Grid(start, slope, index, "snapped", jitter)
    uneven = steps - np.diff(index) * slope
    return Grid(float(t[0]), target if near else slope, index, "instants",
                float(np.sqrt(np.mean(uneven ** 2))))


def _simple(usual: float, nominal: float) -> float:
    """Return the multiple or whole part of ``nominal`` that is nearest."""
    ratio = min(max(usual / nominal, 1e-9), 1e9)
    return nominal * round(ratio) if ratio >= 1 else nominal / round(1 / ratio)


def _exact(t: np.ndarray, step: float, refine: bool) -> Grid | None:
    """Return the grid of this spacing if the stamps keep to it over the whole recording.

    ``refine`` takes the spacing from end to end where whole nanoseconds hide a part of it.
    """
    if step <= 0:
        return None
    place = (t - t[0]) / step
    index = np.round(place)
    off = place - index
    phase = np.median(off)
    if np.quantile(np.abs(off - phase), 0.999) > JITTER or (np.diff(index) <= 0).any():
        return None
    whole = float(t[-1] - t[0]) / index[-1]
    if refine and abs(whole - step) * index[-1] > 2e-9:
        step = whole
    return Grid(float(t[0] + phase * step), step, index.astype(np.int64), "exact")


def _slope(t: np.ndarray, index: np.ndarray) -> float:
    """Spacing of the grid points, s: the median over pairs a fifth of the recording apart.

    Single steps carry the jitter of two stamps each; it hardly counts over thousands of steps,
    and the median ignores a clock that was set once in between.
    """
    apart = max(1, len(t) // 5)
    return float(np.median((t[apart:] - t[:-apart]) / (index[apart:] - index[:-apart])))


def _unbroken(t: np.ndarray, step: float, width: int) -> np.ndarray | None:
    """Number the samples one by one if no sample is missing, else None.

    A lost sample lifts all later stamps by one step off a straight line, which the median over
    ``width`` neighbours shows where the jitter of one stamp would hide it.
    """
    index = np.arange(len(t))
    slope = _slope(t, index)
    if slope <= 0 or abs(slope / step - 1) > SNAP:
        return None
    off = (t - index * slope) / slope
    off = off if len(t) < width else running_median(off, width)
    return index if (np.abs(off - np.median(off)) < 0.25).all() else None


def _step_by_step(steps: np.ndarray, step: float) -> np.ndarray | None:
    """Number the samples by rounding each step, if jitter leaves no doubt about any, else None.

    Other than a count from the first sample on, this does not depend on an exact ``step``.
    """
    whole = np.round(steps / step)
    doubtful = np.abs(steps / step - whole) > 0.42
    if (whole < 1).any() or (doubtful & (whole < 10)).any():
        return None
    return np.concatenate([[0], np.cumsum(whole)]).astype(np.int64)


def _count(t: np.ndarray, step: float, width: int) -> np.ndarray:
    """Number the samples on a grid under jitter: one on, plus whole samples at each gap."""
    raw = ahead = (t - t[0]) / step - np.arange(len(t))
    early = 0.5
    if len(t) >= width:
        ahead = running_median(ahead, width)
        ahead = ahead - np.median(ahead[:width])
        early = 0.25  # what is counted once stays counted: better late than for a mere excursion
    missing = np.maximum.accumulate(np.maximum(np.floor(ahead + early), 0))
    missing = missing - missing[0]
    if len(t) >= width:
        missing = _sharpen(raw, missing, width)
    return np.arange(len(t)) + missing.astype(np.int64)


def _sharpen(ahead: np.ndarray, missing: np.ndarray, width: int) -> np.ndarray:
    """Move each gap to where the stamps on both sides of it fit best; (n,) as ``missing``."""
    ahead = ahead - np.median(ahead - missing)
    out = missing.copy()
    places = np.flatnonzero(np.diff(missing)) + 1
    bounds = np.concatenate([[0], places, [len(missing)]])
    for before, place, after in zip(bounds[:-2], places, bounds[2:], strict=True):
        first, last = max(before, place - width), min(after, place + width)
        low, high = missing[place - 1], missing[place]
        near = ahead[first:last]
        # The sum of squares for a gap before sample k, but for what all k share.
        worse = np.concatenate([[0], np.cumsum((near - low) ** 2 - (near - high) ** 2)])
        best = first + int(np.argmin(worse))
        out[best:place] = high
        out[place:best] = low
    return np.maximum.accumulate(out)


def _share_of_jitter(t: np.ndarray, index: np.ndarray, values: np.ndarray,
                     step: float) -> float:
    """Return how much of the stamps' unevenness the quantity took part in: 1 all, 0 none.

    Where a step in time is longer by dt - n step, a quantity that moves at speed v goes further
    by v (dt - n step) if the stamp is the true instant, and no further if only the stamp was
    late.  The regression of the one on the other tells, with white noise in the values
    averaged out.  0 where the motion is too slow to tell.
    """
    reach = 4
    if len(t) < 4 * reach:
        return 0.0
    wide = slice(reach, len(t) - reach - 1)
    ahead, behind = slice(2 * reach + 1, None), slice(None, -2 * reach - 1)
    # Only ratios count; scaled, no square overflows.
    values = values / (np.nanmax(np.abs(values), initial=0.0) or 1.0)
    speed = (values[ahead] - values[behind]) / (t[ahead] - t[behind])
    count = np.diff(index)[wide]
    uneven = speed * (np.diff(t)[wide] - count * step)
    further = np.diff(values)[wide] - speed * count * step
    good = (count <= GAP) & np.isfinite(uneven) & np.isfinite(further)
    uneven, further = uneven[good], further[good]
    power = float(np.sum(uneven ** 2))
    if len(uneven) < 10 or power == 0:
        return 0.0
    share = float(np.sum(uneven * further)) / power
    error = np.sqrt(np.mean((further - share * uneven) ** 2) / power)
    return share if abs(share) > 4 * error else 0.0
