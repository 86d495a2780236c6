"""The README's five steps, with the README's own config."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from eha_monitor.cli import cli, main
from eha_monitor.physics.simulator import Simulator
from eha_monitor.settings import Settings

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def test_five_steps_from_csv_to_estimate(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my_rig.yaml").write_text(re.search(r"```yaml\n(.*?)```", README, re.DOTALL)[1])
    seen = Simulator(Settings(), seed=1).advance(12_000)
    columns = {"time_ms": np.arange(12_000.0), "position_mm": seen["x"] * 1e3,
               "setpoint_mm": seen["x_d"] * 1e3, "pump_rpm": seen["omega"] * 30 / np.pi,
               "p_a_bar": seen["p1"] * 1e-5, "p_b_bar": seen["p2"] * 1e-5}
    np.savetxt("my_recording.csv", np.column_stack(list(columns.values())), delimiter=",",
               header=",".join(columns), comments="", fmt="%.9g")
    steps = re.findall(r"^    eha-monitor (import .*|estimate .*)$", README, re.MULTILINE)
    assert len(steps) == 2
    for step in steps:
        assert main(step.split()) == 0
    answer = json.loads(Path("my_answer.json").read_text())
    assert answer["parameters"]["B"]["value"] == pytest.approx(600, rel=0.01)
    assert answer["parameters"]["beta_e"]["value"] == pytest.approx(6e8, rel=0.02)
    assert answer["model"]["status"] == "consistent"
    assert Path("my_report.html").stat().st_size > 10_000


def test_every_command_is_in_the_table():
    for name in cli.commands:
        assert re.search(rf"^\| `{name}[ `]", README, re.MULTILINE), name


def test_links_lead_somewhere():
    root = Path(__file__).parents[1]
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (root / target).exists(), target
