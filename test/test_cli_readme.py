"""The README's five steps, with the README's own config, and what it shows of a bag."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from eha_monitor.cli import cli, main
from eha_monitor.physics.simulator import Simulator
from eha_monitor.settings import Settings, load_settings

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_five_steps_from_csv_to_estimate(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    seen = Simulator(Settings(), seed=1).advance(12_000)
    columns = {"time_ms": np.arange(12_000.0), "position_mm": seen["x"] * 1e3,
               "setpoint_mm": seen["x_d"] * 1e3, "pump_rpm": seen["omega"] * 30 / np.pi,
               "p_a_bar": seen["p1"] * 1e-5, "p_b_bar": seen["p2"] * 1e-5}
    np.savetxt("my_recording.csv", np.column_stack(list(columns.values())), delimiter=",",
               header=",".join(columns), comments="", fmt="%.9g")
    init = re.findall(r"^    eha-monitor (init .*)$", README, re.MULTILINE)
    assert len(init) == 1
    assert main(init[0].split()) == 0
    drafted = load_settings("my_rig.yaml").table
    Path("my_rig.yaml").write_text(re.search(r"```yaml\n(.*?)```", README, re.DOTALL)[1])
    # The draft and what the README writes by hand read the file alike.
    by_hand = load_settings("my_rig.yaml").table
    assert {name: (one.column, one.gain) for name, one in drafted.columns.items()} == {
        name: (one.column, one.gain) for name, one in by_hand.columns.items()}
    steps = re.findall(r"^    eha-monitor (import .*|estimate .*)$", README, re.MULTILINE)
    assert len(steps) == 2
    for step in steps:
        assert main(step.split()) == 0
    answer = json.loads(Path("my_answer.json").read_text())
    assert answer["parameters"]["B"]["value"] == pytest.approx(600, rel=0.01)
    assert answer["parameters"]["beta_e"]["value"] == pytest.approx(6e8, rel=0.02)
    assert answer["model"]["status"] == "consistent"
    assert Path("my_report.html").stat().st_size > 10_000


def test_what_the_readme_shows_of_a_bag_is_what_comes(capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("COLUMNS", "160")
    shown = re.search(r"^    \$ eha-monitor (estimate .*)\n((?:    .*\n)+)", README, re.MULTILINE)
    assert main(shown[1].split()) == 0
    came = [line.split() for line in capsys.readouterr().out.splitlines()]
    for line in shown[2].splitlines():
        words = line.removesuffix("...").split()
        assert any(one[:len(words)] == words for one in came), line


def test_every_command_is_in_the_table():
    text = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    for name in cli.commands:
        assert re.search(rf"^\| `{name}[ `]", text, re.MULTILINE), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = page.read_text(encoding="utf-8")
    for target, anchor in re.findall(r"\]\(([^)#:]*)(#[^):]*)?\)", text):
        there = page.parent / target if target else page
        assert there.exists(), target
        if anchor:
            heads = re.findall(r"^#+ (.*)$", there.read_text(encoding="utf-8"), re.MULTILINE)
            slugs = {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads}
            assert anchor[1:] in slugs, target + anchor


def test_every_page_can_be_reached_from_the_readme():
    reached, ahead = set(), [ROOT / "README.md"]
    while ahead:
        page = ahead.pop()
        reached.add(page)
        links = re.findall(r"\]\(([^)#:]+\.md)", page.read_text(encoding="utf-8"))
        ahead += {(page.parent / link).resolve() for link in links} - reached
    assert set(PAGES) <= reached
