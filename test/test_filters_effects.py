"""B and beta_e with known effects in the config: one case for each way of modelling them."""

import sys
from pathlib import Path

import numpy as np
import pytest
from rig_tools import settings, with_channels, without
from test_live_estimator import Stream, rows_of

from eha_monitor.estimation.pipeline import estimate
from eha_monitor.estimation.sensors import before_play, earlier

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))
from known_effects import answer, reached, recording_of

CHANNELS = ("x", "x_d", "omega", "p1", "p2")
SOME = ("added_mass", "coulomb_friction", "spring_load", "quadratic_friction",
        "cross_port_leakage", "position_dependent_volume", "pump_dead_zone", "line_dynamics",
        "drive_lag", "command_delay, 1.6 ms", "position_scale, in loop", "backlash",
        "pressure_delay, 1.6 ms", "pressure_offset")
# Effects that the drive makes of x_d and x where the pump speed is not recorded.
MADE = ("drive_lag", "drive_saturation", "feedback_delay", "position_scale, in loop",
        "pump_flow_gain", "line_dynamics")
COMBINED = {"coulomb_friction": {"F_c": 30.0, "z_0": 3e-6}, "pressure_offset": {"b_1": 3e4},
            "drive_lag": {"tau": 3e-3}, "position_delay": {"T": 1.3e-3},
            "line_dynamics": {"T_l": 1.5e-3}, "cross_port_leakage": {"L": 1e-12}}


def told(found):
    return (found.parameters["B"].value, found.parameters["beta_e"].value / 1e6,
            found.model.message)


@pytest.mark.parametrize("case", SOME)
def test_known_physics_is_not_in_b_and_beta_e(case):
    recording, effects = recording_of(case, CHANNELS, seconds=12.0)
    known = answer(recording, effects)
    assert reached(known), told(known)


@pytest.mark.parametrize("case", ["coulomb_friction", "pump_dead_zone", "position_scale"])
def test_left_out_it_is(case):
    recording, _ = recording_of(case, CHANNELS, seconds=12.0)
    assert not reached(answer(recording, {}))


@pytest.mark.parametrize("case", MADE)
def test_the_drive_is_followed_where_the_pump_speed_is_not_recorded(case):
    recording, effects = recording_of(case, ("x", "x_d", "p1", "p2"), seconds=12.0)
    known = answer(recording, effects)
    assert reached(known), told(known)


@pytest.mark.parametrize("case", ["cross_port_leakage", "pump_volumetric_loss", "line_dynamics"])
def test_pressures_that_are_not_recorded_come_from_the_stage_itself(case):
    recording, effects = recording_of(case, ("x", "x_d", "omega"), seconds=12.0)
    beta = answer(recording, effects).parameters["beta_e"]
    # B is the nominal 600 ± 100 N·s/m here.
    assert beta.status == "converged" and beta.value == pytest.approx(6e8, rel=0.03)


def test_several_at_once_and_live_as_offline():
    config = {"effects": COMBINED, "noise": {"fixed": True, "position": 2e-6, "pressure": 2e3,
                                             "pump_speed": 0.1}}
    recording, _ = recording_of("none", CHANNELS, seconds=12.0, effects=COMBINED)
    offline = estimate(recording.part(0, 11_990), settings(**config))
    assert reached(offline), told(offline)
    made = Stream(**config)
    live = made.push(rows_of(recording)).parameters
    for name in ("B", "beta_e"):
        mine, theirs = live[name], offline.parameters[name]
        assert mine.status == "converged"
        assert abs(mine.value - theirs.value) < 1.0 * theirs.stddev, name
        assert mine.stddev == pytest.approx(theirs.stddev, rel=0.2)
    assert made.history[-1].model.status == "consistent"
    assert not made.told("changed")


def test_a_gap_does_no_harm_to_what_is_remembered():
    recording, effects = recording_of("line_dynamics", CHANNELS, seconds=12.0)
    effects = {**effects, "position_delay": {"T": 0.0}}
    channels = {name: values.copy() for name, values in recording.channels.items()}
    for name, values in channels.items():
        values[4000:4300] = np.nan
        values[7000 if name == "omega" else 7050] = np.nan
    known = answer(with_channels(recording, **channels), effects)
    assert reached(known), told(known)


def test_without_drive_or_pressure_there_is_an_answer_with_its_reason():
    recording, effects = recording_of("drive_lag", ("x", "p1", "p2"), seconds=12.0)
    known = answer(recording, effects)
    assert known.parameters["beta_e"].status == "no_data"
    assert known.parameters["B"].value == pytest.approx(600.0, rel=0.01)
    alone = answer(without(recording, "p1", "p2"), effects)
    assert alone.parameters["B"].status == "no_data"


# ---- sensors ---------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [0.0, 1.0, 2.5, 0.3])
def test_a_late_channel_is_read_later(samples):
    t = np.arange(400) * 1e-3
    late = np.sin(40.0 * (t - samples * 1e-3))
    found = earlier(late, samples)
    seen = np.isfinite(found)
    assert seen[5:-5].all() and seen.sum() >= len(t) - np.ceil(samples) - 2
    assert np.abs(found - np.sin(40.0 * t))[5:-5].max() < 1e-6


def test_behind_a_play_the_position_is_known_only_while_the_sensor_moves():
    t = np.arange(4000) * 1e-3
    x = 0.01 * np.sin(3.0 * t)
    shown = np.empty_like(x)
    shown[0] = played = x[0]
    for k in range(1, len(x)):
        shown[k] = played = min(max(played, x[k] - 1e-4), x[k] + 1e-4)
    noise = 1e-6 * np.random.default_rng(0).standard_normal(len(x))
    found = before_play(shown + noise, 2e-4, 1e-6)
    known = np.isfinite(found)
    assert 0.7 < known.mean() < 0.99
    assert np.abs(found - x)[known].max() < 6e-6
