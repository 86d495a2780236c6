"""The drive: its gain, lag and limits, and what reaches it late."""

import math

from eha_monitor.compiled import njit
from eha_monitor.physics import signals as s
from eha_monitor.physics.effect import Effect, Parameter, adds_to

# A drive that turns the position error into another speed than the config says.
DRIVE_GAIN = Effect(
    name="drive_gain",
    balance="drive",
    equation="omega = (1 + k) K_pos (x_d - x)",
    source="outer loop of the drive with another gain",
    parameters=(
        Parameter("k", "1", "relative error of the gain", -0.9, 10.0, 0.05),
    ),
    circuit=adds_to(s.DRIVE_GAIN),
    statement="the drive's gain is {k:+%} off the configured position gain",
    rig_check="Read the gain in the drive's parameters; measured speed over position error is "
    "K_pos.",
    rig_twin="position_gain",
    starts=lambda r: ({"k": 0.003},),
)


# A drive that follows its command late: inverter, motor and shaft.
DRIVE_LAG = Effect(
    name="drive_lag",
    balance="drive",
    equation="tau omega' + omega = K_pos (x_d - x)",
    source="first-order speed loop of an electric drive, Leonhard 2001, Ch. 7",
    parameters=(
        Parameter("tau", "s", "time constant of the drive", 0.0, 1.0, 2e-3),
    ),
    circuit=adds_to(s.DRIVE_LAG),
    statement="the drive follows its command with a time constant of {tau}",
    rig_check="Step the speed command with the rod free: 63 % of the speed must be there after "
    "tau.",
    starts=lambda r: tuple({"tau": share * r.sample_time} for share in (0.3, 1.0, 5.0)),
    rarity=0,
)


# Limits of the drive: speed, and speed gained in a second.
NO_SPEED_LIMIT = 1e6  # rad/s; a config that names only one of the two limits gets these
NO_SLEW_LIMIT = 1e9  # rad/s^2


@njit
def drive_saturation_circuit(p, w):
    """Take the lower limit; what no drive reaches is no limit."""
    if p[0] < NO_SPEED_LIMIT:
        w[s.SPEED_LIMIT] = min(w[s.SPEED_LIMIT], p[0])
    if p[1] < NO_SLEW_LIMIT:
        w[s.SLEW_LIMIT] = min(w[s.SLEW_LIMIT], p[1])


def drive_saturation_starts(r):
    """Limits within the speeds and the accelerations of the record, one at a time."""
    top, fastest = max(r.pump_speed[3], 1e-3), max(r.pump_acceleration[2], 1.0)
    # Where the speed is measured, its maximum is the limit already, but for the noise.
    limits = (0.999 * top, r.pump_speed[2], 0.97 * top, 0.9 * top, 0.75 * top)
    speeds = tuple({"omega_max": limit, "slew": math.inf} for limit in limits)
    slews = tuple({"omega_max": math.inf, "slew": share * fastest} for share in (0.9, 0.5, 0.2))
    return speeds + slews


DRIVE_SATURATION = Effect(
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
    circuit=drive_saturation_circuit,
    statement="the drive is limited to {omega_max} and {slew}",
    rig_check="Command a large step: the measured pump speed must stop at omega_max, or rise in a "
    "straight line.",
    starts=drive_saturation_starts,
)


# A demanded position that reaches the drive late.
COMMAND_DELAY = Effect(
    name="command_delay",
    balance="drive",
    equation="omega(t) = K_pos (x_d(t - T) - x(t))",
    source="dead time of sampling, filtering and bus",
    parameters=(
        Parameter("T", "s", "time from the command to the drive", 0.0, 0.1, 1e-3),
    ),
    circuit=adds_to(s.COMMAND_DELAY),
    statement="the command reaches the drive {T} late",
    rig_check="Log the command where it is made and where the drive takes it: compare the "
    "stamps of a step.",
    starts=lambda r: tuple({"T": share * r.sample_time} for share in (0.2, 1.0, 4.0)),
)


# A measured position that reaches the drive late.
FEEDBACK_DELAY = Effect(
    name="feedback_delay",
    balance="drive",
    equation="omega(t) = K_pos (x_d(t) - x(t - T))",
    source="dead time of sampling, filtering and bus",
    parameters=(
        Parameter("T", "s", "time from the position to the drive", 0.0, 0.1, 1e-3),
    ),
    circuit=adds_to(s.FEEDBACK_DELAY),
    statement="the position reaches the drive {T} late",
    rig_check="Compare the position that the drive logs with the sensor's own output on one "
    "clock.",
    starts=lambda r: tuple({"T": share * r.sample_time} for share in (0.2, 1.0, 4.0)),
)
