"""The proof on data that the fit has not seen: free runs, whiteness, agreement of the parts."""

from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.filters.consistency import variance_ratios
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import FORCED, filled
from eha_monitor.mismatch.diagnosis import Agreement, Overlay, SignalFit, Value
from eha_monitor.mismatch.likelihood.along import signals_along
from eha_monitor.mismatch.likelihood.equation_error import low_pass
from eha_monitor.mismatch.likelihood.fit import Fit, filtered, refine, spread
from eha_monitor.mismatch.likelihood.innovations import N_FILTERED
from eha_monitor.mismatch.locate.missing import modelled_force
from eha_monitor.mismatch.show.sizes import filtered_tracks
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import ALL_NAMES
from eha_monitor.physics.plant import N_OUTPUTS, Y_P1, Y_P2, Y_V, Y_X

SIGNALS = ("position", "velocity", "pressure_1", "pressure_2", "pump_speed")
UNITS = ("m", "m/s", "Pa", "Pa", "rad/s")
BASE_UNITS = {"B": "N·s/m", "beta_e": "Pa"}
WINDOW = 0.5  # s that a model runs free
OVERLAY = 1.0  # s of an overlay
BLOCKS = 30  # fewest blocks of a variance ratio that is shown: chance stays below 1 +- 0.26
DERIVATIVES, BALANCE = 100.0, 20.0  # Hz: pass bands of v and a, and of the whole force balance
FEWEST = 500  # samples in a part whose parameters are fitted
WORSE = 1.02  # ratio of squared errors on unseen data that is beyond chance


@dataclass(frozen=True)
class FreeRuns:
    """A model let go on unseen data.

    Attributes
    ----------
    windows : (stretch, first, last + 1) in samples.
    e : for each stretch (n, N_OUTPUTS) measured less predicted, NaN outside the windows.
    """

    windows: tuple[tuple[int, int, int], ...]
    e: tuple[np.ndarray, ...]

    def residual(self, output: int) -> np.ndarray:
        """Return the residuals of one output, all windows joined; (k,), NaN left out."""
        whole = [e[:, output] for e in self.e]
        joined = np.concatenate(whole) if whole else np.zeros(0)
        return joined[np.isfinite(joined)]


def rms(values: np.ndarray) -> float:
    """Return the root mean square, NaN of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def unseen(experiment: Experiment) -> list[np.ndarray]:
    """Return for each stretch (n,) bool, the samples that the fit has not seen.

    An experiment that holds nothing out is another recording: all of it is unseen.
    """
    if any(stretch.held_out.any() for stretch in experiment.stretches):
        return [stretch.held_out for stretch in experiment.stretches]
    return [stretch.counted for stretch in experiment.stretches]


def windows_of(experiment: Experiment, window: float) -> list[tuple[int, int, int]]:
    """Return the held-out windows of ``window`` s: (stretch, first, last + 1)."""
    length = max(2, round(window / experiment.dt))
    found = []
    for i, mask in enumerate(unseen(experiment)):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            for first in range(int(start), int(stop), length):
                last = min(first + length, int(stop))
                if last - first >= length // 2:
                    found.append((i, first, last))
    return found


def free_runs(experiment: Experiment, fit: Fit, window: float = WINDOW) -> FreeRuns:
    """Let a model run free over short windows of the held-out samples.

    Each window starts from the state that the model's own filter has reached.  The unknown
    force, flow and speed are not zeroed there: they die out within 20 ms by their own equation,
    and a start that threw them away would only add a jolt to the model that needs them.
    Neighbouring windows are run in two passes, so that the filter finds back in between.
    """
    windows = windows_of(experiment, window)
    kept = [np.full((len(stretch), N_OUTPUTS), np.nan) for stretch in experiment.stretches]

    def one(task: tuple[int, int]) -> None:
        i, turn = task
        mine = [w for w in windows if w[0] == i][turn::2]
        if not mine:
            return
        stretch = experiment.stretches[i]
        free = np.zeros(len(stretch), dtype=np.bool_)
        for _, first, last in mine:
            free[first:last] = True
        e, _ = filtered(experiment, stretch, fit.theta, fit.active, fit.gains, free=free)
        kept[i][free] = e[free]

    spread(one, [(i, turn) for i in range(len(kept)) for turn in (0, 1)])
    return FreeRuns(tuple(windows), tuple(kept))


def whiteness(experiment: Experiment, fit: Fit) -> np.ndarray:
    """Return the largest variance ratio of block sums of each output, (N_OUTPUTS,); 1 is white.

    One-step innovations of the held-out samples, over their own deviation; NaN where there are
    too few.
    """
    parts = [filtered(experiment, stretch, fit.theta, fit.active, fit.gains)[0][mask]
             for stretch, mask in zip(experiment.stretches, unseen(experiment), strict=True)
             if mask.any()]
    found = np.full(N_OUTPUTS, np.nan)
    whole = np.concatenate(parts) if parts else np.zeros((0, N_OUTPUTS))
    for j in experiment.columns:
        e = whole[np.isfinite(whole[:, j]), j]
        size = rms(e)
        if len(e) < BLOCKS or not 0 < size < 1e20:
            continue
        lengths, ratios = variance_ratios(e / size)
        enough = len(e) // lengths >= BLOCKS
        found[j] = float(ratios[enough].max()) if enough.any() else np.nan
    return found


def shown(experiment: Experiment, before: Fit, after: Fit | None,
          window: float = WINDOW) -> dict[str, SignalFit]:
    """Return how far both models miss what they have not seen, signal by signal.

    Parameters
    ----------
    experiment : with held-out samples, or another recording of the rig without.
    after : the model with the named effects; None where there is none: then as before.
    window : length of the free runs, s.

    Returns
    -------
    dict
        ``position``, ``velocity``, ``pressure_1``, ``pressure_2``, ``pump_speed`` where measured,
        and ``force`` where the force drives the model.
    """
    models = [before] if after is None or after is before else [before, after]
    runs = [free_runs(experiment, fit, window) for fit in models]
    white = spread(lambda fit: whiteness(experiment, fit), models)
    found = {}
    for j in experiment.columns:
        residuals = [run.residual(j) for run in runs]
        if not len(residuals[0]):
            continue
        errors = [rms(residual) for residual in residuals]
        found[SIGNALS[j]] = SignalFit(UNITS[j], errors[0], errors[-1], float(experiment.noise[j]),
                                      float(white[0][j]), float(white[-1][j]))
    if experiment.mode == FORCED and found:
        forces = [force_residual(experiment, fit) for fit in models]
        found["force"] = SignalFit("N", forces[0][0], forces[-1][0], float("nan"),
                                   signal_rms=forces[-1][1])
    return found


def worse(signals: dict[str, SignalFit]) -> bool:
    """Tell whether the error on unseen data, in units of the noise, has grown."""
    pairs = [(fit.before_rms / fit.noise_rms, fit.after_rms / fit.noise_rms)
             for fit in signals.values() if fit.noise_rms > 0]
    return sum(after**2 for _, after in pairs) > WORSE * sum(before**2 for before, _ in pairs)


def force_residual(experiment: Experiment, fit: Fit) -> tuple[float, float]:
    """Return rms residual and rms force of the force balance on held-out samples, N.

    M v' + B v + effects against the measured force, with v and v' from the position; every term
    goes through the same zero-phase low-pass, so that nothing is lagged against another.
    """
    dt = experiment.dt
    residuals, forces = [], []
    for stretch, mask in zip(experiment.stretches, unseen(experiment), strict=True):
        n = len(stretch)
        if not mask.any() or n < 200:
            continue
        smooth = low_pass(min(DERIVATIVES, 0.2 / dt), dt)
        x = smooth(filled(stretch.z[:, 0]))
        v = np.gradient(x, dt)
        a = np.gradient(v, dt)
        states = np.zeros((n, N_FILTERED))
        states[:, Y_X], states[:, Y_V] = x, v
        states[:, Y_P1], states[:, Y_P2] = stretch.p1, stretch.p2
        track = signals_along(experiment, stretch, states)
        names = tuple(name for name, on in zip(ALL_NAMES, fit.active, strict=True) if on)
        model = (fit.theta[s.M] * a + fit.theta[s.B] * v
                 + modelled_force(experiment, fit, track, names))
        both = low_pass(min(BALANCE, 0.1 / dt), dt)
        force = both(driving_force(experiment, fit, stretch))
        residuals.append((force - both(model))[mask])
        forces.append(force[mask])
    if not residuals:
        return float("nan"), float("nan")
    return rms(np.concatenate(residuals)), rms(np.concatenate(forces))


def driving_force(experiment: Experiment, fit: Fit, stretch) -> np.ndarray:
    """Return the force that drives the piston, N (n,)."""
    if experiment.mode == FORCED:
        return stretch.u[:, 0]
    return fit.theta[s.AREA_1] * stretch.p1 - fit.theta[s.AREA_2] * stretch.p2


def overlays(experiment: Experiment, before: Fit, after: Fit | None,
             window: float = OVERLAY) -> tuple[Overlay, ...]:
    """Return for each signal the held-out second in which the model before is worst.

    Both models run free in it.
    """
    run_1 = free_runs(experiment, before, window)
    run_2 = run_1 if after is None else free_runs(experiment, after, window)
    found = []
    for j in experiment.columns:
        errors = []
        for i, first, last in run_1.windows:
            e = run_1.e[i][first:last, j]
            errors.append(rms(e[np.isfinite(e)]))
        if not np.isfinite(errors).any():
            continue
        i, first, last = run_1.windows[int(np.nanargmax(errors))]
        stretch = experiment.stretches[i]
        z = stretch.z[first:last, j]
        found.append(Overlay(
            SIGNALS[j], UNITS[j], stretch.start + np.arange(first, last) * experiment.dt, z,
            z - run_1.e[i][first:last, j], z - run_2.e[i][first:last, j]))
    return tuple(found)


def parts_of(experiment: Experiment, tracks: list[np.ndarray]
             ) -> list[tuple[str, list[np.ndarray]]]:
    """Return (name, counted mask of each stretch) of slow and fast, small and large."""
    speeds = [np.abs(track[:, s.V]) for track in tracks]
    loads = [np.abs(track[:, s.P1] - track[:, s.P2]) for track in tracks]
    counted = [stretch.counted for stretch in experiment.stretches]
    found = []
    for values, low, high in ((speeds, "slow half", "fast half"),
                              (loads, "small pressure differences", "large pressure differences")):
        whole = np.concatenate([v[c] for v, c in zip(values, counted, strict=True)])
        if not len(whole) or np.ptp(whole) == 0:
            continue
        middle = np.median(whole)
        below = [v <= middle for v in values]
        for name, masks in ((low, below), (high, [~m for m in below])):
            both = [m & c for m, c in zip(masks, counted, strict=True)]
            if sum(int(m.sum()) for m in both) >= FEWEST:
                found.append((name, both))
    return found


def agreement(experiment: Experiment, before: Fit, after: Fit | None,
              tracks: list[np.ndarray] | None = None) -> tuple[Agreement, ...]:
    """Return B and beta_e from parts of the record, all else held.

    A model that lacks nothing finds the same in each of them.  ``tracks`` : signals along each
    stretch, (n, N_SIGNALS) each, where they are at hand; else the filter's.
    """
    models = [before] if after is None or after is before else [before, after]
    parts = parts_of(experiment, filtered_tracks(experiment, models[-1])
                     if tracks is None else tracks)

    def one(task: tuple[list[np.ndarray], Fit]) -> dict[str, Value]:
        masks, fit = task
        some = experiment.only(tuple(
            replace(stretch, counted=mask)
            for stretch, mask in zip(experiment.stretches, masks, strict=True)))
        base = replace(fit, free=tuple(f for f in fit.free if f.name in BASE_UNITS))
        found = refine(some, base, steps=2, tolerance=1.0)
        return {f.name: Value(found.value(f.name), found.stddev(f.name), BASE_UNITS[f.name])
                for f in base.free}

    values = spread(one, [(masks, fit) for _, masks in parts for fit in models])
    k = len(models)
    return tuple(Agreement(name, values[k * i], values[k * i + k - 1])
                 for i, (name, _) in enumerate(parts))
