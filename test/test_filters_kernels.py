"""Compiled stages against filterpy: the same live filters, and independent linear ones."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from rig_tools import (
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
    settings,
    simulated,
    with_channels,
)
from scipy.linalg import expm

from eha_monitor.filters import kernel_one, kernel_two
from eha_monitor.filters.filterpy_stages import FilterpyStageOne, FilterpyStageTwo
from eha_monitor.filters.inputs import StageInputs, moved_mass
from eha_monitor.filters.known import new_known_memory
from eha_monitor.filters.stage_two import states_beside_c
from eha_monitor.filters.supervision import FROZEN, HELD, new_supervision

GAPS = (slice(700, 701), slice(1500, 1700), slice(2500, 2503))
CASES = {
    "plain": ({}, {}),
    "gaps": ({"gaps": True}, {}),
    "effects": ({"effects": {"coulomb_friction": {"F_c": 15.0}, "constant_load": {"F_0": 20.0},
                             "cross_port_leakage": {"L": 1e-12}}}, {}),
    "effects and gaps": ({"gaps": True, "effects": {
        "cross_port_leakage": {"L": 1e-12}, "coulomb_friction": {"F_c": 5.0}}}, {}),
    "memory": ({"effects": {
        "stribeck_friction": {"F_c": 20.0, "F_d": 10.0, "z_0": 3e-6}, "spring_load": {"k": 5e3},
        "line_dynamics": {"T_l": 2e-3}, "relief_valve": {"k": 2e-11, "p_c": 1e5},
        "pump_volumetric_loss": {"k": 2e-7}, "added_mass": {"dM": 4.0},
        "position_dependent_volume": {"A_v": 5e-4}}}, {}),
    "change": ({"faults": {"b": {"parameter": "viscous_damping", "start": 1.5, "value": 900.0},
                           "air": {"parameter": "bulk_modulus", "start": 2.5, "value": 3e8}}},
               {}),
    "spikes": ({"spikes": True}, {}),
    "held": ({}, {}),
    "rest": ({"shape": {"kind": "rest"}}, {}),
    "euler": ({}, {"discretisation": "euler"}),
    "force noise": ({}, {"stage_one": {"force_noise": 3.0},
                         "stage_two": {"acceleration_noise": 0.05}}),
}


def inputs_of(shape=MULTISINE, effects=None, faults=None, gaps=False, spikes=False, **config):
    run = simulated(shape, 4.0, effects=effects, faults=faults or {})
    recording = run.recording(7)
    if gaps:
        channels = {name: values.copy() for name, values in recording.channels.items()}
        channels["x"][GAPS[0]] = channels["p1"][GAPS[2]] = np.nan
        channels["x_d"][2200:2210] = np.nan
        for values in channels.values():
            values[GAPS[1]] = np.nan
        recording = with_channels(recording, **channels)
    if spikes:
        x = recording.channels["x"].copy()
        x[[900, 1800, 1801, 3000]] += 0.05
        recording = with_channels(recording, x=x)
    chosen = settings(effects=effects or {}, **config)
    return StageInputs.of(recording, chosen), chosen


def relative(mine, theirs, floor=1e-12):
    """Largest difference over the largest value; NaN must stand at the same places."""
    assert np.array_equal(np.isnan(mine), np.isnan(theirs))
    if np.isnan(mine).all():
        return 0.0
    return np.nanmax(np.abs(mine - theirs)) / max(np.nanmax(np.abs(theirs)), floor)


@pytest.mark.parametrize("name", CASES)
def test_filterpy_runs_stage_one_to_the_same_numbers(name):
    inputs, config = inputs_of(**CASES[name][0], **CASES[name][1])
    n, one, model = len(inputs.x), config.stage_one, inputs.model
    mass = moved_mass(model, inputs.dt)
    m, p = np.array([np.nan, 0.0, one.prior]), np.array([0, 0, 0, 0, 0, one.prior_stddev**2])
    out, events = np.empty((6, n)), np.empty((50, 4))
    found = kernel_one.run_one(
        inputs.x, inputs.force.start, inputs.force.end, inputs.force.variance, inputs.p1,
        inputs.p2, inputs.dt, mass, inputs.position_variance, one.prior_stddev**2,
        config.discretisation == "euler", model.theta, model.plain, model.remembering,
        new_known_memory(), m, p, new_supervision(), out, events)
    live = FilterpyStageOne(model, mass, inputs.dt, inputs.position_variance, one.prior,
                            one.prior_stddev, config.discretisation == "euler")
    rows, changes = np.empty((6, n)), []
    for k in range(n):
        before = inputs.force.start[k - 1] if k else np.nan
        change = live.step(inputs.x[k], before, inputs.force.end[k], inputs.force.variance[k],
                           inputs.p1[k], inputs.p2[k])
        if change is not None:
            changes.append((k, *change))
        # The compiled filter calls a state that is lost NaN; filterpy keeps the old one.
        lost = live.lost
        rows[:, k] = [np.nan if lost else live.ekf.x[0], live.ekf.x[1], live.value, live.stddev,
                      live.innovation, live.innovation_stddev]
    assert found == len(changes) and (name != "change" or found > 0)
    assert np.array(changes).reshape(-1, 4) == pytest.approx(events[:found], rel=1e-6)
    for i in range(6):
        assert relative(rows[i], out[i]) < 1e-6, i
    final = np.array([*live.ekf.P[0], live.ekf.P[1, 1], live.ekf.P[1, 2], live.ekf.P[2, 2]])
    assert final == pytest.approx(p, rel=1e-4)


@pytest.mark.parametrize("name", [name for name in CASES if name != "euler"])
def test_filterpy_runs_stage_two_to_the_same_numbers(name):
    inputs, config = inputs_of(**CASES[name][0], **CASES[name][1])
    n, model, two = len(inputs.x), inputs.model, config.stage_two
    b, b_variance = np.full(n, 600.0), np.full(n, 4.0)
    b[n // 2 :] = 900.0 if name == "change" else 600.0
    broad = (two.prior_stddev / two.prior) ** 2
    q_f = (config.rig.mass * two.acceleration_noise) ** 2
    size = states_beside_c(model.hydraulics) + 1
    assert size == (6 if name == "memory" else 4)  # a line has two states
    m, p = np.zeros(size), np.zeros((size, size))
    m[0], m[3], p[3, 3] = np.nan, 0.8, 0.05**2
    sens, watch = np.zeros(size), new_supervision()
    if name == "held":
        watch[FROZEN] = HELD
    memory = new_known_memory()
    live = FilterpyStageTwo(model, inputs.dt, inputs.position_variance, q_f, broad, m, p, sens,
                            watch, memory)
    out, events = np.empty((8, n)), np.empty((50, 4))
    drive = inputs.drive
    found = kernel_two.run_two(
        inputs.x, drive.start, drive.end, drive.variance, drive.instrument, b, b_variance,
        model.hydraulics, model.leak, inputs.leak_flow, inputs.dt, inputs.position_variance, q_f,
        broad, inputs.mean, model.theta, model.plain, model.remembering, model.flows, memory, m,
        p, sens, watch, out, events)
    rows, changes = np.empty((8, n)), []
    for k in range(n):
        u0, i0 = (drive.start[k - 1], drive.instrument[k - 1, 0]) if k else (np.nan, np.nan)
        change = live.step(inputs.x[k], u0, drive.end[k], i0, drive.instrument[k, 1],
                           drive.variance[k], b[k], b_variance[k], inputs.leak_flow[k],
                           inputs.mean[k])
        if change is not None:
            changes.append((k, *change))
        beta = model.beta_0 / live.ekf.x[3]
        rows[:, k] = [np.nan if live.lost else live.ekf.x[0], live.ekf.x[1], live.acceleration,
                      live.value, beta / live.ekf.x[3] * live.factor * live.ekf.P[3, 3] ** 0.5,
                      live.stddev, live.innovation, live.innovation_stddev]
    if name == "held":  # considered: neither value nor sigma moves, and the states know of both
        assert (m[3], p[3, 3]) == (0.8, 0.05**2) and p[2, 3] != 0.0
    assert found == len(changes) and (name != "change" or found > 0)
    assert np.array(changes).reshape(-1, 4) == pytest.approx(events[:found], rel=1e-5)
    for i in range(8):
        assert relative(rows[i], out[i]) < (1e-5 if i == 2 else 1e-6), i
    assert live.sens == pytest.approx(sens, rel=1e-5, abs=1e-9 * np.abs(sens).max())
    scale = np.sqrt(np.outer(np.diag(p), np.diag(p)))
    assert np.abs((live.ekf.P - p) / scale).max() < 1e-4


# ---- independent linear filters: the parameter is known -----------------------------------------


def linear_filter(n, r, f, q):
    """A filterpy KalmanFilter that starts at the first position, its speed unknown."""
    plain = KalmanFilter(dim_x=n, dim_z=1, dim_u=2)
    plain.F, plain.Q, plain.R[:] = f, q, r
    plain.H[0, 0] = 1.0
    plain.x[:] = 0.0
    plain.P[:] = 0.0
    plain.P[0, 0] = r
    return plain


def test_with_b_known_stage_one_is_a_linear_kalman_filter():
    recording = simulated(TRIANGLE, 3.0).recording(2)
    inputs = StageInputs.of(recording, settings())
    r = inputs.position_variance
    n = np.zeros((4, 4))
    n[0, 1], n[1, 1], n[1, 2], n[2, 3] = 1, -B / M, 1 / M, 1
    e = expm(n * T_S)
    f, held = e[:2, :2], e[:2, 2]
    end = e[:2, 3] / T_S
    plain = linear_filter(2, r, f, np.zeros((2, 2)))
    plain.B = np.column_stack([held - end, end])
    plain.x[0, 0] = recording.channels["x"][0]
    plain.P[1, 1] = (1e3 * np.sqrt(r) / T_S) ** 2
    hold = inputs.force
    expected = np.full((4, len(inputs.x)), np.nan)
    for k in range(1, len(inputs.x)):
        plain.Q = hold.variance[k] * np.outer(held, held)
        plain.predict(u=np.array([[hold.start[k - 1]], [hold.end[k]]]))
        plain.update(recording.channels["x"][k])
        expected[:, k] = [plain.x[0, 0], plain.x[1, 0], plain.y[0, 0], plain.S[0, 0] ** 0.5]
    assert hold.variance.min() == pytest.approx(
        A**2 * (inputs.noise["p1"].value ** 2 + inputs.noise["p2"].value ** 2), rel=1e-9)
    m, p = np.array([np.nan, 0.0, B]), np.array([0, 0, 0, 0, 0, 1e-12])
    out = np.empty((6, len(inputs.x)))
    model = inputs.model
    kernel_one.run_one(inputs.x, hold.start, hold.end, hold.variance, inputs.p1, inputs.p2, T_S,
                       M, r, 1e-12, False, model.theta, model.plain, model.remembering,
                       new_known_memory(), m, p, new_supervision(), out, np.empty((5, 4)))
    assert np.all(out[2] == pytest.approx(B, abs=1e-6))
    sd = np.nanmax(expected[3])
    assert np.nanmax(np.abs(out[0, 1:] - expected[0, 1:])) < 1e-6 * sd
    assert np.nanmax(np.abs(out[1, 1:] - expected[1, 1:])) < 1e-9
    assert np.nanmax(np.abs(out[4, 2:] - expected[2, 2:])) < 1e-6 * sd
    assert out[5, 1:] == pytest.approx(expected[3, 1:], rel=1e-6)


def test_with_both_known_stage_two_is_a_linear_kalman_filter():
    recording = simulated(SINE, 2.0).recording(2)
    inputs = StageInputs.of(recording, settings())
    r, x = inputs.position_variance, recording.channels["x"]
    beta, stiff = 6e8, 2 * A / V0
    n = np.zeros((5, 5))
    n[0, 1] = n[3, 4] = 1
    n[1, 1], n[1, 2] = -B / M, 1 / M
    n[2, :4] = beta * np.array([-stiff * D_P * K_POS, -stiff * A, -C_T / V0,
                                stiff * D_P * K_POS])
    e = expm(n * T_S)
    end = e[:3, 4] / T_S
    plain = linear_filter(3, r, e[:3, :3], np.zeros((3, 3)))
    plain.B = np.column_stack([e[:3, 3] - end, end])
    plain.x[0, 0] = x[0]
    broad = 1e3 * np.sqrt(r) / T_S
    plain.P[1, 1], plain.P[2, 2] = broad**2, (M * broad / T_S) ** 2
    drive = inputs.drive
    expected = np.full((4, len(x)), np.nan)
    for k in range(1, len(x)):
        plain.predict(u=np.array([[drive.start[k - 1]], [drive.end[k]]]))
        plain.update(x[k])
        expected[:, k] = [plain.x[0, 0], plain.x[1, 0], plain.y[0, 0], plain.S[0, 0] ** 0.5]
    log_likelihood = -np.nansum(0.5 * (expected[2] / expected[3]) ** 2 + np.log(expected[3]))
    flat = np.zeros(len(x))
    model = inputs.model
    known = model.theta, model.plain, model.remembering, model.flows, new_known_memory()
    found = kernel_two.log_likelihood_two(
        x, drive.start, drive.end, flat, drive.instrument, B, 5e8 / beta, model.hydraulics,
        model.leak, flat, T_S, r, 0.0, inputs.mean, *known)
    assert found == pytest.approx(log_likelihood, abs=0.02)
    m, p = np.array([np.nan, 0.0, 0.0, 5e8 / beta]), np.diag([0, 0, 0, 1e-20])
    out = np.empty((8, len(x)))
    kernel_two.run_two(x, drive.start, drive.end, flat, drive.instrument, np.full(len(x), B),
                       flat, model.hydraulics, model.leak, flat, T_S, r, 0.0, 1.0, inputs.mean,
                       *known, m, p, np.zeros(4), new_supervision(), out, np.empty((5, 4)))
    late = slice(50, None)
    assert np.abs(out[0] - expected[0])[late].max() < 1e-4 * expected[3][late].max()
    assert np.abs(out[6] - expected[2])[late].max() < 1e-4 * expected[3][late].max()
    assert out[7][late] == pytest.approx(expected[3][late], rel=1e-4)


def test_sensitivity_to_b_is_the_derivative_of_the_estimate():
    """stage two's sigma counts what an error of B does: compare with running at two B."""
    recording = simulated(SINE, 3.0).recording(4, position=1e-7)
    inputs = StageInputs.of(recording, settings())
    model, drive, n = inputs.model, inputs.drive, len(inputs.x)

    def run(b):
        m, p, sens = np.array([np.nan, 0, 0, 5 / 6]), np.diag([0, 0, 0, 1e-4]), np.zeros(4)
        out = np.empty((8, n))
        kernel_two.run_two(inputs.x, drive.start, drive.end, drive.variance, drive.instrument,
                           np.full(n, b), np.zeros(n), model.hydraulics, model.leak, np.zeros(n),
                           T_S, inputs.position_variance, 0.0, 1.0, inputs.mean, model.theta,
                           model.plain, model.remembering, model.flows, new_known_memory(), m, p,
                           sens, new_supervision(True), out, np.empty((5, 4)))
        return m[3], sens[3]

    low, here, high = run(599.0), run(600.0), run(601.0)
    assert here[1] == pytest.approx((high[0] - low[0]) / 2, rel=0.02)
