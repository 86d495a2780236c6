"""The effects of force and flow in the moving plant, against closed forms of steady motion.

On a triangle of the demanded position the piston runs at +v and -v.  There

    A dp = B v + F,   D_p (omega + speed) = A v + (C_T/2) dp + leakage

and each effect adds its own, known part.  On a sine the ratio of two signals' Fourier
components is an impedance that is known as well.
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rig_tools import BETA, C_T, D_P, SINE, TRIANGLE, V0, A, B, M, simulated

from eha_monitor.compiled import njit
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.effects.friction import dry_force, remember, sliding

V, CHARGE, MAKEUP, AMBIENT = 0.04, 2e6, 1e-13, 101325.0
DP = B * V / A  # 47.5 kPa, of the linear model


def steady(effect, values):
    """Simulate; (v, dp, omega, x, p1 + p2) at two places of opposite motion."""
    truth = simulated(TRIANGLE, 8.0, effects={effect: values}).truth
    found = []
    for start in (4600, 6600):  # 1.6 s and more after a reversal: forwards, backwards
        part = truth[start:start + 300].mean(axis=0)
        found.append((part[s.V], part[s.P1] - part[s.P2], part[s.OMEGA], part[s.X],
                      part[s.P1] + part[s.P2]))
    return found


# What each adds to the driving force, N; d is the direction, x the position.
FORCES = {
    "coulomb_friction": ({"F_c": 10.0, "v_e": 1e-3, "z_0": 4e-6}, lambda d, x: 10.0 * d),
    "presliding_friction": ({"F_c": 10.0, "z_0": 1e-4}, lambda d, x: 10.0 * d),
    "stribeck_friction": ({"F_c": 7.0, "F_d": 11.0, "v_s": 0.05, "z_0": 4e-6},
                          lambda d, x: d * (7.0 + 11.0 * math.exp(-0.64))),
    "quadratic_friction": ({"a_1": 8000.0}, lambda d, x: 12.8 * d),
    "asymmetric_friction": ({"F_c": 9.0, "dF": 3.0, "dB": 100.0}, lambda d, x: 9.0 * d + 7.0),
    "pressure_friction": ({"mu": 3e-6}, lambda d, x: 12.0 * d),
    "constant_load": ({"F_0": 15.0}, lambda d, x: 15.0),
    "spring_load": ({"k": 900.0, "x_0": 0.01}, lambda d, x: 900.0 * (x - 0.01)),
}


@pytest.mark.parametrize("effect", FORCES)
def test_force_in_steady_motion(effect):
    values, force = FORCES[effect]
    for (v, dp, omega, x, _), d in zip(steady(effect, values), (1, -1), strict=True):
        assert v == pytest.approx(d * V, rel=5e-3)
        assert A * dp == pytest.approx(B * v + force(d, x), rel=1e-3)
        assert D_P * omega == pytest.approx(A * v + C_T / 2 * dp, rel=1e-3)


def root(dp):
    return math.copysign(math.sqrt(abs(dp)), dp)


# What leaks from chamber 1 to 2, m^3/s; what is missing of the shaft's speed, rad/s.
FLOWS = {
    "cross_port_leakage": ({"L": 3e-11}, lambda dp, w: 3e-11 * dp),
    "turbulent_leakage": ({"c": 4e-9, "dp_0": 1e3}, lambda dp, w: 4e-9 * root(dp)),
    "leakage_offset": ({"Q_0": 1e-6}, lambda dp, w: math.copysign(1e-6, dp)),
    "relief_valve": ({"k": 2e-11, "p_c": 2e4},
                     lambda dp, w: math.copysign(2e-11 * (abs(dp) - 2e4), dp)),
    "pump_dead_zone": ({"omega_0": 8.0}, lambda dp, w: D_P * math.copysign(8.0, w)),
    "pump_flow_gain": ({"k": -0.08}, lambda dp, w: 0.08 * D_P * w),
    "pump_volumetric_loss": ({"k": 1e-6}, lambda dp, w: 1e-6 * abs(w) * dp * D_P),
    "line_dynamics": ({"T_l": 2e-3}, lambda dp, w: 0.0),
}


@pytest.mark.parametrize("effect", FLOWS)
def test_flow_in_steady_motion(effect):
    values, lost = FLOWS[effect]
    for (v, dp, omega, _, _), d in zip(steady(effect, values), (1, -1), strict=True):
        assert v == pytest.approx(d * V, rel=5e-3) and dp == pytest.approx(d * DP, rel=5e-3)
        assert D_P * omega == pytest.approx(A * v + C_T / 2 * dp + lost(dp, omega), rel=1e-3)


@pytest.mark.parametrize("effect, values, pressure", [
    ("external_leakage", {"L_1": 5e-14, "L_2": 5e-14},
     (MAKEUP * CHARGE + 5e-14 * AMBIENT) / (MAKEUP + 5e-14)),
    ("anti_cavitation", {"k": 4e-13, "p_min": 3e6},
     (MAKEUP * CHARGE + 4e-13 * 3e6) / (MAKEUP + 4e-13))])
def test_pressure_at_rest_is_where_make_up_and_effect_meet(effect, values, pressure):
    rest = simulated({"kind": "rest"}, 8.0, effects={effect: values}).truth[-1]
    assert rest[[s.P1, s.P2]] == pytest.approx([pressure] * 2, rel=2e-3)


@pytest.mark.parametrize("ambient", [0.0, AMBIENT, 5e5])
def test_closed_chambers_leak_down_to_the_ambient_pressure(ambient):
    """V/beta p' = -L (p - p_a), so p - p_a falls as exp(-L beta t/V)."""
    leak, seconds = 2e-13, 1.0
    found = simulated({"kind": "rest"}, seconds, effects={
        "external_leakage": {"L_1": leak, "L_2": leak}}, rig={
            "makeup_conductance": 0.0, "leakage": 0.0, "ambient_pressure": ambient}).truth
    fallen = np.exp(-leak * BETA * found[:, s.T] / V0)
    for p in (s.P1, s.P2):
        assert found[:, p] == pytest.approx(ambient + (CHARGE - ambient) * fallen, rel=1e-6)


def fourier(signal, frequency, dt=1e-3):
    """Complex amplitude over the last whole second."""
    last = signal[-round(1 / dt):]
    return 2 * np.mean(last * np.exp(-2j * np.pi * frequency * dt * np.arange(len(last))))


@pytest.mark.parametrize("effect, values, mass, stiffness", [
    ("added_mass", {"dM": 6.0}, M + 6.0, 0.0), ("spring_load", {"k": 8000.0}, M, 8000.0)])
def test_mechanical_impedance_on_a_sine(effect, values, mass, stiffness):
    truth = simulated(SINE, 3.0, effects={effect: values}).truth
    jw = 2j * np.pi * 4
    force = A * fourier(truth[:, s.P1] - truth[:, s.P2], 4)
    assert force / fourier(truth[:, s.V], 4) == pytest.approx(
        B + jw * mass + stiffness / jw, rel=1e-6)


@pytest.mark.parametrize("effect, values, offset", [
    ("position_dependent_volume", {"A_v": A}, 0.03), ("entrained_air", {"alpha": 0.01}, 0.0)])
def test_compliance_of_a_chamber_on_a_small_sine(effect, values, offset):
    small = {"kind": "sine", "amplitude": 1e-4, "frequency": 20.0, "offset": offset}
    truth = simulated(small, 3.0, effects={effect: values}).truth
    p1, p2, v, omega = (fourier(truth[:, i], 20) for i in (s.P1, s.P2, s.V, s.OMEGA))
    inflow = D_P * omega - A * v - (C_T - MAKEUP) / 2 * (p1 - p2) - MAKEUP * p1
    volume = V0 + values.get("A_v", 0.0) * offset
    air = values.get("alpha", 0.0) / (1.4 * CHARGE) * (101325 / CHARGE) ** (1 / 1.4)
    assert inflow / (2j * np.pi * 20 * p1) == pytest.approx(volume * (1 / BETA + air), rel=1e-3)


@pytest.mark.parametrize("frequency", [4.0, 40.0, 60.0])
def test_line_answers_as_a_low_pass_that_the_chambers_load(frequency):
    """Its own resonance, at 50 Hz, beside the oil column's at 75 Hz."""
    line = {"T_l": 1 / (2 * np.pi * 50), "zeta": 0.2, "Z": 12e3}
    sine = {"kind": "sine", "amplitude": 1e-3, "frequency": frequency}
    truth = simulated(sine, 4.0, effects={"line_dynamics": line}, substeps=20).truth
    jw = 2j * np.pi * frequency
    dp = fourier(truth[:, s.P1] - truth[:, s.P2], frequency)
    flow = (A * fourier(truth[:, s.V], frequency) + (V0 / (2 * BETA) * jw + C_T / 2) * dp)
    r = jw * line["T_l"]
    driven = fourier(truth[:, s.OMEGA], frequency) - r / line["Z"] * dp
    assert flow / D_P == pytest.approx(driven / (r**2 + 2 * 0.2 * r + 1), rel=2e-3)


@pytest.mark.parametrize("share", [1e-3, 0.5, 1.0, 30.0, 1e4])
def test_line_is_stable_for_any_step(share):
    entry, p, row = CATALOGUE["line_dynamics"], np.array([1e-3, 0.05, 3e4]), np.zeros(s.N_SIGNALS)
    m, c, largest = np.zeros(2), np.zeros(s.N_CONTRIBUTIONS), 0.0
    for k in range(2000):
        row[s.OMEGA] = 100.0 if k > 5 else 0.0
        entry.update(row, p, share * 1e-3, m)
        c[:] = 0.0
        entry.term(row, p, m, c)
        largest = max(largest, abs(c[s.SPEED] + row[s.OMEGA]))
    assert largest < 190.0  # a step overshoots by exp(-pi zeta / sqrt(1 - zeta^2)), 85 %
    if share * 2000 * 0.05 > 20:
        assert c[s.SPEED] == pytest.approx(0.0, abs=1e-4)


# ---- Dahl's turning over of dry friction -------------------------------------------------------


@njit
def friction_along(x, v, v_e, z_0, t_1, v_d, level):
    """Friction force along a path, with its memory."""
    m, row, force = np.zeros(2), np.zeros(s.N_SIGNALS), np.zeros(len(x))
    m[1] = x[0]
    for k in range(len(x)):
        row[s.X], row[s.V] = x[k], v[k]
        steady = level * sliding(row, v_e, 0.0)
        force[k] = dry_force(row, steady, z_0, t_1, v_d, m)
        remember(row, steady, z_0, m)
    return force


@pytest.mark.parametrize("z_0", [4e-6, 4e-5, 4e-4, 1e-3])
def test_loop_of_dry_friction_has_dahl_s_area(z_0):
    """Over strokes of 2X the steady loop dissipates 4 F_c (X - z_0 tanh(X / z_0))."""
    stroke = 5e-4
    there = np.linspace(-stroke, stroke, 20001)
    x = np.concatenate([there, there[::-1]] * 5)
    v = np.repeat(np.tile([0.1, -0.1], 5), 20001)
    force = friction_along(x, v, 1e-4, z_0, 0.0, 5e-3, 20.0)[-40002:]
    area = np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(x[-40002:]))
    exact = 4 * 20.0 * (stroke - z_0 * math.tanh(stroke / z_0))
    assert area == pytest.approx(exact, rel=2e-3)
    assert np.abs(force).max() <= 20.0


@given(turns=st.lists(st.floats(-1e-3, 1e-3), min_size=2, max_size=12),
       z_0=st.sampled_from([1e-5, 1e-4, 1e-3]))
def test_dry_friction_gives_back_no_more_than_it_stored(turns, z_0):
    x = np.concatenate([np.linspace(a, b, 400, endpoint=False)
                        for a, b in zip([0.0, *turns], turns, strict=False)])
    v = np.gradient(x) / 1e-3
    force = friction_along(x, v, 1e-6, z_0, 0.0, 5e-3, 20.0)
    work = np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(x))])
    stored = 20.0 * z_0 * (1 - math.log(2))  # the most that a Dahl element gives back
    assert work.min() >= -stored - 1e-6


def test_pushed_within_the_presliding_it_is_a_spring():
    x = np.linspace(0, 1e-6, 50)
    force = friction_along(x, np.full(50, 0.1), 1e-4, 1e-4, 0.0, 5e-3, 20.0)
    assert force[1:] == pytest.approx(20.0 / 1e-4 * x[1:], rel=0.01)


def test_shaken_within_the_presliding_it_is_spring_and_damper():
    """sigma_0 x + sigma_1 v with sigma_0 = F_c / z_0, sigma_1 = t_1 sigma_0, as in LuGre."""
    level, z_0, t_1, omega, n = 20.0, 1e-3, 3e-3, 2 * np.pi * 10.0, 4000
    phase = 2 * np.pi * np.arange(4 * n) / n
    x, v = 1e-7 * np.sin(phase), 1e-7 * omega * np.cos(phase)
    force = friction_along(x, v, 1e-9, z_0, t_1, 1.0, level)[-n:]
    answer = 2 * np.mean(force * np.exp(-1j * phase[-n:]))  # to x = 1e-7 Re(-i e^(i phase))
    assert answer / -1e-7j == pytest.approx(level / z_0 * (1 + 1j * omega * t_1), rel=2e-3)


@pytest.mark.parametrize("v, v_d", [(1e-3, 5e-3), (4e-3, 5e-3), (1e-2, 5e-3), (4e-2, 5e-3)])
def test_micro_damping_fades_with_the_speed(v, v_d):
    """After a reversal at a speed v: F_c - 2 F_c e^(-x/z_0) (1 - t_1 v / z_0 e^-(v/v_d)^2)."""
    x = np.concatenate([[-1e-3, 0.0], np.linspace(0.0, 2e-5, 100)])
    speed = np.where(np.arange(len(x)) < 2, -v, v)
    z_0, t_1 = 5e-6, 1e-3
    force = friction_along(x, speed, 1e-7, z_0, t_1, v_d, 20.0)[2:]
    damped = t_1 * v / z_0 * math.exp(-(v / v_d) ** 2)
    assert force == pytest.approx(20.0 - 40.0 * np.exp(-x[2:] / z_0) * (1 - damped), abs=1e-9)


def first_force(effect, values, x, v):
    """Force of an entry that was at rest at 0 and now is at x with the velocity v, N."""
    entry = CATALOGUE[effect]
    p = np.array([values.get(q.name, q.default if q.default is not None else q.neutral)
                  for q in entry.parameters])
    row, m, c = np.zeros(s.N_SIGNALS), np.zeros(2), np.zeros(s.N_CONTRIBUTIONS)
    row[s.X], row[s.V] = x, v
    entry.term(row, p, m, c)
    return c[s.FORCE]


@pytest.mark.parametrize("dF", [-25.0, -9.0, 0.0, 4.0, 25.0])
@pytest.mark.parametrize("v", [-0.05, -1e-4, 1e-4, 0.05])
def test_friction_that_differs_by_direction_never_drives(dF, v):
    """Dry friction dissipates, whatever is fitted; beyond |dF| = F_c it would be a load."""
    force = first_force("asymmetric_friction", {
        "F_c": 9.0, "dF": dF, "dB": 0.0, "v_e": 1e-5, "z_0": 0.0}, 0.0, v)
    most = max(9.0 + math.copysign(1.0, v) * dF, 0.0)
    assert force * v >= 0.0
    assert force == pytest.approx(math.copysign(most, v), rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("effect, values, most", [
    ("stribeck_friction", {"F_c": 7.0, "F_d": 11.0, "v_s": 5e-3}, 18.0),
    ("asymmetric_friction", {"F_c": 9.0, "dF": 5.0, "dB": 0.0}, 14.0),
    ("asymmetric_friction", {"F_c": 9.0, "dF": -5.0, "dB": 0.0}, 14.0)])
@pytest.mark.parametrize("v", [1e-2, -1e-2, 5e-2, -5e-2])
def test_seal_is_as_stiff_in_each_direction_and_at_each_speed(effect, values, most, v):
    x = math.copysign(1e-9, v)
    shape = {"v_e": 1e-6, "z_0": 4e-6, "t_1": 0.0}
    assert first_force(effect, {**values, **shape}, x, v) == pytest.approx(
        most / 4e-6 * x, rel=2e-3)
