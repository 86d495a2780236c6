"""Exact steps against scipy's matrix exponential, derivatives against finite differences."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rig_tools import BETA, C_T, D_P, K_POS, T_S, V0, A, B, M, settings
from scipy.linalg import expm

from eha_monitor.estimation.discretisation import (
    damped_mass_integrals,
    discretise,
    discretise_at,
    hydraulics,
    matrix_phi,
)
from eha_monitor.estimation.reference_stages import Printed, printed_step
from eha_monitor.estimation.stage_one import predict_one, predict_one_euler
from eha_monitor.physics.parameters import theta_of

LEAK = C_T / V0  # C_T/2 (1/V1 + 1/V2)

# ---- integrals of the damped mass ------------------------------------------------------------


def exact_integrals(g: float) -> list[float]:
    """E_k = sum_n (-g)^n / (n + k)! in exact rational arithmetic."""
    q = Fraction(g)
    terms = 60 + int(6 * abs(g))
    power, sums = Fraction(1), [Fraction(0)] * 5
    for n in range(terms):
        for k in range(5):
            sums[k] += power / math.factorial(n + k)
        power *= -q
    return [float(total) for total in sums]


@pytest.mark.parametrize("g", [0.0, 1e-300, 1e-12, 1e-6, 1e-3, 0.03, 0.3, 0.499999, 0.5, 0.50001,
                               1.0, 3.0, 10.0, 30.0, -1e-9, -0.02, -0.4999, -0.5, -1.0, -5.0])
def test_integrals_hold_to_the_last_digits(g):
    # Beyond |g| = 1/2 the recurrence divides by g four times: a few digits are given up.
    assert damped_mass_integrals(g) == pytest.approx(exact_integrals(g), rel=2e-13 if abs(g) < 0.5
                                                     else 2e-12)


@given(st.floats(-1e3, 1e6))
def test_integrals_are_finite_and_ordered(g):
    e = damped_mass_integrals(g)
    assert np.isfinite(e).all()
    if 0 <= g < 1e5:
        assert all(value >= 0 for value in e)
        assert e[1] >= e[2] >= e[3] >= e[4]


# ---- small matrices -----------------------------------------------------------------------------


def phi_by_scipy(a):
    """exp, phi_1, phi_2 as blocks of one exponential (van Loan)."""
    big = np.zeros((9, 9))
    big[:3, :3], big[:3, 3:6], big[3:6, 6:] = a, np.eye(3), np.eye(3)
    e = expm(big)
    return e[:3, :3], e[:3, 3:6], e[:3, 6:]


def phi_of(a, rate):
    out = np.empty((3, 3, 3))
    matrix_phi(np.ascontiguousarray(a), rate, *out, np.empty((3, 3, 3)))
    return out


@given(st.lists(st.floats(-3, 3), min_size=9, max_size=9), st.floats(-12, 0.7))
def test_phi_functions_of_any_matrix(entries, decade):
    a = np.array(entries).reshape(3, 3) * 10.0**decade
    rate = np.abs(a).sum(axis=1).max()
    for mine, theirs in zip(phi_of(a, rate), phi_by_scipy(a), strict=True):
        assert mine == pytest.approx(theirs, rel=1e-9, abs=1e-10 * np.abs(theirs).max())


def test_phi_functions_of_nothing():
    zero, one, two = phi_of(np.zeros((3, 3)), 0.0)
    assert zero == pytest.approx(np.eye(3)) and one == pytest.approx(np.eye(3))
    assert two == pytest.approx(np.eye(3) / 2)


# ---- stage two's step --------------------------------------------------------------------------


def constants(loop=True, beta_0=5e8, extra=0.0, line=(0.0, 0.0, 0.0), **rig):
    theta, _ = theta_of(settings(rig=rig).rig, {})
    return hydraulics(theta, beta_0, extra, loop, line)


def step_by_scipy(loop, b, beta, leak, dt, mass=M, two_s=2 * A**2 / V0, gain=2 * A * D_P / V0):
    """[Phi | G0 | G1 | Gf | Gq]: states, then input with slope, force, rate of force per beta."""
    n = np.zeros((8, 8))  # x, v, F, u, slope, f, q, (spare)
    k = K_POS if loop else 0.0
    n[0, 1] = 1
    n[1, 1], n[1, 2], n[1, 5] = -b / mass, 1 / mass, -1 / mass
    n[2, :3] = -beta * gain * k, -beta * two_s, -beta * leak
    n[2, 3], n[2, 6] = beta * gain * (k if loop else 1.0), beta
    n[3, 4] = 1
    e = expm(n * dt)
    g1 = e[:3, 4] / dt  # response to a ramp that ends at one
    return np.column_stack([e[:3, :3], e[:3, 3] - g1, g1, e[:3, 5], e[:3, 6]])


def discretised(k, b, c, leak, dt):
    out = np.empty((3, 7))
    discretise_at(k, b, c, leak, dt, np.empty((10, 3, 3)), out)
    return out


def relative_columns(mine, theirs):
    """Largest error of each entry over the largest entry of its row and kind of unit."""
    units = np.array([1.0, 1 / 30.0, 1 / (M * 1e4)])  # m, m/s, N of comparable size
    scale_rows = units[:, None]
    mine, theirs = mine * scale_rows, theirs * scale_rows
    return np.abs(mine - theirs).max(axis=0) / (np.abs(theirs).max(axis=0) + 1e-300)


@pytest.mark.parametrize("loop", [True, False])
@pytest.mark.parametrize("b", [-50.0, 0.0, 300.0, 600.0, 1800.0, 1e5])
@pytest.mark.parametrize("beta", [6e6, 6e7, 6e8, 2e9, 5e11])
@pytest.mark.parametrize("dt", [1e-4, 1e-3, 5e-3])
def test_step_of_stage_two_is_the_exponential_of_its_system(loop, b, beta, dt):
    mine = discretised(constants(loop), b, 5e8 / beta, LEAK, dt)
    theirs = step_by_scipy(loop, b, beta, LEAK, dt)
    assert relative_columns(mine, theirs).max() < 1e-7


def test_two_area_hydraulics_are_the_sum_of_both_chambers():
    a1, a2, v1, v2 = 1.96e-3, 1.65e-3, 3e-4, 1e-4
    k = constants(area_1=a1, area_2=a2, volume_1=v1, volume_2=v2)
    two_s = a1**2 / v1 + a2**2 / v2
    leak = C_T / 2 * (1 / v1 + 1 / v2)
    # The pump gives D_p omega to chamber 1 and takes D_p omega A2/A1 from chamber 2.
    gain = D_P * (a1 / v1 + a2 / v2 * a2 / a1)
    mine = discretised(k, B, 5e8 / BETA, leak, T_S)
    theirs = step_by_scipy(True, B, BETA, leak, T_S, two_s=two_s, gain=gain)
    assert relative_columns(mine, theirs).max() < 1e-8


@pytest.mark.parametrize("loop", [True, False])
@pytest.mark.parametrize("time", [1e-5, 1e-3, 0.1])
def test_step_with_a_line_is_the_exponential_of_both_together(loop, time):
    a1, a2, v1, v2, zeta, impedance = 1.96e-3, 1.65e-3, 3e-4, 2e-4, 0.05, 1.2e4
    k = constants(loop, line=(time, zeta, impedance), area_1=a1, area_2=a2, volume_1=v1,
                  volume_2=v2)
    n = np.zeros((9, 9))  # x, v, F, n, dp_l, input, its slope, force, rate of force per beta
    n[0, 1] = n[5, 6] = 1
    n[1, 1], n[1, 2], n[1, 7] = -B / M, 1 / M, -1 / M
    two_s = a1**2 / v1 + a2**2 / v2
    n[2, 1:4] = BETA * np.array([-two_s, -LEAK, two_s / a1 * D_P])
    n[2, 8] = BETA
    n[3, 2:5] = np.array([-2 / (a1 + a2), -2 * zeta * impedance, 1.0]) / (impedance * time)
    n[4, 3], n[4, 5] = -impedance / time, impedance / time * (K_POS if loop else 1.0)
    n[4, 0] = -impedance / time * (K_POS if loop else 0.0)
    e = expm(n * T_S)
    g1 = e[:5, 6] / T_S
    theirs = np.column_stack([e[:5, :3], e[:5, 5] - g1, g1, e[:5, 7:], e[:5, 3:5]])
    mine = np.empty((5, 9))
    discretise_at(k, B, 5e8 / BETA, LEAK, T_S, np.empty((10, 5, 5)), mine)
    rows = np.array([1.0, 1 / 30.0, 1 / (M * 1e4), 1e-3, 1e-7])[:, None]
    mine, theirs = mine * rows, theirs * rows
    assert (np.abs(mine - theirs).max(axis=0) < 1e-7 * np.abs(theirs).max(axis=0)).all()


def test_air_in_the_model_softens_the_step():
    extra = 1e-9  # 1/Pa
    mine = discretised(constants(extra=extra), B, 5e8 / BETA, LEAK, T_S)
    theirs = step_by_scipy(True, B, 1 / (1 / BETA + extra), LEAK, T_S)
    assert relative_columns(mine, theirs).max() < 1e-8


@pytest.mark.parametrize("loop", [True, False])
@pytest.mark.parametrize("b, beta, dt", [(600.0, 6e8, 1e-3), (0.0, 6e8, 1e-3), (1800.0, 6e7, 1e-3),
                                         (300.0, 2e9, 5e-4), (600.0, 6e8, 4e-3)])
def test_derivatives_of_the_step(loop, b, beta, dt):
    k, c = constants(loop), 5e8 / beta
    made = np.empty((5, 3, 7))
    discretise(k, b, c, LEAK, dt, np.empty((10, 3, 3)), made)
    step, d_c, d_cc, d_b, d_leak = made
    assert np.array_equal(step, discretised(k, b, c, LEAK, dt))

    def at(db=0.0, dc=0.0, dl=0.0):
        return step_by_scipy(loop, b + db, 5e8 / (c + dc), LEAK + dl, dt)

    def first(h, **key):  # fourth order, on scipy's own step
        name = next(iter(key))
        near = at(**{name: h}) - at(**{name: -h})
        far = at(**{name: 2 * h}) - at(**{name: -2 * h})
        return (8 * near - far) / (12 * h)

    assert relative_columns(d_c, first(2e-3 * c, dc=0)).max() < 1e-4
    assert relative_columns(d_b, first(2e-3 * M / dt, db=0))[[0, 1, 2, 3, 4, 5]].max() < 1e-4
    h = 1e-3 * LEAK + 1e-3 / (beta * dt)
    assert relative_columns(d_leak, first(h, dl=0)).max() < 1e-4
    h = 1e-2 * c
    second = (at(dc=h) - 2 * at() + at(dc=-h)) / h**2
    assert relative_columns(d_cc, second).max() < 2e-2


# ---- stage one's step ------------------------------------------------------------------------


def first_order_hold(b, mass, dt):
    n = np.zeros((4, 4))
    n[0, 1], n[1, 1], n[1, 2], n[2, 3] = 1, -b / mass, 1 / mass, 1
    return expm(n * dt)


@given(x=st.floats(-0.1, 0.1), v=st.floats(-1, 1), b=st.floats(-100, 1e6),
       u0=st.floats(-1e4, 1e4), u1=st.floats(-1e4, 1e4),
       dt=st.sampled_from([1e-5, 1e-3, 0.02]), mass=st.sampled_from([1e-4, 1.0, 95.0, 1e4]))
def test_step_of_stage_one_is_exact_for_a_linear_force(x, v, b, u0, u1, dt, mass):
    if b * dt / mass < -5 or b * dt / mass > 1e4:
        return
    x1, v1, f_xv, _, f_vv, _, g_x, g_v = predict_one(x, v, b, u0, u1, dt, mass)
    e = first_order_hold(b, mass, dt)
    exact = e @ np.array([x, v, u0, (u1 - u0) / dt])
    speed = abs(v) + (abs(u0) + abs(u1)) * dt / mass
    assert x1 == pytest.approx(exact[0], rel=1e-8, abs=1e-9 * speed * dt + 1e-15)
    assert v1 == pytest.approx(exact[1], rel=1e-8, abs=1e-9 * speed + 1e-15)
    assert (f_xv, f_vv) == pytest.approx((e[0, 1], e[1, 1]), rel=1e-9, abs=1e-12)
    assert (g_x, g_v) == pytest.approx((e[0, 2], e[1, 2]), rel=1e-7, abs=1e-14)


@pytest.mark.parametrize("b, dt", [(600.0, 1e-3), (0.0, 1e-3), (-20.0, 1e-3), (600.0, 0.05),
                                   (2e4, 1e-3), (1e6, 1e-3)])
def test_jacobian_of_stage_one(b, dt):
    x, v, u0, u1 = 0.01, 0.07, 40.0, -25.0
    h = 1e-3 * (abs(b) + M / dt)
    e = [predict_one(x, v, b + s * h, u0, u1, dt, M)[:2] for s in (-2, -1, 1, 2)]
    d_x, d_v = ((8 * (e[2][i] - e[1][i]) - (e[3][i] - e[0][i])) / (12 * h) for i in (0, 1))
    _, _, f_xv, f_xb, f_vv, f_vb, _, _ = predict_one(x, v, b, u0, u1, dt, M)
    assert f_xb == pytest.approx(d_x, rel=1e-6)
    assert f_vb == pytest.approx(d_v, rel=1e-6)
    ahead, behind = (predict_one(x, v + s, b, u0, u1, dt, M)[:2] for s in (0.1, -0.1))
    assert (f_xv, f_vv) == pytest.approx(((ahead[0] - behind[0]) / 0.2,
                                          (ahead[1] - behind[1]) / 0.2), rel=1e-9)


def test_printed_equation_4():
    x1, v1, f_xv, f_xb, f_vv, f_vb, _, _ = predict_one_euler(0.01, 0.04, 600.0, 31.0, T_S, M)
    assert x1 == pytest.approx(0.01 + T_S * 0.04)
    assert v1 == pytest.approx(0.04 + T_S * (31.0 - 600.0 * 0.04) / M)
    assert (f_xv, f_xb, f_vv, f_vb) == pytest.approx(
        (T_S, 0.0, 1 - T_S * 600.0 / M, -T_S * 0.04 / M))


# ---- Eq. 5 as printed ---------------------------------------------------------------------------


def printed(beta, state=(0.002, 0.1, -3.0), u=0.005, b=B):
    theta, _ = theta_of(settings().rig, {})
    m, f = np.array([*state, beta]), np.empty((4, 4))
    printed_step(m, b, u, Printed.of(theta, M, T_S), f)
    return m, f


@pytest.mark.parametrize("beta, largest, error", [(6e8, 1.094, 5e-4), (3e8, 1.043, 5e-4),
                                                  (8e8, 1.127, 5e-4), (6e7, 0.9997, 5e-5)])
def test_printed_step_is_as_unstable_as_the_check_of_the_paper_found(beta, largest, error):
    poles = np.linalg.eigvals(printed(beta)[1][:3, :3])
    assert np.abs(poles).max() == pytest.approx(largest, abs=error)


def test_exact_step_is_stable_where_the_printed_one_is_not():
    for beta in (6e7, 3e8, 6e8, 8e8):
        step = discretised(constants(), B, 5e8 / beta, LEAK, T_S)
        assert np.abs(np.linalg.eigvals(step[:, :3])).max() < 1.0


def test_printed_step_is_equation_5_and_its_jacobian():
    state, u, beta = (0.002, 0.1, -3.0), 0.005, 4.2e8
    m, f = printed(beta, state, u)
    x, v, a = state
    jerk = (-(B / M + C_T * beta / V0) * a - 2 * beta * A**2 / (M * V0) * v
            + 2 * D_P * beta * A * K_POS / (M * V0) * (u - x))
    assert m == pytest.approx([x + T_S * v, v + T_S * a, a + T_S * jerk, beta], rel=1e-12)
    for j, h in enumerate((1e-4, 1e-3, 1e-2, 1e5)):
        side = []
        for sign in (1, -1):
            moved = np.array([*state, beta])
            moved[j] += sign * h
            side.append(printed(moved[3], tuple(moved[:3]), u)[0])
        assert f[:, j] == pytest.approx((side[0] - side[1]) / (2 * h), rel=1e-6, abs=1e-12)
