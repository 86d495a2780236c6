"""The generator of concealed effects: independent of the diagnosis, sound as a plant."""

import ast
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from eha_monitor.concealed.cases import (
    CONFIG_KEYS,
    DRIVES,
    TOLERANCES,
    Case,
    balance_of,
    demand_of,
    effect_names,
    fine_run,
    hidden_of,
    outside_names,
    rig_of,
    rig_off,
    triangle,
    truth_of,
)
from eha_monitor.concealed.draws import (
    FAMILIES,
    KINDS,
    SHARES,
    TWINS,
    draw_cases,
    misconfigured,
)
from eha_monitor.concealed.generate import noise_of, nominal_config, recording_of, write_case
from eha_monitor.concealed.plant import OMEGA, P1, P2, V, X
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.recordings.read import read_recording
from eha_monitor.settings import settings_from_tree
from eha_monitor.settings.load import load_settings
from eha_monitor.settings.rig import TOLERATED, Tolerance

PACKAGE = Path(__file__).parents[1] / "eha_monitor"
SIMULATOR = Path(__file__).parents[2] / "shared" / "data" / "fluid_power_sim"
NOISE = {"x": 2e-6, "omega": 0.1, "p1": 2e3, "p2": 2e3}
TRIANGLE = triangle(np.arange(3000) * 1e-3, 4.0, 0.04)  # the paper's, as far as needed
BARRED = ("physics", "estimation", "mismatch", "prove", "health", "settings")
# The modules that make recordings and configs; their reach stops at what they call.
WRITING = ("eha_monitor.recordings", "eha_monitor.draft", "eha_monitor.settings",
           "eha_monitor.output", "eha_monitor.errors", "eha_monitor.compiled")


def imports_of(path: Path) -> set[str]:
    names, tree = set(), ast.parse(path.read_text(encoding="utf-8"))
    tree.body = [node for node in tree.body if not (  # never run
        isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            names.add(node.module)
    return {name for name in names if name.split(".")[0] == "eha_monitor"}


def test_nothing_of_the_fitted_models_is_imported():
    for start in sorted((PACKAGE / "concealed").rglob("*.py")):
        todo, seen = [start], set()
        while todo:
            path = todo.pop()
            if path in seen:
                continue
            seen.add(path)
            for name in imports_of(path):
                if path.name == "generate.py" and name.startswith(WRITING):
                    continue
                part = name.split(".")[1] if "." in name else ""
                assert part not in BARRED, f"{start.name} reaches {name} by {path.name}"
                found = PACKAGE.joinpath(*name.split(".")[1:])
                todo += [p for p in (found.with_suffix(".py"), found / "__init__.py")
                         if p.is_file()]


def test_only_the_generators_know_bags():
    for path in (PACKAGE / "concealed").rglob("*.py"):
        knows = any(name.startswith(("eha_monitor.recordings", "eha_monitor.settings"))
                    for name in imports_of(path))
        assert knows == (path.name == "generate.py")


def test_nothing_that_is_fitted_knows_the_generator():
    for room in ("physics", "estimation", "recordings", "settings", "health"):
        for path in (PACKAGE / room).rglob("*.py"):
            assert not any("concealed" in name for name in imports_of(path)), path


def test_catalogue_is_the_contract_and_every_name_has_a_balance():
    assert set(effect_names()) == set(CATALOGUE), "concealed/hidden.py: a new effect"
    assert len(outside_names()) >= 6
    assert {balance_of(name) for name in effect_names()} == {"force", "flow", "drive", "sensor"}
    assert balance_of("backlash") == "force" and balance_of("pump_ripple") == "flow"


def plateau(case: Case, start: float, stop: float) -> dict[str, float]:
    """Return means over a stretch of steady motion."""
    fine, time, _ = fine_run(case, hidden_of(case))
    rows = fine[(time > start) & (time < stop)]
    return {"v": rows[:, V].mean(), "dp": (rows[:, P1] - rows[:, P2]).mean(),
            "omega": rows[:, OMEGA].mean(), "x": rows[:, X].mean()}


def test_steady_motion_obeys_the_balances():
    here = plateau(Case("a", demand=TRIANGLE), 2.2, 2.9)
    assert here["v"] == pytest.approx(-0.04, rel=1e-4)
    assert 5.05e-4 * here["dp"] == pytest.approx(600.0 * here["v"], rel=1e-4)
    flow = 1.6925e-7 * here["omega"]
    assert flow == pytest.approx(5.05e-4 * here["v"] + 2.5e-13 * here["dp"], rel=1e-4)


@pytest.mark.parametrize("effect, force", [
    ("coulomb_friction", -40.0), ("pressure_friction", -40.0), ("presliding_friction", -40.0),
    ("constant_load", 40.0), ("quadratic_friction", -8000.0 * 0.04**2),
    ("asymmetric_friction", -10.0 + 100.0 * 0.04),
])
def test_forces_have_the_size_that_the_key_says(effect, force):
    here = plateau(Case("a", ((effect, 1.0),), demand=TRIANGLE), 2.2, 2.9)
    assert 5.05e-4 * here["dp"] + 600.0 * 0.04 == pytest.approx(force, abs=0.02)


def test_spring_pushes_back():
    here = plateau(Case("a", (("spring_load", 1.0),), demand=TRIANGLE), 2.2, 2.9)
    assert 5.05e-4 * here["dp"] - 600.0 * here["v"] == pytest.approx(8000.0 * here["x"], abs=0.1)


@pytest.mark.parametrize("effect, speed", [
    ("pump_dead_zone", -8.0), ("pump_flow_gain", None), ("leakage_offset", -1e-6 / 1.6925e-7)])
def test_flows_have_the_size_that_the_key_says(effect, speed):
    base = plateau(Case("a", demand=TRIANGLE), 2.2, 2.9)["omega"]
    here = plateau(Case("a", ((effect, 1.0),), demand=TRIANGLE), 2.2, 2.9)["omega"]
    expected = base + speed if speed is not None else base / 0.92
    assert here == pytest.approx(expected, rel=1e-3)


def test_seals_stick_as_springs():
    """At rest under less than the break-away force the rod moves by micrometres and returns."""
    demand = np.zeros(3000)
    demand[500:1500] = 0.5e-6
    case = Case("a", (("coulomb_friction", 1.0), ("constant_load", 0.5)), demand=demand)
    fine, time, _ = fine_run(case, hidden_of(case))
    x = fine[time > 0.0, X]
    assert np.ptp(x) < 2e-6


def test_external_leakage_lowers_the_mean_pressure():
    case = Case("a", (("external_leakage", 1.0),), motion="triangle")
    fine, time, _ = fine_run(case, hidden_of(case))
    mean = 0.5 * (fine[time > 10, P1] + fine[time > 10, P2]).mean()
    assert mean == pytest.approx((2e6 * 1e-13 + 101325.0 * 5e-14) / 1.5e-13, rel=1e-3)


@pytest.mark.parametrize("effect", ["coulomb_friction", "stribeck_friction", "line_dynamics",
                                    "relief_valve", "leakage_offset", "feedback_delay"])
def test_the_step_is_fine_enough(effect):
    case = Case("a", ((effect, 1.0),), motion="short")
    made = hidden_of(case)
    coarse, time, _ = fine_run(case, made)
    steps = round(1e-3 / (time[1] - time[0]))
    fine = fine_run(case, made, substeps=2 * steps)[0][::2]
    error = np.sqrt(np.mean((coarse - fine) ** 2, axis=0))
    assert error[X] < 0.1e-6 and error[P1] < 300.0 and error[OMEGA] < 0.01


@pytest.mark.parametrize("effect", [*effect_names(), *outside_names()])
def test_every_effect_shows_and_grows(effect, unchanged):
    sizes = []
    for strength in (0.1, 1.0):
        shown, _ = recording_of(Case("a", ((effect, strength),), motion="short", noise=0.0))
        sizes.append(max(np.sqrt(np.mean((shown[name] - unchanged[name]) ** 2)) / noise
                         for name, noise in NOISE.items()))
    assert sizes[1] > 1.3 * sizes[0]
    assert sizes[1] > 1.0  # noise levels, rms, in the channel that shows it best


@pytest.fixture(scope="module")
def unchanged():
    return recording_of(Case("a", motion="short", noise=0.0))[0]


def test_sensor_effects_leave_the_plant_alone():
    base = fine_run(Case("a", motion="short"), [])[0]
    for name in effect_names():
        if balance_of(name) == "sensor":
            case = Case("a", ((name, 1.0),), motion="short")
            assert np.array_equal(fine_run(case, hidden_of(case))[0], base)


@pytest.mark.parametrize("drive", ["digital", "digital_own"])
def test_a_digital_drive_holds_what_it_computes_at_each_sample(drive):
    case = Case("a", motion="short", drive=drive)
    noise = noise_of(case)["x"]
    fine, time, _ = fine_run(case, [], noise=noise)
    fine, time = fine[time > -1e-9], time[time > -1e-9]
    steps = round(1e-3 / (time[1] - time[0]))
    wanted = rig_of(case)["position_gain"] * (
        demand_of(case, time[::steps]) - fine[::steps, X])[:-1]
    heard = rig_of(case)["position_gain"] * noise if drive == "digital" else 0.0 * noise
    for later in range(steps):
        assert fine[later::steps, OMEGA][:len(noise)] == pytest.approx(
            wanted[:len(noise)] - heard, abs=1e-9)
    shown, _ = recording_of(case)
    left = shown["omega"] - fine[::steps, OMEGA][:len(noise)]
    assert left.std() == pytest.approx(0.1, rel=0.05)  # no more than the sensor's noise


def test_half_of_the_drives_are_digital_and_nothing_else_depends_on_it():
    cases = draw_cases(400, 5)
    share = np.mean([case.drive != "analogue" for case in cases])
    assert share == pytest.approx(0.5, abs=0.08)
    assert {case.drive for case in cases} == set(DRIVES)


def test_delays_are_what_they_say(unchanged):
    shown, _ = recording_of(
        Case("a", (("position_delay", 1.0),), motion="short", noise=0.0, nuisance=0.0))
    plain, _ = recording_of(Case("a", motion="short", noise=0.0, nuisance=0.0))
    assert np.abs(shown["x"][10:] - plain["x"][8:-2]).max() < 1e-8
    assert np.array_equal(shown["p1"], plain["p1"])
    assert np.abs(plain["x"] - unchanged["x"]).max() < 10e-6  # nuisances are small


def test_saturation_and_relief_hold_their_limits():
    case = Case("a", (("drive_saturation", 1.0),), motion="short", noise=0.0)
    limit = truth_of(case)["effects"][0]["parameters"]["omega_max"]
    shown, _ = recording_of(case)
    assert np.abs(shown["omega"]).max() == pytest.approx(limit, rel=1e-6)
    relief = truth_of(Case("a", (("relief_valve", 1.0),), motion="short"))
    little = truth_of(Case("a", (("relief_valve", 0.3),), motion="short"))
    assert (relief["effects"][0]["parameters"]["p_c"]
            < little["effects"][0]["parameters"]["p_c"])


def test_same_seed_same_recording_and_noise_as_asked():
    case = Case("a", motion="short", seed=3)
    first, time = recording_of(case)
    again, _ = recording_of(case)
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert len(time) == 6000
    quiet, _ = recording_of(Case("a", motion="short", seed=3, noise=0.0))
    assert np.std(first["p1"] - quiet["p1"]) == pytest.approx(2e3, rel=0.05)
    assert np.std(first["x"] - quiet["x"]) == pytest.approx(2e-6, rel=0.1)
    assert np.std(first["omega"] - quiet["omega"]) == pytest.approx(0.1, rel=0.05)


def test_key_and_nominal_config():
    case = Case("k", (("coulomb_friction", 0.5), ("pressure_scale", -1.0)), rig={"B": 850.0},
                options={"pressure_scale": {"sensor": "p2"}})
    truth = json.loads(json.dumps(truth_of(case)))
    assert truth["B"] == 850.0 and truth["beta_e"] == 6e8
    assert truth["effects"][0]["parameters"] == {"F_c": 20.0}
    assert truth["effects"][1]["balance"] == "sensor"
    assert truth["effects"][1]["parameters"] == {"k_1": 0.0, "k_2": -0.08}
    assert truth["rig_off"] == []
    assert truth_of(replace(case, nominal={"M": 25.0, "B": 700.0}))["rig_off"] == [
        {"key": "mass", "true": 20.0, "configured": 25.0,
         "tolerances": pytest.approx(np.log(1.25) / 0.05)}]
    config = nominal_config(case)["/**"]["ros__parameters"]
    assert config["rig"]["viscous_damping"] == 600.0 and "effects" not in config
    assert config["noise"] == {"position": 2e-6, "pressure": 2e3, "pump_speed": 0.1}


def test_a_case_is_written_as_bag_and_config(tmp_path):
    case = Case("c7", (("drive_lag", 1.0),), motion="short", channels=("x", "x_d", "omega"))
    bag, config = write_case(case, tmp_path)
    text = config.read_text()
    assert not any(name in text for name in (*effect_names(), *outside_names()))
    assert YAML(typ="safe").load(text) == nominal_config(case)
    settings = load_settings(config)
    recording = read_recording(bag, settings)
    channels, _ = recording_of(case)
    assert {name for name in recording.channels if recording.has(name)} == set(channels)
    for name, values in channels.items():
        assert np.allclose(recording.get(name), values, rtol=0, atol=1e-9)


def test_draws_repeat_and_are_varied():
    cases, more = draw_cases(150, 5), draw_cases(160, 5)
    assert cases == more[:150] and cases != draw_cases(150, 6)
    counts = [len(case.effects) for case in cases]
    assert set(counts) == {0, 1, 2, 3}
    named = {name for case in cases for name, _ in case.effects}
    assert len(named & set(effect_names())) > 25 and named & set(outside_names())
    assert {case.motion for case in cases} == {"rich", "short", "triangle"}
    for case in cases:
        names = [name for name, _ in case.effects]
        assert all(sum(name in family for name in names) <= 1 for family in FAMILIES)
        assert len(set(names)) == len(names)


# What the nominal config says of the rig.

def test_tolerances_of_the_draws_are_the_configs():
    for symbol, spread in TOLERANCES.items():
        for key in CONFIG_KEYS[symbol]:
            assert Tolerance().log_spread(key) == pytest.approx(spread)
    assert {key for symbol in TOLERANCES for key in CONFIG_KEYS[symbol]} == set(
        TOLERATED)


def test_kinds_of_rig_numbers_change_the_config_and_nothing_else():
    kinds = {kind: draw_cases(60, 5, rig=kind) for kind in KINDS}
    assert draw_cases(60, 5) == kinds["mixed"] == draw_cases(80, 5)[:60]
    for kind, cases in kinds.items():
        for case, exact in zip(cases, kinds["exact"], strict=True):
            assert (case.effects, case.rig, case.motion, case.seed) == (
                exact.effects, exact.rig, exact.motion, exact.seed)
            assert rig_of(case) == rig_of(exact), "the plant runs on the true numbers"
            count = {"exact": {0}, "within": {10}, "beyond": {1, 2}}.get(kind, {0, 1, 2, 10})
            assert len(rig_off(case)) in count
    assert not any(case.nominal for case in kinds["exact"])
    with pytest.raises(ValueError, match="no kind 'all'"):
        misconfigured((), 1, "all")


def test_rig_numbers_are_off_by_what_is_said():
    errors = {symbol: [] for symbol in TOLERANCES}
    for case in draw_cases(300, 5, rig="within"):
        off = {one["key"]: one["tolerances"] for one in rig_off(case)}
        assert off["area_1"] == off["area_2"] and off["volume_1"] == off["volume_2"]
        for symbol in TOLERANCES:
            errors[symbol].append(off[CONFIG_KEYS[symbol][0]])
    for symbol, found in errors.items():
        assert abs(np.mean(found)) < (0.5 if symbol in ("C_T", "G") else 0.25), symbol
        assert 0.75 < np.std(found) < 1.25, symbol
    seen = set()
    for case in draw_cases(150, 5, rig="beyond"):
        off = rig_off(case)
        symbol = next(symbol for symbol, keys in CONFIG_KEYS.items() if off[0]["key"] in keys)
        assert [one["key"] for one in off] == list(CONFIG_KEYS[symbol])
        assert 2.99 < abs(off[0]["tolerances"]) < 10.01
        assert TWINS.get(symbol) not in dict(case.effects)
        seen.add(symbol)
    assert seen == set(TOLERANCES)


def test_a_config_with_wrong_numbers_is_still_one_of_a_rig():
    """It is read, its make-up path is part of its leakage, and its position loop is stable."""
    kinds = []
    for case in draw_cases(300, 9):
        rig = settings_from_tree(nominal_config(case), case.name).rig
        off = {one["key"]: one for one in rig_off(case)}
        assert all(getattr(rig, key) == one["configured"] for key, one in off.items())
        loop = rig.position_gain * rig.pump_displacement / rig.area_1
        assert loop < 0.7 * min(rig_of(case)["damping"], rig.viscous_damping) / rig.mass
        kinds.append("exact" if not off else "beyond" if len(off) < 3 else "within")
    for kind, share in SHARES.items():
        assert kinds.count(kind) / len(kinds) == pytest.approx(share, abs=0.07)


def test_a_drawn_rig_runs_within_its_means():
    for case in draw_cases(4, 11):
        shown, _ = recording_of(case)
        assert all(np.isfinite(values).all() for values in shown.values())
        if "p1" in shown:
            assert min(shown["p1"].min(), shown["p2"].min()) > 2e5
        if "omega" in shown:
            assert np.abs(shown["omega"]).max() < 550.0


def test_unknown_names_are_refused():
    for wrong in (dict(effects=(("friction", 1.0),)), dict(motion="waltz"), dict(rig={"Z": 1.0})):
        with pytest.raises(ValueError, match="a: no "):
            Case("a", **wrong)


@pytest.mark.skipif(not SIMULATOR.is_dir(), reason=f"{SIMULATOR} is absent")
@pytest.mark.parametrize("record, hidden", [
    ("h32_rich", {}), ("h32_tri", {}), ("h19_tri", {"spring_load": {"k": 900.0}}),
    ("h12_rich", {"cross_port_leakage": {"L": 5e-13}}),
    ("h30_rich", {"pump_dead_zone": {"omega_0": 2.0}}),
    ("h41_rich", {"drive_lag": {"tau": 0.01}}),
    ("h46_rich", {"drive_saturation": {"omega_max": 200.0}}),
])
def test_plant_agrees_with_an_independent_simulator(record, hidden):
    table = np.genfromtxt(SIMULATOR / f"{record}.csv.gz", delimiter=",", names=True)
    shown, _ = recording_of(Case("a", tuple((name, 1.0) for name in hidden), noise=0.0,
                                 nuisance=0.0, options=hidden, demand=table["xd"]))
    for name, column, limit in (("x", "x", 0.2e-6), ("p1", "p1", 100.0), ("p2", "p2", 100.0),
                                ("omega", "w", 0.01)):
        assert np.sqrt(np.mean((shown[name] - table[column]) ** 2)) < limit
