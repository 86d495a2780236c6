"""From a recording to what the stages take: force, drive input, noise, constants, reasons."""

from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.filters.hold import Hold, hold_of
from eha_monitor.filters.noise import noise_levels, quantum
from eha_monitor.filters.results import NoiseEstimate
from eha_monitor.filters.stage_two import STIFF, hydraulics
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects.entrained_air import compliance as air_compliance
from eha_monitor.physics.parameters import theta_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig

SPIKE_SPAN, SPIKE_SIGMAS = 10.0, 30.0


@dataclass(frozen=True)
class RigModel:
    """Constants of the two stages that do not depend on the recording."""

    settings: Settings
    theta: np.ndarray
    active: np.ndarray
    beta_0: float
    loop: bool
    hydraulics: np.ndarray | None
    leak: float

    @classmethod
    def of(cls, settings: Settings, mean_pressure: float | None = None,
           commanded: bool = True) -> "RigModel":
        """Collect the constants.

        ``mean_pressure`` (Pa) sets the compliance of modelled air; without ``commanded`` (no x_d)
        the pump speed is the input and the loop is open.
        """
        theta, active = theta_of(settings.rig, settings.effects)
        beta_0 = settings.stage_two.prior
        rig = settings.rig
        known = None not in (rig.area_1, rig.area_2, rig.volume_1, rig.volume_2,
                             rig.pump_displacement)
        loop = (commanded and rig.position_gain is not None
                and settings.command_hold == "continuous")
        air = settings.effects.get("entrained_air")
        pressure = rig.charge_pressure if mean_pressure is None else mean_pressure
        extra = air_compliance(pressure, air["alpha"], air["n"]) if air else 0.0
        constants = hydraulics(theta, beta_0, extra, loop) if known else None
        leak = 0.0
        if known:
            leak = 0.5 * theta[s.C_T] * (1 / theta[s.VOL_1] + 1 / theta[s.VOL_2])
        return cls(settings, theta, active, beta_0, loop, constants, leak)


def measured_leakage(rig: Rig, channels: dict) -> np.ndarray | None:
    """Return A1/V1 Q1 - A2/V2 Q2 of leakage and make-up from measured pressures, or None.

    With equal sides leakage is proportional to the force and part of the lumped balance; None
    then.  A single-rod cylinder rests at two pressures, so that oil leaks at no force; the flow
    then comes from the pressures themselves (the flow balances of
    :func:`physics.balances.derivatives`).  N/Pa/s per unit of bulk modulus.
    """
    equal = rig.area_1 == rig.area_2 and rig.volume_1 == rig.volume_2
    if equal or None in (rig.area_1, rig.area_2, rig.volume_1, rig.volume_2) or not (
            "p1" in channels and "p2" in channels):
        return None
    p1, p2 = channels["p1"], channels["p2"]
    one, two = rig.area_1 / rig.volume_1, rig.area_2 / rig.volume_2
    crossing = 0.5 * (rig.leakage - rig.makeup_conductance) * (p1 - p2)
    makeup_1 = rig.makeup_conductance * (p1 - rig.charge_pressure)
    makeup_2 = rig.makeup_conductance * (p2 - rig.charge_pressure)
    return -crossing * (one + two) - makeup_1 * one + makeup_2 * two


def force_of(rig: Rig, row: dict) -> np.ndarray | float | None:
    """Return A1 p1 - A2 p2, or the measured force where pressures are not at hand; N."""
    if "p1" in row and "p2" in row and rig.area_1 is not None and rig.area_2 is not None:
        return rig.area_1 * row["p1"] - rig.area_2 * row["p2"]
    return row.get("force")


def moved_mass(model: "RigModel", dt: float) -> float:
    """Return the mass by which stage one reads the sampled force, kg.

    Behind a drive that holds its speed over the sample the force bends within the sample by
    F'' = -beta_e S2 x'', and all of its corners lie at the samples, so that its samples do not
    show it.  Its mean is higher by -F'' T^2/12, which acts like a smaller mass:
    M (1 - beta_e S2 T^2/(12 M)), with the nominal bulk modulus.
    """
    rig = model.settings.rig
    if model.settings.command_hold != "sampled" or model.hydraulics is None:
        return rig.mass
    return max(rig.mass - rig.bulk_modulus * model.hydraulics[STIFF] * dt**2 / 12.0,
               0.5 * rig.mass)


def force_missing(rig: Rig, names) -> str | None:
    """Say why stage one has no input, or None where it has."""
    if "x" not in names:
        return "stage one needs the position channel x"
    if "force" in names or ("p1" in names and "p2" in names and rig.area_1 and rig.area_2):
        return None
    if "p1" in names and "p2" in names:
        return "stage one needs rig.area_1 and rig.area_2 for the pressure force"
    return "stage one needs the channels p1 and p2, or force"


def drive_missing(settings: Settings, names) -> str | None:
    """Say why stage two has no input, or None where it has."""
    if "x" not in names:
        return "stage two needs the position channel x"
    rig = settings.rig
    for key in ("area_1", "area_2", "volume_1", "volume_2", "pump_displacement"):
        if getattr(rig, key) is None:
            return f"stage two needs rig.{key}, which the config leaves null"
    if rig.position_gain is not None and "x_d" in names:
        return None
    if "omega" in names:
        return None
    return "stage two needs the channel x_d with rig.position_gain, or the channel omega"


def force_variance(rig: Rig, noise: dict[str, NoiseEstimate], extra: float) -> float:
    """Return the variance of the force on a sample from the sensors' noise, N^2."""
    if "p1" in noise and "p2" in noise and rig.area_1 is not None and rig.area_2 is not None:
        measured = (rig.area_1 * noise["p1"].value) ** 2 + (rig.area_2 * noise["p2"].value) ** 2
    else:
        measured = noise["force"].value ** 2 if "force" in noise else 0.0
    return measured + extra**2


@dataclass(frozen=True)
class StageInputs:
    """Everything the two kernels take from one recording.

    ``measured_force`` is the force as sampled, N.  The holds' variances include the sensors'
    noise; the reasons are None where the stage can run.
    ``p1``, ``p2`` are the mean pressures of the sample before each, or one charge pressure.
    ``quantum`` is the position's resolution in m, 0 where it is continuous; ``spikes`` counts the
    samples of each channel that were left out.
    """

    model: RigModel
    dt: float
    x: np.ndarray
    measured_force: np.ndarray
    force: Hold
    drive: Hold
    leak_flow: np.ndarray
    p1: np.ndarray
    p2: np.ndarray
    noise: dict[str, NoiseEstimate]
    position_variance: float
    quantum: float
    no_force: str | None
    no_drive: str | None
    spikes: dict[str, int]

    @classmethod
    def of(cls, recording: Recording, settings: Settings) -> "StageInputs":
        """Collect the inputs of a recording."""
        names = [name for name in recording.channels if recording.has(name)]
        noise = noise_levels(recording, settings.noise)
        channels, spikes = without_spikes(
            {name: recording.channels[name] for name in names}, noise)
        rig = settings.rig
        both = "p1" in channels and "p2" in channels
        mean = float(np.nanmedian(0.5 * (channels["p1"] + channels["p2"]))) if both else None
        model = RigModel.of(settings, mean, "x_d" in channels)
        no_force = force_missing(rig, channels)
        no_drive = drive_missing(settings, channels)
        nothing = hold_of(np.full(len(recording), np.nan), 0.0)
        force = drive = nothing
        measured_force = nothing.start
        if no_force is None:
            variance = force_variance(rig, noise, settings.stage_one.force_noise)
            measured_force = force_of(rig, channels)
            force = with_noise(hold_of(measured_force, variance**0.5,
                                       kinked=settings.command_hold == "sampled"), variance)
        if no_drive is None:
            drive = drive_input(model, channels, noise)
        charge = np.array([rig.charge_pressure])
        x = channels.get("x", np.full(len(recording), np.nan))
        step = quantum(x[np.isfinite(x)])
        leak_flow = measured_leakage(rig, channels)
        if leak_flow is not None:
            model = replace(model, leak=0.0)
        return cls(
            model, recording.sample_time, x, measured_force, force, drive,
            np.zeros(len(recording)) if leak_flow is None else between(leak_flow),
            between(channels["p1"]) if both else charge,
            between(channels["p2"]) if both else charge, noise,
            position_variance(noise, step), step, no_force, no_drive, spikes)


def position_variance(noise: dict[str, NoiseEstimate], step: float) -> float:
    """Return the variance of the measured position, m^2.

    A rounding error is not white: on periodic motion it repeats with the motion.  Where it
    dominates it counts with twice its standard deviation, step/sqrt(3).
    """
    if "x" not in noise:
        return np.nan
    return max(noise["x"].value, step / np.sqrt(3.0)) ** 2


def without_spikes(channels: dict[str, np.ndarray], noise: dict[str, NoiseEstimate]
                   ) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Return the channels with lone wild samples set to NaN, and how many there were.

    A sample is wild when it lies far outside what its two neighbours on each side span: ten
    times that span and thirty sigmas.  A step is none: its neighbours span it.
    """
    cleaned, counts = {}, {}
    for name, values in channels.items():
        cleaned[name] = values
        if name not in noise or name == "temperature" or len(values) < 5:
            continue
        around = np.stack([np.roll(values, d) for d in (-2, -1, 1, 2)])
        span = around.max(axis=0) - around.min(axis=0)
        middle = 0.5 * (around.max(axis=0) + around.min(axis=0))
        with np.errstate(invalid="ignore"):
            wild = np.abs(values - middle) > SPIKE_SPAN * span + SPIKE_SIGMAS * noise[name].value
        wild[:2] = wild[-2:] = False
        if wild.any():
            cleaned[name] = np.where(wild, np.nan, values)
            counts[name] = int(wild.sum())
    return cleaned, counts


def between(values: np.ndarray) -> np.ndarray:
    """Return the mean over the sample before each; at one end alone where the other is missing.

    A pressure taken from one end would be half a sample late or early, which a modelled leakage
    shows as a change of beta_e.
    """
    before = np.concatenate([values[:1], values[:-1]])
    mean = 0.5 * (before + values)
    return np.where(np.isnan(mean), np.where(np.isnan(values), before, values), mean)


def with_noise(hold: Hold, variance: float) -> Hold:
    """Add the sensor's variance to that of the interpolation."""
    return replace(hold, variance=hold.variance + variance)


def drive_input(model: RigModel, channels: dict, noise: dict) -> Hold:
    """Return stage two's input.

    x_d in m where the loop is part of the model; the pump speed in rad/s where it is not: the
    one that a sampled drive makes of x_d - x, or the measured one.  Whether the drive reads the
    recorded x or a cleaner one is not known, so the noise of x counts as the input's own.
    """
    rig = model.settings.rig
    if rig.position_gain is not None and "x_d" in channels:
        if model.loop:
            return hold_of(channels["x_d"], 0.0)
        sigma = rig.position_gain * noise["x"].value
        return with_noise(hold_of(rig.position_gain * (channels["x_d"] - channels["x"]), 0.0,
                                  sampled=True), sigma**2)
    sigma = noise["omega"].value
    return with_noise(hold_of(channels["omega"], sigma), sigma**2)
