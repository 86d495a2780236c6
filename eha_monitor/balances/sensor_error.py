"""A constant force that came: a load, or the zero of a pressure sensor.

The force balance A1 p1 - A2 p2 sees no difference.  The others do: a sensor that reads b too high
makes C_T b of leakage that is not there, and moves the lowest pressure of its chamber by b.  So
each hypothesis is tried on the recordings themselves: with the channel less its zero error, is
anything left of what had changed?
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from eha_monitor.balances.course import Course, courses_of
from eha_monitor.balances.judge import Judged, Moved, within_stroke
from eha_monitor.balances.machine import Machine
from eha_monitor.balances.model import LOAD
from eha_monitor.balances.viscous import judge_with_oil
from eha_monitor.mismatch.diagnosis import Change, Value
from eha_monitor.quantity import with_uncertainty
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

ZERO = "pressure_offset"
# Channel -> area that its pressure acts on, and in which direction; the catalogue's parameter.
CHAMBERS = {"p1": ("area_1", 1.0, "b_1"), "p2": ("area_2", -1.0, "b_2")}


@dataclass(frozen=True)
class ZeroError:
    """A sensor of the pressure whose zero would make the force that came.

    Attributes
    ----------
    channel : ``p1`` or ``p2``.
    value, stddev : by how much it reads too high, Pa.
    judged, courses : the recordings without it, in which nothing has changed.
    """

    channel: str
    value: float
    stddev: float
    judged: Judged
    courses: Sequence[Course]

    @property
    def words(self) -> str:
        """What it is, as a sentence's beginning."""
        amount = with_uncertainty(abs(self.value), self.stddev, "Pa")
        return (f"the sensor of {self.channel} reads {amount} too "
                f"{'high' if self.value > 0.0 else 'low'}")


def load_of(judged: Judged) -> Moved | None:
    """Return the constant load that has changed and may be the zero of a sensor."""
    return next((one for one in judged.changed if one.candidate.effect == LOAD
                 and ZERO in one.rivals), None)


def zero_errors(machine: Machine, recordings: Sequence[Recording], settings: Settings,
                load: Moved) -> list[ZeroError]:
    """Return the sensors whose zero makes a load, and all else that has changed with it."""
    found = []
    for channel, (area, sign, _) in CHAMBERS.items():
        slope = sign / getattr(settings.rig, area)
        value = (load.here - load.machine) * slope
        right = [replace(one, channels=one.channels | {channel: one.channels[channel] - value})
                 for one in recordings]
        courses, _ = within_stroke(machine, courses_of(right, settings)[1])
        judged = judge_with_oil(machine, courses, settings)
        if judged.belongs:
            found.append(ZeroError(channel, value, abs(load.apart * slope), judged, courses))
    return found


def without_offset(judged: Judged, load: Moved) -> Judged:
    """Return a recording whose load is none of a sensor's zero: that would have moved more."""
    plain = replace(load, rivals=tuple(one for one in load.rivals if one != ZERO))
    return replace(judged, balances=tuple(replace(one, changed=tuple(
        plain if moved is load else moved for moved in one.changed)) for one in judged.balances))


def change_of(errors: Sequence[ZeroError], load: Moved, runs: str) -> Change:
    """Return the record of a zero error; of two that explain as much, the first."""
    one, *others = errors
    more = "".join(f", or {other.words}" for other in others)
    force = with_uncertainty(abs(load.here - load.machine), load.apart, "N")
    return Change(
        ZERO, CHAMBERS[one.channel][2], "sensor", Value(0.0, one.stddev, "Pa"),
        Value(one.value, one.stddev, "Pa"), "Pa",
        f"{one.words}{more}: that explains a force of {force}, and all else that differs from "
        f"{runs}")
