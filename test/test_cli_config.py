"""config/eha.yaml is the settings in writing: the two cannot drift apart."""

import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel
from ruamel.yaml import YAML

from eha_monitor.cli import main
from eha_monitor.settings import Settings, load_settings
from eha_monitor.settings.load import _number, annotated

ROOT = Path(__file__).parents[1]
FILE = ROOT / "config" / "eha.yaml"
# The one that is for another program is held in test_dashboard_configs.py.
CONFIGS = sorted(set((ROOT / "config").glob("*.yaml"))
                 - {ROOT / "config" / "diagnostic_aggregator.yaml"})


def test_file_is_what_the_command_prints(capsys):
    assert main(["config"]) == 0
    assert capsys.readouterr().out == FILE.read_text(encoding="utf-8"), (
        "settings have changed: python -m eha_monitor config > config/eha.yaml")


def test_file_says_what_no_file_says():
    assert load_settings(FILE) == Settings()


def sections(model: type[BaseModel]):
    """Yield every section class below a model."""
    yield model
    for field in model.model_fields.values():
        for found in (field.annotation, *getattr(field.annotation, "__args__", ())):
            if isinstance(found, type) and issubclass(found, BaseModel):
                yield from sections(found)


@pytest.mark.parametrize(("text", "words"), [
    ("rig: {mass: '85,5 kg'}", "rig.mass: expected a decimal point, such as '85.5 kg', got "
                               "'85,5 kg'"),  # pint would read 855
    ("", "expected a config, found none of its sections"),  # cut while it was written
    ("# nothing but a remark\n", "expected a config, found none of its sections")])
def test_what_a_person_did_not_mean_is_refused(text, words, tmp_path, capsys):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    assert main(["estimate", str(ROOT / "bags" / "air_ingress"), "--config", str(file)]) == 2
    assert capsys.readouterr().err.strip() == f"eha_monitor: {file}: {words}"


def test_every_key_stands_in_the_file_with_its_description():
    text = " ".join(FILE.read_text(encoding="utf-8").replace("#", " ").split())
    for section in sections(Settings):
        for key, field in section.model_fields.items():
            assert f"{key}:" in text
            assert field.description, f"{section.__name__}.{key} has no description"
            assert " ".join(field.description.split()) in text, f"{section.__name__}.{key}"


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_every_config_survives_being_written_in_full(path, tmp_path):
    tree = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    if "columns" in tree:
        pytest.skip("a channel map for import, not a config")
    settings = load_settings(path)
    copy = tmp_path / "copy.yaml"
    copy.write_text(annotated(settings), encoding="utf-8")
    assert load_settings(copy) == settings


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_are_written_exactly_for_both_yaml_versions(value):
    yaml11 = YAML(typ="safe")
    yaml11.version = (1, 1)
    for reader in (YAML(typ="safe"), yaml11):
        read = reader.load(_number(value))
        assert isinstance(read, float)
        assert read == value


def test_ros_reads_the_file_as_a_parameter_file():
    pytest.importorskip("rclpy")
    code = (
        "import sys, rclpy; rclpy.init(args=['--ros-args', '--params-file', sys.argv[1]]);"
        "n = rclpy.create_node('reader', automatically_declare_parameters_from_overrides=True);"
        "print(n.get_parameter('rig.mass').value, n.get_parameter('rig.bulk_modulus').value)")
    read = subprocess.run([sys.executable, "-c", code, str(FILE)], capture_output=True,
                          text=True, timeout=60)
    assert read.stdout.split() == ["20.0", "600000000.0"], read.stderr
