"""Indices of the arrays that the compiled equations share.

An effect's term reads the signals ``s`` and *adds* to the contributions ``c``; it sees nothing
else, so an entry is self-contained.
"""

# Signals s: what the equations may look at (SI units).
T, X, V, P1, P2, OMEGA, X_D = range(7)
N_SIGNALS = 7

# Contributions c: what an effect may add.
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
(AREA_1, AREA_2, VOL_1, VOL_2, M, B, BETA_E, C_T, D_P, K_POS, P_CHARGE, G_MAKEUP) = range(12)
N_BASE = 12
MAX_PARAMETERS = 4
