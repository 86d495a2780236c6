"""Recordings that lack something: no number is made of nothing, and the reason is told."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from rig_tools import BETA, SINE, copies, settings, simulated, with_channels, without

from eha_monitor.estimation.joint import observability
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.recordings.recording import CHANNELS, Recording


@pytest.fixture(scope="module")
def recording():
    return simulated(SINE, 6.0).recording(0)


def sane(found):
    """Whatever came in: every number has its meaning, every status its reason."""
    for parameter in found.parameters.values():
        assert parameter.message and "\n" not in parameter.message
        has_number = math.isfinite(parameter.value) and math.isfinite(parameter.stddev)
        assert has_number == (parameter.status in ("converged", "not_excited"))
        assert has_number or (math.isnan(parameter.value) and math.isnan(parameter.stddev))
        if parameter.status == "converged":
            assert 0 <= parameter.stddev <= 0.1 * abs(parameter.value)
    assert found.model.status in ("consistent", "mismatch", "not_judged")
    assert found.model.message and "\n" not in found.model.message
    for event in found.events:
        assert math.isfinite(event.time_s) and event.message
    if found.joint is not None:
        for parameter in found.joint.parameters.values():
            assert (parameter.status in ("diverged", "no_data")) == math.isnan(parameter.value)


@pytest.mark.parametrize("missing, b_reason, beta_reason", [
    (("p1",), "stage one needs the channels p1 and p2, or force", None),
    (("p1", "p2"), "stage one needs the channels p1 and p2, or force", None),
    (("x",), "stage one needs the position channel x", "stage two needs the position channel x"),
    (("x_d", "omega"), None,
     "stage two needs the channel x_d with rig.position_gain, or the channel omega"),
    (("p1", "p2", "x_d", "omega"), "stage one needs the channels p1 and p2, or force",
     "stage two needs the channel x_d with rig.position_gain, or the channel omega")])
def test_a_missing_channel_is_named(recording, missing, b_reason, beta_reason):
    found = estimate(without(recording, *missing), settings())
    sane(found)
    b, beta = found.parameters["B"], found.parameters["beta_e"]
    for parameter, reason in ((b, b_reason), (beta, beta_reason)):
        if reason:
            assert (parameter.status, parameter.message) == ("no_data", reason)
            assert math.isnan(parameter.value)
    if b_reason is None:
        assert b.value == pytest.approx(600.0, rel=0.01)
    stage = found.stage_one if b_reason else found.stage_two
    assert len(stage.time) == len(stage.value) == len(stage.innovation) == 0


def test_without_pressures_stage_two_takes_the_nominal_damping_and_says_so(recording):
    found = estimate(without(recording, "p1", "p2"), settings())
    beta = found.parameters["beta_e"]
    assert beta.status == "converged" and beta.value == pytest.approx(BETA, rel=0.02)
    full = estimate(recording, settings()).parameters["beta_e"]
    assert beta.stddev > 10 * full.stddev  # B is known to 100 N·s/m only
    assert any("provides no B (no_data)" in event.message for event in found.events)
    wrong = estimate(without(recording, "p1", "p2"), settings(rig={"viscous_damping": 700.0}))
    beta = wrong.parameters["beta_e"]
    assert abs(beta.value - BETA) < 3 * beta.stddev


def test_without_the_command_the_pump_speed_is_the_input(recording):
    found = estimate(without(recording, "x_d"), settings())
    beta = found.parameters["beta_e"]
    assert beta.status == "converged" and beta.value == pytest.approx(BETA, rel=0.01)
    assert found.model.status == "consistent"
    no_gain = estimate(recording, settings(rig={"position_gain": None})).parameters["beta_e"]
    assert no_gain.value == pytest.approx(beta.value, rel=1e-6)


@pytest.mark.parametrize("key, stage", [("area_1", "one"), ("area_2", "one"),
                                        ("volume_1", "two"), ("volume_2", "two"),
                                        ("pump_displacement", "two")])
def test_a_null_constant_is_named(recording, key, stage):
    found = estimate(recording, settings(rig={key: None}))
    sane(found)
    parameter = found.parameters["B" if stage == "one" else "beta_e"]
    assert parameter.status == "no_data" and key in parameter.message
    assert found.joint is None


@pytest.mark.parametrize("n", [0, 1, 2, 3, 4, 5, 10, 63, 64, 65, 150, 199, 200, 300])
def test_short_recordings(recording, n):
    found = estimate(recording.part(0, n), settings())
    sane(found)
    observability(found)
    if n < 4:
        assert {p.status for p in found.parameters.values()} <= {"no_data", "not_excited"}
    if n < 200:
        assert found.model.status == "not_judged"


@pytest.mark.parametrize("names", [CHANNELS, ("x",), ("p1",), ("x_d", "omega"), ("p1", "p2")])
def test_channels_of_nan_are_as_good_as_missing(recording, names):
    channels = copies(recording)
    for name in set(names) & set(channels):
        channels[name][:] = np.nan
    found = estimate(with_channels(recording, **channels), settings())
    sane(found)
    missing = estimate(without(recording, *names), settings())
    for name in ("B", "beta_e"):
        assert found.parameters[name].status == missing.parameters[name].status
        assert found.parameters[name].message == missing.parameters[name].message


def test_channels_that_never_meet_are_told(recording):
    channels = copies(recording)
    channels["x"][:3000] = np.nan
    for name in ("p1", "p2", "x_d", "omega"):
        channels[name][3000:] = np.nan
    found = estimate(with_channels(recording, **channels), settings())
    sane(found)
    assert {p.status for p in found.parameters.values()} == {"no_data"}
    assert "no stretch" in found.parameters["B"].message


@pytest.mark.parametrize("which", ["all", "x", "p1", "x_d"])
def test_a_lost_second_costs_little(recording, which):
    channels = copies(recording)
    for name in channels if which == "all" else (which,):
        channels[name][2500:3500] = np.nan
    found = estimate(with_channels(recording, **channels), settings())
    sane(found)
    assert found.parameters["B"].value == pytest.approx(600.0, rel=0.01)
    assert found.parameters["beta_e"].value == pytest.approx(BETA, rel=0.01)
    assert found.model.status == "consistent", found.model.message
    if which in ("all", "x"):
        assert np.isnan(found.stage_one.innovation[2500:3500]).all()
    assert np.isfinite(found.stage_one.value).all()


def test_single_lost_samples_cost_little(recording):
    channels = copies(recording)
    rng = np.random.default_rng(1)
    for values in channels.values():
        values[rng.integers(0, len(values), 30)] = np.nan
    found = estimate(with_channels(recording, **channels), settings())
    assert found.parameters["B"].value == pytest.approx(600.0, rel=0.01)
    assert found.parameters["beta_e"].value == pytest.approx(BETA, rel=0.02)
    assert found.model.status == "consistent", found.model.message


def test_spikes_do_not_move_the_estimates(recording):
    channels = copies(recording)
    channels["x"][[1000, 2000, 2001, 4300]] += 0.02
    found = estimate(with_channels(recording, **channels), settings())
    sane(found)
    clean = estimate(recording, settings())
    for name, parameter in found.parameters.items():
        assert abs(parameter.value - clean.parameters[name].value) < parameter.stddev
    beta = found.joint.parameters["beta_e"]
    assert beta.status == "converged" and abs(beta.value - BETA) < 4 * beta.stddev
    assert any("x: " in note and "outlier" in note for note in found.warnings)  # and are told


@given(st.data())
@hypothesis_settings(max_examples=40)
def test_any_recording_gives_an_answer(data):
    """Any channels, lengths, sizes and holes: an answer that means something, no exception."""
    names = data.draw(st.lists(st.sampled_from(CHANNELS), unique=True))
    n = data.draw(st.sampled_from([1, 7, 100, 400]))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**20)))
    channels = {}
    for name in names:
        size = 10.0 ** data.draw(st.floats(-9, 4))
        kind = data.draw(st.sampled_from(["noise", "constant", "walk", "holes", "steps"]))
        values = size * rng.standard_normal(n)
        if kind == "constant":
            values[:] = size
        if kind == "walk":
            values = np.cumsum(values)
        if kind == "steps":
            values = size * np.round(values / size)
        if kind == "holes":
            values[rng.random(n) < 0.4] = np.nan
        channels[name] = values
    effects = data.draw(st.sampled_from([{}, {"coulomb_friction": {"F_c": 10.0}},
                                         {"entrained_air": {"alpha": 0.01},
                                          "cross_port_leakage": {"L": 1e-12}}]))
    rig = data.draw(st.sampled_from([{}, {"position_gain": None}, {"area_2": 3e-4}]))
    hold = data.draw(st.sampled_from(["continuous", "sampled"]))
    with np.errstate(all="ignore"):
        found = estimate(Recording(1e-3, channels), settings(
            effects=effects, rig=rig, command_hold=hold))
    sane(found)
