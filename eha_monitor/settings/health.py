"""Config section of the indicators of health: conditions they are told at, oil, limits."""

from pydantic import Field

from eha_monitor.settings.section import Section
from eha_monitor.units import Si


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
