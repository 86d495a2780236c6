"""Where a missing term is at home: regime, intervals, and its shape against what it hangs on.

Both likelihoods bring their missing term here as parts of recordings.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.diagnosis import Curve

TIMES, BINS = 1200, 41  # points of a curve against time, and against anything else
FEWEST = 15  # samples in a bin that is shown
AFTER_REVERSAL = 0.1  # s
EXTREME = 0.2  # share of the samples that count as fast, loaded or near a limit
CLEARLY = 3.0  # times the mean square elsewhere: the regime is named
GRAIN, MOST_INTERVALS = 0.1, 8  # s of an interval's grain; intervals
SMOOTH = 0.02  # s over which a term's change is taken
MATERIAL = 0.3  # of a term's mean square: what it changes by at a reversal, squared, to count
# Where a term of each balance may be at home.
HOMES = {
    "force": ("velocity_reversal", "high_speed", "high_pressure", "near_limit"),
    "flow": ("velocity_reversal", "high_speed", "high_pressure", "near_limit"),
    "drive": ("velocity_reversal", "near_limit"),
    "sensor": ("velocity_reversal", "high_speed", "high_pressure", "near_limit"),
}


@dataclass(frozen=True)
class Part:
    """A missing term along a part of a recording, and the motion there; (n,) each, SI.

    Attributes
    ----------
    start, dt : s.
    x, v : position and velocity; ``dp``, ``omega`` None where nothing says.
    kept : bool, what counts.
    measured : what the record needs; NaN where it does not say.
    modelled : what the named effects make; None where nothing is named.
    """

    start: float
    dt: float
    x: np.ndarray
    v: np.ndarray
    dp: np.ndarray | None
    omega: np.ndarray | None
    kept: np.ndarray
    measured: np.ndarray
    modelled: np.ndarray | None = None

    @property
    def best(self) -> np.ndarray:
        """The modelled term, which has no noise, or else the measured one; 0 where unknown."""
        return np.nan_to_num(self.measured if self.modelled is None else self.modelled)


def curves_of(balance: str, unit: str, parts: Sequence[Part]) -> list[Curve]:
    """Bin a missing term against everything that it may hang on."""
    def joined(of):
        return np.concatenate([of(part)[part.kept] for part in parts])

    what = joined(lambda part: part.measured)
    model = joined(lambda part: np.zeros(len(part.x)) if part.modelled is None else part.modelled)
    against = [("time", "s", joined(lambda part: part.start + np.arange(len(part.x)) * part.dt)),
               ("velocity", "m/s", joined(lambda part: part.v)),
               ("position", "m", joined(lambda part: part.x))]
    for name, its_unit, of in (("pressure_difference", "Pa", lambda part: part.dp),
                               ("pump_speed", "rad/s", lambda part: part.omega)):
        if all(of(part) is not None for part in parts):
            against.append((name, its_unit, joined(of)))
    curves = []
    for name, its_unit, values in against:
        x, middle, width, shown = (over_time if name == "time" else binned)(values, what, model)
        if len(x):
            curves.append(Curve(balance, name, its_unit, unit, x, middle, width, shown))
    return curves


def over_time(time: np.ndarray, measured: np.ndarray, modelled: np.ndarray
              ) -> tuple[np.ndarray, ...]:
    """Return means and deviations over equal numbers of samples in turn."""
    good = np.isfinite(measured)
    block = max(1, int(np.ceil(good.sum() / TIMES)))
    count = good.sum() // block
    t, m, f = (values[good][: count * block].reshape(count, block)
               for values in (time, measured, modelled))
    return t.mean(axis=1), m.mean(axis=1), m.std(axis=1), f.mean(axis=1)


def binned(values: np.ndarray, measured: np.ndarray, modelled: np.ndarray
           ) -> tuple[np.ndarray, ...]:
    """Return bin centres, medians, half the width of the middle 68 %, and modelled medians."""
    good = np.isfinite(values) & np.isfinite(measured)
    values, measured, modelled = values[good], measured[good], modelled[good]
    if len(values) < FEWEST:
        return (np.zeros(0),) * 4
    low, high = np.quantile(values, [0.005, 0.995])
    if high <= low:
        return (np.zeros(0),) * 4
    edges = np.linspace(low, high, BINS + 1)
    which = np.digitize(values, edges) - 1
    order = np.argsort(which, kind="stable")
    cuts = np.searchsorted(which[order], np.arange(BINS + 1))
    rows = []
    for i in range(BINS):
        here = order[cuts[i] : cuts[i + 1]]
        if len(here) >= FEWEST:
            lower, middle, upper = np.quantile(measured[here], [0.16, 0.5, 0.84])
            rows.append((np.mean(values[here]), middle, 0.5 * (upper - lower),
                         np.median(modelled[here])))
    return tuple(np.array(rows).T) if rows else (np.zeros(0),) * 4


def regime_of(balance: str, parts: Sequence[Part]) -> tuple[str, list[np.ndarray]]:
    """Return the regime that a missing term is at home in, and its weight, (n,) per part.

    A term is at home where it is clearly larger than elsewhere; or, if it is much the same
    everywhere, at the reversals if that is where it changes.
    """
    masks = regimes(balance, parts)
    size = [part.best**2 for part in parts]
    change = [(AFTER_REVERSAL / part.dt * np.gradient(
        rolling(part.best, max(1, round(SMOOTH / part.dt)))))**2 for part in parts]

    def inside(name: str, weight: list[np.ndarray]) -> tuple[float, float]:
        mask = np.concatenate([m[name][p.kept] for m, p in zip(masks, parts, strict=True)])
        whole = np.concatenate([w[p.kept] for w, p in zip(weight, parts, strict=True)])
        if not 0.003 < mask.mean() < 0.6:
            return 0.0, max(float(np.mean(whole)), 1e-300)  # a term may be nil throughout
        return float(np.mean(whole[mask])), max(float(np.mean(whole[~mask])), 1e-300)

    def ratio(name: str, weight: list[np.ndarray]) -> float:
        here, elsewhere = inside(name, weight)
        return here / elsewhere

    sizes = {name: ratio(name, size) for name in HOMES[balance]}
    best = ties.best(sizes, sizes.get)
    if sizes[best] > CLEARLY:
        return best, size
    moves, _ = inside("velocity_reversal", change)
    everywhere = float(np.mean(np.concatenate(size)))
    if ratio("velocity_reversal", change) > CLEARLY and moves > MATERIAL * everywhere:
        return "velocity_reversal", change
    return "always", size


def rolling(values: np.ndarray, width: int) -> np.ndarray:
    """Return the centred mean of ``width`` samples, (n,)."""
    sums = np.cumsum(np.pad(values, (width // 2 + 1, width - 1 - width // 2), mode="edge"))
    return (sums[width:] - sums[:-width]) / width


def regimes(balance: str, parts: Sequence[Part]) -> list[dict[str, np.ndarray]]:
    """Return for each part regime -> (n,) bool."""
    def loads(part):
        return np.zeros(len(part.x)) if part.dp is None else np.abs(part.dp)

    def limited(part):
        return part.omega if balance == "drive" else part.x

    fast = np.quantile(np.abs(np.concatenate([part.v for part in parts])), 1 - EXTREME)
    loaded = np.quantile(np.concatenate([loads(part) for part in parts]), 1 - EXTREME)
    low, high = np.quantile(np.concatenate([limited(part) for part in parts]),
                            [0.25 * EXTREME, 1 - 0.25 * EXTREME])
    return [{
        "velocity_reversal": after_reversal(part.v, fast, part.dt),
        "high_speed": np.abs(part.v) >= fast,
        "high_pressure": loads(part) >= max(loaded, 1e-9),
        "near_limit": (limited(part) <= low) | (limited(part) >= high)} for part in parts]


def after_reversal(v: np.ndarray, fast: float, dt: float) -> np.ndarray:
    """Return (n,) bool: within 0.1 s after the velocity has turned, jitter at rest left out."""
    threshold = 0.02 * fast
    sign = np.where(np.abs(v) > threshold, np.sign(v), 0.0)
    last = np.maximum.accumulate(np.where(sign != 0, np.arange(len(v)), 0))
    held = sign[last]
    turned = np.flatnonzero(np.diff(held) != 0) + 1
    mask = np.zeros(len(v), dtype=bool)
    reach = max(1, round(AFTER_REVERSAL / dt))
    for k in turned:
        # The turn itself lies before the speed has grown past the threshold again.
        start = k
        while start > 0 and v[start - 1] * v[k] > 0:
            start -= 1
        mask[start : start + reach] = True
    return mask


def worst_intervals(parts: Sequence[Part], weight: Sequence[np.ndarray]
                    ) -> tuple[tuple[float, float], ...]:
    """Return up to eight intervals, s of the recording, in which a weight is largest."""
    rows: list[tuple[float, float, float]] = []
    for part, square in zip(parts, weight, strict=True):
        grain = max(1, round(GRAIN / part.dt))
        count = len(square) // grain
        mean = np.where(part.kept, square, 0.0)[: count * grain]
        for i, value in enumerate(mean.reshape(count, grain).mean(axis=1)):
            start = part.start + i * grain * part.dt
            rows.append((start, start + grain * part.dt, float(value)))
    level = np.array([value for _, _, value in rows])
    if not len(level):
        return ()
    chosen = ties.ordered(range(len(level)), level.__getitem__)[: 3 * MOST_INTERVALS]
    chosen = [i for i in chosen if level[i] > np.mean(level)]
    merged: list[list[float]] = []
    for i in sorted(chosen):
        start, stop, value = rows[i]
        if merged and abs(start - merged[-1][1]) < 0.5 * GRAIN:  # of one recording
            merged[-1][1], merged[-1][2] = stop, max(merged[-1][2], value)
        else:
            merged.append([start, stop, value])
    merged = ties.ordered(merged, lambda row: row[2])[:MOST_INTERVALS]
    return tuple((round(float(start), 4), round(float(stop), 4))
                 for start, stop, _ in sorted(merged))


def whole_of(parts: Sequence[Part]) -> tuple[tuple[float, float], ...]:
    """Return the parts themselves, s of the recording."""
    return tuple((round(float(part.start), 4), round(float(part.start + len(part.x) * part.dt), 4))
                 for part in parts[:MOST_INTERVALS])
