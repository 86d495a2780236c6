"""B, beta_e and leakage at once, and what each set of channels can tell."""

from dataclasses import replace

import numpy as np
import pytest
from rig_tools import (
    BETA,
    C_T,
    CHIRP,
    MULTISINE,
    REST,
    SINE,
    T_S,
    TRIANGLE,
    B,
    closed_loop,
    linear_response,
    settings,
    simulated,
    without,
)
from scipy.linalg import expm

from eha_monitor.estimation.joint import observability
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.physics import signals as s

SHAPES = {"triangle": TRIANGLE, "sine": SINE, "multisine": MULTISINE, "chirp": CHIRP}
TRUTH = {"B": B, "beta_e": BETA, "L": C_T}


@pytest.fixture(scope="module")
def found():
    answers = {}
    for name, shape in SHAPES.items():
        run = simulated(shape, 8.0)
        answers[name] = run, estimate(run.recording(3), settings())
    return answers


@pytest.mark.parametrize("name", SHAPES)
def test_three_parameters_at_once(found, name):
    joint = found[name][1].joint
    for key, truth in TRUTH.items():
        parameter = joint.parameters[key]
        assert parameter.status == "converged", parameter
        assert abs(parameter.value - truth) < 4 * parameter.stddev
        assert parameter.value == pytest.approx(truth, rel=0.05 if key == "L" else 0.01)


@pytest.mark.parametrize("name", SHAPES)
def test_correlation_is_a_correlation(found, name):
    r = found[name][1].joint.correlation
    assert r.shape == (3, 3) and np.diag(r) == pytest.approx(np.ones(3))
    assert pytest.approx(r.T) == r and np.abs(r).max() <= 1 + 1e-12
    assert np.linalg.eigvalsh(r).min() > -1e-12


def test_another_leakage_than_configured_is_found():
    recording = simulated(SINE, 8.0, rig={"leakage": 2e-12}).recording(0)
    joint = estimate(recording, settings()).joint
    assert joint.parameters["L"].value == pytest.approx(2e-12, rel=0.03)
    assert joint.parameters["beta_e"].value == pytest.approx(BETA, rel=0.01)


def test_what_one_number_has_run_away_with_is_in_the_others(found):
    whole = next(iter(found.values()))[1]
    assert whole.joint_doubt == ""
    lost = replace(whole.joint.parameters["beta_e"], status="diverged")
    joint = replace(whole.joint, parameters=whole.joint.parameters | {"beta_e": lost})
    assert replace(whole, joint=joint).joint_doubt == "βe diverged in the joint filter"


def test_without_pressures_or_speed_there_is_no_joint_answer(found):
    recording = found["sine"][0].recording(0)
    for missing in (("p1",), ("p1", "p2"), ("omega",)):
        assert estimate(without(recording, *missing), settings()).joint is None


def test_dry_friction_makes_no_joint_number():
    recording = simulated(MULTISINE, 8.0, effects={"coulomb_friction": {"F_c": 10.0}}
                          ).recording(0)
    joint = estimate(recording, settings()).joint
    for parameter in joint.parameters.values() if joint is not None else ():
        assert parameter.status == "diverged" and np.isnan(parameter.value)


# ---- observability ------------------------------------------------------------------------------


def table_of(answer):
    return {row.channels: row.relative_stddev for row in observability(answer).rows}


def test_what_each_set_of_channels_can_tell(found):
    table = table_of(found["sine"][1])
    assert set(table) == {("x", "x_d"), ("x", "omega"), ("x", "p1", "p2"),
                          ("x", "x_d", "p1", "p2"), ("x", "omega", "p1", "p2")}
    force_only = table["x", "p1", "p2"]
    assert force_only["B"] < 1e-2  # nothing is assumed of the force between samples here
    assert np.isinf(force_only["beta_e"]) and force_only["L"] > 1.0  # more than its own size
    # The paper's "not observable": from x and x_d alone, one tone, all three unknown, the answer
    # is hundreds of times worse than with the pressures.
    position_only, everything = table["x", "x_d"], table["x", "x_d", "p1", "p2"]
    assert position_only["B"] > 30 * everything["B"]
    assert everything["B"] < 1e-3 and everything["beta_e"] < 1e-3
    for narrow, wide in ((("x", "x_d"), ("x", "x_d", "p1", "p2")),
                         (("x", "p1", "p2"), ("x", "x_d", "p1", "p2")),
                         (("x", "omega"), ("x", "omega", "p1", "p2"))):
        for key in TRUTH:
            assert table[wide][key] <= 1.01 * table[narrow][key]


def test_at_rest_nothing_can_be_told():
    table = table_of(estimate(simulated(REST, 5.0).recording(0), settings()))
    assert len(table) == 5
    assert all(np.isinf(value) for row in table.values() for value in row.values())


def test_rows_are_those_of_the_recorded_channels(found):
    recording = found["sine"][0].recording(0)
    table = table_of(estimate(without(recording, "p1", "omega"), settings()))
    assert list(table) == [("x", "x_d")]
    assert table_of(estimate(without(recording, "x"), settings())) == {}
    no_volume = estimate(recording, settings(rig={"volume_1": None}))
    assert table_of(no_volume) == {}


@pytest.mark.parametrize("name", ["sine", "chirp", "triangle"])
def test_bounds_agree_with_finite_differences_of_an_own_model(found, name):
    """Fisher information of x, or x and dp, given x_d; B, beta_e, C_T and the start unknown."""
    run, answer = found[name]
    x_d = run.truth[:, s.X_D]
    base = {"b": B, "beta": BETA, "c_t": C_T}
    columns = []
    for key, value in base.items():
        h = 1e-3 * value
        ahead, behind = ({**base, key: value + sign * h} for sign in (1, -1))
        columns.append(value * (linear_response(x_d, T_S, **ahead)
                                - linear_response(x_d, T_S, **behind)) / (2 * h))
    step = expm(closed_loop()[0] * T_S)
    power, powers = np.eye(3), np.empty((len(x_d), 3, 3))
    for k in range(len(x_d)):
        powers[k] = power
        power = step @ power
    columns += list(np.moveaxis(powers, 2, 0) * np.array([1e-6, 1e-3, 1e3])[:, None, None])
    noise = {"x": 1e-6, "dp": np.sqrt(2) * 500.0}
    table = table_of(answer)
    for channels, pieces in ((("x", "x_d"), ((0, "x"),)),
                             (("x", "x_d", "p1", "p2"), ((0, "x"), (2, "dp")))):
        j = np.array([np.concatenate([d[:, i] / noise[key] for i, key in pieces])
                      for d in columns])
        bound = np.sqrt(np.diag(np.linalg.inv(j @ j.T)))[:3]
        found_ = np.array([table[channels][key] for key in TRUTH])
        # Corners of a triangle count as uncertain input, which costs a little.
        assert (found_ > 0.9 * bound).all() and (found_ < 1.4 * bound).all(), found_ / bound
