"""Drive and pump: gain, lag, limits, what comes late, and flow that is not speed times volume."""

import math

from eha_monitor.compiled import njit
from eha_monitor.physics import signals as s
from eha_monitor.physics.effect import Effect, Parameter, adds_to
from eha_monitor.physics.signals import OMEGA, P1, P2, SPEED

# A drive that turns the position error into another speed than the config says.
DRIVE_GAIN = Effect(
    name="drive_gain", balance="drive",
    equation="omega = (1 + k) K_pos (x_d - x)",
    source="outer loop of the drive with another gain",
    parameters=(Parameter("k", "1", "relative error of the gain", -0.9, 10.0, 0.05),),
    circuit=adds_to(s.DRIVE_GAIN),
    statement="the drive's gain is {k:+%} off the configured position gain",
    rig_check="Read the gain in the drive's parameters; measured speed over position error is "
    "K_pos.",
    rig_twin="position_gain",
    starts=lambda r: ({"k": 0.003},),
)


# A drive that follows its command late: inverter, motor and shaft.
DRIVE_LAG = Effect(
    name="drive_lag", balance="drive",
    equation="tau omega' + omega = K_pos (x_d - x)",
    source="first-order speed loop of an electric drive, Leonhard 2001, Ch. 7",
    parameters=(Parameter("tau", "s", "time constant of the drive", 0.0, 1.0, 2e-3,
                          late="omega"),),
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
    name="drive_saturation", balance="drive",
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
    name="command_delay", balance="drive",
    equation="omega(t) = K_pos (x_d(t - T) - x(t))",
    source="dead time of sampling, filtering and bus",
    parameters=(Parameter("T", "s", "time from the command to the drive", 0.0, 0.1, 1e-3,
                          late="omega"),),
    circuit=adds_to(s.COMMAND_DELAY),
    statement="the command reaches the drive {T} late",
    rig_check="Log the command where it is made and where the drive takes it: compare the "
    "stamps of a step.",
    starts=lambda r: tuple({"T": share * r.sample_time} for share in (0.2, 1.0, 4.0)),
)


# A measured position that reaches the drive late.
FEEDBACK_DELAY = Effect(
    name="feedback_delay", balance="drive",
    equation="omega(t) = K_pos (x_d(t) - x(t - T))",
    source="dead time of sampling, filtering and bus",
    parameters=(Parameter("T", "s", "time from the position to the drive", 0.0, 0.1, 1e-3,
                          late="feedback"),),
    circuit=adds_to(s.FEEDBACK_DELAY),
    statement="the position reaches the drive {T} late",
    rig_check="Compare the position that the drive logs with the sensor's own output on one "
    "clock.",
    starts=lambda r: tuple({"T": share * r.sample_time} for share in (0.2, 1.0, 4.0)),
)


# A pump that displaces more or less than the config says.
@njit
def pump_flow_gain_term(s, p, m, c):
    """Add k omega to the speed that makes flow."""
    c[SPEED] += p[0] * s[OMEGA]


PUMP_FLOW_GAIN = Effect(
    name="pump_flow_gain", balance="flow",
    equation="Q = D_p (1 + k) omega",
    source="flow balance with another displacement",
    parameters=(Parameter("k", "1", "relative error of the displacement", -0.9, 10.0, 0.05),),
    term=pump_flow_gain_term, adds=(SPEED,), reads=(OMEGA,),
    statement="the pump gives {k:+%} flow at every speed, against the configured displacement",
    rig_check="Turn the pump by hand for a number of turns without load: the rod's travel times "
    "its area over the angle is the displacement.",
    rig_twin="pump_displacement",
    starts=lambda r: ({"k": 0.003},),
)


# A pump that slips: the more it turns and the more pressure it works against, the less it gives.
#
# The loss runs from the high to the low side, as every leak does: it takes from the flow while the
# pump drives the oil (omega dp > 0) and adds to the shaft's flow while the oil drives the pump.
# That is the form with ``motoring`` = 1, and it takes energy in all four quadrants.  Many models
# apply the efficiency 1 - k |dp| to omega whatever the quadrant; that is ``motoring`` = -1.
@njit
def pump_volumetric_loss_term(s, p, m, c):
    """Take k |omega dp|, by quadrant, off the speed that makes flow."""
    dp = s[P1] - s[P2]
    lost = p[0] * s[OMEGA] * abs(dp)
    c[SPEED] -= lost if s[OMEGA] * dp >= 0.0 else -p[1] * lost


PUMP_VOLUMETRIC_LOSS = Effect(
    name="pump_volumetric_loss", balance="flow",
    equation="Q = D_p omega (1 - k |dp|) while pumping, D_p omega (1 + motoring k |dp|) while "
    "motoring,  dp = p1 - p2",
    source="slip of a displacement machine, Wilson 1950; Merritt 1967, Sec. 4-3",
    parameters=(
        Parameter("k", "1/Pa", "relative loss of flow over the pressure difference", 0.0, 1e-5,
                  1e-8),
        Parameter("motoring", "1", "1: the slip runs to the low side, also while motoring; -1: it "
                  "always takes from the speed", -1.0, 1.0, 1.0, 1.0, fitted=False),
    ),
    term=pump_volumetric_loss_term, adds=(SPEED,), reads=(P1, P2, OMEGA),
    statement="the pump has a volumetric loss of {k} of pressure difference",
    rig_check="Hold the same pump speed at two loads: the rod must be slower by k times the "
    "difference in pressure.",
    starts=lambda r: tuple({"k": 0.01 / max(r.pressure_difference[3], 1.0), "motoring": motoring}
                           for motoring in (1.0, -1.0)),  # both forms
)


# A pump that gives no flow below a speed: the first turns only fill its own leakage.
@njit
def pump_dead_zone_term(s, p, m, c):
    """Take omega, at most omega_0 of it, off the speed that makes flow."""
    c[SPEED] -= min(max(s[OMEGA], -p[0]), p[0])


PUMP_DEAD_ZONE = Effect(
    name="pump_dead_zone", balance="flow",
    equation="Q = D_p (|omega| - omega_0)+ sgn omega",
    source="dead zone, Tao, Kokotovic 1996; of a pump: Ivantysyn, Ivantysynova 2001",
    parameters=(Parameter("omega_0", "rad/s", "shaft speed below which no flow is made", 0.0, 1e4,
                          5.0),),
    term=pump_dead_zone_term, adds=(SPEED,), reads=(OMEGA,),
    statement="the pump delivers no flow below {omega_0}, and the same speed is lost above it",
    rig_check="Turn the pump slowly with the rod free: the rod must not move below omega_0.",
    starts=lambda r: ({"omega_0": 0.003 * r.pump_speed[3]},),  # it shows at small speeds
)
