"""Where model and recording disagree: balance, regime, intervals, and the missing term's shape."""

from collections.abc import Mapping, Sequence

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import FORCED
from eha_monitor.mismatch.diagnosis import Curve, Location
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.mismatch.likelihood.smooth import smoothed
from eha_monitor.mismatch.locate.latent import latent_gains, shares_of
from eha_monitor.mismatch.locate.terms import (
    BALANCES,
    STATES,
    UNITS,
    Missing,
    following,
    missing_terms,
    sensor_errors,
    tracks_of,
)
from eha_monitor.mismatch.name.base import limits_of
from eha_monitor.mismatch.name.unnamed import INTERMITTENT
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE

TIMES, BINS = 1200, 41  # points of a curve against time, and against anything else
FEWEST = 15  # samples in a bin that is shown
AFTER_REVERSAL = 0.1  # s
EXTREME = 0.2  # share of the samples that count as fast, loaded or near a limit
CLEARLY = 3.0  # times the mean square elsewhere: the regime is named
GRAIN, MOST_INTERVALS = 0.1, 8  # s of an interval's grain; intervals
SMOOTH = 0.02  # s over which a term's change is taken
MATERIAL = 0.3  # of a term's mean square: what it changes by at a reversal, squared, to count
LEFT = 30.0  # times the smallest unknowns: the named effects leave something behind
LEARNED = "learned."  # before the balance of a term that was learned
# Where a term of each balance may be at home.
HOMES = {
    "force": ("velocity_reversal", "high_speed", "high_pressure", "near_limit"),
    "flow": ("velocity_reversal", "high_speed", "high_pressure", "near_limit"),
    "drive": ("velocity_reversal", "near_limit"),
    "sensor": ("velocity_reversal", "high_speed", "high_pressure", "near_limit"),
}


def latent_curves(experiment: Experiment, before: Fit, after: Fit | None,
                  terms: Sequence[Missing] | None = None) -> tuple[Curve, ...]:
    """Return the missing term against time, velocity, position, pressure difference and speed.

    Parameters
    ----------
    before : nominal model, fitted.
    after : with the named effects; None, or without names, where nothing explains the mismatch:
        then the unknown force, flow and speed are shown beside a modelled term of zero.
    terms : :func:`missing_terms`, where they are at hand.
    """
    terms = missing_terms(experiment, before, after) if terms is None else terms
    return tuple(curve for term in terms for curve in curves_of(experiment, term))


def curves_of(experiment: Experiment, term: Missing) -> list[Curve]:
    """Bin a missing term against everything that it may hang on."""
    keep = [stretch.counted | stretch.held_out for stretch in experiment.stretches]

    def joined(parts):
        return np.concatenate([part[k] for part, k in zip(parts, keep, strict=True)])

    track, what = joined(term.tracks), joined(term.measured)
    model = np.zeros(len(what)) if term.modelled is None else joined(term.modelled)
    time = np.concatenate([stretch.start + np.flatnonzero(k) * experiment.dt
                           for stretch, k in zip(experiment.stretches, keep, strict=True)])
    against = [("time", "s", time), ("velocity", "m/s", track[:, s.V]),
               ("position", "m", track[:, s.X])]
    pressures = any(np.ptp(stretch.p1 - stretch.p2) > 0 for stretch in experiment.stretches)
    if experiment.mode != FORCED or pressures:
        against.append(("pressure_difference", "Pa", track[:, s.P1] - track[:, s.P2]))
    if experiment.mode != FORCED:
        against.append(("pump_speed", "rad/s", track[:, s.OMEGA]))
    curves = []
    for name, its_unit, values in against:
        x, middle, width, shown = (over_time if name == "time" else binned)(values, what, model)
        if len(x):
            curves.append(Curve(term.balance, name, its_unit, term.unit, x, middle, width, shown))
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


def told_location(experiment: Experiment, term: Missing) -> Location:
    """Return where a model's own term acts: all of the disagreement is in its balance."""
    return located(experiment, {name: float(name == term.balance) for name in BALANCES}, term)


def located(experiment: Experiment, shares: dict[str, float], term: Missing) -> Location:
    """Return where a missing term is worst, beside the shares of the balances."""
    regime, weight = regime_of(experiment, term)
    return Location(shares, regime, worst_intervals(experiment, weight) if regime != "always"
                    else whole_of(experiment))


def location_of(experiment: Experiment, before: Fit, after: Fit | None,
                named: Mapping[str, float], terms: Sequence[Missing] | None = None) -> Location:
    """Say where model and recording disagree.

    Parameters
    ----------
    named : effect, ``rig.<key>`` or ``learned.<balance>`` -> log evidence; empty where nothing
        explains the mismatch.  What the named effects leave behind counts beside them.
    terms : :func:`missing_terms` of the named effects, where they are at hand.
    """
    weights = dict.fromkeys(BALANCES, 0.0)
    for name, gain in named.items():
        weights[balance_of(name)] += max(float(gain), 0.0)
    known, outputs = sum(weights.values()), []
    last = before if after is None else after
    small = limits_of(experiment)[0].as_array()
    if not known or (last.unknowns.as_array() > LEFT * small).any():
        gains = latent_gains(experiment, last)
        shares, best, outputs = shares_of(gains)
        if not known or best > 0.1 * known:
            for balance, share in shares.items():
                weights[balance] += share * best
    total = sum(weights.values())
    if total <= 0.0:
        return Location(weights, "", ())
    shares = {balance: weight / total for balance, weight in weights.items()}
    balance = ties.best(shares, shares.get)
    mine = [term for term in terms or [] if term.balance == balance]
    if not mine and any(balance_of(name) == balance for name in named if name in CATALOGUE):
        mine = [term for term in missing_terms(experiment, before, after)
                if term.balance == balance]
    if not mine and balance in UNITS:
        states = smoothed(experiment, following(experiment, last, balance))
        mine = [Missing(balance, UNITS[balance], tracks_of(experiment, states),
                        tuple(one[:, STATES[balance]] for one in states))]
    elif not mine:
        mine = sensor_errors(experiment, last, balance, outputs)
    if not mine:
        return Location(shares, "always", whole_of(experiment))
    return located(experiment, shares, mine[-1])


def balance_of(name: str) -> str:
    """Return the balance of an effect, a number of the rig (``rig.<key>``), a learned term."""
    if name in CATALOGUE:
        return CATALOGUE[name].balance
    if name.startswith(LEARNED):
        return name.removeprefix(LEARNED)
    key = name.removeprefix("rig.")
    return ("force" if key in ("mass", "area_1", "area_2", INTERMITTENT)
            else "drive" if key == "position_gain" else "flow")


def regime_of(experiment: Experiment, term: Missing) -> tuple[str, list[np.ndarray]]:
    """Return the regime that a missing term is at home in, and its weight, (n,) per stretch.

    A term is at home where it is clearly larger than elsewhere; or, if it is much the same
    everywhere, at the reversals if that is where it changes.
    """
    keep = [stretch.counted | stretch.held_out for stretch in experiment.stretches]
    masks = regimes(experiment, term)
    values = [np.nan_to_num(one) for one in term.best]
    size = [one**2 for one in values]
    change = [(AFTER_REVERSAL / experiment.dt * np.gradient(
        rolling(one, max(1, round(SMOOTH / experiment.dt)))))**2 for one in values]

    def inside(name: str, weight: list[np.ndarray]) -> tuple[float, float]:
        mask = np.concatenate([m[name][k] for m, k in zip(masks, keep, strict=True)])
        whole = np.concatenate([w[k] for w, k in zip(weight, keep, strict=True)])
        if not 0.003 < mask.mean() < 0.6:
            return 0.0, max(float(np.mean(whole)), 1e-300)  # a term may be nil throughout
        return float(np.mean(whole[mask])), max(float(np.mean(whole[~mask])), 1e-300)

    def ratio(name: str, weight: list[np.ndarray]) -> float:
        here, elsewhere = inside(name, weight)
        return here / elsewhere

    sizes = {name: ratio(name, size) for name in HOMES[term.balance]}
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


def regimes(experiment: Experiment, term: Missing) -> list[dict[str, np.ndarray]]:
    """Return for each stretch regime -> (n,) bool."""
    whole = np.concatenate(term.tracks)
    fast = np.quantile(np.abs(whole[:, s.V]), 1 - EXTREME)
    loaded = np.quantile(np.abs(whole[:, s.P1] - whole[:, s.P2]), 1 - EXTREME)
    limited = s.OMEGA if term.balance == "drive" else s.X
    low, high = np.quantile(whole[:, limited], [0.25 * EXTREME, 1 - 0.25 * EXTREME])
    found = []
    for track in term.tracks:
        dp = np.abs(track[:, s.P1] - track[:, s.P2])
        found.append({
            "velocity_reversal": after_reversal(track[:, s.V], fast, experiment.dt),
            "high_speed": np.abs(track[:, s.V]) >= fast,
            "high_pressure": dp >= max(loaded, 1e-9),
            "near_limit": (track[:, limited] <= low) | (track[:, limited] >= high)})
    return found


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


def worst_intervals(experiment: Experiment, weight: list[np.ndarray]
                    ) -> tuple[tuple[float, float], ...]:
    """Return up to eight intervals, s of the recording, in which a weight is largest."""
    grain = max(1, round(GRAIN / experiment.dt))
    rows: list[tuple[float, float, float]] = []
    for stretch, square in zip(experiment.stretches, weight, strict=True):
        count = len(square) // grain
        mean = np.where(stretch.counted | stretch.held_out, square, 0.0)[: count * grain]
        for i, value in enumerate(mean.reshape(count, grain).mean(axis=1)):
            start = stretch.start + i * grain * experiment.dt
            rows.append((start, start + grain * experiment.dt, float(value)))
    level = np.array([value for _, _, value in rows])
    if not len(level):
        return ()
    chosen = ties.ordered(range(len(level)), level.__getitem__)[: 3 * MOST_INTERVALS]
    chosen = [i for i in chosen if level[i] > np.mean(level)]
    merged: list[list[float]] = []
    for i in sorted(chosen):
        start, stop, value = rows[i]
        if merged and start - merged[-1][1] < 0.5 * GRAIN:
            merged[-1][1], merged[-1][2] = stop, max(merged[-1][2], value)
        else:
            merged.append([start, stop, value])
    merged = ties.ordered(merged, lambda row: row[2])[:MOST_INTERVALS]
    return tuple((round(float(start), 4), round(float(stop), 4))
                 for start, stop, _ in sorted(merged))


def whole_of(experiment: Experiment) -> tuple[tuple[float, float], ...]:
    """Return the stretches themselves, s of the recording."""
    return tuple((round(float(stretch.start), 4),
                  round(float(stretch.start + len(stretch) * experiment.dt), 4))
                 for stretch in experiment.stretches[:MOST_INTERVALS])
