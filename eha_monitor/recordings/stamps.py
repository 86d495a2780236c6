"""Repair of time stamps: order, repeats, clock jumps, wild values."""

import numpy as np

BLOCK = 100_000  # samples worked on at once where memory would grow with the recording
FILTER = 21  # samples of the running median under little jitter
LONG_FILTER = 101  # and under much
ROUGH = 0.4  # spread of the steps, in steps, that is much jitter
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
    return FILTER if spread < ROUGH else LONG_FILTER


def running_median(values: np.ndarray, width: int) -> np.ndarray:
    """Median over ``width`` neighbours, in blocks, since the windows are copied; (n,)."""
    padded = np.pad(values, width // 2, "symmetric")
    windows = np.lib.stride_tricks.sliding_window_view(padded, width)
    return np.concatenate([np.median(windows[start:start + BLOCK], axis=1)
                           for start in range(0, len(values), BLOCK)])


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
    if far.any() and far.sum() < 0.1 * len(keep):
        said.append(f"{label}: {_samples(int(far.sum()))} with a stamp far off its neighbours' "
                    "dropped")
        return keep[~far]
    return keep


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
