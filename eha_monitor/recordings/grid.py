"""The uniform grid under stamps that jitter, drift, jump, repeat or have holes."""

from dataclasses import dataclass

import numpy as np

from eha_monitor.recordings.columns import any_of, blocks, let_go, spans_of

FILTER = 21  # samples of the running median under little jitter
LONG_FILTER = 101  # and under much
MUCH = 0.4  # spread of the steps, in steps, that is much jitter
UNEVEN = 0.1  # spread of sorted steps, in steps, above which sorting proves nothing
FAR = 5  # standard deviations of the jitter; a stamp further off belongs to another place
LATEST = 1e9  # ns; a message is late by less, a clock jumps by more
SETBACK = 20  # steps, and
SETBACK_NS = 50e6  # ns: up to the larger of them, backwards is jitter and no clock jump
CLOSE = 0.6  # of the sample time; stamps are crowded when closer
CROWDED = 3  # crowded stamps that still count as late messages


def lower_median(values: np.ndarray) -> float:
    """Median that is always one of the values."""
    return np.partition(values, (len(values) - 1) // 2)[(len(values) - 1) // 2]


def period_of(stamps: np.ndarray) -> float:
    """Return the usual spacing of stamps in recorded order; 0 if there is none."""
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    return float(lower_median(steps)) if len(steps) else 0.0


def deviation(values: np.ndarray) -> float:
    """Standard deviation by the median, which a few wild values do not move."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def window_for(spread: float) -> int:
    """Neighbours whose median tells a missing sample, for steps of this relative spread."""
    return FILTER if spread < MUCH else LONG_FILTER


def running_median(values: np.ndarray, width: int) -> np.ndarray:
    """Median over ``width`` neighbours, an odd number, mirrored at both ends; (n,)."""
    from scipy.ndimage import median_filter
    return median_filter(values, width, mode="reflect")


def repair(stamps: np.ndarray, label: str, said: list[str]) -> tuple[np.ndarray, bool]:
    """Return which samples to keep, in order of time, and whether the clock had jumped back.

    Stamps that jitter by more than a step are left as they are: the order is that of arrival.

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
    keep = _drop_far(stamps, keep, label, said)
    if len(keep) > 1 and lower_median(np.diff(stamps[keep])) <= 0:  # too few left to go by
        keep = keep[np.unique(stamps[keep], return_index=True)[1]]
    return keep, jumped


def _drop_wild(stamps, keep, step, label, said):
    """Drop single stamps that lie far from their neighbours on both sides."""
    if len(keep) < 5:
        return keep
    shifted = (stamps[keep] - stamps[keep[0]]).astype(float)
    far = np.abs(shifted - running_median(shifted, 5)) > max(1e9, 100 * step)
    if not 0 < far.sum() < 0.1 * len(keep):
        return keep
    said.append(f"{label}: {_samples(int(far.sum()))} with a stamp far off its neighbours' "
                "dropped")
    return keep[~far]


def _put_in_order(stamps, keep, step, label, said):
    """Sort late messages, leave jitter alone; after a clock jump keep the longest stretch."""
    steps = np.diff(stamps[keep])
    back = np.flatnonzero(steps < 0)
    if not len(back):
        return keep, False
    order = keep[np.argsort(stamps[keep], kind="stable")]
    ahead = np.diff(stamps[order])
    # Late messages fill holes; after a jump two stretches lie between one another.
    crowded = np.sum(ahead < CLOSE * step) - np.sum((steps > 0) & (steps < CLOSE * step))
    late = (-steps.min() <= max(LATEST, 5 * step)
            and crowded <= max(CROWDED, 0.05 * len(keep) * (len(back) > 0.02 * len(keep))))
    if late and deviation(ahead) <= UNEVEN * step:
        return _sorted(stamps, order, len(back), label, said), False
    arrived = _by_arrival(stamps, keep, back, label, said)
    if arrived is not None:
        return arrived, False
    if late:
        return _sorted(stamps, order, len(back), label, said), False
    jumps = back[steps[back] < -_setback(steps)]
    if not len(jumps):
        jumps = back
    runs = np.split(keep, jumps + 1)
    longest = max(runs, key=len)
    lost = len(keep) - len(longest)
    jump = -steps[jumps].min() * 1e-9
    said.append(f"{label}: the clock jumps back {len(jumps)} time{'s' * (len(jumps) > 1)} "
                f"(up to {jump:.3f} s): the longest stretch of {_samples(len(longest))} kept, "
                f"{_samples(lost)} dropped")
    back = np.flatnonzero(np.diff(stamps[longest]) < 0)
    if not len(back):
        return longest, True
    inside = _by_arrival(stamps, longest, back, label, said)
    if inside is None:
        order = longest[np.argsort(stamps[longest], kind="stable")]
        inside = _sorted(stamps, order, len(back), label, said)
    return inside, True


def _sorted(stamps, order, reversed_count, label, said):
    fresh = np.concatenate([[True], np.diff(stamps[order]) > 0])
    said.append(f"{label}: {reversed_count} reversed stamp{'s' * (reversed_count > 1)} put in "
                "order" + (f", {_samples(int(np.sum(~fresh)))} at a taken stamp dropped"
                           if not fresh.all() else ""))
    return order[fresh]


def _setback(steps) -> float:
    return max(SETBACK * max(0, int(lower_median(steps))), SETBACK_NS)


def _by_arrival(stamps, keep, back, label, said):
    """Return the samples in order of arrival where only jitter turns stamps round, else None.

    A stamp older by more than jitter explains is a late message: it goes where it says, and so
    do those that overtook it.  What then still runs backwards by more than a setback is a clock
    that jumps.
    """
    steps = np.diff(stamps[keep])
    usual = int(lower_median(steps))
    if usual <= 0 or len(keep) < FILTER:
        return None
    place = np.arange(len(keep))
    t = (stamps[keep] - stamps[keep[0]]) / usual
    middle = running_median(t - place, window_for(deviation(steps) / usual))
    off = t - place - middle
    far = np.abs(off) > max(FAR * deviation(off), 0.75)
    far = _overtaken(off, far) & (np.abs(off) > 0.5)
    due = np.maximum.accumulate(np.where(far, -np.inf, place + middle))
    due[far] = t[far]
    order = keep[np.argsort(due, kind="stable")]
    if -np.diff(stamps[order]).min() > _setback(steps):
        return None
    said.append(f"{label}: {len(back)} stamp{'s' * (len(back) > 1)} reversed by jitter, the "
                "order of arrival is kept"
                + (f", {_samples(int(far.sum()))} out of it put in order" if far.any() else ""))
    return order


def _overtaken(off, far):
    """Tell which places lie between where a late message is due and where it came; (n,) bool.

    Stamps that are too young without any late message are jitter with a long tail.
    """
    late = np.flatnonzero(far & (off < 0))
    due = np.maximum(late + np.floor(off[late]).astype(np.int64), 0)
    edges = np.zeros(len(off) + 1, dtype=np.int64)
    np.add.at(edges, due, 1)
    np.add.at(edges, late + 1, -1)
    return np.cumsum(edges)[:-1] > 0


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


def _samples(count: int) -> str:
    return f"{count} sample{'s' * (count != 1)}"


JITTER = 0.02  # of the sample time; below it stamps count as exact
SNAP = 0.05  # the config's sample time is taken when the stamps agree this well
GAP = 2.5  # periods across which nothing is interpolated
ROUGH = 0.2  # spread of the steps, in steps, above which a missing sample hides in it


@dataclass(frozen=True)
class Grid:
    """How stamps lie on a uniform grid."""

    start: float  # first grid point, s
    step: float  # s
    index: np.ndarray  # (n,) int64 place of each sample; of no use when ``mode`` is ``instants``
    # ``exact`` (stamps on the grid), ``snapped`` (stamps jitter about it), ``instants`` (samples
    # were taken at their uneven stamps).
    mode: str
    # Root mean square of the stamps' distance from the grid, or of the steps' distance from whole
    # samples where the mode is ``instants``, s.
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
    step = usual if spread > ROUGH else float(np.mean(steps[np.abs(steps - usual) < 0.5 * usual]))
    target = simple_step(usual, nominal)
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


def simple_step(usual: float, nominal: float) -> float:
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


def _share_of_jitter(t: np.ndarray, index: np.ndarray, values: np.ndarray, step: float) -> float:
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


TOLD = 3  # gaps named one by one


def tell_gaps(columns: dict[str, np.ndarray], step: float, said: list[str]) -> None:
    """Say where rows are missing: of everything, then of single channels beyond that."""
    names, values = list(columns), tuple(columns.values())

    def spans(test):
        return spans_of((start, test(np.isfinite(np.stack(rows))))
                        for start, _, rows in blocks(*values))

    _tell_spans(*spans(lambda finite: ~finite.any(axis=0)), "no data", step, said)
    for place, name in enumerate(names):
        if not any_of((values[place],), np.isnan):
            continue
        starts, stops = spans(lambda finite, place=place: ~finite[place] & finite.any(axis=0))
        long = (stops - starts) * step > max(GAP * step, 0.01)  # single NaN have been counted
        _tell_spans(starts[long], stops[long], f"{name}: no data", step, said)
    let_go(*values)


def _tell_spans(starts: np.ndarray, stops: np.ndarray, what: str, step: float,
               said: list[str]) -> None:
    """Say where stretches of rows lie, the first ones by name."""
    for start, stop in list(zip(starts, stops, strict=True))[:TOLD]:
        said.append(f"{what} from {start * step:.3f} s for {(stop - start) * step:.3f} s")
    if len(starts) > TOLD:
        rest = np.sum(stops[TOLD:] - starts[TOLD:]) * step
        said.append(f"{what} in {len(starts) - TOLD} more gaps, {rest:.3f} s in all")


def filled(u: np.ndarray) -> np.ndarray:
    """Return the samples with short gaps bridged linearly, (n,)."""
    good = np.isfinite(u)
    if good.all() or not good.any():
        return u
    index = np.arange(len(u))
    return np.interp(index, index[good], u[good])
