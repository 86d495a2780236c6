"""A stranger's rig: its motion, its two-chamber cylinder from textbooks, what its sensors show."""

from dataclasses import dataclass
from math import atan, exp, floor, pi, sqrt, tanh
from typing import NamedTuple

import numba
import numpy as np
from scipy.signal import butter, lfilter, lfilter_zi

# Compiled as the package's own plants are, and kept beside this file.
njit = numba.njit(cache=True, error_model="numpy", fastmath={"contract", "arcp"})


@dataclass(frozen=True)
class Motion:
    """A demanded position x_d(t) in m.

    Attributes
    ----------
    kind : ``triangle``, ``sines``, ``ramps`` or ``chirp``.
    amplitudes : m; half of peak to peak of each tone, or of each stretch of triangle.
    frequencies : Hz; tones, triangles of equal length in turn, or first and last of a chirp.
    seed : phases of the tones, places of the ramps.
    speed : m/s, of the ramps.
    dwell : s, how long a ramp's end is held.
    before : s of rest at the start of the recording; negative: it begins on a moving rig.
    """

    kind: str
    amplitudes: tuple[float, ...]
    frequencies: tuple[float, ...] = ()
    seed: int = 0
    speed: float = 0.05
    dwell: float = 0.4
    before: float = 0.3

    def __call__(self, t: np.ndarray, length: float) -> np.ndarray:
        """Return x_d (n,) in m at times ``t`` (n,) in s of a recording of ``length`` s."""
        u = np.asarray(t) - self.before
        moving = np.maximum(u, 0.0)
        return {"triangle": self._triangle, "sines": self._sines, "ramps": self._ramps,
                "chirp": self._chirp}[self.kind](moving, length - self.before)

    def _triangle(self, u, length):
        parts = len(self.frequencies)
        out = np.zeros_like(u)
        each = length / parts
        start = 0.0
        for k, (a, f) in enumerate(zip(self.amplitudes, self.frequencies, strict=True)):
            # Whole periods, so that each stretch ends at 0.
            end = length + 1.0 if k == parts - 1 else start + max(round(each * f), 1) / f
            here = (u >= start) & (u < end)
            phase = np.mod((u[here] - start) * f + 0.25, 1.0)
            out[here] = a * (1.0 - 4.0 * np.abs(phase - 0.5))
            start = end
        return out

    def _sines(self, u, length):
        phases = np.random.default_rng([self.seed, 3]).uniform(0, 2 * np.pi, 64)
        out = np.zeros_like(u)
        for a, f, phi in zip(self.amplitudes, self.frequencies, phases, strict=False):
            out += a * np.sin(2 * np.pi * f * u + phi)
        # Faded in over half a second: nobody jumps into a motion.
        s = np.clip(u / 0.5, 0.0, 1.0)
        return out * s * s * (3.0 - 2.0 * s)

    def _ramps(self, u, length):
        rng = np.random.default_rng([self.seed, 5])
        times, places, side = [0.0], [0.0], 1.0
        while times[-1] < length + 2.0:
            place = side * self.amplitudes[0] * rng.uniform(0.3, 1.0)
            speed = self.speed * rng.uniform(0.5, 1.0)
            times += [times[-1] + abs(place - places[-1]) / speed]
            times += [times[-1] + self.dwell * rng.uniform(0.5, 1.5)]
            places += [place, place]
            side = -side
        return np.interp(u, times, places)

    def _chirp(self, u, length):
        first, last = self.frequencies
        rate = np.log(last / first) / length
        phase = 2 * np.pi * first * (np.exp(rate * u) - 1.0) / rate
        return self.amplitudes[0] * np.sin(phase)


X, V, P1, P2, F, W, PA, WARM, XE = range(9)
N_STATE = 9
NO_FRICTION, STRIBECK, DAHL, RATIONAL, TANH, GAUSSIAN, KARNOPP, LUGRE = range(8)
MICRO_DAMPING = 0.3  # sigma_1 of LuGre, of sqrt(sigma_0 M)


class Constants(NamedTuple):
    """Constants of one plant, SI; every one a float, so that it compiles once."""

    area_1: float  # m^2
    area_2: float
    volume_1: float  # m^3 at x = 0
    volume_2: float
    mass: float  # kg
    damping: float  # B, N s/m
    bulk_modulus: float  # Pa
    displacement_1: float  # m^3/rad into chamber 1
    displacement_2: float  # m^3/rad out of chamber 2
    gain: float  # rad/(s m)
    cross_leakage: float = 0.0  # L, m^3/(s Pa)
    case_leakage: float = 0.0  # E, m^3/(s Pa), each chamber to the tank
    makeup: float = 0.0  # G, m^3/(s Pa)
    makeup_2: float = -1.0  # G of chamber 2 where another
    check_valve: float = 0.0  # K_c, m^3/(s Pa)
    cracking: float = 2e4  # Pa
    reservoir: float = 1e6  # p_0, absolute Pa
    gas_volume: float = 0.0  # V_0, m^3; 0: a source that holds its pressure, or an open tank
    friction: float = 0.0  # law
    dry: float = 0.0  # F_c, N
    breakaway: float = 0.0  # F_s, N
    stribeck_speed: float = 5e-3  # m/s
    smooth_speed: float = 1e-3  # m/s, of the tanh
    dahl_travel: float = 1e-5  # m, F_c over the rest stiffness
    load: float = 0.0  # F_0, N, against positive motion
    lag: float = 0.0  # tau, s
    feedforward: float = 0.0  # rad/m: shaft angle over demanded travel
    speed_limit: float = 1e6  # rad/s
    tank: float = 101325.0  # p_t, Pa
    polytropic: float = 1.25  # n
    case_leakage_2: float = -1.0  # E of chamber 2 where another
    damping_drop: float = 0.0  # d, share of B that is gone when the oil is warm
    warming: float = 10.0  # tau_h, s
    play: float = 0.0  # b, m, between rod and encoder, end to end
    stiffening: float = 0.0  # k of LuGre
    contact: float = 0.0  # N/m, of what the rod meets while extending
    contact_place: float = 0.0  # m, where


@njit
def friction_force(v, f, push, c):
    """Return the dry friction, N, and f'; ``push`` is the sum of the other forces, N."""
    if c.friction == STRIBECK:
        level = c.dry + (c.breakaway - c.dry) * exp(-(v / c.stribeck_speed) ** 2)
        return level * tanh(v / c.smooth_speed), 0.0
    if c.friction == RATIONAL:
        level = c.dry + (c.breakaway - c.dry) / (1.0 + (v / c.stribeck_speed) ** 2)
        return level * v / sqrt(v * v + c.smooth_speed ** 2), 0.0
    if c.friction == TANH:
        sign = tanh(v / c.smooth_speed)
        return (c.breakaway - c.dry) * (sign - tanh(v / c.stribeck_speed)) + c.dry * sign, 0.0
    if c.friction == GAUSSIAN:
        level = c.dry + (c.breakaway - c.dry) * exp(-(v / c.stribeck_speed) ** 2)
        return level * atan(v / c.smooth_speed) * 2.0 / pi, 0.0
    sign = 1.0 if v > 0.0 else (-1.0 if v < 0.0 else 0.0)
    if c.friction == KARNOPP:
        if abs(v) < c.smooth_speed:
            return min(max(push, -c.breakaway), c.breakaway), 0.0
        drop = exp(-abs(v) / c.stribeck_speed)
        return sign * (c.dry + (c.breakaway - c.dry) * drop), 0.0
    if c.friction == DAHL:
        return f, c.dry / c.dahl_travel * (1.0 - sign * f / c.dry) * v
    if c.friction == LUGRE:
        sigma = c.dry / c.dahl_travel * (1.0 + c.stiffening / (1.0 + abs(v) / c.stribeck_speed))
        level = c.dry + (c.breakaway - c.dry) * exp(-(v / c.stribeck_speed) ** 2)
        bent = v - sigma * abs(v) * f / level
        micro = MICRO_DAMPING * sqrt(sigma * c.mass) * exp(-(v / c.stribeck_speed) ** 2)
        return sigma * f + micro * bent, bent
    return 0.0, 0.0


@njit
def moving(v, c):
    """Return the speed at which the piston moves, m/s: none within Karnopp's band."""
    return 0.0 if c.friction == KARNOPP and abs(v) < c.smooth_speed else v


@njit
def rates(y, wanted, c, out):
    """Write y' into ``out`` (N_STATE,) for a wanted shaft speed, rad/s."""
    w = y[W] if c.lag > 0.0 else wanted
    v = moving(y[V], c)
    push = (c.area_1 * y[P1] - c.area_2 * y[P2]
            - c.damping * (1.0 - c.damping_drop * y[WARM]) * v - c.load
            - c.contact * max(y[X] - c.contact_place, 0.0))
    dry, out[F] = friction_force(y[V], y[F], push, c)
    second = c.makeup if c.makeup_2 < 0.0 else c.makeup_2
    case_2 = c.case_leakage if c.case_leakage_2 < 0.0 else c.case_leakage_2
    q_1 = (c.makeup * (y[PA] - y[P1])
           + c.check_valve * max(0.0, y[PA] - c.cracking - y[P1]))
    q_2 = (second * (y[PA] - y[P2])
           + c.check_valve * max(0.0, y[PA] - c.cracking - y[P2]))
    across = c.cross_leakage * (y[P1] - y[P2])
    into_1 = (-c.area_1 * v + c.displacement_1 * w - across
              - c.case_leakage * (y[P1] - c.tank) + q_1)
    into_2 = (c.area_2 * v - c.displacement_2 * w + across
              - case_2 * (y[P2] - c.tank) + q_2)
    out[X] = v
    out[V] = (push - dry) / c.mass
    out[P1] = into_1 * c.bulk_modulus / (c.volume_1 + c.area_1 * y[X])
    out[P2] = into_2 * c.bulk_modulus / (c.volume_2 - c.area_2 * y[X])
    out[W] = (wanted - y[W]) / c.lag if c.lag > 0.0 else 0.0
    out[WARM] = (1.0 - y[WARM]) / c.warming
    out[XE] = 0.0  # carried along after each step
    out[PA] = 0.0
    if c.gas_volume > 0.0:
        drawn = (c.displacement_1 - c.displacement_2) * w + q_1 + q_2
        gas = c.gas_volume * (c.reservoir / y[PA]) ** (1.0 / c.polytropic)
        out[PA] = -c.polytropic * y[PA] / gas * drawn


@njit
def shown_place(y, c):
    """Return where the encoder stands, m."""
    return y[XE] if c.play > 0.0 else y[X]


@njit
def wanted_speed(x_d, rate, x, c):
    """Return what the controller asks of the pump, rad/s."""
    w = c.gain * (x_d - x) + c.feedforward * rate
    return min(max(w, -c.speed_limit), c.speed_limit)


class Computer(NamedTuple):
    """When a digital drive computes, and what it reads.

    period, phase : steps between two computations (0: at every instant) and the step of the first.
    encoder, noise : step of what it reads (m; 0 none), and (m,) noise in m for each computation.
    """

    period: int
    phase: int
    encoder: float
    noise: np.ndarray


@njit
def run(y, c, demand, demand_rate, h, computer, out):
    """Integrate by the classical Runge-Kutta rule; ``y`` is carried along in place.

    Parameters
    ----------
    demand, demand_rate : (2*steps + 1,) x_d (m) and x_d' (m/s) at every half step.
    h : step, s.
    computer : of the drive.
    out : (steps + 1, N_STATE) the trajectory; its column W is the speed of the shaft.
    """
    (period, phase, encoder, noise), steps = computer, len(out) - 1
    k1, k2, k3, k4 = np.empty(N_STATE), np.empty(N_STATE), np.empty(N_STATE), np.empty(N_STATE)
    held, tick = wanted_speed(demand[0], demand_rate[0], shown_place(y, c), c), 0
    for i in range(steps + 1):
        if period > 0:
            if i >= phase and (i - phase) % period == 0:
                read = shown_place(y, c) + noise[tick % len(noise)]
                if encoder > 0.0:
                    read = encoder * floor(read / encoder + 0.5)
                held = wanted_speed(demand[2 * i], demand_rate[2 * i], read, c)
                tick += 1
            begin = held
        else:
            begin = wanted_speed(demand[2 * i], demand_rate[2 * i], shown_place(y, c), c)
        out[i] = y
        if c.lag <= 0.0:
            out[i, W] = begin
        if i == steps:
            return
        u_1 = begin
        rates(y, u_1, c, k1)
        z = y + 0.5 * h * k1
        m, n = 2 * i + 1, 2 * i + 2
        u_2 = held if period > 0 else wanted_speed(
            demand[m], demand_rate[m], shown_place(z, c), c)
        rates(z, u_2, c, k2)
        z = y + 0.5 * h * k2
        u_3 = held if period > 0 else wanted_speed(
            demand[m], demand_rate[m], shown_place(z, c), c)
        rates(z, u_3, c, k3)
        z = y + h * k3
        u_4 = held if period > 0 else wanted_speed(
            demand[n], demand_rate[n], shown_place(z, c), c)
        rates(z, u_4, c, k4)
        for j in range(N_STATE):
            y[j] += h / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j])
        y[XE] = min(max(y[XE], y[X] - 0.5 * c.play), y[X] + 0.5 * c.play)


def rest(c: Constants, x_d: float) -> np.ndarray:
    """Return the state (N_STATE,) that stands still with the drive on at ``x_d``, m."""
    from scipy.optimize import root

    # Dry friction holds any state near this one.
    c, y, out = c._replace(friction=float(NO_FRICTION)), np.zeros(N_STATE), np.empty(N_STATE)
    y[PA] = c.reservoir
    # The reservoir's own rate is left out: it is where it is.
    scale = np.array([c.reservoir, c.reservoir, 1.0])

    def missing(u):
        y[P1], y[P2], y[W] = u * scale
        y[X] = x_d - y[W] / c.gain
        rates(y, y[W], c, out)
        return [out[V], out[P1] / c.bulk_modulus, out[P2] / c.bulk_modulus]

    level = (c.load / c.reservoir + c.area_2) / c.area_1
    found = root(missing, np.array([level, 1.0, 0.0]), method="hybr", tol=1e-13)
    y[P1], y[P2], y[W] = found.x * scale
    y[X] = y[XE] = x_d - y[W] / c.gain
    return y


ATMOSPHERE = 101325.0  # Pa
PREROLL = 1.0  # s: the rig runs before the logger does
LONGEST_STEP = 5e-5  # s
SUBSTEPS = 20  # in a sample, at least


@dataclass(frozen=True)
class Sensors:
    """What the transducers and the logger make of the truth; SI."""

    encoder: float = 1e-6  # m, step
    position_noise: float = 0.5e-6  # m
    pressure_noise: float = 1.5e3  # Pa
    pressure_step: float = 300.0  # Pa, of the converter
    speed_noise: float = 0.1  # rad/s
    filter_hz: float = 0.0  # Hz, second-order anti-alias filter on pressures and speed; 0 none
    gauge: bool = False  # the transducers show pressure above the atmosphere


@dataclass(frozen=True)
class Drive:
    """How the controller runs.

    Attributes
    ----------
    hold : 0 continuous; else it computes every ``hold`` samples and holds.
    phase : when it computes after the logger's sample, as a share of a sample; at 0 the logger
        is the controller, and writes the very position it has used.
    """

    hold: int = 0
    phase: float = 0.0


@dataclass(frozen=True)
class Run:
    """One recording as it is made: a plant, its motion, and who looks at it.

    Attributes
    ----------
    plant : its constants.
    rate, length : Hz of the logger, s.
    celsius, warms : °C of the oil at the start, and how much warmer it gets in the end.
    """

    plant: Constants
    rate: float
    length: float
    motion: Motion
    sensors: Sensors = Sensors()
    drive: Drive = Drive()
    celsius: float = 41.0
    warms: float = 1.5


def fine_run(rig, seed: int = 0, substeps: int | None = None
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the trajectory (m, N_STATE), its times (m,) s, the sample of each log, its noise.

    Parameters
    ----------
    rig : a :class:`Run`, or what has its attributes.

    Returns
    -------
    out, time, at, noise : trajectory; its times, 0 at the first logged sample; (n,) rows of
        ``out`` at the logged samples; (n,) noise of the position in m at them.
    """
    period = 1.0 / rig.rate
    if substeps is None:
        substeps = max(SUBSTEPS, int(np.ceil(period / LONGEST_STEP)))
    h = period / substeps
    ahead = round((PREROLL - min(rig.motion.before, 0.0)) * rig.rate)
    ahead += ahead % 2  # whole periods of any drive
    samples = round(rig.length * rig.rate)
    steps = (ahead + samples) * substeps
    halves = np.arange(2 * steps + 1) * 0.5 * h - ahead * period
    demand = rig.motion(halves, rig.length)
    slope = np.gradient(demand, 0.5 * h)
    rng = np.random.default_rng([seed, 1])
    noise = rig.sensors.position_noise * rng.standard_normal(ahead + samples)
    drive = rig.drive
    if drive.hold and drive.phase == 0.0:
        read = noise[::drive.hold]
    else:
        read = rig.sensors.position_noise * rng.standard_normal(ahead + samples)
    out = np.empty((steps + 1, N_STATE))
    c = Constants(*map(float, rig.plant))
    y = rest(c, float(demand[0]))
    run(y, c, demand, slope, h, Computer(drive.hold * substeps, round(drive.phase * substeps),
                                         float(rig.sensors.encoder), read), out)
    at = (ahead + np.arange(samples)) * substeps
    return out, halves[::2], at, noise[ahead:]


def recording(rig, seed: int = 0) -> dict[str, np.ndarray]:
    """Return time and channels as the sensors of a :class:`Run` show them, name -> (n,) SI."""
    out, time, at, noise = fine_run(rig, seed)
    sensors, rng = rig.sensors, np.random.default_rng([seed, 2])
    h = time[1] - time[0]

    def filtered(values):
        if not sensors.filter_hz:
            return values
        b, a = butter(2, sensors.filter_hz, fs=1.0 / h)
        return lfilter(b, a, values, zi=lfilter_zi(b, a) * values[0])[0]

    def stepped(values, step):
        return step * np.round(values / step) if step else values

    found = {"time": np.arange(len(at)) / rig.rate,
             "x": stepped(out[at, XE] + noise, sensors.encoder),
             "x_d": rig.motion(time[at], rig.length),
             "omega": filtered(out[:, W])[at] + sensors.speed_noise * rng.standard_normal(len(at)),
             "temperature": (getattr(rig, "celsius", 41.0)
                             + getattr(rig, "warms", 1.5) * out[at, WARM])}
    for name, column in (("p1", P1), ("p2", P2)):
        p = filtered(out[:, column])[at] + sensors.pressure_noise * rng.standard_normal(len(at))
        found[name] = stepped(p - ATMOSPHERE * sensors.gauge, sensors.pressure_step)
    return found
