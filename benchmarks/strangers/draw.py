"""Draws of strangers' rigs: what is true of each, and what its owner's data sheets say."""

from dataclasses import dataclass
from math import exp, pi

import numpy as np

from strangers.plant import (
    DAHL,
    GAUSSIAN,
    KARNOPP,
    LUGRE,
    NO_FRICTION,
    P1,
    P2,
    PA,
    RATIONAL,
    STRIBECK,
    TANH,
    Constants,
    Drive,
    Motion,
    Run,
    Sensors,
    W,
    fine_run,
)

LAWS = {"none": NO_FRICTION, "rational": RATIONAL, "tanh": TANH, "gaussian": GAUSSIAN,
        "karnopp": KARNOPP, "lugre": LUGRE, "dahl": DAHL, "stribeck": STRIBECK}
LAW_SHARES = (0.2, 0.16, 0.16, 0.12, 0.12, 0.16, 0.04, 0.04)
# equal: a rod on both sides; two_pumps: single rod, two pumps on one shaft displaced as the areas
# are; rod_accumulator: single rod, its rod side on an accumulator, the pump feeds the other.
KINDS = ("equal", "two_pumps", "rod_accumulator")
KIND_SHARES = (0.35, 0.5, 0.15)
# Bore and rod, mm, as they are sold.
CYLINDERS = ((16, 8), (20, 10), (25, 12), (32, 20), (40, 25), (50, 32), (63, 40), (80, 50))
STROKES = (0.1, 0.16, 0.2, 0.25, 0.32, 0.4)  # m
GRAVITY = 9.81
COOLING = 0.02  # 1/K, by which B falls with the oil's temperature
WARMEST = 40.0  # °C at which a rig's B is stated
# One standard deviation of each number of a data sheet, those of the config's rig.tolerance:
# relative, or the logarithm of a factor.
ERRORS = {"bore": 0.0025, "volume": 0.1, "mass": 0.05, "displacement": 0.03, "gain": 0.03,
          "charge": 0.2, "leakage": 1.1, "makeup": 1.1}
MOST = 1.7  # of these errors; a make-up that would exceed the leakage is brought below it
VACUUM = 6e4  # Pa absolute: below, oil would boil
ATTEMPTS = 50


@dataclass(frozen=True)
class Setting:
    """What differs between recordings of a rig.

    Attributes
    ----------
    load : N, against positive motion.
    damping : B at the start, N s/m.
    celsius : of the oil at the start; ``warms`` by so many K in the end.
    """

    name: str
    load: float
    damping: float
    celsius: float
    warms: float
    motion: Motion
    length: float


@dataclass(frozen=True)
class Sheet:
    """What the owner knows: SI, from data sheets and drawings, each off by its tolerance.

    ``gain`` None: he asks the recording.
    """

    bore: float
    rod: float
    rods: int
    stroke: float
    line_volume: float
    mass: float
    displacement: float
    gain: float | None
    charge: float
    leakage: float
    makeup: float


@dataclass(frozen=True)
class StrangerRig:
    """One rig with all that is true of it.

    Attributes
    ----------
    plant : constants without the setting's (load, B).
    law : of dry friction, a key of ``LAWS``.
    vary : what the settings differ in beside the motion: ``load``, ``temperature``, ``both`` or
        ``nothing``.
    """

    name: str
    kind: str
    law: str
    vary: str
    plant: Constants
    rate: float
    sensors: Sensors
    drive: Drive
    sheet: Sheet
    settings: tuple[Setting, ...]

    def run(self, setting: Setting, length: float | None = None) -> Run:
        """Return what is made of a setting; ``length`` in s in place of the setting's."""
        plant = self.plant._replace(load=setting.load, damping=setting.damping)
        return Run(plant, self.rate, length or setting.length, setting.motion, self.sensors,
                   self.drive, setting.celsius, setting.warms)


def draw_rig(seed: int, i: int, kind: str | None = None, law: str | None = None) -> StrangerRig:
    """Return the i-th rig of a seed; the same whatever else is drawn.

    Parameters
    ----------
    kind, law : one of ``KINDS``, one of ``LAWS``; drawn without.

    Raises
    ------
    RuntimeError
        If no draw keeps the oil liquid and the drive within its speed.
    """
    for attempt in range(ATTEMPTS):
        rig = _drawn(np.random.default_rng([seed, i, attempt, 26]), f"s{seed}_{i:03d}", kind, law)
        if all(_runs(rig, setting) for setting in rig.settings[:2]):
            return rig
    raise RuntimeError(f"no rig of seed {seed}, {i}, {kind}, {law} runs")


def _runs(rig: StrangerRig, setting: Setting) -> bool:
    """Tell whether no chamber boils and the pump stays below 450 rad/s, 250 bar."""
    out, _, at, _ = fine_run(rig.run(setting, 5.0), substeps=20)
    rows = out[at[0]:]
    return bool(np.isfinite(rows).all() and rows[:, [P1, P2]].min() > VACUUM
                and rows[:, [P1, P2]].max() < 2.5e7 and np.abs(rows[:, W]).max() < 450.0
                and rows[:, PA].min() > VACUUM)


def _drawn(rng: np.random.Generator, name: str, kind: str | None, law: str | None
           ) -> StrangerRig:
    kind = kind or str(rng.choice(KINDS, p=KIND_SHARES))
    law = law or str(rng.choice(list(LAWS), p=LAW_SHARES))

    def between(low, high):
        return float(rng.uniform(low, high))

    def decade(low, high):
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    def off(which):  # a data sheet's value over the true one
        return exp(ERRORS[which] * float(np.clip(rng.standard_normal(), -MOST, MOST)))

    # A cylinder that suits the mass: 8 kg on 20 mm, 800 kg on 80 mm.
    mass_said = float(f"{decade(8, 800):.2g}")
    suits = 0.75 * np.log2(mass_said / 8) + 0.8
    bore_mm, rod_mm = CYLINDERS[int(np.clip(round(suits + between(-0.7, 0.7)), 0, 7))]
    stroke = float(rng.choice(STROKES[:4] if bore_mm < 40 else STROKES))
    bore, rod = bore_mm * 1e-3 / off("bore"), rod_mm * 1e-3
    area_1 = pi / 4 * (bore**2 - (rod**2 if kind == "equal" else 0.0))
    area_2 = pi / 4 * (bore**2 - rod**2)
    line = float(f"{0.12 * area_1 * stroke * between(0.5, 2.0):.1g}")
    both = off("volume")
    volumes = [(area * stroke / 2 + line) / both * between(0.97, 1.03)
               for area in (area_1, area_2)]
    mass, beta = mass_said / off("mass"), between(4.5, 11.0) * 1e8
    natural = np.sqrt(beta * (area_1**2 / volumes[0] + area_2**2 / volumes[1]) / mass)
    damping = 2.0 * between(0.03, 0.12) * natural * mass
    # A loop that the oil column bears, with its lag and its hold.
    rate = float(rng.choice((500.0, 1000.0)))
    loop = min(between(0.15, 0.28) * damping / mass, 14.0)
    hold = int(rng.choice((0, 1, 2), p=(0.35, 0.45, 0.2))) if rate > 600 else int(
        rng.random() < 0.65)
    lag = min(between(1e-3, 6e-3), 0.05 / loop) if rng.random() < 0.45 else 0.0
    speed = decade(0.03, 0.16)
    shaft = between(120.0, 280.0)
    displacement_said = float(f"{area_1 * speed / shaft:.2g}")
    displacement = displacement_said / off("displacement")
    gain = loop * area_1 / displacement
    makeup = 1e-13 * area_1 / 5e-4 * decade(0.7, 4.0)
    cross = 1.5e-13 * area_1 / 5e-4 * decade(0.5, 3.0)
    charge_said = float(rng.choice((8, 10, 12, 15, 20, 25, 30))) * 1e5
    charge = charge_said / off("charge")
    leakage_said, makeup_said = ((2 * cross + makeup) * off("leakage"), makeup * off("makeup"))
    makeup_said = min(makeup_said, 0.8 * leakage_said)
    if kind == "rod_accumulator" or (kind == "two_pumps" and rng.random() < 0.4):
        makeup_said = 0.0  # the owner knows of no such number: the config holds no circuit
    dry = between(0.4, 2.5) * 1e5 * area_1
    if rng.random() < 0.2:  # a leak across the piston that no data sheet has
        cross += leakage_said * between(8.0, 20.0)
    outer = [makeup * between(0.4, 2.0) if flag else 0.0
             for flag in rng.choice(((0, 0), (1, 1), (1, 0), (0, 1)), p=(0.7, 0.12, 0.09, 0.09))]
    plant = Constants(
        area_1, area_2, *volumes, mass, damping, beta, displacement,
        {"equal": displacement, "two_pumps": displacement * area_2 / area_1}.get(kind, 0.0), gain,
        cross_leakage=cross, case_leakage=outer[0], case_leakage_2=outer[1], makeup=makeup,
        makeup_2=2e-9 * area_1 / 1e-3 if kind == "rod_accumulator" else -1.0, reservoir=charge,
        gas_volume=float(rng.choice((0.0, 5e-4, 1e-3, 2e-3))) * max(1.0, area_1 / 1e-3)
        if kind != "rod_accumulator" else 2e-3 * max(1.0, area_1 / 1e-3),
        friction=float(LAWS[law]), dry=dry,
        breakaway=dry * (between(1.15, 1.6) if law != "dahl" else 1.0),
        stribeck_speed=decade(2e-3, 1.5e-2),
        smooth_speed=2e-4 if law == "karnopp" else decade(1e-4, 6e-4),
        dahl_travel=decade(1.5e-5, 5e-5), stiffening=between(0.5, 2.0), lag=lag, speed_limit=450.0,
        damping_drop=between(0.05, 0.15) if rng.random() < 0.5 else 0.0,
        warming=between(4.0, 15.0),
        play=decade(5e-5, 3e-4) if rng.random() < 0.2 else 0.0)
    coarse = rng.random() < 0.5
    full = float(rng.choice((100, 160, 250))) * 1e5
    sensors = Sensors(
        encoder=float(rng.choice((0.5e-6, 1e-6, 2e-6, 5e-6))), position_noise=decade(2e-7, 1e-6),
        pressure_noise=decade(8e2, 3e3), pressure_step=full / (4096 if coarse else 65536),
        speed_noise=between(0.03, 0.2), filter_hz=float(rng.choice((0.0, 0.35 * rate))),
        gauge=bool(coarse or rng.random() < 0.3))
    sheet = Sheet(bore_mm * 1e-3, rod, 2 if kind == "equal" else 1, stroke, line, mass_said,
                  displacement_said, None if rng.random() < 0.5 else gain * off("gain"),
                  charge_said, leakage_said, makeup_said)
    settings, vary = _settings(rng, plant, stroke, speed)
    return StrangerRig(name, kind, law, vary, plant, rate, sensors,
                       Drive(hold, float(rng.choice((0.0, 0.3))) if hold else 0.0), sheet,
                       settings)


def _settings(rng: np.random.Generator, plant: Constants, stroke: float, speed: float
              ) -> tuple[tuple[Setting, ...], str]:
    """Return 4 to 8 settings of a rig, and what they differ in beside the motion."""
    vary = str(rng.choice(("load", "temperature", "both", "nothing")))
    # Gravity along an inclined cylinder: at most 30 % of what its pressures hold.
    most = min(plant.mass * GRAVITY, 0.3 * 1.5 * plant.area_1 * plant.reservoir)
    inclined = rng.random() < 0.6 or vary in ("load", "both")
    own = rng.uniform(0.2, 1.0) * (1 if rng.random() < 0.7 else -1) * inclined
    warm = float(rng.uniform(25.0, 50.0))
    found = []
    for k in range(int(rng.integers(4, 9))):
        share = own * (rng.uniform(0.3, 1.0) if k and vary in ("load", "both") else 1.0)
        celsius = warm + (rng.uniform(-10, 10) if k and vary in ("temperature", "both") else 0.0)
        found.append(Setting(
            f"r{k + 1}", float(share * most),
            float(plant.damping * exp(-COOLING * (celsius - WARMEST))), float(celsius),
            float(plant.damping_drop / COOLING), motion_of(rng, speed, stroke),
            float(rng.uniform(8.0, 16.0))))
    return tuple(found), vary


def motion_of(rng: np.random.Generator, speed: float, stroke: float) -> Motion:
    """Return a motion as people choose them, within a speed (m/s) and a stroke (m)."""
    kind = str(rng.choice(("triangle", "sines", "ramps", "chirp"), p=(0.25, 0.35, 0.25, 0.15)))
    reach = float(rng.uniform(0.1, 0.3) * stroke)
    before = float(rng.choice((0.3, 0.3, -0.6)))
    seed = int(rng.integers(1000))
    if kind == "triangle":
        f = float(np.clip(speed * rng.uniform(0.3, 0.8) / (4.0 * reach), 0.1, 2.0))
        return Motion(kind, (reach, 0.3 * reach), (f, 2.0 * f), before=before)
    if kind == "sines":
        tones = np.array([0.4, 1.6, 4.9, 11.0]) * rng.uniform(0.8, 1.25, 4)
        share = np.array([0.5, 0.25, 0.15, 0.1]) * 0.9 * speed / (2 * np.pi * tones)
        share *= min(1.0, reach / share.sum())
        return Motion(kind, tuple(map(float, share)), tuple(map(float, tones)), seed=seed,
                      before=before)
    if kind == "ramps":
        return Motion(kind, (reach,), seed=seed, speed=0.7 * speed,
                      dwell=float(rng.uniform(0.2, 0.6)), before=before)
    last = float(rng.uniform(6.0, 20.0))
    return Motion(kind, (min(reach, 0.8 * speed / (2 * np.pi * last)),), (0.3, last),
                  before=before)
