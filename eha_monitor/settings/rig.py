"""Config sections that describe the rig: constants, simulation, excitation, faults."""

import math
from typing import Literal

from pydantic import Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.own_term import SLOTS
from eha_monitor.settings import own_terms
from eha_monitor.settings.section import Section
from eha_monitor.settings.tolerance import Tolerance
from eha_monitor.units import Si, to_si


class Rig(Section):
    """Constants of the actuator; the defaults are the paper's EHA.

    A value that the rig does not have is ``null``; what needs it then answers ``no_data``.
    """

    name: str = Field("eha", description="name of the actuator, used as hardware_id in the "
                                         "diagnostics")
    motion: Literal["linear", "rotary"] = Field(
        "linear", description="rotary: read m as rad, N as N·m, kg as kg·m²")
    identified: str = Field("", description="numbers of this section, and effects, that "
                            "recordings determined, comma separated; diagnose --write-config "
                            "writes it, and exports call only these identified")
    area_1: Si("m²", "piston area of chamber 1", gt=0, optional=True) = 5.05e-4
    area_2: Si("m²", "piston area of chamber 2", gt=0, optional=True) = 5.05e-4
    volume_1: Si("m³", "oil volume of chamber 1 at x = 0, lines included", gt=0,
                 optional=True) = 6.85e-5
    volume_2: Si("m³", "oil volume of chamber 2 at x = 0, lines included", gt=0,
                 optional=True) = 6.85e-5
    mass: Si("kg", "moving mass", gt=0) = 20.0
    viscous_damping: Si("N·s/m", "nominal B, used by the simulator", ge=0) = 600.0
    bulk_modulus: Si("Pa", "nominal effective bulk modulus, used by the simulator",
                     gt=0) = 6e8
    leakage: Si("m³/(s·Pa)", "lumped leakage coefficient C_T; leakage flow is C_T/2·Δp",
                ge=0) = 5e-13
    pump_displacement: Si("m³/rad", "pump displacement D_p", gt=0, optional=True) = 1.6925e-7
    position_gain: Si("rad/(s·m)", "outer loop gain K_pos, pump speed over position error",
                      gt=0, optional=True) = 23000.0
    charge_pressure: Si("Pa", "absolute pressure of the make-up source", ge=0) = 2e6
    makeup_conductance: Si("m³/(s·Pa)", "laminar path of each chamber to the make-up source, "
                           "included in leakage", ge=0) = 1e-13
    ambient_pressure: Si("Pa", "absolute pressure of the tank and of the surroundings, where "
                         "leakage to the outside ends", ge=0) = 101325.0
    sample_time: Si("s", "sample time T_s", gt=0, le=1) = 1e-3
    tolerance: Tolerance = Field(Tolerance(), description="one standard deviation of each value; "
                                                          "diagnose fits it within that without "
                                                          "reporting it")

    @model_validator(mode="after")
    def _makeup_within_leakage(self):
        if self.makeup_conductance > self.leakage:
            raise ValueError("makeup_conductance is part of leakage and must not exceed it")
        return self


class Segment(Section):
    """One stretch of demanded motion x_d(t)."""

    kind: Literal["triangle", "sine", "multisine", "chirp", "steps", "rest", "file"] = Field(
        description="shape of the demanded position")
    duration: Si("s", "length of this interval", gt=0, le=86400) = 8.0
    amplitude: Si("m", "half of peak to peak", ge=0) = 0.04
    frequency: Si("Hz", "fundamental; first frequency of a chirp; steps per second", gt=0) = 0.25
    frequency_end: Si("Hz", "last frequency of a chirp or multisine", gt=0) = 20.0
    components: int = Field(12, ge=1, le=1000, description="number of tones of a multisine")
    offset: Si("m", "mean position", ) = 0.0
    seed: int = Field(0, ge=0, description="phases of a multisine, heights of steps")
    file: str | None = Field(None, description="CSV with columns t (s) and x_d (m)")

    @model_validator(mode="after")
    def _file_given(self):
        if (self.kind == "file") != (self.file is not None):
            raise ValueError("'file' goes with kind: file, and only with it")
        return self


class SensorNoise(Section):
    """Standard deviation of white noise on each sample of each sensor, and resolutions."""

    position: Si("m", "noise of the position sensor", ge=0) = 1e-6
    velocity: Si("m/s", "noise of the velocity sensor", ge=0) = 1e-3
    pressure: Si("Pa", "noise of each pressure sensor", ge=0) = 500.0
    pump_speed: Si("rad/s", "noise of the pump speed sensor", ge=0) = 0.1
    force: Si("N", "noise of the force sensor", ge=0) = 0.5
    temperature: Si("K", "noise of the temperature sensor", ge=0) = 0.05
    position_resolution: Si("m", "encoder step; 0 = continuous", ge=0) = 0.0


class Fault(Section):
    """A parameter that changes while the simulator runs.

    The value runs linearly from its nominal to ``value`` in ``duration`` seconds from ``start``.
    """

    parameter: str = Field(
        description="viscous_damping, bulk_modulus, leakage, mass, or <effect>.<parameter>")
    start: Si("s", "start of the change", ge=0) = 0.0
    duration: Si("s", "duration of the change; 0: a step", ge=0) = 0.0
    value: float = Field(allow_inf_nan=False, description="value at the end, in SI")

    @field_validator("parameter")
    @classmethod
    def _known(cls, name):
        names = ["viscous_damping", "bulk_modulus", "leakage", "mass"] + [
            f"{effect.name}.{p.name}" for effect in CATALOGUE.values() for p in effect.parameters]
        if name not in names:
            raise ValueError(f"unknown parameter {name!r}, expected one of {', '.join(names)}")
        return name


class Simulation(Section):
    """What the simulator does beyond the rig's constants."""

    seed: int = Field(0, ge=0, description="seed of the sensor noise")
    substeps: int = Field(10, ge=1, le=1000, description="integration steps in a sample")
    noise: SensorNoise = Field(SensorNoise(), description="sensor noise and resolution")
    publish: tuple[Literal["x", "v", "x_d", "omega", "p1", "p2", "force", "temperature"], ...] = (
        Field(("x", "x_d", "omega", "p1", "p2"), description="channels that are measured"))
    temperature: Si("°C", "oil temperature shown by the sensor") = 40.0
    excitation: dict[str, Segment] = Field(
        {"triangle": Segment(kind="triangle", duration=24.0)},
        description="intervals of motion in order, by name", min_length=1)
    test_excitation: dict[str, Segment] = Field(
        {"slow": Segment(kind="sine", duration=4.0, amplitude=0.02, frequency=0.5),
         "fast": Segment(kind="sine", duration=4.0, amplitude=0.005, frequency=4.0)},
        description="intervals that the service simulator/excite inserts once, about the "
                    "demanded position at their start; the excitation then "
                    "continues", min_length=1)
    faults: dict[str, Fault] = Field({}, description="parameters that change, by name")


def _superscript(unit: str) -> str:
    return unit.replace("^2", "²").replace("^3", "³").replace("*", "·")


def effects_field(value):
    """Check the ``effects`` section against the catalogue and return {effect: {name: value}}.

    What has the key ``adds`` is a term of the rig's own (:mod:`settings.own_terms`).

    A shape that is not given takes its default; a size that is not given is absent, as long as
    the effect has another size that is.

    Raises
    ------
    ValueError
        Naming the effect, its parameter, the unit and the range that was expected.
    """
    if not isinstance(value, dict):
        raise ValueError("expected a mapping from effect to its parameters")
    checked = {}
    own = [name for name, given in value.items() if own_terms.is_own(given)]
    if len(own) > SLOTS:
        raise ValueError(f"{own[SLOTS]}: expected at most {SLOTS} terms beyond the catalogue")
    for name, given in value.items():
        if name in own:
            checked[name] = own_terms.checked(name, given)
            continue
        if name not in CATALOGUE:
            raise ValueError(f"unknown effect {name!r}, expected a user-defined term with the "
                             f"key adds, or one of {', '.join(CATALOGUE)}")
        effect = CATALOGUE[name]
        known = {p.name: p for p in effect.parameters}
        if not isinstance(given, dict):
            raise ValueError(f"{name}: expected its parameters {', '.join(known)}")
        if extra := set(given) - set(known):
            raise ValueError(f"{name}.{sorted(extra)[0]}: unknown key, "
                             f"expected {', '.join(known)}")
        some_size = any(given.get(p.name) is not None for p in effect.sizes)
        checked[name] = {}
        for p in effect.parameters:
            raw = given.get(p.name, p.default)
            if (raw is None and p.default is None and some_size) or raw == math.inf == p.neutral:
                raw = min(p.neutral, p.upper)  # a limit that is not there: its upper bound
            try:
                number = to_si(raw, _superscript(p.unit))
            except PydanticCustomError as problem:
                raise ValueError(f"{name}.{p.name}: {problem}") from problem
            if not isinstance(number, (int, float)) or not p.lower <= number <= p.upper:
                raise ValueError(f"{name}.{p.name}: expected a number in {p.unit} from "
                                 f"{p.lower:g} to {p.upper:g}, got {number!r}")
            checked[name][p.name] = float(number)
    return checked
