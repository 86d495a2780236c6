"""Errors of the sensors and of their way into the recording."""

from eha_monitor.physics import signals as s
from eha_monitor.physics.effect import Effect, Parameter, adds_to

# A position sensor whose scale is wrong.
POSITION_SCALE = Effect(
    name="position_scale", balance="sensor",
    equation="x_s = (1 + k) x, and with in_loop = 1 the drive reads x_s",
    source="sensor model y = a x",
    parameters=(
        Parameter("k", "1", "relative error of the scale", -0.5, 1.0, 0.03),
        Parameter("in_loop", "1", "1: the drive reads the same sensor; 0: only the recording "
                  "does", 0.0, 1.0, 1.0, 0.0, fitted=False),
    ),
    circuit=adds_to(s.POSITION_SCALE, s.IN_LOOP),
    statement="the position sensor reads {k:+%} off its scale",
    rig_check="Move the rod between two stops and compare with a gauge.",
    starts=lambda r: ({"k": 0.003, "in_loop": 0.0}, {"k": 0.003, "in_loop": 1.0}),
)


# A position that comes in whole steps.
#
# No term and no circuit: the step is found in the recording itself, where the positions are whole
# multiples of it, and not by a fit.  The simulator makes it from ``noise.position_resolution``.
POSITION_QUANTISATION = Effect(
    name="position_quantisation", balance="sensor",
    equation="x_s = q round(x / q)",
    source="uniform quantiser, Widrow, Kollar 2008",
    parameters=(Parameter("q", "m", "step of the position sensor", 0.0, 0.01, 1e-5),),
    statement="the position comes in steps of {q}",
    rig_check="Read the resolution of the encoder or of its converter in the data sheet.",
    starts=lambda r: (),
)


# A position that reaches the recording late; the drive has it in time.
POSITION_DELAY = Effect(
    name="position_delay", balance="sensor",
    equation="x_s(t) = x(t - T)",
    source="dead time of sampling, filtering and bus",
    parameters=(Parameter("T", "s", "time from the position to its stamp in the recording", 0.0,
                          0.1, 1e-3, late="x"),),
    circuit=adds_to(s.POSITION_DELAY),
    statement="the recorded position is {T} late",
    rig_check="Tap the rod while a second sensor is on the same clock: the position must respond "
              "T later.",
    starts=lambda r: tuple({"T": share * r.sample_time} for share in (0.2, 1.0, 4.0)),
)


# Play between the piston and its position sensor.
BACKLASH = Effect(
    name="backlash", balance="force",
    equation="x_s = min(max(x_s, x - b/2), x + b/2), x_s is what the sensor shows and, with "
    "in_loop = 1, the drive reads",
    source="play operator, Nordin, Gutman 2002; Tao, Kokotovic 1996",
    parameters=(
        Parameter("b", "m", "width of the play, end to end", 0.0, 0.1, 1e-4),
        Parameter("in_loop", "1", "1: the drive reads the sensor behind the play; 0: only the "
                  "recording does", 0.0, 1.0, 1.0, 1.0, fitted=False),
    ),
    circuit=adds_to(s.PLAY, s.IN_LOOP),
    statement="there is a backlash of {b} between the piston and its position sensor",
    rig_check="Put a dial gauge on the piston rod and reverse slowly: the sensor must stand still "
    "for b.",
    starts=lambda r: tuple({"b": share * max(r.position, 1e-6), "in_loop": in_loop}
                           for in_loop in (1.0, 0.0) for share in (0.001, 0.01)),
    rarity=2,
)


# Pressure sensors with a zero error.
PRESSURE_OFFSET = Effect(
    name="pressure_offset", balance="sensor",
    equation="p_s = p + b_1 in chamber 1, p + b_2 in chamber 2",
    source="sensor model y = x + b",
    parameters=(
        Parameter("b_1", "Pa", "zero error of sensor 1", -1e8, 1e8, 2e4),
        Parameter("b_2", "Pa", "zero error of sensor 2", -1e8, 1e8, 2e4),
    ),
    circuit=adds_to(s.PRESSURE_OFFSET_1, s.PRESSURE_OFFSET_2),
    statement="the pressure sensors have zero errors of {b_1:+} (chamber 1) and {b_2:+} (chamber "
              "2)",
    rig_check="Open both chambers to the tank: the sensors must show the same pressure, and a "
    "gauge too.",
    starts=lambda r: (dict.fromkeys(  # both sensors at once
        ("b_1", "b_2"), 0.003 * max(r.pressure_difference[3], 1.0)),),
    rarity=0,
)


# Pressure sensors whose scale is wrong.
PRESSURE_SCALE = Effect(
    name="pressure_scale", balance="sensor",
    equation="p_s = (1 + k_1) p in chamber 1, (1 + k_2) p in chamber 2",
    source="sensor model y = a x",
    parameters=(
        Parameter("k_1", "1", "relative error of the scale of sensor 1", -0.9, 2.0, 0.03),
        Parameter("k_2", "1", "relative error of the scale of sensor 2", -0.9, 2.0, 0.03),
    ),
    circuit=adds_to(s.PRESSURE_SCALE_1, s.PRESSURE_SCALE_2),
    statement="the pressure sensors read {k_1:+%} (chamber 1) and {k_2:+%} (chamber 2) off their "
    "scale",
    rig_check="Put both sensors on a dead-weight tester, or on one another's port, at two "
    "pressures.",
    starts=lambda r: ({"k_1": 0.003, "k_2": 0.003},),
)


# Pressure sensors whose zero wanders during the record.
PRESSURE_DRIFT = Effect(
    name="pressure_drift", balance="sensor",
    equation="p_s = p + d_1 t in chamber 1, p + d_2 t in chamber 2",
    source="sensor model y = x + d t, t since the start of the record",
    parameters=(
        Parameter("d_1", "Pa/s", "drift of the zero of sensor 1", -1e7, 1e7, 1e3),
        Parameter("d_2", "Pa/s", "drift of the zero of sensor 2", -1e7, 1e7, 1e3),
    ),
    circuit=adds_to(s.PRESSURE_DRIFT_1, s.PRESSURE_DRIFT_2),
    statement="the pressure sensors drift by {d_1:+} (chamber 1) and {d_2:+} (chamber 2)",
    rig_check="Log the sensors for as long as the record took with the rig at rest and both "
    "chambers open to the tank.",
    starts=lambda r: (dict.fromkeys(("d_1", "d_2"), 0.003 * max(
        r.pressure_difference[3], 1.0) / max(r.duration, r.sample_time)),),
    rarity=2,
)


# Pressures that reach the recording late.
PRESSURE_DELAY = Effect(
    name="pressure_delay", balance="sensor",
    equation="p_s(t) = p(t - T), both chambers",
    source="dead time of sampling, filtering and bus",
    parameters=(Parameter("T", "s", "time from the pressures to their stamps in the recording",
                          0.0, 0.1, 1e-3, late="p"),),
    circuit=adds_to(s.PRESSURE_DELAY),
    statement="the recorded pressures are {T} late",
    rig_check="Tap the blocked rod while a second sensor is on the same clock: the pressures "
              "must respond T later.",
    starts=lambda r: tuple({"T": share * r.sample_time} for share in (0.2, 1.0, 4.0)),
)
