"""Limits of the drive: speed, and speed gained in a second."""

import math

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import Effect, Parameter
from eha_monitor.physics.signals import SLEW_LIMIT, SPEED_LIMIT

NO_SPEED_LIMIT = 1e6  # rad/s; a config that names only one of the two limits gets these
NO_SLEW_LIMIT = 1e9  # rad/s^2


@njit
def circuit(p, w):
    """Take the lower limit; what no drive reaches is no limit."""
    if p[0] < NO_SPEED_LIMIT:
        w[SPEED_LIMIT] = min(w[SPEED_LIMIT], p[0])
    if p[1] < NO_SLEW_LIMIT:
        w[SLEW_LIMIT] = min(w[SLEW_LIMIT], p[1])


def starts(r):
    """Limits within the speeds and the accelerations of the record, one at a time."""
    top, fastest = max(r.pump_speed[3], 1e-3), max(r.pump_acceleration[2], 1.0)
    # Where the speed is measured, its maximum is the limit already, but for the noise.
    limits = (0.999 * top, r.pump_speed[2], 0.97 * top, 0.9 * top, 0.75 * top)
    speeds = tuple({"omega_max": limit, "slew": math.inf} for limit in limits)
    slews = tuple({"omega_max": math.inf, "slew": share * fastest} for share in (0.9, 0.5, 0.2))
    return speeds + slews


EFFECT = Effect(
    name="drive_saturation",
    balance="drive",
    equation="|omega| <= omega_max, |omega'| <= slew",
    source="speed and current limit of an electric drive, Leonhard 2001, Ch. 7",
    parameters=(
        Parameter("omega_max", "rad/s", "largest shaft speed", 0.0, NO_SPEED_LIMIT, 100.0,
                  neutral=math.inf),
        Parameter("slew", "rad/s^2", "largest rate of the shaft speed", 0.0, NO_SLEW_LIMIT, 1e4,
                  neutral=math.inf),
    ),
    circuit=circuit,
    statement="the drive is limited to {omega_max} and {slew}",
    rig_check="Command a large step: the measured pump speed must stop at omega_max, or rise in a "
    "straight line.",
    starts=starts,
)
