"""The concealed plant: two oil chambers, LuGre seals, pump, drive; integrated finely.

Nothing here is taken from the models that the diagnosis fits.  Differences in detail that are
meant: chamber pressures with make-up flow, bristle seals in place of smoothed signs, a mixture
law for air, a laminar start of every orifice, a line with a volume at the pump.

Dry friction is LuGre's (Canudas de Wit et al. 1995): F = s0 z + s1 z', z' = v - s0 |v| z/g.
"""

import math

import numpy as np

from eha_monitor.compiled import njit

# The plant's constants, by their place in a vector; each is zero where an effect is absent.
(
    # the paper's rig
    AREA, VOLUME, MASS, DAMPING, BULK_MODULUS, LEAKAGE, MAKEUP, CHARGE_PRESSURE, DISPLACEMENT,
    POSITION_GAIN,
    # seals: level and travel of the first bristle, then of a second, softer one
    SEAL_FORWARD, SEAL_BACKWARD, SEAL_STATIC, STRIBECK_SPEED, SEAL_PER_PRESSURE, SEAL_TRAVEL,
    SOFT_SEAL, SOFT_TRAVEL,
    # load
    DAMPING_ASYMMETRY, QUADRATIC, CONSTANT_LOAD, STIFFNESS, CONTACT, CONTACT_PLACE, PLAY,
    PLAY_IN_LOOP,
    # leakage and valves
    TURBULENT, LEAKAGE_OFFSET, EXTERNAL_LEAKAGE_1, EXTERNAL_LEAKAGE_2, TANK, RELIEF_GAIN,
    RELIEF_PRESSURE, CHECK_GAIN, CHECK_PRESSURE,
    # oil and chambers
    AIR_FRACTION, AIR_EXPONENT, VOLUME_SLOPE,
    # pump and line
    DEAD_ZONE, PUMP_GAIN, PUMP_LOSS, LINE_INERTANCE, LINE_RESISTANCE, LINE_VOLUME,
    # drive; of a digital one the integration steps in which it holds a command
    DRIVE_LAG, SPEED_LIMIT, FEEDBACK_DELAY, HELD_STEPS,
    # outside the catalogue of the diagnosis
    HUMP_FORCE, HUMP_PLACE, HUMP_WIDTH, STICK_FORCE, STICK_PLACE, STICK_WIDTH, STICKY_GAIN,
    STICKY_OPEN, STICKY_CLOSE, RIPPLE, RIPPLE_ORDER, GAPPED_MASS, GAPPED_PLAY, PLACE_LEAK,
    PLACE_LEAK_PLACE, PLACE_LEAK_WIDTH, LEVER_LOAD, LEVER_LENGTH, CUSHION, CUSHION_PLACE,
    WIDENING_GAP,
) = range(69)
NAMES = tuple(name.lower() for name in list(globals()) if name.isupper())  # those so far
N_CONSTANTS = len(NAMES)

# Columns of the fine trajectory.
X, X_SENSED, V, P1, P2, OMEGA = range(6)
N_COLUMNS = 6

ATMOSPHERE = 1.01325e5  # Pa
CAVITATION = 5e4  # Pa; no motion of the trial is meant to come near it
LAMINAR = 5e3  # Pa, below which an orifice flows like a capillary
MICRO_DAMPING = 0.6  # s1 in units of sqrt(s0 M)
MICRO_SPEED = 5e-3  # m/s, above which the micro damping fades: keeps the seal passive
STICK_SPEED = 0.03  # m/s, speed over which a sticking place lets go
CONTACT_STIFFNESS, CONTACT_LOSS = 2e6, 20.0  # N/m, s/m of the gapped load (Hunt, Crossley)
GAPPED_DAMPING = 150.0  # N s/m of the gapped load's own guide
GAPPED_FILM = 400.0  # N s/m between piston and gapped load: without it the bouncing is chaotic

# State: piston, chambers, drive, line, shaft angle, gapped load, then discrete memory.
SX, SV, SP1, SP2, SW, SLP, SLQ, SANGLE, SXL, SVL = range(10)
N_STATES = 10
BRISTLE, SOFT_BRISTLE, PLAYED, VALVE = range(4)
N_MEMORY = 4


@njit
def _bump(x, place, width):
    return math.exp(-(((x - place) / width) ** 2))


@njit
def seal_level(x, v, p1, p2, c):
    """Return g, the sliding friction of the seals in N, for the direction of ``v``."""
    level = c[SEAL_FORWARD] if v >= 0.0 else c[SEAL_BACKWARD]
    level += c[SEAL_PER_PRESSURE] * (p1 + p2)
    if c[SEAL_STATIC] > 0.0:
        level += c[SEAL_STATIC] * math.exp(-((v / c[STRIBECK_SPEED]) ** 2))
    if c[HUMP_FORCE] > 0.0:
        level += c[HUMP_FORCE] * _bump(x, c[HUMP_PLACE], c[HUMP_WIDTH])
    if c[STICK_FORCE] > 0.0:
        level += (c[STICK_FORCE] * _bump(x, c[STICK_PLACE], c[STICK_WIDTH])
                  * math.exp(-((v / STICK_SPEED) ** 2)))
    return max(level, 1e-9)


@njit
def bristle_stiffness(c):
    """Return s0 in N/m: the level at rest over the travel of the bristles."""
    level = (max(c[SEAL_FORWARD], c[SEAL_BACKWARD]) + c[SEAL_STATIC] + c[HUMP_FORCE]
             + c[STICK_FORCE] + 2.0 * c[SEAL_PER_PRESSURE] * c[CHARGE_PRESSURE])
    return level / c[SEAL_TRAVEL]


@njit
def _bend(z, v, level, stiffness, dt):
    """Carry a bristle over ``dt`` exactly at constant speed."""
    if stiffness == 0.0 or v == 0.0:
        return z
    rate = stiffness * abs(v) / level
    sliding = math.copysign(level / stiffness, v)
    return sliding + (z - sliding) * math.exp(-rate * dt)


@njit
def _bristle_force(z, v, level, stiffness, mass):
    if stiffness == 0.0:
        return 0.0
    damping = MICRO_DAMPING * math.sqrt(stiffness * mass) * math.exp(-((v / MICRO_SPEED) ** 2))
    return stiffness * z + damping * (v - stiffness * abs(v) * z / level)


@njit
def _compliance(p, c):
    """Return the mixture's -(dV/dp)/V in 1/Pa: liquid and polytropic air, both at ``p``."""
    if p < CAVITATION:  # vapour: no chamber is drawn below it
        return 1.0 / c[BULK_MODULUS] + 1e-6 * (CAVITATION - p) / CAVITATION
    if c[AIR_FRACTION] == 0.0:
        return 1.0 / c[BULK_MODULUS]
    air = c[AIR_FRACTION] * (ATMOSPHERE / p) ** (1.0 / c[AIR_EXPONENT])
    liquid = 1.0 - c[AIR_FRACTION]
    return (liquid / c[BULK_MODULUS] + air / (c[AIR_EXPONENT] * p)) / (liquid + air)


@njit
def _leak(x, dp, c):
    """Return the flow from chamber 1 to chamber 2 in m^3/s."""
    flow = 0.5 * (c[LEAKAGE] - c[MAKEUP]) * dp
    if c[TURBULENT] != 0.0:
        flow += c[TURBULENT] * dp / (dp * dp + LAMINAR * LAMINAR) ** 0.25
    if c[LEAKAGE_OFFSET] != 0.0:
        flow += c[LEAKAGE_OFFSET] * dp / math.sqrt(dp * dp + LAMINAR * LAMINAR)
    if c[RELIEF_GAIN] > 0.0 and abs(dp) > c[RELIEF_PRESSURE]:
        flow += c[RELIEF_GAIN] * (dp - math.copysign(c[RELIEF_PRESSURE], dp))
    if c[PLACE_LEAK] != 0.0:
        flow += c[PLACE_LEAK] * _bump(x, c[PLACE_LEAK_PLACE], c[PLACE_LEAK_WIDTH]) * dp
    if c[WIDENING_GAP] != 0.0:  # a gap that its own pressure opens lets through its cube
        flow += c[WIDENING_GAP] * dp * dp * dp
    return flow


@njit
def _pumped(w, dp, angle, c):
    """Return what the pump delivers into chamber 1 in m^3/s."""
    if c[DEAD_ZONE] > 0.0:
        w = math.copysign(max(abs(w) - c[DEAD_ZONE], 0.0), w)
    flow = w * (1.0 + c[PUMP_GAIN]) - c[PUMP_LOSS] * abs(w) * dp
    if c[RIPPLE] != 0.0:
        phase = c[RIPPLE_ORDER] * angle
        flow *= 1.0 + c[RIPPLE] * (math.cos(phase) + 0.4 * math.cos(2.0 * phase))
    return c[DISPLACEMENT] * flow


@njit
def _played(sensed, x, c):
    half = 0.5 * c[PLAY]
    return min(max(sensed, x - half), x + half)


@njit
def _command(x_d, x_read, c):
    w = c[POSITION_GAIN] * (x_d - x_read)
    if c[SPEED_LIMIT] > 0.0:
        w = min(max(w, -c[SPEED_LIMIT]), c[SPEED_LIMIT])
    return w


@njit
def _own_flow(p, leakage, open_, c):
    """Return what one chamber gains from the charge line and loses to the outside."""
    flow = c[MAKEUP] * (c[CHARGE_PRESSURE] - p)
    flow -= leakage * (p - c[TANK])
    if c[CHECK_GAIN] > 0.0 and p < c[CHECK_PRESSURE]:
        flow += c[CHECK_GAIN] * (c[CHECK_PRESSURE] - p)
    if open_ > 0.5:
        flow += c[STICKY_GAIN] * (c[CHARGE_PRESSURE] - p)
    return flow


@njit
def _derivatives(y, memory, w_command, c, dy):
    x, v, p1, p2 = y[SX], y[SV], y[SP1], y[SP2]
    dp = p1 - p2
    w = y[SW] if c[DRIVE_LAG] > 0.0 else w_command
    dy[SW] = (w_command - y[SW]) / c[DRIVE_LAG] if c[DRIVE_LAG] > 0.0 else 0.0

    resisting = c[DAMPING] * v + c[QUADRATIC] * v * abs(v) + c[CONSTANT_LOAD] + c[STIFFNESS] * x
    if c[CONTACT] > 0.0 and x > c[CONTACT_PLACE]:
        resisting += c[CONTACT] * (x - c[CONTACT_PLACE])
    if c[LEVER_LOAD] != 0.0:
        resisting += c[LEVER_LOAD] * math.sin(2.0 * math.pi * x / c[LEVER_LENGTH])
    if c[CUSHION] != 0.0:
        resisting += c[CUSHION] * max(abs(x) - c[CUSHION_PLACE], 0.0) * v
    resisting += c[DAMPING_ASYMMETRY] * abs(v)
    stiffness = bristle_stiffness(c)
    if stiffness > 0.0:
        resisting += _bristle_force(memory[BRISTLE], v, seal_level(x, v, p1, p2, c), stiffness,
                                    c[MASS])
    if c[SOFT_SEAL] > 0.0:
        resisting += _bristle_force(memory[SOFT_BRISTLE], v, c[SOFT_SEAL],
                                    c[SOFT_SEAL] / c[SOFT_TRAVEL], c[MASS])
    if c[GAPPED_MASS] > 0.0:
        apart = x - y[SXL]
        beyond = abs(apart) - 0.5 * c[GAPPED_PLAY]
        contact = 0.0
        if beyond > 0.0:
            closing = math.copysign(v - y[SVL], apart * (v - y[SVL]))
            contact = math.copysign(
                CONTACT_STIFFNESS * beyond * max(1.0 + CONTACT_LOSS * closing, 0.0), apart)
        contact += GAPPED_FILM * (v - y[SVL])
        resisting += contact
        dy[SXL] = y[SVL]
        dy[SVL] = (contact - GAPPED_DAMPING * y[SVL]) / c[GAPPED_MASS]
    else:
        dy[SXL] = dy[SVL] = 0.0
    dy[SX] = v
    dy[SV] = (c[AREA] * dp - resisting) / c[MASS]

    dy[SANGLE] = w
    if c[LINE_INERTANCE] > 0.0:
        supply = y[SLQ]
        dy[SLQ] = (y[SLP] - dp - c[LINE_RESISTANCE] * y[SLQ]) / c[LINE_INERTANCE]
        dy[SLP] = ((_pumped(w, y[SLP], y[SANGLE], c) - y[SLQ])
                   * 2.0 * c[BULK_MODULUS] / c[LINE_VOLUME])
    else:
        supply = _pumped(w, dp, y[SANGLE], c)
        dy[SLQ] = dy[SLP] = 0.0
    net = supply - c[AREA] * v - _leak(x, dp, c)
    swept = c[VOLUME_SLOPE] * x
    dy[SP1] = ((net + _own_flow(p1, c[EXTERNAL_LEAKAGE_1], memory[VALVE], c))
               / ((c[VOLUME] + swept) * _compliance(p1, c)))
    dy[SP2] = ((-net + _own_flow(p2, c[EXTERNAL_LEAKAGE_2], 0.0, c))
               / ((c[VOLUME] - swept) * _compliance(p2, c)))


@njit
def _read_position(i, ahead, y, x, memory, h, c, out):
    """Return the position that the controller reads ``ahead`` steps after step ``i``."""
    if c[FEEDBACK_DELAY] > 0.0:
        at = i + ahead - c[FEEDBACK_DELAY] / h
        if at <= 0.0:
            return out[0, 0]
        if at >= i:
            return y[SX] + (at - i) * h * y[SV]
        j = int(at)
        before = out[j, 0]
        after = out[j + 1, 0] if j + 1 < i else y[SX]
        return before + (at - j) * (after - before)
    if c[PLAY_IN_LOOP] > 0.5:
        return _played(memory[PLAYED], x, c)
    return x


@njit
def _bend_all(memory, y, c, dt):
    v = y[SV]
    stiffness = bristle_stiffness(c)
    if stiffness > 0.0:
        memory[BRISTLE] = _bend(memory[BRISTLE], v, seal_level(y[SX], v, y[SP1], y[SP2], c),
                                stiffness, dt)
    if c[SOFT_SEAL] > 0.0:
        memory[SOFT_BRISTLE] = _bend(memory[SOFT_BRISTLE], v, c[SOFT_SEAL],
                                     c[SOFT_SEAL] / c[SOFT_TRAVEL], dt)


@njit
def run(c, x_d, h, read, out):
    """Integrate from rest; the bristles are split off and carried exactly (Strang).

    Parameters
    ----------
    c : (N_CONSTANTS,) SI constants of the plant.
    x_d : (2 n - 1,) demanded position at each half step, m.
    h : step, s.
    read : (n,) m, what a digital controller reads beyond the position.
    out : (n, N_COLUMNS) written: x, sensed x, v, p1, p2, shaft speed at each step.
    """
    n = out.shape[0]
    y, stage = np.zeros(N_STATES), np.zeros(N_STATES)
    memory = np.zeros(N_MEMORY)
    k = np.zeros((4, N_STATES))
    y[SX] = x_d[0]
    y[SP1] = y[SP2] = c[CHARGE_PRESSURE]
    y[SXL] = memory[PLAYED] = x_d[0]
    now, digital = 0.0, c[HELD_STEPS] > 0.0
    for i in range(n):
        memory[PLAYED] = _played(memory[PLAYED], y[SX], c)
        out[i, 0] = y[SX]  # first: a delayed controller reads it
        if not digital or i % c[HELD_STEPS] == 0.0:
            now = _command(
                x_d[2 * i], _read_position(i, 0.0, y, y[SX], memory, h, c, out) + read[i], c)
        out[i, 1] = memory[PLAYED]
        out[i, 2] = y[SV]
        out[i, 3] = y[SP1]
        out[i, 4] = y[SP2]
        out[i, 5] = y[SW] if c[DRIVE_LAG] > 0.0 else now
        if i == n - 1:
            break
        if c[STICKY_GAIN] > 0.0:
            if y[SP1] < c[STICKY_OPEN]:
                memory[VALVE] = 1.0
            elif y[SP1] > c[STICKY_CLOSE]:
                memory[VALVE] = 0.0
        _bend_all(memory, y, c, 0.5 * h)
        _derivatives(y, memory, now, c, k[0])
        for s in range(1, 4):
            ahead = 1.0 if s == 3 else 0.5
            for j in range(N_STATES):
                stage[j] = y[j] + ahead * h * k[s - 1, j]
            w = now
            if not digital:
                sensed = _read_position(i, ahead, y, stage[SX], memory, h, c, out)
                w = _command(x_d[2 * i + (2 if s == 3 else 1)], sensed, c)
            _derivatives(stage, memory, w, c, k[s])
        for j in range(N_STATES):
            y[j] += h / 6.0 * (k[0, j] + 2.0 * k[1, j] + 2.0 * k[2, j] + k[3, j])
        _bend_all(memory, y, c, 0.5 * h)
