"""Config sections that describe the rig: constants, simulation, excitation, faults."""

import math
import operator
from typing import Literal

from pydantic import Field, field_validator, model_validator

from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.units import LARGEST, Section, Si

_RELATIVE = {"gt": 0.0, "le": 1.0}
_FACTOR = {"gt": 1.0, "le": 100.0}


class Tolerance(Section):
    """One standard deviation of each configured number of the rig.

    Relative for most; for a leakage and the make-up path, whose order of magnitude is all that a
    data sheet gives, a factor.
    """

    area_1: float = Field(0.005, **_RELATIVE,
                          description="of the piston area of chamber 1, relative")
    area_2: float = Field(0.005, **_RELATIVE,
                          description="of the piston area of chamber 2, relative")
    volume_1: float = Field(0.1, **_RELATIVE,
                          description="of the oil volume of chamber 1, relative")
    volume_2: float = Field(0.1, **_RELATIVE,
                          description="of the oil volume of chamber 2, relative")
    mass: float = Field(0.05, **_RELATIVE, description="of the mass, relative")
    leakage: float = Field(3.0, **_FACTOR, description="of the leakage, a factor")
    pump_displacement: float = Field(0.03, **_RELATIVE,
                                     description="of the pump displacement, relative")
    position_gain: float = Field(0.03, **_RELATIVE, description="of the position gain, relative")
    charge_pressure: float = Field(0.2, **_RELATIVE,
                                   description="of the charge pressure, relative")
    makeup_conductance: float = Field(3.0, **_FACTOR,
                                      description="of the make-up conductance, a factor")
    effects: float = Field(0.05, **_RELATIVE, description="of each size of the config's effects "
                           "(a friction, a spring, a lag), relative")

    def log_spread(self, key: str) -> float:
        """Return the standard deviation of the logarithm of a rig key (``mass``)."""
        value = getattr(self, key)
        field = type(self).model_fields[key]
        factor = any(getattr(one, "gt", None) == 1.0 for one in field.metadata)
        return math.log(value) if factor else value


TOLERATED = tuple(key for key in Tolerance.model_fields if key != "effects")  # keys of the rig


SIZES = ("area_1", "area_2", "volume_1", "volume_2", "mass", "pump_displacement")


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
    area_1: Si("m²", "piston area of chamber 1", gt=0, optional=True,
               possible=(1e-7, 4.0)) = 5.05e-4
    area_2: Si("m²", "piston area of chamber 2", gt=0, optional=True,
               possible=(1e-7, 4.0)) = 5.05e-4
    volume_1: Si("m³", "oil volume of chamber 1 at x = 0, lines included", gt=0,
                 optional=True, possible=(1e-9, 50.0)) = 6.85e-5
    volume_2: Si("m³", "oil volume of chamber 2 at x = 0, lines included", gt=0,
                 optional=True, possible=(1e-9, 50.0)) = 6.85e-5
    mass: Si("kg", "moving mass", gt=0, possible=(1e-6, 1e6)) = 20.0
    viscous_damping: Si("N·s/m", "nominal B, used by the simulator", ge=0) = 600.0
    bulk_modulus: Si("Pa", "nominal effective bulk modulus, used by the simulator",
                     gt=0, possible=(1e5, 1e12)) = 6e8
    leakage: Si("m³/(s·Pa)", "lumped leakage coefficient C_T; leakage flow is C_T/2·Δp",
                ge=0, possible=(1e-18, 1e-6)) = 5e-13
    pump_displacement: Si("m³/rad", "pump displacement D_p", gt=0, optional=True,
                          possible=(1e-10, 1e-2)) = 1.6925e-7
    position_gain: Si("rad/(s·m)", "outer loop gain K_pos, pump speed over position error",
                      gt=0, optional=True) = 23000.0
    charge_pressure: Si("Pa", "absolute pressure of the make-up source", ge=0, absolute=True,
                        possible=(1e3, 1e8)) = 2e6
    makeup_conductance: Si("m³/(s·Pa)", "laminar path of each chamber to the make-up source, "
                           "included in leakage", ge=0, possible=(1e-18, 1e-6)) = 1e-13
    ambient_pressure: Si("Pa", "absolute pressure of the tank and of the surroundings, where "
                         "leakage to the outside ends", ge=0, absolute=True,
                         possible=(1e3, 1e8)) = 101325.0
    sample_time: Si("s", "sample time T_s", gt=0, le=1, possible=(1e-7, 0.5)) = 1e-3
    tolerance: Tolerance = Field(Tolerance(), description="one standard deviation of each value; "
                                                          "diagnose fits it within that without "
                                                          "reporting it")

    @property
    def is_papers(self) -> bool:
        """Whether it may be the paper's EHA: what it has is within three tolerances of that."""
        return self.motion == "linear" and all(
            abs(math.log(value / type(self).model_fields[key].default))
            <= 3.0 * self.tolerance.log_spread(key)
            for key in SIZES if (value := getattr(self, key)) is not None)

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
    amplitude: Si("m", "half of peak to peak", ge=0, possible=(1e-9, 20.0)) = 0.04
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
    demand: Literal["excitation", "topic"] = Field(
        "excitation", description="x_d of the node simulator; excitation: that of this config, "
                                  "and it publishes it; topic: what others publish on the topic "
                                  "of the channel x_d, by stamp, held between and after")
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
        description="intervals that the service simulator/excite inserts once, about the demanded "
                    "position at their start; the excitation then continues", min_length=1)
    faults: dict[str, Fault] = Field({}, description="parameters that change, by name")


FIGURES = 6  # digits of a number in a config: more than any of them is known to
_BOUNDS = (("gt", operator.gt, "more than"), ("ge", operator.ge, "at least"),
           ("lt", operator.lt, "less than"), ("le", operator.le, "at most"))


def rounded(value: float) -> float:
    """Return a number with as many digits as a written config has."""
    return float(f"{value:.{FIGURES}g}")


def corrected(rig: Rig, found: dict[str, float]) -> tuple[dict[str, float], dict[str, str]]:
    """Return what a rig must be changed in to have the found numbers.

    ``found`` : key of the rig -> number that a recording says, SI.

    Returns
    -------
    changed : key -> value, SI; also of a key that has to follow another one.
    refused : key -> why its number cannot stand in a config.
    """
    changed, refused = {}, {}
    for key, value in found.items():
        why = _refusal(key, value)
        if why:
            refused[key] = why
        else:
            changed[key] = rounded(value)
    leakage = changed.get("leakage", rig.leakage)
    makeup = changed.get("makeup_conductance", rig.makeup_conductance)
    if makeup > leakage:  # the make-up path is a part of it, and the whole is what the flow shows
        changed["makeup_conductance"] = leakage
    return changed, refused


def _refusal(key: str, value: float) -> str:
    """Return why a key cannot hold a value, or nothing."""
    field = Rig.model_fields.get(key)
    if field is None or not isinstance(field.json_schema_extra, dict):
        return "is no number of the config's rig"
    unit = field.json_schema_extra["unit"]
    if not abs(value) <= LARGEST:
        return f"the recording gives no plausible value, in {unit}"
    for name, holds, words in _BOUNDS:
        for rule in field.metadata:
            bound = getattr(rule, name, None)
            if bound is not None and not holds(value, bound):
                return f"expected {words} {bound:g} {unit}, the recording says {value:g}"
    return ""
