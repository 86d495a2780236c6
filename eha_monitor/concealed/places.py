"""Places in the plant's constant vector; every constant is zero where an effect is absent."""

NAMES = (
    # the paper's rig
    "area", "volume", "mass", "damping", "bulk_modulus", "leakage", "makeup", "charge_pressure",
    "displacement", "position_gain",
    # seals: level and travel of the first bristle, then of a second, softer one
    "seal_forward", "seal_backward", "seal_static", "stribeck_speed", "seal_per_pressure",
    "seal_travel", "soft_seal", "soft_travel",
    # load
    "damping_asymmetry", "quadratic", "constant_load", "stiffness", "play", "play_in_loop",
    # leakage and valves
    "turbulent", "leakage_offset", "external_leakage_1", "external_leakage_2",
    "tank", "relief_gain", "relief_pressure",
    "check_gain", "check_pressure",
    # oil and chambers
    "air_fraction", "air_exponent", "volume_slope",
    # pump and line
    "dead_zone", "pump_gain", "pump_loss", "line_inertance", "line_resistance", "line_volume",
    # drive
    "drive_lag", "speed_limit", "feedback_delay",
    # outside the catalogue of the diagnosis
    "hump_force", "hump_place", "hump_width", "stick_force", "stick_place", "stick_width",
    "sticky_gain", "sticky_open", "sticky_close", "ripple", "ripple_order",
    "gapped_mass", "gapped_play", "place_leak", "place_leak_place", "place_leak_width",
    "lever_load", "lever_length", "cushion", "cushion_place", "widening_gap",
)
(AREA, VOLUME, MASS, DAMPING, BULK_MODULUS, LEAKAGE, MAKEUP, CHARGE_PRESSURE, DISPLACEMENT,
 POSITION_GAIN, SEAL_FORWARD, SEAL_BACKWARD, SEAL_STATIC, STRIBECK_SPEED, SEAL_PER_PRESSURE,
 SEAL_TRAVEL, SOFT_SEAL, SOFT_TRAVEL, DAMPING_ASYMMETRY, QUADRATIC, CONSTANT_LOAD, STIFFNESS,
 PLAY, PLAY_IN_LOOP, TURBULENT, LEAKAGE_OFFSET, EXTERNAL_LEAKAGE_1,
 EXTERNAL_LEAKAGE_2, TANK, RELIEF_GAIN, RELIEF_PRESSURE,
 CHECK_GAIN, CHECK_PRESSURE, AIR_FRACTION, AIR_EXPONENT, VOLUME_SLOPE, DEAD_ZONE, PUMP_GAIN,
 PUMP_LOSS, LINE_INERTANCE, LINE_RESISTANCE, LINE_VOLUME, DRIVE_LAG, SPEED_LIMIT,
 FEEDBACK_DELAY, HUMP_FORCE, HUMP_PLACE, HUMP_WIDTH, STICK_FORCE, STICK_PLACE, STICK_WIDTH,
 STICKY_GAIN, STICKY_OPEN, STICKY_CLOSE, RIPPLE, RIPPLE_ORDER, GAPPED_MASS, GAPPED_PLAY,
 PLACE_LEAK, PLACE_LEAK_PLACE, PLACE_LEAK_WIDTH, LEVER_LOAD, LEVER_LENGTH, CUSHION,
 CUSHION_PLACE, WIDENING_GAP) = range(len(NAMES))
N_CONSTANTS = len(NAMES)

# Columns of the fine trajectory.
X, X_SENSED, V, P1, P2, OMEGA = range(6)
N_COLUMNS = 6
