"""Config sections of the monitor: channels, stages, thresholds, temperature."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, field_validator, model_validator

from eha_monitor.settings.health import Health
from eha_monitor.settings.measured import Measured, check_unit
from eha_monitor.settings.rig import Rig, SensorNoise, Simulation, effects_field
from eha_monitor.settings.section import Section
from eha_monitor.settings.table import Table
from eha_monitor.units import Si

CHANNELS = ("x", "v", "x_d", "omega", "omega_d", "p1", "p2", "force", "temperature")
CHANNEL_UNITS = {"x": "m", "v": "m/s", "x_d": "m", "omega": "rad/s",
                 "omega_d": "rad/s", "p1": "Pa", "p2": "Pa", "force": "N", "temperature": "°C"}
_ABSOLUTE = "absolute (above vacuum), not gauge; of a gauge sensor: unit bar gauge"
CHANNEL_WORDS = {"x": "piston position", "v": "piston velocity", "x_d": "demanded position",
                 "omega": "pump speed", "omega_d": "demanded pump speed",
                 "p1": f"pressure of chamber 1, {_ABSOLUTE}",
                 "p2": f"pressure of chamber 2, {_ABSOLUTE}",
                 "force": "force that drives the piston, if measured",
                 "temperature": "oil temperature"}


def channel_about(name: str) -> str:
    """Return unit and meaning of a channel, ``[Pa] pressure of chamber 1, absolute ...``."""
    return f"[{CHANNEL_UNITS[name]}] {CHANNEL_WORDS[name]}"


class Channel(Section, Measured):
    """Where a channel comes from: scale * raw + offset is in ``unit``, taken ``delay`` earlier."""

    topic: str = Field("", description="topic (relative names get the namespace) or, for an "
                       "import, unused")
    name: str = Field("", description="entry of a JointState, or column of an imported table")
    field: str = Field("", description="message field, e.g. position, velocity, effort, "
                       "fluid_pressure, temperature, data")
    unit: str = Field("", description="unit of scale * raw + offset, such as mm, rpm, bar, bar "
                      "gauge; empty: SI")
    scale: float = Field(1.0, allow_inf_nan=False, description="of unit, per raw unit, not 0")
    offset: float = Field(0.0, allow_inf_nan=False, description="in unit, at raw zero")
    delay: Si("s", "delay of the stamp relative to the quantity") = 0.0

    @field_validator("scale")
    @classmethod
    def _not_zero(cls, value):
        if value == 0:
            raise ValueError("expected a number other than 0")
        return value


DEFAULT_CHANNELS = {
    "x": Channel(topic="joint_states", name="piston", field="position"),
    "v": Channel(topic="joint_states", name="piston", field="velocity"),
    "force": Channel(topic="joint_states", name="piston", field="effort"),
    "omega": Channel(topic="joint_states", name="pump", field="velocity"),
    "x_d": Channel(topic="command", name="piston", field="position"),
    "omega_d": Channel(topic="command", name="pump", field="velocity"),
    "p1": Channel(topic="pressure/chamber_1", field="fluid_pressure"),
    "p2": Channel(topic="pressure/chamber_2", field="fluid_pressure"),
    "temperature": Channel(topic="temperature", field="temperature"),
}


def _fill_channels(given):
    """Fill in what a ``channels`` section leaves out, channel by channel and key by key."""
    if not isinstance(given, dict):
        return given
    filled = {name: channel.model_dump() for name, channel in DEFAULT_CHANNELS.items()}
    for name, channel in given.items():
        if isinstance(channel, dict) and name in filled and "topic" not in channel:
            channel = {**filled[name], **channel}
        filled[name] = channel
    return filled


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

    prior: Si("Pa", "effective bulk modulus before any data", gt=0) = 5e8
    prior_stddev: Si("Pa", "standard deviation of the prior", gt=0) = 1e9
    largest: Si("Pa", "above the modulus of the oil itself; a larger estimate counts as diverged",
                gt=0) = 5e9
    damping_stddev: Si("N·s/m", "standard deviation of B if stage one provides none",
                       gt=0) = 100.0
    acceleration_noise: Si("m/s²", "unmodelled white acceleration on each sample", ge=0) = 0.0


class Limits(Section):
    """Thresholds of one parameter; null where there is none."""

    low_error: Si("1", "below this: ERROR", optional=True) = None
    low_warn: Si("1", "below this: WARN", optional=True) = None
    high_warn: Si("1", "above this: WARN", optional=True) = None
    high_error: Si("1", "above this: ERROR", optional=True) = None
    hysteresis: Si("1", "relative hysteresis before an alarm clears", ge=0, lt=1) = 0.02
    hold_time: Si("s", "time beyond a limit before the alarm is raised", ge=0) = 0.5

    @model_validator(mode="after")
    def _ordered(self):
        present = [value for value in (self.low_error, self.low_warn, self.high_warn,
                                       self.high_error) if value is not None]
        if present != sorted(present):
            raise ValueError("expected low_error <= low_warn <= high_warn <= high_error")
        return self


LIMITS = ("low_error", "low_warn", "high_warn", "high_error")


class DampingLimits(Limits):
    """Thresholds of the viscous damping."""

    low_error: Si("N·s/m", "below this: ERROR", optional=True) = None
    low_warn: Si("N·s/m", "below this: WARN", optional=True) = None
    high_warn: Si("N·s/m", "above this: WARN", optional=True) = None
    high_error: Si("N·s/m", "above this: ERROR", optional=True) = None


class ModulusLimits(Limits):
    """Thresholds of the effective bulk modulus."""

    low_error: Si("Pa", "below this: ERROR", optional=True) = None
    low_warn: Si("Pa", "below this: WARN", optional=True) = None
    high_warn: Si("Pa", "above this: WARN", optional=True) = None
    high_error: Si("Pa", "above this: ERROR", optional=True) = None


class Thresholds(Section):
    """Alarm limits on the two health parameters, in their SI units.

    A limit that is left out keeps its default, unless that is out of order with those given;
    null switches it off.
    """

    viscous_damping: DampingLimits = Field(
        DampingLimits(low_error=150.0, low_warn=250.0, high_warn=1000.0, high_error=1500.0),
        description="limits on B, N·s/m")
    bulk_modulus: ModulusLimits = Field(
        ModulusLimits(low_error=1.5e8, low_warn=4e8),
        description="limits on the effective bulk modulus, Pa")
    confidence: Si("1", "standard deviations by which a value must be beyond a limit", ge=0) = 2.0

    @model_validator(mode="before")
    @classmethod
    def _keep_default_limits(cls, given):
        if not isinstance(given, dict):
            return given
        filled = dict(given)
        for name in ("viscous_damping", "bulk_modulus"):
            if isinstance(filled.get(name), dict):
                filled[name] = _with_defaults(filled[name], cls.model_fields[name].default)
        return filled


def _with_defaults(section: dict, defaults: Limits) -> dict:
    """Fill in the default limits, those left out that would not be in order with the given."""
    filled = dict(section)
    numbers = {key: section[key] for key in LIMITS
               if isinstance(section.get(key), int | float)}
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
        "hold", description="alarms of an estimate biased by a model mismatch; hold: not raised "
                            "or cleared if the mismatch may have moved the estimate across the "
                            "limit; rebase: once settled, judged by the change since; ignore: "
                            "judged as if the model fitted")
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


class Settings(Section):
    """The whole config; every section and key has a default."""

    rig: Rig = Field(Rig(), description="constants of the actuator")
    simulation: Simulation = Field(Simulation(), description="the simulator")
    channels: Annotated[dict[Literal[CHANNELS], Channel], BeforeValidator(_fill_channels)] = Field(
        DEFAULT_CHANNELS, description="source of each channel; omitted channels and keys keep "
                                      "their defaults", json_schema_extra={
            "entries": {name: channel_about(name) for name in CHANNELS}})
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
    thresholds: Thresholds = Field(Thresholds(), description="alarm limits")
    viscosity: Viscosity = Field(Viscosity(), description="temperature compensation of B and of "
                                 "leakage")
    health: Health = Field(Health(), description="reference conditions and limits of the health "
                                                 "indicators (docs/health.md, docs/limits.md)")
    monitor: Monitor = Field(Monitor(), description="the live monitor")
    effects: Annotated[dict[str, dict[str, float | str | list[float]]],
                       BeforeValidator(effects_field)] = Field(
        {}, description="modelled physics beyond the linear model")

    @property
    def frame_id(self) -> str:
        """The frame_id of published messages: that of the config, else the rig's name."""
        return self.monitor.frame_id or self.rig.name

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
