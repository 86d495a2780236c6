"""The plant against closed forms that are written here a second time."""

import numpy as np
import pytest
from rig_tools import (
    BETA,
    C_T,
    D_P,
    K_POS,
    MULTISINE,
    SINE,
    T_S,
    TRIANGLE,
    V0,
    A,
    B,
    M,
    linear_response,
    settings,
    simulated,
)
from scipy.integrate import simpson
from scipy.linalg import expm

from eha_monitor.errors import InputError
from eha_monitor.physics import signals as s
from eha_monitor.physics.balances import rates
from eha_monitor.physics.parameters import require_plant, theta_of
from eha_monitor.physics.simulator import Simulator

CHARGE, MAKEUP = 2e6, 1e-13
NOTHING = np.zeros(s.N_CONTRIBUTIONS)


@pytest.mark.parametrize("b, beta", [(600.0, 6e8), (300.0, 6e8), (1800.0, 6e8), (600.0, 6e7),
                                     (600.0, 8e8)])
def test_triangle_is_the_matrix_exponential_of_the_linear_loop(b, beta):
    truth = simulated(TRIANGLE, 2.5, rig={"viscous_damping": b, "bulk_modulus": beta}).truth
    exact = linear_response(truth[:, s.X_D], T_S, b, beta)
    dp = truth[:, s.P1] - truth[:, s.P2]
    assert np.abs(truth[:, s.X] - exact[:, 0]).max() < 1e-9
    assert np.abs(truth[:, s.V] - exact[:, 1]).max() < 1e-6
    assert np.abs(dp - exact[:, 2]).max() < 1e-4 * np.abs(exact[:, 2]).max()
    # Symmetric rig: the mean pressure stays at the charge pressure.
    assert np.abs(truth[:, s.P1] + truth[:, s.P2] - 2 * CHARGE).max() < 1e-3
    assert truth[:, s.OMEGA] == pytest.approx(K_POS * (truth[:, s.X_D] - truth[:, s.X]))


def test_integrator_is_of_fourth_order():
    errors = []
    exact = None
    for substeps in (1, 2, 4, 8):
        truth = simulated(TRIANGLE, 0.9, substeps=substeps).truth
        if exact is None:
            exact = linear_response(truth[:, s.X_D], T_S)
        errors.append(np.abs(truth[:, s.V] - exact[:, 1]).max())
    ratios = np.array(errors[:-1]) / errors[1:]
    assert (ratios[:2] > 13).all() and (ratios < 19).all(), ratios


def test_mean_pressure_decays_to_the_charge_pressure_as_one_exponential():
    config = settings(simulation={"excitation": {"rest": {"kind": "rest"}}},
                      rig={"makeup_conductance": 4e-13, "leakage": 5e-13})
    simulator = Simulator(config)
    simulator.y[[2, 3]] += 3e5  # both pressures
    truth = simulator.advance_truth(400)
    time = np.arange(400) * T_S
    expected = CHARGE + 3e5 * np.exp(-4e-13 * BETA / V0 * time)
    assert truth[:, s.P1] == pytest.approx(expected, rel=1e-9)
    assert np.abs(truth[:, [s.X, s.V]]).max() < 1e-15


@pytest.mark.parametrize("speed", [0.5, 8.0, 60.0])
@pytest.mark.parametrize("valve", ["anti_cavitation", "relief_valve"])
def test_a_stiff_valve_settles_as_one_exponential(valve, speed):
    """However short its time is beside an integration step; ``speed`` is step over time."""
    check = valve == "anti_cavitation"
    k = speed * V0 / (BETA * T_S * (1.0 if check else 2.0))
    effect = {"k": k, "p_min": 2.5e6} if check else {"k": k, "p_c": 2e6}
    simulator = Simulator(settings(
        simulation={"excitation": {"rest": {"kind": "rest"}}, "substeps": 1},
        rig={"mass": 1e12, "leakage": 0.0, "makeup_conductance": 0.0}, effects={valve: effect}))
    simulator.y[[2, 3]] = (2.4e6, 2.3e6) if check else (4.4e6, 2e6)
    truth = simulator.advance_truth(12)
    left = np.exp(-speed * np.arange(12))
    if check:
        assert truth[:, s.P1] == pytest.approx(2.5e6 - 1e5 * left, abs=300.0)
        assert truth[:, s.P2] == pytest.approx(2.5e6 - 2e5 * left, abs=600.0)
    else:
        assert truth[:, s.P1] - truth[:, s.P2] == pytest.approx(2e6 + 4e5 * left, abs=1200.0)
        assert truth[:, s.P1] + truth[:, s.P2] == pytest.approx(6.4e6, rel=1e-12)


def test_pressure_difference_leaks_away_with_half_the_leakage_coefficient():
    # V/(2 beta) dp' = -(C_T/2) dp while the piston is held (an immense mass, no drive).
    theta, _ = theta_of(settings(rig={"mass": 1e12}).rig, {})
    dv, dp1, dp2 = rates(0.0, CHARGE + 4e5, CHARGE - 1e5, 0.0, 0.0, theta, NOTHING)
    assert dp1 - dp2 == pytest.approx(-2 * BETA / V0 * C_T / 2 * 5e5, rel=1e-12)
    assert dv == pytest.approx(A * 5e5 / 1e12, rel=1e-12)


def test_steady_triangle_holds_the_paper_plateau():
    truth = simulated(TRIANGLE, 8.0).truth
    dp = truth[:, s.P1] - truth[:, s.P2]
    for start, sign in ((2600, -1), (4600, 1), (6600, -1)):  # 1.6 s and more after a reversal
        part = slice(start, start + 300)
        assert truth[part, s.V] == pytest.approx(sign * 0.04, rel=1e-3)
        assert dp[part] == pytest.approx(sign * B * 0.04 / A, rel=1e-3)
        # D_p omega = A v + C_T/2 dp: the position error that carries the speed.
        lag = (A * 0.04 + C_T / 2 * B * 0.04 / A) / (D_P * K_POS)
        error = truth[part, s.X_D] - truth[part, s.X]
        assert error == pytest.approx(sign * lag, rel=1e-3)


def test_energy_and_oil_are_conserved():
    truth = simulated(SINE, 1.0, rig={"sample_time": 1e-4}, substeps=4).truth
    v, p1, p2, omega = (truth[:, i] for i in (s.V, s.P1, s.P2, s.OMEGA))
    dp, dt = p1 - p2, 1e-4
    across = (C_T - MAKEUP) / 2 * dp
    stored = 0.5 * M * v**2 + V0 / (2 * BETA) * (p1**2 + p2**2)
    power = (D_P * omega * dp - B * v**2 - across * dp
             - MAKEUP * (p1 * (p1 - CHARGE) + p2 * (p2 - CHARGE)))
    gained = simpson(power, dx=dt)
    assert stored[-1] - stored[0] == pytest.approx(gained, abs=1e-6 * np.abs(power).max())
    # Oil of chamber 1: what compresses is what the pump gave less what the piston made room for.
    inflow = D_P * omega - A * v - across - MAKEUP * (p1 - CHARGE)
    assert V0 / BETA * (p1[-1] - p1[0]) == pytest.approx(simpson(inflow, dx=dt), abs=1e-12)


def test_two_area_rig_stays_at_rest():
    rig = {"area_1": 1.963495e-3, "area_2": 1.649336e-3, "volume_1": 3e-4, "volume_2": 1e-4,
           "makeup_conductance": 0.0}
    rest = {"kind": "rest", "offset": 0.01}
    tight = simulated(rest, 1.0, rig={**rig, "leakage": 0.0}).truth
    assert np.abs(tight[:, s.X] - 0.01).max() < 1e-12
    assert np.abs(tight[:, s.V]).max() < 1e-9
    assert tight[-1, s.P2] == pytest.approx(2e6 * rig["area_1"] / rig["area_2"], rel=1e-9)
    # With leakage the smaller chamber's higher pressure feeds the other one, and the drive
    # holds against it with a position error of D_p K_pos e = C_T/2 (p2 - p1), and a little more
    # while both pressures still fall.
    leaky = simulated(rest, 3.0, rig=rig).truth
    error = C_T / 2 * (leaky[-1, s.P2] - leaky[-1, s.P1]) / (D_P * K_POS)
    assert leaky[-1, s.X] - 0.01 == pytest.approx(error, rel=0.25)
    assert np.abs(leaky[-500:, s.V]).max() < 1e-6
    force = rig["area_1"] * leaky[:, s.P1] - rig["area_2"] * leaky[:, s.P2]
    assert np.abs(force[-100:]).max() < 0.05


def test_two_area_rig_moves_as_its_own_two_chamber_matrix():
    a1, a2, v1, v2, g = 1.9635e-3, 1.6493e-3, 3e-4, 1e-4, 2e-13
    rig = {"area_1": a1, "area_2": a2, "volume_1": v1, "volume_2": v2, "makeup_conductance": g,
           "mass": 30.0, "viscous_damping": 2000.0, "position_gain": 5000.0}
    truth = simulated(TRIANGLE, 1.0, rig=rig).truth
    cross = (C_T - g) / 2
    q = D_P * 5000.0
    n = np.zeros((6, 6))  # x, v, p1 - charge, p2 - charge, x_d, slope
    n[0, 1] = n[4, 5] = 1
    n[1, 1], n[1, 2], n[1, 3] = -2000 / 30, a1 / 30, -a2 / 30
    n[2, :5] = BETA / v1 * np.array([-q, -a1, -cross - g, cross, q])
    n[3, :5] = BETA / v2 * np.array([q * a2 / a1, a2, cross, -cross - g, -q * a2 / a1])
    # The constant part: forces and the leak at the charge pressure on both sides.
    constant = np.array([0, (a1 - a2) * CHARGE / 30, 0, 0, 0, 0])
    big = np.zeros((7, 7))
    big[:6, :6], big[:6, 6] = n, constant
    e = expm(big * T_S)
    y = np.array([0, 0, 0, CHARGE * a1 / a2 - CHARGE, 0, 0.04, 1.0])
    for k in range(len(truth)):
        shown = truth[k, [s.X, s.V, s.P1, s.P2]] - [0, 0, CHARGE, CHARGE]
        assert shown == pytest.approx(y[:4], rel=1e-5, abs=1e-5), k
        y = e @ y


def equation_2(b, beta):
    """Denominators of Eq. 1 and Eq. 2 as the paper prints them, highest power first."""
    stiffness = 2 * beta * A / (M * V0)
    open_loop = np.array([1.0, b / M + C_T * beta / V0, stiffness * A, 0.0])
    closed_loop_too = open_loop.copy()
    closed_loop_too[3] = stiffness * D_P * K_POS
    return open_loop, closed_loop_too


def numeric_matrix(loop: bool, **rig):
    """The plant's own derivatives, differenced; (4, 4) for (x, v, p1, p2)."""
    theta, _ = theta_of(settings(rig=rig).rig, {})
    out = np.empty((4, 4))
    for j, h in enumerate((1e-3, 1e-3, 1e3, 1e3)):
        side = []
        for sign in (1, -1):
            y = np.array([0.0, 0.0, CHARGE, CHARGE])
            y[j] += sign * h
            omega = -theta[s.K_POS] * y[0] if loop else 0.0
            side.append(np.array([y[1], *rates(*y[1:], omega, 0.0, theta, NOTHING)]))
        out[:, j] = (side[0] - side[1]) / (2 * h)
    return out


def test_plant_has_the_poles_of_the_paper():
    poles = np.linalg.eigvals(numeric_matrix(True))
    ringing = poles[np.argmax(poles.imag)]
    assert abs(ringing) == pytest.approx(472, abs=1.5)
    assert -ringing.real / abs(ringing) == pytest.approx(0.03, abs=0.003)
    printed = np.roots(equation_2(B, BETA)[1])
    for root in printed:  # Eq. 2 drops B C_T beta/(M V), so not exactly equal
        assert np.abs(poles - root).min() < 1e-3 * abs(root)


@pytest.mark.parametrize("b, beta", [(600.0, 6e8), (1800.0, 6e7), (300.0, 8e8)])
def test_open_loop_is_equation_1_with_its_dropped_term(b, beta):
    poles = np.linalg.eigvals(numeric_matrix(False, viscous_damping=b, bulk_modulus=beta))
    full = equation_2(b, beta)[0] + [0, 0, b * C_T * beta / (M * V0), 0]
    for root in np.roots(full):
        assert np.abs(poles - root).min() < 1e-6 * max(abs(root), 1.0)
    dropped = b * C_T * beta / (M * V0) / (2 * beta * A**2 / (M * V0))
    assert dropped < 2e-3  # 0.06 % at the paper's constants


def test_a_rig_without_a_constant_cannot_be_simulated():
    config = settings(rig={"volume_1": None})
    with pytest.raises(InputError, match=r"^mine\.yaml: rig\.volume_1: .*null$"):
        Simulator(config, source="mine.yaml")
    require_plant(settings().rig, "x")


def test_stream_and_one_piece_are_the_same():
    config = settings(simulation={"excitation": {"m": {**SINE, "duration": 1.0}}})
    whole = Simulator(config).advance_truth(300)
    stream = Simulator(config)
    pieces = np.vstack([stream.advance_truth(n) for n in (1, 99, 120, 80)])
    assert whole == pytest.approx(pieces, rel=1e-12, abs=1e-15)
    assert stream.time == pytest.approx(0.3)


@pytest.mark.parametrize("lag", [1.2e-4, 2.4e-4, 6e-4, 3e-3])
def test_a_lag_behind_a_held_command_is_exact(lag):
    """omega decays towards the speed of the sample: Runge-Kutta runs away where a lag is short."""
    config = simulated(MULTISINE, 1.0, effects={"drive_lag": {"tau": lag}}).config
    truth = Simulator(config.model_copy(update={"command_hold": "sampled"})).advance_truth(1000)
    x, x_d, omega = (truth[:, place] for place in (s.X, s.X_D, s.OMEGA))
    wanted = K_POS * (x_d - x)
    after = wanted[:-1] + (omega[:-1] - wanted[:-1]) * np.exp(-T_S / lag)
    assert omega[1:] == pytest.approx(after, abs=1e-9 * np.abs(omega).max())
