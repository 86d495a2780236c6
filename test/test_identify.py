"""The experiment that decides: limits, planned motions, the simulated rig, and one in full."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from command_tools import refused
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from rig_tools import MULTISINE, simulated
from rig_tools import settings as rig_settings

from eha_monitor.cli import main
from eha_monitor.errors import InputError
from eha_monitor.identify import plan
from eha_monitor.identify.experiment import (
    NEEDED,
    Round,
    SimulatedRig,
    Watch,
    bounds_of,
    by_least_squares,
    identify,
)
from eha_monitor.identify.plan import Planned, Planner, most_decisive, standing, within
from eha_monitor.mismatch.advise.motions import Motion, demanded
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.likelihood.fit import free_run
from eha_monitor.mismatch.name.naming import Naming
from eha_monitor.mismatch.name.refit import unfitted
from eha_monitor.recordings.read import read_recording
from eha_monitor.settings import load_settings, settings_from_tree

CONFIG = "config/identify.yaml"
NUMBERS = (st.floats(-1e9, 1e9) | st.sampled_from(["30 mm", "-3 cm", "5 m/s^2", "60 bar", "2 s", 0,
                                                   None, "fast", True]) | st.floats())
KEYS = (*NEEDED, "motion_time", "total_time", "silence", "command_lead")


@pytest.mark.parametrize("effects", [
    {"pressure_offset": {"b_1": 4e4, "b_2": 0.0}}, {"pressure_scale": {"k_1": 0.05, "k_2": 0.0}},
    {"position_scale": {"k": 0.05}}, {"position_scale": {"k": 0.05, "in_loop": 1.0}},
    {"constant_load": {"F_0": 400.0}, "spring_load": {"k": 8e3, "x_0": -0.03}}])
def test_a_planned_rest_is_one_whatever_the_sensors_show(effects):
    """Other readings would push the piston, and seem to tell models apart."""
    settings = rig_settings(effects=effects)
    experiment = experiment_of([simulated(MULTISINE, 2.0).recording(1)], settings)
    fit = unfitted(experiment)
    rest = demanded(experiment, fit, "rest", np.full(2000, 0.01))
    shown = free_run(rest, rest.stretches[0], fit)
    if "constant_load" in effects:  # a leak moves the mean pressure, slowly
        assert np.ptp(shown[:, 0]) < 2e-6 and np.ptp(shown[:, 2]) < 2e4
        assert abs(np.mean(shown[:, 2] - shown[:, 3]) * settings.rig.area_1 - 720.0) < 5.0
        return
    assert np.ptp(shown[:, 0]) < 1e-9 and np.ptp(shown[:, 2]) < 1.0 and np.ptp(shown[:, 3]) < 1.0


def test_where_no_set_follows_another_motion_is_run_and_least_squares_decide_nothing():
    settings = load_settings(CONFIG)
    planner = Planner(settings, bounds_of(settings, CONFIG), CONFIG)
    first = planner.first(0.0)
    other = planner.best(planner.blank, 0.0, 10.0, [first.motion.name])
    assert other.motion.name != first.motion.name and len(other.x_d) < 10_000
    assert planner.best(planner.blank, 0.0, 0.1) is None
    effect = SimpleNamespace(name="coulomb_friction", probability=0.95)
    found = SimpleNamespace(verdict="mismatch", effects=(effect,), probability={}, advice=())
    last = by_least_squares(Round(first, None, 3.0, found))
    assert (last.names, last.probability, last.end) == ({"coulomb_friction"}, 0.95, "balances")


def test_why_no_motion_is_left_is_told_apart():
    settings = load_settings(CONFIG)
    bounds = bounds_of(settings, CONFIG)
    planner = Planner(settings, bounds, CONFIG)
    assert planner.best(planner.blank, 0.0, 0.1) is None
    assert planner.binding["total_time"] > 0
    slow = Planner(settings, bounds.model_copy(update={"acceleration": 1e-4}), CONFIG)
    assert slow.best(slow.blank, 0.0, 60.0) is None
    assert slow.binding and not slow.binding["total_time"]


def test_a_rest_that_shows_nothing_is_followed_by_a_motion(monkeypatch):
    settings = load_settings(CONFIG)
    bounds = bounds_of(settings, CONFIG)
    turns = iter([lambda found: replace(found[0], x_d=np.zeros(2000))])
    monkeypatch.setattr(plan, "most_decisive", lambda found: next(turns, most_decisive)(found))
    first, *_, last = identify(SimulatedRig(settings, bounds, 1, CONFIG),
                               Planner(settings, bounds, CONFIG))
    assert first.diagnosis.verdict == "insufficient_data" and not first.end
    assert np.ptp(last.planned.x_d) > 0.01 and last.diagnosis.verdict == "consistent"


def test_the_motion_that_decides_first_is_run():
    """One long motion against two short ones; where neither decides, what tells more."""
    def motion(samples, expected, until):
        return Planned(Motion(str(samples), "", {}), np.zeros(samples), expected, until=until)

    long, short, never = motion(9000, 0.99, 9.0), motion(3000, 0.9, 6.0), motion(1000, 0.5, np.inf)
    assert most_decisive([long, short, never]) is short
    assert most_decisive([long, replace(short, until=12.0)]) is long
    slow = [replace(one, until=np.inf) for one in (long, short)]
    assert most_decisive(slow) is slow[0]


@given(st.dictionaries(st.sampled_from(KEYS), NUMBERS))
@hypothesis_settings(max_examples=200)
def test_any_limits_are_complete_and_agree_or_one_line(section):
    try:
        found = bounds_of(settings_from_tree({"experiment": section}, "my.yaml"), "my.yaml")
    except InputError as problem:
        text = str(problem)
        assert text.startswith("my.yaml: ") and "experiment" in text and "\n" not in text
        return
    assert found.lower < found.upper and min(found.speed, found.acceleration) > 0
    assert found.pressure > 2e6 and found.motion_time <= found.total_time
    assert all(np.isfinite(getattr(found, key)) for key in KEYS)


@pytest.mark.parametrize("change, said", [
    ({"lower": 0.03}, "expected lower below upper"),
    ({"speed": None}, "experiment.speed: expected a number"),
    ({"pressure": "15 bar"}, "expected more than the charge pressure"),
    ({"motion_time": 90}, "expected motion_time of at most total_time"),
    ({"motion_time": 1}, "the limits allow no motion"),
])
def test_limits_that_contradict_are_one_line(tmp_path, capsys, change, said):
    file = tmp_path / "my.json"  # JSON is YAML
    tree = load_settings(CONFIG).model_dump(include={"experiment"})
    tree["experiment"] |= change
    file.write_text(json.dumps(tree), encoding="utf-8")
    text = refused(capsys, "identify", "--config", file, "--simulate", CONFIG,
                   "--out", tmp_path / "bags")
    assert said in text and str(file) in text


def test_an_output_in_no_folder_is_refused_before_the_rig_moves(tmp_path, capsys):
    nowhere = tmp_path / "nowhere" / "found.json"
    text = refused(capsys, "identify", "--config", CONFIG, "--simulate", CONFIG,
                   "--out", tmp_path / "bags", "--json", nowhere)
    assert f"the folder {nowhere.parent} does not exist" in text
    assert not (tmp_path / "bags").exists()


@pytest.mark.parametrize(("acceleration", "noise"), [
    ("1e-6 m/s^2", 1e-6), ("0.001 m/s^2", 1e-6), ("5 m/s^2", 3e-3)])
def test_no_motion_is_proposed_that_the_position_would_not_show(acceleration, noise):
    """4 nm, or 4 µm, were what limits as tight as that left of a sine of 2 Hz."""
    tree = load_settings(CONFIG).model_dump(exclude_unset=True)
    tree["experiment"]["acceleration"] = acceleration
    tree["simulation"] = {"noise": {"position": noise}}
    settings = settings_from_tree(tree, "my.yaml")
    try:
        planned = Planner(settings, bounds_of(settings, "my.yaml"), "my.yaml").first(0.0)
    except InputError as problem:
        text = str(problem)
        assert "10 times the noise of the position" in text and "\n" not in text
        return
    sizes = [one.amplitude for one in planned.motion.segments.values() if one.kind != "rest"]
    assert sizes and min(sizes) >= 10.0 * noise


def test_a_piston_outside_the_limits_is_not_moved():
    settings = load_settings(CONFIG)
    with pytest.raises(InputError, match=r"the piston stands at x = 0\.05 m"):
        Planner(settings, settings.experiment, CONFIG).first(0.05)


def bounds(**change):
    return load_settings(CONFIG).experiment.model_copy(update=change)


@given(st.floats(0.2, 2.0), st.sampled_from(["upper", "lower", "speed", "acceleration"]))
def test_watch_tells_what_is_beyond_a_limit_and_nothing_else(share, which):
    time, omega, noise = np.arange(1000) * 1e-3, 2.0 * np.pi * 2.0, 1e-6
    peak = {"upper": 1.0, "lower": 1.0, "speed": omega, "acceleration": omega**2}[which]
    limit = 0.01 * peak
    b = bounds(**{which: -limit if which == "lower" else limit})
    x = share * 0.01 * np.sin(omega * time) + noise * np.random.default_rng(1).standard_normal(
        len(time))
    watch = Watch(replace_others(b, which), 1e-3, noise)
    told = [watch.exceeded({"x": part}) for part in np.array_split(x, 37)]
    if abs(share - 1.0) > 0.05:
        assert any(told) == (share > 1.0)
        assert share < 1.0 or {"upper": "position", "lower": "position"}.get(
            which, which) in "".join(told)


def replace_others(b, which):
    wide = {"lower": -1.0, "upper": 1.0, "speed": 1e3, "acceleration": 1e6}
    return b.model_copy(update={key: value for key, value in wide.items() if key != which})


def test_a_spike_aborts_nothing_and_missing_samples_are_no_jump():
    watch = Watch(bounds(speed=1e3, acceleration=1e6), 1e-3, 1e-6)
    x = np.zeros(200)
    x[100], x[50:60] = 1.0, np.nan
    assert not watch.exceeded({"x": x, "p1": np.full(200, 2e6)})
    assert "p1 of 8 MPa" in watch.exceeded({"x": x[:20], "p1": np.full(200, 8e6)})


@given(st.integers(0, 2**32 - 1))
def test_rows_that_are_lost_make_nothing_faster(seed):
    """By their stamps the speed stays 0.1 m/s, whatever is lost and however the stamps jitter."""
    rng = np.random.default_rng(seed)
    at = 1e-3 * (np.arange(2000) + rng.uniform(-0.3, 0.3, 2000))
    there = rng.uniform(size=2000) > 0.3
    there[rng.integers(100, 1500):][:300] = False  # longer than the window
    watch = Watch(bounds(lower=-1.0, upper=1.0, speed=0.101, acceleration=1.0), 1e-3, 1e-6)
    for rows in np.array_split(np.flatnonzero(there), 11):
        assert not watch.exceeded({"x": 0.1 * at[rows]}, at[rows])
    # Stamps that stand still are no stamps: rows count one each sample time.
    same = Watch(bounds(lower=-1.0, upper=1.0, speed=0.101, acceleration=1.0), 1e-3, 1e-6)
    for k in range(0, 1000, 10):
        assert not same.exceeded({"x": 1e-4 * np.arange(k, k + 10)}, np.full(10, 5.0))
    later = at[-1] + 1e-3 * np.arange(1, 100)
    assert "speed of 200 mm/s" in watch.exceeded({"x": 0.2 * later - 0.1 * at[-1]}, later)


def test_simulated_rig_aborts_and_holds_what_was_demanded_last():
    settings = load_settings(CONFIG)
    rig = SimulatedRig(settings, settings.experiment, 1)
    time = np.arange(1000) * 1e-3
    ran = rig.run(0.05 * np.sin(2 * np.pi * time), "too_far")
    assert "speed" in ran.aborted
    held = rig.position()
    assert len(ran.recording) < 1000 and abs(held) <= 0.03
    again = rig.run(np.full(1500, held), "still")
    assert not again.aborted and again.recording.channels["x"][-1] == pytest.approx(held, abs=1e-4)


def test_a_set_that_adds_what_no_data_ask_for_is_no_rival():
    one, more, other = (frozenset(names) for names in (
        ("coulomb_friction",), ("coulomb_friction", "rig.mass"), ("pressure_friction",)))
    law = frozenset({"stribeck_friction"})
    assert within(one, law) and within(one, more) and not within(one, other)
    weights = {one: 0.6, more: 0.003, law: 0.3, other: 0.09, frozenset(): 1e-9}
    tried = tuple((names, None, 0.0) for names in (one, other))
    found = standing(replace(NOTHING, weights=weights, tried=tried))
    assert next(iter(found)) == one and found[one] == pytest.approx(0.903)
    assert found[other] == 0.09 and law not in found
    asked = standing(replace(NOTHING, weights=weights | {more: 0.2}))
    assert asked[more] == 0.2  # the data ask for it
    # By the linear guess another law of the family, beside anything, is as good: the same claim.
    guessed = frozenset({"pressure_friction", "rig.leakage"})
    found = standing(replace(NOTHING, weights=weights | {guessed: 0.05}, tried=tried))
    assert guessed not in found and found[one] == pytest.approx(0.953)


NOTHING = Naming(None, None, None)


def test_dry_run_moves_nothing(tmp_path, capsys):
    assert main(["identify", "--config", CONFIG, "--dry-run", "--out", str(tmp_path)]) == 0
    assert "nothing is moved; planned:" in capsys.readouterr().out
    assert (tmp_path / "planned.png").read_bytes()[:4] == b"\x89PNG"
    settings = load_settings(CONFIG)
    x_d = read_recording(tmp_path / "planned", settings).channels["x_d"]
    assert 0.005 < np.abs(x_d).max() < settings.experiment.upper and x_d[0] == 0.0


def test_an_experiment_decides_within_its_limits(tmp_path, capsys):
    hidden, answer, config = (tmp_path / name for name in ("rig.yaml", "a.json", "found.yaml"))
    hidden.write_text("effects: {quadratic_friction: {a_1: 600}}", encoding="utf-8")
    assert main(["identify", "--config", CONFIG, "--simulate", str(hidden), "--seed", "1",
                 "--out", str(tmp_path / "bags"), "--json", str(answer), "--report",
                 str(tmp_path / "r.html"), "--write-config", str(config)]) == 0
    out = capsys.readouterr().out
    assert ": quadratic friction, 9" in out and "Decided" in out
    found = json.loads(answer.read_text(encoding="utf-8"))
    assert found["schema"] == "eha_monitor/identify/1" and found["end"] == "decided"
    assert found["names"] == ["quadratic_friction"] and found["probability"] >= 0.95
    assert found["diagnosis"]["effects"][0]["name"] == "quadratic_friction"
    assert load_settings(config).effects["quadratic_friction"]["a_1"] == pytest.approx(600, 0.05)
    b, settings = bounds(), load_settings(CONFIG)
    for bag in found["bags"]:
        x = read_recording(bag, settings).channels["x"]
        assert b.lower < x.min() and x.max() < b.upper
        assert np.abs(np.gradient(x, 1e-3)).max() < b.speed
