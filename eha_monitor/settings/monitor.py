"""The whole config, and its sections of the monitor: stages, thresholds, temperature, health."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, create_model, field_serializer, model_validator

from eha_monitor.settings.channels import (
    CHANNEL_ABOUT,
    CHANNELS,
    DEFAULT_CHANNELS,
    Channel,
    Table,
    check_unit,
    fill_channels,
)
from eha_monitor.settings.own_terms import effects_field
from eha_monitor.settings.rig import Rig, SensorNoise, Simulation
from eha_monitor.units import Section, Si


class Experiment(Section):
    """Limits of an experiment; the first five have no default, as only the rig's owner knows them.

    A motion is planned to stay within them, and ends at once where a sensor shows that it does
    not.
    """

    lower: Si("m", "lowest position that the piston may reach", optional=True,
              possible=(1e-6, 20.0)) = None
    upper: Si("m", "highest position that the piston may reach", optional=True,
              possible=(1e-6, 20.0)) = None
    speed: Si("m/s", "largest speed of the piston, in either direction", gt=0, optional=True,
              possible=(1e-5, 20.0)) = None
    acceleration: Si("m/s²", "largest acceleration of the piston, in either direction", gt=0,
                     optional=True) = None
    pressure: Si("Pa", "highest absolute pressure in either chamber", gt=0, optional=True,
                 absolute=True, possible=(1e4, 1e9)) = None
    motion_time: Si("s", "longest time of one motion, with the way to where it begins", gt=0,
                    le=3600) = 12.0
    total_time: Si("s", "longest time of all motions together", gt=0, le=86400) = 60.0
    silence: Si("s", "a motion is aborted after this time without data", gt=0, le=10) = 0.5
    command_lead: Si("s", "a command is sent this long before its stamp, for a rig that applies "
                          "commands by stamp; 0: one that applies them as they come", ge=0,
                     le=1) = 0.1

    @model_validator(mode="after")
    def _agree(self):
        if None not in (self.lower, self.upper) and self.lower >= self.upper:
            raise ValueError(f"expected lower below upper, got {self.lower:g} and "
                             f"{self.upper:g} m")
        if self.motion_time > self.total_time:
            raise ValueError(f"expected motion_time of at most total_time, got "
                             f"{self.motion_time:g} and {self.total_time:g} s")
        return self


class Health(Section):
    """What the indicators of health need beside the rig; null where it is not known.

    An indicator that needs a key that is null says which, and no number.
    """

    rated_pressure: Si("Pa", "pressure difference across the piston at which leakage, efficiency "
                             "and stall force are reported: rated pressure, or that of the "
                             "relief valve",
                       ge=1e5, optional=True) = None
    rated_speed: Si("rad/s", "speed of the pump at which its efficiency is reported", gt=0,
                    le=2500, optional=True) = None
    oil_temperature: Si("°C", "oil temperature for recordings without the channel temperature",
                        ge=-60, le=200, optional=True) = None
    oil_temperature_stddev: Si("K", "one standard deviation of the oil temperature, measured or "
                                    "given", ge=0, le=50) = 2.0
    air_free_modulus: Si("Pa", "effective bulk modulus without free air, including hoses and "
                               "walls: from a healthy recording just after bleeding, or of the "
                               "oil",
                         ge=1e7, optional=True) = None
    air_free_tolerance: float = Field(
        0.1, ge=0.0, le=1.0, description="its relative standard deviation")
    air_pressure: Si("Pa", "absolute pressure at which the free air volume is reported",
                     gt=0) = 101325.0
    polytropic_exponent: Si("1", "of the free air; null: unknown between 1 (slow, isothermal) "
                                 "and 1.4 (fast, adiabatic), included in the "
                                 "uncertainty", ge=1.0, le=1.67,
                            optional=True) = None
    leakage_limit: Si("m³/s", 'upper limit of the internal leakage, e.g. "50 mL/min"', gt=0,
                      optional=True) = None
    free_air_limit: Si("1", 'upper limit of the free air fraction, e.g. "1 %"', gt=0, le=1,
                       optional=True) = None
    friction_limit: Si("1", "upper limit of the dry friction over the stall force", gt=0,
                       optional=True) = None
    pump_efficiency_limit: Si("1", "lower limit of the volumetric efficiency", gt=0, le=1,
                              optional=True) = None
    drive_lag_limit: Si("s", "upper limit of the drive lag", gt=0, optional=True) = None


class NoiseLevels(SensorNoise):
    """Noise that the filters assume; measured from the data unless ``fixed``."""

    fixed: bool = Field(False, description="use these levels instead of measuring them from the "
                                           "recording")


class StageOne(Section):
    """Stage one (Eq. 3, 4): viscous damping from force and position."""

    prior: Si("N·s/m", "B before any data", gt=0) = 500.0
    prior_stddev: Si("N·s/m", "standard deviation of the prior", gt=0) = 1000.0
    force_noise: Si("N", "unmodelled white force on each sample, beside the pressure noise",
                    ge=0) = 0.0


class StageTwo(Section):
    """Stage two (Eq. 5): effective bulk modulus from demanded and measured position."""

    prior: Si("Pa", "effective bulk modulus before any data", gt=0, possible=(1e5, 1e12)) = 5e8
    prior_stddev: Si("Pa", "standard deviation of the prior", gt=0) = 1e9
    largest: Si("Pa", "above the modulus of the oil itself; a larger estimate counts as diverged",
                gt=0, possible=(1e5, 1e12)) = 5e9
    damping_stddev: Si("N·s/m", "standard deviation of B if stage one provides none", gt=0) = 100.0
    acceleration_noise: Si("m/s²", "unmodelled white acceleration on each sample", ge=0) = 0.0


LIMITS = ("low_error", "low_warn", "high_warn", "high_error")


class Limits(Section):
    """Thresholds of one parameter; null where there is none."""

    low_error: float | None = None
    low_warn: float | None = None
    high_warn: float | None = None
    high_error: float | None = None
    hysteresis: Si("1", "relative hysteresis before an alarm clears", ge=0, lt=1) = 0.02
    hold_time: Si("s", "time beyond a limit before the alarm is raised", ge=0) = 0.5

    @model_validator(mode="after")
    def _ordered(self):
        present = [value for key in LIMITS if (value := getattr(self, key)) is not None]
        if present != sorted(present):
            raise ValueError("expected low_error <= low_warn <= high_warn <= high_error")
        return self


def _limits_in(unit: str, name: str, possible: tuple[float, float] | None = None) -> type[Limits]:
    """Return the section of thresholds whose limits have a unit; it is pickled by its name."""
    words = {"low_error": "below this: ERROR", "low_warn": "below this: WARN",
             "high_warn": "above this: WARN", "high_error": "above this: ERROR"}
    return create_model(name, __base__=Limits, __doc__=Limits.__doc__, __module__=__name__, **{
        key: (Si(unit, words[key], optional=True, possible=possible, ge=0), None)
        for key in LIMITS})


DampingLimits = _limits_in("N·s/m", "DampingLimits")
ModulusLimits = _limits_in("Pa", "ModulusLimits", (1e5, 1e12))


class Thresholds(Section):
    """Alarm limits on the two health parameters, in their SI units.

    A limit that is left out is the paper's, unless that is out of order with those given or the
    rig is another one (:attr:`Rig.is_papers`); null switches it off.
    """

    viscous_damping: DampingLimits = Field(
        DampingLimits(low_error=150.0, low_warn=250.0, high_warn=1000.0, high_error=1500.0),
        description="limits on B, N·s/m")
    bulk_modulus: ModulusLimits = Field(
        ModulusLimits(low_error=1.5e8, low_warn=4e8),
        description="limits on the effective bulk modulus, Pa")
    confidence: Si("1", "standard deviations by which a value must be beyond a limit", ge=0) = 2.0

    def beside(self, rig: Rig) -> "Thresholds":
        """Return the limits with those that a rig has where none are given."""
        sections = {}
        for name in ("viscous_damping", "bulk_modulus"):
            section = getattr(self, name)
            given = section.model_fields_set if name in self.model_fields_set else set()
            kept = {key: getattr(section, key) for key in type(section).model_fields
                    if key not in LIMITS or key in given}
            if rig.is_papers:
                kept = _with_defaults(kept, type(self).model_fields[name].default)
            sections[name] = type(section).model_construct(given, **kept)
        return type(self).model_construct(self.model_fields_set, **sections,
                                          confidence=self.confidence)


def _with_defaults(section: dict, defaults: Limits) -> dict:
    """Fill in the default limits, those left out that are in order with the given."""
    filled = dict(section)
    numbers = {key: section[key] for key in LIMITS if section.get(key) is not None}
    for place, key in enumerate(LIMITS):
        default = getattr(defaults, key)
        if key in section or default is None:
            continue
        below = [v for other, v in numbers.items() if LIMITS.index(other) < place]
        above = [v for other, v in numbers.items() if LIMITS.index(other) > place]
        if all(v <= default for v in below) and all(default <= v for v in above):
            filled[key] = default
    return filled


class Viscosity(Section):
    """Viscosity law by which B and laminar leakage are carried to the reference temperature.

    B(T) = B(T_ref) exp(-k (T - T_ref)), the Reynolds law; k about 0.03 1/K for mineral oil.
    With both viscosities of the oil's data sheet, Walther's law (ASTM D341) in its place.
    """

    reference_temperature: Si("°C", "temperature at which the thresholds of B apply, and to "
                                    "which leakage is converted", ge=-40, le=200) = 40.0
    coefficient: Si("1/K", "relative decrease of the viscosity with temperature, k; not used if "
                           "grade and at_100 are given", ge=0) = 0.03
    grade: Si("mm²/s", "kinematic viscosity of the oil at 40 °C: its ISO VG number, or from its "
                       "data sheet", ge=2, le=5000, optional=True) = None
    at_100: Si("mm²/s", "kinematic viscosity of the oil at 100 °C, from its data sheet",
               ge=1, le=500, optional=True) = None

    @model_validator(mode="after")
    def _two_points(self):
        if (self.grade is None) != (self.at_100 is None):
            raise ValueError("expected grade and at_100 together: the law goes through both")
        if self.grade is not None and self.at_100 >= self.grade:
            raise ValueError("expected at_100 below grade: the viscosity of oil decreases with "
                             "temperature")
        return self


def _off(given):
    """Return the word that YAML 1.1, and so a ROS parameter, reads as false."""
    return "off" if given is False else given


class Monitor(Section):
    """How the live monitor runs."""

    namespace: str = Field("/eha", description="namespace of the topics")
    frame_id: str = Field("", description="frame_id of the messages that monitor and simulator "
                          "publish; empty: rig.name")
    publish_rate: Si("Hz", "rate at which estimates are published; topics are read at this rate, "
                           "at least ten times a second", gt=0, le=1000) = 10.0
    stale_after: Si("s", "health becomes STALE after this time without data", gt=0) = 1.0
    latency: Si("s", "longest time a row waits for its last channel", gt=0) = 0.02
    on_mismatch: Literal["hold", "rebase", "ignore"] = Field(
        "hold", description="alarms of an estimate biased by a model mismatch; hold: judged by "
                            "least squares on the balances, neither raised nor cleared where "
                            "these do not determine it; rebase: once settled, judged by the "
                            "change since; ignore: judged as if the model fitted")
    buffer_minutes: Si("min", "length of the buffer of inputs, estimates and health, kept "
                              "compressed in memory to be saved as a bag (service monitor/save, "
                              "or save_on); at most 128 MiB, the oldest data are dropped first, "
                              "and at most twice that while a bag is being written or cannot be "
                              "written; 0 = off",
                       ge=0, le=60) = 2.0
    save_on: Annotated[Literal["off", "warn", "error"], BeforeValidator(_off)] = Field(
        "off", description="save the buffer to a bag when an alarm is raised to this level or "
                           "above")
    save_folder: str = Field("saved_bags", description="folder of those bags, made when needed")


class Diagnosis(Section):
    """How the monitor diagnoses itself, and what it may adopt (docs/live.md)."""

    start: Literal["automatic", "service"] = Field(
        "automatic", description="automatic: diagnose once model_mismatch has stood for after, "
                                 "with a machine only what the comparison does not explain; "
                                 "service: only on the service monitor/diagnose")
    after: Si("s", "time that a mismatch must stand; the recording that is diagnosed begins with "
                   "it. While nothing explains it, again after twice that time, and so on",
              ge=2, le=3600) = 20.0
    processor_time: Si("s", "processor time that one diagnosis may take", ge=1, le=86400) = 300.0
    memory_gigabytes: Si("1", "address space that it may take, in 10⁹ bytes", gt=0, le=1000) = 4.0
    niceness: int = Field(10, ge=0, le=19, description="how far it stands back behind other "
                                                       "processes")
    adopt: Literal["service", "automatic"] = Field(
        "service", description="service: a diagnosed model is adopted on the service "
                               "monitor/adopt; automatic: also by itself, if probable enough and "
                               "if it fits the rows that follow")
    adopt_probability: Si("1", "probability that each effect must reach to be adopted by itself",
                          gt=0.5, le=1) = 0.95
    adopt_after: Si("s", "duration of the rows, not seen by the diagnosis, that a model must fit "
                         "before it is adopted by itself", ge=2, le=3600) = 60.0
    machine: str = Field("", description="file of the healthy machine, as diagnose --machine "
                                         "writes it of several recordings, with which the monitor "
                                         "compares; empty: none")


class Settings(Section):
    """The whole config; every section and key has a default."""

    rig: Rig = Field(Rig(), description="constants of the actuator")
    simulation: Simulation = Field(Simulation(), description="the simulator")
    channels: Annotated[dict[Literal[CHANNELS], Channel], BeforeValidator(fill_channels)] = Field(
        DEFAULT_CHANNELS, description="source of each channel; omitted channels and keys keep "
                                      "their defaults, but for name and field of another "
                                      "JointState topic; v and force have none where x is "
                                      "another entry than the default's; null: there is none",
        json_schema_extra={"entries": CHANNEL_ABOUT})
    table: Table = Field(Table(), description="column of a CSV or MAT file for each channel, for "
                                              "import")
    noise: NoiseLevels = Field(NoiseLevels(), description="noise levels for the filters")
    stage_one: StageOne = Field(StageOne(), description="viscous damping")
    stage_two: StageTwo = Field(StageTwo(), description="effective bulk modulus")
    discretisation: Literal["exact", "euler"] = Field(
        "exact", description="euler: forward Euler, for comparison")
    command_hold: Literal["auto", "continuous", "sampled"] = Field(
        "auto", description="sampled: a digital controller holds x_d and x over a sample; "
        "continuous: an analogue or much faster one; auto: identified from the recording")
    engine: Literal["compiled", "filterpy"] = Field(
        "compiled", description="implementation of the stages, live and offline; filterpy: the "
                                "readable reference, same results at a hundredth of the speed")
    implausible: Literal["refuse", "warn"] = Field(
        "refuse", description="handling of a recording whose channels contradict this config "
                              "(signs, units, swapped channels): refuse it, or process it with a "
                              "warning")
    thresholds: Thresholds = Field(Thresholds(), description="alarm limits; the defaults are for "
                                   "a rig like the default one, any other has none")
    viscosity: Viscosity = Field(Viscosity(), description="temperature compensation of B and of "
                                 "leakage")
    health: Health = Field(Health(), description="reference conditions and limits of the health "
                                                 "indicators (docs/health.md, docs/limits.md)")
    monitor: Monitor = Field(Monitor(), description="the live monitor")
    diagnosis: Diagnosis = Field(Diagnosis(), description="the live monitor's own diagnosis")
    experiment: Experiment = Field(Experiment(), description="limits within which identify moves "
                                   "the rig (docs/identify.md)")
    effects: Annotated[dict[str, dict[str, float | str | list[float]]],
                       BeforeValidator(effects_field)] = Field(
        {}, description="modelled physics beyond the linear model")

    @field_serializer("channels", mode="wrap")
    def _and_those_that_are_absent(self, channels, written):
        """A default channel that is null stays so where the settings are read back."""
        return {name: None for name in DEFAULT_CHANNELS if name not in channels} | written(
            channels)

    @property
    def frame_id(self) -> str:
        """The frame_id of published messages: that of the config, else the rig's name."""
        return self.monitor.frame_id or self.rig.name

    @model_validator(mode="after")
    def _limits_of_the_rig(self):
        object.__setattr__(self, "thresholds", self.thresholds.beside(self.rig))
        return self

    @model_validator(mode="after")
    def _units_of_the_channels(self):
        rotary = self.rig.motion == "rotary"
        for section, entries in (("table.columns", self.table.columns),
                                 ("channels", self.channels)):
            for name, entry in entries.items():
                try:
                    check_unit(name, entry.unit, rotary)
                except ValueError as problem:
                    raise ValueError(f"{section}.{name}.unit: {problem}") from None
        return self
