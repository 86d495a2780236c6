"""The user's own hypothesis: read, refused in one line, fitted and ranked."""

import re
from pathlib import Path

import numpy as np
import pytest
from rig_tools import settings, simulated
from ruamel.yaml import YAML

from eha_monitor.api.diagnose import answer, written_config
from eha_monitor.errors import InputError
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.mismatch.learn.validated import starts_of
from eha_monitor.settings import settings_from_tree
from eha_monitor.settings.hypothesis import load_hypothesis

PAGE = (Path(__file__).parents[1] / "docs/effects.md").read_text()
SPOT = re.search(r"```yaml\n(# spot.yaml.*?)```", PAGE, re.DOTALL)[1]
CAM = """
name: cam
adds: force
expression: "A*cos(2*pi*x/0.007)"
parameters:
  A: {start: 20.0, lower: -500.0, upper: 500.0, unit: N}
"""
SWEEP = {"kind": "multisine", "amplitude": 0.02, "frequency": 0.3, "frequency_end": 20.0,
         "duration": 5.0}


def loaded(tmp_path, text):
    (tmp_path / "mine.yaml").write_text(text)
    return load_hypothesis(tmp_path / "mine.yaml")


def package(folder: Path, text: str) -> None:
    """Install a package with an entry point, as pip leaves it."""
    (folder / "my_laws.py").write_text(text)
    about = folder / "my_laws-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my_laws\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[eha_monitor.effects]\ncam = my_laws:CAM\n")


def test_a_hypothesis_of_an_installed_package_goes_by_its_name(tmp_path, monkeypatch):
    package(tmp_path, f"CAM = {YAML(typ='safe').load(CAM)!r}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    found = load_hypothesis("cam")
    assert found.name == "cam" and found.parameters["A"].unit == "N"
    with pytest.raises(InputError, match=r"eha_monitor\.effects: cam"):
        load_hypothesis("camel")


def test_a_package_that_cannot_be_imported_is_told_in_one_line(tmp_path, monkeypatch):
    package(tmp_path, "import nothing_of_that_name\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(__import__("sys").modules, "my_laws", raising=False)
    with pytest.raises(InputError, match="nothing_of_that_name"):
        load_hypothesis("cam")


def test_the_page_s_hypothesis_is_read(tmp_path):
    found = loaded(tmp_path, SPOT)
    assert (found.name, found.adds, found.balance) == ("worn_spot", "force", "force")
    assert [one.log for one in found.parameters.values()] == [False, False, True]
    starts = starts_of(found)
    assert starts[0] == {"F": 20.0, "x_0": 0.0, "w": 3e-3} and len(starts) == 10
    assert all(one.lower <= start[key] <= one.upper for start in starts
               for key, one in found.parameters.items())


@pytest.mark.parametrize(("old", "new", "told"), [
    ("start: 20.0", "start: 900.0", "parameters.F: start: expected 0 to 500, got 900"),
    ("upper: 500.0", "upper: -1.0", "parameters.F: upper: expected more than lower"),
    ("adds: force", "adds: weight", "worn_spot.adds: expected one of force"),
    ("F*exp", "G*exp", "worn_spot.F: the expression has no parameter"),
    ("F*exp(", "__import__(", "worn_spot.expression: "),
    ("{x_0}:", "{y}:", "sentence: expected only names of its parameters in braces, F, x_0, w"),
    ("{x_0}:", "{x_0.__class__}:", "sentence: expected only names"),
    ("name: worn_spot", "name: coulomb_friction", "is an effect of the catalogue"),
    ("sentence:", "sentense:", "sentense: unknown key, did you mean 'sentence'"),
    ("start: 20.0", "start: .nan", "parameters.F.start: "),
    ("name: worn_spot", "name: [1]", "name: "),
])
def test_a_wrong_one_is_one_line_with_file_and_key(tmp_path, old, new, told):
    with pytest.raises(InputError) as refused:
        loaded(tmp_path, SPOT.replace(old, new, 1))
    line = str(refused.value)
    assert told in line and "mine.yaml: " in line and "\n" not in line


@pytest.mark.parametrize("text", ["", "[]", "3", "a: b: c", "parameters: {}"])
def test_what_is_no_hypothesis_is_one_line(tmp_path, text):
    with pytest.raises(InputError, match=r"mine\.yaml"):
        loaded(tmp_path, text)


@pytest.fixture(scope="module")
def worn():
    return simulated(SWEEP, 5.0, effects={"worn": {
        "adds": "force", "expression": "F*exp(-((x - x_0)/w)**2)*tanh(v/1e-3)", "F": 60.0,
        "x_0": 4e-3, "w": 5e-3}}).recording(seed=1)


def test_a_right_one_is_named_with_its_numbers(worn, tmp_path):
    found = diagnose([worn.part(0, 3000)], settings(), hypothesis=loaded(tmp_path, SPOT))
    assert (found.verdict, found.learned) == ("mismatch", ())
    effect = next(one for one in found.effects if one.name == "worn_spot")
    assert effect.probability > 0.99 and effect.statement.startswith("the cylinder is worn at 4")
    for key, true in (("F", 60.0), ("x_0", 4e-3), ("w", 5e-3)):
        said = effect.parameters[key]
        assert said.value == pytest.approx(true, rel=0.03)
        assert abs(said.value - true) < 4.0 * said.stddev + 1e-3 * true
    assert max(found.location.balance, key=found.location.balance.get) == "force"
    for fit in found.signals.values():
        if np.isfinite(fit.noise_rms):  # the balance of forces has no sensor
            assert fit.after_rms < 1.3 * fit.noise_rms
    assert answer(found)["effects"][0]["equation"].startswith("F*exp(")
    tree = YAML(typ="safe").load(written_config(found, settings(), None))
    written = settings_from_tree(tree, "written")
    assert written.effects["worn_spot"]["F"] == pytest.approx(60.0, rel=0.03)


@pytest.mark.slow  # 25 s: a whole diagnosis that learns a term, beside that of the right one
@pytest.mark.timeout(300)
def test_a_wrong_one_is_considered_and_lost(worn, tmp_path):
    found = diagnose([worn], settings(), hypothesis=loaded(tmp_path, CAM))
    assert "cam" not in {effect.name for effect in found.effects} | set(found.config_effects)
    lost = next(one for one in found.considered if one.name == "cam")
    assert lost.why and np.isfinite(lost.gain)
    assert found.learned and found.learned[0].shape == "a bump"  # the truth is learned instead
