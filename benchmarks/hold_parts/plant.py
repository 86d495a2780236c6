"""A rig whose controller is a computer: two chambers, valves, pump, drive, in fine steps.

None of the package's equations are used.  The controller reads the position sensor, noise
included, once in a period and holds the pump speed that it computes; or it is an ideal analogue
loop.  What is recorded is the sensor that the controller reads.
"""

import math
from dataclasses import dataclass

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.recordings.recording import Recording

STEP = 2e-5  # s, longest integration step
CREEP = 4e-4  # m/s over which dry friction builds up
PREROLL = 1.0  # s at rest
PHYSICS = ("coulomb", "quadratic", "load", "leak", "dead_zone", "play", "drive_lag",
           "command_delay", "feedback_delay", "position_delay", "swept")


@dataclass(frozen=True)
class Rig:
    """Constants of a rig, SI, and what it has beyond the linear model (0: nothing).

    Attributes
    ----------
    coulomb, quadratic, load : N, N s^2/m^2, N.
    leak : between the chambers, beyond that of the datasheet, m^3/s/Pa.
    dead_zone : of the pump, rad/s;  play : of the position sensor's coupling, m.
    drive_lag, command_delay, feedback_delay, position_delay : s.
    swept : 1 where the piston's motion changes the chambers' volumes.
    """

    area_1: float = 6.3e-4
    area_2: float = 6.3e-4
    volume_1: float = 9.0e-5
    volume_2: float = 9.0e-5
    mass: float = 26.0
    damping: float = 900.0
    bulk_modulus: float = 7e8
    leakage: float = 6e-13
    makeup: float = 1e-13
    charge: float = 2e6
    displacement: float = 1.9e-7
    gain: float = 21000.0
    coulomb: float = 0.0
    quadratic: float = 0.0
    load: float = 0.0
    leak: float = 0.0
    dead_zone: float = 0.0
    play: float = 0.0
    drive_lag: float = 0.0
    command_delay: float = 0.0
    feedback_delay: float = 0.0
    position_delay: float = 0.0
    swept: float = 0.0

    def config(self, dt: float, noise: "Noise", **more) -> dict:
        """Return the sections of the config that its owner would write, without B and beta_e.

        ``more`` : further sections.
        """
        levels = {"position": noise.position, "pressure": noise.pressure,
                  "pump_speed": noise.speed}
        return {"rig": {
            "name": "digital", "area_1": self.area_1, "area_2": self.area_2,
            "volume_1": self.volume_1, "volume_2": self.volume_2, "mass": self.mass,
            "leakage": self.leakage, "makeup_conductance": self.makeup,
            "charge_pressure": self.charge, "pump_displacement": self.displacement,
            "position_gain": self.gain, "sample_time": dt}, "noise": levels, **more}


@dataclass(frozen=True)
class Noise:
    """White noise of the sensors, SI."""

    position: float = 2e-6
    pressure: float = 2e3
    speed: float = 0.2


@dataclass(frozen=True)
class Motion:
    """A demanded position: parts (kind, seconds, amplitude in m, frequency in Hz)."""

    parts: tuple[tuple[str, float, float, float], ...]
    seed: int = 0

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return sum(part[1] for part in self.parts)

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return x_d in m at any times, s; 0 before the start."""
        out, start = np.zeros_like(t), 0.0
        for number, (kind, seconds, amplitude, frequency) in enumerate(self.parts):
            here = (t >= start) & (t < start + seconds)
            out[here] = amplitude * shape(kind, frequency, t[here] - start, self.seed + number)
            start += seconds
        return out


def shape(kind: str, frequency: float, t: np.ndarray, seed: int) -> np.ndarray:
    """Return a motion of unit size."""
    if kind == "triangle":
        return 1.0 - 4.0 * np.abs(np.mod(t * frequency + 0.25, 1.0) - 0.5)
    if kind == "sine":
        return np.sin(2.0 * np.pi * frequency * t)
    if kind == "multisine":
        rng = np.random.default_rng(seed)
        tones = np.geomspace(0.2 * frequency, 4.0 * frequency, 9)
        phases = rng.uniform(0.0, 2.0 * np.pi, len(tones))
        waves = sum((np.sin(2.0 * np.pi * f * t + a) - np.sin(a)) / f
                    for f, a in zip(tones, phases, strict=True))
        return 0.2 * frequency * waves
    raise ValueError(f"no motion {kind!r}")


@njit
def integrate(c, x_d, h, steps, period, read, out):
    """Carry the rig through all recorded samples.

    Parameters
    ----------
    c : constants in the order of :class:`Rig`.
    x_d : demand at each half step, m.
    h, steps : integration step in s, and how many make a sample.
    period : samples between two computations of the controller; 0 for an analogue one.
    read : (n,) noise of the position sensor at each sample, m.
    out : (n, 5) written: x without noise as the sensor shows it, p1, p2, shaft speed, true x.
    """
    (a1, a2, v1, v2, mass, damping, beta, c_t, makeup, charge, d_p, gain, coulomb, quadratic, load,
     leak, dead, play, lag, late_d, late_f, late_x, swept) = c
    n = out.shape[0]
    total = (n - 1) * steps + 1
    past = np.empty(total)
    y, k, s = np.zeros(5), np.zeros((4, 5)), np.zeros(5)
    y[0] = x_d[0]
    y[2], y[3] = charge, charge
    played, held = y[0], 0.0
    back_d = round(2.0 * late_d / h)
    for i in range(total):
        past[i] = y[0]
        played = min(max(played, y[0] - 0.5 * play), y[0] + 0.5 * play)
        sample = i // steps
        if i % steps == 0:
            seen = played if play > 0.0 else past[max(i - round(late_x / h), 0)]
            out[sample, 0] = seen
            if period > 0 and sample % period == 0:
                known = past[max(i - round(late_f / h), 0)] if late_f > 0.0 else seen
                held = gain * (x_d[max(2 * i - back_d, 0)] - known - read[sample])
        for stage in range(4):
            along = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            for j in range(5):
                s[j] = y[j] + (along * h * k[stage - 1, j] if stage else 0.0)
            w = held
            if period == 0:
                known = s[0]
                if play > 0.0:
                    known = min(max(played, s[0] - 0.5 * play), s[0] + 0.5 * play)
                if late_f > 0.0:
                    known = past[max(i - round(late_f / h), 0)]
                elif late_x > 0.0:
                    known = past[max(i - round(late_x / h), 0)]
                place = 2 * i + (0 if stage == 0 else (2 if stage == 3 else 1)) - back_d
                w = gain * (x_d[min(max(place, 0), len(x_d) - 1)] - known)
            k[stage, 4] = (w - s[4]) / lag if lag > 0.0 else 0.0
            shaft = s[4] if lag > 0.0 else w
            if stage == 0 and i % steps == 0:
                out[sample, 1], out[sample, 2], out[sample, 3], out[sample, 4] = (
                    y[2], y[3], shaft, y[0])
            pumped = math.copysign(max(abs(shaft) - dead, 0.0), shaft) * d_p
            dp = s[2] - s[3]
            through = (0.5 * (c_t - makeup) + leak) * dp
            v = s[1]
            k[stage, 0] = v
            resist = damping * v + quadratic * v * abs(v) + coulomb * math.tanh(v / CREEP) + load
            k[stage, 1] = (a1 * s[2] - a2 * s[3] - (a1 - a2) * charge - resist) / mass
            k[stage, 2] = beta / (v1 + swept * a1 * s[0]) * (
                pumped - a1 * v - through + makeup * (charge - s[2]))
            k[stage, 3] = beta / (v2 - swept * a2 * s[0]) * (
                -pumped + a2 * v + through + makeup * (charge - s[3]))
        for j in range(5):
            y[j] += h / 6.0 * (k[0, j] + 2.0 * k[1, j] + 2.0 * k[2, j] + k[3, j])


def recorded(rig: Rig, motion: Motion, dt: float, digital: bool, *, every: int = 1, seed: int = 0,
             noise: Noise = Noise(), channels: tuple[str, ...] = ("x", "x_d", "omega", "p1", "p2")
             ) -> Recording:
    """Return a recording of ``motion`` on ``rig``, sampled every ``dt`` s.

    Parameters
    ----------
    digital : the controller computes once in ``every`` samples; else it is analogue.
    channels : what is recorded.
    """
    rng = np.random.default_rng(seed)
    before, n = round(PREROLL / dt), round(motion.seconds / dt)
    steps = int(np.ceil(dt / STEP))
    h = dt / steps
    read = noise.position * rng.standard_normal(before + n)
    half = (np.arange(2 * (before + n) * steps) - 2 * before * steps) * (0.5 * h)
    out = np.full((before + n, 5), np.nan)
    constants = tuple(float(getattr(rig, name)) for name in rig.__dataclass_fields__)
    integrate(constants, motion.at(half), h, steps, every if digital else 0, read, out)
    shown = out[before:]
    values = {"x": shown[:, 0] + read[before:],
              "x_d": motion.at(np.arange(n) * dt),
              "omega": shown[:, 3] + noise.speed * rng.standard_normal(n),
              "p1": shown[:, 1] + noise.pressure * rng.standard_normal(n),
              "p2": shown[:, 2] + noise.pressure * rng.standard_normal(n)}
    return Recording(dt, {name: values[name] for name in channels}, 0, "digital rig")
