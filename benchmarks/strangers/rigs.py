"""Ten rigs of ten people: bench, press, valve actuator, single rods, digital drives.

Each is what its owner knows (data sheet, logger, file) and what only this file knows (B, beta_e,
friction, hold).  Loop gain K D/A below a third of B/M keeps the oil column stable.
"""

from dataclasses import dataclass, field

from strangers.plant import DAHL, STRIBECK, Constants, Drive, Motion, Sensors


@dataclass(frozen=True)
class Dialect:
    """How the owner's logger writes its CSV.

    Attributes
    ----------
    columns : channel -> (header, unit, digits after the point), in the order of the file.
    extra : headers of columns that nobody asked for.
    units_row : a second row of units.
    """

    columns: dict[str, tuple[str, str, int]]
    separator: str = ";"
    decimal: str = "."
    units_row: bool = False
    bom: bool = False
    extra: tuple[str, ...] = ()


@dataclass(frozen=True)
class Rig:
    """One rig with all that is true of it."""

    name: str
    words: str
    plant: Constants
    rate: float  # Hz, of the logger
    length: float  # s
    motion: Motion
    dialect: Dialect
    sensors: Sensors = field(default_factory=Sensors)
    drive: Drive = field(default_factory=Drive)
    gain_known: bool = True


CM2, CM3, L_BAR = 1e-4, 1e-6, 1e5
# A rig of the paper's kind has one displacement for both ports.


def _equal(area, volume, mass, damping, beta, displacement, gain, **more) -> Constants:
    return Constants(area * CM2, area * CM2, volume * CM3, volume * CM3, mass, damping, beta,
                     displacement, displacement, gain, **more)


def _single_rod(areas, volumes, mass, damping, beta, displacement, gain, **more) -> Constants:
    """Two pumps on one shaft, displaced as the areas are; the difference is the reservoir's."""
    a_1, a_2 = (a * CM2 for a in areas)
    v_1, v_2 = (v * CM3 for v in volumes)
    return Constants(a_1, a_2, v_1, v_2, mass, damping, beta, displacement,
                     more.pop("second", displacement * a_2 / a_1), gain, **more)


PRESS = Rig(
    "press", "800 kg platen, 500 Hz, digital hold, Stribeck friction",
    _equal(40, 1300, 800, 14000, 8.5e8, 2.2e-6, 9000, cross_leakage=8e-13, makeup=5e-13,
           case_leakage=2e-14, check_valve=1e-9, reservoir=8e5, friction=STRIBECK, dry=180,
           breakaway=230, speed_limit=300),
    500, 20, Motion("triangle", (0.05, 0.012), (0.25, 0.25)),
    Dialect({"time": ("Zeit [ms]", "ms", 1), "x": ("Weg [mm]", "mm", 4),
             "x_d": ("Sollweg [mm]", "mm", 4), "p1": ("Druck A [bar]", "bar", 3),
             "p2": ("Druck B [bar]", "bar", 3), "omega": ("Drehzahl [1/min]", "rpm", 1)},
            ";", ","),
    Sensors(encoder=1e-6, pressure_noise=1.5e3, speed_noise=0.05), Drive(1))

MICRO = Rig(
    "micro", "2 kg, 1.2 cm², 2 kHz, sum of sines, continuous",
    _equal(1.2, 12, 2, 70, 7.5e8, 4e-8, 36000, cross_leakage=2e-14, makeup=5e-14,
           check_valve=1e-11, reservoir=6e5, speed_limit=900),
    2000, 10, Motion("sines", (6e-3, 2e-3, 8e-4, 4e-4), (0.5, 2.3, 7.1, 17.0)),
    Dialect({"time": ("t", "s", 4), "x_d": ("ref", "mm", 5), "x": ("pos", "mm", 5),
             "omega": ("motor_rpm", "rpm", 2), "p1": ("pA", "kPa", 3), "p2": ("pB", "kPa", 3)},
            ","),
    Sensors(encoder=0.2e-6, position_noise=0.2e-6, pressure_noise=400, pressure_step=50,
            speed_noise=0.3))

BENCH = Rig(
    "bench", "35 kg, 8 cm², 500 Hz, digital hold, 40 N of Dahl friction",
    _equal(8, 150, 35, 900, 7e8, 3.2e-7, 15000, cross_leakage=3e-13, makeup=1.5e-13,
           check_valve=1e-10, reservoir=1.2e6, friction=DAHL, dry=40, dahl_travel=8e-6,
           speed_limit=500),
    500, 16, Motion("sines", (0.025, 5e-3, 1.2e-3), (0.4, 1.7, 6.3)),
    Dialect({"time": ("time_ms", "ms", 0), "x": ("position_mm", "mm", 4),
             "x_d": ("setpoint_mm", "mm", 4), "omega": ("pump_rpm", "rpm", 1),
             "p1": ("p_a_bar", "bar", 4), "p2": ("p_b_bar", "bar", 4)}, "\t"),
    Sensors(encoder=1e-6, filter_hz=200.0), Drive(1))

SINGLE_ROD = Rig(
    "single_rod", "40/25 mm, 60 kg, two pumps on one shaft, accumulator, continuous",
    _single_rod((12.566, 7.658), (260, 190), 60, 2400, 8e8, 5e-7, 20000, cross_leakage=1.5e-13,
                makeup=1e-13, reservoir=1.5e6, gas_volume=1e-3, speed_limit=400),
    1000, 12, Motion("sines", (0.02, 5e-3, 1.5e-3, 5e-4), (0.4, 1.3, 4.1, 11.0), seed=4),
    Dialect({"time": ("Time", "s", 3), "x": ("Position (mm)", "mm", 4),
             "x_d": ("Command (mm)", "mm", 4), "p1": ("Cap pressure (bar)", "bar", 4),
             "p2": ("Rod pressure (bar)", "bar", 4), "omega": ("Shaft speed (rpm)", "rpm", 2),
             "temperature": ("Oil (C)", "degC", 1)}, ",", bom=True),
    Sensors(encoder=0.5e-6, pressure_noise=1e3, pressure_step=100, speed_noise=0.1))

ROD_SIDE = Rig(
    "rod_side", "63/35 mm, rod side on the accumulator, pump feeds the cap side, hold of 2",
    _single_rod((31.17, 21.55), (520, 400), 150, 6000, 9e8, 1.3e-6, 14400, second=0.0,
                cross_leakage=4e-13, makeup=2e-13, makeup_2=2e-9, reservoir=2.5e6,
                gas_volume=1.5e-3, speed_limit=300),
    1000, 16, Motion("ramps", (0.04,), seed=2, speed=0.06),
    Dialect({"time": ("t_ms", "ms", 0), "x": ("s_ist", "mm", 3), "x_d": ("s_soll", "mm", 3),
             "omega": ("n", "rpm", 1), "p1": ("pK", "MPa", 5), "p2": ("pS", "MPa", 5)}, ";",
            units_row=True),
    Sensors(encoder=2e-6, filter_hz=400.0), Drive(2, 0.3))

SLOW_LOGGER = Rig(
    "slow_logger", "120 kg, 250 Hz, open tank under 3 bar, check valves, ramps, digital hold",
    _equal(20, 600, 120, 5000, 5e8, 1e-6, 10000, cross_leakage=6e-13, makeup=2e-13,
           check_valve=5e-10, reservoir=3e5, speed_limit=300),
    250, 20, Motion("ramps", (0.03,), seed=7, speed=0.08),
    Dialect({"time": ("ms", "ms", 0), "x_d": ("xref", "mm", 4), "x": ("xact", "mm", 4),
             "p1": ("p_left", "bar", 4), "p2": ("p_right", "bar", 4),
             "omega": ("speed", "rpm", 1)}, ";", ",", extra=("status", "I_motor")),
    Sensors(encoder=1e-6, pressure_noise=800), Drive(1))

CHIRP = Rig(
    "chirp", "25 kg, aerated oil, chirp to 25 Hz, drive lag of 3 ms, 30 bar charge",
    _equal(6.16, 110, 25, 1500, 2.5e8, 2.5e-7, 22000, cross_leakage=2e-13, makeup=1e-13,
           check_valve=1e-10, reservoir=3e6, lag=3e-3, speed_limit=600),
    1000, 12, Motion("chirp", (6e-3,), (0.3, 25.0)),
    Dialect({"time": ("time", "s", 4), "x_d": ("xd", "m", 7), "x": ("x", "m", 7),
             "p1": ("P1", "Pa", 0), "p2": ("P2", "Pa", 0), "omega": ("w", "rad/s", 3)}, ","),
    Sensors(encoder=1e-6))

FAST_LOGGER = Rig(
    "fast_logger", "8 kg, logged at 2 kHz, drive computes at 1 kHz, 6 N of dry friction",
    _equal(2.5, 30, 8, 260, 1.1e9, 8e-8, 31250, cross_leakage=5e-14, makeup=1e-13,
           check_valve=2e-11, reservoir=1e6, friction=STRIBECK, dry=6, breakaway=6,
           smooth_speed=5e-4, speed_limit=900),
    2000, 10, Motion("sines", (9e-3, 2e-3, 6e-4, 2e-4), (0.6, 2.9, 9.7, 23.0), seed=9),
    Dialect({"time": ("Timestamp [s]", "s", 4), "x": ("Encoder [um]", "um", 1),
             "x_d": ("Target [um]", "um", 2), "omega": ("Speed [rpm]", "rpm", 2),
             "p1": ("Port A [kPa]", "kPa", 2), "p2": ("Port B [kPa]", "kPa", 2)}, "\t"),
    Sensors(encoder=0.5e-6, position_noise=0.2e-6, pressure_noise=800, pressure_step=100),
    Drive(2))

GAUGE = Rig(
    "gauge", "60 kg, gauge transducers, drive lag of 8 ms, 60 N with Stribeck, triangles",
    _equal(10, 200, 60, 1800, 6.5e8, 4.5e-7, 13300, cross_leakage=4e-13, makeup=2e-13,
           check_valve=2e-10, reservoir=1.5e6, friction=STRIBECK, dry=60, breakaway=85,
           lag=8e-3, speed_limit=400),
    1000, 16, Motion("triangle", (0.03, 0.03), (0.25, 0.75), before=-0.6),
    Dialect({"time": ("t/ms", "ms", 1), "x": ("x/mm", "mm", 4), "x_d": ("w/mm", "mm", 4),
             "p1": ("pa/bar", "bar", 4), "p2": ("pb/bar", "bar", 4),
             "omega": ("n/rpm", "rpm", 1)}, ";", ","),
    Sensors(encoder=1e-6, filter_hz=350.0, gauge=True))

HOIST = Rig(
    "hoist", "300 kg hanging on a single rod, own controller with feedforward, digital hold",
    _single_rod((20, 16), (460, 380), 300, 20000, 1e9, 8e-7, 15000, cross_leakage=1.5e-12,
                makeup=5e-13, case_leakage=2e-14, reservoir=2.5e6, gas_volume=2e-3,
                load=2943.0, lag=2e-3, feedforward=2000.0, speed_limit=400),
    1000, 14, Motion("sines", (0.03, 6e-3, 1.5e-3), (0.3, 1.1, 4.7), seed=12),
    Dialect({"time": ("t", "s", 3), "x": ("hook_mm", "mm", 3), "x_d": ("wish_mm", "mm", 3),
             "omega": ("rpm", "rpm", 1), "p1": ("p_head_bar", "bar", 3),
             "p2": ("p_rod_bar", "bar", 3)}, ";"),
    Sensors(encoder=2e-6), Drive(1, 0.4), gain_known=False)

RIGS = {rig.name: rig for rig in (PRESS, MICRO, BENCH, SINGLE_ROD, ROD_SIDE, SLOW_LOGGER, CHIRP,
                                  FAST_LOGGER, GAUGE, HOIST)}
