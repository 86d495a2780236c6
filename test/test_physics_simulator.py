"""Excitation, faults over time and sensors of the simulated rig."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from rig_tools import CHIRP, MULTISINE, SINE, TRIANGLE, motion, settings, simulated

from eha_monitor.errors import InputError
from eha_monitor.physics import signals as s
from eha_monitor.physics.parameters import place_of
from eha_monitor.physics.simulator import Simulator, demanded_position, total_duration


def segments(**shapes):
    return settings(simulation={"excitation": shapes}).simulation.excitation


# ---- excitation ---------------------------------------------------------------------------------


def test_triangle_has_the_paper_speed_and_amplitude():
    time = np.linspace(0, 8, 8001)
    x = demanded_position(segments(m={**TRIANGLE, "duration": 8.0}), time)
    speed = np.diff(x) / np.diff(time)
    assert np.abs(speed) == pytest.approx(0.04, rel=1e-9)
    assert x.max() == pytest.approx(0.04) and x.min() == pytest.approx(-0.04)
    assert x[0] == 0 and speed[0] > 0
    reversals = time[1:-1][np.diff(np.sign(speed)) != 0]
    assert reversals == pytest.approx([1.0, 3.0, 5.0, 7.0], abs=2e-3)


def test_sine_starts_at_its_mean():
    time = np.linspace(0, 1, 4001)
    x = demanded_position(segments(m={**SINE, "duration": 1.0, "offset": 0.02}), time)
    assert x == pytest.approx(0.02 + 0.01 * np.sin(2 * np.pi * 4 * np.mod(time, 1.0)), abs=1e-15)


@pytest.mark.parametrize("shape, fastest", [(CHIRP, 12.0), (MULTISINE, 20.0), (SINE, 4.0)])
def test_motion_is_continuous_and_within_its_amplitude(shape, fastest):
    time = np.arange(0, 5, 1e-4)
    x = demanded_position(segments(m={**shape, "duration": 5.0}), time)
    assert np.abs(np.diff(x)).max() < 1.2 * shape["amplitude"] * 2 * np.pi * fastest * 1e-4
    # "Half of peak to peak": a multisine is taken from its start, so at most twice that.
    assert np.abs(x).max() <= 2.0 * shape["amplitude"]
    assert abs(x[0]) < 1e-12


def test_chirp_passes_its_frequencies_linearly():
    time = np.arange(0, 8, 1e-4)
    x = demanded_position(segments(m={**CHIRP, "duration": 8.0}), time)
    crossings = time[1:][np.diff(np.signbit(x).astype(int)) != 0]
    middle = 0.5 * (crossings[1:] + crossings[:-1])
    frequency = 0.5 / np.diff(crossings)
    wanted = 0.5 + (12.0 - 0.5) * middle / 8.0
    assert frequency[3:] == pytest.approx(wanted[3:], rel=0.03)


def test_multisine_holds_its_tones_and_no_others():
    time = np.arange(0, 40, 1e-3)
    shape = {**MULTISINE, "frequency": 0.5, "frequency_end": 16.0, "components": 6}
    x = demanded_position(segments(m={**shape, "duration": 40.0}), time)
    tones = 0.5 * 2.0 ** np.arange(6)  # evenly spaced in the logarithm, whole periods in 40 s
    spectrum = np.abs(np.fft.rfft(x - x.mean())) / len(x) * 2
    at = np.round(tones * 40).astype(int)
    assert spectrum[at] == pytest.approx(spectrum[at[0]] * tones[0] / tones, rel=1e-6)
    rest = np.delete(spectrum, at)
    assert rest.max() < 1e-9 * spectrum.max()


def test_stretches_follow_one_another_and_repeat():
    several = segments(rise={**SINE, "duration": 0.5},
                       hold={"kind": "rest", "duration": 0.25, "offset": 0.003},
                       step={"kind": "steps", "duration": 1.0, "frequency": 4.0, "seed": 2})
    assert total_duration(several) == pytest.approx(1.75)
    time = np.arange(0, 1.75, 1e-3)
    first = demanded_position(several, time)
    # A tick beside the edges, where rounding decides which stretch an instant belongs to.
    inside = np.abs(np.mod(time / 0.25 + 0.5, 1.0) - 0.5) > 0.02
    later = demanded_position(several, time + 3 * 1.75)
    assert first[inside] == pytest.approx(later[inside], abs=1e-9)
    assert (first[510:740] == 0.003).all()
    assert len(np.unique(first[inside & (time > 0.76)])) == 4  # four heights in one second


@given(time=st.floats(0, 1e6))
@hypothesis_settings(max_examples=50)
def test_any_time_gives_a_position(time):
    x = demanded_position(segments(a={**TRIANGLE, "duration": 3.0},
                                   b={**CHIRP, "duration": 2.0}), np.array([time]))
    assert np.isfinite(x).all() and abs(x[0]) <= 0.04 + 1e-12


def test_motion_from_a_file(tmp_path):
    path = tmp_path / "motion.csv"
    path.write_text("t,x_d\n0,0\n1,0.01\n3,-0.01\n")
    x = demanded_position(segments(m={"kind": "file", "file": str(path), "duration": 4.0}),
                          np.array([0.0, 0.5, 2.0, 3.5]))
    assert x == pytest.approx([0.0, 0.005, 0.0, -0.01])


@pytest.mark.parametrize("text", ["", "t,x\n0,1\n", "t,x_d\n0,0\n0,1\n", "t,x_d\n0,a\n1,b\n",
                                  "t,x_d\n0,0\n"])
def test_a_bad_motion_file_is_one_line(tmp_path, text):
    path = tmp_path / "motion.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=r"motion\.csv: expected [^\n]*$"):
        demanded_position(segments(m={"kind": "file", "file": str(path)}), np.zeros(1))


def test_a_missing_motion_file_is_one_line():
    with pytest.raises(InputError, match=r"^nowhere\.csv: expected [^\n]*$"):
        Simulator(settings(simulation=motion({"kind": "file", "file": "nowhere.csv"}, 1.0)))


# ---- faults ------------------------------------------------------------------------------------


def test_faults_reach_their_value_as_step_and_as_ramp():
    config = settings(simulation=motion(SINE, 1.0, faults={
        "wear": {"parameter": "viscous_damping", "start": 2.0, "duration": 4.0, "value": 1400.0},
        "burst": {"parameter": "leakage", "start": 3.0, "value": 9e-13},
        "air": {"parameter": "entrained_air.alpha", "start": 1.0, "duration": 2.0,
                "value": 0.02}}))
    simulator = Simulator(config)
    time = np.array([0.0, 2.0, 3.0, 4.0, 6.0, 100.0])
    table = simulator.theta_over(time)
    assert table[:, place_of("viscous_damping")] == pytest.approx(
        [600, 600, 800, 1000, 1400, 1400])
    assert table[:, place_of("leakage")] == pytest.approx([5e-13] * 2 + [9e-13] * 4)
    assert table[:, place_of("entrained_air.alpha")] == pytest.approx(
        [0, 0.01, 0.02, 0.02, 0.02, 0.02])
    assert table[:, place_of("entrained_air.n")] == pytest.approx(1.4)  # its default


def test_a_damping_step_moves_the_plateau():
    truth = simulated(TRIANGLE, 7.0, faults={
        "b": {"parameter": "viscous_damping", "start": 4.0, "value": 1200.0}}).truth
    dp = truth[:, s.P1] - truth[:, s.P2]
    assert dp[2900] == pytest.approx(-600 * 0.04 / 5.05e-4, rel=2e-3)
    assert dp[6900] == pytest.approx(-1200 * 0.04 / 5.05e-4, rel=2e-3)


def test_before_a_fault_nothing_differs():
    fault = {"b": {"parameter": "bulk_modulus", "start": 0.5, "value": 1e8}}
    clean, faulty = simulated(SINE, 1.0).truth, simulated(SINE, 1.0, faults=fault).truth
    assert np.array_equal(clean[:501], faulty[:501])
    assert not np.array_equal(clean[510], faulty[510])


# ---- sensors -----------------------------------------------------------------------------------

ALL = ("x", "v", "x_d", "omega", "p1", "p2", "force", "temperature")


@pytest.fixture(scope="module")
def run():
    return simulated(SINE, 2.0, publish=ALL)


def test_noise_has_the_configured_size_and_is_white(run):
    channels = run.recording(seed=5).channels
    truth = {"x": run.truth[:, s.X], "v": run.truth[:, s.V], "p1": run.truth[:, s.P1],
             "p2": run.truth[:, s.P2], "omega": run.truth[:, s.OMEGA],
             "force": 5.05e-4 * (run.truth[:, s.P1] - run.truth[:, s.P2]), "temperature": 40.0}
    sigma = {"x": 1e-6, "v": 1e-3, "p1": 500.0, "p2": 500.0, "omega": 0.1, "force": 0.5,
             "temperature": 0.05}
    errors = {name: (channels[name] - truth[name]) / sigma[name] for name in sigma}
    for e in errors.values():
        assert e.std() == pytest.approx(1.0, abs=0.07)
        assert abs(e.mean()) < 0.1 and abs(np.mean(e[1:] * e[:-1])) < 0.1
    for a, b in (("p1", "p2"), ("x", "v"), ("x", "p1")):
        assert abs(np.mean(errors[a] * errors[b])) < 0.1
    assert np.array_equal(channels["x_d"], run.truth[:, s.X_D])  # a command has no noise


def test_noise_is_the_seed_s(run):
    a, b, c = run.recording(1), run.recording(1), run.recording(2)
    for name in ALL:
        assert np.array_equal(a.channels[name], b.channels[name])
    assert not np.array_equal(a.channels["x"], c.channels["x"])


def test_channels_do_not_change_one_another_s_noise(run):
    few = simulated(SINE, 2.0, publish=("p2",)).recording(4)
    assert list(few.channels) == ["p2"]
    assert np.array_equal(few.channels["p2"], run.recording(4).channels["p2"])
    louder = run.recording(4, position=1e-4)
    assert np.array_equal(louder.channels["p1"], run.recording(4).channels["p1"])


def test_encoder_shows_whole_steps(run):
    x = run.recording(0, position_resolution=1e-5).channels["x"]
    assert np.abs(x / 1e-5 - np.round(x / 1e-5)).max() < 1e-6
    assert np.abs(x - run.truth[:, s.X]).max() < 1e-5 / 2 + 6e-6
    assert x.std() > 1e-3


# ---- test excitation ----------------------------------------------------------------------------


def test_a_test_excitation_begins_where_the_demand_stands_and_stops_its_time():
    moved = settings(simulation={
        "excitation": {"m": {**TRIANGLE, "duration": 4.0}}, "publish": ["x_d"],
        "test_excitation": {"t": {**SINE, "duration": 0.5, "offset": 0.03}}})
    plain, tested = Simulator(moved, 0), Simulator(moved, 0)
    alone = plain.advance_truth(3000)[:, s.X_D]
    parts = [tested.advance_truth(700)[:, s.X_D]]
    assert tested.test_left == 0.0
    tested.excite()
    tested.excite()  # one runs already: nothing
    assert tested.test_left == pytest.approx(0.5)
    parts += [tested.advance_truth(100)[:, s.X_D] for _ in range(20)]
    assert tested.test_left == 0.0
    found = np.concatenate(parts)
    time = np.arange(500) * 1e-3
    assert found[:700] == pytest.approx(alone[:700], abs=1e-12)
    assert found[701:1199] == pytest.approx(
        alone[700] + 0.01 * np.sin(2 * np.pi * 4 * time[1:499]), abs=1e-6)
    assert found[1201:2700] == pytest.approx(alone[701:2200], abs=1e-9)
    tested.excite()
    again = tested.advance_truth(200)[:, s.X_D]
    assert np.ptp(again) > 0.015


def test_without_a_request_nothing_is_excited():
    quiet = settings(simulation={"test_excitation": {"t": {**SINE, "duration": 0.5}}})
    seen, usual = Simulator(quiet, 3).advance(500), Simulator(settings(), 3).advance(500)
    assert all((seen[name] == usual[name]).all() for name in usual)


@pytest.mark.parametrize("effects", [
    {"constant_load": {"F_0": 500.0}}, {"constant_load": {"F_0": -500.0}},
    {"spring_load": {"k": 2e4, "x_0": 0.02}}])
def test_a_rig_begins_at_rest_with_pressures_that_hold_its_load(effects):
    """It had begun at the charge pressure, and the load fell first; closed form of the hold."""
    rig = Simulator(settings(effects=effects))
    theta = rig.theta
    force = theta[s.AREA_1] * rig.y[2] - theta[s.AREA_2] * rig.y[3]
    assert force == pytest.approx(effects.get("constant_load", {}).get("F_0", -400.0))
    assert rig.y[2] + rig.y[3] == pytest.approx(
        theta[s.P_CHARGE] * (1.0 + theta[s.AREA_1] / theta[s.AREA_2]))
    rig.advance(2)
    assert abs(rig.y[1]) < 1e-3
