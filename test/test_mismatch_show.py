"""The proof on unseen data, and the model as a config."""

import json
from dataclasses import replace

import numpy as np
import pytest
from mismatch_tools import fitted, nominal_fit
from rig_tools import MULTISINE, B, real, settings, simulated, with_channels

from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.data.inputs import cut
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.mismatch.diagnosis import Agreement, Value
from eha_monitor.mismatch.name.refit import Slopes, polished, unfitted
from eha_monitor.mismatch.show.held_out import (
    agreement,
    force_residual,
    free_runs,
    overlays,
    righted,
    shown,
    windows_of,
)
from eha_monitor.mismatch.show.model import config_effects, in_doubt, replaced, stated_stddev
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of, theta_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.load import settings_from_tree


def test_the_true_model_misses_by_the_noise_alone():
    case = fitted(motion="rich")
    found = shown(case.experiment, case.before, case.after)
    assert set(found) == {"position", "pressure_1", "pressure_2", "pump_speed", "force"}
    for name, true in (("position", 2e-6), ("pressure_1", 2e3), ("pressure_2", 2e3),
                       ("pump_speed", 0.1)):
        signal = found[name]
        assert signal.after_rms == pytest.approx(true, rel=0.1)
        assert signal.before_rms == signal.after_rms
        assert signal.noise_rms == pytest.approx(true, rel=0.1)
        assert 0.9 < signal.after_whiteness < 1.5


def test_naming_the_friction_takes_the_error_away():
    case = fitted("coulomb_friction", motion="rich")
    found = shown(case.experiment, case.before, case.after)
    pressure = found["pressure_1"]
    assert pressure.before_rms > 8 * pressure.noise_rms
    assert pressure.after_rms < 1.15 * pressure.noise_rms
    assert pressure.before_whiteness > 3.0 > 1.5 > pressure.after_whiteness
    assert found["position"].before_rms > 2 * found["position"].after_rms
    assert found["position"].unit == "m"


def test_windows_lie_in_what_was_held_out():
    case = fitted("coulomb_friction", motion="rich")
    windows = windows_of(case.experiment, 0.5)
    assert len(windows) == 8  # a second of every five
    runs = free_runs(case.experiment, case.before)
    covered = np.isfinite(runs.e[0][:, 0])
    assert (covered == case.experiment.stretches[0].held_out).all()
    assert len(runs.residual(0)) == 4000


def test_the_fit_does_not_see_what_is_held_out_and_the_proof_does():
    case = fitted("coulomb_friction")
    stretch, = case.experiment.stretches
    assert not (stretch.held_out & stretch.counted).any()
    z = stretch.z.copy()
    late = np.flatnonzero(stretch.held_out)
    z[late[len(late) // 4 :]] *= 1.3
    changed = case.experiment.only((replace(stretch, z=z),))
    one = polished(case.experiment, case.before, Slopes(case.experiment), 3)
    other = polished(changed, case.before, Slopes(changed), 3)
    assert (one.theta == other.theta).all()
    assert one.log_likelihood == other.log_likelihood
    was = shown(case.experiment, case.before, case.after)
    now = shown(changed, case.before, case.after)
    assert now["position"].after_rms > 10 * was["position"].after_rms


def test_another_recording_is_unseen_as_a_whole():
    case, other = fitted("coulomb_friction"), fitted("coulomb_friction", told=False, seed=4)
    unseen = experiment_of([other.recording], case.experiment.settings, False)
    found = shown(unseen, case.before, case.after)
    assert found["pressure_1"].after_rms < 1.3 * found["pressure_1"].noise_rms
    assert found["pressure_1"].before_rms > 3 * found["pressure_1"].noise_rms
    runs = free_runs(unseen, case.after)
    assert len(runs.residual(0)) > 5000


def test_overlays_show_the_worst_second_of_unseen_data():
    case = fitted("coulomb_friction", motion="rich")
    found = overlays(case.experiment, case.before, case.after)
    assert [one.signal for one in found] == ["position", "pressure_1", "pressure_2", "pump_speed"]
    for one in found:
        assert len(one.time) == len(one.measured) == len(one.before) == len(one.after) == 1000
        assert ((np.mod(one.time, 5.0) >= 3.999) | (one.time < 1e-9)).all()
        worse = np.sqrt(np.mean((one.measured - one.before) ** 2))
        better = np.sqrt(np.mean((one.measured - one.after) ** 2))
        assert worse > better


def test_parts_agree_once_the_friction_is_named():
    case = fitted("coulomb_friction", motion="rich")
    parts = {one.part: one for one in agreement(case.experiment, case.before, case.after)}
    assert set(parts) == {"slow half", "fast half", "small pressure differences",
                          "large pressure differences"}
    slow, fast = parts["slow half"], parts["fast half"]
    # 40 N at a low speed look like more damping than at a high one.
    assert slow.before["B"].value > fast.before["B"].value + 200.0
    for one in parts.values():
        assert one.after["B"].value == pytest.approx(600.0, rel=0.03)
        assert one.after["beta_e"].value == pytest.approx(6e8, rel=0.01)
        assert one.after["B"].unit == "N·s/m"


def forced(friction: float, seconds: float = 12.0):
    """Return a mass on a damper, driven by a force, by exact steps far finer than the samples."""
    mass, b, fine = 20.0, 100.0, 10
    t = np.arange(round(seconds * 1e3) * fine) / (1e3 * fine)
    force = 120.0 * np.sin(2 * np.pi * 0.7 * t) + 40.0 * np.sin(2 * np.pi * 2.3 * t)
    x, v, h = np.zeros(len(t)), 0.0, t[1]
    for k in range(len(t) - 1):
        v += h * (force[k] - b * v - friction * np.tanh(v / 1e-3)) / mass
        x[k + 1] = x[k] + h * v
    x = x[::fine] + np.random.default_rng(0).normal(0.0, 1e-6, len(t) // fine)
    tree = {"rig": {"area_1": None, "area_2": None, "volume_1": None, "volume_2": None,
                    "pump_displacement": None, "position_gain": None, "mass": mass,
                    "viscous_damping": b, "sample_time": 1e-3}}
    settings = settings_from_tree({"/**": {"ros__parameters": tree}}, "forced")
    return experiment_of([Recording(1e-3, {"x": x, "force": force[::fine]})], settings)


@pytest.mark.slow
def test_a_sensor_that_drifts_through_a_long_recording_is_named():
    """Windows of it are fitted, and in each of them it has drifted since the beginning."""
    recording = simulated(MULTISINE, 32.0).recording(1)
    drift = -400.0 * recording.sample_time * np.arange(len(recording))
    found = diagnose([with_channels(recording, p2=recording.channels["p2"] + drift)], settings())
    assert (found.verdict, [effect.name for effect in found.effects]) == (
        "mismatch", ["pressure_drift"])
    assert found.effects[0].parameters["d_2"].value == pytest.approx(-400.0, rel=0.01)
    assert found.after["B"].value == pytest.approx(B, rel=0.02)


def test_what_a_sensor_has_drifted_is_taken_off_in_every_window():
    recording = simulated(MULTISINE, 4.0).recording(1)
    drift = 5e3 * recording.sample_time * np.arange(len(recording))
    drifted = with_channels(recording, p1=recording.channels["p1"] + drift)
    right, wrong = (experiment_of([one], settings(
        effects={"pressure_drift": {"d_1": rate, "d_2": 0.0}}))
        for one, rate in ((recording, 0.0), (drifted, 5e3)))
    window = cut(wrong.stretches[0], 2000, 4000, recording.sample_time)
    np.testing.assert_allclose(righted(wrong, unfitted(wrong), window).p1,
                               right.stretches[0].p1[2000:], atol=20.0)


def test_force_residual_of_a_mass_on_a_damper():
    clean = forced(0.0)
    residual, force = force_residual(clean, nominal_fit(clean))
    assert force == pytest.approx(np.hypot(120.0, 40.0) / np.sqrt(2.0), rel=0.1)
    assert residual < 0.01 * force
    dry = forced(10.0)
    nominal = nominal_fit(dry)
    found = shown(dry, nominal, nominal)
    assert found["force"].unit == "N"
    assert 2.0 < found["force"].before_rms < 8.0  # 10 N, of which the damping takes a part


def test_force_residual_of_emps_is_below_the_published_one():
    recordings, settings = real("emps", "emps/DATA_EMPS.mat")
    settings = settings.model_copy(update={"effects": {
        "coulomb_friction": {"F_c": 20.39, "v_e": 2e-4, "z_0": 1e-5, "t_1": 0.0, "w": 0.0,
                             "v_d": 5e-3},
        "constant_load": {"F_0": -3.16}}})
    experiment = experiment_of(recordings, settings)
    residual, force = force_residual(experiment, nominal_fit(experiment))
    assert residual < 0.045 * force


def test_what_stays_unexplained_leaves_b_as_uncertain_as_the_parts_differ():
    known = {"B": Value(600.0, 3.0, "N·s/m"), "beta_e": Value(6e8, 1e6, "Pa")}
    parts = tuple(Agreement(name, {}, {"B": Value(b, 5.0, "N·s/m")})
                  for name, b in (("slow half", 596.0), ("fast half", 640.0)))
    found = in_doubt(known, parts)
    assert found["B"].value == 600.0 and found["B"].stddev == pytest.approx(np.hypot(3.0, 40.0))
    assert found["beta_e"] == known["beta_e"]  # no part says anything of it
    assert in_doubt(known, ()) == known


def test_a_named_delay_is_known_no_better_than_a_sensors_own_lag():
    case = fitted("command_delay")
    own = case.after.stddev("command_delay.T")
    floor = 0.05 * 1e-3 / np.sqrt(3.0)
    assert own < 0.1 * floor
    assert stated_stddev(case.experiment, case.after, "command_delay.T") == pytest.approx(
        np.hypot(own, floor))
    assert stated_stddev(case.experiment, case.after, "B") == case.after.stddev("B")


# ---- the model as a config ---------------------------------------------------------------------


def test_a_law_whose_place_another_took_is_in_no_written_config():
    """Both would be twice the friction: 50 N of a config beside 50 N that build up over travel."""
    case, name = fitted("coulomb_friction"), "coulomb_friction"
    values = config_effects(case.experiment, case.after, (name,))
    known = replace(case.experiment, active=case.after.active, settings=settings_from_tree(
        {"effects": values}, "a config that has it"))
    assert config_effects(known, case.after, ()) == values
    gone = case.after.active.copy()
    gone[NAMES.index(name)] = False
    assert config_effects(known, replace(case.after, active=gone), ()) == {}
    assert (replaced(known, replace(case.after, active=gone)), replaced(known, case.after)) == (
        [name], [])


def test_named_physics_goes_through_a_config_and_explains_the_record():
    """As a config it is known: B and the likelihood are those of the fit that found it."""
    case = fitted("coulomb_friction")
    found = config_effects(case.experiment, case.after, ("coulomb_friction",))
    assert set(found) == {"coulomb_friction"}
    assert config_effects(case.experiment, case.after, ()) == {}
    tree = json.loads(json.dumps({**case.experiment.settings.model_dump(mode="json"),
                                  "effects": found}))
    again = settings_from_tree(tree, "written")
    theta, active = theta_of(again.rig, again.effects)
    for p in CATALOGUE["coulomb_friction"].parameters:
        place = place_of(f"coulomb_friction.{p.name}")
        assert theta[place] == pytest.approx(case.after.theta[place], rel=1e-9, abs=1e-15)
    assert active[NAMES.index("coulomb_friction")]
    explained = nominal_fit(replace(case.experiment, settings=again, theta=theta, active=active))
    assert explained.named == ()
    assert explained.log_likelihood > case.before.log_likelihood + 0.98 * (
        case.after.log_likelihood - case.before.log_likelihood)
    assert explained.value("B") == pytest.approx(600.0, rel=0.02)
