"""How well each number of the rig is known: what a diagnosis may move it by and say nothing."""

import math

from pydantic import Field

from eha_monitor.settings.section import Section

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

    def log_spread(self, key: str) -> float:
        """Return the standard deviation of the logarithm of a rig key (``mass``)."""
        value = getattr(self, key)
        field = type(self).model_fields[key]
        factor = any(getattr(one, "gt", None) == 1.0 for one in field.metadata)
        return math.log(value) if factor else value
