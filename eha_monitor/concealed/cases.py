"""A case of the trial: its motion, what is true in it, and the plant's run of it."""

import math
from dataclasses import dataclass, field, replace

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
from eha_monitor.concealed.plant import N_CONSTANTS, NAMES, OMEGA, P1, P2, bristle_stiffness, run

RAMP = 6e-3  # s, a step is a ramp of this length: the sampled demand then hides nothing
# rich: two triangles, multisine, steps; short: the same parts; triangle and sine: the paper's own;
# two_speed: the paper's triangle, then a slow one.
# Of fast triangle and multisine, of slow triangle and steps, s; period of the fast triangle, s;
# amplitudes of both, m; length of a step, s.
PARTS = {"rich": (8.0, 4.0, 4.0, 0.04, 0.008, 0.4), "short": (2.0, 1.0, 2.0, 0.02, 0.002, 0.2)}
LENGTHS = {"rich": 24.0, "short": 6.0, "triangle": 24.0, "two_speed": 24.0, "sine": 8.0}


def triangle(t: np.ndarray, period: float, amplitude: float) -> np.ndarray:
    """Return a triangle from 0, rising first; m."""
    phase = np.mod(t / period + 0.25, 1.0)
    return amplitude * (1.0 - 4.0 * np.abs(phase - 0.5))


def multisine(t: np.ndarray, duration: float, amplitude: float, rng) -> np.ndarray:
    """Return tones from about 0.4 to 28 Hz, periodic in ``duration``, from 0 to 0; m."""
    lines = np.unique(np.round(np.geomspace(0.4, 28.0, 14) * duration).clip(min=1))
    phases = rng.uniform(0.0, 2 * np.pi, len(lines))
    weights = (lines / lines[0]) ** -0.35
    wave = np.zeros_like(t)
    for line, phase, weight in zip(lines, phases, weights, strict=True):
        wave += weight * (np.sin(2 * np.pi * line * t / duration + phase) - np.sin(phase))
    return amplitude * wave / weights.sum()


def steps(t: np.ndarray, duration: float, amplitude: float, each: float, rng) -> np.ndarray:
    """Return steps to random places on alternate sides, the last back to 0; m."""
    count = round(duration / each)
    sides = np.where(np.arange(count - 1) % 2 == 0, 1.0, -1.0)
    places = np.concatenate([[0.0], amplitude * sides * rng.uniform(0.3, 1.0, count - 1), [0.0]])
    corners = np.arange(count) * each
    at = np.column_stack([corners, corners + RAMP]).ravel()
    return np.interp(t, at, np.column_stack([places[:-1], places[1:]]).ravel())


def demanded_position(motion: str, t: np.ndarray, seed: int = 0, scale: float = 1.0) -> np.ndarray:
    """Return x_d(t) in m; before 0 the demand rests at its first value.

    Parameters
    ----------
    motion : a key of ``LENGTHS``.
    t : any shape, s.
    seed : phases of the multisine and places of the steps.
    scale : factor on all amplitudes.
    """
    t = np.maximum(t, 0.0)
    if motion == "triangle":
        return scale * triangle(t, 4.0, 0.04)
    if motion == "sine":
        return scale * 0.01 * np.sin(2 * np.pi * 4.0 * t)
    if motion == "two_speed":
        return scale * np.where(t < 12.0, triangle(t, 4.0, 0.04), triangle(t, 4.0, 0.008))
    if motion not in PARTS:
        raise ValueError(f"motion: expected {', '.join(LENGTHS)}, got {motion!r}")
    rng = np.random.default_rng([seed, 77])
    tones, places = rng.spawn(2)
    long, brief, period, fast, slow, each = PARTS[motion]
    parts = ((long, lambda u: triangle(u, period, fast)),
             (brief, lambda u: triangle(u, brief, slow)),
             (long, lambda u: multisine(u, long, 0.036, tones)),
             (brief, lambda u: steps(u, brief, 0.008, each, places)))
    out = np.zeros_like(t)
    start = 0.0
    for length, shape in parts:
        here = (t >= start) & (t < start + length)
        out[here] = shape(t[here] - start)
        start += length
    return scale * out


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
DRIVES = ("analogue", "digital", "digital_own")
SEAL_TRAVEL = 4e-6  # m
SAMPLE_TIME = 1e-3  # s
PREROLL = 1.5  # s at rest before the recording: it starts on a running rig
SUBSTEPS = 20
_BALANCES = {name: balance for table in (CATALOGUE_BALANCES, OUTSIDE_BALANCES)
             for balance, names in table.items() for name in names}


@dataclass(frozen=True)
class Case:
    """One recording to be made."""

    name: str
    # Name, strength: 1 is clear, negative turns the sign.
    effects: tuple[tuple[str, float], ...] = ()
    motion: str = "rich"  # a key of LENGTHS
    seed: int = 0  # of noise, clock and the random parts of the motion
    noise: float = 1.0  # factor on the sensors' noise
    channels: tuple[str, ...] = ("x", "x_d", "omega", "p1", "p2")  # what is recorded
    # Constants of the true rig that differ from the paper's, by symbol, e.g. ``B``; also
    # ``amplitude``, the factor on the motion.
    rig: dict = field(default_factory=dict)
    # Constants that the nominal config gets in place of the true design values; B and beta_e are
    # the paper's there unless named here.
    nominal: dict = field(default_factory=dict)
    tolerances: dict = field(default_factory=dict)  # that differ from TOLERANCES, by symbol
    # Effect -> parameters of its key to set outright: {"pressure_offset": {"sensor": "p2"}}.
    options: dict = field(default_factory=dict)
    nuisance: float = 1.0  # factor on sensor lag, clock jitter and encoder step
    # ``digital``: it reads the recorded position with its noise and holds the speed that it
    # computes until the next sample; ``digital_own``: it reads a sensor of its own, without noise.
    drive: str = "analogue"
    # (n,) x_d in m, one value to a sample, in place of the motion.
    demand: np.ndarray | None = field(default=None, compare=False, repr=False)

    def __post_init__(self):
        for name, _ in self.effects:
            if name not in ENTRIES:
                raise ValueError(f"{self.name}: no effect {name!r}")
        if self.motion not in LENGTHS:
            raise ValueError(f"{self.name}: no motion {self.motion!r}")
        if self.drive not in DRIVES:
            raise ValueError(f"{self.name}: no drive {self.drive!r}")
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

    ``key`` of the config, ``true`` and ``configured`` value (SI), ``tolerances`` between them,
    positive where the config says too much.
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
    others = tuple(one for one in case.effects
                   if one[0] not in (*THRESHOLDED, "sticking_check_valve"))
    reach = reach_of(replace(case, effects=others)) if others != case.effects else Reach()
    return [ENTRIES[name](Context(strength, case.options.get(name, {}), rig, reach))
            for name, strength in case.effects]


def reach_of(case: Case) -> Reach:
    """Return what the motion needs on the rig of this case."""
    key = repr((case.effects, case.motion, case.seed, case.drive, sorted(case.rig.items()),
                sorted((k, sorted(v.items())) for k, v in case.options.items()),
                None if case.demand is None else np.asarray(case.demand).tobytes()))
    if key not in _reaches:
        fine, time, _ = fine_run(case, hidden_of(case))
        fine = fine[time >= 0.0]
        _reaches[key] = Reach(
            speed=float(np.abs(fine[:, OMEGA]).max()),
            pressure_difference=float(np.abs(fine[:, P1] - fine[:, P2]).max()),
            lowest_pressure=float(min(fine[:, P1].min(), fine[:, P2].min())))
    return _reaches[key]


_reaches: dict[str, Reach] = {}  # by all that the plant of a case depends on


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
    return demanded_position(case.motion, time, case.seed, float(case.rig.get("amplitude", 1.0)))


def fine_run(case: Case, made: list[Hidden], substeps: int = SUBSTEPS,
             noise: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Return the trajectory (m, N_COLUMNS), its time (m,) from the recording's start, sensors.

    The step is a 20th of the sample time, or finer where a seal is stiff.

    ``noise`` : (n,) m, of the recorded position, which a digital drive reads with it.
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
    read = np.zeros(len(out))
    if case.drive != "analogue":
        constants[NAMES.index("held_steps")] = substeps
    if case.drive == "digital" and noise is not None:
        read[before::substeps][:len(noise)] = noise
    run(constants, x_d, h, read, out)
    return out, halves[::2], sensors
