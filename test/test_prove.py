"""The concealed-effect trial: sealed, blind, resumable, and marked as docs/proof.md says."""

import hashlib
import json
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_tools import refused

from eha_monitor.commands.experiments import prove as command
from eha_monitor.concealed.cases import Case, truth_of
from eha_monitor.concealed.draws import KINDS
from eha_monitor.concealed.generate import nominal_config
from eha_monitor.errors import InputError
from eha_monitor.prove.trial import DRAWS, Trial, begun, cases_of, ended, on_rig, prove
from eha_monitor.reports.proof_report import proof_page
from eha_monitor.settings import settings_from_tree

pytestmark = pytest.mark.timeout(600)  # 20 s; minutes where all has to be compiled first
ROOT = Path(__file__).parents[1]
CASES = (Case("c001", (("constant_load", 1.0),), motion="short", seed=11),
         Case("c002", motion="short", seed=12),
         Case("c003", (("position_delay", 1.0),), motion="short", seed=13))


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    return Trial(CASES, 4, tmp_path_factory.mktemp("trial"))


@pytest.fixture(scope="module")
def done(trial):
    told, moments = [], []

    def announce(text):
        told.append(text)
        moments.append(sorted(path.name for path in (trial.work / "answers").iterdir()))

    return prove(trial, announce), told, moments


def test_key_is_sealed_before_any_recording_is_read(trial, done):
    found, told, moments = done
    assert told == [f"sealed key: SHA-256 {found['sealed_key_sha256']}"]
    assert moments == [[]], "an answer was there before the key was sealed"
    content = (trial.work / "key" / "key.json").read_bytes()
    assert hashlib.sha256(content).hexdigest() == found["sealed_key_sha256"]
    for case in json.loads(content)["cases"]:  # the key holds the recordings fast as well
        bag = trial.work / "recordings" / case["case"]
        for path in [*bag.iterdir(), bag.with_suffix(".yaml")]:
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            assert digest == case["recording_sha256"][path.name]


def test_result_is_the_contracts(done):
    found, _, _ = done
    assert found["schema"] == "eha_monitor/proof/1" and found["cases"] == 3
    assert not found["failed"], [row["message"] for row in found["rows"]]
    for mark in ("exact", "within_class", "located", "null_false_alarm",
                 "sensor_blamed_on_physics", "held_out_error_removed"):
        assert 0 <= found["score"][mark] <= 1
    rows = {row["case"]: row for row in found["rows"]}
    assert set(rows["c001"]) >= {"case", "truth", "named", "located", "before_rms", "after_rms",
                                 "oracle_rms"}
    assert rows["c001"]["truth"] == ["constant_load"]
    assert rows["c001"]["located"] == "force" and rows["c001"]["within_class"]
    assert rows["c001"]["after_rms"] < 0.2 * rows["c001"]["before_rms"]
    assert rows["c002"]["exact"] and rows["c003"]["truth"] == ["position_delay"]
    assert found["by_effect"]["constant_load"]["n"] == 1


def test_nothing_that_is_there_is_done_again(trial, done):
    answers = {name: trial.work / "answers" / f"{name}.json" for name in ("c001", "c002")}
    stamps = {name: path.stat().st_mtime_ns for name, path in answers.items()}
    answers["c002"].unlink()
    shares = []
    again = prove(replace(trial, keep="all"), lambda text: None,
                  lambda text, share: shares.append((text, share)))
    assert [text for text, _ in shares if "diagnosing" in text] == ["diagnosing, 1 of 1"]
    assert answers["c001"].stat().st_mtime_ns == stamps["c001"]
    assert answers["c002"].stat().st_mtime_ns > stamps["c002"]
    assert again["score"] == done[0]["score"]


@pytest.mark.parametrize(("change", "words"), [
    ({"seed": 5}, "another seed (4), expected 5"),
    ({"cases": CASES[:2]}, "another number of cases (3), expected 2"),
    ({"cases": (CASES[0], CASES[1], replace(CASES[2], seed=1))}, "another generator of cases"),
])
def test_another_trials_folder_is_refused(trial, done, change, words):
    with pytest.raises(InputError, match=re.escape(words)):
        prove(replace(trial, **change))


def test_an_opened_key_must_be_the_sealed_one(trial, done):
    path = trial.work / "key" / "key.json"
    content = path.read_text()
    path.write_text(content.replace("constant_load", "spring_load"))
    try:
        with pytest.raises(InputError, match="is not the key that was sealed"):
            prove(trial)
    finally:
        path.write_text(content)


def test_command_refuses_another_seed_in_one_line(trial, done, capsys):
    assert "belongs to a trial with another seed (4), expected 9" in refused(
        capsys, "prove", "--cases", "3", "--seed", "9", "--work", trial.work)


def test_report_shows_marks_hash_and_misses(trial, done):
    found, _, _ = done
    assert 'id="reliability"' in proof_page({**found, "reliability": [
        {"low": 0.9, "high": 1.0, "n": 3, "said": 0.97, "right": 1.0}]})
    missed = dict(found["rows"][0], exact=False, within_class=False, named=["spring_load"],
                  classes={"spring_load": []}, pairs={}, verdict="mismatch")
    rest = [dict(row, within_class=True) for row in found["rows"][1:]]
    page = proof_page({**found, "rows": [missed, *rest]}, trial.work)
    assert found["sealed_key_sha256"] in page and 'data-mark="exact"' in page
    assert "Misses: 1 of 3" in page and "spring load" in page and "data:image/png" in page
    assert "http" not in re.sub(r"<meta[^>]*>", "", page)


def blind(trial: Path, allowed: Path, code: str) -> subprocess.CompletedProcess:
    guarded = ("import sys; from eha_monitor.prove.blind import guard;"
               f"sys.addaudithook(guard({str(trial)!r}, [{str(allowed)!r}])); {code}")
    return subprocess.run([sys.executable, "-c", guarded], capture_output=True, text=True,
                          timeout=60, cwd=ROOT)


def test_a_diagnosis_sees_its_own_recording_and_nothing_else(tmp_path):
    own, key = tmp_path / "recordings" / "c001", tmp_path / "key" / "key.json"
    for path in (own / "a", key, tmp_path / "recordings" / "c001.key"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("seen")
    (tmp_path / "way_round").symlink_to(key)
    good = blind(tmp_path, own, f"print(open({str(own / 'a')!r}).read())")
    assert good.stdout == "seen\n", good.stderr
    for code in (f"open({str(key)!r})", f"import os; os.open({str(key)!r}, 0)",
                 f"open({str(tmp_path / 'way_round')!r})",
                 f"open({str(own / '..' / '..' / 'key' / 'key.json')!r})",
                 f"open({str(tmp_path / 'recordings' / 'c001.key')!r})",
                 f"import os; os.listdir({str(tmp_path)!r})",
                 f"import os; os.chdir({str(tmp_path / 'key')!r})",
                 "import os; os.system('true')",
                 "import subprocess; subprocess.run(['true'])",
                 "import eha_monitor.concealed.draws"):
        bad = blind(tmp_path, own, code)
        assert bad.returncode == 1 and "PermissionError" in bad.stderr, code


def test_the_generator_in_memory_is_refused():
    code = ("import eha_monitor.concealed.cases; from eha_monitor.prove.blind import main;"
            "main(['/nowhere', '--', 'diagnose', 'bag'])")
    bad = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60,
                         cwd=ROOT)
    assert bad.returncode == 1 and "must not know it" in bad.stderr


@pytest.mark.parametrize(("seconds", "status", "words"), [
    (60.0, 1, "ValueError: 'such' is not in list"), (0.0, -signal.SIGKILL, "took more than 0 s")])
def test_how_a_process_ended_is_told(seconds, status, words):
    process = begun("eha_monitor.prove.blind", ["no", "such"])
    told = ended(process, seconds)
    assert told[0] == status and words.split(":")[0] in told[1]


def test_the_command_offers_every_kind_of_rig_numbers():
    offered = {option.name: option.type for option in command.params}
    assert set(offered["rig"].choices) == set(KINDS)
    assert set(offered["draw"].choices) == set(DRAWS)


def test_draws_of_a_seed_are_a_head_of_more():
    for draw in DRAWS:
        assert cases_of(draw, 5, 3) == cases_of(draw, 9, 3)[:5] != cases_of(draw, 5, 4)


def test_a_config_puts_all_cases_on_its_rig():
    settings = settings_from_tree({"rig": {"mass": 33.0, "viscous_damping": 700.0}}, "rig")
    cases = on_rig(cases_of("mixed", 3, 1), settings, "rig")
    assert {case.rig["M"] for case in cases} == {33.0}
    assert {nominal_config(case)["/**"]["ros__parameters"]["rig"]["viscous_damping"]
            for case in cases} == {700.0}
    own = {"rig": {"mass": 33.0, "tolerance": {"mass": 0.2, "leakage": 2.0}}}
    for case in cases_of("outside", 9, 1, "beyond", settings_from_tree(own, "rig"), "rig"):
        nominal = settings_from_tree(nominal_config(case), case.name).rig
        assert nominal.tolerance == settings_from_tree(own, "rig").rig.tolerance
        off = truth_of(case)["rig_off"]
        error = np.log(off[0]["configured"] / off[0]["true"])
        assert 2.99 < abs(error) / nominal.tolerance.log_spread(off[0]["key"]) < 10.01
    with pytest.raises(InputError, match="equal areas"):
        on_rig(cases, settings_from_tree({"rig": {"area_2": 4e-4}}, "rig"), "rig")
