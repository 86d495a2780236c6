"""A folder of bags: found, answered many at a time, kept in one table, resumed."""

import json
import os
import re
import shutil
from functools import partial
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from archive_tools import here, killed_by_three
from command_tools import refused
from diagnosis_tools import coulomb, everything
from rig_tools import MULTISINE, simulated, write_channels
from test_reports import Page

from eha_monitor.api.diagnose import answer as diagnosis_tree
from eha_monitor.archive.find import find_bags, is_archive, stamp_of
from eha_monitor.archive.run import DIED, on_this_machine
from eha_monitor.archive.store import COLUMNS
from eha_monitor.cli import main
from eha_monitor.commands.archive_rows import (
    Task,
    diagnosis_columns,
    estimate_columns,
    limit_columns,
    row_of,
    show,
)
from eha_monitor.indicators.indicator import AVAILABLE, Indicator
from eha_monitor.physics.simulator import Simulator
from eha_monitor.reports.archive_report import archive_page, phrases, summary_words
from eha_monitor.settings import settings_from_tree

pyarrow = pytest.importorskip(
    "pyarrow", reason="pyarrow is not installed (make setup WITH=archive)")

from eha_monitor.archive.store import Store, iso_time, nanoseconds_of, read_table  # noqa: E402

ROOT = Path(__file__).parents[1]
START = 1_790_000_000_000_000_000
DAY = 86_400 * 10**9
OF_THE_RUN = ("wall_s", "answered")  # of a row: not of the recording


def night(path: Path, k: int, damping: float = 600.0, seconds: float = 3.0) -> Path:
    """Record the paper's EHA for some seconds on the evening of day ``k``."""
    settings = settings_from_tree({"rig": {"viscous_damping": damping}}, "test")
    path.parent.mkdir(parents=True, exist_ok=True)
    seen = Simulator(settings, seed=k).advance(round(1000 * seconds))
    return write_channels(path, seen, settings, start_ns=START + k * DAY)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Four nights, one of them a lone file, a broken bag, and what is no bag."""
    made = tmp_path_factory.mktemp("rig") / "nights"
    for k, name in enumerate(("october/n0", "october/n1.mcap", "november/n10", "november/n9")):
        night(made / name, k, 600.0 + 10.0 * k)
    (made / "november/cut.mcap").write_bytes(b"")
    (made / "notes").mkdir()
    (made / "notes/readme.txt").write_text("no bag")
    return made


@pytest.fixture(scope="module")
def answered(folder) -> Path:
    """The table of the folder, made by two processes."""
    out = folder.parent / "table"
    assert main(["estimate", str(folder), "--out", str(out), "--jobs", "2"]) == 0
    return out


def rows_of(out: Path, command: str = "estimate") -> dict[str, dict]:
    return {row["bag"]: row for row in read_table(out / f"{command}.parquet")[0]}


def counted(monkeypatch) -> list[str]:
    """Let answers be made in this process, without the page; returns the bags that are."""
    asked = []
    monkeypatch.setattr("eha_monitor.archive.run.on_this_machine", partial(here, asked=asked))
    monkeypatch.setattr("eha_monitor.reports.archive_report.archive_page",
                        lambda *arguments: "")
    return asked


def test_what_is_a_bag_and_what_holds_bags(tmp_path):
    def touch(*names):
        for name in names:
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"")

    touch("all/whole/metadata.yaml", "all/whole/whole_0.mcap", "all/deep/er/x.mcap",
          "all/crashed/run_0.mcap", "all/crashed/run_1.mcap", "all/old/old_0.db3",
          "all/loose.mcap", "all/packed.mcap.zstd", "all/.trash/gone.mcap", "all/read.txt",
          "one/only.mcap", "empty/notes.txt", "two/a.mcap", "two/b.mcap",
          "daily/night_20261101.mcap", "daily/night_20261102.mcap")
    (tmp_path / "all/again").symlink_to(tmp_path / "all")  # a loop
    (tmp_path / "empty/dangling.mcap").symlink_to(tmp_path / "missing")
    names = [place.name for place in find_bags(tmp_path / "all")]
    assert names == ["crashed", "deep/er/x.mcap", "loose.mcap", "old", "packed.mcap.zstd",
                     "whole"]
    held = {name: is_archive(tmp_path / name) for name in (
        "all", "all/whole", "all/crashed", "all/loose.mcap", "one", "empty", "two", "daily",
        "missing")}
    assert [name for name, is_one in held.items() if is_one] == ["all", "two", "daily"]
    # What was read as one bag before still is, unless a table is asked for.
    assert is_archive(tmp_path / "one", wanted=True)
    assert not is_archive(tmp_path / "all/whole", wanted=True)


def test_a_stamp_changes_with_the_files_and_not_with_their_place(tmp_path, folder):
    bag = shutil.copytree(folder / "october/n0", tmp_path / "n0")
    stamp = stamp_of(bag)
    assert stamp == stamp_of(folder / "october/n0")
    moved = bag.rename(tmp_path / "elsewhere")
    assert stamp_of(moved) == stamp
    os.utime(next(moved.glob("*.mcap")), (1, 1))
    assert stamp_of(moved) != stamp


def test_rows_are_what_the_single_bag_says(folder, answered, tmp_path, capsys):
    rows = rows_of(answered)
    assert set(rows) == {"november/cut.mcap", "november/n9", "november/n10", "october/n0",
                         "october/n1.mcap"}
    for name in ("october/n0", "october/n1.mcap", "november/n9", "november/n10"):
        answer = tmp_path / "a.json"
        assert main(["estimate", str(folder / name), "--json", str(answer)]) == 0
        for key, value in estimate_columns(json.loads(answer.read_text())).items():
            assert rows[name][key] == value, (name, key)
        assert rows[name]["error"] is None
    assert rows["november/n10"]["start"] == "2026-09-23T14:13:20.000000000Z"
    broken = refused(capsys, "estimate", folder / "november/cut.mcap")
    assert rows["november/cut.mcap"]["error"] in broken
    assert rows["november/cut.mcap"]["B"] is None


def test_other_programs_read_the_table(answered):
    import pandas

    table = pandas.read_parquet(answered / "estimate.parquet").set_index("bag")
    assert str(table["start"].dt.tz) == "UTC"
    assert table.loc["november/n9", "B"] == pytest.approx(630.0, rel=0.02)
    assert set(table.columns) | {"bag"} == {c.name for c in COLUMNS if c.only != "diagnose"}


def test_a_row_leads_to_the_report_of_its_recording(folder, tmp_path, monkeypatch, capsys):
    few, out = tmp_path / "few", tmp_path / "table"
    shutil.copytree(folder / "october/n0", few / "a #1/n0")
    monkeypatch.setattr("eha_monitor.archive.run.on_this_machine", here)
    assert main(["estimate", str(few), "--out", str(out)]) == 0
    page = Page((out / "estimate.html").read_text(encoding="utf-8"))
    assert "--reports" in page.text and not (out / "estimate_reports").exists()
    # Rows that have none are made again; the address is one that a browser finds.
    assert main(["estimate", str(few), "--out", str(out), "--reports"]) == 0
    page = Page((out / "estimate.html").read_text(encoding="utf-8"))
    led = [r for r in page.references if r.startswith("estimate_reports/")]
    assert len(led) == 1 and "%20%23" in led[0]
    report = Page((out / unquote(led[0])).read_text(encoding="utf-8"))
    assert "parameters" in report.ids and "a #1" in report.text
    # One that is older than its row is another answer's.
    store = Store(out, "estimate", few)
    row = next(iter(rows_of(out).values()))
    os.utime(store.report_of(row["bag"]), (1, 1))
    assert not store.has_report(row)
    assert store.report_of("../../x").resolve().is_relative_to(out.resolve())
    assert "--reports is for a folder" in refused(
        capsys, "estimate", folder / "october/n0", "--reports")


def test_page_shows_trends_and_what_is_broken(answered):
    page = Page((answered / "estimate.html").read_text(encoding="utf-8"))
    assert page.ids >= {"summary", "history-B", "history-beta_e", "broken", "recordings"}
    assert "through 4 recordings" in page.text
    assert "the file is empty" in page.text
    assert not [one for one in page.references if not one.startswith(("data:", "#"))]


def test_a_second_run_does_only_what_is_new(folder, answered, tmp_path, monkeypatch, capsys):
    nights = shutil.copytree(folder, tmp_path / "nights")
    out = tmp_path / "out"
    asked = counted(monkeypatch)

    def run(*more) -> list[str]:
        asked.clear()
        assert main(["estimate", str(nights), "--out", str(out), *more]) == 0
        return sorted(asked)

    everything = ["november/cut.mcap", "november/n10", "november/n9", "october/n0",
                  "october/n1.mcap"]
    assert run() == everything
    first = rows_of(out)
    assert run() == []
    assert rows_of(out) == first
    assert "0 processed now, 5 unchanged" in capsys.readouterr().out

    os.utime(nights / "october/n1.mcap", (1, 1))  # changed
    (nights / "november/n9").rename(nights / "n9")  # moved
    shutil.rmtree(nights / "october/n0")  # gone
    night(nights / "new", 9, seconds=1.0)
    assert run() == ["new", "october/n1.mcap"]
    rows = rows_of(out)
    assert [name for name, row in rows.items() if row["gone"]] == ["october/n0"]
    assert rows["n9"]["B"] == first["november/n9"]["B"]
    assert "november/n9" not in rows

    config = tmp_path / "other.yaml"
    config.write_text("thresholds: {viscous_damping: {high_warn: 601.0}}")
    assert run("--config", str(config), "--keep", "all") == []
    assert len(run("--config", str(config))) == 5
    assert rows_of(out)["n9"]["alarm"] == "WARN"
    assert main(["estimate", str(nights), "--out", str(out), "--config", str(config),
                 "--exit-code"]) == 1
    assert len(run("--config", str(config), "--keep", "none")) == 5


def test_what_was_answered_before_an_interruption_stays(folder, tmp_path, monkeypatch, capsys):
    arguments = ["estimate", str(folder), "--out", str(tmp_path)]

    def interrupted(function, tasks, jobs, alone=0):
        for task in tasks[:2]:
            yield task, function(task), ""
        raise KeyboardInterrupt

    monkeypatch.setattr("eha_monitor.archive.run.on_this_machine", interrupted)
    assert main(arguments) == 130
    done = set(rows_of(tmp_path))
    assert len(done) == 2
    assert (tmp_path / "estimate.html").exists()
    asked = counted(monkeypatch)
    assert main(arguments) == 0
    assert len(asked) == 3
    assert not done & set(asked)


def test_a_killed_run_leaves_its_journal(tmp_path):
    row = {"bag": "a", "stamp": "1", "made_with": "2", "B": 600.0}
    with Store(tmp_path / "out", "estimate", tmp_path) as store:
        store.add(row)
        store.add(row | {"bag": "b"})
        with pytest.raises(Exception, match="another run is writing it"), \
                Store(tmp_path / "out", "estimate", tmp_path):
            pass
    journal = tmp_path / "out/.estimate.journal"
    journal.write_text(journal.read_text() + '{"bag": "c", "B": 6')  # the power went
    with Store(tmp_path / "out", "estimate", tmp_path) as store:
        assert set(store.rows) == {"a", "b"}
        store.add(row | {"bag": "d", "start": iso_time(START + 7), "effects": None})
    with Store(tmp_path / "out", "estimate", tmp_path) as store:
        assert set(store.rows) == {"a", "b", "d"}
        store.write()
    assert not journal.exists()
    rows = rows_of(tmp_path / "out")
    assert nanoseconds_of(rows["d"]["start"]) == START + 7
    with pytest.raises(Exception, match=r"is the table of .* expected another --out"), \
            Store(tmp_path / "out", "estimate", tmp_path / "out"):
        pass


@pytest.mark.parametrize(("arguments", "words"), [
    (["estimate", "{folder}", "--json", "x.json"], "--json is for a single bag"),
    (["estimate", "{folder}", "--report", "x.html"], "--report is for a single bag"),
    (["diagnose", "{folder}", "--write-config", "x.yaml"], "--write-config is for a single bag"),
    (["diagnose", "{folder}", "--held-out", "x"], "--held-out is for a single bag"),
    (["diagnose", "{folder}", "{folder}"], "expected one folder that holds bags"),
    (["estimate", "{folder}", "--jobs", "2", "--scheduler", "x"], "expected one of the two"),
    (["estimate", "{folder}/october/n0", "--jobs", "2"], "--jobs is for a folder that holds"),
    (["estimate", "{folder}/notes", "--out", "x"], "found a folder without bags"),
    (["estimate", "{folder}/notes"], "neither metadata.yaml nor .mcap file"),
    (["estimate", "{folder}", "--config", "missing.yaml"], "missing.yaml: cannot read config"),
    (["estimate", "{folder}", "--out", "{folder}/october/n1.mcap"], "n1.mcap"),
])
def test_bad_usage_is_one_line_before_any_work(folder, capsys, arguments, words):
    told = refused(capsys, *(part.format(folder=folder) for part in arguments))
    assert words in told


def test_a_folder_of_broken_bags_is_bad_input(tmp_path, monkeypatch, capsys):
    (tmp_path / "in").mkdir()
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / "in" / name).write_bytes(b"nonsense")
    counted(monkeypatch)
    told = refused(capsys, "estimate", tmp_path / "in", "--out", tmp_path / "out")
    assert "none of its 2 bags has an answer" in told
    assert len(rows_of(tmp_path / "out")) == 2


def test_a_row_of_a_diagnosis_holds_what_it_says(tmp_path):
    tree = diagnosis_tree(coulomb())
    row = diagnosis_columns(tree)
    assert row["B_after"] == tree["parameters"]["after"]["B"]["value"]
    assert row["verdict"] == tree["verdict"]
    with Store(tmp_path / "out", "diagnose", tmp_path) as store:
        store.add({"bag": "a", "stamp": "1", "made_with": "2", **row})
        store.write()
    effect, = rows_of(tmp_path / "out", "diagnose")["a"]["effects"]
    said, = tree["effects"]
    assert effect["name"] == said["name"] == "coulomb_friction"
    assert effect["statement"] == said["statement"]
    assert {one["name"]: one["value"] for one in effect["parameters"]} == {
        name: one["value"] for name, one in said["parameters"].items()}


def test_a_row_tells_wrong_numbers_of_the_rig_before_the_effects(tmp_path):
    tree = diagnosis_tree(everything())
    with Store(tmp_path / "out", "diagnose", tmp_path) as store:
        store.add({"bag": "a", "stamp": "1", "made_with": "2", **diagnosis_columns(tree)})
        store.add({"bag": "old", "stamp": "1", "made_with": "1", "effects": [
            {"name": "drive_lag", "indistinguishable_from": [], "parameters": []}]})
        store.write()
    rows = rows_of(tmp_path / "out", "diagnose")
    row, said = rows["a"], tree["rig_data"][0]
    assert row["rig_data"][0] == {key: said[key] for key in said if key != "found"} | said["found"]
    assert row["probability_unexplained"] == tree["probability"]["unexplained"]
    assert row["effects"][0]["intervals_s"] == [[3.2, 5.1], [8.0, 9.4], [17.25, 21.0]]
    assert phrases(row)[:3] == [
        "charge_pressure: the config says 2000 kPa, the recording 300.0 ± 2.0 kPa, 99 %",
        "mass: the config says 20 kg, the recording 25.10 ± 0.20 kg, 71 %, or added mass",
        "intermittent load (F = −95.2 ± 1.6 N), 86 %, or constant load"]
    assert phrases(rows["old"]) == ["drive lag"]  # of a version that knew no probabilities
    page = Page(archive_page(list(rows.values()), "diagnose", settings_from_tree({}, "x"),
                             tmp_path, "2")).text
    assert all(phrase in page for phrase in phrases(row))


def test_diagnose_of_a_folder_is_diagnose_of_its_bags(tmp_path, monkeypatch, capsys):
    settings = settings_from_tree({}, "test")
    (tmp_path / "in").mkdir()
    for k in range(2):  # at rest, which is told at once
        noise = np.random.default_rng(k).normal(0.0, 1e-6, 1000)
        write_channels(tmp_path / "in" / f"bag{k}", {"x": noise, "x_d": np.zeros(1000)},
                       settings, start_ns=START)
    counted(monkeypatch)
    assert main(["diagnose", str(tmp_path / "in"), "--out", str(tmp_path / "out")]) == 0
    assert main(["diagnose", str(tmp_path / "in/bag1"), "--json", str(tmp_path / "a.json")]) == 0
    row = rows_of(tmp_path / "out", "diagnose")["bag1"]
    for key, value in diagnosis_columns(json.loads((tmp_path / "a.json").read_text())).items():
        assert row[key] == value, key
    assert row["verdict"] == "insufficient_data"
    said = " ".join(capsys.readouterr().out.split())
    assert "verdicts: 2 insufficient data" in said


def test_a_process_that_dies_costs_its_own_bag_only():
    answers = list(on_this_machine(killed_by_three, range(5), 2))
    assert sorted(argument for argument, _, _ in answers) == list(range(5))
    assert {argument: error for argument, _, error in answers if error} == {3: DIED}
    assert all(answer == number * number for number, answer, error in answers if not error)


def test_a_defect_is_a_row_too(folder, monkeypatch):
    def broken(*arguments):
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr("eha_monitor.api.estimate.run", broken)
    settings = settings_from_tree({}, "test")
    row = row_of(Task("n0", folder / "october/n0", "estimate", settings, "1", "2"))
    assert row["error"].startswith("defect of eha_monitor: ZeroDivisionError: a defect at ")
    assert row["bag"] == "n0"


def test_a_cluster_says_the_same(folder, answered, tmp_path, capsys):
    distributed = pytest.importorskip(
        "distributed", reason="distributed is not installed (make setup WITH=dask)")
    arguments = ["estimate", str(folder), "--out", str(tmp_path)]
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1,
                                  dashboard_address=None) as cluster:
        assert main([*arguments, "--scheduler", cluster.scheduler_address]) == 0
    there, here = rows_of(tmp_path), rows_of(answered)
    assert there.keys() == here.keys()
    for name, row in there.items():
        differ = [key for key in row if key not in OF_THE_RUN and row[key] != here[name][key]]
        assert not differ, name
    for address, words in ((cluster.scheduler_address, "no Dask scheduler answers there"),
                           ("nonsense", "missing port number")):
        assert words in refused(capsys, *arguments, "--scheduler", address)


def test_every_column_is_documented():
    text = (ROOT / "docs/archive.md").read_text(encoding="utf-8")
    for column in COLUMNS:
        assert re.search(rf"^\|.*`{re.escape(column.name)}`.*\|", text, re.MULTILINE), column.name


def test_stamps_that_are_no_dates_are_not_written_as_dates():
    settings = settings_from_tree({}, "test")
    bag = Path(__file__).parents[1] / "bags" / "air_ingress"  # its stamps count from 0
    row = row_of(Task("air", bag, "estimate", settings, "1", "2"))
    assert row.get("error") is None and row.get("start") is None
    text = Page(archive_page([row], "estimate", settings, bag.parent, "2")).text
    assert "1970" not in text and "600" in text
    assert text.count("one standard deviation") == 1


def test_what_is_not_judged_is_no_ok_in_a_row():
    alarm = {"name": "viscous_damping_high", "level": "WARN", "message": "not judged: B 1080",
             "time_s": 3.0, "not_judged": True}
    fine = {"name": "bulk_modulus_low", "level": "OK", "message": "", "time_s": 0.0,
            "not_judged": False}
    one = {"value": 1080.0, "stddev": 1.0, "unit": "", "status": "converged"}
    tree = {"duration_s": 8.0, "samples": 8000, "parameters": {"B": one, "beta_e": one},
            "alarms": [alarm, fine], "losses": [],
            "model": {"status": "mismatch", "message": "", "mismatches": [], "tainted": {}}}
    row = estimate_columns(tree)
    assert (row["viscous_damping_high"], row["bulk_modulus_low"]) == ("not judged", "OK")
    assert (row["alarm"], row["alarm_message"]) == ("not judged", "not judged: B 1080")


@pytest.mark.parametrize(("limit", "level"), [("8 mL/min", "ERROR"), ("8 L/min", "OK"),
                                              (None, None)])
def test_a_limit_of_an_indicator_is_an_alarm_of_the_row(limit, level):
    settings = settings_from_tree({"health": {"leakage_limit": limit}}, "test")
    leak = Indicator("leakage", 16.0, 1.0, 1.0, "mL/min", AVAILABLE, "", "")
    row = limit_columns((leak,), settings)
    assert row.get("alarm") == level
    assert (row.get("alarm_message") == "internal leakage of 16.0 ± 1.0 mL/min is beyond its "
            "limit") == (level == "ERROR")
    words = summary_words([row], "estimate")
    assert ("no limit is set" in words) == (limit is None)


def test_models_that_do_not_fit_for_one_reason_are_one_line(tmp_path, capsys):
    row = {"model": "mismatch", "model_balance": "force balance", "made_with": "1"}
    rows = [row | {"bag": f"b{k}"} for k in range(5)]
    rows[0] |= {"alarm": "ERROR", "alarm_message": "B is too high"}
    show(rows, "estimate", settings_from_tree({}, "test"), "1", tmp_path, 5, [])
    said = capsys.readouterr().out
    assert "4 recordings: the model does not fit: force balance" in said
    assert "b0" in said and "B is too high" in said and "b3" not in said


def test_each_bag_of_a_folder_is_judged_against_the_healthy_machine(tmp_path, capsys):
    """What a machine's weeks are: three healthy days, then dry friction."""
    folder, file, out = tmp_path / "weeks", tmp_path / "machine.json", tmp_path / "out"
    folder.mkdir()
    for day in range(4):
        shape = {**MULTISINE, "frequency_end": 4.0, "seed": day}
        dry = {"coulomb_friction": {"F_c": 40.0}} if day == 3 else {}
        run = simulated(shape, 12.0, effects=dry)
        write_channels(folder / f"d{day}", run.recording(day).channels, run.config,
                       start_ns=START + day * 86_400 * 10**9)
    healthy = [str(folder / f"d{day}") for day in range(3)]
    assert main(["diagnose", *healthy, "--machine", str(file)]) == 0
    judged = ["diagnose", str(folder), "--machine", str(file), "--out", str(out), "--jobs", "1"]
    assert main([*judged, "--exit-code"]) == 1
    rows = rows_of(out, "diagnose")
    assert [rows[f"d{day}"]["verdict"] for day in range(4)] == ["consistent"] * 3 + ["mismatch"]
    assert [one["name"] for one in rows["d3"]["effects"]] == ["coulomb_friction"]
    page = Page((out / "diagnose.html").read_text()).text
    assert "Effects that have changed" in page and f"--machine {file}" in page
    said = capsys.readouterr().out
    assert "nothing has changed" not in said and "the model does not fit" not in said
    file.write_text(file.read_text() + "\n")  # another machine: all anew
    assert main(judged) == 0
    assert "4 bags, 4 processed now" in capsys.readouterr().out
    assert main([*judged[:3], str(tmp_path / "none.json"), "--out", str(out)]) == 2
