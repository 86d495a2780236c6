"""A case of the trial, what is true in it, and the plant's run of it."""

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from eha_monitor.concealed.hidden import (
    CATALOGUE_BALANCES,
    ENTRIES,
    OUTSIDE_BALANCES,
    THRESHOLDED,
    Context,
    Hidden,
    Reach,
)
from eha_monitor.concealed.motions import LENGTHS, demanded_position
from eha_monitor.concealed.plant import N_CONSTANTS, NAMES, OMEGA, P1, P2, bristle_stiffness, run

# Key of Case.rig -> (constant of the plant, the paper's value).
RIG = {
    "A": ("area", 5.05e-4), "V": ("volume", 6.85e-5), "M": ("mass", 20.0),
    "B": ("damping", 600.0), "beta_e": ("bulk_modulus", 6e8), "C_T": ("leakage", 5e-13),
    "G": ("makeup", 1e-13), "p_charge": ("charge_pressure", 2e6),
    "D_p": ("displacement", 1.6925e-7), "K_pos": ("position_gain", 23000.0),
}
# Key of Case.rig -> keys of a config's rig.  One number for both sides of the piston: the plant is
# symmetric, and so is whoever measures it.
CONFIG_KEYS = {
    "A": ("area_1", "area_2"), "V": ("volume_1", "volume_2"), "M": ("mass",),
    "B": ("viscous_damping",), "beta_e": ("bulk_modulus",), "C_T": ("leakage",),
    "G": ("makeup_conductance",), "p_charge": ("charge_pressure",),
    "D_p": ("pump_displacement",), "K_pos": ("position_gain",),
}
# How well an engineer knows each: one standard deviation of its logarithm, as in the config's
# rig.tolerance.  Of the leakages only the order of magnitude is known.
TOLERANCES = {
    "A": 0.005, "V": 0.1, "M": 0.05, "C_T": math.log(3.0), "G": math.log(3.0), "p_charge": 0.2,
    "D_p": 0.03, "K_pos": 0.03,
}
SEAL_TRAVEL = 4e-6  # m
SAMPLE_TIME = 1e-3  # s
PREROLL = 1.5  # s at rest before the recording: it starts on a running rig
SUBSTEPS = 20
_BALANCES = {name: balance for table in (CATALOGUE_BALANCES, OUTSIDE_BALANCES)
             for balance, names in table.items() for name in names}


@dataclass(frozen=True)
class Case:
    """One recording to be made.

    Attributes
    ----------
    name : of the case.
    effects : (name, strength) pairs; 1 is clear, negative turns the sign where there is one.
    motion : ``rich`` (24 s), ``short`` (6 s), ``triangle`` (the paper's, 24 s), ``two_speed``
        (24 s) or ``sine`` (8 s).
    seed : of noise, clock and the random parts of the motion.
    noise : factor on the sensors' noise.
    channels : what is recorded.
    rig : constants of the true rig that differ from the paper's, by symbol, e.g. ``B``; also
        ``amplitude``, the factor on the motion.
    nominal : constants that the nominal config gets in place of the true design values; B and
        beta_e are the paper's there unless named here.
    tolerances : standard deviations of the logarithm that differ from ``TOLERANCES``, by symbol.
    options : effect -> parameters of its key to set outright, e.g. ``{"pressure_offset":
        {"sensor": "p2"}}``.
    nuisance : factor on sensor lag, clock jitter and encoder step.
    demand : (n,) x_d in m, one value to a sample, in place of the motion.
    """

    name: str
    effects: tuple[tuple[str, float], ...] = ()
    motion: str = "rich"
    seed: int = 0
    noise: float = 1.0
    channels: tuple[str, ...] = ("x", "x_d", "omega", "p1", "p2")
    rig: dict = field(default_factory=dict)
    nominal: dict = field(default_factory=dict)
    tolerances: dict = field(default_factory=dict)
    options: dict = field(default_factory=dict)
    nuisance: float = 1.0
    demand: np.ndarray | None = field(default=None, compare=False, repr=False)

    def __post_init__(self):
        for name, _ in self.effects:
            if name not in ENTRIES:
                raise ValueError(f"{self.name}: no effect {name!r}")
        if self.motion not in LENGTHS:
            raise ValueError(f"{self.name}: no motion {self.motion!r}")
        for key in self.rig:
            if key not in RIG and key != "amplitude":
                raise ValueError(f"{self.name}: no rig constant {key!r}")


def effect_names() -> tuple[str, ...]:
    """Return the names that the diagnosis has in its catalogue."""
    return tuple(name for names in CATALOGUE_BALANCES.values() for name in names)


def outside_names() -> tuple[str, ...]:
    """Return the effects that the diagnosis has no name for."""
    return tuple(name for names in OUTSIDE_BALANCES.values() for name in names)


def balance_of(name: str) -> str:
    """Return the balance that an effect is in: force, flow, drive or sensor."""
    return _BALANCES[name]


def rig_of(case: Case) -> dict[str, float]:
    """Return the true constants by the plant's names, SI."""
    return {place: float(case.rig.get(key, value)) for key, (place, value) in RIG.items()}


def truth_of(case: Case) -> dict:
    """Return the key's entry: effects with SI parameters, true B and beta_e, rig numbers off."""
    made = hidden_of(case)
    return {
        "effects": [
            {"name": name, "balance": balance_of(name), "strength": strength,
             "in_catalogue": name in effect_names(), "parameters": dict(one.parameters)}
            for (name, strength), one in zip(case.effects, made, strict=True)],
        "B": rig_of(case)["damping"], "beta_e": rig_of(case)["bulk_modulus"],
        "rig_off": rig_off(case),
    }


def rig_off(case: Case) -> list[dict]:
    """Return the rig numbers that the nominal config has wrong.

    Returns
    -------
    list of dict
        ``key`` of the config, ``true`` and ``configured`` value (SI), ``tolerances`` between
        them, positive where the config says too much.
    """
    true, spreads, found = rig_of(case), TOLERANCES | case.tolerances, []
    for symbol, spread in spreads.items():
        value = true[RIG[symbol][0]]
        said = case.nominal.get(symbol, value)
        if said != value:
            found += [{"key": key, "true": value, "configured": said,
                       "tolerances": math.log(said / value) / spread}
                      for key in CONFIG_KEYS[symbol]]
    return found


def hidden_of(case: Case) -> list[Hidden]:
    """Return the effects of a case made concrete, in its order."""
    rig = rig_of(case)
    needs = (*THRESHOLDED, "sticking_check_valve")
    reach = Reach()
    if any(name in needs for name, _ in case.effects):
        reach = reach_of(replace(case, effects=tuple(
            one for one in case.effects if one[0] not in needs)))
    return [ENTRIES[name](Context(strength, case.options.get(name, {}), rig, reach))
            for name, strength in case.effects]


def reach_of(case: Case) -> Reach:
    """Return what the motion needs on the rig of this case."""
    return _reach(_Key(case))


def constants_of(case: Case, made: list[Hidden]) -> tuple[np.ndarray, dict[str, float]]:
    """Return the plant's constants (N_CONSTANTS,) and those of the sensors, SI."""
    values = {**rig_of(case), "seal_travel": SEAL_TRAVEL}
    sensors: dict[str, float] = {}
    for one in made:
        values |= one.plant
        sensors |= one.sensors
    for one in made:  # after what is set: added mass and friction accumulate
        for place, more in one.added.items():
            values[place] = values.get(place, 0.0) + more
    constants = np.zeros(N_CONSTANTS)
    for place, value in values.items():
        constants[NAMES.index(place)] = value
    return constants, sensors


def samples_of(case: Case) -> int:
    """Return how many samples the recording has."""
    if case.demand is not None:
        return len(case.demand)
    return round(LENGTHS[case.motion] / SAMPLE_TIME)


def demand_of(case: Case, time: np.ndarray) -> np.ndarray:
    """Return x_d in m at any times, s since the recording's start."""
    if case.demand is not None:
        return np.interp(time, np.arange(len(case.demand)) * SAMPLE_TIME, case.demand)
    return demanded_position(case.motion, time, case.seed,
                             float(case.rig.get("amplitude", 1.0)))


def fine_run(case: Case, made: list[Hidden],
             substeps: int = SUBSTEPS) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Return the trajectory (m, N_COLUMNS), its time (m,) from the recording's start, sensors.

    The step is a 20th of the sample time, or finer where a seal is stiff.
    """
    constants, sensors = constants_of(case, made)
    mass = constants[NAMES.index("mass")]
    fastest = max(np.sqrt(bristle_stiffness(constants) / mass), 1.0)
    substeps = max(substeps, int(np.ceil(fastest * SAMPLE_TIME / 0.15)))
    h = SAMPLE_TIME / substeps
    before = round(PREROLL / SAMPLE_TIME) * substeps
    after = (samples_of(case) + 1) * substeps
    halves = (np.arange(2 * (before + after) + 1) - 2 * before) * (0.5 * h)
    x_d = demand_of(case, halves - sensors.get("command_delay", 0.0))
    out = np.empty((before + after + 1, 6))
    run(constants, x_d, h, out)
    return out, halves[::2], sensors


class _Key:
    """Hashable stand-in for a case: everything that its plant depends on."""

    def __init__(self, case: Case):
        self.case = case
        self.text = repr((case.effects, case.motion, case.seed, sorted(case.rig.items()),
                          sorted((k, sorted(v.items())) for k, v in case.options.items()),
                          None if case.demand is None else np.asarray(case.demand).tobytes()))

    def __eq__(self, other) -> bool:
        return self.text == other.text

    def __hash__(self) -> int:
        return hash(self.text)


@lru_cache(maxsize=64)
def _reach(key: _Key) -> Reach:
    fine, time, _ = fine_run(key.case, hidden_of(key.case))
    fine = fine[time >= 0.0]
    return Reach(speed=float(np.abs(fine[:, OMEGA]).max()),
                 pressure_difference=float(np.abs(fine[:, P1] - fine[:, P2]).max()),
                 lowest_pressure=float(min(fine[:, P1].min(), fine[:, P2].min())))
