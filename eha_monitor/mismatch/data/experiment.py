"""What the diagnosis looks at: one or more recordings of one rig, ready for the filter."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from threading import Lock

import numpy as np

from eha_monitor.balances import measured
from eha_monitor.balances.circuit import one_side_is_held
from eha_monitor.errors import InputError
from eha_monitor.estimation.hold_choice import SAMPLED
from eha_monitor.estimation.rig_model import force_of
from eha_monitor.estimation.sensors import (
    PRESSURE_ERRORS,
    noise_levels,
    true_pressure,
    without_spikes,
)
from eha_monitor.mismatch.data.inputs import (
    BURN_IN,
    CLOSED,
    FORCED,
    OPEN,
    Rows,
    Stretch,
    angle_of,
    course_of,
    noise_governs,
    present,
    speed_of,
    windows_of,
)
from eha_monitor.mismatch.policy import POLICY, SearchPolicy
from eha_monitor.physics.contributions import NAMES, circuit_of
from eha_monitor.physics.effect import Ranges
from eha_monitor.physics.parameters import theta_of
from eha_monitor.physics.plant import N_OUTPUTS, STEP_DECAY
from eha_monitor.physics.signals import K_POS
from eha_monitor.recordings.grid import filled
from eha_monitor.recordings.position import quantum
from eha_monitor.recordings.recording import Recording, between_stops, rows_of, sample_of
from eha_monitor.settings.monitor import Settings

OUTPUTS = ("x", "v", "p1", "p2", "omega")
LONGEST_GAP = 0.02  # s of missing input that is bridged
SHORTEST = 0.5  # s of a stretch worth fitting
PERIOD, SHARE = 5.0, 0.2  # of every 5 s the last fifth is held out
STEP_PHASE = 0.16  # rad of the fastest resonance in one integration step
MOST_DAMPING = 3.0  # times the prior of B: how far a fit may take it
MOST_STEPS = 40
ABOVE = 1.3  # times a fitted B: quadratic friction adds to it at the highest speed
PULL = 1.0  # rad/s for a metre: what stands for K_pos where the wanted speed is recorded
LOOSE = 0.01  # of the pressure noise squared: what an unknown course of the demand may do

SMOOTH, JAGGED = 2e-5, 5e-3  # of a logarithm: over the first, ridges of two numbers stay ridges


class Work:
    """What filters have done on an experiment and all that is made of it, to end a search by.

    It counts integration steps and not seconds: the same on every machine.
    """

    def __init__(self):
        self._lock, self.steps = Lock(), 0

    def add(self, steps: int) -> None:
        """Count steps of a filter; from any thread."""
        with self._lock:
            self.steps += steps


@dataclass(frozen=True)
class Experiment:
    """Recordings of one rig as the mismatch filter takes them."""

    settings: Settings  # nominal config, effects included
    mode: int  # ``CLOSED`` (x_d drives the loop), ``OPEN`` (pump speed drives) or ``FORCED``
    dt: float  # sample time, s
    steps: int  # of the integration in a sample
    used: np.ndarray  # (N_OUTPUTS,) bool, the channels that are compared
    noise: np.ndarray  # (N_OUTPUTS,) standard deviation of each sensor, SI
    theta: np.ndarray  # nominal parameters
    active: np.ndarray  # effects that the config has
    stretches: tuple[Stretch, ...]  # the data
    ranges: Ranges  # what they cover
    position_step: float = 0.0  # resolution of the position sensor, m; 0 where it is continuous
    input_noise: float = 0.0  # standard deviation of the noise on a measured input, in its unit
    # ``CLOSED``: its input is the speed that the drive was told, not x_d
    wanted_speed: bool = False
    # By how much the circuit outside the model moves a chamber's pressure in a sample, Pa
    drift: float = 0.0
    by_pressures: bool = False  # ``FORCED``: its input is what the pressure sensors say
    held: bool = False  # the drive holds its command over each sample, a digital controller
    # Such a drive reads the recorded position with its noise, not a cleaner one
    hears: bool = True
    windows: bool = False  # the stretches are windows of longer recordings
    without: tuple[str, ...] = ()  # effects of the catalogue that are not considered
    policy: SearchPolicy = POLICY  # the numbers that decide what is named
    log_step: float = SMOOTH  # of a parameter's logarithm, over which a slope is taken
    work: Work = field(default_factory=Work, compare=False, repr=False)  # what filters have done

    @property
    def n(self) -> int:
        """Samples in all stretches."""
        return sum(len(stretch) for stretch in self.stretches)

    @property
    def columns(self) -> np.ndarray:
        """Places of the used outputs."""
        return np.flatnonzero(self.used)

    def counted(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Return what is given for each stretch (n, ...) at its counted samples, joined."""
        return np.concatenate([part[stretch.counted] for part, stretch in zip(
            parts, self.stretches, strict=True)])

    def only(self, stretches: tuple[Stretch, ...]) -> "Experiment":
        """Return the same rig with other data."""
        return replace(self, stretches=stretches)


def experiment_of(recordings: list[Recording], settings: Settings,
                  hold_out: bool = True, without: tuple[str, ...] = ()) -> Experiment:
    """Make the experiment of one or more recordings of a rig.

    Of long ones it holds the windows that tell most, of all together.  Effects ``without`` are not
    considered.

    Raises
    ------
    InputError
        If the recordings differ in sample time, or hold nothing that a model predicts.
    """
    first = recordings[0]
    mode = mode_of(first, settings)
    theta, active = theta_of(settings.rig, settings.effects)
    if mode == OPEN:  # what the pump turns is late already
        active[NAMES.index("command_delay")] = False
    circuit = circuit_of(theta, active)
    wanted = mode == CLOSED and wants_speed(first)
    if wanted:
        theta[K_POS] = PULL
    levels, parts, columns = {}, [], []
    for recording in recordings:
        if abs(recording.sample_time - first.sample_time) > 1e-6 * first.sample_time:
            raise InputError(f"{recording.source}: expected the sample time of {first.source}, "
                             f"{first.sample_time:g} s, got {recording.sample_time:g} s")
    chosen = windows_of(recordings, settings)
    for number, recording in enumerate(recordings):
        noise = noise_levels(sample_of(recording), settings.noise)
        names = [name for name in recording.channels if recording.has(name)]
        for name, level in noise.items():
            levels.setdefault(name, []).append(level.value)
        windows = [Rows(number, 0, len(recording))] if chosen is None else [
            one for one in chosen if one.recording == number]
        for one in windows:
            rows = recording if chosen is None else rows_of(recording, one.first, one.last)
            channels, _ = without_spikes({name: rows.channels[name] for name in names}, noise)
            begun = one.first * recording.sample_time
            if mode == FORCED:  # the sensors drive the model
                channels |= meant(channels, circuit, begun, recording.sample_time)
            parts += stretches_of(rows, channels, settings, mode, levels, hold_out, begun)
            columns.append(channels)
    if not parts:
        raise InputError(f"{first.source}: expected at least {SHORTEST:g} s without a gap of "
                         "position and of the input (command, pump speed or force)")
    sigma = np.array([np.median(levels[name]) if name in levels else np.nan for name in OUTPUTS])
    x = sample_of(first).get("x")
    step = quantum(x[np.isfinite(x)])
    sigma[0] = max(sigma[0], step / np.sqrt(12.0))
    used = np.array([any(np.isfinite(part.z[:, j]).any() for part in parts)
                     for j in range(N_OUTPUTS)])
    ranges = ranges_of(columns, settings, first.sample_time)
    return Experiment(settings, mode, first.sample_time,
                      integration_steps(settings, mode, first.sample_time), used, sigma, theta,
                      active, tuple(parts), ranges, step, input_noise(mode, settings, levels),
                      wanted, circuit_drift(settings, mode, columns),
                      by_pressures=mode == FORCED and settings.rig.area_1 is not None
                      and "p1" in levels and "p2" in levels, held=is_held(mode, settings),
                      windows=chosen is not None, without=without)


def meant(channels: dict, w: np.ndarray, begun: float, dt: float) -> dict[str, np.ndarray]:
    """Return the pressures, (n,) Pa, less the errors that the config knows of their sensors.

    ``w`` is the config's circuit; the first sample is ``begun`` s after the recording began.
    """
    time = begun + np.arange(len(channels["x"])) * dt
    return {name: true_pressure(channels[name], name, w, time)
            for name in channels.keys() & PRESSURE_ERRORS.keys()}


def is_held(mode: int, settings: Settings) -> bool:
    """Tell whether a drive holds its command over each sample; a slow shaft turns in between."""
    slow = settings.effects.get("drive_lag", {}).get("tau", 0.0) > 0.0
    return settings.command_hold == SAMPLED and (mode == CLOSED or (mode == OPEN and not slow))


def input_noise(mode: int, settings: Settings, levels: dict) -> float:
    """Return the standard deviation of the noise on a measured input, in its unit."""
    def level(name):
        return float(np.median(levels[name])) if name in levels else 0.0

    rig = settings.rig
    if mode == OPEN:
        return level("omega")
    if mode == FORCED and "p1" in levels and "p2" in levels and rig.area_1:
        return float(np.hypot(rig.area_1 * level("p1"), rig.area_2 * level("p2")))
    return level("force") if mode == FORCED else 0.0


def mode_of(recording: Recording, settings: Settings) -> int:
    """Tell which input drives the model.

    Raises
    ------
    InputError
        If there is no position, or nothing that moves it.
    """
    rig = settings.rig
    known = None not in (rig.area_1, rig.area_2, rig.volume_1, rig.volume_2, rig.pump_displacement)
    if not recording.has("x"):
        raise InputError(f"{recording.source}: expected a position (channel x), found "
                         f"{', '.join(recording.channels) or 'nothing'}")
    if known and (wants_speed(recording)
                  or (rig.position_gain is not None and recording.has("x_d"))):
        return CLOSED
    if known and recording.has("omega"):
        return OPEN
    if recording.has("force") or (recording.has("p1", "p2") and rig.area_1 and rig.area_2):
        return FORCED
    raise InputError(f"{recording.source}: expected what moves the piston: x_d (with "
                     "rig.position_gain), omega, or force or p1 and p2")


def circuit_drift(settings: Settings, mode: int, columns: list[dict]) -> float:
    """Return by how much the circuit outside the model moves a chamber's pressure, Pa a sample.

    A single-rod cylinder takes more oil on one side than it gives on the other.  Valves and an
    accumulator make up for that; where the config holds no path for it the model cannot say
    what the mean pressure does, and must not be judged by it.  The record says how fast it moves.
    """
    rig = settings.rig
    if mode == FORCED or rig.area_1 == rig.area_2 or rig.makeup_conductance > 0.0:
        return 0.0
    steps = [np.diff(smooth(0.5 * (c["p1"] + c["p2"]), rig.charge_pressure))
             for c in columns if "p1" in c and "p2" in c]
    return float(np.sqrt(np.mean(np.concatenate(steps) ** 2))) if steps else 0.0


def by_balances(recordings: Sequence[Recording], settings: Settings) -> bool:
    """Tell whether the balances as they stand judge recordings, and not a filter's predictions.

    A filter predicts the position from the force and asks which model predicts best.  Where the
    force is told by noisy sensors and the position by an encoder that is worth a thousandth of
    it, that question has a wrong answer: a model with a false mass, which does not respond to the
    noise, wins.  So it has where the motion answers to the force within a sample, so that there is
    nothing to integrate, and around a single-rod cylinder whose circuit (valves, an accumulator)
    the config does not hold, so that the model does not know the mean pressure, or is another
    than that of pumps which match the areas (:func:`one_side_is_held`).
    """
    rig = settings.rig
    if mode_of(recordings[0], settings) == FORCED:
        quick = settings.stage_one.prior / rig.mass * rig.sample_time > 1.0
        return quick or noise_governs([force_of(rig, sample_of(one).channels)
                                       for one in recordings])
    return (rig.area_1 != rig.area_2 and all(one.has("p1", "p2", "omega") for one in recordings)
            and (rig.makeup_conductance == 0.0
                 or all(_on_another_circuit(one, settings) for one in recordings)))


def _on_another_circuit(recording: Recording, settings: Settings) -> bool:
    try:
        return one_side_is_held(measured.course_of(recording, settings), settings.rig)
    except InputError:  # of a motion that balances cannot take they say nothing
        return False


def wants_speed(recording: Recording) -> bool:
    """Tell whether the speed that the drive was told is there, and what it made of it.

    Such a record tells drive and position loop apart, whatever that loop is; with x_d alone the
    loop must be the config's own.
    """
    return recording.has("omega_d", "omega")


def integration_steps(settings: Settings, mode: int, dt: float) -> int:
    """Return Runge-Kutta steps in a sample, so that the resonance turns little in each."""
    rig = settings.rig
    fastest = 0.0
    if mode != FORCED:
        stiff = 2.0 * max(rig.bulk_modulus, settings.stage_two.prior) * (
            rig.area_1**2 / rig.volume_1 + rig.area_2**2 / rig.volume_2)
        fastest = np.sqrt(0.5 * stiff / rig.mass)
    steps = max(fastest * dt / STEP_PHASE, damping_steps(
        settings, MOST_DAMPING * settings.stage_one.prior, dt))
    return int(np.clip(np.ceil(steps), 2, MOST_STEPS))


def damping_steps(settings: Settings, damping: float, dt: float) -> float:
    """Return how many steps of a sample a viscous damping, N s/m, needs."""
    return damping / settings.rig.mass * dt / STEP_DECAY


def resolving(experiment: Experiment, damping: float) -> Experiment:
    """Return the experiment with steps short enough for a viscous damping, N s/m.

    Where they are too long Runge-Kutta runs away, and a fit stops there in place of at the
    optimum, or adds a mass so that it does not.
    """
    steps = damping_steps(experiment.settings, ABOVE * damping, experiment.dt)
    return replace(experiment, steps=max(experiment.steps,
                                         int(np.clip(np.ceil(steps), 2, MOST_STEPS))))


def stretches_of(recording: Recording, channels: dict, settings: Settings, mode: int,
                 levels: dict, hold_out: bool, begun: float = 0.0) -> list[Stretch]:
    """Cut a recording where its input is missing for long; it begins at ``begun`` s."""
    n, dt, rig = len(recording), recording.sample_time, settings.rig
    nothing = np.full(n, np.nan)
    if mode == CLOSED and wants_speed(recording):
        # omega = K_pos (x_d - x) with a K_pos so small that a metre more or less does not count.
        u, sigma = channels["omega_d"] / PULL + channels["x"], 0.0
    elif mode == CLOSED:
        u, sigma = channels.get("x_d", nothing), 0.0
    elif mode == OPEN:
        u, sigma = channels["omega"], levels["omega"][-1]
    else:
        u, sigma = force_of(rig, channels), 0.0
    held = is_held(mode, settings)
    z = np.column_stack([channels.get(name, nothing) for name in OUTPUTS])
    if mode == OPEN:
        z[:, 4] = np.nan  # the pump speed is the input
    if mode == FORCED:
        z[:, 2:] = np.nan
    p1, p2 = channels.get("p1", nothing), channels.get("p2", nothing)
    charge = rig.charge_pressure
    parts, angle = [], None if mode == FORCED else angle_of(channels, rig, dt)
    spans = present(u, z[:, 0], int(LONGEST_GAP / dt))
    if mode == FORCED:
        spans = [(start + first, start + last) for start, stop in spans
                 for first, last in between_stops(z[start:stop, 0], u[start:stop], dt)]
    for start, stop in spans:
        if (stop - start) * dt < SHORTEST:
            continue
        here = slice(start, stop)
        time = np.arange(stop - start) * dt
        # A drive that holds its command reads it at the stamps.
        course, off = course_of(filled(u[here]), sigma, held and mode == OPEN)
        loose = np.zeros(stop - start)
        if (mode == CLOSED and not held and not wants_speed(recording)
                and "p1" in levels and "p2" in levels):
            known = 0.5 * (levels["p1"][-1]**2 + levels["p2"][-1]**2)
            entered = (rig.position_gain * off * rig.pump_displacement * dt  # Pa, into the oil
                       * rig.bulk_modulus / min(rig.volume_1, rig.volume_2))[:-1] ** 2
            loose[1:] = np.where(entered > LOOSE * known, entered / (entered + 0.5 * known), 0.0)
        held_out = (np.mod(time, PERIOD) >= PERIOD * (1 - SHARE)) & hold_out
        if (stop - start) * dt < 2 * PERIOD:  # a short record: its last fifth
            held_out = (time >= (1 - SHARE) * (stop - start) * dt) & hold_out
        # What follows a held-out part starts from a state that has seen it.
        burn = max(1, int(BURN_IN / dt))
        seen = np.convolve(held_out, np.ones(burn + 1))[: len(time)] > 0.5
        parts.append(Stretch(
            recording.source, begun + start * dt, z[here].copy(),
            course, smooth(p1[here], charge), smooth(p2[here], charge),
            (time >= BURN_IN) & ~seen & (loose == 0.0), held_out, loose,
            None if angle is None else angle[here]))
    return parts


def smooth(values: np.ndarray, otherwise: float) -> np.ndarray:
    """Return a pressure without gaps and with less noise (mean of five), Pa."""
    return averaged(values, 5) if np.isfinite(values).any() else np.full(len(values), otherwise)


def averaged(values: np.ndarray, reach: int) -> np.ndarray:
    """Return means over ``reach`` samples around each, gaps filled, (n,)."""
    if not np.isfinite(values).any():
        return values
    whole = np.pad(filled(values), (reach // 2, reach - 1 - reach // 2), mode="edge")
    return np.convolve(whole, np.full(reach, 1.0 / reach), mode="valid")


def ranges_of(columns: list[dict], settings: Settings, dt: float) -> Ranges:
    """Return what the recordings cover, from the channels or from what stands for them."""
    rig = settings.rig
    area = rig.area_1 or 1.0

    def pooled(make, of=None):
        found = [values[np.isfinite(values)] for values in map(make, of or columns)
                 if values is not None]
        return np.concatenate(found) if found else np.zeros(1)

    def slope(values, reach):
        return None if values is None else (values[reach:] - values[:-reach]) / (reach * dt)

    reach = max(1, round(0.01 / dt))
    # The largest of many noisy readings is none of the rig's.
    read = columns
    columns = [c | {name: averaged(c[name], reach) for name in c.keys() & {"p1", "p2", "omega"}}
               for c in columns]
    x = pooled(lambda c: c.get("x"))
    v = np.abs(pooled(lambda c: slope(c.get("x"), reach)))
    a = np.abs(pooled(lambda c: slope(slope(c.get("x"), reach), reach)))
    both = all("p1" in c and "p2" in c for c in columns)
    dp = np.abs(pooled(lambda c: c["p1"] - c["p2"])) if both else np.array([1e5])
    low = (pooled(lambda c: np.minimum(c["p1"], c["p2"])) if both
           else np.array([rig.charge_pressure]))
    mean = pooled(lambda c: 0.5 * (c["p1"] + c["p2"])) if both else low

    # Where pressures drive the model, their noise is part of the force that it is driven by.
    forced = all(speed_of(c, rig) is None for c in columns)
    force = np.abs(pooled(lambda c: force_of(rig, c), read if forced else columns)) if (
        both or all("force" in c for c in columns)) else rig.mass * a
    omega = np.abs(pooled(lambda c: speed_of(c, rig)))
    turn = np.abs(pooled(lambda c: slope(speed_of(c, rig), 1)))

    def q(values, *levels):
        return tuple(float(max(value, 1e-12)) for value in np.quantile(values, levels))

    return Ranges(
        speed=q(v, 0.998)[0], position=float(max(np.ptp(x) / 2, 1e-9)),
        acceleration=q(a, 0.99)[0], pressure_difference=q(dp, 0.5, 0.9, 0.98, 1.0),
        lowest_pressure=q(low, 0.002, 0.02, 0.2), mean_pressure=q(mean, 0.5)[0],
        pump_speed=q(omega, 0.5, 0.9, 0.98, 1.0), pump_acceleration=q(turn, 0.9, 0.98, 1.0),
        force=q(force, 0.98)[0], flow=area * q(v, 0.98)[0], sample_time=dt,
        duration=float(sum(len(next(iter(c.values()))) for c in columns) * dt),
        middle=float(np.max(x) + np.min(x)) / 2)
