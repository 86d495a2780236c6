"""Motions that a rig can run within the limits of a recording, and the model on them."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_banded

from eha_monitor import ties
from eha_monitor.estimation.modelled import contributions_along
from eha_monitor.mismatch.data.experiment import BURN_IN, Experiment, Stretch
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED, cubics
from eha_monitor.mismatch.likelihood.fit import Fit, free_run
from eha_monitor.physics import plant
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import circuit_of, new_memory
from eha_monitor.physics.plant import N_OUTPUTS, Y_OMEGA, Y_P1, Y_P2, Step, actuator_of, sense
from eha_monitor.physics.simulator import demanded_position, total_duration
from eha_monitor.settings.rig import Segment

USED = 0.9  # of the recording's pump speed
STRAINED = 1.2  # times the largest force of the recording
LOOP = 0.1  # s with which a rig follows its demand, where its gain is not known
SETTLED = 8.0  # loop time constants for which a triangle's speed must last
SHORTEST = 2.0  # s
DIGITS = 3  # of amplitudes


@dataclass(frozen=True)
class Limits:
    """What a recording went to, and a planned motion may: the rig's own limits are not known."""

    middle: float  # mean position, m
    reach: float  # largest distance from it, m
    speed: float  # largest |v|, m/s
    pump_speed: float  # largest |omega|, rad/s, or |v| without a pump
    gain: float  # of the position loop, rad/s per m, or 1/s
    loop: float  # its time constant, s


@dataclass(frozen=True)
class Motion:
    """A demanded motion.

    ``words`` say it; ``segments`` are what ``simulation.excitation`` takes.
    """

    name: str
    words: str
    segments: dict[str, Segment]

    @property
    def duration(self) -> float:
        """Length in s."""
        return total_duration(self.segments)


def limits_for(experiment: Experiment) -> Limits | None:
    """Return what the recording went to; None where no motion can be simulated."""
    rig, r = experiment.settings.rig, experiment.ranges
    if experiment.mode == FORCED:  # any controller will do: only its speed matters
        per_speed, gain, fastest = 1.0, 1.0 / LOOP, r.speed
    elif None in (rig.area_1, rig.pump_displacement):
        return None
    else:
        per_speed = rig.area_1 / rig.pump_displacement  # rad/s of pump for 1 m/s of piston
        gain, fastest = rig.position_gain or per_speed / LOOP, r.pump_speed[3]
    x = np.concatenate([stretch.z[:, 0] for stretch in experiment.stretches])
    low, high = np.nanmin(x), np.nanmax(x)
    reach = float(0.5 * (high - low))
    grid = 10.0 ** np.floor(np.log10(max(0.05 * reach, 1e-9)))
    return Limits(float(np.round(0.5 * (low + high) / grid) * grid), reach, r.speed,
                  fastest, gain, per_speed / gain)


def candidates(limits: Limits) -> list[Motion]:
    """Return motions within the limits, shortest first."""
    middle, reach, v = limits.middle, limits.reach, limits.speed
    period = max(2.0, 2.0 * SETTLED * limits.loop)

    def triangle(speed: float, where: float = middle, most: float = reach) -> Segment:
        lasting = min(period, 4.0 * most / speed)
        count = max(2, int(np.ceil(SHORTEST / lasting)))
        return Segment(kind="triangle", duration=_tidy(count * lasting), frequency=_tidy(
            1.0 / lasting), amplitude=speed * lasting / 4.0, offset=where)

    def sine(frequency: float, where: float = middle, most: float = reach,
             share: float = 1.0) -> Segment:
        return Segment(kind="sine", duration=max(2.0, _tidy(4.0 / frequency)),
                       frequency=frequency, amplitude=share * most, offset=where)

    aside, half = middle + 0.5 * reach, 0.5 * reach
    plans: list[tuple[str, str, dict[str, Segment]]] = [
        ("rest", "rest at the middle", {"rest": Segment(kind="rest", duration=2.0,
                                                        offset=middle)}),
        ("rest_aside", "rest at two places", {
            "here": Segment(kind="rest", duration=2.0, offset=middle - half),
            "there": Segment(kind="rest", duration=2.0, offset=aside)}),
    ]
    slow = {"triangle": triangle(0.5 * v)}
    tones = {"multisine": Segment(
        kind="multisine", duration=4.0, amplitude=reach, frequency=0.5, frequency_end=20.0,
        components=12, offset=middle, seed=1)}
    plans += [
        ("triangle_full", "a triangle at the speed of this recording", {"triangle": triangle(v)}),
        ("triangle_half", "a triangle at half the speed", slow),
        ("triangle_tenth", "a triangle at a tenth of the speed", {"triangle": triangle(0.1 * v)}),
        ("triangle_aside", "a triangle at half the speed about another place",
         {"triangle": triangle(0.5 * v, aside, half)}),
        ("two_triangles", "two triangles, one at a quarter of the other's speed",
         {"fast": triangle(v), "slow": triangle(0.25 * v)}),
        *((f"sine_{frequency:g}_hz", f"a sine of {frequency:g} Hz", {"sine": sine(frequency)})
          for frequency in (1.0, 2.0, 5.0, 10.0, 20.0)),
        ("sine_small", "a small sine of 2 Hz", {"sine": sine(2.0, share=0.03)}),
        ("sine_places", "a sine of 10 Hz at two places",
         {"here": sine(10.0, middle - half, half), "there": sine(10.0, aside, half)}),
        ("multisine", "a multisine of 0.5 to 20 Hz", tones),
        ("chirp", "a chirp of 0.5 to 20 Hz", {"chirp": Segment(
            kind="chirp", duration=4.0, amplitude=reach, frequency=0.5, frequency_end=20.0,
            offset=middle)}),
        ("steps", "random steps, two a second", {"steps": Segment(
            kind="steps", duration=4.0, amplitude=reach, frequency=2.0, offset=middle, seed=1)}),
        ("triangle_and_multisine", "a slow triangle, then a multisine", slow | tones)]
    found = [Motion(name, words, within(limits, segments)) for name, words, segments in plans]
    return ties.ordered(found, lambda motion: -motion.duration)


def within(limits: Limits, segments: dict[str, Segment]) -> dict[str, Segment]:
    """Return segments whose sizes keep pump speed and position in the limits.

    Each by itself first; then all together, with the jumps from one to the next.
    """
    each = {name: resized(limits, segment, share_within(limits, {name: segment}), False)
            for name, segment in segments.items()}
    share = share_within(limits, each)
    return {name: resized(limits, segment, share, True) for name, segment in each.items()}


def resized(limits: Limits, segment: Segment, share: float, moved: bool) -> Segment:
    """Return a segment at a share of its amplitude, and of its distance from the middle."""
    if share >= 1.0:
        return segment.model_copy(update={"amplitude": _tidy(segment.amplitude),
                                          "offset": _tidy(segment.offset)})
    offset = limits.middle + share * (segment.offset - limits.middle) if moved else segment.offset
    return segment.model_copy(update={"amplitude": _tidy(0.999 * share * segment.amplitude),
                                      "offset": _tidy(offset)})


def share_within(limits: Limits, segments: dict[str, Segment]) -> float:
    """Return the share of a motion's size that the limits allow, 1 where all of it is allowed.

    Judged by the linear position loop; the motion is run twice, since it repeats.
    """
    dt = min(1e-3, 0.1 * limits.loop)
    time = np.arange(round(2.0 * total_duration(segments) / dt)) * dt
    x_d = demanded_position(segments, time)
    left = np.exp(-dt / limits.loop)
    away = x_d - x_d[0]
    lag = away - lagged(away, left)
    speed = limits.gain * np.abs(lag).max()
    reached = np.abs(x_d - lag - limits.middle).max()
    return float(min(1.0, USED * limits.pump_speed / max(speed, 1e-12),
                     limits.reach / max(reached, 1e-12)))


def lagged(values: np.ndarray, left: float) -> np.ndarray:
    """Return values behind a first-order lag of which ``left`` is left after a sample, (n,).

    From 0 on: y_k - left y_k-1 = (1 - left) x_k.
    """
    bands = np.stack([np.ones(len(values)), np.full(len(values), -left)])
    return solve_banded((1, 0), bands, (1.0 - left) * values)


def _tidy(value: float) -> float:
    """Return a number with few digits, as people set them."""
    return float(f"{value:.{DIGITS}g}")


def planned(experiment: Experiment, fit: Fit, limits: Limits, motion: Motion) -> Experiment:
    """Return a motion as an experiment: the fitted model's own outputs, without noise.

    The rig is at rest where the motion begins, and is driven by it.
    """
    blank = (forced(experiment, fit, limits, motion) if experiment.mode == FORCED else
             demanded(experiment, fit, motion.name, demand_of(motion, experiment.dt)))
    return without_noise(blank, fit)


def without_noise(blank: Experiment, fit: Fit) -> Experiment:
    """Return an experiment of one stretch with the fitted model's own outputs."""
    stretch = blank.stretches[0]
    clean = free_run(blank, stretch, fit)
    clean[~np.isfinite(stretch.z)] = np.nan
    return blank.only((replace(stretch, z=clean),))


def demand_of(motion: Motion, dt: float) -> np.ndarray:
    """Return x_d of a motion, one value to a sample of ``dt`` s, (n,) m."""
    time = np.arange(max(4, round(motion.duration / dt))) * dt
    return demanded_position(motion.segments, time)


def demanded(experiment: Experiment, fit: Fit, name: str, x_d: np.ndarray) -> Experiment:
    """Return a model's rig at rest at the first of the demanded positions (n,), driven by them."""
    time = np.arange(len(x_d)) * experiment.dt
    y = at_rest(fit, x_d[0])
    shown = np.zeros(N_OUTPUTS)
    sense(actuator_of(y, new_memory()), 0.0, Step(experiment.dt, experiment.steps),
          circuit_of(fit.theta, fit.active), shown)
    z = np.where(experiment.used, shown, np.nan) * np.ones((len(time), 1))
    counted = time >= BURN_IN
    stretch = Stretch(name, 0.0, z, cubics(x_d, 0.0), np.full(len(time), y[Y_P1]),
                      np.full(len(time), y[Y_P2]), counted, np.zeros(len(time), dtype=bool))
    return replace(experiment, mode=CLOSED, stretches=(stretch,))


def at_rest(fit: Fit, x_d: float) -> np.ndarray:
    """Return a model's state at rest where ``x_d`` m is demanded, (N_STATE,).

    The pump makes up for what leaks under a load, and the piston stands off for that.
    """
    theta, w = fit.theta, circuit_of(fit.theta, fit.active)
    scale = w[s.POSITION_SCALE] if w[s.IN_LOOP] else 0.0
    y = plant.at_rest(theta, fit.active, x_d / (1.0 + scale))
    omega = 0.5 * theta[s.C_T] * (y[Y_P1] - y[Y_P2]) / theta[s.D_P]
    if np.isfinite(theta[s.K_POS]):
        y = plant.at_rest(theta, fit.active, (x_d - omega / theta[s.K_POS]) / (1.0 + scale))
        y[Y_OMEGA] = omega
    return y


def forced(experiment: Experiment, fit: Fit, limits: Limits, motion: Motion) -> Experiment:
    """Return a motion of a rig whose driving force is measured: the force that it takes."""
    dt = experiment.dt
    x_d = demand_of(motion, dt)
    time = np.arange(len(x_d)) * dt
    left, x = np.exp(-2.0 * dt / limits.loop), x_d - x_d[0]
    for _ in range(2):  # two poles, so that the force stays finite at corners
        x = lagged(x, left)
    track = np.zeros((len(time), s.N_SIGNALS))
    track[:, s.T], track[:, s.X_D] = time, x_d
    track[:, s.X] = x + x_d[0]
    track[:, s.V] = np.gradient(x, dt)
    for column, name in ((s.P1, "p1"), (s.P2, "p2")):
        track[:, column] = np.mean([np.mean(getattr(one, name)) for one in experiment.stretches])
    added = np.zeros((len(time), s.N_CONTRIBUTIONS))
    contributions_along(track, dt, experiment.steps, fit.theta, fit.active, new_memory(), added)
    force = ((fit.theta[s.M] + added[:, s.MASS]) * np.gradient(track[:, s.V], dt)
             + fit.theta[s.B] * track[:, s.V] + added[:, s.FORCE])
    z = np.full((len(time), N_OUTPUTS), np.nan)
    z[:, 0] = x_d[0]
    if experiment.used[1]:
        z[:, 1] = 0.0
    stretch = Stretch(motion.name, 0.0, z, cubics(force, 0.0), track[:, s.P1].copy(),
                      track[:, s.P2].copy(), time >= BURN_IN, np.zeros(len(time), dtype=bool))
    return experiment.only((stretch,))


def strained(experiment: Experiment, there: Experiment) -> bool:
    """Tell whether a motion takes much more force than the recording shows, where it is known."""
    if experiment.mode != FORCED:
        return False
    shown = max(float(np.abs(one.u[:, 0]).max()) for one in experiment.stretches)
    return bool(np.abs(there.stretches[0].u[:, 0]).max() > STRAINED * shown)


def looped(fit: Fit, limits: Limits) -> Fit:
    """Return a fit whose position loop is closed, with the gain of the limits."""
    if np.isfinite(fit.theta[s.K_POS]):
        return fit
    theta = fit.theta.copy()
    theta[s.K_POS] = limits.gain
    return replace(fit, theta=theta)


def excitation_tree(motion: Motion) -> dict:
    """Return a motion as the plain data of a config: ``simulation.excitation``."""
    kept = {"triangle": ("frequency", "amplitude"), "sine": ("frequency", "amplitude"),
            "chirp": ("frequency", "frequency_end", "amplitude"),
            "multisine": ("frequency", "frequency_end", "components", "amplitude", "seed"),
            "steps": ("frequency", "amplitude", "seed"), "rest": ()}
    return {name: {"kind": segment.kind, "duration": segment.duration,
                   **{key: getattr(segment, key) for key in kept[segment.kind]},
                   "offset": segment.offset}
            for name, segment in motion.segments.items()}
