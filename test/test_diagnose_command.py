"""``diagnose`` from a bag to its answers: the bundled bag hides dry friction."""

import json
import os
import pty
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from command_tools import refused
from test_reports import Page

from eha_monitor.cli import main
from eha_monitor.commands.common import progress_bar
from eha_monitor.recordings.read import read_recording
from eha_monitor.recordings.write import write_recording
from eha_monitor.settings import Settings, load_settings

ROOT = Path(__file__).parents[1]
BAG = ROOT / "bags" / "hidden_friction"
FAMILY = {"coulomb_friction", "stribeck_friction", "presliding_friction", "asymmetric_friction"}


def test_what_does_nothing_is_not_offered(capsys):
    assert main(["diagnose", "--help"]) == 0
    assert "calibration" not in capsys.readouterr().out


@pytest.mark.parametrize(("arguments", "words"), [
    ([], "Missing argument 'BAG [BAG ...]'"),
    (["missing_bag"], "missing_bag: no such bag"),
    ([BAG, BAG], "is given twice"),
    ([BAG, "--held-out", BAG], "--held-out names a bag that is fitted"),
    ([BAG, "--held-out", "missing_bag"], "missing_bag: no such bag"),
    ([BAG, "--json", "x.out", "--report", "x.out"], "--json and --report name the same file"),
    ([BAG, "--json", "x.out", "--write-config", "x.out"], "--write-config name the same file"),
    ([BAG, "--json", "missing/x.json"], "the folder missing does not exist"),
    ([BAG, "--report", BAG], "expected a file to write, found a folder"),
    ([BAG, "--write-config", BAG / "metadata.yaml"], "is part of the bag"),
    ([BAG, "--config", ROOT / "config/eha.yaml", "--write-config", ROOT / "config/eha.yaml"],
     "is the config that is read"),
    ([BAG, "--config", "missing.yaml"], "missing.yaml: cannot read config"),
    ([BAG, "--ros-args", "-r", "a:=b"], "is no ROS node"),
])
def test_bad_usage_is_one_line_before_any_work(capsys, arguments, words):
    assert words in refused(capsys, "diagnose", *arguments)


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """One diagnosis as a process of its own, with everything it writes; it takes the longest."""
    folder = tmp_path_factory.mktemp("diagnosed")
    done = subprocess.run(
        [sys.executable, "-m", "eha_monitor", "diagnose", str(BAG), "--exit-code",
         "--json", folder / "a.json", "--report", folder / "a.html",
         "--write-config", folder / "a.yaml"], cwd=ROOT, capture_output=True, text=True,
        timeout=280)
    return folder, done


@pytest.mark.timeout(300)
def test_friction_is_found_and_told(answered):
    folder, done = answered
    assert done.returncode == 1, done.stderr  # --exit-code: the model does not fit
    assert "━" not in done.stderr  # no bar where nobody watches
    tree = json.loads((folder / "a.json").read_text())
    assert tree["verdict"] == "mismatch"
    assert max(tree["location"]["balance"], key=tree["location"]["balance"].get) == "force"
    first, = tree["effects"]
    assert first["name"] == "coulomb_friction" or (
        "coulomb_friction" in first["indistinguishable_from"] and first["name"] in FAMILY)
    assert first["parameters"]["F_c"]["value"] == pytest.approx(40.0, rel=0.05)
    assert tree["parameters"]["before"]["B"]["value"] > 900.0
    assert tree["parameters"]["after"]["B"]["value"] == pytest.approx(600.0, rel=0.02)
    modulus = tree["parameters"]["after"]["beta_e"]  # no better known than the volumes are
    assert abs(modulus["value"] - 6e8) < 2.0 * modulus["stddev"] < 0.2 * 6e8
    position = tree["fit"]["signals"]["position"]
    assert position["after_rms"] < 0.3 * position["before_rms"]
    assert "coulomb_friction" in done.stdout


def test_report_and_config_are_whole(answered):
    folder, _ = answered
    page = Page((folder / "a.html").read_text())
    assert page.ids >= {"verdict", "curve", "where", "effects", "fit", "certainty", "command"}
    assert "Coulomb friction" in page.text or "friction" in page.text
    settings = load_settings(folder / "a.yaml")
    assert settings.effects
    assert settings.rig.viscous_damping == pytest.approx(600.0, rel=0.02)


def test_estimate_runs_with_the_written_config(answered, capsys):
    """With the friction in the model, B is B: before, only least squares have it."""
    folder, _ = answered
    told = {}
    first = read_recording(BAG, Settings()).part(0, 3000)  # with the friction: 2.4 s a second
    bag = write_recording(folder / "first", first, Settings())
    for name, more in (("nominal", []), ("named", ["--config", str(folder / "a.yaml")])):
        out = folder / f"{name}.json"
        assert main(["estimate", str(bag), "--json", str(out), *more]) == 0
        told[name] = json.loads(out.read_text())
    capsys.readouterr()
    assert told["nominal"]["stages"]["one"]["value"] > 900.0
    assert told["nominal"]["parameters"]["B"]["by"] == "least squares"
    assert told["nominal"]["parameters"]["B"]["value"] == pytest.approx(600.0, rel=0.02)
    assert told["named"]["parameters"]["B"]["value"] == pytest.approx(600.0, rel=0.1)
    levels = {alarm["name"]: alarm["level"] for alarm in told["named"]["alarms"]}
    assert levels["viscous_damping_high"] == "OK"


def test_simulator_runs_with_the_written_config(answered, tmp_path, capsys):
    folder, _ = answered
    assert main(["simulate", "--out", str(tmp_path / "bag"), "--duration", "1",
                 "--config", str(folder / "a.yaml")]) == 0
    assert "1 s, 1000 samples" in capsys.readouterr().out


def test_bar_moves_on_a_terminal_only(monkeypatch, capsys):
    with progress_bar() as told:
        told("trying", 0.5)
    assert capsys.readouterr().err == ""

    leader, follower = pty.openpty()
    shown = []

    def read() -> None:
        while True:
            try:
                part = os.read(leader, 4096)
            except OSError:  # the other end is closed
                return
            if not part:
                return
            shown.append(part)

    reader = threading.Thread(target=read)
    reader.start()
    with os.fdopen(follower, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setenv("COLUMNS", "100")
        with progress_bar() as told:
            told("trying the catalogue", 0.3)
            told("going back [a]", 0.1)
        monkeypatch.undo()
    reader.join(10)
    os.close(leader)
    text = b"".join(shown).decode()
    assert "going back [a]" in text
