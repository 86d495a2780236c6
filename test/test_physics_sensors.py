"""Effects of the drive and of the sensors in the simulator, against independent closed forms."""

import json
from functools import cache

import numpy as np
import pytest
from rig_tools import (
    K_POS,
    MULTISINE,
    SENSORS,
    SILENT,
    SINE,
    T_S,
    TRIANGLE,
    A,
    motion,
    settings,
)
from scipy.interpolate import CubicSpline

from eha_monitor.cli import main
from eha_monitor.physics import signals as s
from eha_monitor.physics.effect import Ranges
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import place_of
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.read import read_recording
from eha_monitor.settings import settings_from_tree


def simulator(shape, seconds, effects=None, **simulation):
    return Simulator(settings(effects=effects or {}, simulation=motion(
        shape, seconds, noise=SILENT, publish=SENSORS, **simulation)))


def both(shape, seconds, effects=None, **simulation):
    """Return what the sensors show without noise, channel -> (n,), and the truth (n, 7)."""
    n = round(seconds / T_S)
    return (simulator(shape, seconds, effects, **simulation).advance(n),
            simulator(shape, seconds, effects, **simulation).advance_truth(n))


def fourier(signal, frequency=4.0):
    """Complex amplitude over the last whole second."""
    last = signal[-1000:]
    return 2 * np.mean(last * np.exp(-2j * np.pi * frequency * T_S * np.arange(1000)))


# ---- sensors -----------------------------------------------------------------------------------


def late(values, delay):
    """A signal that was at rest before the record, ``delay`` s later."""
    time = np.arange(len(values)) * T_S
    padded = np.concatenate([np.full(200, values[0]), values])
    spline = CubicSpline(np.arange(-200, len(values)) * T_S, padded)
    return spline(time - delay)


@pytest.mark.parametrize("delay", [2e-5, 3e-4, 2e-3, 4.3e-3, 0.05])
def test_position_delay_shifts_the_recorded_position_only(delay):
    shown, truth = both(MULTISINE, 1.0, {"position_delay": {"T": delay}})
    _, clean = both(MULTISINE, 1.0)
    assert np.array_equal(truth, clean)
    assert shown["x"][200:] == pytest.approx(late(truth[:, s.X], delay)[200:], abs=2e-8)
    assert shown["p1"] == pytest.approx(truth[:, s.P1], rel=1e-12)


@pytest.mark.parametrize("delay", [3e-4, 2e-3, 4.3e-3])
def test_pressure_delay_shifts_both_pressures_only(delay):
    shown, truth = both(MULTISINE, 1.0, {"pressure_delay": {"T": delay}})
    for name, place in (("p1", s.P1), ("p2", s.P2)):
        swing = np.ptp(truth[:, place])
        assert shown[name][200:] == pytest.approx(late(truth[:, place], delay)[200:],
                                                  abs=2e-3 * swing)
        assert np.abs(shown[name] - truth[:, place]).max() > 4e-3 * swing
    assert shown["x"] == pytest.approx(truth[:, s.X], abs=1e-15)


def test_scale_offset_and_drift_of_the_pressures():
    shown, truth = both(SINE, 1.0, {
        "pressure_scale": {"k_1": 0.08, "k_2": -0.024}, "pressure_offset": {"b_1": 4e4, "b_2": 0},
        "pressure_drift": {"d_1": 0.0, "d_2": -3e3}})
    time = np.arange(1000) * T_S
    assert shown["p1"] == pytest.approx(1.08 * truth[:, s.P1] + 4e4, rel=1e-12)
    assert shown["p2"] == pytest.approx(0.976 * truth[:, s.P2] - 3e3 * time, rel=1e-12)
    assert np.array_equal(truth, both(SINE, 1.0)[1])


def test_position_scale_in_the_recording_and_in_the_loop():
    shown, truth = both(SINE, 1.0, {"position_scale": {"k": 0.03}})
    assert shown["x"] == pytest.approx(1.03 * truth[:, s.X], abs=1e-15)
    assert np.array_equal(truth, both(SINE, 1.0)[1])
    shown, truth = both(SINE, 3.0, {"position_scale": {"k": 0.03, "in_loop": 1.0}})
    assert shown["x"] == pytest.approx(1.03 * truth[:, s.X], abs=1e-15)
    assert truth[:, s.OMEGA] == pytest.approx(K_POS * (truth[:, s.X_D] - shown["x"]), abs=1e-8)


def play(x, width):
    """The play operator, sample by sample."""
    behind = np.empty_like(x)
    held = x[0]
    for k, value in enumerate(x):
        held = min(max(held, value - width / 2), value + width / 2)
        behind[k] = held
    return behind


@pytest.mark.parametrize("in_loop", [0.0, 1.0])
def test_backlash_is_the_play_operator(in_loop):
    values = {"b": 4e-4, "in_loop": in_loop}
    shown, truth = both(SINE, 1.0, {"backlash": values}, substeps=10)
    # Between samples the piston turns by less than a t^2/8 beyond the sample.
    assert shown["x"] == pytest.approx(play(truth[:, s.X], 4e-4), abs=3e-6)
    assert np.ptp(shown["x"] - truth[:, s.X]) == pytest.approx(4e-4, rel=1e-3)
    read = shown["x"] if in_loop else truth[:, s.X]
    assert truth[:, s.OMEGA] == pytest.approx(K_POS * (truth[:, s.X_D] - read), abs=1e-7)


def test_quantisation_is_the_simulator_s_noise_section():
    with_entry, _ = both(SINE, 0.2, {"position_quantisation": {"q": 1e-5}})
    without, _ = both(SINE, 0.2)
    assert np.array_equal(with_entry["x"], without["x"])


# ---- drive -------------------------------------------------------------------------------------


def drive_response(effects):
    """Complex amplitudes of x_d, x, omega on a sine of 4 Hz."""
    truth = both(SINE, 4.0, effects)[1]
    return (fourier(truth[:, i]) for i in (s.X_D, s.X, s.OMEGA))


JW = 2j * np.pi * 4


@pytest.mark.parametrize("effects, expected", [
    ({}, lambda x_d, x: x_d - x),
    ({"drive_gain": {"k": -0.03}}, lambda x_d, x: 0.97 * (x_d - x)),
    ({"drive_lag": {"tau": 4e-3}}, lambda x_d, x: (x_d - x) / (1 + 4e-3 * JW)),
    ({"drive_lag": {"tau": 5e-4}}, lambda x_d, x: (x_d - x) / (1 + 5e-4 * JW)),
    ({"command_delay": {"T": 4e-3}}, lambda x_d, x: x_d * np.exp(-4e-3 * JW) - x),
    ({"command_delay": {"T": 2e-4}}, lambda x_d, x: x_d * np.exp(-2e-4 * JW) - x),
    ({"feedback_delay": {"T": 4e-3}}, lambda x_d, x: x_d - x * np.exp(-4e-3 * JW)),
    ({"feedback_delay": {"T": 2e-5}}, lambda x_d, x: x_d - x * np.exp(-2e-5 * JW)),
    ({"feedback_delay": {"T": 0.02}, "command_delay": {"T": 0.01}, "drive_lag": {"tau": 0.01}},
     lambda x_d, x: (x_d * np.exp(-0.01 * JW) - x * np.exp(-0.02 * JW)) / (1 + 0.01 * JW))])
def test_drive_answers_a_sine_as_its_transfer_function(effects, expected):
    x_d, x, omega = drive_response(effects)
    assert omega == pytest.approx(K_POS * expected(x_d, x), rel=2e-6)


def test_command_delay_is_the_same_motion_later():
    _, delayed = both(MULTISINE, 1.0, {"command_delay": {"T": 3e-3}})
    _, clean = both(MULTISINE, 1.0)
    assert delayed[3:, s.X] == pytest.approx(clean[:-3, s.X], abs=1e-10)
    assert np.array_equal(delayed[:, s.X_D], clean[:, s.X_D])  # recorded where it is made


def test_speed_limit_clips_and_nothing_else():
    shown, truth = both(MULTISINE, 2.0, {"drive_saturation": {"omega_max": 60.0}})
    wanted = K_POS * (truth[:, s.X_D] - truth[:, s.X])
    assert (np.abs(wanted) > 70).any()
    assert truth[:, s.OMEGA] == pytest.approx(np.clip(wanted, -60, 60), abs=1e-8)
    assert np.array_equal(shown["omega"], truth[:, s.OMEGA])


def test_slew_limit_holds_the_rate_and_is_reached():
    slew = 2e3
    _, truth = both({"kind": "steps", "amplitude": 0.005, "frequency": 2.0, "seed": 1}, 3.0,
                    {"drive_saturation": {"slew": slew}})
    wanted = K_POS * (truth[:, s.X_D] - truth[:, s.X])
    rate = np.abs(np.diff(truth[:, s.OMEGA])) / T_S
    assert rate.max() == pytest.approx(slew, rel=1e-6)
    assert np.mean(rate > 0.999 * slew) > 0.02  # after each step it is the limit that acts
    slow = rate[-200:].max() < 0.5 * slew
    assert slow and truth[-200:, s.OMEGA] == pytest.approx(wanted[-200:], rel=0.01, abs=0.2)


# ---- the whole catalogue in the simulator ------------------------------------------------------


@cache
def ranges():
    """What the clean multisine covers."""
    truth = both(MULTISINE, 0.4)[1]
    x, v, p1, p2, omega = truth[:, [s.X, s.V, s.P1, s.P2, s.OMEGA]].T
    dp = np.abs(p1 - p2)
    return Ranges(np.abs(v).max(), np.abs(x - x.mean()).max(), np.abs(np.gradient(v, T_S)).max(),
                  (*np.quantile(dp, [0.5, 0.9, 0.98]), dp.max()),
                  tuple(np.quantile(np.minimum(p1, p2), [0.002, 0.02, 0.2])), 2e6,
                  (*np.quantile(np.abs(omega), [0.5, 0.9, 0.98]), np.abs(omega).max()),
                  tuple(np.quantile(np.abs(np.gradient(omega, T_S)), [0.9, 0.98, 1.0])),
                  A * dp.max(), A * np.abs(v).max(), T_S, 0.4)


def instance(effect):
    """A start of a fit that is inside the bounds of a config."""
    start = (effect.starts(ranges()) or ({"q": 1e-5},))[-1]
    return {p.name: min(max(start[p.name], p.lower), p.upper) for p in effect.parameters
            if p.name in start}


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=lambda effect: effect.name)
def test_every_effect_runs_and_shows_itself(effect):
    shown, _ = both(MULTISINE, 0.4, {effect.name: instance(effect)})
    clean, _ = both(MULTISINE, 0.4)
    assert all(np.isfinite(values).all() for values in shown.values())
    differs = [name for name in shown if not np.array_equal(shown[name], clean[name])]
    silent = effect.name == "position_quantisation"
    assert bool(differs) != silent, differs
    if effect.balance == "sensor" and "in_loop" not in instance(effect):
        kind = effect.name.split("_")[0]
        assert set(differs) <= ({"x"} if kind == "position" else {"p1", "p2", "force"})


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=lambda effect: effect.name)
def test_a_fault_brings_an_effect_in(effect):
    values = instance(effect)
    size = effect.sizes[-1].name
    fault = {"f": {"parameter": f"{effect.name}.{size}", "start": 0.2, "duration": 0.05,
                   "value": values[size]}}
    shown, truth = both(TRIANGLE, 0.4, faults=fault)
    clean, _ = both(TRIANGLE, 0.4)
    assert all(np.isfinite(values).all() for values in shown.values())
    assert shown["x"][:200] == pytest.approx(clean["x"][:200], abs=1e-12)
    assert np.abs(truth[:, s.V]).max() < 0.2
    table = simulator(TRIANGLE, 0.4, faults=fault).theta_over(np.array([0.0, 0.3]))
    absent = min(effect.sizes[-1].neutral, effect.sizes[-1].upper)
    assert table[:, place_of(f"{effect.name}.{size}")] == pytest.approx([absent, values[size]])


def test_all_effects_at_once_survive_a_config_and_a_simulation():
    effects = {name: instance(effect) for name, effect in CATALOGUE.items()}
    config = settings(effects=effects, simulation=motion(MULTISINE, 0.5))
    assert settings_from_tree(config.model_dump(), "x") == config
    shown = Simulator(config).advance(500)
    assert all(np.isfinite(values).all() for values in shown.values())


def test_simulate_writes_a_bag_with_all_effects(tmp_path, capsys):
    effects = {name: instance(effect) for name, effect in CATALOGUE.items()}
    config = tmp_path / "all.yaml"
    config.write_text(json.dumps({"effects": effects}), encoding="utf-8")  # JSON is YAML
    bag = tmp_path / "bag"
    assert main(["simulate", "--config", str(config), "--out", str(bag), "--duration", "1"]) == 0
    assert "1000 samples" in capsys.readouterr().out
    x = read_recording(bag, settings()).channels["x"]
    assert len(x) == 1000 and np.isfinite(x).all()
