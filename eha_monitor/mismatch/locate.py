"""Where model and recording disagree: balance, regime, intervals, and the missing term's shape."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from eha_monitor.mismatch.diagnosis import Curve, Location
from eha_monitor.mismatch.experiment import Experiment
from eha_monitor.mismatch.fit import Fit, filtered, tune, whitener, with_unknowns
from eha_monitor.mismatch.gains import Unknowns, smallest_unknowns
from eha_monitor.mismatch.innovations import FORCED
from eha_monitor.mismatch.missing import (
    erring_outputs,
    modelled_error,
    modelled_flow,
    modelled_force,
    modelled_speed,
    signals_along,
    without,
)
from eha_monitor.mismatch.rivals import latent_shares
from eha_monitor.mismatch.search import limits_of
from eha_monitor.mismatch.smooth import smoothed
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.plant import Y_FLOW, Y_FORCE, Y_SPEED

BALANCES = ("force", "flow", "drive", "sensor")
UNITS = {"force": "N", "flow": "m^3/s", "drive": "rad/s"}
STATES = {"force": Y_FORCE, "flow": Y_FLOW, "drive": Y_SPEED}
TIMES, BINS = 1200, 41  # points of a curve against time, and against anything else
FEWEST = 15  # samples in a bin that is shown
AFTER_REVERSAL = 0.1  # s
EXTREME = 0.2  # share of the samples that count as fast, loaded or near a limit
CLEARLY = 2.0  # times the mean square elsewhere: the regime is named
WINDOW, MOST_INTERVALS = 0.1, 8  # s of an interval's grain; intervals


def latent_curves(experiment: Experiment, before: Fit, after: Fit | None) -> tuple[Curve, ...]:
    """Return the missing term against time, velocity, position, pressure difference and speed.

    Parameters
    ----------
    before : nominal model, fitted.
    after : with the named effects, or None where nothing explains the mismatch.  With it,
        ``measured`` is what the record needs when the effects of that balance are switched off
        in ``after``: its B and beta_e, so that neither absorbs a part of the term.
    """
    curves: list[Curve] = []
    if after is None or not after.named:
        base = before
        states = smoothed(experiment, base)
        tracks = [signals_along(experiment, stretch, one)
                  for stretch, one in zip(experiment.stretches, states, strict=True)]
        small, large = limits_of(experiment)
        for i, balance in enumerate(("force", "flow", "drive")):
            if large.as_array()[i] > small.as_array()[i]:
                missing = [one[:, STATES[balance]] for one in states]
                curves += curves_of(experiment, balance, UNITS[balance], tracks, missing,
                                    [np.zeros(len(one)) for one in missing])
        return tuple(curves)
    found = {CATALOGUE[name].balance for name in after.named}
    for balance in BALANCES:
        if balance not in found:
            continue
        base = without(before, after, balance)
        names = tuple(name for name in after.named if CATALOGUE[name].balance == balance)
        outputs = erring_outputs(base, after)
        if outputs:
            curves += sensor_curves(experiment, base, after, balance, outputs)
        if balance in UNITS and set(names) != {"backlash"}:
            curves += balance_curves(experiment, base, after, balance, names)
    return tuple(curves)


def following(experiment: Experiment, base: Fit, balance: str) -> Fit:
    """Return a fit whose unknown of one balance follows what the record needs, no other."""
    small, large = limits_of(experiment)
    i = list(UNITS).index(balance)
    low, high = smallest_unknowns(experiment).as_array(), small.as_array()
    start = np.minimum(base.unknowns.as_array(), 10.0 * low)
    high = start.copy()
    high[i] = max(large.as_array()[i], 1e3 * low[i])
    start[i] = 300.0 * low[i]
    floor = start.copy()
    floor[i] = 10.0 * low[i]
    return tune(experiment, with_unknowns(experiment, base, Unknowns(*start)),
                Unknowns(*floor), Unknowns(*high), (10.0, 3.0))


def balance_curves(experiment: Experiment, base: Fit, after: Fit, balance: str,
                   names: tuple[str, ...]) -> list[Curve]:
    """Return the curves of a missing force, flow or speed."""
    states = smoothed(experiment, following(experiment, base, balance))
    tracks, missing, modelled = [], [], []
    for stretch, one in zip(experiment.stretches, states, strict=True):
        track = signals_along(experiment, stretch, one)
        tracks.append(track)
        missing.append(one[:, STATES[balance]])
        if balance == "force":
            modelled.append(modelled_force(experiment, after, track, names))
        elif balance == "flow":
            modelled.append(modelled_flow(experiment, after, track, names))
        else:
            modelled.append(modelled_speed(experiment, base, after, stretch, track))
    return curves_of(experiment, balance, UNITS[balance], tracks, missing, modelled)


def sensor_curves(experiment: Experiment, base: Fit, after: Fit, balance: str,
                  outputs: tuple[int, ...]) -> list[Curve]:
    """Return the curves of a sensor's error: what it shows beyond what all others imply."""
    used = experiment.used.copy()
    used[list(outputs)] = False
    if not used.any():
        return []
    others = replace(experiment, used=used)
    states = smoothed(others, with_unknowns(others, base, base.unknowns))
    curves = []
    for output in outputs:
        if not experiment.used[output]:
            continue
        tracks, missing, modelled = [], [], []
        for stretch, one in zip(experiment.stretches, states, strict=True):
            track = signals_along(experiment, stretch, one)
            tracks.append(track)
            place = {0: s.X, 2: s.P1, 3: s.P2}[output]
            missing.append(stretch.z[:, output] - track[:, place])
            modelled.append(modelled_error(after, track, output))
        curves += curves_of(experiment, balance, "m" if output == 0 else "Pa", tracks, missing,
                            modelled)
    return curves


def curves_of(experiment: Experiment, balance: str, unit: str, tracks: list[np.ndarray],
              measured: list[np.ndarray], modelled: list[np.ndarray]) -> list[Curve]:
    """Bin a missing term against everything that it may hang on."""
    keep = [stretch.counted | stretch.held_out for stretch in experiment.stretches]
    track = np.concatenate([t[k] for t, k in zip(tracks, keep, strict=True)])
    what = np.concatenate([m[k] for m, k in zip(measured, keep, strict=True)])
    model = np.concatenate([m[k] for m, k in zip(modelled, keep, strict=True)])
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


def location_of(experiment: Experiment, before: Fit, after: Fit | None,
                named: Mapping[str, float]) -> Location:
    """Say where model and recording disagree.

    Parameters
    ----------
    named : effect -> log evidence; empty where nothing in the catalogue explains the mismatch.
        Then ``after`` (with what is named all the same, or None) is asked for its unknowns.
    """
    if named:
        weight = dict.fromkeys(BALANCES, 0.0)
        for name, gain in named.items():
            weight[CATALOGUE[name].balance] += max(float(gain), 0.0)
        total = sum(weight.values())
        shares = {name: value / total if total > 0 else 0.0 for name, value in weight.items()}
    else:
        shares = latent_shares(experiment, after or before)
    suspect = before if named or after is None else after
    squares = excess_squares(experiment, suspect)
    return Location(shares, regime_of(experiment, suspect, squares),
                    worst_intervals(experiment, squares))


def excess_squares(experiment: Experiment, fit: Fit) -> list[np.ndarray]:
    """Return the mean square of the innovations over the sensors' noise, (n,) per stretch.

    The whitening is that of the quiet half of the record, so that what is wrong stands out and
    does not become its own yardstick.
    """
    columns = experiment.columns
    found = [filtered(experiment, stretch, fit.theta, fit.active, fit.gains)[0][:, columns]
             for stretch in experiment.stretches]
    w = whitener(fit.s)
    white = [np.nan_to_num(e) @ w.T for e in found]
    return [np.mean(np.minimum(one**2, 1e6), axis=1) for one in white]


def regime_of(experiment: Experiment, fit: Fit, squares: list[np.ndarray]) -> str:
    """Return the regime in which the innovations are clearly larger than elsewhere."""
    inside: dict[str, list[np.ndarray]] = {}
    keep = [stretch.counted | stretch.held_out for stretch in experiment.stretches]
    for where in regimes(experiment, fit):
        for name, mask in where.items():
            inside.setdefault(name, []).append(mask)
    whole = np.concatenate([q[k] for q, k in zip(squares, keep, strict=True)])
    best, ratio = "always", CLEARLY
    for name, masks in inside.items():
        mask = np.concatenate([m[k] for m, k in zip(masks, keep, strict=True)])
        if not 0.005 < mask.mean() < 0.6:
            continue
        found = np.mean(whole[mask]) / max(np.mean(whole[~mask]), 1e-12)
        if found > ratio:
            best, ratio = name, found
    return best


def regimes(experiment: Experiment, fit: Fit) -> list[dict[str, np.ndarray]]:
    """Return for each stretch regime -> (n,) bool."""
    tracks = []
    for stretch in experiment.stretches:
        _, states = filtered(experiment, stretch, fit.theta, fit.active, fit.gains, states=True)
        tracks.append(signals_along(experiment, stretch, states))
    whole = np.concatenate(tracks)
    fast = np.quantile(np.abs(whole[:, s.V]), 1 - EXTREME)
    loaded = np.quantile(np.abs(whole[:, s.P1] - whole[:, s.P2]), 1 - EXTREME)
    low, high = np.quantile(whole[:, s.X], [0.5 * EXTREME, 1 - 0.5 * EXTREME])
    turning = np.quantile(np.abs(whole[:, s.OMEGA]), 1 - 0.25 * EXTREME)
    found = []
    for track in tracks:
        v, dp = np.abs(track[:, s.V]), np.abs(track[:, s.P1] - track[:, s.P2])
        limit = (track[:, s.X] <= low) | (track[:, s.X] >= high)
        if turning > 0:
            limit = limit | (np.abs(track[:, s.OMEGA]) >= turning)
        found.append({"velocity_reversal": after_reversal(track[:, s.V], fast, experiment.dt),
                      "high_speed": v >= fast, "high_pressure": dp >= max(loaded, 1e-9),
                      "near_limit": limit})
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


def worst_intervals(experiment: Experiment, squares: list[np.ndarray]
                    ) -> tuple[tuple[float, float], ...]:
    """Return up to eight intervals, s of the recording, in which the innovations are worst."""
    grain = max(1, round(WINDOW / experiment.dt))
    rows: list[tuple[float, float, float]] = []
    for stretch, square in zip(experiment.stretches, squares, strict=True):
        count = len(square) // grain
        mean = np.where(stretch.counted | stretch.held_out, square, 0.0)[: count * grain]
        for i, value in enumerate(mean.reshape(count, grain).mean(axis=1)):
            start = stretch.start + i * grain * experiment.dt
            rows.append((start, start + grain * experiment.dt, float(value)))
    level = np.array([value for _, _, value in rows])
    if not len(level):
        return ()
    chosen = np.argsort(-level)[: 3 * MOST_INTERVALS]
    chosen = [i for i in chosen if level[i] > CLEARLY * np.median(level)]
    merged: list[list[float]] = []
    for i in sorted(chosen):
        start, stop, value = rows[i]
        if merged and start - merged[-1][1] < 0.5 * WINDOW:
            merged[-1][1], merged[-1][2] = stop, max(merged[-1][2], value)
        else:
            merged.append([start, stop, value])
    merged = sorted(merged, key=lambda row: -row[2])[:MOST_INTERVALS]
    return tuple((round(start, 4), round(stop, 4)) for start, stop, _ in sorted(merged))
