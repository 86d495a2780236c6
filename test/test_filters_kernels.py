"""Compiled stages against filterpy and themselves in batches, and against linear filters."""

import copy

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
    copies,
    settings,
    simulated,
    with_channels,
)
from scipy.linalg import expm

from eha_monitor.estimation import reference_stages, stage_one, stage_two
from eha_monitor.estimation.inputs import StageInputs
from eha_monitor.estimation.stage_one import ConstantsOne, new_state_one
from eha_monitor.estimation.stage_two import ConstantsTwo, new_state_two
from eha_monitor.estimation.stages import constants_one, constants_two

SAME = 1e-8  # between processors rounding differs: 1.1e-9 was seen in 32 samples of stage two
# Stage two's covariance falls by twelve orders of magnitude: what rounding makes of that at first,
# and of the rest over 4000 samples: 1.2e-6 of the slope to B beside a dry friction without memory.
GROWN = {"one": SAME, "two": 1e-5}
BATCH = 5
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
        channels = copies(recording)
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


class One:
    """Stage one with all that it takes and leaves; ``run`` is an engine's."""

    def __init__(self, inputs, config):
        self.inputs, self.constants = inputs, constants_one(inputs, config)
        self.left = new_state_one(config.stage_one.prior, self.constants.prior_variance)
        self.out, self.events = np.empty((6, len(inputs.x))), np.empty((50, 4))
        self.found = 0

    @property
    def state(self):
        return self.left._asdict()

    def rows(self, stop):
        return self.inputs.rows_one(stop)

    def take(self, run, first, stop):
        events = np.empty((50, 4))
        found = run(self.rows(stop), self.constants, self.inputs.model.effects, self.left, first,
                    self.out, events)
        self.events[self.found : self.found + found] = events[:found]
        self.found += found


class Two(One):
    """Stage two likewise; B doubles half way where ``change``."""

    def __init__(self, inputs, config, held, change):
        n = len(inputs.x)
        self.inputs, self.constants = inputs, constants_two(inputs, config)
        self.b, self.b_variance = np.full(n, 600.0), np.full(n, 4.0)
        self.b[n // 2 :] = 900.0 if change else 600.0
        self.left = new_state_two(inputs.model.hydraulics, 0.8, 0.05**2, held=held)
        self.out, self.events, self.found = np.empty((8, n)), np.empty((50, 4)), 0

    def rows(self, stop):
        return self.inputs.rows_two(self.b, self.b_variance, stop)


def of_case(name, stage):
    inputs, config = inputs_of(**CASES[name][0], **CASES[name][1])
    if stage == "one":
        return lambda: One(inputs, config)
    return lambda: Two(inputs, config, name == "held", name == "change")


BOTH = [("one", name) for name in CASES] + [("two", name) for name in CASES if name != "euler"]
COMPILED = {"one": stage_one.run_one, "two": stage_two.run_two}
FILTERPY = {"one": reference_stages.run_one, "two": reference_stages.run_two}


def check_same(stage, reference, compiled, rows, tolerance):
    assert compiled.found == reference.found
    assert reference.events[: reference.found] == pytest.approx(
        compiled.events[: compiled.found], rel=tolerance)
    for i, (theirs, mine) in enumerate(zip(reference.out, compiled.out, strict=True)):
        assert relative(theirs[rows], mine[rows]) < tolerance, i
    for key, value in compiled.state.items():
        if key == "P" and value.ndim == 2:
            scale = np.sqrt(np.outer(np.diag(value), np.diag(value)))
            assert np.abs((reference.left.P - value) / scale).max() < GROWN[stage]
        else:
            assert relative(reference.state[key], value) < tolerance, key


@pytest.mark.parametrize(("stage", "name"), BOTH)
def test_filterpy_runs_the_stages_to_the_same_numbers(stage, name):
    make = of_case(name, stage)
    compiled, reference = make(), make()
    n = len(compiled.inputs.x)
    reference.take(FILTERPY[stage], 0, n)
    for first in range(0, n, BATCH):
        stop, rows = min(n, first + BATCH), slice(first, first + BATCH)
        again = copy.deepcopy(compiled) if first % (20 * BATCH) == 0 else None
        compiled.take(COMPILED[stage], first, stop)
        if again is not None:
            again.take(FILTERPY[stage], first, stop)
            check_same(stage, again, compiled, rows, SAME)
    assert name != "change" or compiled.found > 0
    check_same(stage, reference, compiled, slice(None), GROWN[stage])
    if name == "held" and stage == "two":  # considered: neither value nor sigma moves
        x, P = compiled.left.x, compiled.left.P
        assert (x[3], P[3, 3]) == (0.8, 0.05**2) and P[2, 3] != 0.0
    if name == "memory" and stage == "two":
        assert len(compiled.left.x) == 6  # a line has two states


@pytest.mark.parametrize(("stage", "name"), BOTH)
def test_batch_by_batch_a_stage_gives_the_very_same_numbers(stage, name):
    """Live rows come in batches of any length; what is kept of a stage is its whole state."""
    make = of_case(name, stage)
    at_once, batches = make(), make()
    n, first = len(at_once.inputs.x), 0
    at_once.take(COMPILED[stage], 0, n)
    draw = np.random.default_rng(0)
    while first < n:
        stop = min(n, first + int(draw.integers(1, 150)))
        if draw.random() < 0.1:  # as a rewind does
            batches = copy.deepcopy(batches)
        batches.take(COMPILED[stage], first, stop)
        first = stop
    assert np.array_equal(batches.out, at_once.out, equal_nan=True)
    assert np.array_equal(batches.events[: batches.found], at_once.events[: at_once.found])
    for key, value in at_once.state.items():
        assert np.array_equal(batches.state[key], value, equal_nan=True), key


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
    out = np.empty((6, len(inputs.x)))
    stage_one.run_one(inputs.rows_one(), ConstantsOne(T_S, M, r, 1e-12, False),
                      inputs.model.effects, new_state_one(B, 1e-12), 0, out, np.empty((5, 4)))
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
    model, effects = inputs.model, inputs.model.effects
    rows = inputs.rows_two(B, 0.0)._replace(Q_u=np.zeros(len(x)))
    known = ConstantsTwo(model.hydraulics, model.leak, T_S, r, 0.0, 1.0)
    found = stage_two.log_likelihood_two(rows, known, effects, 5e8 / beta)
    assert found == pytest.approx(log_likelihood, abs=0.02)
    out = np.empty((8, len(x)))
    stage_two.run_two(rows, known, effects, new_state_two(model.hydraulics, 5e8 / beta, 1e-20), 0,
                      out, np.empty((5, 4)))
    late = slice(50, None)
    assert np.abs(out[0] - expected[0])[late].max() < 1e-4 * expected[3][late].max()
    assert np.abs(out[6] - expected[2])[late].max() < 1e-4 * expected[3][late].max()
    assert out[7][late] == pytest.approx(expected[3][late], rel=1e-4)


def test_sensitivity_to_b_is_the_derivative_of_the_estimate():
    """stage two's sigma counts what an error of B does: compare with running at two B."""
    recording = simulated(SINE, 3.0).recording(4, position=1e-7)
    inputs = StageInputs.of(recording, settings())
    model = inputs.model

    def run(b):
        state = new_state_two(model.hydraulics, 5 / 6, 1e-4, frozen=True)
        known = ConstantsTwo(model.hydraulics, model.leak, T_S, inputs.position_variance, 0.0, 1.0)
        stage_two.run_two(inputs.rows_two(b, 0.0), known, model.effects, state, 0,
                          np.empty((8, inputs.rows)), np.empty((5, 4)))
        return state.x[3], state.sens[3]

    low, here, high = run(599.0), run(600.0), run(601.0)
    assert here[1] == pytest.approx((high[0] - low[0]) / 2, rel=0.02)
