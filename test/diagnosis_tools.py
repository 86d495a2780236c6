"""Diagnoses made by hand, with the numbers of 40 N of Coulomb friction on the paper's EHA."""

from dataclasses import replace

import numpy as np

from eha_monitor.mismatch.diagnosis import (
    Agreement,
    Considered,
    Curve,
    Diagnosis,
    Location,
    NamedEffect,
    Overlay,
    RigFinding,
    SignalFit,
    Value,
)

NAN = float("nan")
NOTHING = Location({"force": 0.0, "flow": 0.0, "drive": 0.0, "sensor": 0.0}, "", ())


def damping(value: float, stddev: float) -> Value:
    return Value(value, stddev, "N·s/m")


def modulus(value: float, stddev: float) -> Value:
    return Value(value, stddev, "Pa")


def curves(seed: int = 0, modelled: bool = True) -> tuple[Curve, ...]:
    """The missing force of 40 N of dry friction against velocity, position and pressure."""
    rng = np.random.default_rng(seed)
    v = np.linspace(-0.12, 0.12, 49)
    friction = 40.0 * np.tanh(v / 1.5e-3)
    line = friction if modelled else np.full_like(v, np.nan)
    place = np.linspace(-0.04, 0.04, 33)
    pressure = np.linspace(-1.6e6, 1.6e6, 33)
    level = 20.0 * np.tanh(pressure / 5e5)

    def flat(n: int) -> np.ndarray:
        return rng.normal(0.0, 4.0, n)

    none = np.full(33, np.nan)
    return (
        Curve("force", "position", "m", "N", place, flat(33), np.full(33, 38.0),
              np.zeros(33) if modelled else none),
        Curve("force", "velocity", "m/s", "N", v, friction + rng.normal(0.0, 1.0, 49),
              2.0 + 9.0 * np.exp(-np.abs(v) / 0.01), line),
        Curve("force", "pressure difference", "Pa", "N", pressure, level + flat(33),
              np.full(33, 26.0), level if modelled else none),
        Curve("flow", "pump speed", "rad/s", "m³/s", np.linspace(-200, 200, 41),
              rng.normal(0.0, 2e-8, 41), np.full(41, 1e-7), np.zeros(41)),
    )


def overlays() -> tuple[Overlay, ...]:
    """Two seconds of a triangle, both models running free in windows of a quarter second."""
    rng = np.random.default_rng(3)
    t = 18.0 + np.arange(2000) * 1e-3
    x = 0.008 * (1.0 - 4.0 * np.abs(np.mod(t / 2.0, 1.0) - 0.5))
    run = np.mod(t, 0.25) / 0.25
    return (
        Overlay("position", "m", t, x + rng.normal(0, 2e-6, t.size),
                x + 4e-5 * run * np.sign(np.gradient(x)), x + 1e-6 * run),
        Overlay("pressure_difference", "Pa", t, 8e4 * np.sign(np.gradient(x)) + rng.normal(
            0, 2e3, t.size), 6e4 * np.sign(np.gradient(x)) * run,
            8e4 * np.sign(np.gradient(x))),
    )


def coulomb() -> Diagnosis:
    """40 N of Coulomb friction, found."""
    effect = NamedEffect(
        "coulomb_friction", "force",
        "Coulomb friction of 40 N opposes the motion at every speed",
        {"F_c": Value(40.03, 0.08, "N"), "v_e": Value(3.1e-4, 4e-5, "m/s")},
        48211.7, ("presliding_friction",), "F_steady = F_c s,  s = tanh(v / v_e)",
        "Push the depressurised rod by hand with a spring balance: the force at which it keeps "
        "creeping is F_c.", "40 N", 0.9991)
    considered = (
        Considered("stribeck_friction", 48214.1, (), "says the same with two parameters more"),
        Considered("presliding_friction", 48207.3, (), "cannot be told apart in this recording"),
        Considered("asymmetric_friction", 48212.0, (), "its asymmetry is zero: 0.02 ± 0.11 N"),
        Considered("pressure_friction", 9120.4, (), "explains less"),
        Considered("spring_load", 812.0, (), "explains less"),
        Considered("cross_port_leakage", 95.3, (), "explains less"),
        Considered("drive_lag", 14.1, (), "explains less"),
        Considered("constant_load", 3.2, ("coulomb_friction",), "below the threshold"),
        Considered("added_mass", 1.1, ("coulomb_friction",), "below the threshold"),
        Considered("pump_dead_zone", -0.4, ("coulomb_friction",), "below the threshold"),
    )
    return Diagnosis(
        ("bags/hidden_friction",), "mismatch",
        "The force balance lacks Coulomb friction of 40 N, which acts where the motion turns "
        "round",
        Location({"force": 0.97, "flow": 0.02, "drive": 0.01, "sensor": 0.0},
                 "velocity_reversal", ((0.95, 1.1), (2.95, 3.12), (4.96, 5.1), (6.9, 7.2),
                                       (8.1, 9.4), (10.0, 10.2), (11.3, 11.5))),
        (effect,),
        {"B": damping(1412.0, 9.0), "beta_e": modulus(5.31e8, 1.9e6)},
        {"B": damping(601.2, 1.1), "beta_e": modulus(5.998e8, 2.6e5)},
        "held_out",
        {"position": SignalFit("m", 4.1e-5, 2.1e-6, 2.0e-6, 812.0, 1.1),
         "pressure_difference": SignalFit("Pa", 6.1e4, 2.9e3, 2.83e3, 340.0, 1.2),
         "pump_speed": SignalFit("rad/s", 0.93, 0.11, 0.1, NAN, NAN)},
        curves(), overlays(), considered,
        (Agreement("slow", {"B": damping(4630.0, 80.0), "beta_e": modulus(4.2e8, 6e7)},
                   {"B": damping(603.0, 6.0), "beta_e": modulus(5.9e8, 2e7)}),
         Agreement("fast", {"B": damping(880.0, 14.0), "beta_e": modulus(5.6e8, 3e6)},
                   {"B": damping(601.0, 1.4), "beta_e": modulus(6.0e8, 4e5)}),
         Agreement("small", {"B": damping(2900.0, 60.0), "beta_e": modulus(4.9e8, 2e7)},
                   {"B": damping(598.0, 5.0), "beta_e": modulus(6.01e8, 3e6)}),
         Agreement("large", {"B": damping(1010.0, 12.0), "beta_e": modulus(5.5e8, 2e6)},
                   {"B": damping(601.5, 1.2), "beta_e": modulus(5.997e8, 3e5)})),
        ("B read 1412 N·s/m; 811 of it is 40 N of Coulomb friction, not wear",
         "The bulk modulus read 531 MPa; 69 MPa of the fall is Coulomb friction, not air"),
        ("Slower motion, 1 mm/s and below, would tell Coulomb friction from presliding",),
        {"coulomb_friction": {"F_c": 40.03, "v_e": 3.1e-4}}, duration_s=24.0, wall_s=6.8,
        probability={"consistent": 0.0, "unexplained": 0.004})


def consistent() -> Diagnosis:
    """A clean recording."""
    values = {"B": damping(600.4, 1.0), "beta_e": modulus(6.002e8, 2.5e5)}
    quiet = tuple(replace(c, measured=0.05 * c.measured, modelled=np.full_like(c.x, np.nan))
                  for c in curves()[1:2])
    return Diagnosis(
        ("bags/clean",), "consistent",
        "Nothing is missing from the model that this recording could show", NOTHING, (),
        values, values, "held_out",
        {"position": SignalFit("m", 2.1e-6, 2.1e-6, 2.0e-6, 1.1, 1.1)}, quiet,
        considered=(Considered("constant_load", 3.2, (), "below the threshold"),),
        health=("B and the bulk modulus can be read as they are",), duration_s=24.0, wall_s=3.0,
        probability={"consistent": 0.97, "unexplained": 0.01})


def unexplained() -> Diagnosis:
    """A force that no entry has."""
    rest = coulomb()
    return replace(
        rest, verdict="unexplained", effects=(), config_effects={}, after=rest.before,
        message="Something of up to 40 N is missing from the force balance, and no entry of "
        "the catalogue explains it", curves=curves(modelled=False), overlays=(),
        signals={"position": SignalFit("m", 4.1e-5, 4.0e-5, 2.0e-6, 812.0, 801.0)},
        agreement=(), considered=(Considered("quadratic_friction", 911.0, (),
                                             "explains 4 % of the mismatch"),),
        health=("B and the bulk modulus carry what is missing and tell nothing of the health",),
        advice=("Record the rod pushed by hand, depressurised",),
        probability={"consistent": 0.0, "unexplained": 0.93})


def insufficient() -> Diagnosis:
    """A recording that says nothing."""
    return Diagnosis(
        ("bags/rest",), "insufficient_data",
        "The recording holds no pressure and no demanded position; expected x with p1 and p2, "
        "with a force, or with x_d", NOTHING, (), {}, {}, "held_out", {},
        advice=("Record the demanded position or both pressures",), duration_s=3.0)


def pair() -> Diagnosis:
    """Two effects, one with several rivals."""
    one = coulomb()
    second = NamedEffect(
        "pump_dead_zone", "flow",
        "the pump delivers no flow below 8.1 rad/s, and the same speed is lost above it",
        {"omega_0": Value(8.1, 0.2, "rad/s")}, 611.0,
        ("leakage_offset", "cross_port_leakage"), "Q = D_p (|omega| - omega_0)+ sgn omega",
        "Let the pump creep and see from which speed on the piston follows.", "0.8 l/min",
        0.91)
    return replace(
        one, effects=(*one.effects, second),
        message="The force balance lacks Coulomb friction of 40 N; the flow balance lacks a pump "
        "dead zone of 8.1 rad/s, or leakage that does not pass through zero",
        location=replace(one.location, balance={"force": 0.7, "flow": 0.28, "drive": 0.02,
                                                "sensor": 0.0}),
        config_effects={**one.config_effects, "pump_dead_zone": {"omega_0": 8.1}})


def partly() -> Diagnosis:
    """An effect that takes away a part, and more that no entry has."""
    return replace(pair(), verdict="unexplained", agreement=(),
                   message="Something in the force balance is left out that no entry explains",
                   probability={"consistent": 0.0, "unexplained": 0.88})


CHARGE = RigFinding(
    "charge_pressure", 2e6, Value(3e5, 2e3, "Pa"), 0.99,
    "charge_pressure: the config says 2000 kPa, the recording 300.0 ± 2.0 kPa")
MASS = RigFinding(
    "mass", 20.0, Value(25.1, 0.2, "kg"), 0.71,
    "mass: the config says 20 kg, the recording 25.10 ± 0.20 kg", ("added_mass",))
PUMP = RigFinding(
    "pump_displacement", 1.69e-7, Value(1.643e-7, 8e-10, "m³/rad"), float("nan"),
    "pump_displacement: the config says 0.169 cm³/rad, the recording 0.1643 ± 0.0008 cm³/rad, "
    "within its tolerance")


def wrong_number() -> Diagnosis:
    """20 bar of charge pressure in the config, 3 bar on the rig, and nothing left out."""
    found = coulomb()
    return replace(found, effects=(), config_effects={}, message=CHARGE.statement,
                   rig_data=(CHARGE,), considered=(), curves=found.curves[3:],
                   location=replace(found.location, regime="always", balance={
                       "force": 0.05, "flow": 0.93, "drive": 0.0, "sensor": 0.02}),
                   health=("B read 1412 N·s/m; 811 of it is the charge pressure, not wear",),
                   probability={"consistent": 0.0, "unexplained": 0.02})


def everything() -> Diagnosis:
    """Two effects, a load that comes and goes, and a wrong number of the rig."""
    two = pair()
    load = NamedEffect(
        "intermittent_load", "force",
        "a load of −95 N pushes against positive motion now and then",
        {"F": Value(-95.2, 1.6, "N")}, 5120.0, ("constant_load",), "M v' = ... - F(t)",
        "Look what touches the rod at those times.", "95 N", 0.86,
        ((3.2, 5.1), (8.0, 9.4), (17.25, 21.0)))
    rng = np.random.default_rng(5)
    t = np.linspace(0.0, 24.0, 121)
    pushed = -95.0 * sum((t > start) & (t < stop) for start, stop in load.intervals_s)
    time = Curve("force", "time", "s", "N", t, pushed + rng.normal(0.0, 6.0, t.size),
                 np.full(t.size, 6.0), pushed)
    return replace(
        two, effects=(load, *two.effects), rig_data=(CHARGE, MASS), rig_within=(PUMP,),
        curves=(*two.curves, time),
        message="; ".join([CHARGE.statement, MASS.statement, load.statement,
                           *(effect.statement for effect in two.effects)]),
        probability={"consistent": 0.0, "unexplained": 0.06})


ALL = {"coulomb": coulomb, "pair": pair, "partly": partly, "consistent": consistent,
       "unexplained": unexplained, "insufficient": insufficient, "wrong_number": wrong_number,
       "everything": everything}
