"""The command ``export``: what it writes, what it says, what it refuses."""

import stat

import pytest
from command_tools import refused

from eha_monitor.cli import main

FRICTION = "effects:\n  coulomb_friction: {F_c: 40.0}\n"


@pytest.fixture
def config(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.yaml").write_text(FRICTION)
    return "rig.yaml"


def test_several_formats_at_once(config, capsys, tmp_path):
    assert main(["export", config, "--modelica", "m.mo", "--urdf", "r.urdf", "--mujoco", "r.xml",
                 "--ros2-control", "ff.yaml", "--fmu", "m.fmu", "--fmu-platform",
                 "linux64"]) == 0
    said = capsys.readouterr().out
    for name in ("m.mo", "r.urdf", "r.xml", "ff.yaml", "m.fmu"):
        assert (tmp_path / name).stat().st_size > 200
        assert f"{name}: written" in said
    assert "  not in it: hydraulics and drive" in said
    assert not list(tmp_path.glob(".*"))


def test_an_older_file_is_replaced_and_kept_where_nothing_is_made(config, tmp_path):
    (tmp_path / "m.mo").write_text("old")
    (tmp_path / "bad.yaml").write_text("rig: {area_1: null}\n")
    assert main(["export", "bad.yaml", "--urdf", "r.urdf", "--modelica", "m.mo"]) == 2
    assert (tmp_path / "m.mo").read_text() == "old"
    assert not (tmp_path / "r.urdf").exists()  # nothing where one of them is refused
    assert main(["export", config, "--modelica", "m.mo"]) == 0
    assert "model eha" in (tmp_path / "m.mo").read_text()


@pytest.mark.parametrize(("arguments", "words"), [
    ([], "expected a format, one of --fmu, --modelica, --urdf"),
    (["--sdf", "a"], "No such option"),
    (["--urdf", "rig.yaml"], "is the config that is read"),
    (["--urdf", "a", "--mujoco", "a"], "--urdf and --mujoco name the same file"),
    (["--urdf", "nowhere/a"], "the folder nowhere does not exist"),
    (["--urdf", "."], "expected a file to write, found a folder"),
    (["--urdf", "a", "--joint", "a b"], "--joint: expected a name"),
    (["--urdf", "a", "--recording", "bag"], "--recording: expected --ros2-control beside it"),
    (["--urdf", "a", "--fmu-platform", "linux64"], "--fmu-platform: expected --fmu"),
    (["--ros2-control", "a", "--recording", "missing"], "missing"),
    (["--fmu", "a", "--fmu-platform", "irix"], "irix"),
])
def test_bad_input_is_one_line_and_status_2(config, capsys, arguments, words, tmp_path):
    assert words in refused(capsys, "export", config, *arguments)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig.yaml"]


@pytest.mark.parametrize("text", ["", "rig: 3\n", "effects: {friction: {F: 1}}\n",
                                  "rig: {mass: -1}\n"])
def test_a_config_that_is_none(config, capsys, text, tmp_path):
    assert "none.yaml" in refused(capsys, "export", "none.yaml", "--urdf", "a.urdf")
    (tmp_path / "odd.yaml").write_text(text)
    assert main(["export", "odd.yaml", "--urdf", "a.urdf"]) == 2


def test_a_folder_that_cannot_be_written(config, capsys, tmp_path):
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(stat.S_IRUSR | stat.S_IXUSR)
    try:
        (folder / "probe").touch()
        pytest.skip("this user may write everywhere")
    except PermissionError:
        pass
    said = refused(capsys, "export", config, "--urdf", "locked/a.urdf")
    assert "locked/a.urdf: cannot write" in said


def test_a_motion_that_stands_still_has_no_speed(config, tmp_path):
    (tmp_path / "rest.yaml").write_text(
        FRICTION + "simulation: {excitation: {rest: {kind: rest, duration: 1.0}}}\n")
    assert main(["export", "rest.yaml", "--urdf", "r.urdf", "--ros2-control", "f.yaml"]) == 0
    assert "nan" not in (tmp_path / "r.urdf").read_text() + (tmp_path / "f.yaml").read_text()
