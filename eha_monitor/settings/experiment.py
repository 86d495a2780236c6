"""Config section of ``identify``: the limits within which it may move the rig."""

from pydantic import model_validator

from eha_monitor.units import Section, Si


class Experiment(Section):
    """Limits of an experiment; the first five have no default, as only the rig's owner knows them.

    A motion is planned to stay within them, and ends at once where a sensor shows that it does
    not.
    """

    lower: Si("m", "lowest position that the piston may reach", optional=True) = None
    upper: Si("m", "highest position that the piston may reach", optional=True) = None
    speed: Si("m/s", "largest speed of the piston, in either direction", gt=0, optional=True
              ) = None
    acceleration: Si("m/s²", "largest acceleration of the piston, in either direction", gt=0,
                     optional=True) = None
    pressure: Si("Pa", "highest absolute pressure in either chamber", gt=0, optional=True) = None
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
