"""The proof on data that the fit has not seen: free runs, whiteness, agreement of the parts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.balances.baseline import Baseline
from eha_monitor.balances.course import STANDING
from eha_monitor.estimation.consistency import variance_ratios
from eha_monitor.estimation.results import units_of
from eha_monitor.estimation.sensors import true_position, true_pressure
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import FORCED, Stretch
from eha_monitor.mismatch.diagnosis import Agreement, Gate, Overlay, SignalFit, Value
from eha_monitor.mismatch.likelihood.along import filtered_tracks, played, signals_along
from eha_monitor.mismatch.likelihood.fit import Fit, filtered, spread
from eha_monitor.mismatch.likelihood.innovations import N_FILTERED
from eha_monitor.mismatch.locate.terms import modelled_force
from eha_monitor.mismatch.name.refit import Slopes, polished
from eha_monitor.mismatch.policy import SearchPolicy
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import ALL_NAMES, circuit_of
from eha_monitor.physics.plant import N_OUTPUTS, Y_P1, Y_P2, Y_V, Y_X
from eha_monitor.quantity import quantity, share
from eha_monitor.recordings.columns import stretches
from eha_monitor.recordings.grid import filled

SIGNALS = ("position", "velocity", "pressure_1", "pressure_2", "pump_speed")
UNITS = ("m", "m/s", "Pa", "Pa", "rad/s")
WINDOW = 0.5  # s that a model runs free
OVERLAY = 1.0  # s of an overlay
BLOCKS = 30  # fewest blocks of a variance ratio that is shown: chance stays below 1 +- 0.26
DERIVATIVES, BALANCE = 100.0, 20.0  # Hz: pass bands of v and a, and of the whole force balance
FEWEST = 500  # samples in a part whose parameters are fitted


@dataclass(frozen=True)
class FreeRuns:
    """A model let go on unseen data."""

    windows: tuple[tuple[int, int, int], ...]  # (stretch, first, last + 1) in samples
    # For each stretch (n, N_OUTPUTS) measured less predicted, NaN outside the windows
    e: tuple[np.ndarray, ...]

    def residual(self, output: int) -> np.ndarray:
        """Return the residuals of one output, all windows joined; (k,), NaN left out."""
        joined = np.concatenate([e[:, output] for e in self.e])
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
        for start, stop in stretches(mask).tolist():
            for first in range(start, stop, length):
                last = min(first + length, stop)
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


def shown(experiment: Experiment, before: Fit, after: Fit) -> dict[str, SignalFit]:
    """Return how far both models miss what they have not seen, signal by signal.

    Parameters
    ----------
    experiment : with held-out samples, or another recording of the rig without.
    after : the model with the named effects; ``before`` where there are none.

    Returns
    -------
    dict
        ``position``, ``velocity``, ``pressure_1``, ``pressure_2``, ``pump_speed`` where measured,
        and ``force`` where the force drives the model.
    """
    models = [before] if after is before else [before, after]
    runs = [free_runs(experiment, fit) for fit in models]
    white = spread(lambda fit: whiteness(experiment, fit), models)
    found = {}
    for j in experiment.columns:
        residuals = [run.residual(j) for run in runs]
        if not len(residuals[0]):
            continue
        errors = [rms(residual) for residual in residuals]
        measured = np.concatenate([stretch.z[mask, j] for stretch, mask in zip(
            experiment.stretches, unseen(experiment), strict=True)])
        found[SIGNALS[j]] = SignalFit(UNITS[j], errors[0], errors[-1], float(experiment.noise[j]),
                                      float(white[0][j]), float(white[-1][j]),
                                      float(np.nanstd(measured)))
    if (experiment.mode == FORCED or experiment.used[[Y_P1, Y_P2]].all()) and found:
        forces = [force_residual(experiment, fit) for fit in models]
        found["force"] = SignalFit("N", forces[0][0], forces[-1][0], float("nan"),
                                   signal_rms=forces[-1][1])
    return found


def unseen_gates(signals: dict[str, SignalFit], policy: SearchPolicy) -> tuple[Gate, ...]:
    """Return where a model does worse on unseen data than the one before.

    In any signal or balance by more than the share ``worse`` of that signal's size, or of the
    squares of all of them together, in units of their noise.
    """
    found = [Gate("unseen_error", name, f"on unseen data the error of {name.replace('_', ' ')} "
                  f"grows from {quantity(fit.before_rms, fit.unit, 3)} to "
                  f"{quantity(fit.after_rms, fit.unit, 3)}")
             for name, fit in signals.items()
             if fit.after_rms - fit.before_rms > policy.worse * fit.signal_rms]
    pairs = [(fit.before_rms / fit.noise_rms, fit.after_rms / fit.noise_rms)
             for fit in signals.values() if fit.noise_rms > 0]
    before, after = (sum(one[i] ** 2 for one in pairs) for i in (0, 1))
    if not found and after > (1.0 + policy.worse) * before:
        found.append(Gate("unseen_error", "all signals", "on unseen data the errors of all "
                          f"signals together grow by {share(np.sqrt(after / before) - 1.0)}"))
    return tuple(found)


def baseline_gates(experiment: Experiment, baselines: Sequence[Baseline], after: Fit,
                   force: SignalFit | None) -> tuple[Gate, ...]:
    """Return the gate of a model whose force balance ten lines of least squares beat.

    On samples that the model's fit has not seen.  The least squares have, but four numbers from
    thousands of samples gain nothing by that beside the share ``worse``.

    ``force`` : what the model leaves of it there (:func:`shown`); None where none is measured.
    """
    of = {one.source: one for one in baselines if one.force is not None}
    if force is None or not {stretch.source for stretch in experiment.stretches} <= of.keys():
        return ()
    left, first = force.after_rms, baseline_residual(experiment, of, after)
    if not left - first > experiment.policy.worse * force.signal_rms:
        return ()
    return (Gate("unseen_error", "force", "least squares on the force balance leave "
                 f"{quantity(first, 'N', 3)} on unseen data, the model {quantity(left, 'N', 3)}"),)


def without_answer(signals: dict[str, SignalFit]) -> dict[str, SignalFit]:
    """Return the errors on unseen data where no model is the answer: the nominal one's."""
    return {name: replace(fit, after_rms=fit.before_rms, after_whiteness=fit.before_whiteness)
            for name, fit in signals.items()}


def low_pass(cutoff: float, dt: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a zero-phase low-pass (Butterworth, fourth order, both ways) of ``cutoff`` Hz."""
    from scipy.signal import butter, sosfiltfilt  # takes half of the start of ``diagnose``

    sections = butter(4, cutoff, fs=1.0 / dt, output="sos")
    return lambda values: sosfiltfilt(sections, values)


def force_residual(experiment: Experiment, fit: Fit) -> tuple[float, float]:
    """Return rms residual and rms force of the force balance on held-out samples, N.

    M v' + B v + effects against the measured force, with v and v' from the position; every term
    goes through the same zero-phase low-pass, so that nothing is lagged against another.  What
    the model says the sensors err by is taken off first.
    """
    def modelled(stretch, x, v, a):
        states = np.zeros((len(x), N_FILTERED))
        states[:, Y_X], states[:, Y_V] = x, v
        states[:, Y_P1], states[:, Y_P2] = stretch.p1, stretch.p2
        track = signals_along(experiment, stretch, states)
        names = tuple(name for name, on in zip(ALL_NAMES, fit.active, strict=True) if on)
        return (fit.theta[s.M] * a + fit.theta[s.B] * v
                + modelled_force(experiment, fit, track, names))

    return force_left(experiment, fit, modelled)


def baseline_residual(experiment: Experiment, of: Mapping[str, Baseline], after: Fit) -> float:
    """Return rms residual of the least-squares balances on the same held-out samples, N.

    The noise of an acceleration is part of M a, and a regression leaves less of it with a smaller
    mass (errors in variables): 13.9 kg of 18.5 left 0.8 N where the true mass leaves 3.8.  So
    they have the mass of ``after``, unless that calls the config's wrong.

    ``of`` : source -> first view of that recording; its sensors err by what ``after`` says.
    """
    named = set(after.named) & {"rig.mass", "added_mass"}

    def modelled(stretch, x, v, a):
        first = of[stretch.source].force
        standing = STANDING * np.quantile(np.abs(v), 0.998)
        mass = first["M"].value if named else after.theta[s.M]
        return (mass * a + first["B"].value * v + first["F_0"].value
                + first["F_c"].value * np.clip(v / max(standing, 1e-12), -1.0, 1.0))

    return force_left(experiment, after, modelled)[0]


def force_left(experiment: Experiment, fit: Fit, modelled: Callable) -> tuple[float, float]:
    """Return rms of what a model leaves of the force on held-out samples, and of the force, N.

    ``fit`` : whose sensors and areas the measured force and motion are taken from.
    ``modelled`` : (stretch, x, v, a) -> (n,) N.
    """
    dt = experiment.dt
    residuals, forces = [], []
    for stretch, mask in zip(experiment.stretches, unseen(experiment), strict=True):
        if not mask.any() or len(stretch) < 200:
            continue
        stretch = righted(experiment, fit, stretch)
        smooth = low_pass(min(DERIVATIVES, 0.2 / dt), dt)
        x = smooth(filled(stretch.z[:, 0]))
        v = np.gradient(x, dt)
        a = np.gradient(v, dt)
        both = low_pass(min(BALANCE, 0.1 / dt), dt)
        force = both(stretch.u[:, 0] if experiment.mode == FORCED else
                     fit.theta[s.AREA_1] * stretch.p1 - fit.theta[s.AREA_2] * stretch.p2)
        moving = mask & (np.abs(v) > STANDING * np.quantile(np.abs(v), 0.998))
        residuals.append((force - both(modelled(stretch, x, v, a)))[moving])
        forces.append(force[moving])
    if not residuals:
        return float("nan"), float("nan")
    return rms(np.concatenate(residuals)), rms(np.concatenate(forces))


def righted(experiment: Experiment, fit: Fit, stretch: Stretch) -> Stretch:
    """Return a stretch less what its sensors err by: scales, offsets, drifts, delays, play."""
    w, dt = circuit_of(fit.theta, fit.active), experiment.dt
    t = stretch.start + np.arange(len(stretch)) * dt  # a drift counts from the recording's start
    z = stretch.z.copy()
    z[:, 0] = true_position(np.interp(t + w[s.POSITION_DELAY], t, filled(z[:, 0])), w)
    if w[s.PLAY] > 0.0:  # where the sensor rests behind it, the filter says where the piston is
        x = filtered(experiment, stretch, fit.theta, fit.active, fit.gains, states=True)[1][:, Y_X]
        z[:, 0] += x - played(x, w[s.PLAY])
    late = t + w[s.PRESSURE_DELAY]
    return replace(stretch, z=z, p1=true_pressure(np.interp(late, t, stretch.p1), "p1", w, t),
                   p2=true_pressure(np.interp(late, t, stretch.p2), "p2", w, t))


def overlays(experiment: Experiment, before: Fit, after: Fit) -> tuple[Overlay, ...]:
    """Return for each signal the held-out second in which the model before is worst.

    Both models run free in it.
    """
    run_1 = free_runs(experiment, before, OVERLAY)
    run_2 = run_1 if after is before else free_runs(experiment, after, OVERLAY)
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
        whole = experiment.counted(values)
        if not len(whole) or np.ptp(whole) == 0:
            continue
        middle = np.median(whole)
        below = [v <= middle for v in values]
        for name, masks in ((low, below), (high, [~m for m in below])):
            both = [m & c for m, c in zip(masks, counted, strict=True)]
            if sum(int(m.sum()) for m in both) >= FEWEST:
                found.append((name, both))
    return found


def agreement(experiment: Experiment, before: Fit, after: Fit) -> tuple[Agreement, ...]:
    """Return B and beta_e from parts of the record, all else held.

    A model that lacks nothing finds the same in each of them.
    """
    models = [before] if after is before else [before, after]
    parts = parts_of(experiment, filtered_tracks(experiment, models[-1]))
    units = units_of(experiment.settings.rig.motion)

    def one(task: tuple[list[np.ndarray], Fit]) -> dict[str, Value]:
        masks, fit = task
        some = experiment.only(tuple(
            replace(stretch, counted=mask)
            for stretch, mask in zip(experiment.stretches, masks, strict=True)))
        free = tuple(f for f in fit.free if f.name in units)
        base = replace(fit, free=free, covariance=np.diag([f.spread**2 for f in free]))
        found = polished(some, base, Slopes(some), 2, 1.0)
        return {f.name: Value(found.value(f.name), found.stddev(f.name), units[f.name])
                for f in base.free}

    values = spread(one, [(masks, fit) for _, masks in parts for fit in models])
    k = len(models)
    return tuple(Agreement(name, values[k * i], values[k * i + k - 1])
                 for i, (name, _) in enumerate(parts))
