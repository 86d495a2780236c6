"""What has changed against healthy recordings: strokes of a made-up actuator, and real ones."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from rig_tools import write_channels

from eha_monitor.commands.answers import command_line, diagnose
from eha_monitor.errors import InputError
from eha_monitor.mismatch.compared import compared
from eha_monitor.physics.simulator import Simulator
from eha_monitor.recordings.importing import read_table
from eha_monitor.recordings.recording import between_stops
from eha_monitor.settings import load_settings
from eha_monitor.settings.load import settings_from_tree

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT.parent / "shared" / "data" / "flo_tork"
DT, SPEED = 4e-3, 2700.0  # s; counts/s


def stroke(seed: int, way: int = 1, dry: float = 100.0, load: float = 0.0, spread: float = 10.0,
           samples: int = 1200):
    """Return time, angle, p1 and p2 of one stroke between two stops, pressed on both, counts."""
    rng = np.random.default_rng(seed)
    speed = SPEED + 150.0 * rng.standard_normal()
    t = np.arange(samples) * DT
    v = speed * np.clip(np.minimum((t - 0.1) / 0.1, (1.7 - t) / 0.1), 0.0, 1.0)
    x = np.cumsum(v) * DT
    force = np.where(v > 0, 0.03 * v + dry + spread * rng.standard_normal() + way * load, 0.0)
    force[t < 0.1], force[v == 0] = -3000.0, np.where(t[v == 0] < 1.0, -3000.0, 5000.0)
    p1 = 3600.0 + way * 0.5 * force + rng.standard_normal(samples)
    p2 = 3600.0 - way * 0.5 * force + rng.standard_normal(samples)
    return t, way * (np.round(x) - 0.5 * x.max()) + 9500.0, p1, p2


def written(folder: Path, name: str, *made) -> Path:
    """Write a stroke as the table that config/flo_tork.yaml reads."""
    path = folder / f"{name}.csv"
    np.savetxt(path, np.column_stack([np.arange(len(made[0])), *made[1:]]), delimiter=",",
               header="Time,Angle,PG_1,PG_2", comments="", fmt="%.6g")
    return path


@pytest.fixture(scope="module")
def strokes(tmp_path_factory):
    folder, settings = tmp_path_factory.mktemp("strokes"), load_settings(
        ROOT / "config" / "flo_tork.yaml")

    def read(name, *made):
        return read_table(written(folder, name, *made), settings)

    healthy = [read(f"healthy_{i}", *stroke(i, 1 if i % 2 else -1)) for i in range(12)]
    return settings, read, healthy


def test_a_stroke_is_cut_where_it_is_pressed_against_a_stop():
    _, x, p1, p2 = stroke(3)
    ((first, last),) = between_stops(x, p1 - p2, DT)
    moving = np.flatnonzero(np.abs(np.diff(x)) > 1)
    assert moving[0] < first < last < moving[-1]
    assert np.ptp(x[first:last]) == pytest.approx(0.8 * np.ptp(x), rel=0.03)  # a tenth at each


def test_a_motion_that_reverses_is_not_cut():
    t = np.arange(5000) * 1e-3
    x, v = 0.1 * np.sin(2 * np.pi * t), 0.2 * np.pi * np.cos(2 * np.pi * t)
    assert between_stops(x, 20.0 * np.sign(v) + 100.0 * v, 1e-3) == [(0, 5000)]


def test_another_healthy_stroke_has_not_changed(strokes):
    settings, read, healthy = strokes
    for seed in (50, 51, 52, 53):
        found = compared([read(f"same_{seed}", *stroke(seed, 1 if seed % 2 else -1))], healthy,
                         settings)
        assert found.verdict == "consistent" and not found.changes
        assert "nothing has changed" in found.message


def test_more_dry_friction_is_named_with_its_size(strokes):
    settings, read, healthy = strokes
    found = compared([read("dry", *stroke(60, -1, dry=250.0))], healthy, settings)
    (change,) = found.changes
    # One stroke at one speed cannot tell dry friction from damping: either, with the other beside.
    alike = {change.what, *change.indistinguishable_from}
    assert found.verdict == "mismatch" and {"B", "coulomb_friction"} <= alike
    unit = SPEED if change.what == "B" else 1.0
    more = unit * (change.now.value - change.reference.value)
    assert more == pytest.approx(150.0, abs=3.0 * np.hypot(unit * change.reference.stddev, 10.0))
    assert found.location.balance["force"] == 1.0


def test_both_directions_tell_a_load_from_friction(strokes):
    settings, read, healthy = strokes
    found = compared([read("load_1", *stroke(61, 1, load=150.0)),
                      read("load_2", *stroke(62, -1, load=150.0))], healthy, settings)
    assert found.changes[0].what == "constant_load"
    assert "coulomb_friction" not in found.changes[0].indistinguishable_from


def test_a_single_reference_is_refused_where_it_is_too_short(strokes):
    settings, _, healthy = strokes
    with pytest.raises(InputError, match="at least 3 reference recordings"):
        compared(healthy[:1], healthy[1:2], settings)


def simulated(folder: Path, name: str, seed: int, **rig) -> Path:
    """Write a recording of the paper's EHA, each a little different from the next."""
    rng = np.random.default_rng(seed)
    settings = settings_from_tree({"rig": {
        "viscous_damping": 600.0 * (1 + 0.02 * rng.standard_normal()),
        "bulk_modulus": 6e8 * (1 + 0.02 * rng.standard_normal()), **rig}}, "test")
    return write_channels(folder / name, Simulator(settings, seed).advance(6000), settings)


@pytest.mark.timeout(300)
def test_command_says_what_has_changed_of_an_eha(tmp_path):
    references = [str(simulated(tmp_path, f"healthy_{i}", i)) for i in range(5)]
    now = simulated(tmp_path, "now", 90, bulk_modulus=4e8)
    answer = tmp_path / "answer.json"
    asked = CliRunner().invoke(diagnose, [
        str(now), "--json", str(answer), "--report", str(tmp_path / "r.html"), "--exit-code",
        "--reference", *references], catch_exceptions=False, standalone_mode=False)
    assert asked.return_value == 1, asked.output
    found = json.loads(answer.read_text())
    assert found["verdict"] == "mismatch" and len(found["references"]) == 5
    (change,) = found["changes"]
    assert change["what"] == "beta_e" and change["unit"] == "Pa"
    assert change["now"]["value"] == pytest.approx(4e8, rel=0.02)
    assert change["reference"]["value"] == pytest.approx(6e8, rel=0.05)
    fit = found["fit"]["signals"]["pressure_1"]
    assert fit["after_rms"] < 1.3 * fit["noise_rms"] < fit["before_rms"]
    page = (tmp_path / "r.html").read_text()
    assert "What has changed" in page and "Change identified" in page


def test_reference_and_bag_must_differ(tmp_path):
    asked = CliRunner().invoke(diagnose, ["a", "--reference", "b", "a"])
    assert isinstance(asked.exception, InputError) and "given twice" in str(asked.exception)


def test_what_a_comparison_has_no_use_for_is_refused(tmp_path):
    asked = CliRunner().invoke(diagnose, ["a", "--reference", "b", "--without", "backlash"])
    assert isinstance(asked.exception, InputError) and "--without" in str(asked.exception)


def test_the_report_s_command_names_what_was_not_considered():
    words = command_line((Path("a"),), None, None, without=("backlash", "relief_valve"))
    assert words == "eha-monitor diagnose a --without backlash relief_valve"


def test_effects_without_are_of_the_catalogue(tmp_path):
    asked = CliRunner().invoke(diagnose, ["a", "--without", "magic"])
    assert isinstance(asked.exception, InputError) and "magic" in str(asked.exception)


@pytest.mark.skipif(not DATA.exists(), reason="../shared/data/flo_tork is not here")
def test_the_valve_of_a_real_actuator_is_dry_friction():
    settings = load_settings(ROOT / "config" / "flo_tork.yaml")
    free = [read_table(file, settings) for file in sorted(DATA.glob("unit_5*"))]
    valve = [read_table(file, settings) for file in sorted(DATA.glob("unit_1*"))]
    healthy = [one for i, one in enumerate(free) if i % 4 != 3]
    for one in free[3::4]:
        assert compared([one], healthy, settings).verdict == "consistent"
    for one in valve[::3]:
        names = [change.what for change in compared([one], healthy, settings).changes]
        assert names[:1] == ["coulomb_friction"], names
