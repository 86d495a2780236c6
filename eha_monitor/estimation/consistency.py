"""Whether the innovations are what the filter expects: right size, white at every scale."""

import math
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor import ties
from eha_monitor.estimation.results import Consistency, ParameterEstimate, Stage
from eha_monitor.quantity import SYMBOLS, number, quantity
from eha_monitor.recordings import columns
from eha_monitor.recordings.columns import blocks

LENGTHS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)  # samples in a block
# Verdict: a ratio must be beyond what chance gives AND large enough to matter.
SIGNIFICANCE = 6.0  # standard deviations of the ratio under white noise
HUGE = 1e4  # times the noise: a larger number tells nobody more
TOLERANCE = 1.6  # ratio of variances: the filters' own approximations stay below (measured)
SMALLEST_SAMPLES = 200
MOST_HOPPING, MOST_GROWING = 1.0 / 3.0, 0.7  # share of a record that may be left out
AROUND = 500  # samples beside a detected change that may still lag behind it
RESOLVED = 0.6  # quanta: a rounding error that stays the same for a while is this large
WINDOW = 100  # samples of the windows in which the worst place is sought
LOCAL = 25.0  # NIS of a window that is a mismatch by itself, however short (white: 1 +- 0.14)
PER_CHANGE = 400.0  # excess of squares that a seen change explains (measured on ramps: to 200)
GROSS = 25.0  # variance ratio
FIRST = 2.0  # NIS of a window that is taken for the beginning of a mismatch


def whitened(innovation: np.ndarray, stddev: np.ndarray) -> np.ndarray:
    """Return innovation/stddev with NaN where there is none; (n,)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return innovation / stddev


def variance_ratios(e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return block lengths and the variance of block sums over that of white noise.

    For white e of unit variance the sum over m samples has variance m; the ratio's standard
    deviation with k blocks is sqrt(2/k).

    ``e`` : (n,) whitened innovations without NaN.
    """
    sums = np.concatenate([[0.0], np.cumsum(e)])
    lengths, ratios = [], []
    for m in LENGTHS:
        blocks = len(e) // m
        if blocks < 8:
            break
        edges = sums[: blocks * m + 1 : m]
        lengths.append(m)
        ratios.append(np.mean(np.diff(edges) ** 2) / m)
    return np.array(lengths), np.array(ratios)


def normal_deviate(ratio: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Return how far a variance ratio of so many blocks is from 1, in standard deviations.

    By Wilson and Hilferty's cube root: with few blocks the ratio itself has a long tail, and what
    looks like six standard deviations comes by chance once a day at one look a second.
    """
    spread = 2.0 / (9.0 * blocks)
    return (np.cbrt(ratio) - (1.0 - spread)) / np.sqrt(spread)


def while_changing(n: int, changes: np.ndarray | None, whole: int = 0) -> list[tuple[int, int]]:
    """Return the stretches of samples that showed a change of the parameter, in order.

    A parameter that hops to and fro for more than a third of the record, or that never settles,
    is no fault that grows but a model that does not fit: then nothing is left out.  The record
    counts as ``whole`` samples long at least.
    """
    if changes is None or not len(changes):
        return []
    spans: list[tuple[int, int]] = []
    for sample, window in sorted(zip(changes[:, 0], changes[:, 3], strict=True)):
        around = max(window, AROUND)
        first = max(0, int(sample - 2 * around))
        last = min(n, max(0, int(sample + around) + 1))
        if spans and first <= spans[-1][1]:
            first, last = spans[-1][0], max(last, spans.pop()[1])
        spans.append((first, last))
    allowed = MOST_GROWING if one_way(changes) else MOST_HOPPING
    return spans if sum(b - a for a, b in spans) <= allowed * max(n, whole) else []


def _mask(spans: list[tuple[int, int]], start: int, stop: int) -> np.ndarray:
    """Return (stop - start,) bool, True on the samples within the stretches."""
    mask = np.zeros(stop - start, dtype=bool)
    for first, last in spans:
        mask[max(first - start, 0) : max(last - start, 0)] = True
    return mask


class _Squares:
    """Sums over whitened innovations, chunk after chunk, of whole blocks of every length."""

    WHOLE = math.lcm(*LENGTHS, WINDOW)  # samples in which all blocks and windows end

    def __init__(self, stride: int):
        self.samples, self.squares = 0, 0.0
        self.blocks = dict.fromkeys(LENGTHS, 0)
        self.sums = dict.fromkeys(LENGTHS, 0.0)
        self.stddevs: list[np.ndarray] = []
        self.loudest, self.loudest_at, self.windows = -np.inf, 0, 0
        self.loud_at: int | None = None
        self._stride, self._left = stride, (np.empty(0), np.empty(0), np.empty(0, np.int64))

    def add(self, values: np.ndarray, stddev: np.ndarray, index: np.ndarray,
            last: bool = False) -> None:
        """Take (m,) whitened innovations, their sigmas, and which samples they are of."""
        values, stddev, index = (np.concatenate(pair) for pair in zip(
            self._left, (values, stddev, index), strict=True))
        whole = len(values) if last else len(values) // self.WHOLE * self.WHOLE
        self._left = values[whole:], stddev[whole:], index[whole:]
        if whole:
            self._take(values[:whole], stddev[:whole], index[:whole])

    def _take(self, values: np.ndarray, stddev: np.ndarray, index: np.ndarray) -> None:
        self.stddevs.append(stddev[-self.samples % self._stride :: self._stride].copy())
        self.samples += len(values)
        self.squares += np.sum(values**2)
        sums = np.concatenate([[0.0], np.cumsum(values)])
        for m in LENGTHS:
            blocks = len(values) // m
            self.blocks[m] += blocks
            self.sums[m] += np.sum(np.diff(sums[: blocks * m + 1 : m]) ** 2)
        windows = len(values) // WINDOW
        if not windows:
            return
        local = (values[: windows * WINDOW] ** 2).reshape(windows, WINDOW).mean(axis=1)
        peak = ties.largest(local)
        if local[peak] > self.loudest:
            self.loudest = float(local[peak])
            self.loudest_at = int(index[min(peak * WINDOW + WINDOW // 2, len(index) - 1)])
        loud = np.flatnonzero(local > FIRST)
        if len(loud) and self.loud_at is None:
            self.loud_at = int(index[(loud[0] + 1) * WINDOW - 1])
        self.windows += windows

    def ratios(self) -> tuple[np.ndarray, np.ndarray]:
        """Return what :func:`variance_ratios` does."""
        lengths = [m for m in LENGTHS if self.blocks[m] >= 8]
        return np.array(lengths), np.array([self.sums[m] / self.blocks[m] / m for m in lengths])


def one_way(changes: np.ndarray) -> bool:
    """Tell whether a parameter drifts rather than hops to and fro; (k, 4) changes."""
    moves = changes[:, 2] - changes[:, 1]
    return abs(moves.sum()) > 0.5 * np.abs(moves).sum()


@dataclass(frozen=True)
class Window:
    """Which innovations are judged.

    Attributes
    ----------
    dt, start : sample time and time of the first sample, s.
    quantum : resolution of the measurement; slow errors below it are no mismatch.
    seconds : this is a window of so many seconds of a longer record: then a parameter that drifts
        may be a little behind also where it was not seen to change.
    """

    dt: float
    quantum: float = 0.0
    start: float = 0.0
    seconds: float = 0.0


_IMPOSSIBLE = {"B": "no friction drives", "beta_e": "no oil grows under pressure"}


def stage_verdict(stage: Stage, parameter: ParameterEstimate, innovation: np.ndarray,
                  stddev: np.ndarray, window: Window, changes: np.ndarray | None = None
                  ) -> Consistency | None:
    """Judge a stage's innovations, unless its parameter is not excited; see :func:`judge`.

    A model that nothing moves is not tested: zeros fit any.  A parameter that stays at its prior
    fits a little badly; only a gross misfit is the model's.  A damping that has to become negative
    in between makes the innovations white, but no friction drives.
    """
    verdict = judge(innovation, stddev, window, stage.words, stage.missing, changes)
    if verdict is None:
        return None
    if verdict.consistent and changes is not None and (changes[:, 2] < 0.0).any():
        worst = changes[ties.largest(-changes[:, 2])]
        began = float((worst[0] - worst[3]) * window.dt) + window.start
        verdict = replace(verdict, consistent=False, decisive=True, first_time_s=began, message=(
            f"{stage.words}: {SYMBOLS[parameter.name]} had to become "
            f"{quantity(worst[2], parameter.unit)} near t = "
            f"{worst[0] * window.dt + window.start:.2f} s, and {_IMPOSSIBLE[parameter.name]}: "
            f"{stage.missing}"))
    if parameter.status != "not_excited":
        return verdict
    return verdict if not verdict.consistent and verdict.variance_ratio > GROSS else None


def _times(variance_ratio: float) -> str:
    """Return in words how far a prediction is off, of its variance over what the noise makes."""
    size = float(np.sqrt(variance_ratio))
    return (f"{number(size, 3)} times the noise" if size < HUGE else
            f"more than {HUGE:g} times the noise")


def judge(innovation: np.ndarray, stddev: np.ndarray, window: Window, stage: str, missing: str,
          changes: np.ndarray | None = None) -> Consistency | None:
    """Judge one stage's innovations.

    Parameters
    ----------
    innovation, stddev : (n,) in the measurement's unit, NaN where nothing was measured.
    stage, missing : words for the sentence: which stage, and what a mismatch points to.
    changes : (k, 4) detected changes of the parameter; the samples that showed them are left
        out, unless that would be more than a third of the record.

    Returns
    -------
    Consistency or None
        None with fewer than 200 innovations: too few to judge.
    """
    dt = window.dt
    left_out = while_changing(len(innovation), changes, round(window.seconds / dt))
    seen = _Squares(-(-len(innovation) // columns.IN_MEMORY))
    for first, last, rows in blocks(innovation, stddev):
        e = whitened(*rows)
        index = np.flatnonzero(np.isfinite(e) & ~_mask(left_out, first, last))
        seen.add(e[index], rows[1][index], index + first, last == len(innovation))
    n = seen.samples
    if n < SMALLEST_SAMPLES:
        return None
    nis = float(seen.squares / n)
    lengths, ratios = seen.ratios()
    chance = np.sqrt(2.0 / (n // lengths))
    excess = (ratios - 1.0) / chance
    judged = np.where((excess > SIGNIFICANCE) & (ratios > TOLERANCE), ratios, 0.0)
    if window.quantum:
        # Root mean square of block means.
        size = np.sqrt(ratios / lengths) * float(np.median(np.concatenate(seen.stddevs)))
        judged[size <= RESOLVED * window.quantum] = 0.0
    if (changes is not None and len(changes) and one_way(changes)
            and (window.seconds or not left_out)):
        # A parameter that drifts is always a little behind: each change that was seen, and the
        # next one, explain so much of the excess.
        explained = PER_CHANGE * (len(changes) + 1)
        judged[(ratios - 1.0) * (n // lengths) <= explained] = 0.0
    worst = ties.largest(judged if judged.any() else ratios)
    ratio, length = float(ratios[worst]), int(lengths[worst])

    loudest = seen.loudest
    first_time = window.start + (seen.loud_at * dt if seen.loud_at is not None else 0.0)
    peak_time = seen.loudest_at * dt + window.start
    deviate = normal_deviate(ratios, n // lengths)
    decisive = bool(loudest >= LOCAL or ((judged > 0) & (deviate > SIGNIFICANCE)).any())
    consistent = not judged.any() and loudest < LOCAL
    if consistent:
        message = f"{stage}: off by no more than the noise, from one sample to the whole recording"
    elif judged.any():
        message = (f"{stage}: off by {_times(ratio)} over {length * dt:.3g} s, worst near "
                   f"t = {peak_time:.2f} s: {missing}")
    else:
        message = f"{stage}: off by {_times(loudest)} near t = {peak_time:.2f} s: {missing}"
    return Consistency(n, nis, ratio, length * dt, peak_time, bool(consistent), message,
                       first_time, decisive)
