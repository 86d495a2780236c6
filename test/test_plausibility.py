"""Signs, units and channels that a recording contradicts: what is told, and what is not."""

import contextlib
import json
import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from command_tools import refused
from hypothesis import given, strategies
from hypothesis import settings as property_settings
from rig_tools import MULTISINE, TRIANGLE, fed, motion, settings
from scipy.signal import lfilter

from eha_monitor import cli
from eha_monitor.errors import InputError
from eha_monitor.physics.simulator import Simulator
from eha_monitor.plausibility.held import held
from eha_monitor.plausibility.judge import (
    corrected,
    plausibility_of,
    reading_of,
    stuck,
    unsigned,
)
from eha_monitor.plausibility.moments import derivatives, moments_of
from eha_monitor.plausibility.relations import charge, ratio
from eha_monitor.recordings.position import astray, trusted
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import write_recording

SENSORS = ("x", "x_d", "omega", "p1", "p2")
RPM = 2 * math.pi / 60
# Another rig than the paper's: a single rod, 500 Hz, 20 bar.
OTHER = {"area_1": 1.2e-3, "area_2": 8e-4, "volume_1": 2e-4, "volume_2": 1.4e-4, "mass": 60.0,
         "viscous_damping": 2500.0, "bulk_modulus": 9e8, "pump_displacement": 5e-7,
         "position_gain": 14000.0, "charge_pressure": 2e6, "sample_time": 2e-3}


def made(shape=MULTISINE, seconds=12.0, effects=None, **rig):
    """Return a recording of the simulator and the config it was made with."""
    config = settings(rig=rig, simulation=motion(shape, seconds, publish=list(SENSORS)),
                      effects=effects or {})
    plant = Simulator(config, seed=4)
    channels = plant.advance(round(seconds / config.rig.sample_time))
    return (Recording(config.rig.sample_time, channels, 10**9, "made"),
            settings(rig=rig, simulation=motion(shape, seconds, publish=list(SENSORS))))


PAPER = made(TRIANGLE, 8.0)
SECOND = made(MULTISINE, 7.0, **OTHER)


def changed(recording, **factors):
    """Return a recording with channels scaled, or replaced by another channel."""
    channels = dict(recording.channels)
    for name, how in factors.items():
        channels[name] = recording.channels[how] if isinstance(how, str) else (
            recording.channels[name] * how)
    return replace(recording, channels=channels)


def with_rig(config, **factors):
    tree = config.model_dump()
    for key, factor in factors.items():
        tree["rig"][key] *= factor
    return settings(**tree)


MISTAKES = {
    "pressures swapped": (dict(p1="p2", p2="p1"), "swapped", ("p1", "p2"), "swapped"),
    "x in mm": (dict(x=1e3), "unit", ("x",), "millimetres"),
    "x and x_d in mm": (dict(x=1e3, x_d=1e3), "unit", ("x", "x_d"), "millimetres"),
    "bar": (dict(p1=1e-5, p2=1e-5), "unit", ("p1", "p2"), "bar"),
    "one in bar": (dict(p1=1e-5), "unit", ("p1",), "bar"),
    "kPa": (dict(p1=1e-3, p2=1e-3), "unit", ("p1", "p2"), "kPa"),
    "rpm": (dict(omega=1 / RPM), "unit", ("omega",), "rpm"),
    "pump reversed": (dict(omega=-1), "sign", ("omega",), "wrong sign"),
    "x reversed": (dict(x=-1), "sign", ("x",), "wrong sign"),
    "both reversed": (dict(x=-1, x_d=-1), "sign", ("x", "x_d"), "wrong sign"),
    "x_d reversed": (dict(x_d=-1), "sign", ("x_d",), "wrong sign"),
    "x and x_d swapped": (dict(x="x_d", x_d="x"), "swapped", ("x", "x_d"), "swapped"),
    "x_d's column as x": (dict(x="x_d"), "swapped", ("x", "x_d"), "same numbers"),
    "inches": (dict(x=1 / 0.0254, x_d=1 / 0.0254), "unit", ("x", "x_d"), "inches"),
}


@pytest.mark.parametrize("case", [PAPER, SECOND], ids=["paper", "single rod"])
@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_of_a_channel_is_named_and_mended(case, name):
    recording, config = case
    factors, kind, channels, word = MISTAKES[name]
    wrong = changed(recording, **factors)
    found = plausibility_of(wrong, config)
    assert found.blocking
    first = found.findings[0]
    assert (first.kind, first.channels) == (kind, channels), found.message
    assert word in first.finding
    if "same" not in word:  # one of two columns is not there: no key brings it back
        mended = corrected(config, found.findings)
        again = {n: channel.scale * wrong.channels[n] + channel.offset
                 for n, channel in mended.channels.items() if n in SENSORS} if kind != "swapped" \
            else {**recording.channels}
        assert not plausibility_of(replace(wrong, channels=again), config).findings
        for n in SENSORS:
            assert again[n] == pytest.approx(recording.channels[n], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("case", [PAPER, SECOND], ids=["paper", "single rod"])
@pytest.mark.parametrize(("factors", "keys"), [
    ({"mass": 10.0}, ("mass",)), ({"mass": 0.1}, ("mass",)),
    ({"area_1": 10.0, "area_2": 10.0}, ("area_1", "area_2")),
    ({"area_1": 0.01, "area_2": 0.01}, ("area_1", "area_2")),
    ({"pump_displacement": 2 * math.pi}, ("pump_displacement",)),
    ({"position_gain": 10.0}, ("position_gain",))])
def test_a_number_of_the_rig_that_is_far_off_is_named_and_mended(case, factors, keys):
    recording, config = case
    found = plausibility_of(recording, with_rig(config, **factors))
    assert found.blocking
    assert found.findings[0].channels == keys, found.message
    right = {key: getattr(config.rig, key) for key in keys}
    for key, value in found.findings[0].correction["rig"].items():
        assert value == pytest.approx(right[key], rel=0.02)


@pytest.mark.parametrize("factor", [10.0, 0.1, 1000.0])
@pytest.mark.parametrize("case", [PAPER, SECOND], ids=["paper", "single rod"])
def test_a_clock_that_runs_wrong_is_named(case, factor):
    recording, config = case
    found = plausibility_of(replace(recording, sample_time=recording.sample_time * factor), config)
    assert found.findings[0].channels == ("time",), found.message


def test_who_forgot_every_unit_is_told_every_unit():
    recording, config = SECOND
    found = plausibility_of(changed(recording, x=1e3, x_d=1e3, p1=1e-5, p2=1e-5, omega=1 / RPM),
                            config)
    assert {finding.channels for finding in found.findings} == {
        ("x", "x_d"), ("p1", "p2"), ("omega",)}
    for word in ("millimetres", "bar", "rpm"):
        assert word in found.message


@pytest.mark.parametrize("times, penalty", [(1.0, 0.3), (100.0, None), (0.145, None)])
def test_the_lower_pressure_comes_down_to_what_feeds_it(times, penalty):
    recording, config = SECOND
    reading = reading_of(moments_of(changed(recording, p1=times, p2=times)), config)
    found = charge(reading)
    assert found.penalty < penalty if penalty else found.penalty > 2.0


def test_gauge_pressures_are_told_and_block_nothing():
    recording, config = PAPER
    channels = dict(recording.channels)
    for name in ("p1", "p2"):
        channels[name] = channels[name] - 101325.0
    found = plausibility_of(replace(recording, channels=channels), config)
    assert [finding.kind for finding in found.findings] == ["offset"]
    assert not found.blocking


def test_what_a_unit_says_to_be_gauge_is_not_gauge_again():
    recording, config = PAPER
    low = replace(recording, channels=dict(recording.channels, **{
        name: recording.channels[name] - 101325.0 for name in ("p1", "p2")}))
    tree = config.model_dump() | {"table": {"columns": {
        name: {"column": name, "unit": "bar gauge"} for name in ("p1", "p2")}}}
    assert plausibility_of(low, config).findings and not plausibility_of(
        low, settings(**tree)).findings


def test_a_dead_pressure_and_a_speed_without_its_sign_are_told():
    recording, _ = PAPER
    assert not stuck(moments_of(recording)) and not unsigned(moments_of(recording))
    odd = moments_of(replace(recording, channels=dict(
        recording.channels, p2=np.full(len(recording), 13e5),
        omega=np.abs(recording.channels["omega"]))))
    assert "p2 is 13 bar in the whole recording" in stuck(odd)[0].finding
    assert "its sign may be missing" in unsigned(odd)[0].finding
    still, steady = (stuck(moments_of(replace(recording, channels=dict(
        recording.channels, omega=np.full(len(recording), speed))))) for speed in (0.0, 150.0))
    assert "omega is 0 rad/s in the whole recording" in still[0].finding
    assert not steady  # a pump of constant speed, behind a valve


def test_a_measured_force_tells_its_unit_and_sign():
    config = settings(rig={"area_1": None, "area_2": None},
                      simulation=motion(MULTISINE, 8.0, publish=["x", "force"]))
    force_config = settings(simulation=motion(MULTISINE, 8.0, publish=["x", "force"]))
    recording = Recording(1e-3, Simulator(force_config, seed=1).advance(8000), 10**9, "made")
    assert not plausibility_of(recording, config).findings
    kilo = plausibility_of(changed(recording, force=1e-3), config)
    assert "kN" in kilo.message or "millimetres" in kilo.message
    assert plausibility_of(changed(recording, force=-1), config).findings[0].kind == "sign"


@pytest.mark.parametrize("effects", [
    {}, {"coulomb_friction": {"F_c": 40.0}}, {"constant_load": {"F_0": 60.0}},
    {"spring_load": {"k": 8000.0}}, {"added_mass": {"dM": 8.0}}, {"drive_lag": {"tau": 4e-3}},
    {"position_delay": {"T": 2e-3}}, {"pump_dead_zone": {"omega_0": 8.0}},
    {"pump_flow_gain": {"k": -0.1}}, {"cross_port_leakage": {"L": 8e-12}}],
    ids=lambda effects: next(iter(effects), "clean"))
@pytest.mark.parametrize("shape", [TRIANGLE, MULTISINE], ids=["triangle", "multisine"])
def test_physics_that_is_left_out_is_no_mistake(effects, shape):
    assert not plausibility_of(*made(shape, 8.0, effects)).findings


@pytest.mark.parametrize("recording, config", [PAPER, SECOND], ids=["paper", "single rod"])
def test_a_feed_forward_makes_no_gain_implausible(recording, config):
    """A demand r with r + T r' = x_d drives the pump by K (r - x) + K T r'."""
    rig, step = config.rig, recording.sample_time
    lag = 0.85 * rig.area_1 / (rig.position_gain * rig.pump_displacement)
    demand = lfilter([1.0 - np.exp(-step / lag)], [1.0, -np.exp(-step / lag)],
                     recording.channels["x_d"])
    led = replace(recording, channels=recording.channels | {"x_d": demand})
    assert not plausibility_of(led, config).findings


@property_settings(max_examples=40)
@given(strategies.fixed_dictionaries({
    key: strategies.floats(1 / limit, limit) for key, limit in {
        "mass": 1.4, "pump_displacement": 1.15, "position_gain": 1.15, "leakage": 3.0,
        "charge_pressure": 7.0, "viscous_damping": 5.0, "bulk_modulus": 5.0}.items()}),
    strategies.floats(0.8, 1.25))
def test_numbers_that_are_a_little_wrong_are_no_mistake(factors, volume):
    recording, config = SECOND
    config = with_rig(config, volume_1=volume, volume_2=volume, **factors)
    assert not plausibility_of(recording, config).findings


@pytest.mark.parametrize("rig", [{}, OTHER], ids=["paper", "single rod"])
@pytest.mark.parametrize("effects", [{}, {"coulomb_friction": {"F_c": 60.0}}],
                         ids=["plain", "dry friction"])
def test_a_part_of_a_slow_stroke_contradicts_nothing(rig, effects):
    recording, config = made({**TRIANGLE, "frequency": 0.02, "amplitude": 0.02}, 30.0, effects,
                             **rig)
    rng = np.random.default_rng(7)
    for _ in range(30):
        start, length = rng.uniform(1.5, 24.0), rng.uniform(1.5, 6.0)
        rows = slice(*(round(t / recording.sample_time) for t in (start, start + length)))
        part = replace(recording, channels={name: values[rows] for name, values in
                                            recording.channels.items()})
        assert not plausibility_of(part, config).blocking


@given(strategies.lists(strategies.sampled_from(
    [0.0, 1e-300, 1.0, 1e30, 1e200, -1e300, math.inf, -math.inf, math.nan]),
    min_size=5, max_size=5), strategies.integers(0, 300))
def test_any_values_at_all_are_looked_at_in_silence(values, samples):
    rng = np.random.default_rng(0)
    channels = {name: value * rng.standard_normal(samples)
                if math.isfinite(value) else np.full(samples, value)
                for name, value in zip(SENSORS, values, strict=True)}
    with warnings.catch_warnings(), contextlib.suppress(InputError):  # a recording may refuse them
        warnings.simplefilter("error")
        plausibility_of(Recording(1e-3, channels, 0, "any"), settings())


def test_nothing_is_told_of_what_stands_still_or_is_noise():
    rng = np.random.default_rng(1)
    for size in (0.0, 1e-6):
        channels = {name: size * rng.standard_normal(4000) for name in SENSORS}
        channels["p1"] = channels["p2"] = 2e6 + 500 * rng.standard_normal(4000)
        channels["p2"] = 2e6 + 500 * rng.standard_normal(4000)
        found = plausibility_of(Recording(1e-3, channels, 0, "still"), settings())
        assert not found.blocking, found.message


# Oracles: closed forms and numpy's own least squares.


def test_derivatives_are_those_of_a_sine():
    dt, n, w = 1e-3, 6001, 2 * np.pi * 1.5
    t = np.arange(n) * dt
    (x, v, a), _ = derivatives(0.3 + 0.2 * t + 0.05 * np.sin(w * t), n // 4, dt)
    cut = slice((n - len(x)) // 2, (n - len(x)) // 2 + len(x))
    assert x == pytest.approx((0.3 + 0.2 * t + 0.05 * np.sin(w * t))[cut], abs=1e-6)
    assert v == pytest.approx((0.2 + 0.05 * w * np.cos(w * t))[cut], abs=2e-3 * 0.05 * w)
    assert a == pytest.approx((-0.05 * w**2 * np.sin(w * t))[cut], abs=5e-3 * 0.05 * w**2)


def test_the_ratio_is_that_of_least_squares():
    recording, config = SECOND
    moments = moments_of(recording)
    reading = reading_of(replace(moments, noise=0.0 * moments.noise), config)
    rng = np.random.default_rng(2)
    table = rng.multivariate_normal(np.zeros(len(moments.scale)), moments.gram, 5000,
                                    method="eigh").T
    table -= table.mean(axis=1, keepdims=True)
    gram = table @ table.T / table.shape[1]
    reading = replace(reading, moments=replace(reading.moments, gram=gram))
    left, right, beside = (reading.column("omega"), reading.column("x", 1), reading.column("p1"))
    sides = np.array([side @ table for side in (left, right, beside)])
    slope = np.linalg.lstsq(sides[1:].T, sides[0], rcond=None)[0][0]
    assert ratio(reading, left, right, beside).slope == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize(
    ("pair", "unit", "scale", "said"),
    [
        (("p1", "p2"), "bar gauge", 1e2, "p1 and p2 look like kPa, not bar"),
        (("x", "x_d"), "mm", 0.1, "x and x_d look like centimetres, not millimetres"),
        (("omega",), "rpm", RPM, "omega looks like rad/s, not rpm"),
    ],
)
def test_a_written_unit_is_the_one_that_was_taken(pair, unit, scale, said):
    """Where the header says bar and kPa were read, no other unit was taken for the right one."""
    recording, config = PAPER
    tree = config.model_dump()
    tree["table"]["columns"] = {name: {"column": name, "unit": unit} for name in pair}
    found = plausibility_of(changed(recording, **dict.fromkeys(pair, scale)), settings(**tree))
    assert found.blocking and found.message.startswith(said)


# By use: the commands.


@pytest.fixture
def bag(tmp_path):
    recording, config = PAPER
    write_recording(tmp_path / "bag", recording, config)
    (tmp_path / "wrong.yaml").write_text("channels:\n  x: {scale: 1000.0}\n"
                                         "  x_d: {scale: 1000.0}\n")
    return tmp_path


def run(capfd, *arguments):
    status = cli.main([str(argument) for argument in arguments])
    return status, capfd.readouterr().err


@pytest.mark.parametrize("command", ["estimate", "diagnose", "advise"])
def test_a_contradiction_ends_every_command_in_one_line(bag, capfd, command):
    answer = bag / "answer.json"
    more = () if command == "advise" else ("--write-config", bag / "right.yaml")
    said = refused(capfd, command, bag / "bag", "--config", bag / "wrong.yaml", "--json", answer,
                   *more)
    assert "x and x_d look like millimetres, not metres" in said
    if command == "advise":
        assert not answer.exists()
        return
    tree = json.loads(answer.read_text())
    assert tree["channels"][0]["kind"] == "unit"
    assert tree["channels"][0]["correction"]["channels"]["x"]["scale"] == 1.0
    if command == "diagnose":
        assert tree["verdict"] == "insufficient_data"
        assert tree["effects"] == []
    else:
        assert {p["status"] for p in tree["parameters"].values()} == {"no_data"}
    status, said = run(capfd, "estimate", bag / "bag", "--config", bag / "right.yaml", "--json",
                       answer)
    assert status == 0, said
    tree = json.loads(answer.read_text())
    assert tree["channels"] == []
    assert tree["parameters"]["B"]["value"] == pytest.approx(600.0, rel=0.01)


def test_swapped_pressures_are_swapped_back_by_the_written_config(bag, capfd):
    (bag / "wrong.yaml").write_text(
        "channels:\n  p1: {topic: pressure/chamber_2, field: fluid_pressure}\n"
        "  p2: {topic: pressure/chamber_1, field: fluid_pressure}\n")
    wrong = ("estimate", bag / "bag", "--config", bag / "wrong.yaml")
    status, said = run(capfd, *wrong, "--write-config", bag / "right.yaml")
    assert status == 2
    assert "p1 and p2 look swapped" in said
    assert run(capfd, "estimate", bag / "bag", "--config", bag / "right.yaml")[0] == 0


def test_who_insists_gets_an_answer_with_the_warning(bag, capfd):
    with (bag / "wrong.yaml").open("a") as file:
        file.write("implausible: warn\n")
    answer = bag / "answer.json"
    status, _ = run(capfd, "estimate", bag / "bag", "--config", bag / "wrong.yaml", "--json",
                    answer)
    assert status == 0
    tree = json.loads(answer.read_text())
    assert any("millimetres" in warning for warning in tree["warnings"])


def test_import_tells_it_already(tmp_path, capfd):
    recording, _ = PAPER
    rows = np.column_stack([recording.time, *(recording.channels[name] for name in SENSORS)])
    np.savetxt(tmp_path / "file.csv", rows[:6000], delimiter=",", comments="",
               header=",".join(["t", *SENSORS]))
    columns = "\n".join(f"    {name}: {{column: {name}}}" for name in SENSORS if name != "omega")
    (tmp_path / "map.yaml").write_text(
        f"table:\n  time: t\n  columns:\n{columns}\n    omega: {{column: omega, scale: -1.0}}\n")
    status = cli.main(["import", str(tmp_path / "file.csv"), "--map", str(tmp_path / "map.yaml"),
                       "--out", str(tmp_path / "bag")])
    assert status == 0
    assert "omega has the wrong sign" in capfd.readouterr().out
    assert read_recording(tmp_path / "bag", settings()).has("omega")


def test_an_archive_tells_it_of_each_bag(bag, capfd):
    status, said = run(capfd, "estimate", bag, "--config", bag / "wrong.yaml", "--out",
                       bag / "archive", "--jobs", "1")
    assert status == 2  # none of its bags has an answer
    assert "millimetres" in said


# Live.


def look_on(recording, config, seconds):
    from test_live_estimator import rows_of

    from eha_monitor.live.estimator import LiveEstimator

    live = LiveEstimator(config)
    for _ in fed(live, rows_of(recording.part(0, round(seconds / recording.sample_time)))):
        pass
    return live.snapshot()


def test_live_rows_that_contradict_the_config_give_no_number():
    recording, config = SECOND
    seen = look_on(changed(recording, p1="p2", p2="p1"), config, 5.0)
    assert "p1 and p2 look swapped" in seen.implausible
    assert {p.status for p in seen.parameters.values()} == {"no_data"}
    assert seen.model.status == "not_judged"
    assert any("swapped" in event.message for event in seen.events)
    assert not look_on(recording, config, 5.0).implausible


@pytest.mark.parametrize("late", [["p1"], ["p1", "p2"], ["omega"]])
def test_a_channel_that_comes_late_contradicts_nothing(late):
    """Live, topics come one after another; this one half a second after the position."""
    recording, config = made({"kind": "sine", "amplitude": 0.01, "frequency": 1.0}, 4.0,
                             {"quadratic_friction": {"a_1": 3e4}})
    channels = {name: values.copy() for name, values in recording.channels.items()}
    for name in late:
        channels[name][:round(0.5 / recording.sample_time)] = np.nan
    cut = replace(recording, channels=channels)
    assert not plausibility_of(cut, config).findings
    assert not look_on(cut, config, 3.0).implausible


def test_who_insists_gets_live_numbers_with_the_warning():
    recording, config = SECOND
    config = config.model_copy(update={"implausible": "warn"})
    seen = look_on(changed(recording, omega=-1.0), config, 5.0)
    assert "omega has the wrong sign" in seen.implausible
    assert seen.parameters["B"].status != "no_data"


def test_the_monitor_says_it_in_its_diagnostics():
    from eha_monitor.health.alarms import AlarmBoard
    from eha_monitor.ros.findings import DataState, all_findings

    recording, config = SECOND
    seen = look_on(changed(recording, omega=-1.0), config, 5.0)
    data = DataState(None, implausible=seen.implausible, refused=True)
    found = {one.name: one for one in all_findings(
        config, AlarmBoard(config), seen.parameters, seen.consistency, seen.model, {}, data)}
    assert found["data"].level == "ERROR"
    assert "omega has the wrong sign" in found["data"].message
    assert found["stage_one"].level == "STALE"


def held_of(recording, config, **channels):
    """What is said of a recording in which channels were replaced."""
    odd = replace(recording, channels={**recording.channels, **channels})
    return [one.finding for one in plausibility_of(odd, config).findings if one.kind == "hold"]


@pytest.mark.parametrize("missing", [0.0, 0.05, 0.3])
@pytest.mark.parametrize("name", ["p1", "p2"])
@pytest.mark.parametrize("step", [0.0, 2e3])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_sensor_at_the_end_of_its_range_is_told(name, missing, step, sign):
    recording, config = SECOND
    time = np.arange(len(recording)) * 2e-3
    wave = np.minimum(5e5 * np.sin(2 * np.pi * 0.7 * time), 5e5 - missing * 1e6)
    seen = 25e5 + sign * wave + (0.0 if missing else np.random.default_rng(1).normal(
        0, 500.0, len(time)))
    shown = np.round(seen / step) * step if step else seen
    said = held_of(recording, config, **{name: shown})
    assert len(said) == (missing > 0.0)
    assert all(f"{name} stays at exactly" in one and ("highest", "lowest")[sign < 0] in one
               for one in said)


def test_a_set_point_in_the_place_of_a_pressure_is_told():
    recording, config = SECOND
    wave = np.where(np.sin(2 * np.pi * 0.4 * np.arange(len(recording)) * 2e-3) > 0, 30e5, 20e5)
    said = held_of(recording, config, p1=wave)
    assert len(said) == 1 and "jumps by 10 bar: it may be a set-point" in said[0]
    copied = replace(recording, channels={
        **recording.channels, "p1": 20e5 + 4e7 * recording.channels["x_d"]})
    found = plausibility_of(copied, config)
    assert found.blocking and "x_d and p1 hold the same numbers in other units" in found.message


@pytest.mark.parametrize("step", [0.0, 500.0, 5e3, 2e4])
@pytest.mark.parametrize("effects", [{}, {"coulomb_friction": {"F_c": 300.0}}])
@pytest.mark.parametrize("shape", [TRIANGLE, MULTISINE])
def test_coarse_and_quiet_sensors_of_a_machine_with_friction_are_not_cut_off(step, effects, shape):
    quiet = dict.fromkeys(("position", "pressure", "pump_speed"), 0.0)
    config = settings(rig=OTHER, effects=effects, simulation=motion(
        shape, 8.0, publish=list(SENSORS)) | {"noise": quiet})
    recording = Recording(2e-3, Simulator(config, seed=1).advance(4000), 10**9, "made")
    rounded = {name: np.round(recording.channels[name] / step) * step
               for name in ("p1", "p2") if step}
    assert not held_of(recording, config, **rounded)


def test_a_frozen_position_is_told_with_its_interval():
    """A second of the same position was seen by no offline command."""
    recording, config = SECOND
    x, n = recording.channels["x"].copy(), round(1.0 / recording.sample_time)
    first = int(np.argmax(np.abs(x[2 * n:-2 * n] - x[3 * n:-n]))) + 2 * n
    x[first:first + n] = x[first]
    frozen = replace(recording, channels=recording.channels | {"x": x})
    (line,) = [one.finding for one in plausibility_of(frozen, config).findings
               if "stands still" in one.finding]
    a, b = (float(one) for one in line.split(" at ")[1].split(" s ")[0].split("–"))
    assert (a, b) == pytest.approx((first / n, first / n + 1.0), abs=0.02)


@pytest.mark.parametrize("gap", [False, True])
@pytest.mark.parametrize("name", ["p1", "p2"])
def test_a_channel_that_stays_far_longer_than_ever_is_told(name, gap):
    """Half of a recording of one pressure had no word; to its end there is no jump either."""
    recording, _ = SECOND
    values, n = recording.channels[name].copy(), round(1.0 / recording.sample_time)
    first = len(values) // 2
    values[first:] = 0.5 * (np.nanmin(values) + np.nanmax(values))
    if gap:  # which a resampling leaves
        values[first + n // 2:first + n // 2 + 4] = np.nan
    frozen = replace(recording, channels=recording.channels | {name: values})
    said = [one for one in held(frozen) if one.channels == (name,)]
    assert len(said) == 1 and "stands still" in said[0].finding
    assert held(recording) == ()


def test_a_steady_stroke_has_no_frozen_pressure():
    """Coarse pressures stand to the last digit while the piston goes its way."""
    recording, _ = SECOND
    n = round(2.0 / recording.sample_time)
    first, channels = len(recording) // 2, {k: v.copy() for k, v in recording.channels.items()}
    for name in ("p1", "p2", "omega"):
        channels[name][first:first + n] = 0.5 * (channels[name].min() + channels[name].max())
    channels["x"][first:] = channels["x"][first] + 1e-5 * np.arange(len(recording) - first)
    assert not [one for one in held(replace(recording, channels=channels))
                if "frozen" in one.finding and one.channels != ("x",)]


def test_a_chamber_that_stays_at_the_source_is_not_frozen():
    recording, _ = SECOND
    low = np.maximum(recording.channels["p1"], np.median(recording.channels["p1"]))
    assert not [one for one in held(replace(
        recording, channels=recording.channels | {"p1": low})) if "frozen" in one.finding]


def test_a_rig_at_rest_has_no_frozen_position():
    recording, config = SECOND
    n = round(1.0 / recording.sample_time)
    resting = {name: np.concatenate([values[:3 * n], np.full(2 * n, values[3 * n - 1]),
                                     values[3 * n:]])
               for name, values in recording.channels.items()}
    resting["omega"][3 * n:5 * n] = 0.0
    resting["x"] = np.round(resting["x"] / 1e-4) * 1e-4
    found = plausibility_of(replace(recording, channels=resting), config).findings
    assert not [one for one in found if "stands still" in one.finding and "x" in one.channels]


def broken(kind, x, rate, rng):
    """Return a position whose sensor is broken, and the words that say so."""
    x, n, where = x.copy(), len(x), np.zeros(len(x), dtype=bool)
    if kind == "lone":
        where = rng.random(n) < 0.05
        return np.where(where, x.min() - 0.5 * np.ptp(x), x), "drops out", where
    for first in rng.uniform(0.05, 0.9, 6) * n:
        where[int(first):int(first) + round(0.3 * rate)] = True
    if kind == "long":
        return np.where(where, x.min() - 0.5 * np.ptp(x), x), "drops out", where
    if kind == "noisy":
        return np.where(where, x + 0.2 * np.ptp(x) * rng.standard_normal(n), x), "as noisy", where
    where = np.arange(n) > 0.45 * n
    return x + 0.3 * np.ptp(x) * where, "jumps at", where


@pytest.mark.parametrize("shape", [MULTISINE, TRIANGLE])
@pytest.mark.parametrize("kind", ["lone", "long", "noisy", "lost"])
def test_a_position_that_no_piston_has_is_told_and_left_out(kind, shape):
    """A loose contact made "a drive that hunts", and lost counts a load."""
    recording, config = SECOND if shape == MULTISINE else PAPER
    x, dt = recording.channels["x"], recording.sample_time
    shown, words, where = broken(kind, x, 1.0 / dt, np.random.default_rng(5))
    off = replace(recording, channels=recording.channels | {"x": shown})
    said = [one.finding for one in plausibility_of(off, config).findings]
    assert sum(words in one for one in said) == 1 and "drive" not in "".join(said)
    left = np.isfinite(trusted(off).channels["x"])
    if kind == "lost":
        (at,) = astray(shown, dt).jumps
        assert left.all() and at == np.argmax(where) - 1
    else:
        assert (left & where).mean() < 0.002 and (~left & ~where).mean() < 0.2
    assert trusted(recording) is recording and held(recording) == ()


def test_a_position_that_stands_while_its_demand_goes_on_is_told():
    recording, config = PAPER
    x, n = recording.channels["x"].copy(), len(recording) // 3
    x[n:] = x[n]
    stuck_at = replace(recording, channels=recording.channels | {"x": x})
    (line,) = [one.finding for one in plausibility_of(stuck_at, config).findings
               if one.channels == ("x",)]
    assert f"x stands still from {n * recording.sample_time:.2f} s to the end" in line
    resting = recording.channels | {"x": x, "x_d": np.where(np.arange(len(x)) > n, x[n],
                                                            recording.channels["x_d"])}
    assert not [one for one in held(replace(recording, channels=resting)) if "x" in one.channels]
