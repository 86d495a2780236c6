"""The rig as the stages take it: constants of the balances, modelled effects, what is lacking."""

import math
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.estimation.discretisation import LOOP, MASS, STIFF, hydraulics
from eha_monitor.estimation.drive import loop_gain, opens_loop
from eha_monitor.estimation.modelled import Effects, contributions, new_known_memory
from eha_monitor.estimation.results import NoiseEstimate
from eha_monitor.physics import own_term
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import circuit_of, slot_of, with_term, with_update
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of, theta_of
from eha_monitor.recordings.grid import filled
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig

SMOOTHED = 5  # samples on each side over which the mean pressure is smoothed
LINE = NAMES.index("line_dynamics")
NEAR = 3.0  # times the noise of a pressure sensor
STIFF_VALVE = 0.5  # times in a sample that a chamber settles by it
FLOW_BALANCE = {s.FLOW_1, s.FLOW_2, s.COMPLIANCE_1, s.COMPLIANCE_2, s.VOLUME_1, s.VOLUME_2}


@dataclass(frozen=True)
class RigModel:
    """Constants of the two stages that do not depend on the recording.

    Attributes
    ----------
    effects : those of the config with the parameters; a modelled mass is part of ``theta[M]``.
    active : which effects the config has.
    pump : places of the effects that change the pump's speed whatever the pressure.
    circuit : constants of the modelled drive and sensors.
    opened : the drive's effects make the pump speed, not x_d, stage two's input.
    loop : x_d is the input and the drive is part of the model.
    hydraulics, leak : lumped flow balance; None without its constants.
    valves : names of the stiff valves, while which are open stage two has no input.
    """

    settings: Settings
    effects: Effects
    active: np.ndarray
    pump: np.ndarray
    circuit: np.ndarray
    opened: bool
    beta_0: float
    loop: bool
    hydraulics: np.ndarray | None
    leak: float
    valves: tuple[str, ...] = ()

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
        with_terms = with_term(active).tolist()
        places = {kind: np.array([which for which in with_terms
                                  if added_by(which, theta) & added], dtype=np.int64)
                  for kind, added in (("force", {s.FORCE}), ("pump", {s.SPEED}),
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
        by_force = np.array([depends_on_pressure(which, theta)
                             for which in places["pump"].tolist()], dtype=bool)
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
        flows = places["flows"] if known else places["flows"][:0]
        return cls(settings, Effects(theta, places["force"][~remember], places["force"][remember],
                                     flows),
                   active, places["pump"], circuit, opened, beta_0, loop, constants, leak)

    @property
    def held(self) -> bool:
        """Whether the pump turns at one speed over each sample; behind a lag it does not."""
        return self.settings.command_hold == "sampled" and not self.circuit[s.DRIVE_LAG]

    @property
    def theta(self) -> np.ndarray:
        """(N_THETA,) parameters of rig and effects."""
        return self.effects.theta

    @property
    def ringing(self) -> float:
        """Resonance of mass and oil column as configured, rad/s; 0 without its constants."""
        if self.hydraulics is None:
            return 0.0
        return math.sqrt(self.settings.rig.bulk_modulus * self.hydraulics[STIFF]
                         / self.hydraulics[MASS])


def added_by(which: int, theta: np.ndarray) -> set[int]:
    """Return to which contributions the effect or own term at a place adds."""
    return set(CATALOGUE[NAMES[which]].adds if which < len(NAMES)
               else own_term.added(theta[slot_of(which)]))


def depends_on_pressure(which: int, theta: np.ndarray) -> bool:
    """Tell whether the term of the effect or own term at a place reads a pressure."""
    if which < len(NAMES):
        return not {s.P1, s.P2}.isdisjoint(CATALOGUE[NAMES[which]].reads)
    return own_term.reads_pressure(theta[slot_of(which)])


def rest_contributions(theta: np.ndarray, active: np.ndarray, pressure: float) -> np.ndarray:
    """Return what the effects add at rest at this pressure, (N_CONTRIBUTIONS,)."""
    signals, found = np.zeros(s.N_SIGNALS), np.zeros(s.N_CONTRIBUTIONS)
    signals[[s.P1, s.P2]] = pressure
    contributions(signals, theta, with_term(active), new_known_memory(), found)
    return found


def model_for(channels: dict[str, np.ndarray], settings: Settings) -> RigModel:
    """Return the rig's model for what a recording holds."""
    mean = None
    if "p1" in channels and "p2" in channels:
        both = 0.5 * (channels["p1"] + channels["p2"])
        if np.isfinite(both).any():  # they need not be there at the same time
            mean = float(np.nanmedian(both))
    model = RigModel.of(settings, mean, "x_d" in channels)
    if measures_leakage(settings.rig, channels):
        model = replace(model, leak=0.0)
    if mean is not None and (valves := stiff_valves(settings)):
        flows = np.setdiff1d(model.effects.flows, [NAMES.index(name) for name in valves])
        model = replace(model, effects=model.effects._replace(flows=flows), valves=valves)
    return model


def stiff_valves(settings: Settings) -> tuple[str, ...]:
    """Return the config's valves by which a chamber settles in a sample, as fast as beta_e k/V.

    Stage two has the pressures from its force and their mean.  What such a valve takes back of
    that force within a sample is as much as all of it: the filter would run away each time one
    opens.  It gets no input while one is open, and starts again behind.
    """
    rig = settings.rig
    if None in (rig.area_1, rig.area_2, rig.volume_1, rig.volume_2):
        return ()
    stiffness = rig.bulk_modulus / min(rig.volume_1, rig.volume_2) * rig.sample_time
    return tuple(name for name, values in settings.effects.items()
                 if name in CATALOGUE and CATALOGUE[name].valve
                 and values["k"] * stiffness > STIFF_VALVE)


def valve_open(model: RigModel, channels: dict, noise: float) -> np.ndarray:
    """Return where a stiff valve is open, or the sensors' ``noise`` (Pa) may say so; (n,) bool."""
    effects, near = model.settings.effects, NEAR * noise
    p1, p2 = channels["p1"], channels["p2"]
    found = np.zeros(len(p1), dtype=bool)
    for name in model.valves:
        opens = effects[name][CATALOGUE[name].parameters[1].name]
        if CATALOGUE[name].valve == "below":
            found |= np.fmin(p1, p2) < opens + near
        else:
            found |= np.abs(p1 - p2) > opens - near
    # As far as the mean pressure, of which stage two takes its own, mixes neighbours.
    return np.convolve(found, np.ones(2 * SMOOTHED + 1), mode="same") > 0.5


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
    if not np.isfinite(mean).any():
        return np.full(len(mean), rig.charge_pressure)
    window = np.ones(2 * SMOOTHED) / (2 * SMOOTHED)
    mean = filled(mean)
    padded = np.concatenate([mean[:1].repeat(SMOOTHED), mean, mean[-1:].repeat(SMOOTHED - 1)])
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
    if not model.held or model.hydraulics is None:
        return model.theta[s.M]
    return max(model.theta[s.M] - rig.bulk_modulus * model.hydraulics[STIFF] * dt**2 / 12.0,
               0.5 * model.theta[s.M])


def force_missing(rig: Rig, names) -> str | None:
    """Say why stage one has no input, or None where it has."""
    pressures = "p1" in names and "p2" in names
    if "x" not in names:
        return "stage one needs the position channel x"
    if "force" in names or (pressures and rig.area_1 and rig.area_2):
        return None
    if pressures:
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
    if (rig.position_gain is not None and "x_d" in names) or "omega" in names:
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
