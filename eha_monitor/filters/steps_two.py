"""What stage two's kernels and its live filter do to state and covariance, compiled."""

import math

from eha_monitor.compiled import njit
from eha_monitor.filters.kernel_one import BROAD
from eha_monitor.filters.small_matrices import on_stack
from eha_monitor.filters.stage_one import UNSEEN
from eha_monitor.filters.stage_two import (
    C_PLACE,
    GAIN,
    LINE_DAMPING,
    LINE_IMPEDANCE,
    LINE_LOAD,
    MASS,
    STIFF,
    column,
    place,
)
from eha_monitor.filters.supervision import FROZEN, HELD, INFORMATION, SCORE

STIFFEST = 1e-2  # smallest compliance beta_0/beta_e: a hundred times stiffer than the prior


@njit(allocates=False)
def start_two(m, p, x, r, dt, mass):
    """(Re)start (x, v, F) at a measurement; the compliance and its variance stay.

    m : (n,) x, v, F, then parameters;  p : (n, n).
    """
    m[0], m[1], m[2] = x, 0.0, 0.0
    broad_v = BROAD * math.sqrt(r) / dt
    for i in range(3):
        for j in range(p.shape[0]):
            p[i, j] = 0.0
            p[j, i] = 0.0
    p[0, 0] = r
    p[1, 1] = broad_v * broad_v
    p[2, 2] = (mass * broad_v / dt) ** 2


@njit(allocates=False)
def restart_two(m, p, sens, x, r, dt, k):
    """(Re)start all states at a measurement, a line's too; ``k`` the lumped hydraulics."""
    start_two(m, p, x, r, dt, k[MASS])
    for i in range(m.shape[0]):
        if i != C_PLACE:
            sens[i] = 0.0
    if m.shape[0] == C_PLACE + 1:
        return
    speed = math.sqrt(p[1, 1]) * k[STIFF] / k[GAIN]
    load = k[LINE_LOAD] * math.sqrt(p[2, 2])
    for i, broad in ((4, speed), (5, load + (1.0 + k[LINE_DAMPING]) * k[LINE_IMPEDANCE] * speed)):
        m[i] = 0.0
        for j in range(m.shape[0]):
            p[i, j] = 0.0
            p[j, i] = 0.0
        p[i, i] = broad * broad


def predict_with(rows, forceinline):
    """Return the prediction for so many states beside c: their loops unroll."""
    n = rows + 1
    U0, U1, FORCE, FLOW = 3 * rows, 4 * rows, 5 * rows, 6 * rows  # where columns of a step begin

    @njit(forceinline=forceinline, allocates=False)
    def predict(m, p, sens, step, b_step, d_b, u0, u1, i0, i1, force, flow, q_f, q_u):
        """Predict state, covariance and the sensitivity to B over one sample.

        Parameters
        ----------
        m : (n,) x, v, F, c, and with a line n, dp_l;  p : (n, n) covariance;  sens : (n,) d m/d B.
        step : (7*3,) or (9*5,) transition at the present (B, c), column by column; b_step : its
            derivative to c;  d_b : its derivative to B.
        u0, u1 : drive input at the two ends; i0, i1 : its instrument there.
        force, flow : modelled extra force (N) and flow (N/Pa/s).
        q_f, q_u : variances of an unmodelled force (N^2) and of the drive input on a sample.
        """
        f, fp, made = on_stack(n, n), on_stack(n, n), on_stack(3, n)  # f: F transposed
        for i in range(rows):
            row = place(i)
            new = (step[U0 + i] * u0 + step[U1 + i] * u1 + step[FORCE + i] * force
                   + step[FLOW + i] * flow)
            slope = (b_step[U0 + i] * i0 + b_step[U1 + i] * i1 + b_step[FORCE + i] * force
                     + b_step[FLOW + i] * flow)
            from_b = d_b[U0 + i] * u0 + d_b[U1 + i] * u1
            for j in range(rows):
                value, along = m[place(j)], column(j) * rows + i
                new += step[along] * value
                slope += b_step[along] * value
                from_b += d_b[along] * value
                f[place(j), row] = step[along]
            f[C_PLACE, row] = slope
            made[0, row], made[1, row] = new, from_b
            made[2, row] = step[U0 + i] + step[U1 + i]
        # Where the slope is no larger than what the states' own uncertainty makes of it, it is
        # noise and tells nothing about c; a filter that takes it for information drifts at rest.
        noise, lean = q_u * (b_step[U0 + 2] + b_step[U1 + 2]) ** 2, 0.0
        for i in range(rows):
            along = b_step[column(i) * rows + 2]
            lean += along * p[place(i), C_PLACE]
            for j in range(rows):
                noise += along * p[place(i), place(j)] * b_step[column(j) * rows + 2]
        if f[C_PLACE, 2] ** 2 < UNSEEN * (noise - lean * lean / p[C_PLACE, C_PLACE]):
            for i in range(rows):
                f[C_PLACE, place(i)] = 0.0
        for i in range(rows):  # d m/d B goes with F, and with what B itself does
            row = place(i)
            for j in range(n):
                made[1, row] += f[j, row] * sens[j]
            for j in range(n):
                fp[row, j] = 0.0
                for k in range(n):
                    fp[row, j] += f[k, row] * p[k, j]
        for i in range(rows):
            row = place(i)
            m[row], sens[row] = made[0, row], made[1, row]
            p[row, C_PLACE] = p[C_PLACE, row] = fp[row, C_PLACE]  # c stays, and so does its row
            for j in range(i, rows):  # P = F P F' + Q
                total = (q_f * step[FORCE + i] * step[FORCE + j]
                         + q_u * made[2, row] * made[2, place(j)])
                for k in range(n):
                    total += fp[row, k] * f[k, place(j)]
                p[row, place(j)] = total
                p[place(j), row] = total

    return predict


def correct_with(rows, forceinline):
    """Return the correction for so many states beside c."""
    n = rows + 1

    @njit(forceinline=forceinline, allocates=False)
    def correct(m, p, sens, z, r, w):
        """Update with a position and its variance; the caller has gated it.

        A held c is considered and not estimated (Schmidt 1966): its gain is zero.
        """
        s = p[0, 0] + r
        nu = z - m[0]
        c, own, to_b = m[C_PLACE], p[C_PLACE, C_PLACE], sens[C_PLACE]
        h = p[0, C_PLACE] / own
        w[SCORE] += h * nu / s
        w[INFORMATION] += h * h / s
        lead, first = sens[0], on_stack(1, n)  # P's first row, by which all are changed
        for i in range(n):
            first[0, i] = p[0, i]
        for i in range(n):
            gain = first[0, i] / s
            m[i] += gain * nu
            sens[i] -= gain * lead
            for j in range(i, n):
                p[i, j] -= gain * first[0, j]
                p[j, i] = p[i, j]
        m[C_PLACE] = max(m[C_PLACE], STIFFEST)
        if w[FROZEN] == HELD:
            m[C_PLACE], p[C_PLACE, C_PLACE], sens[C_PLACE] = c, own, to_b

    return correct


# The chambers' are in every sample of every rig; written into their callers they cost no call.
predict_chambers, predict_line = predict_with(3, True), predict_with(5, False)
correct_chambers, correct_line = correct_with(3, True), correct_with(5, False)


@njit(forceinline=True, allocates=False)
def correct_two(m, p, sens, z, r, w):
    """Update with a position and its variance; the caller has gated it."""
    if m.shape[0] == C_PLACE + 1:
        correct_chambers(m, p, sens, z, r, w)
    else:
        correct_line(m, p, sens, z, r, w)


@njit
def jump_two(m, p, delta, information):
    """Move c by ``delta`` and forget, as :func:`kernel_one.jump_one`."""
    h = p[:, 3] / p[3, 3]
    grown = max(4.0 / information, p[3, 3]) - p[3, 3]
    for i in range(m.shape[0]):
        m[i] += h[i] * delta
        for j in range(m.shape[0]):
            p[i, j] += h[i] * h[j] * grown
    m[3] = max(m[3], STIFFEST)
