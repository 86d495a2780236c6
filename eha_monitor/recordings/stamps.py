"""Repair of time stamps: order, repeats, clock jumps, wild values, jitter."""

from dataclasses import dataclass

import numpy as np

JITTER = 0.02  # of the sample time; below it stamps count as exact
SNAP = 0.05  # the config's sample time is taken when the stamps agree this well
GAP = 2.5  # periods across which nothing is interpolated
BLOCK = 100_000  # samples worked on at once where memory would grow with the recording
FILTER = 21  # samples of the running median that counts missing samples under jitter
LATEST = 1e9  # ns; a message is late by less, a clock jumps by more
CLOSE = 0.6  # of the sample time; stamps are crowded when closer
CROWDED = 3  # crowded stamps that still count as late messages


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


def lower_median(values: np.ndarray) -> float:
    """Median that is always one of the values."""
    return np.partition(values, (len(values) - 1) // 2)[(len(values) - 1) // 2]


def period_of(stamps: np.ndarray) -> float:
    """Return the usual spacing of stamps in recorded order; 0 if there is none."""
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    return float(lower_median(steps)) if len(steps) else 0.0


def repair(stamps: np.ndarray, label: str, said: list[str]) -> tuple[np.ndarray, bool]:
    """Return which samples to keep, in order of time, and whether the clock had jumped back.

    Parameters
    ----------
    stamps : (n,) int64 ns in recorded order.
    label : topic or channel, for the sentences that are added to ``said``.
    """
    keep = np.arange(len(stamps))
    repeated = np.flatnonzero(np.diff(stamps) == 0)
    if len(repeated):
        keep = np.delete(keep, repeated + 1)
        said.append(f"{label}: {_samples(len(repeated))} with a repeated stamp dropped")
    step = period_of(stamps[keep])
    if len(keep) < 2 or step == 0:
        return keep[:1], False
    jumped = False
    if (np.diff(stamps[keep]) < 0).any():
        keep = _drop_wild(stamps, keep, step, label, said)
        keep, jumped = _put_in_order(stamps, keep, step, label, said)
    return _drop_far(stamps, keep, label, said), jumped


def _drop_wild(stamps, keep, step, label, said):
    """Drop single stamps that lie far from their neighbours on both sides."""
    if len(keep) < 5:
        return keep
    shifted = (stamps[keep] - stamps[keep[0]]).astype(float)
    far = np.abs(shifted - _running_median(shifted, 5)) > max(1e9, 100 * step)
    if far.any() and far.sum() < 0.1 * len(keep):
        said.append(f"{label}: {_samples(int(far.sum()))} with a stamp far off its neighbours' "
                    "dropped")
        return keep[~far]
    return keep


def _put_in_order(stamps, keep, step, label, said):
    """Sort late messages into their places; after a clock jump keep the longest stretch."""
    steps = np.diff(stamps[keep])
    back = np.flatnonzero(steps < 0)
    if not len(back):
        return keep, False
    order = keep[np.argsort(stamps[keep], kind="stable")]
    # Late messages fill holes; after a jump two stretches lie between one another.
    crowded = (np.sum(np.diff(stamps[order]) < CLOSE * step)
               - np.sum((steps > 0) & (steps < CLOSE * step)))
    late = -steps.min() <= max(LATEST, 5 * step)
    if late and crowded <= max(CROWDED, 0.05 * len(keep) * (len(back) > 0.02 * len(keep))):
        fresh = np.concatenate([[True], np.diff(stamps[order]) > 0])
        said.append(f"{label}: {len(back)} reversed stamp{'s' * (len(back) > 1)} put in order"
                    + (f", {_samples(int(np.sum(~fresh)))} at a taken stamp dropped"
                       if not fresh.all() else ""))
        return order[fresh], False
    jumps = back[steps[back] < -2 * step]
    if not len(jumps):
        jumps = back
    runs = np.split(keep, jumps + 1)
    longest = max(runs, key=len)
    lost = len(keep) - len(longest)
    jump = -steps[jumps].min() * 1e-9
    said.append(f"{label}: the clock jumps back {len(jumps)} time{'s' * (len(jumps) > 1)} "
                f"(up to {jump:.3f} s): the longest stretch of {_samples(len(longest))} kept, "
                f"{_samples(lost)} dropped")
    inside = longest[np.argsort(stamps[longest], kind="stable")]
    return inside[np.concatenate([[True], np.diff(stamps[inside]) > 0])], True


def _drop_far(stamps, keep, label, said):
    """Drop what lies behind a gap of more than ten times all the rest."""
    while len(keep) > 2:
        gaps = np.diff(stamps[keep])
        at = int(np.argmax(gaps))
        rest = int(stamps[keep[-1]] - stamps[keep[0]]) - int(gaps[at])
        if gaps[at] <= 10 * max(rest, 1_000_000_000):
            break
        first, last = keep[:at + 1], keep[at + 1:]
        lost = min(len(first), len(last))
        keep = first if len(first) > len(last) else last
        said.append(f"{label}: {_samples(lost)} {gaps[at] * 1e-9:.6g} s away from all others "
                    "dropped")
    return keep


def fit_grid(t: np.ndarray, values: np.ndarray, nominal: float) -> Grid:
    """Find the uniform grid of rising stamps and decide what their jitter means.

    Stamps off the grid are either jitter of the clock about an even sampling, or true instants
    of an uneven one.  The wrong choice puts false accelerations into a moving quantity; the
    motion itself tells which it is.

    Parameters
    ----------
    t : (n,) rising, s.  values : (n,) the quantity.  nominal : sample time of the config, s.
    """
    if len(t) < 2:
        return Grid(float(t[0]) if len(t) else 0.0, nominal, np.zeros(len(t), np.int64), "exact")
    steps = np.diff(t)
    usual = lower_median(steps)
    step = float(np.mean(steps[steps < 1.5 * usual]))
    near = abs(step / nominal - 1) <= SNAP
    for candidate in ([nominal] if near else []) + [usual, step]:
        grid = _exact(t, float(candidate), refine=candidate != nominal)
        if grid is not None:
            return grid
    index = _count(t, step)
    slope, start = np.polyfit(index, t, 1) if len(t) > 2 else (step, t[0])
    drift = abs(slope - nominal) * index[-1]
    if near and drift < 0.5 * nominal:
        slope = nominal
        index = _count(t, nominal)
    start = float(np.median(t - index * slope))
    jitter = float(np.sqrt(np.mean((t - start - index * slope) ** 2)))
    if _share_of_jitter(t, index, values, float(slope)) < 0.5:
        return Grid(start, float(slope), index, "snapped", jitter)
    uneven = np.diff(t) - np.diff(index) * slope
    return Grid(float(t[0]), nominal if near else float(slope), index, "instants",
                float(np.sqrt(np.mean(uneven ** 2))))


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


def _count(t: np.ndarray, step: float) -> np.ndarray:
    """Number the samples on a grid under jitter: one on, plus whole samples at each gap."""
    ahead = (t - t[0]) / step - np.arange(len(t))
    if len(t) >= FILTER:
        ahead = _running_median(ahead, FILTER)
    missing = np.maximum.accumulate(np.round(ahead - ahead[0]))
    return np.arange(len(t)) + missing.astype(np.int64)


def _running_median(values: np.ndarray, width: int) -> np.ndarray:
    """Median over ``width`` neighbours, in blocks, since the windows are copied; (n,)."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, width // 2, "edge"), width)
    return np.concatenate([np.median(windows[start:start + BLOCK], axis=1)
                           for start in range(0, len(values), BLOCK)])


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


def _samples(count: int) -> str:
    return f"{count} sample{'s' * (count != 1)}"
