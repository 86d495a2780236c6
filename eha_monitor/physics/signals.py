"""Indices of the arrays that the compiled equations share.

An effect's term reads the signals ``s`` and *adds* to the contributions ``c``; an effect of the
drive or of a sensor *adds* its constants to the circuit ``w``.  It sees nothing else, so an entry
is self-contained.
"""

# Signals s: what the equations may look at (SI units).
T, X, V, P1, P2, OMEGA, X_D, ANGLE = range(8)  # ANGLE: what the shaft has turned, rad
N_SIGNALS = 8

# Contributions c: what an effect may add while the plant moves.
FORCE = 0  # N, resists positive motion: M x'' = A1 p1 - A2 p2 - B v - c[FORCE]
FLOW_1 = 1  # m^3/s into chamber 1
FLOW_2 = 2  # m^3/s into chamber 2
COMPLIANCE_1 = 3  # 1/Pa, added to 1/beta_e of chamber 1
COMPLIANCE_2 = 4  # 1/Pa, added to 1/beta_e of chamber 2
VOLUME_1 = 5  # m^3, added to chamber 1
VOLUME_2 = 6  # m^3, added to chamber 2
MASS = 7  # kg, added to the moving mass
SPEED = 8  # rad/s, added to the pump speed that makes flow
N_CONTRIBUTIONS = 9

# Base parameters at the head of theta; the effects' parameters follow, MAX_PARAMETERS each.
(AREA_1, AREA_2, VOL_1, VOL_2, M, B, BETA_E, C_T, D_P, K_POS, P_CHARGE, G_MAKEUP,
 P_AMBIENT) = range(13)
N_BASE = 13
MAX_PARAMETERS = 7

# Memory of an effect that remembers: so many numbers each.
MAX_MEMORY = 2

# Circuit w: constants of the drive and the sensors, neutral (0, or inf for a limit) where no
# effect adds to them.
DRIVE_GAIN = 0  # relative: omega = (1 + w) K_pos (x_d - x)
DRIVE_LAG = 1  # s, first order
SPEED_LIMIT = 2  # rad/s
SLEW_LIMIT = 3  # rad/s^2
COMMAND_DELAY = 4  # s, x_d reaches the drive late
FEEDBACK_DELAY = 5  # s, x reaches the drive late
POSITION_DELAY = 6  # s, x reaches the recording late
PRESSURE_DELAY = 7  # s, both pressures reach the recording late
POSITION_SCALE = 8  # relative error of the position sensor
IN_LOOP = 9  # 1: the drive reads the erring position sensor too; 0: only the recording does
PLAY = 10  # m, play between piston and position sensor
PRESSURE_SCALE_1 = 11  # relative
PRESSURE_SCALE_2 = 12  # relative
PRESSURE_OFFSET_1 = 13  # Pa
PRESSURE_OFFSET_2 = 14  # Pa
PRESSURE_DRIFT_1 = 15  # Pa/s since the start of the record
PRESSURE_DRIFT_2 = 16  # Pa/s
N_CIRCUIT = 17
LIMITS = (SPEED_LIMIT, SLEW_LIMIT)
