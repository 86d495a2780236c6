"""From a stranger's rig to the channels that its sensors show."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, lfilter, lfilter_zi

from eha_monitor.concealed.strangers.motions import Motion
from eha_monitor.concealed.strangers.plant import (
    N_STATE,
    P1,
    P2,
    WARM,
    XE,
    Constants,
    W,
    rest,
    run,
)

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
    run(y, c, demand, slope, h, steps, drive.hold * substeps,
        round(drive.phase * substeps), rig.sensors.encoder, read, out)
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
