"""Whether the circuit around a single-rod cylinder is the config's: pumps that match its areas.

With them both chambers are pressed by the same flow, as of chamber 1

    V1 p1' / beta_e = D_p omega - A1 v - ... = -(A1/A2) V2 p2' / beta_e,

and one goes with the other.  With one pump an accumulator holds the rod's side, or check valves
that of the lower pressure: what the other side is pressed by does not reach it.
"""

import numpy as np

from eha_monitor.balances.candidates import oil_pressed
from eha_monitor.balances.course import Course
from eha_monitor.balances.least_squares import rms
from eha_monitor.settings.rig import Rig

HALF = 0.5  # of what two matched pumps make: less of it is another circuit


def one_side_is_held(course: Course, rig: Rig) -> bool:
    """Tell whether something holds the pressure of one side, so that no pump presses it.

    Its rate is less than half of the other side's (two sensors' noise alone would be equal), and
    what goes of the other's oil into its own is less than half of what matched pumps make,
    beside what goes with speed and pressure: a pump that is a little too large for its side, and
    a path to the make-up source.
    """
    pressed = None if course.p1 is None or rig.area_1 == rig.area_2 else oil_pressed(course, rig)
    if pressed is None or course.omega is None or not course.good.any():
        return False
    good = course.good
    rates = [rms(rate[good]) for rate in (course.rate_1, course.rate_2)]
    held = int(rates[1] < rates[0])
    if not rates[held] < HALF * rates[1 - held]:
        return False
    columns = np.column_stack([pressed[1 - held], course.v, (course.p1, course.p2)[held],
                               np.ones(len(course))])[good]
    sizes = np.maximum(np.abs(columns).max(axis=0), 1e-300)
    weights = np.linalg.lstsq(columns / sizes, pressed[held][good], rcond=None)[0]
    return bool(weights[0] < HALF * sizes[0])
