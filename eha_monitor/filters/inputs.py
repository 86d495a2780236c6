"""From a recording to what the stages take: force, drive input, noise, constants, reasons."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np

from eha_monitor.filters.drive import drive_input, loop_gain, opens_loop
from eha_monitor.filters.hold import Hold, hold_of
from eha_monitor.filters.known import contributions, new_known_memory, speaks_of
from eha_monitor.filters.noise import noise_levels, quantum, without_spikes
from eha_monitor.filters.results import NoiseEstimate
from eha_monitor.filters.sensors import undo_sensors
from eha_monitor.filters.stage_two import LOOP, STIFF, hydraulics
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import circuit_of, with_term, with_update
from eha_monitor.physics.effects import NAMES
from eha_monitor.physics.parameters import place_of, theta_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig

SMOOTHED = 5  # samples on each side over which the mean pressure is smoothed
LINE = NAMES.index("line_dynamics")
FLOW_BALANCE = ("FLOW_1", "FLOW_2", "COMPLIANCE_1", "COMPLIANCE_2", "VOLUME_1", "VOLUME_2")


@dataclass(frozen=True)
class RigModel:
    """Constants of the two stages that do not depend on the recording.

    Attributes
    ----------
    theta, active : parameters and the effects of the config; a modelled mass is part of
        ``theta[M]``.
    plain, remembering, flows, pump : places of the active effects that make force, without and
        with memory, that are in the flow balance, and that change the pump's speed whatever the
        pressure.
    circuit : constants of the modelled drive and sensors.
    opened : the drive's effects make the pump speed, not x_d, stage two's input.
    loop : x_d is the input and the drive is part of the model.
    hydraulics, leak : lumped flow balance; None without its constants.
    """

    settings: Settings
    theta: np.ndarray
    active: np.ndarray
    plain: np.ndarray
    remembering: np.ndarray
    flows: np.ndarray
    pump: np.ndarray
    circuit: np.ndarray
    opened: bool
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
        places = {kind: np.array([which for which in with_term(active)
                                  if speaks_of(which, theta, *names)], dtype=np.int64)
                  for kind, names in (("force", ("FORCE",)), ("pump", ("SPEED",)),
                                      ("flows", FLOW_BALANCE))}
        # A line is part of stage two's own flow balance (:mod:`stage_two`).
        line = (0.0, 0.0, 0.0)
        if active[LINE]:
            line = tuple(theta[place_of(f"{NAMES[LINE]}.{one}")] for one in ("T_l", "zeta", "Z"))
            places["pump"] = places["pump"][places["pump"] != LINE]
        updates = with_update(active, theta)
        remember = np.isin(places["force"], updates)
        circuit = circuit_of(theta, active)
        opened = opens_loop(circuit, places["pump"])
        # What a pump loses to pressure is better told by the stage's own force than by sensors.
        by_force = np.array([speaks_of(which, theta, "P1", "P2")
                             for which in places["pump"]], dtype=bool)
        places["flows"] = np.union1d(places["flows"], places["pump"][by_force])
        places["pump"] = places["pump"][~by_force]
        known = None not in (rig.area_1, rig.area_2, rig.volume_1, rig.volume_2,
                             rig.pump_displacement)
        loop = (commanded and rig.position_gain is not None and not opened
                and settings.command_hold != "sampled")
        pressure = rig.charge_pressure if mean_pressure is None else mean_pressure
        at_rest = rest_contributions(theta, active, pressure)
        theta[s.M] += at_rest[s.MASS]
        extra = 0.5 * (at_rest[s.COMPLIANCE_1] + at_rest[s.COMPLIANCE_2])
        constants = hydraulics(theta, beta_0, extra, loop, line) if known else None
        leak = 0.0
        if known:
            leak = 0.5 * theta[s.C_T] * (1 / theta[s.VOL_1] + 1 / theta[s.VOL_2])
            if loop:
                constants[LOOP] = loop_gain(theta, circuit)
        return cls(settings, theta, active, places["force"][~remember],
                   places["force"][remember], places["flows"] if known else places["flows"][:0],
                   places["pump"], circuit, opened, beta_0, loop, constants, leak)


def rest_contributions(theta: np.ndarray, active: np.ndarray, pressure: float) -> np.ndarray:
    """Return what the effects add at rest at this pressure, (N_CONTRIBUTIONS,)."""
    signals, found = np.zeros(s.N_SIGNALS), np.zeros(s.N_CONTRIBUTIONS)
    signals[[s.P1, s.P2]] = pressure
    contributions(signals, theta, with_term(active), new_known_memory(), found)
    return found


def mean_pressure(channels: dict[str, np.ndarray], rig: Rig) -> np.ndarray:
    """Return the mean of both pressures over the sample before each, smoothed; Pa.

    It moves slowly; stage two takes the difference of the pressures from its own force, since
    the sensors' noise would stand in a flow balance that trusts itself.  Where the pressures are
    not recorded it is that of the rig at rest, (1,).
    """
    if not ("p1" in channels and "p2" in channels):
        ratio = 1.0 if None in (rig.area_1, rig.area_2) else rig.area_1 / rig.area_2
        return np.array([0.5 * rig.charge_pressure * (1.0 + ratio)])
    mean = 0.5 * (channels["p1"] + channels["p2"])
    good = np.isfinite(mean)
    if not good.any():
        return np.full(len(mean), rig.charge_pressure)
    window = np.ones(2 * SMOOTHED) / (2 * SMOOTHED)
    index = np.arange(len(mean))
    filled = np.interp(index, index[good], mean[good])
    padded = np.pad(filled, (SMOOTHED, SMOOTHED - 1), mode="edge")
    return np.convolve(padded, window, mode="valid")


def measures_leakage(rig: Rig, names) -> bool:
    """Tell whether leakage and make-up come from measured pressures."""
    equal = rig.area_1 == rig.area_2 and rig.volume_1 == rig.volume_2
    return not equal and None not in (rig.area_1, rig.area_2, rig.volume_1, rig.volume_2) and (
        "p1" in names and "p2" in names)


def measured_leakage(rig: Rig, channels: dict) -> np.ndarray | None:
    """Return A1/V1 Q1 - A2/V2 Q2 of leakage and make-up from measured pressures, or None.

    With equal sides leakage is proportional to the force and part of the lumped balance; None
    then.  A single-rod cylinder rests at two pressures, so that oil leaks at no force; the flow
    then comes from the pressures themselves (the flow balances of
    :func:`physics.balances.derivatives`).  N/Pa/s per unit of bulk modulus.
    """
    if not measures_leakage(rig, channels):
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
        return model.theta[s.M]
    return max(model.theta[s.M] - rig.bulk_modulus * model.hydraulics[STIFF] * dt**2 / 12.0,
               0.5 * model.theta[s.M])


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


def missing(settings: Settings, names) -> tuple[str | None, str | None]:
    """Say why stage one and stage two have no input, each None where it has."""
    return force_missing(settings.rig, names), drive_missing(settings, names)


def force_variance(rig: Rig, noise: dict[str, NoiseEstimate], extra: float) -> float:
    """Return the variance of the force on a sample from the sensors' noise, N^2."""
    if "p1" in noise and "p2" in noise and rig.area_1 is not None and rig.area_2 is not None:
        measured = (rig.area_1 * noise["p1"].value) ** 2 + (rig.area_2 * noise["p2"].value) ** 2
    else:
        measured = noise["force"].value ** 2 if "force" in noise else 0.0
    return measured + extra**2


@dataclass(frozen=True)
class Known:
    """What the live estimator knows about its rows and does not measure anew on each batch.

    The reasons are those of the rows that it began with; ``started`` is what the drive
    remembers at the first row; ``counted`` are the rows whose spikes are counted.
    """

    model: RigModel
    noise: dict[str, NoiseEstimate]
    quantum: float
    no_force: str | None
    no_drive: str | None
    started: np.ndarray | None = None
    counted: slice | None = None


@dataclass(frozen=True)
class Piece:
    """Rows that a stage takes at a time.

    Attributes
    ----------
    inputs : of these rows; the one before them comes first where there is one.
    first : the first of them in ``inputs``; ``row`` : its number in the recording.
    recording, within : rows that hold these and their neighbours, and where ``inputs`` lie there.
    """

    inputs: "StageInputs"
    first: int
    row: int
    recording: Recording | None
    within: slice


@dataclass(frozen=True)
class StageInputs:
    """Everything the two kernels take from one recording.

    ``measured_force`` is the force as sampled, N.  The holds' variances include the sensors'
    noise; the reasons are None where the stage can run.
    ``p1``, ``p2`` are the mean pressures of the sample before each, or one charge pressure;
    ``mean`` is :func:`mean_pressure`.
    ``quantum`` is the position's resolution in m, 0 where it is continuous; ``spikes`` counts the
    samples of each channel that were left out.  ``x``, ``noise`` and all that comes of them have
    the sensors' known errors undone.  ``kept`` is what the drive remembers after each sample.
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
    mean: np.ndarray
    noise: dict[str, NoiseEstimate]
    position_variance: float
    quantum: float
    no_force: str | None
    no_drive: str | None
    spikes: dict[str, int]
    kept: np.ndarray

    @classmethod
    def of(cls, recording: Recording, settings: Settings, known: Known | None = None,
           since: float = 0.0) -> "StageInputs":
        """Collect the inputs of a recording that starts ``since`` s after the record did."""
        rig = settings.rig
        names = [name for name in recording.channels if known or recording.has(name)]
        noise = known.noise if known else noise_levels(recording, settings.noise)
        recorded, spikes = without_spikes(
            {name: recording.channels[name] for name in names}, noise,
            known.counted if known else None)
        circuit = known.model.circuit if known else circuit_of(
            *theta_of(rig, settings.effects))
        channels, noise = undo_sensors(
            recorded, noise, circuit, since + recording.sample_time * np.arange(len(recording)))
        if known:
            model, step = known.model, known.quantum
            no_force, no_drive = known.no_force, known.no_drive
        else:
            model, step = model_for(channels, settings), quantum_of(channels)
            no_force, no_drive = missing(settings, channels)
        measured_force = np.full(len(recording), np.nan)
        force = drive = Hold(*(measured_force,) * 3, np.full((len(recording), 2), np.nan))
        kept = np.empty((len(recording), 0))
        if no_force is None:
            variance = force_variance(rig, noise, settings.stage_one.force_noise)
            measured_force = force_of(rig, channels)
            force = with_noise(hold_of(measured_force, variance**0.5,
                                       kinked=settings.command_hold == "sampled"), variance)
        if no_drive is None:
            made = drive_input(model, recorded, channels, noise, recording.sample_time,
                               known.started if known else None)
            drive, kept = made.hold, made.kept
        both = "p1" in channels and "p2" in channels
        charge = np.array([rig.charge_pressure])
        leak_flow = measured_leakage(rig, channels)
        return cls(
            model, recording.sample_time,
            channels.get("x", np.full(len(recording), np.nan)), measured_force, force, drive,
            np.zeros(len(recording)) if leak_flow is None else between(leak_flow),
            between(channels["p1"]) if both else charge,
            between(channels["p2"]) if both else charge, mean_pressure(channels, rig), noise,
            position_variance(noise, step), step, no_force, no_drive, spikes, kept)

    @property
    def rows(self) -> int:
        """How many there are."""
        return len(self.x)

    @property
    def course(self) -> tuple[np.ndarray, np.ndarray]:
        """The drive's input at the start of each sample, and the position; (n,) each."""
        return self.drive.start, self.x

    def pieces(self, recording: Recording | None = None, begin: int = 0) -> Iterator[Piece]:
        """Yield the rows of ``recording`` from ``begin`` on at once, see :mod:`filters.pieces`."""
        part = self.part(begin, self.rows) if begin else self
        yield Piece(part, 0, begin, recording, slice(begin, None))

    def part(self, start: int, stop: int) -> "StageInputs":
        """Return the inputs of samples ``start`` to ``stop``."""
        n, cut = len(self.x), slice(start, stop)
        changed = {
            field.name: value[cut] for field in fields(self)
            if isinstance(value := getattr(self, field.name), np.ndarray) and len(value) == n}
        for name in ("force", "drive"):
            changed[name] = getattr(self, name).part(cut)
        return replace(self, **changed)


def model_for(channels: dict[str, np.ndarray], settings: Settings) -> RigModel:
    """Return the rig's model for what a recording holds."""
    mean = None
    if "p1" in channels and "p2" in channels:
        mean = float(np.nanmedian(0.5 * (channels["p1"] + channels["p2"])))
    model = RigModel.of(settings, mean, "x_d" in channels)
    if measures_leakage(settings.rig, channels):
        model = replace(model, leak=0.0)
    return model


def quantum_of(channels: dict[str, np.ndarray]) -> float:
    """Return the step of the position, m; 0 where it is continuous or absent."""
    x = channels.get("x", np.empty(0))
    return quantum(x[np.isfinite(x)])


def position_variance(noise: dict[str, NoiseEstimate], step: float) -> float:
    """Return the variance of the measured position, m^2.

    A rounding error is not white: on periodic motion it repeats with the motion.  Where it
    dominates it counts with twice its standard deviation, step/sqrt(3).
    """
    if "x" not in noise:
        return np.nan
    return max(noise["x"].value, step / np.sqrt(3.0)) ** 2


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
